"""Source of a gait: `options -> gait file, walk file, gait network or files of the package -> verified gait`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from atalante_tools.console.options import GaitFiles
from atalante_tools.console.stop_request import check_stop
from atalante_tools.console.terminal import print_message
from atalante_tools.session.extra import extra

if TYPE_CHECKING:
    from atalante_control.gait.gait import Gait
    from atalante_control.gait.subject import Subject
    from atalante_control.gait.walk import WalkGaits
    from atalante_control.model import ExoskeletonParameters, Patient
    from atalante_hal.robot import Robot


def gait_in_the_air(files: GaitFiles, subject: Subject | None, robot: Robot) -> tuple[ExoskeletonParameters, Gait, str]:
    """Return the empty exoskeleton, its periodic gait, and a text that states the source of the gait.

    Args:
        files: Files of the gait. Without a file and without a subject, the gait is that of the package.
        subject: Patient and step; None for the patient in the gait file.
        robot: Limits of the joints.

    Raises:
        GaitError: If the gait file is invalid.
        NetworkError: If the network file is invalid, or the subject is outside the range of the network.
    """
    from atalante_control.dynamics.gait_network import load_network
    from atalante_control.dynamics.suspended import suspended_gait
    from atalante_control.gait.gait import AIRWALK_GAIT, load_gait
    from atalante_control.gait.walk import load_gaits
    from atalante_control.model import ExoskeletonParameters

    exoskeleton = ExoskeletonParameters()
    if files.gait is not None:
        loaded = load_gaits(files.gait, robot)
        gait = _periodic_step(loaded)
        patient = patient_in(gait, files.gait) if subject is None else subject.patient
        if patient is not None:
            exoskeleton = exoskeleton.fitted(patient)
        # A gait for the ground contains feedforward torques that support the weight of the patient.
        # Replace these feedforward torques with the torques of a walk in the air.
        if gait.feedforward is not None:
            gait = suspended_gait(gait, exoskeleton, robot)
        return exoskeleton, gait, f"gait of {files.gait}: {gait.name}"
    if subject is None:
        return exoskeleton, load_gait(AIRWALK_GAIT, robot), ""
    exoskeleton = exoskeleton.fitted(subject.patient)
    gait = load_network(files.network).gait(subject, robot)
    return exoskeleton, suspended_gait(gait, exoskeleton, robot), f"gait of the network: {subject}"


def patient_of_files(files: GaitFiles, patient: Patient | None, robot: Robot) -> Patient | None:
    """Return the patient of an emulated robot: the patient that the user gave, otherwise the patient in the gait file.

    The robot gets the leg lengths of this patient. The result is None if neither the user nor the file states a patient.

    Args:
        files: Files of the gait. They are checked, and the network must cover the patient.
        patient: Patient that the user gave, or None.
        robot: Limits of the joints.

    Raises:
        GaitError: If the gait file is invalid.
        NetworkError: If the network file is invalid, or the patient is outside the range of the network.
    """
    from atalante_control.dynamics.gait_network import load_network
    from atalante_control.gait.walk import load_gaits

    if files.network is not None and patient is not None:
        load_network(files.network).check_patient(patient)
    if files.gait is None:
        return patient
    loaded = load_gaits(files.gait, robot)
    stated = patient_in(_periodic_step(loaded), files.gait)
    return stated if patient is None else patient


def gaits_of_file(path: Path, patient: Patient | None, robot: Robot) -> tuple[Patient, WalkGaits]:
    """Return the patient and the gaits of a walk from a file.

    A gait file contains only the periodic step. Its start step and stop step are computed by the gait optimisation.

    Args:
        path: Path of a gait file or walk file.
        patient: Patient that the user gave; None for the patient in the file.
        robot: Limits of the joints.

    Raises:
        GaitError: If the file is invalid, states no patient, or has no start step or stop step.
        Failed: If the gait optimisation is needed, but not installed.
    """
    from atalante_control.gait.gait import Gait, GaitError
    from atalante_control.gait.subject import Subject
    from atalante_control.gait.walk import load_gaits

    loaded = load_gaits(path, robot)
    gait = _periodic_step(loaded)
    patient = patient_in(gait, path) if patient is None else patient
    if patient is None:
        raise GaitError(
            f"{path}: the patient is unknown; add --mass and --height, or patient_mass and patient_height in the parameters"
        )
    if not isinstance(loaded, Gait):
        return patient, loaded
    if "step_length" not in gait.parameters:
        raise GaitError(
            f"{path}: the parameters must contain step_length, which is needed to compute the start step and the stop step"
        )
    try:
        subject = Subject(patient, gait.parameters["step_length"], gait.duration)
    except ValueError as error:
        raise GaitError(f"{path}: {error}") from error
    return patient, with_start_and_stop(subject, gait)


def with_start_and_stop(subject: Subject, step: Gait) -> WalkGaits:
    """Return a periodic gait together with a start step and a stop step, which the gait optimisation computes.

    Args:
        subject: Patient and step.
        step: Periodic gait.

    Raises:
        GaitError: If there is no start step or no stop step for the gait.
        Failed: If the gait optimisation is not installed.
        Stopped: If a signal arrived during the optimisation.
    """
    print_message(f"solving start step and stop step for {subject}")
    with extra():
        from atalante_control.gait_optimization.walk import solve_walk

        try:
            return solve_walk(subject, step)
        finally:
            # A stop signal raises `Stopped`, but the optimiser catches this exception.
            # After a stop signal, the optimiser returns a wrong result or raises `GaitError`. So raise `Stopped` again.
            check_stop()


def patient_in(gait: Gait, path: Path) -> Patient | None:
    """Return the patient in the parameters of a gait, or None if the parameters state no patient.

    Args:
        gait: Gait of a file.
        path: Path of the file, for the error message.

    Raises:
        GaitError: If the parameters of the patient are out of range.
    """
    from atalante_control.gait.gait import GaitError
    from atalante_control.gait.subject import patient_of

    try:
        return patient_of(gait.parameters)
    except KeyError:
        return None
    except ValueError as error:
        raise GaitError(f"{path}: {error}") from error


def _periodic_step(loaded: Gait | WalkGaits) -> Gait:
    """Return the periodic step of a loaded gait file or walk file."""
    from atalante_control.gait.gait import Gait

    return loaded if isinstance(loaded, Gait) else loaded.step

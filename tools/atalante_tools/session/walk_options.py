"""Options of a walk on the ground, and its gaits: `options -> patient, start step, periodic step, stop step`."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Final

from atalante_tools.console.options import GaitFiles
from atalante_tools.session.gait_source import gaits_of_file, with_start_and_stop
from atalante_tools.session.law import Law
from atalante_tools.session.recording import RecordingOptions

if TYPE_CHECKING:
    from atalante_control.gait.subject import Subject
    from atalante_control.gait.walk import WalkGaits
    from atalante_control.model import Patient
    from atalante_control.walking.section import Section
    from atalante_hal.robot import Robot

#: Patient of the default walk file: mass [kg] and height [m].
DEFAULT_PATIENT: Final = (75.0, 1.75)
#: Step of the default walk file: length [m] and duration [s].
DEFAULT_STEP: Final = (0.16, 0.8)


@dataclass(frozen=True)
class Push:
    """Push at the pelvis of the emulated robot. The push begins at a given phase of a periodic step."""

    force: float  # force of the push [N]
    direction: float  # direction of the push relative to the desired line [deg]: 0 is forwards, 90 is to the left
    duration: float = 0.2  # duration of the push [s]
    step: int | None = None  # index of the pushed step, from 0; None means the middle step of the walk
    phase: float = 0.3  # phase of the push: time since the start of the step divided by the duration of the step


@dataclass(frozen=True)
class SpeedChange:
    """Change of step length and step duration during a walk."""

    steps: int  # number of periodic steps from this change to the next change or to the stop step
    subject: Subject  # patient of the walk, and the step parameters after the change


@dataclass(frozen=True)
class WalkOptions:
    """Options of a walk."""

    steps: int  # number of periodic steps before the first speed change; without a change: before the stop step
    xi: float  # assistance factor, 0 to 1
    shape: str  # name or file of the guide shape
    passive: bool  # whether the emulated patient has the impedance of relaxed legs; False: the legs are masses only
    subject: Subject | None  # patient and step parameters; None means the values in the walk file
    #: Gait file or network file of the user. If the user gives neither, the gaits come from files of the package.
    #: The package has a walk file for the default subject, and a gait network for every other subject.
    files: GaitFiles
    seed: int  # seed of the sensor noise
    friction: float  # coefficient of friction between soles and floor
    push: Push | None  # push at the pelvis; None means no push
    law: Law  # control law of the periodic steps
    #: Numbers of steps in the three parts of the walk: with full assistance, in the transition to `xi`, and with `xi`.
    #: None means that all steps have the assistance factor `xi`.
    protocol: tuple[int, int, int] | None = None
    #: Options of recording, CAN log and telemetry. If none of these outputs is requested, no telemetry process is started.
    recording: RecordingOptions = field(default_factory=RecordingOptions)
    #: Whether the emulated robot runs in a process of its own; None: only if enough processor cores are idle.
    robot_process: bool | None = None
    #: Whether the pelvis IMU has a heading reference, so that the measured heading does not drift.
    #: With a heading reference, the controller corrects its estimated heading with the measured heading.
    heading_reference: bool = False
    then: tuple[SpeedChange, ...] = ()  # speed changes, in walking order
    turn: float = 0.0  # angle by which the walking line turns before each periodic step, positive to the left [deg]
    out: Path | None = None  # folder for summary.json, trace.npz and walk.png; None means no files


def gaits_of(options: WalkOptions, robot: Robot) -> tuple[Patient, WalkGaits]:
    """Return the patient and the gaits of a walk.

    Args:
        options: Options of the user.
        robot: Limits of the joints.

    Raises:
        GaitError: If the file of the gait is invalid, if a step fails a check on the ground, or if there is no start step or
            no stop step for the gait.
        NetworkError: If the network file is invalid, or if the subject is outside the range of the network.
        Failed: If the gait optimisation is needed, but not installed.
    """
    from atalante_control.gait.subject import Subject
    from atalante_control.gait_optimization.walk_verification import check_on_ground
    from atalante_control.model import Patient

    subject, file = options.subject, options.files.gait
    if file is not None:
        patient, gaits = gaits_of_file(file, None if subject is None else subject.patient, robot)
        check_on_ground(gaits, patient, robot, str(file))
        return patient, gaits
    if subject is None:
        subject = Subject(Patient(*DEFAULT_PATIENT), *DEFAULT_STEP)
    return subject.patient, gaits_of_subject(subject, robot, options.files.network)


def sections_of(options: WalkOptions, robot: Robot) -> list[Section]:
    """Return one section of the walk for each speed change, in walking order.

    A section is a group of successive steps with the same gait. It begins at the speed change.

    Args:
        options: Options of the user.
        robot: Limits of the joints.

    Raises:
        GaitError: If there is no start step or no stop step for a gait, or if a step fails a check on the ground.
        NetworkError: If a step is outside the range of the network.
        Failed: If the gait optimisation is needed, but not installed.
    """
    from atalante_control.walking.section import Section

    network = options.files.network
    return [Section(gaits_of_subject(change.subject, robot, network), change.steps) for change in options.then]


@cache
def solved_gaits(subject: Subject, network: Path | None = None) -> WalkGaits:
    """Return the gaits of a subject, computed for the default joint limits. The gaits are computed once per process.

    Args:
        subject: Patient and step.
        network: Network file; None means the network of the package.

    Raises:
        Stopped: If a signal arrived during the optimisation.
    """
    from atalante_hal.robot import load_robot

    return gaits_of_subject(subject, load_robot(), network)


def gaits_of_subject(subject: Subject, robot: Robot, network: Path | None = None) -> WalkGaits:
    """Return start step, periodic step and stop step of a subject.

    The gaits of the default subject are read from the default walk file, unless `network` is given. In all other cases,
    the gait network (a neural network) computes the periodic step. The gait optimisation then computes start step and stop step.

    Args:
        subject: Patient and step.
        robot: Limits of the joints.
        network: File of the gait network; None means the network of the package.

    Raises:
        GaitError: If there is no start step or no stop step for the gait, or if a step fails a check on the ground.
        NetworkError: If the network file is invalid, or if the subject is outside the range of the network.
        Failed: If the gait optimisation is needed, but not installed.
    """
    from atalante_control.dynamics.gait_network import load_network
    from atalante_control.gait.gait import check_gait
    from atalante_control.gait.walk import DEFAULT_WALK, check_walk, load_walk
    from atalante_control.gait_optimization.walk_verification import check_on_ground

    if network is None and _is_default(subject):
        gaits, where = load_walk(DEFAULT_WALK, robot), str(DEFAULT_WALK)
    else:
        where = "gait of the network" if network is None else f"gait of the network {network}"
        step = load_network(network).gait(subject, robot)
        check_gait(step, robot, where)  # an invalid gait is rejected before the solver starts
        gaits = with_start_and_stop(subject, step)
        check_walk(gaits, robot, where)
    check_on_ground(gaits, subject.patient, robot, where)
    return gaits


def _is_default(subject: Subject) -> bool:
    from atalante_control.gait.subject import Subject
    from atalante_control.model import Patient

    return subject.parameters() == Subject(Patient(*DEFAULT_PATIENT), *DEFAULT_STEP).parameters()

"""Body of the emulated robot: exoskeleton and patient in a physics engine, suspended at the pelvis or on the ground."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib.util import find_spec
from typing import TYPE_CHECKING, Final

from atalante_hal.robot import LEG_JOINTS, Robot
from atalante_tools.console.options import PYBULLET
from atalante_tools.console.outcome import Failed

if TYPE_CHECKING:
    from atalante_control.gait.walk import WalkGaits
    from atalante_control.model import ExoskeletonParameters, Patient
    from atalante_emulator.bodies import Body
    from atalante_emulator.mechanics import Mechanics
    from atalante_emulator.patient import ActiveParameters, ActiveTask


#: Newest Python version for which the package index has a wheel of PyBullet.
ENGINE_PYTHON: Final = (3, 11)
_NAMES: Final = {"pybullet": "PyBullet", "mujoco": "MuJoCo"}


def engine_hint() -> str:
    """Return a text with the commands that install a physics engine, and the newest Python version with a PyBullet wheel."""
    python = sys.version_info[:2]
    newest = "{}.{}".format(*ENGINE_PYTHON)
    if python <= ENGINE_PYTHON:
        return f"pip install 'atalante-hal[emulator]' (Python {newest})"
    reason = f"PyBullet has no wheel for Python above {newest}, got {python[0]}.{python[1]}"
    return (
        "pip install 'atalante-hal[mujoco]' and add --engine mujoco, "
        f"or python{newest} -m pip install 'atalante-hal[emulator]' ({reason})"
    )


def require_engine(engine: str = PYBULLET) -> None:
    """Check that a physics engine is installed, without importing it.

    Args:
        engine: Name of the engine.

    Raises:
        Failed: If the engine is not installed. The message contains the command that installs it.
    """
    if find_spec(engine) is None:
        hint = engine_hint() if engine == PYBULLET else "pip install 'atalante-hal[mujoco]'"
        raise Failed(f"the emulated robot needs {_NAMES[engine]}; type: {hint}")


def active_task(
    gaits: WalkGaits, patient: Patient, seed: int, parameters: ActiveParameters | None = None
) -> ActiveTask:
    """Return the task of an active patient: the hip and knee angles that the swing leg must track in each step.

    Args:
        gaits: Gaits of the walk.
        patient: Mass and height of the patient.
        seed: Seed of the noise of the muscles.
        parameters: Parameters of the patient. None means the default parameters.
    """
    from atalante_emulator.patient import ActiveParameters, ActiveTask

    first = LEG_JOINTS.index("SH")
    swing = [(hip, knee) for hip, knee in gaits.step.tables().q[:, first : first + 2].tolist()]
    return ActiveTask(patient.mass, patient.height, swing, seed, parameters or ActiveParameters())


def describe(robot: Robot, exoskeleton: ExoskeletonParameters | None = None, wearer: Patient | None = None) -> str:
    """Return the URDF text of the exoskeleton, without or with a patient.

    Args:
        robot: Joint limits of the robot.
        exoskeleton: Geometry and masses. None means default leg lengths.
        wearer: Patient whose segments are part of the links. If None, the exoskeleton is empty.
    """
    from atalante_control.model import ExoskeletonParameters, urdf

    return urdf(exoskeleton or ExoskeletonParameters(), robot, wearer)


@contextmanager
def open_body(robot: Robot, *, engine: str = PYBULLET) -> Iterator[Body]:
    """Create the body of an empty exoskeleton that is suspended at its pelvis, and close it after the block.

    Args:
        robot: Joint limits of the robot.
        engine: Name of the physics engine.

    Raises:
        Failed: If the engine is not installed.
    """
    from atalante_emulator.mechanics import Mechanics

    with open_mechanics(Mechanics(describe(robot), engine)) as body:
        yield body


@contextmanager
def open_mechanics(mechanics: Mechanics, pose: Sequence[float] | None = None) -> Iterator[Body]:
    """Create the body of an emulated robot, and close it after the block.

    Args:
        mechanics: Description of the body.
        pose: Initial joint angles, shape (12,) [rad]. None means all zero.

    Raises:
        Failed: If the engine is not installed.
    """
    require_engine(mechanics.engine)
    with no_banner():
        body = mechanics.make_body(pose)
    try:
        yield body
    finally:
        body.close()


@contextmanager
def no_banner() -> Iterator[None]:
    """Discard all output to stderr inside the block. This includes output of C code, such as the import banner of PyBullet."""
    sys.stderr.flush()
    terminal, nowhere = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nowhere, 2)
        yield
    finally:
        os.dup2(terminal, 2)
        os.close(terminal)
        os.close(nowhere)

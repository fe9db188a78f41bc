"""Body of the emulated robot: an exoskeleton without a patient in PyBullet, suspended at its pelvis."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib.util import find_spec
from typing import TYPE_CHECKING, Final

from atalante_hal.robot import Robot
from atalante_tools.console.outcome import Failed

if TYPE_CHECKING:
    from atalante_control.model import ExoskeletonParameters
    from atalante_emulator.body import PyBulletBody


#: Newest Python version for which the package index has a wheel of PyBullet.
ENGINE_PYTHON: Final = (3, 11)


def engine_hint() -> str:
    """Return the command that installs PyBullet, together with the Python version that it requires."""
    python = sys.version_info[:2]
    newest = "{}.{}".format(*ENGINE_PYTHON)
    if python <= ENGINE_PYTHON:
        return f"pip install 'atalante-hal[emulator]' (Python {newest})"
    reason = f"PyBullet has no wheel for Python above {newest}, got {python[0]}.{python[1]}"
    return f"python{newest} -m pip install 'atalante-hal[emulator]' ({reason})"


def require_engine() -> None:
    """Check that PyBullet is installed, without importing it.

    Raises:
        Failed: If PyBullet is not installed. The message contains the command that installs it.
    """
    if find_spec("pybullet") is None:
        raise Failed(f"the emulated robot needs PyBullet; type: {engine_hint()}")


def describe(robot: Robot, exoskeleton: ExoskeletonParameters | None = None) -> str:
    """Return the URDF text of the exoskeleton.

    Args:
        robot: Joint limits of the robot.
        exoskeleton: Geometry and masses. None: default leg lengths.
    """
    from atalante_control.model import ExoskeletonParameters, urdf

    return urdf(exoskeleton or ExoskeletonParameters(), robot)


@contextmanager
def open_body(
    robot: Robot, pose: Sequence[float] | None = None, exoskeleton: ExoskeletonParameters | None = None
) -> Iterator[PyBulletBody]:
    """Create the body of a robot in PyBullet, and close it after the block.

    Args:
        robot: Joint limits of the robot.
        pose: Initial joint angles, shape (12,) [rad]. None: all zero.
        exoskeleton: Geometry and masses. None: default leg lengths.

    Raises:
        Failed: If PyBullet is not installed.
    """
    require_engine()
    with open_described(describe(robot, exoskeleton), pose) as body:
        yield body


@contextmanager
def open_described(urdf: str, pose: Sequence[float] | None = None) -> Iterator[PyBulletBody]:
    """Create a body from a URDF in PyBullet, and close it after the block.

    Args:
        urdf: URDF text.
        pose: Initial joint angles, shape (12,) [rad]. None: all zero.
    """
    with no_banner():
        from atalante_emulator.body import PyBulletBody
    body = PyBulletBody(urdf)
    try:
        if pose is not None:
            body.reset(pose)
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

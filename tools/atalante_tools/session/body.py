"""The body of an emulated robot: the empty exoskeleton hanging from its pelvis, in PyBullet."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib.util import find_spec
from typing import TYPE_CHECKING

from atalante_hal.robot import Robot
from atalante_tools.console.outcome import Failed

if TYPE_CHECKING:
    from atalante_control.model import ExoskeletonParameters
    from atalante_emulator.body import PyBulletBody


def require_engine() -> None:
    """Raise `Failed` with what to type where PyBullet is not installed."""
    if find_spec("pybullet") is None:
        raise Failed("the emulated robot needs PyBullet: type `pip install 'atalante-hal[emulator]'`")


def describe(robot: Robot, exoskeleton: ExoskeletonParameters | None = None) -> str:
    """Its URDF; the legs as they come from the factory unless an exoskeleton is given."""
    from atalante_control.model import ExoskeletonParameters, urdf

    return urdf(exoskeleton or ExoskeletonParameters(), robot)


@contextmanager
def open_body(
    robot: Robot, pose: Sequence[float] | None = None, exoskeleton: ExoskeletonParameters | None = None
) -> Iterator[PyBulletBody]:
    """The body of a robot. `pose` shape (12,) [rad].

    Raises:
        Failed: PyBullet is not installed.
    """
    require_engine()
    with open_described(describe(robot, exoskeleton), pose) as body:
        yield body


@contextmanager
def open_described(urdf: str, pose: Sequence[float] | None = None) -> Iterator[PyBulletBody]:
    """The body of a URDF. `pose` shape (12,) [rad]."""
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
    """Keep what a library's C code prints on import off the terminal."""
    sys.stderr.flush()
    terminal, nowhere = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nowhere, 2)
        yield
    finally:
        os.dup2(terminal, 2)
        os.close(terminal)
        os.close(nowhere)

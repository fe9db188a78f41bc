"""Checks that cannot run: their messages come and carry no values, so that a fault they look for would not be found.

A check uses values up to the timeout of their message, see `finding.Rows`. A node that is silent for longer is the message
monitor's: it ends in HOLD within 10 cycles. A node that goes on sending messages without values does not: an IMU that says that
it has none for good leaves the robot in FULL_ASSIST, where the encoders of its leg are compared with nothing.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from atalante_hal.robot import FEET, IMUS, JOINTS, LEG_JOINTS, SIDES
from atalante_hal.safety.diagnostics import Dtc
from atalante_hal.safety.plausibility.finding import FOOT_NODES, JOINT_NODES, Cycles, Finding, Rows
from atalante_hal.wire.e2e import Check
from atalante_hal.wire.process_image import NEVER

#: Cycles on end in which a check could not run, after which it counts as failed: the slowest finds its fault in as many.
UNCHECKED_CYCLES = 128
#: Joints of a leg whose encoders are compared with the IMUs.
_COMPARED = 4


class _Check(NamedTuple):
    dtc: Dtc
    node: str
    rows: list[int]  # it needs
    what: str  # it checks


class Unchecked:
    """Counts for how long each check could not run.

    Args:
        check: `Check` of each row of the image, shape (rows,); read in each `judge`.
        every: cycles between two calls of `judge`.
    """

    def __init__(self, rows: Rows, check: npt.NDArray[np.uint8], every: int) -> None:
        self._every, self._timeout, self._check = every, rows.timeout, check
        self._checks = tuple(_checks(rows))
        self._cycles = [0] * len(self._checks)
        self._findings: tuple[Finding, ...] = ()

    def judge(self, age: Cycles | None) -> bool:
        """Count the checks that could not run now.

        Args:
            age: of each row of the image [cycles], shape (rows,); from `NEVER` on it never had values, and what needs it is not
                counted: the robot is not READY without it. None: all values are of this cycle. A check that needs a silent row
                keeps its count.

        Returns:
            Whether a check could not run.
        """
        if age is None:
            self._cycles = [0] * len(self._checks)
        else:
            too_old = (age >= self._timeout) & (age < NEVER)
            empty = (too_old & (self._check >= Check.RANGE)).tolist()
            missed = too_old.tolist()
            self._cycles = [
                cycles + self._every
                if any(empty[row] for row in check.rows)
                else cycles
                if any(missed[row] for row in check.rows)
                else 0
                for check, cycles in zip(self._checks, self._cycles, strict=True)
            ]
        self._findings = tuple(
            _unchecked(check, cycles) for check, cycles in zip(self._checks, self._cycles, strict=True) if cycles
        )
        return bool(self._findings)

    def findings(self) -> tuple[Finding, ...]:
        """Return what stands."""
        return self._findings


def _checks(rows: Rows) -> Iterator[_Check]:
    """Yield the checks that compare several values; those of one value run whenever it comes."""
    joints, imus, feet = rows.joint.tolist(), rows.imu.tolist(), rows.foot.tolist()
    for joint, row in enumerate(joints):
        yield _Check(Dtc.ENC_VELOCITY, JOINT_NODES[joint], [row], f"the velocity of {JOINTS[joint]}")
    for leg, side in enumerate(SIDES):
        hip = leg * len(LEG_JOINTS)
        needed = [*joints[hip : hip + _COMPARED], imus[IMUS.index("pelvis")], imus[IMUS.index(f"{side}_tibia")]]
        yield _Check(Dtc.ENC_DRIFT, JOINT_NODES[hip], needed, f"what encoders and IMUs say of the {side} leg")
    for foot, row in enumerate(feet):
        yield _Check(Dtc.FOOT_CELL, FOOT_NODES[foot], [row], f"the force cells of the {FEET[foot]} foot")


def _unchecked(check: _Check, cycles: int) -> Finding:
    text = f"{check.what} could not be checked for {cycles} cycles"
    return Finding(check.dtc, check.node, float(cycles), cycles >= UNCHECKED_CYCLES, text)

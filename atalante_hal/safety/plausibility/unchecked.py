"""Monitor of the checks that cannot run because their messages contain no usable values.

A check uses values that are younger than the timeout of their message, see `finding.Rows`. If a node sends nothing for longer,
the message monitor brings the robot to HOLD within 10 cycles. If a node keeps sending messages without values, the robot may keep
moving. For example, an IMU that permanently sends its invalid code leaves the robot in FULL_ASSIST. Then the encoders of its leg
are not checked against the IMUs, and this module reports it.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from atalante_hal.robot import FEET, IMUS, JOINTS, LEG_JOINTS, SIDES
from atalante_hal.safety.diagnostics import Dtc, Finding
from atalante_hal.safety.plausibility.finding import FOOT_NODES, JOINT_NODES, Cycles, Rows
from atalante_hal.wire.e2e import Check
from atalante_hal.wire.process_image import NEVER

#: Time without a check after which its diagnostic is confirmed [cycles]. It is the detection time of the slowest check.
UNCHECKED_CYCLES = 128
#: Number of encoders per leg that are compared with the IMUs.
_COMPARED = 4


class _SensorCheck(NamedTuple):
    dtc: Dtc
    node: str
    rows: list[int]  # rows of the process image that the check needs
    quantity: str  # checked quantity, for the text of the finding


class Unchecked:
    """Measurement of the time for which each check could not run.

    Args:
        rows: rows and timeouts of the sensor messages.
        check: `Check` of each row of the process image, shape (rows,); read in each `judge`.
        every: interval between two calls of `judge` [cycles].
    """

    def __init__(self, rows: Rows, check: npt.NDArray[np.uint8], every: int) -> None:
        self._every, self._timeout, self._check = every, rows.timeout, check
        self._checks = tuple(_checks(rows))
        self._cycles = [0] * len(self._checks)
        self._findings: tuple[Finding, ...] = ()

    def judge(self, age: Cycles | None) -> bool:
        """Update the time for which each check could not run.

        The time of a check grows if one of its messages arrives, but without usable values. If one of its messages timed out for
        another reason, the time does not change. Otherwise it is reset.

        Args:
            age: age of each row of the process image [cycles], shape (rows,). A row with an age of `NEVER` or more never had
                values and is not counted, because the robot cannot be READY without it. None if all values are of this cycle.

        Returns:
            Whether any check could not run.
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
        """Return the present findings."""
        return self._findings


def _checks(rows: Rows) -> Iterator[_SensorCheck]:
    """Yield the checks: velocity of each joint, encoders against IMUs of each leg, force cells of each foot."""
    joints, imus, feet = rows.joint.tolist(), rows.imu.tolist(), rows.foot.tolist()
    for joint, row in enumerate(joints):
        yield _SensorCheck(Dtc.ENC_VELOCITY, JOINT_NODES[joint], [row], f"the velocity of {JOINTS[joint]}")
    for leg, side in enumerate(SIDES):
        hip = leg * len(LEG_JOINTS)
        needed = [*joints[hip : hip + _COMPARED], imus[IMUS.index("pelvis")], imus[IMUS.index(f"{side}_tibia")]]
        yield _SensorCheck(Dtc.ENC_DRIFT, JOINT_NODES[hip], needed, f"the encoders against the IMUs of the {side} leg")
    for foot, row in enumerate(feet):
        yield _SensorCheck(Dtc.FOOT_CELL, FOOT_NODES[foot], [row], f"the force cells of the {FEET[foot]} foot")


def _unchecked(check: _SensorCheck, cycles: int) -> Finding:
    text = f"{check.quantity} could not be checked for {cycles} cycles"
    return Finding(check.dtc, check.node, float(cycles), cycles >= UNCHECKED_CYCLES, text)

"""Monitor of the checks that cannot run because their messages contain no usable values.

A check uses values that are younger than the timeout of their message, see `signals.Rows`. If a node sends no message,
the message monitor brings the robot to HOLD within 10 cycles. If a node sends messages without usable values, the robot
may keep moving. For example, the robot stays in FULL_ASSIST if an IMU permanently sends the code for invalid values.
Then the encoders of the leg are not checked against the IMUs, and this module reports the missing check. The checks that need
only one IMU are not reported here, because an IMU without usable values is itself reported with the same reaction.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from atalante_hal.dbc_names import FOOT_NODES, IMU_NODES, JOINT_NODES
from atalante_hal.robot import FEET, IMUS, JOINTS, LEG_JOINTS, SIDES
from atalante_hal.safety.diagnostics import Dtc, Finding
from atalante_hal.safety.plausibility.signals import Cycles, Rows
from atalante_hal.wire.e2e import Check
from atalante_hal.wire.process_image import NEVER

#: Time for which a check may lack usable data before its diagnostic is confirmed [cycles].
#: With usable data, even the slowest check detects a fault within `UNCHECKED_CYCLES`.
UNCHECKED_CYCLES = 128
#: Number of encoders per leg that are compared with the IMUs.
_COMPARED = 4


class _SensorCheck(NamedTuple):
    dtc: Dtc
    node: str
    rows: list[int]  # rows of the process image that the check needs
    quantity: str  # quantity that the check covers, for the text of the finding


class Unchecked:
    """Measurement of the time for which each check could not run.

    Args:
        rows: rows and timeouts of the sensor messages.
        check: `Check` of each row of the process image, shape (rows,); read in each `evaluate`.
        every: interval between two calls of `evaluate` [cycles].
    """

    def __init__(self, rows: Rows, check: npt.NDArray[np.uint8], every: int) -> None:
        self._every, self._timeout, self._check = every, rows.timeout, check
        self._checks = tuple(_checks(rows))
        self._cycles = [0] * len(self._checks)
        self._findings: tuple[Finding, ...] = ()

    def evaluate(self, age: Cycles | None) -> bool:
        """Update the time for which each check could not run.

        The time of a check grows while one of the required messages arrives without usable values. The time does not
        change while one of these messages has timed out for another reason. In all other cycles the time is reset to 0.

        Args:
            age: age of each row of the process image [cycles], shape (rows,). A row with an age of `NEVER` or more has
                had no values yet and is ignored, because without this message the robot cannot be READY. Pass None if
                all values are of this cycle.

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
        """Return the current findings about checks that cannot run."""
        return self._findings


def _checks(rows: Rows) -> Iterator[_SensorCheck]:
    """Yield the monitored checks: one for each joint velocity, one for each leg, one for the trunk IMUs, one for each foot."""
    joints, imus, feet = rows.joint.tolist(), rows.imu.tolist(), rows.foot.tolist()
    for joint, row in enumerate(joints):
        yield _SensorCheck(Dtc.ENC_VELOCITY, JOINT_NODES[joint], [row], f"the velocity of {JOINTS[joint]}")
    for leg, side in enumerate(SIDES):
        hip = leg * len(LEG_JOINTS)
        needed = [*joints[hip : hip + _COMPARED], imus[IMUS.index("pelvis")], imus[IMUS.index(f"{side}_tibia")]]
        yield _SensorCheck(Dtc.ENC_DRIFT, JOINT_NODES[hip], needed, f"the encoders against the IMUs of the {side} leg")
    torso, pelvis = IMUS.index("torso"), IMUS.index("pelvis")
    yield _SensorCheck(
        Dtc.IMU_IMPLAUSIBLE, IMU_NODES[torso], [imus[torso], imus[pelvis]], "the torso IMU against the pelvis IMU"
    )
    for foot, row in enumerate(feet):
        yield _SensorCheck(Dtc.FOOT_CELL, FOOT_NODES[foot], [row], f"the force cells of the {FEET[foot]} foot")


def _unchecked(check: _SensorCheck, cycles: int) -> Finding:
    text = f"{check.quantity} could not be checked for {cycles} cycles"
    return Finding(check.dtc, check.node, float(cycles), cycles >= UNCHECKED_CYCLES, text)

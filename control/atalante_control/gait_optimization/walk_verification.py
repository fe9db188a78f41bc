"""Verification of a walk before the robot executes it: `start step, periodic step, stop step, patient -> error or nothing`.

The checks and their limits are the same as for the gaits of the network. The checks need no optimiser.
"""

from __future__ import annotations

from atalante_control.gait.gait import GaitError
from atalante_control.gait.walk import WalkGaits
from atalante_control.gait_optimization.verify import INTERPOLATED, Verifier
from atalante_control.model import Patient
from atalante_hal.robot import Robot


def check_on_ground(walk: WalkGaits, patient: Patient, robot: Robot, where: str) -> None:
    """Raise `GaitError` if a step of a walk fails a check of joints, ground forces, clearance, landing or impact.

    Args:
        walk: walk to verify.
        patient: patient in the exoskeleton.
        robot: limits of the joints.
        where: start of the error message, for example the name of the file.

    Raises:
        GaitError: If a step fails a check. The message states the step, the check, the value and the limit.
    """
    verifier = Verifier(robot, patient)
    for name, gait in walk._asdict().items():
        for check in verifier.verify(gait, gait.kind, INTERPOLATED):
            if not check.holds:
                unit = f" {check.unit}" if check.unit else ""
                raise GaitError(
                    f"{where}: {check.name} in {name} must be at most {check.limit:.3g}{unit}, got {check.value:.3g}{unit}"
                )

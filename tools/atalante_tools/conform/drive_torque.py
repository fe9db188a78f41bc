"""Tests of the torque of a drive: zero while disabled, sign and magnitude as commanded, at most MaxTorque."""

from __future__ import annotations

import math

from atalante_hal.wire.cia402 import Controlword, DriveState
from atalante_tools.conform.axis import NOISE, SHOWN, Axis, all_in, mean_torque, names_of, torque_of
from atalante_tools.conform.node_tester import NodeTester
from atalante_tools.conform.requirement import Outcome

_S, _C = DriveState, Controlword


def makes_no_torque_disabled(tester: NodeTester) -> Outcome:
    """Test DRIVE-06: the drive produces no torque in the three states on the way to OPERATION ENABLED."""
    axis, most = Axis(tester), 0.0
    stay = {
        _S.SWITCH_ON_DISABLED: _C.DISABLE_VOLTAGE,
        _S.READY_TO_SWITCH_ON: _C.SHUTDOWN,
        _S.SWITCHED_ON: _C.SWITCH_ON,
    }
    for state, controlword in stay.items():
        axis.go(state)
        axis.run(3, controlword)  # wait until the torque of a previous position hold has decayed
        most = max(most, torque_of(axis.run(10, controlword, tester.limits.torque)), key=abs)
    return Outcome(abs(most) <= NOISE, f"at most {most:.2f} Nm")


def follows_torque(tester: NodeTester) -> Outcome:
    """Test DRIVE-07: the mean measured torque equals the target torque."""
    axis, most, found, passed = Axis(tester), tester.limits.torque, [], True
    axis.enable()
    for target_torque in (0.0, most, -most, most / 2.0):
        received = axis.run(12, _C.ENABLE_OPERATION, target_torque)[2 * SHOWN :]
        mean = mean_torque(received)
        passed &= abs(mean - target_torque) <= NOISE
        found.append(f"{target_torque:+g}: {mean:+.2f} Nm")
    return Outcome(passed, ", ".join(found))


def respects_the_limit(tester: NodeTester) -> Outcome:
    """Test DRIVE-08: the drive limits its torque to MaxTorque, even if TargetTorque is at a limit of its DBC range.

    The limited torque must have the sign of TargetTorque, and its mean must be at least half of MaxTorque.
    """
    axis, found, passed = Axis(tester), [], True
    target = tester.command.message.signal(axis.signal("TargetTorque"))
    axis.enable()
    for limit in (tester.limits.torque, 0.0):
        for target_torque in (target.maximum, target.minimum):
            received = axis.run(12, _C.ENABLE_OPERATION, target_torque, limit)[2 * SHOWN :]
            sign, mean, most = math.copysign(1.0, target_torque), mean_torque(received), torque_of(received)
            opposite = any(sign * frame.values["Torque"] < -NOISE for frame in received)
            reached = limit == 0.0 or sign * mean >= limit / 2.0
            passed &= reached and not opposite and abs(most) <= limit + NOISE
            found.append(
                f"{target_torque:+.0f} Nm with limit {limit:g} Nm: mean {mean:+.2f} Nm, largest {most:+.2f} Nm"
            )
    return Outcome(passed, ", ".join(found))


def takes_the_largest_limit(tester: NodeTester) -> Outcome:
    """Test DRIVE-09: the drive accepts a command in which MaxTorque has the largest value of its DBC range."""
    axis, target_torque = Axis(tester), tester.limits.torque
    axis.enable()
    usual = mean_torque(axis.run(12, _C.ENABLE_OPERATION, target_torque)[2 * SHOWN :])
    most = tester.command.message.signal(axis.signal("MaxTorque")).maximum
    received = axis.run(12, _C.ENABLE_OPERATION, target_torque, most)
    made = mean_torque(received[2 * SHOWN :])
    passed = abs(made - usual) <= NOISE and all_in(received, _S.OPERATION_ENABLED)
    return Outcome(passed, f"{made:+.2f} Nm, with the usual limit {usual:+.2f} Nm, {names_of(received)}")

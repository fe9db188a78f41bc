"""What a drive's torque owes: none unless enabled, what is commanded with its sign, never more than the limit."""

from __future__ import annotations

from atalante_hal.wire.cia402 import Controlword, DriveState
from atalante_tools.conform.axis import NOISE, SHOWN, Axis, always, mean_torque, names_of, torque_of
from atalante_tools.conform.bench import Bench
from atalante_tools.conform.requirement import Outcome

_S, _C = DriveState, Controlword


def makes_no_torque_disabled(bench: Bench) -> Outcome:
    """DRIVE-06."""
    axis, most = Axis(bench), 0.0
    stay = {
        _S.SWITCH_ON_DISABLED: _C.DISABLE_VOLTAGE,
        _S.READY_TO_SWITCH_ON: _C.SHUTDOWN,
        _S.SWITCHED_ON: _C.SWITCH_ON,
    }
    for state, controlword in stay.items():
        axis.go(state)
        axis.run(3, controlword)  # what was left of a hold
        most = max(most, torque_of(axis.run(10, controlword, bench.limits.torque)), key=abs)
    return Outcome(abs(most) <= NOISE, f"at the most {most:.2f} Nm")


def follows_torque(bench: Bench) -> Outcome:
    """DRIVE-07."""
    axis, most, found, passed = Axis(bench), bench.limits.torque, [], True
    axis.enable()
    for wanted in (0.0, most, -most, most / 2.0):
        heard = axis.run(12, _C.ENABLE_OPERATION, wanted)[2 * SHOWN :]
        mean = mean_torque(heard)
        passed &= abs(mean - wanted) <= NOISE
        found.append(f"{wanted:+g}: {mean:+.2f} Nm")
    return Outcome(passed, ", ".join(found))


def respects_the_limit(bench: Bench) -> Outcome:
    """DRIVE-08."""
    axis, found, passed = Axis(bench), [], True
    target = bench.command.message.signal(axis.signal("TargetTorque"))
    axis.enable()
    for limit in (bench.limits.torque, 0.0):
        for wanted in (target.maximum, target.minimum):
            most = torque_of(axis.run(12, _C.ENABLE_OPERATION, wanted, limit)[2 * SHOWN :])
            passed &= limit / 2.0 <= abs(most) <= limit + NOISE
            found.append(f"{wanted:+.0f} Nm under {limit:g} Nm: {most:+.2f} Nm")
    return Outcome(passed, ", ".join(found))


def takes_the_largest_limit(bench: Bench) -> Outcome:
    """DRIVE-09."""
    axis, wanted = Axis(bench), bench.limits.torque
    axis.enable()
    usual = mean_torque(axis.run(12, _C.ENABLE_OPERATION, wanted)[2 * SHOWN :])
    most = bench.command.message.signal(axis.signal("MaxTorque")).maximum
    heard = axis.run(12, _C.ENABLE_OPERATION, wanted, most)
    made = mean_torque(heard[2 * SHOWN :])
    passed = abs(made - usual) <= NOISE and always(heard, _S.OPERATION_ENABLED)
    return Outcome(passed, f"{made:+.2f} Nm as against {usual:+.2f} Nm, {names_of(heard)}")

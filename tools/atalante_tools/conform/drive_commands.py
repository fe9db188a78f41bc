"""What a drive makes of commands that are damaged, somebody else's or none, and of silence: nothing, then the latched hold."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Final

from atalante_hal.wire.cia402 import Controlword, DriveState
from atalante_hal.wire.frame import Frames
from atalante_tools.conform.axis import (
    FOLLOW,
    NOISE,
    SHOWN,
    STAY,
    Axis,
    always,
    codes_of,
    emergencies_of,
    mean_torque,
    names_of,
    state_of,
    torque_of,
)
from atalante_tools.conform.bench import Bench, NotTested
from atalante_tools.conform.requirement import Outcome

_S, _C = DriveState, Controlword

#: Controlwords outside the range: known ones with the highest bit set, as a sloppy mask would let through, and the last.
UNKNOWN: Final = (0x82, 0x86, 0x87, 0x8F, 0xFE)
#: Commands a drive rides through without, and those after which it holds by itself.
RIDDEN, LATCHED = 4, 5
#: CiA 301 emergency code of a lost HAL: its command came no more (RPDO timeout).
COMMAND_TIMEOUT: Final = 0x8250


def ignores_unknown_controlwords(bench: Bench) -> Outcome:
    """DRIVE-10."""
    axis, wrong = Axis(bench), []
    for state, stay in ((_S.OPERATION_ENABLED, _C.ENABLE_OPERATION), (_S.SWITCH_ON_DISABLED, _C.DISABLE_VOLTAGE)):
        axis.go(state)
        for code in UNKNOWN:
            heard = [*axis.send(axis.word(stay, raw={"Controlword": code})), *axis.run(2 * SHOWN, stay)]
            if not always(heard, state):
                wrong.append(f"{code} in {state.name}: {names_of(heard)}")
    return Outcome(not wrong, f"acted on {'; '.join(wrong)}" if wrong else "all refused")


def ignores_invalid_codes(bench: Bench) -> Outcome:
    """DRIVE-11."""
    axis, found, passed = Axis(bench), [], True
    message = bench.command.message
    axis.enable()
    for quantity in ("Controlword", "TargetTorque", "MaxTorque"):
        code = message.signal(axis.signal(quantity)).invalid_raw
        assert code is not None
        # A target above the limit: whoever took the invalid MaxTorque for a limit would make it.
        limit, wanted = bench.limits.torque / 3.0, bench.limits.torque
        heard = axis.run(6, _C.ENABLE_OPERATION, 0.0, limit)[2 * SHOWN :]
        for _ in range(2):
            heard += axis.send(axis.word(_C.ENABLE_OPERATION, wanted, limit, raw={quantity: code}))
        heard += axis.run(2 * SHOWN, _C.ENABLE_OPERATION, 0.0, limit)
        most = torque_of(heard)
        passed &= abs(most) <= NOISE and always(heard, _S.OPERATION_ENABLED)
        found.append(f"{quantity}: {most:+.2f} Nm, {names_of(heard)}")
    return Outcome(passed, "; ".join(found))


def ignores(bad: Callable[[Axis, int], Frames], *, or_holds: bool = False) -> Callable[[Bench], Outcome]:
    """Two bad commands change nothing; ten of them, and nothing else, latch the hold. `or_holds`: so may the first."""

    def test(bench: Bench) -> Outcome:
        axis = Axis(bench)
        axis.enable()
        heard = [h for number in range(2) for h in axis.send(bad(axis, number))]
        heard += axis.run(2 * SHOWN, _C.ENABLE_OPERATION)
        holds = [h for h in heard if or_holds and state_of(h) == _S.QUICK_STOP_ACTIVE]
        obeys = [h for h in heard if h not in holds]
        most = torque_of(obeys)
        if abs(most) > NOISE or any(state_of(h) != _S.OPERATION_ENABLED for h in obeys) or not heard:
            return Outcome(False, f"acted on: {most:+.2f} Nm, {names_of(heard)}")
        if holds:
            return Outcome(True, f"{most:+.2f} Nm, {names_of(heard)}")
        axis.run(4, _C.ENABLE_OPERATION)
        heard = [h for number in range(2 * LATCHED) for h in axis.send(bad(axis, number))]
        fed = always(heard, _S.OPERATION_ENABLED)
        return Outcome(not fed, f"{most:+.2f} Nm; {'fed the watchdog' if fed else 'latched without a good one'}")

    return test


def ignores_a_jump(bench: Bench) -> Outcome:
    """DRIVE-20."""
    axis = Axis(bench)
    axis.enable()
    heard = axis.send(axis.push(counter=(bench.command.counter + 100) & 0xFF))
    heard += axis.run(2 * SHOWN, _C.ENABLE_OPERATION)
    most = torque_of(heard)
    return Outcome(abs(most) <= NOISE and always(heard, _S.OPERATION_ENABLED), f"{most:+.2f} Nm, {names_of(heard)}")


# -- when the HAL is not heard -------------------------------------------------------------------------------------------


def rides_through(bench: Bench) -> Outcome:
    """DRIVE-12."""
    axis, wanted = Axis(bench), bench.limits.torque
    axis.enable()
    before = mean_torque(axis.run(12, _C.ENABLE_OPERATION, wanted)[2 * SHOWN :])
    heard = bench.states([h for _ in range(RIDDEN) for h in bench.cycle()])
    heard += axis.run(2 * SHOWN, _C.ENABLE_OPERATION, wanted)
    least = min((h.values["Torque"] for h in heard), default=math.nan)
    passed = always(heard, _S.OPERATION_ENABLED) and least >= before - NOISE
    return Outcome(passed, f"at least {least:+.2f} of {before:+.2f} Nm, {names_of(heard)}")


def latches(bench: Bench) -> Outcome:
    """DRIVE-13."""
    axis = Axis(bench)
    axis.enable()
    heard = bench.states([h for _ in range(LATCHED) for h in bench.cycle()])
    heard += axis.run(2 * SHOWN, _C.ENABLE_OPERATION)
    stopped = any(state_of(h) == _S.QUICK_STOP_ACTIVE for h in heard)
    return Outcome(stopped, names_of(heard))


def releases_only_when_acknowledged(bench: Bench) -> Outcome:
    """DRIVE-14."""
    axis = Axis(bench)
    _latch(axis)
    for controlword in (_C.ENABLE_OPERATION, _C.SHUTDOWN, _C.SWITCH_ON, _C.FAULT_RESET, _C.ENABLE_OPERATION):
        heard = axis.run(STAY, controlword)
        if not always(heard, _S.QUICK_STOP_ACTIVE):
            return Outcome(False, f"{controlword.name} alone: {names_of(heard)}")
    axis.run(FOLLOW, _C.QUICK_STOP)
    took = axis.follow(_C.ENABLE_OPERATION, _S.OPERATION_ENABLED)
    text = "stays after QUICK_STOP and ENABLE_OPERATION" if took is None else f"enabled {took} cycles after both"
    return Outcome(took is not None, text)


def tells_the_latch(bench: Bench) -> Outcome:
    """DRIVE-15."""
    axis = Axis(bench)
    axis.enable()
    first = len(bench.heard)
    bench.idle(20)
    told = emergencies_of(bench, first)
    return Outcome(told == [COMMAND_TIMEOUT], f"emergencies: {codes_of(told)}")


def latches_without_sync(bench: Bench) -> Outcome:
    """DRIVE-16."""
    axis = Axis(bench)
    axis.enable()
    for _ in range(3):
        bench.silent_cycle()
    short = axis.run(2 * SHOWN, _C.ENABLE_OPERATION)
    for _ in range(20):
        bench.silent_cycle()
    long = axis.run(2 * SHOWN, _C.ENABLE_OPERATION)
    # Whether it stays in the hold is DRIVE-14.
    passed = always(short, _S.OPERATION_ENABLED) and any(state_of(h) == _S.QUICK_STOP_ACTIVE for h in long)
    return Outcome(passed, f"after 3 ms {names_of(short)}, after 20 ms {names_of(long)}")


def _latch(axis: Axis) -> None:
    """Bring the latched hold about by silence of the HAL. Raises `NotTested`."""
    axis.enable()
    heard = axis.bench.states(axis.bench.idle(4 * LATCHED))
    if not heard or state_of(heard[-1]) != _S.QUICK_STOP_ACTIVE:
        raise NotTested("the drive does not latch a hold when commands stay away")

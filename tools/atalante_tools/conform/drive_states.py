"""What a drive's state machine owes: the transitions of CiA 402 and no others, a hold that holds, a fault until it is reset."""

from __future__ import annotations

import math
from typing import Final

from atalante_hal.wire.cia402 import Controlword, DriveState
from atalante_tools.conform.axis import (
    FOLLOW,
    LEGAL,
    NOISE,
    ROUTES,
    SHOWN,
    STAY,
    Axis,
    always,
    codes_of,
    emergencies_of,
    names_of,
    state_of,
    torque_of,
)
from atalante_tools.conform.bench import Bench, NotTested
from atalante_tools.conform.frames import Heard
from atalante_tools.conform.requirement import Outcome
from atalante_tools.conform.technician import Action

_S, _C = DriveState, Controlword

#: Cycles a drive may take for a quick stop.
STOP: Final = 5
#: A joint that holds may give way by this much [rad].
GIVE: Final = math.radians(1.0)
#: Class of emergency codes of temperatures.
TEMPERATURE_CLASS: Final = 0x4000


def starts_disabled(bench: Bench) -> Outcome:
    """DRIVE-01."""
    heard = bench.states(bench.heard) or bench.states(bench.idle(10))
    return Outcome(always(heard, _S.SWITCH_ON_DISABLED), names_of(heard))


def makes_legal_transitions(bench: Bench) -> Outcome:
    """DRIVE-02."""
    axis, slowest, wrong = Axis(bench), 0, []
    for (state, controlword), (number, goal) in LEGAL.items():
        axis.go(state)
        took = axis.follow(controlword, goal)
        stayed = axis.run(STAY, controlword)
        if took is None or not always(stayed, goal):
            wrong.append(f"{number} ({state.name}, {controlword.name}): {names_of(stayed)}")
        slowest = max(slowest, took or FOLLOW)
    text = f"wrong: {'; '.join(wrong)}" if wrong else f"all, the slowest in {slowest} cycles"
    return Outcome(not wrong, text)


def refuses_illegal_transitions(bench: Bench) -> Outcome:
    """DRIVE-03."""
    axis, wrong, tried = Axis(bench), [], 0
    for state in ROUTES:
        axis.go(state)
        for controlword in Controlword:
            if (state, controlword) in LEGAL:
                continue
            tried += 1
            heard = axis.run(STAY, controlword)
            if not always(heard, state):
                wrong.append(f"({state.name}, {controlword.name}): {names_of(heard)}")
                axis.go(state)
    return Outcome(not wrong, f"obeyed: {'; '.join(wrong)}" if wrong else f"all {tried} refused")


def stops_quickly(bench: Bench) -> Outcome:
    """DRIVE-04."""
    axis = Axis(bench)
    axis.enable()
    took = axis.follow(_C.QUICK_STOP, _S.QUICK_STOP_ACTIVE)
    return Outcome(took is not None and took <= STOP, f"{took or f'more than {FOLLOW}'} cycles")


def holds_its_position(bench: Bench) -> Outcome:
    """DRIVE-05."""
    axis = Axis(bench)
    axis.enable()
    axis.run(10, _C.ENABLE_OPERATION, bench.limits.torque)
    if axis.follow(_C.QUICK_STOP, _S.QUICK_STOP_ACTIVE) is None:
        raise NotTested("the drive does not go to QUICK_STOP_ACTIVE; see DRIVE-02")
    heard = axis.run(100, _C.QUICK_STOP)
    positions = [h.values["Position"] / bench.robot.gear[axis.joint] for h in heard]
    gave = max(positions) - min(positions) if positions else math.inf
    return Outcome(gave <= GIVE and always(heard, _S.QUICK_STOP_ACTIVE), f"moved {math.degrees(gave):.2f} degrees")


def trips_when_hot(bench: Bench) -> Outcome:
    """DRIVE-22."""
    axis = Axis(bench)
    axis.enable()
    first = len(bench.heard)

    def is_faulty(heard: list[Heard]) -> bool:
        return any(state_of(h) == _S.FAULT for h in bench.states(heard))

    def enabled() -> list[Heard]:
        return bench.cycle(axis.word(_C.ENABLE_OPERATION))

    if not bench.ask(Action.OVERHEAT, is_faulty, enabled):
        return Outcome(False, "does not trip")
    axis.run(2 * SHOWN, _C.ENABLE_OPERATION, bench.limits.torque)
    made = torque_of(axis.run(2 * SHOWN, _C.ENABLE_OPERATION, bench.limits.torque))
    told = emergencies_of(bench, first)
    hot = [code for code in told if code & 0xF000 == TEMPERATURE_CLASS]
    return Outcome(len(hot) == 1 and abs(made) <= NOISE, f"emergencies: {codes_of(told)}; {made:+.2f} Nm in FAULT")


def leaves_fault_when_reset(bench: Bench) -> Outcome:
    """DRIVE-23."""
    axis = Axis(bench)
    heard = axis.run(SHOWN, _C.ENABLE_OPERATION)
    if not always(heard[-1:], _S.FAULT):
        raise NotTested("the drive is not in FAULT; see DRIVE-22")
    bench.technician.please(Action.COOL, bench.node.name)
    for controlword in Controlword:
        if controlword is not _C.FAULT_RESET:
            heard = axis.run(STAY, controlword)
            if not always(heard, _S.FAULT):
                return Outcome(False, f"{controlword.name}: {names_of(heard)}")

    def is_reset(heard: list[Heard]) -> bool:
        return any(state_of(h) == _S.SWITCH_ON_DISABLED for h in bench.states(heard))

    def reset() -> list[Heard]:
        return bench.cycle(axis.word(_C.FAULT_RESET))

    passed = bench.until(is_reset, reset)
    return Outcome(passed, "SWITCH_ON_DISABLED after FAULT_RESET alone" if passed else "stays in FAULT")

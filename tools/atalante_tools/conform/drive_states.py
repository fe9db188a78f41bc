"""Tests of the state machine of a drive: transitions of CiA 402, quick stop, position hold, fault and fault reset."""

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
    all_in,
    codes_of,
    emergencies_of,
    names_of,
    state_of,
    torque_of,
)
from atalante_tools.conform.frames import ReceivedFrame
from atalante_tools.conform.node_tester import NodeTester, NotTested
from atalante_tools.conform.requirement import Outcome
from atalante_tools.conform.technician import Action

_S, _C = DriveState, Controlword

#: Longest accepted time from the command QUICK_STOP to the drive state QUICK STOP ACTIVE [cycles].
STOP: Final = 5
#: Largest accepted motion of a joint in QUICK STOP ACTIVE [rad].
MOVEMENT: Final = math.radians(1.0)
#: CiA 301 emergency codes for a temperature fault are 0x4000 to 0x4FFF.
TEMPERATURE_CLASS: Final = 0x4000


def starts_disabled(tester: NodeTester) -> Outcome:
    """Test DRIVE-01: the state after start-up is SWITCH ON DISABLED."""
    received = tester.states(tester.received) or tester.states(tester.idle(10))
    return Outcome(all_in(received, _S.SWITCH_ON_DISABLED), names_of(received))


def makes_legal_transitions(tester: NodeTester) -> Outcome:
    """Test DRIVE-02: the drive makes every transition of CiA 402 that a command causes."""
    axis, slowest, wrong = Axis(tester), 0, []
    unreached: set[DriveState] = set()
    for (state, controlword), (number, goal) in LEGAL.items():
        if state not in unreached:
            try:
                axis.go(state)
            except NotTested:
                unreached.add(state)
                wrong.append(f"{state.name} not reached")
        if state in unreached:
            continue
        took = axis.follow(controlword, goal)
        stayed = axis.run(STAY, controlword)
        if took is None or not all_in(stayed, goal):
            wrong.append(f"{number} ({state.name}, {controlword.name}): {names_of(stayed)}")
        slowest = max(slowest, took or FOLLOW)
    text = f"wrong: {'; '.join(wrong)}" if wrong else f"all right, slowest in {slowest} cycles"
    return Outcome(not wrong, text)


def refuses_illegal_transitions(tester: NodeTester) -> Outcome:
    """Test DRIVE-03: a command that has no transition in the current state leaves this state unchanged."""
    axis, wrong, tried = Axis(tester), [], 0
    for state in ROUTES:
        axis.go(state)
        for controlword in Controlword:
            if (state, controlword) in LEGAL:
                continue
            tried += 1
            received = axis.run(STAY, controlword)
            if not all_in(received, state):
                wrong.append(f"({state.name}, {controlword.name}): {names_of(received)}")
                axis.go(state)
    return Outcome(not wrong, f"wrong: {'; '.join(wrong)}" if wrong else f"all {tried} ignored")


def stops_quickly(tester: NodeTester) -> Outcome:
    """Test DRIVE-04: QUICK_STOP takes effect within `STOP` cycles."""
    axis = Axis(tester)
    axis.enable()
    took = axis.follow(_C.QUICK_STOP, _S.QUICK_STOP_ACTIVE)
    return Outcome(took is not None and took <= STOP, f"{took or f'more than {FOLLOW}'} cycles")


def holds_its_position(tester: NodeTester) -> Outcome:
    """Test DRIVE-05: the joint moves by at most `MOVEMENT` in QUICK STOP ACTIVE."""
    axis = Axis(tester)
    axis.enable()
    axis.run(10, _C.ENABLE_OPERATION, tester.limits.torque)
    if axis.follow(_C.QUICK_STOP, _S.QUICK_STOP_ACTIVE) is None:
        raise NotTested("the drive must reach QUICK_STOP_ACTIVE, but it did not; see DRIVE-02")
    received = axis.run(100, _C.QUICK_STOP)
    positions = [frame.values["Position"] / tester.robot.gear[axis.joint] for frame in received]
    moved = max(positions) - min(positions) if positions else math.inf
    return Outcome(
        moved <= MOVEMENT and all_in(received, _S.QUICK_STOP_ACTIVE), f"moved {math.degrees(moved):.2f} degrees"
    )


def trips_when_hot(tester: NodeTester) -> Outcome:
    """Test DRIVE-22: overheating leads to FAULT, zero torque and one emergency message."""
    axis = Axis(tester)
    axis.enable()
    first = len(tester.received)

    def is_faulty(received: list[ReceivedFrame]) -> bool:
        return any(state_of(frame) == _S.FAULT for frame in tester.states(received))

    def enabled() -> list[ReceivedFrame]:
        return tester.cycle(axis.command(_C.ENABLE_OPERATION))

    if not tester.request(Action.OVERHEAT, is_faulty, enabled):
        return Outcome(False, "no FAULT")
    axis.run(2 * SHOWN, _C.ENABLE_OPERATION, tester.limits.torque)
    made = torque_of(axis.run(2 * SHOWN, _C.ENABLE_OPERATION, tester.limits.torque))
    reported = emergencies_of(tester, first)
    hot = [code for code in reported if code & 0xF000 == TEMPERATURE_CLASS]
    return Outcome(len(hot) == 1 and abs(made) <= NOISE, f"emergencies: {codes_of(reported)}; {made:+.2f} Nm in FAULT")


def leaves_fault_when_reset(tester: NodeTester) -> Outcome:
    """Test DRIVE-23: in FAULT, only the command FAULT_RESET changes the drive state.

    A hot drive stays in FAULT on every command, so the test waits until the drive has cooled.
    """
    axis = Axis(tester)
    received = axis.run(SHOWN, _C.ENABLE_OPERATION)
    if not all_in(received[-1:], _S.FAULT):
        raise NotTested(f"the drive must be in FAULT, got {names_of(received[-1:])}; see DRIVE-22")
    cool = tester.robot.derating.start

    def is_cool(received: list[ReceivedFrame]) -> bool:
        return any(frame.values["Temperature"] < cool for frame in tester.states(received))

    def enable() -> list[ReceivedFrame]:
        return tester.cycle(axis.command(_C.ENABLE_OPERATION))

    if not tester.request(Action.COOL, is_cool, enable):
        raise NotTested(f"the drive must cool below {cool:g} degC, but it stayed hot")
    for controlword in Controlword:
        if controlword is not _C.FAULT_RESET:
            received = axis.run(STAY, controlword)
            if not all_in(received, _S.FAULT):
                return Outcome(False, f"{controlword.name}: {names_of(received)}")

    def is_reset(received: list[ReceivedFrame]) -> bool:
        return any(state_of(frame) == _S.SWITCH_ON_DISABLED for frame in tester.states(received))

    def reset() -> list[ReceivedFrame]:
        return tester.cycle(axis.command(_C.FAULT_RESET))

    passed = tester.run_until(is_reset, reset)
    return Outcome(
        passed, "SWITCH_ON_DISABLED only after FAULT_RESET" if passed else "still in FAULT after FAULT_RESET"
    )

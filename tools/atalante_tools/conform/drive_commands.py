"""Tests of a drive with defective commands, foreign commands, lost commands and lost SYNC.

A few cycles without a valid command must have no effect. After more such cycles in a row, the drive must hold its
position in QUICK STOP ACTIVE. This hold is latched: it ends only on QUICK_STOP followed by ENABLE_OPERATION.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Final

from atalante_hal.wire.cia402 import Controlword, DriveState
from atalante_hal.wire.e2e import MAX_DELTA
from atalante_hal.wire.frame import Frames
from atalante_tools.conform.axis import (
    FOLLOW,
    NOISE,
    SHOWN,
    STAY,
    Axis,
    all_in,
    codes_of,
    emergencies_of,
    mean_torque,
    names_of,
    state_of,
    torque_of,
)
from atalante_tools.conform.node_tester import NodeTester, NotTested
from atalante_tools.conform.requirement import Outcome

_S, _C = DriveState, Controlword

#: Controlwords outside the DBC range: four valid controlwords with the highest bit set, and 0xFE.
UNKNOWN: Final = (0x82, 0x86, 0x87, 0x8F, 0xFE)
#: `TOLERATED`: 4 consecutive lost commands must change neither the state nor the torque of the drive.
#: `LATCHED`: after 5 consecutive lost commands, the drive must hold its position and stay in QUICK STOP ACTIVE.
TOLERATED, LATCHED = 4, 5
#: CiA 301 emergency code for loss of the HAL command (RPDO timeout).
COMMAND_TIMEOUT: Final = 0x8250


def ignores_unknown_controlwords(tester: NodeTester) -> Outcome:
    """Test DRIVE-10: a controlword outside the DBC range has no effect."""
    axis, wrong = Axis(tester), []
    for state, stay in ((_S.OPERATION_ENABLED, _C.ENABLE_OPERATION), (_S.SWITCH_ON_DISABLED, _C.DISABLE_VOLTAGE)):
        axis.go(state)
        for code in UNKNOWN:
            received = [*axis.send(axis.command(stay, raw={"Controlword": code})), *axis.run(2 * SHOWN, stay)]
            if not all_in(received, state):
                wrong.append(f"0x{code:02X} in {state.name}: {names_of(received)}")
    return Outcome(not wrong, f"acted on {'; '.join(wrong)}" if wrong else "all ignored")


def ignores_invalid_codes(tester: NodeTester) -> Outcome:
    """Test DRIVE-11: a command in which a signal has its invalid code (`InvalidRaw` in the DBC) has no effect."""
    axis, found, passed = Axis(tester), [], True
    message, target = tester.command.message, tester.limits.torque
    if target < 2.0 * NOISE:
        raise NotTested(f"the torque must be at least {2.0 * NOISE:g} Nm, got {target:g} Nm; set a larger --torque")
    # The torque limit is at least 2 * NOISE, so that the test can measure the torque of a drive that obeys the command.
    limit = max(target / 3.0, 2.0 * NOISE)
    axis.enable()
    for quantity in ("Controlword", "TargetTorque", "MaxTorque"):
        code = message.signal(axis.signal(quantity)).invalid_raw
        assert code is not None
        # A drive must not decode the invalid code of MaxTorque as a number, because the number is a large torque.
        # With this number as the torque limit, the drive produces the target torque, and fails the test.
        received = axis.run(6, _C.ENABLE_OPERATION, 0.0, limit)[2 * SHOWN :]
        for _ in range(2):
            received += axis.send(axis.command(_C.ENABLE_OPERATION, target, limit, raw={quantity: code}))
        received += axis.run(2 * SHOWN, _C.ENABLE_OPERATION, 0.0, limit)
        most = torque_of(received)
        passed &= abs(most) <= NOISE and all_in(received, _S.OPERATION_ENABLED)
        found.append(f"{quantity}: {most:+.2f} Nm, {names_of(received)}")
    return Outcome(passed, "; ".join(found))


def ignores(bad: Callable[[Axis, int], Frames], *, may_hold: bool = False) -> Callable[[NodeTester], Outcome]:
    """Return a test with defective commands.

    Two defective commands must have no effect. Ten defective commands in a row must latch the position hold.

    Args:
        bad: function that returns a defective command for an axis, called with the command's index.
        may_hold: whether two defective commands may already latch the position hold.
    """

    def test(tester: NodeTester) -> Outcome:
        axis = Axis(tester)
        axis.enable()
        received = [frame for number in range(2) for frame in axis.send(bad(axis, number))]
        received += axis.run(2 * SHOWN, _C.ENABLE_OPERATION)
        holds = [frame for frame in received if may_hold and state_of(frame) == _S.QUICK_STOP_ACTIVE]
        others = [frame for frame in received if frame not in holds]
        most = torque_of(others)
        if abs(most) > NOISE or any(state_of(frame) != _S.OPERATION_ENABLED for frame in others) or not received:
            return Outcome(False, f"acted on: {most:+.2f} Nm, {names_of(received)}")
        if holds:
            return Outcome(True, f"{most:+.2f} Nm, {names_of(received)}")
        axis.run(4, _C.ENABLE_OPERATION)
        received = [frame for number in range(2 * LATCHED) for frame in axis.send(bad(axis, number))]
        enabled = all_in(received, _S.OPERATION_ENABLED)
        reaction = "reset the watchdog" if enabled else "latched without a valid command"
        return Outcome(not enabled, f"{most:+.2f} Nm; {reaction}")

    return test


def ignores_a_jump(tester: NodeTester) -> Outcome:
    """Test DRIVE-20: a command whose alive counter jumps has no effect."""
    axis = Axis(tester)
    axis.enable()
    received = axis.send(axis.bad_command(counter=(tester.command.counter + 100) & 0xFF))
    received += axis.run(2 * SHOWN, _C.ENABLE_OPERATION)
    most = torque_of(received)
    return Outcome(
        abs(most) <= NOISE and all_in(received, _S.OPERATION_ENABLED), f"{most:+.2f} Nm, {names_of(received)}"
    )


# -- loss of commands and SYNC ---------------------------------------------------------------------------------------------


def tolerates_lost_commands(tester: NodeTester) -> Outcome:
    """Test DRIVE-12: four consecutive lost commands change neither the state nor the torque of the drive."""
    axis, target = Axis(tester), tester.limits.torque
    axis.enable()
    before = mean_torque(axis.run(12, _C.ENABLE_OPERATION, target)[2 * SHOWN :])
    received = tester.states([frame for _ in range(TOLERATED) for frame in tester.cycle()])
    received += axis.run(2 * SHOWN, _C.ENABLE_OPERATION, target)
    least = min((frame.values["Torque"] for frame in received), default=math.nan)
    passed = all_in(received, _S.OPERATION_ENABLED) and least >= before - NOISE
    return Outcome(passed, f"at least {least:+.2f} of {before:+.2f} Nm, {names_of(received)}")


def latches(tester: NodeTester) -> Outcome:
    """Test DRIVE-13: loss of commands leads to QUICK STOP ACTIVE."""
    axis = Axis(tester)
    axis.enable()
    last = tester.command.counter
    received = tester.states([frame for _ in range(LATCHED) for frame in tester.cycle()])
    # The next command is valid: its alive counter increases by MAX_DELTA, the largest increase that a drive accepts.
    # A drive without a watchdog obeys the command, stays in OPERATION ENABLED and fails this test.
    received += axis.send(axis.command(_C.ENABLE_OPERATION, counter=last + MAX_DELTA & 0xFF))
    received += axis.run(2 * SHOWN, _C.ENABLE_OPERATION)
    stopped = any(state_of(frame) == _S.QUICK_STOP_ACTIVE for frame in received)
    return Outcome(stopped, names_of(received))


def latches_late_commands(tester: NodeTester) -> Outcome:
    """Test DRIVE-24: the drive enters QUICK STOP ACTIVE if the commands are too old, even if no command is lost.

    The test delays the commands by 4 cycles (`TOLERATED`) three times, so the last commands are 12 cycles late. The drive
    tolerates a delay of 4 cycles. The alive counters are consecutive, so only a comparison with the SYNC shows the delay.
    """
    axis = Axis(tester)
    axis.enable()
    counter, received = tester.command.counter, []
    for _ in range(3):
        received += tester.states([frame for _ in range(TOLERATED) for frame in tester.cycle()])
        for _ in range(2 * SHOWN):
            counter = counter + 1 & 0xFF
            received += axis.send(axis.command(_C.ENABLE_OPERATION, counter=counter))
    stopped = any(state_of(frame) == _S.QUICK_STOP_ACTIVE for frame in received)
    return Outcome(stopped, names_of(received))


def releases_only_when_acknowledged(tester: NodeTester) -> Outcome:
    """Test DRIVE-14: after a loss of commands, the drive obeys ENABLE_OPERATION only after a QUICK_STOP."""
    axis = Axis(tester)
    _latch(axis)
    for controlword in (_C.ENABLE_OPERATION, _C.SHUTDOWN, _C.SWITCH_ON, _C.FAULT_RESET, _C.ENABLE_OPERATION):
        received = axis.run(STAY, controlword)
        if not all_in(received, _S.QUICK_STOP_ACTIVE):
            return Outcome(False, f"{controlword.name} alone: {names_of(received)}")
    axis.run(FOLLOW, _C.QUICK_STOP)
    took = axis.follow(_C.ENABLE_OPERATION, _S.OPERATION_ENABLED)
    text = (
        "not enabled after QUICK_STOP and ENABLE_OPERATION"
        if took is None
        else f"enabled {took} cycles after QUICK_STOP and ENABLE_OPERATION"
    )
    return Outcome(took is not None, text)


def reports_the_latch(tester: NodeTester) -> Outcome:
    """Test DRIVE-15: after a loss of commands, the drive sends exactly one emergency message."""
    axis = Axis(tester)
    axis.enable()
    first = len(tester.received)
    tester.idle(20)
    reported = emergencies_of(tester, first)
    return Outcome(reported == [COMMAND_TIMEOUT], f"emergencies: {codes_of(reported)}")


def latches_without_sync(tester: NodeTester) -> Outcome:
    """Test DRIVE-16: a SYNC loss of 3 ms has no effect, and a SYNC loss of 20 ms leads to QUICK STOP ACTIVE."""
    axis = Axis(tester)
    axis.enable()
    for _ in range(3):
        tester.silent_cycle()
    short = axis.run(2 * SHOWN, _C.ENABLE_OPERATION)
    for _ in range(20):
        tester.silent_cycle()
    long = axis.run(2 * SHOWN, _C.ENABLE_OPERATION)
    # The drive only has to enter QUICK STOP ACTIVE. DRIVE-14 tests which commands end this state.
    passed = all_in(short, _S.OPERATION_ENABLED) and any(state_of(frame) == _S.QUICK_STOP_ACTIVE for frame in long)
    return Outcome(passed, f"after 3 ms {names_of(short)}, after 20 ms {names_of(long)}")


def _latch(axis: Axis) -> None:
    """Stop the commands, so that the drive holds its position in QUICK STOP ACTIVE.

    Raises:
        NotTested: If the drive does not reach QUICK STOP ACTIVE.
    """
    axis.enable()
    received = axis.tester.states(axis.tester.idle(4 * LATCHED))
    if not received or state_of(received[-1]) != _S.QUICK_STOP_ACTIVE:
        raise NotTested("the drive must be in QUICK STOP ACTIVE after a loss of commands, but it is not; see DRIVE-13")

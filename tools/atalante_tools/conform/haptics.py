"""Requirements for the haptics node, which drives eight vibration motors.

The measured amplitude of each motor must follow the commanded level with a lag. Without commands, the motors must stop.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

import numpy as np

from atalante_hal.types import Vector
from atalante_hal.wire.frame import Frames
from atalante_tools.conform.frames import ReceivedFrame
from atalante_tools.conform.node_tester import NodeTester, NotTested
from atalante_tools.conform.requirement import E2E, Outcome, Requirement

#: Largest time constant of a motor with which the motor passes the test HAPTICS-02 [s].
TIME_CONSTANT = 0.06
#: Largest accepted difference between the measured and the expected amplitude of a motor.
#: Amplitudes and levels are numbers from 0 (off) to 1 (strongest).
#: HAPTICS-02: the expected amplitudes are an exponential curve that is fitted to the measured amplitudes.
#: HAPTICS-04: the expected amplitude is the commanded level.
#: HAPTICS-05: the amplitude may be below 0.5 by at most `LAG`.
#: HAPTICS-07: an amplitude must fall by at least `LAG` as a sign that the motor stops.
LAG = 0.05
#: Longest accepted time until a motor reaches its commanded level [cycles].
_SETTLED: Final = 250
#: Largest difference between amplitude and commanded level at which a motor is considered to be at the level.
_STILL: Final = 0.02
#: Number of defective commands that a test sends. HAPTICS-05 sends `_BAD` commands for each raw value.
_BAD: Final = 40


def requirements(tester: NodeTester) -> list[Requirement]:
    """Return the requirements for the haptics node."""
    timeout = tester.command.message.timeout_ms
    return [
        Requirement("HAPTICS-01", "Does not vibrate at rest.", "50 ms without command", "DBC Amplitude", is_still),
        Requirement(
            "HAPTICS-02",
            f"Follows its level like a first-order lag of at most {TIME_CONSTANT * 1e3:g} ms.",
            "all motors from level 0 to 1",
            "DBC Level, Amplitude",
            follows_like_a_lag,
        ),
        Requirement(
            "HAPTICS-03",
            "Reaches both ends of the level range.",
            f"level 1 and level 0 for {_SETTLED} ms each",
            "DBC Level",
            reaches_both_ends,
        ),
        Requirement(
            "HAPTICS-04",
            "Drives only the commanded motor.",
            "one motor after the other at level 0.5",
            "DBC Level",
            moves_one_motor,
        ),
        Requirement(
            "HAPTICS-05",
            "Clamps or ignores a level above the DBC range.",
            f"codes 201, 230 and 254 in every second of {2 * _BAD} commands at level 0.5",
            "DBC Level range",
            stays_in_range,
        ),
        Requirement(
            "HAPTICS-06",
            "Ignores the invalid code of a level.",
            f"the invalid code for {_BAD} ms at level 0",
            "DBC InvalidRaw",
            _ignores(lambda b, _: _command(b, 0.0, raw=_codes(b, 255))),
        ),
        Requirement(
            "HAPTICS-07",
            f"Stops on loss of commands: the amplitude falls as soon as the last command is {timeout} ms old.",
            f"{2 * _SETTLED} ms without command after level 1; amplitude after {_stop_bound(tester)} ms and at the end",
            "DBC HAPTICS_COMMAND TimeoutTime",
            stops_without_commands,
        ),
        Requirement(
            "HAPTICS-08",
            "Ignores commands with a wrong CRC.",
            f"{_BAD} commands with one bit flipped",
            E2E,
            _ignores(lambda b, number: _command(b, 1.0, flip=24 + number)),
        ),
        Requirement(
            "HAPTICS-09",
            "Ignores commands protected for another message.",
            f"{_BAD} commands with another Data ID",
            E2E,
            _ignores(lambda b, _: _command(b, 1.0, data_id=b.sync.message.data_id)),
        ),
        Requirement(
            "HAPTICS-10",
            "Ignores repeated commands.",
            f"{_BAD} commands with the counter of the last valid command",
            E2E,
            _ignores(lambda b, _: _command(b, 1.0, counter=b.command.counter)),
        ),
        Requirement(
            "HAPTICS-11",
            "Ignores commands of a wrong length.",
            f"{_BAD} commands of 20 and 64 bytes, CRC valid for that length",
            "DBC length",
            _ignores(lambda b, number: _command(b, 1.0, length=(20, 64)[number % 2])),
        ),
    ]


def is_still(tester: NodeTester) -> Outcome:
    """Test HAPTICS-01: the vibration amplitude of every motor is 0 without commands."""
    most = _amplitudes(tester, tester.idle(50)).max()
    return Outcome(bool(most <= _STILL), f"amplitude {most:.3f} at most")


def follows_like_a_lag(tester: NodeTester) -> Outcome:
    """Test HAPTICS-02: the amplitude of each motor approaches the commanded level as a first-order lag.

    In a first-order lag, the distance from the level shrinks by the same factor from one state frame to the next.
    """
    _settle(tester, 0.0)
    remaining = 1.0 - _amplitudes(tester, _run(tester, _SETTLED, 1.0))
    period = tester.state_message.cycle_ms * 1e-3
    slowest, worst = 0.0, 0.0
    for motor in remaining.T:
        start = int(np.flatnonzero(motor > 0.99)[-1]) + 1 if (motor > 0.99).any() else 0
        rising = motor[start:]
        if len(rising) < 3:
            return Outcome(False, "a motor does not follow its level")
        squares = rising[:-1] @ rising[:-1]
        # In each state frame, the distance from the level is `factor` times the distance in the previous state frame.
        # Fit `factor` by least squares. It is 0 if the motor reaches the level within one state frame.
        factor = float(rising[1:] @ rising[:-1] / squares) if squares else 0.0
        model = rising[0] * factor ** np.arange(len(rising))
        if factor:
            slowest = max(slowest, -period / np.log(factor) if 0.0 < factor < 1.0 else np.inf)
        worst = max(worst, float(np.abs(rising - model).max()))
    text = f"time constant {slowest * 1e3:.0f} ms, largest deviation from a first-order lag {worst:.3f}"
    return Outcome(slowest <= TIME_CONSTANT and worst <= LAG, text)


def reaches_both_ends(tester: NodeTester) -> Outcome:
    """Test HAPTICS-03: the amplitude of every motor is 1 at level 1, and 0 at level 0."""
    high = _amplitudes(tester, _run(tester, _SETTLED, 1.0))[-1].min()
    low = _amplitudes(tester, _run(tester, _SETTLED, 0.0))[-1].max()
    return Outcome(
        bool(high >= 1.0 - _STILL and low <= _STILL), f"amplitude {high:.3f} at level 1, {low:.3f} at level 0"
    )


def moves_one_motor(tester: NodeTester) -> Outcome:
    """Test HAPTICS-04: a level commanded for one motor drives only this motor."""
    wrong = []
    names = _motors(tester)
    for index, name in enumerate(names):
        last = _settle(tester, 0.5, only=name)
        others = np.delete(last, index)
        if not (abs(last[index] - 0.5) <= LAG and others.max() <= _STILL):
            wrong.append(f"{name} {last[index]:.2f}, others up to {others.max():.2f}")
    return Outcome(not wrong, "; ".join(wrong) if wrong else f"{len(names)} motors, each driven alone")


def stays_in_range(tester: NodeTester) -> Outcome:
    """Test HAPTICS-05: after the command 0.5, a command above the DBC range must give an amplitude between 0.5 and 1."""
    found, passed = [], True
    for code in (201, 230, 254):
        _settle(tester, 0.5)
        # Every second command is valid. So a node that ignores the raw values above the DBC range does not time out.
        received = [
            frame
            for _ in range(_BAD)
            for raw in (_codes(tester, code), None)
            for frame in tester.cycle(_command(tester, 0.5, raw=raw))
        ]
        amplitudes = _amplitudes(tester, received)
        low, high = amplitudes.min(), amplitudes.max()
        passed &= bool(low >= 0.5 - LAG and high <= 1.0 + 1e-9)
        found.append(f"{code}: {low:.2f} to {high:.2f}")
    return Outcome(passed, ", ".join(found))


def stops_without_commands(tester: NodeTester) -> Outcome:
    """Test HAPTICS-07: without commands, each amplitude falls by at least `LAG` until the deadline, and finally to 0."""
    bound = _stop_bound(tester)
    before, last_command = _settle(tester, 1.0), tester.cycle_number
    states = tester.states(tester.idle(2 * _SETTLED))
    amplitudes = _amplitudes(tester, [frame for frame in states if frame.cycle - last_command >= bound])
    fell, last = before - amplitudes[0], amplitudes[-1].max()
    text = f"amplitude {amplitudes[0].max():.3f} after {bound} ms, {last:.3f} after {2 * _SETTLED} ms"
    return Outcome(bool(fell.min() >= LAG and last <= _STILL), text)


def _stop_bound(tester: NodeTester) -> int:
    """Return the deadline for the motors to stop, in cycles since the last command.

    The command times out after the TimeoutTime of the DBC, and the next state may be sampled one state period later.
    """
    return tester.command.message.timeout_ms + tester.state_message.cycle_ms


def _ignores(bad: Callable[[NodeTester, int], Frames]) -> Callable[[NodeTester], Outcome]:
    def test(tester: NodeTester) -> Outcome:
        _settle(tester, 0.0)
        received = [frame for number in range(_BAD) for frame in tester.cycle(bad(tester, number))]
        most = _amplitudes(tester, received).max()
        _run(tester, 10, 0.0)
        return Outcome(bool(most <= _STILL), f"amplitude {most:.3f} at most")

    return test


def _motors(tester: NodeTester) -> list[str]:
    return [s.name.removesuffix("_Amplitude") for s in tester.state_message.signals if s.name.endswith("_Amplitude")]


def _codes(tester: NodeTester, code: int) -> dict[str, int]:
    return {f"{motor}_Level": code for motor in _motors(tester)}


def _command(
    tester: NodeTester,
    level: float,
    *,
    only: str | None = None,
    raw: dict[str, int] | None = None,
    counter: int | None = None,
    data_id: int | None = None,
    length: int | None = None,
    flip: int | None = None,
) -> Frames:
    levels = {f"{motor}_Level": level for motor in _motors(tester) if only in (None, motor)}
    return tester.command.frame(levels, raw=raw, counter=counter, data_id=data_id, length=length, flip=flip)


def _run(tester: NodeTester, cycles: int, level: float, only: str | None = None) -> list[ReceivedFrame]:
    return [frame for _ in range(cycles) for frame in tester.cycle(_command(tester, level, only=only))]


def _settle(tester: NodeTester, level: float, only: str | None = None) -> Vector:
    """Command a level until the motors reach the level, for at most `_SETTLED` cycles.

    Args:
        tester: tester of the haptics node.
        level: level of the motors, 0 to 1.
        only: name of the only motor with this level, while the other motors have level 0; None means all motors.

    Returns:
        Last measured amplitudes, shape (motors,), 0 to 1.
    """
    expected = np.array([level if only in (None, motor) else 0.0 for motor in _motors(tester)])
    amplitude = np.full(len(expected), np.nan)
    for _ in range(_SETTLED // tester.state_message.cycle_ms):
        amplitude = _amplitudes(tester, _run(tester, tester.state_message.cycle_ms, level, only))[-1]
        if np.abs(amplitude - expected).max() <= _STILL:
            break
    return amplitude


def _amplitudes(tester: NodeTester, received: list[ReceivedFrame]) -> Vector:
    """Return the amplitude of each motor in each state frame. Shape (states, motors)."""
    states = tester.states(received)
    if not states:
        raise NotTested("no state frame of the DBC length received; see NODE-04 and NODE-13")
    return np.array([[frame.values[f"{motor}_Amplitude"] for motor in _motors(tester)] for frame in states])

"""What the haptics node owes its eight motors: each follows its own level like a first-order lag, and stops without commands."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

import numpy as np
import numpy.typing as npt

from atalante_hal.wire.frame import Frames
from atalante_tools.conform.bench import Bench, NotTested
from atalante_tools.conform.frames import Heard
from atalante_tools.conform.requirement import Outcome, Requirement

Vector = npt.NDArray[np.float64]

E2E: Final = "AUTOSAR E2E Profile 5"
#: Longest time constant [s], and how far the lag may be from one of first order (share of full amplitude).
TIME_CONSTANT, LAG = 0.06, 0.05
#: Cycles in which every motor has reached its level, or stopped.
_SETTLED: Final = 250
#: An amplitude that is nothing.
_STILL: Final = 0.02
#: Cycles of commands that are to be ignored.
_BAD: Final = 40


def requirements(bench: Bench) -> list[Requirement]:
    """Of the haptics node."""
    return [
        Requirement("HAPTICS-01", "Is still at rest.", "50 ms without command", "DBC Amplitude", is_still),
        Requirement(
            "HAPTICS-02",
            f"Follows its level like a first-order lag of at most {TIME_CONSTANT * 1e3:g} ms.",
            "all levels from 0 to 1",
            "DBC Level, Amplitude",
            follows_like_a_lag,
        ),
        Requirement(
            "HAPTICS-03",
            "Reaches both ends of the range of its level.",
            f"1 and 0 for {_SETTLED} ms each",
            "DBC Level",
            reaches_both_ends,
        ),
        Requirement(
            "HAPTICS-04",
            "Moves the commanded motor alone.",
            "one motor after the other at 0.5",
            "DBC Level",
            moves_one_motor,
        ),
        Requirement(
            "HAPTICS-05",
            "Clamps or refuses a level above its range.",
            f"codes 201, 230 and 254 for {_BAD} ms at level 0.5",
            "DBC Level range",
            stays_in_range,
        ),
        Requirement(
            "HAPTICS-06",
            "Does not act on an invalid level.",
            f"the invalid code for {_BAD} ms at level 0",
            "DBC InvalidRaw",
            _ignores(lambda b, _: _command(b, 0.0, raw=_codes(b, 255))),
        ),
        Requirement(
            "HAPTICS-07",
            "Stops when commands stay away.",
            f"{2 * _SETTLED} ms without command after level 1",
            "DBC HAPTICS_COMMAND TimeoutTime",
            stops_without_commands,
        ),
        Requirement(
            "HAPTICS-08",
            "Ignores commands with a wrong CRC.",
            f"{_BAD} commands with one bit damaged",
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
            f"{_BAD} commands with the counter of the last good one",
            E2E,
            _ignores(lambda b, _: _command(b, 1.0, counter=b.command.counter)),
        ),
        Requirement(
            "HAPTICS-11",
            "Ignores commands of another length.",
            f"{_BAD} commands of 20 and 64 bytes, CRC right for that length",
            "DBC length",
            _ignores(lambda b, number: _command(b, 1.0, length=(20, 64)[number % 2])),
        ),
    ]


def is_still(bench: Bench) -> Outcome:
    """HAPTICS-01."""
    most = _amplitudes(bench, bench.idle(50)).max()
    return Outcome(bool(most <= _STILL), f"amplitude {most:.3f} at the most")


def follows_like_a_lag(bench: Bench) -> Outcome:
    """HAPTICS-02: what is left to go shrinks by the same factor from one state to the next."""
    _bring(bench, 0.0)
    left = 1.0 - _amplitudes(bench, _run(bench, _SETTLED, 1.0))
    period = bench.state_message.cycle_ms * 1e-3
    slowest, worst = 0.0, 0.0
    for motor in left.T:
        start = int(np.flatnonzero(motor > 0.99)[-1]) + 1 if (motor > 0.99).any() else 0
        going = motor[start:]
        if len(going) < 3:
            return Outcome(False, "a motor does not move")
        factor = float(going[1:] @ going[:-1] / (going[:-1] @ going[:-1]))  # least squares
        model = going[0] * factor ** np.arange(len(going))
        slowest = max(slowest, -period / np.log(factor) if 0.0 < factor < 1.0 else np.inf)
        worst = max(worst, float(np.abs(going - model).max()))
    text = f"time constant {slowest * 1e3:.0f} ms, {worst:.3f} from a first-order lag"
    return Outcome(slowest <= TIME_CONSTANT and worst <= LAG, text)


def reaches_both_ends(bench: Bench) -> Outcome:
    """HAPTICS-03."""
    high = _amplitudes(bench, _run(bench, _SETTLED, 1.0))[-1].min()
    low = _amplitudes(bench, _run(bench, _SETTLED, 0.0))[-1].max()
    return Outcome(bool(high >= 1.0 - _STILL and low <= _STILL), f"{high:.3f} at level 1, {low:.3f} at level 0")


def moves_one_motor(bench: Bench) -> Outcome:
    """HAPTICS-04."""
    wrong = []
    names = _motors(bench)
    for place, name in enumerate(names):
        last = _bring(bench, 0.5, only=name)
        others = np.delete(last, place)
        if not (abs(last[place] - 0.5) <= LAG and others.max() <= _STILL):
            wrong.append(f"{name} {last[place]:.2f}, others up to {others.max():.2f}")
    return Outcome(not wrong, "; ".join(wrong) if wrong else f"{len(names)} motors, each by itself")


def stays_in_range(bench: Bench) -> Outcome:
    """HAPTICS-05."""
    found, passed = [], True
    for code in (201, 230, 254):
        _bring(bench, 0.5)
        heard = [h for _ in range(_BAD) for h in bench.cycle(_command(bench, 0.5, raw=_codes(bench, code)))]
        amplitudes = _amplitudes(bench, heard)
        low, high = amplitudes.min(), amplitudes.max()
        passed &= bool(low >= 0.5 - LAG and high <= 1.0 + 1e-9)
        found.append(f"{code}: {low:.2f} to {high:.2f}")
    return Outcome(passed, ", ".join(found))


def stops_without_commands(bench: Bench) -> Outcome:
    """HAPTICS-07."""
    _bring(bench, 1.0)
    last = _amplitudes(bench, bench.idle(2 * _SETTLED))[-1].max()
    return Outcome(bool(last <= _STILL), f"amplitude {last:.3f} after {2 * _SETTLED} ms")


def _ignores(bad: Callable[[Bench, int], Frames]) -> Callable[[Bench], Outcome]:
    def test(bench: Bench) -> Outcome:
        _bring(bench, 0.0)
        heard = [h for number in range(_BAD) for h in bench.cycle(bad(bench, number))]
        most = _amplitudes(bench, heard).max()
        _run(bench, 10, 0.0)
        return Outcome(bool(most <= _STILL), f"amplitude {most:.3f} at the most")

    return test


def _motors(bench: Bench) -> list[str]:
    return [s.name.removesuffix("_Amplitude") for s in bench.state_message.signals if s.name.endswith("_Amplitude")]


def _codes(bench: Bench, code: int) -> dict[str, int]:
    return {f"{motor}_Level": code for motor in _motors(bench)}


def _command(
    bench: Bench,
    level: float,
    *,
    only: str | None = None,
    raw: dict[str, int] | None = None,
    counter: int | None = None,
    data_id: int | None = None,
    length: int | None = None,
    flip: int | None = None,
) -> Frames:
    levels = {f"{motor}_Level": level for motor in _motors(bench) if only in (None, motor)}
    return bench.command.frame(levels, raw=raw, counter=counter, data_id=data_id, length=length, flip=flip)


def _run(bench: Bench, cycles: int, level: float, only: str | None = None) -> list[Heard]:
    return [h for _ in range(cycles) for h in bench.cycle(_command(bench, level, only=only))]


def _bring(bench: Bench, level: float, only: str | None = None) -> Vector:
    """Command a level until every motor is there, or should be; the amplitudes then. Shape (motors,)."""
    wanted = np.array([level if only in (None, motor) else 0.0 for motor in _motors(bench)])
    amplitude = np.full(len(wanted), np.nan)
    for _ in range(_SETTLED // bench.state_message.cycle_ms):
        amplitude = _amplitudes(bench, _run(bench, bench.state_message.cycle_ms, level, only))[-1]
        if np.abs(amplitude - wanted).max() <= _STILL:
            break
    return amplitude


def _amplitudes(bench: Bench, heard: list[Heard]) -> Vector:
    """Amplitude of each motor in each state. Shape (states, motors)."""
    states = bench.states(heard)
    if not states:
        raise NotTested("no state frame was heard")
    return np.array([[h.values[f"{motor}_Amplitude"] for motor in _motors(bench)] for h in states])

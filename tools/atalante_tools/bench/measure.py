"""Measurement of a benchmark. A measured function and a baseline run alternately in blocks. Their median times are compared.

Absolute times depend on the machine and the load of the machine. The measured function and the baseline run under the
same conditions, so the ratio of the two times is comparable between machines. Times also depend on the memory layout of the
process, so a benchmark of a few microseconds is repeated in several processes.
"""

from __future__ import annotations

import gc
import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Final

#: Number of blocks of the measured function in a normal run, large enough for a robust median.
#: The baseline has the same number of blocks.
ROUNDS: Final = 200
#: Number of blocks of the measured function with the option `--quick`.
#: The baseline has the same number of blocks.
QUICK_ROUNDS: Final = 5

#: Function that runs one block and returns the time per repetition [s].
Block = Callable[[], float]


class BenchmarkError(Exception):
    """Raised if a benchmark computed a wrong result, because the measured times are then meaningless."""


@dataclass(frozen=True)
class Measurement:
    """Result of a benchmark: measured time and baseline time [s]. A time that was not measured is None.

    A measured time is usually the median of many blocks. The baseline may also be a fixed limit. The field `remarks`
    contains sentences to log, such as the reason why a time is missing.
    """

    value: float | None
    baseline: float | None
    remarks: tuple[str, ...] = ()
    #: Values of `ratio` from all processes that ran the benchmark, in ascending order. Empty if it ran only in this process.
    ratios: tuple[float, ...] = ()

    @property
    def ratio(self) -> float | None:
        """Return the measured time divided by the baseline time, or None if one of these times was not measured."""
        return None if self.value is None or not self.baseline else self.value / self.baseline


def median(measured: Sequence[Measurement]) -> Measurement:
    """Return the measurement with the median ratio. Its field `ratios` contains the ratios of all measurements.

    If a time was not measured, return the first measurement.

    Args:
        measured: measurements of the same benchmark in an odd number of processes.
    """
    ordered = sorted((one.ratio, number) for number, one in enumerate(measured) if one.ratio is not None)
    if len(ordered) < len(measured):  # a time was not measured
        return measured[0]
    _, number = ordered[len(ordered) // 2]
    return replace(measured[number], ratios=tuple(ratio for ratio, _ in ordered))


@dataclass(frozen=True)
class Effort:
    """Settings of a measurement: how many rounds, and how to show the progress."""

    quick: bool = False  # True for a short run (option `--quick`), which only checks that the benchmark works
    #: Function `progress(done, total)`, called after each round with the numbers of completed rounds and of all rounds.
    progress: Callable[[int, int], None] = field(default=lambda _done, _total: None)

    def rounds(self, share: float = 1.0) -> int:
        """Return the number of rounds of a measurement, at least `QUICK_ROUNDS`.

        Args:
            share: fraction of the usual number of rounds, below 1 for benchmarks with long blocks.
        """
        return QUICK_ROUNDS if self.quick else max(QUICK_ROUNDS, round(ROUNDS * share))

    def interleave(self, value: Block, baseline: Block, share: float = 1.0) -> Measurement:
        """Run the two blocks alternately and return the median time of each block.

        Before the measurement, each block runs once to warm up. During the measurement, garbage collection is off.

        Args:
            value: block of the measured function.
            baseline: block of the baseline.
            share: fraction of the usual number of rounds.
        """
        rounds = self.rounds(share)
        value(), baseline()
        values, baselines = [], []
        with _NoGarbageCollection():
            for done in range(1, rounds + 1):
                values.append(value())
                baselines.append(baseline())
                self.progress(done, rounds)
        return Measurement(statistics.median(values), statistics.median(baselines))


def timed(work: Callable[[], object], repetitions: int) -> Block:
    """Return a block that calls the function `work` repeatedly and returns the mean time per call [s]."""
    counter = range(repetitions)
    # The processor time of this thread excludes the time of other processes.
    now = time.thread_time

    def block() -> float:
        begin = now()
        for _ in counter:
            work()
        return (now() - begin) / repetitions

    return block


def require(condition: object, message: str) -> None:
    """Raise `BenchmarkError` if a condition for a valid benchmark is false.

    Args:
        condition: condition that must be true.
        message: text of the error.

    Raises:
        BenchmarkError: If the condition is false.
    """
    if not condition:
        raise BenchmarkError(message)


class _NoGarbageCollection:
    """Context manager that switches garbage collection off, because its pauses would distort the times."""

    def __enter__(self) -> None:
        gc.collect()
        self._was_on = gc.isenabled()
        gc.disable()

    def __exit__(self, *_: object) -> None:
        if self._was_on:
            gc.enable()

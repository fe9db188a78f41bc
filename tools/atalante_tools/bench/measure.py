"""Measurement of one benchmark: value and baseline in alternating short blocks, and the median of each.

Absolute times depend on the machine and its load. Both sides run under the same conditions, so the ratio is comparable
between machines.
"""

from __future__ import annotations

import gc
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Final

#: Number of blocks of each side for a robust median, and for a quick functional check.
ROUNDS: Final = 200
QUICK_ROUNDS: Final = 5

#: Function that runs one block and returns the time per unit of work [s].
Block = Callable[[], float]


class WorkError(Exception):
    """Benchmark did not do its work, so its times are meaningless."""


@dataclass(frozen=True)
class Measurement:
    """Result of a benchmark: its time and its baseline [s], each None if it was not measured.

    A measured time is usually the median of many blocks. The baseline may also be a fixed limit. `remarks` are sentences to log,
    such as the reason why a time is missing.
    """

    value: float | None
    baseline: float | None
    remarks: tuple[str, ...] = ()

    @property
    def ratio(self) -> float | None:
        """Return value divided by baseline; None if one of them was not measured."""
        return None if self.value is None or not self.baseline else self.value / self.baseline


@dataclass(frozen=True)
class Effort:
    """Number of rounds to measure. `progress(done, total)` is called after each round."""

    quick: bool = False
    progress: Callable[[int, int], None] = field(default=lambda _done, _total: None)

    def rounds(self, share: float = 1.0) -> int:
        """Return the number of rounds.

        Args:
            share: fraction of the usual number, for benchmarks with long blocks; the result is at least `QUICK_ROUNDS`.
        """
        return QUICK_ROUNDS if self.quick else max(QUICK_ROUNDS, round(ROUNDS * share))

    def interleave(self, value: Block, baseline: Block, share: float = 1.0) -> Measurement:
        """Run both blocks alternately and return the medians. One warm-up block each comes first; garbage collection is off.

        Args:
            value: block of the benchmark.
            baseline: block of the baseline.
            share: fraction of the usual number of rounds.
        """
        rounds = self.rounds(share)
        value(), baseline()
        ours, theirs = [], []
        with _no_collection():
            for done in range(1, rounds + 1):
                ours.append(value())
                theirs.append(baseline())
                self.progress(done, rounds)
        return Measurement(statistics.median(ours), statistics.median(theirs))


def timed(work: Callable[[], object], repetitions: int) -> Block:
    """Return a block that calls `work` `repetitions` times."""
    counter = range(repetitions)
    # Processor time of this thread excludes the time used by other processes.
    now = time.thread_time

    def block() -> float:
        begin = now()
        for _ in counter:
            work()
        return (now() - begin) / repetitions

    return block


def require(condition: object, message: str) -> None:
    """Raise an error with `message` if the condition is false.

    Raises:
        WorkError: If the condition is false.
    """
    if not condition:
        raise WorkError(message)


class _no_collection:  # noqa: N801 - used like a function
    """Context with garbage collection off, because its pauses belong to no benchmark."""

    def __enter__(self) -> None:
        gc.collect()
        self._was_on = gc.isenabled()
        gc.disable()

    def __exit__(self, *_: object) -> None:
        if self._was_on:
            gc.enable()

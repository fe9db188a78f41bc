"""How a figure is taken: value and baseline side by side in the same run, in short blocks A B A B, medians of each.

Absolute figures depend on the machine and on what else it does; both sides meet the same machine, so the ratio travels.
"""

from __future__ import annotations

import gc
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Final

#: Blocks of each side: enough for a median that other processes do not move, or just enough to see that it works.
ROUNDS: Final = 200
QUICK_ROUNDS: Final = 5

#: Runs one block and returns its seconds for one unit of work.
Block = Callable[[], float]


class WorkError(Exception):
    """A benchmark did not do the work it is about; its figures would mean nothing."""


@dataclass(frozen=True)
class Measurement:
    """Medians in seconds; None: not measured, and `remarks` say why. `remarks` are sentences for the person who asked."""

    value: float | None
    baseline: float | None
    remarks: tuple[str, ...] = ()

    @property
    def ratio(self) -> float | None:
        """Value over baseline."""
        return None if self.value is None or not self.baseline else self.value / self.baseline


@dataclass(frozen=True)
class Effort:
    """How much to measure. `progress(done, of)` is called after each round."""

    quick: bool = False
    progress: Callable[[int, int], None] = field(default=lambda _done, _of: None)

    def rounds(self, share: float = 1.0) -> int:
        """Rounds of a benchmark whose blocks are long: a share of the usual number, at least a few."""
        return QUICK_ROUNDS if self.quick else max(QUICK_ROUNDS, round(ROUNDS * share))

    def interleave(self, value: Block, baseline: Block, share: float = 1.0) -> Measurement:
        """Medians of both over the rounds, after one block each to warm up; the garbage collector rests meanwhile."""
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
    """A block that calls `work` a number of times."""
    counter = range(repetitions)
    # What other processes take meanwhile is not in it.
    now = time.thread_time

    def block() -> float:
        begin = now()
        for _ in counter:
            work()
        return (now() - begin) / repetitions

    return block


def require(held: object, what: str) -> None:
    """Raise `WorkError` unless the check held."""
    if not held:
        raise WorkError(what)


class _no_collection:  # noqa: N801 - used like a function
    """Garbage collection off inside the block: its pauses are the loop's business to avoid, not part of a stage."""

    def __enter__(self) -> None:
        gc.collect()
        self._was_on = gc.isenabled()
        gc.disable()

    def __exit__(self, *_: object) -> None:
        if self._was_on:
            gc.enable()

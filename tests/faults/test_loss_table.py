"""Compare the table below the fault matrix with the simulated time until a node with random frame loss is untrusted."""

from __future__ import annotations

import re

import numpy as np
import pytest

from atalante_hal.wire.e2e import MAX_DELTA, SETTLED, qualify
from atalante_tools.faults.matrix import MATRIX_FILE

SEEDS = 200


def cycles_to_trip(loss: float, seed: int, longest: int) -> int:
    """Return the number of cycles until a node with random frame loss is untrusted.

    A node is untrusted after five losses in a row, or when too many of its frames are lost, see `qualify`.
    """
    lost = np.random.default_rng((round(1000 * loss), seed)).random(longest) < loss
    now, age = SETTLED, 0
    for cycle, bad in enumerate(lost.tolist(), 1):
        age = age + 1 if bad else 0
        now = qualify(now, good=not bad, timed_out=age >= MAX_DELTA)
        if not now.trusted:
            return cycle
    return longest


def milliseconds(text: str) -> float:
    number, unit = text.split()
    return float(number) * {"s": 1000.0, "ms": 1.0}[unit]


def table() -> dict[float, tuple[float, float | None]]:
    """Return the rows of the table, by loss: median time, and time for 95 % of the nodes or None [ms]."""
    found = re.findall(
        r"^\| (\d+) % \| ([\d.]+ m?s)(?: \(95 % within ([\d.]+ ms)\))? \|$", MATRIX_FILE.read_text(), re.MULTILINE
    )
    return {
        int(loss) / 100: (milliseconds(median), milliseconds(most) if most else None) for loss, median, most in found
    }


@pytest.mark.parametrize("loss", [0.2, 0.3, 0.5])
def test_f02_time_to_the_first_trip_agrees_with_the_table(loss: float) -> None:
    median, most = table()[loss]
    trips = [cycles_to_trip(loss, seed, 10_000) for seed in range(SEEDS)]
    assert np.median(trips) == pytest.approx(median, rel=0.2)
    if most is not None:
        assert np.percentile(trips, 95) == pytest.approx(most, rel=0.2)


def test_f02_ten_percent_loss_does_not_trip_for_seconds() -> None:
    trips = [cycles_to_trip(0.1, seed, 20_000) for seed in range(20)]
    assert np.median(trips) == 20_000


def test_f01_one_percent_loss_never_trips() -> None:
    assert all(cycles_to_trip(0.01, seed, 60_000) == 60_000 for seed in range(3))

"""Benchmark of the start-up: a process starts HAL and emulator, runs one cycle and exits."""

from __future__ import annotations

import statistics
import subprocess
import sys
import time
from typing import Final

from atalante_tools.bench.measure import Effort, Measurement, require

_FIRST_CYCLE: Final = """
from atalante_tools.console.options import EMBEDDED, Target
from atalante_tools.session.rig import open_hal
with open_hal(Target(EMBEDDED, "", lockstep=True)) as rig:
    print(rig.hal.read().cycle)
"""
_IMPORT_ALONE: Final = "import pybullet; print(1)"


def start_up(effort: Effort) -> Measurement:
    """Measure the time of a process that starts HAL and emulator, runs one cycle and exits."""
    values: list[float] = []
    baselines: list[float] = []
    rounds = 1 if effort.quick else 5
    for done in range(1, rounds + 1):
        values.append(_seconds(_FIRST_CYCLE))
        baselines.append(_seconds(_IMPORT_ALONE))
        effort.progress(done, rounds)
    return Measurement(statistics.median(values), statistics.median(baselines))


def _seconds(program: str) -> float:
    begin = time.perf_counter()
    process = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    seconds = time.perf_counter() - begin
    require(
        process.returncode == 0 and process.stdout.split()[-1:] == ["1"], f"the process failed: {process.stderr[-300:]}"
    )
    return seconds

"""All benchmarks as data: what is measured, against what, and how small the ratio has to be."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from atalante_tools.bench import gait_solve, gaits, motion, startup, wire
from atalante_tools.bench.measure import Effort, Measurement
from atalante_tools.canlog.validate import benchmark

_UNITS: Final = {"us": 1e6, "s": 1.0}


@dataclass(frozen=True)
class Benchmark:
    """One line of the result."""

    name: str
    run: Callable[[Effort], Measurement]
    unit: str
    baseline: str  # what the baseline is
    target: float | None = None  # largest ratio that is good enough; None: for information

    @property
    def per_second(self) -> float:
        """Units in a second."""
        return _UNITS[self.unit]


BENCHMARKS: Final = (
    Benchmark(
        "hal_cycle",
        wire.hal_cycle,
        "us",
        "the same cycle with python-can (virtual), cantools and the same filter",
        1 / 7,
    ),
    Benchmark(
        "decode_cycle",
        wire.decode_cycle,
        "us",
        "C of cantools, gcc -O2: unpack, decode and range check of the same signals",
        8.0,
    ),
    Benchmark(
        "encode_cycle",
        wire.encode_cycle,
        "us",
        "C of cantools, gcc -O2: range check, encode and pack of the same signals",
    ),
    Benchmark(
        "e2e_check",
        wire.e2e_check,
        "us",
        "autosar-e2e and the counter, frame by frame",
    ),
    Benchmark(
        "ring_write",
        wire.ring_write,
        "us",
        "the whole HAL cycle",
        0.02,
    ),
    Benchmark(
        "filter_tick",
        motion.filter_tick,
        "us",
        "the same rollouts integrated step by step in numpy on the same grid",
        1 / 20,
    ),
    Benchmark(
        "emulator_tick",
        motion.emulator_tick,
        "us",
        "PyBullet's share of the same tick: torques, step and reads",
        2.3,
    ),
    Benchmark(
        "lockstep",
        motion.lockstep,
        "s",
        "real time: a simulated second of the whole stack in the air",
        1 / 6,
    ),
    Benchmark(
        "judge_log",
        benchmark.judge_log,
        "us",
        "python-can and cantools reading and decoding the same candump log, a frame",
        1 / 20,
    ),
    Benchmark(
        "judge_against_mdf",
        benchmark.judge_against_mdf,
        "us",
        "asammdf decoding the same frames from MF4, a frame",
        1.0,
    ),
    Benchmark(
        "model_build",
        gaits.model_build,
        "us",
        "Pinocchio parsing the same URDF",
    ),
    Benchmark(
        "inverse_dynamics",
        gaits.inverse_dynamics,
        "us",
        "one recursive Newton-Euler pass of Pinocchio over the floating model",
    ),
    Benchmark(
        "network_evaluation",
        gaits.network_evaluation,
        "us",
        "50 us, a twentieth of a cycle",
        1.0,
    ),
    Benchmark(
        "gait_solve_cold",
        gait_solve.gait_solve_cold,
        "s",
        "3 s, a gait on one core",
        1.0,
    ),
    Benchmark(
        "gait_solve_warm",
        gait_solve.gait_solve_warm,
        "s",
        "1 s, what a gait from its neighbour should take",
        1.0,
    ),
    Benchmark(
        "library_one_process",
        gaits.library_one_process,
        "s",
        "3 s, a gait of a library on one core",
        1.0,
    ),
    Benchmark(
        "library_two_processes",
        gaits.library_two_processes,
        "s",
        "3 s a core, a gait of a library on two",
        1.0,
    ),
    Benchmark(
        "start_up",
        startup.start_up,
        "s",
        "a process that imports pybullet and ends",
    ),
)

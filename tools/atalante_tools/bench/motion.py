"""Benchmarks of what moves: the guide filter, the emulator, and the whole stack in the air."""

from __future__ import annotations

import statistics
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from itertools import cycle
from typing import Any, Final

import numpy as np

from atalante_control.airwalk.controller import AirwalkController
from atalante_control.guide.shapes import CONSTANT
from atalante_hal.hal import PERIOD
from atalante_hal.telemetry.ring import RingWriter
from atalante_hal.types import State, SupervisorState
from atalante_tools.bench.measure import Effort, Measurement, require, timed
from atalante_tools.bench.nodes import ASSISTANCE, ERROR, ERROR_RATE, walk
from atalante_tools.bench.stepped import SteppedRollouts
from atalante_tools.console.options import EMBEDDED, Target
from atalante_tools.session.embedded import EmbeddedRobot
from atalante_tools.session.rig import Rig, open_hal

#: Exact flow and step-by-step integration agree within this [rad].
AGREEMENT: Final = 1e-6
#: A robot that walks keeps the gait within this [rad]; one that fell, hangs limp or exploded does not.
POSE: Final = 0.15
#: Cycles from the start until the robot walks, and of one block.
_BEFORE_WALKING: Final = 3000
_BLOCK: Final = 50
_TICKS: Final = 40
_MARCHES: Final = 4


def filter_tick(effort: Effort) -> Measurement:
    """u_v of both joints against nothing but the march of the rollouts."""
    guide = walk().guide
    guide.start_step(ASSISTANCE, (ERROR, -ERROR), (ERROR_RATE, ERROR_RATE))
    march = SteppedRollouts(guide)
    rng = np.random.default_rng(0)
    errors = rng.uniform(-1.0, 1.0, (256, 4)) * np.array([ERROR, ERROR_RATE, ERROR, ERROR_RATE])
    moments = [
        (k, *x) for k, x in zip(rng.integers(0, guide.cycles, len(errors)).tolist(), errors.tolist(), strict=True)
    ]
    saturated = guide.stepped
    worst = max(float(np.abs(guide.rollouts(*moment) - march.rollouts(*moment)).max()) for moment in moments)
    require(worst <= AGREEMENT, f"the exact flow is {worst:.1e} rad off the integration, more than {AGREEMENT:.0e}")
    ours, theirs = cycle(moments), cycle(moments)
    measured = effort.interleave(
        timed(lambda: guide.tick(*next(ours)), _TICKS), timed(lambda: march.rollouts(*next(theirs)), _MARCHES)
    )
    require(guide.stepped == saturated, "the filter saturated, which is another benchmark")
    return Measurement(measured.value, measured.baseline, (f"agrees with the integration to {worst:.1e} rad",))


def emulator_tick(effort: Effort) -> Measurement:
    """What the emulator does with a cycle while the whole stack walks, beside the engine's share of the same ticks.

    Both are taken inside the cycle: a bare step repeated alone has its caches to itself and is a third cheaper, which no
    emulator in a loop will ever see.
    """
    now = time.perf_counter
    ours: list[float] = []
    theirs: list[float] = []
    with _stack(None) as stack:
        emulator = stack.rig.emulator
        assert emulator is not None
        poll, body, bus = emulator.poll, emulator.body, stack.rig.hal.bus
        exchange = body.exchange  # type: ignore[attr-defined]

        def timed_exchange(torque: Sequence[float]) -> Any:
            began = now()
            answer = exchange(torque)
            theirs.append(now() - began)
            return answer

        def tick() -> None:
            begin = now()
            ran = poll()
            polled = now()
            if ran:
                ours.append(polled - begin)

        body.exchange = timed_exchange  # type: ignore[attr-defined]
        bus.step = tick  # type: ignore[attr-defined]
        cycles = stack.walk(effort)
        # What came before was not walking, what came after was holding.
        walked = slice(_BEFORE_WALKING, _BEFORE_WALKING + cycles)
        require(len(ours[walked]) == len(theirs[walked]) == cycles, f"only {len(ours)} ticks ran")
    return Measurement(statistics.median(ours[walked]), statistics.median(theirs[walked]))


def lockstep(effort: Effort) -> Measurement:
    """Wall time of a simulated second: HAL, controller, emulator, and a record into the ring every cycle."""
    with _stack(EmbeddedRobot()) as stack:
        stack.walk(effort)
    ordered = [block / (_BLOCK * PERIOD) for block in sorted(stack.blocks)]
    seconds, undisturbed = statistics.median(ordered), ordered[len(ordered) // 10]
    # Two processes need two whole cores: who shares a core's other half with them takes almost half of their speed, unseen.
    told = f"{1.0 / seconds:.1f} times real time; {1.0 / undisturbed:.1f} in the tenth of its blocks least disturbed by others"
    return Measurement(seconds, 1.0, (told,))


@dataclass
class _Stack:
    """Everything in the air, as `atalante demo` runs it."""

    rig: Rig
    controller: AirwalkController
    ring: RingWriter
    blocks: list[float] = field(default_factory=list)  # s, wall time of each block of walking

    def walk(self, effort: Effort) -> int:
        """Start, walk, and stop after the effort's rounds of `_BLOCK` cycles; returns how many that were.

        Raises:
            WorkError: the robot did not walk, or frames or records were lost.
        """
        rounds = effort.rounds()
        cycles = rounds * _BLOCK
        count = 0
        begun = 0.0

        def over(state: State) -> bool:
            nonlocal count, begun
            count += 1
            walked = count - _BEFORE_WALKING
            if walked >= 0 and walked % _BLOCK == 0:
                ended = time.perf_counter()
                if walked:
                    self.blocks.append(ended - begun)
                    effort.progress(walked // _BLOCK, rounds)
                self._require_walking(state)
                begun = time.perf_counter()
            return walked == cycles

        hal, ring = self.rig.hal, self.ring
        self.rig.run(self.controller, until=over, record=lambda: ring.write(hal.record))
        require(
            ring.written == _BEFORE_WALKING + cycles, f"{ring.written} records in {_BEFORE_WALKING + cycles} cycles"
        )
        frames = hal.record[hal.layout["frames"]][0]
        require(hal.crc_errors == 0 and frames >= 19 * cycles, f"{frames:.0f} frames, {hal.crc_errors} CRC errors")
        return cycles

    def _require_walking(self, state: State) -> None:
        """A robot that fell or hangs limp is cheaper to simulate."""
        reason = self.rig.hal.reason
        require(state.supervisor is SupervisorState.ACTIVE, f"the robot is in {state.supervisor.name}: {reason}")
        error = np.abs(state.position - self.controller.telemetry[: len(state.position)]).max()
        require(error < POSE, f"a joint is {error:.2f} rad off the gait, more than {POSE}")


@contextmanager
def _stack(robot_process: EmbeddedRobot | None) -> Iterator[_Stack]:
    """With the robot in a process of its own, or in this one."""
    walking = walk()
    controller = AirwalkController(walking.robot, walking.gait, CONSTANT)
    with (
        open_hal(
            Target(EMBEDDED, "", lockstep=True),
            network=walking.network,
            robot=walking.robot,
            pose=walking.tables.q[0].tolist(),
            assistance_factor=ASSISTANCE,
            controller_fields=controller.telemetry_fields,
            gait_hash=walking.gait.hash32,
            robot_process=robot_process,
        ) as rig,
        RingWriter(rig.hal.record.nbytes) as ring,
    ):
        yield _Stack(rig, controller, ring)

"""Benchmarks of what moves: the guide filter, the emulator, and the whole stack in the air."""

from __future__ import annotations

import statistics
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from itertools import cycle
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from atalante_control.controller import HangController
from atalante_control.guide_shapes import CONSTANT
from atalante_control.stepped import SteppedRollouts
from atalante_hal.bus.pair import PairBus, lockstep_pair
from atalante_hal.hal import PERIOD, Hal
from atalante_hal.loop import LockStep, run
from atalante_hal.telemetry.ring import RingWriter
from atalante_hal.types import State, SupervisorState
from atalante_tools.bench.measure import Effort, Measurement, require, timed
from atalante_tools.bench.nodes import ASSISTANCE, ERROR, ERROR_RATE, walk
from atalante_tools.rig import open_body

if TYPE_CHECKING:
    from atalante_emulator.body import LinkState, PyBulletBody, Vector, Vector3
    from atalante_emulator.emulator import Emulator

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
    with _stack() as stack:
        poll, engine = stack.emulator.poll, stack.body.engine
        exchange = engine.exchange

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

        engine.exchange = timed_exchange  # type: ignore[method-assign]
        stack.bus.step = tick
        cycles = stack.walk(effort)
        # What came before was not walking, what came after was holding.
        walked = slice(_BEFORE_WALKING, _BEFORE_WALKING + cycles)
        require(len(ours[walked]) == len(theirs[walked]) == cycles, f"only {len(ours)} ticks ran")
    return Measurement(statistics.median(ours[walked]), statistics.median(theirs[walked]))


def lockstep(effort: Effort) -> Measurement:
    """Wall time of a simulated second: HAL, controller, emulator, and a record into the ring every cycle."""
    with _stack() as stack:
        stack.walk(effort)
    seconds = statistics.median(stack.blocks) / (_BLOCK * PERIOD)
    return Measurement(seconds, 1.0, (f"{1.0 / seconds:.1f} times real time",))


@dataclass
class _Stack:
    """Everything in one process, in the air, as `atalante demo` runs it."""

    hal: Hal
    controller: HangController
    bus: PairBus
    emulator: Emulator
    body: _Tap
    pose: list[float]
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

        hal, ring = self.hal, self.ring
        run(hal, self.controller, LockStep(), until=over, record=lambda: ring.write(hal.record))
        require(
            ring.written == _BEFORE_WALKING + cycles, f"{ring.written} records in {_BEFORE_WALKING + cycles} cycles"
        )
        frames = hal.record[hal.layout["frames"]][0]
        require(hal.crc_errors == 0 and frames >= 19 * cycles, f"{frames:.0f} frames, {hal.crc_errors} CRC errors")
        return cycles

    def _require_walking(self, state: State) -> None:
        """A robot that fell or hangs limp is cheaper to simulate."""
        require(
            state.supervisor is SupervisorState.ACTIVE, f"the robot is in {state.supervisor.name}: {self.hal.reason}"
        )
        desired = self.controller.telemetry[: len(state.position)]
        error = max(np.abs(q - desired).max() for q in (state.position, self.body.position))
        require(error < POSE, f"a joint is {error:.2f} rad off the gait, more than {POSE}")


@contextmanager
def _stack() -> Iterator[_Stack]:
    walking = walk()
    controller = HangController(walking.robot, walking.gait, CONSTANT)
    pose = walking.tables.q[0].tolist()
    ours, theirs = lockstep_pair()
    with open_body(walking.robot, pose) as engine:
        from atalante_emulator.emulator import Emulator
        from atalante_emulator.pendant import Operator

        body = _Tap(engine)
        emulator = Emulator(walking.network, walking.robot, body, theirs, operator=Operator(ASSISTANCE))
        ours.step = emulator.poll
        fields = controller.telemetry_fields
        hal = Hal(walking.network, walking.robot, ours, controller_fields=fields, gait_hash=walking.gait.hash32)
        with RingWriter(hal.record.nbytes) as ring:
            yield _Stack(hal, controller, ours, emulator, body, pose, ring)


class _Tap:
    """A body that remembers the torques it was given."""

    def __init__(self, body: PyBulletBody) -> None:
        self.engine = body
        self.position: Vector = body.position
        self.velocity: Vector = body.velocity
        self.imu: Sequence[LinkState] = body.imu
        self.foot_rotation: Sequence[tuple[float, ...]] = body.foot_rotation
        self.torque: Sequence[float] = ()

    @property
    def contact(self) -> Sequence[tuple[int, int, Vector3]]:
        return self.engine.contact

    def reset(self, position: Sequence[float]) -> None:
        self.engine.reset(position)

    def step(self, torque: Sequence[float]) -> None:
        self.torque = torque
        self.engine.step(torque)

    def close(self) -> None:
        self.engine.close()

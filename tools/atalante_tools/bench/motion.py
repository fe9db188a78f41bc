"""Benchmarks of the guide filter, the emulator and the whole stack.

The guide filter adds torques that keep hip and knee of the swing leg inside a virtual guide. In the benchmarks of emulator and
stack, the robot is suspended or walks on the ground.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from itertools import cycle
from typing import Any, Final

import numpy as np

from atalante_control.airwalk.controller import AirwalkController
from atalante_control.gait.walk import DEFAULT_WALK, load_walk
from atalante_control.guide.kernel import LegState
from atalante_control.guide.shapes import CONSTANT
from atalante_control.joint.leg_model import leg_model
from atalante_control.model import Patient
from atalante_control.walking.controller import WalkController
from atalante_emulator.mechanics import Ground, Mechanics
from atalante_hal.robot import load_robot
from atalante_hal.telemetry.ring import RingWriter
from atalante_hal.types import PERIOD, State, SupervisorState
from atalante_tools.bench.measure import Effort, Measurement, require, timed
from atalante_tools.bench.nodes import ASSISTANCE, ERROR, ERROR_RATE, walk
from atalante_tools.bench.stepped import SteppedRollout
from atalante_tools.console.options import EMBEDDED, Target
from atalante_tools.session.body import describe
from atalante_tools.session.embedded import EmbeddedRobot
from atalante_tools.session.rig import Rig, open_hal
from atalante_tools.session.walk_options import DEFAULT_PATIENT, DEFAULT_STEP

#: Largest accepted deviation of a joint from the gait while the robot walks [rad].
POSE: Final = 0.15
#: Number of cycles from power-on to the measurement of a suspended robot. The robot starts to walk within these cycles.
_BEFORE_WALKING: Final = 3000
#: Number of cycles from power-on to the measurement of a robot on the ground.
#: In the first `_BEFORE_STEPPING` cycles, the crane lowers the robot, and the robot shifts its weight.
_BEFORE_STEPPING: Final = 8000
#: Smallest accepted vertical component of the upward axis of the pelvis after a walk on the ground, 1 if upright.
_UPRIGHT: Final = 0.95
#: Number of cycles that are timed together as one block.
_BLOCK: Final = 50
_STEPS: Final = 1000  # number of requested walking steps; a benchmark ends before the last step
_TICKS: Final = 40
_INTEGRATIONS: Final = 4


def filter_tick(effort: Effort) -> Measurement:
    """Measure one call of the guide filter, which predicts the tracking errors of hip and knee from tables.

    The baseline predicts the same errors by a simulation of each cycle.
    """
    guide = walk().guide
    guide.start_step(ASSISTANCE, (ERROR, -ERROR), (ERROR_RATE, ERROR_RATE))
    stepped, leg = SteppedRollout(guide), guide.prediction.leg
    rng = np.random.default_rng(0)
    cycles = rng.integers(0, guide.cycles, 256)
    errors, rates = rng.uniform(-ERROR, ERROR, (256, 2)), rng.uniform(-ERROR_RATE, ERROR_RATE, (256, 2))
    moments = []
    for at, e, rate in zip(cycles.tolist(), errors, rates, strict=True):
        q, (hip_gravity, knee_gravity) = leg.q[at].tolist(), leg.gravity[at].tolist()
        (hip, knee), (hip_rate, knee_rate) = (leg.q[at] + e).tolist(), (leg.qd[at] + rate).tolist()
        state = LegState(hip, knee, hip_rate, knee_rate, q[0], q[1], 10.0, 5.0, hip_gravity, knee_gravity)
        moments.append((at, state))
    worst = 0.0
    for moment in moments:
        guide.tick(*moment)
        difference = np.abs(guide.errors_ahead() - stepped.errors(guide.state))
        worst = max(worst, float((difference / guide.uncertainty()).max()))
    require(
        worst <= 1.0, f"the prediction must agree with the integration within its uncertainty, got {worst:.2f} of it"
    )
    states = [guide.state]
    exact_inputs, stepped_inputs = cycle(moments), cycle(states)
    measured = effort.interleave(
        timed(lambda: guide.tick(*next(exact_inputs)), _TICKS),
        timed(lambda: stepped.errors(next(stepped_inputs)), _INTEGRATIONS),
    )
    return Measurement(
        measured.value, measured.baseline, (f"agrees with the integration to {worst:.2f} of its uncertainty",)
    )


def emulator_tick(effort: Effort) -> Measurement:
    """Measure one cycle of the emulator while the robot walks; the baseline is the time of PyBullet in the same cycles.

    The whole stack runs during the measurement. Without the stack, PyBullet would need a third less time per cycle,
    because no other code would use the processor caches.
    """
    now = time.perf_counter
    tick_times: list[float] = []
    engine_times: list[float] = []
    with _stack(None) as stack:
        emulator = stack.rig.emulator
        assert emulator is not None
        poll, body, bus = emulator.poll, emulator.body, stack.rig.hal.bus
        exchange = body.exchange  # type: ignore[attr-defined]

        def timed_exchange(torque: Sequence[float]) -> Any:
            began = now()
            answer = exchange(torque)
            engine_times.append(now() - began)
            return answer

        def tick() -> None:
            begin = now()
            ran = poll()
            polled = now()
            if ran:
                tick_times.append(polled - begin)

        body.exchange = timed_exchange  # type: ignore[attr-defined]
        bus.step = tick  # type: ignore[attr-defined]
        cycles = stack.walk(effort)
        # Omit the cycles before the robot walks.
        walked = slice(_BEFORE_WALKING, _BEFORE_WALKING + cycles)
        require(
            len(tick_times[walked]) == len(engine_times[walked]) == cycles,
            f"the emulator must run {_BEFORE_WALKING + cycles} ticks, got {len(tick_times)}",
        )
    return Measurement(statistics.median(tick_times[walked]), statistics.median(engine_times[walked]))


def lockstep(effort: Effort) -> Measurement:
    """Measure the wall time for one simulated second of HAL, controller, emulator and telemetry ring."""
    with _stack(EmbeddedRobot()) as stack:
        stack.walk(effort)
    return _against_real_time(stack)


def lockstep_walk(engine: str) -> Callable[[Effort], Measurement]:
    """Return the benchmark of a walk on the ground with a patient: the wall time for one simulated second of the whole stack.

    Args:
        engine: physics engine of the emulated robot.
    """

    def run(effort: Effort) -> Measurement:
        with _walking_stack(engine) as stack:
            cycles = stack.walk(effort)
            controller = stack.controller
            assert isinstance(controller, WalkController)
            walked, (_, duration) = controller.statistics.steps, DEFAULT_STEP
            require(
                walked >= int(cycles * PERIOD / duration),
                f"the robot must walk a step in {duration} s, got {walked} steps after {cycles * PERIOD} s",
            )
            require(controller.vertical[2] > _UPRIGHT, f"the pelvis must be upright, got {controller.vertical[2]:.2f}")
        return _against_real_time(stack)

    return run


def _against_real_time(stack: _Stack) -> Measurement:
    """Return the wall time for one simulated second, as the median of all blocks. The baseline is real time, 1 s."""
    ordered = [block / (_BLOCK * PERIOD) for block in sorted(stack.blocks)]
    seconds, undisturbed = statistics.median(ordered), ordered[len(ordered) // 10]
    # Another process on the same physical core almost halves the speed, so the remark also reports the fastest blocks.
    remark = f"{1.0 / seconds:.1f} times real time; {1.0 / undisturbed:.1f} times in the fastest tenth of the blocks"
    return Measurement(seconds, 1.0, (remark,))


@dataclass
class _Stack:
    """HAL, controller, emulated robot and telemetry ring, as in `atalante demo` and `atalante walk`."""

    rig: Rig
    controller: AirwalkController | WalkController
    ring: RingWriter
    before: int = _BEFORE_WALKING  # number of cycles before the measurement
    blocks: list[float] = field(default_factory=list)  # wall time of each block of `_BLOCK` cycles [s]

    def walk(self, effort: Effort) -> int:
        """Run the stack until all rounds of the measurement are complete; return the number of measured cycles.

        Args:
            effort: number of rounds of `_BLOCK` cycles, and progress display.

        Raises:
            BenchmarkError: If the robot does not walk, or frames or records are lost.
        """
        rounds = effort.rounds()
        cycles = rounds * _BLOCK
        count = 0
        start = 0.0

        def finished(state: State) -> bool:
            nonlocal count, start
            count += 1
            walked = count - self.before
            if walked >= 0 and walked % _BLOCK == 0:
                end = time.perf_counter()
                if walked:
                    self.blocks.append(end - start)
                    effort.progress(walked // _BLOCK, rounds)
                self._require_walking(state)
                start = time.perf_counter()
            return walked == cycles

        hal, ring = self.rig.hal, self.ring
        self.rig.run(self.controller, until=finished, record=lambda: ring.write(hal.record))
        require(
            ring.written == self.before + cycles,
            f"the ring must have {self.before + cycles} records, got {ring.written}",
        )
        frames = hal.record[hal.layout["frames"]][0]
        require(
            hal.crc_errors == 0 and frames >= 19 * cycles,
            f"the HAL must receive at least {19 * cycles} frames without CRC errors, "
            f"got {frames:.0f} frames and {hal.crc_errors} CRC errors",
        )
        return cycles

    def _require_walking(self, state: State) -> None:
        """Check that the robot walks, because a robot at rest takes less time to simulate."""
        reason = self.rig.hal.reason
        require(
            state.supervisor is SupervisorState.ACTIVE,
            f"the robot must be in ACTIVE, got {state.supervisor.name}: {reason}",
        )
        error = np.abs(state.position - self.controller.telemetry[: len(state.position)]).max()
        require(error < POSE, f"joint deviation from the gait must be below {POSE} rad, got {error:.2f} rad")


@contextmanager
def _stack(robot_process: EmbeddedRobot | None) -> Iterator[_Stack]:
    """Open HAL, controller, emulated robot and telemetry ring, and close all of them at the end of the `with` block.

    Args:
        robot_process: subprocess of the emulated robot. If None, the emulated robot runs in this process.
    """
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
            legs=leg_model(),
        ) as rig,
        RingWriter(rig.hal.record.nbytes) as ring,
    ):
        yield _Stack(rig, controller, ring)


@contextmanager
def _walking_stack(engine: str) -> Iterator[_Stack]:
    """Open HAL, walking controller and telemetry ring. The emulated robot stands on the ground and runs in a subprocess.

    Args:
        engine: physics engine of the emulated robot.
    """
    robot, patient = load_robot(), Patient(*DEFAULT_PATIENT)
    gaits = load_walk(DEFAULT_WALK, robot)
    controller = WalkController(robot, patient, gaits, _STEPS)
    with (
        open_hal(
            Target(EMBEDDED, "", lockstep=True, engine=engine),
            robot=robot,
            pose=controller.standing_pose.tolist(),
            controller_fields=controller.telemetry_fields,
            gait_hash=gaits.step.hash32,
            robot_process=EmbeddedRobot(engine),
            mechanics=Mechanics(describe(robot, None, patient), engine, Ground()),
        ) as rig,
        RingWriter(rig.hal.record.nbytes) as ring,
    ):
        yield _Stack(rig, controller, ring, _BEFORE_STEPPING)

"""Runner of the fault cases: it injects faults while an emulated robot walks in lock-step, and records the run.

case -> rig -> walk -> fault begins -> fault ends -> operator's START -> observation
"""

from __future__ import annotations

import functools
import gc
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np
import numpy.typing as npt

import atalante_dbc
from atalante_control.airwalk.controller import AirwalkConfig, AirwalkController
from atalante_control.gait.gait import AIRWALK_GAIT, Gait, load_gait
from atalante_control.guide.shapes import SHAPES
from atalante_control.joint.leg_model import leg_model
from atalante_dbc import Network
from atalante_hal.leg_model import LegModel
from atalante_hal.loop import run
from atalante_hal.robot import Robot, load_robot
from atalante_hal.types import PERIOD, State, SupervisorState, Vector
from atalante_tools.console.options import EMBEDDED, PYBULLET, Target
from atalante_tools.faults.command_check import Commands, SentFrames
from atalante_tools.faults.disturbed import DisturbedBus, DisturbedClock, DisturbedController, TimedStimuli
from atalante_tools.faults.observation import Observation, restarted
from atalante_tools.faults.scenario import Case
from atalante_tools.session.rig import Rig, open_hal

if TYPE_CHECKING:
    from atalante_emulator.pendant import Operator
    from atalante_hal.safety.events import Event

#: Telemetry fields of the controller for the assisted hip and knee. `error` is the tracking error [rad].
#: `q_bound` is the distance from the desired angle to the edge of the guide (corridor around the desired motion) [rad].
_GUIDE: Final = ("error", "q_bound")
#: Controller settings. A short startup is sufficient, because the robot is already in the first pose of the gait.
CONFIG: Final = AirwalkConfig(startup=0.1)
ASSISTANCE: Final = 0.5
#: Number of cycles within which a robot without fault must reach ACTIVE after power-on.
_START: Final = 600
#: Number of cycles between two presses of START after the fault. The first press ends FAULT, the second press ends HOLD.
RECOVERY: Final = 100
#: Longest wait for ACTIVE after the START that ends HOLD [cycles]. If the HAL is not ACTIVE by then, the run ends.
_RESTART: Final = 300


@dataclass(frozen=True)
class RunContext:
    """Network, robot, gait, controller and model of the legs, which all runs of a process share."""

    network: Network
    robot: Robot
    gait: Gait
    pose: list[float]  # first pose of the gait [rad]
    controller: AirwalkController
    legs: LegModel


@functools.cache
def run_context() -> RunContext:
    """Return the network, the robot, the gait, the controller and the model of the legs of all runs."""
    network, robot = atalante_dbc.load(), load_robot()
    gait = load_gait(AIRWALK_GAIT, robot)
    pose = gait.tables().q[0].tolist()
    controller = AirwalkController(robot, gait, SHAPES["constant"], CONFIG)
    shared = RunContext(network, robot, gait, pose, controller, leg_model())
    # Exclude the permanent objects from later garbage collections. This makes every run faster.
    gc.collect()
    gc.freeze()
    return shared


class Milestones(NamedTuple):
    """Milestones of a run without a fault, in HAL cycles. All runs with the same physics engine have the same milestones."""

    ready: int  # first cycle in READY; the operator presses START in the next cycle
    active: int  # first cycle in ACTIVE
    walk: int  # first cycle of the first walking step


@functools.cache
def milestones(engine: str = PYBULLET) -> Milestones:
    """Return the milestones of a run without a fault.

    Args:
        engine: physics engine of the emulated robot.

    Raises:
        RuntimeError: If the robot does not become ACTIVE although there is no fault.
    """
    trial = CaseRun(Case("nothing", (), engine=engine), begins=1)
    trial.execute(lambda state: state.supervisor is SupervisorState.ACTIVE or state.cycle >= _START)
    if trial.states[-1] is not SupervisorState.ACTIVE:
        raise RuntimeError(f"a robot without fault must be ACTIVE within {_START} cycles, got {trial.states[-1].name}")
    active = len(trial.states)
    return Milestones(trial.states.index(SupervisorState.READY) + 1, active, active + round(CONFIG.startup / PERIOD))


def walk_cycle(phase: float, engine: str = PYBULLET) -> int:
    """Return the HAL cycle in which the first walking step reaches a phase.

    Args:
        phase: phase of the step, 0 to 1.
        engine: physics engine of the emulated robot.
    """
    return milestones(engine).walk + round(phase * run_context().gait.duration / PERIOD)


def observe(case: Case, bound: int, *, recovery: bool = True) -> Observation:
    """Run a test case and return the record of the run.

    Args:
        case: faults to inject and actions of the operator.
        bound: number of cycles within which the reaction must occur. A permanent fault lasts `bound + case.observed` cycles.
        recovery: whether the operator presses START twice after the fault, to restart the walk.
    """
    begins = 1 if case.phase is None else walk_cycle(case.phase, case.engine)
    start_pressed = begins + max(case.first_faulty + bound, case.ends or 0) + case.observed
    case_run = CaseRun(case, begins)
    if recovery:
        case_run.presses[start_pressed].append("start")
        case_run.presses[start_pressed + RECOVERY].append("start")
    last = start_pressed + RECOVERY + _RESTART if recovery else start_pressed - 1

    def over(state: State) -> bool:
        if not recovery or state.supervisor is not SupervisorState.ACTIVE:
            return state.cycle >= last
        return restarted(case_run.states[start_pressed:])

    case_run.execute(over)
    return case_run.observation(start_pressed if recovery else None)


class CaseRun:
    """Run of a case that begins in the HAL cycle `begins`.

    Attributes:
        states: state of the HAL in each cycle.
        presses: actions of the operator, by HAL cycle. More actions can be added before `execute`.
    """

    def __init__(self, case: Case, begins: int, *, starts: bool = True) -> None:
        """Prepare the run of a fault case.

        Args:
            case: faults to inject and actions of the operator.
            begins: HAL cycle in which the case begins, from 1.
            starts: whether the operator presses START when the HAL is READY for the first time.
        """
        self._case, self._begins, self._starts = case, begins, starts
        self.states: list[SupervisorState] = []
        self._stimuli = TimedStimuli(case.stimuli, begins)
        self.presses = self._stimuli.presses
        self._sent = SentFrames()
        self._samples: list[_Sample] = []
        self._events: list[Event] = []  # events that the HAL reported before its shutdown
        self._copied = 0  # value of `hal.events.count` after the last copy of events to `_events`

    def execute(self, until: Callable[[State], bool]) -> None:
        """Run the HAL and the emulator.

        Args:
            until: end condition, called with the state after every cycle.
        """
        from atalante_emulator.pendant import Operator

        shared = run_context()
        operator = Operator(starts=False)
        controller = DisturbedController(shared.controller, self._stimuli.host_faults)
        with open_hal(
            Target(EMBEDDED, "", lockstep=True, engine=self._case.engine),
            network=shared.network,
            robot=shared.robot,
            seed=self._case.seed,
            pose=shared.pose,
            operator=operator,
            assistance_factor=ASSISTANCE,
            controller_fields=controller.telemetry_fields,
            tap=self._sent,
            faults=self._stimuli.faults,
            legs=shared.legs,
        ) as rig:
            hal = rig.hal
            hal.bus = DisturbedBus(hal.bus, self._stimuli.host_faults)
            self._prepare(1, operator)
            waiting = self._starts

            def record() -> None:
                self.states.append(hal.state.supervisor)
                self._samples.append(_Sample.of(rig))
                self._events += hal.events.since(self._copied)
                self._copied = hal.events.count

            def over(state: State) -> bool:
                nonlocal waiting
                if waiting and state.supervisor is SupervisorState.READY:
                    waiting = False
                    operator.start()
                self._prepare(state.cycle + 1, operator)
                return until(state)

            run(hal, controller, DisturbedClock(self._stimuli.host_faults), until=over, record=record)
            self._messages = hal.messages

    def _prepare(self, cycle: int, operator: Operator) -> None:
        """Set the number of the next cycle, and execute the operator actions of the next cycle."""
        self._sent.cycle = cycle
        self._stimuli.prepare(cycle, operator)

    def observation(self, pressed: int | None) -> Observation:
        """Return the record of the run.

        Args:
            pressed: cycle of the operator's START after the fault; None if there is no START.
        """
        shared, ends = run_context(), self._case.ends
        cycles, frames = self._sent.frames()
        keep = cycles <= len(self.states)
        columns = zip(*self._samples, strict=True)
        return Observation(
            network=shared.network,
            robot=shared.robot,
            first=self._stimuli.host_faults.first_active or self._begins + self._case.first_faulty,
            over=None if ends is None else self._begins + ends,
            pressed=pressed,
            states=tuple(self.states),
            events=tuple(self._events),
            commands=Commands(shared.network, cycles[keep], frames[keep]),
            messages=self._messages,
            **{name: np.array(column) for name, column in zip(_Sample._fields, columns, strict=True)},
        )


class _Sample(NamedTuple):
    """Values of one cycle. Each value is one row of the array with the same name in an `Observation`."""

    drive_state: list[int]
    torque: Vector
    position: Vector
    velocity: Vector
    temperature: Vector
    age: npt.NDArray[np.int64]
    guide_exit: float

    @classmethod
    def of(cls, rig: Rig) -> _Sample:
        """Return the values of the current cycle. Drive states, torques and motion come from the emulator."""
        hal, emulator = rig.hal, rig.emulator
        assert emulator is not None
        (hip, knee), (hip_bound, knee_bound) = (hal.record[hal.layout[f"controller.{name}"]] for name in _GUIDE)
        return cls(
            [int(state) for state in emulator.drives.state],
            emulator.drives.signals.torque.copy(),
            emulator.body.position.copy(),
            emulator.body.velocity.copy(),
            hal.state.temperature.copy(),
            hal.state.age.copy(),
            max(abs(hip) - hip_bound, abs(knee) - knee_bound),
        )

"""Runner of all fault cases: walks the emulated robot in lock-step, injects a case and records the run.

case -> rig -> walk -> fault begins -> fault ends -> operator's START -> observation
"""

from __future__ import annotations

import functools
import gc
from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np
import numpy.typing as npt

import atalante_dbc
from atalante_control.airwalk.controller import AirwalkConfig, AirwalkController
from atalante_control.gait.gait import AIRWALK_GAIT, PERIOD, Gait, load_gait
from atalante_control.guide.shapes import SHAPES
from atalante_dbc import Network
from atalante_emulator.faults import Fault
from atalante_hal.loop import run
from atalante_hal.robot import Robot, load_robot
from atalante_hal.types import State, SupervisorState
from atalante_tools.console.options import EMBEDDED, Target
from atalante_tools.faults.command_check import Commands, SentFrames
from atalante_tools.faults.disturbed import DisturbedBus, DisturbedClock, DisturbedController, Moment
from atalante_tools.faults.observation import Observation
from atalante_tools.faults.scenario import Case, Host, Press
from atalante_tools.session.rig import Rig, open_hal

if TYPE_CHECKING:
    from atalante_emulator.pendant import Operator
    from atalante_hal.safety.events import Event

Vector = npt.NDArray[np.float64]
#: Telemetry fields of the controller: tracking error of the assisted joints, and width of the guide.
_GUIDE: Final = ("error", "q_bound")
#: Short startup, because the suspended robot is already in the first pose of the gait.
CONFIG: Final = AirwalkConfig(startup=0.1)
ASSISTANCE: Final = 0.5
#: HAL cycles within which a robot without fault must be ACTIVE.
_START: Final = 600
#: Cycles after each START after the fault. The operator presses it twice: the first leaves FAULT, the second leaves HOLD.
RECOVERY: Final = 100
#: Consecutive cycles in ACTIVE after which the robot counts as restarted.
AGAIN: Final = 10


@dataclass(frozen=True)
class Stage:
    """Objects shared by all runs of a process, built once."""

    network: Network
    robot: Robot
    gait: Gait
    pose: list[float]  # rad, first pose of the gait
    controller: AirwalkController


@functools.cache
def stage() -> Stage:
    """Return network, robot, gait and controller of all runs."""
    network, robot = atalante_dbc.load(), load_robot()
    gait = load_gait(AIRWALK_GAIT, robot)
    pose = gait.tables().q[0].tolist()
    shared = Stage(network, robot, gait, pose, AirwalkController(robot, gait, SHAPES["constant"], CONFIG))
    # These objects exist until the process ends. Frozen, they do not slow down the garbage collection before every run.
    gc.collect()
    gc.freeze()
    return shared


@functools.cache
def walk_begins() -> int:
    """Return the HAL cycle in which the first step begins without a fault; it is the same in every lock-step run.

    Raises:
        RuntimeError: If the robot does not start without a fault.
    """
    trial = _Run(Case("nothing", ()), moment=1)
    trial.go(lambda state: state.supervisor is SupervisorState.ACTIVE or state.cycle >= _START)
    if trial.states[-1] is not SupervisorState.ACTIVE:
        raise RuntimeError(
            f"the robot without fault must be ACTIVE within {_START} cycles, got {trial.states[-1].name}"
        )
    return len(trial.states) + round(CONFIG.startup / PERIOD)


def observe(case: Case, bound: int, *, recovery: bool = True) -> Observation:
    """Run a case and return the observation.

    Args:
        case: faults to inject and actions of the operator.
        bound: cycles within which the reaction must occur. A permanent fault is observed for `bound + case.watched` cycles.
        recovery: whether the operator presses START after the fault.
    """
    moment = 1 if case.phase is None else walk_begins() + round(case.phase * stage().gait.duration / PERIOD)
    quiet = moment + max(case.begins + bound, case.ends or 0) + case.watched
    case_run = _Run(case, moment)
    if recovery:
        case_run.presses[quiet].append("start")
        case_run.presses[quiet + RECOVERY].append("start")
    last = quiet + 2 * RECOVERY if recovery else quiet - 1
    again = [SupervisorState.ACTIVE] * AGAIN

    def over(state: State) -> bool:
        return state.cycle >= last or (state.cycle >= quiet + AGAIN and case_run.states[-AGAIN:] == again)

    case_run.go(over)
    return case_run.observation(quiet if recovery else None)


class _Run:
    """One run of one case, whose faults begin at the HAL cycle `moment`."""

    def __init__(self, case: Case, moment: int) -> None:
        self._case, self._begins = case, moment
        self.states: list[SupervisorState] = []
        #: Actions of the operator, by cycle.
        self.presses: defaultdict[int, list[str]] = defaultdict(list)
        for one in case.happens:
            if isinstance(one, Press):
                self.presses[moment + one.start].append(one.kind)
        self._faults = [one.starting(moment - 1 + one.start) for one in case.happens if isinstance(one, Fault)]
        self._moment = Moment([one for one in case.happens if isinstance(one, Host)], moment)
        self._sent = SentFrames()
        self._seen: list[_Seen] = []
        self._events: list[Event] = []  # without the HOLD at the end of the loop
        self._counted = 0  # events of the HAL that were copied to `_events` or dropped

    def go(self, until: Callable[[State], bool]) -> None:
        """Run the rig; the operator presses START when the HAL is READY for the first time.

        Args:
            until: returns True for the state after which the run ends.
        """
        from atalante_emulator.pendant import Operator

        shared = stage()
        operator = Operator(starts=False)
        controller = DisturbedController(shared.controller, self._moment)
        with open_hal(
            Target(EMBEDDED, "", lockstep=True),
            network=shared.network,
            robot=shared.robot,
            seed=self._case.seed,
            pose=shared.pose,
            operator=operator,
            assistance_factor=ASSISTANCE,
            controller_fields=controller.telemetry_fields,
            tap=self._sent,
            faults=self._faults,
        ) as rig:
            hal = rig.hal
            hal.bus = DisturbedBus(hal.bus, self._moment)
            self._before(1, operator)
            waiting = True

            def record() -> None:
                self.states.append(hal.state.supervisor)
                self._seen.append(_Seen.of(rig))
                self._events += hal.events.since(self._counted)
                self._counted = hal.events.count

            def over(state: State) -> bool:
                nonlocal waiting
                if waiting and state.supervisor is SupervisorState.READY:
                    waiting = False
                    operator.start()
                self._before(state.cycle + 1, operator)
                return until(state)

            run(hal, controller, DisturbedClock(self._moment), until=over, record=record)
            self._messages = hal.messages

    def _before(self, cycle: int, operator: Operator) -> None:
        """Prepare the next cycle: set its number and execute the actions of the operator."""
        self._moment.cycle = self._sent.cycle = cycle
        for press in self.presses.get(cycle, ()):
            getattr(operator, press)()

    def observation(self, pressed: int | None) -> Observation:
        """Return the observation of the run.

        Args:
            pressed: cycle of the operator's START after the fault. None if there was none.
        """
        shared, ends = stage(), self._case.ends
        cycles, frames = self._sent.frames()
        keep = cycles <= len(self.states)
        columns = zip(*self._seen, strict=True)
        return Observation(
            network=shared.network,
            robot=shared.robot,
            first=self._moment.struck or self._begins + self._case.begins,
            over=None if ends is None else self._begins + ends,
            pressed=pressed,
            states=tuple(self.states),
            events=tuple(self._events),
            commands=Commands(shared.network, cycles[keep], frames[keep]),
            messages=self._messages,
            **{name: np.array(column) for name, column in zip(_Seen._fields, columns, strict=True)},
        )


class _Seen(NamedTuple):
    """One cycle of the arrays of an `Observation`."""

    drive_state: list[int]
    torque: Vector
    position: Vector
    velocity: Vector
    temperature: Vector
    age: npt.NDArray[np.int64]
    guide_exit: float

    @classmethod
    def of(cls, rig: Rig) -> _Seen:
        """Read the present values, from the emulated drives and the body directly where the HAL could be wrong."""
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

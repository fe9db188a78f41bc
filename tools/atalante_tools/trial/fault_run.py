"""Run the trials of the experiment `faults`: `trial -> walks with the fault -> outcomes, diagnostics, durations`.

In each walk of a trial, the fault begins at another moment. A first walk without a fault gives the cycle of each moment. All
walks with the same seed are equal until a fault begins. So a second walk forks a waiting copy of its process (a branch)
shortly before each moment. Every walk with a fault continues from one of these branches.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cache
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np

from atalante_control.model import Patient
from atalante_control.walking.controller import WalkController
from atalante_control.walking.phases import Phase
from atalante_emulator.emulator import Emulator
from atalante_emulator.mechanics import Ground, Mechanics
from atalante_emulator.pendant import Operator
from atalante_emulator.wearer import LimbParameters
from atalante_hal.loop import run
from atalante_hal.robot import IMUS, load_robot
from atalante_hal.types import PERIOD, State, SupervisorState
from atalante_tools.console.stop_request import check_stop, deferred
from atalante_tools.faults.absence import Absence
from atalante_tools.faults.disturbed import DisturbedBus, DisturbedClock, DisturbedController, TimedStimuli
from atalante_tools.faults.matrix import load_matrix
from atalante_tools.faults.scenario import Case, Stimulus
from atalante_tools.faults.tasks import HORIZON, limited
from atalante_tools.faults.verdict import WALKING, exception_sentence
from atalante_tools.session.body import describe
from atalante_tools.session.rig import Rig, open_hal
from atalante_tools.session.walk_observation import AFTERMATH, Observation
from atalante_tools.trial.branch import Branch, Continuation, branch
from atalante_tools.trial.fault_plan import FURTHER_MOMENTS, MOMENTS, PERMANENT, STEPS, FaultTrial
from atalante_tools.trial.ground_cases import ground_cases
from atalante_tools.trial.lockstep import gaits_of_trial, target
from atalante_tools.trial.plan import STEP

if TYPE_CHECKING:
    from atalante_hal.safety.events import Event

#: Number of cycles from the fork of the walk to the cycle in which the fault begins.
#: A fork one cycle before the fault would be too late: the emulated robot already has the frames of the first faulty cycle.
_LEAD: Final = 5
#: Number of cycles for which the HAL is observed after a fall.
_FALLEN: Final = 300
#: Largest number of cycles of a walk. A walk without a fault lasts about 10000 cycles.
_LONGEST: Final = 20_000
#: The robot is at rest if two conditions are true for `_RESTED` cycles:
#: pelvis and joints are slower than `_STILL` [m/s, rad/s], and each foot carries a load of at least `_LOADED` [N].
_STILL, _RESTED, _LOADED = 0.01, 500, 50.0
#: A walk has the outcome "walked" if the robot completes it.
#: It also has this outcome if two events follow the end of the fault: `_LANDINGS` landings, then `_WALKED` cycles of walking.
_WALKED: Final = 400
_LANDINGS: Final = 2
#: Phases of the walk that begin with the landing of a foot.
_LANDED: Final = frozenset({Phase.STEP, Phase.STOP, Phase.BACK})
_PELVIS: Final = IMUS.index("pelvis")
#: Resolution of the bisection for the longest fault duration without a fall [cycles].
#: The result may be too short by at most `RESOLUTION`.
RESOLUTION: Final = 10


@dataclass(frozen=True)
class FaultRun:
    """Result of one walk with a fault."""

    moment: str  # one of `FaultTrial.moments`
    #: "walked" (two steps after the fault, or to the end), "hold" (stopped upright), "fell", "exception", or "unfinished".
    #: Unfinished means that the robot is upright after `_LONGEST` cycles, and that the controller still drives the joints.
    outcome: str
    state: str  # state of the HAL at the end
    #: diagnostics since the first faulty cycle, in the order of their first report; the severity `info` is left out
    codes: tuple[str, ...]
    #: cycle in which the expected diagnostic was reported, where 1 is the first faulty cycle; None: no such diagnostic
    detected: int | None
    reason: str  # reason that the HAL states for its last state, or the exception
    fallen: int | None = None  # number of cycles from `moment` to the fall; None: no fall


class _Request(NamedTuple):
    """Request to a branch (a waiting copy of the walk): continue the walk with these faults and actions."""

    stimuli: tuple[Stimulus, ...]  # injected faults, and actions of the operator
    begins: int  # HAL cycle in which the case begins; `start` of the stimuli counts from this cycle
    ends: int | None  # first cycle after all faults and actions, counted from `begins`; None if a fault is permanent


class _Answer(NamedTuple):
    """Result of a walk that continued from a branch (a waiting copy of an earlier walk)."""

    outcome: str
    state: SupervisorState
    reason: str
    fallen: int | None  # HAL cycle of the fall
    events: tuple[Event, ...]  # all events of the HAL


def run_fault(trial: FaultTrial) -> dict[str, Any]:
    """Run the walks of a trial, one for each moment at which the fault begins, and return the result.

    Args:
        trial: trial to run.

    Returns:
        Result for JSON. For a permanent fault, the list `longest` has one element per moment: the longest duration for which the
        fault may act without a fall [cycles], or None if the robot does not fall at all. Without a permanent fault, `longest` is
        empty.
    """
    case = ground_cases(trial.id)[trial.index]
    runs: list[FaultRun] = []
    longest: list[int | None] = []
    for moment in trial.moments:
        runs.append(_run(trial, case, moment))
        if trial.index == PERMANENT:
            longest.append(_longest(trial, case, runs[-1]) if runs[-1].outcome == "fell" else None)
    return {
        "outcome": "computed",
        "fell": sum(one.outcome == "fell" for one in runs),
        "runs": [asdict(one) for one in runs],
        "longest": longest,
    }


def _longest(trial: FaultTrial, case: Case, permanent: FaultRun) -> int:
    """Return the longest fault duration that the robot withstands without a fall [cycles], by bisection.

    Args:
        trial: trial of the case.
        case: case with a permanent fault.
        permanent: walk with this case, which ended in a fall.
    """
    assert permanent.fallen is not None
    fatal = permanent.fallen

    def falls(cycles: int) -> bool:
        # With the permanent fault, the robot falls after `fatal` cycles. So it also falls if the fault lasts that long or longer.
        if cycles >= fatal:
            return True
        stimuli = tuple(limited(stimulus, cycles) for stimulus in case.stimuli)
        return _run(trial, replace(case, stimuli=stimuli), permanent.moment).outcome == "fell"

    return longest_without(falls, HORIZON, RESOLUTION)


def longest_without(falls: Callable[[int], bool], horizon: int, resolution: int) -> int:
    """Return the longest fault duration that the robot withstands without a fall, by bisection from 0 to `horizon`.

    The bisection assumes that the robot does not fall if there is no fault. It also assumes: if the robot falls with a fault of
    one duration, then the robot falls with every longer duration, too.

    Args:
        falls: function that returns whether the robot falls with a fault of the given duration [cycles].
        horizon: longest duration [cycles].
        resolution: largest number of cycles by which the result may be too short.
    """
    if not falls(horizon):
        return horizon
    survived, fatal = 0, horizon
    while fatal - survived > resolution:
        middle = (survived + fatal) // 2
        survived, fatal = (survived, middle) if falls(middle) else (middle, fatal)
    return survived


def _run(trial: FaultTrial, case: Case, moment: str) -> FaultRun:
    """Run one walk in which the fault of `case` begins at the moment named `moment`, and return its result."""
    check_stop()
    begins, walk = _branches(trial.mass, trial.height, trial.seed, trial.engine, trial.network)[moment]
    answer: _Answer = walk.ask(_Request(case.stimuli, begins, case.ends))
    first = begins + case.first_faulty
    events = [event for event in answer.events if event.cycle >= first]
    expected = case.dtc if case.dtc is not None else load_matrix()[trial.id].dtc
    codes, detected = diagnosed(events, expected, first)
    fallen = None if answer.fallen is None else answer.fallen - begins
    return FaultRun(moment, answer.outcome, answer.state.name, codes, detected, answer.reason, fallen)


def diagnosed(events: Sequence[Event], expected: str, first: int) -> tuple[tuple[str, ...], int | None]:
    """Return the codes of the diagnostics, and the number of cycles until the expected diagnostic.

    Events of the severity `info` are left out, except the expected diagnostic. Without an expected diagnostic, the number of
    cycles is None.

    Args:
        events: events since the first faulty cycle.
        expected: diagnostic code as in the fault matrix, a regular expression; empty means none.
        first: first faulty cycle.
    """
    pattern = re.compile(expected.replace("xxxx", "[0-9A-F]{4}"))
    matching = [event for event in events if pattern.fullmatch(event.code)]
    codes = dict.fromkeys(event.code for event in events if event.severity != "info" or event in matching)
    return tuple(codes), min(event.cycle for event in matching) - first + 1 if matching else None


@cache
def _branches(
    mass: float, height: float, seed: int, engine: str, network: tuple[str, ...]
) -> dict[str, tuple[int, Branch]]:
    """Return for each moment the cycle in which the fault begins, and a forked process paused shortly before this cycle.

    The paused process is a copy of a walk without a fault. `Branch.ask` continues this walk from the pause, now with a fault.

    Args:
        mass: mass of the wearer [kg].
        height: height of the wearer [m].
        seed: seed of the sensor noise.
        engine: physics engine of the emulated robot.
        network: network of the gaits, as in `FaultTrial.network`.

    Raises:
        RuntimeError: If the robot does not walk to the end although there is no fault.
    """
    walk = _Walk(())
    walk.execute(mass, height, seed, engine, network)
    if walk.outcome != "walked":
        raise RuntimeError(
            f"the walk without a fault must reach its end, got the outcome {walk.outcome}: {walk.reason}"
        )
    begins = {
        name: walk.begins[Phase[moment.phase], moment.step] + round(moment.share * STEP[1] / PERIOD)
        for name, moment in (MOMENTS | FURTHER_MOMENTS).items()
    }
    trunk = _Walk(cycle - _LEAD for cycle in begins.values())
    trunk.execute(mass, height, seed, engine, network)
    return {name: (cycle, trunk.branches[cycle - _LEAD]) for name, cycle in begins.items()}


class _Walk:
    """One walk on the ground, which forks waiting copies of its process at chosen cycles.

    A waiting copy gets a `_Request` with faults. A further copy of the process then continues the walk with these faults.

    Attributes:
        begins: (phase, number of periodic steps completed before the phase) -> first cycle of the phase.
        branches: cycle -> branch, a forked copy of the walk that waits at the end of this cycle.
        outcome: how the walk ended, as in `FaultRun`.
        reason: reason of the last state.
    """

    def __init__(self, forks: Iterable[int]) -> None:
        """Prepare the walk.

        Args:
            forks: cycles at whose end a copy of the walk is forked. The walk ends after the last of these cycles.
                Without such cycles, the walk ends when its outcome is known.
        """
        self._forks = set(forks)
        self.begins: dict[tuple[Phase, int], int] = {}
        self.branches: dict[int, Branch] = {}
        self.outcome, self.reason = "hold", ""
        self._state = SupervisorState.OFF
        self._fallen: int | None = None  # cycle of the fall
        self._events: list[Event] = []
        self._continuation: Continuation | None = None
        self._stimuli = TimedStimuli((), 1)
        self._ends: int | None = None  # first cycle after the faults; None: no fault, or a permanent fault

    def execute(self, mass: float, height: float, seed: int, engine: str, network: tuple[str, ...] = ()) -> None:
        """Walk until the outcome is known: the robot stands, has fallen, has left ACTIVE, or walks on after the fault.

        The process of a `Continuation` ends in this call.

        Args:
            mass: mass of the wearer [kg].
            height: height of the wearer [m].
            seed: seed of the sensor noise.
            engine: physics engine of the emulated robot.
            network: network of the gaits, as in `FaultTrial.network`.
        """
        robot, patient, operator = load_robot(), Patient(mass, height), Operator()
        gaits = gaits_of_trial(mass, height, network)
        walk = WalkController(robot, patient, gaits, STEPS)
        with open_hal(
            target(engine),
            robot=robot,
            seed=seed,
            pose=walk.standing_pose.tolist(),
            operator=operator,
            assistance_factor=1.0,
            controller_fields=walk.telemetry_fields,
            gait_hash=gaits.step.hash32,
            mechanics=Mechanics(describe(robot, None, patient), engine, Ground(), LimbParameters()),
        ) as rig:
            try:
                self._walk(rig, walk, operator)
            except Exception as error:
                if self._continuation is None:
                    raise
                self.outcome, self.reason = "exception", exception_sentence(error)
            finally:
                if self._continuation is not None:
                    self._finish(self._continuation)

    def _walk(self, rig: Rig, walk: WalkController, operator: Operator) -> None:
        """Run the loop of the HAL until the walk is over."""
        assert rig.emulator is not None
        hal, emulator, host_faults = rig.hal, rig.emulator, self._stimuli.host_faults
        observation = Observation(rig, walk, None)
        hal.bus = DisturbedBus(hal.bus, host_faults)
        host_faults.cycle = 1
        copied, started, halted, resting, after_fall, landings, landed = 0, False, 0, 0, 0, 0, 0

        def record() -> None:
            nonlocal copied, landings, landed
            cycle = hal.state.cycle
            if (walk.phase, walk.statistics.steps) not in self.begins:
                self.begins[walk.phase, walk.statistics.steps] = cycle
                if walk.phase in _LANDED and self._ends is not None and cycle > self._ends:
                    landings, landed = landings + 1, cycle
            self._events += hal.events.since(copied)
            copied = hal.events.count

        def over(state: State) -> bool:
            nonlocal started, halted, resting, after_fall
            if state.cycle in self._forks and self._branch_off(state.cycle, emulator):
                return True
            self._stimuli.prepare(state.cycle + 1, operator)
            self._state = state.supervisor
            if observation.check():
                if self._fallen is None:
                    self.outcome, self.reason, self._fallen = "fell", self.reason or hal.reason, state.cycle
                after_fall += 1
                return after_fall > _FALLEN
            started = started or hal.moving
            self.reason = hal.reason
            if hal.moving:
                walks_on = landings >= _LANDINGS and state.cycle - landed >= _WALKED
                if walk.done or (walks_on and state.supervisor in WALKING):
                    self.outcome = "walked"
                    return True
                if state.cycle > _LONGEST:
                    self.outcome = "unfinished"
                    return True
                return False
            halted += started
            resting = resting + 1 if started and _still(emulator) else 0
            return resting > _RESTED or halted > AFTERMATH or state.cycle > _LONGEST

        clock = Absence(DisturbedClock(host_faults), emulator)
        with deferred():
            run(hal, DisturbedController(walk, host_faults), clock, until=over, record=record)

    def _branch_off(self, cycle: int, emulator: Emulator) -> bool:
        """Fork a waiting copy of the walk at this cycle. Return True if the walk needs no further copies and can end.

        For each request to the waiting copy, a new process continues the walk. In the new process, this function injects the
        requested faults and returns False.

        Args:
            cycle: number of the last cycle.
            emulator: emulated robot.
        """
        one = branch()
        if isinstance(one, Branch):
            self.branches[cycle] = one
            return len(self.branches) == len(self._forks)
        request: _Request = one.request
        self._continuation, self._forks = one, set()
        self._stimuli.schedule(request.stimuli, request.begins)
        self._ends = None if request.ends is None else request.begins + request.ends
        emulator.inject(self._stimuli.faults)
        return False

    def _finish(self, continuation: Continuation) -> None:
        """Send the result of a continued walk, and end the process."""
        try:
            continuation.finish(_Answer(self.outcome, self._state, self.reason, self._fallen, tuple(self._events)))
        finally:
            continuation.abandon()


def _still(emulator: Emulator) -> bool:
    """Return whether the robot stands on both feet and hardly moves."""
    body = emulator.body
    loads = body.sole_force[:, :, 2].sum(axis=1)
    moves = max(np.abs(body.imu[_PELVIS, 4:]).max(), np.abs(body.velocity).max())
    return bool(loads.min() > _LOADED and moves < _STILL)

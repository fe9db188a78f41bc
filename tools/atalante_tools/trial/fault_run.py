"""Run the trials of the experiment `faults`: `trial -> a walk for each start of the fault -> outcomes, diagnostics, durations`.

A first walk without a fault gives the cycles of the moments. All walks with the same seed are equal until the fault begins.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cache
from typing import TYPE_CHECKING, Any, Final

from atalante_control.gait.subject import Subject
from atalante_control.model import Patient
from atalante_control.walking.controller import WalkController
from atalante_control.walking.phases import Phase
from atalante_emulator.mechanics import Ground, Mechanics
from atalante_emulator.pendant import Operator
from atalante_emulator.wearer import LimbParameters
from atalante_hal.loop import run
from atalante_hal.robot import load_robot
from atalante_hal.types import PERIOD, State, SupervisorState
from atalante_tools.console.stop_request import check_stop, deferred
from atalante_tools.faults.absence import Absence
from atalante_tools.faults.catalogue import SCENARIOS
from atalante_tools.faults.disturbed import DisturbedBus, DisturbedClock, DisturbedController, TimedStimuli
from atalante_tools.faults.matrix import load_matrix
from atalante_tools.faults.scenario import Case, Stimulus
from atalante_tools.faults.tasks import HORIZON, limited
from atalante_tools.faults.verdict import exception_sentence
from atalante_tools.session.body import describe
from atalante_tools.session.rig import open_hal
from atalante_tools.session.walk_observation import AFTERMATH, Observation
from atalante_tools.session.walk_options import solved_gaits
from atalante_tools.trial.fault_plan import PERMANENT, FaultTrial
from atalante_tools.trial.lockstep import target
from atalante_tools.trial.plan import STEP

if TYPE_CHECKING:
    from atalante_hal.safety.events import Event

#: Steps of a walk before its stop step, and index of the step in which the fault begins (0 is the first step).
_STEPS, _FAULTY_STEP = 2, 1
#: Cycles from the start of the weight shift to a fault in double support.
_SHIFTED: Final = 600
#: Cycles for which the HAL is observed after a fall.
_FALLEN: Final = 300
#: Cycles after which a walk ends in any case. A walk without a fault lasts about 10000 cycles.
_LONGEST: Final = 20_000
#: Resolution of the longest duration of a fault without a fall [cycles].
RESOLUTION: Final = 10


@dataclass(frozen=True)
class FaultRun:
    """Result of one walk with a fault."""

    moment: float | None  # of `FaultTrial.moments`
    outcome: str  # "stood" (walked to the end), "hold" (stopped upright), "fell" or "exception"
    state: str  # state of the HAL at the end
    #: diagnostics since the first faulty cycle, except information, in the order of their first report
    codes: tuple[str, ...]
    detected: int | None  # cycles from the first faulty cycle to the diagnostic of the fault matrix, both included
    reason: str  # reason that the HAL states for its last state, or the exception


def run_fault(trial: FaultTrial) -> dict[str, Any]:
    """Run the walks of a trial, one for each point at which the fault begins, and return the result.

    Args:
        trial: trial to run.
    """
    scenario = SCENARIOS[trial.id]
    permanent = trial.index == PERMANENT
    case = scenario.permanent if permanent else scenario.cases[trial.index]
    assert case is not None
    runs: list[FaultRun] = []
    longest: list[int | None] = []
    for moment in trial.moments:
        runs.append(_run(trial, case, moment))
        if permanent:
            longest.append(_longest(trial, case, moment) if runs[-1].outcome == "fell" else None)
        check_stop()
    fell = sum(one.outcome == "fell" for one in runs)
    return {
        "outcome": "computed",
        "fell": fell,
        "runs": [asdict(one) for one in runs],
        "longest": longest,  # longest duration of a permanent fault without a fall [cycles]; None: no fall
    }


def _longest(trial: FaultTrial, case: Case, moment: float | None) -> int:
    """Return the longest duration of a permanent fault without a fall [cycles], by bisection."""

    def falls(cycles: int) -> bool:
        check_stop()
        stimuli = tuple(limited(stimulus, cycles) for stimulus in case.stimuli)
        return _run(trial, replace(case, stimuli=stimuli), moment).outcome == "fell"

    return longest_without(falls, HORIZON, RESOLUTION)


def longest_without(falls: Callable[[int], bool], horizon: int, resolution: int) -> int:
    """Return the longest duration without a fall, by bisection from 0 to `horizon`.

    The robot must not fall without a fault. A longer fault must not be easier to survive than a shorter one.

    Args:
        falls: whether the robot falls with a fault of this duration [cycles].
        horizon: longest duration [cycles].
        resolution: largest accepted error of the result [cycles].
    """
    if not falls(horizon):
        return horizon
    survived, fatal = 0, horizon
    while fatal - survived > resolution:
        middle = (survived + fatal) // 2
        survived, fatal = (survived, middle) if falls(middle) else (middle, fatal)
    return survived


def _run(trial: FaultTrial, case: Case, moment: float | None) -> FaultRun:
    """Walk with a fault that begins at a given point of the walk."""
    shift, step = _cycles(trial.mass, trial.height, trial.seed, trial.engine)
    begins = shift + _SHIFTED if moment is None else step + round(moment * STEP[1] / PERIOD)
    walk = _Walk(case.stimuli, begins)
    try:
        walk.execute(trial.mass, trial.height, trial.seed, trial.engine)
    except Exception as error:  # noqa: BLE001 - any exception of the stack is a finding
        return FaultRun(moment, "exception", "-", (), None, exception_sentence(error))
    first = begins + case.first_faulty
    events = [event for event in walk.events if event.cycle >= first]
    expected = case.dtc if case.dtc is not None else load_matrix()[trial.id].dtc
    codes, detected = diagnosed(events, expected, first)
    return FaultRun(moment, walk.outcome, walk.state.name, codes, detected, walk.reason)


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
def _cycles(mass: float, height: float, seed: int, engine: str) -> tuple[int, int]:
    """Return the first cycles of the weight shift and of the faulty step in a walk without a fault.

    Raises:
        RuntimeError: If the robot does not walk to the end although there is no fault.
    """
    walk = _Walk((), 1)
    walk.execute(mass, height, seed, engine)
    if walk.outcome != "stood":
        raise RuntimeError(f"a robot without fault must walk to the end, got {walk.outcome}: {walk.reason}")
    return walk.begins[Phase.SHIFT, 0], walk.begins[Phase.STEP, _FAULTY_STEP]


class _Walk:
    """Walk on the ground with faults.

    Attributes:
        begins: first cycle of each phase and step.
        events: events of the HAL.
        outcome: how the walk ended, as in `FaultRun`.
        state: last state of the HAL.
        reason: reason of this state.
    """

    def __init__(self, stimuli: Sequence[Stimulus], begins: int) -> None:
        """Prepare the walk with its faults.

        Args:
            stimuli: faults and actions of the operator.
            begins: HAL cycle in which the case begins, from 1.
        """
        self._stimuli = TimedStimuli(stimuli, begins)
        self.begins: dict[tuple[Phase, int], int] = {}
        self.events: list[Event] = []
        self.outcome, self.state, self.reason = "hold", SupervisorState.OFF, ""

    def execute(self, mass: float, height: float, seed: int, engine: str) -> None:
        """Walk until the robot stands, has stopped or has fallen.

        Args:
            mass: mass of the wearer [kg].
            height: height of the wearer [m].
            seed: seed of the sensor noise.
            engine: physics engine of the emulated robot.
        """
        robot, patient, operator = load_robot(), Patient(mass, height), Operator()
        gaits = solved_gaits(Subject(patient, *STEP))
        walk = WalkController(robot, patient, gaits, _STEPS)
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
            faults=self._stimuli.faults,
        ) as rig:
            hal, observation, host_faults = rig.hal, Observation(rig, walk, None), self._stimuli.host_faults
            hal.bus = DisturbedBus(hal.bus, host_faults)
            host_faults.cycle = 1
            copied, halted, fallen, started = 0, 0, 0, False

            def record() -> None:
                nonlocal copied
                self.begins.setdefault((walk.phase, walk.statistics.steps), hal.state.cycle)
                self.events += hal.events.since(copied)
                copied = hal.events.count

            def over(state: State) -> bool:
                nonlocal halted, fallen, started
                self._stimuli.prepare(state.cycle + 1, operator)
                self.state = state.supervisor
                if observation.check():
                    self.outcome = "fell"
                    fallen += 1
                    self.reason = self.reason or hal.reason
                    return fallen > _FALLEN
                started = started or hal.moving
                halted += started and not hal.moving
                self.reason = hal.reason
                if hal.moving and walk.done:
                    self.outcome = "stood"
                    return True
                return halted > AFTERMATH or state.cycle > _LONGEST

            assert rig.emulator is not None
            clock = Absence(DisturbedClock(host_faults), rig.emulator)
            with deferred():
                run(hal, DisturbedController(walk, host_faults), clock, until=over, record=record)

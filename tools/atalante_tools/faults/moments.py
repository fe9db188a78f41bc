"""Single faults and random pairs of faults that begin at any time from power-on to the restart, not only during a walk.

    case of the matrix, moment -> run with a schedule of START and STOP -> safety checks, measured extremes

The fault matrix states the reaction to a fault during a walk. The matrix prescribes no reaction for other moments or for
pairs. The runs check what must be true for every fault at every moment:

- No torque, position, velocity or torque rate exceeds its limit. There are two exceptions. For `FOUND` cycles, a faulty motor may
  move the joints of its leg above their velocity limits, because the HAL cannot limit the speed while the drive holds its
  position. A motor that is too strong may exceed its torque limit by the same share.
- No command lets a drive produce torque before the operator has pressed START.
- If the fault begins after START, only the operator can cause a change to a less severe state. Each START
  can cause only one such change.
- During a start of the schedule, no joint moves by more than `SAG_MAX`. A faulty motor, faulty encoder or push moves its joint,
  and the inertia of this joint moves the other joints of the leg. So these faults have other limits in their leg (`SAG_OF`).
- The run raises no exception.
"""

from __future__ import annotations

import math
import random
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Final, NamedTuple

import numpy as np

from atalante_emulator.faults import Fault
from atalante_hal.dbc_names import JOINT_NODES
from atalante_hal.robot import JOINTS, LEG_JOINTS
from atalante_hal.safety.start import ENABLE_CYCLES, powered
from atalante_hal.types import SupervisorState, Vector
from atalante_tools.console.options import PYBULLET
from atalante_tools.faults.catalogue import SCENARIOS
from atalante_tools.faults.observation import Observation
from atalante_tools.faults.runner import RECOVERY, CaseRun, milestones, walk_cycle
from atalante_tools.faults.scenario import MID_SWING, Case, OperatorAction, Stimulus, shifted
from atalante_tools.faults.verdict import WALKING, automatic_improvements, exception_sentence, limit_violations

_S = SupervisorState
#: Largest accepted motion of a joint during a start [deg].
#: The measurement begins when the first drive is on. It ends when the HAL is ACTIVE or the start has failed.
SAG_MAX: Final = 1.0
#: Codes of the events with which the HAL reports that a start ended without reaching ACTIVE.
_ENDS_OF_START: Final = ("START_FAILED", "START_REFUSED")
#: Largest accepted motion of a joint during a start [deg], for each kind of fault that moves joints during a start.
#: Each limit applies to all joints of a leg with the fault.
#: A faulty motor or an exchanged encoder moves a joint until the direction test at the end of the start detects the fault (F72).
#: For a push, the motion has no limit, because a push may be stronger than the torque that holds the joint.
SAG_OF: Final = {
    "torque_wrong": 5.0,
    "torque_weak": 5.0,
    "encoder_swapped": 5.0,
    "encoder_stuck": 5.0,
    "encoder_drift": 10.0,  # an ankle moves until its encoder reads a position outside the range of the joint
    "value": 5.0,
    "push": math.inf,
}
#: Kinds of motor faults. Until the HAL finds a motor fault, the joints of that leg may exceed their velocity limits.
#: The speeds of these joints are not checked for `FOUND` cycles after the fault begins, and for `FOUND` cycles after each later
#: START. Cycles in which the HAL receives no data of the drive do not count, because another fault hides the motor fault (see
#: `_SILENT`).
_MOTOR: Final = ("torque_wrong", "torque_weak")
#: Number of cycles within which the HAL must find a faulty motor: time limit of F84 in FAULTS.md.
FOUND: Final = 200
#: Smallest data age of a drive [cycles] at which the HAL cannot find a motor fault of the drive.
#: Cycles with this data age or a higher one do not count in `FOUND`.
_SILENT: Final = 5
#: Number of cycles from READY to the operator's START.
_PAUSE: Final = 50
#: Number of cycles from the operator's STOP to a fault that begins in HOLD.
_STOPPED: Final = 60
#: Number of cycles from the operator's STOP to the START that restarts the walk.
_RESTART: Final = 200
#: Longest wait for the end of a fault [cycles]. The run continues after this wait, even if the fault is permanent.
_LONGEST: Final = 400
#: Number of cycles from the end of the fault to the next press of START. A fault counts as ended after `_LONGEST` cycles.
#: If a START of the schedule comes after the end of the fault, the cycles count from this START.
_REST: Final = 60
#: Number of cycles from the second press of START after the fault to the end of the run.
_END: Final = 300


class Moment(StrEnum):
    """Point of a run at which a fault begins."""

    BOOT = "boot"  # in the first cycle of the HAL
    READY = "ready"  # in READY, before the operator's START
    START = "start"  # in the cycle after the operator's START, while the HAL enables the drives
    WALKING = "walking"  # in the first walking step, when the left leg swings fastest
    HOLD = "hold"  # in HOLD, after the operator's STOP during the walk
    RESTART = "restart"  # in the cycle after the operator's START that restarts the walk from HOLD


@dataclass(frozen=True)
class Schedule:
    """Times of a run, in HAL cycles."""

    begins: int  # first faulty cycle
    #: cycles in which the operator presses START. The two presses that `_observe` adds after the fault are not included.
    starts: tuple[int, ...]
    stop: int | None = None  # cycle in which the operator presses STOP


def schedule(moment: Moment, engine: str) -> Schedule:
    """Return the schedule of a run in which the fault begins at a given `Moment`.

    Args:
        moment: moment at which the fault begins.
        engine: physics engine of the emulated robot.
    """
    ready = milestones(engine).ready
    if moment in (Moment.BOOT, Moment.READY, Moment.START):
        start = ready + _PAUSE
        return Schedule({Moment.BOOT: 1, Moment.READY: ready + _PAUSE // 2, Moment.START: start + 1}[moment], (start,))
    start, walking = ready + 1, walk_cycle(MID_SWING, engine)
    if moment is Moment.WALKING:
        return Schedule(walking, (start,))
    if moment is Moment.HOLD:
        return Schedule(walking + _STOPPED, (start,), walking)
    restart = walking + _RESTART
    return Schedule(restart + 1, (start, restart), walking)


class Extreme(NamedTuple):
    """Largest value among all joints, and the joint with this value."""

    value: float
    joint: str


@dataclass(frozen=True)
class Extremes:
    """Largest values of a run: joint speed, torque step, joint motion during a start, and joint motion after the walk."""

    speed: Extreme  # joint velocity divided by the velocity limit of the joint
    torque_step: Extreme  # change of the commanded torque in one cycle [Nm]
    sag: Extreme  # motion of a joint during a start [deg], measured as in `SAG_MAX`
    #: motion of a joint after the walk [deg]. It is measured from the first cycle after the walk until the robot walks again.
    lost: Extreme


@dataclass(frozen=True)
class MomentVerdict:
    """Result of a run in which one fault or two faults begin at a `Moment`."""

    moment: str
    faults: tuple[str, ...]  # for each fault: its ID and the name of the case
    state: str  # state of the HAL just before the operator presses START after the faults
    restarted: bool  # whether the operator's START after the faults led to ACTIVE
    extremes: Extremes | None  # None if the run raised an exception
    failures: tuple[str, ...]  # failed checks, one sentence each


@dataclass(frozen=True)
class MomentTask:
    """Task to run cases of the fault matrix that begin `delays` cycles after a `Moment`."""

    moment: Moment
    cases: tuple[tuple[str, int], ...]  # for each case: its fault ID and its index in the scenario
    delays: tuple[int, ...] = (0,)  # for each case: number of cycles from `moment` to the start of the case
    engine: str = PYBULLET

    def __call__(self) -> MomentVerdict:
        """Run the cases together in one run. Check the rules for all faults and moments (see the module docstring)."""
        chosen = [SCENARIOS[id_].cases[index] for id_, index in self.cases]
        names = tuple(f"{id_} {case.name}" for (id_, _), case in zip(self.cases, chosen, strict=True))
        stimuli = tuple(shifted(s, d) for case, d in zip(chosen, self.delays, strict=True) for s in case.stimuli)
        case = Case(" and ".join(names), stimuli, engine=self.engine, seed=chosen[0].seed)
        plan = schedule(self.moment, self.engine)
        try:
            run = _observe(case, plan)
        except Exception as error:  # noqa: BLE001 - any exception of the driver software is a failed check
            return MomentVerdict(self.moment, names, "-", False, None, (exception_sentence(error),))
        extremes, before = _extremes(run, plan.starts), run.last_before_start
        motors = _motor_faults(stimuli)
        restart = before + 1
        in_run = (
            *plan.starts,
            *(run.first + s.start for s in stimuli if isinstance(s, OperatorAction) and s.kind == "start"),
        )
        presses = (*in_run, restart, restart + RECOVERY)
        unlimited = [entry for motor in motors for entry in _unlimited(run, motor, presses)]
        failures = [*limit_violations(run, unlimited, _strength(motors)), *_premature(run, plan.starts[0])]
        # The check `automatic_improvements` requires that no fault delays the reception of START.
        # At BOOT and READY, the fault begins before the first START, and may delay the effect of START.
        if self.moment not in (Moment.BOOT, Moment.READY):
            failures += automatic_improvements(run, before, in_run)
        failures += _sag_violations(_sag(run, plan.starts), _sag_limits(stimuli))
        restarted = _S.ACTIVE in run.states[before:]
        return MomentVerdict(self.moment, names, run.state(before).name, restarted, extremes, tuple(failures))


def single_tasks(ids: Sequence[str], engine: str) -> list[MomentTask]:
    """Return one task for each case of the fault matrix and each `Moment`.

    Args:
        ids: IDs of the scenarios.
        engine: physics engine of the emulated robot.
    """
    return [
        MomentTask(moment, ((id_, index),), engine=engine)
        for moment in Moment
        for id_ in ids
        for index in range(len(SCENARIOS[id_].cases))
    ]


def random_pairs(count: int, seed: int, engine: str) -> list[MomentTask]:
    """Return tasks with two random cases of the fault matrix that begin at a random `Moment`.

    The second case begins 0 to 50 cycles after the first.

    Args:
        count: number of tasks.
        seed: seed of the random choice.
        engine: physics engine of the emulated robot.
    """
    draw = random.Random(seed)
    every = [(id_, index) for id_, scenario in SCENARIOS.items() for index in range(len(scenario.cases))]
    tasks = []
    for _ in range(count):
        first, second = draw.sample(every, 2)
        tasks.append(MomentTask(draw.choice(list(Moment)), (first, second), (0, draw.randint(0, 50)), engine))
    return tasks


def _observe(case: Case, plan: Schedule) -> Observation:
    """Run a case with a schedule, and press START twice after the fault. Return the record of the run."""
    ends = _LONGEST if case.ends is None else min(case.ends, _LONGEST)
    restart = max(plan.begins + ends, *plan.starts) + _REST
    case_run = CaseRun(case, plan.begins, starts=False)
    for cycle in (*plan.starts, restart, restart + RECOVERY):
        case_run.presses[cycle].append("start")
    if plan.stop is not None:
        case_run.presses[plan.stop].append("stop")
    case_run.execute(lambda state: state.cycle >= restart + RECOVERY + _END)
    return case_run.observation(restart)


def _motor_faults(stimuli: Sequence[Stimulus]) -> list[Fault]:
    """Return the motor faults of a run.

    Args:
        stimuli: faults and actions of the run.
    """
    return [stimulus for stimulus in stimuli if isinstance(stimulus, Fault) and stimulus.kind in _MOTOR]


def _unlimited(run: Observation, motor: Fault, starts: Sequence[int]) -> list[tuple[range, slice]]:
    """Return ranges of cycles, and the joints whose speed is not checked in each range.

    The joints are those of the leg with the motor fault. Each range contains `FOUND` cycles with data of the faulty motor. The
    ranges begin with the fault and with each later START.

    Args:
        run: observation of the run.
        motor: motor fault of the run.
        starts: cycles in which the operator pressed START.
    """
    begin = run.first + motor.start
    leg = JOINT_NODES.index(motor.target) // len(LEG_JOINTS)
    fresh = run.age[:, run.messages.index(f"{motor.target}_STATE")] < _SILENT
    found = []
    for first in (begin, *(start for start in starts if start >= begin)):
        seen = np.flatnonzero(fresh[first - 1 :])
        end = first + int(seen[FOUND - 1]) + 1 if len(seen) >= FOUND else run.last + 1
        found.append((range(first, end), slice(leg * len(LEG_JOINTS), (leg + 1) * len(LEG_JOINTS))))
    return found


def _strength(motors: Sequence[Fault]) -> Vector:
    """Return, for each motor, the factor by which motor faults can increase its torque, at least 1, shape (12,).

    Args:
        motors: motor faults of the run.
    """
    strength = np.ones(len(JOINTS))
    for fault in motors:
        joint = JOINT_NODES.index(fault.target)
        strength[joint] = max(strength[joint], abs(float(fault["share"])))
    return strength


def _sag_limits(stimuli: Sequence[Stimulus]) -> Vector:
    """Return the largest accepted motion of each joint during a start [deg], shape (12,).

    Args:
        stimuli: faults and actions of the run.
    """
    limits = np.full((2, len(JOINTS) // 2), SAG_MAX)  # row 0: joints of the left leg; row 1: right leg
    for stimulus in stimuli:
        if isinstance(stimulus, Fault) and stimulus.kind in SAG_OF:
            nodes = {stimulus.target.removesuffix("_STATE"), dict(stimulus.parameters).get("other")}
            for leg in {JOINT_NODES.index(node) // len(limits[0]) for node in nodes & set(JOINT_NODES)}:
                limits[leg] = np.maximum(limits[leg], SAG_OF[stimulus.kind])
    return limits.ravel()


def _sag_violations(sag: Vector, limits: Vector) -> list[str]:
    """Return a sentence if a joint moved by more than its limit during a start.

    Args:
        sag: motion of each joint during a start [deg], shape (12,).
        limits: largest accepted motion of each joint [deg], shape (12,).
    """
    if not (sag > limits).any():
        return []
    joint = int(np.argmax(sag / limits))
    return [
        f"{JOINTS[joint]} must not move by more than {limits[joint]:g} deg during a start, got {sag[joint]:.2f} deg"
    ]


def _premature(run: Observation, start: int) -> list[str]:
    """Return a sentence if a command enabled the operation of a drive before the operator's first START."""
    first = run.commands.first_enabled()
    if first is not None and first < start:
        return [f"ENABLE OPERATION must not be sent before START in cycle {start}, but it was sent in cycle {first}"]
    return []


def _sag(run: Observation, starts: Sequence[int]) -> Vector:
    """Return the largest motion of each joint during a start [deg], shape (12,).

    Args:
        run: observation of the run.
        starts: cycles in which the operator pressed START, except the two presses after the observation of the fault.
    """
    sag = np.zeros(len(JOINTS))
    ends = [event.cycle for event in run.events if event.code in _ENDS_OF_START]
    for start in starts:
        before, enabled = run.position[start - 1], False
        last = min((end for end in ends if end >= start), default=run.last)
        for cycle in range(start, min(start + ENABLE_CYCLES, last, run.last) + 1):
            on = bool(powered(run.drive_state[cycle - 1]).any())
            if run.state(cycle) is not run.state(start) or (enabled and not on):
                break
            enabled |= on
            if enabled:
                np.maximum(sag, np.abs(run.position[cycle - 1] - before), out=sag)
            else:
                before = run.position[cycle - 1]
    return np.degrees(sag)


def _extremes(run: Observation, starts: Sequence[int]) -> Extremes:
    """Return the largest speed, torque step and joint motion of a run (see `Extremes`).

    Args:
        run: observation of the run.
        starts: cycles in which the operator pressed START. The two presses that `_observe` adds after the fault are not
            included.
    """
    count = len(JOINTS)
    lost, held = np.zeros(count), None
    walked = False
    for cycle in range(starts[0], run.last_before_start + 1):
        if run.state(cycle) in WALKING:
            walked, held = True, None
        elif walked:
            held = run.position[cycle - 1] if held is None else held
            np.maximum(lost, np.abs(run.position[cycle - 1] - held), out=lost)
    return Extremes(
        _worst(np.abs(run.velocity).max(axis=0) / run.robot.velocity_max),
        _worst(np.array([run.commands.largest_step(joint) for joint in range(count)])),
        _worst(_sag(run, starts)),
        _worst(np.degrees(lost)),
    )


def _worst(values: Vector) -> Extreme:
    joint = int(np.argmax(values))
    return Extreme(float(values[joint]), JOINTS[joint])

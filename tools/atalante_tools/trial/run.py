"""Run one trial on the emulated robot: `trial -> rig in lock-step -> result as a JSON object`.

HAL, bus, controller and emulator are the same as in `atalante airwalk` and `atalante walk`. Equal trials give equal results: time
is virtual, and all random numbers come from the seed of the trial.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Final

import numpy as np

from atalante_control.airwalk.config import AirwalkConfig
from atalante_control.airwalk.controller import AirwalkController
from atalante_control.gait.gait import AIRWALK_GAIT, load_gait
from atalante_control.gait.walk import WalkGaits
from atalante_control.guide.shapes import SHAPES
from atalante_control.joint.leg_model import leg_model
from atalante_control.model import Patient
from atalante_control.walking.config import WALK_GUIDE, WalkConfig
from atalante_control.walking.controller import WalkController
from atalante_control.walking.phases import Phase
from atalante_emulator.mechanics import HEADING_REFERENCE_PARAMETERS, Ground, Mechanics
from atalante_emulator.metabolism import (
    SAMPLE,
    MetabolismParameters,
    brockway,
    gas_exchange,
    metabolic_rate,
    treadmill_rate,
)
from atalante_emulator.patient import ActiveParameters, ActivePatient, ActiveTask
from atalante_emulator.pendant import Operator
from atalante_emulator.wearer import LimbParameters
from atalante_hal.loop import LockStep, run
from atalante_hal.robot import LEG_JOINTS, load_robot
from atalante_hal.types import PERIOD, Vector
from atalante_tools.console.stop_request import deferred
from atalante_tools.session.body import active_task, describe
from atalante_tools.session.dial import Dial
from atalante_tools.session.rig import Rig, open_hal
from atalante_tools.session.walk_observation import Observation
from atalante_tools.session.walk_result import diagnostics
from atalante_tools.trial.lockstep import Ending, gaits_of_trial, target
from atalante_tools.trial.plan import STEP, PushTrial, RobustTrial, ShapeTrial, TreadmillTrial, WalkTrial
from atalante_tools.trial.pushes import largest_push
from atalante_tools.trial.robustness import robust_walk

_SH, _LEG = LEG_JOINTS.index("SH"), len(LEG_JOINTS)
_RIGHT: Final = 1
#: Smallest amplitude of a vibration motor that a subject feels in a trial with `haptics`, 0 to 1. The value is an assumption.
_FELT_VIBRATION: Final = 0.1
_SAMPLING = 20  # number of cycles from one sample of the motion to the next
#: Number of swings of the left leg whose curves are stored in a result.
_CURVES: Final = 15
#: Edges of the bins in a histogram of e / q_bound: the angle error of a joint, divided by the half-width of the guide.
EDGES: Final = tuple(round(-1.0 + 0.05 * k, 2) for k in range(41))
#: Names of the three parts of a walk: full assistance, changing assistance factor, and assistance factor of the trial.
SEGMENTS: Final = ("full", "transition", "target")


def run_trial(trial: ShapeTrial | WalkTrial | TreadmillTrial | RobustTrial | PushTrial) -> dict[str, Any]:
    """Run a trial, and return its result. Worker processes call this function, too.

    Args:
        trial: trial to run.
    """
    if isinstance(trial, ShapeTrial):
        return _shape(trial)
    if isinstance(trial, WalkTrial):
        return _walk(trial)
    if isinstance(trial, PushTrial):
        return largest_push(trial)
    return robust_walk(trial) if isinstance(trial, RobustTrial) else _treadmill(trial)


# -- guide shapes ----------------------------------------------------------------------------------------------------------


def _shape(trial: ShapeTrial) -> dict[str, Any]:
    robot = load_robot()
    gait = load_gait(AIRWALK_GAIT, robot)
    controller = AirwalkController(robot, gait, SHAPES[trial.shape], AirwalkConfig(feedforward=0.0))
    field = _columns(controller.telemetry_fields)
    samples: list[list[float]] = []
    with open_hal(
        target(trial.engine),
        robot=robot,
        seed=trial.seed,
        operator=Operator(),
        assistance_factor=trial.xi,
        controller_fields=controller.telemetry_fields,
        gait_hash=gait.hash32,
        mechanics=Mechanics(describe(robot), trial.engine),
        legs=leg_model(),
    ) as rig:

        def record() -> None:
            row = controller.telemetry
            if (
                rig.hal.state.cycle % _SAMPLING == 0
                and controller.statistics.steps
                and row[field["stance"]][0] == _RIGHT
            ):
                desired, (upper, lower) = row[field["q_des"]][_SH], row[field["guide"]]
                if upper > 0.0:
                    angles = np.degrees([desired + row[field["error"]][0], desired, desired + upper, desired - lower])
                    samples.append([row[field["step"]][0], round(float(row[field["phase"]][0]), 4), *_rounded(angles)])

        ending = Ending(rig, lambda: controller.statistics.steps > trial.steps)
        with deferred():
            run(rig.hal, controller, LockStep(), until=ending, record=record)
        certificate, statistics = controller.certificate(trial.xi), controller.statistics
    curves: dict[float, list[list[float]]] = {}
    for step, *sample in samples:
        curves.setdefault(step, []).append(sample)
    return {
        "outcome": ending.outcome,
        "steps": min(statistics.steps, trial.steps),
        "certified": certificate.certified,
        "max_ratio": round(statistics.max_ratio, 4),
        "inside": round(statistics.inside_fraction, 6),
        "filter_active": round(statistics.active_fraction, 4),
        "curves": list(curves.values())[: trial.steps],
    }


# -- walks -----------------------------------------------------------------------------------------------------------------


def _walk(trial: WalkTrial) -> dict[str, Any]:
    robot, patient = load_robot(), Patient(trial.mass, trial.height)
    gaits = gaits_of_trial(trial.mass, trial.height, trial.network)
    guide = replace(WALK_GUIDE, idealization=trial.idealization, feedforward=trial.feedforward)
    steps = sum(trial.protocol)
    config = replace(
        WalkConfig.literal() if trial.literal else WalkConfig(),
        guide=guide,
        heading_reference=trial.heading_reference,
    )
    controller = WalkController(robot, patient, gaits, steps, config, shape=SHAPES[trial.shape])
    operator = Operator()
    with open_hal(
        target(trial.engine),
        robot=robot,
        seed=trial.seed,
        pose=controller.standing_pose.tolist(),
        operator=operator,
        assistance_factor=1.0,
        controller_fields=controller.telemetry_fields,
        gait_hash=gaits.step.hash32,
        mechanics=Mechanics(
            describe(robot, None, patient),
            trial.engine,
            Ground(),
            LimbParameters(),
            active=_task(trial, gaits, patient),
            parameters=HEADING_REFERENCE_PARAMETERS if trial.heading_reference else None,
        ),
    ) as rig:
        observation, dial = Observation(rig, controller, None), Dial(operator, trial.protocol, trial.xi)
        motion, effort = Motion(rig, controller), Effort(rig, controller, trial.protocol)

        def record() -> None:
            dial.turn(controller.steps_begun)
            motion.sample()
            effort.sample()

        ending = Ending(rig, lambda: controller.done, observation)
        with deferred():
            run(rig.hal, controller, LockStep(), until=ending, record=record)
        (certificate,) = controller.certificates(trial.xi)
        certified = certificate.certified if trial.xi < 1.0 else None
        deviation = {**observation.true_deviation(), "attitude_rms_deg": observation.attitude_rms_deg}
        found = diagnostics(rig.hal)
    statistics = controller.statistics
    counted = statistics.guide.cycles > 0
    return {
        "outcome": ending.outcome,
        "steps": statistics.steps,
        "certified": certified,
        "max_ratio": round(statistics.guide.max_ratio, 4) if counted else None,
        "inside": round(statistics.guide.inside_fraction, 6) if counted else None,
        "diagnostics": found,
        **deviation,
        **motion.result(trial.protocol),
        **effort.result(trial.mass, trial.seed),
    }


def _task(trial: WalkTrial, gaits: WalkGaits, patient: Patient) -> ActiveTask | None:
    """Return the motion that the muscles of an active subject track; None for a passive subject."""
    if not trial.active:
        return None
    parameters = ActiveParameters(vibration=_FELT_VIBRATION) if trial.haptics else None
    return active_task(gaits, patient, trial.seed, parameters)


class Motion:
    """Measured and desired angles of hip (SH) and knee (SK) of the swing leg, sampled during the periodic steps.

    If a step lasts longer than its nominal duration, the rest of the step has no samples.
    """

    def __init__(self, rig: Rig, controller: WalkController) -> None:
        """Create an empty series of samples.

        Args:
            rig: rig of the run.
            controller: controller of the run.
        """
        self._rig, self._controller = rig, controller
        self._field = _columns(controller.telemetry_fields)
        self._rows: list[tuple[float, ...]] = []

    def sample(self) -> None:
        """Store a sample of the motion every `_SAMPLING` cycles of a periodic step."""
        state, controller = self._rig.hal.state, self._controller
        if state.cycle % _SAMPLING or controller.phase is not Phase.STEP:
            return
        row, field = controller.telemetry, self._field
        elapsed = float(row[field["elapsed"]][0])
        if elapsed <= STEP[1]:
            stance = int(row[field["stance"]][0])
            first = _LEG * (1 - stance) + _SH
            joints = slice(first, first + 2)
            self._rows.append(
                (controller.statistics.steps, elapsed, stance, *state.position[joints].tolist(),
                 *row[field["q_des"]][joints].tolist(), *row[field["q_bound"]].tolist())
            )  # fmt: skip

    def result(self, protocol: tuple[int, int, int]) -> dict[str, Any]:
        """Return tracking errors, statistics of the angles in the guide, and curves of the last swings of the left leg.

        Args:
            protocol: numbers of steps of the three segments.
        """
        rows = np.array(self._rows).reshape(-1, 9)
        step, stance, error, bound = rows[:, 0], rows[:, 2], rows[:, 3:5] - rows[:, 5:7], rows[:, 7:9]
        last, errors = 0, {}
        for name, count in zip(SEGMENTS, protocol, strict=True):
            part = error[(step >= last) & (step < last + count)]
            errors[name] = round(math.degrees(math.sqrt(float(np.mean(part**2)))), 4) if len(part) else None
            last += count
        guided = (step >= last - protocol[2]) & (bound.min(axis=1, initial=1.0) > 0.0)
        return {
            "error_deg": errors,
            "guide": _position(error[guided] / bound[guided]) if guided.any() else None,
            "curves": self._curves(rows[(step >= last - protocol[2]) & (stance == _RIGHT)]),
        }

    def _curves(self, rows: Vector) -> list[list[list[float]]]:
        """Return the angle curves of the last steps in `rows`: for each step, a list of samples.

        A sample has seven numbers: phase, two measured angles, two desired angles, and two half-widths of the guide (q_bound).
        Each pair belongs to hip (SH) and knee (SK) [deg].
        """
        chosen = np.unique(rows[:, 0])[-_CURVES:]
        return [
            [[round(row[1] / STEP[1], 4), *_rounded(np.degrees(row[3:]))] for row in rows[rows[:, 0] == step]]
            for step in chosen
        ]


def _position(ratio: Vector) -> dict[str, Any]:
    """Return statistics of the angle errors, each divided by the half-width of the guide.

    Args:
        ratio: angle error e divided by the half-width q_bound, for hip (SH) and knee (SK), shape (n, 2).
    """
    return {
        # share of the samples in which |e| / q_bound of hip or knee is above 0.5
        "outer": round(float(np.mean(np.abs(ratio).max(axis=1) > 0.5)), 4),
        # standard deviation of e / q_bound, averaged over hip and knee
        "spread": round(float(ratio.std(axis=0).mean()), 4),
        "histogram": [np.histogram(ratio[:, k], EDGES)[0].tolist() for k in range(2)],
    }


class Effort:
    """Work of the muscles of the subject in each second of the walk, and the resulting gas exchange."""

    def __init__(self, rig: Rig, controller: WalkController, protocol: tuple[int, int, int]) -> None:
        """Create an empty series of samples.

        Args:
            rig: rig of the run.
            controller: controller of the run.
            protocol: numbers of steps of the three segments.
        """
        assert rig.emulator is not None
        wearer = rig.emulator.wearer
        self._patient = wearer if isinstance(wearer, ActivePatient) else None
        self._controller, self._ends = controller, (protocol[0], protocol[0] + protocol[1])
        self._cycle, self._totals, self._segments = 0, [(0.0, 0.0, 0.0)], list[int]()

    def sample(self) -> None:
        """Store the work and the impulse of the muscles so far. In the periodic steps, this is done once per second.

        Call this function in every cycle.
        """
        if self._controller.phase is not Phase.STEP:
            return
        self._cycle += 1
        if self._cycle % round(SAMPLE / PERIOD):
            return
        patient = self._patient
        self._totals.append(
            (patient.positive_work, patient.negative_work, patient.impulse) if patient else (0.0, 0.0, 0.0)
        )
        self._segments.append(sum(self._controller.statistics.steps >= end for end in self._ends))

    def result(self, mass: float, seed: int) -> dict[str, Any]:
        """Return the metabolic rate of each part of the protocol [W/kg], and the series of the respirometer.

        Args:
            mass: mass of the subject [kg].
            seed: seed of the trial.
        """
        rates = np.diff(np.array(self._totals), axis=0) / SAMPLE
        return _respiration(metabolic_rate(rates[:, 0], rates[:, 1], rates[:, 2], mass), self._segments, mass, seed)


def _respiration(rate: Vector, segments: Sequence[int], mass: float, seed: int) -> dict[str, Any]:
    """Return the measurements of the emulated respirometer. The subject stands still before the first second of `rate`.

    Args:
        rate: metabolic rate in each second, shape (n,) [W].
        segments: index of the segment to which each second belongs, shape (n,).
        mass: mass of the subject [kg].
        seed: seed of the trial.
    """
    rest = MetabolismParameters().standing * mass
    oxygen, carbon = (series[1:] for series in gas_exchange(np.concatenate([[rest], rate]), [seed, 1]))
    measured, label = brockway(oxygen, carbon) / mass, np.array(segments)
    means = {
        name: round(float(measured[label == k].mean()), 5) if (label == k).any() else None
        for k, name in enumerate(SEGMENTS)
    }
    series = {
        "segment": label.tolist(),
        "oxygen_ml_s": _rounded(1e3 * oxygen),
        "carbon_dioxide_ml_s": _rounded(1e3 * carbon),
    }
    return {
        "metabolic_w_kg": means,
        "muscle_w_kg": round(float((rate[label == 2] - rest).mean()) / mass, 5) if (label == 2).any() else None,
        "respirometer": {**series, "rate_w_kg": _rounded(measured)},
    }


def _treadmill(trial: TreadmillTrial) -> dict[str, Any]:
    rate = np.full(trial.seconds, treadmill_rate(trial.speed, trial.mass))
    segments = [2 if second >= trial.seconds - 180 else 1 for second in range(trial.seconds)]
    return {"outcome": "computed", **_respiration(rate, segments, trial.mass, trial.seed)}


# -- shared ----------------------------------------------------------------------------------------------------------------


def _columns(fields: Sequence[tuple[str, int]]) -> dict[str, slice]:
    """Return a mapping from the name of each telemetry field to its columns."""
    columns, first = {}, 0
    for name, width in fields:
        columns[name] = slice(first, first + width)
        first += width
    return columns


def _rounded(values: Vector) -> list[float]:
    rounded: list[float] = np.round(values, 3).tolist()
    return rounded

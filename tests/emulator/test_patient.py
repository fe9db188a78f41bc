"""Active patient: muscles bounded by strength, delayed, learned from step to step, and deterministic."""

from __future__ import annotations

import pickle
from dataclasses import replace

import numpy as np
import pytest

from atalante_control.model import ExoskeletonParameters, Patient, urdf
from atalante_emulator.emulator import Emulator
from atalante_emulator.mechanics import Mechanics
from atalante_emulator.patient import ActiveParameters, ActivePatient, ActiveTask
from atalante_emulator.wearer import LimbParameters
from atalante_hal.bus.pair import lockstep_pair
from atalante_hal.robot import MOTORS
from atalante_hal.types import GRAVITY

CYCLES = 400  # of a step
LIMP = LimbParameters((0.0,) * 6, (0.0,) * 6, (0.0,) * 6)
QUIET = ActiveParameters(noise=0.0)
LEFT_SH, LEFT_SK, RIGHT_SH, RIGHT_SK = 2, 3, 8, 9
STANDING, LEFT_IN_AIR, RIGHT_IN_AIR = (400.0, 400.0), (0.0, 800.0), (800.0, 0.0)


class Floor:
    """Body of which the patient feels only the loads of the feet."""

    mass = 100.0
    touching = True

    def __init__(self) -> None:
        self.sole_force = np.zeros((2, 4, 3))

    def load(self, loads: tuple[float, float]) -> None:
        self.sole_force[:, :, 2] = np.array(loads)[:, None] / 4.0


class Walk:
    """Patient whose joints stand still at an error to the nominal angles, while the feet take steps."""

    def __init__(self, parameters: ActiveParameters = QUIET, seed: int = 0, error: float = 0.0) -> None:
        self.floor, self.nominal = Floor(), 0.3
        task = ActiveTask(75.0, 1.75, [(self.nominal, self.nominal)] * CYCLES, seed, parameters)
        self.amplitude = np.zeros(len(MOTORS))
        self.patient = ActivePatient(self.floor, task, LIMP, self.amplitude)  # type: ignore[arg-type]
        self.position = np.full(12, self.nominal - error)
        self.velocity, self.torque = np.zeros(12), np.zeros(12)
        self.stand()

    def run(self, cycles: int) -> np.ndarray:
        """Return the torques of the patient in each cycle, shape (cycles, 12)."""
        rows = []
        for _ in range(cycles):
            self.patient.act(self.position, self.velocity, self.torque)
            rows.append(self.torque.copy())
        return np.array(rows)

    def stand(self) -> None:
        self.floor.load(STANDING)
        self.run(600)

    def step(self, swing: tuple[float, float] = LEFT_IN_AIR, cycles: int = CYCLES) -> np.ndarray:
        """Land the other foot, so that a leg begins to swing."""
        other = RIGHT_IN_AIR if swing == LEFT_IN_AIR else LEFT_IN_AIR
        self.floor.load(other)
        self.run(1)
        self.floor.load(swing)
        return self.run(cycles)


def test_muscle_torques_never_exceed_the_strength() -> None:
    for fraction in (1.0, 0.1):
        parameters = ActiveParameters(fraction=fraction, noise=0.3)
        walk = Walk(parameters, error=3.0)
        torque = np.vstack([walk.step(), walk.step(RIGHT_IN_AIR), walk.step()])
        hip = fraction * 0.113 * 75.0 * GRAVITY * 1.75
        knee = fraction * 0.087 * 75.0 * GRAVITY * 1.75
        assert walk.patient.strength == pytest.approx((hip, knee))
        assert np.abs(torque[:, [LEFT_SH, RIGHT_SH]]).max() == pytest.approx(hip)  # reached, not exceeded
        assert np.abs(torque[:, [LEFT_SK, RIGHT_SK]]).max() == pytest.approx(knee)


def test_only_hip_and_knee_of_the_swing_leg_have_muscle_torque() -> None:
    walk = Walk(error=0.2)
    torque = walk.step()
    assert torque[-1, LEFT_SH] > 5.0
    assert torque[-1, LEFT_SK] > 3.0
    others = [i for i in range(12) if i not in (LEFT_SH, LEFT_SK)]
    assert not torque[:, others].any()


def test_patient_does_nothing_before_the_first_step() -> None:
    walk = Walk(error=0.5)
    assert not walk.run(1000).any()
    suspended = Walk(error=0.5)
    suspended.floor.touching = False
    assert not suspended.run(100).any()


def test_feedback_begins_after_the_reaction_time() -> None:
    torque = Walk(replace(QUIET, delay=0.15), error=0.2).step()
    assert not torque[:150, LEFT_SH].any()
    assert torque[151, LEFT_SH] > 0.0


def test_errors_below_the_threshold_cause_no_effort() -> None:
    walk = Walk(error=0.9 * QUIET.threshold)
    for _ in range(3):
        assert not walk.step().any()
        assert not walk.step(RIGHT_IN_AIR).any()


def test_learned_torque_approaches_the_balance_of_learning_and_forgetting() -> None:
    parameters = replace(QUIET, forgetting=0.8, learning=0.1)
    walk = Walk(parameters, error=parameters.threshold + 0.1)
    for _ in range(40):
        first, _ = walk.step(), walk.step(RIGHT_IN_AIR)
    # Before the reaction time, there is only the learned torque g e / (1 - f): 0.1 * 150 Nm/rad * 0.1 rad / 0.2.
    assert first[140, LEFT_SH] == pytest.approx(7.5, rel=0.1)
    assert first[140, LEFT_SK] == pytest.approx(4.0, rel=0.1)


def test_effort_decays_when_the_error_vanishes() -> None:
    parameters = replace(QUIET, forgetting=0.8)
    walk = Walk(parameters, error=0.1)
    for _ in range(10):
        walk.step(), walk.step(RIGHT_IN_AIR)
    walk.position[:] = walk.nominal
    peaks = []
    for _ in range(4):
        walk.step(RIGHT_IN_AIR)
        peaks.append(np.abs(walk.step()[100:, LEFT_SH]).max())
    assert peaks[2:] == pytest.approx([0.8 * peak for peak in peaks[1:-1]], rel=0.01)


def test_work_is_split_by_its_sign() -> None:
    walk = Walk(error=0.2)
    walk.velocity[LEFT_SH], walk.velocity[LEFT_SK] = 0.5, -0.2
    torque = walk.step()
    assert walk.patient.positive_work == pytest.approx(1e-3 * 0.5 * torque[:, LEFT_SH].clip(0.0).sum(), rel=1e-6)
    assert walk.patient.negative_work == pytest.approx(1e-3 * 0.2 * torque[:, LEFT_SK].clip(0.0).sum(), rel=1e-6)
    assert walk.patient.impulse == pytest.approx(1e-3 * np.abs(torque[:, [LEFT_SH, LEFT_SK]]).sum(), rel=1e-6)


@pytest.mark.parametrize(
    ("motor", "amplitude", "joint"),
    [
        ("left_thigh_front", 0.2, LEFT_SH),
        ("left_thigh_back", 0.2, LEFT_SH),
        ("left_shank_front", 1.0, LEFT_SK),
        ("left_shank_back", 0.2, LEFT_SK),
        ("left_thigh_front", 0.19, None),
        ("right_thigh_front", 1.0, None),
    ],
)
def test_vibration_shows_an_error_below_the_threshold_of_perception(
    motor: str, amplitude: float, joint: int | None
) -> None:
    parameters = replace(QUIET, vibration=0.2)
    walk = Walk(parameters, error=0.5 * QUIET.threshold)
    assert not walk.step().any()
    walk.step(RIGHT_IN_AIR)
    walk.amplitude[MOTORS.index(motor)] = amplitude
    torque = walk.step()
    moved = [] if joint is None else [joint]
    assert np.flatnonzero(torque.any(axis=0)).tolist() == moved
    if joint is not None:
        assert torque[-1, joint] > 0.0


def test_patient_ignores_the_vibration_motors_by_default() -> None:
    walk = Walk(error=0.5 * QUIET.threshold)
    walk.amplitude[:] = 1.0
    assert not walk.step().any()


def test_equal_seeds_give_equal_torques() -> None:
    one, same, other = (Walk(ActiveParameters(), seed, error=0.2).step() for seed in (1, 1, 2))
    np.testing.assert_array_equal(one, same)
    assert np.abs(one - other).max() > 0.1


def test_noise_is_proportional_to_the_torque() -> None:
    walks = [Walk(ActiveParameters(noise=0.2), seed, error=QUIET.threshold + 0.1) for seed in range(60)]
    last = np.array([walk.step()[-1, LEFT_SH] for walk in walks])
    assert last.mean() == pytest.approx(15.0, rel=0.1)
    assert 0.1 < last.std() / last.mean() < 0.25


@pytest.mark.parametrize(
    "change",
    [
        {"delay": 0.0},
        {"activation": float("nan")},
        {"forgetting": 1.1},
        {"fraction": -0.1},
        {"gain": (1.0, -1.0)},
        {"vibration": 0.0},
        {"vibration": float("nan")},
    ],
)
def test_parameters_out_of_range_are_rejected(change: dict[str, object]) -> None:
    with pytest.raises(ValueError, match=next(iter(change))):
        replace(ActiveParameters(), **change)  # type: ignore[arg-type]


def test_mechanics_with_a_task_have_an_active_patient(network, robot) -> None:
    task = ActiveTask(75.0, 1.75, [(0.1, 0.2)] * 10)
    mechanics = Mechanics(
        urdf(ExoskeletonParameters(), robot, Patient(75.0, 1.75)), limbs=LimbParameters(), active=task
    )
    assert pickle.loads(pickle.dumps(mechanics)) == mechanics
    body = mechanics.make_body()
    emulator = Emulator(network, robot, body, lockstep_pair()[1])
    mechanics.complete(emulator)
    assert isinstance(emulator.wearer, ActivePatient)
    body.close()

"""Torques from the motion of a leg: comparison with Pinocchio, friction, times of the averages, and missing values."""

from __future__ import annotations

import numpy as np
import pinocchio
import pytest

from atalante_control.joint.idealization import Friction
from atalante_control.joint.leg_model import leg_model
from atalante_control.model import ExoskeletonParameters, Patient, imu_link, pinocchio_model, urdf
from atalante_hal.robot import CELLS, IMUS, JOINTS, LEG_JOINTS, SIDES, load_robot
from atalante_hal.safety.leg_torques import (
    DELAY,
    HALF,
    LATE,
    MORE,
    REPEATED,
    SPAN,
    Sample,
    Torques,
    compute,
    make_history,
    make_torques,
    store,
)
from atalante_hal.types import PERIOD

PELVIS = IMUS.index("pelvis")
WITHOUT_FRICTION = Friction(coulomb=(0.0,) * 6, viscous=(0.0,) * 6)
PATIENT = Patient(80.0, 1.8)
MIDDLE = SPAN - 1 - HALF  # index of the cycle to which the averages belong


class Motion:
    """Values of `cycles` cycles, with noise in the last bits of IMU and feet, so that no value repeats."""

    def __init__(self, cycles: int = SPAN) -> None:
        noise = np.random.default_rng(1).standard_normal((cycles, 3)) * 1e-12
        self.sent = np.zeros((cycles, len(JOINTS)))
        self.position = np.zeros((cycles, len(JOINTS)))
        self.accel, self.gyro = noise + np.array([0.0, 0.0, 9.81]), noise.copy()
        self.force = np.zeros((cycles, 2, len(CELLS), 3)) + noise[:, None, None, :]
        self.age = np.zeros((cycles, len(JOINTS)), np.int64)

    def torques(self, leg: int = 0, model=None, late: int = 0) -> Torques | None:
        """Return the torques of a leg after the last cycle; None if the values do not suffice."""
        history, torques = make_history(), make_torques()
        for k in range(len(self.sent)):
            accel, gyro = np.zeros((2, len(IMUS), 3))
            accel[PELVIS], gyro[PELVIS] = self.accel[k], self.gyro[k]
            # The process image has a row without a joint first.
            age = np.concatenate([[99], self.age[k]])
            rows = np.arange(1, 1 + len(JOINTS))
            store(Sample(self.sent[k], self.position[k], accel, gyro, self.force[k], age, rows), history)
        return torques if compute(leg, model or leg_model(), late, history, torques) else None


def accelerated(generator: np.random.Generator) -> tuple[Motion, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return a motion with constant accelerations; position, speed, acceleration [rad] and pelvis rate and turn in its middle."""
    motion = Motion()
    position, speed, acceleration = generator.uniform(-0.5, 0.5, 12), *generator.uniform(-3.0, 3.0, (2, 12))
    time = ((np.arange(SPAN) - MIDDLE) * PERIOD)[:, None]
    motion.position[:] = position + speed * time + 0.5 * acceleration * time**2
    rate, turn = generator.uniform(-1.0, 1.0, (2, 3))
    motion.accel += generator.uniform(-5.0, 5.0, 3)
    # The mean of the gyroscope covers the cycles after the oldest one, so it belongs to a time half a cycle later.
    motion.gyro += rate + turn * (time - 0.5 * PERIOD)
    motion.force += generator.uniform(-300.0, 300.0, (2, len(CELLS), 3))
    return motion, position, speed, acceleration, np.array([rate, turn])


@pytest.mark.parametrize("patient", [None, PATIENT], ids=["empty", "patient"])
@pytest.mark.parametrize("seed", range(3))
def test_torques_are_those_of_pinocchio(patient: Patient | None, seed: int) -> None:
    motion, position, speed, acceleration, (rate, turn) = accelerated(np.random.default_rng(seed))
    articulated = pinocchio_model(urdf(ExoskeletonParameters(), load_robot(), patient), fixed_base=False)
    model, joints = articulated.model, articulated.v
    model.gravity.setZero()  # the accelerometer measures the acceleration minus gravity
    q, v, a = pinocchio.neutral(model), np.zeros(model.nv), np.zeros(model.nv)
    q[articulated.q], v[joints], a[joints] = position, speed, acceleration
    imu = model.frames[model.getFrameId(imu_link("pelvis"))].placement.translation
    v[3:6], a[3:6] = rate, turn
    a[:3] = motion.accel[0] - np.cross(turn, imu) - np.cross(rate, np.cross(rate, imu))
    loads = [pinocchio.Force.Zero() for _ in range(model.njoints)]
    for side, load in zip(SIDES, motion.force[0], strict=True):
        for cell, force in zip(CELLS, load, strict=True):
            frame = model.frames[model.getFrameId(f"{side}_foot_{cell}")]
            loads[frame.parentJoint] += frame.placement.act(pinocchio.Force(force, np.zeros(3)))
    expected = pinocchio.rnea(model, model.createData(), q, v, a, loads)[joints]
    for leg in range(len(SIDES)):
        torques = motion.torques(leg, leg_model(patient=patient, friction=WITHOUT_FRICTION))
        assert torques is not None
        np.testing.assert_allclose(torques.produced, expected[6 * leg : 6 * leg + 6], rtol=1e-6, atol=1e-5)
        np.testing.assert_allclose(torques.speed, speed[6 * leg : 6 * leg + 6], rtol=1e-9)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_friction_is_added_to_the_torque_of_the_motor(sign: float) -> None:
    motion, friction = Motion(), Friction()
    motion.position[:, 3] = sign * 0.2 * PERIOD * np.arange(SPAN)
    with_friction, without = motion.torques(), motion.torques(model=leg_model(friction=WITHOUT_FRICTION))
    assert with_friction is not None
    assert without is not None
    expected = np.zeros(len(LEG_JOINTS))
    expected[3] = friction.torque(3, sign * 0.2)
    np.testing.assert_allclose(with_friction.produced - without.produced, expected, atol=1e-9)


@pytest.mark.parametrize("late", range(MORE + 1))
def test_mean_of_the_sent_torques_has_the_weights_of_the_acceleration(late: int) -> None:
    # A torque of one cycle moves the joint by the second difference of the positions from this cycle on.
    cycles = SPAN + MORE
    for cycle in range(cycles):
        motion = Motion(cycles)
        motion.sent[cycle, 8] = 7.0
        motion.position[:, 8] = np.maximum(np.arange(cycles) - cycle - DELAY - late + 1, 0) * 7.0 * PERIOD**2
        torques = motion.torques(1, late=late)
        assert torques is not None
        assert torques.sent[2] == pytest.approx(torques.acceleration[2], abs=1e-9), cycle


def test_too_few_cycles_give_no_torques() -> None:
    assert Motion(SPAN - 1).torques() is None
    assert Motion(SPAN).torques() is not None
    assert Motion(SPAN + MORE - 1).torques(late=MORE) is None
    assert Motion(SPAN + MORE).torques(late=MORE) is not None


@pytest.mark.parametrize(
    ("ages", "computed"),
    [
        ((0, 0, 0), True),
        ((LATE, LATE, LATE), True),
        ((LATE + 1, LATE + 1, LATE + 1), False),
        ((1, 0, 0), False),
        ((0, 1, 0), False),
        ((0, 0, 1), False),
    ],
)
@pytest.mark.parametrize("joint", [0, 5])
def test_positions_of_a_joint_must_have_the_same_age(ages: tuple[int, int, int], computed: bool, joint: int) -> None:
    motion = Motion()
    motion.age[[0, HALF, 2 * HALF], joint] = ages
    assert (motion.torques(0) is not None) is computed
    assert motion.torques(1) is not None


@pytest.mark.parametrize("sensor", ["imu", "left", "right"])
@pytest.mark.parametrize("excess", [0, 1])
@pytest.mark.parametrize("begin", [1, SPAN - 2, SPAN + 3])
def test_repeated_values_prevent_the_check_for_the_span(sensor: str, excess: int, begin: int) -> None:
    motion = Motion(2 * SPAN)
    rows = range(begin, begin + REPEATED + excess)
    for row in rows:
        if sensor == "imu":
            motion.accel[row] = motion.accel[begin - 1]
        else:
            motion.force[row, SIDES.index(sensor)] = motion.force[begin - 1, SIDES.index(sensor)]
    within = excess and 2 * SPAN - 1 - rows[-1] < SPAN
    for leg, side in enumerate(SIDES):
        affected = within and sensor in ("imu", side)
        assert (motion.torques(leg) is None) is bool(affected)

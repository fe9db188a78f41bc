"""Ideal plant of the adversary: its equation of motion against rigid-body dynamics, and the limits of its commands."""

from __future__ import annotations

import math

import numpy as np
import pinocchio
import pytest

from atalante_control.gait.gait import AIRWALK_GAIT, load_gait
from atalante_control.model import ExoskeletonParameters, pinocchio_model, urdf
from atalante_hal.robot import load_robot
from atalante_hal.types import PERIOD
from atalante_tools.guide.plant import HIP, KNEE, Condition, Plant, advance, dynamics, inverse_dynamics, limited, plant

ROBOT = load_robot()
GAIT = load_gait(AIRWALK_GAIT, ROBOT)
ARTICULATED = pinocchio_model(urdf(ExoskeletonParameters(), ROBOT))
NO_FRICTION = np.zeros(2), np.zeros(2), 0.05
FRICTION = np.array([5.0, 5.0]), np.array([6.0, 4.0]), 0.05


def of(condition: Condition, friction=NO_FRICTION) -> Plant:
    return plant(ARTICULATED, GAIT, ROBOT, friction, condition)


@pytest.mark.parametrize("seed", range(5))
def test_torques_are_those_of_the_rigid_body_dynamics(seed: int):
    generator = np.random.default_rng(seed)
    q, qd, qdd = generator.uniform([-1.5, 0.0], [0.2, 1.8]), generator.normal(size=2), 5.0 * generator.normal(size=2)
    model, into, out_of = ARTICULATED
    pose, both = GAIT.tables().q.mean(axis=0), [HIP, KNEE]
    pose[both] = q
    full, velocity, acceleration = pinocchio.neutral(model), np.zeros(model.nv), np.zeros(model.nv)
    full[into] = pose
    velocity[out_of[both]], acceleration[out_of[both]] = qd, qdd
    expected = pinocchio.rnea(model, model.createData(), full, velocity, acceleration)[out_of[both]]
    np.testing.assert_allclose(inverse_dynamics(of(Condition()), q, qd, qdd), expected, atol=1e-9)


def test_energy_is_constant_without_friction_and_torque():
    constants, leg = of(Condition()), np.array([-0.4, 0.9, 0.3, -0.5])

    def kinetic() -> float:
        m11, m12, m22, _, _ = dynamics(constants, *leg)
        return 0.5 * (m11 * leg[2] ** 2 + 2.0 * m12 * leg[2] * leg[3] + m22 * leg[3] ** 2)

    before, work = kinetic(), 0.0
    for _ in range(300):
        middle = leg.copy()
        advance(constants, leg, 0.0, 0.0)
        middle = 0.5 * (middle + leg)
        gravity = np.array(dynamics(constants, middle[0], middle[1], 0.0, 0.0)[3:])
        work -= float(gravity @ middle[2:]) * PERIOD
    assert abs(before + work - kinetic()) < 1e-3
    assert abs(work) > 1.0


def test_condition_scales_friction_mass_and_weight():
    model, other = of(Condition(), FRICTION), of(Condition(friction=1.2, mass=0.9), FRICTION)
    np.testing.assert_allclose(other.mass, 0.9 * model.mass)
    np.testing.assert_allclose(other.weight, 0.9 * model.weight)
    np.testing.assert_allclose(other.coulomb, 1.2 * model.coulomb)
    np.testing.assert_allclose(other.viscous, 1.2 * model.viscous)


@pytest.mark.parametrize(
    ("condition", "text"),
    [
        (Condition(), "as modelled"),
        (Condition(friction=1.2, mass=0.9), "friction +20 %, mass -10 %"),
        (Condition(noise=1e-5, loss=0.01, delay=1), "encoder noise 1e-05 rad, 1 % frame loss, 1 ms delay"),
    ],
)
def test_condition_is_described_in_words(condition: Condition, text: str):
    assert str(condition) == text


@pytest.mark.parametrize(
    ("requested", "last", "velocity", "sent"),
    [
        (10.0, 0.0, 0.0, 10.0),
        (50.0, 0.0, 0.0, 20.0),
        (-50.0, 0.0, 0.0, -20.0),
        (500.0, 210.0, 0.0, 219.0),
        (200.0, 200.0, 4.25, 180.0),  # above the velocity limit the torque falls, no faster than the rate limit
        (-200.0, -200.0, 4.25, -200.0),
    ],
)
def test_command_is_limited_in_torque_and_rate(requested: float, last: float, velocity: float, sent: float):
    assert math.isclose(limited(of(Condition()), 0, requested, last, velocity), sent)

"""Literal law of the paper: its equations, joint by joint, and the absence of a promise."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from atalante_control.airwalk.config import AirwalkConfig
from atalante_control.airwalk.controller import AirwalkController
from atalante_control.guide.kernel import LegState
from atalante_control.guide.literal import FEEDFORWARD, REFERENCE, LiteralConfig, LiteralGuide, assistive_torque
from atalante_control.guide.shapes import SHAPES
from tests.control.guide.ideal_leg import GAIT, ROBOT, controller

GAINS = AirwalkConfig.literal().gains.swing
KP, KD = np.array(GAINS.kp[2:4]), np.array(GAINS.kd[2:4])
CYCLE = 300


def guide(
    idealization: float = 0.0, feedforward: float = 0.0, push: tuple[float, float] = (30.0, 18.0)
) -> LiteralGuide:
    leg = controller("constant").guide.prediction.leg
    config = LiteralConfig(GAINS, push, 0.01, idealization, feedforward)
    return LiteralGuide(config, SHAPES["constant"], leg, np.tile([5.0, -3.0], (GAIT.cycles + 1, 1)))


def torque(one: LiteralGuide, e: np.ndarray, rate: np.ndarray, speed: tuple[float, float] = (0.0, 0.0)) -> np.ndarray:
    """Return the torques for errors e and e'. The desired angles are zero, and the desired speeds are `speed - rate`."""
    guard = controller("constant").guide.tables.guards[0].copy()
    leg = LegState(e[0], e[1], speed[0], speed[1], 0.0, 0.0, 0.0, 0.0, 7.0, 2.0)
    return np.array(assistive_torque(one.tables, guard, CYCLE, leg, (speed[0] - rate[0], speed[1] - rate[1])))


def h_of(one: LiteralGuide, joint: int, e: float, rate: float) -> float:
    """Return the smallest h of the two predictions, one for each extreme of u_ext, integrated independently of the law."""
    step, push = one.tables.step, one.tables.records[0].push[joint]
    inertia, worst = one.tables.records[0].inertia[joint], 0.0
    for side in (1.0, -1.0):
        x, v = e, rate
        for now in step[CYCLE:]:
            worst = max(worst, x / now[2 * joint], -x / now[2 * joint + 1])
            u = side * push + now[FEEDFORWARD + joint] - KP[joint] * x - KD[joint] * v
            v += 1e-3 * (u / inertia - now[REFERENCE + joint])
            x += 1e-3 * v
    return 1.0 - worst**2


@pytest.mark.parametrize("xi", [0.0, 0.5, 0.9])
def test_torque_of_a_joint_is_the_gate_times_the_pd_torque_of_its_own_error(xi: float):
    one, e, rate = guide(), np.array([0.01, -0.02]), np.array([0.05, 0.1])
    one.start_step(xi, (0.0, 0.0), (0.0, 0.0))
    found = torque(one, e, rate)
    for joint in (0, 1):
        h = max(0.0, h_of(one, joint, e[joint], rate[joint]))
        gate = (1.0 + (xi**10 - 1.0) * h) ** 3
        assert found[joint] == pytest.approx(gate * (-KP[joint] * e[joint] - KD[joint] * rate[joint]), rel=1e-9)


def test_error_of_the_hip_leaves_the_torque_of_the_knee_unchanged():
    one, rate = guide(), np.zeros(2)
    one.start_step(0.5, (0.0, 0.0), (0.0, 0.0))
    calm = torque(one, np.array([0.0, 0.02]), rate)
    one.start_step(0.5, (0.0, 0.0), (0.0, 0.0))
    assert torque(one, np.array([0.03, 0.02]), rate)[1] == calm[1]


def test_falling_h_raises_the_gate():
    one, rate = guide(), np.zeros(2)
    one.start_step(0.0, (0.0, 0.0), (0.0, 0.0))
    before, after = (h_of(one, 0, e, 0.0) for e in (0.01, 0.0101))
    assert after < before
    torque(one, np.array([0.01, 0.0]), rate)
    falling = torque(one, np.array([0.0101, 0.0]), rate)[0]
    gate = (1.0 - after) ** 3
    assert falling == pytest.approx(-KP[0] * 0.0101 * (gate + (1.0 - gate) * 0.01 * (before - after) / 1e-3), rel=1e-9)


def test_idealization_is_gravity_and_friction_with_a_sharp_sign():
    friction = controller("constant").guide.prediction.leg.friction
    none, full = (guide(idealization=x) for x in (0.0, 1.0))
    zero = np.zeros(2)
    for one in (none, full):
        one.start_step(0.0, (0.0, 0.0), (0.0, 0.0))
    found = torque(full, zero, zero, (1e-6, -1.0)) - torque(none, zero, zero, (1e-6, -1.0))
    expected = [7.0 + friction.coulomb[2], 2.0 - friction.coulomb[3] - friction.viscous[3]]
    np.testing.assert_allclose(found, expected, rtol=1e-5)


def test_feedforward_is_that_of_the_gait():
    zero = np.zeros(2)
    np.testing.assert_allclose(torque(guide(feedforward=0.5), zero, zero), [2.5, -1.5], atol=1e-9)


@cache
def literal(shape: str = "constant") -> AirwalkController:
    return AirwalkController(ROBOT, GAIT, SHAPES[shape], replace(AirwalkConfig.literal(), startup=0.1))


@pytest.mark.parametrize("xi", [0.0, 0.5, 0.95])
def test_literal_law_has_no_promise(xi: float):
    certificate = literal().certificate(xi)
    assert (certificate.certified, certificate.promise) == (False, None)
    assert certificate.reason.startswith("no promise: the paper's literal law")


def test_literal_law_carries_no_torque_over_a_stance_change():
    assert len(literal().guided_blend) == 0

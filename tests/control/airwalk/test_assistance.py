"""Feedforward of the assisted joints: off, on the coupled pair, and on the separate inertias."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from atalante_control.airwalk.assistance import Assistance, swing_feedforward
from atalante_control.gait.gait import AIRWALK_GAIT, load_gait
from atalante_control.joint.idealization import AssistedInertia, Friction
from atalante_control.model import ExoskeletonParameters, pinocchio_model, urdf
from atalante_hal.robot import load_robot

ROBOT = load_robot()
GAIT = load_gait(AIRWALK_GAIT, ROBOT)
INERTIA = AssistedInertia(pinocchio_model(urdf(ExoskeletonParameters(), ROBOT)), GAIT.tables().q)
PUSHED = replace(GAIT, feedforward=np.random.default_rng(8).normal(size=(12, 8)) * 5.0)


def assistance(decoupled: bool = True, feedforward: bool = True) -> Assistance:
    return Assistance(INERTIA, PUSHED, Friction(), decoupled=decoupled, feedforward=feedforward)


def test_no_feedforward_acts_unless_it_is_switched_on():
    off = assistance(feedforward=False)
    assert off.feedforward is None
    assert off.rows.shape == (GAIT.cycles + 1, 2)
    assert not off.rows.any()
    assert swing_feedforward(replace(GAIT, feedforward=None), INERTIA, True) is None


def test_feedforward_of_the_coupled_pair_is_that_of_the_gait():
    np.testing.assert_allclose(assistance(decoupled=False).rows, PUSHED.tables().uf[:, 2:4], atol=1e-12)


def test_feedforward_of_the_separate_inertias_gives_the_torques_of_the_gait():
    rows, tables = assistance().rows, PUSHED.tables()
    torques = [
        INERTIA.torques(q[3], qd[2], qd[3], (u[0], u[1])) for q, qd, u in zip(tables.q, tables.qd, rows, strict=True)
    ]
    spread = np.abs(tables.uf[:, 2:4]).max()
    np.testing.assert_allclose(torques, tables.uf[:, 2:4], atol=0.25 * spread)  # a fit of degree 7

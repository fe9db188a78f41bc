"""Swing leg of the airwalk controller, from which its guides are built."""

from __future__ import annotations

import numpy as np

from atalante_control.airwalk.config import AirwalkConfig
from atalante_control.airwalk.swing_leg import swing_leg
from atalante_control.dynamics.gravity import Gravity
from atalante_control.gait.gait import AIRWALK_GAIT, load_gait
from atalante_control.joint.idealization import AssistedInertia
from atalante_control.model import ExoskeletonParameters, pinocchio_model, urdf
from atalante_hal.robot import load_robot

ROBOT, CONFIG = load_robot(), AirwalkConfig()
GAIT = load_gait(AIRWALK_GAIT, ROBOT)
MODEL = pinocchio_model(urdf(ExoskeletonParameters(), ROBOT))
INERTIA = AssistedInertia(MODEL, GAIT.tables().q)


def test_swing_leg_follows_the_gait_into_the_next_step():
    leg = swing_leg(CONFIG, GAIT, INERTIA, Gravity(MODEL))
    table, after = GAIT.tables(), GAIT.mirrored().tables()
    np.testing.assert_allclose(leg.q[: GAIT.cycles + 1], table.q[:, 2:4], atol=1e-12)
    np.testing.assert_allclose(leg.qd[GAIT.cycles + 1 :], after.qd[1:101, 2:4], atol=1e-12)
    pose = table.q[300].copy()
    np.testing.assert_allclose(leg.gravity[300], Gravity(MODEL).torque(pose, (1.0, 0.0, 0.0, 0.0))[2:4])

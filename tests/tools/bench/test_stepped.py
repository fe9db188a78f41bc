"""Tests of the step-by-step rollouts against the exact flow of the guide filter."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from atalante_control.gait.gait import AIRWALK_GAIT, load_gait
from atalante_control.gait.recentering import Deadbeat
from atalante_control.guide.backup_policy import BackupPolicy
from atalante_control.guide.filter import GuideConfig, GuideFilter
from atalante_control.guide.shapes import CONSTANT
from atalante_hal.robot import load_robot
from atalante_tools.bench.stepped import SteppedRollouts

GAIT = load_gait(AIRWALK_GAIT, load_robot())
CONFIG = GuideConfig(
    (BackupPolicy(6300.0, 473.0, 8.0), BackupPolicy(3600.0, 173.0, 1.9)), ((-30.0, 10.0), (-20.0, 20.0))
)
GUIDE = GuideFilter(
    CONFIG, CONSTANT, Deadbeat(GAIT.duration, 0.4), GAIT.coefficients[2:4], GAIT.mirrored().coefficients[2:4]
)
STEPPED = SteppedRollouts(GUIDE)


@given(st.integers(0, 800), *[st.floats(-0.1, 0.1), st.floats(-3.0, 3.0)] * 2)
@settings(max_examples=40)
def test_integration_agrees_with_the_exact_flow(cycle: int, e1: float, ed1: float, e2: float, ed2: float):
    integrated = STEPPED.rollouts(cycle, e1, ed1, e2, ed2)
    np.testing.assert_allclose(integrated, GUIDE.rollouts(cycle, e1, ed1, e2, ed2), atol=1e-12)


def test_rollouts_agree_after_a_new_step():
    GUIDE.start_step(0.5, (0.05, -0.02), (0.3, 0.9))
    STEPPED.start_step()
    np.testing.assert_allclose(
        STEPPED.rollouts(11, 0.01, 0.1, 0.02, 0.2), GUIDE.rollouts(11, 0.01, 0.1, 0.02, 0.2), atol=1e-12
    )


@pytest.mark.parametrize("points", [13, 50, 160, 800])
def test_rollouts_agree_on_any_grid(points: int):
    config = GuideConfig(CONFIG.policies, CONFIG.disturbance, points=points)
    guide = GuideFilter(config, CONSTANT, GUIDE.deadbeat, GAIT.coefficients[2:4], GAIT.mirrored().coefficients[2:4])
    for cycle in (0, 7, 400):
        np.testing.assert_allclose(
            SteppedRollouts(guide).rollouts(cycle, 0.01, 0.1, 0.02, 0.2),
            guide.rollouts(cycle, 0.01, 0.1, 0.02, 0.2),
            atol=1e-12,
        )

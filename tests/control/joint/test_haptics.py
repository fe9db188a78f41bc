"""Haptics: amplitude of the paper, side of the error, and zero amplitude at full assistance."""

from __future__ import annotations

import math

import numpy as np
import pinocchio
import pytest
from hypothesis import given
from hypothesis import strategies as st

from atalante_control.joint.haptics import intensity, levels
from atalante_control.model import ExoskeletonParameters, pinocchio_model, urdf
from atalante_hal.robot import JOINTS, MOTORS, load_robot

BOUND = math.radians(4.0)
ERRORS = st.floats(-2 * BOUND, 2 * BOUND)


@given(st.integers(0, 1), ERRORS, ERRORS, st.floats(0.0, 1.0))
def test_amplitude_follows_the_paper_on_the_side_of_the_error(leg: int, hip: float, knee: float, xi: float):
    out = levels(leg, (hip, knee), (BOUND, BOUND), intensity(xi), np.full(8, 9.0))
    side = ("left", "right")[leg]
    expected = dict.fromkeys(MOTORS, 0.0)
    for segment, error in (("thigh", hip), ("shank", knee)):
        face = "front" if error < 0 else "back"
        expected[f"{side}_{segment}_{face}"] = min(1.0, abs(error / BOUND) * (1.0 - math.exp(30.0 * (xi - 1.0))))
    np.testing.assert_allclose(out, [expected[m] for m in MOTORS], atol=1e-12)
    assert (out >= 0.0).all()
    assert (out <= 1.0).all()


@pytest.mark.parametrize("segment", ["thigh", "shank"])
@pytest.mark.parametrize("error", [-0.01, 0.01])
def test_front_motor_vibrates_if_the_segment_is_in_front_of_its_target(segment: str, error: float):
    articulated = pinocchio_model(urdf(ExoskeletonParameters(), load_robot()))
    model, data, joint = articulated.model, articulated.model.createData(), ("thigh", "shank").index(segment)
    end = model.getFrameId(("left_shank", "left_ankle")[joint])  # lower end of the segment

    def forward(angle: float) -> float:
        q = pinocchio.neutral(model)
        q[articulated.q[JOINTS.index(("left_SH", "left_SK")[joint])]] = angle
        pinocchio.framesForwardKinematics(model, data, q)
        return float(data.oMf[end].translation[0])

    errors = (error, 0.0) if segment == "thigh" else (0.0, error)
    out = levels(0, errors, (BOUND, BOUND), intensity(0.5), np.zeros(8))
    (motor,) = np.flatnonzero(out)
    assert MOTORS[motor] == f"left_{segment}_{'front' if forward(error) > forward(0.0) else 'back'}"


def test_amplitude_is_zero_at_full_assistance():
    assert intensity(1.0) == 0.0
    assert not levels(0, (BOUND, -BOUND), (BOUND, BOUND), intensity(1.0), np.ones(8)).any()


def test_amplitude_grows_with_error_and_with_less_assistance():
    strength = [levels(0, (e, 0.0), (BOUND, BOUND), intensity(0.5), np.empty(8)).max() for e in (0.01, 0.02, 0.03)]
    assert strength == sorted(strength)
    assert intensity(0.0) > intensity(0.9) > intensity(0.99) > 0.0


def test_asymmetric_guide_uses_the_bound_of_each_side():
    wide = levels(1, (0.02, 0.0), (0.04, 0.04), 1.0, np.empty(8)).max()
    narrow = levels(1, (-0.02, 0.0), (0.02, 0.04), 1.0, np.empty(8)).max()
    assert wide == pytest.approx(0.5)
    assert narrow == pytest.approx(1.0)

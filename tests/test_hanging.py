from __future__ import annotations

import numpy as np
import pinocchio
import pytest

from atalante_control.controller import HangConfig, HangController
from atalante_control.gait import HANG_GAIT, bezier, load_gait, motion
from atalante_control.gait_network import load_network
from atalante_control.guide_shapes import SHAPES
from atalante_control.hanging import hung
from atalante_control.model import ExoskeletonParameters, Patient, pinocchio_model, urdf
from atalante_control.subject import Subject
from atalante_hal.robot import load_robot

ROBOT = load_robot()
EXOSKELETON = ExoskeletonParameters().fitted(Patient(80.0, 1.85))


def test_gravity_and_feedforward_together_are_the_torque_of_the_motion() -> None:
    gait = hung(load_gait(HANG_GAIT, ROBOT), EXOSKELETON, ROBOT)
    model, into, out_of = pinocchio_model(urdf(EXOSKELETON, ROBOT))
    data = model.createData()
    phase = np.linspace(0.0, 1.0, 50)
    assert gait.feedforward is not None
    u_f = bezier(gait.feedforward, phase)
    demanded = []
    for row, state in enumerate(zip(*motion(gait.coefficients, gait.duration, phase), strict=True)):
        q, v, a = np.zeros((3, 12))
        q[into], v[out_of], a[out_of] = state
        demanded.append(pinocchio.rnea(model, data, q, v, a)[out_of])
        u_f[row] += pinocchio.computeGeneralizedGravity(model, data, q)[out_of]
    assert np.abs(u_f - demanded).max() < 0.04 * np.abs(demanded).max()


def test_trajectories_stay() -> None:
    gait = load_gait(HANG_GAIT, ROBOT)
    np.testing.assert_array_equal(hung(gait, EXOSKELETON, ROBOT).coefficients, gait.coefficients)


@pytest.mark.parametrize("mass_height", [(58.0, 1.62), (75.0, 1.75), (91.0, 1.93)])
@pytest.mark.parametrize("step", [(0.1, 1.1), (0.15, 0.9), (0.2, 0.75)])
def test_guides_are_certified_with_the_gaits_of_the_network(
    mass_height: tuple[float, float], step: tuple[float, float]
) -> None:
    subject = Subject(Patient(*mass_height), *step)
    exoskeleton = ExoskeletonParameters().fitted(subject.patient)
    gait = hung(load_network().gait(subject, ROBOT), exoskeleton, ROBOT)
    for shape in SHAPES.values():
        certificate = HangController(ROBOT, gait, shape, HangConfig(feedforward=True), exoskeleton).certificate(0.5)
        assert certificate.certified == (shape.name != "snap"), certificate.reason

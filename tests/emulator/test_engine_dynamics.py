from __future__ import annotations

import xml.etree.ElementTree as ET

import numpy as np
import pinocchio
import pytest

from atalante_control.model import ExoskeletonParameters, Patient, pinocchio_model, urdf
from atalante_emulator.engine_dynamics import EngineDynamics
from atalante_hal.robot import load_robot

ROBOT = load_robot()
EMPTY = ExoskeletonParameters()
#: No patient (empty exoskeleton), a typical patient, a light patient, a heavy patient.
WORN = (None, Patient(75.0, 1.75), Patient(45.0, 2.0, 0.5, 0.4), Patient(110.0, 1.5))


def assert_agree(actual: np.ndarray, expected: np.ndarray) -> None:
    np.testing.assert_allclose(actual, expected, rtol=1e-6, atol=1e-6 * np.abs(expected).max())


@pytest.mark.parametrize("patient", WORN, ids=str)
def test_pinocchio_and_pybullet_agree_on_the_dynamics(patient: Patient | None) -> None:
    text = urdf(EMPTY, ROBOT, patient)
    model, q_index, v_index = pinocchio_model(text)
    free, free_index, _ = pinocchio_model(text, fixed_base=False)
    data, free_data = model.createData(), free.createData()
    rng = np.random.default_rng(11)
    with EngineDynamics(text) as engine:
        for _ in range(100):
            q = rng.uniform(ROBOT.position_min, ROBOT.position_max)
            v, a = rng.normal(size=12) * 2.0, rng.normal(size=12) * 20.0
            expected = np.zeros((3, 12))
            expected[0, q_index], expected[1, v_index], expected[2, v_index] = q, v, a
            assert_agree(engine.inverse_dynamics(q, v, a), np.asarray(pinocchio.rnea(model, data, *expected))[v_index])
            assert_agree(engine.gravity(q), pinocchio.computeGeneralizedGravity(model, data, expected[0])[v_index])
            upper = np.triu(pinocchio.crba(model, data, expected[0]))
            assert_agree(engine.mass_matrix(q), (upper + np.triu(upper, 1).T)[np.ix_(v_index, v_index)])
            full = pinocchio.neutral(free)
            full[free_index] = q
            # The tolerance is absolute [m], because a coordinate of the centre of mass may be zero.
            centre = pinocchio.centerOfMass(free, free_data, full)
            np.testing.assert_allclose(engine.centre_of_mass(q), centre, rtol=0, atol=1e-7)


def test_pybullet_has_every_link_with_the_mass_of_the_urdf() -> None:
    text = urdf(EMPTY, ROBOT, WORN[1])
    masses = {
        link.attrib["name"]: float(mass.attrib["value"])
        for link in ET.fromstring(text).iter("link")
        if (mass := link.find("inertial/mass")) is not None
    }
    with EngineDynamics(text) as engine:
        assert engine.masses == masses
    assert sum(masses.values()) == pytest.approx(157.5, abs=1e-12)


def test_urdf_with_a_missing_joint_is_rejected_with_its_name() -> None:
    with pytest.raises(ValueError, match=r"must contain the joints .*, got no joint right_HA"):
        EngineDynamics(urdf(EMPTY, ROBOT).replace('"right_HA"', '"spare"'))

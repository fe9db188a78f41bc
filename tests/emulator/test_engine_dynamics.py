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
#: The exoskeleton alone, worn, and both ends of the range.
WORN = (None, Patient(75.0, 1.75), Patient(45.0, 2.0, 0.5, 0.4), Patient(110.0, 1.5))


def agree(theirs: np.ndarray, ours: np.ndarray) -> None:
    np.testing.assert_allclose(theirs, ours, rtol=1e-6, atol=1e-6 * np.abs(ours).max())


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
            ours = np.zeros((3, 12))
            ours[0, q_index], ours[1, v_index], ours[2, v_index] = q, v, a
            agree(engine.inverse_dynamics(q, v, a), np.asarray(pinocchio.rnea(model, data, *ours))[v_index])
            agree(engine.gravity(q), pinocchio.computeGeneralizedGravity(model, data, ours[0])[v_index])
            upper = np.triu(pinocchio.crba(model, data, ours[0]))
            agree(engine.mass_matrix(q), (upper + np.triu(upper, 1).T)[np.ix_(v_index, v_index)])
            full = pinocchio.neutral(free)
            full[free_index] = q
            # 1e-7 of a machine of 1 m: the centre of mass may lie on the origin.
            centre = pinocchio.centerOfMass(free, free_data, full)
            np.testing.assert_allclose(engine.centre_of_mass(q), centre, rtol=0, atol=1e-7)


def test_pybullet_has_every_link_with_the_mass_of_the_text() -> None:
    text = urdf(EMPTY, ROBOT, WORN[1])
    masses = {
        link.attrib["name"]: float(mass.attrib["value"])
        for link in ET.fromstring(text).iter("link")
        if (mass := link.find("inertial/mass")) is not None
    }
    with EngineDynamics(text) as engine:
        assert engine.masses == masses
    assert sum(masses.values()) == pytest.approx(157.5, abs=1e-12)


def test_the_engine_refuses_what_is_no_robot_of_ours() -> None:
    with pytest.raises(ValueError, match=r"must have the joints .*, but right_HA is missing"):
        EngineDynamics(urdf(EMPTY, ROBOT).replace('"right_HA"', '"spare"'))

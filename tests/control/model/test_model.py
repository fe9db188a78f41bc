from __future__ import annotations

import xml.etree.ElementTree as ET

import numpy as np
import pinocchio
import pytest

from atalante_control.model import (
    BASE_LINK,
    ExoskeletonParameters,
    Patient,
    imu_link,
    links,
    pad_link,
    pinocchio_model,
    urdf,
)
from atalante_hal.robot import CELLS, FEET, IMUS, JOINTS, MIRROR_SIGN, load_robot
from atalante_hal.safety.limiter import SMALLEST_INERTIA

ROBOT = load_robot()
PARAMETERS = (ExoskeletonParameters(), ExoskeletonParameters(thigh_length=0.45, shank_length=0.36))
PATIENTS = (None, Patient(75.0, 1.75), Patient(45.0, 2.0, 0.5, 0.4), Patient(110.0, 1.5))
SIGN = np.array(MIRROR_SIGN * 2, dtype=float)
SWAP = np.r_[6:12, 0:6]


def random_state(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    q = rng.uniform(ROBOT.position_min, ROBOT.position_max)
    return q, rng.normal(size=12) * 2.0, rng.normal(size=12) * 20.0


def test_total_mass_is_the_sum_of_the_published_masses() -> None:
    bodies = links(ExoskeletonParameters())
    assert sum(link.inertia.mass for link in bodies) == pytest.approx(
        16.5 + 2 * (3.7 + 4.4 + 9.0 + 11.0 + 1.7 + 3.2), abs=1e-12
    )
    model = pinocchio_model(urdf(ExoskeletonParameters(), ROBOT), fixed_base=False).model
    assert pinocchio.computeTotalMass(model) == pytest.approx(82.5, abs=1e-12)


def test_urdf_text_is_deterministic_without_negative_zeros() -> None:
    text = urdf(ExoskeletonParameters(), load_robot())
    assert text == urdf(ExoskeletonParameters(), ROBOT)
    assert "-0.0 " not in text
    assert '"-0.0"' not in text
    assert text != urdf(PARAMETERS[1], ROBOT)


def test_urdf_has_the_joints_and_limits_of_the_robot() -> None:
    joints = [
        j for j in ET.fromstring(urdf(ExoskeletonParameters(), ROBOT)).iter("joint") if j.get("type") == "revolute"
    ]
    assert tuple(j.get("name") for j in joints) == JOINTS
    for row, joint in enumerate(joints):
        limit = joint.find("limit")
        assert limit is not None
        values = [float(limit.attrib[key]) for key in ("lower", "upper", "effort", "velocity")]
        assert values == [
            ROBOT.position_min[row],
            ROBOT.position_max[row],
            ROBOT.torque_max[row],
            ROBOT.velocity_max[row],
        ]


@pytest.mark.parametrize("patient", PATIENTS)
@pytest.mark.parametrize("parameters", PARAMETERS)
def test_links_are_exact_mirror_images(parameters: ExoskeletonParameters, patient: Patient | None) -> None:
    bodies = {link.name: link for link in links(parameters, patient) if not link.name.startswith("imu_")}
    for name, link in bodies.items():
        image = link.mirrored()
        if name.startswith("left_"):
            assert bodies[image.name] == image
        elif name == BASE_LINK:
            assert link == image


@pytest.mark.parametrize("patient", PATIENTS)
@pytest.mark.parametrize("seed", range(3))
def test_mirrored_motion_needs_mirrored_torques(patient: Patient | None, seed: int) -> None:
    model, q_index, v_index = pinocchio_model(urdf(ExoskeletonParameters(), ROBOT, patient))
    data = model.createData()
    q, v, a = random_state(np.random.default_rng(seed))

    def mass_matrix(q: np.ndarray) -> np.ndarray:
        full = np.zeros(12)
        full[q_index] = q
        upper = np.triu(pinocchio.crba(model, data, full))
        return (upper + np.triu(upper, 1).T)[np.ix_(v_index, v_index)]

    def torque(*state: np.ndarray) -> np.ndarray:
        full = np.zeros((3, 12))
        for row, index, values in zip(full, (q_index, v_index, v_index), state, strict=True):
            row[index] = values
        return np.asarray(pinocchio.rnea(model, data, *full))[v_index]

    mirrored = (SIGN * values[SWAP] for values in (q, v, a))
    np.testing.assert_allclose(torque(*mirrored), SIGN * torque(q, v, a)[SWAP], rtol=0, atol=1e-12 * 400)
    original, mirror = mass_matrix(q), mass_matrix(SIGN * q[SWAP])
    np.testing.assert_allclose(mirror, np.outer(SIGN, SIGN) * original[np.ix_(SWAP, SWAP)], rtol=0, atol=1e-13 * 20)


def test_floating_exoskeleton_is_symmetric_about_the_sagittal_plane() -> None:
    model, q_index, _ = pinocchio_model(urdf(ExoskeletonParameters(), ROBOT), fixed_base=False)
    data = model.createData()
    q = pinocchio.neutral(model)
    rng = np.random.default_rng(3)
    left = rng.uniform(ROBOT.position_min, ROBOT.position_max)[:6]
    q[q_index] = np.r_[left, SIGN[:6] * left]
    assert pinocchio.centerOfMass(model, data, q)[1] == pytest.approx(0.0, abs=1e-15)
    pinocchio.crba(model, data, q)
    assert pinocchio.computeTotalMass(model) == pytest.approx(82.5)


@pytest.mark.parametrize("fixed_base", [True, False])
def test_limiter_assumes_at_most_the_smallest_inertia_of_each_joint(fixed_base: bool) -> None:
    """The inertia that a torque on one free joint accelerates is 1 over the diagonal element of the inverse mass matrix."""
    model, q_index, v_index = pinocchio_model(urdf(ExoskeletonParameters(), ROBOT), fixed_base=fixed_base)
    data, rng, smallest = model.createData(), np.random.default_rng(0), np.full(12, np.inf)
    for number in range(400):
        q = pinocchio.neutral(model)
        inside = rng.uniform(ROBOT.position_min, ROBOT.position_max)
        q[q_index] = inside if number % 2 else np.where(rng.random(12) < 0.5, ROBOT.position_min, ROBOT.position_max)
        upper = np.triu(pinocchio.crba(model, data, q))
        inverse = np.linalg.inv(upper + np.triu(upper, 1).T)
        smallest = np.minimum(smallest, 1.0 / np.diag(inverse)[v_index])
    assert (np.array(SMALLEST_INERTIA * 2) <= smallest).all()
    if not fixed_base:
        assert (np.array(SMALLEST_INERTIA * 2) >= 0.85 * smallest).all()


def test_sensor_frames_have_the_documented_positions() -> None:
    p = ExoskeletonParameters()
    model, _, _ = pinocchio_model(urdf(p, ROBOT))
    data = model.createData()
    pinocchio.framesForwardKinematics(model, data, np.zeros(12))

    def position(frame: str) -> np.ndarray:
        assert model.existFrame(frame)
        return np.asarray(data.oMf[model.getFrameId(frame)].translation)

    np.testing.assert_allclose(position(imu_link("pelvis")), [-0.164, -0.015, 0.191])
    np.testing.assert_allclose(position(imu_link("torso")), [-0.14, 0.0, 0.5])
    ankle = np.array([0.0, 0.094, -0.788])
    np.testing.assert_allclose(position("left_foot"), ankle, atol=1e-15)
    np.testing.assert_allclose(position(imu_link("left_tibia")), [-0.13, 0.263 - 0.074, -0.38 - 0.39], atol=1e-15)
    np.testing.assert_allclose(position(imu_link("right_tibia")), [-0.13, -0.263 + 0.074, -0.38 - 0.39], atol=1e-15)
    out = np.radians(8.0)
    for foot, sign in zip(FEET, (1, -1), strict=True):
        yaw = np.array([[np.cos(out), -sign * np.sin(out), 0], [sign * np.sin(out), np.cos(out), 0], [0, 0, 1]])
        for cell in CELLS:
            local = [0.178 if cell[0] == "F" else -0.064, 0.027 if cell[1] == "L" else -0.027, -0.16]
            expected = ankle * [1, sign, 1] + yaw @ local
            np.testing.assert_allclose(position(pad_link(foot, cell)), expected, atol=1e-15)
    assert all(model.existFrame(imu_link(imu)) for imu in IMUS)


@pytest.mark.parametrize(
    ("field", "value"), [("thigh_length", 0.0), ("shank_length", 1.2), ("pad_mass", 0.2), ("pad_mass", 0.0)]
)
def test_invalid_parameters_are_rejected(field: str, value: float) -> None:
    with pytest.raises(ValueError, match=field):
        ExoskeletonParameters(**{field: value})


def test_urdf_without_a_joint_is_rejected() -> None:
    text = urdf(ExoskeletonParameters(), ROBOT).replace('"right_HA"', '"spare"')
    with pytest.raises(ValueError, match="got no joint right_HA"):
        pinocchio_model(text)

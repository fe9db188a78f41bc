from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pinocchio
import pybullet
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


def test_text_is_deterministic() -> None:
    text = urdf(ExoskeletonParameters(), load_robot())
    assert text == urdf(ExoskeletonParameters(), ROBOT)
    assert "-0.0 " not in text
    assert '"-0.0"' not in text
    assert text != urdf(PARAMETERS[1], ROBOT)


def test_joints_and_limits_are_the_robot_s() -> None:
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
def test_links_are_their_own_mirror_image_to_the_bit(
    parameters: ExoskeletonParameters, patient: Patient | None
) -> None:
    bodies = {link.name: link for link in links(parameters, patient) if not link.name.startswith("imu_")}
    for name, link in bodies.items():
        image = link.mirrored()
        if name.startswith("left_"):
            assert bodies[image.name] == image
        elif name == BASE_LINK:
            assert link == image


@pytest.mark.parametrize("patient", PATIENTS)
@pytest.mark.parametrize("seed", range(3))
def test_motion_of_the_mirrored_robot_takes_the_mirrored_torques(patient: Patient | None, seed: int) -> None:
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
    there, back = mass_matrix(q), mass_matrix(SIGN * q[SWAP])
    np.testing.assert_allclose(back, np.outer(SIGN, SIGN) * there[np.ix_(SWAP, SWAP)], rtol=0, atol=1e-13 * 20)


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


def test_sensor_places() -> None:
    p = ExoskeletonParameters()
    model, _, _ = pinocchio_model(urdf(p, ROBOT))
    data = model.createData()
    pinocchio.framesForwardKinematics(model, data, np.zeros(12))

    def place(frame: str) -> np.ndarray:
        assert model.existFrame(frame)
        return np.asarray(data.oMf[model.getFrameId(frame)].translation)

    np.testing.assert_allclose(place(imu_link("pelvis")), [-0.164, -0.015, 0.191])
    np.testing.assert_allclose(place(imu_link("torso")), [-0.14, 0.0, 0.5])
    ankle = np.array([0.0, 0.094, -0.788])
    np.testing.assert_allclose(place("left_foot"), ankle, atol=1e-15)
    np.testing.assert_allclose(place(imu_link("left_tibia")), [-0.13, 0.263 - 0.074, -0.38 - 0.39], atol=1e-15)
    np.testing.assert_allclose(place(imu_link("right_tibia")), [-0.13, -0.263 + 0.074, -0.38 - 0.39], atol=1e-15)
    out = np.radians(8.0)
    for foot, sign in zip(FEET, (1, -1), strict=True):
        yaw = np.array([[np.cos(out), -sign * np.sin(out), 0], [sign * np.sin(out), np.cos(out), 0], [0, 0, 1]])
        for cell in CELLS:
            local = [0.178 if cell[0] == "F" else -0.064, 0.027 if cell[1] == "L" else -0.027, -0.16]
            expected = ankle * [1, sign, 1] + yaw @ local
            np.testing.assert_allclose(place(pad_link(foot, cell)), expected, atol=1e-15)
    assert all(model.existFrame(imu_link(imu)) for imu in IMUS)


@pytest.mark.parametrize(
    ("field", "value"), [("thigh_length", 0.0), ("shank_length", 1.2), ("pad_mass", 0.2), ("pad_mass", 0.0)]
)
def test_impossible_parameters_are_refused(field: str, value: float) -> None:
    with pytest.raises(ValueError, match=field):
        ExoskeletonParameters(**{field: value})


def test_urdf_without_a_joint_is_refused() -> None:
    text = urdf(ExoskeletonParameters(), ROBOT).replace('"right_HA"', '"spare"')
    with pytest.raises(ValueError, match="lacks joint right_HA"):
        pinocchio_model(text)


def agree(theirs: np.ndarray, ours: np.ndarray) -> None:
    np.testing.assert_allclose(theirs, ours, rtol=1e-6, atol=1e-6 * np.abs(ours).max())


def load(client: int, text: str, folder: Path, *, fixed: bool) -> int:
    path = folder / "exoskeleton.urdf"
    path.write_text(text)
    flags = pybullet.URDF_USE_INERTIA_FROM_FILE
    return int(pybullet.loadURDF(str(path), useFixedBase=fixed, flags=flags, physicsClientId=client))


class TestAgainstPyBullet:
    """The two engines read the same text and must agree on the dynamics."""

    @pytest.fixture(params=PATIENTS, ids=str)
    def engines(self, request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[tuple[int, int, list[int], str]]:
        text = urdf(PARAMETERS[0] if request.param else PARAMETERS[1], ROBOT, request.param)
        client = pybullet.connect(pybullet.DIRECT)
        pybullet.setGravity(0, 0, -9.81, physicsClientId=client)
        body = load(client, text, tmp_path, fixed=True)
        infos = [
            pybullet.getJointInfo(body, i, physicsClientId=client)
            for i in range(pybullet.getNumJoints(body, physicsClientId=client))
        ]
        moving = [info[1].decode() for info in infos if info[2] == pybullet.JOINT_REVOLUTE]
        yield client, body, [moving.index(name) for name in JOINTS], text
        pybullet.disconnect(client)

    def test_dynamics_agree(self, engines: tuple[int, int, list[int], str]) -> None:
        client, body, order, text = engines
        model, q_index, v_index = pinocchio_model(text)
        data = model.createData()
        rng = np.random.default_rng(11)
        for _ in range(100):
            q, v, a = random_state(rng)
            theirs = np.zeros((3, 12))
            theirs[:, order] = q, v, a
            ours = np.zeros((3, 12))
            ours[0, q_index], ours[1, v_index], ours[2, v_index] = q, v, a

            def inverse_dynamics(states: np.ndarray) -> np.ndarray:
                torque = pybullet.calculateInverseDynamics(
                    body, *(row.tolist() for row in states), physicsClientId=client
                )
                return np.array(torque)[order]

            agree(inverse_dynamics(theirs), np.asarray(pinocchio.rnea(model, data, *ours))[v_index])
            gravity = np.asarray(pinocchio.computeGeneralizedGravity(model, data, ours[0]))[v_index]
            agree(inverse_dynamics(theirs * [[1], [0], [0]]), gravity)

            upper = np.triu(pinocchio.crba(model, data, ours[0]))
            mass = (upper + np.triu(upper, 1).T)[np.ix_(v_index, v_index)]
            bullet = np.array(pybullet.calculateMassMatrix(body, theirs[0].tolist(), physicsClientId=client))
            agree(bullet[np.ix_(order, order)], mass)

    def test_centres_of_mass_agree(self, engines: tuple[int, int, list[int], str], tmp_path: Path) -> None:
        client, _, _, text = engines
        body = load(client, text, tmp_path, fixed=False)  # Bullet knows no mass of a base it holds fixed
        inertial_in_base = pybullet.getDynamicsInfo(body, -1, physicsClientId=client)[3:5]
        model, q_index, _ = pinocchio_model(text, fixed_base=False)
        data = model.createData()
        count = pybullet.getNumJoints(body, physicsClientId=client)
        infos = [pybullet.getJointInfo(body, i, physicsClientId=client) for i in range(count)]
        row_of = {info[1].decode(): i for i, info in enumerate(infos)}
        masses = np.array([pybullet.getDynamicsInfo(body, i, physicsClientId=client)[0] for i in range(-1, count)])
        rng = np.random.default_rng(12)
        for _ in range(100):
            q, _, _ = random_state(rng)
            for name, angle in zip(JOINTS, q, strict=True):
                pybullet.resetJointState(body, row_of[name], angle, physicsClientId=client)
            root = pybullet.getBasePositionAndOrientation(body, physicsClientId=client)
            states = pybullet.getLinkStates(body, range(count), 0, 1, physicsClientId=client)
            centre = masses @ np.array([root[0], *(state[0] for state in states)]) / masses.sum()
            # Bullet's base frame is that of its principal axes.
            in_root = pybullet.multiplyTransforms(*pybullet.invertTransform(*root), centre.tolist(), [0, 0, 0, 1])[0]
            in_base = pybullet.multiplyTransforms(*inertial_in_base, in_root, [0, 0, 0, 1])[0]
            full = pinocchio.neutral(model)
            full[q_index] = q
            # 1e-7 of a machine of 1 m: the centre of mass may lie on the origin.
            np.testing.assert_allclose(in_base, pinocchio.centerOfMass(model, data, full), rtol=0, atol=1e-7)

    def test_the_base_and_every_link_have_the_inertia_of_the_text(
        self, engines: tuple[int, int, list[int], str]
    ) -> None:
        client, body, _, text = engines
        masses = {
            link.attrib["name"]: float(mass.attrib["value"])
            for link in ET.fromstring(text).iter("link")
            if (mass := link.find("inertial/mass")) is not None
        }
        count = pybullet.getNumJoints(body, physicsClientId=client)
        names = [pybullet.getJointInfo(body, i, physicsClientId=client)[12].decode() for i in range(count)]
        assert set(names) | {BASE_LINK} == set(masses)
        for row, name in enumerate(names):  # Bullet reports 0 for a base it holds fixed
            assert pybullet.getDynamicsInfo(body, row, physicsClientId=client)[0] == masses[name]

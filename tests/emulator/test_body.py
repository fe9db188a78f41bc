from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pinocchio
import pytest

from atalante_control.model import ExoskeletonParameters, imu_link, pad_link, pinocchio_model, urdf
from atalante_emulator.body import GRAVITY, PyBulletBody
from atalante_hal.robot import CELLS, FEET, IMUS, JOINTS, load_robot
from atalante_hal.types import PERIOD

ROBOT = load_robot()
TEXT = urdf(ExoskeletonParameters(), ROBOT)
STEPPING = [0.05, -0.02, -0.4, 0.7, -0.1, 0.03, -0.02, 0.04, -0.1, 0.3, 0.1, -0.05]


@pytest.fixture
def body() -> Iterator[PyBulletBody]:
    made = PyBulletBody(TEXT)
    yield made
    made.close()


def run(body: PyBulletBody, seed: int, steps: int) -> list[bytes]:
    rng = np.random.default_rng(seed)
    body.reset(STEPPING)
    trace = []
    for _ in range(steps):
        body.step((rng.normal(size=12) * 20.0).tolist())
        trace.append(body.position.tobytes() + body.velocity.tobytes() + body.imu.tobytes())
    return trace


def test_fresh_bodies_driven_alike_agree_to_the_bit(body: PyBulletBody) -> None:
    first = run(body, 1, 300)
    other = PyBulletBody(TEXT)
    assert run(other, 1, 300) == first
    other.close()
    different = PyBulletBody(TEXT)
    assert run(different, 2, 300) != first
    different.close()


def test_reset_puts_the_joints_in_order_and_at_rest(body: PyBulletBody) -> None:
    body.reset(STEPPING)
    assert body.position.tolist() == STEPPING
    assert not body.velocity.any()


def test_one_step_is_forward_dynamics(body: PyBulletBody) -> None:
    """Semi-implicit Euler of Pinocchio's forward dynamics: no damping, no motor, no friction of the engine's own."""
    model, q_index, v_index = pinocchio_model(TEXT)
    data = model.createData()
    rng = np.random.default_rng(5)
    body.reset(STEPPING)
    for _ in range(50):
        q, v, tau = np.zeros(12), np.zeros(12), np.zeros(12)
        torque = rng.normal(size=12) * 15.0
        q[q_index], v[v_index], tau[v_index] = body.position, body.velocity, torque
        acceleration = np.asarray(pinocchio.aba(model, data, q, v, tau))[v_index]
        expected = body.velocity + PERIOD * acceleration
        before = body.position.copy()
        body.step(torque.tolist())
        np.testing.assert_allclose(body.velocity, expected, rtol=0, atol=1e-6)
        np.testing.assert_allclose(body.position, before + PERIOD * body.velocity, rtol=0, atol=1e-9)


def test_imu_links_move_as_kinematics_says(body: PyBulletBody) -> None:
    model, q_index, v_index = pinocchio_model(TEXT)
    data = model.createData()
    body.reset(STEPPING)
    for _ in range(40):
        body.step([5.0, -5.0, 20.0, -10.0, 3.0, 1.0] * 2)
    q, v = np.zeros(12), np.zeros(12)
    q[q_index], v[v_index] = body.position, body.velocity
    pinocchio.forwardKinematics(model, data, q, v)
    pinocchio.updateFramePlacements(model, data)
    for imu, state in zip(IMUS, body.imu, strict=True):
        (x, y, z, w), velocity, rotation = np.split(state, [4, 7])
        frame = model.getFrameId(imu_link(imu))
        twist = pinocchio.getFrameVelocity(model, data, frame, pinocchio.LOCAL_WORLD_ALIGNED)
        np.testing.assert_allclose(pinocchio.Quaternion(w, x, y, z).matrix(), data.oMf[frame].rotation, atol=1e-7)
        np.testing.assert_allclose(velocity, twist.linear, atol=1e-6)
        np.testing.assert_allclose(rotation, twist.angular, atol=1e-6)
    assert any(np.linalg.norm(state[4:7]) > 0.05 for state in body.imu)


def test_joints_stop_at_their_limits(body: PyBulletBody) -> None:
    for push in (60.0, -60.0):
        for _ in range(400):
            body.step((push - 3.0 * body.velocity).tolist())
            assert (body.position < ROBOT.position_max + 0.02).all()
            assert (body.position > ROBOT.position_min - 0.02).all()
        limit = ROBOT.position_max if push > 0 else ROBOT.position_min
        henke = [JOINTS.index("left_HA"), JOINTS.index("right_HA")]
        assert body.position[henke] == pytest.approx(limit[henke], abs=0.02)


def test_nothing_touches_in_the_air(body: PyBulletBody) -> None:
    run(body, 3, 50)
    assert len(body.contact) == 0


def test_contact_forces_balance_the_motion() -> None:
    """M a + h = torque + sum of J' f over the pads, with f the force on the foot: signs, frames and cells."""
    crouched = [0.0, 0.0, -0.5, 0.75, -0.25, 0.0] * 2  # soles level
    model, q_index, v_index = pinocchio_model(TEXT)
    data = model.createData()
    q = np.zeros(12)
    q[q_index] = crouched
    pinocchio.framesForwardKinematics(model, data, q)
    pads = {(f, c): model.getFrameId(pad_link(FEET[f], CELLS[c])) for f in range(2) for c in range(4)}
    lowest = min(data.oMf[frame].translation[2] for frame in pads.values())
    body = PyBulletBody(TEXT, ground=float(lowest) - 0.02)
    body.reset(crouched)
    touched = set()
    kp, kd = np.array([6000, 2000, 1000, 800, 20, 10] * 2), np.array([100, 40, 60, 40, 2, 1] * 2)
    target = np.array([0.0, 0.0, -0.35, 0.55, -0.2, 0.0] * 2)  # reaches down through the floor
    for step in range(600):
        torque = kp * (target - body.position) - kd * body.velocity
        q, v, a, tau = np.zeros((4, 12))
        q[q_index], v[v_index], tau[v_index] = body.position, body.velocity, torque
        before = body.velocity.copy()
        body.step(torque.tolist())
        a[v_index] = (body.velocity - before) / PERIOD
        if step < 500:
            continue
        total = tau.copy()
        pinocchio.computeJointJacobians(model, data, q)
        pinocchio.updateFramePlacements(model, data)
        for foot, cell, force in body.contact:
            touched.add((foot, cell))
            jacobian = pinocchio.getFrameJacobian(model, data, pads[foot, cell], pinocchio.LOCAL_WORLD_ALIGNED)
            arm = np.array([0.0, 0.0, -ExoskeletonParameters().pad_radius])  # the ball touches at its lowest point
            total += jacobian[:3].T @ force + jacobian[3:].T @ np.cross(arm, force)
        needed = np.asarray(pinocchio.rnea(model, data, q, v, a))
        np.testing.assert_allclose(total, needed, atol=1.0)
        assert sum(force[2] for _, _, force in body.contact) > 50.0
    assert len(touched) == 8
    for (x, y, z, w), foot in zip(body.foot_rotation, FEET, strict=True):
        frame = model.getFrameId(f"{foot}_foot")
        np.testing.assert_allclose(pinocchio.Quaternion(w, x, y, z).matrix(), data.oMf[frame].rotation, atol=1e-3)
    body.close()


@pytest.mark.parametrize("part", ["right_SK", "imu_torso", "left_foot_RL"])
def test_urdf_without_a_part_is_refused(part: str) -> None:
    with pytest.raises(ValueError, match=f"must have the (joint|link)s .*, but {part}.* is missing"):
        PyBulletBody(TEXT.replace(f'"{part}"', '"spare"'))


def test_text_that_is_no_urdf_is_refused() -> None:
    with pytest.raises(ValueError, match="cannot load"):
        PyBulletBody("<robot/>")


def test_gravity_is_pinocchio_s() -> None:
    model, _, _ = pinocchio_model(TEXT)
    assert np.allclose(model.gravity.linear, [0, 0, -GRAVITY])

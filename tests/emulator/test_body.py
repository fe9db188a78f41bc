from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
import pinocchio
import pytest

from atalante_control.model import ExoskeletonParameters, Patient, imu_link, pad_link, pinocchio_model, urdf
from atalante_emulator.bodies import ENGINES, FRICTION, Body, DivergedError, Pose, hang, lowest_corner, make_body
from atalante_emulator.bodies.links import FOOT_LINKS
from atalante_hal.robot import CELLS, FEET, IMUS, JOINTS, load_robot
from atalante_hal.types import GRAVITY, PERIOD

ROBOT = load_robot()
TEXT = urdf(ExoskeletonParameters(), ROBOT)
WORN = urdf(ExoskeletonParameters(), ROBOT, Patient(75.0, 1.75))
STEPPING = [0.05, -0.02, -0.4, 0.7, -0.1, 0.03, -0.02, 0.04, -0.1, 0.3, 0.1, -0.05]
CROUCHED = [0.0, 0.0, -0.5, 0.75, -0.25, 0.0] * 2  # soles level
STANDING = [0.0, 0.0, -0.2, 0.45, -0.25, 0.0] * 2  # soles level, centre of mass over the soles
KP, KD = np.array([9000, 4000, 6000, 6000, 4000, 2500] * 2), np.array([200, 90, 160, 140, 60, 25] * 2)

Make = Callable[..., Body]


@pytest.fixture(params=ENGINES)
def make(request: pytest.FixtureRequest) -> Iterator[Make]:
    bodies: list[Body] = []

    def build(text: str = TEXT, **options: object) -> Body:
        bodies.append(make_body(request.param, text, **options))
        return bodies[-1]

    yield build
    for body in bodies:
        body.close()


@pytest.fixture
def body(make: Make) -> Body:
    return make()


def run(body: Body, seed: int, steps: int) -> list[bytes]:
    rng = np.random.default_rng(seed)
    body.reset(STEPPING)
    trace = []
    for _ in range(steps):
        body.step((rng.normal(size=12) * 20.0).tolist())
        trace.append(body.position.tobytes() + body.velocity.tobytes() + body.imu.tobytes())
    return trace


def test_two_bodies_with_the_same_torques_move_identically(make: Make) -> None:
    first = run(make(), 1, 300)
    assert run(make(), 1, 300) == first
    assert run(make(), 2, 300) != first


def test_reset_sets_the_joint_positions_and_zero_velocities(body: Body) -> None:
    body.reset(STEPPING)
    assert body.position.tolist() == STEPPING
    assert not body.velocity.any()


def test_one_step_is_forward_dynamics(body: Body) -> None:
    """A time step is a semi-implicit Euler step of Pinocchio's forward dynamics, without damping, motors or friction."""
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


def test_imu_link_states_agree_with_forward_kinematics(body: Body) -> None:
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


def test_joints_stop_at_their_position_limits(body: Body) -> None:
    for push in (60.0, -60.0):
        for _ in range(400):
            body.step((push - 3.0 * body.velocity).tolist())
            assert (body.position < ROBOT.position_max + 0.02).all()
            assert (body.position > ROBOT.position_min - 0.02).all()
        limit = ROBOT.position_max if push > 0 else ROBOT.position_min
        henke = [JOINTS.index("left_HA"), JOINTS.index("right_HA")]
        assert body.position[henke] == pytest.approx(limit[henke], abs=0.02)


def test_mujoco_reports_a_simulation_that_diverged() -> None:
    body = make_body("mujoco", TEXT)
    body.reset(STEPPING)
    with pytest.raises(DivergedError, match="the simulation in MuJoCo diverged"):
        body.step([1e15] * 12)


def test_suspended_body_has_no_contact_forces(body: Body) -> None:
    run(body, 3, 50)
    assert not body.touching
    assert not body.sole_force.any()


def test_contact_forces_balance_the_motion(make: Make) -> None:
    """The contact forces satisfy M a + h = torque + sum of J' f over the corners, where f is the force on a corner."""
    crouched = CROUCHED
    model, q_index, v_index = pinocchio_model(TEXT)
    data = model.createData()
    q = np.zeros(12)
    q[q_index] = crouched
    pinocchio.framesForwardKinematics(model, data, q)
    feet = [model.getFrameId(f"{foot}_foot") for foot in FEET]
    pads = [model.getFrameId(pad_link(foot, cell)) for foot in FEET for cell in CELLS]
    lowest = min(data.oMf[frame].translation[2] for frame in pads)
    body = make(ground=float(lowest) - 0.02)
    body.reset(crouched)
    touched = np.zeros((2, 4), np.bool_)
    kp, kd = np.array([6000, 2000, 1000, 800, 20, 10] * 2), np.array([100, 40, 60, 40, 2, 1] * 2)
    target = np.array([0.0, 0.0, -0.35, 0.55, -0.2, 0.0] * 2)  # soles below the floor, so that they press on it
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
        for foot, frame in enumerate(feet):
            jacobian = pinocchio.getFrameJacobian(model, data, frame, pinocchio.LOCAL)
            for corner, force in zip(body.soles.corner[foot], body.sole_force[foot], strict=True):
                total += jacobian[:3].T @ force + jacobian[3:].T @ np.cross(corner, force)
        touched |= body.sole_force.any(axis=2)
        needed = np.asarray(pinocchio.rnea(model, data, q, v, a))
        np.testing.assert_allclose(total, needed, atol=1.0)
        assert body.sole_force[:, :, 2].sum() > 50.0
        assert body.touching
    assert touched.all()


def test_soles_have_the_size_of_the_model(body: Body) -> None:
    p, corner = ExoskeletonParameters(), body.soles.corner
    length, width = 0.275 - 2 * p.pad_radius, 0.119 - 2 * p.pad_radius
    np.testing.assert_allclose(np.ptp(corner, axis=1), [[length, width, 0.0]] * 2, atol=1e-12)
    np.testing.assert_allclose(corner.mean(axis=1), [[0.06, 0.0, -0.165]] * 2, atol=1e-12)
    np.testing.assert_allclose(body.soles.cell[:, :, 0], [[0.178, 0.178, -0.064, -0.064]] * 2, atol=1e-12)
    np.testing.assert_allclose(body.soles.cell[:, :, 1], [[0.027, -0.027] * 2] * 2, atol=1e-12)


class TestFreePelvis:
    """Robot with a free pelvis, in the air and on the floor."""

    def test_one_step_is_forward_dynamics_with_the_push(self, make: Make) -> None:
        model, q_index, v_index = pinocchio_model(WORN, fixed_base=False)
        data = model.createData()
        body = make(WORN, free=True)
        rng = np.random.default_rng(5)
        body.reset(CROUCHED, Pose((0.1, -0.2, 2.0), (0.0, 0.0, np.sin(0.3), np.cos(0.3))))
        pelvis = model.getJointId("root_joint")
        centre = model.inertias[pelvis].lever
        for _ in range(50):
            force, moment = rng.normal(size=3) * 100.0, rng.normal(size=3) * 20.0
            torque = rng.normal(size=12) * 15.0
            motion = body.motion("pelvis")
            rotation = pinocchio.Quaternion(*motion.attitude[[3, 0, 1, 2]]).matrix()
            q, v, tau = pinocchio.neutral(model), np.zeros(model.nv), np.zeros(model.nv)
            q[:3], q[3:7] = motion.position, motion.attitude
            v[:3], v[3:6] = rotation.T @ motion.velocity, rotation.T @ motion.rate
            q[q_index], v[v_index], tau[v_index] = body.position, body.velocity, torque
            tau[:3], tau[3:6] = rotation.T @ force, rotation.T @ moment + np.cross(centre, rotation.T @ force)
            acceleration = np.asarray(pinocchio.aba(model, data, q, v, tau))
            body.push(force.tolist(), moment.tolist())
            body.step(torque.tolist())
            np.testing.assert_allclose(body.velocity, v[v_index] + PERIOD * acceleration[v_index], rtol=0, atol=2e-5)
            # The classical acceleration of the pelvis frame is its spatial acceleration plus rate x velocity.
            linear = rotation @ (v[:3] + PERIOD * (acceleration[:3] + np.cross(v[3:6], v[:3])))
            np.testing.assert_allclose(body.motion("pelvis").velocity, linear, rtol=0, atol=2e-4)
            np.testing.assert_allclose(
                body.motion("pelvis").rate, rotation @ (v[3:6] + PERIOD * acceleration[3:6]), rtol=0, atol=2e-4
            )

    def test_push_acts_until_the_next_call(self, make: Make) -> None:
        body = make(free=True)
        body.reset(CROUCHED, Pose((0.0, 0.0, 2.0)))
        body.push((100.0, 0.0, 0.0))
        for _ in range(10):
            body.step([0.0] * 12)
        assert body.motion("pelvis").velocity[0] > 0.01
        body.push((0.0, 0.0, 0.0))
        fallen = make(free=True)
        fallen.reset(CROUCHED, Pose((0.0, 0.0, 2.0)))
        for _ in range(10):
            fallen.step([0.0] * 12)
        assert abs(fallen.motion("pelvis").velocity[0]) < 1e-6
        assert fallen.motion("pelvis").velocity[2] == pytest.approx(-10 * PERIOD * GRAVITY, rel=1e-3)

    def test_link_motion_agrees_with_forward_kinematics(self, make: Make) -> None:
        model, q_index, v_index = pinocchio_model(TEXT, fixed_base=False)
        data = model.createData()
        body = make(free=True)
        body.reset(STEPPING, Pose((0.3, 0.2, 2.0), (0.1, 0.0, 0.0, np.sqrt(0.99))))
        for _ in range(40):
            body.step([5.0, -5.0, 20.0, -10.0, 3.0, 1.0] * 2)
        base = body.motion("pelvis")
        rotation = pinocchio.Quaternion(*base.attitude[[3, 0, 1, 2]]).matrix()
        q, v = pinocchio.neutral(model), np.zeros(model.nv)
        q[:3], q[3:7], q[q_index] = base.position, base.attitude, body.position
        v[:3], v[3:6], v[v_index] = rotation.T @ base.velocity, rotation.T @ base.rate, body.velocity
        pinocchio.forwardKinematics(model, data, q, v)
        pinocchio.updateFramePlacements(model, data)
        for row, link in enumerate([imu_link(imu) for imu in IMUS]):
            motion, frame = body.motion(link), model.getFrameId(link)
            twist = pinocchio.getFrameVelocity(model, data, frame, pinocchio.LOCAL_WORLD_ALIGNED)
            np.testing.assert_allclose(motion.position, data.oMf[frame].translation, atol=1e-6)
            np.testing.assert_allclose(motion.velocity, twist.linear, atol=1e-5)
            np.testing.assert_allclose(motion.rate, twist.angular, atol=1e-5)
            np.testing.assert_allclose(
                body.imu[row], np.concatenate([motion.attitude, motion.velocity, motion.rate]), atol=1e-6
            )

    @pytest.mark.parametrize("text", [TEXT, WORN], ids=["empty", "worn"])
    def test_standing_body_rests_on_its_soles_with_its_weight(self, make: Make, text: str) -> None:
        traces = []
        for _ in range(2):
            body = make(text, free=True, ground=0.0)
            hang(body, STANDING, 0.001)
            target, vertical = np.array(STANDING), []
            trace = []
            for step in range(1500):
                body.step((KP * (target - body.position) - KD * body.velocity).tolist())
                trace.append(body.position.tobytes() + body.sole_force.tobytes() + body.imu.tobytes())
                if step >= 1000:
                    vertical.append(body.sole_force[:, :, 2].sum())
            traces.append(trace)
            assert np.mean(vertical) == pytest.approx(body.mass * GRAVITY, rel=0.01)
            motion = body.motion("pelvis")
            assert np.abs(motion.attitude[:2]).max() < 0.02  # upright
            assert np.abs(motion.velocity).max() < 0.02
            assert abs(lowest_corner(body)) < 0.001
        assert traces[0] == traces[1]

    def test_pushed_robot_slides_only_with_low_friction(self, make: Make) -> None:
        slid = []
        for friction in (FRICTION, 0.05):
            body = make(free=True, ground=0.0, friction=friction)
            hang(body, STANDING, 0.0005)
            target = np.array(STANDING)
            for step in range(800):
                body.push((60.0 if step >= 500 else 0.0, 0.0, 0.0))
                if step == 500:
                    before = body.motion(FOOT_LINKS[0]).position
                body.step((KP * (target - body.position) - KD * body.velocity).tolist())
            slid.append(float(np.abs(body.motion(FOOT_LINKS[0]).position - before)[:2].max()))
        assert slid[0] < 0.002
        assert slid[1] > 0.005

    def test_suspended_soles_are_at_the_clearance(self, make: Make) -> None:
        body = make(free=True, ground=-0.3)
        pose = hang(body, STEPPING, 0.05, floor=-0.3)
        assert lowest_corner(body) == pytest.approx(-0.25, abs=1e-6)
        assert body.position.tolist() == STEPPING
        assert body.motion("pelvis").position == pytest.approx(pose.position, abs=1e-6)

    def test_pose_for_a_fixed_pelvis_is_rejected(self, body: Body) -> None:
        with pytest.raises(ValueError, match="base must be None for a fixed pelvis"):
            body.reset(STEPPING, Pose((0.0, 0.0, 1.0)))


@pytest.mark.parametrize("part", ["right_SK", "imu_torso", "left_foot_RL"])
def test_urdf_without_a_joint_or_link_is_rejected(make: Make, part: str) -> None:
    with pytest.raises(ValueError, match=f"must contain the (joint|link)s .*, got no (joint|link) {part}"):
        make(TEXT.replace(f'"{part}"', '"spare"'))


def test_text_that_is_no_urdf_is_rejected(make: Make) -> None:
    with pytest.raises(ValueError, match="cannot load"):
        make("no robot")


def test_unknown_engine_is_rejected() -> None:
    with pytest.raises(ValueError, match="engine must be one of pybullet, mujoco, got 'ode'"):
        make_body("ode", TEXT)


def test_gravity_equals_that_of_pinocchio() -> None:
    model, _, _ = pinocchio_model(TEXT)
    assert np.allclose(model.gravity.linear, [0, 0, -GRAVITY])

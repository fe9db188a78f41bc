"""The hanging controller on the coupled exoskeleton: forward dynamics by Pinocchio, drives as they are.

The plant knows what the controller does not: friction that is a fifth off what was identified, one cycle of delay, a
current loop, encoder steps and an 80 Hz velocity filter.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np
import pinocchio
import pytest
from hypothesis import given
from hypothesis import strategies as st

from atalante_control.airwalk.controller import AirwalkConfig, AirwalkController, baseline_share
from atalante_control.dynamics.gravity import Gravity
from atalante_control.gait.gait import AIRWALK_GAIT, Gait, load_gait
from atalante_control.guide.certificate import certify
from atalante_control.guide.shapes import SHAPES
from atalante_control.joint.idealization import Friction
from atalante_control.joint.pid import AIR_GAINS, LEFT, RIGHT, Pid
from atalante_control.model import ExoskeletonParameters, pinocchio_model, urdf
from atalante_hal.robot import IMUS, JOINTS, MOTORS, load_robot
from atalante_hal.types import State, SupervisorState

ROBOT = load_robot()
GAIT = load_gait(AIRWALK_GAIT, ROBOT)
MODEL = pinocchio_model(urdf(ExoskeletonParameters(), ROBOT))
CONFIG = AirwalkConfig(startup=0.5)
RATE = ROBOT.torque_rate_max * 1e-3  # Nm a cycle
STARTUP = 500
SH, SK = JOINTS.index("left_SH"), JOINTS.index("left_SK")
START = np.array([0.02, 0.0, -0.1, 0.3, -0.1, 0.0, -0.02, 0.0, -0.2, 0.3, -0.05, 0.0])


def blank_state(xi: float) -> State:
    attitude = np.zeros((4, 4))
    attitude[:, 0] = 1.0
    zeros = [np.zeros(12) for _ in range(5)]
    sensors = [attitude, np.zeros((4, 3)), np.zeros((4, 3)), np.zeros((2, 4, 3)), np.zeros(8)]
    return State(0, 0.0, SupervisorState.ACTIVE, xi, *zeros, *sensors, np.ones(24, bool), np.zeros(24, int), True)


class Plant:
    """Twelve joints under a fixed pelvis; order of JOINTS."""

    COUNT = 2 * math.pi / 131072 / 100.0  # rad, encoder step at the joint
    KEEP = math.exp(-2 * math.pi * 80.0 * 1e-3)

    def __init__(self, friction: float = 1.0, xi: float = 0.5) -> None:
        identified = Friction()
        self.coulomb = friction * np.array(identified.coulomb * 2)
        self.viscous = friction * np.array(identified.viscous * 2)
        self.q, self.v, self.motor, self.command = START.copy(), np.zeros(12), np.zeros(12), np.zeros(12)
        self.state = blank_state(xi)
        self.state.position[:] = self.measured = np.rint(self.q / self.COUNT) * self.COUNT
        self._data = MODEL.model.createData()
        self._tibiae = [MODEL.model.getFrameId(f"imu_{side}_tibia") for side in ("left", "right")]
        self._sense_tibiae()

    def step(self, torque: np.ndarray) -> None:
        """One cycle with the command of the cycle before, then sense."""
        for _ in range(2):
            self.motor += (self.command - self.motor) * (1.0 - math.exp(-1.0))  # 0.5 ms current loop
            friction = self.coulomb * np.tanh(self.v / 0.05) + self.viscous * self.v
            q, v, tau = np.empty(12), np.empty(12), np.empty(12)
            q[MODEL.q], v[MODEL.v], tau[MODEL.v] = self.q, self.v, self.motor - friction
            self.v = self.v + 0.5e-3 * pinocchio.aba(MODEL.model, self._data, q, v, tau)[MODEL.v]
            self.q = self.q + 0.5e-3 * self.v
        self.command = torque.copy()
        state, before = self.state, self.measured
        self.measured = np.rint(self.q / self.COUNT) * self.COUNT
        state.position[:] = self.measured
        state.velocity *= self.KEEP
        state.velocity += (1.0 - self.KEEP) * (self.measured - before) / 1e-3
        state.torque[:] = self.motor
        state.cycle += 1
        state.time = state.cycle * 1e-3
        self._sense_tibiae()

    def _sense_tibiae(self) -> None:
        q, v = np.empty(12), np.empty(12)
        q[MODEL.q], v[MODEL.v] = self.q, self.v
        pinocchio.forwardKinematics(MODEL.model, self._data, q, v)
        for imu, frame in zip((2, 3), self._tibiae, strict=True):
            placement = pinocchio.updateFramePlacement(MODEL.model, self._data, frame)
            x, y, z, w = pinocchio.Quaternion(placement.rotation).coeffs()
            self.state.imu_quaternion[imu] = w, x, y, z
            self.state.imu_gyro[imu] = pinocchio.getFrameVelocity(
                MODEL.model, self._data, frame, pinocchio.ReferenceFrame.LOCAL
            ).angular


def walk(
    controller: AirwalkController,
    cycles: int,
    friction: float = 1.0,
    xi: float = 0.5,
    each: Callable[[State], None] = lambda state: None,
) -> np.ndarray:
    """Commands of a closed loop, shape (cycles, 12)."""
    plant = Plant(friction, xi)
    controller.reset(plant.state)
    torques = np.empty((cycles, 12))
    for k in range(cycles):
        each(plant.state)
        torques[k] = controller.update(plant.state).torque
        plant.step(torques[k])
    return torques


def airwalk(shape: str = "constant", config: AirwalkConfig = CONFIG, gait: Gait = GAIT) -> AirwalkController:
    return AirwalkController(ROBOT, gait, SHAPES[shape], config)


STEP = 800
TWO_STEPS = STARTUP + 4 * STEP
CERTIFIED = ["constant", "widening", "narrowing", "pinched", "asymmetric"]


@pytest.mark.parametrize("shape", [*CERTIFIED, "snap"])
def test_a_step_takes_the_gentlest_gains_that_are_certified_with_a_margin(shape: str):
    controller = airwalk(shape)
    box, margin = CONFIG.hand_over, CONFIG.guide_margin
    kp = [guide.config.policies[0].kp for guide in controller.guides]
    assert kp == sorted(kp)
    for xi in (0.0, 0.25, 0.5, 0.75, 0.93):
        certificates = [certify(guide, xi, box) for guide in controller.guides]
        enough = [c.certified and c.margin >= margin + 0.05 for c in certificates]  # the bound in Xi is found to 0.01
        never = [not c.certified or c.margin < margin for c in certificates]
        taken = controller.guides.index(controller.guide_at(xi))
        assert not any(enough[:taken])
        assert taken == len(kp) - 1 or not never[taken]
        if xi <= CONFIG.fade:
            assert replace(controller.certificate(xi), joint_torque=None) == certificates[taken]
    # What the stiffest gains keep is never lost to gentler ones.
    stiffest = [certify(controller.guides[-1], xi, box).certified for xi in (0.5, 0.93)]
    assert [certify(controller.guide_at(xi), xi, box).certified for xi in (0.5, 0.93)] == stiffest


@pytest.mark.parametrize("shape", list(SHAPES))
@pytest.mark.parametrize("xi", [0.9 + 1e-9, 0.91, 0.95, 0.99, 1.0])
def test_no_guide_is_certified_where_the_baseline_is_blended_in(shape: str, xi: float):
    certificate = airwalk(shape).certificate(xi)
    assert not certificate.certified
    assert certificate.joint_torque is None
    assert ("fade" if xi < 1.0 else "only the baseline controller drives the joints") in certificate.reason


def test_the_fade_is_that_of_the_configuration():
    controller = airwalk("constant", replace(CONFIG, fade=0.4))
    assert [controller.certificate(xi).certified for xi in (0.4, 0.5)] == [True, False]


def test_a_guide_whose_torques_are_not_decoupled_is_not_certified():
    certificate = airwalk("constant", replace(CONFIG, decoupled=False)).certificate(0.5)
    assert not certificate.certified
    assert certificate.joint_torque is None
    assert "decoupled=False" in certificate.reason


def test_statistics_keep_the_factors_of_the_steps():
    controller = airwalk()

    def operator(state: State) -> None:
        state.assistance_factor = 0.5 if state.cycle < STARTUP + 100 else 0.95

    walk(controller, STARTUP + STEP + 2, each=operator)
    assert controller.statistics.factors == {0.5, 0.95}


def test_a_joint_whose_torque_is_cut_winds_no_integral_up():
    controllers = airwalk(), airwalk()
    joint, commands = JOINTS.index("right_FH"), []
    for controller, cut in zip(controllers, (0.0, 1.0), strict=True):
        state = blank_state(1.0)
        state.position[:] = START
        state.torque_sent = np.zeros(12)
        controller.reset(state)
        for _ in range(STARTUP // 2):
            state.cycle += 1
            torque = controller.update(state).torque
            state.torque_sent[:] = torque
            state.torque_sent[joint] -= math.copysign(cut, controller.telemetry[joint] - START[joint])  # q_des - q
        commands.append(torque.copy())
    free, limited = commands
    assert abs(free[joint]) > abs(limited[joint]) + 1e-3
    assert np.array_equal(np.delete(free, joint), np.delete(limited, joint))


@pytest.mark.parametrize("shape", CERTIFIED)
def test_a_certified_guide_is_kept_by_the_coupled_leg(shape: str):
    controller = airwalk(shape)
    assert controller.certificate(0.5).certified
    torques = walk(controller, TWO_STEPS + 1)
    said = controller.statistics
    assert said.steps == 2
    assert said.max_ratio <= 1.0
    assert said.inside_fraction == 1.0
    assert said.active_fraction > 0.5  # nobody moves the leg: it is led along the guide
    assert said.min_h_at_start > 0.0
    assert said.hand_overs_exceeded == 0
    # Nothing for the limiter to cut, at step changes least of all.
    jumps = np.abs(np.diff(torques, axis=0))
    assert (jumps <= RATE).all()
    changes = STARTUP + STEP * np.arange(1, 4)
    assert jumps[changes - 1].max() < 5.0
    assert (np.abs(torques) <= ROBOT.torque_max).all()


@pytest.mark.parametrize("friction", [0.8, 1.2])
@pytest.mark.parametrize("shape", ["constant", "pinched"])
def test_friction_a_fifth_off_does_not_break_the_guide(shape: str, friction: float):
    controller = airwalk(shape)
    walk(controller, STARTUP + 3 * STEP, friction)
    assert controller.statistics.max_ratio <= 1.0


@pytest.mark.parametrize("xi", [0.0, 0.8, 0.93])
def test_the_guide_is_kept_at_other_assistance_factors(xi: float):
    controller = airwalk()
    assert controller.certificate(xi).certified == (xi <= CONFIG.fade)
    walk(controller, STARTUP + 3 * STEP, xi=xi)
    assert controller.statistics.max_ratio <= 1.0


def test_an_uncertified_guide_is_announced_and_left():
    controller = airwalk("snap")
    certificate = controller.certificate(0.5)
    assert not certificate.certified
    assert certificate.reason
    walk(controller, STARTUP + 3 * STEP)
    assert controller.statistics.max_ratio > 1.0
    assert controller.statistics.inside_fraction < 1.0


def test_without_the_coupling_undone_a_certified_guide_is_left():
    """Why `decoupled` is there: as printed, each torque on its own joint, the knee throws the hip out."""
    controller = airwalk("pinched", replace(CONFIG, decoupled=False))
    walk(controller, STARTUP + 3 * STEP)
    assert controller.statistics.max_ratio > 1.05


# -- Xi --------------------------------------------------------------------------------------------------------------


@given(st.floats(0.0, 1.0), st.floats(0.0, 0.99))
def test_share_of_the_baseline_is_a_smooth_step_to_exactly_one(xi: float, fade: float):
    share = baseline_share(xi, fade)
    assert 0.0 <= share <= 1.0
    assert baseline_share(1.0, fade) == 1.0
    if xi <= fade:
        assert share == 0.0
    assert share <= baseline_share(min(1.0, xi + 1e-3), fade)
    assert abs(baseline_share(min(1.0, xi + 1e-9), fade) - share) < 1e-6


def test_at_full_assistance_the_command_is_the_baseline_torque_to_the_last_bit():
    controller = airwalk()
    pid, gravity = Pid(AIR_GAINS), Gravity(MODEL)
    plant = Plant(xi=1.0)
    controller.reset(plant.state)
    compared = 0
    for k in range(STARTUP + 3 * STEP):
        since = k - STARTUP
        if since >= 0 and since % STEP == 0:
            pid.start_step(RIGHT if since // STEP % 2 == 0 else LEFT, np.ones(12))
        state = plant.state
        torque = controller.update(state).torque.copy()
        if since < 0:
            # The way to the start is the baseline's own; take over its integrals.
            pid.records[0].integral[:] = controller.pid.records[0].integral
        else:
            expected = pid.update(controller.desired, state.position, state.velocity)
            expected += gravity.torque(state.position, (1.0, 0.0, 0.0, 0.0))
            if since % STEP >= 30:  # the hand-over of the baseline itself has faded
                assert torque.tobytes() == expected.tobytes()
                compared += 1
        plant.step(torque)
    assert compared == 3 * (STEP - 30)


def test_at_full_assistance_the_guide_has_no_say():
    """Whatever u_v is, and in the hand-over too."""
    calm, wild = airwalk(), airwalk()
    rng = np.random.default_rng(1)

    def nonsense(state: State) -> None:
        for guide in wild.guides:
            for name in ("kp", "kd", "limit"):
                guide.tables.joints[name] = rng.uniform(0.0, 1e6, 2)

    cycles = STARTUP + 2 * STEP + 100
    assert walk(calm, cycles, xi=1.0).tobytes() == walk(wild, cycles, xi=1.0, each=nonsense).tobytes()


def recorded(cycles: int) -> list[State]:
    states: list[State] = []

    def keep(state: State) -> None:
        copies = {
            name: getattr(state, name).copy()
            for name in ("position", "velocity", "torque", "imu_quaternion", "imu_gyro")
        }
        states.append(replace(state, **copies))

    walk(airwalk(), cycles, each=keep)
    return states


@cache
def walked() -> list[State]:
    return recorded(STARTUP + STEP + 200)


def replayed(xi: float, shape: str = "constant", config: AirwalkConfig = CONFIG, gait: Gait = GAIT) -> np.ndarray:
    controller, states = airwalk(shape, config, gait), walked()
    controller.reset(states[0])
    return np.array([controller.update(replace(state, assistance_factor=xi)).torque.copy() for state in states])


@pytest.mark.parametrize("xi", [0.0, 0.5, 0.9, 0.95, 0.999, 1.0 - 1e-6])
def test_the_command_is_continuous_in_the_assistance_factor(xi: float):
    here = replayed(xi)
    near, nearer = (np.abs(replayed(xi + step) - here).max() for step in (1e-6, 1e-7))
    assert near < 0.05
    assert nearer < 0.3 * near + 1e-9


def test_only_hip_and_knee_of_the_swing_leg_are_assisted():
    assisted, baseline = replayed(0.5), replayed(1.0)
    first = slice(STARTUP, STARTUP + STEP)
    others = [j for j in range(12) if j not in (SH, SK)]
    assert assisted[first][:, others].tobytes() == baseline[first][:, others].tobytes()
    assert np.abs(assisted[first][:, [SH, SK]] - baseline[first][:, [SH, SK]]).max() > 10.0
    faded = slice(STARTUP + STEP + 30, None)
    left = [j for j in range(6) if j not in (SH, SK)]
    np.testing.assert_allclose(assisted[faded][:, left], baseline[faded][:, left], atol=1e-9)


def test_a_new_assistance_factor_waits_for_the_step_change():
    controller = airwalk("widening")
    seen: list[tuple[float, float]] = []

    def operator(state: State) -> None:
        state.assistance_factor = 0.5 if state.cycle < STARTUP + 1000 else 0.2 if state.cycle < STARTUP + 2500 else 1.0
        seen.append((float(controller.telemetry[-1]), float(controller.telemetry[-2])))

    torques = walk(controller, STARTUP + 5 * STEP, each=operator)
    factors = np.array([xi for xi, _ in seen[STARTUP + 1 :]])
    changes = np.flatnonzero(np.diff(factors)) + 1
    np.testing.assert_array_equal(changes, [2 * STEP, 4 * STEP])
    np.testing.assert_array_equal(np.unique(factors), [0.2, 0.5, 1.0])
    assert (np.abs(np.diff(torques, axis=0)) <= RATE).all()


@pytest.mark.parametrize("asked", [-1.0, 2.0])
def test_a_factor_out_of_range_is_brought_into_it(asked: float):
    controller = airwalk()
    controller.reset(walked()[0])
    for state in walked()[: STARTUP + 3]:
        controller.update(replace(state, assistance_factor=asked))
    assert controller.telemetry[-1] == min(1.0, max(0.0, asked))


# -- the rest --------------------------------------------------------------------------------------------------------


def test_starts_from_the_measured_pose_and_torque():
    controller, state = airwalk(), blank_state(0.5)
    state.position[:] = START
    state.torque[:] = np.linspace(-20.0, 20.0, 12)
    controller.reset(state)
    np.testing.assert_allclose(controller.update(state).torque, state.torque, atol=1e-12)
    np.testing.assert_allclose(controller.telemetry[:12], START, atol=1e-12)
    poses = []
    for state.cycle in range(1, STARTUP + 1):
        controller.update(state)
        poses.append(controller.telemetry[:12].copy())
    np.testing.assert_allclose(
        poses[-2], GAIT.tables().q[0] + CONFIG.ankle_offset * np.isin(np.arange(12) % 6, 4), atol=3e-3
    )
    assert (np.abs(np.diff(poses[:-1], axis=0)) / 1e-3 < ROBOT.velocity_max).all()


def test_starts_again_after_a_reset_as_if_new():
    used, fresh = airwalk(), airwalk()
    walk(used, STARTUP + 900)
    first, second = (walk(controller, STARTUP + 850) for controller in (used, fresh))
    assert first.tobytes() == second.tobytes()
    assert used.statistics == fresh.statistics


def test_telemetry_is_what_its_fields_say():
    controller = airwalk("asymmetric")
    fields = dict(controller.telemetry_fields)
    assert sum(fields.values()) == len(controller.telemetry)
    assert list(fields)[:9] == ["q_des", "error", "q_bound", "guide", "h", "lambda", "filter_active", "step", "phase"]
    places, start = {}, 0
    for name, length in controller.telemetry_fields:
        places[name], start = slice(start, start + length), start + length
    rows: list[np.ndarray] = []
    walk(controller, STARTUP + 2 * STEP + 50, each=lambda state: rows.append(controller.telemetry.copy()))
    walked = np.array(rows[STARTUP + 1 :])
    phase, stance = walked[:, places["phase"]][:, 0], walked[:, places["stance"]][:, 0]
    np.testing.assert_allclose(phase[:STEP], np.arange(STEP) / STEP)
    assert (stance[:STEP] == RIGHT).all()
    assert (stance[STEP : 2 * STEP] == LEFT).all()
    steps = walked[:, places["step"]][:, 0]
    assert (steps[:STEP] == 0).all()
    assert (steps[STEP:] == 1).all()
    error, bound, guide = (walked[:, places[name]] for name in ("error", "q_bound", "guide"))
    np.testing.assert_array_equal(bound, np.where(error > 0.0, guide[:, :1], guide[:, 1:]))
    weight, active = walked[:, places["lambda"]], walked[:, places["filter_active"]]
    np.testing.assert_array_equal(active, weight > CONFIG.active)


def test_haptics_follow_the_swing_leg_and_are_silent_at_full_assistance():
    for xi in (0.5, 1.0):
        controller = airwalk()
        controller.reset(walked()[0])
        for state in walked()[: STARTUP + 200]:
            vibration = controller.update(replace(state, assistance_factor=xi)).vibration
        assert vibration.shape == (len(MOTORS),)
        assert bool(vibration[:4].any()) is (xi < 1.0)
        assert not vibration[4:].any()


def test_a_joint_outside_its_safe_backward_image_is_told():
    controller = airwalk()
    controller.reset(walked()[0])
    told = []
    for cycle, state in enumerate(walked()[: STARTUP + 300]):
        pushed = state.position.copy()
        pushed[SH] += 0.3 * (cycle > STARTUP + 200)
        told.append(controller.update(replace(state, assistance_factor=0.5, position=pushed)).outside)
    assert not any(told[: STARTUP + 200])
    assert told[-1]


@pytest.mark.parametrize("silent", [("left_tibia", "right_tibia"), ("left_tibia", "right_tibia", "pelvis")])
def test_flat_foot_does_not_listen_to_an_imu_that_is_silent(silent: tuple[str, ...]):
    def ankles(quaternion: float, age: int) -> np.ndarray:
        controller = airwalk(config=replace(CONFIG, gentler=()))
        controller.reset(walked()[0])
        targets = []
        for state in walked()[: STARTUP + STEP + 100]:
            attitude, ages = state.imu_quaternion.copy(), np.zeros(4, int)
            for imu in silent[:2]:
                attitude[IMUS.index(imu), 2] = quaternion
            for imu in silent:
                ages[IMUS.index(imu)] = age
            controller.update(replace(state, imu_quaternion=attitude, age=ages, imu_rows=(0, 1, 2, 3)))
            targets.append(controller.telemetry[[4, 5, 10, 11]].copy())
        return np.array(targets)

    assert (ankles(0.0, 0) != ankles(0.1, 0)).any()
    assert (ankles(0.0, 0) == ankles(0.0, 10)).all()
    unheard = ankles(0.1, 11)
    assert (ankles(0.0, 11) == unheard).all()
    assert np.abs(np.diff(unheard[STARTUP + 1 : STARTUP + STEP], axis=0)).max() < 0.01


def test_missed_cycles_do_not_stretch_the_step():
    controller = airwalk()
    controller.reset(walked()[0])
    for state in walked()[: STARTUP + STEP - 2]:
        controller.update(state)
    late = replace(walked()[STARTUP + STEP + 3], cycle=STARTUP + STEP + 3)
    controller.update(late)
    assert controller.statistics.steps == 1
    np.testing.assert_allclose(controller.telemetry[:12], late.position, atol=math.radians(5.0))


def test_feedforward_is_off_in_the_air_and_acts_when_asked_for():
    rng = np.random.default_rng(7)
    points = rng.normal(size=(12, 8)) * 5.0
    pushed = replace(GAIT, feedforward=points)
    np.testing.assert_array_equal(replayed(0.5, gait=pushed), replayed(0.5))
    open_guide = replace(CONFIG, feedforward=True, gentler=())  # the stiffest gains leave it alone longest
    swing = STARTUP + 100
    difference = replayed(0.5, config=open_guide, gait=pushed)[swing] - replayed(0.5, config=open_guide)[swing]
    assert not difference[[j for j in range(12) if j not in (SH, SK)]].any()
    # As a torque on the coupled pair it comes out as the gait asks for, where the guide leaves the joint alone.
    uf = pushed.tables().uf[100, [SH, SK]]
    np.testing.assert_allclose(difference[[SH, SK]], uf, atol=6.0)


@pytest.mark.parametrize(
    "bad",
    [
        {"startup": 0.0},
        {"blend": float("nan")},
        {"fade": 1.0},
        {"guide_rate": (0.0, 1.0)},
        {"gentler": (0.7, 0.5)},
        {"gentler": (1.0,)},
        {"alpha": 2.0},
        {"points": 1},
    ],
)
def test_refuses_a_configuration_that_is_none(bad: dict[str, object]):
    with pytest.raises(ValueError, match=r"\w"):
        airwalk(config=replace(CONFIG, **bad))

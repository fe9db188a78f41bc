"""Airwalk controller on a simulated exoskeleton: forward dynamics of Pinocchio, with the dynamics of the drives.

The simulation includes one cycle of delay, a current loop, encoder steps and a velocity filter of 80 Hz. In some tests its
friction differs by 20 % from the friction that the controller compensates.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np
import pinocchio
import pytest

from atalante_control.airwalk.controller import AirwalkConfig, AirwalkController
from atalante_control.dynamics.gravity import Gravity
from atalante_control.gait.gait import AIRWALK_GAIT, Gait, load_gait
from atalante_control.guide.certificate import PromiseLimits
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
RATE = ROBOT.torque_rate_max * 1e-3  # Nm per cycle
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
    """Simulated exoskeleton with a fixed pelvis. Its twelve joints are in the order of JOINTS."""

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
        """Advance by one cycle under the command of the previous cycle, then measure the new state."""
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
    """Walk in a closed loop, and return the commands, shape (cycles, 12) [Nm]."""
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
def test_step_uses_the_softest_gains_certified_for_the_promise(shape: str):
    controller = airwalk(shape)
    stiffness = [guide.prediction.policy.stiffness for guide in controller.guides]
    assert stiffness == sorted(stiffness)
    for xi in (0.0, 0.5, 0.75, 0.93):
        scales = [PromiseLimits(guide).largest(xi) for guide in controller.guides]
        guide, promise = controller.choice(xi)
        enough = [scale >= 1.0 for scale in scales]
        expected = enough.index(True) if any(enough) else int(np.argmax(scales))
        assert guide is controller.guides[expected] is controller.guide_at(xi)
        assert promise == pytest.approx(1.0 if any(enough) else max(0.0, 0.95 * max(scales)))


@pytest.mark.parametrize("shape", list(SHAPES))
def test_no_guide_has_a_promise_at_full_assistance(shape: str):
    certificate = airwalk(shape).certificate(1.0)
    assert not certificate.certified
    assert certificate.promise is None
    assert "only the baseline controller drives the joints" in certificate.reason


def test_statistics_contain_the_assistance_factors_of_the_steps():
    controller = airwalk()

    def operator(state: State) -> None:
        state.assistance_factor = 0.5 if state.cycle < STARTUP + 100 else 0.95

    walk(controller, STARTUP + STEP + 2, each=operator)
    assert controller.statistics.factors == {0.5, 0.95}


@pytest.mark.parametrize(
    ("delay", "period", "late"),
    [
        (2, 0, [0, 1, 2]),  # the loop is 2 ms slower at START
        (0, 0, [2]),  # the data of a knee becomes 2 cycles old in the second step
        (0, 5, []),  # every fifth frame arrives in time: lost frames, but no delay
    ],
)
def test_step_has_no_guide_if_the_loop_is_slower_than_the_guide_covers(delay: int, period: int, late: list[int]):
    controller, plant = airwalk(), Plant(xi=0.5)
    state, found = plant.state, []
    state.delay, state.joint_rows = delay, tuple(range(12))
    controller.reset(state)
    for cycle in range(STARTUP + 2 * STEP + 10):
        state.age[SK] = 2 if (cycle % period if period else cycle > STARTUP + STEP) else 0
        command = controller.update(state)
        if command.loop_late:
            found.append((cycle - STARTUP) // STEP)
            assert (cycle - STARTUP) % STEP == 0
        plant.step(command.torque.copy())
    assert found == late
    assert controller.statistics.late == len(late)
    assert controller.statistics.factors == (set() if delay else {0.5})


def test_integral_does_not_wind_up_when_the_limiter_cuts_the_torque():
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
def test_coupled_leg_stays_inside_a_certified_guide(shape: str):
    controller = airwalk(shape)
    assert controller.certificate(0.5).certified
    torques = walk(controller, TWO_STEPS + 1)
    statistics = controller.statistics
    assert statistics.steps == 2
    assert statistics.max_ratio <= 1.0
    assert statistics.inside_fraction == 1.0
    assert statistics.active_fraction < 0.9  # the feedforward moves the leg, so the guide acts little
    assert statistics.min_h_at_start > 0.0
    assert statistics.hand_overs_exceeded == 0
    # The torques stay within the rate limit of the limiter, also at stance changes.
    jumps = np.abs(np.diff(torques, axis=0))
    assert (jumps <= RATE).all()
    changes = STARTUP + STEP * np.arange(1, 4)
    assert jumps[changes - 1].max() < 5.0
    assert (np.abs(torques) <= ROBOT.torque_max).all()


def pushed(factor: float) -> AirwalkController:
    """Push hip and knee of both legs by a multiple of the promise, in an own constant direction in each step."""
    controller, rng, step = airwalk(), np.random.default_rng(0), None
    promise = controller.certificate(0.5).promise
    assert promise is not None
    plant, push = Plant(xi=0.5), np.zeros(12)
    controller.reset(plant.state)
    exceeded = 0
    for _ in range(STARTUP + 6 * STEP + 1):
        command = controller.update(plant.state)
        exceeded += command.hand_over_exceeded
        if command.step != step:
            step = command.step
            push[[SH, SH + 6]] = rng.choice([-promise.hip, promise.hip], 2)
            push[[SK, SK + 6]] = rng.choice([-promise.knee, promise.knee], 2)
        torque = command.torque.copy()
        plant.step(torque)
        plant.command += factor * push * (controller.statistics.steps > 0)
    assert exceeded == controller.statistics.hand_overs_exceeded
    return controller


def test_pushes_of_exactly_the_promise_keep_the_guide_and_the_hand_over_box():
    statistics = pushed(1.0).statistics
    assert statistics.max_ratio <= 1.0
    assert statistics.hand_overs == 6
    assert statistics.hand_overs_exceeded == 0


def test_hand_over_outside_the_box_is_counted_and_reported():
    assert pushed(2.5).statistics.hand_overs_exceeded > 0


def test_torque_added_to_a_guided_leg_is_at_most_the_carried_torque_of_the_box():
    controller = pushed(2.5)  # ends with the first cycle of a step
    leg = 6 * (1 - int(controller.telemetry[-2]))  # swing leg
    joints, carry = [leg + SH, leg + SK], controller._carry.records[0]
    limit = np.array(CONFIG.hand_over.carried)
    assert (np.abs(carry.jump[joints]) > limit).any()
    np.testing.assert_array_equal(carry.carried[joints], np.clip(carry.jump[joints], -limit, limit))
    others = np.delete(np.arange(12), joints)
    np.testing.assert_array_equal(carry.carried[others], carry.jump[others])


@pytest.mark.parametrize("friction", [0.8, 1.2])
@pytest.mark.parametrize("shape", ["constant", "pinched"])
def test_joints_stay_inside_the_guide_with_20_percent_friction_error(shape: str, friction: float):
    controller = airwalk(shape)
    walk(controller, STARTUP + 3 * STEP, friction)
    assert controller.statistics.max_ratio <= 1.0


@pytest.mark.parametrize("xi", [0.0, 0.8, 0.93, 0.97])
def test_joints_stay_inside_the_guide_at_other_assistance_factors(xi: float):
    controller = airwalk()
    assert controller.certificate(xi).certified
    walk(controller, STARTUP + 3 * STEP, xi=xi)
    assert controller.statistics.max_ratio <= 1.0


def test_push_moves_a_joint_out_of_a_guide_without_promise():
    controller = airwalk("snap")
    certificate = controller.certificate(0.5)
    assert not certificate.certified
    assert certificate.reason
    plant = Plant(xi=0.5)
    controller.reset(plant.state)
    for cycle in range(STARTUP + 3 * STEP):
        torque = controller.update(plant.state).torque.copy()
        torque[SK] += 30.0 if cycle > STARTUP + 2 * STEP + 300 else 0.0
        plant.step(torque)
    assert controller.statistics.max_ratio > 1.0


# -- Xi --------------------------------------------------------------------------------------------------------------


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
            # The start motion is not compared, so copy the integrals of the controller.
            pid.records[0].integral[:] = controller.pid.records[0].integral
        else:
            expected = pid.update(controller.desired, state.position, state.velocity)
            expected += gravity.torque(state.position, (1.0, 0.0, 0.0, 0.0))
            if since % STEP >= 30:  # the torque that was carried over the stance change has faded
                assert torque.tobytes() == expected.tobytes()
                compared += 1
        plant.step(torque)
    assert compared == 3 * (STEP - 30)


def test_steps_without_guide_are_not_counted_in_the_statistics_of_the_guide():
    controller, plant = airwalk(), Plant(xi=0.5)
    controller.reset(plant.state)
    for cycle in range(STARTUP + 5 * STEP):
        if cycle == STARTUP + 3 * STEP - 1:
            guided = replace(controller.statistics, factors=set(controller.statistics.factors))
            plant.state.assistance_factor = 1.0
        command = controller.update(plant.state)
        assert not command.hand_over_exceeded
        torque = command.torque.copy()
        torque[SK] += 30.0 if cycle > STARTUP + 3 * STEP else 0.0  # larger than any guide permits
        plant.step(torque)
    counted = replace(controller.statistics, steps=guided.steps, factors=guided.factors)
    assert counted == replace(guided, cycles=counted.cycles, inside=counted.inside, active=counted.active)
    assert counted.cycles == counted.inside == guided.cycles + 1  # the last cycle of the guided step


def test_guide_has_no_effect_at_full_assistance():
    """The guide torque u_v has no effect, also not directly after a stance change."""
    calm, wild = airwalk(), airwalk()
    rng = np.random.default_rng(1)

    def nonsense(state: State) -> None:
        for guide in wild.guides:
            guide.tables.guards["gains"] = rng.uniform(0.0, 1e6, (1, 2, 4))

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


@pytest.mark.parametrize("xi", [0.0, 0.5, 0.9])
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
    assert np.abs(assisted[first][:, [SH, SK]] - baseline[first][:, [SH, SK]]).max() > 5.0
    faded = slice(STARTUP + STEP + 30, None)
    left = [j for j in range(6) if j not in (SH, SK)]
    np.testing.assert_allclose(assisted[faded][:, left], baseline[faded][:, left], atol=1e-9)


def test_new_assistance_factor_takes_effect_at_the_stance_change():
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


@pytest.mark.parametrize("requested", [-1.0, 2.0])
def test_assistance_factor_out_of_range_is_clamped(requested: float):
    controller = airwalk()
    controller.reset(walked()[0])
    for state in walked()[: STARTUP + 3]:
        controller.update(replace(state, assistance_factor=requested))
    assert controller.telemetry[-1] == min(1.0, max(0.0, requested))


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


def test_reset_controller_behaves_like_a_new_one():
    used, fresh = airwalk(), airwalk()
    walk(used, STARTUP + 900)
    first, second = (walk(controller, STARTUP + 850) for controller in (used, fresh))
    assert first.tobytes() == second.tobytes()
    assert used.statistics == fresh.statistics


def test_start_after_a_walk_with_a_guide_continues_from_any_measured_torque():
    """The added torque is limited only at hip and knee of a leg with a guide, so not in the start motion."""
    controller, state = airwalk(), blank_state(0.5)
    walk(controller, STARTUP + 100)
    state.position[:], state.torque[:] = START, 60.0
    controller.reset(state)
    np.testing.assert_allclose(controller.update(state).torque, state.torque, atol=1e-12)


def test_telemetry_matches_the_names_and_lengths_of_its_fields():
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


def pushed_out(config: AirwalkConfig = CONFIG, shape: str = "constant") -> list[tuple[bool, bool]]:
    """Return `outside` and `guide_left` of each cycle. After cycle STARTUP + 200, the measured hip angle is far outside."""
    controller = airwalk(shape, config)
    controller.reset(walked()[0])
    found = []
    for cycle, state in enumerate(walked()[: STARTUP + 300]):
        position = state.position.copy()
        position[SH] += 0.3 * (cycle > STARTUP + 200)
        command = controller.update(replace(state, assistance_factor=0.5, position=position))
        found.append((command.outside, command.guide_left))
    return found


def test_a_joint_outside_its_safe_backward_image_is_reported():
    outside = [out for out, _ in pushed_out()]
    assert not any(outside[: STARTUP + 200])
    assert outside[-1]


def test_leaving_the_guide_is_reported_after_outside_cycles():
    left = [left for _, left in pushed_out(replace(CONFIG, outside_cycles=50))]
    assert left.index(True) in range(STARTUP + 251, STARTUP + 254)
    assert all(left[left.index(True) :])
    # A guide without a promise is not reported.
    assert not any(left for _, left in pushed_out(replace(CONFIG, outside_cycles=50), "snap"))


def test_cycles_outside_a_guide_without_a_promise_are_not_counted():
    """In the first step, which has no promise, the hip is outside. In the second step, a promise holds and nothing is outside."""
    controller = airwalk("widening", replace(CONFIG, outside_cycles=50))
    controller.reset(walked()[0])
    outside, left = [], []
    for cycle, state in enumerate(walked()[: STARTUP + 2 * STEP - 10]):
        position = state.position.copy()
        position[SH] += 0.3 * (STARTUP + 200 < cycle < STARTUP + STEP - 50)
        xi = 0.95 if cycle < STARTUP + STEP - 100 else 0.85
        command = controller.update(replace(state, assistance_factor=xi, position=position))
        outside.append(command.outside)
        left.append(command.guide_left)
    assert controller.certificate(0.85).certified
    assert not controller.certificate(0.95).certified
    assert sum(outside[: STARTUP + STEP]) > 300
    assert not any(left)


@pytest.mark.parametrize("silent", [("left_tibia", "right_tibia"), ("left_tibia", "right_tibia", "pelvis")])
def test_flat_foot_ignores_imus_that_timed_out(silent: tuple[str, ...]):
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


def test_missed_cycles_do_not_lengthen_the_step():
    controller = airwalk()
    controller.reset(walked()[0])
    for state in walked()[: STARTUP + STEP - 2]:
        controller.update(state)
    late = replace(walked()[STARTUP + STEP + 3], cycle=STARTUP + STEP + 3)
    controller.update(late)
    assert controller.statistics.steps == 1
    np.testing.assert_allclose(controller.telemetry[:12], late.position, atol=math.radians(5.0))


def test_literal_law_at_full_assistance_is_the_pid_alone():
    config = replace(AirwalkConfig.literal(), startup=0.5)
    controller, pid, plant = airwalk(config=config), Pid(config.gains), Plant(xi=1.0)
    controller.reset(plant.state)
    for k in range(STARTUP + STEP):
        if k == STARTUP:
            pid.start_step(RIGHT, np.ones(12))
        state = plant.state
        torque = controller.update(state).torque.copy()
        if k < STARTUP:
            pid.records[0].integral[:] = controller.pid.records[0].integral
        else:
            assert torque.tobytes() == pid.update(controller.desired, state.position, state.velocity).tobytes()
        plant.step(torque)


def test_intensities_scale_idealization_and_feedforward():
    full, none = (replayed(0.0, config=replace(CONFIG, idealization=x, feedforward=x)) for x in (1.0, 0.0))
    half = replayed(0.0, config=replace(CONFIG, idealization=0.5, feedforward=0.5))
    cycle = STARTUP + 100
    others = [j for j in range(12) if j not in (SH, SK)]
    assert np.array_equal(full[cycle][others], none[cycle][others])
    assert np.abs(full[cycle] - none[cycle])[[SH, SK]].max() > 5.0
    np.testing.assert_allclose(half[cycle][[SH, SK]], 0.5 * (full + none)[cycle][[SH, SK]], atol=3.0)


@pytest.mark.parametrize(
    "bad",
    [
        {"startup": 0.0},
        {"blend": float("nan")},
        {"guided_blend": 0.0005},
        {"stiffness": (0.0, 1.0)},
        {"promise": (30.0, 0.0)},
        {"idealization": 1.5},
        {"feedforward": -0.5},
        {"gentler": (0.7, 0.5)},
        {"gentler": (1.0,)},
        {"alpha": 2.0},
    ],
)
def test_invalid_configuration_is_rejected(bad: dict[str, object]):
    with pytest.raises(ValueError, match=r"\w"):
        airwalk(config=replace(CONFIG, **bad))

"""Walking controller on a body without a bus: standing, walking, stopping."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import pytest

from atalante_control.guide.shapes import CONSTANT
from atalante_control.model import ExoskeletonParameters, urdf
from atalante_control.walking.config import TURN_MAX, WalkConfig
from atalante_control.walking.controller import SENSOR_AGE, StanceError, WalkController
from atalante_control.walking.kernel import SOLE, TIBIA
from atalante_control.walking.lean import LeanConfig
from atalante_control.walking.phases import STEPPING, Phase
from atalante_control.walking.placement import PlacementConfig
from atalante_control.walking.rotation import about_z, rotation_of
from atalante_control.walking.telemetry import TELEMETRY_FIELDS
from atalante_dbc import Network
from atalante_emulator.bodies import hang, make_body
from atalante_hal.dbc_names import FOOT_MESSAGES, IMU_MESSAGES
from atalante_hal.robot import IMUS, JOINTS, MOTORS
from atalante_hal.types import Command, State
from tests.control.walking.ideal_robot import PATIENT, ROBOT, WALK, Ideal, walk_with

KNEES = [JOINTS.index("left_SK"), JOINTS.index("right_SK")]


def walked(
    engine: str,
    steps: int,
    *,
    finish_after: int | None = None,
    xi: float = 1.0,
    lost_feet: Sequence[int] = (),
    lost_imus: Sequence[int] = (),
    implausible_imus: Sequence[int] = (),
) -> tuple[WalkController, list[Phase]]:
    """Walk as in `walk_with`; return the controller and its phases."""
    controller = WalkController(ROBOT, PATIENT, WALK, steps)
    phases = walk_with(
        controller,
        engine,
        finish_after=finish_after,
        xi=xi,
        lost_feet=lost_feet,
        lost_imus=lost_imus,
        implausible_imus=implausible_imus,
    )
    return controller, phases


def hung(controller: WalkController) -> State:
    """Return the state of the suspended robot after the first cycle of a controller."""
    body = make_body("mujoco", urdf(ExoskeletonParameters(), ROBOT, PATIENT), free=True, ground=0.0)
    try:
        hang(body, controller.standing_pose.tolist(), 0.03)
        robot = Ideal(body)
        robot.cycle(controller)
    finally:
        body.close()
    return robot.state


def turn_during(controller: WalkController, state: State, cycles: int) -> float:
    """Update a controller for some cycles with the same measurements. Return the turn of its attitude about the vertical."""
    before = controller._observer.rotation.copy()
    for _ in range(cycles):
        controller.update(state)
        state.cycle += 1
    rotation = controller._observer.rotation
    return math.atan2(rotation[1, 0], rotation[0, 0]) - math.atan2(before[1, 0], before[0, 0])


@pytest.mark.sample(2)
@pytest.mark.parametrize("engine", ["pybullet", "mujoco"])
def test_patient_walks_from_standing_to_standing(engine: str) -> None:
    controller, phases = walked(engine, 3)
    assert phases == list(Phase)
    assert controller.statistics.steps == 3
    assert controller.statistics.unnoticed <= 1
    assert controller.steering.distance == pytest.approx(4 * 0.16, abs=0.12)
    assert abs(controller.steering.lateral) < 0.05
    assert controller.max_dcm_error < 0.03


@pytest.mark.long
def test_second_walk_starts_without_the_footprints_of_the_first_and_with_the_load_that_the_feet_carry() -> None:
    controller = WalkController(ROBOT, PATIENT, WALK, 1)
    body = make_body("mujoco", urdf(ExoskeletonParameters(), ROBOT, PATIENT), free=True, ground=0.0)
    try:
        hang(body, controller.standing_pose.tolist(), 0.0005)
        robot = Ideal(body)
        while controller.phase is not Phase.REST:
            robot.cycle(controller)
        walked = controller.steering.distance
        controller.reset(robot.state)
    finally:
        body.close()
    assert walked > 0.2
    assert not controller.steering.feet.any()
    assert (controller.steering.yaw, controller.steering.lateral) == (0.0, 0.0)
    weight = robot.state.foot_force[:, :, 2].sum()
    assert weight > 500.0
    robot.state.cycle += 1
    controller.update(robot.state)
    assert fields_of(controller)["load"].sum() == pytest.approx(weight, rel=1e-6)


@pytest.mark.parametrize("duration", [0.3, 0.301, 0.302])
def test_gait_as_short_as_the_prediction_of_the_guide_has_a_certificate(duration: float) -> None:
    gaits = WALK._replace(step=replace(WALK.step, duration=duration))
    (certificate,) = WalkController(ROBOT, PATIENT, gaits, 3).certificates(0.5)
    assert certificate.promise is None
    assert "the backup torque reaches" in certificate.reason


@pytest.mark.parametrize("delay", [0, 3])
def test_delay_of_the_loop_lowers_the_damping_of_a_loaded_leg(delay: int) -> None:
    controller = WalkController(ROBOT, PATIENT, WALK, 3)
    state, torques = hung(controller), []
    state.foot_force[:, :, 2] = 200.0
    state.velocity[:] = 0.0
    state.delay = delay
    for velocity in (0.0, 0.1):
        controller.reset(state)
        for _ in range(100):  # the filtered loads of the feet reach their final values
            controller.update(state)
        state.velocity[:] = velocity
        torques.append(controller.update(state).torque.copy())
        state.velocity[:] = 0.0
    kd, damping = WalkConfig().gains.stance.kd, (torques[0] - torques[1]) / 0.1
    for hip, knee in ((2, 3), (8, 9)):  # the stabiliser adds torques to the ankles
        assert damping[hip] == pytest.approx(kd[2] * (0.75 if delay else 1.0), rel=0.02)
        assert damping[knee] == pytest.approx(kd[3] * (0.75 if delay else 1.0), rel=0.02)


def test_delay_lowers_only_the_damping_of_the_sagittal_joints_of_a_stance_leg() -> None:
    now, late = WalkConfig().leg_gains(), WalkConfig(damping_loss=0.1).leg_gains(2)
    changed = late != now
    assert late[changed] == pytest.approx(0.8 * now[changed])
    assert [tuple(index) for index in np.argwhere(changed).tolist()] == [(1, 1, j) for j in (2, 3, 4, 8, 9, 10)]
    with pytest.raises(ValueError, match=r"damping_loss must be from 0 to 0\.25 per cycle, got 0\.3"):
        WalkConfig(damping_loss=0.3)


@pytest.mark.parametrize(
    ("reference", "fault", "follows"),
    [(False, "", False), (True, "", True), (True, "lost", False), (True, "implausible", False)],
)
def test_heading_follows_a_pelvis_imu_with_a_heading_reference(reference: bool, fault: str, follows: bool) -> None:
    """The controller ignores the heading of a pelvis IMU that is lost or implausible."""
    controller = WalkController(ROBOT, PATIENT, WALK, 3, WalkConfig(heading_reference=reference))
    state = hung(controller)
    state.imu_rows = (2, 3, 4, 5)
    state.age[list(state.imu_rows)] = 100 if fault == "lost" else 0
    if fault == "implausible":
        state.implausible_imus = frozenset({IMUS.index("pelvis")})
    state.imu_gyro[:] = 0.0
    state.imu_quaternion[:] = math.cos(0.005), 0.0, 0.0, math.sin(0.005)
    turn = turn_during(controller, state, 2500)
    assert turn > 1e-7 if follows else abs(turn) < 1e-9


@pytest.mark.parametrize(("swung", "text"), [(0.15, "ahead of"), (-0.15, "behind")])
@pytest.mark.parametrize("yaw", [0.0, 2.0])
def test_walk_starts_on_the_ground_only_with_the_feet_side_by_side(swung: float, text: str, yaw: float) -> None:
    """A robot that stands still after HOLD in a step has one foot ahead of the other."""
    controller = WalkController(ROBOT, PATIENT, WALK, 3)
    state, hips = hung(controller), [JOINTS.index("left_SH"), JOINTS.index("right_SH")]
    state.imu_quaternion[:] = math.cos(yaw / 2.0), 0.0, 0.0, math.sin(yaw / 2.0)
    state.foot_force[:, :, 2] = 190.0
    for small in (0.0, swung / 10.0):
        state.position[:] = controller.standing_pose
        state.position[hips] += small, -small
        controller.reset(state)
    state.position[hips] += swung, -swung
    with pytest.raises(StanceError, match=rf"got the right foot 0\.33 m {text} the left foot: suspend the robot first"):
        controller.reset(state)
    state.foot_force[:] = 0.0
    controller.reset(state)


@pytest.mark.parametrize(
    ("implausible", "replaced"),
    [
        ((), False),
        (("torso",), False),
        (("pelvis",), True),
        (("pelvis", "left_tibia"), True),
    ],
)
def test_torso_imu_replaces_an_implausible_pelvis_imu_for_the_rest_of_the_walk(
    implausible: tuple[str, ...], replaced: bool
) -> None:
    """The gyro of the pelvis has a constant error. The finding ends after one cycle, but the error remains."""
    controller = WalkController(ROBOT, PATIENT, WALK, 3)
    state, pelvis = hung(controller), IMUS.index("pelvis")
    state.imu_gyro[:] = 0.0
    state.imu_gyro[pelvis, 1] = 0.3
    state.implausible_imus = frozenset(map(IMUS.index, implausible))
    before = controller.vertical.copy()
    for _ in range(200):
        controller.update(state)
        state.cycle += 1
        state.implausible_imus = frozenset()
    assert bool(abs(controller.vertical - before).max() < 1e-3) is replaced
    controller.reset(state)
    controller.update(state)
    assert controller._measured is controller._measured_by[pelvis]


def test_data_of_imus_and_feet_is_valid_up_to_the_timeout_of_its_message(network: Network) -> None:
    assert {network.message(name).timeout_ms for name in (*IMU_MESSAGES, *FOOT_MESSAGES)} == {SENSOR_AGE}


@pytest.mark.parametrize("implausible", ["pelvis", "torso"])
def test_implausible_trunk_imu_does_not_replace_the_other_one(implausible: str) -> None:
    """The finding ends after one cycle. Without the other IMU of the trunk, the stance leg replaces both."""
    controller = WalkController(ROBOT, PATIENT, WALK, 3)
    state, other = hung(controller), "torso" if implausible == "pelvis" else "pelvis"
    intact = controller._measured_by[IMUS.index(other)]
    state.implausible_imus = frozenset({IMUS.index(implausible)})
    for lost, replaced in (
        ((), False),
        ((other,), True),
        ((), False),
        ((implausible,), False),
        (("torso", "pelvis"), True),
    ):
        state.age[list(state.imu_rows)] = [11 if imu in lost else 10 for imu in IMUS]
        controller.update(state)
        state.cycle += 1
        state.implausible_imus = frozenset()
        assert controller._measured is (controller._without_trunk if replaced else intact)


@pytest.mark.parametrize(("implausible", "source"), [((), TIBIA), (("left_tibia",), SOLE), (("right_tibia",), SOLE)])
def test_stance_leg_replaces_implausible_trunk_imus_and_corrects_the_attitude(
    implausible: tuple[str, ...], source: int
) -> None:
    """The attitude is wrong by 0.1 rad about X, and the heading is 0.5 rad. The robot hangs still, with level soles."""
    controller = WalkController(ROBOT, PATIENT, WALK, 3)
    state, observer = hung(controller), controller._observer
    state.imu_gyro[:] = 0.0
    state.implausible_imus = frozenset(map(IMUS.index, ("torso", "pelvis", *implausible)))
    before, wrong = controller.vertical.copy(), rotation_of((math.cos(0.05), math.sin(0.05), 0.0, 0.0))
    observer.rotation[:] = about_z(0.5) @ observer.rotation @ wrong
    for cycles, error in ((1, 0.095), (19, 0.1 / math.e), (180, 0.0)):
        for _ in range(cycles):
            controller.update(state)
            state.cycle += 1
            state.implausible_imus = frozenset()
        assert abs(controller.vertical - before).max() == pytest.approx(error, abs=2e-3)
    assert controller._measured is controller._without_trunk
    assert controller._stage.gyro_source == source
    assert math.atan2(observer.rotation[1, 0], observer.rotation[0, 0]) == pytest.approx(0.5, abs=2e-3)


def test_attitude_is_not_corrected_after_the_loss_of_plausible_trunk_imus() -> None:
    """A tibia IMU that is mounted askew has no effect on the attitude."""
    controller = WalkController(ROBOT, PATIENT, WALK, 3)
    state = hung(controller)
    state.imu_gyro[:], state.imu_quaternion[:] = 0.0, (math.cos(0.01), math.sin(0.01), 0.0, 0.0)
    state.age[list(state.imu_rows[:2])] = 11
    before = controller.vertical.copy()
    for _ in range(300):
        controller.update(state)
        state.cycle += 1
    assert controller._stage.gyro_source == TIBIA
    assert controller.vertical == pytest.approx(before, abs=1e-3)


@pytest.mark.parametrize(("lost", "rate"), [((), 0.3), (("left_tibia",), 0.0), (("right_tibia",), 0.0)])
def test_stance_leg_replaces_both_lost_trunk_imus_until_they_return(lost: tuple[str, ...], rate: float) -> None:
    """The right tibia turns about the vertical. If a tibia IMU is lost, too, the stance foot counts as at rest."""
    controller, trunk = WalkController(ROBOT, PATIENT, WALK, 3), [IMUS.index("torso"), IMUS.index("pelvis")]
    state = hung(controller)
    links, soles = controller._parts.chain.links, controller._parts.chain.soles
    up, shank = controller.vertical.copy(), links[soles[1].link - 2].rotation
    state.velocity[:], state.imu_gyro[:], state.foot_force[:, :, 2] = 0.0, 0.0, 100.0
    state.imu_gyro[IMUS.index("right_tibia")] = 0.3 * shank.T @ up
    for missing, gyro in (("torso", "pelvis", *lost), 9.0), ((), rate * up):
        state.age[list(state.imu_rows)] = [11 if imu in missing else 10 for imu in IMUS]
        state.imu_gyro[trunk] = gyro
        vertical = controller.vertical.copy()
        assert turn_during(controller, state, 100) == pytest.approx(0.1 * rate, abs=1e-3)
        assert controller.vertical == pytest.approx(vertical, abs=1e-3)


@pytest.mark.long
def test_change_between_pelvis_imu_and_torso_imu_in_a_step_keeps_the_attitude() -> None:
    """The pelvis IMU is lost in the middle of the first periodic step and returns in the next step."""
    controller, errors = WalkController(ROBOT, PATIENT, WALK, 2), list[float]()
    body = make_body("mujoco", urdf(ExoskeletonParameters(), ROBOT, PATIENT), free=True, ground=0.0)
    try:
        hang(body, controller.standing_pose.tolist(), 0.0005)
        robot = Ideal(body)
        robot.state.imu_rows = (2, 3, 4, 5)
        while controller.statistics.steps < 2:
            lost = controller.reached(0, 0.5) and not controller.reached(1, 0.5)
            robot.state.age[robot.state.imu_rows[IMUS.index("pelvis")]] = 100 if lost else 0
            robot.cycle(controller)
            x, y, z, w = body.motion("pelvis").attitude
            up = np.array([2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)])
            errors.append(
                math.degrees(math.acos(min(1.0, float(up @ controller.vertical)))) if controller.steps_begun else 0.0
            )
            assert robot.upright()
    finally:
        body.close()
    assert max(errors) < 0.05
    assert controller.max_dcm_error < 0.01


@pytest.mark.long
def test_steering_in_a_turn_keeps_the_transverse_hips_within_their_limits() -> None:
    """The joints do not move, so the heading error grows from step to step, and steering requests its largest offset."""
    controller = WalkController(ROBOT, PATIENT, WALK, 4, WalkConfig(turn=TURN_MAX))
    state, hips, desired = hung(controller), [JOINTS.index("left_TH"), JOINTS.index("right_TH")], list[np.ndarray]()
    while controller.statistics.steps < 4:
        stance = int(fields_of(controller)["stance"][0])
        state.foot_force[:, :, 2] = 250.0
        if controller.phase in STEPPING:
            state.foot_force[1 - stance] = 0.0
        controller.update(state)
        state.cycle += 1
        desired.append(fields_of(controller)["q_des"][hips])
        assert state.cycle < 20_000
    low, high = ROBOT.position_min[hips], ROBOT.position_max[hips]
    assert np.all((low <= np.array(desired)) & (np.array(desired) <= high))
    assert np.any(np.array(desired) == high)


def elapsed_of(controller: WalkController) -> float:
    """Return the time since the start of the phase, from the telemetry [s]."""
    return float(fields_of(controller)["elapsed"][0])


def fields_of(controller: WalkController) -> dict[str, np.ndarray]:
    """Return a copy of the values of each telemetry field."""
    ends = np.cumsum([width for _, width in TELEMETRY_FIELDS])
    values = np.split(controller.telemetry.copy(), ends[:-1])
    return dict(zip((name for name, _ in TELEMETRY_FIELDS), values, strict=True))


def pushed(
    dead_zone: float,
    direction: float,
    force: float,
    edge: float = WalkConfig().edge,
    check: Callable[[WalkController, State, Command], None] | None = None,
) -> bool:
    """Push the pelvis for 0.2 s from phase 0.2 of the second step; return whether the robot walks three more steps."""
    lean = LeanConfig() if math.isfinite(dead_zone) else LeanConfig(gain=0.0, leg_gain=0.0)
    config = WalkConfig(placement=PlacementConfig(dead_zone=dead_zone), lean=lean, edge=edge)
    controller = WalkController(ROBOT, PATIENT, WALK, 100, config)
    body = make_body("mujoco", urdf(ExoskeletonParameters(), ROBOT, PATIENT), free=True, ground=0.0)
    angle, cycles = math.radians(direction), 0
    try:
        hang(body, controller.standing_pose.tolist(), 0.0005)
        robot = Ideal(body)
        while controller.statistics.steps < 4 and robot.upright():
            command = robot.cycle(controller)
            if check is not None:
                check(controller, robot.state, command)
            steps, elapsed = controller.statistics.steps, elapsed_of(controller)
            if steps == 1 and controller.phase is Phase.STEP and elapsed >= 0.16 and cycles < 200:
                body.push((force * math.cos(angle), force * math.sin(angle), 0.0))
                cycles += 1
                if cycles == 200:
                    body.push((0.0, 0.0, 0.0))
            assert robot.state.cycle < 30_000
        return robot.upright()
    finally:
        body.close()


@pytest.mark.long
@pytest.mark.parametrize(("direction", "force"), [(90.0, 210.0), (270.0, 180.0)], ids=["left", "right"])
def test_robot_withstands_a_push_only_with_foot_placement_step_timing_and_lean(direction: float, force: float) -> None:
    assert pushed(PlacementConfig().dead_zone, direction, force)
    assert not pushed(math.inf, direction, force)


@pytest.mark.long
def test_ankle_of_a_pushed_robot_keeps_the_centre_of_pressure_within_the_sole() -> None:
    foot, arms = ExoskeletonParameters(), list[float]()

    def store_arm(controller: WalkController, state: State, command: Command) -> None:
        if controller.phase is Phase.STEP and elapsed_of(controller) > 0.1:
            stance = int(fields_of(controller)["stance"][0])
            force = float(state.foot_force[stance, :, 2].sum())
            if force > 1000.0:
                arms.append(float(command.torque[6 * stance + 4]) / force)

    edge = 0.06  # so large that the push moves the centre of pressure to the limit
    pushed(PlacementConfig().dead_zone, 180.0, 200.0, edge, store_arm)
    heel = foot.sole_centre[0] - 0.5 * foot.sole_size[0] + foot.pad_radius
    assert heel + edge - 0.01 <= min(arms) < heel + edge


@pytest.mark.sample(2)
@pytest.mark.parametrize("feet", [(0,), (1,), (0, 1)])
def test_robot_makes_a_stop_step_without_the_data_of_a_foot(feet: tuple[int, ...]) -> None:
    controller, phases = walked("mujoco", 100, finish_after=1, lost_feet=feet)
    assert phases[-3:] == [Phase.STOP, Phase.BACK, Phase.REST]
    assert controller.max_dcm_error < 0.05


@pytest.mark.sample(2)
@pytest.mark.parametrize("lost", [("torso", "pelvis"), IMUS])
def test_robot_makes_a_stop_step_without_the_imus_of_the_trunk(lost: tuple[str, ...]) -> None:
    controller, phases = walked("mujoco", 100, finish_after=1, lost_imus=list(map(IMUS.index, lost)))
    assert phases[-3:] == [Phase.STOP, Phase.BACK, Phase.REST]
    assert controller.max_dcm_error < 0.03


@pytest.mark.sample(2)
@pytest.mark.parametrize(("lost", "implausible"), [("pelvis", "torso"), ("torso", "pelvis")])
def test_robot_makes_a_stop_step_without_one_trunk_imu_and_with_an_implausible_other_one(
    lost: str, implausible: str
) -> None:
    controller, phases = walked(
        "mujoco", 100, finish_after=1, lost_imus=[IMUS.index(lost)], implausible_imus=[IMUS.index(implausible)]
    )
    assert phases[-3:] == [Phase.STOP, Phase.BACK, Phase.REST]
    assert controller.max_dcm_error < 0.03


def test_walk_that_starts_without_the_feet_has_finite_loads() -> None:
    """The first estimate of the loads uses the kinematics of the joint angles 0."""
    controller = WalkController(ROBOT, PATIENT, WALK, 3)
    state = hung(WalkController(ROBOT, PATIENT, WALK, 3))
    state.age[list(state.foot_rows)] = 11
    with np.errstate(all="raise"):
        controller.reset(state)
    assert controller._load.sum() == pytest.approx(controller._constants.weight)


def test_centre_of_mass_gives_the_loads_of_lost_feet_that_stand() -> None:
    """Frontal hip angles of 0.05 rad move the soles (0.21 m apart) to the left by 51 mm, the centre of mass by 11 mm."""
    controller = WalkController(ROBOT, PATIENT, WALK, 3)
    state = hung(controller)
    state.age[list(state.foot_rows)] = 11
    state.foot_force[:] = 9.0
    for hip, expected in ((0.0, 0.5), (0.05, 0.5 - 0.04 / 0.21), (-0.05, 0.5 + 0.04 / 0.21)):
        state.position[[JOINTS.index("left_FH"), JOINTS.index("right_FH")]] = hip
        for _ in range(300):
            controller.update(state)
            state.cycle += 1
        load = fields_of(controller)["load"]
        assert load.sum() == pytest.approx(controller._constants.weight)
        assert load[0] / load.sum() == pytest.approx(expected, abs=0.01)


def test_finish_step_ends_the_walk_with_a_stop_step() -> None:
    controller, phases = walked("mujoco", 100, finish_after=1)
    assert phases[-3:] == [Phase.STOP, Phase.BACK, Phase.REST]
    assert controller.statistics.steps <= 2


@pytest.mark.parametrize("phase", [Phase.POSTURE, Phase.STAND])
def test_stop_before_the_weight_shift_ends_the_walk_without_a_step(phase: Phase) -> None:
    controller, phases = WalkController(ROBOT, PATIENT, WALK, 3), [Phase.POSTURE]
    body = make_body("mujoco", urdf(ExoskeletonParameters(), ROBOT, PATIENT), free=True, ground=0.0)
    try:
        hang(body, controller.standing_pose.tolist(), 0.0005)
        robot = Ideal(body)
        while not controller.done:
            robot.cycle(controller)
            if controller.phase is not phases[-1]:
                phases.append(controller.phase)
            if controller.phase is phase:
                controller.stop()
            assert robot.state.cycle < 10_000
        assert robot.upright()
    finally:
        body.close()
    assert phases == [Phase.POSTURE, Phase.STAND, Phase.REST]


@pytest.mark.sample(2)
@pytest.mark.parametrize("xi", [0.0, 0.5])
def test_swing_leg_stays_inside_the_certified_guide(xi: float) -> None:
    controller, phases = walked("mujoco", 3, xi=xi)
    guide = controller.statistics.guide
    assert phases == list(Phase)
    assert [certificate.certified for certificate in controller.certificates(xi)] == [True]
    assert guide.factors == {xi}
    assert 3 * 600 < guide.cycles < 3 * 850
    # The joints stay inside although this robot has no friction and the controller compensates friction.
    assert guide.inside == guide.cycles
    assert 0.02 < guide.active_fraction < 1.0


@dataclass
class Felt:
    """Vibration of one cycle, with the values from which the controller computes it."""

    guided: bool
    swing: int
    shares: list[float]  # e / q_bound of SH and SK
    levels: list[float]


class RecordingController(WalkController):
    """Controller that records the vibration of each cycle in `felt`."""

    felt: list[Felt]

    def update(self, state: State) -> Command:
        command, fields = super().update(state), fields_of(self)
        guided = self.phase is Phase.STEP and fields["elapsed"][0] <= 0.8 and state.assistance_factor < 1.0
        shares = (fields["error"] / fields["q_bound"]).tolist() if guided else []
        self.felt.append(Felt(guided, 1 - int(fields["stance"][0]), shares, command.vibration.tolist()))
        return command


@pytest.mark.long
def test_count_of_the_cycles_outside_falls_in_a_step_without_a_guide() -> None:
    """In step 1, a torque beyond the promise moves the swing leg out of its guide. Step 2 has full assistance, step 3 a guide."""
    controller = WalkController(ROBOT, PATIENT, WALK, 4, WalkConfig(), CONSTANT)
    body = make_body("mujoco", urdf(ExoskeletonParameters(), ROBOT, PATIENT), free=True, ground=0.0)
    left: dict[int, list[bool]] = {step: [] for step in range(5)}
    try:
        hang(body, controller.standing_pose.tolist(), 0.0005)
        robot = Ideal(body)
        while controller.phase is not Phase.REST:
            step = controller.statistics.steps
            robot.state.assistance_factor = 1.0 if step == 1 and any(left[1]) else 0.85
            command = robot.cycle(controller)
            if controller.phase is Phase.STEP:
                left[step].append(command.guide_left)
                swing = ("right", "left")[int(fields_of(controller)["stance"][0])]
                pushed = step == 1 and 0.25 < elapsed_of(controller) < 0.72
                for joint in ("SH", "SK"):
                    robot.push[JOINTS.index(f"{swing}_{joint}")] = 100.0 * pushed
            assert robot.upright()
    finally:
        body.close()
    assert any(left[1])
    assert not any(left[3])


@pytest.mark.long
def test_vibration_shows_the_tracking_errors_of_the_guided_leg() -> None:
    controller = RecordingController(ROBOT, PATIENT, WALK, 2)
    controller.felt = []
    walk_with(controller, "mujoco", xi=0.5)
    guided = [felt for felt in controller.felt if felt.guided]
    assert {felt.swing for felt in guided} == {0, 1}
    assert max(max(felt.levels) for felt in guided) > 0.1
    for felt in guided:
        expected = [0.0] * len(MOTORS)
        for segment, share in zip(("thigh", "shank"), felt.shares, strict=True):
            motor = f"{('left', 'right')[felt.swing]}_{segment}_{'front' if share < 0.0 else 'back'}"
            expected[MOTORS.index(motor)] = min(1.0, abs(share) * (1.0 - math.exp(30.0 * (0.5 - 1.0))))
        assert felt.levels == pytest.approx(expected)
    assert not any(any(felt.levels) for felt in controller.felt if not felt.guided)


def test_guide_and_vibration_are_off_at_full_assistance() -> None:
    controller = RecordingController(ROBOT, PATIENT, WALK, 1)
    controller.felt = []
    walk_with(controller, "mujoco")
    assert not any(any(felt.levels) for felt in controller.felt)
    assert controller.statistics.guide.cycles == 0
    assert not controller.certificates(1.0)[0].certified


@pytest.mark.parametrize("delay", [1, 2])
def test_guide_acts_only_if_it_covers_the_delay_of_the_loop(delay: int) -> None:
    controller = WalkController(ROBOT, PATIENT, WALK, 2)
    late, seen = walk_in_guide(controller, delay=delay), controller.statistics.guide
    assert len(late) == seen.late == (2 if delay == 2 else 0)
    assert (seen.cycles == 0) == (delay == 2)


def test_guide_ends_within_the_step_if_data_becomes_late() -> None:
    """The baseline controller takes over. The torque of the guide fades out."""
    controller = WalkController(ROBOT, PATIENT, WALK, 2)
    late = walk_in_guide(controller, late_from=0.4)
    seen = controller.statistics.guide
    assert len(late) == seen.late == 2
    (first, jump), (second, _) = late
    assert first == pytest.approx(0.4, abs=0.02)
    assert seen.cycles == round(first * WALK.step.duration * 1000.0)  # the fifth late cycle has no guide
    assert jump < 2.0
    assert second == 0.0


def test_telemetry_shows_no_guide_after_the_guide_ended_within_the_step() -> None:
    controller, ended = WalkController(ROBOT, PATIENT, WALK, 1), []

    def watch(state: State, command: Command) -> None:
        shown = fields_of(controller)
        if command.loop_late or (ended and controller.phase is Phase.STEP):
            ended.append(
                (shown["assistance_factor"].item(), *shown["q_bound"], *shown["error"], shown["lambda"].item())
            )
            assert not command.vibration.any()

    walk_in_guide(controller, late_from=0.4, watch=watch)
    assert len(ended) > 400
    assert set(ended) == {(1.0, 0.0, 0.0, 0.0, 0.0, 0.0)}


def test_frames_lost_at_the_start_of_a_step_do_not_prevent_its_guide() -> None:
    """Only every fifth frame of a knee arrives in time. So at most stance changes, the data is older than the guide covers."""
    controller = WalkController(ROBOT, PATIENT, WALK, 2)

    def watch(state: State, command: Command) -> None:
        state.age[state.joint_rows[KNEES[0]]] = 2 if state.cycle % 5 else 0

    late = walk_in_guide(controller, watch=watch)
    assert not late
    assert controller.statistics.guide.late == 0
    assert controller.statistics.guide.cycles > 2 * 700


def test_end_of_a_guide_does_not_shorten_the_guide_of_the_next_step() -> None:
    """In the second step, the data is old in one cycle only. The late cycles of the first step do not count any more."""
    controller = WalkController(ROBOT, PATIENT, WALK, 2)

    def watch(state: State, command: Command) -> None:
        elapsed = fields_of(controller)["elapsed"].item() / WALK.step.duration
        first, second = (controller.phase is Phase.STEP and controller.statistics.steps == step for step in (0, 1))
        old = (first and 0.4 <= elapsed < 0.42) or (second and elapsed == 0.0)
        state.age[state.joint_rows[KNEES[0]]] = 2 if old else 0

    assert len(walk_in_guide(controller, watch=watch)) == 1
    assert controller.statistics.guide.late == 1


def walk_in_guide(
    controller: WalkController,
    *,
    delay: int = 0,
    late_from: float | None = None,
    watch: Callable[[State, Command], None] = lambda state, command: None,
) -> list[tuple[float, float]]:
    """Walk in a guide to standing. Return when the command was late: phase of the step, and largest change of a knee torque [Nm].

    Args:
        controller: controller of the walk.
        delay: delay of the torques that the HAL measured at START [cycles].
        late_from: phase of the first step from which on the data of both knees is 3 cycles old. None if it is always new.
        watch: function called after each cycle with state and command.
    """
    body = make_body("mujoco", urdf(ExoskeletonParameters(), ROBOT, PATIENT), free=True, ground=0.0)
    try:
        hang(body, controller.standing_pose.tolist(), 0.0005)
        robot, late = Ideal(body), []
        state = robot.state
        state.assistance_factor, state.delay = 0.5, delay
        before = np.zeros(12)
        while controller.phase is not Phase.REST:
            if late_from is not None and controller.reached(0, late_from):
                state.age[[state.joint_rows[joint] for joint in KNEES]] = 3
            command = robot.cycle(controller)
            if command.loop_late:
                jump = np.abs(command.torque - before)[KNEES].max()
                late.append((fields_of(controller)["elapsed"].item() / WALK.step.duration, float(jump)))
            before[:] = command.torque
            watch(state, command)
            assert robot.upright()
    finally:
        body.close()
    return late


@pytest.mark.parametrize("assisted", [False, True])
def test_literal_law_limits_the_integral_only_outside_the_periodic_steps(assisted: bool) -> None:
    """In a guided step, the integrals of hip and knee of the swing leg stand still, because the guide drives them."""
    controller = WalkController(ROBOT, PATIENT, WALK, 2, WalkConfig.literal(), CONSTANT)
    state = hung(controller)
    state.assistance_factor = 0.5 if assisted else 1.0
    state.torque_sent = controller._pid.requested  # no torque is limited
    controller.reset(state)
    record, hip, swinging = controller._pid.records[0], JOINTS.index("left_SH"), (8, 9)  # the right leg swings

    def follow(phase: Phase) -> np.ndarray:
        """Start a phase; return the growth of the integrals in 100 cycles in which all joints are far below their targets."""
        state.position[:] = 0.0
        controller._begin(phase, state)
        before = record.integral.copy()
        state.position[:] = -3.0
        for _ in range(100):
            controller.update(state)
            state.cycle += 1
        return record.integral - before

    follow(Phase.SHIFT)
    assert np.abs(record.integral).max() == 10.0
    controller._begin(Phase.START, state)
    grown = follow(Phase.STEP)
    assert abs(grown[hip]) > 20.0
    assert [grown[joint] == 0.0 for joint in swinging] == [assisted, assisted]
    assert np.abs(record.integral).max() > 20.0
    follow(Phase.STOP)
    assert np.abs(record.integral).max() == 10.0

"""Walking controller on a body without a bus: standing, walking, stopping."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest

from atalante_control.gait.walk import DEFAULT_WALK, load_walk
from atalante_control.model import ExoskeletonParameters, Patient, urdf
from atalante_control.walking.config import WalkConfig
from atalante_control.walking.controller import WalkController
from atalante_control.walking.lean import LeanConfig
from atalante_control.walking.phases import Phase
from atalante_control.walking.placement import PlacementConfig
from atalante_control.walking.telemetry import TELEMETRY_FIELDS
from atalante_emulator.bodies import Body, hang, make_body
from atalante_emulator.imu import ImuParameters, Imus, ImuSignals
from atalante_hal.robot import load_robot
from atalante_hal.types import State, SupervisorState

ROBOT = load_robot()
PATIENT = Patient(75.0, 1.75)
WALK = load_walk(DEFAULT_WALK, ROBOT)


class Ideal:
    """Robot without noise and bus. The torques act in the next cycle."""

    def __init__(self, body: Body) -> None:
        self.body = body
        self.signals = ImuSignals(np.zeros((4, 4)), np.zeros((4, 3)), np.zeros((4, 3)))
        self._imus = Imus(ImuParameters(), self.signals)
        zero, valid = np.zeros(12), np.ones(22, bool)
        self.state = State(
            cycle=0,
            time=0.0,
            supervisor=SupervisorState.ACTIVE,
            assistance_factor=1.0,
            position=zero.copy(),
            velocity=zero.copy(),
            torque=zero.copy(),
            temperature=zero.copy(),
            drive_state=zero.copy(),
            imu_quaternion=self.signals.quaternion,
            imu_gyro=self.signals.gyro,
            imu_accel=self.signals.accel,
            foot_force=np.zeros((2, 4, 3)),
            vibration=np.zeros(8),
            valid=valid,
            age=np.zeros(22, np.int64),
            joints_valid=True,
            foot_rows=(0, 1),
        )
        self._torque = zero.copy()

    def cycle(self, controller: WalkController) -> None:
        body, state = self.body, self.state
        self._imus.sample(body.imu)
        state.position[:], state.velocity[:] = body.position, body.velocity
        received = state.age[list(state.foot_rows)] == 0
        state.foot_force[received] = body.sole_force[received]
        if state.cycle == 0:
            controller.reset(state)
        torque = controller.update(state).torque.copy()
        body.step(self._torque.tolist())
        self._torque = np.clip(torque, -ROBOT.torque_max, ROBOT.torque_max)
        state.cycle += 1

    def upright(self) -> bool:
        x, y, _, _ = self.body.motion("pelvis").attitude
        return bool(1.0 - 2.0 * (x * x + y * y) > 0.9)


def walked(
    engine: str, steps: int, *, finish_after: int | None = None, xi: float = 1.0, lost_foot: int | None = None
) -> tuple[WalkController, list[Phase]]:
    """Walk until the robot stands again; return the controller and its phases.

    After `finish_after` steps, FINISH_STEP begins and the data of the foot `lost_foot` is no longer received.
    """
    controller = WalkController(ROBOT, PATIENT, WALK, steps)
    body = make_body(engine, urdf(ExoskeletonParameters(), ROBOT, PATIENT), free=True, ground=0.0)
    try:
        hang(body, controller.standing_pose.tolist(), 0.0005)
        robot, phases = Ideal(body), [controller.phase]
        robot.state.assistance_factor = xi
        while not controller.done:
            robot.cycle(controller)
            if controller.phase is not phases[-1]:
                phases.append(controller.phase)
            if finish_after is not None and controller.statistics.steps == finish_after:
                robot.state.supervisor = SupervisorState.FINISH_STEP
                if lost_foot is not None:
                    robot.state.age[robot.state.foot_rows[lost_foot]] = 100
            assert robot.upright(), f"fell in {controller.phase.name} after {controller.statistics.steps} steps"
            assert robot.state.cycle < 30_000
    finally:
        body.close()
    return controller, phases


@pytest.mark.parametrize("engine", ["pybullet", "mujoco"])
def test_patient_walks_from_standing_to_standing(engine: str) -> None:
    controller, phases = walked(engine, 3)
    assert phases == list(Phase)
    assert controller.statistics.steps == 3
    assert controller.statistics.unnoticed <= 1
    assert controller.steering.distance == pytest.approx(4 * 0.16, abs=0.12)
    assert abs(controller.steering.lateral) < 0.05
    assert controller.max_dcm_error < 0.03


@pytest.mark.parametrize(("gain", "lost", "heading"), [(0.0, False, 0.0), (2.0, False, 0.2), (2.0, True, 0.0)])
def test_heading_follows_a_pelvis_imu_with_a_heading_reference(gain: float, lost: bool, heading: float) -> None:
    """The controller ignores the heading of a pelvis IMU that is lost."""
    controller = WalkController(ROBOT, PATIENT, WALK, 3, WalkConfig(heading_gain=gain))
    body = make_body("mujoco", urdf(ExoskeletonParameters(), ROBOT, PATIENT), free=True, ground=0.0)
    try:
        hang(body, controller.standing_pose.tolist(), 0.03)
        robot = Ideal(body)
        robot.cycle(controller)
    finally:
        body.close()
    state = robot.state
    state.imu_rows = (2, 3, 4, 5)
    state.age[list(state.imu_rows)] = 100 if lost else 0
    state.imu_gyro[:] = 0.0
    state.imu_quaternion[:] = math.cos(0.1), 0.0, 0.0, math.sin(0.1)
    for _ in range(2500):
        controller.update(state)
        state.cycle += 1
    rotation = controller._observer.rotation
    assert math.atan2(rotation[1, 0], rotation[0, 0]) == pytest.approx(heading, abs=0.005)


def elapsed_of(controller: WalkController) -> float:
    """Return the time since the start of the phase, from the telemetry [s]."""
    widths = dict(TELEMETRY_FIELDS)
    names = [*widths]
    return float(controller.telemetry[sum(widths[name] for name in names[: names.index("elapsed")])])


def pushed(
    dead_zone: float,
    direction: float,
    force: float,
    edge: float = WalkConfig().edge,
    check: Callable[[WalkController, State], None] | None = None,
) -> bool:
    """Push the pelvis for 0.2 s from phase 0.2 of the second step; return whether the robot walks three more steps."""
    lean = LeanConfig() if math.isfinite(dead_zone) else LeanConfig(gain=0.0)
    config = WalkConfig(placement=PlacementConfig(dead_zone=dead_zone), lean=lean, edge=edge)
    controller = WalkController(ROBOT, PATIENT, WALK, 100, config)
    body = make_body("mujoco", urdf(ExoskeletonParameters(), ROBOT, PATIENT), free=True, ground=0.0)
    angle, cycles = math.radians(direction), 0
    try:
        hang(body, controller.standing_pose.tolist(), 0.0005)
        robot = Ideal(body)
        while controller.statistics.steps < 4 and robot.upright():
            robot.cycle(controller)
            if check is not None:
                check(controller, robot.state)
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


@pytest.mark.parametrize(("direction", "force"), [(90.0, 210.0), (270.0, 180.0)], ids=["left", "right"])
def test_robot_withstands_a_push_only_with_foot_placement_step_timing_and_lean(direction: float, force: float) -> None:
    assert pushed(PlacementConfig().dead_zone, direction, force)
    assert not pushed(math.inf, direction, force)


def test_ankle_of_a_pushed_robot_keeps_the_centre_of_pressure_within_the_sole() -> None:
    foot, arms = ExoskeletonParameters(), list[float]()

    def store_arm(controller: WalkController, state: State) -> None:
        if controller.phase is Phase.STEP and elapsed_of(controller) > 0.1:
            stance = controller._stance
            force = float(state.foot_force[stance, :, 2].sum())
            if force > 1000.0:
                arms.append(float(controller._command.torque[6 * stance + 4]) / force)

    edge = 0.06  # so large that the push moves the centre of pressure to the limit
    pushed(PlacementConfig().dead_zone, 180.0, 200.0, edge, store_arm)
    heel = foot.sole_centre[0] - 0.5 * foot.sole_size[0] + foot.pad_radius
    assert heel + edge - 0.01 <= min(arms) < heel + edge


@pytest.mark.parametrize("foot", [0, 1])
def test_robot_makes_a_stop_step_without_the_data_of_a_foot(foot: int) -> None:
    controller, phases = walked("mujoco", 100, finish_after=1, lost_foot=foot)
    assert phases[-3:] == [Phase.STOP, Phase.BACK, Phase.REST]
    assert controller.max_dcm_error < 0.05


def test_finish_step_ends_the_walk_with_a_stop_step() -> None:
    controller, phases = walked("mujoco", 100, finish_after=1)
    assert phases[-3:] == [Phase.STOP, Phase.BACK, Phase.REST]
    assert controller.statistics.steps <= 2


@pytest.mark.parametrize("xi", [0.0, 0.5])
def test_swing_leg_stays_inside_the_certified_guide(xi: float) -> None:
    controller, phases = walked("mujoco", 3, xi=xi)
    guide = controller.statistics.guide
    assert phases == list(Phase)
    assert controller.certificate(xi).certified
    assert guide.factors == {xi}
    assert 3 * 600 < guide.cycles < 3 * 850
    # The joints stay inside although this robot has no friction and the controller compensates friction.
    assert guide.inside == guide.cycles
    assert 0.02 < guide.active_fraction < 1.0


def test_guide_does_not_act_at_full_assistance() -> None:
    controller, _ = walked("mujoco", 1)
    assert controller.statistics.guide.cycles == 0
    assert not controller.certificate(1.0).certified

"""Comparison of motion and sent torque: faulty motors, external torques, end stops, several deviations, missing values."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from atalante_hal.leg_model import LegModel
from atalante_hal.robot import CELLS, FEET, IMUS, JOINTS, LEG_JOINTS, SIDES, load_robot
from atalante_hal.safety.diagnostics import Dtc, Finding
from atalante_hal.safety.leg_torques import SPAN
from atalante_hal.safety.torque_motion import BAND, TorqueMotion
from atalante_hal.types import PERIOD, State, SupervisorState

ROBOT = load_robot()
KNEE, HIP = JOINTS.index("left_SK"), JOINTS.index("left_SH")
FAULT = 200  # first cycle of the fault
CYCLES = 600
#: In this model, links have no mass, and the torque of a motor is its viscous friction: 1 mrad/s is a torque of 1 Nm.
VISCOUS = 1000.0
LEGS = LegModel(
    offset=np.zeros((2, 6, 3)),
    turn=np.tile(np.array([np.eye(3), np.zeros((3, 3)), np.zeros((3, 3))]), (2, 6, 1, 1, 1)),
    axis=np.tile([0.0, 1.0, 0.0], (2, 6, 1)),
    mass=np.zeros((2, 6)),
    centre=np.zeros((2, 6, 3)),
    inertia=np.zeros((2, 6, 3, 3)),
    cell=np.zeros((2, len(CELLS), 3)),
    dry=np.zeros((2, 6)),
    viscous=np.full((2, 6), VISCOUS),
    friction_speed=0.05,
)


class Robot:
    """State of a robot whose motors produce given torques.

    Attributes:
        state: state of the HAL.
        sent: torques sent in the last cycle, shape (12,) [Nm].
        check: check under test.
    """

    def __init__(self) -> None:
        self.sent = np.zeros(len(JOINTS))
        zero = np.zeros(len(JOINTS))
        middle = 0.5 * (ROBOT.position_min + ROBOT.position_max)
        self.state = State(
            cycle=0, time=0.0, supervisor=SupervisorState.ACTIVE, assistance_factor=1.0,
            position=middle, velocity=zero, torque=zero, temperature=zero, drive_state=zero,
            imu_quaternion=np.zeros((len(IMUS), 4)), imu_gyro=np.zeros((len(IMUS), 3)), imu_accel=np.zeros((len(IMUS), 3)),
            foot_force=np.zeros((len(FEET), len(CELLS), 3)), vibration=np.zeros(8),
            valid=np.ones(len(JOINTS), np.bool_), age=np.zeros(len(JOINTS), np.int64), joints_valid=True,
        )  # fmt: skip
        self.check = TorqueMotion(ROBOT, LEGS, self.state, self.sent, np.arange(len(JOINTS)))
        self.noise = np.random.default_rng(0)

    def run(self, sent: np.ndarray, produced: np.ndarray) -> tuple[Finding, ...]:
        """Run one cycle. The motion continues with the produced torque.

        Args:
            sent: torques sent in this cycle [Nm].
            produced: torques that the motors produce in this cycle [Nm].
        """
        self.sent[:] = sent
        self.state.position[:] += produced / VISCOUS * PERIOD
        self.state.imu_accel[:] = self.noise.standard_normal(self.state.imu_accel.shape)
        self.state.foot_force[:] = 1e-9 * self.noise.standard_normal(self.state.foot_force.shape)
        return self.check.check()


Torque = Callable[[int], float]


def found(produced: Callable[[int, float], float], sent: Torque, joint: int = KNEE, cycles: int = CYCLES) -> int | None:
    """Return the number of cycles from `FAULT` to the first finding, which must be about the joint; None without a finding.

    Args:
        produced: torque that the motor produces, a function of the cycle and the sent torque [Nm].
        sent: sent torque of a cycle [Nm]; all other joints get no torque.
        joint: index in `JOINTS`.
        cycles: number of cycles.
    """
    robot, torque, motor = Robot(), np.zeros(len(JOINTS)), np.zeros(len(JOINTS))
    for cycle in range(cycles):
        torque[joint] = sent(cycle)
        motor[joint] = produced(cycle, torque[joint])
        if findings := robot.run(torque, motor):
            assert [finding.node for finding in findings] == [JOINTS[joint].upper()]
            return cycle - FAULT + 1
    return None


def growing(joint: int = KNEE, rate: float = 0.5) -> Torque:
    """Return a torque that grows after the fault, as a controller without its motor would request."""
    unit = float(ROBOT.torque_error[joint])
    return lambda cycle: unit * (5.0 + rate * max(cycle - FAULT, 0))


def swinging(size: float = 12.0) -> Torque:
    """Return a torque that swings as in a walk, relative to the error of the computed torque of the knee."""
    return lambda cycle: float(size * ROBOT.torque_error[KNEE] * np.sin(2.0 * np.pi * cycle / 300.0))


@pytest.mark.parametrize("joint", range(len(JOINTS)))
@pytest.mark.parametrize(("share", "bound"), [(-1.0, 45), (0.0, 60), (0.4, 100)])
def test_motor_that_produces_a_share_of_its_torque_is_found(joint: int, share: float, bound: int) -> None:
    cycles = found(lambda cycle, sent: sent if cycle < FAULT else share * sent, growing(joint), joint)
    assert cycles is not None
    assert 0 < cycles <= bound


def test_strong_motor_is_found_if_its_torque_changes() -> None:
    assert found(lambda cycle, sent: sent if cycle < FAULT else 1.8 * sent, growing()) is not None


@pytest.mark.parametrize("share", [0.85, 1.0, 1.15])
def test_motor_with_a_small_error_is_not_found(share: float) -> None:
    for sent in (growing(), swinging(), swinging(30.0)):
        assert found(lambda _, sent: share * sent, sent) is None


def test_dead_motor_is_not_found_while_its_torque_is_constant() -> None:
    assert found(lambda cycle, sent: sent if cycle < FAULT else 0.0, lambda _: 50.0) is None


@pytest.mark.exhaustive
@pytest.mark.parametrize("torque", [-200.0, -40.0, -10.0, 10.0, 40.0, 200.0])
@pytest.mark.parametrize("ends", [FAULT + 60, FAULT + 200, CYCLES])
def test_constant_external_torque_is_not_found(torque: float, ends: int) -> None:
    for sent in (growing(), swinging()):
        assert found(lambda cycle, t: t + (torque if FAULT <= cycle < ends else 0.0), sent) is None


@pytest.mark.parametrize("push", [-100.0, 100.0])
def test_controller_that_resists_an_external_torque_is_not_found(push: float) -> None:
    def sent(cycle: int) -> float:
        return 10.0 - push * (1.0 - np.exp(-(cycle - FAULT) / 40.0)) if cycle >= FAULT else 10.0

    assert found(lambda cycle, t: t + (push if cycle >= FAULT else 0.0), sent) is None


@pytest.mark.parametrize("other", [HIP, JOINTS.index("left_HA")])
def test_deviations_of_two_joints_of_a_leg_are_not_found(other: int) -> None:
    robot, torque, motor = Robot(), np.zeros(len(JOINTS)), np.zeros(len(JOINTS))
    for cycle in range(CYCLES):
        torque[KNEE] = growing()(cycle)
        motor[KNEE] = torque[KNEE] if cycle < FAULT else 0.0
        motor[other] = 0.0 if cycle < FAULT else 6.0 * ROBOT.torque_error[other]
        assert robot.run(torque, motor) == ()


def test_motors_of_both_legs_are_found() -> None:
    robot, torque, motor = Robot(), np.zeros(len(JOINTS)), np.zeros(len(JOINTS))
    joints = [KNEE, KNEE + len(LEG_JOINTS)]
    nodes: set[str] = set()
    for cycle in range(FAULT + 100):
        torque[joints] = growing()(cycle)
        motor[joints] = torque[joints] if cycle < FAULT else 0.0
        nodes.update(finding.node for finding in robot.run(torque, motor))
    assert nodes == {f"{side.upper()}_SK" for side in SIDES}


@pytest.mark.parametrize(("stop", "sign"), [("min", 1.0), ("max", -1.0)])
@pytest.mark.parametrize("into", [True, False])
def test_joint_at_its_end_stop_may_be_held_by_the_stop(stop: str, sign: float, into: bool) -> None:
    """A torque into the stop moves nothing. A torque away from the stop must move the joint."""
    robot, torque, motor = Robot(), np.zeros(len(JOINTS)), np.zeros(len(JOINTS))
    edge = getattr(ROBOT, f"position_{stop}")[KNEE]
    robot.state.position[KNEE] = edge
    found = False
    for cycle in range(CYCLES):
        torque[KNEE] = (-sign if into else sign) * growing()(cycle)
        found |= bool(robot.run(torque, motor))
    assert found is not into


@pytest.mark.parametrize("row", [0, KNEE])
def test_lost_frames_of_the_leg_delay_the_check(row: int) -> None:
    robot, torque, motor = Robot(), np.zeros(len(JOINTS)), np.zeros(len(JOINTS))
    for cycle in range(FAULT + 100):
        robot.state.age[row] = cycle % 7
        torque[KNEE] = growing()(cycle)
        motor[KNEE] = torque[KNEE] if cycle < FAULT else 0.0
        assert robot.run(torque, motor) == ()


def test_restart_forgets_all_values() -> None:
    robot, torque, motor = Robot(), np.zeros(len(JOINTS)), np.zeros(len(JOINTS))
    for cycle in range(CYCLES):
        torque[KNEE] = growing()(cycle)
        motor[KNEE] = torque[KNEE] if cycle < FAULT else 0.0
        if cycle % (2 * SPAN) == 0:
            robot.check.restart()
        assert robot.run(torque, motor) == ()


def test_deviation_within_the_band_is_not_found() -> None:
    least = 0.9 * BAND * ROBOT.torque_error[KNEE]
    small: Torque = lambda cycle: 0.0 if cycle < FAULT else min(least, 0.1 * (cycle - FAULT))  # noqa: E731
    assert found(lambda _, __: 0.0, small) is None


def test_finding_names_joint_and_share() -> None:
    robot, torque, motor = Robot(), np.zeros(len(JOINTS)), np.zeros(len(JOINTS))
    findings: tuple[Finding, ...] = ()
    cycle = 0
    while not findings:
        torque[KNEE] = growing()(cycle)
        motor[KNEE] = torque[KNEE] if cycle < FAULT else -torque[KNEE]
        findings = robot.run(torque, motor)
        cycle += 1
    (finding,) = findings
    assert finding.dtc is Dtc.TORQUE_MOTION
    assert finding.confirmed
    assert finding.value == pytest.approx(-1.0, abs=0.1)
    text = "the motion of left_SK must agree with the torque that was sent, got a motion as with "
    assert finding.text == f"{text}{finding.value:.2f} times this torque"

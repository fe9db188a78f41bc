"""Checks at rest: each force cell and each IMU is compared with weight and gravity before START."""

from __future__ import annotations

import math

import numpy as np
import pytest
from simulated_robot import PERIOD, ROBOT, SimulatedRobot, cells, imus, only, row, signals, signs

from atalante_control.model import ExoskeletonParameters
from atalante_control.model.patient import MASS_RANGE
from atalante_hal.robot import CELLS, FEET, IMUS
from atalante_hal.safety.diagnostics import Dtc
from atalante_hal.safety.plausibility import Finding
from atalante_hal.safety.plausibility.at_rest import (
    FAULTY_BLOCKS,
    GRAVITY,
    MASS_MAX,
    SAMPLES,
    SETTLING_CYCLES,
    AtRest,
    foot_fault,
    imu_fault,
    relative,
    rigid_fault,
    turn_rate,
    vertical,
)
from atalante_hal.safety.plausibility.finding import Ages
from atalante_hal.types import SupervisorState
from atalante_hal.wire.cia402 import DriveState
from atalante_hal.wire.process_image import NEVER

S = SupervisorState
NODES = {*(f"IMU_{imu.upper()}" for imu in IMUS), *(f"FOOT_{foot.upper()}" for foot in FEET)}
LEVEL = [1.0, 0.0, 0.0, 0.0]
UP = [0.0, 0.0, GRAVITY]
STILL = [0.0, 0.0, 0.0]


def turned(axis: int, degrees: float) -> list[float]:
    """Return the attitude after a rotation about one axis."""
    half = math.radians(degrees) / 2.0
    attitude = [math.cos(half), 0.0, 0.0, 0.0]
    attitude[1 + axis] = math.sin(half)
    return attitude


class Resting:
    """The checks at rest, called directly in every cycle, with a robot that stands level and has no load."""

    def __init__(self, supervisor: SupervisorState = S.OFF) -> None:
        self.now = signals()
        self.now.quaternion[:], self.now.accel[:] = LEVEL, UP
        self.drive_state = np.full(12, float(DriveState.SWITCH_ON_DISABLED))
        self.checks = AtRest(ROBOT, self.now, self.drive_state, 1, PERIOD)
        self.checks.supervisor = supervisor

    def block(self, count: int = 1) -> bool:
        return [self.checks.sample(None) for _ in range(count * SAMPLES)][-1]

    def blocks(self) -> bool:
        """Run the blocks after which a faulty sensor is reported."""
        assert self.block(FAULTY_BLOCKS - 1) == bool(self.checks.findings())
        return self.block()

    def finding(self) -> Finding:
        return only(self.checks.findings())


class TestDisturbed:
    def test_sensor_is_not_checked_until_the_robot_has_settled_after_a_start(self):
        resting = Resting(S.READY)
        resting.block()
        resting.checks.disturb()
        resting.now.accel[:] = STILL
        for _ in range(SETTLING_CYCLES + FAULTY_BLOCKS * SAMPLES - 1):
            assert not resting.checks.sample(None)
        assert resting.checks.sample(None)

    def test_start_does_not_remove_a_finding(self):
        resting = Resting(S.HOLD)
        resting.now.accel[0] = STILL
        assert resting.blocks()
        resting.checks.disturb()
        assert resting.checks.sample(None)
        assert resting.finding().node == "IMU_TORSO"


class TestBlocks:
    def test_each_sensor_is_unchecked_until_its_first_block_is_complete(self):
        resting = Resting()
        assert resting.checks.unchecked == NODES
        for _ in range(SAMPLES - 1):
            assert not resting.checks.sample(None)
        assert resting.checks.unchecked == NODES
        assert not resting.checks.sample(None)
        assert resting.checks.unchecked == set()
        assert resting.checks.findings() == ()

    @pytest.mark.parametrize("missing", sorted(NODES))
    def test_sensor_without_usable_values_begins_a_new_block(self, missing: str):
        resting = Resting()
        order = [*(f"IMU_{imu.upper()}" for imu in IMUS), *(f"FOOT_{foot.upper()}" for foot in FEET)]
        age = np.array([NEVER if node == missing else NEVER - 1 for node in order])
        ages = Ages(np.zeros(12, np.int64), age[: len(IMUS)], age[len(IMUS) :])
        for cycle in range(SAMPLES):
            assert not resting.checks.sample(ages if cycle == 1 else None)
        assert resting.checks.unchecked == {missing}
        resting.checks.sample(None)
        assert resting.checks.unchecked == {missing}
        resting.checks.sample(None)
        assert resting.checks.unchecked == set()

    @pytest.mark.parametrize("node", sorted(NODES))
    def test_restarted_node_is_checked_again_from_its_first_sample(self, node: str):
        resting = Resting()
        resting.block()
        resting.checks.sample(None)
        resting.checks.forget("LEFT_SK")
        assert resting.checks.unchecked == set()
        resting.checks.forget(node)
        for _ in range(SAMPLES - 1):
            resting.checks.sample(None)
            assert resting.checks.unchecked == {node}
        resting.checks.sample(None)
        assert resting.checks.unchecked == set()

    @pytest.mark.parametrize("moving", [S.ACTIVE, S.FULL_ASSIST, S.FINISH_STEP])
    def test_moving_robot_is_not_checked_until_it_has_settled(self, moving: SupervisorState):
        resting = Resting()
        resting.now.accel[2] = 0.0
        assert resting.blocks()
        resting.block()
        resting.checks.sample(None)
        resting.checks.enter(moving)
        assert not any(resting.checks.sample(None) for _ in range(2 * SETTLING_CYCLES))
        assert resting.checks.findings() == ()
        resting.checks.enter(S.HOLD)
        assert not any(resting.checks.sample(None) for _ in range(SETTLING_CYCLES))
        until = FAULTY_BLOCKS * SAMPLES
        assert [resting.checks.sample(None) for _ in range(until)] == [False] * (until - 1) + [True]
        resting.checks.enter(S.LOWER)  # the robot did not move
        assert resting.checks.sample(None)

    def test_settling_time_is_counted_in_cycles(self):
        resting = Resting()
        resting.checks = AtRest(ROBOT, resting.now, resting.drive_state, 3, PERIOD)
        resting.checks.enter(S.ACTIVE)
        resting.checks.enter(S.HOLD)
        calls = math.ceil(SETTLING_CYCLES / 3) + FAULTY_BLOCKS * SAMPLES
        resting.now.accel[:] = 0.0
        assert [resting.checks.sample(None) for _ in range(calls)] == [False] * (calls - 1) + [True]

    def test_vibration_of_500_hz_has_no_effect(self):
        robot = SimulatedRobot(amplitude=0.0, supervisor=S.READY)

        def vibrate(now) -> None:
            now.accel[:, 0] += 9.0 if robot.cycles % 2 else -9.0

        for _ in range(300):
            assert robot.cycle(vibrate) == ()

    @imus
    def test_mean_of_the_block_is_compared(self, imu: int):
        resting = Resting()
        for _ in range(2):
            for cycle in range(SAMPLES):
                resting.now.accel[imu] = [0.0, 0.0, GRAVITY + (1.9 if cycle % 2 else -1.9) + 1.0]
                resting.now.gyro[imu] = [0.0, 2.0 if cycle % 2 else -2.0, 0.09]
                assert not resting.checks.sample(None)
        resting.now.gyro[imu] = [0.0, 0.0, 0.11]
        resting.now.accel[imu] = UP
        assert resting.blocks()
        resting.now.gyro[imu] = 0.0
        assert not resting.block()

    @cells
    def test_mean_force_of_the_block_is_compared(self, foot: int, cell: int):
        resting, free = Resting(), ROBOT.sensors.cell_free
        for _ in range(2):
            for cycle in range(SAMPLES):
                resting.now.force[foot, cell, 2] = free * (3.9 if cycle % 4 == 0 else 0.0)
                assert not resting.checks.sample(None)
        resting.now.force[foot, cell, 2] = 1.01 * free
        assert resting.blocks()
        resting.now.force[foot, cell, 2] = free
        assert not resting.block()


class TestImus:
    @imus
    def test_faulty_imu_is_reported_with_its_node(self, imu: int):
        resting = Resting()
        node = f"IMU_{IMUS[imu].upper()}"
        for _ in range(3):  # a single implausible block is no fault, but it is no check either
            resting.checks.forget(node)
            resting.now.accel[imu] = [0.0, 0.0, -GRAVITY]
            assert not resting.block()
            assert node in resting.checks.unchecked
            resting.now.accel[imu] = UP
            assert not resting.block()
            assert resting.checks.unchecked == set()
        resting.now.accel[imu] = [0.0, 0.0, -GRAVITY]
        assert resting.blocks()
        text = f"the accelerometer of the {IMUS[imu]} IMU contradicts its attitude by 180 degrees at rest"
        assert resting.finding() == Finding(Dtc.IMU_IMPLAUSIBLE, node, pytest.approx(math.pi), True, text)
        assert resting.checks.unchecked == set()
        resting.now.accel[imu] = UP
        assert not resting.block()
        assert resting.checks.findings() == ()

    @imus
    def test_block_is_discarded_while_the_imu_turns_fast(self, imu: int):
        resting = Resting()

        def block(rate: float, gyro: float) -> bool:
            for sample in range(SAMPLES):
                resting.now.quaternion[:] = LEVEL
                resting.now.quaternion[imu] = turned(1, math.degrees(rate * sample * PERIOD))
                resting.now.gyro[imu] = [0.0, gyro, 0.0]
                found = resting.checks.sample(None)
            return found

        assert not block(0.52, 5.0)
        assert resting.checks.unchecked == {f"IMU_{IMUS[imu].upper()}"}
        assert not block(0.48, 0.48)
        assert resting.checks.unchecked == set()
        assert not block(0.48, -0.48)
        assert not block(0.52, 0.0)  # a discarded block does not interrupt a series of faulty blocks
        assert block(0.48, -0.48)
        assert resting.finding().value == pytest.approx(0.96, abs=0.001)
        assert block(0.52, 0.0)  # the finding remains until the next block at rest
        assert not block(0.0, 0.0)

    @pytest.mark.parametrize("imu", ["torso", "pelvis"])
    @pytest.mark.parametrize("axis", range(3))
    @pytest.mark.parametrize("later", [None, "torso", "pelvis"])
    def test_turned_mount_of_torso_or_pelvis_is_reported(self, imu: str, axis: int, later: str | None):
        resting, i = Resting(), IMUS.index(imu)
        resting.now.quaternion[i] = turned(axis, 90.0)
        resting.now.accel[i] = GRAVITY * np.array(vertical(turned(axis, 90.0)))
        resting.block()
        if later is not None:
            resting.checks.sample(None)
            resting.checks.forget(f"IMU_{later.upper()}")
        resting.block(FAULTY_BLOCKS)
        finding = resting.checks.findings()[-1]
        assert {f.node for f in resting.checks.findings()} <= {"IMU_TORSO", "IMU_PELVIS"}
        assert finding.dtc is Dtc.IMU_IMPLAUSIBLE
        assert f"differ by {81 if axis < 2 else 90} degrees in {'tilt' if axis < 2 else 'heading'}" in finding.text
        assert not resting.checks.unchecked

    @pytest.mark.parametrize(("imu", "other"), [("torso", "pelvis"), ("pelvis", "torso")])
    def test_torso_and_pelvis_are_not_compared_while_one_is_unchecked(self, imu: str, other: str):
        resting = Resting()
        resting.block()
        resting.checks.forget(f"IMU_{other.upper()}")
        resting.now.quaternion[IMUS.index(other)] = turned(0, 30.0)
        resting.now.accel[IMUS.index(other)] = 0.0
        resting.block()
        assert f"IMU_{imu.upper()}" not in resting.checks.unchecked
        assert resting.checks.unchecked == {f"IMU_{other.upper()}"}
        resting.block()
        assert resting.finding().text.startswith(f"the accelerometer of the {other} IMU")

    def test_exchanged_imus_of_torso_and_pelvis_have_equal_readings(self):
        robot = SimulatedRobot(amplitude=0.0, supervisor=S.READY)
        torso, pelvis = IMUS.index("torso"), IMUS.index("pelvis")
        assert robot.attitudes[torso] == pytest.approx(robot.attitudes[pelvis], abs=1e-12)


def test_healthy_robot_at_rest_has_no_findings_and_all_sensors_are_checked():
    for supervisor in (S.OFF, S.READY, S.HOLD, S.LOWER, S.FAULT):
        robot = SimulatedRobot(amplitude=0.0, supervisor=supervisor)
        for _ in range(300):
            assert robot.cycle() == ()
        assert robot.checks.at_rest.unchecked == set()


def test_finding_at_rest_is_reported_within_192_cycles():
    robot = SimulatedRobot(amplitude=0.0, supervisor=S.READY)
    robot.run(50)
    robot.until_found(Dtc.FOOT_CELL, 192, lambda now: now.force[0, :, 2].__iadd__(200.0))
    robot.run(128)
    assert robot.checks.findings == ()
    robot.until_found(Dtc.IMU_IMPLAUSIBLE, 192, lambda now: now.accel[2].__imul__(-1.0))


def test_node_restart_requires_a_new_check():
    robot = SimulatedRobot(amplitude=0.0, supervisor=S.READY)
    robot.run(200)
    robot.checks.reference("FOOT_LEFT")
    assert robot.checks.at_rest.unchecked == {"FOOT_LEFT"}
    robot.missing = {row("FOOT_LEFT")}
    robot.run(200)
    assert robot.checks.at_rest.unchecked == {"FOOT_LEFT"}
    robot.missing = set()
    robot.run(100)
    assert robot.checks.at_rest.unchecked == set()


class TestFeet:
    @cells
    @signs
    def test_offset_of_a_cell_is_reported_while_the_drives_are_off(self, foot: int, cell: int, sign: float):
        for supervisor in (S.OFF, S.READY):
            resting = Resting(supervisor)
            resting.now.force[foot, cell, 2] = sign * 200.0
            assert resting.blocks()
            text = (
                f"force cell {CELLS[cell]} of the {FEET[foot]} foot reports {sign * 200:.0f} N while all drives are off; must be "
                "within 60 N, because the robot is suspended before START"
            )
            node = f"FOOT_{FEET[foot].upper()}"
            assert resting.finding() == Finding(Dtc.FOOT_CELL, node, sign * 200.0, True, text)

    @pytest.mark.parametrize("supervisor", [S.HOLD, S.LOWER, S.FAULT])
    def test_robot_may_stand_after_the_first_start(self, supervisor: SupervisorState):
        resting = Resting(supervisor)
        resting.now.force[:, :, 2] = 200.0
        assert not resting.block(3)

    @pytest.mark.parametrize("state", [DriveState.QUICK_STOP_ACTIVE, DriveState.OPERATION_ENABLED])
    def test_robot_may_stand_before_the_first_start_if_a_drive_holds(self, state: DriveState):
        resting = Resting()
        resting.now.force[:, :, 2] = 200.0
        resting.drive_state[7] = state
        assert not resting.block(3)

    def test_load_above_the_largest_weight_is_reported(self):
        resting = Resting(S.HOLD)
        resting.now.force[0, :, 2] = 200.0
        resting.now.force[1, :, 2] = 319.0
        assert not resting.block(3)
        resting.now.force[1, :, 2] = 325.0
        assert resting.blocks()
        assert "both feet report 2100 N at rest; must be at most 2077 N" in resting.checks.findings()[-1].text

    def test_largest_mass_is_that_of_exoskeleton_and_heaviest_patient(self):
        model = ExoskeletonParameters()
        leg = sum(
            getattr(model, f"{name}_mass")
            for name in ("frontal_hip", "transverse_hip", "thigh", "shank", "ankle", "foot")
        )
        assert model.pelvis_mass + 2.0 * leg + MASS_RANGE[1] == pytest.approx(MASS_MAX)


class TestPureFunctions:
    @pytest.mark.parametrize("axis", range(3))
    @pytest.mark.parametrize("rate", [0.3, -0.3])
    @pytest.mark.parametrize("base", [LEVEL, turned(0, 50.0), turned(1, -120.0), [-x for x in turned(2, 70.0)]])
    def test_turn_rate_is_the_angular_velocity_in_the_sensor_frame(self, axis: int, rate: float, base: list[float]):
        after = relative([base[0], *(-x for x in base[1:])], turned(axis, math.degrees(rate * 0.06)))
        expected = [rate if a == axis else 0.0 for a in range(3)]
        assert turn_rate(base, after, 0.06) == pytest.approx(expected, abs=1e-4)
        assert turn_rate(base, [-x for x in after], 0.06) == pytest.approx(expected, abs=1e-4)

    @pytest.mark.parametrize(
        ("attitude", "up"),
        [(LEVEL, [0, 0, 1]), (turned(0, 90.0), [0, 1, 0]), (turned(1, 90.0), [-1, 0, 0]), (turned(2, 90.0), [0, 0, 1])],
    )
    def test_vertical_is_the_upward_direction_in_the_sensor_frame(self, attitude: list[float], up: list[int]):
        assert vertical(attitude) == pytest.approx(up)

    @pytest.mark.parametrize(
        ("attitude", "turn", "gyro", "accel", "value", "text"),
        [
            (LEVEL, STILL, STILL, UP, 0.0, ""),
            (LEVEL, STILL, STILL, [0, 0, GRAVITY + 1.99], 0.0, ""),
            (LEVEL, STILL, STILL, [0, 0, GRAVITY - 1.99], 0.0, ""),
            (LEVEL, STILL, STILL, [0, 0, 11.82], 11.82, "accelerometer of the x IMU must report 9.8 +- 2 m/s2 at rest, got 11.8"),
            (LEVEL, STILL, STILL, [0, 0, 7.8], 7.8, "got 7.8 m/s2"),
            (LEVEL, STILL, STILL, [math.nan, 0, 9.8], math.nan, "got nan m/s2"),
            (LEVEL, STILL, STILL, [0, math.sin(0.19) * 9.81, math.cos(0.19) * 9.81], 0.19, ""),
            (LEVEL, STILL, STILL, [-math.sin(0.21) * 9.81, 0, math.cos(0.21) * 9.81], 0.21, "attitude by 12 degrees at rest"),
            (turned(0, 90.0), STILL, STILL, UP, math.pi / 2, "accelerometer of the x IMU contradicts its attitude by 90"),
            (turned(0, 90.0), STILL, STILL, [0, GRAVITY, 0], 0.0, ""),
            (LEVEL, [0.3, 0, 0], [0.3, 0.09, 0], UP, 0.0, ""),
            (LEVEL, [0.3, 0, 0], [0.3, 0.11, 0], UP, 0.11, "gyroscope of the x IMU contradicts the change of its attitude"),
            (LEVEL, [0, 0.06, 0], [0, -0.06, 0], UP, 0.12, "by 0.12 rad/s at rest"),
        ],
    )  # fmt: skip
    def test_imu_is_compared_with_gravity_and_its_attitude(self, attitude, turn, gyro, accel, value: float, text: str):
        found, said = imu_fault("x", attitude, turn, gyro, accel)
        assert found == pytest.approx(value, abs=1e-6, nan_ok=True)
        assert (text in said) if text else not said

    @pytest.mark.parametrize("axis", range(3))
    @pytest.mark.parametrize(
        ("degrees", "tilted", "headed"), [(3.0, False, False), (-4.0, True, False), (90.0, True, True)]
    )
    def test_torso_and_pelvis_have_equal_attitudes(self, axis: int, degrees: float, tilted: bool, headed: bool):
        for base in (LEVEL, turned(1, 20.0)):
            other = relative([base[0], *(-x for x in base[1:])], turned(axis, degrees))
            for torso, pelvis in ((other, base), (base, other), ([-x for x in other], base)):
                _, text = rigid_fault(torso, pelvis, 0.06)
                assert bool(text) == (tilted if axis < 2 else headed)

    @pytest.mark.parametrize(
        ("degrees", "found"), [(57.0, False), (58.0, True), (180.0, True), (302.0, True), (303.0, False)]
    )
    def test_heading_may_drift_by_one_radian(self, degrees: float, found: bool):
        value, text = rigid_fault(turned(2, degrees), LEVEL, 0.06)
        assert text == (
            f"the torso IMU and the pelvis IMU differ by {min(degrees, 360 - degrees):.0f} degrees in heading; must be within 57 "
            "degrees, because their body is rigid"
            if found
            else ""
        )
        assert value == pytest.approx(math.radians(min(degrees, 360.0 - degrees)) if found else 0.0)

    @pytest.mark.parametrize(
        ("forces", "total", "free", "value", "text"),
        [
            ([60.0, -60.0, 0.0, 0.0], 0.0, 60.0, 0.0, ""),
            (
                [0.0, 10.0, -61.0, 0.0],
                0.0,
                60.0,
                -61.0,
                "force cell RL of the x foot reports -61 N while all drives are off",
            ),
            ([900.0, 900.0, 100.0, 100.0], 2077.0, math.inf, 2077.0, ""),
            (
                [900.0, 900.0, 100.0, 100.0],
                2078.0,
                math.inf,
                2078.0,
                "feet report 2078 N at rest; must be at most 2077 N",
            ),
        ],
    )
    def test_feet_are_compared_with_the_possible_load(self, forces, total: float, free: float, value, text: str):
        assert foot_fault("x", forces, total, free)[0] == value
        said = foot_fault("x", forces, total, free)[1]
        assert (text in said) if text else not said

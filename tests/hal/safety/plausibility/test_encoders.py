"""Encoder checks: each position beyond reach or range and each wrong velocity is reported within its bound."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from simulated_robot import (
    CODEC,
    GEAR,
    MESSAGES,
    MIDDLE,
    PERIOD,
    REACH,
    ROBOT,
    SimulatedRobot,
    joints,
    only,
    row,
    signals,
    signs,
)

from atalante_hal.robot import JOINTS
from atalante_hal.safety.diagnostics import Dtc, Reaction
from atalante_hal.safety.limiter import Limiter
from atalante_hal.safety.plausibility import Finding, Plausibility
from atalante_hal.safety.plausibility.encoders import JUMPS_TO_CONFIRM, EncoderChecks
from atalante_hal.safety.plausibility.signals import Signals, signals_of
from atalante_hal.wire.e2e import Check
from atalante_hal.wire.process_image import NEVER, ReceiveImage


class Pair:
    """Robot at rest, with one joint at different positions in both legs.

    Attributes:
        positions: position of the joint in the left and in the right leg [rad].
        nodes: drives of both joints.
    """

    def __init__(self, joint: int) -> None:
        self._robot, self._joints = SimulatedRobot(amplitude=0.0), [joint, joint + 6]
        apart = 0.3 * (ROBOT.position_max[joint] - ROBOT.position_min[joint])
        self.positions = (float(MIDDLE[joint] - apart), float(MIDDLE[joint + 6] + apart))
        self.nodes = [JOINTS[joint].upper() for joint in self._joints]
        for node in self.nodes:
            self._robot.checks.reference(node)
        for _ in range(5):
            assert not any(f.dtc is Dtc.ENC_JUMP for f in self.readings(*self.positions))

    def readings(self, left: float, right: float) -> tuple[Finding, ...]:
        """Run one cycle with the given readings of both encoders [rad], and return the findings."""

        def read(now: Signals) -> None:
            now.position[self._joints] = np.array([left, right]) * GEAR[self._joints]

        return self._robot.cycle(read)


class TestEncoderJump:
    @joints
    @signs
    def test_position_beyond_reach_is_rejected_as_jump(self, joint: int, sign: float):
        for size, refused in ((1.0 - 1e-9, False), (1.0 + 1e-9, True)):
            robot = SimulatedRobot(amplitude=0.0)
            robot.run(5)

            def move(now: Signals, size: float = size) -> None:
                now.position[joint] = (MIDDLE[joint] + sign * size * REACH[joint]) * GEAR[joint]
                now.velocity[joint] = 7.0

            found = robot.cycle(move)
            if not refused:
                assert found == ()
                assert not robot.rejected
                assert robot.now.velocity[joint] == 7.0
                continue
            finding = only(found)
            assert (finding.dtc, finding.node) == (Dtc.ENC_JUMP, JOINTS[joint].upper())
            assert not finding.confirmed
            assert finding.value == pytest.approx(REACH[joint])
            assert f"{JOINTS[joint]} jumped by {math.degrees(REACH[joint]):.2f} degrees" in finding.text
            assert robot.rejected == {row(JOINTS[joint]): 1}
            assert robot.now.position[joint] == MIDDLE[joint] * GEAR[joint]
            assert robot.now.velocity[joint] == 0.0
            assert robot.cycle() == ()

    @joints
    @pytest.mark.parametrize("lost", [1, 4])
    def test_reach_grows_with_lost_frames(self, joint: int, lost: int):
        motion, noise = ROBOT.top_speed[joint] * PERIOD, 3.0 * ROBOT.encoder_noise[joint]
        for size, refused in ((-1e-9, False), (1e-9, True)):
            robot = SimulatedRobot(amplitude=0.0)
            robot.missing = {row(JOINTS[joint])}
            assert robot.run(lost) == ()
            robot.missing = set()
            target = (MIDDLE[joint] + (lost + 1) * motion + noise + size) * GEAR[joint]
            found = robot.cycle(lambda now, target=target: now.position.__setitem__(joint, target))
            assert bool(found) is refused
            assert robot.rejected == ({row(JOINTS[joint]): lost + 1} if refused else {})

    @pytest.mark.parametrize(("before", "after", "cycles"), [(3, 3, 1), (3, 0, 4), (0, 2, 1), (4, 2, 3)])
    def test_reach_depends_on_measurement_time_not_on_arrival_time(self, before: int, after: int, cycles: int):
        """The last good values had the age `before` on arrival, the new values the age `after` [cycles].

        The time between the two measurements is `cycles`.
        """
        motion, noise = ROBOT.top_speed[2] * PERIOD, 3.0 * ROBOT.encoder_noise[2]
        for size, refused in ((-1e-9, False), (1e-9, True)):
            robot = SimulatedRobot(amplitude=0.0)
            robot.late = {row("left_SH"): before}
            robot.run(6)
            lost = cycles - 1 - before + after
            robot.missing = {row("left_SH")} if lost else set()
            robot.late = {}
            robot.run(lost)
            robot.missing, robot.late = set(), {row("left_SH"): after}
            target = (MIDDLE[2] + cycles * motion + noise + size) * GEAR[2]
            found = robot.cycle(lambda now, target=target: now.position.__setitem__(2, target))
            assert bool(found) is refused
            robot.late = {}

    def test_fifth_jump_in_a_row_is_confirmed(self):
        robot = SimulatedRobot()

        def away(now: Signals) -> None:
            now.position[3] += 1.0 * GEAR[3]

        assert [only(robot.cycle(away)).confirmed for _ in range(6)] == [False] * 4 + [True] * 2
        assert robot.rejected == {row("left_SK"): 6}
        robot.missing = {row("left_SK")}
        assert only(robot.cycle()).confirmed
        assert robot.rejected == {}
        robot.missing = set()
        assert robot.cycle() == ()
        assert not only(robot.cycle(away)).confirmed

    def test_small_offset_is_accepted_once_within_reach(self):
        robot = SimulatedRobot(amplitude=0.0)
        for cycle in range(1, 7):
            robot.cycle(lambda now: now.position.__setitem__(3, (MIDDLE[3] + 0.018) * GEAR[3]))
            assert bool(robot.rejected) == (cycle * ROBOT.top_speed[3] * PERIOD + 3e-5 < 0.018)

    @joints
    @signs
    @pytest.mark.sample(5)
    def test_permanent_offset_is_never_accepted(self, joint: int, sign: float):
        """The joint is at rest, or moves back to where the jump began. The test lasts longer than this motion."""
        size = 12.0 * REACH[joint]
        for speed in (0.0, 0.5 * ROBOT.top_speed[joint]):
            robot = SimulatedRobot(amplitude=0.0)
            for cycle in range(200):
                at = (MIDDLE[joint] + sign * max(size - speed * PERIOD * cycle, 0.0)) * GEAR[joint]
                found = robot.cycle(lambda now, at=at: now.position.__setitem__(joint, at))
                assert robot.rejected == {row(JOINTS[joint]): cycle + 1}
            finding = next(f for f in found if f.dtc is Dtc.ENC_JUMP)
            assert finding.confirmed
            assert "not used until it jumps back or its drive restarts" in finding.text

    @joints
    @signs
    def test_motion_that_accelerates_beyond_the_top_speed_is_no_jump(self, joint: int, sign: float):
        robot, at = SimulatedRobot(amplitude=0.0), float(MIDDLE[joint])
        seen = []
        for share in (0.3, 0.6, 0.9, 1.05, 1.3, 1.6, 1.2, 0.9, 0.5):
            at += sign * share * ROBOT.top_speed[joint] * PERIOD
            found = robot.cycle(lambda now, at=at: now.position.__setitem__(joint, at * GEAR[joint]))
            assert robot.now.position[joint] == at * GEAR[joint]
            assert not any(f.dtc is Dtc.ENC_JUMP for f in found)
            seen += [f for f in found if f.dtc is Dtc.OVERSPEED]
        assert [f.confirmed for f in seen] == [False, True, True, True]
        assert {f.node for f in seen} == {JOINTS[joint].upper()}
        top = ROBOT.top_speed[joint]
        assert [f.value / (sign * top) for f in seen] == pytest.approx([1.05, 1.3, 1.6, 1.2])
        assert seen[1].text == (
            f"the speed of {JOINTS[joint]} must be at most {math.degrees(top):.0f} deg/s, "
            f"got {math.degrees(sign * 1.3 * top):+.0f} deg/s"
        )

    def test_overspeed_is_measured_over_lost_frames(self):
        robot, step = SimulatedRobot(amplitude=0.0), ROBOT.top_speed[3] * PERIOD
        robot.cycle(lambda now: now.position.__setitem__(3, (MIDDLE[3] + 0.9 * step) * GEAR[3]))
        robot.missing = {row("left_SK")}
        robot.run(2)
        robot.missing = set()
        found = robot.cycle(lambda now: now.position.__setitem__(3, (MIDDLE[3] + (0.9 + 3 * 1.2) * step) * GEAR[3]))
        finding = next(f for f in found if f.dtc is Dtc.OVERSPEED)
        assert finding.value == pytest.approx(1.2 * ROBOT.top_speed[3])

    @pytest.mark.parametrize(("before", "after"), [(0.4, 1.1), (-0.9, 1.1), (0.9, 2.0)])
    def test_sudden_motion_beyond_the_top_speed_is_a_jump(self, before: float, after: float):
        robot, step = SimulatedRobot(amplitude=0.0), ROBOT.top_speed[3] * PERIOD * GEAR[3]
        at = MIDDLE[3] * GEAR[3] + before * step
        robot.cycle(lambda now: now.position.__setitem__(3, at))
        found = robot.cycle(lambda now: now.position.__setitem__(3, at + after * step))
        assert {f.dtc for f in found} == {Dtc.ENC_JUMP}
        assert robot.now.position[3] == at

    def test_jump_during_an_overspeed_ends_the_overspeed(self):
        robot, step = SimulatedRobot(amplitude=0.0), ROBOT.top_speed[3] * PERIOD * GEAR[3]
        at = MIDDLE[3] * GEAR[3]
        for share in (0.9, 1.1, 1.1):
            at += share * step
            found = robot.cycle(lambda now, at=at: now.position.__setitem__(3, at))
        assert {(f.dtc, f.confirmed) for f in found} == {(Dtc.OVERSPEED, True)}
        found = robot.cycle(lambda now: now.position.__setitem__(3, at + 9.0 * step))
        assert {(f.dtc, f.confirmed) for f in found} == {(Dtc.ENC_JUMP, False)}
        found = robot.cycle(lambda now: now.position.__setitem__(3, at + 10.1 * step))
        assert {(f.dtc, f.confirmed) for f in found} == {(Dtc.ENC_JUMP, False)}

    def test_value_that_is_not_newer_is_no_overspeed(self):
        robot, step = SimulatedRobot(amplitude=0.0), ROBOT.top_speed[3] * PERIOD * GEAR[3]
        at = MIDDLE[3] * GEAR[3] + 0.9 * step
        robot.cycle(lambda now: now.position.__setitem__(3, at))
        robot.late = {row("left_SK"): 1}
        found = robot.cycle(lambda now: now.position.__setitem__(3, at + 1.1 * step))
        assert {f.dtc for f in found} == {Dtc.ENC_JUMP}

    @joints
    @signs
    def test_encoder_is_used_again_after_jumping_back(self, joint: int, sign: float):
        motion = ROBOT.top_speed[joint] * PERIOD
        for left, used in ((0.0, True), (4.9 * motion, True), (6.1 * motion, False)):
            robot = SimulatedRobot(amplitude=0.0)

            def show(gone: float, offset: float, robot: SimulatedRobot = robot) -> tuple[Finding, ...]:
                at = (MIDDLE[joint] + sign * (offset - gone)) * GEAR[joint]
                return robot.cycle(lambda now: now.position.__setitem__(joint, at))

            for cycle in range(40):
                assert any(f.dtc is Dtc.ENC_JUMP for f in show(0.5 * motion * cycle, 30.0 * motion))
            found = show(0.5 * motion * 40, left)
            assert any(f.dtc is Dtc.ENC_JUMP for f in found) is not used
            assert bool(robot.rejected) is not used

    @joints
    def test_drive_restart_accepts_the_next_position_of_only_its_own_encoder(self, joint: int):
        robot = SimulatedRobot(amplitude=0.0)
        away = MIDDLE[joint] + 6.0 * REACH[joint]

        def jump(now: Signals) -> None:
            now.position[joint] = away * GEAR[joint]

        for _ in range(2):
            assert any(f.dtc is Dtc.ENC_JUMP and f.confirmed for f in robot.run(20, jump))
            for node in ("IMU_PELVIS", "PENDANT", JOINTS[(joint + 1) % 12].upper()):
                robot.checks.reference(node)
            assert robot.rejected
            robot.cycle(jump)
            assert robot.rejected
            robot.checks.reference(JOINTS[joint].upper())
            assert Dtc.ENC_JUMP not in {f.dtc for f in robot.cycle(jump)}
            assert not robot.rejected
            away = 2.0 * MIDDLE[joint] - away

    def test_restart_permits_one_jump_of_its_own_joint(self):
        robot = SimulatedRobot(amplitude=0.0)
        robot.run(5)
        robot.checks.reference("LEFT_SK")
        robot.missing = {row("left_FH")}
        assert robot.cycle(lambda now: now.position.__setitem__(3, (MIDDLE[3] + 0.2) * GEAR[3])) == ()
        robot.missing = set()
        assert only(robot.cycle()).node == "LEFT_SK"
        robot = SimulatedRobot(amplitude=0.0)
        robot.run(5)
        robot.checks.reference("LEFT_SK")
        assert only(robot.cycle(lambda now: now.position.__setitem__(4, 0.0))).node == "LEFT_SA"

    def test_two_joints_that_jump_are_both_reported(self):
        robot = SimulatedRobot()
        found = robot.cycle(lambda now: now.position.__setitem__(slice(1, 8, 6), 0.0))
        assert [f.node for f in found] == ["LEFT_TH", "RIGHT_TH"]
        assert robot.rejected == {row("left_TH"): 1, row("right_TH"): 1}

    @pytest.mark.parametrize("joint", range(6), ids=JOINTS[:6])
    def test_exchanged_encoders_are_reported_with_the_fifth_jump(self, joint: int):
        robot = Pair(joint)
        for cycle in range(1, 8):
            found = robot.readings(*robot.positions[::-1])
            exchanged = [f for f in found if f.dtc is Dtc.TORQUE_DIRECTION]
            assert [f.node for f in exchanged] == robot.nodes * (cycle >= 5)
            assert all(f.confirmed and f.dtc.reaction is Reaction.LOWER for f in exchanged)
        assert f"reads the position of {JOINTS[joint + 6]}, and vice versa" in exchanged[0].text
        assert exchanged[0].value == pytest.approx(robot.positions[1] - robot.positions[0])

    @pytest.mark.parametrize(("share", "exchanged"), [(-0.98, 2), (0.98, 2), (-1.02, 0), (1.02, 0)])
    @pytest.mark.parametrize("side", [0, 1])
    def test_exchanged_encoders_read_the_position_of_the_other_leg(self, side: int, share: float, exchanged: int):
        """Between the last good value and the fifth jump, each joint may move as far as it can in five cycles."""
        robot = Pair(3)
        readings = list(robot.positions[::-1])
        readings[side] += share * (JUMPS_TO_CONFIRM * ROBOT.top_speed[3] * PERIOD + 3.0 * ROBOT.encoder_noise[3])
        for _ in range(6):
            found = robot.readings(*readings)
        assert [f.dtc for f in found].count(Dtc.ENC_JUMP) == 2
        assert [f.dtc for f in found].count(Dtc.TORQUE_DIRECTION) == exchanged

    @pytest.mark.parametrize("speed", [-0.95, -0.3, 0.3, 0.95])
    def test_exchange_is_found_while_the_legs_move_fast_in_opposite_directions(self, speed: float):
        robot, moved = Pair(3), speed * ROBOT.top_speed[3] * PERIOD
        left, right = robot.positions
        for cycle in range(1, 20):
            left, right = left + moved, right - moved
            found = robot.readings(*((left, right) if cycle < 5 else (right, left)))
            assert [f.dtc for f in found].count(Dtc.TORQUE_DIRECTION) == 2 * (cycle >= 9)

    def test_one_encoder_that_jumps_to_the_position_of_the_other_leg_is_no_exchange(self):
        robot = Pair(3)
        for _ in range(6):
            found = robot.readings(robot.positions[1], robot.positions[1])
        assert only(found).dtc is Dtc.ENC_JUMP

    def test_jumps_of_two_joints_of_a_leg_are_no_exchange(self):
        robot = SimulatedRobot(amplitude=0.0)
        robot.run(5)

        def away(now: Signals) -> None:
            now.position[[2, 3]] += 0.5 * GEAR[[2, 3]]

        for _ in range(6):
            found = robot.cycle(away)
        assert [f.dtc for f in found] == [Dtc.ENC_JUMP, Dtc.ENC_JUMP]

    def test_first_position_is_no_jump(self):
        image = ReceiveImage(MESSAGES)  # all values are NaN
        checks = Plausibility(ROBOT, image, PERIOD)
        image.values[:100] = SimulatedRobot().image.values[:100]
        image.check.fill(Check.OK)
        image.age.fill(0)
        assert checks.check() == ()
        assert not (image.check == Check.IMPLAUSIBLE).any()

    @joints
    @signs
    def test_motion_that_the_limiter_permits_is_no_jump(self, joint: int, sign: float):
        """The joint oscillates at the speed from which the limiter permits no accelerating torque."""
        limiter, motion = Limiter(ROBOT, PERIOD), np.array([MIDDLE, np.zeros(12)])
        motion[1, joint] = sign * ROBOT.top_speed[joint]
        assert limiter.apply(sign * np.eye(12)[joint], motion).clamped
        assert not limiter.last.any()
        robot, step = SimulatedRobot(amplitude=0.0), sign * ROBOT.top_speed[joint] * PERIOD
        for cycle in range(60):
            away = MIDDLE[joint] + step * (10 - abs(cycle % 20 - 10))
            found = robot.cycle(lambda now, away=away: now.position.__setitem__(joint, away * GEAR[joint]))
            assert Dtc.ENC_JUMP not in {f.dtc for f in found}
            assert not robot.rejected

    def test_fast_motion_of_all_joints_is_accepted(self):
        robot = SimulatedRobot(amplitude=0.0)
        robot.cycle(lambda now: now.position.__iadd__(0.9 * REACH * GEAR))
        assert robot.checks.findings == ()
        assert not robot.rejected


class TestRange:
    tolerance = ROBOT.thresholds.position_tolerance

    @joints
    @pytest.mark.parametrize("end", ["position_min", "position_max"])
    def test_position_beyond_tolerance_is_reported_in_the_same_cycle(self, joint: int, end: str):
        limit, outwards = getattr(ROBOT, end)[joint], 1.0 if end == "position_max" else -1.0
        for size, found in ((1.0 - 1e-9, False), (1.0 + 1e-9, True)):
            angle = limit + outwards * size * self.tolerance
            robot = SimulatedRobot(amplitude=0.0)
            robot.checks.reference(JOINTS[joint].upper())
            findings = robot.cycle(lambda now, angle=angle: now.position.__setitem__(joint, angle * GEAR[joint]))
            assert bool(findings) is found
            assert not robot.rejected
            if not found:
                continue
            finding = only(findings)
            assert (finding.dtc, finding.node, finding.confirmed) == (Dtc.POSITION_RANGE, JOINTS[joint].upper(), True)
            assert finding.value == pytest.approx(angle)
            low, high = (math.degrees(getattr(ROBOT, name)[joint]) for name in ("position_min", "position_max"))
            expected = (
                f"{JOINTS[joint]} is at {math.degrees(angle):.1f} degrees, outside its range of {low:.1f} to {high:.1f}"
            )
            assert expected in finding.text
            inside = (angle - outwards * 2e-9 * self.tolerance) * GEAR[joint]
            robot.missing = {row(JOINTS[joint])}
            assert only(robot.cycle()) is finding
            robot.missing = set()
            for lost in (False, True):
                robot.cycle(lambda now, angle=angle: now.position.__setitem__(joint, angle * GEAR[joint]))
                robot.missing = {row(JOINTS[joint])} if lost else set()
                assert len(robot.run(lost)) == lost
                robot.missing = set()
                assert robot.cycle(lambda now, inside=inside: now.position.__setitem__(joint, inside)) == ()

    def test_first_position_outside_the_range_is_reported(self):
        image = ReceiveImage(MESSAGES)  # all values are NaN
        checks = Plausibility(ROBOT, image, PERIOD)
        image.values[:100] = SimulatedRobot().image.values[:100]
        signals_of(CODEC, image.values).position[4] = 1.0 * GEAR[4]
        image.check.fill(Check.OK)
        image.age.fill(0)
        assert only(checks.check()).text.startswith(
            "left_SA is at 57.3 degrees, outside its range of -16.0 to 9.0 degrees"
        )


class TestVelocity:
    @joints
    @signs
    @pytest.mark.sample(5)
    def test_velocity_error_beyond_threshold_is_reported_within_64_cycles(self, joint: int, sign: float):
        error = ROBOT.sensors.velocity_error
        for phase in (0, 3, 15):
            robot = SimulatedRobot(amplitude=0.0)
            robot.run(40 + phase)

            def off(now: Signals, size: float) -> None:
                now.velocity[joint] = sign * size * error * GEAR[joint]

            assert robot.run(100, lambda now: off(now, 1.0 - 1e-9)) == ()
            robot.run(17)
            assert robot.until_found(Dtc.ENC_VELOCITY, 64, lambda now: off(now, 1.0 + 1e-6)) >= 48
            finding = only(robot.checks.findings)
            assert finding.node == JOINTS[joint].upper()
            assert finding.value == pytest.approx(sign * error, rel=1e-5)
            assert (
                f"velocity of {JOINTS[joint]} differs from its encoder by {math.degrees(sign * error):+.0f} deg/s"
                in finding.text
            )
            assert robot.run(33) == ()

    def test_velocity_noise_without_mean_is_accepted(self):
        robot = SimulatedRobot()
        rng = np.random.default_rng(3)
        jitter = [rng.choice([-0.9, 0.9]) for _ in range(1000)]
        assert robot.run(400, lambda now: now.velocity.__iadd__(jitter[robot.cycles // 16] * GEAR)) == ()

    @pytest.mark.parametrize("lost", ["left_HA", "right_HA", "IMU_torso", "FOOT_left", "pendant"])
    def test_velocity_error_is_found_although_another_frame_is_lost_at_each_sample(self, lost: str):
        robot = SimulatedRobot()
        robot.run(40)

        def wrong(now: Signals) -> None:
            robot.missing = {row(lost)} if robot.cycles % 16 < 4 else set()
            now.velocity[5] = 1000.0

        robot.until_found(Dtc.ENC_VELOCITY, 64, wrong)
        assert only(robot.checks.findings).node == "LEFT_HA"

    def test_velocity_error_needs_three_wrong_comparisons_in_a_row(self):
        """One wrong sample makes two comparisons wrong: with the previous sample and with the next sample."""
        robot = SimulatedRobot(amplitude=0.0)

        def wrong(now: Signals) -> None:
            now.velocity[5] = 10.0 * ROBOT.sensors.velocity_error * GEAR[5]

        for _ in range(4):
            assert [robot.run(16, wrong), robot.run(16), robot.run(16)] == [()] * 3
        robot.until_found(Dtc.ENC_VELOCITY, 48, wrong)

    def test_velocity_that_matches_the_encoder_is_accepted(self):
        robot = SimulatedRobot(amplitude=0.0)

        def turn(now: Signals) -> None:
            now.position[5] += 0.9 * robot.time * GEAR[5]
            now.velocity[5] = 0.9 * GEAR[5]

        assert robot.run(300, turn) == ()

    @pytest.mark.parametrize("lost", [0, 3, 7])
    def test_delay_of_the_low_pass_in_a_fast_oscillation_is_accepted(self, lost: int):
        """An ankle oscillates at 15 Hz and 3.5 rad/s. The drive filters its velocity at 80 Hz. Some frames may be lost."""
        robot = SimulatedRobot(amplitude=0.0)
        keep = math.exp(-2.0 * math.pi * ROBOT.sensors.velocity_bandwidth * PERIOD)
        joint, last, filtered = JOINTS.index("left_HA"), 0.0, 0.0

        def oscillate(now: Signals) -> None:
            nonlocal last, filtered
            angle = 0.037 * math.sin(2.0 * math.pi * 15.0 * robot.time) * GEAR[joint]
            filtered = keep * filtered + (1.0 - keep) * (angle - last) / PERIOD
            last = angle
            now.position[joint] = MIDDLE[joint] * GEAR[joint] + angle
            now.velocity[joint] = filtered
            robot.missing = {row("left_HA")} if lost and robot.cycles % lost == 0 else set()

        robot.run(20)
        for _ in range(500):
            assert [f for f in robot.cycle(oscillate) if f.dtc is Dtc.ENC_VELOCITY] == []


class TestEncodersAlone:
    """The encoder checks, called directly instead of by the schedule, exactly at their thresholds."""

    motion = ROBOT.top_speed * ROBOT.gear * PERIOD
    noise = 3.0 * ROBOT.encoder_noise * ROBOT.gear

    @staticmethod
    def encoders() -> tuple[EncoderChecks, Signals]:
        now = signals()
        return EncoderChecks(ROBOT, now, signals(), PERIOD, 16), now

    def test_new_encoder_checks_have_no_findings(self):
        encoders, _ = self.encoders()
        assert encoders.jumps == [0] * 12
        assert encoders.findings() == ()
        assert encoders.within_reach()

    @signs
    @pytest.mark.parametrize("cycles", [1, 3])
    def test_motion_of_exactly_the_reach_is_accepted(self, sign: float, cycles: int):
        for joint in range(12):
            reach = cycles * self.motion[joint] + self.noise[joint]
            for size, good in ((reach, True), (np.nextafter(reach, np.inf), False)):
                encoders, now = self.encoders()
                now.position[joint] = sign * size
                assert encoders.accept(joint, cycles) is good
                if cycles == 1:
                    assert encoders.within_reach() is good
            assert encoders.jumps == [int(j == joint) for j in range(12)]

    def test_velocity_error_of_exactly_the_threshold_is_accepted(self):
        for joint, found in itertools.product(range(12), (False, True)):
            allowed = ROBOT.sensors.velocity_error * ROBOT.gear[joint]
            encoders, now = self.encoders()
            now.velocity[joint] = -np.nextafter(allowed, np.inf) if found else -allowed
            encoders.follow()
            # The first sample is not compared; the next three comparisons are wrong.
            assert [encoders.check_velocity(None) for _ in range(5)] == [False] * 3 + [found] * 2
            assert [f.value for f in encoders.findings()] == pytest.approx([-ROBOT.sensors.velocity_error] * found)

    def test_joint_with_old_values_is_skipped_and_others_are_checked(self):
        for joint in range(12):
            old = np.zeros(12, np.int64)
            old[joint] = NEVER
            encoders, now = self.encoders()
            now.velocity[joint] = 100.0
            encoders.follow()
            assert [encoders.check_velocity(age) for age in (None, old) * 6] == [False] * 12
            encoders, now = self.encoders()
            now.velocity[joint] = 100.0
            encoders.follow()
            ages = (None, None, None, old, None, None)
            assert [encoders.check_velocity(age) for age in ages] == [False] * 5 + [True]
            finding = only(encoders.findings())
            assert encoders.check_velocity(old)
            assert only(encoders.findings()) is finding
            encoders, now = self.encoders()
            now.velocity[(joint + 1) % 12] = 100.0
            encoders.follow()
            assert [encoders.check_velocity(age) for age in (old,) * 5] == [False] * 3 + [True] * 2

    @pytest.mark.parametrize("gaps", list(itertools.product((1, 2, 5), repeat=2)))
    def test_velocity_check_uses_measurement_times_of_late_samples(self, gaps: tuple[int, int]):
        """All joints move at their highest velocity, and the time between two positions alternates."""
        speed = ROBOT.velocity_max * ROBOT.gear
        for error, found in ((0.99, False), (1.01, True)):
            now, before = signals(), signals()
            encoders = EncoderChecks(ROBOT, now, before, PERIOD, 16)
            now.velocity[:] = speed - error * ROBOT.sensors.velocity_error * ROBOT.gear
            for sample in range(60):
                gap = gaps[sample % 2]
                before.position[:] = now.position
                now.position[:] += 0.9 * speed * PERIOD * gap
                now.velocity[:] = 0.9 * speed - error * ROBOT.sensors.velocity_error * ROBOT.gear
                assert all(encoders.accept(joint, gap) for joint in range(12))
                if sample % 16 == 15 or sample == 59:
                    last = encoders.check_velocity(None)
            assert last is found

    def test_value_that_is_not_newer_leaves_the_low_pass_unchanged(self):
        encoders, now = self.encoders()
        now.velocity[4] = 1e6
        assert encoders.accept(4, 0)
        assert [encoders.check_velocity(None) for _ in range(5)] == [False] * 5

    def test_first_position_of_a_joint_starts_the_low_pass_at_its_velocity(self):
        for position, cycles in ((np.nan, 1), (0.0, NEVER)):
            now, before = signals(), signals()
            before.position[:] = position
            encoders = EncoderChecks(ROBOT, now, before, PERIOD, 16)
            now.velocity[:] = 100.0
            assert all(encoders.accept(joint, cycles) for joint in range(12))
            assert [encoders.check_velocity(None) for _ in range(5)] == [False] * 5

    def test_wrong_velocities_are_counted_per_joint(self):
        encoders, now = self.encoders()
        now.velocity[4] = now.velocity[9] = 100.0
        encoders.follow()
        assert [encoders.check_velocity(None) for _ in range(3)] == [False] * 3
        now.velocity[9] = -100.0  # the opposite of the last error, so that the mean of both errors is zero
        encoders.follow()
        assert encoders.check_velocity(None)
        assert [f.node for f in encoders.findings()] == [JOINTS[4].upper()]

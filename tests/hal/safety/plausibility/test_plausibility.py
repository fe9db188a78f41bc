"""Plausibility: what a healthy robot says is never doubted, and each fault is found as fast and as tightly as promised."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pinocchio
import pytest
from hypothesis import given
from hypothesis import strategies as st

import atalante_dbc
from atalante_control.model import ExoskeletonParameters, pinocchio_model, urdf
from atalante_hal.robot import CELLS, FEET, IMUS, JOINTS, load_robot
from atalante_hal.safety.diagnostics import Dtc
from atalante_hal.safety.plausibility import Finding, Plausibility
from atalante_hal.safety.plausibility.encoders import EncoderChecks
from atalante_hal.safety.plausibility.feet import FootChecks
from atalante_hal.safety.plausibility.finding import Ages, Signals, measured, signals_of
from atalante_hal.safety.plausibility.imus import Imus
from atalante_hal.safety.plausibility.legs import Legs, _Contradiction, _forgotten, hip_angles
from atalante_hal.safety.plausibility.stillness import Stillness
from atalante_hal.safety.plausibility.unchecked import Unchecked
from atalante_hal.wire.codec import Codec
from atalante_hal.wire.e2e import Check
from atalante_hal.wire.process_image import NEVER, ReceiveImage

NETWORK = atalante_dbc.load()
ROBOT = load_robot()
MESSAGES = [m for m in NETWORK.received_by("HAL") if m.cycle_ms == 1]
CODEC = Codec(MESSAGES)
PERIOD = 1e-3
GEAR = ROBOT.gear * ROBOT.polarity
MIDDLE = (ROBOT.position_min + ROBOT.position_max) / 2.0
REACH = ROBOT.velocity_max * PERIOD + 3.0 * ROBOT.encoder_noise
MODEL = pinocchio_model(urdf(ExoskeletonParameters(), ROBOT))
DATA = MODEL.model.createData()
IMU_FRAMES = [MODEL.model.getFrameId(f"imu_{imu}") for imu in IMUS]
NOISE = [signals_of(CODEC, row) for row in np.random.default_rng(1).standard_normal((1021, CODEC.size))]

joints = pytest.mark.parametrize("joint", range(12), ids=JOINTS)
imus = pytest.mark.parametrize("imu", range(4), ids=IMUS)
cells = pytest.mark.parametrize(("foot", "cell"), [(f, c) for f in range(2) for c in range(4)])
signs = pytest.mark.parametrize("sign", [1.0, -1.0])

Change = Callable[[Signals], object]


def row(name: str) -> int:
    return CODEC.rows[f"{name.upper()}_STATE"]


def attitudes(position: np.ndarray) -> np.ndarray:
    """Quaternions wxyz of the four IMUs, by Pinocchio."""
    q = pinocchio.neutral(MODEL.model)
    q[MODEL.q] = position
    pinocchio.framesForwardKinematics(MODEL.model, DATA, q)
    quaternions = [pinocchio.Quaternion(DATA.oMf[frame].rotation).coeffs() for frame in IMU_FRAMES]
    return np.array([[w, x, y, z] for x, y, z, w in quaternions])


@dataclass
class Machine:
    """A robot whose joints swing slowly and whose sensors are well but for what a test changes."""

    cycles: int = 0
    missing: set[int] = field(default_factory=set)  # rows that are not heard
    late: dict[int, int] = field(default_factory=dict)  # rows whose data is so many cycles old
    gaps: set[int] = field(default_factory=set)  # rows that are heard, and some of whose frames were lost before
    amplitude: float = 0.05  # rad
    standing: bool = False

    def __post_init__(self) -> None:
        self.image = ReceiveImage(MESSAGES, np.zeros(CODEC.size))
        self.now = signals_of(CODEC, self.image.values)
        self.checks = Plausibility(ROBOT, self.image, PERIOD)
        self.attitudes = attitudes(MIDDLE)
        self.run(1)

    @property
    def time(self) -> float:
        return self.cycles * PERIOD

    @property
    def refused(self) -> dict[int, int]:
        """Row -> age of what came and was not used."""
        rows = np.flatnonzero(self.image.check == Check.IMPLAUSIBLE).tolist()
        assert not rows or not self.image.all_fresh
        return {row: int(self.image.age[row]) for row in rows}

    def position(self) -> np.ndarray:
        return MIDDLE + self.amplitude * math.sin(3.0 * self.time)

    def cycle(self, change: Change = lambda now: None) -> tuple[Finding, ...]:
        image, now, noise = self.image, self.now, NOISE[self.cycles % len(NOISE)]
        values, age = image.values, image.age
        image.values_before[:] = values
        image._age_before[:] = age
        position = self.position()
        now.position[:] = position * GEAR
        now.velocity[:] = self.amplitude * 3.0 * math.cos(3.0 * self.time) * GEAR
        swing = 20.0 * math.sin(50.0 * self.time) if self.amplitude else 0.0  # who is pushed moves
        now.torque[:] = swing + 0.05 * noise.torque
        if self.cycles % 16 in (0, 8):  # when they may be looked at
            self.attitudes = attitudes(position)
        now.quaternion[:] = self.attitudes
        now.gyro[:] = 4e-3 * noise.gyro
        now.accel[:] = [0.0, 0.0, 9.81]
        now.accel[:] += 0.05 * noise.accel
        now.force[:] = 3.0 * noise.force
        if self.standing:
            now.force[:, :, 2] += 100.0
        change(now)
        image.check.fill(Check.OK)
        missing = list(self.missing)
        aged = age[missing] + 1
        age.fill(0)
        if missing:
            lost = np.isin(CODEC.row_of, missing)
            values[lost] = image.values_before[lost]
            age[missing] = aged
            image.check[missing] = Check.NO_DATA
        for row, cycles in self.late.items():
            age[row] = cycles
        image.check[list(self.gaps)] = Check.SOME_LOST
        image.all_fresh = not (self.missing or self.late or self.gaps)
        found = self.checks.check()
        assert found is self.checks.findings
        self.cycles += 1
        return found

    def run(self, cycles: int, change: Change = lambda now: None) -> tuple[Finding, ...]:
        found: tuple[Finding, ...] = ()
        for _ in range(cycles):
            found = self.cycle(change)
        return found

    def until_found(self, dtc: Dtc, cycles: int, change: Change) -> int:
        """Cycles until it is found and confirmed, the first with the fault being 1."""
        for cycle in range(1, cycles + 1):
            if any(f.dtc is dtc and f.confirmed for f in self.cycle(change)):
                return cycle
        raise AssertionError(f"no {dtc} in {cycles} cycles, but {self.checks.findings}")


def only(found: tuple[Finding, ...]) -> Finding:
    assert len(found) == 1, found
    return found[0]


def nobody(*_: object) -> None:
    """In the place of what is not to be called."""
    raise AssertionError


def signals() -> Signals:
    return signals_of(CODEC, np.zeros(CODEC.size))


def test_measured_signals_come_first_and_views_are_views():
    assert measured(CODEC) == slice(0, 100)
    values = np.arange(CODEC.size, dtype=np.float64)
    now = signals_of(CODEC, values)
    assert now.motion.tolist() == [now.position.tolist(), now.velocity.tolist()]
    assert now.forces.tolist() == now.force.ravel().tolist()
    for name, view in now._asdict().items():
        assert np.shares_memory(view, values), name
    for joint in JOINTS:
        assert now.position[JOINTS.index(joint)] == CODEC.index(f"{joint.upper()}_STATE", "Position")


@pytest.mark.parametrize("standing", [False, True])
def test_a_healthy_robot_is_never_doubted(standing: bool):
    machine = Machine(standing=standing)
    nothing = machine.checks.findings
    for _ in range(3000):
        assert machine.cycle() is nothing
        assert not machine.refused
    assert nothing == ()


@pytest.mark.exhaustive
def test_losing_frames_is_not_implausible():
    machine = Machine(amplitude=0.2)
    rng = np.random.default_rng(2)
    for _ in range(3000):
        machine.missing = set(np.flatnonzero(rng.random(len(MESSAGES)) < 0.3).tolist())
        assert machine.cycle() == ()
        assert not machine.refused


class TestEncoderJump:
    @joints
    @signs
    def test_the_threshold_is_tight(self, joint: int, sign: float):
        for size, refused in ((1.0 - 1e-9, False), (1.0 + 1e-9, True)):
            machine = Machine(amplitude=0.0)
            machine.run(5)

            def move(now: Signals, size: float = size) -> None:
                now.position[joint] = (MIDDLE[joint] + sign * size * REACH[joint]) * GEAR[joint]
                now.velocity[joint] = 7.0

            found = machine.cycle(move)
            if not refused:
                assert found == ()
                assert not machine.refused
                assert machine.now.velocity[joint] == 7.0
                continue
            finding = only(found)
            assert (finding.dtc, finding.node) == (Dtc.ENC_JUMP, JOINTS[joint].upper())
            assert not finding.confirmed
            assert finding.value == pytest.approx(REACH[joint])
            assert f"{JOINTS[joint]} jumped by {math.degrees(REACH[joint]):.2f} degrees" in finding.text
            assert machine.refused == {row(JOINTS[joint]): 1}
            assert machine.now.position[joint] == MIDDLE[joint] * GEAR[joint]
            assert machine.now.velocity[joint] == 0.0
            assert machine.cycle() == ()

    @joints
    @pytest.mark.parametrize("lost", [1, 4])
    def test_who_was_not_heard_may_have_gone_further(self, joint: int, lost: int):
        way, noise = ROBOT.velocity_max[joint] * PERIOD, 3.0 * ROBOT.encoder_noise[joint]
        for size, refused in ((-1e-9, False), (1e-9, True)):
            machine = Machine(amplitude=0.0)
            machine.missing = {row(JOINTS[joint])}
            assert machine.run(lost) == ()
            machine.missing = set()
            target = (MIDDLE[joint] + (lost + 1) * way + noise + size) * GEAR[joint]
            found = machine.cycle(lambda now, target=target: now.position.__setitem__(joint, target))
            assert bool(found) is refused
            assert machine.refused == ({row(JOINTS[joint]): lost + 1} if refused else {})

    @pytest.mark.parametrize(("before", "after", "cycles"), [(3, 3, 1), (3, 0, 4), (0, 2, 1), (4, 2, 3)])
    def test_the_time_between_two_samples_counts_and_not_when_they_came(self, before: int, after: int, cycles: int):
        """From data `before` cycles old to data `after` cycles old; where that is less than a cycle, one has to be missed."""
        way, noise = ROBOT.velocity_max[2] * PERIOD, 3.0 * ROBOT.encoder_noise[2]
        for size, refused in ((-1e-9, False), (1e-9, True)):
            machine = Machine(amplitude=0.0)
            machine.late = {row("left_SH"): before}
            machine.run(6)
            lost = cycles - 1 - before + after
            machine.missing = {row("left_SH")} if lost else set()
            machine.late = {}
            machine.run(lost)
            machine.missing, machine.late = set(), {row("left_SH"): after}
            target = (MIDDLE[2] + cycles * way + noise + size) * GEAR[2]
            found = machine.cycle(lambda now, target=target: now.position.__setitem__(2, target))
            assert bool(found) is refused
            machine.late = {}

    def test_five_in_a_row_are_no_stray(self):
        machine = Machine()

        def away(now: Signals) -> None:
            now.position[3] += 1.0 * GEAR[3]

        assert [only(machine.cycle(away)).confirmed for _ in range(6)] == [False] * 4 + [True] * 2
        assert machine.refused == {row("left_SK"): 6}
        machine.missing = {row("left_SK")}
        assert only(machine.cycle()).confirmed
        assert machine.refused == {}
        machine.missing = set()
        assert machine.cycle() == ()
        assert not only(machine.cycle(away)).confirmed

    def test_a_small_offset_is_taken_once_the_joint_can_have_got_there(self):
        machine = Machine(amplitude=0.0)
        for cycle in range(1, 7):
            machine.cycle(lambda now: now.position.__setitem__(3, (MIDDLE[3] + 0.018) * GEAR[3]))
            assert bool(machine.refused) == (cycle * ROBOT.velocity_max[3] * PERIOD + 3e-5 < 0.018)

    @joints
    @signs
    def test_a_value_that_stays_away_is_never_taken(self, joint: int, sign: float):
        """Longer than the joint would need to get there, at rest and in motion, which ends where the jump began."""
        size = 12.0 * REACH[joint]
        for speed in (0.0, 0.5 * ROBOT.velocity_max[joint]):
            machine = Machine(amplitude=0.0)
            for cycle in range(200):
                at = (MIDDLE[joint] + sign * max(size - speed * PERIOD * cycle, 0.0)) * GEAR[joint]
                found = machine.cycle(lambda now, at=at: now.position.__setitem__(joint, at))
                assert machine.refused == {row(JOINTS[joint]): cycle + 1}
            finding = next(f for f in found if f.dtc is Dtc.ENC_JUMP)
            assert finding.confirmed
            assert "not used until it jumps back or its drive restarts" in finding.text

    @joints
    @signs
    def test_an_encoder_that_jumps_back_is_used_wherever_its_joint_has_gone_meanwhile(self, joint: int, sign: float):
        way = ROBOT.velocity_max[joint] * PERIOD
        for left, used in ((0.0, True), (4.9 * way, True), (6.1 * way, False)):
            machine = Machine(amplitude=0.0)

            def show(gone: float, offset: float, machine: Machine = machine) -> tuple[Finding, ...]:
                at = (MIDDLE[joint] + sign * (offset - gone)) * GEAR[joint]
                return machine.cycle(lambda now: now.position.__setitem__(joint, at))

            for cycle in range(40):
                assert any(f.dtc is Dtc.ENC_JUMP for f in show(0.5 * way * cycle, 30.0 * way))
            found = show(0.5 * way * 40, left)
            assert any(f.dtc is Dtc.ENC_JUMP for f in found) is not used
            assert bool(machine.refused) is not used

    @joints
    def test_a_drive_that_restarted_has_its_encoder_referenced(self, joint: int):
        machine = Machine(amplitude=0.0)
        away = MIDDLE[joint] + 6.0 * REACH[joint]

        def jump(now: Signals) -> None:
            now.position[joint] = away * GEAR[joint]

        for _ in range(2):
            assert any(f.dtc is Dtc.ENC_JUMP and f.confirmed for f in machine.run(20, jump))
            for node in ("IMU_PELVIS", "PENDANT", JOINTS[(joint + 1) % 12].upper()):
                machine.checks.reference(node)
            assert machine.refused
            machine.cycle(jump)
            assert machine.refused
            machine.checks.reference(JOINTS[joint].upper())
            assert Dtc.ENC_JUMP not in {f.dtc for f in machine.cycle(jump)}
            assert not machine.refused
            away = 2.0 * MIDDLE[joint] - away

    def test_a_restart_forgives_one_value_and_no_other(self):
        machine = Machine(amplitude=0.0)
        machine.run(5)
        machine.checks.reference("LEFT_SK")
        machine.missing = {row("left_FH")}
        assert machine.cycle(lambda now: now.position.__setitem__(3, (MIDDLE[3] + 0.2) * GEAR[3])) == ()
        machine.missing = set()
        assert only(machine.cycle()).node == "LEFT_SK"
        machine = Machine(amplitude=0.0)
        machine.run(5)
        machine.checks.reference("LEFT_SK")
        assert only(machine.cycle(lambda now: now.position.__setitem__(4, 0.0))).node == "LEFT_SA"

    def test_two_joints_at_once(self):
        machine = Machine()
        found = machine.cycle(lambda now: now.position.__setitem__(slice(1, 8, 6), 0.0))
        assert [f.node for f in found] == ["LEFT_TH", "RIGHT_TH"]
        assert machine.refused == {row("left_TH"): 1, row("right_TH"): 1}

    def test_the_first_value_may_be_any(self):
        image = ReceiveImage(MESSAGES)  # of NaN
        checks = Plausibility(ROBOT, image, PERIOD)
        image.values[:100] = Machine().image.values[:100]
        image.check.fill(Check.OK)
        image.age.fill(0)
        assert checks.check() == ()
        assert not (image.check == Check.IMPLAUSIBLE).any()

    def test_many_quick_joints_are_no_jump(self):
        machine = Machine(amplitude=0.0)
        machine.cycle(lambda now: now.position.__iadd__(0.9 * REACH * GEAR))
        assert machine.checks.findings == ()
        assert not machine.refused


class TestRange:
    tolerance = ROBOT.thresholds.position_tolerance

    @joints
    @pytest.mark.parametrize("end", ["position_min", "position_max"])
    def test_the_threshold_is_tight_and_found_in_its_cycle(self, joint: int, end: str):
        limit, outwards = getattr(ROBOT, end)[joint], 1.0 if end == "position_max" else -1.0
        for size, found in ((1.0 - 1e-9, False), (1.0 + 1e-9, True)):
            angle = limit + outwards * size * self.tolerance
            machine = Machine(amplitude=0.0)
            machine.checks.reference(JOINTS[joint].upper())
            findings = machine.cycle(lambda now, angle=angle: now.position.__setitem__(joint, angle * GEAR[joint]))
            assert bool(findings) is found
            assert not machine.refused
            if not found:
                continue
            finding = only(findings)
            assert (finding.dtc, finding.node, finding.confirmed) == (Dtc.POSITION_RANGE, JOINTS[joint].upper(), True)
            assert finding.value == pytest.approx(angle)
            low, high = (math.degrees(getattr(ROBOT, name)[joint]) for name in ("position_min", "position_max"))
            said = (
                f"{JOINTS[joint]} is at {math.degrees(angle):.1f} degrees, outside its range of {low:.1f} to {high:.1f}"
            )
            assert said in finding.text
            inside = (angle - outwards * 2e-9 * self.tolerance) * GEAR[joint]
            machine.missing = {row(JOINTS[joint])}
            assert only(machine.cycle()) is finding
            machine.missing = set()
            for lost in (False, True):
                machine.cycle(lambda now, angle=angle: now.position.__setitem__(joint, angle * GEAR[joint]))
                machine.missing = {row(JOINTS[joint])} if lost else set()
                assert len(machine.run(lost)) == lost
                machine.missing = set()
                assert machine.cycle(lambda now, inside=inside: now.position.__setitem__(joint, inside)) == ()

    def test_a_first_value_outside_is_found(self):
        image = ReceiveImage(MESSAGES)  # of NaN
        checks = Plausibility(ROBOT, image, PERIOD)
        image.values[:100] = Machine().image.values[:100]
        signals_of(CODEC, image.values).position[4] = 1.0 * GEAR[4]
        image.check.fill(Check.OK)
        image.age.fill(0)
        assert only(checks.check()).text.startswith(
            "left_SA is at 57.3 degrees, outside its range of -16.0 to 9.0 degrees"
        )


class TestVelocity:
    @joints
    @signs
    def test_the_threshold_is_tight_and_found_in_time(self, joint: int, sign: float):
        error = ROBOT.sensors.velocity_error
        for phase in (0, 3, 15):
            machine = Machine(amplitude=0.0)
            machine.run(40 + phase)

            def off(now: Signals, size: float) -> None:
                now.velocity[joint] = sign * size * error * GEAR[joint]

            assert machine.run(100, lambda now: off(now, 1.0 - 1e-9)) == ()
            machine.run(17)
            assert machine.until_found(Dtc.ENC_VELOCITY, 64, lambda now: off(now, 1.0 + 1e-6)) >= 48
            finding = only(machine.checks.findings)
            assert finding.node == JOINTS[joint].upper()
            assert finding.value == pytest.approx(sign * error, rel=1e-5)
            assert f"velocity of {JOINTS[joint]} is {math.degrees(sign * error):+.0f} deg/s" in finding.text
            assert machine.run(33) == ()

    def test_the_mean_counts_and_not_the_moment(self):
        machine = Machine()
        rng = np.random.default_rng(3)
        jitter = [rng.choice([-0.9, 0.9]) for _ in range(1000)]
        assert machine.run(400, lambda now: now.velocity.__iadd__(jitter[machine.cycles // 16] * GEAR)) == ()

    @pytest.mark.parametrize("lost", ["left_HA", "right_HA", "IMU_torso", "FOOT_left", "pendant"])
    def test_frames_lost_when_samples_are_taken_hide_no_wrong_velocity(self, lost: str):
        machine = Machine()
        machine.run(40)

        def wrong(now: Signals) -> None:
            machine.missing = {row(lost)} if machine.cycles % 16 < 4 else set()
            now.velocity[5] = 1000.0

        machine.until_found(Dtc.ENC_VELOCITY, 64, wrong)
        assert only(machine.checks.findings).node == "LEFT_HA"

    def test_three_wrong_comparisons_on_end_are_needed(self):
        """A sample is compared with the one before and with the one after it."""
        machine = Machine(amplitude=0.0)

        def wrong(now: Signals) -> None:
            now.velocity[5] = 10.0 * ROBOT.sensors.velocity_error * GEAR[5]

        for _ in range(4):
            assert [machine.run(16, wrong), machine.run(16), machine.run(16)] == [()] * 3
        machine.until_found(Dtc.ENC_VELOCITY, 48, wrong)

    def test_it_follows_the_way_of_the_encoder(self):
        machine = Machine(amplitude=0.0)

        def turn(now: Signals) -> None:
            now.position[5] += 0.9 * machine.time * GEAR[5]
            now.velocity[5] = 0.9 * GEAR[5]

        assert machine.run(300, turn) == ()


class TestEncodersAlone:
    """Exactly at their thresholds, which no Machine hits: there the joints are somewhere."""

    way = ROBOT.velocity_max * ROBOT.gear * PERIOD
    noise = 3.0 * ROBOT.encoder_noise * ROBOT.gear

    @staticmethod
    def encoders() -> tuple[EncoderChecks, Signals]:
        now = signals()
        return EncoderChecks(ROBOT, now, signals(), PERIOD, 16), now

    def test_at_first_nothing_is_known(self):
        encoders, _ = self.encoders()
        assert encoders.jumps == [0] * 12
        assert encoders.findings() == ()
        assert encoders.within_reach()

    @signs
    @pytest.mark.parametrize("cycles", [1, 3])
    def test_the_reach_itself_is_within_it(self, sign: float, cycles: int):
        for joint in range(12):
            encoders, now = self.encoders()
            reach = cycles * self.way[joint] + self.noise[joint]
            for size, good in ((reach, True), (np.nextafter(reach, np.inf), False)):
                now.position[joint] = sign * size
                assert encoders.accept(joint, cycles) is good
                if cycles == 1:
                    assert encoders.within_reach() is good
            assert encoders.jumps == [int(j == joint) for j in range(12)]

    def test_the_velocity_itself_may_err_by_what_is_allowed(self):
        for joint, found in itertools.product(range(12), (False, True)):
            allowed = ROBOT.sensors.velocity_error * ROBOT.gear[joint]
            encoders, now = self.encoders()
            now.velocity[joint] = -np.nextafter(allowed, np.inf) if found else -allowed
            # One sample, and three that are compared with the one before.
            assert [encoders.judge_velocity(None) for _ in range(5)] == [False] * 3 + [found] * 2
            assert [f.value for f in encoders.findings()] == pytest.approx([-ROBOT.sensors.velocity_error] * found)

    def test_a_joint_too_old_is_compared_with_no_sample_of_its_own_and_hides_no_other(self):
        for joint in range(12):
            old = np.zeros(12, np.int64)
            old[joint] = NEVER
            encoders, now = self.encoders()
            now.velocity[joint] = 100.0
            assert [encoders.judge_velocity(age) for age in (None, old) * 6] == [False] * 12
            encoders, now = self.encoders()
            now.velocity[joint] = 100.0
            ages = (None, None, None, old, None, None)
            assert [encoders.judge_velocity(age) for age in ages] == [False] * 5 + [True]
            finding = only(encoders.findings())
            assert encoders.judge_velocity(old)
            assert only(encoders.findings()) is finding
            encoders, now = self.encoders()
            now.velocity[(joint + 1) % 12] = 100.0
            assert [encoders.judge_velocity(age) for age in (old,) * 5] == [False] * 3 + [True] * 2

    @pytest.mark.parametrize("ages", list(itertools.product((0, 1, 4), repeat=2)))
    def test_samples_count_from_the_cycles_they_were_measured_in(self, ages: tuple[int, int]):
        """A joint at its highest velocity, whose samples are of ages that change: right is right, and wrong is wrong."""
        speed = ROBOT.velocity_max * ROBOT.gear
        for error, found in ((0.99, False), (1.01, True)):
            encoders, now = self.encoders()
            for turn in range(5):
                age = ages[turn % 2]
                now.position[:] = speed * PERIOD * (16 * turn - age)
                now.velocity[:] = speed - error * ROBOT.sensors.velocity_error * ROBOT.gear
                last = encoders.judge_velocity(np.full(12, age))
            assert last is found

    def test_each_joint_is_counted_for_itself(self):
        encoders, now = self.encoders()
        now.velocity[4] = now.velocity[9] = 100.0
        assert [encoders.judge_velocity(None) for _ in range(3)] == [False] * 3
        now.velocity[9] = -100.0  # right on average
        assert encoders.judge_velocity(None)
        assert [f.node for f in encoders.findings()] == [JOINTS[4].upper()]


class TestImuRange:
    @imus
    @pytest.mark.parametrize("quantity", ["gyro", "accel"])
    @pytest.mark.parametrize("axis", range(3))
    @signs
    def test_the_last_step_of_the_range_is_no_measurement(self, imu: int, quantity: str, axis: int, sign: float):
        index = CODEC.index(f"IMU_{IMUS[imu].upper()}_STATE", f"{quantity.capitalize()}X")
        signal = CODEC.signals[index][1]
        machine = Machine()
        machine.run(5)
        before = {name: getattr(machine.now, name)[imu].copy() for name in ("quaternion", "gyro", "accel")}

        def say(value: float) -> Change:
            return lambda now: getattr(now, quantity)[imu].__setitem__(axis, sign * value)

        assert machine.cycle(say(signal.maximum - signal.factor)) == ()
        before = {name: getattr(machine.now, name)[imu].copy() for name in before}
        finding = only(machine.cycle(say(signal.maximum)))
        assert (finding.dtc, finding.node) == (Dtc.IMU_SATURATED, f"IMU_{IMUS[imu].upper()}")
        assert finding.value == pytest.approx(signal.maximum)
        assert f"the {IMUS[imu]} IMU is at the end of its range, {signal.maximum:.0f}" in finding.text
        assert machine.refused == {row(f"IMU_{IMUS[imu]}"): 1}
        for name, value in before.items():
            assert np.array_equal(getattr(machine.now, name)[imu], value)
        assert machine.cycle() == ()

    @imus
    def test_ten_cycles_without_a_value_give_an_imu_up(self, imu: int):
        machine = Machine()
        found = [only(machine.cycle(lambda now: now.gyro.__setitem__(imu, 40.95875))) for _ in range(11)]
        assert [f.confirmed for f in found] == [False] * 9 + [True] * 2
        assert machine.refused == {row(f"IMU_{IMUS[imu]}"): 11}

    def test_all_shaking_hard_is_no_saturation(self):
        machine = Machine()
        assert machine.cycle(lambda now: now.accel.__iadd__(30.0)) == ()


class TestQuaternion:
    @imus
    @pytest.mark.parametrize("phase", range(8))
    def test_the_norm_is_tight_and_found_at_once(self, imu: int, phase: int):
        allowed = ROBOT.sensors.quaternion_error
        machine = Machine()
        machine.run(phase)
        for squared in (1.0 + allowed * (1.0 - 1e-9), 1.0 - allowed * (1.0 - 1e-9)):
            assert machine.run(9, lambda now, s=squared: now.quaternion[imu].__imul__(math.sqrt(s))) == ()
            assert not machine.refused
            machine.cycle()
        for squared in (1.0 + allowed * (1.0 + 1e-9), 1.0 - allowed * (1.0 + 1e-9)):

            def stretch(now: Signals, squared: float = squared) -> None:
                now.quaternion[imu] *= math.sqrt(squared)

            finding = only(machine.cycle(stretch))
            assert (finding.dtc, finding.node) == (Dtc.IMU_INVALID, f"IMU_{IMUS[imu].upper()}")
            assert not finding.confirmed
            assert finding.value == pytest.approx(math.sqrt(squared))
            assert f"quaternion of the {IMUS[imu]} IMU has the norm {math.sqrt(squared):.3f}" in finding.text
            assert machine.refused == {row(f"IMU_{IMUS[imu]}"): 1}
            assert np.allclose(np.linalg.norm(machine.now.quaternion[imu]), 1.0)
            assert not only(machine.run(8, stretch)).confirmed
            assert only(machine.cycle(stretch)).confirmed
            assert machine.cycle() == ()
            assert machine.refused == {}

    def test_an_imu_that_was_never_heard_is_not_judged(self):
        image = ReceiveImage(MESSAGES, np.zeros(CODEC.size))
        checks = Plausibility(ROBOT, image, PERIOD)
        for _ in range(40):
            image.new_cycle()
            assert checks.check() == ()

    @pytest.mark.parametrize("phase", [0, 5])
    def test_two_that_err_the_opposite_way_are_found_at_once(self, phase: int):
        machine = Machine()
        machine.run(phase)

        def stretch(now: Signals) -> None:
            now.quaternion[1] *= math.sqrt(1.1)
            now.quaternion[3] *= math.sqrt(0.9)

        assert machine.cycle(stretch)
        assert [f.node for f in machine.checks.findings] == ["IMU_PELVIS", "IMU_RIGHT_TIBIA"]
        assert machine.refused == {row("IMU_pelvis"): 1, row("IMU_right_tibia"): 1}


class TestImusAlone:
    """Exactly at their thresholds, with an error of the norm that is a binary fraction."""

    robot = replace(ROBOT, sensors=replace(ROBOT.sensors, quaternion_error=0.125))
    ends = tuple(
        signal.maximum - 0.5 * signal.factor
        for signal in (CODEC.signals[CODEC.index("IMU_TORSO_STATE", name)][1] for name in ("GyroX", "AccelX"))
    )

    def make(self) -> tuple[Imus, Signals]:
        now = signals()
        now.quaternion[:, 0] = 1.0
        return Imus(self.robot, CODEC, now), now

    @pytest.mark.parametrize(
        ("quaternion", "norm"),
        [
            ((1.0, 0.25, 0.25, 0.0), None),
            ((0.75, 0.5, 0.25, 0.0), None),
            ((1.0, 0.25, 0.25, 0.125), math.sqrt(1.140625)),
            ((0.75, 0.5, 0.125, 0.125), math.sqrt(0.84375)),
        ],
    )
    def test_what_a_norm_may_err_by_is_allowed_itself(self, quaternion: tuple[float, ...], norm: float | None):
        wrong = norm is not None
        for imu, turn in itertools.product(range(4), range(4)):
            imus, now = self.make()
            now.quaternion[imu] = np.roll(quaternion, turn)
            assert imus.usable() is not wrong
            assert imus.findings() == ()
            for cycles in (9, 10):
                assert imus.accept(imu, cycles, frozen=False) is not wrong
                assert imus.no_attitude == ({imu: norm} if wrong else {})
                assert [f.confirmed for f in imus.findings()] == [cycles == 10] * wrong

    @pytest.mark.parametrize("quantity", ["gyro", "accel"])
    @pytest.mark.parametrize("usable", [False, True])
    def test_the_end_of_the_range_itself_is_the_end(self, quantity: str, usable: bool):
        end = self.ends[quantity == "accel"]
        for imu, axis, sign in itertools.product(range(4), range(3), (1.0, -1.0)):
            imus, now = self.make()
            getattr(now, quantity)[imu, axis] = sign * (np.nextafter(end, 0.0) if usable else end)
            assert imus.usable() is usable
            for cycles in (9, 10):
                assert imus.accept(imu, cycles, frozen=False) is usable
                assert imus.saturated == ({} if usable else {imu: end})
                assert [f.confirmed for f in imus.findings()] == [cycles == 10] * (not usable)

    def test_one_that_repeats_itself_is_of_no_use(self):
        imus, _ = self.make()
        assert not imus.accept(2, 1, frozen=True)
        assert imus.accept(2, 1, frozen=False)
        assert imus.findings() == ()


angles = st.floats(-1.2, 1.2)


class TestDrift:
    @given(st.lists(angles, min_size=12, max_size=12))
    def test_two_attitudes_tell_the_angles_between_them(self, position: list[float]):
        q = np.array(position)
        quaternions = attitudes(q)
        for hip, tibia in ((0, IMUS.index("left_tibia")), (6, IMUS.index("right_tibia"))):
            found = hip_angles(quaternions[IMUS.index("pelvis")].tolist(), quaternions[tibia].tolist())
            expected = (q[hip], q[hip + 1], q[hip + 2] + q[hip + 3])
            assert found == pytest.approx(expected, abs=1e-9)
            turned = hip_angles((-quaternions[IMUS.index("pelvis")]).tolist(), quaternions[tibia].tolist())
            assert turned == pytest.approx(expected, abs=1e-9)

    @pytest.mark.parametrize("heading", [(0.5, 0.5, 0.5, 0.5), (0.5, -0.5, 0.5, 0.5), (0.1, 0.7, -0.1, 0.7)])
    def test_angles_between_two_attitudes_are_the_same_wherever_both_point(self, heading: tuple[float, ...]):
        """The robot of the tests hangs with its pelvis straight; a wearer walks where he likes."""
        position = np.array([0.2, -0.3, 0.5, 0.4, 0.0, 0.0] * 2)
        whole = pinocchio.Quaternion(np.array(heading)).normalized()
        quaternions = []
        for w, x, y, z in attitudes(position)[[IMUS.index("pelvis"), IMUS.index("left_tibia")]]:
            x, y, z, w = (whole * pinocchio.Quaternion(np.array([x, y, z, w]))).coeffs()
            quaternions.append([w, x, y, z])
        assert hip_angles(*quaternions) == pytest.approx((0.2, -0.3, 0.9), abs=1e-9)

    def test_a_sine_beyond_one_is_a_right_angle(self):
        half = math.sqrt(0.5) * (1.0 + 1e-5)
        assert hip_angles([1.0, 0.0, 0.0, 0.0], [half, 0.0, 0.0, half])[1] == math.pi / 2.0
        assert hip_angles([1.0, 0.0, 0.0, 0.0], [half, 0.0, 0.0, -half])[1] == -math.pi / 2.0

    @joints
    @signs
    def test_the_threshold_is_tight_where_an_imu_sees_the_joint(self, joint: int, sign: float):
        allowed = ROBOT.sensors.attitude_error
        machine = Machine(amplitude=0.0)
        offset = 0.0

        def off(now: Signals) -> None:
            now.position[joint] += offset * GEAR[joint]

        for offset in np.linspace(0.0, sign * allowed * (1.0 - 1e-6), 20):  # noqa: B007 - read by `off`
            machine.cycle(off)
        assert machine.run(200, off) == ()
        offset = sign * allowed * (1.0 + 1e-6)
        if JOINTS[joint].endswith(("SA", "HA")):  # the promised miss
            assert machine.run(400, off) == ()
            return
        assert 64 < machine.until_found(Dtc.ENC_DRIFT, 128, off) <= 128
        finding = only(machine.checks.findings)
        named = JOINTS[joint].replace("SK", "SH")
        assert finding.node == named.upper()
        assert finding.value == pytest.approx(offset, rel=1e-5)
        side, axis = JOINTS[joint].split("_")
        told = f"{side}_SH and {side}_SK" if axis in ("SH", "SK") else JOINTS[joint]
        assert finding.text == (
            f"encoder of {told}: {math.degrees(offset):+.1f} degrees off what pelvis and tibia IMU say"
        )
        machine.missing = {row("pendant")}
        assert only(machine.run(40, off)) is finding
        machine.missing = set()
        for offset in np.linspace(sign * allowed, 0.0, 20):  # noqa: B007 - read by `off`
            machine.cycle(off)
        assert machine.run(33, off) == ()

    @pytest.mark.parametrize("leg", [0, 1])
    def test_an_angle_and_the_same_a_turn_on_agree(self, leg: int):
        now = signals_of(CODEC, np.zeros(CODEC.size))
        now.quaternion[:, 0] = 1.0
        legs = Legs(ROBOT, now, np.zeros(12, np.int64), PERIOD)
        for turn in (0.0, 2.0 * math.pi, -2.0 * math.pi):
            now.position[:] = (turn + np.array([0.05, -0.04, 0.03, 0.0] * 3)) * GEAR
            hip = 6 * leg
            now.position[hip : hip + 4] = (turn + np.array([0.05, -0.04, 0.03, -turn])) * GEAR[hip : hip + 4]
            assert legs._compare(leg, None).errors == pytest.approx((0.05, -0.04, 0.03), abs=1e-9)

    @pytest.mark.parametrize("leg", [0, 1])
    @pytest.mark.parametrize("late", ["none", "joints", "pelvis", "tibia", "all"])
    def test_values_of_several_cycles_are_compared_at_one_moment(self, leg: int, late: str):
        """All joints at their highest velocity, and a pelvis that turns; values up to four cycles old."""
        velocity, turning = ROBOT.velocity_max, np.array([0.5, -0.7, 0.9])
        tibia = IMUS.index(("left_tibia", "right_tibia")[leg])
        ages = Ages(np.zeros(12, np.int64), np.zeros(4, np.int64), np.zeros(2, np.int64))
        ages.joint[:] = 4 * (late in ("joints", "all"))
        ages.imu[IMUS.index("pelvis")] = 4 * (late in ("pelvis", "all"))
        ages.imu[tibia] = 4 * (late in ("tibia", "all"))

        def attitudes_at(time: float) -> np.ndarray:
            whole = pinocchio.Quaternion(pinocchio.exp3(turning * time))
            placed = [whole * pinocchio.Quaternion(w, x, y, z) for w, x, y, z in attitudes(MIDDLE + velocity * time)]
            return np.array([q.coeffs()[[3, 0, 1, 2]] for q in placed])

        now = signals()
        now.position[:] = (MIDDLE - velocity * PERIOD * ages.joint) * GEAR
        now.velocity[:] = velocity * GEAR
        for imu, age in enumerate(ages.imu.tolist()):
            w, x, y, z = now.quaternion[imu] = attitudes_at(-age * PERIOD)[imu]
            later = pinocchio.Quaternion(*attitudes_at(1e-6 - age * PERIOD)[imu])
            now.gyro[imu] = (
                pinocchio.log3((pinocchio.Quaternion(w, x, y, z).inverse() * later).toRotationMatrix()) / 1e-6
            )
        legs = Legs(ROBOT, now, np.zeros(12, np.int64), PERIOD)
        said = legs._compare(leg, ages)
        assert said is not None
        cycles = sum(ages.joint[:4]) + sum(ages.imu)
        assert said.doubt == pytest.approx(ROBOT.sensors.velocity_error * PERIOD * cycles)
        assert np.abs(said.errors).max() <= 1e-9 + 0.25 * said.doubt  # without being carried up to 32 mrad
        for values, needed in ((ages.joint, range(6 * leg, 6 * leg + 4)), (ages.imu, (IMUS.index("pelvis"), tibia))):
            for place in range(len(values)):
                kept, values[place] = values[place], NEVER
                assert (legs._compare(leg, ages) is None) is (place in needed)
                values[place] = kept

    @pytest.mark.parametrize("leg", [0, 1])
    @pytest.mark.parametrize("axis", range(3))
    def test_four_samples_beyond_the_threshold_itself_are_a_drift(self, leg: int, axis: int):
        legs = Legs(ROBOT, signals_of(CODEC, np.zeros(CODEC.size)), np.zeros(12, np.int64), PERIOD)
        allowed = ROBOT.sensors.attitude_error
        for size, found in ((allowed, False), (np.nextafter(allowed, 1.0), True)):
            errors = [0.0] * 3
            errors[axis] = -float(size)
            for samples in range(1, 6):
                legs._judge_drift(leg, _Contradiction((0.0, 0.0, 0.0), (errors[0], errors[1], errors[2])))
                assert bool(legs.findings()) is (found and samples >= 4)

    @pytest.mark.parametrize("rate", [0.035, 0.05, 0.2])
    def test_a_slow_drift_is_found_within_a_thousand_cycles(self, rate: float):
        machine = Machine()
        begin = machine.cycles

        def drift(now: Signals) -> None:
            now.position[8] += rate * PERIOD * (machine.cycles - begin) * GEAR[8]

        machine.until_found(Dtc.ENC_DRIFT, 1000, drift)


class TestStuckEncoder:
    @joints
    @pytest.mark.parametrize("phase", [0, 1, 9, 15])
    def test_found_within_fifty_cycles_while_the_torque_swings(self, joint: int, phase: int):
        machine = Machine()
        machine.run(20 + phase)
        stuck = float(machine.now.position[joint])

        def stick(now: Signals) -> None:
            now.position[joint] = stuck
            now.velocity[joint] = 0.0

        assert 32 < machine.until_found(Dtc.ENC_STUCK, 50, stick) <= 48
        finding = only(machine.checks.findings)
        assert finding.node == JOINTS[joint].upper()
        assert finding.value >= ROBOT.breakaway[joint]
        assert f"{JOINTS[joint]} stands still while the torque swings by {finding.value:.0f} Nm" in finding.text
        assert machine.refused == {}
        assert machine.run(17) == ()

    @joints
    def test_the_swing_of_the_torque_is_tight_and_counted_from_where_it_stood(self, joint: int):
        machine = Machine(amplitude=0.0)
        wobble = 0.0

        def hold(now: Signals) -> None:
            now.position[:] += np.array([machine.cycles % 7] * 12) * 1e-5
            now.position[joint] = MIDDLE[joint] * GEAR[joint]
            now.torque[:] = 3.0 + wobble

        wobble = 30.0
        machine.run(32, lambda now: (hold(now), now.position.__iadd__(1e-4 * machine.cycles)))
        wobble = 0.0
        machine.run(32, hold)
        wobble = ROBOT.breakaway[joint] * (1.0 - 1e-9)
        assert machine.run(100, hold) == ()
        wobble = -1e-6
        assert machine.until_found(Dtc.ENC_STUCK, 16, hold) <= 16
        assert only(machine.checks.findings).value == pytest.approx(ROBOT.breakaway[joint], rel=1e-5)

    @signs
    def test_the_torque_counts_from_where_it_stood_first(self, sign: float):
        machine, torque = Machine(amplitude=0.0), 0.0

        def push(now: Signals) -> None:
            now.torque[:] = torque

        def move(now: Signals) -> None:
            push(now)
            now.position[:] += 1e-5 * machine.cycles * GEAR

        for torque in (sign * 100.0, -sign * 100.0, 0.0):  # noqa: B007 - read by `push`
            assert machine.run(32, move) == ()
            assert machine.run(96, push) == ()
        torque = sign * 100.0
        machine.run(32, move)
        assert machine.run(16, push) == ()  # one sample
        torque = 0.0
        assert machine.until_found(Dtc.ENC_STUCK, 48, push) > 16

    @joints
    @pytest.mark.parametrize("limit", ["position_min", "position_max"])
    def test_a_joint_at_its_stop_may_stand_still(self, joint: int, limit: str):
        end = getattr(ROBOT, limit)[joint]
        inwards = 1.0 if limit == "position_min" else -1.0
        for distance, found in ((0.0049, False), (0.0051, True)):
            machine = Machine(amplitude=0.0)
            machine.now.position[joint] = at = (end + inwards * distance) * GEAR[joint]

            def push(now: Signals, machine: Machine = machine, at: float = at) -> None:
                now.position[joint] = at
                now.torque[joint] = 20.0 * math.sin(50.0 * machine.time)

            machine.run(100, push)
            stuck = [f.node for f in machine.checks.findings if f.dtc is Dtc.ENC_STUCK]
            assert stuck == ([JOINTS[joint].upper()] if found else [])

    @pytest.mark.parametrize("end", ["_low_stop", "_high_stop"])
    def test_the_stop_itself_belongs_to_the_stop(self, end: str):
        machine, at = Machine(amplitude=0.0), {}
        for joint, stop in enumerate(getattr(machine.checks._stillness, end)):
            to_joint = ROBOT.polarity[joint] / ROBOT.gear[joint]
            near = stop / to_joint + np.spacing(stop / to_joint) * np.arange(-8, 9)
            at.update((joint, value) for value in near[near * to_joint == stop].tolist())
        assert len(at) >= 8  # of the others no number is the stop itself

        def push(now: Signals) -> None:
            for joint, value in at.items():
                now.position[joint] = value
                now.torque[joint] = 20.0 * math.sin(50.0 * machine.time)

        push(machine.now)
        assert machine.run(100, push) == ()

    def test_a_torque_that_swings_by_the_breakaway_is_enough(self):
        machine, torque = Machine(amplitude=0.0), np.zeros(12)

        def hold(now: Signals) -> None:
            now.torque[:] = torque

        machine.run(64, lambda now: (hold(now), now.position.__iadd__(1e-5 * machine.cycles)))
        assert machine.run(64, hold) == ()
        torque[:] = ROBOT.breakaway
        machine.run(16, hold)
        assert [f.node for f in machine.checks.findings] == [joint.upper() for joint in JOINTS]
        assert [f.value for f in machine.checks.findings] == ROBOT.breakaway.tolist()

    def test_who_is_not_heard_is_not_stuck(self):
        machine = Machine()
        machine.missing = {row("left_SK")}
        assert machine.run(200) == ()


class TestStandingEncoder:
    """An encoder that stands still while pelvis and tibia IMU say that its leg turns; nobody drives it."""

    allowed = ROBOT.sensors.attitude_change / (1.0 - ROBOT.sensors.misalignment)

    @staticmethod
    def standing(joint: int) -> tuple[Machine, Callable[[float], None]]:
        """A robot that stands, and how to turn a joint whose encoder does not show it."""
        machine = Machine(amplitude=0.0)
        turned = np.zeros(12)
        machine.position = lambda: MIDDLE + turned  # type: ignore[method-assign]
        machine.run(40)
        return machine, lambda angle: turned.__setitem__(joint, angle)

    @staticmethod
    def still(now: Signals) -> None:
        now.position[:] = MIDDLE * GEAR

    @joints
    @pytest.mark.parametrize("phase", [0, 9, 24])
    def test_found_without_any_torque(self, joint: int, phase: int):
        machine = Machine(amplitude=0.1)
        machine.run(200 + phase, lambda now: now.torque.fill(0.0))
        stuck = float(machine.now.position[joint])

        def stick(now: Signals) -> None:
            now.position[joint] = stuck
            now.torque[:] = 0.0

        if JOINTS[joint].endswith(("SA", "HA")):  # the promised miss
            assert machine.run(400, stick) == ()
            return
        machine.until_found(Dtc.ENC_STUCK, 80, stick)
        finding = only(machine.checks.findings)
        assert finding.node == JOINTS[joint].upper()
        assert finding.text == (
            f"the encoder of {JOINTS[joint]} stands still while its leg turned by {math.degrees(finding.value):+.2f} degrees"
        )
        machine.missing = {row(f"IMU_{JOINTS[joint].split('_')[0]}_tibia")}
        assert machine.run(9, stick)[0] is finding

    @joints
    @signs
    def test_the_threshold_is_tight(self, joint: int, sign: float):
        if JOINTS[joint].endswith(("SA", "HA")):
            return
        machine, turn = self.standing(joint)
        turn(sign * 0.99 * self.allowed)
        assert machine.run(33, self.still) == ()
        machine, turn = self.standing(joint)
        turn(sign * 1.01 * self.allowed)
        assert 16 < machine.until_found(Dtc.ENC_STUCK, 48, self.still) <= 48
        pair = (
            {joint, joint ^ 1} if JOINTS[joint].endswith(("SH", "SK")) else {joint}
        )  # no attitude tells these two apart
        assert [f.node for f in machine.checks.findings] == [JOINTS[one].upper() for one in sorted(pair)]
        assert [f.value for f in machine.checks.findings] == pytest.approx([sign * 1.01 * self.allowed] * len(pair))
        turn(0.0)
        assert machine.run(33, self.still) == ()

    @pytest.mark.parametrize("leg", [0, 1])
    @pytest.mark.parametrize(("place", "axis"), [(0, 0), (1, 1), (2, 2), (3, 2)])
    def test_two_samples_in_which_the_leg_turned_and_the_encoder_did_not(self, leg: int, place: int, axis: int):
        standing = np.zeros(12, np.int64)
        legs, joint = Legs(ROBOT, signals_of(CODEC, np.zeros(CODEC.size)), standing, PERIOD), 6 * leg + place

        def say(turned: float, change: float) -> list[float]:
            angles, errors = [0.1, -0.2, 0.3], [0.05, 0.06, -0.07]
            angles[axis] -= turned
            errors[axis] += change
            legs._judge_standstill(leg, _Contradiction(tuple(angles), tuple(errors)))  # type: ignore[arg-type]
            found = legs.findings()
            assert {f.node for f in found} <= {JOINTS[joint].upper()}
            return [f.value for f in found]

        for _ in range(2):
            standing[joint] = 0
            assert [say(0.5, 0.5), say(0.0, 0.0)] == [[], []]  # it moves
            standing[joint] = 1
            assert say(0.02, 0.02) == []
            assert say(0.02, 0.02) == pytest.approx([-0.02])
            assert say(-0.03, -0.03) == pytest.approx([0.03])
            assert [say(0.0, 0.0), say(0.02, 0.02)] == [[], []]
            # Neither a change without a turn nor a turn without a change is a standstill.
            assert [say(0.0, 0.5), say(0.0, 0.5), say(0.0, 0.5)] == [[]] * 3
            assert [say(0.5, 0.0), say(0.5, 0.0), say(0.5, 0.0)] == [[]] * 3

    def test_what_a_turn_may_change_is_tight(self):
        sensors, standing = ROBOT.sensors, np.zeros(12, np.int64)
        for turned in (0.0, 0.125, 0.5):
            allowed = sensors.attitude_change + sensors.misalignment * turned
            for change, found in ((allowed, False), (np.nextafter(allowed, 1.0), turned > 0.0)):
                legs = Legs(ROBOT, signals_of(CODEC, np.zeros(CODEC.size)), standing, PERIOD)
                standing[0] = 0
                legs._judge_standstill(0, _Contradiction((0.0, 0.0, 0.0), (0.0, 0.0, 0.0)))
                standing[0] = 1
                for _ in range(2):
                    legs._judge_standstill(0, _Contradiction((0.0, turned, 0.0), (float(change), 0.0, 0.0)))
                assert bool(legs.findings()) is found

    @pytest.mark.parametrize("axis", range(3))
    @pytest.mark.parametrize(
        ("change", "way"), [(0.5, 2e-5), (2.1e-5, 2e-5), (1e-5, 1e-5), (-1e-5, -1e-5), (-0.5, -2e-5)]
    )
    def test_what_changes_slowly_is_forgotten(self, axis: int, change: float, way: float):
        moved = _Contradiction((1.0, 2.0, 3.0), (0.1, 0.2, 0.3))
        now = _forgotten(moved, axis, change)
        assert now.angles == moved.angles
        errors = list(moved.errors)
        errors[axis] += way
        assert now.errors == tuple(errors)

    def test_a_leg_is_looked_at_out_of_turn_while_it_stands_still(self):
        standing, looked_at = np.zeros(12, np.int64), []
        legs = Legs(ROBOT, signals(), standing, PERIOD)

        too_old: set[int] = set()

        def compare(leg: int, _: object) -> _Contradiction | None:
            if leg in too_old:
                return None
            looked_at.append(leg)
            return _Contradiction((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))

        legs._compare = compare  # type: ignore[method-assign]

        def look(judge: Callable[[None], bool]) -> list[int]:
            looked_at.clear()
            assert not judge(None)
            return looked_at.copy()

        left, right = legs.judge_left, legs.judge_right
        for stands, orders in (
            ([], ([0], [1])),
            ([0], ([0], [1, 0])),
            ([3], ([0], [1, 0])),
            ([4, 11], ([0], [1])),  # ankles
            ([6], ([0, 1], [1])),
            ([9], ([0, 1], [1])),
        ):
            standing[:] = np.isin(range(12), stands)
            assert (look(left), look(right)) == orders
        standing[:] = 0
        for leg, judge in enumerate((right, left)):
            legs._stuck[leg] = (Finding(Dtc.ENC_STUCK, "", 0.0, True, ""),)
            assert look(judge) == [1 - leg, leg]
        standing[:] = 1
        for leg in (0, 1):
            too_old = {leg}
            assert look(left) == look(right) == [1 - leg]

    def test_one_sample_is_a_stray(self):
        machine, turn = self.standing(JOINTS.index("left_TH"))
        for _ in range(5):
            turn(0.1)
            assert machine.run(16, self.still) == ()
            turn(0.0)
            assert machine.run(16, self.still) == ()

    def test_a_leg_that_turns_about_another_axis_does_not_show_how_its_imu_is_mounted(self):
        machine, turn = self.standing(JOINTS.index("left_SH"))
        askew = pinocchio.Quaternion(np.array([0.0, 0.0, math.sin(math.radians(0.4)), math.cos(math.radians(0.4))]))
        tibia, begin = IMUS.index("left_tibia"), machine.cycles

        def mounted(now: Signals) -> None:
            angle = -1.25 * PERIOD * (machine.cycles - begin)
            turn(angle)
            now.position[:] = MIDDLE * GEAR
            now.position[2] += angle * GEAR[2]
            now.velocity[2] = -1.25 * GEAR[2]
            w, x, y, z = now.quaternion[tibia]
            x, y, z, w = (pinocchio.Quaternion(np.array([x, y, z, w])) * askew).coeffs()
            now.quaternion[tibia] = w, x, y, z

        assert machine.run(400, mounted) == ()

    @pytest.mark.exhaustive
    def test_the_heading_of_an_imu_may_drift_under_a_robot_that_stands(self):
        machine = Machine(amplitude=0.0)

        def drift(now: Signals) -> None:
            half = 0.5 * 1.1e-3 * machine.time
            w, x, y, z = now.quaternion[1]
            c, s = math.cos(half), math.sin(half)
            now.quaternion[1] = c * w - s * z, c * x - s * y, c * y + s * x, c * z + s * w

        assert machine.run(6500, drift) == ()


class TestFrozenImu:
    @imus
    @pytest.mark.parametrize("phase", [0, 7, 15])
    def test_found_within_a_hundred_cycles(self, imu: int, phase: int):
        machine = Machine()
        machine.run(20 + phase)
        frozen = machine.now.gyro[imu].copy()

        def freeze(now: Signals) -> None:
            now.gyro[imu] = frozen

        assert 80 < machine.until_found(Dtc.IMU_STUCK, 100, freeze) <= 96
        finding = only(machine.checks.findings)
        assert (finding.node, finding.value) == (f"IMU_{IMUS[imu].upper()}", 100.0)
        assert f"gyro of the {IMUS[imu]} IMU" in finding.text
        assert machine.refused == {row(f"IMU_{IMUS[imu]}"): 1}
        assert only(machine.run(20, freeze)) == finding
        assert machine.refused == {row(f"IMU_{IMUS[imu]}"): 21}
        assert machine.run(17) == ()
        assert machine.refused == {}

    def test_an_axis_alone_may_stand_still(self):
        machine = Machine()
        assert machine.run(300, lambda now: now.gyro.__setitem__((slice(None), slice(2)), 0.0)) == ()

    def test_a_lost_frame_does_not_count(self):
        machine = Machine()
        frozen = machine.now.gyro[0].copy()
        waited = 0
        while not machine.checks.findings:
            machine.missing = {row("IMU_torso")} if waited % 32 < 16 else set()
            machine.cycle(lambda now: now.gyro.__setitem__(0, frozen))
            waited += 1
        assert 150 < waited < 200


class TestStillnessAlone:
    """Sample by sample."""

    rng = np.random.default_rng(4)

    def stillness(self, every: int = 16) -> tuple[Stillness, ReceiveImage, Signals]:
        image = ReceiveImage(MESSAGES, np.zeros(CODEC.size))
        now = signals_of(CODEC, image.values)
        return Stillness(ROBOT, image, now, every), image, now

    def move(self, now: Signals) -> None:
        now.position[:] = MIDDLE * GEAR + 1e-3 * self.rng.random(12)
        now.gyro[:] = self.rng.random((4, 3))
        now.force[:] = self.rng.random((2, 4, 3))

    def test_at_first_nothing_stands_still(self):
        stillness, _, _ = self.stillness()
        assert not stillness.standing.any()
        assert stillness.findings() == ()

    @pytest.mark.parametrize(("every", "to_stuck", "to_freeze"), [(3, 16, 32), (4, 11, 24), (16, 2, 5)])
    def test_as_many_repetitions_are_needed_as_fit(self, every: int, to_stuck: int, to_freeze: int):
        def hold_encoder(now: Signals) -> None:
            now.position[7] = MIDDLE[7] * GEAR[7]

        def hold_gyro(now: Signals) -> None:
            now.gyro[2] = 1.0, 2.0, 3.0

        def hold_cell(now: Signals) -> None:
            now.force[1, 3, 0] = 1.0

        for hold, repetitions in ((hold_encoder, to_stuck), (hold_gyro, to_freeze), (hold_cell, to_freeze)):
            # That every node was heard is not looked up: here the image knows of none.
            stillness, _, now = self.stillness(every)
            for sample in range(repetitions + 2):
                self.move(now)
                hold(now)
                now.torque[:] = 100.0 * sample
                assert stillness.sample(True) is (sample >= repetitions)
                assert len(stillness.findings()) == (sample >= repetitions)
            self.move(now)
            assert not stillness.sample(True)
            assert stillness.findings() == ()

    @pytest.mark.parametrize("heard", [Check.OK, Check.SOME_LOST])
    def test_who_is_not_heard_is_neither_sampled_nor_counted(self, heard: Check):
        stillness, image, now = self.stillness()
        torso = row("IMU_torso")

        def sample(value: float, check: Check) -> bool:
            self.move(now)
            now.gyro[0] = value
            image.age += 16
            image.age[np.arange(len(MESSAGES)) != torso] = 0
            if check <= Check.SOME_LOST:
                image.age[torso] = 0
            return stillness.sample(False)

        assert not sample(1.0, heard)
        assert not sample(2.0, Check.NO_DATA)
        assert not sample(2.0, heard)  # other than the one before
        for _ in range(4):
            assert not sample(2.0, heard)
            assert not sample(2.0, Check.REPEATED)
        assert sample(2.0, heard)
        assert stillness.imus == [0]
        assert sample(3.0, Check.NO_DATA)
        assert not sample(3.0, heard)


class TestForceCells:
    @cells
    @pytest.mark.parametrize("axis", range(3))
    @pytest.mark.parametrize("value", [0.0, 400.0])
    def test_one_that_repeats_itself_is_silenced(self, foot: int, cell: int, axis: int, value: float):
        machine = Machine()
        machine.run(21)

        def stick(now: Signals) -> None:
            now.force[foot, cell, axis] = value

        assert 80 < machine.until_found(Dtc.FOOT_CELL, 100, stick) <= 96
        finding = only(machine.checks.findings)
        assert finding.node == f"FOOT_{FEET[foot].upper()}"
        assert f"force cell {CELLS[cell]} of the {FEET[foot]} foot repeats" in finding.text
        if axis == 2:
            assert finding.value == value
        assert not machine.now.force[foot, cell].any()
        assert np.count_nonzero(machine.now.force) == 21
        assert machine.refused == {}
        machine.run(30, stick)
        assert not machine.now.force[foot, cell].any()
        machine.missing = {row(f"FOOT_{FEET[foot]}")}
        machine.run(20, stick)
        machine.missing = set()
        assert only(machine.cycle(stick)).dtc is Dtc.FOOT_CELL
        assert machine.run(17) == ()
        assert machine.now.force[foot, cell].all()

    def stick_out(self, foot: int, cell: int, force: float) -> Change:
        return lambda now: now.force[foot, cell].__setitem__(2, force + now.force[foot, cell, 0])

    @cells
    @signs
    def test_one_that_carries_alone_contradicts_the_others(self, foot: int, cell: int, sign: float):
        machine = Machine()
        change = self.stick_out(foot, cell, sign * 200.0)
        assert 250 <= machine.until_found(Dtc.FOOT_CELL, 260, change) <= 260
        finding = only(machine.checks.findings)
        assert finding.node == f"FOOT_{FEET[foot].upper()}"
        assert finding.value == pytest.approx(sign * 200.0, abs=20.0)
        assert f"force cell {CELLS[cell]} of the {FEET[foot]} foot says" in finding.text
        assert not machine.now.force[foot, cell].any()
        assert only(machine.run(8, change)) == finding
        machine.missing = {row(f"FOOT_{FEET[foot]}")}
        assert only(machine.run(8)) == finding
        machine.missing = set()
        assert machine.run(5) == ()

    @cells
    def test_one_that_is_free_under_a_load_contradicts_the_others(self, foot: int, cell: int):
        machine = Machine(standing=True)
        heavy = machine.run(500, lambda now: now.force[foot, :, 2].__iadd__(20.0))
        assert heavy == ()

        def lift(now: Signals, load: float) -> None:
            now.force[foot, :, 2] = load / 3.0 + 0.1 * now.force[foot, :, 0]
            now.force[foot, cell, 2] = now.force[foot, cell, 0]

        assert machine.run(500, lambda now: lift(now, 296.0)) == ()
        assert machine.until_found(Dtc.FOOT_CELL, 260, lambda now: lift(now, 304.0)) >= 250
        finding = only(machine.checks.findings)
        assert finding.node == f"FOOT_{FEET[foot].upper()}"
        assert CELLS[cell] in finding.text

    def test_thresholds_of_free_and_alone(self):
        free = ROBOT.sensors.cell_free
        for force, found in ((free, False), (free * (1.0 + 1e-9), True)):
            machine = Machine()
            for cycle in range(300):
                exact = force * (1.0 - 1e-12 * (cycle % 3))
                machine.cycle(lambda now, exact=exact: now.force[1, 2].__setitem__(2, exact))
            assert bool(machine.checks._feet.cells) is found

    def test_two_cells_are_a_foot_that_rocks(self):
        machine = Machine()
        assert machine.run(600, lambda now: now.force[0, :2, 2].__iadd__(200.0)) == ()


class Plates:
    """The feet alone, looked at in every cycle."""

    def __init__(self) -> None:
        self.now = signals_of(CODEC, np.zeros(CODEC.size))
        self.feet = FootChecks(ROBOT, self.now, 1)

    def judge(self, left: list[float], right: list[float], heard: tuple[bool, bool] = (True, True)) -> bool:
        self.now.force[:, :, 2] = left, right
        return self.feet.judge(heard)


NOTHING, EVEN = [0.0] * 4, [100.0] * 4


class TestPlates:
    def test_who_carries_nothing_is_not_looked_at_cell_by_cell(self):
        plates = Plates()
        plates.feet._judge_cells = nobody  # type: ignore[method-assign]
        assert not plates.judge(NOTHING, [0.0, ROBOT.sensors.cell_free, 0.0, 0.0])

    def test_at_first_nothing_is_known(self):
        feet = Plates().feet
        assert (feet.swing, feet.cells, feet.findings()) == (None, {}, ())

    @pytest.mark.parametrize("foot", [0, 1])
    @pytest.mark.parametrize("cell", range(4))
    def test_a_cell_alone_contradicts_the_others_after_256_cycles_on_end(self, foot: int, cell: int):
        plates, loads = Plates(), [NOTHING, NOTHING]
        loads[foot] = [-200.0 if c == cell else 0.0 for c in range(4)]
        for _ in range(2):
            assert [plates.judge(*loads) for _ in range(257)] == [False] * 255 + [True] * 2
            assert plates.feet.cells == {(foot, cell): -200.0}
            told = f"force cell {CELLS[cell]} of the {FEET[foot]} foot says -200 N, which contradicts the other three"
            node = f"FOOT_{FEET[foot].upper()}"
            assert plates.feet.findings() == (Finding(Dtc.FOOT_CELL, node, -200.0, True, told),)
            # What is not heard is as it was.
            heard = foot == 1, foot == 0
            assert plates.judge(NOTHING, NOTHING, heard)
            assert not plates.judge(NOTHING, NOTHING)
            assert plates.feet.cells == {}

    def test_a_free_cell_contradicts_three_that_carry_more_than_the_load(self):
        loaded, free = ROBOT.sensors.cell_loaded, ROBOT.sensors.cell_free
        third = loaded / 3.0
        for others, found in (
            ([third] * 3, False),
            ([third, third, third + 1.0], True),
            ([loaded, loaded, free], False),
        ):
            plates = Plates()
            for _ in range(256):
                last = plates.judge([*others, free], EVEN)
            assert last is found

    def test_two_cells_stand_and_one_does_not(self):
        free = ROBOT.sensors.cell_free
        plates = Plates()
        for cells, stands in (([free + 1.0, free, 0.0, 0.0], False), ([free + 1.0, -free - 1.0, 0.0, 0.0], True)):
            plates.judge(cells, NOTHING)
            assert plates.feet.swing == (1 if stands else None)
        plates.judge(NOTHING, EVEN)
        assert plates.feet.swing == 0
        plates.judge(EVEN, EVEN)
        assert plates.feet.swing is None

    def test_both_swing_from_the_twentieth_cycle_to_the_hundredth(self):
        plates = Plates()
        for _ in range(2):
            assert not plates.judge(EVEN, NOTHING)
            assert [plates.judge(NOTHING, NOTHING) for _ in range(100)] == [False] * 19 + [True] * 80 + [False]
            assert not plates.judge(NOTHING, NOTHING)
        plates.judge(EVEN, NOTHING)
        for _ in range(20):
            plates.judge(NOTHING, NOTHING)
        assert [f.text for f in plates.feet.findings()] == ["both feet say that they swing on the ground"]
        assert not plates.judge(EVEN, NOTHING)
        assert plates.feet.findings() == ()


class TestContact:
    def stand(self, machine: Machine, cycles: int, cells: int = 4, force: float = 200.0) -> tuple[Finding, ...]:
        return machine.run(cycles, lambda now: now.force[1, :cells, 2].__iadd__(force))

    @pytest.mark.parametrize("phase", range(4))
    @pytest.mark.parametrize("cells", [2, 4])
    def test_both_feet_off_the_ground_are_found_within_twenty_cycles(self, phase: int, cells: int):
        machine = Machine()
        machine.run(phase)
        assert self.stand(machine, 40, cells) == ()
        assert 16 < machine.until_found(Dtc.CONTACT_IMPLAUSIBLE, 24, lambda now: None) <= 20
        finding = only(machine.checks.findings)
        assert (finding.node, finding.value, finding.confirmed) == ("FOOT_LEFT", 20.0, True)
        assert "both feet" in finding.text
        assert only(machine.run(72)) is finding
        assert machine.run(12) == ()
        assert machine.run(100) == ()

    def test_standing_again_ends_it(self):
        machine = Machine()
        self.stand(machine, 8)
        machine.run(30)
        assert machine.checks.findings
        assert self.stand(machine, 4) == ()

    def test_nineteen_cycles_are_a_jolt(self):
        machine = Machine()
        for _ in range(5):
            self.stand(machine, 8)
            for _ in range(16):
                assert machine.cycle() == ()

    def test_who_stands_on_one_leg_swings_the_other(self):
        machine = Machine()
        assert machine.checks.swing is None
        self.stand(machine, 4)
        assert machine.checks.swing == 0
        machine.run(4, lambda now: now.force[0, :, 2].__iadd__(200.0))
        assert machine.checks.swing == 1
        machine.run(4, lambda now: now.force[:, :, 2].__iadd__(200.0))
        assert machine.checks.swing is None
        machine.run(4)
        assert machine.checks.swing is None

    def test_one_cell_is_no_foot_on_the_ground(self):
        machine = Machine()
        self.stand(machine, 100, cells=1)
        assert machine.run(100) == ()


def test_what_was_kept_is_what_was_good_last():
    """A jump, a lost frame and another jump: the value of before the first is in use all the time."""
    machine = Machine()
    good = float(machine.now.position[4])
    for change, missing in ((1.0, set()), (0.0, {row("left_SA")}), (1.0, set())):
        machine.missing = missing
        machine.cycle(lambda now, change=change: now.position.__setitem__(4, change * GEAR[4]))
        assert machine.now.position[4] == good
    assert machine.refused == {row("left_SA"): 3}
    assert only(machine.checks.findings).dtc is Dtc.ENC_JUMP


def test_two_machines_alike_find_alike():
    def run(machine: Machine) -> list[Any]:
        machine.run(10)
        return [machine.cycle(lambda now: now.position.__setitem__(2, 0.0)) for _ in range(40)]

    assert run(Machine()) == run(Machine())


def test_which_check_is_made_in_which_cycle(monkeypatch: pytest.MonkeyPatch):
    made: list[str] = []
    for owner, name in (
        (Stillness, "sample"),
        (EncoderChecks, "judge_velocity"),
        (Legs, "judge_left"),
        (Legs, "judge_right"),
        (FootChecks, "judge"),
        (Unchecked, "judge"),
    ):
        monkeypatch.setattr(owner, name, lambda *_, name=f"{owner.__name__}.{name}": bool(made.append(name)))
    image = ReceiveImage(MESSAGES, np.zeros(CODEC.size))
    checks = Plausibility(ROBOT, image, PERIOD)
    assert checks.findings == ()
    expected = {0: "Stillness.sample", 2: "EncoderChecks.judge_velocity", 4: "Unchecked.judge"}
    expected |= {cycle + 16: name for cycle, name in expected.items()}
    expected |= {8: "Legs.judge_left", 24: "Legs.judge_right"}
    expected |= dict.fromkeys(range(1, 32, 4), "FootChecks.judge")
    for cycle in range(64):
        assert checks.check() == ()
        assert made == ([expected[cycle % 32]] if cycle % 32 in expected else [])
        made.clear()


def test_rows_are_judged_one_by_one_only_where_something_is_wrong():
    machine = Machine()
    judge_rows, machine.checks._judge_rows = machine.checks._judge_rows, nobody  # type: ignore[method-assign]
    assert machine.run(64) == ()
    machine.checks._judge_rows = judge_rows  # type: ignore[method-assign]
    machine.missing = {row("left_FH"), row("IMU_pelvis")}
    machine.run(3)
    machine.missing = set()
    machine.run(1)
    machine.checks._judge_rows = nobody  # type: ignore[method-assign]
    assert machine.run(64) == ()


def test_who_is_not_heard_hides_nobody_who_jumps():
    machine = Machine()
    machine.missing = {row("left_FH")}
    assert only(machine.cycle(lambda now: now.position.__setitem__(5, 100.0 * GEAR[5]))).node == "LEFT_HA"
    assert machine.refused == {row("left_HA"): 1}


class TestAfterALoss:
    """A frame after one that was lost is as good as any."""

    def test_a_joint_that_jumps_is_found(self):
        machine = Machine()
        machine.gaps = {row("left_SH")}
        assert only(machine.cycle(lambda now: now.position.__setitem__(2, 100.0 * GEAR[2]))).node == "LEFT_SH"
        assert machine.refused == {row("left_SH"): 1}

    @pytest.mark.parametrize(("foot", "cell"), [(0, 3), (1, 0)])
    def test_a_cell_that_contradicts_the_others_is_found(self, foot: int, cell: int):
        machine = Machine()
        machine.gaps = {row(f"FOOT_{FEET[foot]}")}
        push = TestForceCells().stick_out(foot, cell, 200.0)
        assert machine.until_found(Dtc.FOOT_CELL, 260, push) >= 250

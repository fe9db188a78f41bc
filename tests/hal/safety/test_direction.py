"""Test of the directions before ACTIVE: pulse, mobility, and simulated joints with and without a motor fault."""

from __future__ import annotations

import numpy as np
import pytest

from atalante_hal.robot import JOINTS, load_robot
from atalante_hal.safety.direction import (
    BOOST,
    GROUPS,
    LATENCIES,
    LATENCY,
    MOBILITY,
    PEAK,
    TRAVEL,
    TRIALS,
    DirectionProof,
    mobilities_of,
    pose_gains,
    pulse,
)
from atalante_hal.types import PERIOD

ROBOT = load_robot()
KNEE, ANKLE = JOINTS.index("left_SK"), JOINTS.index("left_SA")
MIDDLE = 0.5 * (ROBOT.position_min + ROBOT.position_max)
INERTIA = 0.4 / np.array(MOBILITY * 2)  # kg m2
NO_FORCE, LOADED = np.zeros((2, 4)), np.array([[50.0] * 4, [0.0] * 4])  # vertical forces on the cells of both feet [N]
#: Cycles of a test of 19 cycles in which a loaded foot reports its load.
MOST = range(3, 19)
#: Longest test of the directions if every joint passes at once [cycles].
ONCE = sum(duration + LATENCY + 1 for _, duration in GROUPS)


@pytest.mark.parametrize("duration", [16, 32])
def test_pulse_moves_a_free_inertia_away_and_back(duration: int):
    shape = np.array([pulse(cycle, duration) for cycle in range(-1, duration + 2)])
    assert shape.min() == -1.0
    assert 0.5 < shape.max() <= 0.5625
    assert shape[0] == shape[-1] == 0.0
    velocity = np.cumsum(shape)
    assert velocity[-1] == pytest.approx(0.0, abs=1e-9)
    assert np.cumsum(velocity)[-1] == pytest.approx(0.0, abs=1e-9)
    assert np.cumsum(velocity).min() >= -1e-9


def motion(latency: int, inertia: float) -> tuple[np.ndarray, np.ndarray]:
    """Return pulse and position of an inertia that moves in a field of gravity and follows its torque after a delay."""
    torque = np.array([[20.0 * pulse(cycle, 32)] for cycle in range(35)])
    acting = np.concatenate([np.zeros((latency, 1)), torque[:-latency]])
    falls = 0.3 + 0.2 * np.linspace(0.0, 1.0, 35)[:, None] ** 2
    return torque, falls + np.cumsum(np.cumsum(acting, axis=0), axis=0) * PERIOD**2 / inertia


@pytest.mark.parametrize("latency", LATENCIES)
@pytest.mark.parametrize("inertia", [0.05, -2.0, 8.0])
def test_mobility_is_that_of_the_simulated_inertia_despite_its_weight_and_delay(inertia: float, latency: int):
    mobility, explained = mobilities_of(*motion(latency, inertia))
    row = LATENCIES.index(latency)
    assert mobility.shape == explained.shape == (len(LATENCIES), 1)
    assert mobility[row] == pytest.approx([1.0 / inertia], rel=1e-6)
    assert explained[row] == pytest.approx([np.sign(inertia)], rel=1e-6)
    assert np.abs(np.delete(explained, row)).max() < 0.97


def test_explained_shares_of_joints_with_different_motions_are_independent():
    torque, small = motion(LATENCY, 8.0)
    _, large = motion(LATENCY, 0.05)
    _, explained = mobilities_of(np.hstack([torque, torque]), np.hstack([small, large]))
    assert explained[0] == pytest.approx([1.0, 1.0], rel=1e-6)


def test_mobility_of_a_joint_without_torque_change_is_zero():
    mobility, explained = mobilities_of(np.full((20, 1), 5.0), np.linspace(0.0, 1.0, 20)[:, None] ** 5)
    assert not mobility.any()
    assert not explained.any()


def test_motion_of_a_joint_that_stands_still_is_not_explained():
    mobility, explained = mobilities_of(motion(LATENCY, 1.0)[0], np.full((35, 1), 0.2))
    assert np.abs(mobility).max() < 1e-12
    assert np.isfinite(explained).all()


class Joints:
    """Twelve independent joints, with `strength` as the ratio of true torque to sent torque."""

    def __init__(self, proof: DirectionProof) -> None:
        self.proof, self.strength = proof, np.ones(12)
        self.position, self.velocity = MIDDLE.copy(), np.zeros(12)
        self.delay(0)
        self.weight = np.zeros(12)  # torque of the weight [Nm]
        self.encoder = np.arange(12)  # joint that each encoder measures

    def delay(self, late: int) -> None:
        """Let all torques act some cycles later."""
        self._pending = [np.zeros(12)] * (LATENCY - 1 + late)

    def run(self, force: np.ndarray = NO_FORCE, cycles: int = 500, within: range = MOST) -> tuple[str, int]:
        encoder = self.encoder
        self.proof.begin(self.position[encoder], np.zeros(12))
        for cycle in range(cycles):
            if not self.proof.running:
                return "", cycle
            torque = self.proof.torque(self.position[encoder], self.velocity[encoder])
            self.proof.sent(torque)
            self._pending.append(torque)
            self.velocity = self.velocity + PERIOD * (self.strength * self._pending.pop(0) + self.weight) / INERTIA
            self.position = self.position + PERIOD * self.velocity
            stopped = (self.position < ROBOT.position_min) | (self.position > ROBOT.position_max)
            self.position = np.clip(self.position, ROBOT.position_min, ROBOT.position_max)
            self.velocity[stopped] = 0.0
            if failure := self.proof.evaluate(
                self.position[encoder], force if (cycle - 16) % 19 in within else NO_FORCE
            ):
                return failure, cycle
        raise AssertionError("the test of the directions must end")


@pytest.fixture
def joints() -> Joints:
    return Joints(DirectionProof(ROBOT))


def test_every_joint_with_the_right_sign_passes_with_its_mobility(joints: Joints):
    assert joints.run() == ("", ONCE)
    assert joints.proof.proven.all()
    assert not joints.proof.failed
    assert joints.proof.mobility == pytest.approx(1.0 / INERTIA, rel=0.05)
    assert joints.proof.report().startswith(f"effective inertia [kg m2]: left_FH {INERTIA[0]:.1f}")
    assert "not tested" not in joints.proof.report()


@pytest.mark.parametrize("late", range(1, len(LATENCIES)))
def test_joints_pass_although_their_torque_acts_late(joints: Joints, late: int):
    assert joints.proof.late == 0
    joints.delay(late)
    assert joints.run() == ("", ONCE)
    assert joints.proof.late == late
    assert joints.proof.mobility == pytest.approx(1.0 / INERTIA, rel=0.2)
    assert joints.proof.report().startswith("effective inertia [kg m2]: left_FH")
    assert joints.proof.report().endswith(f"; torques {late} ms late")


def test_each_start_measures_the_delay_again(joints: Joints):
    for late in (3, 0, 3):
        joints.delay(late)
        joints.run()
        assert joints.proof.late == late


def test_start_in_which_no_joint_passes_keeps_the_delay(joints: Joints):
    joints.delay(3)
    joints.run()
    joints.strength[:] = 0.0
    joints.run(np.full((2, 4), 125.0), within=range(1000))
    assert not joints.proof.proven.any()
    assert joints.proof.late == 3


def delays(monkeypatch: pytest.MonkeyPatch, joints: Joints, *late: int) -> None:
    """Let the torques in each of the first tests act with another delay."""
    sent, ends, count = joints.proof.sent, [0], 0
    for _, duration in GROUPS:
        ends.append(ends[-1] + duration + LATENCY + 1)

    def counted(torque: np.ndarray) -> None:
        nonlocal count
        if count in ends[: len(late)]:
            joints.delay(late[ends.index(count)])
        count += 1
        sent(torque)

    monkeypatch.setattr(joints.proof, "sent", counted)


def test_only_short_pulses_measure_the_delay(joints: Joints, monkeypatch: pytest.MonkeyPatch):
    delays(monkeypatch, joints, 0, 2, 2)
    assert joints.run() == ("", ONCE)
    assert joints.proof.late == 2


def test_all_short_pulses_measure_the_delay(joints: Joints, monkeypatch: pytest.MonkeyPatch):
    """Knee and ankle of the loaded left leg do not move, so fewer joints have the smaller delay."""
    delays(monkeypatch, joints, 2, 2, 1)
    joints.strength[[3, 5]] = 0.0
    assert joints.run(on_foot(0, 500.0), within=range(19))[0] == ""
    assert joints.proof.late == 2


def test_joints_that_fail_do_not_change_the_delay(joints: Joints):
    joints.delay(2)
    joints.strength[[4, 10]] = 1e-3
    joints.run()
    assert joints.proof.late == 2


@pytest.mark.parametrize("late", range(1, len(LATENCIES)))
@pytest.mark.parametrize("joint", range(6), ids=JOINTS[:6])
def test_reversed_motor_fails_although_its_torque_acts_late(joints: Joints, joint: int, late: int):
    joints.delay(late)
    joints.strength[joint] = -1.0
    failure, _ = joints.run()
    assert failure.startswith(f"{JOINTS[joint]} moves against its torque") or "deg in the test" in failure


@pytest.mark.parametrize("joint", range(6), ids=JOINTS[:6])
def test_reversed_motor_fails_again_in_a_second_start(joints: Joints, joint: int):
    joints.strength[joint] = -1.0
    assert joints.run()[0]
    joints.position, joints.velocity = MIDDLE.copy(), np.zeros(12)
    failure, _ = joints.run()
    assert failure.startswith(JOINTS[joint])


def test_each_start_tests_all_joints_again(joints: Joints):
    assert joints.run() == joints.run() == ("", ONCE)
    joints.strength[ANKLE] = -1.0
    assert joints.run()[0].startswith(JOINTS[ANKLE])


def test_without_groups_no_joint_is_tested():
    proof = DirectionProof(ROBOT, ())
    proof.begin(MIDDLE, np.zeros(12))
    assert not proof.running


@pytest.mark.parametrize("joint", range(12), ids=JOINTS)
def test_dead_motor_fails_after_all_trials(joints: Joints, joint: int):
    joints.strength[joint] = 0.0
    failure, _ = joints.run()
    assert (
        failure
        == f"{JOINTS[joint]} does not follow its torque (mobility 0; must be at least {joints.proof._least[joint]:g})"
    )
    assert joints.proof.failed == [joint]
    assert joints.proof._trials[joint] == TRIALS
    assert not joints.proof.running


@pytest.mark.parametrize("joint", range(12), ids=JOINTS)
@pytest.mark.parametrize("force", [NO_FORCE, LOADED], ids=["suspended", "loaded"])
def test_reversed_motor_fails_also_under_load(joints: Joints, joint: int, force: np.ndarray):
    joints.strength[joint] = -1.0
    failure, _ = joints.run(force)
    assert failure.startswith((f"{JOINTS[joint]} moves against its torque", f"{JOINTS[joint]} moved by "))
    assert joints.proof.failed == [joint]


@pytest.mark.parametrize("joint", range(6), ids=JOINTS[:6])
def test_exchanged_encoders_of_both_legs_fail(joints: Joints, joint: int):
    """The torque pulses of both legs are opposite, so the encoder of the other leg moves against the torque."""
    joints.encoder[[joint, joint + 6]] = joint + 6, joint
    failure = joints.run()[0]
    assert failure.startswith((f"{JOINTS[joint]} moves against its torque", f"{JOINTS[joint]} moved by "))
    assert not joints.proof.proven[[joint, joint + 6]].any()


@pytest.mark.parametrize("pressed", [KNEE, KNEE + 6])
@pytest.mark.parametrize("stop", ["position_min", "position_max"])
def test_pulses_of_both_legs_move_a_joint_at_its_end_stop_towards_the_middle(pressed: int, stop: str):
    proof, anchor = DirectionProof(ROBOT), MIDDLE.copy()
    anchor[pressed] = getattr(ROBOT, stop)[pressed]
    anchor[KNEE + 6 if pressed == KNEE else KNEE] += 0.1 if stop == "position_max" else -0.1
    proof.begin(anchor, np.zeros(12))
    away = -1.0 if stop == "position_max" else 1.0
    assert proof._sign[[KNEE, KNEE + 6]].tolist() == [away, away]


def test_joint_that_does_not_move_under_load_stays_untested(joints: Joints):
    joints.strength[[KNEE, ANKLE, ANKLE + 6]] = 0.0, 0.0, 1.0
    assert joints.run(LOADED)[0] == ""
    assert np.flatnonzero(~joints.proof.proven).tolist() == [KNEE, ANKLE]
    assert joints.proof.report().endswith("; not tested under load: left_SK, left_SA")


def test_load_on_one_foot_does_not_explain_a_dead_motor_of_the_other_leg(joints: Joints):
    joints.strength[ANKLE + 6] = 0.0
    assert joints.run(LOADED)[0].startswith("right_SA does not follow its torque")


@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_joint_that_its_weight_presses_onto_its_end_stop_passes(joints: Joints, sign: float):
    joints.position[ANKLE] = ROBOT.position_max[ANKLE] if sign > 0.0 else ROBOT.position_min[ANKLE]
    joints.weight[ANKLE] = sign * 0.6 * PEAK[4] * ROBOT.breakaway[ANKLE]
    assert joints.run()[0] == ""
    assert joints.proof.proven.all()


def test_dead_joint_at_its_end_stop_fails(joints: Joints):
    joints.position[ANKLE] = ROBOT.position_max[ANKLE]
    joints.strength[ANKLE] = 0.0
    assert joints.run()[0].startswith("left_SA does not follow its torque")


@pytest.mark.parametrize("force", [10.0, -10.0])
def test_noise_of_the_feet_is_no_load(joints: Joints, force: float):
    joints.strength[KNEE] = 0.0
    assert joints.run(np.full((2, 4), force / 4.0))[0].startswith("left_SK does not follow its torque")


def on_foot(foot: int, force: float) -> np.ndarray:
    """Return the vertical forces on the cells of both feet if a foot carries a force that its cells share."""
    return np.outer(np.eye(2)[foot], np.full(4, force / 4.0))


@pytest.mark.parametrize("offset", [25.0, -25.0, 79.0, 130.0])
@pytest.mark.parametrize("foot", [0, 1])
def test_offset_of_one_force_cell_does_not_hide_a_dead_motor(joints: Joints, foot: int, offset: float):
    knee = KNEE + 6 * foot
    joints.strength[knee] = 0.0
    force = NO_FORCE.copy()
    force[foot, 2] = offset
    assert joints.run(force, within=range(19))[0].startswith(f"{JOINTS[knee]} does not follow its torque")


@pytest.mark.parametrize(
    ("cells", "tested"),
    [
        ([30.0, 30.0, 0.0, 0.0], False),
        ([30.0, 10.1, 0.0, 0.0], False),
        ([30.0, 10.0, 0.0, 0.0], True),
        ([15.0, 15.0, -10.0, 0.0], True),
        ([10.1, 9.8, 0.0, 0.0], True),
        ([10.1, 10.1, -0.3, 0.0], True),
        ([30.0, -30.0, 0.0, 0.0], True),
    ],
)
def test_foot_is_loaded_if_the_sum_and_two_cells_are(joints: Joints, cells: list[float], tested: bool):
    joints.strength[KNEE] = 0.0
    failure = joints.run(np.array([cells, [0.0] * 4]), within=range(19))[0]
    assert failure.startswith("left_SK does not follow its torque") if tested else failure == ""


@pytest.mark.parametrize(
    ("cells", "tested"),
    [
        ([[30.0, 30.0, 0.0, 0.0], [-30.0, -30.0, 0.0, 0.0]], False),
        ([[30.0, 0.0, 0.0, 0.0], [30.0, 0.0, 0.0, 0.0]], True),
    ],
)
def test_load_of_a_foot_does_not_depend_on_the_other_foot(joints: Joints, cells: list[list[float]], tested: bool):
    joints.strength[KNEE] = 0.0
    failure = joints.run(np.array(cells), within=range(19))[0]
    assert failure.startswith("left_SK does not follow its torque") if tested else failure == ""


@pytest.mark.parametrize(
    ("force", "cycles", "tested"),
    [(75.0, 2, False), (-75.0, 2, False), (61.0, 2, False), (121.0, 1, False), (60.0, 2, True), (120.0, 1, True)],
)
@pytest.mark.parametrize("foot", [0, 1])
def test_joint_whose_foot_hits_the_floor_stays_untested(
    joints: Joints, foot: int, force: float, cycles: int, tested: bool
):
    """An impact of one or two cycles hardly changes the mean force in a test of 19 cycles."""
    ankle = ANKLE + 6 * foot
    joints.strength[ankle] = 0.0
    within = range(10, 10 + cycles)
    failure = joints.run(on_foot(foot, force), within=within)[0]
    assert failure.startswith(f"{JOINTS[ankle]} does not follow its torque") if tested else failure == ""
    assert not joints.proof.proven[ankle]
    assert joints.run(on_foot(1 - foot, force), within=within)[0].startswith(f"{JOINTS[ankle]} does not follow")


def test_failure_names_every_joint_and_the_report_lists_them_in_order(joints: Joints):
    joints.strength[[KNEE, KNEE + 6]] = 0.0
    failure = joints.run()[0]
    assert failure.count(", ") == 1
    assert failure.split(", ")[1].startswith("right_SK does not follow its torque")
    report = joints.proof.report()
    assert report.startswith("effective inertia [kg m2]: left_FH 8.9, left_TH 1.7, left_SH 5.3, ")


def test_new_test_of_the_directions_has_not_begun():
    proof = DirectionProof(ROBOT)
    assert proof.running is False
    assert proof.failed == []
    assert not proof.proven.any()


def test_torque_is_pose_control_and_pulse_that_is_opposite_in_both_legs():
    rng, proof = np.random.default_rng(1), DirectionProof(ROBOT)
    anchor = MIDDLE + np.tile([0.1, -0.1, -0.1, 0.1], 3)
    anchor[0] = MIDDLE[0]
    base, (kp, kd) = rng.normal(size=12), pose_gains(ROBOT)
    tested = [JOINTS.index(f"{side}_{name}") for side in ("left", "right") for name in ("FH", "SH")]
    peak = np.zeros(12)
    sign = np.where(anchor < MIDDLE, 1.0, -1.0)
    sign[6:] = -sign[:6]
    peak[tested] = (sign * np.array(PEAK * 2) * ROBOT.breakaway)[tested]
    proof.begin(anchor, base)
    for cycle in range(32):
        position, velocity = anchor + 1e-3 * rng.normal(size=12), 0.1 * rng.normal(size=12)
        spring = kp * (anchor - position)
        base = base + spring * (PERIOD / 0.03)
        expected = base + spring - kd * velocity + peak * pulse(cycle, 32)
        np.testing.assert_allclose(proof.torque(position, velocity), expected, rtol=1e-12, atol=1e-12)


def test_only_a_repeated_test_of_a_joint_at_its_limit_has_a_larger_pulse():
    proof, tolerance = DirectionProof(ROBOT), ROBOT.thresholds.position_tolerance
    left_fh, left_sh, right_fh, right_sh = (
        JOINTS.index(name) for name in ("left_FH", "left_SH", "right_FH", "right_SH")
    )
    anchor = MIDDLE.copy()
    anchor[left_fh], anchor[left_sh] = ROBOT.position_min[left_fh], ROBOT.position_max[left_sh]
    anchor[right_fh], anchor[right_sh] = (
        ROBOT.position_min[right_fh] + tolerance,
        ROBOT.position_max[right_sh] - tolerance,
    )
    proof.begin(anchor, np.zeros(12))
    largest = []
    for _ in range(TRIALS):
        sums = []
        for _ in range(32 + LATENCY + 1):
            torque = proof.torque(anchor, np.zeros(12))
            proof.sent(torque)
            sums.append(np.abs(torque))
            failure = proof.evaluate(anchor, NO_FORCE)
        largest.append(np.max(sums, axis=0))
    joints = [left_fh, left_sh, right_fh, right_sh]
    np.testing.assert_allclose(largest[0][joints], (np.array(PEAK * 2) * ROBOT.breakaway)[joints])
    np.testing.assert_allclose(largest[1][joints] / largest[0][joints], [BOOST, BOOST, 1.0, 1.0])
    assert failure.count("does not follow its torque") == 4


def test_large_motion_names_the_joint_and_not_a_lighter_one_before_it():
    proof = DirectionProof(ROBOT)
    proof.begin(MIDDLE, np.zeros(12))
    proof.sent(proof.torque(MIDDLE, np.zeros(12)))
    position = MIDDLE.copy()
    position[[JOINTS.index("left_TH"), JOINTS.index("left_SH")]] += [0.6 * TRAVEL, 1.1 * TRAVEL]
    motion = "left_SH moved by 1.6 deg in the test of its direction; each joint may move by at most 1.5 deg"
    assert proof.evaluate(position, NO_FORCE) == motion


def test_start_that_ends_early_has_no_mobility_of_an_earlier_start(joints: Joints):
    joints.run()
    assert joints.proof.mobility.all()
    joints.weight[0] = 1e4
    assert "moved by" in joints.run()[0]
    assert joints.proof.mobility.tolist() == [0.0] * 12


def test_large_motion_names_the_joint_that_its_pose_control_holds_most_strongly(joints: Joints):
    joints.proof.begin(joints.position, np.zeros(12))
    joints.proof.torque(joints.position, joints.velocity)
    joints.proof.sent(np.zeros(12))
    moved = joints.position.copy()
    moved[[0, 2, 5, 8]] += 0.9 * TRAVEL, 0.6 * TRAVEL, 1.1 * TRAVEL, 0.6 * TRAVEL
    failure = joints.proof.evaluate(moved, NO_FORCE)
    motion = f"moved by {0.9 * 1.5:.1f} deg in the test of its direction"
    other = f"{JOINTS[5]} moved by {1.1 * 1.5:.1f} deg"
    assert failure == f"left_FH {motion}, and {other}; each joint may move by at most 1.5 deg"
    assert joints.proof.failed == [0, 2, 5, 8]

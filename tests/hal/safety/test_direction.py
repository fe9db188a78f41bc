"""Test of the directions before ACTIVE: pulse, mobility, and simulated joints with and without a motor fault."""

from __future__ import annotations

import numpy as np
import pytest

from atalante_hal.robot import JOINTS, load_robot
from atalante_hal.safety.direction import (
    GROUPS,
    LATENCY,
    MOBILITY,
    PEAK,
    TRAVEL,
    TRIALS,
    DirectionProof,
    mobility_of,
    pulse,
)
from atalante_hal.types import PERIOD

ROBOT = load_robot()
KNEE, ANKLE = JOINTS.index("left_SK"), JOINTS.index("left_SA")
MIDDLE = 0.5 * (ROBOT.position_min + ROBOT.position_max)
INERTIA = 0.4 / np.array(MOBILITY * 2)  # kg m2
NO_FORCE, LOADED = np.zeros(2), np.array([200.0, 0.0])
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


@pytest.mark.parametrize("inertia", [0.05, -2.0, 8.0])
def test_mobility_is_that_of_the_simulated_inertia_despite_its_weight(inertia: float):
    torque = np.array([[20.0 * pulse(cycle, 32)] for cycle in range(35)])
    acting = np.concatenate([np.zeros((LATENCY, 1)), torque[:-LATENCY]])
    falls = 0.3 + 0.2 * np.linspace(0.0, 1.0, 35)[:, None] ** 2
    position = falls + np.cumsum(np.cumsum(acting, axis=0), axis=0) * PERIOD**2 / inertia
    assert mobility_of(torque, position) == pytest.approx([1.0 / inertia], rel=1e-6)


def test_mobility_of_a_joint_without_torque_change_is_zero():
    assert mobility_of(np.full((20, 1), 5.0), np.linspace(0.0, 1.0, 20)[:, None] ** 5).tolist() == [0.0]


class Joints:
    """Twelve independent joints, with `strength` as the ratio of true torque to sent torque."""

    def __init__(self, proof: DirectionProof) -> None:
        self.proof, self.strength = proof, np.ones(12)
        self.position, self.velocity = MIDDLE.copy(), np.zeros(12)
        self._pending = [np.zeros(12)] * (LATENCY - 1)
        self.weight = np.zeros(12)  # torque of the weight [Nm]

    def run(self, force: np.ndarray = NO_FORCE, cycles: int = 500) -> tuple[str, int]:
        self.proof.begin(self.position, np.zeros(12))
        for cycle in range(cycles):
            if not self.proof.running:
                return "", cycle
            torque = self.proof.torque(self.position, self.velocity)
            self.proof.sent(torque)
            self._pending.append(torque)
            self.velocity = self.velocity + PERIOD * (self.strength * self._pending.pop(0) + self.weight) / INERTIA
            self.position = self.position + PERIOD * self.velocity
            stopped = (self.position < ROBOT.position_min) | (self.position > ROBOT.position_max)
            self.position = np.clip(self.position, ROBOT.position_min, ROBOT.position_max)
            self.velocity[stopped] = 0.0
            if failure := self.proof.evaluate(self.position, force):
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


def test_joints_that_passed_are_not_tested_again_until_their_drive_restarts(joints: Joints):
    joints.run()
    assert joints.run() == ("", 0)
    joints.proof.forget(ANKLE)
    assert joints.run() == ("", GROUPS[1][1] + LATENCY + 1)
    assert joints.proof.proven.all()


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


def test_joint_that_does_not_move_under_load_stays_untested(joints: Joints):
    joints.strength[[KNEE, ANKLE, ANKLE + 6]] = 0.0, 0.0, 1.0
    assert joints.run(LOADED)[0] == ""
    assert np.flatnonzero(~joints.proof.proven).tolist() == [KNEE, ANKLE]
    assert joints.proof.report().endswith("; not tested under load: left_SK, left_SA")


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


def test_large_motion_names_the_joint_that_its_pose_control_holds_most_strongly(joints: Joints):
    joints.proof.begin(joints.position, np.zeros(12))
    joints.proof.torque(joints.position, joints.velocity)
    joints.proof.sent(np.zeros(12))
    moved = joints.position.copy()
    moved[[0, 2, 5, 8]] += 0.9 * TRAVEL, 0.6 * TRAVEL, 1.1 * TRAVEL, 0.6 * TRAVEL
    failure = joints.proof.evaluate(moved, NO_FORCE)
    assert failure == f"left_FH moved by {0.9 * 1.5:.1f} deg in the test of its direction; must be within 1.5 deg"
    assert joints.proof.failed == [0, 2, 5, 8]

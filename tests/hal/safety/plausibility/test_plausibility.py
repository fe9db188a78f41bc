"""Schedule of the plausibility checks: a healthy robot has no findings, and rejected values are not used."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from simulated_robot import CODEC, GEAR, MESSAGES, PERIOD, ROBOT, SimulatedRobot, must_not_be_called, only, row

from atalante_hal.robot import JOINTS
from atalante_hal.safety.diagnostics import Dtc
from atalante_hal.safety.plausibility import Plausibility
from atalante_hal.safety.plausibility.encoders import EncoderChecks
from atalante_hal.safety.plausibility.feet import FootChecks
from atalante_hal.safety.plausibility.imus import Imus
from atalante_hal.safety.plausibility.legs import Legs
from atalante_hal.safety.plausibility.signals import measured, signals_of
from atalante_hal.safety.plausibility.soles import Soles
from atalante_hal.safety.plausibility.stillness import Stillness
from atalante_hal.safety.plausibility.support import Support
from atalante_hal.safety.plausibility.unchecked import Unchecked
from atalante_hal.wire.process_image import ReceiveImage


def test_measured_signals_come_first_and_are_views():
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
def test_healthy_robot_has_no_findings(standing: bool):
    robot = SimulatedRobot(standing=standing)
    nothing = robot.checks.findings
    for _ in range(3000):
        assert robot.cycle() is nothing
        assert not robot.rejected
    assert nothing == ()


@pytest.mark.exhaustive
def test_lost_frames_cause_no_findings():
    robot = SimulatedRobot(amplitude=0.2)
    rng = np.random.default_rng(2)
    for _ in range(3000):
        robot.missing = set(np.flatnonzero(rng.random(len(MESSAGES)) < 0.3).tolist())
        assert robot.cycle() == ()
        assert not robot.rejected


def test_rejected_jumps_keep_the_last_good_position():
    """The position jumps, then a frame is lost, then the position jumps again."""
    robot = SimulatedRobot()
    good = float(robot.now.position[4])
    for change, missing in ((1.0, set()), (0.0, {row("left_SA")}), (1.0, set())):
        robot.missing = missing
        robot.cycle(lambda now, change=change: now.position.__setitem__(4, change * GEAR[4]))
        assert robot.now.position[4] == good
    assert robot.rejected == {row("left_SA"): 3}
    assert only(robot.checks.findings).dtc is Dtc.ENC_JUMP


def test_same_input_gives_same_findings():
    def run(robot: SimulatedRobot) -> list[Any]:
        robot.run(10)
        return [robot.cycle(lambda now: now.position.__setitem__(2, 0.0)) for _ in range(40)]

    assert run(SimulatedRobot()) == run(SimulatedRobot())


def test_each_slow_check_runs_in_its_scheduled_cycle(monkeypatch: pytest.MonkeyPatch):
    made: list[str] = []
    for owner, name in (
        (Stillness, "sample"),
        (EncoderChecks, "check_velocity"),
        (Legs, "check_left"),
        (Legs, "check_right"),
        (FootChecks, "evaluate"),
        (Support, "evaluate"),
        (Soles, "check_left"),
        (Soles, "check_right"),
        (Unchecked, "evaluate"),
    ):
        monkeypatch.setattr(owner, name, lambda *_, name=f"{owner.__name__}.{name}": bool(made.append(name)))
    image = ReceiveImage(MESSAGES, np.zeros(CODEC.size))
    checks = Plausibility(ROBOT, image, PERIOD)
    assert checks.findings == ()
    expected = {0: "Stillness.sample", 2: "EncoderChecks.check_velocity", 4: "Unchecked.evaluate"}
    expected |= {cycle + 16: name for cycle, name in expected.items()}
    expected |= {8: "Legs.check_left", 24: "Legs.check_right"}
    expected |= {10: "Soles.check_left", 26: "Soles.check_right"}
    expected |= dict.fromkeys(range(1, 32, 4), "FootChecks.evaluate")
    expected[6] = "Support.evaluate"
    for cycle in range(64):
        assert checks.check() == ()
        assert made == ([expected[cycle % 32]] if cycle % 32 in expected else [])
        made.clear()


def test_rows_are_checked_one_by_one_only_after_a_fault(monkeypatch: pytest.MonkeyPatch):
    robot = SimulatedRobot()

    def run_without_row_checks() -> None:
        with monkeypatch.context() as replaced:
            replaced.setattr(EncoderChecks, "accept", must_not_be_called)
            replaced.setattr(Imus, "accept", must_not_be_called)
            assert robot.run(64) == ()

    run_without_row_checks()
    robot.missing = {row("left_FH"), row("IMU_pelvis")}
    robot.run(3)
    robot.missing = set()
    robot.run(1)
    run_without_row_checks()


def test_missing_joint_does_not_hide_jump_of_another():
    robot = SimulatedRobot()
    robot.missing = {row("left_FH")}
    assert only(robot.cycle(lambda now: now.position.__setitem__(5, 100.0 * GEAR[5]))).node == "LEFT_HA"
    assert robot.rejected == {row("left_HA"): 1}


class TestAfterLostFrames:
    """A frame after lost frames is checked like every other frame."""

    def test_joint_that_jumps_is_found(self):
        robot = SimulatedRobot()
        robot.gaps = {row("left_SH")}
        assert only(robot.cycle(lambda now: now.position.__setitem__(2, 100.0 * GEAR[2]))).node == "LEFT_SH"
        assert robot.rejected == {row("left_SH"): 1}

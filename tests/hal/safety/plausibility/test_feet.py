"""Foot checks: faulty force cells and a missing ground contact are found within their bounds."""

from __future__ import annotations

import numpy as np
import pytest
from simulated_robot import CODEC, ROBOT, Change, SimulatedRobot, cells, must_not_be_called, only, row, signs

from atalante_hal.robot import CELLS, FEET
from atalante_hal.safety.diagnostics import Dtc
from atalante_hal.safety.plausibility import Finding
from atalante_hal.safety.plausibility.feet import FootChecks
from atalante_hal.safety.plausibility.finding import Signals, signals_of


class TestForceCells:
    def stick_out(self, foot: int, cell: int, force: float) -> Change:
        return lambda now: now.force[foot, cell].__setitem__(2, force + now.force[foot, cell, 0])

    @cells
    @signs
    def test_single_loaded_cell_is_reported(self, foot: int, cell: int, sign: float):
        robot = SimulatedRobot()
        change = self.stick_out(foot, cell, sign * 200.0)
        assert 250 <= robot.until_found(Dtc.FOOT_CELL, 260, change) <= 260
        finding = only(robot.checks.findings)
        assert finding.node == f"FOOT_{FEET[foot].upper()}"
        assert finding.value == pytest.approx(sign * 200.0, abs=20.0)
        assert f"force cell {CELLS[cell]} of the {FEET[foot]} foot says" in finding.text
        assert not robot.now.force[foot, cell].any()
        assert only(robot.run(8, change)) == finding
        robot.missing = {row(f"FOOT_{FEET[foot]}")}
        assert only(robot.run(8)) == finding
        robot.missing = set()
        assert robot.run(5) == ()

    @cells
    def test_single_unloaded_cell_under_load_is_reported(self, foot: int, cell: int):
        robot = SimulatedRobot(standing=True)
        heavy = robot.run(500, lambda now: now.force[foot, :, 2].__iadd__(20.0))
        assert heavy == ()

        def lift(now: Signals, load: float) -> None:
            now.force[foot, :, 2] = load / 3.0 + 0.1 * now.force[foot, :, 0]
            now.force[foot, cell, 2] = now.force[foot, cell, 0]

        assert robot.run(500, lambda now: lift(now, 296.0)) == ()
        assert robot.until_found(Dtc.FOOT_CELL, 260, lambda now: lift(now, 304.0)) >= 250
        finding = only(robot.checks.findings)
        assert finding.node == f"FOOT_{FEET[foot].upper()}"
        assert CELLS[cell] in finding.text

    def test_cell_counts_as_loaded_just_above_cell_free(self):
        free = ROBOT.sensors.cell_free
        for force, found in ((free, False), (free * (1.0 + 1e-9), True)):
            robot = SimulatedRobot()
            for cycle in range(300):
                exact = force * (1.0 - 1e-12 * (cycle % 3))
                robot.cycle(lambda now, exact=exact: now.force[1, 2].__setitem__(2, exact))
            assert bool(robot.checks._feet.cells) is found

    def test_load_on_two_cells_is_accepted(self):
        robot = SimulatedRobot()
        assert robot.run(600, lambda now: now.force[0, :2, 2].__iadd__(200.0)) == ()

    @pytest.mark.parametrize(("foot", "cell"), [(0, 3), (1, 0)])
    def test_single_loaded_cell_is_reported_after_lost_frames(self, foot: int, cell: int):
        robot = SimulatedRobot()
        robot.gaps = {row(f"FOOT_{FEET[foot]}")}
        push = self.stick_out(foot, cell, 200.0)
        assert robot.until_found(Dtc.FOOT_CELL, 260, push) >= 250


class Plates:
    """The feet alone, looked at in every cycle."""

    def __init__(self) -> None:
        self.now = signals_of(CODEC, np.zeros(CODEC.size))
        self.feet = FootChecks(ROBOT, self.now, 1)

    def judge(self, left: list[float], right: list[float], heard: tuple[bool, bool] = (True, True)) -> bool:
        self.now.force[:, :, 2] = left, right
        return self.feet.judge(heard)


NOTHING, EVEN = [0.0] * 4, [100.0] * 4


class TestFeetAlone:
    def test_cells_of_unloaded_feet_are_not_compared(self):
        plates = Plates()
        plates.feet._judge_cells = must_not_be_called  # type: ignore[method-assign]
        assert not plates.judge(NOTHING, [0.0, ROBOT.sensors.cell_free, 0.0, 0.0])

    def test_new_foot_checks_have_no_findings(self):
        feet = Plates().feet
        assert (feet.swing, feet.cells, feet.findings()) == (None, {}, ())

    @pytest.mark.parametrize("foot", [0, 1])
    @pytest.mark.parametrize("cell", range(4))
    def test_single_loaded_cell_is_reported_after_256_cycles_in_a_row(self, foot: int, cell: int):
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

    def test_unloaded_cell_is_reported_if_the_others_exceed_cell_loaded(self):
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

    def test_foot_stands_with_two_loaded_cells(self):
        free = ROBOT.sensors.cell_free
        plates = Plates()
        for forces, stands in (([free + 1.0, free, 0.0, 0.0], False), ([free + 1.0, -free - 1.0, 0.0, 0.0], True)):
            plates.judge(forces, NOTHING)
            assert plates.feet.swing == (1 if stands else None)
        plates.judge(NOTHING, EVEN)
        assert plates.feet.swing == 0
        plates.judge(EVEN, EVEN)
        assert plates.feet.swing is None

    def test_swing_of_both_feet_is_reported_from_cycle_20_to_99(self):
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
    def stand(self, robot: SimulatedRobot, cycles: int, cells: int = 4, force: float = 200.0) -> tuple[Finding, ...]:
        return robot.run(cycles, lambda now: now.force[1, :cells, 2].__iadd__(force))

    @pytest.mark.parametrize("phase", range(4))
    @pytest.mark.parametrize("cells", [2, 4])
    def test_both_feet_off_the_ground_are_found_within_twenty_cycles(self, phase: int, cells: int):
        robot = SimulatedRobot()
        robot.run(phase)
        assert self.stand(robot, 40, cells) == ()
        assert 16 < robot.until_found(Dtc.CONTACT_IMPLAUSIBLE, 24, lambda now: None) <= 20
        finding = only(robot.checks.findings)
        assert (finding.node, finding.value, finding.confirmed) == ("FOOT_LEFT", 20.0, True)
        assert "both feet" in finding.text
        assert only(robot.run(72)) is finding
        assert robot.run(12) == ()
        assert robot.run(100) == ()

    def test_finding_ends_when_a_foot_stands_again(self):
        robot = SimulatedRobot()
        self.stand(robot, 8)
        robot.run(30)
        assert robot.checks.findings
        assert self.stand(robot, 4) == ()

    def test_sixteen_cycles_without_contact_are_accepted(self):
        robot = SimulatedRobot()
        for _ in range(5):
            self.stand(robot, 8)
            for _ in range(16):
                assert robot.cycle() == ()

    def test_swing_leg_is_the_leg_without_load(self):
        robot = SimulatedRobot()
        assert robot.checks.swing is None
        self.stand(robot, 4)
        assert robot.checks.swing == 0
        robot.run(4, lambda now: now.force[0, :, 2].__iadd__(200.0))
        assert robot.checks.swing == 1
        robot.run(4, lambda now: now.force[:, :, 2].__iadd__(200.0))
        assert robot.checks.swing is None
        robot.run(4)
        assert robot.checks.swing is None

    def test_load_on_one_cell_is_no_ground_contact(self):
        robot = SimulatedRobot()
        self.stand(robot, 100, cells=1)
        assert robot.run(100) == ()

"""Foot checks: faulty force cells and a missing ground contact are found within their bounds."""

from __future__ import annotations

import pytest
from simulated_robot import ROBOT, Change, SimulatedRobot, cells, must_not_be_called, only, row, signals, signs

from atalante_hal.robot import CELLS, FEET
from atalante_hal.safety.diagnostics import Dtc
from atalante_hal.safety.plausibility import Finding
from atalante_hal.safety.plausibility.feet import FootChecks
from atalante_hal.safety.plausibility.finding import Signals


class TestForceCells:
    def load(self, foot: int, cell: int, force: float) -> Change:
        return lambda now: now.force[foot, cell].__setitem__(2, force + now.force[foot, cell, 0])

    @cells
    @signs
    def test_single_loaded_cell_is_reported(self, foot: int, cell: int, sign: float):
        robot = SimulatedRobot()
        change = self.load(foot, cell, sign * 200.0)
        assert 250 <= robot.until_found(Dtc.FOOT_CELL, 260, change) <= 260
        finding = only(robot.checks.findings)
        assert finding.node == f"FOOT_{FEET[foot].upper()}"
        assert finding.value == pytest.approx(sign * 200.0, abs=20.0)
        assert f"force cell {CELLS[cell]} of the {FEET[foot]} foot reports" in finding.text
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
            assert bool(robot.checks.findings) is found

    def test_load_on_two_cells_is_accepted(self):
        robot = SimulatedRobot()
        assert robot.run(600, lambda now: now.force[0, :2, 2].__iadd__(200.0)) == ()

    @pytest.mark.parametrize(("foot", "cell"), [(0, 3), (1, 0)])
    def test_single_loaded_cell_is_reported_after_lost_frames(self, foot: int, cell: int):
        robot = SimulatedRobot()
        robot.gaps = {row(f"FOOT_{FEET[foot]}")}
        push = self.load(foot, cell, 200.0)
        assert robot.until_found(Dtc.FOOT_CELL, 260, push) >= 250


class TwoFeet:
    """The foot checks without the schedule, run in every cycle."""

    def __init__(self) -> None:
        self.now = signals()
        self.checks = FootChecks(ROBOT, self.now, 1)

    def judge(self, left: list[float], right: list[float], new: tuple[bool, bool] = (True, True)) -> bool:
        self.now.force[:, :, 2] = left, right
        return self.checks.judge(new)


class Unreadable:
    """Forces that must not be read one by one."""

    __getitem__ = must_not_be_called


UNLOADED, LOADED = [0.0] * 4, [100.0] * 4  # vertical forces of the cells of a foot [N]


class TestFeetAlone:
    def test_cells_of_unloaded_feet_are_not_compared(self):
        now = signals()
        checks = FootChecks(ROBOT, now._replace(force=Unreadable()), 1)
        now.force[1, 1, 2] = ROBOT.sensors.cell_free
        assert not checks.judge((True, True))

    def test_new_foot_checks_have_no_findings(self):
        checks = TwoFeet().checks
        assert (checks.swing, checks.cells, checks.findings()) == (None, {}, ())

    @pytest.mark.parametrize("foot", [0, 1])
    @pytest.mark.parametrize("cell", range(4))
    def test_single_loaded_cell_is_reported_after_256_cycles_in_a_row(self, foot: int, cell: int):
        feet, loads = TwoFeet(), [UNLOADED, UNLOADED]
        loads[foot] = [-200.0 if c == cell else 0.0 for c in range(4)]
        for _ in range(2):
            assert [feet.judge(*loads) for _ in range(257)] == [False] * 255 + [True] * 2
            assert feet.checks.cells == {(foot, cell): -200.0}
            text = f"force cell {CELLS[cell]} of the {FEET[foot]} foot reports -200 N, which contradicts the other three cells"
            node = f"FOOT_{FEET[foot].upper()}"
            assert feet.checks.findings() == (Finding(Dtc.FOOT_CELL, node, -200.0, True, text),)
            # The cells of a foot without new values are not checked again.
            assert feet.judge(UNLOADED, UNLOADED, (foot == 1, foot == 0))
            assert not feet.judge(UNLOADED, UNLOADED)
            assert feet.checks.cells == {}

    def test_unloaded_cell_is_reported_if_the_others_exceed_cell_loaded(self):
        loaded, free = ROBOT.sensors.cell_loaded, ROBOT.sensors.cell_free
        third = loaded / 3.0
        for others, found in (
            ([third] * 3, False),
            ([third, third, third + 1.0], True),
            ([loaded, loaded, free], False),
        ):
            feet = TwoFeet()
            for _ in range(256):
                last = feet.judge([*others, free], LOADED)
            assert last is found

    def test_foot_stands_with_two_loaded_cells(self):
        free = ROBOT.sensors.cell_free
        feet = TwoFeet()
        for forces, stands in (([free + 1.0, free, 0.0, 0.0], False), ([free + 1.0, -free - 1.0, 0.0, 0.0], True)):
            feet.judge(forces, UNLOADED)
            assert feet.checks.swing == (1 if stands else None)
        feet.judge(UNLOADED, LOADED)
        assert feet.checks.swing == 0
        feet.judge(LOADED, LOADED)
        assert feet.checks.swing is None

    def test_swing_of_both_feet_is_reported_from_cycle_20_to_99(self):
        feet = TwoFeet()
        for _ in range(2):
            assert not feet.judge(LOADED, UNLOADED)
            assert [feet.judge(UNLOADED, UNLOADED) for _ in range(100)] == [False] * 19 + [True] * 80 + [False]
            assert not feet.judge(UNLOADED, UNLOADED)
        feet.judge(LOADED, UNLOADED)
        for _ in range(20):
            feet.judge(UNLOADED, UNLOADED)
        assert [f.text for f in feet.checks.findings()] == ["neither foot reports a load on the ground"]
        assert not feet.judge(LOADED, UNLOADED)
        assert feet.checks.findings() == ()


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
        assert "neither foot" in finding.text
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

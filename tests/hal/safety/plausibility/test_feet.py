"""Foot checks: faulty force cells and a missing ground contact are found within their bounds."""

from __future__ import annotations

import numpy as np
import pytest
from simulated_robot import ROBOT, Change, SimulatedRobot, cells, must_not_be_called, only, row, signals, signs

from atalante_hal.robot import CELLS, FEET
from atalante_hal.safety.diagnostics import Dtc
from atalante_hal.safety.plausibility import Finding
from atalante_hal.safety.plausibility.feet import FootChecks
from atalante_hal.safety.plausibility.signals import Signals


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
        assert abs(finding.value) == pytest.approx(200.0, abs=20.0)
        assert f"force cell {CELLS[cell]} of the {FEET[foot]} foot contradicts the other three cells" in finding.text
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
            now.force[foot, :, 2] = load + 0.1 * now.force[foot, :, 0]
            now.force[foot, cell, 2] = now.force[foot, cell, 0]

        assert robot.run(500, lambda now: lift(now, 60.0)) == ()
        assert robot.until_found(Dtc.FOOT_CELL, 260, lambda now: lift(now, 120.0)) >= 250
        finding = only(robot.checks.findings)
        assert finding.node == f"FOOT_{FEET[foot].upper()}"
        assert CELLS[cell] in finding.text

    @pytest.mark.parametrize("seed", range(4))
    def test_foot_on_an_edge_or_corner_of_its_sole_is_accepted(self, seed: int):
        """If a rigid sole stands on an edge or a corner, the opposite cells are pulled. This may last for any time."""
        robot, rng = SimulatedRobot(standing=True), np.random.default_rng(seed)
        for _ in range(4):
            load, xi, eta = rng.uniform(200.0, 1700.0), *rng.uniform([-1.1, -2.0], [1.1, 2.0])
            plate = 0.25 * load * np.array([1 + xi + eta, 1 + xi - eta, 1 - xi + eta, 1 - xi - eta])
            assert robot.run(400, lambda now, plate=plate: now.force[1, :, 2].__iadd__(plate - 100.0)) == ()

    def test_load_on_two_cells_of_one_edge_is_accepted(self):
        robot = SimulatedRobot()
        assert robot.run(600, lambda now: now.force[0, :2, 2].__iadd__(200.0)) == ()

    @pytest.mark.parametrize(("foot", "cell"), [(0, 3), (1, 0)])
    def test_single_loaded_cell_is_reported_after_lost_frames(self, foot: int, cell: int):
        robot = SimulatedRobot()
        robot.gaps = {row(f"FOOT_{FEET[foot]}")}
        push = self.load(foot, cell, 200.0)
        assert robot.until_found(Dtc.FOOT_CELL, 260, push) >= 250


class TwoFeet:
    """The foot checks, called directly in every cycle instead of by the schedule."""

    def __init__(self) -> None:
        self.now = signals()
        self.checks = FootChecks(ROBOT, self.now, 1)

    def evaluate(self, left: list[float], right: list[float], new: tuple[bool, bool] = (True, True)) -> bool:
        self.now.force[:, :, 2] = left, right
        return self.checks.evaluate(new)


class Unreadable:
    """Array that fails the test if an element is read."""

    __getitem__ = must_not_be_called


CELL_TWIST = ROBOT.sensors.cell_twist  # N
UNLOADED, LOADED = [0.0] * 4, [100.0] * 4  # vertical forces on the four cells of a foot [N]


class TestFeetAlone:
    def test_cells_of_unloaded_feet_are_not_compared(self):
        now = signals()
        checks = FootChecks(ROBOT, now._replace(force=Unreadable()), 1)
        now.force[1, 1, 2] = ROBOT.sensors.cell_free
        assert not checks.evaluate((True, True))

    def test_new_foot_checks_have_no_findings(self):
        checks = TwoFeet().checks
        assert (checks.swing, list(checks.cells), checks.findings()) == (None, [], ())

    @pytest.mark.parametrize("foot", [0, 1])
    @pytest.mark.parametrize("cell", range(4))
    def test_single_loaded_cell_is_reported_after_256_cycles_in_a_row(self, foot: int, cell: int):
        feet, loads = TwoFeet(), [UNLOADED, UNLOADED]
        loads[foot] = [-200.0 if c == cell else 0.0 for c in range(4)]
        twist = -200.0 if cell in (0, 3) else 200.0
        for _ in range(2):
            assert [feet.evaluate(*loads) for _ in range(257)] == [False] * 255 + [True] * 2
            assert list(feet.checks.cells) == [(foot, cell)]
            text = (
                f"force cell {CELLS[cell]} of the {FEET[foot]} foot contradicts the other three cells: "
                "the diagonals of the cells differ by 200 N"
            )
            node = f"FOOT_{FEET[foot].upper()}"
            assert feet.checks.findings() == (Finding(Dtc.FOOT_CELL, node, twist, True, text),)
            # The cells of a foot without new values are not checked again.
            assert feet.evaluate(UNLOADED, UNLOADED, (foot == 1, foot == 0))
            assert not feet.evaluate(UNLOADED, UNLOADED)
            assert list(feet.checks.cells) == []

    @pytest.mark.parametrize(
        ("forces", "found"),
        [
            ([CELL_TWIST, 0.0, 0.0, 0.0], False),
            ([CELL_TWIST + 0.1, 0.0, 0.0, 0.0], True),
            ([0.0, CELL_TWIST + 0.1, 0.0, 0.0], True),
            ([300.0, 300.0 - CELL_TWIST, 300.0, 300.0], False),
            ([300.0, 299.9 - CELL_TWIST, 300.0, 300.0], True),
            ([900.0, 500.0, 300.0, -100.0], False),
            ([900.0, 500.0, 300.0, 0.0], True),
        ],
        ids=str,
    )
    def test_diagonals_that_differ_by_more_than_cell_twist_are_reported(self, forces: list[float], found: bool):
        for mirrored in (False, True):
            feet = TwoFeet()
            cells = [-force for force in forces] if mirrored else forces
            assert not any(feet.evaluate(LOADED, cells) for _ in range(255))
            feet.evaluate(LOADED, cells)
            assert any("diagonals" in finding.text for finding in feet.checks.findings()) == found

    @pytest.mark.parametrize(
        ("forces", "cell"),
        [
            ([400.0, 400.0, 400.0, 0.0], 3),
            ([400.0, 0.0, 400.0, 400.0], 1),
            ([0.0, 0.0, 200.0, 0.0], 2),
            ([400.0, 100.0, 100.0, 100.0], None),
            ([400.0, 100.0, 0.0, 0.0], None),
        ],
        ids=str,
    )
    def test_faulty_cell_is_known_if_it_alone_is_loaded_or_unloaded(self, forces: list[float], cell: int | None):
        feet = TwoFeet()
        for _ in range(256):
            feet.evaluate(forces, LOADED)
        assert list(feet.checks.cells) == ([] if cell is None else [(0, cell)])
        finding = only(feet.checks.findings())
        if cell is None:
            assert finding.text == (
                "the force cells of the left foot contradict each other: the diagonals of the cells differ by "
                f"{abs(forces[0] + forces[3] - forces[1] - forces[2]):.0f} N"
            )
        # The faulty cell may become known later, when the foot is in the air.
        feet.evaluate([0.0, 300.0, 0.0, 0.0], LOADED)
        assert list(feet.checks.cells) == [(0, 1 if cell is None else cell)]

    @pytest.mark.parametrize("foot", [0, 1])
    def test_foot_that_the_floor_seems_to_pull_is_reported_after_256_cycles_in_a_row(self, foot: int):
        feet, free = TwoFeet(), ROBOT.sensors.cell_free
        pulled, allowed, twisted = ([LOADED, LOADED] for _ in range(3))
        pulled[foot], allowed[foot] = [-free / 2.0 - 0.1] * 4, [-free / 2.0] * 4
        twisted[foot] = [-CELL_TWIST - 300.0, -100.0, -100.0, -100.0]
        for _ in range(2):
            assert [feet.evaluate(*pulled) for _ in range(257)] == [False] * 255 + [True] * 2
            text = f"the force cells of the {FEET[foot]} foot report -120 N in total, but the floor cannot pull"
            node = f"FOOT_{FEET[foot].upper()}"
            assert feet.checks.findings() == (
                Finding(Dtc.FOOT_CELL, node, pytest.approx(4.0 * pulled[foot][0]), True, text),
            )
            assert list(feet.checks.cells) == []
            feet.evaluate(*([-110.0] * 4 if f == foot else LOADED for f in (0, 1)))
            assert only(feet.checks.findings()).value == pytest.approx(4.0 * pulled[foot][0])  # the first value is kept
            assert not feet.evaluate(*allowed)
            assert feet.checks.findings() == ()
        assert not any(feet.evaluate(*allowed) for _ in range(300))
        feet.evaluate(*twisted)
        for _ in range(300):
            feet.evaluate(*twisted)
        assert ["diagonals" in finding.text for finding in feet.checks.findings()] == [True]

    def test_pulled_foot_is_checked_until_it_is_without_load(self):
        feet = TwoFeet()
        assert [feet.evaluate([-31.0] * 4, UNLOADED) for _ in range(256)] == [False] * 255 + [True]
        assert not feet.evaluate(UNLOADED, UNLOADED)
        assert feet.checks.findings() == ()

    def test_interrupted_pull_is_counted_from_zero(self):
        feet = TwoFeet()
        for _ in range(3):
            assert not any(feet.evaluate([-200.0] * 4, LOADED) for _ in range(255))
            assert not feet.evaluate(LOADED, LOADED)

    def test_interrupted_contradiction_is_counted_from_zero(self):
        feet = TwoFeet()
        for _ in range(3):
            assert [feet.evaluate([200.0, 0.0, 0.0, 0.0], UNLOADED) for _ in range(255)] == [False] * 255
            assert not feet.evaluate(UNLOADED, UNLOADED)

    def test_foot_is_on_the_ground_if_two_cells_are_loaded(self):
        free = ROBOT.sensors.cell_free
        feet = TwoFeet()
        for forces, on_ground in (([free + 1.0, free, 0.0, 0.0], False), ([free + 1.0, -free - 1.0, 0.0, 0.0], True)):
            feet.evaluate(forces, UNLOADED)
            assert feet.checks.swing == (1 if on_ground else None)
        feet.evaluate(UNLOADED, LOADED)
        assert feet.checks.swing == 0
        feet.evaluate(LOADED, LOADED)
        assert feet.checks.swing is None

    def stand(self, feet: TwoFeet, cycles: int = 500) -> None:
        for _ in range(cycles):
            assert not feet.evaluate(LOADED, LOADED)

    def test_swing_of_both_feet_is_reported_from_cycle_60_to_139(self):
        feet = TwoFeet()
        for _ in range(2):
            self.stand(feet)
            assert not feet.evaluate(LOADED, UNLOADED)
            assert [feet.evaluate(UNLOADED, UNLOADED) for _ in range(140)] == [False] * 59 + [True] * 80 + [False]
            assert not feet.evaluate(UNLOADED, UNLOADED)
        self.stand(feet)
        for _ in range(60):
            feet.evaluate(UNLOADED, UNLOADED)
        assert [f.text for f in feet.checks.findings()] == ["neither foot reports a load on the ground"]
        assert not feet.evaluate(LOADED, UNLOADED)
        assert feet.checks.findings() == ()

    @pytest.mark.parametrize("new", [(True, False), (False, True), (False, False)])
    def test_time_without_values_of_a_foot_is_no_swing_of_both_feet(self, new: tuple[bool, bool]):
        feet = TwoFeet()
        self.stand(feet)
        assert not any(feet.evaluate(UNLOADED, UNLOADED, new) for _ in range(300))
        assert not any(feet.evaluate(UNLOADED, UNLOADED) for _ in range(40))
        assert not any(feet.evaluate(UNLOADED, UNLOADED, new) for _ in range(300))
        assert [feet.evaluate(UNLOADED, UNLOADED) for _ in range(20)] == [False] * 19 + [True]
        assert all(feet.evaluate(UNLOADED, UNLOADED, new) for _ in range(300)), "the finding stays"
        assert not feet.evaluate(LOADED, UNLOADED, new)

    def test_swing_of_both_feet_is_accepted_before_both_stood_for_500_cycles(self):
        feet = TwoFeet()
        for _ in range(2):  # the time with both feet on the ground is counted from 0 after each swing
            self.stand(feet, 499)
            assert [feet.evaluate(UNLOADED, UNLOADED) for _ in range(130)] == [False] * 130
            assert not feet.evaluate(LOADED, UNLOADED)
        self.stand(feet, 500)
        assert [feet.evaluate(UNLOADED, UNLOADED) for _ in range(60)] == [False] * 59 + [True]

    def test_contact_check_stays_armed_in_a_walk_and_is_disarmed_by_lifting(self):
        feet = TwoFeet()
        self.stand(feet)
        for _ in range(20):  # between two steps, no foot has contact for 50 cycles
            for loads in ((LOADED, UNLOADED), (UNLOADED, UNLOADED), (UNLOADED, LOADED), (UNLOADED, UNLOADED)):
                assert not any(feet.evaluate(*loads) for _ in range(50))
        assert any(feet.evaluate(UNLOADED, UNLOADED) for _ in range(60))
        for _ in range(100):
            feet.evaluate(UNLOADED, UNLOADED)
        assert not feet.evaluate(LOADED, UNLOADED)
        assert not any(feet.evaluate(UNLOADED, UNLOADED) for _ in range(200))


class TestContact:
    def stand(self, robot: SimulatedRobot, cycles: int, cells: int = 4, force: float = 200.0) -> tuple[Finding, ...]:
        return robot.run(cycles, lambda now: now.force[1, :cells, 2].__iadd__(force))

    def stand_on_both(self, robot: SimulatedRobot, cells: int = 4) -> None:
        assert robot.run(516, lambda now: now.force[:, :cells, 2].__iadd__(200.0)) == ()

    @pytest.mark.parametrize("phase", range(4))
    @pytest.mark.parametrize("cells", [2, 4])
    def test_swing_of_both_feet_is_found_within_60_cycles(self, phase: int, cells: int):
        robot = SimulatedRobot()
        robot.run(phase)
        self.stand_on_both(robot, cells)
        assert self.stand(robot, 40, cells) == ()
        assert 56 < robot.until_found(Dtc.CONTACT_IMPLAUSIBLE, 64, lambda now: None) <= 60
        finding = only(robot.checks.findings)
        assert (finding.node, finding.value, finding.confirmed) == ("FOOT_LEFT", 60.0, True)
        assert "neither foot" in finding.text
        assert only(robot.run(72)) is finding
        assert robot.run(12) == ()
        assert robot.run(100) == ()

    @pytest.mark.parametrize("foot", [0, 1])
    def test_silent_foot_is_no_swing_of_both_feet(self, foot: int):
        robot = SimulatedRobot()
        self.stand_on_both(robot)
        robot.run(8)
        robot.missing = {row(f"FOOT_{FEET[foot]}")}
        assert all(finding.dtc is not Dtc.CONTACT_IMPLAUSIBLE for _ in range(300) for finding in robot.cycle())

    def test_finding_ends_when_a_foot_is_on_the_ground_again(self):
        robot = SimulatedRobot()
        self.stand_on_both(robot)
        robot.run(80)
        assert robot.checks.findings
        assert self.stand(robot, 4) == ()

    def test_set_down_by_a_crane_reports_nothing(self):
        robot = SimulatedRobot()
        for _ in range(5):
            self.stand(robot, 40)
            for _ in range(100):
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

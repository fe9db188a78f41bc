"""Tests of walks without a fault: which walks run, and which diagnostics are false alarms."""

from __future__ import annotations

import json

import pytest
from click.testing import CliRunner

from atalante_control.airwalk.controller import AirwalkConfig, AirwalkController
from atalante_control.gait.gait import AIRWALK_GAIT, load_gait
from atalante_control.guide.shapes import SHAPES
from atalante_emulator.faults import Fault
from atalante_hal.robot import Robot
from atalante_tools.cli import cli
from atalante_tools.console.options import Target
from atalante_tools.faults import campaign, false_alarms
from atalante_tools.faults.false_alarms import EXPECTED, Quiet, QuietTask, quiet_tasks
from atalante_tools.session.rig import open_hal
from atalante_tools.session.walk_result import diagnostics


def test_walks_cover_the_requested_cycles_in_the_air_and_on_the_ground() -> None:
    assert [task.number for task in quiet_tasks(150_000, "mujoco")] == [0, 1, 2]


@pytest.mark.sample(2)
@pytest.mark.parametrize(
    ("number", "name"),
    # The gaits of the patient of 75 kg are in a file. Gaits of another patient would be solved first, which takes 10 s.
    [(4, "air, constant, Xi 0.5"), (25, "ground, 75 kg, pinched, Xi 0.5")],
)
def test_walk_without_a_fault_has_no_false_alarm(number: int, name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(false_alarms, "_CYCLES", 8000)
    monkeypatch.setattr(false_alarms, "_STEPS", 3)
    quiet = QuietTask(number, "pybullet")()
    assert (quiet.state, quiet.alarms, quiet.failed) == ("ACTIVE", {}, False)
    assert quiet.name.startswith(name)
    assert quiet.cycles > 5000
    monkeypatch.setattr(false_alarms, "_CYCLES", 1000)  # the walk on the ground cannot end within twice this time
    assert QuietTask(number, "pybullet")().failed is name.startswith("ground")


@pytest.mark.sample(4)
@pytest.mark.parametrize(
    ("axis", "degrees", "cycles"), [("X", 1, 2000), ("Y", 1, 2000), ("Z", 1, 2000), ("Y", 1.5, 4500)]
)
def test_walk_with_askew_tibia_imus_has_no_false_alarm(robot: Robot, axis: str, degrees: float, cycles: int) -> None:
    """The IMUs are turned in opposite directions, so the errors of both legs are opposite. The walk begins slowly."""
    turns = ("LEFT", -degrees), ("RIGHT", degrees)
    askew = [Fault("imu_turned", f"IMU_{side}_TIBIA", axis=axis, degrees=turn) for side, turn in turns]
    controller = AirwalkController(robot, load_gait(AIRWALK_GAIT, robot), SHAPES["constant"], AirwalkConfig())
    fields = controller.telemetry_fields
    with open_hal(
        Target("embedded", "", lockstep=True), assistance_factor=0.5, controller_fields=fields, faults=askew
    ) as rig:
        rig.run(controller, until=lambda state: state.cycle >= cycles)
        assert "ACTIVE" in {event.code for event in rig.hal.events}
        assert diagnostics(rig.hal).keys() <= EXPECTED


@pytest.mark.parametrize(
    ("finished", "counts", "failed"),
    [
        (True, {"TORQUE_SATURATED": 3, "GUIDE_OUTSIDE": 1, "OPERATOR_STOP": 1}, False),
        (True, {"TORQUE_SATURATED": 3, "ENC_DRIFT": 2}, True),
        (False, {}, True),
    ],
)
def test_other_diagnostics_and_unfinished_walks_fail(finished: bool, counts: dict[str, int], failed: bool) -> None:
    assert Quiet("a walk", 10, "ACTIVE", counts, finished).failed is failed


def test_command_reports_false_alarms(monkeypatch: pytest.MonkeyPatch) -> None:
    walks = {0: Quiet("first", 10, "ACTIVE", {}, True), 1: Quiet("second", 20, "ACTIVE", {"ENC_DRIFT": 2}, True)}
    monkeypatch.setattr(campaign, "run_task", lambda task: walks[task.number])
    arguments = ["faults", "false-alarms", "--jobs", "1", "--cycles"]
    result = CliRunner().invoke(cli, [*arguments, "60000"])
    assert result.exit_code == 0
    assert "1 walks, 10 cycles, 0 false alarms" in result.stderr
    result = CliRunner().invoke(cli, [*arguments, "120000"])
    assert result.exit_code == 1
    assert "ENC_DRIFT 2" in result.stdout
    assert "1 of 2 walks had a false alarm" in result.stderr
    result = CliRunner().invoke(cli, [*arguments, "120000", "--json"])
    assert [json.loads(line)["alarms"] for line in result.stdout.splitlines()] == [{}, {"ENC_DRIFT": 2}]

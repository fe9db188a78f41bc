"""Tests of `atalante conform`: report, exit codes, real-time clock, and the frames of the node tester."""

from __future__ import annotations

import json
import time

import cantools
import e2e
import numpy as np
import pytest
from click.testing import CliRunner, Result

from atalante_dbc import DBC_FILE, Network
from atalante_hal.bus.pair import lockstep_pair
from atalante_hal.robot import Robot
from atalante_hal.wire.frame import new_frames
from atalante_hal.wire.process_image import TransmitImage
from atalante_tools.cli import cli
from atalante_tools.conform.any_node import answers_every_sync
from atalante_tools.conform.examination import make_safe, requirements_of
from atalante_tools.conform.frames import MessageReceiver, MessageSender
from atalante_tools.conform.node_tester import NodeTester, NotTested, WallClock
from atalante_tools.conform.requirement import LATE, Outcome, Requirement, Verdict, examine
from atalante_tools.conform.technician import Action, HumanTechnician
from atalante_tools.console.outcome import Failed

from .conftest import MakeSetup

ORACLE = cantools.database.load_file(str(DBC_FILE), strict=False)


def run(*arguments: str) -> Result:
    return CliRunner().invoke(cli, ["conform", *arguments])


# -- command -----------------------------------------------------------------------------------------------------------


def test_report_lists_requirement_test_measurement_and_source():
    result = run("left_sk", "--only", "drive-13", "--only", "NODE-01")
    assert result.exit_code == 0
    report = result.stdout
    assert report.startswith("ACCEPTANCE REPORT  LEFT_SK (drive)\non embedded, ")
    entries = [line.split()[:2] for line in report.splitlines() if line.startswith(("NODE-", "DRIVE-"))]
    assert entries == [["NODE-01", "pass"], ["DRIVE-13", "pass"]]  # in the order of the examination
    for part in (
        "Latches a local hold after 5 lost commands.",
        "tested: 5 cycles without command in OPERATION ENABLED",
        "measured: OPERATION_ENABLED -> QUICK_STOP_ACTIVE",
        "source: fault matrix F25",
    ):
        assert part in report
    assert "2 of 2 requirements passed" in result.stderr


def test_choice_without_any_requirement_is_refused():
    result = run("FOOT_LEFT", "--only", "NODE-03", "--without", "NODE-03")
    assert result.exit_code == 2
    assert "at least one requirement must be tested, but --only and --without leave none" in result.stderr


def test_json_is_one_object_per_requirement():
    result = run("FOOT_LEFT", "--json", "--without", "NODE-03", "--without", "node-10")
    assert result.exit_code == 0
    objects = [json.loads(line) for line in result.stdout.splitlines()]
    assert {o["node"] for o in objects} == {"FOOT_LEFT"}
    assert {o["verdict"] for o in objects} == {"pass"}
    ids = [o["id"] for o in objects]
    assert "FOOT-01" in ids
    assert not {"NODE-03", "NODE-10"} & set(ids)
    assert "skipped on request: NODE-03" in result.stderr
    assert all(set(o) == {"node", "id", "verdict", "requirement", "tested", "measured", "source"} for o in objects)


def test_failed_requirement_is_named_and_exit_code_is_1(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("atalante_emulator.drive.WATCHDOG", 7)
    result = run("LEFT_SK", "--only", "NODE-01", "--only", "DRIVE-13")
    assert result.exit_code == 1
    assert "DRIVE-13   FAIL" in result.stdout
    assert "1 of 2 requirements passed; not passed: DRIVE-13" in result.stderr


def test_untested_requirement_does_not_pass():
    """DRIVE-23 needs the fault of DRIVE-22."""
    result = run("LEFT_SK", "--only", "DRIVE-23", "--json")
    assert result.exit_code == 1
    assert json.loads(result.stdout)["verdict"] == "not tested"
    assert "DRIVE-22" in json.loads(result.stdout)["measured"]


@pytest.mark.parametrize(
    ("arguments", "hint"),
    [
        (("LEFT_SKY",), "LEFT_SK"),
        (("HAL",), "LEFT_FH"),
        (("LEFT_SK", "--only", "DRIVE-99"), "DRIVE-9"),
        (("LEFT_SK", "-i", "socketcan"), "-c"),
        (("LEFT_SK", "--torque", "500"), "20"),
    ],
)
def test_wrong_command_line_is_rejected_with_a_hint(arguments: tuple[str, ...], hint: str):
    result = run(*arguments)
    assert result.exit_code == 2
    assert hint in result.output
    assert "Traceback" not in result.output


def test_missing_bus_exits_with_no_device():
    result = run("LEFT_SK", "-i", "no-such-interface", "-c", "nocan9")
    assert result.exit_code == 3
    assert "no-such-interface" in result.output


def test_empty_bus_passes_nothing_and_exits_with_1(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("atalante_emulator.emulator.Emulator.poll", lambda emulator: None)
    result = run("LEFT_SH")
    assert result.exit_code == 1
    assert "LEFT_SH: 0 of 41 requirements passed; not passed: NODE-01, " in result.stderr
    assert " ".join(result.stdout.split()).count("measured: no frame of LEFT_SH received; ") == 41


# -- requirements in general -------------------------------------------------------------------------------------------


def _requirement(test) -> Requirement:
    return Requirement("X-01", "", "", "", test)


def test_failure_with_a_delayed_cycle_is_repeated_and_then_not_tested(make_setup: MakeSetup):
    tester = make_setup("IMU_TORSO").tester
    tries = 0

    def late(tester: NodeTester) -> Outcome:
        nonlocal tries
        tries += 1
        tester.cycle()
        tester.clock.delay = 2 * LATE
        return Outcome(False, "a gap")

    (result,) = examine(tester, [_requirement(late)])
    assert (result.verdict, tries) == (Verdict.NOT_TESTED, 3)
    assert "late by 4.0 ms" in result.measured

    def late_once(tester: NodeTester) -> Outcome:
        nonlocal tries
        tries += 1
        tester.cycle()
        tester.clock.delay = 2 * LATE if tries == 4 else 0.0
        return Outcome(False, "a defect")

    (result,) = examine(tester, [_requirement(late_once)])
    assert (result.verdict, result.measured) == (Verdict.FAILED, "a defect")


def test_requirement_ids_are_unique_and_texts_complete(make_setup: MakeSetup, network: Network):
    for name in ("LEFT_FH", "IMU_TORSO", "FOOT_LEFT", "HAPTICS", "PENDANT"):
        requirements = requirements_of(make_setup(name).tester)
        assert len({r.id for r in requirements}) == len(requirements)
        assert all(r.text.endswith(".") and r.how and r.source for r in requirements)


def test_drive_is_in_quick_stop_after_the_examination(make_setup: MakeSetup):
    setup = make_setup("LEFT_SK")
    list(examine(setup.tester, [r for r in requirements_of(setup.tester) if r.id == "DRIVE-07"]))
    assert setup.emulator.drives.state[3].name == "OPERATION_ENABLED"
    make_safe(setup.tester)
    assert setup.emulator.drives.state[3].name == "QUICK_STOP_ACTIVE"


# -- real-time clock ---------------------------------------------------------------------------------------------------


def test_real_time_cycles_keep_their_period_and_are_answered(make_setup: MakeSetup, network: Network, robot: Robot):
    """Only facts that do not depend on the load of the machine are asserted."""
    setup = make_setup("IMU_TORSO")
    begun = time.monotonic()
    tester = NodeTester(
        network, robot, network.node("IMU_TORSO"), setup.wire, WallClock(), HumanTechnician(patience=0.5)
    )
    outcome = answers_every_sync(tester)
    assert time.monotonic() - begun >= 0.2  # never faster than real time
    assert outcome.passed, outcome.measured
    assert tester.cycle_number == 200


def test_missed_deadline_is_recorded_and_skipped():
    clock, begun, listened = WallClock(), time.monotonic(), []
    clock._deadline -= 0.005
    clock.next_cycle(sync=True, listen=listened.append)
    assert listened == [0.0]  # pending frames are received before the next SYNC is sent
    assert clock.delay >= 0.0039
    # The next deadline is in the future; the missed deadlines are not repeated.
    assert clock._deadline >= begun


def test_request_that_a_person_does_not_follow_is_not_tested(
    make_setup: MakeSetup, network: Network, robot: Robot, capsys: pytest.CaptureFixture
):
    setup = make_setup("IMU_TORSO")
    tester = NodeTester(
        network, robot, network.node("IMU_TORSO"), setup.wire, setup.tester.clock, HumanTechnician(patience=0.01)
    )
    with pytest.raises(NotTested, match="switch IMU_TORSO off and on again"):
        tester.request(Action.POWER_UP, lambda received: False)
    assert "please switch IMU_TORSO off and on again" in capsys.readouterr().err


def test_boot_up_without_power_cycle_is_not_tested(make_setup: MakeSetup, network: Network, robot: Robot):
    """The emulated node keeps running, because only a person can switch a real node off and on."""
    setup = make_setup("IMU_TORSO")
    tester = NodeTester(
        network, robot, network.node("IMU_TORSO"), setup.wire, setup.tester.clock, HumanTechnician(patience=0.4)
    )
    (result,) = examine(tester, requirements_of(tester)[:1])
    assert result.verdict is Verdict.NOT_TESTED


def test_examination_is_rejected_while_another_hal_is_active(network: Network, robot: Robot):
    ours, theirs = lockstep_pair()
    tester = NodeTester(network, robot, network.node("LEFT_SK"), ours, WallClock(), HumanTechnician(patience=1.0))
    tester.require_no_other_master()
    theirs.send(TransmitImage([network.message("SYNC_LEFT_LEG")]).seal())
    with pytest.raises(Failed, match="SYNC_LEFT_LEG was received"):
        tester.require_no_other_master()


# -- frames ------------------------------------------------------------------------------------------------------------


def _profile_5(frame: np.ndarray, data_id: int) -> bool:
    """Return whether the AUTOSAR E2E package accepts the CRC of a frame."""
    payload = frame["data"][0][: frame["len"][0]].tobytes()
    return bool(e2e.p05.e2e_p05_check(payload, data_id))


def test_valid_frame_is_accepted_by_cantools_and_autosar(network: Network):
    message = network.message("COMMAND_LEFT_LEG")
    out = MessageSender(message)
    for counter in range(3):
        frame = out.frame({"SK_TargetTorque": -12.5, "SK_Controlword": 15.0, "SK_MaxTorque": 3.0})
        reported = ORACLE.decode_message(message.name, frame["data"][0][:48].tobytes(), decode_choices=False)
        assert (reported["SK_TargetTorque"], reported["SK_Controlword"], reported["SK_MaxTorque"]) == (-12.5, 15, 3.0)
        assert (reported["FH_TargetTorque"], reported["Counter"]) == (0.0, counter)
        assert _profile_5(frame, message.data_id)


def test_requested_defect_is_the_only_defect(network: Network):
    message, other = network.message("COMMAND_LEFT_LEG"), network.message("COMMAND_RIGHT_LEG")
    out = MessageSender(message)
    out.frame({})
    damaged = out.frame({}, flip=200)
    assert not _profile_5(damaged, message.data_id)
    other_id_frame = out.frame({}, data_id=other.data_id)
    assert not _profile_5(other_id_frame, message.data_id)
    assert _profile_5(other_id_frame, other.data_id)
    repeated = out.frame({}, counter=out.counter)
    assert repeated["data"][0][2] == out.counter == 2
    longer = out.frame({}, length=64)
    assert longer["len"] == 64
    assert _profile_5(longer, message.data_id)
    classic = MessageSender(network.message("SYNC_LEFT_LEG")).frame({}, classic=True)
    assert classic["flags"] == 0
    invalid = out.frame({"SK_TargetTorque": 1.0}, raw={"SK_TargetTorque": 0x8000})
    assert (
        ORACLE.decode_message(message.name, invalid["data"][0][:48].tobytes(), scaling=False)["SK_TargetTorque"]
        == -32768
    )


def test_defects_are_recorded_per_frame(network: Network):
    message = network.message("IMU_TORSO_STATE")
    out, receiver = MessageSender(message), MessageReceiver(message)
    good = receiver.decode(out.frame({"QuaternionW": 1.0, "AccelZ": 9.81}), cycle=7, time=0.5)
    assert (good.length_valid, good.format_valid, good.crc_valid, good.reserved_zero) == (True, True, True, True)
    assert (good.counter, good.cycle, good.time, good.out_of_range) == (0, 7, 0.5, ())
    assert good.values["AccelZ"] == pytest.approx(9.81, abs=0.0025)
    assert not receiver.decode(out.frame({}, flip=100), 0, 0.0).crc_valid
    assert not receiver.decode(out.frame({}, data_id=1), 0, 0.0).crc_valid
    assert receiver.decode(out.frame({}, raw={"GyroX": 0x8000}), 0, 0.0).out_of_range == ("GyroX",)
    assert not receiver.decode(out.frame({}, flip=45), 0, 0.0).reserved_zero
    short = receiver.decode(out.frame({}, length=24), 0, 0.0)
    assert (short.length_valid, short.values) == (False, {})
    classic = new_frames(1)
    classic["can_id"], classic["len"] = message.frame_id, 1
    decoded = receiver.decode(classic, 0, 0.0)
    assert (decoded.format_valid, decoded.crc_valid, decoded.counter) == (False, False, -1)

"""`atalante conform`: the protocol, exit codes, the wall clock, and that the bench's frames are what it says they are."""

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
from atalante_tools.conform.bench import Bench, NotTested, WallClock
from atalante_tools.conform.examination import make_safe, requirements_of
from atalante_tools.conform.frames import Incoming, Outgoing
from atalante_tools.conform.requirement import LATE, Outcome, Requirement, Verdict, examine
from atalante_tools.conform.technician import Action, Person
from atalante_tools.console.outcome import Failed

from .conftest import MakeDesk

ORACLE = cantools.database.load_file(str(DBC_FILE), strict=False)


def run(*arguments: str) -> Result:
    return CliRunner().invoke(cli, ["conform", *arguments])


# -- command -----------------------------------------------------------------------------------------------------------


def test_the_protocol_says_what_was_asked_how_it_was_tested_and_what_came_of_it():
    result = run("left_sk", "--only", "drive-13", "--only", "NODE-01")
    assert result.exit_code == 0
    protocol = result.stdout
    assert protocol.startswith("ACCEPTANCE PROTOCOL  LEFT_SK (drive)\non embedded, ")
    entries = [line.split()[:2] for line in protocol.splitlines() if line.startswith(("NODE-", "DRIVE-"))]
    assert entries == [["NODE-01", "pass"], ["DRIVE-13", "pass"]]  # in the order of the node's life
    for part in (
        "Latches a local hold after 5 lost commands.",
        "tested: 5 cycles without command in OPERATION ENABLED",
        "measured: OPERATION_ENABLED -> QUICK_STOP_ACTIVE",
        "source: fault matrix F25",
    ):
        assert part in protocol
    assert "2 of 2 requirements passed" in result.stderr


def test_json_is_one_object_a_requirement():
    result = run("FOOT_LEFT", "--json", "--without", "NODE-03", "--without", "node-10")
    assert result.exit_code == 0
    objects = [json.loads(line) for line in result.stdout.splitlines()]
    assert {o["node"] for o in objects} == {"FOOT_LEFT"}
    assert {o["verdict"] for o in objects} == {"pass"}
    ids = [o["id"] for o in objects]
    assert "FOOT-01" in ids
    assert not {"NODE-03", "NODE-10"} & set(ids)
    assert "left out on request: NODE-03" in result.stderr
    assert all(set(o) == {"node", "id", "verdict", "requirement", "tested", "measured", "source"} for o in objects)


def test_what_fails_ends_the_command_with_1_and_is_named(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("atalante_emulator.drive.WATCHDOG", 6)
    result = run("LEFT_SK", "--only", "NODE-01", "--only", "DRIVE-13")
    assert result.exit_code == 1
    assert "DRIVE-13   FAIL" in result.stdout
    assert "1 of 2 requirements passed; not passed: DRIVE-13" in result.stderr


def test_what_could_not_be_tested_is_no_pass():
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
def test_a_wrong_command_line_is_answered_with_what_would_be_right(arguments: tuple[str, ...], hint: str):
    result = run(*arguments)
    assert result.exit_code == 2
    assert hint in result.output
    assert "Traceback" not in result.output


def test_a_bus_that_is_not_there_is_no_device():
    result = run("LEFT_SK", "-i", "no-such-interface", "-c", "nocan9")
    assert result.exit_code == 3
    assert "no-such-interface" in result.output


# -- requirements in general -------------------------------------------------------------------------------------------


def _requirement(test) -> Requirement:
    return Requirement("X-01", "", "", "", test)


def test_a_failure_while_this_computer_was_late_is_repeated_and_then_no_verdict(make_desk: MakeDesk):
    bench = make_desk("IMU_TORSO").bench
    tries = 0

    def late(bench: Bench) -> Outcome:
        nonlocal tries
        tries += 1
        bench.clock.late = 2 * LATE
        return Outcome(False, "a gap")

    (result,) = examine(bench, [_requirement(late)])
    assert (result.verdict, tries) == (Verdict.NOT_TESTED, 3)
    assert "late by 4.0 ms" in result.measured

    def late_once(bench: Bench) -> Outcome:
        nonlocal tries
        tries += 1
        bench.clock.late = 2 * LATE if tries == 4 else 0.0
        return Outcome(False, "a defect")

    (result,) = examine(bench, [_requirement(late_once)])
    assert (result.verdict, result.measured) == (Verdict.FAILED, "a defect")


def test_ids_are_unique_and_texts_complete(make_desk: MakeDesk, network: Network):
    for name in ("LEFT_FH", "IMU_TORSO", "FOOT_LEFT", "HAPTICS", "PENDANT"):
        requirements = requirements_of(make_desk(name).bench)
        assert len({r.id for r in requirements}) == len(requirements)
        assert all(r.text.endswith(".") and r.how and r.source for r in requirements)


def test_a_drive_is_left_in_its_hold(make_desk: MakeDesk):
    desk = make_desk("LEFT_SK")
    list(examine(desk.bench, [r for r in requirements_of(desk.bench) if r.id == "DRIVE-07"]))
    assert desk.emulator.drives.state[3].name == "OPERATION_ENABLED"
    make_safe(desk.bench)
    assert desk.emulator.drives.state[3].name == "QUICK_STOP_ACTIVE"


# -- the wall clock ----------------------------------------------------------------------------------------------------


def test_on_the_wall_clock_cycles_keep_their_time_and_answers_their_cycle(
    make_desk: MakeDesk, network: Network, robot: Robot
):
    """The emulated node again, but in real time; only what does not depend on the machine's punctuality is asserted."""
    desk = make_desk("IMU_TORSO")
    begun = time.monotonic()
    bench = Bench(network, robot, network.node("IMU_TORSO"), desk.wire, WallClock(), Person(patience=0.5))
    outcome = answers_every_sync(bench)
    assert time.monotonic() - begun >= 0.2  # never faster than real time
    assert outcome.passed, outcome.measured
    assert bench.cycle_number == 200


def test_a_missed_deadline_is_counted_and_not_caught_up_with():
    clock, begun, listened = WallClock(), time.monotonic(), []
    clock._deadline -= 0.005
    clock.next_cycle(sync=True, listen=listened.append)
    assert listened == [0.0]  # what has come is still taken before the next SYNC goes out
    assert clock.late >= 0.0039
    # The next deadline is a period from now, not four in the past.
    assert clock._deadline >= begun


def test_a_person_is_asked_on_stderr_and_silence_is_no_verdict(
    make_desk: MakeDesk, network: Network, robot: Robot, capsys: pytest.CaptureFixture
):
    desk = make_desk("IMU_TORSO")
    bench = Bench(network, robot, network.node("IMU_TORSO"), desk.wire, desk.bench.clock, Person(patience=0.01))
    with pytest.raises(NotTested, match="switch IMU_TORSO off and on again"):
        bench.ask(Action.POWER_UP, lambda heard: False)
    assert "please switch IMU_TORSO off and on again" in capsys.readouterr().err


def test_a_node_that_was_not_switched_off_has_not_booted(make_desk: MakeDesk, network: Network, robot: Robot):
    """On a bench nobody but a person can make a node boot; the emulated one here goes on answering."""
    desk = make_desk("IMU_TORSO")
    bench = Bench(network, robot, network.node("IMU_TORSO"), desk.wire, desk.bench.clock, Person(patience=0.4))
    (result,) = examine(bench, requirements_of(bench)[:1])
    assert result.verdict is Verdict.NOT_TESTED


def test_nobody_is_examined_beside_another_hal(network: Network, robot: Robot):
    ours, theirs = lockstep_pair()
    bench = Bench(network, robot, network.node("LEFT_SK"), ours, WallClock(), Person(patience=1.0))
    bench.make_sure_to_be_alone()
    theirs.send(TransmitImage([network.message("SYNC_LEFT_LEG")]).seal())
    with pytest.raises(Failed, match="SYNC_LEFT_LEG was heard"):
        bench.make_sure_to_be_alone()


# -- frames ------------------------------------------------------------------------------------------------------------


def _profile_5(frame: np.ndarray, data_id: int) -> bool:
    """The AUTOSAR package's word on the CRC."""
    payload = frame["data"][0][: frame["len"][0]].tobytes()
    return bool(e2e.p05.e2e_p05_check(payload, data_id))


def test_a_right_frame_is_right_to_cantools_and_autosar(network: Network):
    message = network.message("COMMAND_LEFT_LEG")
    out = Outgoing(message)
    for counter in range(3):
        frame = out.frame({"SK_TargetTorque": -12.5, "SK_Controlword": 15.0, "SK_MaxTorque": 3.0})
        said = ORACLE.decode_message(message.name, frame["data"][0][:48].tobytes(), decode_choices=False)
        assert (said["SK_TargetTorque"], said["SK_Controlword"], said["SK_MaxTorque"]) == (-12.5, 15, 3.0)
        assert (said["FH_TargetTorque"], said["Counter"]) == (0.0, counter)
        assert _profile_5(frame, message.data_id)


def test_each_defect_is_the_one_that_was_asked_for(network: Network):
    message, other = network.message("COMMAND_LEFT_LEG"), network.message("COMMAND_RIGHT_LEG")
    out = Outgoing(message)
    out.frame({})
    damaged = out.frame({}, flip=200)
    assert not _profile_5(damaged, message.data_id)
    stranger = out.frame({}, data_id=other.data_id)
    assert not _profile_5(stranger, message.data_id)
    assert _profile_5(stranger, other.data_id)
    repeated = out.frame({}, counter=out.counter)
    assert repeated["data"][0][2] == out.counter == 2
    longer = out.frame({}, length=64)
    assert longer["len"] == 64
    assert _profile_5(longer, message.data_id)
    classic = Outgoing(network.message("SYNC_LEFT_LEG")).frame({}, classic=True)
    assert classic["flags"] == 0
    invalid = out.frame({"SK_TargetTorque": 1.0}, raw={"SK_TargetTorque": 0x8000})
    assert (
        ORACLE.decode_message(message.name, invalid["data"][0][:48].tobytes(), scaling=False)["SK_TargetTorque"]
        == -32768
    )


def test_what_is_heard_is_judged_frame_by_frame(network: Network):
    message = network.message("IMU_TORSO_STATE")
    out, ear = Outgoing(message), Incoming(message)
    good = ear.hear(out.frame({"QuaternionW": 1.0, "AccelZ": 9.81}), cycle=7, time=0.5)
    assert (good.length_right, good.format_right, good.crc_right, good.reserved_zero) == (True, True, True, True)
    assert (good.counter, good.cycle, good.time, good.outside) == (0, 7, 0.5, ())
    assert good.values["AccelZ"] == pytest.approx(9.81, abs=0.0025)
    assert not ear.hear(out.frame({}, flip=100), 0, 0.0).crc_right
    assert not ear.hear(out.frame({}, data_id=1), 0, 0.0).crc_right
    assert ear.hear(out.frame({}, raw={"GyroX": 0x8000}), 0, 0.0).outside == ("GyroX",)
    assert not ear.hear(out.frame({}, flip=45), 0, 0.0).reserved_zero
    short = ear.hear(out.frame({}, length=24), 0, 0.0)
    assert (short.length_right, short.values) == (False, {})
    classic = new_frames(1)
    classic["can_id"], classic["len"] = message.frame_id, 1
    judged = ear.hear(classic, 0, 0.0)
    assert (judged.format_right, judged.crc_right, judged.counter) == (False, False, -1)

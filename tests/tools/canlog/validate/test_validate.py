"""Command `atalante validate`: log formats, damaged logs, live buses, reports, the rules file, list of unchecked items."""

from __future__ import annotations

import gzip
import json
import signal
import threading
import time
import xml.etree.ElementTree as ET
from collections.abc import Callable
from contextlib import suppress
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import can
import numpy as np
import pytest
from click.testing import CliRunner, Result

import atalante_dbc
from atalante_dbc.foreign import catalogue
from atalante_hal.bus import BusDown
from atalante_hal.wire.codec import Codec
from atalante_hal.wire.e2e import crc, data_id_bytes
from atalante_hal.wire.frame import FRAME, Frames, new_frames
from atalante_tools.canlog.plan import Plan
from atalante_tools.canlog.reader import candump, candump_log
from atalante_tools.canlog.reader import log as log_module
from atalante_tools.canlog.reader.chunk import NO_DIRECTION, Chunk
from atalante_tools.canlog.reader.log import open_log
from atalante_tools.canlog.reader.log_file import LogError
from atalante_tools.canlog.validate import run as run_module
from atalante_tools.canlog.validate.project import Project, ProjectError, load_project
from atalante_tools.canlog.validate.report import Report, report, text
from atalante_tools.canlog.validate.rules import RULES
from atalante_tools.canlog.validate.run import listen, validate_log
from atalante_tools.canlog.validate.timing_rules import BINS, jitter_p99
from atalante_tools.canlog.validate.validator import Validator
from atalante_tools.cli import cli
from atalante_tools.console.stop_request import Stopped, check_stop, ended_by

NETWORK = atalante_dbc.load()
MakeRig = Callable[..., Any]
HEAD = 'VERSION ""\nNS_ :\nBS_:\nBU_: A B\n\n'
BEGIN = 1_700_000_000.0

#: DBC of a foreign network: classic CAN with cycle times, without buses and E2E.
FOREIGN = (
    HEAD
    + """BO_ 256 Speed: 8 A
 SG_ Wheel : 7|16@0+ (0.01,0) [0|300] "km/h" B
 SG_ Gear : 16|4@1+ (1,0) [0|5] "" B
 SG_ Raw : 24|8@1+ (1,0) [0|255] "" B

BO_ 512 Event: 2 B
 SG_ Code : 0|16@1+ (1,0) [0|0] "" A

BA_DEF_ BO_ "GenMsgCycleTime" INT 0 10000;
BA_DEF_ BO_ "GenMsgSendType" ENUM "cyclic","event";
BA_DEF_ "Baudrate" INT 0 1000000;
BA_DEF_DEF_ "GenMsgCycleTime" 0;
BA_DEF_DEF_ "GenMsgSendType" "event";
BA_DEF_DEF_ "Baudrate" 500000;
BA_ "GenMsgCycleTime" BO_ 256 10;
BA_ "GenMsgSendType" BO_ 256 0;
VAL_ 256 Gear 0 "P" 1 "R" 2 "N" 3 "D" 5 "S" ;
"""
)


def node_frames(cycles: int) -> list[can.Message]:
    """Return the messages of the node LEFT_FH: its state every millisecond, its status every 100 ms."""
    noise = np.random.default_rng(0)
    found = []
    for cycle in range(cycles):
        for name in ("LEFT_FH_STATE", "LEFT_FH_STATUS"):
            message = NETWORK.message(name)
            if cycle % message.cycle_ms:
                continue
            codec, frames = Codec([message]), new_frames(1)
            values = np.zeros(codec.size)
            values[codec.index(name, "Counter")] = cycle // message.cycle_ms % 256
            if name == "LEFT_FH_STATE":
                values[codec.index(name, "DriveState")] = 0x40
                values[codec.index(name, "Temperature")] = 25
                values[codec.index(name, "Torque")] = noise.normal(0.0, 0.1)
            else:
                values[codec.index(name, "NodeState")] = 5
                values[codec.index(name, "DbcHash")] = NETWORK.hash32
            codec.encode(values, frames)
            payload = frames["data"][0, : message.length].tobytes()
            protected = crc(payload[2:], data_id_bytes(message.data_id)).to_bytes(2, "little") + payload[2:]
            found.append(
                can.Message(
                    timestamp=BEGIN + cycle * 1e-3 + message.frame_id * 1e-7,
                    arbitration_id=message.frame_id,
                    is_extended_id=False,
                    is_fd=True,
                    bitrate_switch=True,
                    data=protected,
                    channel=0,
                )
            )
    return found


MESSAGES = node_frames(400)


def write(path: Path, messages: list[can.Message]) -> Path:
    with can.Logger(path) as logger:
        for message in messages:
            logger.on_message_received(message)
    return path


def run(*arguments: object) -> Result:
    """Run the command. Any exception except `SystemExit` fails the test."""
    result = CliRunner().invoke(cli, [str(argument) for argument in arguments])
    assert result.exception is None or isinstance(result.exception, SystemExit), result.exception
    return result


def rules_of(result: Result) -> set[str]:
    return {json.loads(line)["rule"] for line in result.stdout.splitlines()}


@pytest.fixture(scope="module")
def plan() -> Plan:
    return Plan(catalogue(atalante_dbc.DBC_FILE))


@pytest.fixture
def good(tmp_path: Path) -> Path:
    return write(tmp_path / "good.log", MESSAGES)


@pytest.mark.parametrize("command", ["validate", "decode"])
def test_stop_signal_discarded_by_a_library_ends_the_command(
    command: str, good: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A library may discard the exception of the signal. The command then ends without a report."""
    opened = log_module.open_log

    def discard(path: Path) -> log_module.Log:
        with suppress(Stopped):
            signal.raise_signal(signal.SIGTERM)
            check_stop()
        return opened(path)

    monkeypatch.setattr(log_module, "open_log", discard)
    monkeypatch.setattr(run_module, "open_log", discard)
    with ended_by(lambda: None):
        result = run(command, good, *(() if command == "validate" else ("-o", tmp_path / "out.parquet")))
    assert result.exit_code == 128 + signal.SIGTERM
    assert result.stdout == ""
    assert not (tmp_path / "out.parquet").exists()


def test_first_chunk_is_read_in_the_main_thread(good: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The first chunk may compile the parser, and a stop signal interrupts a compilation only in the main thread."""
    whole = good.read_bytes()
    threads = []
    parse = candump.parse

    def parse_and_record(*arguments: Any) -> candump.Parsed:
        threads.append(threading.current_thread())
        return parse(*arguments)

    monkeypatch.setattr(candump, "parse", parse_and_record)
    monkeypatch.setattr(candump_log, "_TEXT_BYTES", len(whole) // 3)
    monkeypatch.setattr(log_module, "_CHUNK_FRAMES", 1)
    result = validate_log(good, Plan(catalogue(atalante_dbc.DBC_FILE)), Project())
    assert result.validator.frames == whole.count(b"\n")
    assert threads[0] is threading.main_thread()
    assert len(threads) > 2
    assert all(thread is not threading.main_thread() for thread in threads[1:])


# -- formats ---------------------------------------------------------------------------------------------------------------


def test_complete_compressed_blf_log_is_not_reported_as_truncated(tmp_path: Path) -> None:
    path = tmp_path / "night.blf.gz"
    path.write_bytes(gzip.compress(write(tmp_path / "night.blf", MESSAGES).read_bytes()))
    assert rules_of(run("validate", path, "--node", "LEFT_FH", "--json")) == set()


@pytest.mark.parametrize("suffix", [".log", ".asc", ".blf", ".mf4", ".log.gz", ".asc.gz"])
def test_every_log_format_gives_the_same_findings(suffix: str, tmp_path: Path) -> None:
    damaged = [m for m in MESSAGES if m.arbitration_id != 0x181 or not 0.2 <= m.timestamp - BEGIN <= 0.201]
    damaged[50].data[5] ^= 1
    try:
        path = write(tmp_path / f"night{suffix}", damaged)
    finally:
        damaged[50].data[5] ^= 1
    result = run("validate", path, "--node", "LEFT_FH", "--json")
    found = {json.loads(line)["rule"]: json.loads(line) for line in result.stdout.splitlines()}
    assert set(found) == {"crc", "counter-lost"}
    assert found["counter-lost"]["message"] == "LEFT_FH_STATE"
    assert found["counter-lost"]["worst"] == "1 lost"
    assert result.exit_code == 1


def test_report_lists_the_flag_rules_as_unchecked_for_csv(tmp_path: Path) -> None:
    result = run("validate", write(tmp_path / "night.csv", MESSAGES), "--node", "LEFT_FH")
    assert result.exit_code == 0
    assert "frame-fdf, frame-brs, frame-esi: this log format does not keep CAN FD flags" in result.stdout


@pytest.mark.parametrize(("suffix", "unchecked"), [(".trc", True), (".blf", True), (".asc", False)])
def test_bus_errors_that_are_not_read_are_listed_as_unchecked(suffix: str, unchecked: bool, tmp_path: Path) -> None:
    result = run("validate", write(tmp_path / f"walk{suffix}", MESSAGES[:10]), "--node", "LEFT_FH")
    assert ("error-frame: not all bus errors of this log format are read" in result.stdout) is unchecked


def test_trc_log_has_no_findings(tmp_path: Path) -> None:
    """Use a classic network, because python-can writes no CAN FD frames into .trc."""
    dbc = tmp_path / "foreign.dbc"
    dbc.write_text(FOREIGN)
    messages = [
        can.Message(timestamp=BEGIN + 0.01 * k, arbitration_id=256, is_extended_id=False, data=bytes(8), channel="1")
        for k in range(50)
    ]
    result = run("validate", write(tmp_path / "night.trc", messages), "--dbc", dbc, "--json")
    assert rules_of(result) == set()
    assert result.exit_code == 0


# -- damaged logs ----------------------------------------------------------------------------------------------------------


def test_all_lines_before_a_truncated_line_are_checked(good: Path) -> None:
    good.write_bytes(good.read_bytes()[:-10])
    result = run("validate", good, "--node", "LEFT_FH")
    assert "ends within a line" in result.stdout
    assert f"{len(MESSAGES) - 1} frames" in result.stdout
    assert result.exit_code == 1


@pytest.mark.filterwarnings("ignore:unclosed file:ResourceWarning")  # asammdf leaves a damaged file open
@pytest.mark.parametrize("suffix", [".asc", ".blf", ".mf4", ".log", ".csv"])
@pytest.mark.parametrize("share", [0.0, 0.03, 0.5, 0.97])
@pytest.mark.sample(3)
def test_truncated_log_is_reported(suffix: str, share: float, tmp_path: Path) -> None:
    path = write(tmp_path / f"night{suffix}", MESSAGES)
    whole = path.read_bytes()
    cut = int(share * len(whole))
    path.write_bytes(whole[: cut - (whole[cut - 1 : cut] == b"\n")])  # a cut at the end of a line cannot be detected
    result = run("validate", path, "--node", "LEFT_FH")
    assert result.exit_code == 1
    output = result.stdout + result.stderr
    assert any(word in output for word in ("log-truncated", "log-empty", "cannot be read")), output


@pytest.mark.parametrize("suffix", [".blf", ".blf.gz"])
def test_blf_log_that_was_not_closed_is_reported_as_incomplete(suffix: str, tmp_path: Path) -> None:
    """The recorder is killed: only full containers are in the file, and the header still states no data."""
    path = tmp_path / f"night{suffix}"
    with (tmp_path / "open.blf").open("wb") as file:
        writer = can.BLFWriter(file, max_container_size=4096)
        for message in MESSAGES:
            writer.on_message_received(message)
        file.flush()
        content = (tmp_path / "open.blf").read_bytes()
    path.write_bytes(gzip.compress(content) if suffix.endswith(".gz") else content)
    result = run("validate", path, "--node", "LEFT_FH", "--json")
    assert rules_of(result) == {"log-truncated"}
    assert "was not closed by its recorder" in result.stderr
    assert result.exit_code == 1


@pytest.mark.parametrize("suffix", [".log", ".asc", ".blf", ".mf4", ".trc", ".csv"])
@pytest.mark.parametrize("content", [b"", b"\n", b"no log at all\n", bytes(range(256)) * 20])
@pytest.mark.sample(5)
def test_file_without_frames_is_reported(suffix: str, content: bytes, tmp_path: Path) -> None:
    path = tmp_path / f"strange{suffix}"
    path.write_bytes(content)
    result = run("validate", path)
    assert result.exit_code == 1
    output = result.stdout + result.stderr
    assert "log-empty" in output or "cannot be read" in output, output
    assert "Traceback" not in output


def test_unsorted_log_is_sorted_and_checked(tmp_path: Path) -> None:
    generator = np.random.default_rng(0)
    lines = write(tmp_path / "sorted.log", MESSAGES).read_text().splitlines()
    shuffled = tmp_path / "shuffled.log"
    shuffled.write_text("".join(f"{lines[k]}\n" for k in generator.permutation(len(lines)).tolist()))
    result = run("validate", shuffled, "--node", "LEFT_FH", "--json")
    assert rules_of(result) == {"log-unsorted"}
    assert "not in order of time" in result.stderr


def test_copy_on_a_second_channel_is_reported_as_wrong_bus(tmp_path: Path) -> None:
    """A gateway copies the frames: only the copies are reported."""
    twice = [m for message in MESSAGES for m in (message, _on(message, 1))]
    result = run("validate", write(tmp_path / "twice.blf", twice), "--node", "LEFT_FH", "--json")
    assert rules_of(result) == {"wrong-bus"}


def _on(message: can.Message, channel: int) -> can.Message:
    copy = message.__copy__()
    copy.channel = channel
    return copy


def test_channel_that_is_silent_at_first_is_assigned_to_its_bus(plan: Plan) -> None:
    validator = Validator(plan)
    for channel, name in enumerate(("LEFT_FH_STATE", "RIGHT_FH_STATE")):
        layout = plan.layouts[plan.row_of[name]]
        frames = new_frames(3)
        frames["can_id"], frames["len"] = layout.frame_id, layout.length
        stamps = np.arange(3, dtype=np.int64) * 1_000_000 + channel * 1_000_000_000
        chunk = Chunk(frames, stamps, np.full(3, channel, np.uint8), np.full(3, NO_DIRECTION, np.int8))
        validator.check(chunk, ["can0", "can1"])
    assert [plan.buses[bus] for bus in validator.channel_map.bus_of_channel] == ["left_leg", "right_leg"]


def test_unknown_identifiers_beyond_one_hundred_are_combined(plan: Plan) -> None:
    """20,000 frames with random identifiers give 100 findings and one for all other identifiers."""
    generator = np.random.default_rng(0)
    frames = new_frames(20_000)
    frames["can_id"] = generator.integers(0, 1 << 29, len(frames)).astype(np.uint32) | np.uint32(1 << 31)
    frames["can_id"][:500] = 0x7E0
    validator = Validator(plan)
    stamps = np.arange(len(frames), dtype=np.int64) * 1000
    validator.check(
        Chunk(frames, stamps, np.zeros(len(frames), np.uint8), np.full(len(frames), NO_DIRECTION, np.int8)), ["a"]
    )
    validator.finish()
    found = [finding for finding in validator.findings.all() if finding.rule == "unknown-id"]
    assert len(found) == 101
    assert sum(finding.count for finding in found) == len(frames)
    assert max(found, key=lambda f: f.count if f.message != "(others)" else 0).message == "0x7e0"


def test_log_with_400_channel_names_is_read(tmp_path: Path) -> None:
    path = tmp_path / "names.log"
    path.write_text("".join(f"({k}.000000) ch{k} 7FF#00\n" for k in range(400)))
    result = run("validate", path)
    assert "400 frames" in result.stdout


def test_terminal_output_of_candump_is_rejected_with_a_hint(tmp_path: Path) -> None:
    path = tmp_path / "terminal.log"
    path.write_text("  vcan0  181   [8]  11 22 33 44 55 66 77 88\n" * 3)
    result = run("validate", path)
    assert result.exit_code == 1
    assert "a .log file must have the format of `candump -l`" in result.stdout


def test_missing_logs_do_not_stop_the_other_logs(good: Path, tmp_path: Path) -> None:
    result = run("validate", tmp_path / "none.log", good, tmp_path / "none.txt", "--node", "LEFT_FH")
    assert result.exit_code == 1
    assert "none.log does not exist" in result.stderr
    assert "the suffix of a CAN log must be one of" in result.stderr
    assert f"{len(MESSAGES)} frames" in result.stdout


def test_unknown_suffix_error_lists_the_valid_suffixes(tmp_path: Path) -> None:
    with pytest.raises(LogError, match=r"must be one of \.log, \.asc, \.blf.*night\.pcap"):
        open_log(tmp_path / "night.pcap")


# -- reports ---------------------------------------------------------------------------------------------------------------


def test_json_objects_have_exactly_the_documented_keys(good: Path) -> None:
    result = run("validate", good, "--json")
    lines = [json.loads(line) for line in result.stdout.splitlines()]
    assert lines
    for line in lines:
        assert set(line) == {"log", "rule", "message", "signal", "node", "count", "first_s", "last_s", "worst"}
        assert line["rule"] == "never-seen"
        assert (line["log"], line["signal"]) == (str(good), None)
        assert line["first_s"] == pytest.approx(BEGIN, abs=1.0)
    # The only channel has frames of left_leg, so the other messages of left_leg are missing.
    assert {line["node"] for line in lines} == {"HAL", *(f"LEFT_{j}" for j in ("TH", "SH", "SK", "SA", "HA"))}


def test_json_objects_name_the_log_and_the_signal(tmp_path: Path) -> None:
    dbc = tmp_path / "foreign.dbc"
    dbc.write_text(FOREIGN)
    logs = []
    for name, wheel, gear in (("night.log", 40_000, 3), ("day.log", 12_000, 4)):
        payload = wheel.to_bytes(2, "big") + bytes([gear]) + bytes(5)
        messages = [
            can.Message(timestamp=BEGIN + 0.01 * k, arbitration_id=256, is_extended_id=False, data=payload)
            for k in range(20)
        ]
        logs.append(write(tmp_path / name, messages))
    result = run("validate", *logs, "--dbc", dbc, "--json")
    lines = [json.loads(line) for line in result.stdout.splitlines()]
    assert [(line["log"], line["rule"], line["signal"]) for line in lines] == [
        (str(logs[0]), "range", "Wheel"),
        (str(logs[1]), "value-table", "Gear"),
    ]


@pytest.mark.parametrize("stamp", ["1700000000.267459", "1700000000.467022"])
def test_json_times_are_the_times_of_the_log(stamp: str, tmp_path: Path) -> None:
    path = tmp_path / "night.log"
    path.write_text(f"({stamp}) vcan0 7FF#00\n")
    result = run("validate", path, "--node", "LEFT_FH", "--json")
    (line,) = [line for line in result.stdout.splitlines() if '"unknown-id"' in line]
    assert f'"first_s": {stamp}, "last_s": {stamp}' in line


def test_junit_has_one_case_per_rule(good: Path, tmp_path: Path) -> None:
    path = tmp_path / "result.xml"
    run("validate", good, "--junit", path)
    (suite,) = ET.parse(path).getroot()
    cases = {case.get("name"): case for case in suite}
    assert set(cases) == {rule.id for rule in RULES}
    failure = cases["never-seen"].find("failure")
    assert failure is not None
    assert "LEFT_TH_STATE" in (failure.text or "")
    assert cases["crc"].find("failure") is None
    assert cases["sender"].find("skipped") is not None
    assert (suite.get("failures"), suite.get("tests")) == ("1", str(len(RULES)))


def test_junit_has_an_error_for_each_log_that_was_not_read(good: Path, tmp_path: Path) -> None:
    path = tmp_path / "result.xml"
    missing, wrong = tmp_path / "none.log", tmp_path / "none.txt"
    result = run("validate", missing, good, wrong, "--node", "LEFT_FH", "--junit", path)
    assert result.exit_code == 1
    suites = list(ET.parse(path).getroot())
    assert [suite.get("name") for suite in suites] == [str(missing), str(good), str(wrong)]
    counts = [[suite.get(key) for key in ("tests", "errors", "failures")] for suite in suites]
    assert counts == [["1", "1", "0"], [str(len(RULES)), "0", "0"], ["1", "1", "0"]]
    assert [error.text for error in ET.parse(path).iter("error")] == [
        line.removeprefix("atalante: ") for line in result.stderr.splitlines()
    ]


def test_junit_skips_the_rules_that_checked_nothing(tmp_path: Path) -> None:
    dbc, path = tmp_path / "foreign.dbc", tmp_path / "result.xml"
    dbc.write_text(HEAD + 'BO_ 256 Speed: 1 A\n SG_ Raw : 0|8@1+ (1,0) [0|255] "" B\n')
    messages = [can.Message(timestamp=BEGIN + k, arbitration_id=256, is_extended_id=False, data=[k]) for k in range(30)]
    run("validate", write(tmp_path / "drive.log", messages), "--dbc", dbc, "--junit", path)
    (suite,) = ET.parse(path).getroot()
    skipped = {case.get("name") for case in suite if case.find("skipped") is not None}
    e2e = {"crc", "crc-data-id", "counter-repeated", "counter-lost", "counter-sequence"}
    values = {"range", "invalid-code", "value-table", "multiplexer", "dbc-hash"}
    times = {"cycle-mean", "cycle-jitter", "cycle-gap", "cycle-fast", "timeout", "recovered", "late-start", "inhibit"}
    assert e2e | values | times <= skipped
    assert not {"unknown-id", "length", "never-seen"} & skipped
    assert suite.get("skipped") == str(len(skipped))


def test_junit_skips_the_rules_for_messages_that_are_not_in_the_log(tmp_path: Path) -> None:
    imu, path = NETWORK.message("IMU_TORSO_STATE"), tmp_path / "result.xml"
    message = can.Message(
        arbitration_id=imu.frame_id, is_extended_id=False, is_fd=True, bitrate_switch=True, data=bytes(imu.length)
    )
    log = write(tmp_path / "one.log", [message])
    run("validate", log, "--node", "IMU_TORSO", "--junit", path)
    skipped = {case.get("name") for case in ET.parse(path).iter("testcase") if case.find("skipped") is not None}
    assert {"cia402-transition", "cia402-response", "sync-order", "state-late", "velocity"} <= skipped


def test_junit_lists_the_messages_for_which_a_rule_was_not_checked(good: Path, tmp_path: Path) -> None:
    path = tmp_path / "result.xml"
    run("validate", good, "--node", "LEFT_FH", "--junit", path)
    (case,) = (case for case in ET.parse(path).iter("testcase") if case.get("name") == "cycle-jitter")
    assert case.find("skipped") is None
    assert case.findtext("system-out") == (
        "not checked: cycle-jitter: too few intervals in the log for the 99 % quantile (1): LEFT_FH_STATUS"
    )


def test_junit_has_an_error_if_no_frame_was_checked(tmp_path: Path) -> None:
    path = tmp_path / "live.xml"
    result = run("validate", "-i", "virtual", "-c", "silent", "--for", "0.1", "--junit", path)
    assert result.exit_code == 1
    (suite,) = ET.parse(path).getroot()
    assert [error.text for error in suite.iter("error")] == ["no frame was checked"]
    counts = [suite.get(key) for key in ("tests", "errors", "failures", "skipped")]
    assert counts == [str(len(RULES) + 1), "1", "0", str(len(RULES))]


def test_html_names_each_log_that_was_not_read(good: Path, tmp_path: Path) -> None:
    missing, path = tmp_path / "<missing>.log", tmp_path / "night.html"
    run("validate", missing, good, "--node", "LEFT_FH", "--html", path)
    page = path.read_text()
    assert page.index("&lt;missing&gt;.log does not exist") < page.index(f"<h2>{good}</h2>")


def test_junit_escapes_the_characters_that_xml_does_not_allow(tmp_path: Path) -> None:
    path, strange = tmp_path / "result.xml", tmp_path / "strange.trc"
    strange.write_bytes(bytes(range(256)) * 20)
    run("validate", strange, tmp_path / "no\x1bne.log", "--junit", path)
    suites = ET.parse(path).getroot()
    assert any("\\x00\\x01" in (failure.text or "") for failure in suites.iter("failure"))
    (error,) = suites.iter("error")
    assert error.text == f"the log {tmp_path}/no\\x1bne.log does not exist"
    assert suites[1].get("name") == f"{tmp_path}/no\\x1bne.log"


@pytest.mark.parametrize(
    ("option", "name", "suffixes"),
    [
        ("--html", "night.log", ".html or .htm"),
        ("--html", "result.xml", ".html or .htm"),
        ("--junit", "vehicle.dbc", ".xml"),
        ("--junit", "night.html", ".xml"),
    ],
)
def test_report_does_not_overwrite_a_file_of_another_type(
    option: str, name: str, suffixes: str, good: Path, tmp_path: Path
) -> None:
    path = tmp_path / name
    path.write_text("content")
    result = run("validate", good, option, path)
    assert result.exit_code == 2
    assert f"must end in {suffixes}, got {path}" in result.stderr
    assert path.read_text() == "content"


class _Outside(HTMLParser):
    """Collect the tags of a page and its links to other resources."""

    def __init__(self) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.links: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.links += [f"{tag} {name}={value}" for name, value in attrs if name in ("src", "href", "action", "srcset")]


def test_html_has_the_plots_and_no_external_resources(good: Path, tmp_path: Path) -> None:
    lines = good.read_text().splitlines(keepends=True)
    good.write_text("".join(lines[:200] + lines[203:]))
    path = tmp_path / "night.html"
    run("validate", good, "--html", path, "--node", "LEFT_FH")
    page = path.read_text()
    parser = _Outside()
    parser.feed(page)
    assert parser.links == []
    assert parser.tags.count("svg") == 4  # load, gaps, two histograms
    assert parser.tags.count("circle") == 1
    assert "rect" in parser.tags
    for rule in RULES:
        assert rule.id in page
    assert "url(" not in page


def test_report_to_a_full_device_fails_with_one_line(good: Path, tmp_path: Path) -> None:
    path = tmp_path / "full.html"
    path.symlink_to("/dev/full")
    result = run("validate", good, "--node", "LEFT_FH", "--html", path)
    assert result.exit_code == 1
    assert result.stderr == f"atalante: {path} cannot be written: No space left on device\n"


def test_text_report_explains_the_violated_rules(good: Path) -> None:
    result = run("validate", good)
    assert "never-seen: A cyclic message is not in the log [BA_ GenMsgCycleTime]" in result.stdout
    assert "LEFT_TH_STATE" in result.stdout


def test_list_rules_prints_every_rule() -> None:
    result = run("validate", "--list-rules")
    assert result.exit_code == 0
    for rule in RULES:
        assert rule.id in result.stdout


def test_list_rules_as_json_has_every_threshold() -> None:
    listed = [json.loads(line) for line in run("validate", "--list-rules", "--json").stdout.splitlines()]
    assert [rule["rule"] for rule in listed] == [rule.id for rule in RULES]
    assert all(rule["meaning"] and rule["source"] for rule in listed)
    assert sum(len(rule["thresholds"]) for rule in listed) == sum(len(rule.thresholds) for rule in RULES)


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ((), "the input must be log files or a live bus (-i socketcan -c can0), got neither"),
        (("a.log", "-i", "virtual", "-c", "x"), "(-i socketcan -c can0), got both"),
        (("-i", "virtual"), "virtual needs a channel"),
        (("a.log", "--lockstep"), "--lockstep needs a live bus"),
        (("a.log", "-c", "can0"), "--channel needs a live bus"),
        (("a.log", "--for", "3"), "--for needs a live bus"),
        (("a.log", "--node", "NO_NODE"), "--node must be a sender in the DBC"),
    ],
)
def test_wrong_arguments_give_a_usage_error(arguments: tuple[str, ...], sentence: str) -> None:
    result = run("validate", *arguments)
    assert result.exit_code == 2
    assert sentence in result.stderr


# -- unchecked items -------------------------------------------------------------------------------------------------------


def test_foreign_network_is_checked_within_its_dbc(tmp_path: Path) -> None:
    dbc = tmp_path / "foreign.dbc"
    dbc.write_text(FOREIGN)
    messages = [
        can.Message(
            timestamp=BEGIN + 0.01 * k,
            arbitration_id=256,
            is_extended_id=False,
            data=(40_000 if k == 5 else 12_000).to_bytes(2, "big") + bytes([4 if k == 7 else 3]) + bytes(5),
        )
        for k in range(60)
        if k not in (20, 21, 22)
    ]
    result = run("validate", write(tmp_path / "drive.log", messages), "--dbc", dbc, "--json")
    found = {json.loads(line)["rule"]: json.loads(line) for line in result.stdout.splitlines()}
    assert set(found) == {"range", "value-table", "cycle-gap"}
    assert found["range"]["worst"] == "Wheel = 400 km/h"
    assert found["value-table"]["worst"] == "Gear = 4 raw"
    assert found["cycle-gap"]["worst"] == "40 ms"
    for sentence in (
        "messages without E2EDataId",
        "the DBC has no attribute Bus",
        "no cyclic message SYNC",
        "no message has a signal DriveState",
        "no rule checked the values of these signals (1): Speed.Raw",
        "neither in the log nor required (1): Event",
    ):
        assert sentence in result.stderr


def test_unsupported_messages_are_named(tmp_path: Path) -> None:
    dbc = tmp_path / "foreign.dbc"
    dbc.write_text(HEAD + 'BO_ 1 Long: 16 A\n SG_ S : 0|65@1+ (1,0) [0|0] "" B\n')
    messages = [
        can.Message(timestamp=BEGIN + k, arbitration_id=1, is_extended_id=False, is_fd=True, data=bytes(16))
        for k in range(3)
    ]
    result = run("validate", write(tmp_path / "drive.log", messages), "--dbc", dbc)
    assert result.exit_code == 1
    assert "unsupported" in result.stdout
    assert "S has 65 bits" in result.stdout


def test_report_without_findings_lists_the_unchecked_signals(good: Path) -> None:
    result = run("validate", good, "--node", "LEFT_FH")
    assert result.exit_code == 0
    assert "LEFT_FH_STATUS.FirmwareVersion" in result.stdout
    assert result.stdout.splitlines()[-1] == "no findings; see above for the items that were not checked"


@pytest.mark.parametrize(("cycles", "unchecked"), [(64, True), (400, False)])
def test_short_log_lists_the_rules_that_need_more_frames(cycles: int, unchecked: bool, tmp_path: Path) -> None:
    result = run("validate", write(tmp_path / "short.log", node_frames(cycles)), "--node", "LEFT_FH")
    for sentence in (
        "bus-load: the log has no complete time window of 0.1 s",
        "stuck: fewer than 100 frames in the log (1): LEFT_FH_STATE",
        "velocity: fewer than 65 frames in the log (1): LEFT_FH_STATE",
    ):
        assert (sentence in result.stdout) is unchecked, result.stdout


@pytest.mark.parametrize(
    ("suffix", "rate", "unchecked"),
    [
        (".log", "DataBitrate", False),
        (".csv", "DataBitrate", False),
        (".log", "BaudrateCANFD", False),
        (".log", "X", True),
    ],
)
def test_bus_load_of_can_fd_frames_uses_the_data_bit_rate(
    suffix: str, rate: str, unchecked: bool, tmp_path: Path
) -> None:
    """A frame of 64 bytes each ms is 41 % of 500 kbit/s with a data phase of 2 Mbit/s, and 142 % without."""
    dbc = tmp_path / "fd.dbc"
    dbc.write_text(
        HEAD
        + 'BO_ 256 M: 64 A\n SG_ S : 0|8@1+ (1,0) [0|0] "" B\n\n'
        + f'BA_DEF_ "Baudrate" INT 0 1000000;\nBA_DEF_ "{rate}" INT 0 8000000;\n'
        + f'BA_DEF_DEF_ "Baudrate" 500000;\nBA_DEF_DEF_ "{rate}" 2000000;\n'
    )
    messages = [
        can.Message(
            timestamp=BEGIN + k * 1e-3,
            arbitration_id=256,
            is_extended_id=False,
            is_fd=True,
            bitrate_switch=True,
            data=bytes(64),
        )
        for k in range(400)
    ]
    path = write(tmp_path / f"fd{suffix}", messages)
    result = run("validate", path, "--dbc", dbc)
    reason = "bus-load: frames switch to the data bit rate, but the DBC has neither DataBitrate nor BaudrateCANFD"
    assert (reason in result.stdout) is unchecked
    assert "bus-load" not in rules_of(run("validate", path, "--dbc", dbc, "--json"))


def test_j1939_groups_of_several_senders_have_no_timing_findings(tmp_path: Path) -> None:
    dbc = Path(__file__).parents[3] / "foreign" / "j1939.dbc"
    messages = [
        can.Message(
            timestamp=BEGIN + k * 0.005, arbitration_id=0x18FEF100 + k % 2, is_extended_id=True, data=b"\xff" * 8
        )
        for k in range(20)
    ]
    result = run("validate", write(tmp_path / "truck.log", messages), "--dbc", dbc)
    assert "parameter groups with several sender addresses (1): CCVS" in result.stdout
    assert "unknown-id" not in result.stdout


# -- rules file of a project -----------------------------------------------------------------------------------------------


def test_silenced_findings_are_reported_as_silenced(good: Path, tmp_path: Path) -> None:
    rules = tmp_path / "rules.toml"
    rules.write_text(
        '[[silence]]\nrule = "never-seen"\nmessage = "LEFT_*"\nreason = "one drive on the desk"\n'
        '[[silence]]\nrule = "never-seen"\nmessage = "*_LEFT_LEG"\nreason = "no master"\n'
    )
    junit = tmp_path / "result.xml"
    result = run("validate", good, "--rules", rules, "--junit", junit)
    assert result.exit_code == 0
    assert "never-seen LEFT_TH_STATE, 1 times: one drive on the desk" in result.stdout
    assert "never-seen SYNC_LEFT_LEG, 1 times: no master" in result.stdout
    assert "silenced for LEFT_TH_STATE: one drive on the desk" in junit.read_text()


def test_thresholds_of_the_rules_file_change_the_findings(good: Path, tmp_path: Path) -> None:
    rules = tmp_path / "rules.toml"
    rules.write_text("[cycle-fast]\ncycles = 2.5\n[step]\nFirmwareVersion = 1.0\n")
    result = run("validate", good, "--rules", rules, "--node", "LEFT_FH", "--json")
    assert rules_of(result) == {"cycle-fast"}


def test_channels_are_assigned_to_buses(tmp_path: Path) -> None:
    rules = tmp_path / "rules.toml"
    rules.write_text('[channels]\n0 = "right_leg"\n')
    path = write(tmp_path / "night.blf", MESSAGES)
    result = run("validate", path, "--rules", rules, "--node", "LEFT_FH", "--json")
    assert rules_of(result) <= {"never-seen"}
    rules.write_text('[channels]\n0 = "middle_leg"\n')
    result = run("validate", path, "--rules", rules)
    assert result.exit_code == 2
    assert "[channels] must name buses of the DBC (left_leg" in result.stderr


@pytest.mark.parametrize(
    ("content", "sentence"),
    [
        ("[no-rule]\nx = 1\n", "a rule must be one of log-empty, .*, got 'no-rule'"),
        ("[crc]\nx = 1\n", "crc has no threshold"),
        ("[cycle-gap]\nx = 1\n", "the name of a threshold of cycle-gap must be one of cycles, got 'x'"),
        ("[cycle-gap]\ncycles = -1\n", "must be a number of at least 0, got -1"),
        ("[cycle-gap]\ncycles = 'two'\n", "must be a number of at least 0, got 'two'"),
        ("[cycle-gap]\ncycles = nan\n", "must be a number of at least 0, got nan"),
        ("[bus-load]\nwindow_s = 0\n", "bus-load.window_s must be from 0.001 to 3600, got 0"),
        ("[bus-load]\nwindow_s = 1e-10\n", "bus-load.window_s must be from 0.001 to 3600, got 1e-10"),
        ("[bus-load]\nwindow_s = 1e300\n", "bus-load.window_s must be from 0.001 to 3600, got 1e[+]300"),
        ("[bus-load]\nwindow_s = -0.1\n", "must be a number of at least 0, got -0.1"),
        ("[stuck]\ngroups = 'Gyro'\n", "must be a list of names, got 'Gyro'"),
        ("[velocity]\nposition = 3\n", "must be a name, got 3"),
        ("[[silence]]\nrule = 'crc'\n", "must have a reason"),
        ("[[silence]]\nrule = 'crc'\nreason = ' '\n", "must have a reason"),
        ("[[silence]]\nrule = 'what'\nreason = 'x'\n", "must be one of log-empty, .*, got 'what'"),
        ("[[silence]]\nrule = 'crc'\nwhy = 'x'\n", "must have only the keys rule, message, reason"),
        ("silence = 1\n", "must be a list of tables"),
        ("channels = 1\n", "must assign the name of a bus"),
        ("[", "cannot be read as TOML"),
    ],
)
def test_wrong_rules_file_is_rejected_by_key(content: str, sentence: str, tmp_path: Path) -> None:
    path = tmp_path / "rules.toml"
    path.write_text(content)
    with pytest.raises(ProjectError, match=sentence):
        load_project(path)


# -- live ------------------------------------------------------------------------------------------------------------------


def test_damaged_frames_of_a_live_bus_are_reported(plan: Plan) -> None:
    """A node sends while the command listens; every fifth frame is damaged."""
    sender = can.Bus(interface="virtual", channel="validate", protocol=can.CanProtocol.CAN_FD)
    done = threading.Event()

    def send() -> None:
        number = 0
        while not done.is_set():
            message = MESSAGES[number % len(MESSAGES)].__copy__()
            if number % 5 == 0:
                message.data = bytearray(message.data)
                message.data[5] ^= 1
            sender.send(message)
            number += 1
            time.sleep(0.001)

    thread = threading.Thread(target=send)
    thread.start()
    try:
        result = run("validate", "-i", "virtual", "-c", "validate", "--node", "LEFT_FH", "--for", "1.2", "--json")
    finally:
        done.set()
        thread.join()
        sender.shutdown()
    assert result.exit_code == 1
    assert "crc" in rules_of(result)
    assert "dropped:" not in result.stderr


class Played:
    """Bus that returns up to 37 recorded frames per `receive`, then fails or stays empty."""

    name = "played"
    dropped = 3

    def __init__(self, chunk: Chunk, fails: bool) -> None:
        self.stamps = np.zeros(0, np.int64)
        self.failed = False
        self._chunk, self._fails, self._at = chunk, fails, 0

    def receive(self, frames: Frames, timeout: float = 0.0) -> int:
        part = self._chunk.select(np.arange(self._at, min(self._at + 37, len(self._chunk))))
        self._at += len(part)
        if not len(part) and self._fails:
            self.failed = True
            raise BusDown("played is down: the adapter was unplugged")
        frames[: len(part)], self.stamps = part.frames, part.stamps
        return len(part)

    @property
    def ended(self) -> bool:
        return self._at >= len(self._chunk)

    def send(self, frames: Frames) -> None:
        raise AssertionError("the validator must not send frames")

    def close(self) -> None:
        pass


@pytest.mark.parametrize("fails", [False, True])
@pytest.mark.parametrize("count", [1, 2])
def test_live_bus_gives_the_findings_of_its_log(fails: bool, count: int, good: Path, plan: Plan) -> None:
    """One or two buses with the frames of a log give its findings; frames lost by the bus are also reported."""
    (chunk,) = open_log(good).chunks()
    halves = [chunk.select(np.flatnonzero(np.arange(len(chunk)) % count == number)) for number in range(count)]
    buses = {f"can{number}": Played(half, fails) for number, half in enumerate(halves)}
    result = listen(
        buses,
        plan,
        Project(),
        name="played",
        stopped=lambda: all(bus.ended and bus.failed is fails for bus in buses.values()),
        node="LEFT_FH",
    )
    assert result.validator.frames == len(chunk)
    rules = {finding.rule for finding in result.findings}
    assert "dropped" in rules
    assert ("log-truncated" in rules) == fails
    assert (rules - {"dropped", "log-truncated"} == set()) == (count == 1)


class Tap:
    """Recorder of every frame that a HAL sends or receives, in order."""

    def __init__(self) -> None:
        self.kept: list[Frames] = []

    def sent(self, frames: Frames) -> None:
        self.kept.append(frames.copy())

    def received(self, frames: Frames, count: int) -> None:
        self.kept.append(frames[:count].copy())


def lock_step_chunk(make_rig: MakeRig, seed: int = 0) -> tuple[Chunk, int]:
    """Return the frames of a lock-step run, and its number of cycles. Its speed varies from 0.05 to 50 times real time."""
    rig, frames = make_rig(), Tap()
    rig.hal.tap = frames
    rig.run(2000)
    random = np.random.default_rng(seed)
    per_part = np.exp(random.uniform(np.log(1e-5), np.log(1e-2), len(frames.kept)))  # a cycle has about two parts
    stamps = np.cumsum(per_part * 1e9).astype(np.int64) + 1_700_000_000_000_000_000
    joined = np.concatenate(frames.kept)
    counts = [len(part) for part in frames.kept]
    count = len(joined)
    chunk = Chunk(joined, stamps.repeat(counts), np.zeros(count, np.uint8), np.full(count, NO_DIRECTION, np.int8))
    return chunk, rig.hal.state.cycle


def listen_to(chunk: Chunk, plan: Plan, *, lockstep: bool) -> Report:
    bus = Played(chunk, fails=False)
    bus.dropped = 0
    return listen(
        {"can0": bus}, plan, Project(), name="played", stopped=lambda: bus.ended, lockstep=lockstep, node=None
    )


def test_lock_step_bus_has_no_findings_in_lock_step_time(make_rig: MakeRig, plan: Plan) -> None:
    chunk, cycles = lock_step_chunk(make_rig)
    on_the_wall_clock = listen_to(chunk, plan, lockstep=False)
    assert {"cycle-gap", "cycle-fast"} <= {finding.rule for finding in on_the_wall_clock.findings}
    result = listen_to(chunk, plan, lockstep=True)
    assert [(finding.rule, finding.message) for finding in result.findings] == []
    assert result.validator.frames == len(chunk)
    assert result.validator.end - result.validator.begin == pytest.approx(cycles * 1e6, abs=2e6)


def test_lost_state_is_found_in_lock_step_time(make_rig: MakeRig, plan: Plan) -> None:
    chunk, _ = lock_step_chunk(make_rig)
    state = NETWORK.message("LEFT_SK_STATE").frame_id
    at = np.flatnonzero(chunk.frames["can_id"] == state)
    for lost, rule in ((at[700:702], "counter-lost"), (at[700:750], "recovered")):
        result = listen_to(chunk.select(np.delete(np.arange(len(chunk)), lost)), plan, lockstep=True)
        assert {finding.message for finding in result.findings} == {"LEFT_SK_STATE"}
        assert rule in {finding.rule for finding in result.findings}


def test_lock_step_time_needs_a_cycle_number(tmp_path: Path) -> None:
    path = tmp_path / "foreign.dbc"
    path.write_text(FOREIGN)
    result = run("validate", "-i", "virtual", "-c", "lock-step", "--lockstep", "--for", "1", "--dbc", path)
    assert result.exit_code == 2
    assert "lock-step time needs a cyclic message SYNC* with the signal Cycle" in result.output


def test_missing_bus_gives_exit_code_3() -> None:
    result = run("validate", "-i", "nonsense", "-c", "x")
    assert result.exit_code == 3


# -- kernels ---------------------------------------------------------------------------------------------------------------


def test_jitter_is_the_distance_from_the_median() -> None:
    histogram = np.zeros(BINS, np.int64)
    histogram[100] = 990
    histogram[130] = 10
    assert jitter_p99(histogram) == 0.0
    histogram[130] = 20
    assert jitter_p99(histogram) == pytest.approx(0.3)
    shifted = np.roll(histogram, 17)
    assert jitter_p99(shifted) == pytest.approx(0.3)


def test_report_of_an_empty_log_states_that_nothing_was_checked(plan: Plan) -> None:
    validator = Validator(plan)
    validator.check(Chunk(np.zeros(0, FRAME), np.zeros(0, np.int64), np.zeros(0, np.uint8), np.zeros(0, np.int8)), [])
    validator.finish()
    result = report("nothing", validator)
    assert result.findings == ()
    assert text(result).splitlines()[-1] == "no frame was checked"


def test_random_records_are_checked_without_an_exception(plan: Plan) -> None:
    generator = np.random.default_rng(0)
    for count in (1, 2, 700):
        validator = Validator(plan)
        for _ in range(3):
            frames: Frames = generator.integers(0, 256, count * FRAME.itemsize, dtype=np.uint8).view(FRAME)
            known = generator.integers(0, 2, count) > 0
            ids = np.array([m.frame_id for m in NETWORK.messages], np.uint32)
            frames["can_id"] = np.where(known, generator.choice(ids, count), frames["can_id"])
            frames["flags"] = np.where(generator.integers(0, 2, count) > 0, 5, frames["flags"])
            frames["len"] = generator.choice([8, 12, 16, 24, 32, 48, 3, 200], count)
            stamps = np.sort(generator.integers(0, 10**9, count))
            channels = generator.integers(0, 2, count).astype(np.uint8)
            validator.check(Chunk(frames, stamps, channels, np.full(count, NO_DIRECTION, np.int8)), ["a", "b"])
        validator.finish()
        assert validator.frames == 3 * count
        assert len(validator.findings) > 0


def test_unknown_identifiers_of_11_and_29_bits_are_separate_findings(tmp_path: Path) -> None:
    messages = [
        can.Message(timestamp=BEGIN + k, arbitration_id=0x7F0, is_extended_id=bool(k % 2), data=b"") for k in range(3)
    ]
    result = run("validate", write(tmp_path / "a.log", messages), "--json")
    found = [json.loads(line) for line in result.stdout.splitlines()]
    counts = {f["message"]: f["count"] for f in found if f["rule"] == "unknown-id"}
    assert counts == {"0x7f0": 2, "0x000007f0": 1}

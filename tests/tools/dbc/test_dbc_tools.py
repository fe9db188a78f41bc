"""Tests of `atalante dbc lint | table | busload | diff`: output and exit codes."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest
from click.testing import CliRunner, Result

from atalante_dbc import DBC_FILE, load, wire_time
from atalante_tools.cli import cli
from atalante_tools.dbc.diff import changes
from atalante_tools.dbc.lint import findings

TEXT = DBC_FILE.read_text("cp1252")
NETWORK = load()
#: Lines of two signals of LEFT_FH_STATE (identifier 385). The tests change this message.
TORQUE = ' SG_ Torque : 80|16@1- (0.0125,0) [-409.58750000000003|409.58750000000003] "Nm" HAL'
TEMPERATURE = ' SG_ Temperature : 56|8@1+ (1,-40) [-40|214] "degC" HAL'


def run(*arguments: object) -> Result:
    return CliRunner().invoke(cli, ["dbc", *map(str, arguments)])


def rows(result: Result) -> list[dict]:
    return [json.loads(line) for line in result.stdout.splitlines()]


@pytest.fixture
def mutated(tmp_path: Path):
    """Return a function that writes the DBC with replaced texts.

    For each text, only the first occurrence after the start of LEFT_FH_STATE is replaced.
    """

    def write(*replacements: tuple[str, str]) -> Path:
        start = TEXT.index("BO_ 385 LEFT_FH_STATE")
        head, tail = TEXT[:start], TEXT[start:]
        for old, new in replacements:
            assert old in tail
            tail = tail.replace(old, new, 1)
        path = tmp_path / "new.dbc"
        path.write_text(head + tail, "cp1252")
        return path

    return write


# -- lint ----------------------------------------------------------------------------------------------------------------


def test_network_of_the_robot_has_no_findings():
    result = run("lint")
    assert result.exit_code == 0
    assert result.stdout == ""


def test_each_finding_has_its_line(mutated):
    path = mutated((TORQUE, TORQUE.replace("0.0125", "0")), (TEMPERATURE, TEMPERATURE.replace("56|", "52|")))
    found = findings(path)
    lines = path.read_text().splitlines()
    assert [lines[f.line - 1].split()[1] for f in found] == ["Temperature", "Torque"]
    assert "overlaps" in found[0].text
    assert "factor 0" in found[1].text
    result = run("lint", path)
    assert result.exit_code == 1
    assert result.stdout.splitlines() == [f"{path}:{f.line}: {f.text}" for f in found]
    assert rows(run("lint", "--json", path)) == [{"file": str(path), "line": f.line, "text": f.text} for f in found]


def test_parse_error_is_a_finding(tmp_path: Path):
    path = tmp_path / "no.dbc"
    path.write_text('VERSION "1"\nBO_ nonsense\n')
    (finding,) = findings(path)
    assert finding.line == 2
    result = run("lint", path)
    assert result.exit_code == 1
    assert "Traceback" not in result.output


def test_missing_file_is_a_usage_error():
    result = run("lint", "nowhere.dbc")
    assert result.exit_code == 2
    assert "nowhere.dbc" in result.output


# -- table ---------------------------------------------------------------------------------------------------------------


def test_table_has_every_message_with_all_its_attributes():
    network = NETWORK
    found = rows(run("table", "--json"))
    assert [row["name"] for row in found] == [m.name for m in network.messages]
    joint = next(row for row in found if row["name"] == "LEFT_SK_STATE")
    assert joint == {
        "id": "0x184", "name": "LEFT_SK_STATE", "sender": "LEFT_SK", "receivers": ["HAL"], "bus": "left_leg",
        "cycle_ms": 1, "inhibit_ms": None, "timeout_ms": 5, "bytes": 12, "data_id": "0xa184",
    }  # fmt: skip


def test_text_table_has_one_aligned_line_per_message():
    lines = run("table").stdout.splitlines()
    assert len(lines) == 1 + len(NETWORK.messages)
    columns = [re.search(r"\bbus\b", lines[0]).start()] * len(lines)
    assert {line[column:].split()[0] for line, column in zip(lines[1:], columns[1:], strict=True)} == set(NETWORK.buses)


def test_table_of_signals_has_unit_range_and_invalid_code():
    found = rows(run("table", "--signals", "--json"))
    assert len(found) == sum(len(m.signals) for m in NETWORK.messages)
    torque = next(r for r in found if (r["message"], r["signal"]) == ("LEFT_SK_STATE", "Torque"))
    assert (torque["unit"], torque["min"], torque["max"]) == ("Nm", -409.58750000000003, 409.58750000000003)
    assert (torque["invalid"], torque["bits"], torque["signed"]) == ("0x8000", 16, "yes")
    state = next(r for r in found if (r["message"], r["signal"]) == ("LEFT_SK_STATE", "DriveState"))
    assert "39=OPERATION_ENABLED" in state["values"]


# -- busload -------------------------------------------------------------------------------------------------------------


def test_busload_of_messages_adds_up_to_the_bus_load():
    network = NETWORK
    result = run("busload", "--json")
    assert result.exit_code == 0
    found = {row["bus"]: row for row in rows(result)}
    for bus, share in network.bus_load().items():
        assert found[bus]["percent"] == pytest.approx(100 * share)
        assert sum(m["percent"] for m in found[bus]["messages"]) == pytest.approx(100 * share)
    command = found["left_leg"]["messages"][0]
    assert command["name"] == "COMMAND_LEFT_LEG"
    assert command["percent"] == pytest.approx(100 * wire_time(48) / 1e-3)


def test_busload_above_the_limit_fails_and_names_the_bus():
    result = run("busload", "--limit", 58)
    assert result.exit_code == 1
    assert "left_leg" in result.stderr
    assert "left_sense" not in result.stderr


# -- diff ----------------------------------------------------------------------------------------------------------------


def test_diff_of_a_network_with_itself_is_empty():
    assert changes(NETWORK, load()) == []
    result = run("diff", DBC_FILE, DBC_FILE)
    assert (result.exit_code, result.stdout) == (0, "")


#: Name -> replacements from LEFT_FH_STATE on, subject of the change, location, whether it is breaking.
CHANGES = {
    "length": ([("LEFT_FH_STATE: 12", "LEFT_FH_STATE: 16")], "length", "LEFT_FH_STATE", True),
    "data id": ([('"E2EDataId" BO_ 385 41345', '"E2EDataId" BO_ 385 99')], "data id", "LEFT_FH_STATE", True),
    "sender": ([("LEFT_FH_STATE: 12 LEFT_FH", "LEFT_FH_STATE: 12 LEFT_TH")], "sender", "LEFT_FH_STATE", True),
    "bus": ([('"Bus" BO_ 1792 2', '"Bus" BO_ 1792 3')], "bus", "HAL_STATUS", True),
    "cycle": ([('"GenMsgCycleTime" BO_ 385 1', '"GenMsgCycleTime" BO_ 385 2')], "timing", "LEFT_FH_STATE", True),
    "timeout": ([('"TimeoutTime" BO_ 385 5', '"TimeoutTime" BO_ 385 7')], "timing", "LEFT_FH_STATE", False),
    "inhibit": ([('"GenMsgDelayTime" BO_ 129 100', '"GenMsgDelayTime" BO_ 129 50')], "timing", "LEFT_FH_EMCY", False),
    "layout": ([(TEMPERATURE, ' SG_ Temperature : 56|7@1+ (1,-40) [-40|86] "degC" HAL'),
                ('"InvalidRaw" SG_ 385 Temperature "0xff"', '"InvalidRaw" SG_ 385 Temperature "0x7f"')],
               "layout", "LEFT_FH_STATE.Temperature", True),
    "sign": ([(TEMPERATURE, ' SG_ Temperature : 56|8@1- (1,-40) [-40|80] "degC" HAL')],
             "layout", "LEFT_FH_STATE.Temperature", True),
    "factor": ([(TORQUE, TORQUE.replace("0.0125", "0.02"))], "scaling", "LEFT_FH_STATE.Torque", True),
    "offset": ([(TEMPERATURE, TEMPERATURE.replace(",-40)", ",-39)").replace("[-40|", "[-39|"))],
               "scaling", "LEFT_FH_STATE.Temperature", True),
    "unit": ([(TORQUE, TORQUE.replace('"Nm"', '"mNm"'))], "unit", "LEFT_FH_STATE.Torque", True),
    "range": ([(TORQUE, TORQUE.replace("|409.58750000000003]", "|400]"))], "range", "LEFT_FH_STATE.Torque", True),
    "invalid code": ([('SG_ 385 Temperature "0xff"', 'SG_ 385 Temperature ""')],
                     "invalid code", "LEFT_FH_STATE.Temperature", True),
    "value gone": ([(' 8 "FAULT" 15', " 15")], "value", "LEFT_FH_STATE.DriveState", True),
    "value new": ([(' 8 "FAULT" 15', ' 8 "FAULT" 9 "RESTING" 15')], "value", "LEFT_FH_STATE.DriveState", False),
    "value other": ([(' 8 "FAULT" 15', ' 8 "BROKEN" 15')], "value", "LEFT_FH_STATE.DriveState", True),
    "receivers": ([(TORQUE, TORQUE + ",PENDANT")], "receivers", "LEFT_FH_STATE.Torque", False),
    "signal gone": ([(TEMPERATURE + "\n", ""), ('BA_ "InvalidRaw" SG_ 385 Temperature "0xff";', "")],
                    "signal", "LEFT_FH_STATE.Temperature", True),
    "signal renamed": ([(TEMPERATURE, TEMPERATURE.replace("Temperature", "Heat")),
                        ("SG_ 385 Temperature", "SG_ 385 Heat")], "name", "LEFT_FH_STATE.Heat", False),
    "comment": ([("Left frontal hip:", "The left frontal hip:")], "hash", "network", False),
}  # fmt: skip


@pytest.mark.parametrize("name", CHANGES)
def test_diff_reports_the_change_and_its_consequences(name: str, mutated):
    replacements, subject, where, breaking = CHANGES[name]
    found = [c for c in changes(NETWORK, load(mutated(*replacements))) if c.subject != "hash" or subject == "hash"]
    assert (subject, where, breaking) in {(c.subject, c.where, c.breaking) for c in found}
    # All other changes are consequences of this change.
    follows = {"layout": {"range", "invalid code"}, "sign": {"range"}, "offset": {"range"}}.get(name, set())
    assert {c.subject for c in found} - {subject} <= follows


def test_changed_identifier_is_breaking(tmp_path: Path):
    path = tmp_path / "new.dbc"
    path.write_text(re.sub(r"((?:BO_|SG_|VAL_) )385 ", r"\g<1>384 ", TEXT), "cp1252")
    found = [c for c in changes(NETWORK, load(path)) if c.subject != "hash"]
    assert [(c.subject, c.where, c.breaking) for c in found] == [("id", "LEFT_FH_STATE", True)]
    assert "0x181 -> 0x180" in found[0].text


@pytest.mark.parametrize(("name", "code"), [("range", 1), ("timeout", 0)])
def test_diff_fails_only_on_breaking_changes(name: str, code: int, mutated):
    replacements, _, where, _ = CHANGES[name]
    result = run("diff", DBC_FILE, mutated(*replacements))
    assert result.exit_code == code
    kinds = [line.split()[0] for line in result.stdout.splitlines() if where in line]
    assert kinds == ["breaking" if code else "compatible"]


def test_timeout_below_the_cycle_of_the_other_version_is_breaking(mutated):
    old = mutated(('"GenMsgCycleTime" BO_ 403 10', '"GenMsgCycleTime" BO_ 403 20'))
    before = load(old)
    new = mutated(('"TimeoutTime" BO_ 403 ', '"TimeoutTime" BO_ 403 1'))
    (timeout,) = [c for c in changes(before, load(new)) if "timeout" in c.text]
    assert not timeout.breaking
    shorter = mutated(('"TimeoutTime" BO_ 403 50', '"TimeoutTime" BO_ 403 20'))
    (timeout,) = [c for c in changes(before, load(shorter)) if "timeout" in c.text]
    assert timeout.breaking


def test_removed_message_is_breaking_and_new_message_is_not(tmp_path: Path):
    # Remove the last emergency: its block, and every line with its identifier.
    lines = re.sub(r"BO_ 148 .*?\n\n", "", TEXT, flags=re.S).splitlines()
    path = tmp_path / "less.dbc"
    path.write_text("\n".join(line for line in lines if not re.search(r"(BO_|SG_|VAL_) 148 ", line)) + "\n")
    gone = [c for c in changes(NETWORK, load(path)) if c.subject == "message"]
    assert [(c.where, c.breaking) for c in gone] == [("PENDANT_EMCY", True)]
    new = [c for c in changes(load(path), NETWORK) if c.subject == "message"]
    assert [(c.where, c.breaking) for c in new] == [("PENDANT_EMCY", False)]


def test_renamed_message_is_compatible(mutated):
    path = mutated(("LEFT_FH_STATE", "LEFT_FH_DRIVE_STATE"))
    found = [c for c in changes(NETWORK, load(path)) if c.subject != "hash"]
    assert [(c.subject, c.where, c.breaking) for c in found] == [("name", "LEFT_FH_DRIVE_STATE", False)]


def test_new_signal_is_compatible_only_in_reserved_bits(mutated):
    # The first message after LEFT_FH_STATE with reserved bits is IMU_TORSO_STATE. Its bits 40 to 63 are reserved.
    accel = ' SG_ AccelX : 192|16@1- (0.005,0) [-163.835|163.835] "m/s2" HAL'
    for line, breaking in (
        (' SG_ Extra : 40|8@1+ (1,0) [0|254] "1" HAL', False),
        (' SG_ Extra : 40|8@1+ (1,0) [1|254] "1" HAL', True),  # the 0 sent by an old node is out of range
    ):
        path = mutated((accel, f"{accel}\n{line}"))
        (found,) = [c for c in changes(NETWORK, load(path)) if c.subject == "signal"]
        assert (found.where, found.breaking) == ("IMU_TORSO_STATE.Extra", breaking)


def test_diff_json_is_one_object_per_change(mutated):
    result = run("diff", "--json", DBC_FILE, mutated(("LEFT_FH_STATE: 12", "LEFT_FH_STATE: 16")))
    assert result.exit_code == 1
    kinds = [(row["kind"], row["subject"], row["where"]) for row in rows(result)]
    assert kinds[0] == ("breaking", "length", "LEFT_FH_STATE")
    assert "compatible" in {kind for kind, _, _ in kinds}

"""Tests of the network and of the strict loader, which rejects each defect of a DBC with its line number."""

from __future__ import annotations

from pathlib import Path

import pytest

from atalante_dbc import DBC_FILE, DbcError, load, wire_time

TEXT = DBC_FILE.read_text()


#: Messages changed by the mutations: the first two joint states and the first emergency.
MESSAGES = ("BO_ 385 ", "BO_ 386 ", "BO_ 129 ", "BO_ 145 ", "BO_ 401 ")


def test_network_has_every_node_of_the_robot():
    network = load()
    kinds = {kind: len(network.of_kind(kind)) for kind in ("master", "drive", "imu", "foot", "haptics", "pendant")}
    assert kinds == {"master": 1, "drive": 12, "imu": 4, "foot": 2, "haptics": 1, "pendant": 1}


def test_every_node_except_the_master_sends_status_and_emergency():
    network = load()
    for node in network.nodes:
        names = {m.name for m in network.sent_by(node.name)}
        expected = {"HAL_STATUS"} if node.kind == "master" else {f"{node.name}_STATUS", f"{node.name}_EMCY"}
        assert expected <= names


def test_ids_and_data_ids_are_unique_over_all_buses():
    messages = load().messages
    assert len({m.frame_id for m in messages}) == len(messages) == len({m.data_id for m in messages})


def test_every_node_except_the_master_is_on_one_bus():
    network = load()
    for node in network.nodes:
        if node.kind != "master":
            buses = {
                m.bus for m in network.messages if node.name in (m.sender, *m.receivers) and m.name != "HAL_STATUS"
            }
            assert len(buses) == 1


def test_joint_state_fills_its_twelve_bytes_exactly():
    message = load().message("LEFT_SK_STATE")
    assert message.length == 12
    assert sum(s.length for s in message.signals) == 96


@pytest.mark.parametrize(
    ("length", "microseconds"), [(8, 55.8), (12, 63.8), (16, 71.8), (24, 88.8), (32, 104.8), (48, 136.8), (64, 168.8)]
)
def test_worst_case_wire_time(length: int, microseconds: float):
    assert wire_time(length) * 1e6 == pytest.approx(microseconds)


def test_worst_case_load_of_every_bus_is_at_most_sixty_percent():
    load_of = load().bus_load()
    assert set(load_of) == {"left_leg", "right_leg", "left_sense", "right_sense"}
    assert 0.57 < load_of["left_leg"] <= 0.60
    assert max(load_of.values()) <= 0.60
    assert sum(load_of.values()) == pytest.approx(2.05, abs=0.005)  # docs/quickstart.md and docs/howto/real-bus.md


def test_unknown_name_is_rejected_with_the_valid_names():
    network = load()
    with pytest.raises(KeyError, match="LEFT_SK_STATE"):
        network.message("LEFT_KNEE")
    with pytest.raises(KeyError, match="Position"):
        network.message("LEFT_SK_STATE").signal("Angle")


def _signal(name: str, rest: str) -> tuple[str, str]:
    """Return the line of a signal of LEFT_FH_STATE, and its replacement."""
    block = TEXT[TEXT.index("BO_ 385 LEFT_FH_STATE") :]
    old = next(line for line in block.splitlines() if f"SG_ {name} :" in line)
    return old, f" SG_ {name} : {rest}"


MUTATIONS = {
    "overlap": (*_signal("Temperature", '52|8@1+ (1,-40) [-40|214] "degC" HAL'), "overlaps"),
    "does not fit": (*_signal("Torque", '90|16@1- (0.0125,0) [-400|400] "Nm" HAL'), "got end bit 106"),
    "endless factor": (*_signal("Torque", '80|16@1- (1e999,0) [-400|400] "Nm" HAL'), "factor inf"),
    "factor 0": (*_signal("Torque", '80|16@1- (0,0) [-400|400] "Nm" HAL'), "factor 0"),
    "negative factor": (*_signal("Torque", '80|16@1- (-0.0125,0) [-400|400] "Nm" HAL'), "factor -0.0125"),
    "too long": (*_signal("Torque", '64|52@1- (1,0) [-400|400] "Nm" HAL'), "at most 51 bits, got 52 bits"),
    "range too wide": (*_signal("Torque", '80|16@1- (0.0125,0) [-500|400] "Nm" HAL'), "range that fits 16 bits"),
    "empty range": (*_signal("Torque", '80|16@1- (0.0125,0) [0|0] "Nm" HAL'), r"min < max, got \[0\|0\]"),
    "word boundary": (*_signal("Temperature", '60|8@1+ (1,-40) [-40|214] "degC" HAL'), "64-bit word"),
    "no unit": (*_signal("Torque", '80|16@1- (0.0125,0) [-400|400] "" HAL'), "must have a unit"),
    "no receiver": (*_signal("Torque", '80|16@1- (0.0125,0) [-400|400] "Nm" Vector__XXX'), "receivers"),
    "no CRC": (*_signal("Crc", '0|15@1+ (1,0) [0|32767] "1" HAL'), "signal Crc"),
    "no counter": (*_signal("Counter", '17|7@1+ (1,0) [0|127] "1" HAL'), "signal Counter"),
    "big endian": (*_signal("Torque", '87|16@0- (0.0125,0) [-400|400] "Nm" HAL'), "big endian"),
    "multiplexed": (
        _signal("Torque", "")[0], ' SG_ Torque m0 : 80|16@1- (0.0125,0) [-400|400] "Nm" HAL', "multiplexed"),
    "duplicate signal": (_signal("Torque", "")[0], ' SG_ Velocity : 80|16@1- (0.0125,0) [-400|400] "Nm" HAL', "must be unique"),
    "duplicate id": ("BO_ 386 LEFT_TH_STATE", "BO_ 385 LEFT_TH_STATE", "unique frame id, got 0x181"),
    "duplicate name": ("BO_ 386 LEFT_TH_STATE", "BO_ 386 LEFT_FH_STATE", "name LEFT_FH_STATE must be unique"),
    "illegal length": ("BO_ 385 LEFT_FH_STATE: 12", "BO_ 385 LEFT_FH_STATE: 13", "13 bytes"),
    "unknown sender": ("BO_ 385 LEFT_FH_STATE: 12 LEFT_FH", "BO_ 385 LEFT_FH_STATE: 12 UNKNOWN", "sender"),
    "classic frame": ('BA_ "VFrameFormat" BO_ 385 14;', 'BA_ "VFrameFormat" BO_ 385 0;', "CAN FD frame"),
    "no bus": ('BA_ "Bus" BO_ 401 2;', "", "FOOT_LEFT_STATE must be on left_sense, as most messages of FOOT_LEFT, got left_leg"),
    "no bus of the first message": ('BA_ "Bus" BO_ 145 2;', "", "FOOT_LEFT_EMCY must be on left_sense, .* got left_leg"),
    "no cycle": ('BA_ "GenMsgCycleTime" BO_ 385 1;', "", "GenMsgCycleTime"),
    "no timeout": ('BA_ "TimeoutTime" BO_ 385 5;', "", "TimeoutTime"),
    "no data id": ('BA_ "E2EDataId" BO_ 385 41345;', "", "must have an E2EDataId"),
    "shared data id": ('BA_ "E2EDataId" BO_ 386 41346;', 'BA_ "E2EDataId" BO_ 386 41345;', "unique E2EDataId"),
    "unbounded event": ('BA_ "GenMsgDelayTime" BO_ 129 100;', "", "GenMsgDelayTime"),
    "node kind unknown": ('BA_ "NodeKind" BU_ LEFT_FH 1;', 'BA_ "NodeKind" BU_ LEFT_FH 9;', "one of master, drive"),
    "cycle out of range": (
        'BA_ "GenMsgCycleTime" BO_ 385 1;', 'BA_ "GenMsgCycleTime" BO_ 385 -1;', "a whole number from 0 to 10000"),
    "cycle not whole": ('BA_ "TimeoutTime" BO_ 385 5;', 'BA_ "TimeoutTime" BO_ 385 5.5;', "a whole number from 0 to 10000"),
    "invalid code no number": (
        'BA_ "InvalidRaw" SG_ 385 Torque "0x8000";', 'BA_ "InvalidRaw" SG_ 385 Torque "x8";', "a raw code such as"),
    "no default": ('BA_DEF_DEF_ "E2EDataId" 0;', "", "E2EDataId has no default"),
    "no definition": ('BA_DEF_ SG_ "InvalidRaw" STRING;', "", "InvalidRaw has no definition"),
    "undefined": ('BA_ "E2EDataId" BO_ 385 41345;', 'BA_ "DataId" BO_ 385 41345;', "DataId has no definition"),
    "invalid code in range": (
        'BA_ "InvalidRaw" SG_ 385 Torque "0x8000";', 'BA_ "InvalidRaw" SG_ 385 Torque "0x10";', "outside its valid range"),
    "invalid code too long": (
        'BA_ "InvalidRaw" SG_ 385 Torque "0x8000";', 'BA_ "InvalidRaw" SG_ 385 Torque "0x18000";', "at most 16 bits"),
}  # fmt: skip


def test_29_bit_identifier_is_rejected(tmp_path: Path):
    path = tmp_path / "bad.dbc"
    path.write_text(TEXT.replace(" 385 ", f" {1 << 31 | 385} "), "cp1252")
    with pytest.raises(DbcError, match="LEFT_FH_STATE must have an 11-bit identifier, got the 29-bit identifier 0x181"):
        load(path)


def test_data_id_of_more_than_16_bits_is_rejected(tmp_path: Path):
    path = tmp_path / "bad.dbc"
    text = TEXT.replace('"E2EDataId" INT 0 65535;', '"E2EDataId" INT 0 100000;')
    path.write_text(text.replace('"E2EDataId" BO_ 385 41345;', '"E2EDataId" BO_ 385 70000;'), "cp1252")
    with pytest.raises(DbcError, match="LEFT_FH_STATE must have an E2EDataId from 1 to 65535, got 70000"):
        load(path)


def test_lines_may_begin_with_spaces(tmp_path: Path):
    path = tmp_path / "spaces.dbc"
    path.write_text(TEXT.replace("\nB", "\n B"), "cp1252")
    assert load(path).messages == load().messages


@pytest.mark.parametrize("name", MUTATIONS)
def test_invalid_dbc_is_rejected_with_its_line(name: str, tmp_path: Path):
    old, new, message = MUTATIONS[name]
    assert TEXT.count(old) >= 1
    path = tmp_path / "bad.dbc"
    # Several messages have the same signal line, so search from LEFT_FH_STATE on.
    start = TEXT.index("BO_ 385 LEFT_FH_STATE") if old.startswith(" SG_") else 0
    text = TEXT[:start] + TEXT[start:].replace(old, new, 1)
    path.write_text(text)
    with pytest.raises(DbcError, match=message) as rejected:
        load(path)
    numbers = {int(line.split(":")[1]) for line in str(rejected.value).splitlines()}
    lines = text.splitlines()
    message_lines = [i for i, line in enumerate(lines, start=1) if line.startswith(MESSAGES)]
    named = {line + offset for line in message_lines for offset in range(9)}
    # An attribute error has the line of the value; a missing default has line 1.
    attributes = (i for i, line in enumerate(lines, start=1) if line == new or (not new and '"InvalidRaw"' in line))
    assert numbers <= named | {1, *attributes}


@pytest.mark.parametrize("content", ["", "BO_ nonsense", "\x00\x01"])
def test_file_that_is_not_a_dbc_is_rejected(content: str, tmp_path: Path):
    path = tmp_path / "broken.dbc"
    path.write_text(content)
    with pytest.raises(DbcError, match=r"broken\.dbc"):
        load(path)


def test_missing_file_is_named(tmp_path: Path):
    with pytest.raises(DbcError, match="nowhere"):
        load(tmp_path / "nowhere.dbc")

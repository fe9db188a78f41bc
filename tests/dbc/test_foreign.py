"""Tests of the lenient loader: agreement with the strict loader, and attributes of other DBC files."""

from __future__ import annotations

from pathlib import Path

import pytest

import atalante_dbc
from atalante_dbc.foreign import Layout, catalogue

HEAD = 'VERSION ""\nNS_ :\nBS_:\nBU_: A B\n\n'
ONE = 'BO_ 256 M: 8 A\n SG_ S : 0|8@1+ (1,0) [0|0] "" B\n\n'


def layout_of(text: str, tmp_path: Path, name: str = "M") -> Layout:
    path = tmp_path / "foreign.dbc"
    path.write_text(HEAD + text)
    return catalogue(path).layout(name)


def test_both_loaders_agree_on_the_network() -> None:
    strict, lenient = atalante_dbc.load(), catalogue(atalante_dbc.DBC_FILE)
    assert lenient.refused == ()
    assert lenient.hash32 == strict.hash32
    assert lenient.buses == strict.buses
    assert (lenient.nominal_bitrate, lenient.data_bitrate) == (strict.nominal_bitrate, strict.data_bitrate)
    assert dict(lenient.nodes) == {node.name: node.kind for node in strict.nodes}
    for message in strict.messages:
        layout = lenient.layout(message.name)
        assert (layout.frame_id, layout.length, layout.sender, layout.bus) == (
            message.frame_id,
            message.length,
            message.sender,
            message.bus,
        )
        assert layout.data_id == message.data_id
        assert layout.cyclic == (message.send_type == "cyclic")
        assert (layout.cycle_ms or 0, layout.timeout_ms or 0) == (message.cycle_ms, message.timeout_ms)
        assert (layout.inhibit_ms or 0) == message.inhibit_ms
        assert (layout.extended, layout.fd, layout.bit_rate_switch) == (False, True, True)
        assert [f.name for f in layout.fields] == [s.name for s in message.signals]
        for field, signal in zip(layout.fields, message.signals, strict=True):
            assert (field.start, field.length, field.factor, field.offset) == (
                signal.start,
                signal.length,
                signal.factor,
                signal.offset,
            )
            assert (field.minimum, field.maximum, field.invalid_raw) == (
                signal.minimum,
                signal.maximum,
                signal.invalid_raw,
            )
            assert (field.kind == "signed", dict(field.choices), field.receivers) == (
                signal.signed,
                dict(signal.choices),
                signal.receivers,
            )


def test_dbc_without_attributes_gives_unknown_values(tmp_path: Path) -> None:
    layout = layout_of(ONE, tmp_path)
    assert (layout.fd, layout.bit_rate_switch, layout.bus, layout.data_id) == (None, None, None, None)
    assert (layout.cyclic, layout.cycle_ms, layout.timeout_ms, layout.inhibit_ms) == (False, None, None, None)
    (field,) = layout.fields
    assert (field.minimum, field.maximum, field.invalid_raw, dict(field.choices)) == (None, None, None, {})


@pytest.mark.parametrize(
    ("attributes", "cyclic"),
    [
        (
            'BA_DEF_ BO_ "GenMsgCycleTime" INT 0 9;\nBA_DEF_DEF_ "GenMsgCycleTime" 0;\nBA_ "GenMsgCycleTime" BO_ 256 5;\n',
            True,
        ),
        (
            'BA_DEF_ BO_ "GenMsgCycleTime" INT 0 9;\nBA_DEF_DEF_ "GenMsgCycleTime" 5;\n'
            'BA_DEF_ BO_ "GenMsgSendType" ENUM "Cyclic","NotUsed";\nBA_DEF_DEF_ "GenMsgSendType" "Cyclic";\n',
            True,
        ),
        (
            'BA_DEF_ BO_ "GenMsgCycleTime" INT 0 9;\nBA_DEF_DEF_ "GenMsgCycleTime" 5;\n'
            'BA_DEF_ BO_ "GenMsgSendType" ENUM "Cyclic","IfActive";\nBA_DEF_DEF_ "GenMsgSendType" "Cyclic";\n'
            'BA_ "GenMsgSendType" BO_ 256 1;\n',
            False,
        ),
    ],
)
def test_cycle_time_and_send_type_set_cyclic(attributes: str, cyclic: bool, tmp_path: Path) -> None:
    layout = layout_of(ONE + attributes, tmp_path)
    assert layout.cyclic is cyclic
    assert layout.cycle_ms == 5


def test_frame_format_and_bit_rate_switch(tmp_path: Path) -> None:
    formats = (
        'BA_DEF_ BO_ "VFrameFormat" ENUM "StandardCAN","ExtendedCAN","r","J1939PG","r","r","r","r","r","r","r","r","r","r",'
        '"StandardCAN_FD","ExtendedCAN_FD";\nBA_DEF_DEF_ "VFrameFormat" "StandardCAN";\n'
    )
    assert layout_of(ONE + formats, tmp_path).fd is False
    assert layout_of(ONE + formats + 'BA_ "VFrameFormat" BO_ 256 14;\n', tmp_path).fd is True
    assert layout_of(ONE.replace("M: 8", "M: 12"), tmp_path).fd is True
    switch = 'BA_DEF_ BO_ "CANFD_BRS" ENUM "0","1";\nBA_DEF_DEF_ "CANFD_BRS" "1";\n'
    assert layout_of(ONE + switch, tmp_path).bit_rate_switch is True
    assert layout_of(ONE + switch + 'BA_ "CANFD_BRS" BO_ 256 0;\n', tmp_path).bit_rate_switch is False


@pytest.mark.parametrize(("frame_id", "mask"), [(0x18FEF100, 0x03FFFF00), (0x18EAFFFE, 0x03FF0000)])
def test_j1939_mask_selects_the_parameter_group(frame_id: int, mask: int, tmp_path: Path) -> None:
    identifier = 1 << 31 | frame_id
    text = (
        f'BO_ {identifier} M: 8 A\n SG_ S : 0|8@1+ (1,0) [0|0] "" B\n\n'
        'BA_DEF_ BO_ "VFrameFormat" ENUM "StandardCAN","ExtendedCAN","r","J1939PG";\nBA_DEF_DEF_ "VFrameFormat" "StandardCAN";\n'
        f'BA_ "VFrameFormat" BO_ {identifier} 3;\n'
    )
    layout = layout_of(text, tmp_path)
    assert (layout.extended, layout.frame_id, layout.pgn_mask) == (True, frame_id, mask)


def test_data_id_needs_attribute_and_header(tmp_path: Path) -> None:
    data_id = 'BA_DEF_ BO_ "E2EDataId" INT 0 65535;\nBA_DEF_DEF_ "E2EDataId" 0;\nBA_ "E2EDataId" BO_ 256 7;\n'
    header = 'BO_ 256 M: 8 A\n SG_ Crc : 0|16@1+ (1,0) [0|0] "" B\n SG_ Counter : 16|8@1+ (1,0) [0|0] "" B\n\n'
    assert layout_of(ONE + data_id, tmp_path).data_id is None
    assert layout_of(header + data_id, tmp_path).data_id == 7
    assert layout_of(header, tmp_path).data_id is None


def test_default_of_the_invalid_code_is_ignored(tmp_path: Path) -> None:
    attribute = 'BA_DEF_ SG_ "InvalidRaw" INT 0 255;\nBA_DEF_DEF_ "InvalidRaw" 0;\n'
    assert layout_of(ONE + attribute, tmp_path).field("S").invalid_raw is None
    assert layout_of(ONE + attribute + 'BA_ "InvalidRaw" SG_ 256 S 255;\n', tmp_path).field("S").invalid_raw == 255


def test_dbc_lines_in_a_comment_are_ignored(tmp_path: Path) -> None:
    """The comment contains lines of a message and a signal."""
    layout = layout_of(ONE + 'CM_ BO_ 256 "as in BO_ 256 M: 8 A and SG_ S m0 : 0|8";\n', tmp_path)
    assert layout.field("S").length == 8
    with pytest.raises(KeyError, match=r"signal of M must be one of S, got 'T'"):
        layout.field("T")


def test_selectors_of_nested_multiplexers() -> None:
    found = catalogue(Path(__file__).parents[1] / "foreign" / "extended_multiplexing.dbc")
    nested = found.layout("Nested")
    assert nested.field("Deep").selectors == (("Outer", frozenset({0})), ("Inner", frozenset({0, 1, 2, 3})))
    assert nested.multiplexers["Outer"] == frozenset({0, 1, 2, 3, 4, 5, 6, 7, 12})
    assert nested.field("Outer").selectors == ()


def test_data_id_of_more_than_16_bits_is_ignored(tmp_path: Path) -> None:
    message = 'BO_ 256 M: 8 A\n SG_ Crc : 0|16@1+ (1,0) [0|0] "" B\n SG_ Counter : 16|8@1+ (1,0) [0|0] "" B\n\n'
    data_id = 'BA_DEF_ BO_ "E2EDataId" INT 0 1000000;\nBA_DEF_DEF_ "E2EDataId" 0;\nBA_ "E2EDataId" BO_ 256 {};\n'
    assert layout_of(message + data_id.format(65535), tmp_path).data_id == 65535
    assert layout_of(message + data_id.format(65536), tmp_path).data_id is None


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "cp1252"])
def test_unit_is_read_in_utf_8_and_windows_1252(encoding: str, tmp_path: Path) -> None:
    path = tmp_path / "foreign.dbc"
    path.write_bytes((HEAD + ONE.replace('""', '"°C"')).encode(encoding))
    assert catalogue(path).layout("M").field("S").unit == "°C"


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "cp1252"])
def test_strict_loader_reads_utf_8_and_windows_1252(encoding: str, tmp_path: Path) -> None:
    path = tmp_path / "robot.dbc"
    text = atalante_dbc.DBC_FILE.read_text("cp1252")
    path.write_bytes(text.replace('"degC"', '"°C"').encode(encoding))
    signal = atalante_dbc.load(path).message("LEFT_FH_STATE").signal("Temperature")
    assert signal.unit == "°C"

"""Column codec compared with cantools for every kind of layout, and CRCs of many frames compared with CRCs of single frames."""

from __future__ import annotations

import math
from pathlib import Path

import cantools
import numpy as np
import pytest

import atalante_dbc
from atalante_dbc.foreign import Layout, catalogue
from atalante_hal.wire.codec import Codec
from atalante_hal.wire.e2e import crc, data_id_bytes
from atalante_hal.wire.frame import Frames, new_frames
from atalante_tools.canlog.column_codec import ColumnCodec, crc_differences, crc_of_zeros

#: DBCs with every kind of layout; each message is compared with cantools.
COLLECTION = sorted(Path(__file__).parents[2].joinpath("foreign").glob("*.dbc"))

HEAD = 'VERSION ""\nNS_ :\nBS_:\nBU_: A B\n\n'
FORMATS = (
    'BA_DEF_ BO_ "VFrameFormat" ENUM "StandardCAN","ExtendedCAN","reserved","J1939PG","reserved","reserved","reserved",'
    '"reserved","reserved","reserved","reserved","reserved","reserved","reserved","StandardCAN_FD","ExtendedCAN_FD";\n'
    'BA_DEF_DEF_ "VFrameFormat" "StandardCAN";\n'
)
EXTENDED = 1 << 31


#: Messages with an unsupported layout: case -> (DBC text, part of the reason).
REFUSED = {
    "signal of 65 bits": (
        HEAD + 'BO_ 1 M: 16 A\n SG_ Long : 0|65@1+ (1,0) [0|0] "" B\n',
        "Long has 65 bits",
    ),
    "Intel signal beyond the message": (
        HEAD + 'BO_ 1 M: 2 A\n SG_ Far : 9|8@1+ (1,0) [0|0] "" B\n',
        "Far ends at bit 17",
    ),
    "Motorola signal beyond the message": (
        HEAD + 'BO_ 1 M: 2 A\n SG_ Far : 14|8@0+ (1,0) [0|0] "" B\n',
        "Far ends at bit 17",
    ),
    "overlap": (
        HEAD + 'BO_ 1 M: 8 A\n SG_ One : 0|9@1+ (1,0) [0|0] "" B\n SG_ Two : 15|8@0+ (1,0) [0|0] "" B\n',
        "overlaps",
    ),
    "overlap of a multiplexed signal": (
        HEAD
        + 'BO_ 1 M: 8 A\n SG_ Mux M : 0|8@1+ (1,0) [0|0] "" B\n SG_ One m0 : 8|8@1+ (1,0) [0|0] "" B\n'
        + ' SG_ Two m0 : 15|4@1+ (1,0) [0|0] "" B\n',
        "Two overlaps One",
    ),
    "float of 24 bits": (
        HEAD + 'BO_ 1 M: 8 A\n SG_ Real : 0|24@1- (1,0) [0|0] "" B\n\nSIG_VALTYPE_ 1 Real : 1;\n',
        "float of 24 bits",
    ),
    "multiplexed without a multiplexer": (
        HEAD + 'BO_ 1 M: 8 A\n SG_ One m0 : 0|8@1+ (1,0) [0|0] "" B\n',
        "no multiplexer",
    ),
    "two multiplexers without SG_MUL_VAL_": (
        HEAD
        + 'BO_ 1 M: 8 A\n SG_ Left M : 0|4@1+ (1,0) [0|0] "" B\n SG_ Right M : 4|4@1+ (1,0) [0|0] "" B\n'
        + ' SG_ One m0 : 8|8@1+ (1,0) [0|0] "" B\n',
        "SG_MUL_VAL_",
    ),
    "scaled multiplexer": (
        HEAD + 'BO_ 1 M: 8 A\n SG_ Mux M : 0|8@1+ (2,0) [0|0] "" B\n SG_ One m2 : 8|8@1+ (1,0) [0|0] "" B\n',
        "multiplexer Mux is scaled",
    ),
    "identifier used twice": (
        HEAD + 'BO_ 1 M: 8 A\n SG_ One : 0|8@1+ (1,0) [0|0] "" B\n\nBO_ 1 N: 8 A\n SG_ Two : 0|8@1- (1,0) [0|0] "" B\n',
        "identifier 0x1 is used by 2 messages",
    ),
    "name used twice": (
        HEAD + 'BO_ 1 M: 8 A\n SG_ One : 0|8@1+ (1,0) [0|0] "" B\n\nBO_ 2 M: 8 A\n SG_ Two : 0|8@1- (1,0) [0|0] "" B\n',
        "its name is used by 2 messages",
    ),
    "signal name used twice": (
        HEAD + 'BO_ 1 M: 8 A\n SG_ One : 0|8@1+ (1,0) [0|0] "" B\n SG_ One : 8|8@1- (1,0) [0|0] "" B\n',
        "signal name One is used twice",
    ),
    "more than one frame": (
        HEAD + 'BO_ 1 M: 72 A\n SG_ One : 0|8@1+ (1,0) [0|0] "" B\n',
        "72 bytes do not fit one frame",
    ),
    "J1939 transport protocol": (
        HEAD
        + f'BO_ {EXTENDED | 0x18FECA00} M: 20 A\n SG_ One : 0|8@1+ (1,0) [0|0] "" B\n\n'
        + FORMATS
        + f'BA_ "VFrameFormat" BO_ {EXTENDED | 0x18FECA00} 3;\n',
        "20 bytes do not fit one frame",
    ),
}


def random_frames(generator: np.random.Generator, layout: Layout, count: int) -> Frames:
    """Return frames with random payloads and random bytes after them, as a reused receive buffer has."""
    frames = new_frames(count)
    frames["can_id"], frames["len"] = layout.frame_id, layout.length
    frames["data"] = generator.integers(0, 256, (count, 64))
    frames["data"][0, : layout.length], frames["data"][-1, : layout.length] = 0, 255
    return frames


def same(ours: object, theirs: object) -> bool:
    if isinstance(theirs, int):
        return isinstance(ours, int) and ours == theirs
    assert isinstance(theirs, float)
    assert isinstance(ours, float)
    return (math.isnan(ours) and math.isnan(theirs)) or ours == theirs or math.isclose(ours, theirs, rel_tol=1e-9)


def compare(path: Path, generator: np.random.Generator, count: int) -> int:
    """Compare every message of a DBC on random payloads; return the number of compared values."""
    database = cantools.database.load_file(path, strict=False)
    compared = 0
    found = catalogue(path)
    assert not found.refused
    for layout in found.layouts:
        frames = random_frames(generator, layout, count)
        columns = ColumnCodec(layout).decode(frames)
        lists = {name: column.values.tolist() for name, column in columns.items()}
        codec = ColumnCodec(layout)
        undefined = np.zeros(count, np.bool_)
        raw = codec.extract(frames.view(np.uint64).reshape(count, -1)[:, 1:].T) if layout.length else None
        for multiplexer in layout.multiplexers:
            assert raw is not None
            undefined |= codec.undefined(raw, multiplexer)
        message = database.get_message_by_name(layout.name)
        for row in range(count):
            payload = frames["data"][row, : layout.length].tobytes()
            try:
                expected = message.decode(payload, decode_choices=False)
            except cantools.database.DecodeError:
                assert undefined[row], f"{layout.name} is undefined for cantools but not for the codec"
                continue
            assert not undefined[row]
            there = {name for name, c in columns.items() if c.present is None or c.present[row]}
            assert there == set(expected)
            for name, value in expected.items():
                assert same(lists[name][row], value), f"{layout.name}.{name}: {lists[name][row]!r}, cantools {value!r}"
                compared += 1
    return compared


@pytest.mark.parametrize("path", COLLECTION, ids=lambda path: path.stem)
def test_values_are_equal_to_cantools(path: Path) -> None:
    assert compare(path, np.random.default_rng(len(path.stem)), 200) > 500


def test_collection_has_at_least_six_dbcs() -> None:
    """Without this test, a missing folder would skip all comparisons."""
    assert len(COLLECTION) >= 6


def test_values_of_the_robot_network_are_equal_to_cantools() -> None:
    assert compare(atalante_dbc.DBC_FILE, np.random.default_rng(1), 10) > 5000


@pytest.mark.parametrize("seed", range(8))
def test_values_of_random_layouts_are_equal_to_cantools(seed: int, tmp_path: Path) -> None:
    """The messages have signals of random length, position, byte order, sign and kind."""
    generator = np.random.default_rng(seed)
    path = tmp_path / "random.dbc"
    path.write_text(_random_dbc(generator, 25))
    assert compare(path, generator, 12) > 1000


def _random_dbc(generator: np.random.Generator, messages: int) -> str:
    text, floats = [HEAD], []
    for number in range(messages):
        length = int(generator.choice([1, 3, 8, 12, 24, 48, 64]))
        free = set(range(8 * length))
        signals: list[str] = []
        for _ in range(60):
            big = bool(generator.integers(2))
            size = int(generator.choice([1, 2, 7, 8, 9, 13, 16, 24, 31, 32, 33, 47, 63, 64]))
            first = int(generator.integers(8 * length))
            bits = {b ^ 7 if big else b for b in range(first, first + size)}
            if not bits <= free:
                continue
            free -= bits
            name = f"S{len(signals)}"
            factor, offset = [("1", "0"), ("2", "-3"), ("0.1", "0"), ("-0.25", "17.5"), ("1", "-40")][len(signals) % 5]
            sign = "+-"[int(generator.integers(2))]
            if size in (32, 64) and generator.integers(3) == 0:
                floats.append(f"SIG_VALTYPE_ {number} {name} : {1 if size == 32 else 2};\n")
            start = first ^ 7 if big else first
            signals.append(f' SG_ {name} : {start}|{size}@{int(not big)}{sign} ({factor},{offset}) [0|0] "" B\n')
        text.append(f"BO_ {number} M{number}: {length} A\n" + "".join(signals) + "\n")
    return "".join(text + floats)


@pytest.mark.parametrize("name", REFUSED)
def test_unsupported_layout_is_named_with_the_reason(name: str, tmp_path: Path) -> None:
    text, reason = REFUSED[name]
    path = tmp_path / "foreign.dbc"
    path.write_text(text)
    found = catalogue(path)
    assert not found.layouts
    assert any(reason in refused.reason for refused in found.refused), found.refused
    with pytest.raises(KeyError, match="is not decoded"):
        found.layout("M")


def test_unsupported_message_does_not_affect_the_others(tmp_path: Path) -> None:
    path = tmp_path / "foreign.dbc"
    path.write_text(
        HEAD
        + 'BO_ 1 Bad: 1 A\n SG_ Far : 1|8@1+ (1,0) [0|0] "" B\n\nBO_ 2 Good: 1 A\n SG_ Near : 0|8@1+ (1,0) [0|0] "" B\n'
    )
    found = catalogue(path)
    assert [layout.name for layout in found.layouts] == ["Good"]
    assert [refused.name for refused in found.refused] == ["Bad"]
    with pytest.raises(KeyError, match="message must be one of Good"):
        found.layout("Ugly")


def test_named_code_of_a_64_bit_multiplexer_is_defined(tmp_path: Path) -> None:
    path = tmp_path / "foreign.dbc"
    signals = ' SG_ Mux M : 0|64@1+ (1,0) [0|0] "" B\n SG_ S m3 : 64|8@1+ (1,0) [0|0] "" B\n'
    path.write_text(f'{HEAD}BO_ 256 M: 16 A\n{signals}\nVAL_ 256 Mux {2**64 - 1} "SNA" ;\n')
    codec = ColumnCodec(catalogue(path).layout("M"))
    words = np.array([[2**64 - 1, 3, 2**64 - 2], [0, 0, 0]], np.uint64)
    assert codec.undefined(codec.extract(words), "Mux").tolist() == [False, False, True]


@pytest.mark.parametrize("text", ["", "\x00\x01", "BO_ what"])
def test_file_that_is_no_dbc_is_rejected(text: str, tmp_path: Path) -> None:
    path = tmp_path / "foreign.dbc"
    path.write_text(text)
    with pytest.raises(atalante_dbc.DbcError, match="cannot be read as a DBC"):
        catalogue(path)


def test_missing_dbc_is_reported(tmp_path: Path) -> None:
    with pytest.raises(atalante_dbc.DbcError, match=r"cannot be read as a DBC: No such file"):
        catalogue(tmp_path / "none.dbc")


def test_short_frames_are_rejected(network: atalante_dbc.Network) -> None:
    layout = catalogue(atalante_dbc.DBC_FILE).layout("LEFT_FH_STATE")
    frames = new_frames(2)
    frames["len"] = 12, 8
    with pytest.raises(ValueError, match="frames of LEFT_FH_STATE must have at least 12 bytes, got 8"):
        ColumnCodec(layout).decode(frames)
    assert network.message("LEFT_FH_STATE").length == 12


def test_values_are_equal_to_the_codec_of_the_control_loop(network: atalante_dbc.Network) -> None:
    """Both codecs give the same values to the last bit."""
    generator = np.random.default_rng(3)
    found = catalogue(atalante_dbc.DBC_FILE)
    for message in network.messages:
        frames = random_frames(generator, found.layout(message.name), 5)
        codec = ColumnCodec(found.layout(message.name))
        columns = codec.decode(frames)
        single = Codec([message])
        out = np.zeros(single.size)
        for row in range(5):
            single.decode(frames[row : row + 1].copy(), out)
            for index, (_, signal) in enumerate(single.signals):
                assert columns[signal.name].values[row] == out[index]
    assert network.messages


def test_index_finds_a_signal_or_lists_the_valid_names() -> None:
    codec = ColumnCodec(catalogue(atalante_dbc.DBC_FILE).layout("LEFT_FH_STATE"))
    assert codec.fields[codec.index("Position")].name == "Position"
    with pytest.raises(KeyError, match=r"signal of LEFT_FH_STATE must be one of .*, got 'Nothing'"):
        codec.index("Nothing")


# -- E2E -------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("length", [2, 3, 4, 5, 6, 7, 8, 12, 16, 20, 24, 32, 48, 64])
def test_crc_differences_are_equal_to_single_crcs(length: int) -> None:
    """`crc_differences` and `crc_of_zeros` together give the CRC of `e2e.crc` for each frame."""
    generator = np.random.default_rng(length)
    frames = new_frames(300)
    frames["len"] = length
    frames["data"] = generator.integers(0, 256, (300, 64))
    differences = crc_differences(frames, length)
    data_id = int(generator.integers(1 << 16))
    payloads = [frame["data"][:length].tobytes() for frame in frames]
    expected = [crc(p[2:], data_id_bytes(data_id)) ^ int.from_bytes(p[:2], "little") for p in payloads]
    assert (differences ^ crc_of_zeros(length, data_id)).tolist() == expected


def test_crc_difference_identifies_the_data_id() -> None:
    """The difference is unique for each Data ID, which distinguishes a wrong identifier from a damaged frame."""
    length = 12
    constants = {crc_of_zeros(length, data_id): data_id for data_id in range(1 << 16)}
    assert len(constants) == 1 << 16
    frames = new_frames(4)
    frames["len"] = length
    frames["data"][:, 2:length] = np.random.default_rng(0).integers(0, 256, (4, 10))
    for row, data_id in enumerate((0, 1, 0xA181, 0xFFFF)):
        protected = frames["data"][row, 2:length].tobytes()
        frames["data"][row, :2] = list(crc(protected, data_id_bytes(data_id)).to_bytes(2, "little"))
    assert [constants[int(d)] for d in crc_differences(frames, length)] == [0, 1, 0xA181, 0xFFFF]

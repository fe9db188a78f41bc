"""Parser of candump logs against the reader of python-can, on lines of the usual format, other lines and damaged lines.

Each test runs twice: with the compiled function for usual lines, and with the regular expression alone.
"""

from __future__ import annotations

import errno
import io
import os
import sys
import tracemalloc
from pathlib import Path

import can
import numpy as np
import pytest

from atalante_hal.wire.frame import FLAG_BRS, FLAG_ESI, FLAG_FDF, ID_ERROR, ID_EXTENDED, ID_REMOTE
from atalante_tools.canlog.reader import candump, candump_log
from atalante_tools.canlog.reader import log as log_module
from atalante_tools.canlog.reader.candump import MARGIN, Parsed, parse
from atalante_tools.canlog.reader.chunk import NO_DIRECTION, RECEIVED, SENT, Channels, Chunk
from atalante_tools.canlog.reader.log import Log, open_log


@pytest.fixture(params=["compiled", "regular expression"], autouse=True)
def _parser(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(candump, "_COMPILED_BYTES", 0 if request.param == "compiled" else sys.maxsize)


def parsed(text: str | bytes) -> tuple[Parsed, list[str]]:
    raw = text.encode() if isinstance(text, str) else text
    channels = Channels()
    return parse(bytearray(raw) + bytes(MARGIN), 0, len(raw), channels), channels.names


def one(line: str) -> tuple[dict[str, object], bool]:
    """Return the frame in a line, and whether the line contains a frame."""
    result, names = parsed(line + "\n")
    if not len(result.chunk):
        return {}, False
    frame = result.chunk.frames[0]
    return {
        "id": int(frame["can_id"]),
        "flags": int(frame["flags"]),
        "len": int(frame["len"]),
        "data": frame["data"][: frame["len"]].tobytes(),
        "stamp": int(result.chunk.stamps[0]),
        "channel": names[result.chunk.channels[0]],
        "sent": int(result.chunk.sent[0]),
    }, True


def random_lines(seed: int, count: int) -> list[str]:
    generator = np.random.default_rng(seed)
    lines = []
    stamp = 1_700_000_000_000_000
    for _ in range(count):
        stamp += int(generator.integers(0, 2000))
        extended = generator.integers(3) == 0
        identifier = (
            f"{int(generator.integers(1 << 29)):08X}" if extended else f"{int(generator.integers(1 << 11)):03X}"
        )
        fd = bool(generator.integers(2))
        length = int(generator.choice([0, 1, 2, 3, 7, 8, 12, 20, 48, 64] if fd else [0, 1, 5, 8]))
        data = generator.integers(0, 256, length, dtype=np.uint8).tobytes().hex()
        data = data.upper() if generator.integers(2) else data
        flags = f"#{int(generator.integers(4)):X}" if fd else ""
        channel = str(generator.choice(["can0", "vcan0", "left_sense", "right_sense", "a_name_of_15_chr"]))
        ending = str(generator.choice(["", " R", " T"]))
        lines.append(f"({stamp // 1000000}.{stamp % 1000000:06d}) {channel} {identifier}#{flags}{data}{ending}")
    return lines


@pytest.mark.parametrize("ending", ["\n", "\r\n"])
def test_frames_are_equal_to_those_of_python_can(ending: str, tmp_path: Path) -> None:
    lines = random_lines(1, 3000)
    path = tmp_path / "random.log"
    path.write_bytes("".join(line + ending for line in lines).encode())
    log = open_log(path)
    chunks = list(log.chunks())
    assert log.remarks == []
    messages = list(can.LogReader(path))
    frames = np.concatenate([c.frames for c in chunks])
    stamps = np.concatenate([c.stamps for c in chunks])
    channels = np.concatenate([c.channels for c in chunks])
    assert len(frames) == len(messages) == len(lines)
    for message, frame, stamp, channel in zip(messages, frames, stamps.tolist(), channels.tolist(), strict=True):
        assert int(frame["can_id"]) == message.arbitration_id | (ID_EXTENDED if message.is_extended_id else 0)
        assert frame["data"][: frame["len"]].tobytes() == bytes(message.data)
        assert not frame["data"][frame["len"] :].any()
        flags = FLAG_FDF * message.is_fd | FLAG_BRS * message.bitrate_switch | FLAG_ESI * message.error_state_indicator
        assert int(frame["flags"]) == flags
        assert stamp * 1e-9 == pytest.approx(message.timestamp, abs=1e-6)
        assert log.channels.names[channel] == message.channel
    sent = np.concatenate([c.sent for c in chunks]).tolist()
    directions = {"R": RECEIVED, "T": SENT}
    assert sent == [directions.get(line[-1], NO_DIRECTION) if line[-2] == " " else NO_DIRECTION for line in lines]


def test_chunk_size_does_not_change_the_frames(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "random.log"
    path.write_text("".join(f"{line}\n" for line in random_lines(2, 800)))

    def read() -> bytes:
        chunks = list(open_log(path).chunks())
        return b"".join(c.frames.tobytes() for c in chunks) + b"".join(c.stamps.tobytes() for c in chunks)

    whole = read()
    for piece, frames in ((400, 7), (1000, 100), (4096, 801)):
        monkeypatch.setattr(candump_log, "_TEXT_BYTES", piece)
        monkeypatch.setattr(log_module, "_CHUNK_FRAMES", frames)
        assert read() == whole


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        (
            "(0.001000) vcan0 181##5AABB",
            {"id": 0x181, "flags": FLAG_FDF | FLAG_BRS, "data": b"\xaa\xbb", "stamp": 1_000_000},
        ),
        ("(12.345678912) can0 7FF#", {"id": 0x7FF, "flags": 0, "len": 0, "stamp": 12_345_678_912}),
        ("(9223372036.854775807) can0 7FF#", {"stamp": 2**63 - 1}),
        ("(1700000000.000001) can0 123#R", {"id": 0x123 | ID_REMOTE, "len": 0}),
        ("(1700000000.000001) can0 123#R4 T", {"id": 0x123 | ID_REMOTE, "len": 4, "sent": SENT}),
        ("(1700000000.000001) can0 00000123#11", {"id": 0x123 | ID_EXTENDED, "data": b"\x11"}),
        ("(1700000000.000001) can0 20000004#0001000000000000", {"id": 4 | ID_ERROR, "len": 8}),
        ("(1700000000.000001) can0 123#1122334455667788_E", {"id": 0x123, "len": 8}),
        ("  (1700000000.000001)   can0   123#11   R  ", {"id": 0x123, "data": b"\x11", "sent": RECEIVED}),
        ("(1700000000.000001) can0 123##3" + "00" * 13, {"len": 13, "flags": FLAG_FDF | FLAG_BRS | FLAG_ESI}),
        ("(1700000000.000001) can0 123#" + "00" * 12, {"len": 12, "flags": 0}),
        ("(1700000000.000001) a-very-long-channel-name-indeed 123#11", {"channel": "a-very-long-channel-name-indeed"}),
    ],
)
def test_lines_of_every_format_are_read(line: str, expected: dict[str, object]) -> None:
    frame, readable = one(line)
    assert readable
    assert {key: frame[key] for key in expected} == expected


@pytest.mark.parametrize(
    "line",
    [
        "garbage",
        "(1700000000.000000) vcan0",
        "(1700000000.000000) vcan0 181#ABC",
        "(1700000000.000000) vcan0 181#GG",
        "(1700000000.000000) vcan0 181##",
        "(1700000000.000000) vcan0 181##X00",
        "(1700000000.000000) vcan0 181###00112233",
        "(1700000000.000000) vcan0 1811#00",
        "(1700000000.000000) vcan0 8FF#00",
        "(1700000000.000000) vcan0 18G#00",
        "(1700000000.000000) vcan0 181#00 X",
        "(17000x0000.000000) vcan0 181#00",
        "(1700000000.00000x) vcan0 181#00",
        "(1700000000) vcan0 181#00",
        "1700000000.000000 vcan0 181#00",
        "(1700000000.000000) 181#00",
        "(1700000000.000000) vcan0 181##1" + "00" * 65,
        "(1700000000.000000) vcan0 181#00#11",
        "(1700000000.000000) vcan0 FFFFFFFFF#00",
        "(1700000000.000000) vcan0 4000000F#00",
        "(9223372036.854775808) left_leg 181#00",
        "(9999999999.000000) left_leg 181##1AABB R",
    ],
)
def test_invalid_lines_are_counted_as_unreadable(line: str) -> None:
    """The line is rejected alone and between valid lines. All valid lines are read."""
    good = "(1700000000.000000) left_leg 181##1AABB R"
    assert one(line) == ({}, False)
    for lines in ([line, good, good], [good, line, good], [good, good, line]):
        result, _ = parsed("".join(f"{text}\n" for text in lines))
        assert (len(result.chunk), result.unreadable) == (2, 1)
        assert result.first_unreadable == line.encode()
        assert bool((result.chunk.frames["can_id"] == 0x181).all())


def test_blank_lines_are_ignored() -> None:
    result, _ = parsed("\n  \n(1700000000.000000) left_leg 181##1AABB R\n\n")
    assert (len(result.chunk), result.unreadable) == (1, 0)


def test_digit_after_an_empty_last_line_is_not_read() -> None:
    text = bytearray(b"\n" + b"1" * MARGIN)
    assert len(parse(text, 0, 1, Channels()).chunk) == 0


@pytest.mark.parametrize("seed", range(6))
def test_damaged_lines_never_give_a_wrong_frame(seed: int) -> None:
    """A line with one changed byte gives the same frame as `parse_simply`, or is counted as unreadable."""
    generator = np.random.default_rng(seed)
    lines = random_lines(seed, 400)
    damaged = []
    for line in lines:
        text = bytearray(line.encode())
        text[int(generator.integers(len(text)))] = int(generator.integers(32, 127))
        damaged.append(bytes(text))
    result, names = parsed(b"".join(line + b"\n" for line in damaged))
    alone = [parsed(line + b"\n") for line in damaged]
    assert result.unreadable == sum(single.unreadable for single, _ in alone)
    kept = [(single.chunk, channels) for single, channels in alone if len(single.chunk)]
    assert len(result.chunk) == len(kept)
    assert b"".join(c.frames.tobytes() for c, _ in kept) == result.chunk.frames.tobytes()
    assert [int(c.stamps[0]) for c, _ in kept] == result.chunk.stamps.tolist()
    assert [n[c.channels[0]] for c, n in kept] == [names[k] for k in result.chunk.channels.tolist()]
    readable = [line for line, (single, _) in zip(damaged, alone, strict=True) if len(single.chunk)]
    for line, frame, stamp in zip(readable, result.chunk.frames, result.chunk.stamps.tolist(), strict=True):
        assert parse_simply(line.decode()) == (stamp, int(frame["can_id"]), frame["data"][: frame["len"]].tobytes())


def parse_simply(line: str) -> tuple[int, int, bytes]:
    """Parse a line part by part. Raise an exception if the line contains no frame."""
    time, _, frame, *direction = line.split()
    assert time[0] + time[-1] == "()"
    assert direction in ([], ["R"], ["T"], ["r"], ["t"])
    seconds, decimals = time[1:-1].split(".")
    identifier, data = frame.split("#", 1)
    if data.startswith("#"):
        assert data[1] in "0123456789abcdefABCDEF"
        data = data[2:]
    number = int(identifier, 16)
    if len(identifier) == 8 and not number & ID_ERROR:
        number |= ID_EXTENDED
    if data[:1] in ("R", "r"):
        number, data = number | ID_REMOTE, "00" * int(data[1:] or 0)
    else:
        data = data.split("_")[0]
    return int(seconds) * 10**9 + int(decimals.ljust(9, "0")), number, bytes.fromhex(data)


def test_seconds_with_different_numbers_of_digits_are_read(tmp_path: Path) -> None:
    """Virtual time begins at 0, so the number of its digits grows."""
    path = tmp_path / "virtual.log"
    stamps = [0, 1, 999_999, 9_999_999, 10_000_000, 99_999_999, 100_000_000, 1_234_567_890]
    path.write_text("".join(f"({s // 10**6}.{s % 10**6:06d}) can0 100#00\n" for s in stamps))
    (chunk,) = open_log(path).chunks()
    assert chunk.stamps.tolist() == [s * 1000 for s in stamps]


def test_line_longer_than_the_buffer_is_unreadable(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(candump_log, "_TEXT_BYTES", 512)
    path = tmp_path / "long.log"
    path.write_text("(0.000001) can0 100#00\n" + "x" * 2000 + "\n(0.000002) can0 100#00\n")
    log = open_log(path)
    assert sum(map(len, log.chunks())) == 2
    (remark,) = log.remarks
    assert (remark.rule, remark.count) == ("log-unreadable", 1)
    assert "the first is 'xxx" in remark.sentence


def test_read_error_is_reported_as_a_truncated_log(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "error.log"
    path.write_text("(0.000001) can0 100#00\n")

    class Broken(io.FileIO):
        def readinto(self, memory: object) -> int:
            raise OSError(errno.EIO, os.strerror(errno.EIO))

    log = open_log(path)
    monkeypatch.setattr(candump_log, "_open", lambda log: Broken(log.path))
    assert list(log.chunks()) == []
    sentences = {remark.rule: remark.sentence for remark in log.remarks}
    assert os.strerror(errno.EIO) in sentences["log-truncated"]


def read(path: Path) -> tuple[Log, list[Chunk]]:
    log = open_log(path)
    return log, list(log.chunks())


def test_compressed_log_is_read_up_to_its_truncation(tmp_path: Path) -> None:
    import gzip

    lines = "".join(f"{line}\n" for line in random_lines(3, 4000))
    path = tmp_path / "random.log.gz"
    path.write_bytes(gzip.compress(lines.encode()))
    log, chunks = read(path)
    assert sum(map(len, chunks)) == 4000
    assert log.remarks == []
    path.write_bytes(gzip.compress(lines.encode())[:-4000])
    log, chunks = read(path)
    assert 0 < sum(map(len, chunks)) < 4000
    assert [remark.rule for remark in log.remarks] == ["log-truncated"]


def test_payload_of_a_rejected_line_is_not_in_the_next_frame() -> None:
    result, _ = parsed("(0.000001) can0 100##1" + "FF" * 64 + " X\n(0.000002) can0 101#01\n")
    assert (len(result.chunk), result.unreadable) == (1, 1)
    assert result.chunk.frames["data"][0].tolist() == [1] + [0] * 63


@pytest.mark.parametrize(
    "line",
    [
        "(1700000000.000001)  123#00 R",  # no channel
        "(.000001) can0 123#00",
        "(12345678901.000001) can0 123#00",
        "(1.0000001234) can0 123#00",
        "(1.000001) can0 #00",
        "(1.000001) can0 12345#00",
        "(1.000001)can0 123#00",
    ],
)
def test_line_without_a_field_is_unreadable_after_a_channel_with_a_long_name(line: str) -> None:
    result, _ = parsed(f"(1.000001) a-very-long-channel-name-indeed 123#11\n{line}\n")
    assert (len(result.chunk), result.unreadable, result.first_unreadable) == (1, 1, line.encode())


def test_channel_names_that_differ_only_in_a_nul_are_different_channels() -> None:
    result, names = parsed("(1.000000) \0can0 100#00\n(2.000000) can0 100#00\n(3.000000) \0can0 100#00\n")
    assert names == ["\0can0", "can0"]
    assert result.chunk.channels.tolist() == [0, 1, 0]


@pytest.mark.parametrize("mark", ["#", "##1"])
def test_long_payload_needs_little_memory(mark: str) -> None:
    text = b"(1.000000) can0 100" + mark.encode() + b"A" * 1_000_000 + b"\n"
    tracemalloc.start()
    try:
        result, _ = parsed(text)
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert result.unreadable == 1
    assert peak < 4 * len(text)


def test_many_channel_names_share_the_last_number() -> None:
    """The names after the 256th have the last number, in the first lines and in later lines."""
    lines = [f"({number}.000000) can{number} 100#00\n" for number in range(300)]
    result, names = parsed("".join(lines + lines))
    assert names == [f"can{number}" for number in range(256)]
    assert result.chunk.channels.tolist() == [min(number, 255) for number in range(300)] * 2


def test_short_and_long_texts_give_the_same_frames(monkeypatch: pytest.MonkeyPatch) -> None:
    text = "".join(f"{line}\n" for line in random_lines(4, 2000)).encode()
    monkeypatch.setattr(candump, "_COMPILED_BYTES", len(text))
    by_function, names = parsed(text)
    monkeypatch.setattr(candump, "_COMPILED_BYTES", len(text) + 1)
    by_expression, same_names = parsed(text)
    assert names == same_names
    for field in ("frames", "stamps", "channels", "sent"):
        assert getattr(by_function.chunk, field).tobytes() == getattr(by_expression.chunk, field).tobytes()


def test_compiled_function_gives_the_same_as_python(monkeypatch: pytest.MonkeyPatch) -> None:
    text = "".join(f"{line}\n" for line in random_lines(5, 200)).encode()
    by_machine_code, _ = parsed(text)
    monkeypatch.setenv("NUMBA_DISABLE_JIT", "1")
    by_python, _ = parsed(text)
    assert by_machine_code.chunk.frames.tobytes() == by_python.chunk.frames.tobytes()
    assert by_machine_code.chunk.stamps.tolist() == by_python.chunk.stamps.tolist()

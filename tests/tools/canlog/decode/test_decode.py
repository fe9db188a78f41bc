"""Command `atalante decode` against cantools: every value in Parquet and MCAP, for the robot and for foreign networks."""

from __future__ import annotations

from collections import defaultdict
from pathlib import Path
from typing import Any

import can
import cantools
import numpy as np
import pyarrow.parquet as pq
import pytest
from click.testing import CliRunner, Result
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from mcap.reader import make_reader

import atalante_dbc
from atalante_dbc.foreign import catalogue
from atalante_tools.canlog.decode.mcap import encode
from atalante_tools.cli import cli

COLLECTION = sorted(Path(__file__).parents[3].joinpath("foreign").glob("*.dbc"))
BEGIN = 1_700_000_000.0

#: (message, signal) -> (time [s], value) in order of time.
Series = dict[tuple[str, str], list[tuple[float, Any]]]


def run(*arguments: object) -> Result:
    result = CliRunner().invoke(cli, [str(argument) for argument in arguments])
    assert result.exception is None or isinstance(result.exception, SystemExit), result.exception
    return result


def random_log(dbc: Path, path: Path, count: int) -> tuple[Path, Series]:
    """Write a log of random payloads; return its path and the values that cantools decodes."""
    generator = np.random.default_rng(count)
    database = cantools.database.load_file(dbc, strict=False)
    layouts = catalogue(dbc).layouts
    expected: Series = defaultdict(list)
    with can.Logger(path) as logger:
        for number in range(count):
            layout = layouts[number % len(layouts)]
            data = generator.integers(0, 256, layout.length, dtype=np.uint8).tobytes()
            stamp = BEGIN + number * 1e-4
            logger.on_message_received(
                can.Message(
                    timestamp=stamp,
                    arbitration_id=layout.frame_id,
                    is_extended_id=layout.extended,
                    is_fd=layout.length > 8 or bool(layout.fd),
                    data=data,
                    channel="can1",
                )
            )
            for name, value in _decode(database.get_message_by_name(layout.name), data).items():
                expected[layout.name, name].append((stamp, value))
    return path, expected


def _decode(message: Any, data: bytes) -> dict[str, Any]:
    """Return the values that cantools decodes, or an empty dictionary if the multiplexer value is undefined."""
    try:
        return dict(message.decode(data, decode_choices=False))
    except cantools.database.DecodeError:
        return {}


def check(found: Series, expected: Series) -> int:
    compared = 0
    for key, series in expected.items():
        by_time = {round(stamp, 5): value for stamp, value in found[key]}
        for stamp, value in series:
            ours = by_time[round(stamp, 5)]
            if value != value:
                assert ours != ours
            elif isinstance(value, int):
                assert ours == value, (key, ours, value)
            else:
                assert ours == pytest.approx(value, rel=1e-9)
            compared += 1
    return compared


def read_parquet(path: Path) -> Series:
    found: Series = defaultdict(list)
    for row in pq.read_table(path).to_pylist():
        value = row["value"] if row["integer"] is None else int(row["integer"])
        found[row["message"], row["signal"]].append((row["time"].value * 1e-9, value))
    return found


def read_mcap(path: Path) -> Series:
    found: Series = defaultdict(list)
    kinds: dict[int, Any] = {}
    with path.open("rb") as file:
        for schema, channel, message in make_reader(file).iter_messages():
            assert schema is not None
            if schema.id not in kinds:
                files = descriptor_pb2.FileDescriptorSet.FromString(schema.data)
                pool = descriptor_pool.DescriptorPool()
                for proto in files.file:
                    pool.Add(proto)
                kinds[schema.id] = message_factory.GetMessageClass(pool.FindMessageTypeByName(schema.name))
            assert channel.topic == f"/can/{schema.name.rsplit('.')[-1]}"
            decoded = kinds[schema.id].FromString(message.data)
            for field, value in decoded.ListFields():
                found[schema.name.rsplit(".")[-1], field.name].append((message.log_time * 1e-9, value))
    return found


@pytest.mark.parametrize("dbc", [*COLLECTION, atalante_dbc.DBC_FILE], ids=lambda path: path.stem)
def test_parquet_values_are_equal_to_cantools(dbc: Path, tmp_path: Path) -> None:
    log, expected = random_log(dbc, tmp_path / "random.log", 300)
    result = run("decode", log, "--dbc", dbc, "-o", tmp_path / "out.parquet")
    assert result.exit_code == 0
    assert check(read_parquet(tmp_path / "out.parquet"), expected) > 200


@pytest.mark.parametrize("dbc", [*COLLECTION, atalante_dbc.DBC_FILE], ids=lambda path: path.stem)
def test_mcap_values_are_equal_to_cantools(dbc: Path, tmp_path: Path) -> None:
    log, expected = random_log(dbc, tmp_path / "random.log", 300)
    result = run("decode", log, "--dbc", dbc, "-o", tmp_path / "out.mcap")
    assert result.exit_code == 0
    found = read_mcap(tmp_path / "out.mcap")
    wide = {("WholeScaled", "Wide")}  # integers beyond 64 bits are doubles in protobuf
    assert check(found, {k: v for k, v in expected.items() if k not in wide}) > 200


def test_parquet_integer_is_exact_with_a_large_offset(tmp_path: Path) -> None:
    dbc, log, out = (tmp_path / name for name in ("offset.dbc", "offset.log", "out.parquet"))
    dbc.write_text(f'VERSION ""\nBU_: A\nBO_ 256 M: 8 A\n SG_ S : 0|8@1+ (1,{2**60}) [0|0] "" A\n')
    log.write_text("(0.000001) can0 100#0100000000000000\n")
    assert run("decode", log, "--dbc", dbc, "-o", out).exit_code == 0
    assert [int(row["integer"]) for row in pq.read_table(out).to_pylist()] == [2**60 + 1]


def test_parquet_names_64_bit_codes(tmp_path: Path) -> None:
    dbc, log, out = (tmp_path / name for name in ("wide.dbc", "wide.log", "out.parquet"))
    dbc.write_text(
        'VERSION ""\nBU_: A\nBO_ 256 M: 8 A\n SG_ S : 0|64@1+ (1,0) [0|1000] "" A\n'
        f'VAL_ 256 S {2**64 - 1} "SNA" {2**63} "HALF" 1 "ONE" ;\n'
    )
    codes = (2**64 - 1, 2**63, 1, 2**63 - 1)
    log.write_text("".join(f"(1.000000) can0 100#{code.to_bytes(8, 'little').hex()}\n" for code in codes))
    assert run("decode", log, "--dbc", dbc, "-o", out).exit_code == 0
    rows = pq.read_table(out).to_pylist()
    assert [(int(row["integer"]), row["text"]) for row in rows] == list(
        zip(codes, ("SNA", "HALF", "ONE", None), strict=True)
    )


def test_parquet_has_the_documented_columns(tmp_path: Path) -> None:
    log, _ = random_log(atalante_dbc.DBC_FILE, tmp_path / "random.log", 200)
    run("decode", log, "-o", tmp_path / "out.parquet")
    table = pq.read_table(tmp_path / "out.parquet")
    assert table.column_names == ["time", "channel", "message", "signal", "value", "integer", "text"]
    metadata = pq.read_schema(tmp_path / "out.parquet").metadata
    assert metadata[b"unit:LEFT_FH_STATE.Position"] == b"rad"
    assert metadata[b"dbc"] == b"atalante.dbc"
    only = pq.read_table(tmp_path / "out.parquet", filters=[("signal", "==", "Request")]).to_pylist()
    names = {0: "NONE", 1: "START", 2: "STOP", 3: "HOLD"}
    assert only
    for row in only:
        assert row["text"] == names.get(int(row["value"]))
        assert row["channel"] == "can1"


def test_skipped_frames_of_several_logs_are_counted(tmp_path: Path) -> None:
    log, expected = random_log(atalante_dbc.DBC_FILE, tmp_path / "first.log", 200)
    values = sum(map(len, expected.values()))
    second = tmp_path / "second.log"
    second.write_text(
        log.read_text()
        + "(1700000001.000000) can1 7FF##100\n"
        + "(1700000001.000000) can1 181##10011\n"
        + "(1700000001.000000) can1 181#R\n"
        + "(1700000001.000000) can1 20000004#0000000000000000\n"
        + "no frame\n"
    )
    result = run("decode", log, second, "-o", tmp_path / "out.parquet")
    assert result.exit_code == 0
    assert f"{2 * values} values of 400 frames" in result.stderr
    for sentence in (
        "1 frames with an identifier that is not in the DBC",
        "2 frames without data",
        "1 frames shorter than the message in the DBC",
        "1 lines that are not CAN frames",
    ):
        assert sentence in result.stderr
    assert pq.read_metadata(tmp_path / "out.parquet").num_rows == 2 * values


def test_several_chunks_and_channels_are_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from atalante_tools.canlog.reader import candump_log
    from atalante_tools.canlog.reader import log as log_module

    monkeypatch.setattr(candump_log, "_TEXT_BYTES", 4096)
    monkeypatch.setattr(log_module, "_CHUNK_FRAMES", 50)
    log, expected = random_log(atalante_dbc.DBC_FILE, tmp_path / "random.log", 400)
    lines = log.read_text().replace("can1", "can0", 70)
    log.write_text(lines)
    run("decode", log, "-o", tmp_path / "out.parquet")
    run("decode", log, "-o", tmp_path / "out.mcap")
    assert pq.read_metadata(tmp_path / "out.parquet").num_row_groups > 3
    check(read_parquet(tmp_path / "out.parquet"), expected)
    channels = {row["channel"] for row in pq.read_table(tmp_path / "out.parquet").to_pylist()}
    assert channels == {"can0", "can1"}
    with (tmp_path / "out.mcap").open("rb") as file:
        stamps, topics = [], set()
        for _, channel, message in make_reader(file).iter_messages(log_time_order=False):
            stamps.append(message.log_time)
            topics.add(channel.topic)
    assert stamps == sorted(stamps)
    assert {"/can/LEFT_FH_STATE", "/can/can1/LEFT_FH_STATE"} <= topics


def test_logs_of_different_channels_have_their_own_topics(tmp_path: Path) -> None:
    logs = [tmp_path / f"can{number}.log" for number in range(2)]
    for number, log in enumerate(logs):
        log.write_text(f"({number + 1}.000000) can{number} 181##5" + "00" * 12 + "\n")
    run("decode", *logs, "-o", tmp_path / "out.mcap")
    with (tmp_path / "out.mcap").open("rb") as file:
        found = [(c.topic, c.metadata["channel"], m.log_time) for _, c, m in make_reader(file).iter_messages()]
    assert found == [
        ("/can/LEFT_FH_STATE", "can0", 1_000_000_000),
        ("/can/can1/LEFT_FH_STATE", "can1", 2_000_000_000),
    ]


def test_log_without_known_messages_fails(tmp_path: Path) -> None:
    log = tmp_path / "empty.log"
    log.write_text("(1700000001.000000) can1 7FF##100\n")
    assert run("decode", log, "-o", tmp_path / "out.parquet").exit_code == 1
    assert run("decode", log, "-o", tmp_path / "out.mcap").exit_code == 1
    assert pq.read_metadata(tmp_path / "out.parquet").num_rows == 0


@pytest.mark.parametrize("suffix", ["mcap", "parquet"])
def test_log_without_frames_leaves_the_previous_file(suffix: str, tmp_path: Path) -> None:
    log, out = tmp_path / "empty.log", tmp_path / f"out.{suffix}"
    log.touch()
    out.write_text("of yesterday")
    result = run("decode", log, "-o", out)
    assert result.exit_code == 1
    assert f"a log must have at least one frame to decode, got none; {out} was not written" in result.stderr
    assert out.read_text() == "of yesterday"


@pytest.mark.parametrize(
    ("out", "code", "sentence"),
    [
        ("out.txt", 2, "must end in .parquet or .mcap"),
        ("no/out.parquet", 1, "cannot be written"),
        ("no/out.mcap", 1, "cannot be written"),
    ],
)
def test_wrong_output_path_is_reported(out: str, code: int, sentence: str, tmp_path: Path) -> None:
    log, _ = random_log(atalante_dbc.DBC_FILE, tmp_path / "random.log", 100)
    result = run("decode", log, "-o", tmp_path / out)
    assert result.exit_code == code
    assert sentence in result.stderr


def test_missing_log_is_reported(tmp_path: Path) -> None:
    result = run("decode", tmp_path / "none.log", "-o", tmp_path / "out.parquet")
    assert result.exit_code == 1
    assert "none.log does not exist" in result.stderr
    assert not (tmp_path / "out.parquet").exists()


def test_unsupported_messages_are_named(tmp_path: Path) -> None:
    dbc = tmp_path / "foreign.dbc"
    dbc.write_text('VERSION ""\nBS_:\nBU_: A\n\nBO_ 1 Long: 16 A\n SG_ S : 0|65@1+ (1,0) [0|0] "" A\n')
    log = tmp_path / "a.log"
    log.write_text("(1.000000) can0 001##1" + "00" * 16 + "\n")
    result = run("decode", log, "--dbc", dbc, "-o", tmp_path / "out.parquet")
    assert "Long is not decoded: S has 65 bits" in result.stderr
    assert "1 frames of messages with an unsupported layout" in result.stderr


def test_field_numbers_with_long_tags_are_encoded() -> None:
    """A field number above 15 has a tag of two bytes, and a field number above 2047 has a tag of three bytes."""
    numbers = [1, 15, 16, 300, 2047, 2048]
    files = descriptor_pb2.FileDescriptorProto(name="m.proto", package="p")
    message = files.message_type.add(name="M")
    for number in numbers:
        message.field.add(name=f"f{number}", number=number, type=16, label=1)
    pool = descriptor_pool.DescriptorPool()
    pool.Add(files)
    kind = message_factory.GetMessageClass(pool.FindMessageTypeByName("p.M"))
    values = np.arange(3, dtype=np.int64) - 1
    for row, payload in enumerate(encode([(n, values * n) for n in numbers], 3)):
        decoded = kind.FromString(payload)
        assert [getattr(decoded, f"f{n}") for n in numbers] == [(row - 1) * n for n in numbers]


@pytest.mark.parametrize("suffix", ["mcap", "parquet"])
@pytest.mark.parametrize(("error", "code"), [(OSError(28, "No space left on device"), 1), (KeyboardInterrupt(), 130)])
def test_failed_write_leaves_the_previous_file(
    suffix: str, error: BaseException, code: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    log, _ = random_log(COLLECTION[0], tmp_path / "random.log", 20)
    out = tmp_path / f"out.{suffix}"
    out.write_text("of yesterday")

    def fail(_: object) -> None:
        raise error

    monkeypatch.setattr(f"atalante_tools.canlog.decode.{suffix}.{suffix.capitalize()}Sink.flush", fail)
    result = run("decode", log, "--dbc", COLLECTION[0], "-o", out)
    assert result.exit_code == code
    assert result.stderr == (f"atalante: {out} cannot be written: No space left on device\n" if code == 1 else "")
    assert out.read_text() == "of yesterday"
    assert sorted(path.name for path in tmp_path.iterdir()) == [out.name, log.name]


def test_parquet_has_only_rounded_values_beyond_38_digits(tmp_path: Path) -> None:
    dbc = tmp_path / "large.dbc"
    dbc.write_text('VERSION ""\nNS_ :\nBS_:\nBU_: A B\n\nBO_ 1 M: 8 A\n SG_ S : 0|64@1+ (1e30,0) [0|0] "" B\n')
    log, _ = random_log(dbc, tmp_path / "large.log", 3)
    out = tmp_path / "large.parquet"
    assert run("decode", log, "--dbc", dbc, "-o", out).exit_code == 0
    rows = pq.read_table(out).to_pylist()
    assert [row["integer"] for row in rows] == [None] * 3
    assert min(row["value"] for row in rows) > 1e38


def test_decode_keeps_a_part_file_of_the_user(tmp_path: Path) -> None:
    log, _ = random_log(atalante_dbc.DBC_FILE, tmp_path / "a.log", 3)
    part = tmp_path / "o.parquet.part"
    part.write_text("of the user")
    assert run("decode", log, "-o", tmp_path / "o.parquet").exit_code == 0
    assert part.read_text() == "of the user"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.log", "o.parquet", "o.parquet.part"]


def test_truncated_log_is_decoded_with_exit_code_1(tmp_path: Path) -> None:
    log, _ = random_log(atalante_dbc.DBC_FILE, tmp_path / "a.log", 3)
    log.write_bytes(log.read_bytes()[:-5])
    out = tmp_path / "o.parquet"
    result = run("decode", log, "-o", out)
    assert (result.exit_code, "ends within a line" in result.stderr) == (1, True)
    assert pq.read_table(out).num_rows

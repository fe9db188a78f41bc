"""Tests of the generated C code against the Python codec with sanitizers, and of the comparison itself."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from binascii import crc_hqx
from pathlib import Path

import cantools
import click
import numpy as np
import pytest
from click.testing import CliRunner

from atalante_dbc import DBC_FILE, load
from atalante_hal.wire.codec import Codec
from atalante_tools.cli import cli
from atalante_tools.console.outcome import Failed
from atalante_tools.dbc.build import Build
from atalante_tools.dbc.c_code import write
from atalante_tools.dbc.e2e_c import crc_table
from atalante_tools.dbc.host_test import compile_host_test, run_host_test

IMAGES = 10_000


@pytest.fixture(scope="session", autouse=True)
def compiler() -> None:
    assert shutil.which("gcc"), "the tests of the generated C need gcc: apt-get install gcc libc6-dev"


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> tuple[Build, Path]:
    """Generate the code of the whole network once; return build and folder."""
    return generated(None, tmp_path_factory.mktemp("whole"))


@pytest.fixture(scope="module")
def whole_program(whole: tuple[Build, Path]) -> Path:
    """Compile the code of the whole network once, which takes 20 s; return the program."""
    return compile_host_test(*whole)


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Generate and compile the code of one drive once; return folder and program."""
    build, folder = generated("LEFT_SK", tmp_path_factory.mktemp("drive"))
    return folder, compile_host_test(build, folder)


def generated(node: str | None, folder: Path) -> tuple[Build, Path]:
    build = Build.of(DBC_FILE, node)
    write(build, folder, 0)
    return build, folder


def test_makefile_of_the_user_is_kept(tmp_path: Path):
    (tmp_path / "Makefile").write_text("all:\n")
    arguments = ["dbc", "c-code", "-o", str(tmp_path)]
    done = CliRunner().invoke(cli, arguments)
    assert done.exit_code == 1
    assert "Makefile must be a generated file if it exists, got another Makefile" in done.stderr
    assert [path.name for path in tmp_path.iterdir()] == ["Makefile"]
    (tmp_path / "Makefile").unlink()
    for _ in range(2):  # a generated Makefile is written again
        assert CliRunner().invoke(cli, arguments).exit_code == 0


@pytest.mark.sample(5)
@pytest.mark.parametrize("name", ["atalante.c", "atalante.h", "host_test.c", "vectors.bin", "vectors.json"])
def test_file_of_the_user_is_kept(name: str, tmp_path: Path):
    build = Build.of(DBC_FILE, "PENDANT")
    for _ in range(2):
        write(build, tmp_path, 0)  # a generated file is written again
    (tmp_path / name).write_text("of the user")
    with pytest.raises(Failed, match=f"{name} must be a generated file if it exists, got another {name}"):
        write(build, tmp_path, 0)
    assert (tmp_path / name).read_text() == "of the user"


@pytest.mark.parametrize(
    ("file", "changes", "error"),
    [
        ("3robot.dbc", {}, "must begin with a letter, because .*, got 3robot.c: rename the DBC file"),
        ("Host_Test.dbc", {}, "must differ from host_test.c"),
        (
            "robot.dbc",
            {"DriveState": "Default"},
            "signals of LEFT_FH_STATE must not be named like C keywords, got Default",
        ),
        (
            "robot.dbc",
            {"DriveState": "POSITION"},
            "signals of LEFT_FH_STATE must have different names in C, got POSITION and Position: both are 'position'",
        ),
        (
            "robot.dbc",
            {"LEFT_FH_EMCY": "LeftFhState"},
            "messages must have different names in C, got LeftFhState and LEFT_FH_STATE",
        ),
        (
            "robot.dbc",
            {"DriveState": "True"},
            "signals of LEFT_FH_STATE must not be named like C keywords, got True",
        ),
        (
            "robot.dbc",
            {"LEFT_FH_EMCY": "LEFT_FH", "ErrorCode": "State_Torque"},
            "messages and signals must have different names in C, got LEFT_FH.State_Torque and LEFT_FH_STATE.Torque",
        ),
    ],
)
def test_names_that_are_no_names_in_c_are_rejected(file: str, changes: dict[str, str], error: str, tmp_path: Path):
    text = DBC_FILE.read_text("cp1252")
    for old, new in changes.items():
        text = re.sub(rf"\b{old}\b", new, text)
    (tmp_path / file).write_text(text, "cp1252")
    with pytest.raises(Failed, match=error):
        write(Build.of(tmp_path / file, None), tmp_path / "out", 0)
    assert not (tmp_path / "out").exists()


@pytest.mark.long
def test_c_and_python_agree_on_random_images_of_the_whole_network(whole, whole_program):
    build, _ = whole
    assert len(build.messages) == len(load().messages)
    # Every message is compared twice: unpacked and packed.
    assert run_host_test(build, whole_program, IMAGES, seed=1) == 2 * IMAGES * len(build.messages)


@pytest.mark.long
def test_host_test_passes_on_the_vector_file(whole, whole_program):
    _, folder = whole
    done = subprocess.run([whole_program, folder / "vectors.bin"], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (0, f"{2 * 100 * len(load().messages)} frames compared\n")


@pytest.mark.parametrize("offset", [16 + 8, 16 + 8 + 1, -1], ids=["value range flag", "value", "payload"])
def test_one_wrong_bit_in_the_vectors_fails_the_comparison(drive, offset: int, tmp_path: Path):
    # The first frame is an 8-byte SYNC: payload, range flag, values. The last byte belongs to the payload of a sent frame.
    folder, program = drive
    content = bytearray((folder / "vectors.bin").read_bytes())
    content[offset] ^= 1
    wrong = tmp_path / "wrong.bin"
    wrong.write_bytes(content)
    done = subprocess.run([program, wrong], capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert "not " in done.stdout


def test_vectors_of_another_network_are_rejected(drive, tmp_path: Path):
    folder, program = drive
    content = bytearray((folder / "vectors.bin").read_bytes())
    content[8] ^= 1
    (tmp_path / "other.bin").write_bytes(content)
    done = subprocess.run([program, tmp_path / "other.bin"], capture_output=True, text=True, check=False)
    assert (done.returncode, "another network" in done.stdout) == (2, True)


def test_wrong_factor_in_c_fails_the_comparison(tmp_path: Path):
    """One factor in the C code differs from the DBC in its ninth digit."""
    build = Build.of(DBC_FILE, "LEFT_SK")
    write(build, tmp_path, 0)
    code = tmp_path / "atalante.c"
    factor = "4.7936899621426287e-05"
    assert factor in code.read_text()
    code.write_text(code.read_text().replace(factor, "4.7936899721426287e-05"))
    program = compile_host_test(build, tmp_path)
    with pytest.raises(Failed, match="test_left_sk_state"):
        run_host_test(build, program, 100, seed=0)
    # These vectors do not fit the pipe to the program, which ends at the first difference.
    with pytest.raises(Failed, match="test_left_sk_state"):
        run_host_test(build, program, IMAGES, seed=0)


def test_half_steps_are_rounded_to_the_even_code(tmp_path: Path):
    build = Build.of(DBC_FILE, "PENDANT")
    write(build, tmp_path, 0)
    run_host_test(build, compile_host_test(build, tmp_path), 4, seed=0)
    code = tmp_path / "atalante.c"
    code.write_text(code.read_text().replace("nearbyint(", "round("))
    with pytest.raises(Failed, match="image 3"):
        run_host_test(build, compile_host_test(build, tmp_path), 4, seed=0)


def test_compiler_warning_is_an_error(tmp_path: Path):
    build = Build.of(DBC_FILE, "PENDANT")
    write(build, tmp_path, 0)
    with (tmp_path / "atalante_e2e.c").open("a") as file:
        file.write("static int unused(void) { return 0; }\n")
    with pytest.raises(Failed, match="unused"):
        compile_host_test(build, tmp_path)


def test_command_writes_and_checks_the_messages_of_one_node(tmp_path: Path):
    arguments = ["dbc", "c-code", "-o", str(tmp_path), "--node", "left_sk", "--check", "--images", "500", "--json"]
    result = CliRunner().invoke(cli, arguments)
    assert result.exit_code == 0, result.output
    files, check = (json.loads(line) for line in result.stdout.splitlines())
    assert files["messages"] == [
        "SYNC_LEFT_LEG", "LEFT_SK_EMCY", "COMMAND_LEFT_LEG", "LEFT_SK_STATE", "LEFT_SK_STATUS",
    ]  # fmt: skip
    assert check == {"images": 500, "compared": 2500, "equal": True}
    header = (tmp_path / "atalante_e2e.h").read_text()
    assert "atalante_left_sk_state_protect" in header
    assert "atalante_left_sk_state_check" not in header
    assert "ATALANTE_LEFT_SK_STATE_TORQUE_INVALID (-32768)" in header
    assert f"{load().hash32:#010x}" in header
    # The Makefile needs no Python.
    (tmp_path / "host_test").unlink()
    made = subprocess.run(["make", "-s", "-C", tmp_path, "test"], capture_output=True, text=True, check=False)
    assert (made.returncode, made.stdout) == (0, "500 frames compared\n"), made.stderr


def test_range_check_of_a_node_covers_only_the_signals_that_it_receives(tmp_path: Path):
    torque = 'SG_ Torque : 80|16@1- (0.0125,0) [-409.58750000000003|409.58750000000003] "Nm" '
    text = DBC_FILE.read_text("cp1252")
    assert f"{torque}HAL" in text
    (tmp_path / "robot.dbc").write_text(text.replace(f"{torque}HAL", f"{torque}PENDANT"), "cp1252")
    build = Build.of(tmp_path / "robot.dbc", "PENDANT")
    write(build, tmp_path / "out", 0)
    run_host_test(build, compile_host_test(build, tmp_path / "out"), 100, seed=0)


def test_message_named_counters_compiles(tmp_path: Path):
    text = DBC_FILE.read_text("cp1252")
    (tmp_path / "robot.dbc").write_text(re.sub(r"\bPENDANT_STATUS\b", "COUNTERS", text), "cp1252")
    build = Build.of(tmp_path / "robot.dbc", "PENDANT")
    assert "COUNTERS" in [message.name for message in build.messages]
    write(build, tmp_path / "out", 0)
    compile_host_test(build, tmp_path / "out")


def test_node_without_messages_is_rejected(tmp_path: Path):
    text = DBC_FILE.read_text("cp1252")
    (tmp_path / "robot.dbc").write_text(text.replace("BU_: ", "BU_: SPARE ", 1), "cp1252")
    with pytest.raises(Failed, match="SPARE must have at least one message for the C code, got none"):
        Build.of(tmp_path / "robot.dbc", "SPARE")


def test_same_network_gives_the_same_bytes(tmp_path: Path):
    build = Build.of(DBC_FILE, "HAPTICS")
    first, second = ([path.read_bytes() for path in write(build, tmp_path / name, 0)] for name in "ab")
    assert first == second


def test_unknown_node_is_rejected_with_a_similar_name():
    with pytest.raises(click.UsageError, match="LEFT_SK"):
        Build.of(DBC_FILE, "LEFT_KS")


def test_missing_compiler_gives_the_install_command(whole, monkeypatch: pytest.MonkeyPatch):
    build, folder = whole
    monkeypatch.setenv("CC", "no-such-cc")
    with pytest.raises(Failed, match="apt-get install gcc"):
        compile_host_test(build, folder)


def test_json_vectors_equal_the_values_of_cantools(whole):
    """Cantools decodes the examples independently of the codec of this project."""
    _, folder = whole
    oracle = cantools.database.load_file(str(DBC_FILE), strict=False)
    vectors = json.loads((folder / "vectors.json").read_text())
    assert len(vectors) == 4 * len(load().messages)
    for vector in vectors:
        payload = bytes.fromhex(vector["payload"])
        decoded = oracle.decode_message(vector["id"], payload, decode_choices=False)
        assert vector["values"] == pytest.approx(decoded, rel=1e-12)
        crc = crc_hqx(vector["data_id"].to_bytes(2, "little"), crc_hqx(payload[2:], 0xFFFF))
        assert crc == int.from_bytes(payload[:2], "little")
    assert {v["in_range"] for v in vectors if v["what"] in ("minimum", "maximum", "random")} == {True}
    assert False in {v["in_range"] for v in vectors if v["what"] == "invalid codes"}


def test_crc_table_equals_binascii():
    assert crc_table() == [crc_hqx(bytes([byte]), 0) for byte in range(256)]


def test_random_payloads_have_codes_inside_and_outside_their_range(whole):
    """The comparison of the range checks needs payloads of both kinds."""
    from atalante_tools.dbc.vectors import Vectors

    build, _ = whole
    vectors = Vectors(build, 0)
    seen = np.zeros((2, len(build.messages)), bool)
    for _ in vectors.images(60):
        for row, inside in enumerate(vectors._in_range):
            seen[int(inside), row] = True
    assert seen[1].all()
    can_be_outside = [
        any((s.maximum - s.minimum) / s.factor + 1 < 2**s.length - 0.5 for s in m.signals) for m in build.messages
    ]
    assert (seen[0] == np.array(can_be_outside)).all()
    assert Codec(build.messages).size > 500

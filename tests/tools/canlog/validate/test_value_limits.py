"""Limits of wide fields and float fields, and codes for "no value", in the rules for payloads."""

from __future__ import annotations

import json
import struct
from pathlib import Path

import pytest
from click.testing import CliRunner

from atalante_tools.cli import cli

HEAD = 'VERSION ""\nNS_ :\nBS_:\nBU_: A B\n\n'


def findings(signal: str, payload: bytes, folder: Path, more: str = "") -> list[tuple[str, int]]:
    """Return rule and count of each finding about the values of a log with one frame of message 256.

    Args:
        signal: definition of signal S in the DBC, from the start bit to the range.
        payload: payload of the frame, 8 bytes.
        folder: folder for the DBC and the log.
        more: lines after the messages of the DBC.
    """
    dbc, log = folder / "a.dbc", folder / "a.log"
    dbc.write_text(f'{HEAD}BO_ 256 M: 8 A\n SG_ S : {signal} "" B\n\n{more}')
    log.write_text(f"(1.000000) can0 100#{payload.hex().upper()}\n")
    result = CliRunner().invoke(cli, ["validate", str(log), "--dbc", str(dbc), "--json"])
    assert result.exception is None or isinstance(result.exception, SystemExit), result.exception
    found = [json.loads(line) for line in result.stdout.splitlines()]
    return [(f["rule"], f["count"]) for f in found if f["rule"] in ("range", "value-table", "invalid-code")]


def word(code: int) -> bytes:
    return (code & 2**64 - 1).to_bytes(8, "little")


@pytest.mark.parametrize(
    ("code", "expected"), [(2**64 - 1, []), (2**64 - 2, [("range", 1)]), (1001, [("range", 1)]), (1000, [])]
)
def test_names_of_64_bit_codes_are_valid_outside_the_range(
    code: int, expected: list[tuple[str, int]], tmp_path: Path
) -> None:
    table = f'VAL_ 256 S {2**64 - 1} "SNA" ;\n'
    assert findings("0|64@1+ (1,0) [0|1000]", word(code), tmp_path, table) == expected


@pytest.mark.parametrize(("code", "expected"), [(2**64 - 1, []), (0, []), (7, [("value-table", 1)])])
def test_complete_table_of_a_64_bit_field_is_checked(
    code: int, expected: list[tuple[str, int]], tmp_path: Path
) -> None:
    table = f'VAL_ 256 S {2**64 - 1} "SNA" 0 "OFF" ;\n'
    assert findings("0|64@1+ (1,0) [0|0]", word(code), tmp_path, table) == expected


@pytest.mark.parametrize(
    ("signal", "code", "valid"),
    [
        ("0|64@1+ (1,0) [0|10000000000]", 10**10, True),
        ("0|64@1+ (1,0) [0|10000000000]", 10**10 + 1, False),
        ("0|64@1- (1,0) [0|10000000000]", -1, False),
        ("0|64@1- (1,0) [-5|10000000000]", -5, True),
        ("0|64@1+ (0.1,-0.3) [0|0.3]", 3, True),
        ("0|64@1+ (0.1,-0.3) [0|0.3]", 6, True),
        ("0|64@1+ (0.1,-0.3) [0|0.3]", 2, False),
        ("0|64@1+ (0.1,-0.3) [0|0.3]", 7, False),
        ("0|64@1+ (0.001,0) [0|1E15]", 10**18, True),
        ("0|64@1+ (1,0) [0|1000]", 2**63, False),
        ("0|64@1+ (1,0) [1|1E999]", 2**64 - 1, True),
        ("0|64@1+ (1,0) [1|1E999]", 0, False),
        ("0|64@1+ (1,0) [0|1000000000000000]", 10**15, True),
        ("0|64@1+ (1,0) [0|1000000000000000]", 10**15 + 1, False),
        ("0|64@1- (1,0) [-9007199254740991|0]", 1 - 2**53, True),
        ("0|64@1- (1,0) [-9007199254740991|0]", -(2**53), False),
        ("0|64@1+ (0.001,0) [0|1E13]", 10**16 + 1, False),
        ("0|64@1+ (0.1,-0.3) [0|1E14]", 10**15 + 3, True),
        ("0|64@1+ (0.1,-0.3) [0|1E14]", 10**15 + 4, False),
        ("0|64@1+ (1,0) [0|9007199254740993]", 2**53 + 1, True),
        ("0|64@1+ (1,0) [0|9007199254740993]", 2**53 + 2, False),
        ("0|64@1+ (-0.5,0) [-1000000000000000|0]", 2 * 10**15, True),
        ("0|64@1+ (-0.5,0) [-1000000000000000|0]", 2 * 10**15 + 1, False),
    ],
)
def test_64_bit_integer_is_checked_to_one_raw_code(signal: str, code: int, valid: bool, tmp_path: Path) -> None:
    assert findings(signal, word(code), tmp_path) == ([] if valid else [("range", 1)])


@pytest.mark.parametrize(
    ("limits", "form", "value", "valid"),
    [
        ("(1,0) [0|1E9]", "<fxxxx", -1.0, False),
        ("(1,0) [0|1E9]", "<fxxxx", -1e-30, False),
        ("(1,0) [0|1E9]", "<fxxxx", 0.0, True),
        ("(1,0) [0|0.1]", "<fxxxx", 0.1, True),
        ("(1,0) [0|0.1]", "<fxxxx", 0.10000001, False),
        ("(1,0) [-0.1|0]", "<fxxxx", -0.1, True),
        ("(0.1,-0.3) [-0.3|0]", "<fxxxx", 3.0, True),
        ("(-1,0) [-0.1|5]", "<fxxxx", 0.1, True),
        ("(1,0) [0|1E300]", "<fxxxx", float("inf"), False),
        ("(1,0) [0|1E9]", "<fxxxx", float("nan"), False),
        ("(1,0) [0|0.1]", "<exxxxxx", 0.1, True),
        ("(1,0) [0|0.3]", "<exxxxxx", 0.3, True),
        ("(1,0) [0|0.1]", "<exxxxxx", 0.1001, False),
        ("(1,0) [0|1E9]", "<exxxxxx", float("inf"), False),
        ("(1,0) [0|1E9]", "<d", -0.5, False),
        ("(1,0) [0|0.1]", "<d", 0.1, True),
        ("(1,0) [0|0.1]", "<d", 0.1001, False),
        ("(0.1,-0.3) [0|1]", "<d", 3.0, True),
        ("(0.1,-0.3) [-0.3|0]", "<d", 3.0, True),
    ],
)
def test_float_is_compared_with_the_limits_in_its_format(
    limits: str, form: str, value: float, valid: bool, tmp_path: Path
) -> None:
    bits, kind = {"e": (16, 1), "f": (32, 1), "d": (64, 2)}[form[1]]
    found = findings(f"0|{bits}@1- {limits}", struct.pack(form, value), tmp_path, f"SIG_VALTYPE_ 256 S : {kind};\n")
    assert found == ([] if valid else [("range", 1)])


INVALID = """BA_DEF_ SG_ "InvalidRaw" STRING ;
BA_DEF_DEF_ "InvalidRaw" "";
BA_ "InvalidRaw" SG_ 256 S "{code}";
"""


@pytest.mark.parametrize(
    ("signal", "code"),
    [
        ("0|8@1+ (1,0) [0|254]", 255),
        ("0|8@1+ (1,0) [0|254]", 9),
        ("0|8@1+ (1,0) [0|255]", 9),
        ("0|8@1- (1,0) [-100|100]", 0xFE),
        ("0|64@1+ (1,0) [0|1000]", 9),
        ("0|64@1+ (1,0) [0|1000]", 2**64 - 1),
    ],
)
def test_code_for_no_value_is_reported_once_inside_and_outside_the_range(
    signal: str, code: int, tmp_path: Path
) -> None:
    more = INVALID.format(code=code)
    assert findings(signal, word(code), tmp_path, more) == [("invalid-code", 1)]
    assert findings(signal, word(1), tmp_path, more) == []


def test_code_for_no_value_of_a_float_is_reported_inside_the_range(tmp_path: Path) -> None:
    payload = struct.pack("<fxxxx", 1.0)
    more = INVALID.format(code=0x3F800000) + "SIG_VALTYPE_ 256 S : 1;\n"
    assert findings("0|32@1- (1,0) [0|2]", payload, tmp_path, more) == [("invalid-code", 1)]


def test_code_for_no_value_is_not_reported_if_the_signal_is_not_selected(tmp_path: Path) -> None:
    more = INVALID.format(code=9)
    for selected, expected in ((1, [("invalid-code", 1)]), (2, [])):
        signal = f'0|8@1+ (1,0) [0|254] "" B\n SG_ S{selected} m{selected} : 8|8@1+ (1,0) [0|254]'
        multiplexed = signal.replace("0|8@1+", "16|2@1+", 1).replace("[0|254]", "[0|3]", 1)
        dbc = f'{HEAD}BO_ 256 M: 8 A\n SG_ X M : {multiplexed} "" B\n\n'
        dbc += more.replace(" S ", f" S{selected} ")
        (tmp_path / "a.dbc").write_text(dbc)
        (tmp_path / "a.log").write_text("(1.000000) can0 100#0009010000000000\n")
        result = CliRunner().invoke(
            cli, ["validate", str(tmp_path / "a.log"), "--dbc", str(tmp_path / "a.dbc"), "--json"]
        )
        found = [json.loads(line) for line in result.stdout.splitlines()]
        assert [(f["rule"], f["count"]) for f in found if f["rule"] == "invalid-code"] == expected

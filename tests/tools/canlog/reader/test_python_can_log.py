"""Reader of the logs of python-can: .asc logs with relative time stamps."""

from __future__ import annotations

import gzip
from pathlib import Path

import pytest

from atalante_tools.canlog.reader.log import open_log
from atalante_tools.canlog.reader.log_file import LogError

FRAMES = "".join(f" 0.0{number}0000 1  104             Rx   d 2 00 0{number}\n" for number in (1, 2, 3))


def asc(times: str, frames: str = FRAMES) -> str:
    return f"date Tue Nov 14 10:13:20.000 pm 2023\nbase hex{times}\ninternal events logged\n{frames}"


@pytest.mark.parametrize("name", ["a.asc", "a.asc.gz"])
@pytest.mark.parametrize("times", ["  timestamps relative", " TIMESTAMPS RELATIVE"])
def test_asc_log_with_relative_time_stamps_is_rejected_unless_it_is_empty(
    name: str, times: str, tmp_path: Path
) -> None:
    path = tmp_path / name
    compressed = gzip.compress if name.endswith(".gz") else bytes
    path.write_bytes(compressed(asc(times).encode()))
    sentence = r'a\.asc.* cannot be read as a \.asc log: the time stamps must be absolute, got "timestamps relative"'
    with pytest.raises(LogError, match=sentence):
        list(open_log(path).chunks())
    path.write_bytes(compressed(asc(times, "").encode()))
    empty = open_log(path)
    assert list(empty.chunks()) == []
    assert [remark.rule for remark in empty.remarks] == ["log-empty"]

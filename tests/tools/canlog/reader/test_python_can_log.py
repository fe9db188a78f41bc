"""Reader of the logs of python-can: .asc logs of other recorders, and damaged entries."""

from __future__ import annotations

import gzip
from pathlib import Path

import numpy as np
import pytest

from atalante_hal.wire.frame import FLAG_BRS, FLAG_FDF, ID_REMOTE, Frames
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


def read(path: Path, text: str) -> tuple[Frames, list[str]]:
    """Write a log, and return its frames and the rules of its remarks."""
    path.write_text(text)
    log = open_log(path)
    frames = np.concatenate([chunk.frames for chunk in log.chunks()])
    return frames, [remark.rule for remark in log.remarks]


@pytest.mark.parametrize("events", ["", "internal events logged\n", "no internal events logged\n"])
def test_first_frame_of_an_asc_log_is_read_with_and_without_events_line(events: str, tmp_path: Path) -> None:
    text = asc("  timestamps absolute").replace("internal events logged\n", events)
    frames, remarks = read(tmp_path / "a.asc", text)
    assert frames["data"][:, 1].tolist() == [1, 2, 3]
    assert not remarks


def test_requests_to_send_of_an_asc_log_are_no_frames(tmp_path: Path) -> None:
    sent = FRAMES.replace("Rx  ", "Tx  ")
    fd = " 0.040000 CANFD   1 {}  104  1 0 8  8 00 04 00 00 00 00 00 00  0 0 3000 0 0 0 0 0\n"
    requests = sent.replace("Tx  ", "TxRq") + fd.format("TxRq")
    frames, _ = read(tmp_path / "a.asc", asc("  timestamps absolute", requests + sent + fd.format("Tx")))
    assert frames["data"][:, 1].tolist() == [1, 2, 3, 4]


@pytest.mark.parametrize("name", ["", "Speed"])
@pytest.mark.parametrize(
    ("frame", "can_id", "length", "flags"),
    [
        ("0 0 2  2 00 01  240000  130        0 0 0 0 0 0", 0x104, 2, 0),
        ("0 0 2  0        240000  130       10 0 0 0 0 0", 0x104 | ID_REMOTE, 2, 0),
        ("0 0 2  2 00 01  240000  130     1000 0 0 0 0 0", 0x104, 2, FLAG_FDF),
        ("1 0 2  2 00 01  240000  130     3000 0 0 0 0 0", 0x104, 2, FLAG_FDF | FLAG_BRS),
        ("0 0 2  2 00 01", 0x104, 2, FLAG_FDF),
    ],
    ids=["classic", "remote", "FD", "FD with BRS", "FD without flags"],
)
def test_format_of_a_frame_on_a_can_fd_channel_comes_from_its_flags(
    name: str, frame: str, can_id: int, length: int, flags: int, tmp_path: Path
) -> None:
    frames, remarks = read(
        tmp_path / "a.asc", asc("  timestamps absolute", f" 0.010000 CANFD   1 Rx  104  {name} {frame}\n")
    )
    assert frames[["can_id", "len", "flags"]].tolist() == [(can_id, length, flags)]
    assert not remarks


@pytest.mark.parametrize("end", [" 0.040000 1  104             Rx   d 2 00 04\n", " 0.040000 1  104      "])
def test_all_frames_before_a_damaged_entry_are_read(end: str, tmp_path: Path) -> None:
    damaged = " 0.035000 1  1G4             Rx   d 2 00 00\n"
    frames, remarks = read(tmp_path / "a.asc", asc("  timestamps absolute", FRAMES + damaged + end))
    assert frames["data"][:, 1].tolist() == [1, 2, 3]
    assert remarks == ["log-truncated"]

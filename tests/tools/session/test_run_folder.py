"""Run folder: one run at a time, removed if empty, no figure of an incomplete recording."""

from __future__ import annotations

import errno
import json
from pathlib import Path

import pytest

from atalante_hal.telemetry.process import Recording
from atalante_tools.console.outcome import Failed
from atalante_tools.session.run_folder import Result, run_folder, write_summary

WALKED = Result("pinched", True, 1.97, 1.18, 2, 0.934, 0.99876, 0.5, 4697, 6.25, 90000, 0, 2, 0)


def test_a_second_run_in_the_same_folder_is_rejected(tmp_path: Path) -> None:
    out = tmp_path / "runs" / "demo"
    with run_folder(out):
        (out / "recording.mcap").touch()
        with pytest.raises(Failed, match=r"another run writes into .*/demo: .* --out"), run_folder(out):
            raise AssertionError("two runs are in one folder")
        assert (out / "recording.mcap").exists()
    with run_folder(out):
        pass
    assert [file.name for file in out.iterdir()] == ["recording.mcap"]


def test_a_new_empty_folder_is_removed_and_an_existing_one_kept(tmp_path: Path) -> None:
    for out in (tmp_path / "new", tmp_path / "old"):
        if out.name == "old":
            out.mkdir()
        with pytest.raises(ZeroDivisionError), run_folder(out):
            raise ZeroDivisionError
    assert [folder.name for folder in tmp_path.iterdir()] == ["old"]


def test_the_error_of_an_invalid_folder_contains_its_path(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(OSError, match="file") as refused, run_folder(tmp_path / "file" / "run"):
        raise AssertionError("there is no such folder")
    assert (refused.value.errno, refused.value.filename) == (errno.ENOTDIR, str(tmp_path / "file" / "run"))


@pytest.mark.parametrize("recording", [b"", b"\x89MCAP0\r\n" + b"\x07" * 100])
def test_an_incomplete_recording_gives_a_summary_but_no_figure(
    recording: bytes, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "recording.mcap").write_bytes(recording)
    write_summary(tmp_path, {"steps": 2}, [WALKED], Recording(("recording.mcap", "recording-1.mcap"), False, 7))
    printed = capsys.readouterr().err.splitlines()
    assert printed[0].startswith("no figure: recording.mcap is incomplete")
    assert printed[1] == f"in {tmp_path}: recording.mcap, recording-1.mcap, summary.json"
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert (summary["steps"], summary["shapes"][0]["shape"]) == (2, "pinched")
    files = ["recording.mcap", "recording-1.mcap"]
    assert summary["recording"] == {"files": files, "complete": False, "missing_cycles": 7}
    assert not (tmp_path / "guide_shapes.png").exists()

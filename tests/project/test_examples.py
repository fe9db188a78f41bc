"""Check that the programs in examples/ succeed and print what their docstrings describe."""

from __future__ import annotations

import ast
import itertools
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
EXAMPLES = sorted((ROOT / "examples").glob("*.py"))


def run(name: str) -> str:
    """Run an example from the root of the project; return what it prints on stdout."""
    done = subprocess.run([sys.executable, f"examples/{name}"], capture_output=True, text=True, cwd=ROOT, timeout=300)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.name)
def test_example_has_at_most_sixty_lines_and_a_complete_docstring(path: Path):
    text = path.read_text()
    assert len(text.splitlines()) <= 60
    docstring = ast.get_docstring(ast.parse(text)) or ""
    assert "Run it:" in docstring
    assert path.name in docstring
    assert "Prints" in docstring


def test_hold_pose_example_holds_until_the_program_ends():
    assert run("hold_pose.py").startswith("the program is ending [")  # not another reason for HOLD
    body = (ROOT / "examples" / "hold_pose.py").read_text().split('"""', 2)[2]
    assert sum(bool(line.strip()) for line in body.splitlines()) <= 20


def test_own_bus_example_counts_frames_in_both_directions():
    (line,) = (line for line in run("own_bus.py").splitlines() if line.startswith("HOLD "))
    assert "SYNC_LEFT_LEG" in line


@pytest.mark.long
def test_own_guide_shape_example_is_certified_and_stays_in_its_guide():
    certificate, walk = run("own_guide_shape.py").splitlines()
    assert certificate.startswith("certified - ")
    assert walk.startswith("the program is ending")
    assert float(walk.split()[-1]) < 1.0


def test_lost_frames_example_passes(tmp_path: Path):
    test = ["-m", "pytest", "-n", "0", "-p", "no:cacheprovider", "examples/test_lost_frames.py"]
    done = subprocess.run([sys.executable, *test], capture_output=True, text=True, cwd=ROOT, timeout=300)
    assert "1 passed" in done.stdout, done.stdout


def test_subscriber_example_receives_joint_states_without_atalante_packages(tmp_path: Path):
    text = (ROOT / "examples" / "subscribe.py").read_text()
    assert not re.search(r"^\s*(import|from) atalante", text, re.MULTILINE)
    walk = [
        str(Path(sys.executable).with_name("atalante")),
        "airwalk",
        "--steps",
        "100",
        "--out",
        str(tmp_path / "run"),
    ]
    with subprocess.Popen(walk, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True) as hal:
        assert hal.stderr is not None
        try:
            listening = next(line for line in hal.stderr if "Zenoh at" in line)
            endpoint = re.search(r"tcp/127\.0\.0\.1:\d+", listening)
            assert endpoint
            command = [sys.executable, "-u", "examples/subscribe.py", endpoint[0]]
            with subprocess.Popen(command, stdout=subprocess.PIPE, cwd=ROOT, text=True) as subscriber:
                assert subscriber.stdout is not None
                lines = [subscriber.stdout.readline() for _ in range(20)]
                subscriber.kill()
        finally:
            hal.kill()
            hal.stderr.close()
    cycles = [int(line.split()[0]) for line in lines]
    # 100 Hz of robot time: every tenth cycle, in order.
    assert all(b - a == 10 for a, b in itertools.pairwise(cycles))
    assert "'left_SH'" in lines[0]
    assert lines[0].count(":") == 12

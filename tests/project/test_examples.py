"""Check that the programs in examples/ succeed and print what their docstrings describe."""

from __future__ import annotations

import ast
import itertools
import re
import select
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from atalante_hal.telemetry.publisher import Publisher
from atalante_hal.telemetry.schema import message_class

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


@pytest.mark.parametrize(
    ("name", "arguments", "sentence"),
    [
        ("hold_pose.py", ["socketcan"], "atalante: the arguments must be a CAN interface and a channel"),
        ("hold_pose.py", ["a", "b", "c"], "atalante: the arguments must be a CAN interface and a channel"),
        ("hold_pose.py", ["embedded", "x"], "atalante: the arguments must be a CAN interface and a channel"),
        ("hold_pose.py", ["pigeon", "vcan0"], "atalante: there is no CAN interface 'pigeon'; use one of"),
        ("hold_pose.py", ["socketcan", "a,b"], "atalante: a channel map with several channels must name the bus"),
        ("own_bus.py", ["socketcan"], "own_bus.py: error: unrecognized arguments: socketcan"),
        ("own_guide_shape.py", ["0.5"], "own_guide_shape.py: error: unrecognized arguments: 0.5"),
        ("subscribe.py", ["pigeon"], "subscribe.py: error: the endpoint must be like tcp/192.0.2.7:7447, got pigeon"),
        ("subscribe.py", ["tcp/127.0.0.1:7447", "x"], "subscribe.py: error: unrecognized arguments: x"),
    ],
)
def test_example_with_wrong_arguments_ends_with_one_sentence_and_exit_code_2(
    name: str, arguments: list[str], sentence: str
):
    command = [sys.executable, f"examples/{name}", *arguments]
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, timeout=300)
    assert (done.returncode, done.stdout) == (2, "")
    *usage, last = done.stderr.splitlines()
    assert last.startswith(sentence)
    assert all(line.startswith("usage: ") for line in usage)


def test_subscriber_example_outside_the_project_ends_with_one_sentence(tmp_path: Path):
    command = [sys.executable, ROOT / "examples" / "subscribe.py"]
    done = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, timeout=300)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.splitlines()[-1] == (
        "subscribe.py: error: the program must be started in the root of the project, "
        f"got {tmp_path} without atalante_hal/telemetry/messages.binpb"
    )


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


@contextmanager
def subscriber_example() -> Iterator[tuple[subprocess.Popen[str], Publisher]]:
    """Start the subscriber, reject its first connection, and then publish on the same endpoint until it prints a line."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        endpoint = f"tcp/127.0.0.1:{server.getsockname()[1]}"
        child = subprocess.Popen(
            [sys.executable, "examples/subscribe.py", endpoint],
            stdout=subprocess.PIPE, stderr=subprocess.PIPE, cwd=ROOT, text=True,
        )  # fmt: skip
        server.settimeout(60.0)
        server.accept()[0].close()
    with child:
        try:
            with Publisher("exo", [("joint_states", "JointStates")], endpoint) as publisher:
                publish_until(publisher, lambda: select.select([child.stdout], [], [], 0.02)[0])
                yield child, publisher
        finally:
            child.kill()


def publish_until(publisher: Publisher, condition: Callable[[], object]) -> None:
    """Publish joint states until the condition holds."""
    states = message_class("JointStates")(cycle=10, name=["left_FH"], position=[0.5]).SerializeToString()
    end = time.monotonic() + 60.0
    while not condition():
        assert time.monotonic() < end
        publisher.put("joint_states", states, 0, 10)


def test_subscriber_example_waits_for_the_hal_and_opens_no_udp_socket():
    with subscriber_example() as (child, _):
        assert child.stdout.readline() == "10 {'left_FH': 0.5}\n"
        opened = {str(descriptor.readlink()) for descriptor in Path(f"/proc/{child.pid}/fd").iterdir()}
        tables = [Path(f"/proc/net/{protocol}").read_text() for protocol in ("udp", "udp6")]
        udp = {f"socket:[{line.split()[9]}]" for table in tables for line in table.splitlines()[1:]}
        assert not opened & udp


def test_subscriber_example_ends_quietly_on_ctrl_c():
    with subscriber_example() as (child, _):
        child.send_signal(signal.SIGINT)
        _, errors = child.communicate(timeout=60)
    assert child.returncode == -signal.SIGINT
    assert errors == f"connecting to {child.args[-1]}\n"


def test_subscriber_example_ends_quietly_when_its_output_is_closed():
    with subscriber_example() as (child, publisher):
        child.stdout.close()
        publish_until(publisher, lambda: child.poll() is not None)
        errors = child.stderr.read()
    assert child.returncode == 0
    assert errors == f"connecting to {child.args[-1]}\n"

"""SIGINT and SIGTERM before the robot moves: at any time, no joint moves and the exit code is that of the signal."""

from __future__ import annotations

import json
import random
import signal
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import pytest

#: Program that runs a command and writes a line per HAL cycle: number, whether a signal had arrived, state, knee angle.
#: The program sends itself a signal at a given point. At the points "callback" and "except", an exception is discarded.
DRIVER = """
import ctypes, json, os, signal, sys
log, point, number, *arguments = sys.argv[1:]
number = int(number)
from atalante_tools.entry import main

arrived, wakeup = os.pipe()
os.set_blocking(arrived, False)
os.set_blocking(wakeup, False)
log = open(log, "w", buffering=1)
has_arrived = False

def send():
    os.kill(os.getpid(), number)

def send_in_callback():
    ctypes.CFUNCTYPE(None)(send)()

def send_in_except():
    try:
        send()
    except BaseException:
        pass

class At:  # an import
    def __init__(self, name, act):
        self.name, self.act = name, act

    def find_spec(self, name, path=None, target=None):
        if name == self.name:
            self.name = None
            self.act()

def watch_cycles():
    from atalante_hal.hal import Hal
    from atalante_hal.robot import JOINTS
    knee, read = JOINTS.index("left_SK"), Hal.read

    def read_and_log(hal):
        global has_arrived
        if point == f"cycle {hal.state.cycle + 1}":
            send()
        try:
            has_arrived |= bool(os.read(arrived, 64))
        except BlockingIOError:
            pass
        state = read(hal)
        log.write(json.dumps([state.cycle, has_arrived, state.supervisor.name, float(state.position[knee])]) + "\\n")
        return state

    Hal.read = read_and_log

sys.meta_path.insert(0, At("atalante_tools.commands.jog", lambda: signal.set_wakeup_fd(wakeup, warn_on_full_buffer=False)))
sys.meta_path.insert(0, At("atalante_tools.session.rig", watch_cycles))
kind, _, module = point.partition(" ")
acts = {"import": send, "callback": send_in_callback, "except": send_in_except}
if kind in acts:
    sys.meta_path.insert(0, At(module, acts[kind]))
sys.argv[1:] = arguments
main()
"""
#: Command that takes 100 s of robot time.
JOG = ("jog", "left_SK", "--to", "100", "--speed", "1", "--json")
SIGNALS = (signal.SIGINT, signal.SIGTERM)
#: Largest motion of a joint of a robot that is not driven [rad].
STILL = 0.02


@dataclass
class Cycle:
    number: int
    signalled: bool
    supervisor: str
    knee: float


class Run:
    """A command in a subprocess."""

    def __init__(self, folder: Path, *command: str, point: str = "", number: int = 0) -> None:
        self._log = folder / "cycles"
        self._process = subprocess.Popen(
            [sys.executable, "-c", DRIVER, str(self._log), point, str(int(number)), *command],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )

    def wait_for_handler(self) -> None:
        """Wait until the program has installed its SIGTERM handler."""
        status = Path(f"/proc/{self._process.pid}/status")
        while True:
            caught = next(line for line in status.read_text().splitlines() if line.startswith("SigCgt:"))
            if int(caught.split()[1], 16) >> (signal.SIGTERM - 1) & 1:
                return
            assert self._process.poll() is None
            time.sleep(0.001)

    def send(self, number: int) -> None:
        self._process.send_signal(number)

    def end(self) -> tuple[int, str, str, list[Cycle]]:
        """Wait for the end; return exit code, stdout, stderr and cycles."""
        try:
            out, err = self._process.communicate(timeout=120)
        finally:
            self._process.kill()  # no effect if the process has ended
        lines = self._log.read_text().splitlines() if self._log.exists() else []
        return self._process.returncode, out, err, [Cycle(*json.loads(line)) for line in lines]


def assert_never_started(run: Run, number: int) -> list[Cycle]:
    """Assert the exit code of the signal and that the robot was never ACTIVE; return the cycles."""
    code, out, err, cycles = run.end()
    assert code == 128 + number, err
    assert out == ""
    assert "Traceback" not in err
    assert "Exception ignored" not in err
    assert {cycle.supervisor for cycle in cycles} <= {"OFF", "READY"}
    assert all(abs(cycle.knee - cycles[-1].knee) < STILL for cycle in cycles[20:])
    return cycles


@pytest.mark.sample(4)
@pytest.mark.parametrize(
    ("point", "number"),
    [
        ("import click", signal.SIGINT),
        ("import atalante_tools.commands.jog", signal.SIGTERM),
        ("import pybullet", signal.SIGINT),
        ("callback atalante_tools.session.pose_hold", signal.SIGINT),
        ("callback numba", signal.SIGTERM),
        ("callback pybullet", signal.SIGINT),
        ("except atalante_tools.session.rig", signal.SIGTERM),
    ],
)
def test_signal_before_the_first_cycle_ends_the_command(point: str, number: int, tmp_path: Path) -> None:
    assert assert_never_started(Run(tmp_path, *JOG, point=point, number=number), number) == []


@pytest.mark.parametrize("number", SIGNALS)
@pytest.mark.sample(2)
def test_signal_in_the_cycle_before_active_prevents_the_start(
    number: signal.Signals, first_active: int, tmp_path: Path
) -> None:
    run = Run(tmp_path, *JOG, point=f"cycle {first_active}", number=number)
    cycles = assert_never_started(run, number)
    assert cycles[first_active - 2].supervisor == "READY"


@pytest.fixture(scope="module")
def first_active(tmp_path_factory: pytest.TempPathFactory) -> int:
    """Return the number of the first ACTIVE cycle of a run without a signal."""
    code, _, err, cycles = Run(tmp_path_factory.mktemp("jog"), "jog", "left_SK", "--to", "1", "--json").end()
    assert code == 0, err
    return next(cycle.number for cycle in cycles if cycle.supervisor == "ACTIVE")


@pytest.mark.parametrize("number", SIGNALS)
def test_signal_before_ready_ends_the_command(number: signal.Signals, tmp_path: Path) -> None:
    cycles = assert_never_started(Run(tmp_path, *JOG, point="cycle 5", number=number), number)
    assert {cycle.supervisor for cycle in cycles} == {"OFF"}


@pytest.mark.sample(3)
@pytest.mark.parametrize(
    "command",
    [
        ("vibrate", "left_thigh_front", "0.5", "--for", "100"),
        ("airwalk", "--steps", "1000", "--out", "run"),
        ("demo", "--steps", "1000", "--out", "run"),
    ],
    ids=lambda command: command[0],
)
def test_signal_lost_in_a_callback_ends_every_driving_command(
    command: tuple[str, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    run = Run(tmp_path, *command, point="callback numba", number=signal.SIGINT)
    assert assert_never_started(run, signal.SIGINT) == []
    assert not (tmp_path / "run").exists()


@pytest.mark.sample(5)
@pytest.mark.parametrize("seed", range(10))
def test_no_cycle_is_active_after_a_signal_at_a_random_time(seed: int, tmp_path: Path) -> None:
    rng = random.Random(seed)
    number, delay = rng.choice(SIGNALS), rng.uniform(0.0, 3.0)
    run = Run(tmp_path, *JOG)
    run.wait_for_handler()
    time.sleep(delay)  # the assertions hold whatever the program has reached by then
    run.send(number)
    code, out, err, cycles = run.end()
    assert code == 128 + number, err
    assert out == ""
    assert "Traceback" not in err
    assert not [cycle for cycle in cycles if cycle.signalled and cycle.supervisor == "ACTIVE"]
    if "ACTIVE" in {cycle.supervisor for cycle in cycles}:
        assert cycles[-1].supervisor == "HOLD"
        assert err.endswith("stopped, the robot is in HOLD\n")
    else:
        assert all(abs(cycle.knee - cycles[-1].knee) < STILL for cycle in cycles[20:])

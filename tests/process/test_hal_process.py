"""HAL in a subprocess that is killed, stopped or paused (F41, F42, F43).

The test emulates the robot at the other end of a bus in shared memory. Without the HAL, the drives hold their position.

The wall clock of the HAL is a number in shared memory that the test advances: a stopped process misses exactly the given
milliseconds, independent of the load of the machine.
"""

from __future__ import annotations

import gc
import json
import mmap
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import atalante_dbc
from atalante_emulator.bodies.pybullet_body import PyBulletBody
from atalante_emulator.drive import WATCHDOG
from atalante_emulator.emulator import Emulator
from atalante_emulator.pendant import Operator
from atalante_hal.bus import BusDown
from atalante_hal.bus.shared import SharedBus, descriptors
from atalante_hal.loop import GAP_TO_HOLD, WallClock, run
from atalante_hal.memory import anonymous_file
from atalante_hal.robot import Robot, load_robot
from atalante_hal.safety.direction import pose_gains
from atalante_hal.types import PERIOD, Command, State, SupervisorState
from atalante_hal.wire.cia402 import DriveState

ROBOT = load_robot()
#: Program that loads all modules once. For each line `memory bell`, a child drives the robot on this bus until SIGTERM.
DRIVER = """
import json, mmap, os, signal, sys, time
import atalante_dbc
from atalante_control.airwalk.controller import AirwalkController
from atalante_control.gait.gait import AIRWALK_GAIT, load_gait
from atalante_control.guide.shapes import SHAPES
from atalante_hal.bus.shared import SharedBus
from atalante_hal.hal import Hal
from atalante_hal.loop import LockStep, WallClock, run
from atalante_hal.robot import load_robot

network, robot = atalante_dbc.load(), load_robot()
controller = AirwalkController(robot, load_gait(AIRWALK_GAIT, robot), SHAPES["constant"])
signal.signal(signal.SIGCHLD, signal.SIG_IGN)
wall = None if sys.argv[1] == "-1" else memoryview(mmap.mmap(int(sys.argv[1]), 8)).cast("d")

class Time:
    def now(self):
        self.last = wall[0]
        return self.last

    def sleep(self, seconds):  # counted from the last read of the clock, which may have advanced since
        while wall[0] < self.last + seconds - 1e-9:
            if os.getppid() == 1:  # the test was killed, and the clock stands still
                os._exit(1)
            time.sleep(1e-4)

def drive(memory, bell):
    over = []
    signal.signal(signal.SIGTERM, lambda *_: over.append(1))
    bus = SharedBus("shared", memory, bell, 0)
    bus.patience = 30.0 if wall is None else 0.0
    time_source = Time()
    clock = LockStep() if wall is None else WallClock(now=time_source.now, sleep=time_source.sleep)
    hal = Hal(network, robot, bus, patience=2.0, controller_fields=controller.telemetry_fields)
    at_end = []
    def until(state):
        at_end[:] = [state.supervisor.name]
        return bool(over)
    run(hal, controller, clock, until=until)
    print(json.dumps({"state": at_end[0], "events": [[e.code, e.cycle, e.value] for e in hal.events]}), flush=True)

print("ready", flush=True)
for line in sys.stdin:
    memory, bell = map(int, line.split())
    if not (child := os.fork()):
        drive(memory, bell)
        os._exit(0)
    os.close(memory)
    os.close(bell)
    print(child, flush=True)
"""


class Driver:
    """The process that starts HALs, one for each of the given number of buses."""

    def __init__(self, buses: int, wall: int) -> None:
        self._pairs = [descriptors() for _ in range(buses)]
        fds = [fd for memory, ours, _ in self._pairs for fd in (memory, ours)]
        self._process = subprocess.Popen(
            [sys.executable, "-c", DRIVER, str(wall)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            bufsize=1,
            pass_fds=[*fds, wall][: len(fds) + (wall >= 0)],
        )
        assert self.read_line() == "ready"

    def read_line(self) -> str:
        assert self._process.stdout is not None
        return self._process.stdout.readline().strip()

    def start(self) -> tuple[int, SharedBus]:
        """Start a HAL that drives the robot; return the process id of the HAL, and the robot's end of the bus."""
        memory, ours, theirs = self._pairs.pop(0)
        bus = SharedBus("the robot's bus", os.dup(memory), theirs, 1)
        assert self._process.stdin is not None
        self._process.stdin.write(f"{memory} {ours}\n")
        pid = int(self.read_line())
        os.close(memory)
        os.close(ours)
        return pid, bus

    def close(self) -> None:
        for pair in self._pairs:
            for fd in pair:
                os.close(fd)
        self._process.kill()
        for pipe in (self._process.stdin, self._process.stdout):
            assert pipe is not None
            pipe.close()
        self._process.wait()


@contextmanager
def driver(buses: int = 1, wall: int = -1) -> Iterator[Driver]:
    """Yield a driver of HALs in lock-step, or on the clock in the memory of the descriptor `wall`."""
    made = Driver(buses, wall)
    try:
        yield made
    finally:
        made.close()


@contextmanager
def robot_on(bus: SharedBus, robot: Robot, urdf_text: str) -> Iterator[Emulator]:
    body = PyBulletBody(urdf_text)
    try:
        yield Emulator(atalante_dbc.load(), robot, body, bus, operator=Listener())
    finally:
        body.close()
        bus.close()


class Listener(Operator):
    """Operator that keeps the HAL state from SYNC, and presses START after 5 cycles."""

    REACTION = 5
    hal_state = SupervisorState.OFF

    def receive(self, hal_state: int) -> None:
        self.hal_state = SupervisorState(hal_state)
        super().receive(hal_state)


def enabled(emulator: Emulator) -> bool:
    return set(emulator.drives.state) == {DriveState.OPERATION_ENABLED}


@pytest.mark.sample(2)
@pytest.mark.parametrize(
    "phases", [range(0, 20, 5), [phase for phase in range(20) if phase % 5]], ids=["four", "others"]
)
def test_f41_every_drive_holds_within_five_cycles_of_a_killed_hal(
    phases: Sequence[int], robot: Robot, urdf_text: str
) -> None:
    with driver(buses=len(phases)) as hals:
        for phase in phases:
            pid, bus = hals.start()
            with robot_on(bus, robot, urdf_text) as emulator:
                _kill_in_the_air(emulator, bus, pid, cycles=40 * phase + 1)
                moving_at = emulator.body.velocity.copy()
                for _ in range(WATCHDOG):
                    assert enabled(emulator), phase
                    emulator.run_without_sync()  # a millisecond without SYNC
                assert set(emulator.drives.state) == {DriveState.QUICK_STOP_ACTIVE}, phase
                assert all(emulator.drives.latched), phase
                held = emulator.body.position.copy()
                for _ in range(300):
                    emulator.idle()
                assert set(emulator.drives.state) == {DriveState.QUICK_STOP_ACTIVE}, phase
                # No joint sags: it moves only by its stopping distance.
                assert (abs(emulator.body.position - held) < 0.02 + 0.05 * abs(moving_at)).all(), phase
                assert abs(emulator.body.velocity).max() < 0.1, phase


def _kill_in_the_air(emulator: Emulator, bus: SharedBus, pid: int, cycles: int) -> None:
    """Drive for a number of cycles after the drives are enabled, then send SIGKILL to the HAL."""
    counted = 0

    def step() -> None:
        nonlocal counted
        emulator.poll()
        counted += enabled(emulator)
        if counted == cycles:
            os.kill(pid, signal.SIGKILL)

    with suppress(BusDown):
        bus.serve(step)
    assert counted >= cycles


class SteppedTime:
    """The robot and the clock of the HAL, advanced by the test."""

    def __init__(self, emulator: Emulator, clock: memoryview) -> None:
        self.emulator, self._clock = emulator, clock

    def millisecond(self) -> None:
        """Run one cycle of HAL and robot."""
        self._clock[0] += 1e-3
        assert self.synced(60.0), "the HAL sent no SYNC"

    def synced(self, timeout: float) -> bool:
        """Process the commands of the previous cycle and answer the next SYNC; return whether the SYNC was received."""
        give_up = time.monotonic() + timeout
        while time.monotonic() < give_up:
            if self.emulator.poll(give_up - time.monotonic()):
                return True
        return False

    def without_hal(self, milliseconds: int) -> None:
        """Advance the time while the HAL is stopped."""
        self._clock[0] += milliseconds * 1e-3
        for _ in range(milliseconds):
            self.emulator.run_without_sync()


@pytest.mark.sample(3)
@pytest.mark.parametrize("milliseconds", [3, 20, 2000])
def test_f42_stopped_hal_sends_no_burst_and_holds_after_five_milliseconds(
    milliseconds: int, robot: Robot, urdf_text: str
) -> None:
    wall = anonymous_file("clock", 8)
    clock = memoryview(mmap.mmap(wall, 8)).cast("d")
    with driver(wall=wall) as hals:
        pid, bus = hals.start()
        with robot_on(bus, robot, urdf_text) as emulator:
            operator, time_ = emulator.operator, SteppedTime(emulator, clock)
            assert isinstance(operator, Listener)
            while operator.hal_state is not SupervisorState.ACTIVE:
                time_.millisecond()
            for _ in range(50):
                time_.millisecond()
            os.kill(pid, signal.SIGSTOP)
            _wait_until_stopped(pid)
            time_.without_hal(milliseconds)
            holds = milliseconds >= WATCHDOG
            assert set(emulator.drives.state) == {
                DriveState.QUICK_STOP_ACTIVE if holds else DriveState.OPERATION_ENABLED
            }
            os.kill(pid, signal.SIGCONT)
            # The HAL runs the cycle that is due and waits for the next one; missed cycles are not repeated.
            assert time_.synced(60.0)
            assert not time_.synced(0.2)
            for _ in range(50):
                time_.millisecond()
            assert operator.hal_state is (SupervisorState.HOLD if holds else SupervisorState.ACTIVE)
            assert enabled(emulator) is not holds
            os.kill(pid, signal.SIGTERM)
            with suppress(BusDown):
                while True:
                    time_.millisecond()
        result = json.loads(hals.read_line())
    gaps = [value for code, _, value in result["events"] if code == "CYCLE_GAP"]
    # The HAL was stopped a millisecond before its next deadline.
    assert gaps == [pytest.approx((milliseconds - 1) * 1e-3)]
    os.close(wall)


def _wait_until_stopped(pid: int) -> None:
    while Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "T":
        time.sleep(0.001)


class PausingController:
    """Hold the pose; call `pause` once, in the twentieth update."""

    telemetry, telemetry_fields = np.zeros(0), ()

    def __init__(self, pause: Callable[[], None]) -> None:
        self._pause, self.updates = pause, 0

    def reset(self, state: State) -> None:
        self._pose = state.position.copy()

    def update(self, state: State) -> Command:
        self.updates += 1
        if self.updates == 20:
            self._pause()
        stiffness, damping = pose_gains(ROBOT)
        return Command(stiffness * (self._pose - state.position) - damping * state.velocity, np.zeros(8))


class PausedTime:
    """Monotonic time [s] that advances only in a sleep of the loop and in a pause, independent of the load of the machine."""

    def __init__(self) -> None:
        self.now = 0.0
        self.longest = 0.0  # s, longest advance

    def advance(self, seconds: float) -> None:
        self.now += seconds
        self.longest = max(self.longest, seconds)

    def collect_garbage(self) -> None:
        """Collect garbage for at least 10 ms, and advance by the duration of the collection."""
        many = [[number] for number in range(400_000)]
        begun = time.perf_counter()
        while time.perf_counter() < begun + 0.01:
            gc.collect()
        many.clear()
        self.advance(time.perf_counter() - begun)


@pytest.mark.parametrize(
    ("pause", "state"),
    [
        (lambda paused: paused.advance(0.004), SupervisorState.ACTIVE),
        (lambda paused: paused.advance(0.0075), SupervisorState.HOLD),
        (PausedTime.collect_garbage, SupervisorState.HOLD),
    ],
    ids=["4 ms", "7.5 ms", "garbage collection"],
)
def test_f43_pause_over_five_milliseconds_ends_in_hold_and_shorter_is_reported(
    make_rig: Callable[..., Any], pause: Callable[[PausedTime], None], state: SupervisorState
) -> None:
    rig, paused, states = make_rig(), PausedTime(), list[SupervisorState]()
    rig.until(SupervisorState.READY)
    controller = PausingController(lambda: pause(paused))
    rig.operator.start()

    def until(after: State) -> bool:
        states.append(after.supervisor)
        assert len(states) < 1000, f"expected the pause within 1000 cycles, got {controller.updates} updates"
        return states[-1] is SupervisorState.HOLD or controller.updates > 70

    clock = WallClock(now=lambda: paused.now, sleep=paused.advance)
    statistics = run(rig.hal, controller, clock, until=until)
    (gap,) = (event.value for event in rig.hal.events if event.code == "CYCLE_GAP")
    assert statistics.overruns == 1
    assert (states[-1], gap > GAP_TO_HOLD) == (state, state is SupervisorState.HOLD)
    assert gap == pytest.approx(paused.longest - PERIOD)

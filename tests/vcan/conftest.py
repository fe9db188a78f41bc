"""Real SocketCAN for the tests in this folder: `make test-vcan`, or `pytest tests/vcan` where vcan0 is up.

Nothing here skips: these tests are run where SocketCAN was promised, so a missing interface is a failure that says what
to type.
"""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Self

import pytest

from atalante_hal.bus import BusAbsent
from atalante_hal.bus.socketcan import SocketCanBus, require_channel
from atalante_hal.hal import Hal
from atalante_hal.types import SupervisorState
from atalante_hal.wire.frame import FLAG_BRS, FLAG_FDF, new_frames
from atalante_tools.session.pose_hold import PoseHold

#: Ends a candump log: an identifier the robot's network does not use.
END_ID = 0x7FF
#: Longest wait for another process or thread [s]; a guest without KVM needs more.
PATIENCE = float(os.environ.get("ATALANTE_VCAN_PATIENCE", "20"))


@pytest.fixture(scope="session")
def vcan() -> str:
    """Name of a virtual CAN FD interface that is up."""
    channel = os.environ.get("ATALANTE_VCAN", "vcan0")
    try:
        require_channel(channel)
    except BusAbsent as error:
        pytest.fail(
            f"these tests need SocketCAN: {error}; or type `make test-vcan`, which does all of it", pytrace=False
        )
    return channel


def as_root(*command: str) -> None:
    """Run a command that needs root; fails the test with what to type."""
    line = command if os.geteuid() == 0 else ("sudo", "-n", *command)
    try:
        subprocess.run(line, check=True, capture_output=True, text=True)
    except (OSError, subprocess.CalledProcessError) as error:
        reason = error.stderr if isinstance(error, subprocess.CalledProcessError) else error
        pytest.fail(f"this test needs root for `{' '.join(command)}`: {reason}", pytrace=False)


def create(channel: str) -> None:
    """Create a virtual CAN FD interface and set it up."""
    as_root("ip", "link", "add", channel, "type", "vcan")
    as_root("ip", "link", "set", channel, "mtu", "72", "txqueuelen", "1000", "up")


def remove(channel: str) -> None:
    """Remove a virtual interface, as unplugging removes the interface of an adapter."""
    as_root("ip", "link", "del", channel)


def present(channel: str) -> bool:
    """Return whether an interface exists."""
    return Path("/sys/class/net", channel).exists()


@pytest.fixture
def spare_vcan(vcan: str) -> Iterator[str]:
    """Name of a second interface, up, that the test may take down, clog, remove or reconfigure."""
    channel = "vcanspare"
    create(channel)
    yield channel
    if present(channel):
        remove(channel)


@contextmanager
def repeated(work: Callable[[], object]) -> Iterator[None]:
    """`work` again and again in a thread of its own."""
    over = threading.Event()

    def run() -> None:
        while not over.is_set():
            work()

    thread = threading.Thread(target=run)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()


class Loop:
    """A HAL and the pose it found, one cycle after the other; `each` is called at the end of every cycle."""

    def __init__(self, hal: Hal, each: Callable[[], object] = lambda: None) -> None:
        self._hal, self._each = hal, each
        self._controller = PoseHold(hal.robot)
        self._moved = False

    def cycles(self, count: int, wanted: SupervisorState | None = None) -> SupervisorState:
        """So many cycles, or up to the first one in a state."""
        hal = self._hal
        for _ in range(count):
            state = hal.read()
            if hal.moving:
                if not self._moved:
                    self._controller.reset(state)
                hal.write(self._controller.update(state))
            else:
                hal.hold()
            self._moved = hal.moving
            self._each()
            if state.supervisor is wanted:
                break
        return hal.state.supervisor


class Candump:
    """`candump -L` of can-utils writing every frame of a channel to a log: the second witness of what is on the wire.

    A context: entered, it listens; left, the log is complete. Leaving sends one frame with `END_ID`, which is not in the
    log.
    """

    def __init__(self, channel: str, log: Path) -> None:
        self.log = log
        self._channel = channel

    def __enter__(self) -> Self:
        if shutil.which("candump") is None:
            pytest.fail("candump is missing: type `apt-get install can-utils`", pytrace=False)
        listening = self._listeners()
        with self.log.open("wb") as output:
            command = ["candump", "-L", "-d", "-r", str(8 << 20), self._channel]
            self._process = subprocess.Popen(command, stdout=output, stderr=subprocess.STDOUT)
        self._wait(lambda: self._listeners() > listening)
        return self

    def __exit__(self, *_: object) -> None:
        try:
            end = new_frames(1)
            end["can_id"], end["flags"] = END_ID, FLAG_FDF | FLAG_BRS
            bus = SocketCanBus(self._channel)
            bus.send(end)
            bus.close()
            self._wait(lambda: f" {END_ID:03X}##" in self.log.read_text()[-200:])
        finally:
            self._process.send_signal(signal.SIGTERM)
            self._process.wait(PATIENCE)
        lines = self.log.read_text().splitlines(keepends=True)
        self.log.write_text("".join(line for line in lines if f" {END_ID:03X}##" not in line))

    def _listeners(self) -> int:
        """Sockets that receive everything from the channel."""
        table = Path("/proc/net/can/rcvlist_all").read_text()
        return sum(line.split()[:1] == [self._channel] for line in table.splitlines())

    def _wait(self, ready: Callable[[], bool]) -> None:
        deadline = time.monotonic() + PATIENCE
        while not ready():
            assert self._process.poll() is None, f"candump ended: {self.log.read_text()}"
            assert time.monotonic() < deadline, "candump is silent"
            time.sleep(0.01)


@pytest.fixture
def candump(vcan: str, tmp_path: Path) -> Candump:
    """`with candump: ...` records `vcan` to `candump.log`."""
    return Candump(vcan, tmp_path / "candump.log")

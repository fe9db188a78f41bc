"""Fixtures for the tests in this folder, which need SocketCAN: `make test-vcan`, or `pytest tests/vcan` if vcan0 is up.

No test is skipped. If an interface is missing, the tests fail, and the message contains the command to type.
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

from atalante_dbc import Network
from atalante_hal.bus import BusAbsent
from atalante_hal.bus.socketcan import SocketCanBus, require_channel
from atalante_hal.hal import Hal
from atalante_hal.robot import Robot
from atalante_hal.types import SupervisorState
from atalante_hal.wire.frame import FLAG_BRS, FLAG_FDF, new_frames
from atalante_tools.session.pose_hold import PoseHold
from tests.vcan.commands import load_commands

#: Identifier of the frame that marks the end of a candump log. The network of the robot does not use this identifier.
END_ID = 0x7FF
#: Receive buffer of candump [bytes]: a minute of frames, because a loaded machine may run candump late.
RECEIVE_BUFFER = 256 << 20
#: Longest wait for another process, thread or message [s]. Only a failing test waits this long.
PATIENCE = float(os.environ.get("ATALANTE_VCAN_PATIENCE", "60"))
#: Folder in which each guest kernel marks the tests that it runs (see run.sh); empty means that this process runs all tests.
CLAIMS = os.environ.get("ATALANTE_VCAN_CLAIMS", "")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Run the longest tests first, so that no guest kernel waits for another guest at the end."""
    items.sort(key=lambda item: "terminals" not in item.path.name)


def pytest_runtestloop(session: pytest.Session) -> bool | None:
    """Run the tests that no other guest kernel has claimed. A guest claims its next test before its present test ends."""
    if not CLAIMS or session.testsfailed or session.config.option.collectonly:
        return None

    def claimed(number: int) -> bool:
        try:
            Path(CLAIMS, str(number)).mkdir()
        except FileExistsError:
            return False
        return True

    mine = (item for number, item in enumerate(session.items) if claimed(number))
    item = next(mine, None)
    while item is not None:
        following = next(mine, None)
        item.config.hook.pytest_runtest_protocol(item=item, nextitem=following)
        if session.shouldfail:
            raise session.Failed(session.shouldfail)
        if session.shouldstop:
            raise session.Interrupted(session.shouldstop)
        item = following
    return True


@pytest.fixture(scope="session")
def vcan() -> str:
    """Return the name of a virtual CAN FD interface that is up."""
    channel = os.environ.get("ATALANTE_VCAN", "vcan0")
    try:
        require_channel(channel)
    except BusAbsent as error:
        pytest.fail(
            f"these tests need SocketCAN: {error}; or type `make test-vcan`, which creates the interface", pytrace=False
        )
    return channel


@pytest.fixture(scope="session")
def loaded_commands(vcan: str, network: Network, robot: Robot) -> None:
    """Load modules and machine code of the commands into this process, from which the terminals are forked."""
    load_commands(network, robot)


def as_root(*command: str) -> None:
    """Run a command as root. If it fails, the test fails with a message that contains the command."""
    line = command if os.geteuid() == 0 else ("sudo", "-n", *command)
    try:
        subprocess.run(line, check=True, capture_output=True, text=True)
    except (OSError, subprocess.CalledProcessError) as error:
        reason = error.stderr if isinstance(error, subprocess.CalledProcessError) else error
        pytest.fail(f"this test needs root for `{' '.join(command)}`: {reason}", pytrace=False)


def create(channel: str) -> None:
    """Create a virtual CAN FD interface and set it up."""
    as_root("ip", "link", "add", channel, "mtu", "72", "txqueuelen", "1000", "up", "type", "vcan")


def remove(channel: str) -> None:
    """Remove a virtual interface, as unplugging removes the interface of an adapter."""
    as_root("ip", "link", "del", channel)


def present(channel: str) -> bool:
    """Return whether an interface exists."""
    return Path("/sys/class/net", channel).exists()


@pytest.fixture
def spare_vcan(vcan: str) -> Iterator[str]:
    """Return the name of an interface that is up, and that the test may set down, disturb, remove or reconfigure."""
    channel = "vcanspare"
    create(channel)
    yield channel
    if present(channel):
        remove(channel)


@pytest.fixture
def four_vcans(vcan: str) -> Iterator[list[str]]:
    """Return the names of four interfaces that are up, one for each bus. The test may remove an interface and create it again."""
    channels = [f"vcanbus{number}" for number in range(4)]
    for channel in channels:
        create(channel)
    yield channels
    for channel in channels:
        if present(channel):
            remove(channel)


@pytest.fixture(scope="session")
def second_vcan(vcan: str) -> Iterator[str]:
    """Return the name of a second interface that stays up."""
    channel = "vcansecond"
    create(channel)
    yield channel
    remove(channel)


@contextmanager
def repeated(work: Callable[[], object]) -> Iterator[None]:
    """Call `work` repeatedly in another thread until the block ends."""
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
    """Loop of a HAL that holds its pose, run in steps by a test. `each` is called at the end of every cycle."""

    def __init__(self, hal: Hal, each: Callable[[], object] = lambda: None) -> None:
        self._hal, self._each = hal, each
        self._controller = PoseHold(hal.robot)
        self._moved = False

    def cycles(self, count: int, wanted: SupervisorState | None = None) -> SupervisorState:
        """Run `count` cycles, or fewer if the HAL reaches the state `wanted` earlier. Return the last state."""
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
    """Log of all frames on a channel, written by `candump -L` of can-utils, which is independent of this project.

    Inside the `with` block, candump records. After the block, the log is complete. At the end of the block, a frame with `END_ID`
    is sent, which is then removed from the log.
    """

    def __init__(self, channel: str, log: Path) -> None:
        self.log, self.channel = log, channel

    def __enter__(self) -> Self:
        if shutil.which("candump") is None:
            pytest.fail("candump is missing: type `apt-get install can-utils`", pytrace=False)
        listening = self.listeners()
        with self.log.open("wb") as output:
            command = ["candump", "-L", "-d", "-r", str(RECEIVE_BUFFER), self.channel]
            self._process = subprocess.Popen(command, stdout=output, stderr=subprocess.STDOUT)
        self._wait(lambda: self.listeners() > listening)
        return self

    def __exit__(self, *_: object) -> None:
        try:
            end = new_frames(1)
            end["can_id"], end["flags"] = END_ID, FLAG_FDF | FLAG_BRS
            bus = SocketCanBus(self.channel)
            bus.send(end)
            bus.close()
            self._wait(lambda: f" {END_ID:03X}##" in self._tail())
        finally:
            self._process.send_signal(signal.SIGTERM)
            self._process.wait(PATIENCE)
        lines = self.log.read_text().splitlines(keepends=True)
        self.log.write_text("".join(line for line in lines if f" {END_ID:03X}##" not in line))

    def _tail(self) -> str:
        with self.log.open("rb") as log:
            log.seek(max(0, self.log.stat().st_size - 200))
            return log.read().decode()

    def listeners(self) -> int:
        """Return the number of sockets that receive every frame of the channel."""
        table = Path("/proc/net/can/rcvlist_all").read_text()
        return sum(line.split()[:1] == [self.channel] for line in table.splitlines())

    def _wait(self, ready: Callable[[], bool]) -> None:
        deadline = time.monotonic() + PATIENCE
        while not ready():
            assert self._process.poll() is None, f"candump ended: {self.log.read_text()}"
            assert time.monotonic() < deadline, f"candump is silent after {self._tail()}"
            time.sleep(0.01)


@pytest.fixture
def candump(vcan: str, tmp_path: Path) -> Candump:
    """Return a recorder of the interface `vcan`, which writes `candump.log`."""
    return Candump(vcan, tmp_path / "candump.log")

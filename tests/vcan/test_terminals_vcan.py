"""The three terminals of the README on SocketCAN: in every order, killed, restarted and disconnected."""

from __future__ import annotations

import itertools
import random
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest

import atalante_dbc
from atalante_dbc import Network
from atalante_hal.bus.resilient import ResilientBus
from atalante_hal.bus.socketcan import SocketCanBus
from atalante_hal.types import SupervisorState
from atalante_hal.wire.frame import new_frames
from atalante_hal.wire.process_image import ReceiveImage
from tests.vcan.conftest import as_root, create, present, remove
from tests.vcan.terminal import Terminal, wait_until

S = SupervisorState
ROBOT, CONTROLLER, PENDANT = "robot", "controller", "pendant"
TERMINALS = (ROBOT, CONTROLLER, PENDANT)
#: Most cycles from the first one in which all three send until the robot is ACTIVE: two seconds of robot time.
ACTIVE_BY = 2000
SEEDS = (0, 1, 2, 5, 7)  # each kind of event once
#: Events, one for each seed. A terminal is killed and restarted, or the interface goes down and up, or it is removed and created.
EVENTS = (*TERMINALS, "down", "removed")


class Listener:
    """Socket that reads the HAL state and counts the cycles in which robot, controller and pendant all send."""

    def __init__(self, channel: str, network: Network) -> None:
        state = network.message("PENDANT_STATE")
        sync = next(m for m in network.sent_by("HAL") if m.bus == state.bus and m.name.startswith("SYNC_"))
        self._bus = ResilientBus(SocketCanBus(channel))
        self._frames = new_frames(256)
        self._sync = ReceiveImage([sync])
        self._hal_state = self._sync.codec.index(sync.name, "HalState")
        self._senders = {network.message("LEFT_SK_STATE").frame_id, state.frame_id}
        self._sync_id = sync.frame_id
        self._sent: set[int] = set()  # of the senders, since the last SYNC
        #: Consecutive cycles in which all three have sent.
        self.together = 0
        self.state = S.OFF

    def poll(self) -> SupervisorState:
        """Read all pending frames and return the state of the HAL in the last SYNC."""
        while count := self._bus.receive(self._frames):
            for index in range(count):
                frame = self._frames[index : index + 1]
                identifier = int(frame["can_id"][0])
                if identifier != self._sync_id:
                    self._sent.add(identifier)
                    continue
                self.together = self.together + 1 if self._senders <= self._sent else 0
                self._sent.clear()
                self._sync.new_cycle()
                self._sync.accept_each(frame.copy(), 1)
                self.state = SupervisorState(int(self._sync.values[self._hal_state]))
        return self.state

    def close(self) -> None:
        self._bus.close()


class Lab:
    """Three terminals on one interface."""

    def __init__(self, channel: str, folder: Path, network: Network) -> None:
        self.channel, self._folder = channel, folder
        self.listener = Listener(channel, network)
        self.terminals: dict[str, Terminal] = {}
        self._started = itertools.count()

    def start(self, name: str) -> None:
        """Type the command of the README."""
        bus = ("-i", "socketcan", "-c", self.channel)
        command = {
            ROBOT: ("emulator", *bus, "--no-operator", "--lockstep"),
            CONTROLLER: ("airwalk", *bus, "--steps", "1000", "--lockstep"),
            PENDANT: ("pendant", "start", *bus),
        }[name]
        ready = {
            ROBOT: "the emulated robot is on",
            CONTROLLER: "certified on the model",
            PENDANT: "the pendant is active",
        }
        log = self._folder / f"{next(self._started)}-{name}.log"
        self.terminals[name] = Terminal(log, *command)
        self.terminals[name].wait_for(ready[name])

    def wait_for(self, *states: SupervisorState) -> None:
        """Wait until the HAL is in one of some states."""
        wait_until(lambda: self.listener.poll() in states, lambda: f"{self.listener.state.name}: {self.texts()}")

    def restart(self, *, typed: bool) -> None:
        """Type start until the HAL is ACTIVE, again only after each refusal with a reason."""
        controller, pendant = self.terminals[CONTROLLER], self.terminals[PENDANT]
        while True:
            position = len(controller.text())
            if not typed:
                pendant.type("start")
            typed = False
            wait_until(
                lambda since=position: self.listener.poll() is S.ACTIVE or "START refused" in controller.text()[since:],
                self.texts,
            )
            if self.listener.state is S.ACTIVE:
                return

    def texts(self) -> str:
        """Return the output of all terminals."""
        return "\n".join(f"--- {name}\n{terminal.text()}" for name, terminal in self.terminals.items())

    def close(self) -> None:
        for name in (PENDANT, CONTROLLER, ROBOT):
            if name in self.terminals:
                self.terminals[name].end(signal.SIGKILL)
        self.listener.close()


@pytest.fixture
def lab(spare_vcan: str, tmp_path: Path, network: Network) -> Iterator[Lab]:
    """Lab without a running terminal."""
    terminals = Lab(spare_vcan, tmp_path, network)
    yield terminals
    terminals.close()


@pytest.fixture(scope="module")
def running_lab(vcan: str, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Lab]:
    """Lab whose terminals are started once, for all sequences."""
    channel = "vcanlab"
    create(channel)
    terminals = Lab(channel, tmp_path_factory.mktemp("lab"), atalante_dbc.load())
    for name in TERMINALS:
        terminals.start(name)
    yield terminals
    terminals.close()
    if present(channel):
        remove(channel)


@pytest.mark.parametrize("order", list(itertools.permutations(TERMINALS)), ids="-".join)
def test_every_order_of_the_three_terminals_becomes_active_within_two_seconds(lab: Lab, order: tuple[str, ...]) -> None:
    for name in order:
        lab.start(name)
    lab.wait_for(S.ACTIVE)
    assert lab.listener.together <= ACTIVE_BY
    assert lab.terminals[PENDANT].end() == 143
    lab.wait_for(S.HOLD)
    assert lab.terminals[CONTROLLER].end() == 143
    assert lab.terminals[ROBOT].end() == 143


@pytest.mark.parametrize("seed", SEEDS)
def test_the_others_continue_after_a_kill_a_restart_or_a_lost_link(running_lab: Lab, seed: int) -> None:
    lab, event = running_lab, random.Random(seed).choice(EVENTS)
    lab.wait_for(S.ACTIVE)
    positions = {name: len(terminal.text()) for name, terminal in lab.terminals.items()}
    if event in TERMINALS:
        _kill_and_restart(lab, event, positions)
    else:
        _lose_the_link(lab, event, positions)
    assert all(terminal.running for terminal in lab.terminals.values()), lab.texts()
    lab.restart(typed=event == PENDANT)  # a new pendant presses START without a typed command


def _kill_and_restart(lab: Lab, name: str, positions: dict[str, int]) -> None:
    assert lab.terminals[name].end(signal.SIGKILL) == -signal.SIGKILL
    if name == CONTROLLER:
        lab.terminals[PENDANT].wait_for("no SYNC received", positions[PENDANT])
    else:
        lab.terminals[CONTROLLER].wait_for("HOLD: ", positions[CONTROLLER])
        lab.wait_for(S.HOLD)
    lab.start(name)
    if name != PENDANT:
        lab.wait_for(S.READY, S.HOLD)


def _lose_the_link(lab: Lab, event: str, positions: dict[str, int]) -> None:
    if event == "down":
        as_root("ip", "link", "set", lab.channel, "down")
    else:
        remove(lab.channel)
    for name in (PENDANT, CONTROLLER):  # the kernel also reports "down" on the way to "removed"
        lab.terminals[name].wait_for(f"{lab.channel} is down", positions[name], f"{lab.channel} was removed")
    if event == "down":
        as_root("ip", "link", "set", lab.channel, "up")
    else:
        create(lab.channel)
    lab.terminals[PENDANT].wait_for("is back", positions[PENDANT])
    lab.wait_for(S.HOLD)

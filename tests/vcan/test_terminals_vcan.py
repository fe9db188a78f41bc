"""The three terminals of the README on SocketCAN: in every order, killed, restarted and disconnected."""

from __future__ import annotations

import itertools
import json
import random
import signal
import subprocess
from collections.abc import Iterator, Mapping
from pathlib import Path

import cantools
import e2e
import pytest

import atalante_dbc
from atalante_dbc import DBC_FILE, Network
from atalante_hal.bus.resilient import ResilientBus
from atalante_hal.bus.socketcan import SocketCanBus
from atalante_hal.types import SupervisorState
from atalante_hal.wire.frame import new_frames
from atalante_hal.wire.process_image import ReceiveImage
from atalante_tools.session.takeover import pendant_messages
from tests.vcan.conftest import PATIENCE, Candump, as_root, create, present, remove
from tests.vcan.terminal import Terminal, wait_until

S = SupervisorState
ROBOT, CONTROLLER, PENDANT = "robot", "controller", "pendant"
TERMINALS = (ROBOT, CONTROLLER, PENDANT)
#: Largest number of cycles from the first cycle in which all three terminals send until the robot is ACTIVE: 2 s of robot time.
ACTIVE_BY = 2000
#: Largest number of refused STARTs in a row. The HAL refuses START until it trusts all nodes again.
REFUSALS = 20
#: Longest wait for the end of a walk [s]. On two free CPUs it takes about 20 s.
WALK_PATIENCE = 10 * PATIENCE
#: Number of frames that canplayer replays: the receive buffers hold all of them.
REPLAYED = 3000
#: Seeds of the sequences of events.
SEEDS = range(20)
#: Number of different events in a sequence.
LENGTH = 2
#: Events: a terminal is killed and restarted, or the interface goes down and up, or it is removed and created.
EVENTS = (*TERMINALS, "down", "removed")
#: Terminal whose link is lost -> pattern of what the other terminals print. If the link is lost in the middle of a cycle, the
#: first answers of this cycle still arrive. So any node of the robot can be the first that times out.
MISSED = {
    ROBOT: {CONTROLLER: r"HOLD: \w+: a node timed out", PENDANT: "the HAL is HOLD"},
    CONTROLLER: {ROBOT: "no SYNC received: waiting for a HAL", PENDANT: "no SYNC received"},
    PENDANT: {
        ROBOT: "12 QUICK_STOP_ACTIVE",
        CONTROLLER: "HOLD: the dead-man switch was released or the pendant is lost",
    },
}


class Listener:
    """Socket that reads the HAL state and counts the cycles in which robot, controller and pendant all send."""

    def __init__(self, channel: str, network: Network) -> None:
        state, sync = pendant_messages(network)
        self._bus = ResilientBus(SocketCanBus(channel))
        self._frames = new_frames(256)
        self._sync = ReceiveImage([sync])
        self._hal_state = self._sync.codec.index(sync.name, "HalState")
        self._senders = {network.message("LEFT_SK_STATE").frame_id, state.frame_id}
        self._sync_id = sync.frame_id
        self._sent: set[int] = set()  # identifiers received since the last SYNC
        #: Number of consecutive cycles in which all three have sent.
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
    """Three terminals, each on an interface, and a listener on the interface of the controller.

    Args:
        channels: Interface of each terminal.
        folder: Folder for the output of the terminals.
        network: Nodes and messages of the DBC.
    """

    def __init__(self, channels: Mapping[str, str], folder: Path, network: Network) -> None:
        self.channels, self._folder = channels, folder
        self.listener = Listener(channels[CONTROLLER], network)
        self.terminals: dict[str, Terminal] = {}
        self._started = itertools.count()

    def start(self, name: str, *, steps: int = 1000) -> None:
        """Type the command of the README, with --lockstep because a guest kernel may have only one CPU."""
        bus = ("-i", "socketcan", "-c", self.channels[name])
        command = {
            ROBOT: ("emulator", *bus, "--no-operator", "--lockstep"),
            CONTROLLER: ("airwalk", *bus, "--steps", str(steps), "--lockstep"),
            PENDANT: ("pendant", "start", *bus),
        }[name]
        ready = {
            ROBOT: "the emulated robot is on",
            CONTROLLER: "telemetry on Zenoh",
            PENDANT: "the pendant is active",
        }
        log = self._folder / f"{next(self._started)}-{name}.log"
        self.terminals[name] = Terminal(log, *command)
        self.terminals[name].wait_for(ready[name])

    def wait_for(self, *states: SupervisorState) -> None:
        """Wait until the HAL is in one of the given states."""
        wait_until(lambda: self.listener.poll() in states, lambda: f"{self.listener.state.name}: {self.texts()}")

    def restart(self, *, typed: bool) -> None:
        """Type start until the HAL is ACTIVE. After each refused START, start is typed again.

        Args:
            typed: Whether a pendant already presses START, so that start is typed only after a refusal.
        """
        controller, pendant = self.terminals[CONTROLLER], self.terminals[PENDANT]
        for _ in range(REFUSALS):
            before = 0 if typed else len(pendant.text())
            if not typed:
                pendant.type("start")
            typed = False
            pendant.wait_for("START pressed", before)
            position = len(controller.text())  # a refusal of an earlier START is printed until the state changes
            wait_until(
                lambda since=position: self.listener.poll() is S.ACTIVE or "START refused" in controller.text()[since:],
                self.texts,
            )
            if self.listener.state is S.ACTIVE:
                return
        pytest.fail(f"START was refused {REFUSALS} times: {self.texts()}", pytrace=False)

    def texts(self) -> str:
        """Return the output of all terminals."""
        return "\n".join(f"--- {name}\n{terminal.text()}" for name, terminal in self.terminals.items())

    def close(self) -> None:
        for name in (PENDANT, CONTROLLER, ROBOT):
            if name in self.terminals:
                self.terminals[name].end(signal.SIGKILL)
        self.listener.close()


@pytest.fixture
def lab(loaded_commands: None, spare_vcan: str, tmp_path: Path, network: Network) -> Iterator[Lab]:
    """Return a lab without a running terminal."""
    terminals = Lab(dict.fromkeys(TERMINALS, spare_vcan), tmp_path, network)
    yield terminals
    terminals.close()


@pytest.fixture(scope="module")
def running_lab(loaded_commands: None, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Lab]:
    """Return a lab whose terminals are started once for all sequences of events."""
    channel = "vcanlab"
    create(channel)
    channels = dict.fromkeys(TERMINALS, channel)
    terminals = Lab(channels, tmp_path_factory.mktemp("lab"), atalante_dbc.load())
    try:
        for name in TERMINALS:
            terminals.start(name)
        yield terminals
    finally:
        terminals.close()
        if present(channel):
            remove(channel)


@pytest.fixture
def lab_with_own_links(loaded_commands: None, vcan: str, tmp_path: Path, network: Network) -> Iterator[Lab]:
    """Return a lab in which each terminal has its own interface. The kernel forwards every frame to the other interfaces."""
    channels = {name: f"vcan{name}" for name in TERMINALS}
    as_root("modprobe", "can-gw")
    for channel in channels.values():
        create(channel)
    for source, destination in itertools.permutations(channels.values(), 2):
        as_root("cangw", "-A", "-s", source, "-d", destination, "-X", "-e")
    terminals = Lab(channels, tmp_path, network)
    yield terminals
    terminals.close()
    for channel in channels.values():  # the kernel removes the forwarding rules together with the interface
        remove(channel)


def test_commands_of_the_readme_walk_a_step_with_valid_frames(lab: Lab, network: Network, tmp_path: Path) -> None:
    recorded = Candump(lab.channels[CONTROLLER], tmp_path / "candump.log")
    with recorded:
        lab.start(ROBOT)
        lab.start(CONTROLLER, steps=1)
        lab.start(PENDANT)
        wait_until(lambda: not lab.terminals[CONTROLLER].running, lab.texts, WALK_PATIENCE)
        assert lab.terminals[CONTROLLER].exit_code == 0, lab.texts()
        assert lab.terminals[PENDANT].end() == 143
        assert lab.terminals[ROBOT].end() == 143
    frames = _frames_of(recorded.log)
    _replay_live(recorded, tmp_path, first=_judge_independently(frames, network))


@pytest.mark.parametrize("order", list(itertools.permutations(TERMINALS)), ids="-".join)
def test_every_order_of_the_three_terminals_becomes_active_within_two_seconds(lab: Lab, order: tuple[str, ...]) -> None:
    for name in order:
        lab.start(name)
    lab.wait_for(S.ACTIVE)
    assert lab.listener.together <= ACTIVE_BY


@pytest.mark.parametrize("seed", SEEDS)
def test_the_others_continue_after_kills_restarts_and_lost_links_in_any_order(running_lab: Lab, seed: int) -> None:
    lab = running_lab
    for event in random.Random(seed).sample(EVENTS, LENGTH):
        lab.wait_for(S.ACTIVE)
        positions = {name: len(terminal.text()) for name, terminal in lab.terminals.items()}
        if event in TERMINALS:
            _kill_and_restart(lab, event, positions)
        else:
            _lose_the_link(lab, event, positions)
        assert all(terminal.running for terminal in lab.terminals.values()), lab.texts()
        lab.restart(typed=event == PENDANT)  # a new pendant presses START without a typed command


def test_each_terminal_alone_loses_its_link_and_the_others_continue(lab_with_own_links: Lab) -> None:
    lab = lab_with_own_links
    for name in TERMINALS:
        lab.start(name)
    for name, others in MISSED.items():
        lab.wait_for(S.ACTIVE)
        positions = {terminal: len(lab.terminals[terminal].text()) for terminal in TERMINALS}
        channel = lab.channels[name]
        as_root("ip", "link", "set", channel, "down")
        lab.terminals[name].wait_for(f"{channel} is down", positions[name])
        for other, pattern in others.items():
            lab.terminals[other].wait_for_pattern(pattern, positions[other])
        as_root("ip", "link", "set", channel, "up")
        lab.wait_for(S.HOLD)
        assert all(terminal.running for terminal in lab.terminals.values()), lab.texts()
        lab.restart(typed=False)


def _frames_of(log: Path) -> list[tuple[int, bytes]]:
    """Read identifier and payload of each CAN FD frame of a candump log."""
    split = (line.split()[2].split("##") for line in log.read_text().splitlines())
    return [(int(identifier, 16), bytes.fromhex(payload[1:])) for identifier, payload in split]


def _judge_independently(frames: list[tuple[int, bytes]], network: Network) -> int:
    """Check each frame with cantools and autosar-e2e: it decodes, its CRC is right and its counter is the next one.

    The counters of the HAL are checked in all frames, those of the pendant from the first SYNC with ACTIVE on, and those of all
    other nodes from the first SYNC with READY on. Before READY, the HAL waits only 0.1 s in lock-step for a node that it does not
    trust yet, and a node answers only the last of several SYNCs.

    Returns:
        Index of the first frame in ACTIVE. From there on, every node sends.
    """
    oracle = cantools.database.load_file(str(DBC_FILE))
    messages = {m.frame_id: m for m in network.messages}
    first: dict[str, int] = {}  # state of the HAL -> index of its first SYNC
    waits = {"HAL": S.OFF, "PENDANT": S.ACTIVE}
    counters: dict[int, int] = {}
    for index, (identifier, payload) in enumerate(frames):
        message = messages[identifier]
        assert len(payload) == oracle.get_message_by_frame_id(identifier).length
        values = oracle.decode_message(identifier, payload)
        assert e2e.p05.e2e_p05_check(payload, message.data_id), f"{identifier:X} {payload.hex()}"
        if "HalState" in values:
            first.setdefault(str(values["HalState"]), index)
        counter = payload[2]
        if waits.get(message.sender, S.READY).name in first:
            assert counter == (counters.get(identifier, counter - 1) + 1) % 256, f"{identifier:X} {payload.hex()}"
        counters[identifier] = counter
    assert len(frames) > 20_000
    assert {messages[identifier].name for identifier in counters} >= {
        *(m.name for m in network.messages if m.cycle_ms == 1),
        *(m.name for m in network.messages if m.name.endswith("_STATUS")),
    }
    return first[S.ACTIVE.name]


def _replay_live(recorded: Candump, folder: Path, first: int) -> None:
    """Replay a part of the log with canplayer, and check that `validate` and `status` report no error.

    Args:
        recorded: Log.
        folder: Folder for the part and the output of the commands.
        first: Index of the first replayed frame; from there on every node sends.
    """
    excerpt = folder / "excerpt.log"
    excerpt.write_text("".join(recorded.log.read_text().splitlines(keepends=True)[first : first + REPLAYED]))
    bus, others = ("-i", "socketcan", "-c", recorded.channel), recorded.listeners()
    validate = Terminal(folder / "validate.log", "validate", *bus, "--lockstep", "--for", "15")
    wait_until(lambda: recorded.listeners() == others + 1, validate.text)
    status = Terminal(folder / "status.log", "status", *bus, "--for", "10", "--json")
    wait_until(lambda: recorded.listeners() == others + 2, status.text)
    subprocess.run(["canplayer", "-t", "-I", str(excerpt)], check=True, timeout=PATIENCE)
    for terminal in (status, validate):
        wait_until(lambda ended=terminal: not ended.running, terminal.text)
        assert terminal.exit_code == 0, terminal.text()
    (report,) = [json.loads(line) for line in status.text().splitlines() if line.startswith("{")]
    assert (report["frames"], report["crc_errors"], report["foreign"], report["dropped"]) == (REPLAYED, 0, 0, 0)
    assert f"{REPLAYED} frames" in validate.text(), validate.text()


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
    channel = lab.channels[CONTROLLER]
    if event == "down":
        as_root("ip", "link", "set", channel, "down")
    else:
        remove(channel)
    for name in (PENDANT, CONTROLLER):  # the kernel also reports "down" on the way to "removed"
        lab.terminals[name].wait_for(f"{channel} is down", positions[name], f"{channel} was removed")
    if event == "down":
        as_root("ip", "link", "set", channel, "up")
    else:
        create(channel)
    lab.terminals[PENDANT].wait_for("is back", positions[PENDANT])
    lab.wait_for(S.HOLD)

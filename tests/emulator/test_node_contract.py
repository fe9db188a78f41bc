"""Check the frames of each of the twenty emulated nodes with cantools and AUTOSAR's E2E library, without the codec of the HAL."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import cantools
import e2e
import numpy as np
import pytest
from cantools.database.can import Database

import atalante_dbc
from atalante_dbc import DBC_FILE, Network
from atalante_emulator.bodies.pybullet_body import PyBulletBody
from atalante_emulator.emulator import Emulator
from atalante_emulator.faults import Fault
from atalante_emulator.pendant import Operator
from atalante_hal.bus.pair import lockstep_pair
from atalante_hal.robot import Robot
from atalante_hal.wire.frame import FLAG_BRS, FLAG_FDF, new_frames
from atalante_hal.wire.process_image import TransmitImage

NODES = [node.name for node in atalante_dbc.load().nodes if node.kind != "master"]
CYCLES = 260
HEARTBEAT = 100
EMERGENCY, RESET = 40, 40  # cycle in which the emergency begins, and cycle in which the reset begins
DURATION = 25  # duration of the emergency, and of the reset [cycles]


class SentFrame(NamedTuple):
    """A frame that a node sent."""

    cycle: int
    can_id: int
    length: int
    flags: int
    payload: bytes


Run = Callable[..., list[SentFrame]]


@pytest.fixture(scope="module")
def run(network: Network, robot: Robot, urdf_text: str) -> Run:
    runs: dict[tuple[Fault, ...], list[SentFrame]] = {}

    def record(*faults: Fault, cycles: int = CYCLES) -> list[SentFrame]:
        if faults in runs:
            return runs[faults]
        hal, nodes = lockstep_pair()
        body = PyBulletBody(urdf_text)
        emulator = Emulator(network, robot, body, nodes, operator=Operator(starts=False), faults=faults)
        hal.step = emulator.poll
        syncs = TransmitImage([m for m in network.sent_by("HAL") if m.name.startswith("SYNC_")])
        buffer, frames = new_frames(128), []
        for cycle in range(cycles):
            syncs.values[syncs.codec.slice("Cycle")] = cycle
            hal.send(syncs.seal())
            for frame in buffer[: hal.receive(buffer)]:
                length = int(frame["len"])
                frames.append(
                    SentFrame(
                        cycle, int(frame["can_id"]), length, int(frame["flags"]), frame["data"][:length].tobytes()
                    )
                )
        hal.close()
        body.close()
        runs[faults] = frames
        return frames

    return record


@pytest.fixture(scope="session")
def database() -> Database:
    database = cantools.database.load_file(DBC_FILE)
    assert isinstance(database, Database)
    return database


@pytest.mark.parametrize("node", NODES)
class TestNode:
    @pytest.fixture
    def of(self, node: str, network: Network) -> Callable[[list[SentFrame], str], list[SentFrame]]:
        def of(frames: list[SentFrame], kind: str) -> list[SentFrame]:
            return [s for s in frames if s.can_id == network.message(f"{node}_{kind}").frame_id]

        return of

    def test_sends_one_bootup_and_then_heartbeats_at_their_period(self, node: str, run: Run, of, database) -> None:
        status = of(run(), "STATUS")
        values = [database.decode_message(s.can_id, s.payload, decode_choices=False) for s in status]
        assert [s["NodeState"] for s in values] == [0, 5, 5][: len(values)]
        assert set(np.diff([s.cycle for s in status])) == {HEARTBEAT}
        assert {s["DbcHash"] for s in values} == {atalante_dbc.load().hash32}
        assert {s["ErrorFlags"] for s in values} == {0}

    def test_sends_one_state_frame_for_each_sync(self, node: str, run: Run, of, network: Network) -> None:
        states = of(run(), "STATE")
        period = network.message(f"{node}_STATE").cycle_ms
        assert [s.cycle for s in states] == list(range(0, CYCLES, period))
        if period == 1:
            assert [s.payload[2] for s in states] == [cycle & 0xFF for cycle in range(CYCLES)]

    def test_sends_no_emergency_without_a_fault(self, node: str, run: Run, of) -> None:
        assert of(run(), "EMCY") == []

    @pytest.mark.sample(3)
    def test_every_frame_has_valid_length_flags_e2e_and_ranges(
        self, node: str, run: Run, network: Network, database: Database
    ) -> None:
        own = {m.frame_id: m for m in network.sent_by(node)}
        faults = (Fault("emergency", node, EMERGENCY, DURATION, code=0x5000),)
        for frame in [*run(), *run(*faults)]:
            if frame.can_id not in own:
                continue
            message = own[frame.can_id]
            assert (frame.length, frame.flags) == (message.length, FLAG_FDF | FLAG_BRS)
            assert e2e.p05.e2e_p05_check(frame.payload, message.data_id)
            if frame.cycle % 10 and message.cycle_ms == 1:
                continue  # cantools is slow
            layout = database.get_message_by_frame_id(frame.can_id)
            values = layout.decode(frame.payload, decode_choices=False)
            for signal in layout.signals:
                if signal.minimum is not None:
                    assert signal.minimum <= values[signal.name] <= signal.maximum, signal.name

    def test_emergency_is_sent_once_when_an_error_begins_and_once_when_it_ends(
        self, node: str, run: Run, of, database: Database
    ) -> None:
        frames = run(Fault("emergency", node, EMERGENCY, DURATION, code=0x5000))
        emergencies = [(s.cycle, database.decode_message(s.can_id, s.payload)["ErrorCode"]) for s in of(frames, "EMCY")]
        assert emergencies == [(EMERGENCY, 0x5000), (EMERGENCY + DURATION, 0)]
        assert len(of(frames, "STATE")) == len(of(run(), "STATE"))

    @pytest.mark.sample(3)
    def test_sends_nothing_during_a_reset_and_one_bootup_after_it(
        self, node: str, run: Run, of, database: Database
    ) -> None:
        frames = run(Fault("reset", node, RESET, DURATION))
        own = [s for kind in ("STATE", "STATUS", "EMCY") for s in of(frames, kind)]
        assert not [s for s in own if RESET <= s.cycle < RESET + DURATION]
        boot = next(s for s in of(frames, "STATUS") if s.cycle >= RESET)
        assert boot.cycle == RESET + DURATION
        assert database.decode_message(boot.can_id, boot.payload, decode_choices=False)["NodeState"] == 0
        assert boot.payload[2] == 0
        assert of(frames, "STATE")[-1].cycle >= CYCLES - 10

    @pytest.mark.sample(3)
    def test_silent_node_does_not_change_the_frames_of_other_nodes(self, node: str, run: Run, network: Network) -> None:
        own = {m.frame_id for m in network.sent_by(node)}
        silent = run(Fault("silence", node))
        assert silent == [s for s in run() if s.can_id not in own]


def test_no_node_sends_cyclic_frames_without_sync(run: Run, network: Network) -> None:
    lost = [Fault("drop", message.name) for message in network.sent_by("HAL") if message.name.startswith("SYNC_")]
    sent = {network_name(network, s.can_id) for s in run(*lost)}
    assert {name for name in sent if not name.endswith("_STATUS")} <= {"HAPTICS_STATE"}
    assert len(sent) >= 20


def network_name(network: Network, can_id: int) -> str:
    return next(m.name for m in network.messages if m.frame_id == can_id)

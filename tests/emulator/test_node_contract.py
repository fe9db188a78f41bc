"""What every emulated node owes the bus, each of the twenty: judged with cantools and AUTOSAR's own E2E library alone."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import NamedTuple

import cantools
import e2e
import numpy as np
import pytest
from cantools.database.can import Database

import atalante_dbc
from atalante_dbc import Network
from atalante_dbc.loader import DBC_FILE
from atalante_emulator.body import PyBulletBody
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
#: When every node has an emergency, and when every node is reset, for how long.
EMERGENCY, RESET, FOR = 40, 40, 25


class Said(NamedTuple):
    """One frame."""

    cycle: int
    can_id: int
    length: int
    flags: int
    payload: bytes


Run = Callable[..., list[Said]]


@pytest.fixture(scope="module")
def run(network: Network, robot: Robot, urdf_text: str) -> Iterator[Run]:
    bodies: list[PyBulletBody] = []
    runs: dict[tuple[Fault, ...], list[Said]] = {}

    def record(*faults: Fault, cycles: int = CYCLES) -> list[Said]:
        if faults in runs:
            return runs[faults]
        hal, nodes = lockstep_pair()
        bodies.append(PyBulletBody(urdf_text))
        emulator = Emulator(network, robot, bodies[-1], nodes, operator=Operator(starts=False), faults=faults)
        hal.step = emulator.poll
        syncs = TransmitImage([m for m in network.sent_by("HAL") if m.name.startswith("SYNC_")])
        buffer, said = new_frames(128), []
        for cycle in range(cycles):
            syncs.values[syncs.codec.slice("Cycle")] = cycle
            hal.send(syncs.seal())
            for frame in buffer[: hal.receive(buffer)]:
                length = int(frame["len"])
                said.append(
                    Said(cycle, int(frame["can_id"]), length, int(frame["flags"]), frame["data"][:length].tobytes())
                )
        runs[faults] = said
        return said

    yield record
    for body in bodies:
        body.close()


@pytest.fixture(scope="session")
def database() -> Database:
    database = cantools.database.load_file(DBC_FILE)
    assert isinstance(database, Database)
    return database


@pytest.mark.parametrize("node", NODES)
class TestNode:
    @pytest.fixture
    def of(self, node: str, network: Network) -> Callable[[list[Said], str], list[Said]]:
        def of(said: list[Said], kind: str) -> list[Said]:
            return [s for s in said if s.can_id == network.message(f"{node}_{kind}").frame_id]

        return of

    def test_boots_up_once_and_then_sends_its_heartbeat_in_time(self, node: str, run: Run, of, database) -> None:
        status = of(run(), "STATUS")
        said = [database.decode_message(s.can_id, s.payload, decode_choices=False) for s in status]
        assert [s["NodeState"] for s in said] == [0, 5, 5][: len(said)]
        assert set(np.diff([s.cycle for s in status])) == {HEARTBEAT}
        assert {s["DbcHash"] for s in said} == {atalante_dbc.load().hash32}
        assert {s["ErrorFlags"] for s in said} == {0}

    def test_answers_every_sync_once(self, node: str, run: Run, of, network: Network) -> None:
        states = of(run(), "STATE")
        period = network.message(f"{node}_STATE").cycle_ms
        assert [s.cycle for s in states] == list(range(0, CYCLES, period))
        if period == 1:
            assert [s.payload[2] for s in states] == [cycle & 0xFF for cycle in range(CYCLES)]

    def test_raises_no_emergency_by_itself(self, node: str, run: Run, of) -> None:
        assert of(run(), "EMCY") == []

    def test_every_frame_is_right(self, node: str, run: Run, network: Network, database: Database) -> None:
        mine = {m.frame_id: m for m in network.sent_by(node)}
        faults = (Fault("emergency", node, EMERGENCY, FOR, code=0x5000),)
        for said in [*run(), *run(*faults)]:
            if said.can_id not in mine:
                continue
            message = mine[said.can_id]
            assert (said.length, said.flags) == (message.length, FLAG_FDF | FLAG_BRS)
            assert e2e.p05.e2e_p05_check(said.payload, message.data_id)
            if said.cycle % 10 and message.cycle_ms == 1:
                continue  # cantools is slow
            layout = database.get_message_by_frame_id(said.can_id)
            values = layout.decode(said.payload, decode_choices=False)
            for signal in layout.signals:
                if signal.minimum is not None:
                    assert signal.minimum <= values[signal.name] <= signal.maximum, signal.name

    def test_tells_an_error_once_and_that_it_is_over(self, node: str, run: Run, of, database: Database) -> None:
        said = run(Fault("emergency", node, EMERGENCY, FOR, code=0x5000))
        told = [(s.cycle, database.decode_message(s.can_id, s.payload)["ErrorCode"]) for s in of(said, "EMCY")]
        assert told == [(EMERGENCY, 0x5000), (EMERGENCY + FOR, 0)]
        assert len(of(said, "STATE")) == len(of(run(), "STATE"))

    def test_is_silent_while_it_is_off_and_boots_again(self, node: str, run: Run, of, database: Database) -> None:
        said = run(Fault("reset", node, RESET, FOR))
        mine = [s for kind in ("STATE", "STATUS", "EMCY") for s in of(said, kind)]
        assert not [s for s in mine if RESET <= s.cycle < RESET + FOR]
        boot = next(s for s in of(said, "STATUS") if s.cycle >= RESET)
        assert boot.cycle == RESET + FOR
        assert database.decode_message(boot.can_id, boot.payload, decode_choices=False)["NodeState"] == 0
        assert boot.payload[2] == 0
        assert of(said, "STATE")[-1].cycle >= CYCLES - 10

    def test_its_silence_is_its_own(self, node: str, run: Run, network: Network) -> None:
        mine = {m.frame_id for m in network.sent_by(node)}
        silent = run(Fault("silence", node))
        assert silent == [s for s in run() if s.can_id not in mine]


def test_nobody_says_anything_without_sync(run: Run, network: Network) -> None:
    lost = [Fault("drop", message.name) for message in network.sent_by("HAL") if message.name.startswith("SYNC_")]
    said = {network_name(network, s.can_id) for s in run(*lost)}
    assert {name for name in said if not name.endswith("_STATUS")} <= {"HAPTICS_STATE"}
    assert len(said) >= 20


def network_name(network: Network, can_id: int) -> str:
    return next(m.name for m in network.messages if m.frame_id == can_id)

from __future__ import annotations

import numpy as np
import pytest

from atalante_dbc import Network
from atalante_emulator.heartbeat import BOOTUP, OPERATIONAL, Heartbeats
from atalante_hal.wire.codec import Codec

NODES = ("LEFT_SK", "IMU_TORSO", "PENDANT")


class Listener:
    """Runs the heartbeats and keeps what each node said: cycle, then `SIGNALS`."""

    SIGNALS = ("Counter", "NodeState", "Uptime", "ErrorFlags", "SupplyVoltage", "DbcHash")

    def __init__(self, network: Network) -> None:
        messages = [network.message(f"{node}_STATUS") for node in NODES]
        self.heartbeats, self.cycle = Heartbeats(network, messages), 0
        self.codecs = {message.frame_id: Codec([message]) for message in messages}
        self.said: dict[str, list[tuple[float, ...]]] = {node: [] for node in NODES}

    def run(self, cycles: int) -> None:
        for _ in range(cycles):
            for frames in self.heartbeats.due(self.cycle):
                codec = self.codecs[int(frames["can_id"][0])]
                values, (message,) = np.zeros(codec.size), codec.messages
                assert codec.decode(frames, values)
                self.said[message.sender].append(
                    (self.cycle, *(float(values[codec.index(message.name, s)]) for s in self.SIGNALS))
                )
            self.cycle += 1


@pytest.fixture
def listener(network: Network) -> Listener:
    return Listener(network)


def test_each_in_its_own_cycle_of_the_period(listener: Listener) -> None:
    listener.run(300)
    cycles = {node: [said[0] for said in sayings] for node, sayings in listener.said.items()}
    assert cycles == {"LEFT_SK": [0, 100, 200], "IMU_TORSO": [33, 133, 233], "PENDANT": [66, 166, 266]}


def test_one_bootup_then_operational(listener: Listener, network: Network) -> None:
    listener.run(2300)
    for sayings in listener.said.values():
        assert [s[2] for s in sayings] == [BOOTUP] + [OPERATIONAL] * (len(sayings) - 1)
        assert [s[1] for s in sayings] == list(range(len(sayings)))
        assert [s[3] for s in sayings] == [pytest.approx(round(s[0] * 1e-3), abs=0.51) for s in sayings]
        assert {s[6] for s in sayings} == {network.hash32}
        assert {s[5] for s in sayings} == {48.0}


def test_what_a_node_says_of_itself(listener: Listener) -> None:
    listener.heartbeats.set("LEFT_SK", "SupplyVoltage", 31.5)
    listener.heartbeats.set("LEFT_SK", "ErrorFlags", 5)
    listener.run(100)
    assert listener.said["LEFT_SK"][0][4:6] == (5.0, 31.5)
    assert listener.said["IMU_TORSO"][0][4:6] == (0.0, 48.0)


def test_a_node_that_begins_anew_says_so_at_once(listener: Listener) -> None:
    listener.run(2150)
    before = len(listener.said["IMU_TORSO"])
    listener.heartbeats.set("IMU_TORSO", "ErrorFlags", 5)
    listener.heartbeats.boot("IMU_TORSO", listener.cycle)
    listener.run(1200)
    first, second, *_, last = listener.said["IMU_TORSO"][before:]
    assert (first[:3], first[4]) == ((2150, 0, BOOTUP), 0)
    assert second[:3] == (2233, 1, OPERATIONAL)
    assert last[3] == 1  # s since it began anew


def test_a_node_that_begins_anew_when_its_status_is_due_says_it_once(listener: Listener) -> None:
    listener.run(133)
    listener.heartbeats.boot("IMU_TORSO", listener.cycle)
    listener.run(1)
    assert [said[:3] for said in listener.said["IMU_TORSO"]] == [(33, 0, BOOTUP), (133, 0, BOOTUP)]

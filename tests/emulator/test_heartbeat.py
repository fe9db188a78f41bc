from __future__ import annotations

import numpy as np
import pytest

from atalante_dbc import Network
from atalante_emulator.heartbeat import BOOTUP, OPERATIONAL, Heartbeats
from atalante_hal.wire.codec import Codec
from atalante_hal.wire.e2e import COUNTER_BYTE
from atalante_hal.wire.process_image import TransmitImage

NODES = ("LEFT_SK", "IMU_TORSO", "PENDANT")


class Listener:
    """Listener that runs the heartbeats, and records cycle and `SIGNALS` of each status frame, by node."""

    SIGNALS = ("Counter", "NodeState", "Uptime", "ErrorFlags", "SupplyVoltage", "DbcHash")

    def __init__(self, network: Network) -> None:
        messages = [network.message(f"{node}_STATUS") for node in NODES]
        self.emergencies = TransmitImage([network.message(f"{node}_EMCY") for node in NODES])
        self.heartbeats, self.cycle = Heartbeats(network, messages, self.emergencies), 0
        self.codecs = {message.frame_id: Codec([message]) for message in messages}
        self.sent: dict[str, list[tuple[float, ...]]] = {node: [] for node in NODES}

    def run(self, cycles: int) -> None:
        for _ in range(cycles):
            for frames in self.heartbeats.due(self.cycle):
                codec = self.codecs[int(frames["can_id"][0])]
                values, (message,) = np.zeros(codec.size), codec.messages
                assert codec.decode(frames, values)
                self.sent[message.sender].append(
                    (self.cycle, *(float(values[codec.index(message.name, s)]) for s in self.SIGNALS))
                )
            self.cycle += 1


@pytest.fixture
def listener(network: Network) -> Listener:
    return Listener(network)


def test_heartbeats_are_spread_over_the_cycles_of_the_period(listener: Listener) -> None:
    listener.run(300)
    cycles = {node: [sent[0] for sent in frames_of_node] for node, frames_of_node in listener.sent.items()}
    assert cycles == {"LEFT_SK": [0, 100, 200], "IMU_TORSO": [33, 133, 233], "PENDANT": [66, 166, 266]}


def test_first_heartbeat_reports_bootup_and_every_later_one_operational(listener: Listener, network: Network) -> None:
    listener.run(2300)
    for frames_of_node in listener.sent.values():
        assert [s[2] for s in frames_of_node] == [BOOTUP] + [OPERATIONAL] * (len(frames_of_node) - 1)
        assert [s[1] for s in frames_of_node] == list(range(len(frames_of_node)))
        assert [s[3] for s in frames_of_node] == [pytest.approx(round(s[0] * 1e-3), abs=0.51) for s in frames_of_node]
        assert {s[6] for s in frames_of_node} == {network.hash32}
        assert {s[5] for s in frames_of_node} == {48.0}


def test_signal_set_for_one_node_is_in_its_heartbeat_only(listener: Listener) -> None:
    listener.heartbeats.set("LEFT_SK", "SupplyVoltage", 31.5)
    listener.heartbeats.set("LEFT_SK", "ErrorFlags", 5)
    listener.run(100)
    assert listener.sent["LEFT_SK"][0][4:6] == (5.0, 31.5)
    assert listener.sent["IMU_TORSO"][0][4:6] == (0.0, 48.0)


def test_rebooted_node_sends_bootup_in_the_same_cycle_and_restarts_its_uptime(listener: Listener) -> None:
    listener.run(2150)
    before = len(listener.sent["IMU_TORSO"])
    listener.heartbeats.set("IMU_TORSO", "ErrorFlags", 5)
    listener.heartbeats.boot("IMU_TORSO", listener.cycle)
    listener.run(1200)
    first, second, *_, last = listener.sent["IMU_TORSO"][before:]
    assert (first[:3], first[4]) == ((2150, 0, BOOTUP), 0)
    assert second[:3] == (2233, 1, OPERATIONAL)
    assert last[3] == 1  # s since the reboot


def test_reboot_in_the_cycle_of_a_heartbeat_sends_one_bootup(listener: Listener) -> None:
    listener.run(133)
    listener.heartbeats.boot("IMU_TORSO", listener.cycle)
    listener.run(1)
    assert [sent[:3] for sent in listener.sent["IMU_TORSO"]] == [(33, 0, BOOTUP), (133, 0, BOOTUP)]


def test_reboot_restarts_the_emergency_counter_of_its_node_only(listener: Listener) -> None:
    listener.emergencies.seal(7)
    listener.heartbeats.boot("IMU_TORSO", listener.cycle)
    assert listener.emergencies.seal()["data"][:, COUNTER_BYTE].tolist() == [8, 0, 8]

from __future__ import annotations

import pytest

from atalante_dbc import Network
from atalante_dbc.network import wire_time
from atalante_emulator.wire import Babble, Wire
from atalante_hal.types import PERIOD
from atalante_hal.wire.frame import FLAG_BRS, FLAG_FDF, Frames
from atalante_hal.wire.process_image import TransmitImage


def cyclic(network: Network, bus: str, *, hal: bool) -> list[Frames]:
    """Return the 1 ms frames of a bus: those of the HAL if `hal` is set, otherwise those of the nodes."""
    messages = [m for m in network.messages if m.bus == bus and m.cycle_ms == 1 and (m.sender == "HAL") is hal]
    frames = TransmitImage(messages).seal().copy()
    return [frames[index : index + 1] for index in range(len(frames))]


def ids(frames: list[Frames]) -> list[int]:
    return [int(frame["can_id"][0]) for frame in frames]


def run(wire: Wire, bus: str, *babbles: Babble) -> tuple[list[int], list[int], list[int]]:
    """Run one cycle. Return three lists of identifiers that were sent: by the floods, by the HAL, by the nodes."""
    babbled = wire.begin(babbles)
    hal = wire.carry(cyclic(wire._network, bus, hal=True), from_hal=True)
    nodes = wire.carry(cyclic(wire._network, bus, hal=False), from_hal=False)
    return ids([frame for _, frame in babbled]), ids(hal), ids(nodes)


@pytest.fixture
def wire(network: Network) -> Wire:
    return Wire(network)


@pytest.mark.parametrize("bus", ["left_leg", "right_leg", "left_sense", "right_sense"])
def test_load_of_the_cyclic_frames_is_the_bus_load_of_the_network(wire: Wire, network: Network, bus: str) -> None:
    babbled, hal, nodes = run(wire, bus)
    slow = sum(
        wire_time(m.length) / ((m.cycle_ms or m.inhibit_ms) * 1e-3)
        for m in network.messages
        if m.bus == bus and m.cycle_ms != 1
    )
    assert wire.load(bus) == pytest.approx(network.bus_load()[bus] - slow)
    assert not babbled
    assert len(hal + nodes) == sum(m.bus == bus and m.cycle_ms == 1 for m in network.messages)
    assert wire.idle


def test_frames_are_sent_in_the_order_of_their_identifiers(wire: Wire, network: Network) -> None:
    wire.begin([])
    frames = cyclic(network, "left_leg", hal=False)
    assert ids(wire.carry(frames[::-1], from_hal=False)) == sorted(ids(frames))


def test_flood_of_identifier_0_blocks_every_other_frame_of_its_bus(wire: Wire) -> None:
    babbled, hal, nodes = run(wire, "left_leg", Babble("left_leg", 0, 8, 1.0))
    assert len(babbled) == int(PERIOD / wire_time(8)) == 17
    assert (hal, nodes) == ([], [])
    assert wire.load("left_leg") == pytest.approx(1.0)
    assert not wire.idle


def test_flood_of_one_bus_does_not_change_another_bus(wire: Wire) -> None:
    _, hal, nodes = run(wire, "right_leg", Babble("left_leg", 0, 8, 1.0))
    assert (len(hal), len(nodes)) == (2, 6)
    assert wire.load("right_leg") == pytest.approx(0.5754, abs=1e-3)


def test_flood_of_half_a_bus_blocks_the_frames_of_lowest_priority(wire: Wire, network: Network) -> None:
    _, hal, nodes = run(wire, "left_leg", Babble("left_leg", 0, 8, 0.5))
    joints = [network.message(f"LEFT_{joint}_STATE").frame_id for joint in ("FH", "TH", "SH", "SK", "SA", "HA")]
    assert hal == [0x10, 0x100]
    assert nodes == joints[:4]
    assert wire.load("left_leg") <= 1.0 + 1e-9


def test_babble_of_low_priority_uses_only_the_remaining_time(wire: Wire) -> None:
    babbled, hal, nodes = run(wire, "left_leg", Babble("left_leg", 0x700, 8, 1.0))
    assert (len(hal), len(nodes)) == (2, 6)
    assert len(babbled) == int((1.0 - 0.5754) * PERIOD / wire_time(8)) == 7
    assert wire.load("left_leg") <= 1.0 + 1e-9


def test_babble_with_an_identifier_between_commands_and_states_blocks_the_states(wire: Wire) -> None:
    _, hal, nodes = run(wire, "left_leg", Babble("left_leg", 0x150, 64, 1.0))
    assert (hal, nodes) == ([0x10, 0x100], [])


def test_babble_keeps_its_share_over_many_cycles(wire: Wire) -> None:
    babble = Babble("left_leg", 0, 64, 0.3)
    frames = sum(len(wire.begin([babble])) for _ in range(1000))
    assert frames == pytest.approx(0.3 * 1000 * PERIOD / wire_time(64), abs=1)
    assert {frame["len"][0] for _, frame in wire.begin([babble])} == {64}


def test_babble_frame_has_the_requested_identifier_length_and_fd_flags(wire: Wire) -> None:
    bus, frame = wire.begin([Babble("left_leg", 0x7F, 16, 0.1)])[0]
    assert bus == "left_leg"
    assert (frame["can_id"][0], frame["len"][0], frame["flags"][0]) == (0x7F, 16, FLAG_FDF | FLAG_BRS)


class TestBlockedFrames:
    def test_blocked_frame_is_sent_in_the_next_cycle(self, wire: Wire, network: Network) -> None:
        status = TransmitImage([network.message("LEFT_SK_STATUS")])
        wire.begin([Babble("left_leg", 0, 8, 1.0)])
        assert wire.carry([status.seal().copy()], from_hal=False) == []
        wire.begin([])
        assert ids(wire.carry(cyclic(network, "left_leg", hal=True), from_hal=True)) == [0x10, 0x100]
        assert ids(wire.carry([], from_hal=False)) == [network.message("LEFT_SK_STATUS").frame_id]
        assert wire.idle

    def test_newer_frame_replaces_a_blocked_one_of_the_same_identifier(self, wire: Wire, network: Network) -> None:
        state = TransmitImage([network.message("LEFT_SK_STATE")])
        for _ in range(3):
            wire.begin([Babble("left_leg", 0, 8, 1.0)])
            assert wire.carry([state.seal().copy()], from_hal=False) == []
        wire.begin([])
        (frame,) = wire.carry([state.seal().copy()], from_hal=False)
        assert frame["data"][0, 2] == 3
        assert wire.idle


def test_frame_with_an_unknown_identifier_takes_no_bus_time(wire: Wire, network: Network) -> None:
    frame = cyclic(network, "left_leg", hal=True)[0].copy()
    frame["can_id"] = 0x7FF
    wire.begin([Babble("left_leg", 0, 8, 1.0)])
    assert ids(wire.carry([frame], from_hal=True)) == [0x7FF]

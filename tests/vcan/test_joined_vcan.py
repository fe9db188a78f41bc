"""Two SocketCAN interfaces joined to one bus: the same behaviour as every bus, and one wait for both interfaces."""

from __future__ import annotations

import threading
from collections.abc import Iterator

import pytest

from atalante_dbc import Network
from atalante_hal.bus import Bus, BusDown
from atalante_hal.bus.joined import JoinedBus
from atalante_hal.bus.socketcan import SocketCanBus
from atalante_hal.wire.frame import FLAG_BRS, FLAG_FDF, new_frames
from tests.hal.bus.test_bus import BUSES, FrameReceiver, FrameSender, FrameWaiter, network_of, other_frames
from tests.vcan.conftest import as_root


def joined(network: Network, legs: str, senses: str) -> JoinedBus:
    """Join two interfaces: one for the two leg buses, and one for the two sensor buses."""
    one, other = SocketCanBus(legs), SocketCanBus(senses)
    return JoinedBus(network, dict(zip(BUSES, (one, one, other, other), strict=True)))


class TestJoinedSocketCan(FrameSender, FrameReceiver, FrameWaiter):
    @pytest.fixture
    def ends(self, vcan: str, second_vcan: str) -> Iterator[tuple[Bus, Bus]]:
        network = network_of(dict.fromkeys([*range(0x800), *other_frames()["can_id"].tolist()], "right_sense"))
        one, other = joined(network, vcan, second_vcan), joined(network, vcan, second_vcan)
        yield one, other
        one.close()
        other.close()


def test_one_wait_receives_from_either_interface(vcan: str, second_vcan: str, network: Network) -> None:
    bus = joined(network, vcan, second_vcan)
    block = new_frames(4)
    for channel, message in ((vcan, "LEFT_SK_STATE"), (second_vcan, "FOOT_LEFT_STATE")):
        frame = new_frames(1)
        frame["can_id"], frame["flags"] = network.message(message).frame_id, FLAG_FDF | FLAG_BRS
        frame["len"] = network.message(message).length
        peer = SocketCanBus(channel)
        later = threading.Timer(0.05, peer.send, (frame,))
        later.start()
        assert bus.receive(block, 60.0) == 1
        later.join()
        peer.close()
        assert block[:1].tobytes() == frame.tobytes()
    bus.close()


def test_an_interface_that_goes_down_is_an_error_and_the_other_still_sends(
    vcan: str, spare_vcan: str, network: Network
) -> None:
    bus, peer = joined(network, spare_vcan, vcan), SocketCanBus(vcan)
    syncs = new_frames(4)
    syncs["can_id"] = [network.message(f"SYNC_{name.upper()}").frame_id for name in BUSES]
    syncs["len"], syncs["flags"] = 8, FLAG_FDF | FLAG_BRS
    as_root("ip", "link", "set", spare_vcan, "down")
    with pytest.raises(BusDown, match=f"ip link set {spare_vcan} up"):
        bus.send(syncs)
    block = new_frames(4)
    assert peer.receive(block, 5.0) == 2
    assert block[:2].tobytes() == syncs[2:].tobytes()
    peer.close()
    bus.close()

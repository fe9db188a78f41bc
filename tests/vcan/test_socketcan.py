"""SocketCAN: the same behaviour as every bus, properties of the kernel, and exchange of frames with python-can and candump."""

from __future__ import annotations

import time
from collections.abc import Iterator

import can
import numpy as np
import pytest

from atalante_hal.bus import Bus, BusAbsent, BusDown, BusFull, open_bus, socketcan
from atalante_hal.bus.channel_map import open_channels, parse_channel_map
from atalante_hal.bus.python_can import message_of
from atalante_hal.bus.replay import ReplayBus
from atalante_hal.bus.socketcan import REOPEN_PERIOD, SocketCanBus
from atalante_hal.wire.frame import FLAG_BRS, FLAG_FDF, Frames, new_frames
from tests.hal.bus.test_bus import (
    BUSES,
    FrameReceiver,
    FrameSender,
    FrameWaiter,
    other_frames,
    random_frames,
    receive_all,
)
from tests.vcan.conftest import Candump, as_root, create, remove


class TestSocketCan(FrameSender, FrameReceiver, FrameWaiter):
    @pytest.fixture
    def ends(self, vcan: str) -> Iterator[tuple[Bus, Bus]]:
        one, other = open_bus("socketcan", vcan), open_bus("socketcan", vcan)
        yield one, other
        one.close()
        other.close()


@pytest.fixture
def sender(vcan: str) -> Iterator[SocketCanBus]:
    bus = SocketCanBus(vcan)
    yield bus
    bus.close()


@pytest.fixture
def receiver(vcan: str) -> Iterator[SocketCanBus]:
    bus = SocketCanBus(vcan)
    yield bus
    bus.close()


@pytest.fixture
def stranger(vcan: str) -> Iterator[can.BusABC]:
    """Return the SocketCAN bus of python-can."""
    with can.Bus(interface="socketcan", channel=vcan, fd=True) as bus:
        yield bus


def messages_of(frames: Frames) -> list[can.Message]:
    return [message_of(can_id, length, flags, bytes(data)) for can_id, length, flags, _, data in frames.tolist()]


def test_stamps_come_from_the_clock_of_the_kernel(sender: SocketCanBus, receiver: SocketCanBus) -> None:
    block = new_frames(20)
    before = time.clock_gettime_ns(time.CLOCK_REALTIME)
    sender.send(random_frames(20))
    after = time.clock_gettime_ns(time.CLOCK_REALTIME)
    assert receiver.receive(block, 5.0) == 20
    stamps = receiver.stamps[:20]
    assert before <= stamps[0]
    assert stamps[-1] <= after
    assert (np.diff(stamps) >= 0).all()
    assert len(np.unique(stamps % 1000)) > 1, "microseconds, not nanoseconds"


def test_frames_lost_in_a_full_receive_buffer_are_counted(vcan: str, sender: SocketCanBus) -> None:
    slow = SocketCanBus(vcan, receive_buffer=1)  # the kernel rounds up to its minimum, a few frames
    block = new_frames(256)
    received = sent = 0
    for burst in (100, 150):
        sender.send(random_frames(burst))
        received += slow.receive(block)
        sender.send(random_frames(1))  # with this frame, the kernel reports the number of frames lost before it
        received += slow.receive(block)
        sent += burst + 1
        assert received < sent
        assert slow.dropped == sent - received
    slow.close()


def test_batch_sent_in_several_system_calls_keeps_its_order(sender: SocketCanBus, receiver: SocketCanBus) -> None:
    sent = random_frames(600, seed=11)
    sent["flags"][::7], sent["len"][::7] = 0, 8  # classic frames among them
    sent["data"][::7, 8:] = 0
    sender.send(sent)
    assert receive_all(receiver, 600).tobytes() == sent.tobytes()


def test_classic_and_fd_batches_of_equal_length_are_sent_with_their_own_sizes(
    sender: SocketCanBus, receiver: SocketCanBus
) -> None:
    classic = new_frames(3)
    classic["can_id"], classic["len"] = 0x123, 8
    for sent in (random_frames(3, seed=12), classic, random_frames(3, seed=13)):
        sender.send(sent)
        assert receive_all(receiver, 3).tobytes() == sent.tobytes()


def test_python_can_receives_every_sent_frame(sender: SocketCanBus, stranger: can.BusABC) -> None:
    sent = np.concatenate([random_frames(22, seed=14), other_frames()])
    sender.send(sent)
    for expected in messages_of(sent):
        message = stranger.recv(5.0)
        assert message is not None
        assert message.equals(expected, timestamp_delta=None, check_channel=False, check_direction=False)


def test_every_frame_of_python_can_is_received(receiver: SocketCanBus, stranger: can.BusABC) -> None:
    sent = np.concatenate([random_frames(22, seed=15), other_frames()])
    for message in messages_of(sent):
        stranger.send(message)
    assert receive_all(receiver, len(sent)).tobytes() == sent.tobytes()


def test_candump_records_the_same_bytes(sender: SocketCanBus, vcan: str, candump: Candump) -> None:
    sent = random_frames(150, seed=16, lengths=(8, 12, 16, 24, 32, 48, 64))
    with candump:
        sender.send(sent)
    wire = [line.split(maxsplit=1)[1] for line in candump.log.read_text().splitlines()]
    assert wire == [
        f"{vcan} {can_id:03X}##{FLAG_FDF | FLAG_BRS:X}{bytes(data[:length]).hex().upper()}"
        for can_id, length, _, _, data in sent.tolist()
    ]


def test_replay_of_a_candump_log_gives_the_sent_frames(sender: SocketCanBus, candump: Candump) -> None:
    sent = random_frames(40, seed=17)
    with candump:
        sender.send(sent)
    replay = ReplayBus(candump.log)
    assert receive_all(replay, 40).tobytes() == sent.tobytes()
    assert replay.ended
    replay.close()


def test_a_link_that_goes_down_is_reported_and_comes_back(spare_vcan: str) -> None:
    one, other = SocketCanBus(spare_vcan), SocketCanBus(spare_vcan)
    as_root("ip", "link", "set", spare_vcan, "down")
    with pytest.raises(BusDown, match=f"type `ip link set {spare_vcan} up`"):
        one.receive(new_frames(4))
    with pytest.raises(BusDown, match=f"type `ip link set {spare_vcan} up`"):
        one.send(random_frames(2))
    with pytest.raises(BusDown):
        other.receive(new_frames(4), 5.0)
    as_root("ip", "link", "set", spare_vcan, "up")
    sent = random_frames(2)
    one.send(sent)
    assert receive_all(other, 2).tobytes() == sent.tobytes()
    one.close()
    other.close()


def test_a_removed_interface_is_opened_again_when_it_is_back(spare_vcan: str) -> None:
    sender, receiver = SocketCanBus(spare_vcan), SocketCanBus(spare_vcan)
    remove(spare_vcan)
    with pytest.raises(BusDown, match=f"{spare_vcan} was removed: plug the adapter in again"):
        sender.send(random_frames(2))
    with pytest.raises(BusDown, match=f"{spare_vcan} was removed: plug the adapter in again"):
        receiver.receive(new_frames(4))
    time.sleep(REOPEN_PERIOD)
    for bus in (sender, receiver):
        with pytest.raises(BusDown, match=f"{spare_vcan} was removed: plug the adapter in again"):
            bus.receive(new_frames(4), 5.0)
    create(spare_vcan)
    as_root("ip", "link", "set", spare_vcan, "down")
    time.sleep(REOPEN_PERIOD)
    with pytest.raises(BusDown, match=f"cannot be opened again: {spare_vcan} is down: type `ip link set"):
        receiver.receive(new_frames(4))
    as_root("ip", "link", "set", spare_vcan, "up")
    time.sleep(REOPEN_PERIOD)
    assert receiver.receive(new_frames(4)) == 0
    for _ in range(2):
        sent = random_frames(2)
        sender.send(sent)
        assert receive_all(receiver, 2).tobytes() == sent.tobytes()
    sender.close()
    receiver.close()
    with pytest.raises(BusDown, match="is closed"):
        sender.send(random_frames(2))


def test_a_removed_interface_is_tried_once_in_a_period(spare_vcan: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(socketcan, "REOPEN_PERIOD", 3600.0)
    bus = SocketCanBus(spare_vcan)
    remove(spare_vcan)
    for _ in range(2):
        with pytest.raises(BusDown, match="was removed: plug"):
            bus.send(random_frames(1))
    create(spare_vcan)
    with pytest.raises(BusDown, match="was removed: plug"):
        bus.send(random_frames(1))
    bus.close()


def test_frames_queued_before_a_loss_are_dropped(spare_vcan: str) -> None:
    sender, receiver = SocketCanBus(spare_vcan), SocketCanBus(spare_vcan)
    sender.send(random_frames(300))
    remove(spare_vcan)
    with pytest.raises(BusDown):
        receiver.send(random_frames(1))
    create(spare_vcan)
    time.sleep(REOPEN_PERIOD)
    assert receiver.receive(new_frames(4), 0.05) == 0
    sender.close()
    receiver.close()


def test_error_of_a_full_transmit_queue_has_the_number_of_sent_frames(spare_vcan: str) -> None:
    as_root("tc", "qdisc", "add", "dev", spare_vcan, "root", "netem", "delay", "100s", "limit", "8")
    bus = SocketCanBus(spare_vcan)
    with pytest.raises(BusFull, match="accepted 8 of 20 frames, its transmit queue is full") as refusal:
        bus.send(random_frames(20))
    assert refusal.value.sent == 8
    with pytest.raises(BusFull, match="accepted 0 of 1 frames"):
        bus.send(random_frames(1))
    bus.close()


def test_error_at_opening_contains_the_command_to_type(spare_vcan: str) -> None:
    with pytest.raises(BusAbsent, match=r"no interface vcan99: .*`ip link add vcan99 type vcan && .*atalante doctor"):
        SocketCanBus("vcan99")
    with pytest.raises(BusAbsent, match="lo is not a CAN interface"):
        SocketCanBus("lo")
    as_root("ip", "link", "set", spare_vcan, "down")
    with pytest.raises(BusAbsent, match=f"{spare_vcan} is down: type `ip link set {spare_vcan} up`"):
        SocketCanBus(spare_vcan)
    as_root("ip", "link", "set", spare_vcan, "mtu", "16", "up")
    with pytest.raises(BusAbsent, match=rf"supports classic CAN only \(mtu 16\): .*ip link set {spare_vcan} mtu 72 up"):
        SocketCanBus(spare_vcan)


def test_all_buses_of_the_robot_share_one_vcan(vcan: str) -> None:
    buses = open_channels("socketcan", parse_channel_map(vcan, BUSES))
    assert len({id(bus) for bus in buses.values()}) == 1
    buses["left_leg"].close()

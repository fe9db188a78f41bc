"""`ResilientBus`: a program continues while its link is lost, and after the link is back."""

from __future__ import annotations

import pytest
from can.interfaces.virtual import VirtualBus

from atalante_hal.bus import BusDown, BusFull, resilient
from atalante_hal.bus.joined import JoinedBus
from atalante_hal.bus.pair import lockstep_pair
from atalante_hal.bus.python_can import PythonCanBus
from atalante_hal.bus.resilient import RETRY_PERIOD, SETTLE_TIME, ResilientBus
from atalante_hal.bus.wrapped import WrappedBus
from atalante_hal.wire.frame import Frames, new_frames
from tests.hal.bus.test_bus import BUSES, network_of


class Link(WrappedBus):
    """Link that raises `error` in every call while it is set."""

    error: Exception | None = None

    def send(self, frames: Frames) -> None:
        if self.error:
            raise self.error
        super().send(frames)

    def receive(self, frames: Frames, timeout: float = 0.0) -> int:
        if self.error:
            raise self.error
        return super().receive(frames, timeout)


class Clock:
    """Simulated clock: time passes only while the bus waits."""

    def __init__(self) -> None:
        self.now = 64.0
        self.slept: list[float] = []

    def monotonic(self) -> float:
        return self.now

    def sleep(self, seconds: float) -> None:
        self.slept.append(seconds)
        self.now += seconds


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    made = Clock()
    monkeypatch.setattr(resilient, "time", made)
    return made


def test_lost_link_drops_frames_and_its_loss_and_return_are_reported_once(clock: Clock) -> None:
    near, far = lockstep_pair()
    link, notices = Link(near), []
    bus = ResilientBus(link, notices.append)
    frames = new_frames(2)
    link.error = BusDown("can0 is down")
    for _ in range(8):
        bus.send(frames)
        assert bus.receive(new_frames(4), 0.02) == 0
    assert (bus.down, bus.losses, far.receive(new_frames(4))) == ("can0 is down", 1, 0)
    assert clock.slept == [0.02] * 8
    link.error = None
    assert bus.receive(new_frames(4)) == 0
    assert bus.down == "can0 is down"  # silence does not prove that the link is back
    far.send(frames)
    assert bus.receive(new_frames(4)) == 2
    assert (bus.down, bus.losses) == ("", 1)
    assert notices == ["can0 is down; waiting for the link", f"{near.name} is back"]
    link.error = BusDown("can0 is down")
    bus.send(frames)
    link.error = None
    bus.send(frames)
    assert (bus.down, bus.losses) == ("", 2)
    assert notices[2:] == [f"{near.name} was lost and is back"]
    assert far.receive(new_frames(4)) == 2


def test_only_an_unchanged_error_message_of_a_loss_is_reported(clock: Clock) -> None:
    near, _ = lockstep_pair()
    link, notices = Link(near), []
    bus = ResilientBus(link, notices.append)
    for reason, waits in (("is down", 1), ("was removed", 2), ("is plugged in and down", 3)):
        link.error = BusDown(f"can0 {reason}")
        for _ in range(waits):
            bus.receive(new_frames(4), SETTLE_TIME / 2)
            assert bus.down == f"can0 {reason}"
        link.error = None
    assert bus.receive(new_frames(4)) == 0
    assert notices == ["can0 is plugged in and down; waiting for the link"]
    assert bus.losses == 1


def test_other_channels_transfer_frames_while_one_is_lost(clock: Clock) -> None:
    pairs = {name: lockstep_pair() for name in BUSES}
    links = {name: Link(near) for name, (near, _) in pairs.items()}
    network, notices = network_of(dict(enumerate(BUSES))), []
    bus = ResilientBus(JoinedBus(network, links), notices.append)
    frames = new_frames(4)
    frames["can_id"] = range(4)
    links[BUSES[1]].error = BusDown("can1 is down")
    for _ in range(3):
        bus.send(frames)
        for near, far in pairs.values():
            assert far.receive(new_frames(4)) == (near is not pairs[BUSES[1]][0])
        pairs[BUSES[0]][1].send(frames[:1])
        assert bus.receive(new_frames(4)) == 1
        assert (bus.down, bus.losses) == ("can1 is down", 1)
        clock.sleep(SETTLE_TIME)
    links[BUSES[1]].error = None
    assert bus.receive(new_frames(4)) == 0
    assert bus.down == "can1 is down"
    bus.send(frames)
    assert bus.down == ""
    assert notices == ["can1 is down; waiting for the link", f"{bus.name} is back"]


@pytest.mark.parametrize("joins", [False, True])
def test_only_a_received_frame_ends_the_loss_of_a_python_can_link(
    clock: Clock, monkeypatch: pytest.MonkeyPatch, joins: bool
) -> None:
    def lose(self: VirtualBus, timeout: float) -> None:
        raise OSError("gone")

    link, far = (PythonCanBus("virtual", f"lost link {joins}") for _ in range(2))
    notices: list[str] = []
    network = network_of(dict(enumerate(BUSES)))
    bus = ResilientBus(JoinedBus(network, dict.fromkeys(BUSES, link)) if joins else link, notices.append)
    frames = new_frames(2)
    with monkeypatch.context() as patch:
        patch.setattr(VirtualBus, "recv", lose)
        for _ in range(3):
            assert bus.receive(new_frames(4)) == 0
            clock.sleep(SETTLE_TIME)
    message = (
        f"{link.name} cannot receive: gone; restart this program when the link works again, because python-can does not open it "
        "again"
    )
    assert notices == [message]
    bus.send(frames)
    assert bus.receive(new_frames(4)) == 0
    assert bus.down == message  # a link that accepts frames may still be lost
    assert far.receive(new_frames(4)) == 2
    far.send(frames)
    assert bus.receive(new_frames(4)) == 2
    bus.send(frames)
    assert bus.down == ""
    assert notices[1:] == [f"{bus.name} is back"]
    bus.close()
    far.close()


def test_lost_link_is_tried_again_after_the_retry_period(clock: Clock) -> None:
    near, _ = lockstep_pair()
    link = Link(near)
    link.error = BusDown("can0 is down")
    assert ResilientBus(link).receive(new_frames(4), 60.0) == 0
    assert clock.slept == [RETRY_PERIOD]


def test_bus_that_waits_before_it_raises_an_error_is_not_waited_for_twice(clock: Clock) -> None:
    class LateLink(Link):
        def receive(self, frames: Frames, timeout: float = 0.0) -> int:
            clock.sleep(timeout)
            return super().receive(frames, timeout)

    near, _ = lockstep_pair()
    link = LateLink(near)
    link.error = BusDown("can0 is down")
    bus = ResilientBus(link)
    start = clock.now
    assert bus.receive(new_frames(4), 0.05) == 0
    assert clock.now - start == pytest.approx(0.05)
    assert bus.receive(new_frames(4), 60.0) == 0
    assert clock.now - start == pytest.approx(0.05 + RETRY_PERIOD)


def test_other_errors_of_the_bus_are_raised() -> None:
    near, _ = lockstep_pair()
    link = Link(near)
    link.error = BusFull("the transmit queue is full")
    with pytest.raises(BusFull):
        ResilientBus(link).send(new_frames(1))

"""`ResilientBus`: a program outlasts a link that is lost and comes back."""

from __future__ import annotations

import pytest

from atalante_hal.bus import BusDown, BusFull, resilient
from atalante_hal.bus.pair import lockstep_pair
from atalante_hal.bus.resilient import RETRY_PERIOD, ResilientBus
from atalante_hal.bus.wrapped import WrappedBus
from atalante_hal.wire.frame import Frames, new_frames


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


@pytest.fixture
def sleeps(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    slept: list[float] = []
    monkeypatch.setattr(resilient.time, "sleep", slept.append)
    return slept


def test_a_lost_link_drops_frames_and_reports_loss_and_return_once(sleeps: list[float]) -> None:
    near, far = lockstep_pair()
    link, notices = Link(near), []
    bus = ResilientBus(link, notices.append)
    frames = new_frames(2)
    link.error = BusDown("can0 is down")
    for _ in range(3):
        bus.send(frames)
        assert bus.receive(new_frames(4), 0.02) == 0
    assert (bus.down, bus.losses, far.receive(new_frames(4))) == ("can0 is down", 1, 0)
    assert sleeps == [0.02] * 3
    link.error = None
    assert bus.receive(new_frames(4)) == 0
    assert bus.down == "can0 is down"  # silence does not prove that the link is back
    far.send(frames)
    assert bus.receive(new_frames(4)) == 2
    assert (bus.down, bus.losses) == ("", 1)
    assert notices == ["can0 is down; waiting for it", f"{near.name} is back"]
    link.error = BusDown("can0 is down")
    bus.send(frames)
    link.error = None
    bus.send(frames)
    assert (bus.down, bus.losses) == ("", 2)
    assert far.receive(new_frames(4)) == 2


def test_a_lost_link_is_tried_again_within_the_retry_period(sleeps: list[float]) -> None:
    near, _ = lockstep_pair()
    link = Link(near)
    link.error = BusDown("can0 is down")
    assert ResilientBus(link).receive(new_frames(4), 60.0) == 0
    assert sleeps == [RETRY_PERIOD]


def test_other_errors_of_the_bus_reach_the_caller() -> None:
    near, _ = lockstep_pair()
    link = Link(near)
    link.error = BusFull("the transmit queue is full")
    with pytest.raises(BusFull):
        ResilientBus(link).send(new_frames(1))

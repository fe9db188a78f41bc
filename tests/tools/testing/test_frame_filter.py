"""Tests of the frame filter: a fault drops, delays or corrupts exactly the selected frames and changes no others."""

from __future__ import annotations

import numpy as np
import pytest

from atalante_dbc import Network
from atalante_hal.bus import BusFull
from atalante_hal.bus.pair import PairBus, lockstep_pair
from atalante_hal.bus.wrapped import WrappedBus
from atalante_hal.wire.frame import Frames, new_frames
from atalante_hal.wire.process_image import TransmitImage
from atalante_tools.testing.frame_filter import FrameFilter

STATES = ("LEFT_FH_STATE", "LEFT_SK_STATE", "FOOT_LEFT_STATE")


class BusEnds:
    """Both ends of a bus: the HAL with the frame filter, and the nodes."""

    def __init__(self, network: Network) -> None:
        ours, self.theirs = lockstep_pair()
        self.filter = FrameFilter(ours, network, tap=self)
        self.nodes = TransmitImage([network.message(name) for name in STATES])
        self.hal = TransmitImage([network.message("SYNC_LEFT_LEG"), network.message("COMMAND_LEFT_LEG")])
        self.sent_by_hal, self.received_by_hal = 0, 0
        self._names = {m.frame_id: m.name for m in network.messages}
        self._scratch = new_frames(64)

    def sent(self, frames: Frames) -> None:
        self.sent_by_hal += len(frames)

    def received(self, frames: Frames, count: int) -> None:
        self.received_by_hal += count

    def cycle(self) -> tuple[list[str], list[str]]:
        """Send one cycle in both directions; return the messages that the nodes and the HAL received, in order."""
        self.filter.send(self.hal.seal())
        at_node = self._receive(self.theirs)
        self.theirs.send(self.nodes.seal())
        return at_node, self._receive(self.filter)

    def _receive(self, end: PairBus | FrameFilter) -> list[str]:
        count = end.receive(self._scratch)
        return [self._names[frame_id] for frame_id in self._scratch["can_id"][:count].tolist()]

    def payload(self, name: str) -> bytes:
        """Return the payload of a message that the HAL received in the last cycle."""
        frame_id = next(i for i, n in self._names.items() if n == name)
        return self._scratch[self._scratch["can_id"] == frame_id]["data"][0].tobytes()


@pytest.fixture
def ends(network: Network) -> BusEnds:
    return BusEnds(network)


def test_frames_pass_unchanged_without_faults(ends: BusEnds):
    for _ in range(3):
        assert ends.cycle() == (["SYNC_LEFT_LEG", "COMMAND_LEFT_LEG"], list(STATES))
        assert ends.payload("LEFT_SK_STATE") == ends.nodes.frames["data"][1].tobytes()


def test_drop_removes_the_given_number_of_frames(ends: BusEnds):
    fault = ends.filter.drop("LEFT_SK_STATE", frames=2)
    received = [ends.cycle()[1] for _ in range(4)]
    assert [names == list(STATES) for names in received] == [False, False, True, True]
    assert received[0] == ["LEFT_FH_STATE", "FOOT_LEFT_STATE"]
    assert fault.hit == 2
    assert ends.filter.faults == []


def test_frames_accepted_before_an_error_are_logged(ends: BusEnds):
    class OneFrameBus(WrappedBus):
        def send(self, frames: Frames) -> None:
            raise BusFull("no room", 1)

    logged: list[Frames] = []
    ends.sent = logged.append
    ends.filter.bus = OneFrameBus(ends.theirs)
    ends.filter.drop("SYNC_LEFT_LEG")
    with pytest.raises(BusFull) as refusal:
        ends.filter.send(ends.hal.seal())
    (command,) = ends.hal.frames["can_id"][1:].tolist()
    assert [frames["can_id"].tolist() for frames in logged] == [[command]]
    assert refusal.value.accepted_of(ends.hal.frames)["can_id"].tolist() == [command]


def test_fault_selects_messages_by_node_pattern_or_command_name(ends: BusEnds):
    fault = ends.filter.drop("LEFT_SK")
    assert ends.cycle()[1] == ["LEFT_FH_STATE", "FOOT_LEFT_STATE"]
    fault.end()
    ends.filter.drop("LEFT_*_STATE", frames=1)
    assert ends.cycle()[1] == ["FOOT_LEFT_STATE"]
    ends.filter.drop("COMMAND_LEFT_LEG", frames=1)
    assert ends.cycle() == (["SYNC_LEFT_LEG"], list(STATES))
    assert ends.cycle() == (["SYNC_LEFT_LEG", "COMMAND_LEFT_LEG"], list(STATES))


def test_fault_without_a_frame_count_lasts_until_cleared(ends: BusEnds):
    fault = ends.filter.drop("*_STATE")
    assert all(ends.cycle()[1] == [] for _ in range(10))
    assert not fault.over
    ends.filter.clear()
    assert fault.over
    assert ends.cycle()[1] == list(STATES)


@pytest.mark.parametrize("cycles", [1, 3])
def test_delayed_frame_arrives_the_given_cycles_later_unchanged(ends: BusEnds, cycles: int):
    ends.filter.delay("LEFT_FH_STATE", cycles, frames=1)
    received = [ends.cycle()[1]]
    first = ends.nodes.frames["data"][0].tobytes()
    received += [ends.cycle()[1] for _ in range(cycles)]
    assert [names.count("LEFT_FH_STATE") for names in received] == [0] + [1] * (cycles - 1) + [2]
    assert received[-1][0] == "LEFT_FH_STATE"
    assert ends._scratch["data"][0].tobytes() == first  # the delayed frame is before the new frame
    assert ends.cycle()[1] == list(STATES)


def test_delayed_frames_that_do_not_fit_into_the_receive_buffer_arrive_later(ends: BusEnds):
    ends.filter.delay("*_STATE", 3, frames=3)
    for _ in range(3):
        ends.cycle()
    ends.filter.clear()
    ends.filter.send(ends.hal.seal())
    ends.theirs.receive(ends._scratch)
    counts = [ends.filter.receive(new_frames(2)) for _ in range(4)]
    assert counts == [2, 1, 0, 0]  # the three frames of the first cycle are due
    ends.theirs.send(ends.nodes.seal())
    ends.filter._cycle += 2
    assert [ends.filter.receive(new_frames(2)) for _ in range(6)] == [2, 2, 2, 2, 1, 0]


def test_full_receive_buffer_keeps_the_delayed_frames(ends: BusEnds):
    ends.filter.delay("*_STATE", 1, frames=1)
    ends.cycle()
    ends.filter.send(ends.hal.seal())
    counts = [ends.filter.receive(new_frames(room)) for room in (0, 2, 2)]
    assert counts == [0, 2, 1]


def test_delayed_command_arrives_the_given_cycles_later(ends: BusEnds):
    ends.filter.delay("COMMAND_LEFT_LEG", 2, frames=1)
    assert [ends.cycle()[0].count("COMMAND_LEFT_LEG") for _ in range(4)] == [0, 1, 2, 1]


def test_corruption_changes_one_bit_of_the_payload(ends: BusEnds):
    ends.filter.corrupt("LEFT_SK_STATE", bit=33, frames=1)
    ends.cycle()
    damaged, sent = (
        int.from_bytes(b, "little") for b in (ends.payload("LEFT_SK_STATE"), ends.nodes.frames["data"][1].tobytes())
    )
    assert damaged ^ sent == 1 << 33
    ends.filter.corrupt("LEFT_SK_STATE")
    for _ in range(50):
        ends.cycle()
        difference = int.from_bytes(ends.payload("LEFT_SK_STATE"), "little") ^ int.from_bytes(
            ends.nodes.frames["data"][1].tobytes(), "little"
        )
        assert difference.bit_count() == 1
        assert difference < 1 << 96  # within the 12 bytes


def test_random_losses_are_equal_for_equal_seeds(network: Network):
    def losses(seed: int) -> list[int]:
        ends = BusEnds(network)
        ends.filter._random = np.random.default_rng(seed)
        ends.filter.drop("LEFT_SK_STATE", probability=0.3)
        return [len(ends.cycle()[1]) for _ in range(200)]

    assert losses(1) == losses(1) != losses(2)
    assert 30 <= losses(1).count(2) <= 90


def test_tap_records_only_the_frames_that_passed(ends: BusEnds):
    ends.filter.drop("LEFT_SK_STATE", frames=1)
    ends.filter.drop("COMMAND_LEFT_LEG", frames=1)
    ends.cycle()
    assert (ends.sent_by_hal, ends.received_by_hal) == (1, 2)


def test_invalid_name_probability_or_delay_is_rejected(ends: BusEnds):
    with pytest.raises(ValueError, match="LEFT_SK_STATE"):
        ends.filter.drop("LEFT_SK_STAT")
    with pytest.raises(ValueError, match="probability"):
        ends.filter.drop("LEFT_SK", probability=0.0)
    with pytest.raises(ValueError, match="the parameter 'cycles' must be 1 or more, got 0"):
        ends.filter.delay("LEFT_SK", 0)

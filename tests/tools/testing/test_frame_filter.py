"""Faults of the wire by name: exactly the frames asked for are lost, late or damaged, and nothing else is touched."""

from __future__ import annotations

import numpy as np
import pytest

from atalante_dbc import Network
from atalante_hal.bus.pair import PairBus, lockstep_pair
from atalante_hal.wire.frame import Frames, new_frames
from atalante_hal.wire.process_image import TransmitImage
from atalante_tools.testing.frame_filter import FrameFilter

STATES = ("LEFT_FH_STATE", "LEFT_SK_STATE", "FOOT_LEFT_STATE")


class Ends:
    """The filter on the HAL's end, and the node's end; `cycle` is one of both."""

    def __init__(self, network: Network) -> None:
        ours, self.theirs = lockstep_pair()
        self.filter = FrameFilter(ours, network, tap=self)
        self.nodes = TransmitImage([network.message(name) for name in STATES])
        self.hal = TransmitImage([network.message("SYNC_LEFT_LEG"), network.message("COMMAND_LEFT_LEG")])
        self.sent_by_hal, self.heard_by_hal = 0, 0
        self._names = {m.frame_id: m.name for m in network.messages}
        self._scratch = new_frames(64)

    def sent(self, frames: Frames) -> None:
        self.sent_by_hal += len(frames)

    def received(self, frames: Frames, count: int) -> None:
        self.heard_by_hal += count

    def cycle(self) -> tuple[list[str], list[str]]:
        """What the node hears and what the HAL hears, in order."""
        self.filter.send(self.hal.seal())
        at_node = self._take(self.theirs)
        self.theirs.send(self.nodes.seal())
        return at_node, self._take(self.filter)

    def _take(self, end: PairBus | FrameFilter) -> list[str]:
        count = end.receive(self._scratch)
        return [self._names[frame_id] for frame_id in self._scratch["can_id"][:count].tolist()]

    def payload(self, name: str) -> bytes:
        """Of the last cycle at the HAL."""
        frame_id = next(i for i, n in self._names.items() if n == name)
        return self._scratch[self._scratch["can_id"] == frame_id]["data"][0].tobytes()


@pytest.fixture
def ends(network: Network) -> Ends:
    return Ends(network)


def test_without_faults_everything_passes_untouched(ends: Ends):
    for _ in range(3):
        assert ends.cycle() == (["SYNC_LEFT_LEG", "COMMAND_LEFT_LEG"], list(STATES))
        assert ends.payload("LEFT_SK_STATE") == ends.nodes.frames["data"][1].tobytes()


def test_a_message_is_dropped_as_often_as_asked(ends: Ends):
    fault = ends.filter.drop("LEFT_SK_STATE", frames=2)
    heard = [ends.cycle()[1] for _ in range(4)]
    assert [names == list(STATES) for names in heard] == [False, False, True, True]
    assert heard[0] == ["LEFT_FH_STATE", "FOOT_LEFT_STATE"]
    assert fault.hit == 2
    assert ends.filter.faults == []


def test_a_node_a_pattern_and_the_hals_own_messages_have_names_too(ends: Ends):
    fault = ends.filter.drop("LEFT_SK")
    assert ends.cycle()[1] == ["LEFT_FH_STATE", "FOOT_LEFT_STATE"]
    fault.end()
    ends.filter.drop("LEFT_*_STATE", frames=1)
    assert ends.cycle()[1] == ["FOOT_LEFT_STATE"]
    ends.filter.drop("COMMAND_LEFT_LEG", frames=1)
    assert ends.cycle() == (["SYNC_LEFT_LEG"], list(STATES))
    assert ends.cycle() == (["SYNC_LEFT_LEG", "COMMAND_LEFT_LEG"], list(STATES))


def test_a_fault_without_a_number_lasts_until_it_ends(ends: Ends):
    ends.filter.drop("*_STATE")
    assert all(ends.cycle()[1] == [] for _ in range(10))
    ends.filter.clear()
    assert ends.cycle()[1] == list(STATES)


@pytest.mark.parametrize("cycles", [1, 3])
def test_a_delayed_frame_arrives_that_many_cycles_later_and_as_it_was(ends: Ends, cycles: int):
    ends.filter.delay("LEFT_FH_STATE", cycles, frames=1)
    heard = [ends.cycle()[1]]
    first = ends.nodes.frames["data"][0].tobytes()
    heard += [ends.cycle()[1] for _ in range(cycles)]
    assert [names.count("LEFT_FH_STATE") for names in heard] == [0] + [1] * (cycles - 1) + [2]
    assert heard[-1][0] == "LEFT_FH_STATE"
    assert ends._scratch["data"][0].tobytes() == first  # the late one comes before the new one
    assert ends.cycle()[1] == list(STATES)


def test_a_delayed_command_arrives_with_a_later_cycle(ends: Ends):
    ends.filter.delay("COMMAND_LEFT_LEG", 2, frames=1)
    assert [ends.cycle()[0].count("COMMAND_LEFT_LEG") for _ in range(4)] == [0, 1, 2, 1]


def test_damage_is_one_bit_of_the_payload(ends: Ends):
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
        assert difference < 1 << 96  # inside the 12 bytes


def test_what_happens_at_random_is_the_same_for_the_same_seed(network: Network):
    def losses(seed: int) -> list[int]:
        ends = Ends(network)
        ends.filter._random = np.random.default_rng(seed)
        ends.filter.drop("LEFT_SK_STATE", probability=0.3)
        return [len(ends.cycle()[1]) for _ in range(200)]

    assert losses(1) == losses(1) != losses(2)
    assert 30 <= losses(1).count(2) <= 90


def test_the_tap_sees_what_really_passed(ends: Ends):
    ends.filter.drop("LEFT_SK_STATE", frames=1)
    ends.filter.drop("COMMAND_LEFT_LEG", frames=1)
    ends.cycle()
    assert (ends.sent_by_hal, ends.heard_by_hal) == (1, 2)


def test_names_that_are_none_are_answered_with_near_ones(ends: Ends):
    with pytest.raises(ValueError, match="LEFT_SK_STATE"):
        ends.filter.drop("LEFT_SK_STAT")
    with pytest.raises(ValueError, match="probability"):
        ends.filter.drop("LEFT_SK", probability=0.0)
    with pytest.raises(ValueError, match="cycles of a delay must be 1 or more, got 0"):
        ends.filter.delay("LEFT_SK", 0)

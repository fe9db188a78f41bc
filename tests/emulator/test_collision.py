from __future__ import annotations

import numpy as np
import pytest

from atalante_dbc import Network
from atalante_emulator.collision import Senders
from atalante_hal.wire.frame import Frames, new_frames
from atalante_hal.wire.process_image import TransmitImage

NAME = "COMMAND_LEFT_LEG"


class Source:
    """Makes right frames of the message: counter, and a torque that tells who sent it."""

    def __init__(self, network: Network) -> None:
        self._tx = TransmitImage([network.message(NAME)])
        self._torque = self._tx.codec.index(NAME, "SK_TargetTorque")

    def __call__(self, counter: int, torque: float = 0.0) -> Frames:
        self._tx.values[self._torque] = torque
        self._tx.resume(0, (counter - 1) & 0xFF)
        return self._tx.seal().copy()


@pytest.fixture
def frame(network: Network) -> Source:
    return Source(network)


def judge(network: Network, *cycles: list[Frames]) -> list[bool]:
    senders = Senders(network.message(NAME))
    return [
        senders.are_two(np.concatenate(frames) if frames else new_frames(0), cycle)
        for cycle, frames in enumerate(cycles)
    ]


def test_one_sender_is_one(network: Network, frame: Source) -> None:
    assert judge(network, *([frame(n, n)] for n in range(250, 270))) == [False] * 20


@pytest.mark.parametrize("lost", [1, 4, 5, 100])
def test_lost_frames_are_lost(network: Network, frame: Source, lost: int) -> None:
    assert not any(judge(network, [frame(7)], *([[]] * lost), [frame(8 + lost, 1.0)]))
    assert not any(judge(network, [frame(7)], [frame(8 + lost, 1.0)]))


def test_the_same_frame_twice_is_one_sender(network: Network, frame: Source) -> None:
    assert not any(judge(network, [frame(7), frame(7)], [frame(7), frame(8, 1.0), frame(8, 1.0)], [frame(8, 1.0)]))


def test_a_backlog_is_one_sender(network: Network, frame: Source) -> None:
    assert not any(judge(network, [], [frame(255), frame(0, 1.0), frame(1, 2.0)]))


@pytest.mark.parametrize("ahead", [1, 2, 5, 6, 100, 254, 255])
def test_another_sender_before_the_true_one(network: Network, frame: Source, ahead: int) -> None:
    true = 9
    assert judge(network, [frame(8)], [frame(8 + ahead, 50.0), frame(true)])[1]


def test_another_sender_with_the_counter_of_the_last_frame(network: Network, frame: Source) -> None:
    assert judge(network, [frame(8)], [frame(8, 50.0), frame(9)]) == [False, True]


def test_another_sender_behind_the_true_one_is_found_in_the_next_cycle(network: Network, frame: Source) -> None:
    assert judge(network, [frame(8), frame(9, 50.0)], [frame(9)]) == [False, True]
    assert judge(network, [frame(8), frame(9, 50.0)], [frame(9), frame(10, 50.0)]) == [False, True]


def test_what_was_heard_long_ago_says_nothing(network: Network, frame: Source) -> None:
    senders = Senders(network.message(NAME))
    assert not senders.are_two(frame(8), 1)
    assert not senders.are_two(frame(8, 50.0), 3)
    assert senders.are_two(frame(8), 4)


@pytest.mark.parametrize("spoil", ["crc", "length", "other"])
def test_frames_that_are_not_right_are_not_heard(network: Network, frame: Source, spoil: str) -> None:
    wrong = frame(9, 50.0)
    if spoil == "crc":
        wrong["data"][0, 40] ^= 1
    elif spoil == "length":
        wrong["len"] = 64
    else:
        wrong["can_id"] = network.message("COMMAND_RIGHT_LEG").frame_id
    assert not any(judge(network, [frame(8)], [wrong, frame(9)]))

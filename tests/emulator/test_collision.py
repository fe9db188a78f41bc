from __future__ import annotations

import numpy as np
import pytest

from atalante_dbc import Network
from atalante_emulator.collision import Senders
from atalante_hal.wire.frame import Frames, new_frames
from atalante_hal.wire.process_image import TransmitImage

NAME = "COMMAND_LEFT_LEG"


class FrameSource:
    """Source of command frames with a given counter and torque. The two senders use different torques."""

    def __init__(self, network: Network) -> None:
        self._tx = TransmitImage([network.message(NAME)])
        self._torque = self._tx.codec.index(NAME, "SK_TargetTorque")

    def __call__(self, counter: int, torque: float = 0.0) -> Frames:
        self._tx.values[self._torque] = torque
        self._tx.set_counter(0, (counter - 1) & 0xFF)
        return self._tx.seal().copy()


@pytest.fixture
def frame(network: Network) -> FrameSource:
    return FrameSource(network)


def second_sender_found(network: Network, *cycles: list[Frames]) -> list[bool]:
    senders = Senders(network.message(NAME))
    return [
        senders.are_two(np.concatenate(frames) if frames else new_frames(0), cycle)
        for cycle, frames in enumerate(cycles)
    ]


def test_frames_of_one_sender_are_not_reported(network: Network, frame: FrameSource) -> None:
    assert second_sender_found(network, *([frame(n, n)] for n in range(250, 270))) == [False] * 20


@pytest.mark.parametrize("lost", [1, 4, 5, 100])
def test_lost_frames_are_not_reported_as_a_second_sender(network: Network, frame: FrameSource, lost: int) -> None:
    assert not any(second_sender_found(network, [frame(7)], *([[]] * lost), [frame(8 + lost, 1.0)]))
    assert not any(second_sender_found(network, [frame(7)], [frame(8 + lost, 1.0)]))


def test_identical_repeated_frames_are_not_reported_as_a_second_sender(network: Network, frame: FrameSource) -> None:
    assert not any(
        second_sender_found(network, [frame(7), frame(7)], [frame(7), frame(8, 1.0), frame(8, 1.0)], [frame(8, 1.0)])
    )


def test_consecutive_frames_in_one_cycle_are_not_reported_as_a_second_sender(
    network: Network, frame: FrameSource
) -> None:
    assert not any(second_sender_found(network, [], [frame(255), frame(0, 1.0), frame(1, 2.0)]))


@pytest.mark.parametrize("ahead", [1, 2, 5, 6, 100, 254, 255])
def test_second_sender_ahead_of_the_counter_is_reported_in_the_same_cycle(
    network: Network, frame: FrameSource, ahead: int
) -> None:
    true = 9
    assert second_sender_found(network, [frame(8)], [frame(8 + ahead, 50.0), frame(true)])[1]


def test_second_sender_that_repeats_the_last_counter_is_reported(network: Network, frame: FrameSource) -> None:
    assert second_sender_found(network, [frame(8)], [frame(8, 50.0), frame(9)]) == [False, True]


def test_second_sender_after_the_true_frame_is_reported_in_the_next_cycle(network: Network, frame: FrameSource) -> None:
    assert second_sender_found(network, [frame(8), frame(9, 50.0)], [frame(9)]) == [False, True]
    assert second_sender_found(network, [frame(8), frame(9, 50.0)], [frame(9), frame(10, 50.0)]) == [False, True]


def test_frames_more_than_one_cycle_apart_are_not_compared(network: Network, frame: FrameSource) -> None:
    senders = Senders(network.message(NAME))
    assert not senders.are_two(frame(8), 1)
    assert not senders.are_two(frame(8, 50.0), 3)
    assert senders.are_two(frame(8), 4)


@pytest.mark.parametrize("defect", ["crc", "length", "other"])
def test_invalid_or_unrelated_frames_are_ignored(network: Network, frame: FrameSource, defect: str) -> None:
    wrong = frame(9, 50.0)
    if defect == "crc":
        wrong["data"][0, 40] ^= 1
    elif defect == "length":
        wrong["len"] = 64
    else:
        wrong["can_id"] = network.message("COMMAND_RIGHT_LEG").frame_id
    assert not any(second_sender_found(network, [frame(8)], [wrong, frame(9)]))

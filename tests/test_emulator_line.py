"""The emulated robot's end of a bus that other processes are on."""

from __future__ import annotations

import numpy as np

from atalante_hal.bus.pair import PairBus, lockstep_pair
from atalante_hal.frame import FRAME, Frames, new_frames
from atalante_tools.emulator_line import Line


def frames_with(ids: list[int]) -> Frames:
    frames = new_frames(len(ids))
    frames["can_id"], frames["len"], frames["flags"] = ids, 8, 4
    return frames


def received(bus: PairBus) -> list[int]:
    block = new_frames(32)
    ids: list[int] = block["can_id"][: bus.receive(block)].tolist()
    return ids


def test_the_line_counts_and_keeps_the_pendant_back_once_another_speaks() -> None:
    near, far = lockstep_pair()
    line = Line(near, pendant_id=0x194)
    batch, alone, none = frames_with([0x181, 0x194, 0x701]), frames_with([0x194]), new_frames(0)
    line.send(batch)
    assert received(far) == [0x181, 0x194, 0x701]
    far.send(frames_with([0x10, 0x100]))
    assert line.receive(new_frames(8)) == 2
    assert not line.pendant_given_away
    far.send(frames_with([0x10, 0x194]))
    line.receive(new_frames(8))
    assert line.pendant_given_away
    for _ in range(3):
        line.send(batch)
        line.send(alone)
        line.send(none)
        assert received(far) == [0x181, 0x701]
    assert (line.sent, line.received) == (9, 4)


def test_what_lies_behind_the_received_frames_is_not_heard() -> None:
    near, far = lockstep_pair()
    line = Line(near, pendant_id=0x194)
    block = frames_with([0x194] * 8)
    far.send(frames_with([0x10]))
    assert line.receive(block) == 1
    assert not line.pendant_given_away
    assert line.stamps.dtype == np.int64
    assert (line.dropped, line.name, block.dtype) == (0, near.name, FRAME)

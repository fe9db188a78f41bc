"""Run a small part of `make fuzz` (10 million frames at each end), and check that the fuzzer finds injected defects."""

from __future__ import annotations

from collections import Counter
from typing import Any

import numpy as np
import pytest
from frame_fuzzer import RECEIVE_BUDGET, SWEEP, Finding, Fuzzer, Oracle, fuzz_image, fuzzed_robot, images

import atalante_dbc
from atalante_emulator.drive import Drives
from atalante_hal.robot import JOINTS
from atalante_hal.types import SupervisorState
from atalante_hal.wire.e2e import CRC_BYTES, Check, crc, data_id_bytes
from atalante_hal.wire.frame import Frames, as_words, new_frames
from atalante_hal.wire.process_image import ReceiveImage, TransmitImage

NETWORK = atalante_dbc.load()
IMAGES = {name: messages for name, (messages, _) in images(NETWORK).items()}


@pytest.mark.parametrize("name", IMAGES)
def test_receive_image_accepts_only_intact_frames(name: str) -> None:
    messages = IMAGES[name]
    *_, tally = fuzz_image(messages, 20_000, seed=3, per_cycle=min(100, RECEIVE_BUDGET - len(messages)))
    assert tally.frames == 20_000
    assert 0.1 < tally.intact / tally.frames < 0.2


def test_hal_and_nodes_survive_fuzzed_frames() -> None:
    with fuzzed_robot(seed=5) as robot:
        robot.run(20_000)
        assert max(end.most for end in robot.ends) == RECEIVE_BUDGET
        assert {SupervisorState.READY, SupervisorState.ACTIVE, SupervisorState.HOLD} <= robot.states_seen


def test_fuzzer_covers_every_identifier_length_and_flag() -> None:
    fuzzer, seen = Fuzzer(1, NETWORK.messages), set()
    nothing = new_frames(0)
    fuzzer._swept = 0
    swept = new_frames(SWEEP)
    fuzzer._sweep(swept, SWEEP)
    seen = set(as_words(swept)[:, 0].tolist())
    assert len(seen) == SWEEP
    anything = fuzzer.frames(20_000, nothing)
    assert anything["can_id"].max() > 1 << 31
    assert anything["len"].max() == 255


def test_resealed_frames_are_intact_and_damaged_ones_are_not() -> None:
    messages = IMAGES["HAL, every cycle"]
    genuine = TransmitImage(messages).seal()
    fuzzer, oracle = Fuzzer(1, messages), Oracle(messages)
    assert sum(map(len, oracle.intact(genuine).values())) == len(messages)
    sealed = genuine.copy()
    fuzzer._seal_again(sealed)
    assert sum(map(len, oracle.intact(sealed).values())) == len(messages)
    damaged = np.repeat(genuine, 50)
    fuzzer._damage(damaged)
    assert sum(map(len, oracle.intact(damaged).values())) < 3


def run_image(name: str) -> None:
    Counter(tally.cycles for tally in fuzz_image(IMAGES[name], 20_000, seed=1))


@pytest.mark.parametrize("name", ["HAL, every cycle", "nodes"])
def test_fuzzer_finds_a_receive_image_without_crc_check(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    accept_each = ReceiveImage.accept_each

    def accept_damaged(image: ReceiveImage, frames: Frames, count: int, tag: int | None = None) -> list[int]:
        frames = frames.copy()
        for frame in frames[:count]:
            row = image.frame_ids.get(int(frame["can_id"]))
            if row is not None:
                message = image.codec.messages[row]
                data = frame["data"][: message.length]
                data[:CRC_BYTES] = list(
                    crc(data[CRC_BYTES:].tobytes(), data_id_bytes(message.data_id)).to_bytes(CRC_BYTES, "little")
                )
        return accept_each(image, frames, count, tag)

    monkeypatch.setattr(ReceiveImage, "accept_each", accept_damaged)
    with pytest.raises(Finding, match="accepted a frame that is not intact"):
        run_image(name)


def test_fuzzer_finds_a_receive_image_without_range_check(monkeypatch: pytest.MonkeyPatch) -> None:
    accept_each = ReceiveImage.accept_each

    def accept_anything(image: ReceiveImage, frames: Frames, count: int, tag: int | None = None) -> list[int]:
        unknown = accept_each(image, frames, count, tag)
        for row, reason in image.refused:
            if reason is Check.RANGE:
                image.values[image.codec.row_of == row] = 1e9
        return unknown

    monkeypatch.setattr(ReceiveImage, "accept_each", accept_anything)
    with pytest.raises(Finding, match="left its range"):
        run_image("HAL, every cycle")


def test_fuzzer_finds_a_drive_without_torque_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    command = Drives.command

    def command_without_limit(drives: Drives, *arguments: Any) -> None:
        command(drives, *arguments)
        drives._limit = drives._own_limit = np.full(len(JOINTS), 1e6)

    monkeypatch.setattr(Drives, "command", command_without_limit)
    with fuzzed_robot(seed=2) as robot, pytest.raises(Finding, match="a drive exerts"):
        robot.run(60_000)

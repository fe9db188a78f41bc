"""A desk with one emulated node on it, whose frames and insides a test can spoil."""

from __future__ import annotations

from binascii import crc_hqx
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

from atalante_dbc import Message, Network
from atalante_emulator.body import PyBulletBody
from atalante_emulator.emulator import Emulator
from atalante_emulator.pendant import Operator
from atalante_hal.bus.pair import PairBus, lockstep_pair
from atalante_hal.robot import Robot
from atalante_hal.wire.frame import FLAG_BRS, FLAG_FDF, Frames, joined, new_frames
from atalante_tools.conform.bench import Bench, Limits, LockStep
from atalante_tools.conform.examination import requirements_of
from atalante_tools.conform.requirement import Result, Verdict, examine
from atalante_tools.conform.technician import EmulatorTechnician

NO_FRAME = new_frames(0)


class Wire:
    """The bench's end of the pair; `to_node` and `from_node` take a frame and return the frames that arrive."""

    def __init__(self, bus: PairBus) -> None:
        self._bus = bus
        self.to_node: Callable[[Frames], Frames] | None = None
        self.from_node: Callable[[Frames], Frames] | None = None
        #: Frames the node says besides, asked at every receive.
        self.out_of_the_blue: Callable[[], Frames] = lambda: NO_FRAME
        self.sync_sent = False  # since the last receive
        self._syncs = range(0x10, 0x14)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._bus, name)

    def send(self, frames: Frames) -> None:
        self.sync_sent |= int(frames["can_id"][-1]) in self._syncs
        if self.to_node is None:
            self._bus.send(frames)
            return
        for place in range(len(frames)):
            kept = self.to_node(frames[place : place + 1].copy())
            if len(kept):
                self._bus.send(kept)

    def receive(self, frames: Frames, timeout: float = 0.0) -> int:
        count = self._bus.receive(frames, timeout)
        if self.from_node is not None:
            kept = [self.from_node(frames[place : place + 1].copy()) for place in range(count)]
            together = joined([*kept, self.out_of_the_blue()])
            count = len(together)
            frames[:count] = together
        self.sync_sent = False
        return count


def protect(frame: Frames, message: Message, *, counter: int | None = None, data_id: int | None = None) -> Frames:
    """Make length, format, counter and CRC of a frame right again. Independent of the code under test."""
    frame["len"], frame["flags"] = message.length, FLAG_FDF | FLAG_BRS
    data = frame["data"][0]
    data[message.length :] = 0
    if counter is not None:
        data[2] = counter & 0xFF
    secret = message.data_id if data_id is None else data_id
    code = crc_hqx(secret.to_bytes(2, "little"), crc_hqx(data[2 : message.length].tobytes(), 0xFFFF))
    data[:2] = code & 0xFF, code >> 8
    return frame


def crc_holds(frame: Frames, data_id: int) -> bool:
    """Whether a frame is intact, at the length it has."""
    data = frame["data"][0][: frame["len"][0]].tobytes()
    return crc_hqx(data_id.to_bytes(2, "little"), crc_hqx(data[2:], 0xFFFF)) == int.from_bytes(data[:2], "little")


def is_good(frame: Frames, message: Message) -> bool:
    """Whether length, format and CRC are right."""
    shape = int(frame["len"][0]), int(frame["flags"][0]) & FLAG_FDF
    return shape == (message.length, FLAG_FDF) and crc_holds(frame, message.data_id)


def raw(frame: Frames, message: Message, signal: str) -> int:
    """Code of a signal in a frame."""
    s = message.signal(signal)
    return int.from_bytes(frame["data"][0].tobytes(), "little") >> s.start & (1 << s.length) - 1


def put(frame: Frames, message: Message, signal: str, code: int) -> None:
    """Write the code of a signal into a frame."""
    s = message.signal(signal)
    payload = int.from_bytes(frame["data"][0].tobytes(), "little")
    payload = payload & ~((1 << s.length) - 1 << s.start) | code << s.start
    frame["data"][0] = np.frombuffer(payload.to_bytes(64, "little"), np.uint8)


@dataclass
class Desk:
    """One node, and the bench it is examined on."""

    bench: Bench
    wire: Wire
    emulator: Emulator

    def message(self, kind: str) -> Message:
        return self.bench.network.message(f"{self.bench.node.name}_{kind}")

    def examine(self, without: Sequence[str] = ()) -> list[Result]:
        return list(examine(self.bench, [r for r in requirements_of(self.bench) if r.id not in without]))


#: Takes a frame of the HAL for another: `(frame, message, memory)`; None: as it is. `memory["other"]` is another Data ID.
Reading = Callable[[Frames, Message, dict], Frames | None]


def hear_as(desk: Desk, message: Message, other_data_id: int, change: Reading) -> Desk:
    """Let the node on the desk read one message of the HAL as another."""
    memory: dict = {"other": other_data_id}

    def to_node(frame: Frames) -> Frames:
        if int(frame["can_id"][0]) != message.frame_id:
            return frame
        changed = change(frame.copy(), message, memory)
        return frame if changed is None else changed

    desk.wire.to_node = to_node
    return desk


def no_crc(frame: Frames, message: Message, memory: dict) -> Frames | None:
    """Take damaged frames for good ones."""
    if crc_holds(frame, message.data_id) or crc_holds(frame, memory["other"]):
        return None
    return protect(frame, message)


def no_data_id(frame: Frames, message: Message, memory: dict) -> Frames | None:
    """Take another message's frames for its own."""
    return protect(frame, message) if crc_holds(frame, memory["other"]) else None


def no_repetition(frame: Frames, message: Message, memory: dict) -> Frames | None:
    """Take a repeated frame for a new one."""
    if not is_good(frame, message):
        return None
    counter = int(frame["data"][0][2])
    memory["shift"] = memory.get("shift", 0) + (counter == memory.get("last"))
    memory["last"] = counter
    return protect(frame, message, counter=counter + memory["shift"])


def no_length(frame: Frames, message: Message, _: dict) -> Frames | None:
    """Take a frame of another length or format for one of its own."""
    shape = int(frame["len"][0]), int(frame["flags"][0]) & FLAG_FDF
    return None if shape == (message.length, FLAG_FDF) else protect(frame, message)


def not_passed(results: list[Result]) -> dict[str, Verdict]:
    """Id -> verdict of what did not pass."""
    return {r.requirement.id: r.verdict for r in results if r.verdict is not Verdict.PASSED}


MakeDesk = Callable[..., Desk]


@pytest.fixture
def make_desk(network: Network, robot: Robot, urdf_text: str) -> Iterator[MakeDesk]:
    bodies: list[PyBulletBody] = []

    def make(
        node: str,
        *,
        their_network: Network = network,
        their_robot: Robot = robot,
        operator: Operator | None = None,
        limits: Limits | None = None,
        **options: Any,
    ) -> Desk:
        ours, theirs = lockstep_pair()
        body = PyBulletBody(urdf_text)
        bodies.append(body)
        operator = operator or Operator(starts=False)
        emulator = Emulator(their_network, their_robot, body, theirs, operator=operator, **options)
        ours.step = emulator.poll
        wire = Wire(ours)
        technician = EmulatorTechnician(emulator, operator)
        bench = Bench(network, robot, network.node(node), wire, LockStep(emulator), technician, limits)
        return Desk(bench, wire, emulator)

    yield make
    for body in bodies:
        body.close()

"""Bus of the emulated robot, shared with other processes."""

from __future__ import annotations

import numpy as np
import pytest

from atalante_dbc import Network
from atalante_emulator.body import PyBulletBody
from atalante_emulator.emulator import Emulator
from atalante_emulator.pendant import Operator
from atalante_hal.bus import BusDown, resilient
from atalante_hal.bus.pair import PairBus, lockstep_pair
from atalante_hal.bus.wrapped import WrappedBus
from atalante_hal.hal import Hal
from atalante_hal.robot import Robot
from atalante_hal.types import Command, SupervisorState
from atalante_hal.wire.cia402 import DriveState
from atalante_hal.wire.frame import FRAME, Frames, new_frames
from atalante_tools.commands.emulator import status_line
from atalante_tools.commands.emulator_line import Line

REST = Command(torque=np.zeros(12), vibration=np.zeros(8))


def frames_with(ids: list[int]) -> Frames:
    frames = new_frames(len(ids))
    frames["can_id"], frames["len"], frames["flags"] = ids, 8, 4
    return frames


def received(bus: PairBus) -> list[int]:
    block = new_frames(32)
    ids: list[int] = block["can_id"][: bus.receive(block)].tolist()
    return ids


def test_the_line_counts_frames_and_drops_its_pendant_after_another_sends() -> None:
    near, far = lockstep_pair()
    line = Line(near, pendant_id=0x194)
    batch, alone, none = frames_with([0x181, 0x194, 0x701]), frames_with([0x194]), new_frames(0)
    line.send(batch)
    assert received(far) == [0x181, 0x194, 0x701]
    far.send(frames_with([0x10, 0x100]))
    assert line.receive(new_frames(8)) == 2
    assert not line.pendant_displaced
    far.send(frames_with([0x10, 0x194]))
    line.receive(new_frames(8))
    assert line.pendant_displaced
    for _ in range(3):
        line.send(batch)
        line.send(alone)
        line.send(none)
        assert received(far) == [0x181, 0x701]
    assert (line.sent, line.received) == (9, 4)


def test_buffer_rows_after_the_received_frames_are_ignored() -> None:
    near, far = lockstep_pair()
    line = Line(near, pendant_id=0x194)
    block = frames_with([0x194] * 8)
    far.send(frames_with([0x10]))
    assert line.receive(block) == 1
    assert not line.pendant_displaced
    assert line.stamps.dtype == np.int64
    assert (line.dropped, line.name, block.dtype) == (0, near.name, FRAME)


class Interface(WrappedBus):
    """SocketCAN interface that goes down and up again: receiving fails once, sending as long as it is down."""

    _up = True
    _told = True

    def set(self, *, up: bool) -> None:
        self._up = self._told = up

    def send(self, frames: Frames) -> None:
        if not self._up:
            raise BusDown("can0 is down (Network is down): type `ip link set can0 up`")
        super().send(frames)

    def receive(self, frames: Frames, timeout: float = 0.0) -> int:
        if not self._told:
            self._told = True
            raise BusDown("can0 is down (Network is down): type `ip link set can0 up`")
        return super().receive(frames, timeout) if self._up else 0


def test_the_robot_restarts_after_the_interface_was_down(network: Network, robot: Robot, urdf_text: str) -> None:
    ours, theirs = lockstep_pair()
    interface = Interface(theirs)
    line = Line(interface, network.message("PENDANT_STATE").frame_id)
    body = PyBulletBody(urdf_text)
    emulator = Emulator(network, robot, body, line, operator=Operator())
    hal = Hal(network, robot, ours)

    def answer() -> None:
        if not emulator.poll():
            emulator.idle()  # as on the wall clock

    def cycles(count: int) -> None:
        for _ in range(count):
            if hal.read().supervisor is SupervisorState.ACTIVE:
                hal.write(REST)
            else:
                hal.hold()

    ours.step = answer
    cycles(400)
    assert hal.state.supervisor is SupervisorState.ACTIVE
    assert line.down == ""
    sent = line.sent
    interface.set(up=False)
    cycles(200)
    assert set(emulator.drives.state) == {DriveState.QUICK_STOP_ACTIVE}
    assert line.sent == sent
    assert status_line(emulator, line).endswith("; can0 is down (Network is down): type `ip link set can0 up`")
    while ours.receive(new_frames(64)) or theirs.receive(new_frames(64)):
        """What was said to an interface that is down has gone."""
    interface.set(up=True)
    cycles(200)
    assert line.sent > sent
    assert line.down == ""
    assert hal.missing() == []
    assert hal.state.supervisor is SupervisorState.HOLD
    body.close()


def test_a_removed_adapter_does_not_cause_a_busy_loop(monkeypatch: pytest.MonkeyPatch) -> None:
    near, _ = lockstep_pair()
    slept: list[float] = []
    monkeypatch.setattr(resilient.time, "sleep", slept.append)
    line = Line(near, pendant_id=0x194)
    near.close()
    for _ in range(3):
        assert line.receive(new_frames(8), 0.001) == 0
    assert slept == [0.001] * 3
    assert "closed" in line.down

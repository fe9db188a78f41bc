"""Bus of the emulated robot, shared with other processes."""

from __future__ import annotations

import numpy as np
import pytest

from atalante_dbc import Network
from atalante_emulator.bodies.pybullet_body import PyBulletBody
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
from atalante_hal.wire.process_image import TransmitImage
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


class Sender:
    """Sender of intact frames of one message with increasing counters."""

    def __init__(self, network: Network, name: str) -> None:
        self._image = TransmitImage([network.message(name)])
        if name.startswith("SYNC"):
            self._cycle = self._image.codec.index(name, "Cycle")

    def frame(self, counter: int) -> Frames:
        if hasattr(self, "_cycle"):
            self._image.values[self._cycle] = counter
        return self._image.seal(counter & 0xFF).copy()


def test_line_counts_frames_and_drops_its_pendant_once_another_sends(network: Network) -> None:
    near, far = lockstep_pair()
    line = Line(near, network)
    sync, state = Sender(network, "SYNC_RIGHT_SENSE"), Sender(network, "PENDANT_STATE")
    batch, alone, none = frames_with([0x181, 0x194, 0x714, 0x701]), frames_with([0x194]), new_frames(0)
    line.send(batch)
    assert received(far) == [0x181, 0x194, 0x714, 0x701]
    for cycle in range(10):
        far.send(np.concatenate([sync.frame(cycle), state.frame(cycle)]))
        assert line.receive(new_frames(8)) == 2
    assert line.pendant_displaced
    for _ in range(3):
        line.send(batch)
        line.send(alone)
        line.send(none)
        assert received(far) == [0x181, 0x701]
    assert (line.sent, line.received) == (10, 20)


def test_stale_or_unprotected_frame_is_not_another_pendant(network: Network) -> None:
    near, far = lockstep_pair()
    line = Line(near, network)
    sync, state = Sender(network, "SYNC_RIGHT_SENSE"), Sender(network, "PENDANT_STATE")
    for cycle in range(100):
        far.send(np.concatenate([sync.frame(cycle), state.frame(cycle - 7), frames_with([0x194])]))
        line.receive(new_frames(8))
        line.send(frames_with([0x194]))
        assert received(far) == [0x194]
    assert not line.pendant_displaced


def test_buffer_rows_after_the_received_frames_are_ignored(network: Network) -> None:
    near, far = lockstep_pair()
    line = Line(near, network)
    state, drive = Sender(network, "PENDANT_STATE"), Sender(network, "LEFT_SH_STATE")
    for cycle in range(9):
        block = np.concatenate([state.frame(cycle), state.frame(cycle), drive.frame(cycle)])
        far.send(Sender(network, "SYNC_RIGHT_SENSE").frame(cycle))
        assert line.receive(block) == 1
    assert not line.pendant_displaced
    assert line.other_robot == ""
    assert line.stamps.dtype == np.int64
    assert (line.dropped, line.name, block.dtype) == (0, near.name, FRAME)


@pytest.mark.parametrize(
    ("counters", "robot"),
    [
        ([5, 6], ""),
        ([5, 6, 7], "LEFT_SH_STATE"),
        ([254, 255, 0], "LEFT_SH_STATE"),
        ([5, 9, 13], "LEFT_SH_STATE"),
        ([5, 5, 5, 5], ""),
        ([5, 90, 6, 7, 80], ""),
    ],
)
def test_consecutive_frames_of_an_emulated_node_come_from_another_robot(
    network: Network, counters: list[int], robot: str
) -> None:
    near, far = lockstep_pair()
    line, drive = Line(near, network), Sender(network, "LEFT_SH_STATE")
    for counter in counters:
        far.send(drive.frame(counter))
        line.receive(new_frames(8))
    assert line.other_robot == robot


@pytest.mark.parametrize("message", ["LEFT_SH_STATE", "LEFT_SH_STATUS", "HAPTICS_STATE", "FOOT_LEFT_STATE"])
def test_listening_returns_the_message_of_another_robot(network: Network, message: str) -> None:
    near, far = lockstep_pair()
    line = Line(near, network)
    damaged = Sender(network, message).frame(1)
    damaged["data"][0, 4] ^= 1
    far.send(np.concatenate([damaged, Sender(network, "SYNC_RIGHT_SENSE").frame(1)]))
    far.send(np.concatenate([Sender(network, "PENDANT_STATE").frame(1), frames_with([0x183])]))
    assert line.listen(0.05) == ""
    far.send(Sender(network, message).frame(1))
    assert line.listen(0.05) == message
    assert received(far) == []
    assert (line.sent, line.received) == (0, 0)


class Interface(WrappedBus):
    """SocketCAN interface that goes down and up again: `receive` fails once, and `send` fails while it is down."""

    _up = True
    _reported = True

    def set(self, *, up: bool) -> None:
        self._up = self._reported = up

    def send(self, frames: Frames) -> None:
        if not self._up:
            raise BusDown("can0 is down (Network is down): type `ip link set can0 up`")
        super().send(frames)

    def receive(self, frames: Frames, timeout: float = 0.0) -> int:
        if not self._reported:
            self._reported = True
            raise BusDown("can0 is down (Network is down): type `ip link set can0 up`")
        return super().receive(frames, timeout) if self._up else 0


def test_the_robot_restarts_after_the_interface_was_down(network: Network, robot: Robot, urdf_text: str) -> None:
    ours, theirs = lockstep_pair()
    interface = Interface(theirs)
    line = Line(interface, network)
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
    assert status_line(emulator, line, silent=True).endswith(
        "; can0 is down (Network is down): type `ip link set can0 up`"
    )
    while ours.receive(new_frames(64)) or theirs.receive(new_frames(64)):
        pass  # frames sent while the interface was down are lost
    interface.set(up=True)
    cycles(200)
    assert line.sent > sent
    assert line.down == ""
    assert hal.missing() == []
    assert hal.state.supervisor is SupervisorState.HOLD
    body.close()


def test_a_removed_adapter_does_not_cause_a_busy_loop(network: Network, monkeypatch: pytest.MonkeyPatch) -> None:
    near, _ = lockstep_pair()
    slept: list[float] = []
    monkeypatch.setattr(resilient.time, "sleep", slept.append)
    monkeypatch.setattr(resilient.time, "monotonic", lambda: 0.0)
    line = Line(near, network)
    near.close()
    for _ in range(3):
        assert line.receive(new_frames(8), 0.001) == 0
    assert slept == [0.001] * 3
    assert "closed" in line.down

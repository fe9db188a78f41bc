"""`SocketCanBus` on a simulated kernel: link errors in orders that a real kernel produces only sometimes."""

from __future__ import annotations

import ctypes
import errno
import os
import socket
from collections.abc import Callable
from contextlib import nullcontext
from types import SimpleNamespace

import pytest

from atalante_hal.bus import BusAbsent, BusDown, BusError, socketcan
from atalante_hal.bus.resilient import ResilientBus
from atalante_hal.bus.socketcan import SocketCanBus
from atalante_hal.wire.frame import new_frames

CHANNEL = "can0"


class Kernel:
    """Kernel with one interface, whose sockets receive errors but no frames.

    Attributes:
        errors: Error codes of the next calls of `recvmmsg`. If the list is empty, the error code is EAGAIN.
        present: Whether the interface exists.
        bound: Name of the interface to which the newest socket is bound; empty if none.
    """

    def __init__(self) -> None:
        self.errors: list[int] = []
        self.present = True
        self.bound = ""

    def take_down(self) -> None:
        self.errors.append(errno.ENETDOWN)

    def remove(self) -> None:
        self.present, self.bound = False, ""
        self.errors.append(errno.ENODEV)

    def socket(self, *_: int) -> Socket:
        return Socket(self)

    def library(self, *_: object, **__: object) -> SimpleNamespace:
        def function(call: Callable[[], int]) -> Callable[..., int]:
            return lambda *_: call()

        return SimpleNamespace(recvmmsg=function(self._recvmmsg), sendmmsg=function(int), ppoll=function(int))

    def _recvmmsg(self) -> int:
        ctypes.set_errno(self.errors.pop(0) if self.errors else errno.EAGAIN)
        return -1


class Socket:
    """Raw CAN socket of a `Kernel`."""

    def __init__(self, kernel: Kernel) -> None:
        self._kernel, self._file = kernel, os.memfd_create("socket")

    def __enter__(self) -> Socket:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def bind(self, address: tuple[str]) -> None:
        (self._kernel.bound,) = address

    def getsockname(self) -> tuple[str, int]:
        return self._kernel.bound, socket.AF_CAN

    def setsockopt(self, *_: int) -> None:
        """Accept every option."""

    def fileno(self) -> int:
        return self._file

    def close(self) -> None:
        os.close(self._file)


@pytest.fixture
def kernel(monkeypatch: pytest.MonkeyPatch) -> Kernel:
    made = Kernel()
    monkeypatch.setattr(socketcan.ctypes, "CDLL", made.library)
    monkeypatch.setattr(socketcan.socket, "socket", made.socket)
    monkeypatch.setattr(socketcan, "require_channel", lambda channel: None)
    monkeypatch.setattr(socketcan, "is_present", lambda channel: made.present)
    monkeypatch.setattr(socketcan, "REOPEN_PERIOD", 0.0)
    return made


def test_interface_that_is_down_is_not_opened_again(kernel: Kernel) -> None:
    bus = SocketCanBus(CHANNEL)
    kernel.take_down()
    with pytest.raises(BusDown, match="can0 is down: type `ip link set can0 up`"):
        bus.receive(new_frames(1))
    assert bus.receive(new_frames(1)) == 0
    bus.close()


@pytest.mark.parametrize("code", [errno.ENETDOWN, errno.EIO])
def test_error_contains_the_number_of_frames_sent_before(kernel: Kernel, code: int) -> None:
    bus = SocketCanBus(CHANNEL)
    answers = iter([2, -1])

    def sendmmsg(*_: int) -> int:
        ctypes.set_errno(code)
        return next(answers)

    bus._sendmmsg = sendmmsg
    with pytest.raises(BusError) as refusal:
        bus.send(new_frames(4))
    assert refusal.value.sent == 2
    bus.close()


def test_removal_right_after_a_link_down_is_detected_by_receive(
    kernel: Kernel,
) -> None:
    bus = ResilientBus(SocketCanBus(CHANNEL))
    kernel.take_down()
    kernel.remove()  # the second error is queued before the bus has read the first one
    assert bus.receive(new_frames(1)) == 0
    assert "can0 was removed" in bus.down
    kernel.present = True
    assert bus.receive(new_frames(1)) == 0
    assert kernel.bound == CHANNEL
    bus.close()


@pytest.mark.parametrize(
    ("channel", "remedy"),
    [("can0", "plug the adapter in and load its driver;"), ("vcan0", "type `ip link add vcan0 type vcan && ")],
)
def test_only_a_virtual_interface_that_is_missing_is_to_be_created(
    monkeypatch: pytest.MonkeyPatch, channel: str, remedy: str
) -> None:
    monkeypatch.setattr(socket, "socket", lambda *_: nullcontext())
    monkeypatch.setattr(socketcan, "is_present", lambda channel: False)
    with pytest.raises(BusAbsent, match=f"there is no interface {channel}: {remedy}"):
        socketcan.require_channel(channel)

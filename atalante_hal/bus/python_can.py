"""Bus on a python-can interface with CAN FD, for adapters without SocketCAN and for tests.

The bus takes about 6 us for each frame. For an interface that the kernel supports, use `socketcan.SocketCanBus`, which is
faster.
"""

from __future__ import annotations

import errno
import time
from typing import Any

import can
import numpy as np

from atalante_hal.bus import BusAbsent, BusDown, BusFull, Stamps
from atalante_hal.bus.adapters import refusal, reports_can_fd
from atalante_hal.bus.batch import Batches, is_legal
from atalante_hal.wire.frame import (
    FLAG_BRS,
    FLAG_ESI,
    FLAG_FDF,
    FRAME_BYTES,
    FRAME_STRUCT,
    ID_ERROR,
    ID_EXTENDED,
    ID_MASK,
    ID_REMOTE,
    Frames,
)

#: Remedy of a lost link.
RESTART = "restart this program when the link works again, because python-can does not open it again"
LINK_LOST = (errno.ENETDOWN, errno.ENODEV, errno.ENXIO, errno.EBADF)
#: Exceptions that `can.Bus` raises if it cannot open a channel. For example, kvaser without its driver library raises NameError.
_OPEN_ERRORS = (can.CanError, OSError, ValueError, TypeError, ImportError, NameError, LookupError, AttributeError)


class PythonCanBus:
    """Bus on one channel of a python-can interface.

    A lost link is not opened again, so the program must be restarted. Some backends accept frames also on a lost link, so
    `send` raises `BusDown` after a loss until a frame is received, which proves that the link works.

    Args:
        interface: Name of the interface in python-can.
        channel: Name of the channel.
        capacity: Largest number of frames that one `receive()` returns.
        **options: Keyword arguments of `can.Bus`.

    Attributes:
        dropped: Number of received messages that are not valid CAN frames, such as an FD message of 13 bytes or a damaged line
            of slcan. Frames lost in the adapter are not counted, because python-can does not report them.

    Raises:
        BusAbsent: If the interface is unknown or has no CAN FD (`adapters.refusal`), or if python-can cannot open the channel or
            opens it for classic CAN only.
    """

    def __init__(self, interface: str, channel: str, capacity: int = 256, **options: Any) -> None:
        self.name = f"{interface}:{channel}"
        self.dropped = 0
        self.stamps: Stamps = np.zeros(capacity, np.int64)
        self._capacity = capacity
        self._batches = Batches()
        self._closed = False
        self._loss = ""  # error message of the lost link; empty while the link works
        self._bus = _open(interface, channel, options)
        self._link_errors = _link_errors(interface)

    def send(self, frames: Frames) -> None:
        """Send each frame as a python-can message.

        Args:
            frames: Frames to send, shape (n,).

        Raises:
            BusFull: If python-can accepted only a part of the frames.
            BusDown: If the bus is closed or down, or if no frame was received since the link was lost.
            ValueError: If a frame is not a valid CAN frame.
        """
        self._require_open()
        memory, _ = self._batches.to_send(frames)
        for sent, (can_id, length, flags, data) in enumerate(FRAME_STRUCT.iter_unpack(memory)):
            try:
                self._bus.send(message_of(can_id, length, flags, data), timeout=0.0)
            except can.CanOperationError as error:
                if error.error_code in LINK_LOST:
                    raise self._down(f"is down: {error}", sent) from error
                raise BusFull(f"{self.name} accepted {sent} of {len(frames)} frames: {error}", sent) from error
            except self._link_errors as error:
                raise self._down(f"is down: {error}", sent) from error
        if self._loss:
            raise self._down(self._loss, len(frames))

    def receive(self, frames: Frames, timeout: float = 0.0) -> int:
        """Write the received messages to `frames[:n]` and return n, see `Bus.receive`.

        Args:
            frames: Receive buffer, shape (m,) with m >= n.
            timeout: Longest wait for the first message [s].

        Returns:
            Number of received frames n.

        Raises:
            BusDown: If the bus is closed or cannot receive.
        """
        self._require_open()
        memory = self._batches.to_fill(frames)
        room = min(len(frames), self._capacity)
        count = 0
        while count < room:
            try:
                message = self._bus.recv(0.0 if count else timeout)
            except self._link_errors as error:
                raise self._down(f"cannot receive: {error}") from error
            except (ValueError, LookupError):  # raised by the backend `slcan` for a damaged line
                self.dropped += 1
                continue
            if message is None:
                break
            if pack(message, memory, count * FRAME_BYTES):
                self.stamps[count] = round(message.timestamp * 1e9) if message.timestamp else time.time_ns()
                count += 1
            else:
                self.dropped += 1
        if count:
            self._loss = ""
        return count

    def close(self) -> None:
        """Shut down the python-can bus; a second call has no effect."""
        if not self._closed:
            self._closed = True
            lost: tuple[type[Exception], ...] = (*self._link_errors, ValueError)
            try:
                self._bus.shutdown()
            except lost:  # the backend `remote` raises ValueError if its connection was lost
                can.BusABC.shutdown(self._bus)

    def _down(self, loss: str, sent: int = 0) -> BusDown:
        """Store that the link is lost, and return the error to raise. Its message ends with the remedy.

        Args:
            loss: Error message without the name of the bus.
            sent: Number of frames that python-can accepted.
        """
        self._loss = loss
        error = BusDown(f"{self.name} {loss}; {RESTART}", sent)
        error.reopens = False
        return error

    def _require_open(self) -> None:
        if self._closed:
            raise BusDown(f"{self.name} is closed")


def message_of(can_id: int, length: int, flags: int, data: bytes) -> can.Message:
    """Convert one valid frame to a python-can message.

    Args:
        can_id: Identifier with the flags of `struct canfd_frame`.
        length: Payload length [bytes].
        flags: CAN FD flags of the frame.
        data: Payload buffer of 64 bytes.

    Returns:
        The message.
    """
    remote = bool(can_id & ID_REMOTE)
    return can.Message(
        arbitration_id=can_id & ID_MASK,
        is_extended_id=bool(can_id & ID_EXTENDED),
        is_remote_frame=remote,
        is_error_frame=bool(can_id & ID_ERROR),
        is_fd=bool(flags & FLAG_FDF),
        bitrate_switch=bool(flags & FLAG_BRS),
        error_state_indicator=bool(flags & FLAG_ESI),
        dlc=length,
        data=None if remote else bytearray(data[:length]),
    )


def pack(message: can.Message, memory: memoryview, offset: int) -> bool:
    """Write a python-can message as one `FRAME` if the message is a valid CAN frame.

    Args:
        message: Received message.
        memory: Bytes of a frame array.
        offset: Offset of the frame in `memory` [bytes].

    Returns:
        True if the frame was written; False if the message is not a valid CAN frame.
    """
    can_id = message.arbitration_id
    if message.is_extended_id and not message.is_error_frame:
        can_id |= ID_EXTENDED
    remote = message.is_remote_frame and not message.is_fd  # .asc logs mark empty CAN FD frames as remote
    if remote:
        can_id |= ID_REMOTE
    if message.is_error_frame:
        can_id |= ID_ERROR
    flags = 0
    if message.is_fd:
        flags = FLAG_FDF
        if message.bitrate_switch:
            flags |= FLAG_BRS
        if message.error_state_indicator:
            flags |= FLAG_ESI
    if not is_legal(can_id, message.dlc, flags) or (message.dlc != len(message.data) and not remote):
        return False
    FRAME_STRUCT.pack_into(memory, offset, can_id, message.dlc, flags, bytes(message.data))
    return True


def _link_errors(interface: str) -> tuple[type[Exception], ...]:
    """Return the exceptions that an open bus raises when its link is lost."""
    if interface != "remote":
        return (can.CanError, OSError)
    from can_remote.websocket import WebsocketClosed

    return (can.CanError, OSError, WebsocketClosed)


def _open(interface: str, channel: str, options: dict[str, Any]) -> can.BusABC:
    if refused := refusal(interface, one_process=True):
        raise BusAbsent(refused)
    if interface == "virtual":
        options = {"protocol": can.CanProtocol.CAN_FD} | options
    # The backend `neovi` receives its own frames by default, unlike the other backends.
    options = {"fd": True, "receive_own_messages": False} | options
    try:
        bus = can.Bus(interface=interface, channel=channel, **options)
    except _OPEN_ERRORS as error:
        raise BusAbsent(
            f"python-can cannot open {interface}:{channel} for CAN FD: {error}; check the channel name and the driver with "
            f"`atalante doctor -i {interface}`"
        ) from error
    if bus.protocol is can.CanProtocol.CAN_20 and reports_can_fd(interface):
        bus.shutdown()
        raise BusAbsent(
            f"{interface}:{channel} supports classic CAN only, but CAN FD is required: use another interface"
        )
    return bus

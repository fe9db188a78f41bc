"""CAN transports: classes that send and receive the CAN frames of the HAL or the emulator.

Several transports implement the interface `Bus`. The HAL and the emulator run on each transport without change, except on a log:

- `socketcan.SocketCanBus`: a Linux CAN interface, such as `can0` of an adapter or `vcan0`;
- `pair.PairBus`: two ends in one process, in lock-step;
- `shared.SharedBus`: two ends in two processes, which run in parallel;
- `python_can.PythonCanBus`: an interface of python-can with CAN FD (pcan, kvaser, slcan, ...), see `adapters`;
- `replay.ReplayBus`: a recorded log, read only.
"""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from atalante_hal.wire.frame import Frames

Stamps = npt.NDArray[np.int64]


class BusError(Exception):
    """Error of the bus; the message names the bus, the cause and the remedy.

    Attributes:
        sent: Number of frames of the batch that were accepted; 0 unless `send` raised the error.
        accepted: Accepted frames, shape (sent,). None means the first `sent` frames of the batch.
        full: Error of another channel, whose transmit queue was full in the same call of `send`. None if there is none.
    """

    def __init__(self, message: str = "", sent: int = 0) -> None:
        super().__init__(message)
        self.sent = sent
        self.accepted: Frames | None = None
        self.full: BusFull | None = None

    def accepted_of(self, batch: Frames) -> Frames:
        """Return the frames that `send` passed to the bus before the error, shape (sent,).

        Args:
            batch: Frames that were passed to `send`, shape (n,).
        """
        return batch[: self.sent] if self.accepted is None else self.accepted


class BusAbsent(BusError):  # noqa: N818
    """Error of a bus that cannot be opened: the interface is missing, is down, has no CAN FD, or has no driver."""


class BusDown(BusError):  # noqa: N818
    """Error of an open bus that can no longer be used: interface down, adapter unplugged, or bus closed.

    Attributes:
        reopens: Whether the bus opens the lost link again. If False, the program must be restarted, and the message states this.
    """

    reopens = True


class BusFull(BusError):  # noqa: N818
    """Error of a full transmit queue: the queue accepted only a part of the batch.

    Attributes:
        sent: Number of accepted frames. On each channel, these are the frames that come first in the batch.
    """


class Bus(Protocol):
    """Interface of every CAN transport. Frames are contiguous arrays of `frame.FRAME` records, shape (n,).

    Pass the same array objects in every cycle, because a bus caches memory views of each array object.
    """

    @property
    def name(self) -> str:
        """Return the name of the channel, as it is shown in messages to the user."""
        ...

    @property
    def stamps(self) -> Stamps:
        """Return the receive times of the frames that the last `receive()` returned, int64 [ns].

        Element i is the receive time of frame i. The shape is (capacity,), where capacity is the largest number of frames that
        one `receive()` returns. If n frames were returned, only the first n elements have a meaning.
        """
        ...

    @property
    def dropped(self) -> int:
        """Return how many incoming frames were lost or invalid since the bus was opened."""
        ...

    def send(self, frames: Frames) -> None:
        """Send all frames, in order. The caller may reuse the array after the call.

        Args:
            frames: Frames to send, shape (n,).

        Raises:
            BusFull: If the transmit queue accepted only a part of the frames.
            BusDown: If the bus is closed or down.
            ValueError: If a frame is not a valid CAN frame.
        """
        ...

    def receive(self, frames: Frames, timeout: float = 0.0) -> int:
        """Write the received frames to `frames[:n]`, oldest first, and return n.

        The rest of `frames` does not change. Own frames are not received. The bytes after the payload of a frame are undefined.

        Args:
            frames: Receive buffer, shape (m,) with m >= n.
            timeout: Longest wait for the first frame [s]. With 0 the call does not wait.

        Returns:
            Number of received frames n; 0 if none arrived in time.

        Raises:
            BusDown: If the bus is closed or down.
        """
        ...

    def close(self) -> None:
        """Close the bus; a second call has no effect. Later calls of `send()` and `receive()` raise `BusDown`."""
        ...


def open_bus(interface: str, channel: str, **options: Any) -> Bus:
    """Open one channel of a CAN interface.

    Args:
        interface: Name of the interface in python-can. `socketcan` opens a `SocketCanBus`, every other name a `PythonCanBus`.
        channel: Name of the channel, such as `can0`.
        **options: Keyword arguments of the bus class. `PythonCanBus` passes its options to python-can.

    Returns:
        The open bus.

    Raises:
        BusAbsent: If the channel cannot be opened; the message contains the command that helps.
    """
    if interface == "socketcan":
        from atalante_hal.bus.socketcan import SocketCanBus

        return SocketCanBus(channel, **options)
    from atalante_hal.bus.python_can import PythonCanBus

    return PythonCanBus(interface, channel, **options)

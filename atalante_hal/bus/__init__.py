"""The bus: first and last stage of the flow, `bus -> process image -> ... -> process image -> bus`.

One small protocol and the transports behind it; the HAL and the emulator run on any of them unchanged:

- `socketcan.SocketCanBus`: a Linux CAN interface, `can0` of an adapter or a `vcan0`;
- `pair.PairBus`: two ends in one process, in lock-step;
- `shared.SharedBus`: the same between two processes, which then work at once;
- `python_can.PythonCanBus`: any interface python-can knows (virtual, pcan, kvaser, ...);
- `replay.ReplayBus`: a log, read only.
"""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from atalante_hal.wire.frame import Frames

Stamps = npt.NDArray[np.int64]


class BusError(Exception):
    """Something is wrong with the bus; the message says what, and what would be right."""


class BusAbsent(BusError):  # noqa: N818
    """The bus cannot be opened: no such interface, interface down, no CAN FD, no driver."""


class BusDown(BusError):  # noqa: N818
    """The bus was open and is gone: interface down or unplugged, or closed by us."""


class BusFull(BusError):  # noqa: N818
    """The transmit queue took only the first `sent` frames of the batch."""

    def __init__(self, message: str, sent: int = 0) -> None:
        super().__init__(message)
        self.sent = sent


class Bus(Protocol):
    """What carries frames. Frames are `frame.FRAME` records, shape (n,), contiguous.

    Pass the same array objects cycle after cycle: a bus remembers the memory of the arrays it has seen.
    """

    @property
    def name(self) -> str:
        """The channel, as messages to the user name it."""
        ...

    @property
    def stamps(self) -> Stamps:
        """Receive times of the frames of the last `receive()`, in its order. Shape (capacity,) int64 [ns]."""
        ...

    @property
    def dropped(self) -> int:
        """Frames that reached this end and were lost before `receive()`, since it was opened."""
        ...

    def send(self, frames: Frames) -> None:
        """Send all frames, in order; the array may be written again as soon as this returns.

        Raises `BusFull` or `BusDown`, and `ValueError` for a frame that no CAN controller could send.
        """
        ...

    def receive(self, frames: Frames, timeout: float = 0.0) -> int:
        """Fill `frames[:n]` with what has arrived, oldest first, and return n; the rest of `frames` is left alone.

        Waits up to `timeout` [s] for the first frame only. Own frames are not received. Payload bytes beyond a frame's
        length are not defined. Raises `BusDown`.
        """
        ...

    def close(self) -> None:
        """Leave the bus; a second call does nothing, and `send()` and `receive()` raise `BusDown` from then on."""
        ...


def open_bus(interface: str, channel: str, **options: Any) -> Bus:
    """Open one channel, by python-can's names for interface and channel.

    `socketcan` is ours; every other interface is python-can's and gets `options` as they are. Raises `BusAbsent` with
    what to type.
    """
    if interface == "socketcan":
        from atalante_hal.bus.socketcan import SocketCanBus

        return SocketCanBus(channel, **options)
    from atalante_hal.bus.python_can import PythonCanBus

    return PythonCanBus(interface, channel, **options)

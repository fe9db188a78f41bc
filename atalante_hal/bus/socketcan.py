"""Bus on a Linux CAN interface (`can0`, `vcan0`): one system call moves all frames of a cycle.

`recvmmsg` writes a block of `struct canfd_frame`, with time stamps [ns] and the drop counter as control messages. `sendmmsg`
sends such a block. Every structure that the kernel reads or writes is allocated once. Sources: linux/can/raw.h, recvmmsg(2),
Documentation/networking/can.rst.
"""

from __future__ import annotations

import ctypes
import errno
import fcntl
import math
import os
import socket
import struct
import time
from typing import Final

import numpy as np

from atalante_hal.bus import BusAbsent, BusDown, BusError, BusFull, Stamps
from atalante_hal.bus.batch import Batches
from atalante_hal.wire.frame import FLAG_FDF, FRAME_BYTES, Frames, as_words, new_frames

CLASSIC_BYTES = 16  # size of a `struct can_frame` [bytes]
CAN_RAW_ERR_FILTER: Final = 2
SO_RCVBUFFORCE: Final = 33
SO_TIMESTAMPNS: Final = 35  # number of the socket option, and also type of the control message with the time stamp
SO_RXQ_OVFL: Final = 40
SIOCGIFFLAGS: Final = 0x8913
SIOCGIFMTU: Final = 0x8921
IFF_UP: Final = 1
#: Prefix of the names of virtual CAN interfaces, which `ip link add` creates. All other interfaces are regarded as adapters.
VIRTUAL: Final = "vcan"
#: Classes of error frames to receive (linux/can/error.h): transmit timeout, controller problem, bus-off, controller restarted.
ERROR_FRAMES = 0x0001 | 0x0004 | 0x0040 | 0x0100
LINK_DOWN: Final = errno.ENETDOWN
#: Error codes of a call on a socket whose interface was removed. The kernel does not bind such a socket again.
LINK_REMOVED: Final = (errno.ENODEV, errno.ENXIO)
#: Shortest time [s] between two attempts to open a removed interface again.
REOPEN_PERIOD: Final = 0.1
#: Largest number of calls of `recvmmsg` that empty the receive queue after the link is lost.
DROPPED_BATCHES: Final = 64
NO_ROOM = (errno.ENOBUFS, errno.EAGAIN)

#: Mask for the first 8 bytes of a received frame: keeps identifier, length and flags, and clears the two reserved bytes.
#: In a received frame, the two reserved bytes may have any value.
HEADER_FIELDS = np.uint64(0x0000_FFFF_FFFF_FFFF)
#: FDF flag in the first 8 bytes of a frame. Older kernels leave this flag 0 in received CAN FD frames.
FDF_IN_HEADER = np.uint64(FLAG_FDF << 40)

IOVEC = np.dtype([("base", "u8"), ("length", "u8")])
#: `struct mmsghdr` of 64-bit Linux.
MMSGHDR = np.dtype(
    [
        ("name", "u8"),
        ("name_length", "u8"),
        ("iov", "u8"),
        ("iov_count", "u8"),
        ("control", "u8"),
        ("control_length", "u8"),
        ("flags", "u8"),
        ("length", "u8"),
    ]
)
#: Control messages of one received frame: its time stamp, then a drop counter if frames were lost.
CONTROL = np.dtype(
    [
        ("stamp_length", "u8"),
        ("stamp_level", "i4"),
        ("stamp_type", "i4"),
        ("seconds", "i8"),
        ("nanoseconds", "i8"),
        ("drops_length", "u8"),
        ("drops_level", "i4"),
        ("drops_type", "i4"),
        ("drops", "u4"),
        ("padding", "u4"),
    ]
)
STAMP_ONLY = 32  # size of the control messages [bytes] if there is no drop counter


class SocketCanBus:
    """Bus on a raw CAN FD socket that is bound to one Linux interface.

    The bus does not receive its own frames. It receives error frames about the state of the CAN controller. The kernel takes
    the time stamp of a frame (CLOCK_REALTIME) when the driver delivers the frame.

    If the interface is removed (an adapter is unplugged), the next call raises `BusDown`. Later calls open the interface again
    under the same file descriptor as soon as it is present and up, and raise `BusDown` until then. Frames that are queued when
    the link is lost are dropped. So a frame that is received after `BusDown` proves that the link is back.

    Args:
        channel: Name of the interface, such as `can0`.
        capacity: Largest number of frames in one system call and in the result of one `receive()`.
        receive_buffer: Requested size of the kernel's receive buffer [bytes]. A queued frame takes about 1 kB. Without
            CAP_NET_ADMIN the kernel grants at most net.core.rmem_max.

    Attributes:
        dropped: Number of frames lost because the receive buffer was full.

    Raises:
        BusAbsent: If the interface cannot be used; the message contains the command that helps.
    """

    def __init__(self, channel: str, capacity: int = 256, receive_buffer: int = 1 << 22) -> None:
        self.name = channel
        self.dropped = 0
        self.stamps: Stamps = np.zeros(capacity, np.int64)
        require_channel(channel)
        self._capacity = capacity
        self._batches = Batches()
        self._closed = False
        self._receive_buffer = receive_buffer
        self._removed = ""  # error message of a removed interface; empty otherwise
        self._next_attempt = 0.0  # monotonic time of the next attempt to open a removed interface [s]
        self._socket = _bound_socket(channel, receive_buffer)
        self._file = self._socket.fileno()
        libc = ctypes.CDLL(None, use_errno=True)
        self._recvmmsg, self._sendmmsg, self._ppoll = libc.recvmmsg, libc.sendmmsg, libc.ppoll
        self._recvmmsg.argtypes = [ctypes.c_int, ctypes.c_size_t, ctypes.c_uint, ctypes.c_int, ctypes.c_void_p]
        self._sendmmsg.argtypes = [ctypes.c_int, ctypes.c_size_t, ctypes.c_uint, ctypes.c_int]
        self._ppoll.argtypes = [ctypes.c_size_t, ctypes.c_ulong, ctypes.c_size_t, ctypes.c_void_p]

        # Receive buffers: frames, their headers and their control messages.
        self._rx = new_frames(capacity)
        self._rx_memory = self._rx.view(np.uint8).data
        self._rx_words = as_words(self._rx)[:, 0]
        self._rx_control = np.zeros(capacity, CONTROL)
        self._rx_vectors, self._rx_headers = _headers(self._rx, self._rx_control)
        self._rx_address = _address(self._rx_headers)
        self._rx_lengths = self._rx_headers["length"]
        self._rx_control_lengths = self._rx_headers["control_length"]
        self._rx_stamp_types = self._rx_control["stamp_type"]
        self._seconds, self._nanoseconds = self._rx_control["seconds"], self._rx_control["nanoseconds"]
        self._all_fd = np.full(capacity, FRAME_BYTES, "u8").tobytes()
        self._lost_before = 0
        self._poll = np.array([(self._file, ctypes.c_short(1).value, 0)], np.dtype("i4,i2,i2"))  # POLLIN
        self._poll_address = _address(self._poll)
        self._patience = np.zeros(2, np.int64)  # struct timespec
        self._patience_address = _address(self._patience)

        # Transmit buffers: frames and their headers. A classic CAN frame uses the first 16 bytes of its record.
        self._tx = new_frames(capacity)
        self._tx_memory = self._tx.view(np.uint8).data
        self._tx_flags = self._tx["flags"]
        self._tx_vectors, self._tx_headers = _headers(self._tx, None)
        self._tx_address = _address(self._tx_headers)
        self._tx_lengths = self._tx_vectors["length"]
        self._tx_pattern = b""

    def send(self, frames: Frames) -> None:
        """Pass the frames to the kernel.

        Args:
            frames: Frames to send, shape (n,).

        Raises:
            BusFull: If the transmit queue accepted only a part of the frames.
            BusDown: If the bus is closed or the interface is down.
            ValueError: If a frame is not a valid CAN frame.
        """
        if self._closed:
            raise BusDown(f"{self.name} is closed")
        if self._removed:
            self._reopen()
        memory, headers = self._batches.to_send(frames)
        total = len(frames)
        for start in range(0, total, self._capacity):
            count = min(total - start, self._capacity)
            self._tx_memory[: count * FRAME_BYTES] = memory[start * FRAME_BYTES : (start + count) * FRAME_BYTES]
            pattern = headers[8 * start : 8 * (start + count)]
            if pattern != self._tx_pattern:
                self._tx_lengths[:count] = np.where(self._tx_flags[:count] & FLAG_FDF, FRAME_BYTES, CLASSIC_BYTES)
                self._tx_pattern = pattern
            sent = 0
            while sent < count:
                # If a frame fails, sendmmsg returns the number of frames before it. Only the next call returns the error code.
                address = self._tx_address + sent * MMSGHDR.itemsize
                accepted = self._sendmmsg(self._file, address, count - sent, socket.MSG_DONTWAIT)
                if accepted < 0:
                    raise self._send_error(ctypes.get_errno(), start + sent, total)
                sent += accepted

    def receive(self, frames: Frames, timeout: float = 0.0) -> int:
        """Move frames from the kernel's queue to `frames[:n]` and return n, see `Bus.receive`.

        Args:
            frames: Receive buffer, shape (m,) with m >= n.
            timeout: Longest wait for the first frame [s].

        Returns:
            Number of received frames n.

        Raises:
            BusDown: If the bus is closed or the interface is down.
            BusError: If the kernel reports another error.
        """
        if self._closed:
            raise BusDown(f"{self.name} is closed")
        if self._removed:
            self._reopen()
        memory = self._batches.to_fill(frames)
        room = min(len(frames), self._capacity)
        count = self._recvmmsg(self._file, self._rx_address, room, socket.MSG_DONTWAIT, None)
        if count < 0:
            count = self._wait(room, timeout)
        if count <= 0:
            return 0
        if self._rx_lengths[:count].tobytes() != self._all_fd[: 8 * count]:
            self._widen_classic(count)
        else:
            words = self._rx_words[:count]
            np.bitwise_and(words, HEADER_FIELDS, out=words)
            np.bitwise_or(words, FDF_IN_HEADER, out=words)
        self._read_control(count)
        size = count * FRAME_BYTES
        memory[:size] = self._rx_memory[:size]
        return int(count)

    def fileno(self) -> int:
        """Return the file descriptor of the socket, for `select` or `poll`."""
        return self._file

    def close(self) -> None:
        """Close the socket."""
        self._closed = True
        self._socket.close()

    def _wait(self, room: int, timeout: float) -> int:
        """Wait until a frame arrives, then receive the queued frames.

        Args:
            room: Largest number of frames to receive.
            timeout: Longest wait [s].

        Returns:
            Number of received frames; 0 after the timeout or a signal.

        Raises:
            BusDown: If the interface is down.
            BusError: If the kernel reports another error.
        """
        code = ctypes.get_errno()
        if code in NO_ROOM and timeout > 0.0:
            fraction, whole = math.modf(timeout)
            self._patience[0] = whole
            self._patience[1] = fraction * 1e9
            if self._ppoll(self._poll_address, 1, self._patience_address, None) <= 0:
                return 0
            count: int = self._recvmmsg(self._file, self._rx_address, room, socket.MSG_DONTWAIT, None)
            if count >= 0:
                return count
            code = ctypes.get_errno()
        if code in (errno.EAGAIN, errno.EINTR):
            return 0
        raise self._link_error(code) or BusError(f"{self.name} cannot receive: {os.strerror(code)}")

    def _widen_classic(self, count: int) -> None:
        """Clear the unused bytes of classic CAN frames, and set the FDF flag of CAN FD frames."""
        for frame, length in zip(self._rx[:count], self._rx_lengths[:count].tolist(), strict=True):
            frame["res"] = 0
            if length > CLASSIC_BYTES:
                frame["flags"] |= FLAG_FDF
            else:
                frame["flags"] = 0
                frame["data"][8:] = 0

    def _read_control(self, count: int) -> None:
        """Read the time stamps and the drop counter of the received frames, then reset the control buffers."""
        stamps = self.stamps[:count]
        np.multiply(self._seconds[:count], 1_000_000_000, out=stamps)
        np.add(stamps, self._nanoseconds[:count], out=stamps)
        used = self._rx_control_lengths[:count]
        if int(used[-1]) > STAMP_ONLY:
            lost = int(self._rx_control["drops"][count - 1])
            self.dropped += (lost - self._lost_before) & 0xFFFF_FFFF  # the kernel counts in 32 bits
            self._lost_before = lost
        used.fill(CONTROL.itemsize)

    def _send_error(self, code: int, sent: int, total: int) -> BusError:
        reason = os.strerror(code)
        if code in NO_ROOM:
            return BusFull(
                f"{self.name} accepted {sent} of {total} frames, its transmit queue is full: connect another node, which "
                f"acknowledges frames, or enlarge the queue with `ip link set {self.name} txqueuelen 1000`",
                sent,
            )
        error = self._link_error(code) or BusError(f"{self.name} cannot send: {reason}")
        error.sent = sent
        return error

    def _link_error(self, code: int) -> BusDown | None:
        """Drop the queued frames and return a `BusDown` if `code` means that the interface is down or removed; else None."""
        if code != LINK_DOWN and code not in LINK_REMOVED:
            return None
        self._drop_queued()
        # If an interface is removed, the kernel reports LINK_DOWN first, and one of the codes LINK_REMOVED later.
        # `_drop_queued` may have dropped the code LINK_REMOVED. So check whether the kernel has unbound the socket.
        if code == LINK_DOWN and self._is_bound():
            return BusDown(f"{self.name} is down: type `ip link set {self.name} up`")
        self._removed = f"{self.name} was removed: plug the adapter in again; the link is opened again when it is up"
        return BusDown(self._removed)

    def _is_bound(self) -> bool:
        """Return whether the socket is bound to an interface. If the interface is removed, the kernel unbinds the socket."""
        return bool(self._socket.getsockname()[0])

    def _drop_queued(self) -> None:
        """Drop the received frames and the error codes that wait in the socket.

        A waiting frame or error code would make `poll` report the socket as readable, although the link is lost.
        """
        for _ in range(DROPPED_BATCHES):
            count = self._recvmmsg(self._file, self._rx_address, self._capacity, socket.MSG_DONTWAIT, None)
            if count > 0:
                self._read_control(count)
            elif ctypes.get_errno() in NO_ROOM:
                return

    def _reopen(self) -> None:
        """Open a removed interface again, under the same file descriptor.

        Raises:
            BusDown: If the interface cannot be opened yet; the message names the reason and the command that helps.
        """
        now = time.monotonic()
        if now < self._next_attempt:
            raise BusDown(self._removed)
        self._next_attempt = now + REOPEN_PERIOD
        if not is_present(self.name):
            raise BusDown(self._removed)
        try:
            require_channel(self.name)
            with _bound_socket(self.name, self._receive_buffer) as again:
                os.dup2(again.fileno(), self._file, inheritable=False)
        except (BusAbsent, OSError) as error:
            self._removed = f"{self.name} was removed and cannot be opened again: {error}"
            raise BusDown(self._removed) from error
        self._removed = ""
        self._lost_before = 0  # the kernel counts lost frames per socket, and the new socket starts at 0


def require_channel(channel: str) -> None:
    """Check that a channel is a CAN FD interface that is up.

    Args:
        channel: Name of the interface.

    Raises:
        BusAbsent: If the interface is missing, is down or has no CAN FD; the message contains the command that helps.
    """
    doctor = "run `atalante doctor`"
    create = f"type `ip link add {channel} type vcan && ip link set {channel} mtu 72 txqueuelen 1000 up`"
    remedy = create if channel.startswith(VIRTUAL) else "plug the adapter in and load its driver"
    try:
        raw = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
    except OSError as error:
        raise BusAbsent(
            f"this kernel has no SocketCAN ({error.strerror}): load it with `modprobe can-raw`, or use a kernel with SocketCAN "
            f"(`make test-vcan` boots one); {doctor}"
        ) from error
    with raw:
        if not is_present(channel):
            raise BusAbsent(f"there is no interface {channel}: {remedy}; {doctor}")
        (flags,) = struct.unpack_from("<H", _ioctl(raw, SIOCGIFFLAGS, channel))
        (mtu,) = struct.unpack_from("<i", _ioctl(raw, SIOCGIFMTU, channel))
        try:
            raw.bind((channel,))
        except OSError as error:
            raise BusAbsent(
                f"{channel} is not a CAN interface: `ip -br link show type can` lists CAN interfaces; {doctor}"
            ) from error
    if mtu < FRAME_BYTES:
        raise BusAbsent(
            f"{channel} supports classic CAN only (mtu {mtu}): type `ip link set {channel} down`, and then one of two "
            f"commands: `ip link set {channel} mtu 72 up` for a vcan, or `ip link set {channel} up type can bitrate "
            f"1000000 dbitrate 5000000 fd on` for an adapter; {doctor}"
        )
    if not flags & IFF_UP:
        raise BusAbsent(f"{channel} is down: type `ip link set {channel} up`; {doctor}")


def is_present(channel: str) -> bool:
    """Return whether an interface exists.

    `if_nametoindex` would take milliseconds for an absent interface, because the kernel then starts modprobe.

    Args:
        channel: Name of the interface.
    """
    return channel in [name for _, name in socket.if_nameindex()]


def _ioctl(any_socket: socket.socket, request: int, channel: str) -> bytes:
    """Call ioctl on an interface and return the value in its `struct ifreq` (netdevice(7))."""
    return fcntl.ioctl(any_socket, request, struct.pack("<16s24x", channel.encode()))[16:]


def _bound_socket(channel: str, receive_buffer: int) -> socket.socket:
    raw = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
    raw.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FD_FRAMES, 1)
    raw.setsockopt(socket.SOL_CAN_RAW, CAN_RAW_ERR_FILTER, ERROR_FRAMES)
    raw.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)
    raw.setsockopt(socket.SOL_SOCKET, SO_RXQ_OVFL, 1)
    try:
        raw.setsockopt(socket.SOL_SOCKET, SO_RCVBUFFORCE, receive_buffer)
    except PermissionError:
        raw.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, receive_buffer)
    raw.bind((channel,))
    return raw


def _headers(frames: Frames, control: Frames | None) -> tuple[Frames, Frames]:
    """Create one `iovec` and one `mmsghdr` for each frame. The kernel reads both arrays, so the caller must keep them."""
    index = np.arange(len(frames), dtype=np.uint64)
    vectors = np.zeros(len(frames), IOVEC)
    vectors["base"] = _address(frames) + index * FRAME_BYTES
    vectors["length"] = FRAME_BYTES
    headers = np.zeros(len(frames), MMSGHDR)
    headers["iov"] = _address(vectors) + index * IOVEC.itemsize
    headers["iov_count"] = 1
    if control is not None:
        headers["control"] = _address(control) + index * CONTROL.itemsize
        headers["control_length"] = CONTROL.itemsize
    return vectors, headers


def _address(array: Frames) -> int:
    return array.ctypes.data

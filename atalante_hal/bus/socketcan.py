"""A Linux CAN interface (`can0`, `vcan0`) as a bus: one system call moves a whole cycle's frames.

`recvmmsg` fills a block of `struct canfd_frame` with nanosecond time stamps and the drop counter beside it, `sendmmsg`
empties one; every structure the kernel reads or writes is allocated once. Sources: linux/can/raw.h, recvmmsg(2),
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
from typing import Final

import numpy as np

from atalante_hal.bus import BusAbsent, BusDown, BusError, BusFull, Stamps
from atalante_hal.bus.batch import Batches
from atalante_hal.wire.frame import FLAG_FDF, FRAME_BYTES, Frames, as_words, new_frames

CLASSIC_BYTES = 16  # struct can_frame
CAN_RAW_ERR_FILTER: Final = 2
SO_RCVBUFFORCE: Final = 33
SO_TIMESTAMPNS: Final = 35  # also the type of its control message
SO_RXQ_OVFL: Final = 40
SIOCGIFFLAGS: Final = 0x8913
SIOCGIFMTU: Final = 0x8921
IFF_UP: Final = 1
#: Error frames that change what the controller can do (linux/can/error.h): TX timeout, controller, bus-off, restarted.
ERROR_FRAMES = 0x0001 | 0x0004 | 0x0040 | 0x0100
LINK_LOST = (errno.ENETDOWN, errno.ENODEV, errno.ENXIO)
NO_ROOM = (errno.ENOBUFS, errno.EAGAIN)

#: What we take of a received header word: programs and drivers leave a DLC or worse in the reserved bytes; and older
#: kernels tell CAN FD by the size alone.
HEADER_FIELDS = np.uint64(0x0000_FFFF_FFFF_FFFF)
FDF_IN_HEADER = np.uint64(FLAG_FDF << 40)

IOVEC = np.dtype([("base", "u8"), ("length", "u8")])
#: struct mmsghdr of 64-bit Linux.
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
#: The control messages of one frame in the order the kernel writes them; the second only once frames were lost.
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
STAMP_ONLY = 32  # bytes of control data without the drop counter


class SocketCanBus:
    """A raw CAN FD socket bound to one interface; does not receive its own frames.

    `capacity` frames at most go in one system call and come from one `receive()`. `receive_buffer` [bytes] is asked of
    the kernel, which without CAP_NET_ADMIN grants up to net.core.rmem_max; a frame takes about 1 kB of it. `stamps` are
    CLOCK_REALTIME, taken when the frame left the driver. Error frames about the state of the controller are received.

    Raises `BusAbsent` with the command to type.
    """

    def __init__(self, channel: str, capacity: int = 256, receive_buffer: int = 1 << 22) -> None:
        self.name = channel
        self.dropped = 0
        self.stamps: Stamps = np.zeros(capacity, np.int64)
        require_channel(channel)
        self._capacity = capacity
        self._batches = Batches()
        self._closed = False
        self._socket = _bound_socket(channel, receive_buffer)
        self._file = self._socket.fileno()
        libc = ctypes.CDLL(None, use_errno=True)
        self._recvmmsg, self._sendmmsg, self._ppoll = libc.recvmmsg, libc.sendmmsg, libc.ppoll
        self._recvmmsg.argtypes = [ctypes.c_int, ctypes.c_size_t, ctypes.c_uint, ctypes.c_int, ctypes.c_void_p]
        self._sendmmsg.argtypes = [ctypes.c_int, ctypes.c_size_t, ctypes.c_uint, ctypes.c_int]
        self._ppoll.argtypes = [ctypes.c_size_t, ctypes.c_ulong, ctypes.c_size_t, ctypes.c_void_p]

        # Receive: frames, their headers, their control messages.
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

        # Send: frames and their headers; a classic frame is the first 16 bytes of its record.
        self._tx = new_frames(capacity)
        self._tx_memory = self._tx.view(np.uint8).data
        self._tx_flags = self._tx["flags"]
        self._tx_vectors, self._tx_headers = _headers(self._tx, None)
        self._tx_address = _address(self._tx_headers)
        self._tx_lengths = self._tx_vectors["length"]
        self._tx_pattern = b""

    def send(self, frames: Frames) -> None:
        """Hand the frames to the kernel; raises `BusFull`, `BusDown`, `ValueError`. Shape (n,)."""
        if self._closed:
            raise BusDown(f"{self.name} is closed")
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
                # A batch cut short says so by its count; the reason comes with the next call.
                address = self._tx_address + sent * MMSGHDR.itemsize
                taken = self._sendmmsg(self._file, address, count - sent, socket.MSG_DONTWAIT)
                if taken < 0:
                    raise self._refusal(ctypes.get_errno(), start + sent, total)
                sent += taken

    def receive(self, frames: Frames, timeout: float = 0.0) -> int:
        """Fill `frames[:n]` from the kernel's queue; raises `BusDown`. Shape (m,), n <= m; `timeout` [s]."""
        if self._closed:
            raise BusDown(f"{self.name} is closed")
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
        """File descriptor, to wait for several buses at once."""
        return self._file

    def close(self) -> None:
        """Close the socket."""
        self._closed = True
        self._socket.close()

    def _wait(self, room: int, timeout: float) -> int:
        """What `recvmmsg` returns after an empty queue; 0 when nothing came in time or a signal interrupted."""
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
        if code in LINK_LOST:
            raise BusDown(f"{self.name} is down ({os.strerror(code)}): type `ip link set {self.name} up`")
        raise BusError(f"{self.name} cannot receive: {os.strerror(code)}")

    def _widen_classic(self, count: int) -> None:
        """Clear what a 16-byte `can_frame` left of the record it was written over, and mark the others as CAN FD."""
        for frame, length in zip(self._rx[:count], self._rx_lengths[:count].tolist(), strict=True):
            frame["res"] = 0
            if length > CLASSIC_BYTES:
                frame["flags"] |= FLAG_FDF
            else:
                frame["flags"] = 0
                frame["data"][8:] = 0

    def _read_control(self, count: int) -> None:
        """Time stamps and the drop counter of the frames just received; then make room for the next control data."""
        stamps = self.stamps[:count]
        np.multiply(self._seconds[:count], 1_000_000_000, out=stamps)
        np.add(stamps, self._nanoseconds[:count], out=stamps)
        used = self._rx_control_lengths[:count]
        if int(used[-1]) > STAMP_ONLY:
            lost = int(self._rx_control["drops"][count - 1])
            self.dropped += (lost - self._lost_before) & 0xFFFF_FFFF  # the kernel counts in 32 bits
            self._lost_before = lost
        used.fill(CONTROL.itemsize)

    def _refusal(self, code: int, sent: int, total: int) -> BusError:
        reason = os.strerror(code)
        if code in NO_ROOM:
            return BusFull(
                f"{self.name} took {sent} of {total} frames, its transmit queue is full: is another node there to "
                f"acknowledge? `ip link set {self.name} txqueuelen 1000` gives it room",
                sent,
            )
        if code in LINK_LOST:
            return BusDown(f"{self.name} is down ({reason}): type `ip link set {self.name} up`")
        return BusError(f"{self.name} cannot send: {reason}")


def require_channel(channel: str) -> None:
    """Make sure that `channel` is a CAN FD interface that is up; raises `BusAbsent` with the command to type."""
    doctor = "run `atalante doctor`"
    create = f"ip link add {channel} type vcan && ip link set {channel} mtu 72 txqueuelen 1000 up"
    try:
        raw = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
    except OSError as error:
        raise BusAbsent(
            f"this kernel has no SocketCAN ({error.strerror}): type `modprobe can-raw`, or use a kernel that has it "
            f"(`make test-vcan` boots one), and {doctor}"
        ) from error
    with raw:
        try:
            socket.if_nametoindex(channel)
        except OSError as error:
            raise BusAbsent(
                f"there is no interface {channel}: plug the adapter in, or type `{create}`; {doctor}"
            ) from error
        (flags,) = struct.unpack_from("<H", _ask(raw, SIOCGIFFLAGS, channel))
        (mtu,) = struct.unpack_from("<i", _ask(raw, SIOCGIFMTU, channel))
        try:
            raw.bind((channel,))
        except OSError as error:
            raise BusAbsent(
                f"{channel} is no CAN interface: `ip -br link show type can` lists those; {doctor}"
            ) from error
    if mtu < FRAME_BYTES:
        raise BusAbsent(
            f"{channel} carries classic CAN only (mtu {mtu}): type `ip link set {channel} down`, then for a vcan "
            f"`ip link set {channel} mtu 72 up`, for an adapter `ip link set {channel} up type can bitrate 1000000 "
            f"dbitrate 5000000 fd on`; {doctor}"
        )
    if not flags & IFF_UP:
        raise BusAbsent(f"{channel} is down: type `ip link set {channel} up`; {doctor}")


def _ask(any_socket: socket.socket, request: int, channel: str) -> bytes:
    """The value part of `struct ifreq` (netdevice(7))."""
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
    """One `iovec` and one `mmsghdr` for each frame; both must live as long as the kernel is handed the headers."""
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

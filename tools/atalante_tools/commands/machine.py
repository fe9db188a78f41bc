"""Properties of this computer that `atalante doctor` checks: CAN interfaces, user limits, packages and programs."""

from __future__ import annotations

import importlib.util
import resource
import shutil
import socket
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Protocol

#: Interface type of CAN: ARPHRD_CAN of linux/if_arp.h.
_CAN: Final = 280
#: Flag bit of an interface that is up: IFF_UP of linux/if.h.
_UP: Final = 1
#: Bit numbers of Linux capabilities (linux/capability.h).
_CAP_IPC_LOCK: Final = 14
_CAP_SYS_NICE: Final = 23


@dataclass(frozen=True)
class Interface:
    """CAN interface of the Linux kernel."""

    name: str
    virtual: bool
    up: bool
    mtu: int  # MTU [bytes]: 72 for CAN FD, 16 for classic CAN
    queue: int  # length of the transmit queue, txqueuelen [frames]


class Machine(Protocol):
    """Interface between `atalante doctor` and the checked computer. Tests use an implementation with fixed values."""

    def can_socket(self) -> str | None:
        """Open an AF_CAN socket. Return the error message, or None on success."""

    def vcan(self) -> bool:
        """Return whether the kernel module for virtual CAN interfaces is loaded."""

    def interfaces(self) -> list[Interface]:
        """Return all CAN interfaces of the kernel."""

    def open_channel(self, interface: str, channel: str) -> str | None:
        """Open a channel as all commands do, and close it again. Return the error message, or None on success.

        Args:
            interface: Name of the interface in python-can.
            channel: Name of the channel.
        """

    def realtime_priority(self) -> int:
        """Return the highest SCHED_FIFO priority that this user may request. 0 means that no priority is allowed."""

    def locked_memory(self) -> int | None:
        """Return how much memory this user may lock [bytes]. None means unlimited memory."""

    def package(self, name: str) -> bool:
        """Return whether a Python package is installed.

        Args:
            name: Import name of the package.
        """

    def program(self, name: str) -> bool:
        """Return whether a program is on the search path.

        Args:
            name: Name of the program.
        """


class ThisMachine:
    """This Linux computer. Its properties are read from /sys, /proc, getrlimit(2) and the import system."""

    def __init__(self, sys: Path = Path("/sys")) -> None:
        self._sys = sys

    def can_socket(self) -> str | None:
        """Open an AF_CAN socket. Return the error message, or None on success."""
        try:
            socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW).close()
        except OSError as error:
            return error.strerror
        return None

    def vcan(self) -> bool:
        """Return whether /sys lists the vcan module or a virtual CAN interface."""
        return (self._sys / "module/vcan").exists() or any(interface.virtual for interface in self.interfaces())

    def interfaces(self) -> list[Interface]:
        """Return all CAN interfaces in /sys/class/net, sorted by name."""
        found = []
        for entry in sorted((self._sys / "class/net").glob("*")):
            if not (entry / "type").is_file() or int((entry / "type").read_text()) != _CAN:
                continue
            flags, mtu, queue = ((entry / name).read_text().strip() for name in ("flags", "mtu", "tx_queue_len"))
            virtual = not (entry / "device").exists()
            found.append(Interface(entry.name, virtual, bool(int(flags, 16) & _UP), int(mtu), int(queue)))
        return found

    def open_channel(self, interface: str, channel: str) -> str | None:
        """Open a channel with `open_bus` and close it. Return the error message, or None on success.

        Args:
            interface: Name of the interface in python-can.
            channel: Name of the channel.
        """
        from atalante_hal.bus import BusError, open_bus

        try:
            open_bus(interface, channel).close()
        except BusError as error:
            return str(error)
        return None

    def realtime_priority(self) -> int:
        """Return the limit RLIMIT_RTPRIO, or 99 if it is unlimited or the process has CAP_SYS_NICE."""
        limit = resource.getrlimit(resource.RLIMIT_RTPRIO)[0]
        return 99 if _capable(_CAP_SYS_NICE) or limit == resource.RLIM_INFINITY else limit

    def locked_memory(self) -> int | None:
        """Return the limit RLIMIT_MEMLOCK [bytes], or None if it is unlimited or the process has CAP_IPC_LOCK."""
        limit = resource.getrlimit(resource.RLIMIT_MEMLOCK)[0]
        return None if _capable(_CAP_IPC_LOCK) or limit == resource.RLIM_INFINITY else limit

    def package(self, name: str) -> bool:
        """Return whether the import system finds the package.

        Args:
            name: Import name of the package.
        """
        return importlib.util.find_spec(name) is not None

    def program(self, name: str) -> bool:
        """Return whether the program is on the search path.

        Args:
            name: Name of the program.
        """
        return shutil.which(name) is not None


def _capable(capability: int) -> bool:
    status = Path("/proc/self/status").read_text()
    effective = next(line for line in status.splitlines() if line.startswith("CapEff:"))
    return bool(int(effective.split()[1], 16) >> capability & 1)

"""What `atalante doctor` asks the machine it runs on; nothing here judges."""

from __future__ import annotations

import importlib.util
import resource
import shutil
import socket
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Protocol

#: ARPHRD_CAN of linux/if_arp.h, IFF_UP of linux/if.h.
_CAN: Final = 280
_UP: Final = 1
#: Bits of linux/capability.h.
_CAP_IPC_LOCK: Final = 14
_CAP_SYS_NICE: Final = 23


@dataclass(frozen=True)
class Interface:
    """One CAN interface of the kernel."""

    name: str
    virtual: bool
    up: bool
    mtu: int  # 72 carries CAN FD
    queue: int  # txqueuelen


class Machine(Protocol):
    """The questions."""

    def can_socket(self) -> str | None:
        """Why no AF_CAN socket can be made; None: it can."""

    def vcan(self) -> bool:
        """Whether the kernel can make virtual CAN interfaces, with its module loaded."""

    def interfaces(self) -> list[Interface]:
        """CAN interfaces there are."""

    def realtime_priority(self) -> int:
        """Highest SCHED_FIFO priority this user may ask for; 0: none."""

    def locked_memory(self) -> int | None:
        """Bytes this user may lock; None: without limit."""

    def package(self, name: str) -> bool:
        """Whether a Python package is installed."""

    def program(self, name: str) -> bool:
        """Whether a program is on the path."""


class ThisMachine:
    """Linux, as /sys, setrlimit(2) and the import system tell."""

    def __init__(self, sys: Path = Path("/sys")) -> None:
        self._sys = sys

    def can_socket(self) -> str | None:
        """See `Machine`."""
        try:
            socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW).close()
        except OSError as error:
            return error.strerror
        return None

    def vcan(self) -> bool:
        """See `Machine`."""
        return (self._sys / "module/vcan").exists() or any(interface.virtual for interface in self.interfaces())

    def interfaces(self) -> list[Interface]:
        """See `Machine`."""
        found = []
        for entry in sorted((self._sys / "class/net").glob("*")):
            if not (entry / "type").is_file() or int((entry / "type").read_text()) != _CAN:
                continue
            flags, mtu, queue = ((entry / name).read_text().strip() for name in ("flags", "mtu", "tx_queue_len"))
            virtual = not (entry / "device").exists()
            found.append(Interface(entry.name, virtual, bool(int(flags, 16) & _UP), int(mtu), int(queue)))
        return found

    def realtime_priority(self) -> int:
        """See `Machine`."""
        return 99 if _capable(_CAP_SYS_NICE) else resource.getrlimit(resource.RLIMIT_RTPRIO)[0]

    def locked_memory(self) -> int | None:
        """See `Machine`."""
        limit = resource.getrlimit(resource.RLIMIT_MEMLOCK)[0]
        return None if _capable(_CAP_IPC_LOCK) or limit == resource.RLIM_INFINITY else limit

    def package(self, name: str) -> bool:
        """See `Machine`."""
        return importlib.util.find_spec(name) is not None

    def program(self, name: str) -> bool:
        """See `Machine`."""
        return shutil.which(name) is not None


def _capable(capability: int) -> bool:
    status = Path("/proc/self/status").read_text()
    effective = next(line for line in status.splitlines() if line.startswith("CapEff:"))
    return bool(int(effective.split()[1], 16) >> capability & 1)

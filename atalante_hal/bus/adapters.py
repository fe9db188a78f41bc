"""Table of the CAN interfaces that python-can supports, with the driver and the settings that each interface requires.

    name of an interface -> `Adapter` -> `refusal()`

The commands, `PythonCanBus` and `atalante doctor` call `refusal()`. The facts come from the source code of python-can 4.6.1,
unless `Adapter.source` names another source. A test compares the facts with the installed python-can. No test was run with the
hardware of an adapter.
"""

from __future__ import annotations

import importlib.util
from dataclasses import dataclass
from typing import Final, Literal

#: Entries of python-can's configuration file for 1 Mbit/s and 5 Mbit/s with a CAN clock of 80 MHz. The sample points are at 75 %.
#: For bit rates above 800 kbit/s, the Linux kernel also chooses a sample point of 75 % (drivers/net/can/dev/calc_bittiming.c).
SEGMENTS: Final = (
    ("f_clock", "80000000"),
    ("nom_brp", "1"),
    ("nom_tseg1", "59"),
    ("nom_tseg2", "20"),
    ("nom_sjw", "20"),
    ("data_brp", "1"),
    ("data_tseg1", "11"),
    ("data_tseg2", "4"),
    ("data_sjw", "4"),
)
#: Entries for 1 Mbit/s and 5 Mbit/s in python-can's configuration file, for backends that calculate the bit segments.
BIT_RATES: Final = (("bitrate", "1000000"), ("data_bitrate", "5000000"))
#: Default of `Adapter.source`: where the facts about an adapter come from.
SOURCES: Final = "sources of python-can 4.6.1"
NOT_TRIED: Final = "not tried"


@dataclass(frozen=True)
class Adapter:
    """Facts about one interface of python-can.

    Attributes:
        name: Name of the interface, for the option `-i`.
        can_fd: Whether the backend sends and receives CAN FD frames.
        channel: Form of the channel, for the option `-c`, with an example.
        install: Software that must be installed in addition to python-can: a pip command or the driver of the vendor. Empty
            if python-can is sufficient.
        library: Module or driver library that the backend loads. Empty if it loads no library.
        options: Entries of python-can's configuration file that this network requires.
        setup: Shell command that sets the bit timing, for a backend that does not set it.
        stamps: Clock that gives the receive timestamps: the clock of the adapter (hardware), of the kernel, or of the
            process (software).
        reports_can_fd: Whether the backend reports CAN FD in `can.BusABC.protocol` after a bus was opened for CAN FD.
            If False, `PythonCanBus` does not check `protocol`, and relies on `can_fd`.
        unusable: Reason why the interface cannot connect a HAL and a robot in two processes. Empty if the interface can
            connect them.
        note: Further information for the operator.
        tried: Test that was run on this interface with this project.
        source: Where the facts come from.
    """

    name: str
    can_fd: bool
    channel: str
    install: str = ""
    library: str = ""
    options: tuple[tuple[str, str], ...] = ()
    setup: str = ""
    stamps: Literal["hardware", "kernel", "software"] = "software"
    reports_can_fd: bool = True
    unusable: str = ""
    note: str = ""
    tried: str = NOT_TRIED
    source: str = SOURCES

    @property
    def configuration(self) -> str:
        """Return the section `[default]` for ~/can.conf, which sets the bit timing; empty if none is required."""
        return "\n".join(["[default]", *(f"{key} = {value}" for key, value in self.options)]) if self.options else ""


_SERIAL: Final = "pip install 'python-can[serial]'"

_ADAPTERS: Final = (
    # -- with CAN FD
    Adapter(
        "socketcan",
        True,
        "network interface: can0",
        setup="ip link set can0 up type can bitrate 1000000 dbitrate 5000000 fd on",
        stamps="kernel",
        note="this project uses its own transport for it (atalante_hal/bus/socketcan.py), not python-can's",
        tried="tried on vcan (make test-vcan)",
    ),
    Adapter(
        "pcan",
        True,
        "PCAN_USBBUS1",
        "PCAN-Basic of the vendor; pip install 'python-can[pcan]' for timestamps relative to 1970",
        library="pcanbasic",
        options=SEGMENTS,
        stamps="hardware",
        note="bitrate is ignored for CAN FD; on Linux, the kernel supports PCAN adapters as socketcan",
        source=f"{SOURCES}; kernel support: python-can.readthedocs.io, interfaces/pcan",
    ),
    Adapter(
        "kvaser",
        True,
        "channel number: 0",
        "CANlib of the vendor",
        library="libcanlib.so",
        options=SEGMENTS,
        stamps="hardware",
        note="timestamps have a resolution of 10 us",
    ),
    Adapter(
        "vector",
        True,
        "channel index: 0",
        "XL driver library of the vendor; Windows only",
        library="vxlapi",
        options=SEGMENTS,
        stamps="hardware",
        note="the application CANalyzer of Vector Hardware Config is used, unless app_name or serial is configured",
    ),
    Adapter(
        "ixxat",
        True,
        "channel number: 0",
        "VCI driver of the vendor; Windows only",
        library="vcinpl2.dll",
        options=BIT_RATES,
        stamps="hardware",
        note="unique_hardware_id selects one of several devices; the sample points are at 80 % (1 Mbit/s) and 75 % (5 Mbit/s)",
    ),
    Adapter(
        "neovi",
        True,
        "network: HSCAN, or its number",
        "pip install 'python-can[neovi]'",
        library="ics",
        options=BIT_RATES,
        stamps="hardware",
        note="serial selects one of several devices",
    ),
    Adapter(
        "nixnet",
        True,
        "CAN1",
        "pip install 'python-can[nixnet]' and NI-XNET of the vendor; Windows only",
        library="nixnet",
        options=SEGMENTS,
        stamps="hardware",
        note="can_termination = True switches the termination resistor of the port on",
    ),
    Adapter(
        "etas",
        True,
        "ETAS://ETH/ES910:abcd/CAN:1",
        "ETAS ECU and Bus Interfaces - Distribution Package; Windows only",
        library="dll-csiBind",
        options=BIT_RATES,
        stamps="hardware",
        note="since Linux 5.13, the kernel supports ES581.4, ES582.1 and ES584.1 as socketcan",
        source=f"{SOURCES}; package and kernel support: python-can.readthedocs.io, interfaces/etas",
    ),
    Adapter(
        "slcan",
        True,
        "serial port: /dev/ttyACM0",
        _SERIAL,
        library="serial",
        options=(*SEGMENTS, ("timeout", "0")),
        reports_can_fd=False,
        note="needs CAN FD firmware with data rates 2M and 5M (CANable 2.0); takes about 0.2 ms to receive a 12-byte frame "
        "(measured on a pseudo-terminal), which is too slow for a leg bus at 1 kHz: use it for `status` and for one node",
        tried="tried on loopback (in-memory serial port)",
    ),
    Adapter(
        "remote",
        True,
        "address of the server: 127.0.0.1:54701",
        "pip install 'python-can[remote]'",
        library="can_remote",
        reports_can_fd=False,
        setup="python -m can_remote -i INTERFACE -c CHANNEL --fd --host ADDRESS",
        note="the server runs on the computer with the adapter, whose bit timing is set there; the adapter must support CAN FD; "
        "the connection has no authentication, and without --host the server listens on all addresses",
        tried="tried on loopback (server with interface virtual)",
        source="sources of python-can-remote 0.3.0",
    ),
    Adapter(
        "virtual",
        True,
        "any name",
        unusable="works inside one process only",
        tried="tried (tests of this project)",
    ),
    Adapter(
        "udp_multicast",
        True,
        "multicast address: 239.74.163.2",
        "pip install 'python-can[multicast]'",
        library="msgpack",
        stamps="kernel",
        unusable="returns every sent frame to its sender, which a HAL mistakes for a second HAL",
    ),
    # -- classic CAN only
    Adapter("canalystii", False, "channel number: 0", "pip install 'python-can[canalystii]'", library="canalystii"),
    Adapter("cantact", False, "channel number: 0", "pip install 'python-can[cantact]'", library="cantact"),
    Adapter(
        "gs_usb",
        False,
        "device number: 0",
        "pip install 'python-can[gs-usb]'",
        library="gs_usb",
        note="this backend is for classic CAN, even if the adapter supports CAN FD; the Linux kernel driver gs_usb provides "
        "such an adapter as socketcan",
        source=f"{SOURCES}; kernel driver: drivers/net/can/usb/gs_usb.c of Linux",
    ),
    Adapter("iscan", False, "device number: 0", "isCAN driver of the vendor", library="iscandrv"),
    Adapter("neousys", False, "channel number: 0", "driver of the vendor", library="libwdt_dio.so"),
    Adapter("nican", False, "CAN0", "NI-CAN of the vendor; 32-bit Python on Windows only", library="nican"),
    Adapter("robotell", False, "serial port: /dev/ttyUSB0", _SERIAL, library="serial"),
    Adapter(
        "seeedstudio", False, "serial port: /dev/ttyUSB0", "pip install 'python-can[seeedstudio]'", library="serial"
    ),
    Adapter("serial", False, "serial port: /dev/ttyUSB0", _SERIAL, library="serial"),
    Adapter(
        "socketcand",
        False,
        "network interface of the server: can0",
        "a socketcand server; entries host and port in ~/can.conf",
        note="the client sends a CAN FD frame as a classic frame: it has no CAN FD flags",
        tried="tried on loopback (a server of the test)",
    ),
    Adapter("systec", False, "channel number: 0", "USB-CANmodul driver of the vendor; Windows only", library="usbcan"),
    Adapter("usb2can", False, "serial number of the device", "usb2can.dll; Windows only", library="usb2can.dll"),
)

#: Facts of every built-in interface of python-can and of `remote`, by name.
ADAPTERS: Final = {adapter.name: adapter for adapter in _ADAPTERS}


def refusal(interface: str, *, one_process: bool = False) -> str:
    """Return the reason why an interface cannot connect a HAL with a robot; an empty text if it can.

    Args:
        interface: Name of the interface in python-can.
        one_process: Whether HAL and robot are in one process, as in a test.

    Returns:
        One sentence that names the interface, the reason and the remedy. For an unknown name, the remedy lists the interfaces
        that can connect HAL and robot in two processes. The text is empty if the interface can connect HAL and robot. The
        check assumes that the driver and the adapter are present.
    """
    adapter = ADAPTERS.get(interface)
    if adapter is None:
        import can

        # a python-can plug-in that is not in the table; `PythonCanBus` checks its CAN FD support
        if interface in can.VALID_INTERFACES:
            return ""
        usable = ", ".join(name for name in sorted(can.VALID_INTERFACES) if not refusal(name))
        return f"there is no CAN interface {interface!r}; use one of {usable}"
    remedy = "use a CAN FD adapter, or Linux vcan (`atalante doctor -i socketcan -c vcan0`)"
    if not adapter.can_fd:
        return f"{interface} supports classic CAN only in python-can, but this network requires CAN FD: {remedy}"
    if adapter.unusable and not one_process:
        return f"{interface} {adapter.unusable}: {remedy}"
    if interface == "remote" and importlib.util.find_spec(adapter.library) is None:
        return f"the CAN interface remote is not installed: {adapter.install}"
    return ""


def reports_can_fd(interface: str) -> bool:
    """Return whether the backend of an interface reports CAN FD in `can.BusABC.protocol` after opening a CAN FD bus.

    Args:
        interface: Name of the interface in python-can.

    Returns:
        `Adapter.reports_can_fd`; True for a plug-in, because nothing else is known about it.
    """
    adapter = ADAPTERS.get(interface)
    return adapter is None or adapter.reports_can_fd

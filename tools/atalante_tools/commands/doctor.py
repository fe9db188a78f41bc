"""`atalante doctor`: is this machine ready for the chosen bus, and what to type if not."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Final

import click

from atalante_tools.console.options import EMBEDDED, json_option
from atalante_tools.console.outcome import Failed
from atalante_tools.console.terminal import show_json

if TYPE_CHECKING:
    from atalante_tools.commands.machine import Interface, Machine

#: Frames a transmit queue should hold: a cycle of all four buses is 22.
QUEUE: Final = 1000
FD_MTU: Final = 72
#: Priority and memory the loop asks for.
PRIORITY: Final = 50
LIMITS: Final = "/etc/security/limits.conf"
#: Package -> what it is for, and the extra that brings it.
PACKAGES: Final = {
    "pinocchio": ("the controller's model", ""),
    "pybullet": ("the emulated robot", "[emulator]"),
    "zenoh": ("telemetry", "[telemetry]"),
    "mcap": ("recordings", "[telemetry]"),
    "matplotlib": ("figures", "[plot]"),
}
#: Program -> what it is for, and the Debian package.
PROGRAMS: Final = {
    "candump": ("a second opinion on what is on a bus", "can-utils"),
    "gcc": ("the C baseline of `atalante bench`", "gcc"),
}


@dataclass(frozen=True)
class Check:
    """One answer."""

    name: str
    ok: bool
    needed: bool  # for the chosen interface
    text: str  # what is the case
    fix: str = ""  # what to type


@click.command()
@click.option(
    "-i",
    "--interface",
    default=EMBEDDED,
    show_default=True,
    metavar="NAME",
    help="What the machine is to be ready for: embedded, socketcan, or another of python-can.",
)
@click.option("-c", "--channel", default="", metavar="CHANNEL", help="Channel, or a channel map of the four buses.")
@json_option
def command(interface: str, channel: str, as_json: bool) -> None:
    """Say what this machine can do, and what to type for what it cannot.

    Ends with code 1 when something is missing that the chosen interface needs. Changes nothing.

    \b
    Example: atalante doctor
             atalante doctor -i socketcan -c vcan0
    """
    from atalante_tools.commands.machine import ThisMachine

    checks = list(examine(ThisMachine(), interface, channels_of(interface, channel)))
    for check in checks:
        if as_json:
            show_json(asdict(check) | ({"fix": ""} if check.ok else {}))
        else:
            click.echo(line(check))
    if missing := [check.name for check in checks if check.needed and not check.ok]:
        raise Failed(f"{interface} {channel}".rstrip() + f" is not ready: {', '.join(missing)}")


def channels_of(interface: str, channel: str) -> list[str]:
    """The channels of a channel map, each once.

    Raises:
        click.UsageError: the embedded robot has none.
        ChannelMapError: it is not a channel map.
    """
    if not channel:
        return []
    if interface == EMBEDDED:
        raise click.UsageError(f"the embedded robot has no channel; to ask about {channel} say -i socketcan")
    import atalante_dbc
    from atalante_hal.bus.channel_map import parse_channel_map

    return list(dict.fromkeys(parse_channel_map(channel, atalante_dbc.load().buses).values()))


def line(check: Check) -> str:
    """One answer for a person."""
    mark = "ok  " if check.ok else "MISS" if check.needed else "no  "
    fix = f"\n       type: {check.fix}" if check.fix and not check.ok else ""
    return f"{mark}  {check.name}: {check.text}{fix}"


def examine(machine: Machine, interface: str, channels: Sequence[str]) -> Iterator[Check]:
    """All answers, those about the chosen interface first."""
    yield from _packages(machine, interface)
    yield from _socketcan(machine, interface == "socketcan", channels)
    if interface not in (EMBEDDED, "socketcan"):
        yield _python_can(interface)
    yield from _realtime(machine)
    for name, (purpose, package) in PROGRAMS.items():
        there = machine.program(name)
        text = f"{'there' if there else 'not there'}, for {purpose}"
        yield Check(name, there, False, text, f"apt install {package}")


def _packages(machine: Machine, interface: str) -> Iterator[Check]:
    for name, (purpose, extra) in PACKAGES.items():
        there = machine.package(name)
        needed = not extra or (name == "pybullet" and interface == EMBEDDED)
        text = f"{'installed' if there else 'not installed'}, for {purpose}"
        yield Check(name, there, needed, text, f"pip install 'atalante-hal{extra}'")


def _socketcan(machine: Machine, needed: bool, channels: Sequence[str]) -> Iterator[Check]:
    refusal = machine.can_socket()
    here = refusal is None
    boot = "modprobe can-raw; where there is no such module, `make test-vcan` boots a kernel that has it"
    yield Check("AF_CAN", here, needed, "the kernel has SocketCAN" if here else f"no SocketCAN ({refusal})", boot)
    loaded = here and machine.vcan()
    wants_virtual = any(channel.startswith("vcan") for channel in channels)
    text = "virtual CAN interfaces can be made" if loaded else "the vcan module is not loaded"
    yield Check("vcan", loaded, needed and wants_virtual, text, "modprobe vcan")
    there = {interface.name: interface for interface in machine.interfaces()} if here else {}
    for name in dict.fromkeys([*channels, *there]) if needed or not channels else there:
        yield _interface(name, there.get(name), needed and name in channels)
    if not there and not channels:
        yield Check("interfaces", False, needed, "there is no CAN interface", _create("vcan0"))


def _interface(name: str, interface: Interface | None, needed: bool) -> Check:
    if interface is None:
        return Check(name, False, needed, "there is no such interface", _create(name))
    size = f"mtu {FD_MTU}" if interface.virtual else "type can bitrate 1000000 dbitrate 5000000 fd on"
    if interface.mtu < FD_MTU:
        text, fix = f"classic CAN only (mtu {interface.mtu})", f"ip link set {name} down; ip link set {name} up {size}"
        if interface.virtual:
            fix = f"ip link set {name} down; ip link set {name} {size} up"
        return Check(name, False, needed, text, fix)
    if not interface.up:
        return Check(name, False, needed, "it is down", f"ip link set {name} up")
    if interface.queue < QUEUE:
        # Works, until the other side is slow for some cycles.
        text = f"CAN FD, up, but only {interface.queue} frames fit its transmit queue"
        return Check(name, False, False, text, f"ip link set {name} txqueuelen {QUEUE}")
    return Check(name, True, needed, f"CAN FD, up, txqueuelen {interface.queue}")


def _create(name: str) -> str:
    return f"ip link add {name} type vcan && ip link set {name} mtu {FD_MTU} txqueuelen {QUEUE} up"


def _python_can(interface: str) -> Check:
    import can

    known = interface in can.VALID_INTERFACES
    text = f"python-can {'knows' if known else 'does not know'} {interface}"
    return Check("python-can", known, True, text, f"choose one of {', '.join(sorted(can.VALID_INTERFACES))}")


def _realtime(machine: Machine) -> Iterator[Check]:
    priority, memory = machine.realtime_priority(), machine.locked_memory()
    yield Check(
        "real-time priority",
        priority >= PRIORITY,
        False,
        f"SCHED_FIFO up to {priority}" if priority else "no SCHED_FIFO: the loop may be late on the wall clock",
        f"echo '@realtime - rtprio {PRIORITY}' >> {LIMITS}; usermod -aG realtime $USER; log in again",
    )
    yield Check(
        "locked memory",
        memory is None,
        False,
        "without limit" if memory is None else f"at most {memory // 1024} KiB: a page fault may make a cycle late",
        f"echo '@realtime - memlock unlimited' >> {LIMITS}; usermod -aG realtime $USER; log in again",
    )

"""Command `atalante doctor`: checks whether this computer is ready for a bus, and prints the commands that fix problems.

Machine (commands/machine.py) -> examine -> CheckResult -> one line per check, exit code
interface -> Adapter (atalante_hal/bus/adapters.py) -> facts about the interface
bus -> BusTiming (commands/bus_timing.py) -> time from a SYNC to states and commands, with --bus
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING, Final

import click

from atalante_tools.console.options import EMBEDDED, Between, Target, json_option, typed
from atalante_tools.console.outcome import Failed
from atalante_tools.console.stop_request import StopRequest, stop_requested
from atalante_tools.console.terminal import show_json, table
from atalante_tools.session.body import engine_hint

if TYPE_CHECKING:
    from atalante_hal.bus import Bus
    from atalante_hal.bus.adapters import Adapter
    from atalante_tools.commands.bus_timing import BusTiming
    from atalante_tools.commands.machine import Interface, Machine

#: Recommended length of a transmit queue [frames]. An interface that carries all four buses sends at least 26 frames per cycle.
QUEUE: Final = 1000
#: MTU of a CAN FD interface [bytes].
FD_MTU: Final = 72
#: SCHED_FIFO priority that the 1 kHz loop requests.
PRIORITY: Final = 50
#: Linux file with the real-time limits of each user.
LIMITS: Final = "/etc/security/limits.conf"
#: Name of a Python package -> purpose of the package, and the pip extra of `atalante-hal` that installs the package.
#: If the extra is the empty text "", `pip install atalante-hal` installs the package without an extra.
PACKAGES: Final = {
    "pinocchio": ("the model of the controller", ""),
    "pybullet": ("the emulated robot", "[emulator]"),
    "mujoco": ("the emulated robot with --engine mujoco", "[mujoco]"),
    "zenoh": ("telemetry", "[telemetry]"),
    "mcap": ("recordings", "[telemetry]"),
    "matplotlib": ("figures", "[plot]"),
}
#: Name of a program -> purpose of the program, and name of the Debian package.
PROGRAMS: Final = {
    "candump": ("an independent log of a bus", "can-utils"),
    "gcc": ("the C baseline of `atalante bench`", "gcc"),
}


@dataclass(frozen=True)
class CheckResult:
    """Result of one check of the computer. The option `--json` prints all fields."""

    name: str
    ok: bool
    needed: bool  # whether the chosen interface requires that this check passes
    text: str  # result of the check in words
    fix: str = ""  # shell command that fixes the problem


@click.command()
@click.option(
    "-i",
    "--interface",
    default=EMBEDDED,
    show_default=True,
    metavar="NAME",
    help="Interface to check: embedded, socketcan, or another interface of python-can.",
)
@click.option(
    "-c",
    "--channel",
    default="",
    metavar="CHANNEL",
    help="CAN channel to check (vcan0), or a channel map (left_leg=can0,right_leg=can1,left_sense=can2,right_sense=can3).",
)
@click.option(
    "--bus", "measure", is_flag=True, help="Measure the time from each SYNC to states and commands on a running bus."
)
@click.option(
    "--for",
    "seconds",
    type=Between(0.05, 600.0),
    default=2.0,
    show_default=True,
    metavar="SECONDS",
    help="Listening time [s]. Requires --bus.",
)
@json_option
def command(interface: str, channel: str, measure: bool, seconds: float, as_json: bool) -> None:
    """Check whether this computer is ready, and print the commands that fix problems.

    With -i, the command prints the known facts about the interface: CAN FD, driver, form of the channel, bit timing, tests.
    With -c, the command opens every channel in the same way as all other commands, and closes the channel again. With --bus,
    the command listens to a running HAL and its nodes, and checks with receive timestamps that 99 % of the frames arrive within
    their time budget. The command sends no frames and changes nothing. The exit code is 1 if the chosen interface requires a
    check that fails, or if the frames are too late.

    \b
    Example: atalante doctor
             atalante doctor -i socketcan -c vcan0
             atalante doctor -i pcan
             atalante doctor -i socketcan -c can0 --bus
    """
    if measure and (interface == EMBEDDED or not channel):
        raise click.UsageError("--bus requires an interface and a channel: add for example -i socketcan -c vcan0")
    if typed("seconds") and not measure:
        raise click.UsageError("--for requires a measurement: add --bus")
    from atalante_tools.commands.machine import ThisMachine

    checks = list(examine(ThisMachine(), interface, channels_of(interface, channel)))
    for check in checks:
        if as_json:
            show_json(asdict(check) | ({"fix": ""} if check.ok else {}))
        else:
            click.echo(line(check))
    if interface != EMBEDDED:
        _show_facts(interface, as_json)
    if missing := [check for check in checks if check.needed and not check.ok]:
        names = ", ".join(check.name for check in missing)
        # If only the check of the channel failed, show the result of this check. The message already names the channel.
        why = missing[0].text if names == channel else names
        raise Failed(f"{interface} {channel}".rstrip() + f" is not ready: {why}")
    if measure:
        _measure(Target(interface, channel, lockstep=False), seconds, as_json)


def channels_of(interface: str, channel: str) -> list[str]:
    """Return the channels of a channel map, each channel once.

    Args:
        interface: Interface of the channels.
        channel: One channel or a channel map. May be empty.

    Raises:
        click.UsageError: If a channel is given for the embedded robot.
        ChannelMapError: If the channel map is invalid.
    """
    if not channel:
        return []
    if interface == EMBEDDED:
        raise click.UsageError(f"the embedded robot has no channel; to check {channel}, type -i socketcan -c {channel}")
    import atalante_dbc
    from atalante_hal.bus.channel_map import parse_channel_map

    return list(dict.fromkeys(parse_channel_map(channel, atalante_dbc.load().buses).values()))


def line(check: CheckResult) -> str:
    """Return the result of a check as text for the terminal. A second line contains the command that fixes the problem.

    Args:
        check: Result to print.
    """
    mark = "ok  " if check.ok else "MISS" if check.needed else "no  "
    fix = f"\n       type: {check.fix}" if check.fix and not check.ok else ""
    return f"{mark}  {check.name}: {check.text}{fix}"


def examine(machine: Machine, interface: str, channels: Sequence[str]) -> Iterator[CheckResult]:
    """Check the computer and yield the result of each check.

    Args:
        machine: Computer to check.
        interface: Interface that the user chose.
        channels: Channels that must be ready.
    """
    yield from _packages(machine, interface)
    yield from _socketcan(machine, interface == "socketcan", channels)
    if interface not in (EMBEDDED, "socketcan"):
        yield from _python_can(machine, interface, channels)
    yield from _realtime(machine)
    for name, (purpose, package) in PROGRAMS.items():
        found = machine.program(name)
        text = f"{'installed' if found else 'not installed'}, for {purpose}"
        yield CheckResult(name, found, False, text, f"apt install {package}")


def _packages(machine: Machine, interface: str) -> Iterator[CheckResult]:
    for name, (purpose, extra) in PACKAGES.items():
        found = machine.package(name)
        # The embedded robot needs PyBullet or MuJoCo. If both are missing, only the check of PyBullet is marked as needed.
        needed = not extra or (name == "pybullet" and interface == EMBEDDED and not machine.package("mujoco"))
        text = f"{'installed' if found else 'not installed'}, for {purpose}"
        fix = engine_hint() if name == "pybullet" else f"pip install 'atalante-hal{extra}'"
        yield CheckResult(name, found, needed, text, fix)


def _socketcan(machine: Machine, needed: bool, channels: Sequence[str]) -> Iterator[CheckResult]:
    from atalante_hal.bus.socketcan import VIRTUAL

    error = machine.can_socket()
    supported = error is None
    boot = "modprobe can-raw; without that module, use `make test-vcan`, which boots a kernel that has it"
    text = "the kernel has SocketCAN" if supported else f"no SocketCAN ({error})"
    yield CheckResult("AF_CAN", supported, needed, text, boot)
    loaded = supported and machine.vcan()
    wants_virtual = any(channel.startswith(VIRTUAL) for channel in channels)
    text = "virtual CAN interfaces can be created" if loaded else "the vcan module is not loaded"
    yield CheckResult("vcan", loaded, needed and wants_virtual, text, "modprobe vcan")
    present = {interface.name: interface for interface in machine.interfaces()} if supported else {}
    for name in dict.fromkeys([*channels, *present]) if needed or not channels else present:
        wanted = needed and name in channels
        check = _interface(name, present.get(name), wanted)
        error = machine.open_channel("socketcan", name) if wanted and check.ok else None
        yield replace(check, ok=False, text=error) if error else check
    if not present and not channels:
        yield CheckResult("interfaces", False, needed, "there is no CAN interface", _create("vcan0"))


def _interface(name: str, interface: Interface | None, needed: bool) -> CheckResult:
    from atalante_hal.bus.socketcan import VIRTUAL

    if interface is None:
        text = "this interface does not exist"
        if name.startswith(VIRTUAL):
            return CheckResult(name, False, needed, text, _create(name))
        text += ": plug the adapter in and load its driver; the command below lists the present CAN interfaces"
        return CheckResult(name, False, needed, text, "ip -br link show type can")
    size = f"mtu {FD_MTU}" if interface.virtual else "type can bitrate 1000000 dbitrate 5000000 fd on"
    if interface.mtu < FD_MTU:
        text, fix = f"classic CAN only (mtu {interface.mtu})", f"ip link set {name} down; ip link set {name} up {size}"
        if interface.virtual:
            fix = f"ip link set {name} down; ip link set {name} {size} up"
        return CheckResult(name, False, needed, text, fix)
    if not interface.up:
        return CheckResult(name, False, needed, "the interface is down", f"ip link set {name} up")
    if interface.queue < QUEUE:
        # A short transmit queue is no obstacle (`needed` is False). It overflows only if the receiver is slow for several cycles.
        text = f"CAN FD, up, but its transmit queue holds only {interface.queue} frames"
        return CheckResult(name, False, False, text, f"ip link set {name} txqueuelen {QUEUE}")
    return CheckResult(name, True, needed, f"CAN FD, up, txqueuelen {interface.queue}")


def _create(name: str) -> str:
    return f"ip link add {name} type vcan && ip link set {name} mtu {FD_MTU} txqueuelen {QUEUE} up"


def _python_can(machine: Machine, interface: str, channels: Sequence[str]) -> Iterator[CheckResult]:
    from atalante_hal.bus.adapters import ADAPTERS, refusal

    refused = refusal(interface)
    adapter = ADAPTERS.get(interface)
    install = adapter.install if adapter else ""
    fix = install if install.startswith("pip ") else ""
    usable = ", ".join(name for name in sorted(ADAPTERS) if not refusal(name))
    text = refused or (f"{interface} supports CAN FD" if adapter else f"{interface} is an interface of a plug-in")
    yield CheckResult("python-can", not refused, True, text, f"choose one of {usable}")
    for channel in channels if not refused else ():
        error = machine.open_channel(interface, channel)
        yield CheckResult(channel, error is None, True, error or "opened for CAN FD", fix)


def facts(adapter: Adapter) -> str:
    """Return a description of a CAN interface as text for the terminal: CAN FD support, installation, channel, timestamps.

    Args:
        adapter: Properties of the interface.
    """
    rows = [
        ("CAN FD", "yes" if adapter.can_fd else "no: it cannot be used"),
        ("install", adapter.install or "nothing beside python-can"),
        ("channel", adapter.channel),
        ("bit timing", adapter.setup or ("see below" if adapter.options else "none to set")),
        ("timestamps", adapter.stamps),
        ("note", adapter.note),
        ("tried", adapter.tried),
        ("source", adapter.source),
    ]
    if not adapter.can_fd:
        rows = [row for row in rows if row[0] not in ("bit timing", "timestamps")]
    lines = [f"\ninterface {adapter.name}", *(f"  {name + ':':<12}{text}" for name, text in rows if text)]
    if adapter.options:
        lines += [
            "  ~/can.conf for 1 Mbit/s and 5 Mbit/s:",
            *(f"    {line}" for line in adapter.configuration.splitlines()),
        ]
    return "\n".join(lines)


def _measure(target: Target, seconds: float, as_json: bool) -> None:
    import atalante_dbc
    from atalante_tools.commands.bus_timing import BusTiming, rows
    from atalante_tools.session.rig import join, open_buses

    network = atalante_dbc.load()
    timing = BusTiming(network)
    with stop_requested() as stop:
        bus = join(network, open_buses(network, target))
        try:
            listen(bus, timing, seconds, stop)
        finally:
            bus.close()
        if stop.wanted:
            raise SystemExit(stop.exit_code)
    clock = stamp_clock(target.interface)
    latencies = timing.report()
    if not latencies:
        raise Failed(
            f"no answer to a SYNC on {target} for {seconds:g} s: start a robot and a HAL, for example atalante airwalk"
        )
    if as_json:
        for latency in latencies:
            show_json(asdict(latency) | {"fits": latency.fits, "stamps": clock})
    else:
        click.echo(
            f"\ntime from the end of a SYNC to the end of the frame, {clock} timestamps\n{table(rows(latencies))}"
        )
    if timing.skipped and not as_json:
        click.echo(f"{timing.skipped} frames without an earlier SYNC on their bus")
    if late := [f"{x.kind} on {x.bus}" for x in latencies if not x.fits]:
        raise Failed(
            f"99 % of the frames must arrive within the time budget, got too many late frames: {', '.join(late)}"
        )


def listen(bus: Bus, timing: BusTiming, seconds: float, stop: StopRequest) -> None:
    """Receive frames for some seconds, and measure the time from SYNC to each frame.

    Args:
        bus: Bus to listen to.
        timing: Measurement that collects the frames.
        seconds: Listening time [s].
        stop: Stop request, which ends the listening early.
    """
    from atalante_tools.session.listening import received

    for frames, count in received(bus, seconds, stop):
        timing.accept(frames, bus.stamps, count)


def stamp_clock(interface: str) -> str:
    """Return the clock that sets the receive timestamps of an interface: hardware, kernel, software or unknown.

    Args:
        interface: Name of the interface in python-can.
    """
    from atalante_hal.bus.adapters import ADAPTERS

    adapter = ADAPTERS.get(interface)
    return adapter.stamps if adapter else "unknown"


def _show_facts(interface: str, as_json: bool) -> None:
    from atalante_hal.bus.adapters import ADAPTERS

    adapter = ADAPTERS.get(interface)
    if as_json:
        show_json({"interface": interface, "known": asdict(adapter) if adapter else None})
    elif adapter:
        click.echo(facts(adapter))
    else:
        click.echo(f"\ninterface {interface}: no facts about this interface are stored")


def _realtime(machine: Machine) -> Iterator[CheckResult]:
    priority, memory = machine.realtime_priority(), machine.locked_memory()
    yield CheckResult(
        "real-time priority",
        priority >= PRIORITY,
        False,
        f"SCHED_FIFO up to {priority}" if priority else "no SCHED_FIFO: cycles may be late on the wall clock",
        f"echo '@realtime - rtprio {PRIORITY}' >> {LIMITS}; usermod -aG realtime $USER; log in again",
    )
    yield CheckResult(
        "locked memory",
        memory is None,
        False,
        "unlimited" if memory is None else f"at most {memory // 1024} KiB: page faults may delay cycles",
        f"echo '@realtime - memlock unlimited' >> {LIMITS}; usermod -aG realtime $USER; log in again",
    )

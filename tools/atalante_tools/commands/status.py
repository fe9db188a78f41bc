"""Command `atalante status`: listens to a bus and prints the state of every node, without sending frames.

bus -> Observer -> Report -> tables, or one JSON object
"""

from __future__ import annotations

import time
from dataclasses import replace
from typing import TYPE_CHECKING, Final

import click

from atalante_tools.console.options import Between, Target, json_option, target_options
from atalante_tools.console.outcome import Failed, FaultLatched
from atalante_tools.console.stop_request import StopRequest, stop_requested
from atalante_tools.console.terminal import print_message, show_json, table

if TYPE_CHECKING:
    from atalante_hal.bus.resilient import ResilientBus
    from atalante_tools.commands.observer import NodeReport, Observer, Report

_BLANK: Final = "-"
#: Listening time before the measurement begins [s]. The measurement excludes frames that were lost while the buses were opened.
#: SocketCAN reports lost frames only together with the next received frame. This next frame arrives within `WARM_UP`.
WARM_UP: Final = 0.1


@click.command()
@target_options(embedded=False, clock=False)
@click.option(
    "--for",
    "seconds",
    type=Between(0.05, 60.0),
    default=1.0,
    show_default=True,
    metavar="SECONDS",
    help="Listening time before each table [s].",
)
@click.option("--watch", is_flag=True, help="Repeat the table until Ctrl-C.")
@json_option
def command(target: Target, seconds: float, watch: bool, as_json: bool) -> None:
    """Listen to a bus and print its nodes, joints (degrees, Nm), supervisor state and bus load.

    The measured load counts each received frame with its longest possible wire time. The computed worst case counts every
    message of the DBC at its shortest period. "status only" marks a node that runs without a HAL: it sends status messages, but
    no state messages. State messages are answers to the SYNC of the HAL. The command sends no frames. The exit code is 1 if no
    frame was received, and 4 if a fault is latched.

    \b
    Example: atalante status -i socketcan -c vcan0
             atalante status -i socketcan -c vcan0 --watch
    """
    import atalante_dbc
    from atalante_hal.bus.resilient import ResilientBus
    from atalante_hal.robot import load_robot
    from atalante_tools.commands import observer
    from atalante_tools.session.listening import received
    from atalante_tools.session.rig import join, open_buses

    network, robot = atalante_dbc.load(), load_robot()
    with stop_requested() as stop:
        # Create the observer, which takes about 1 s, before the bus is opened. An open bus would lose frames in this time.
        listener = observer.Observer(network, robot, time.monotonic())
        bus = ResilientBus(join(network, open_buses(network, target)), print_message)
        try:
            for frames, count in received(bus, WARM_UP, stop):
                listener.accept(frames, count, time.monotonic())
            listener.begin(time.monotonic(), bus.dropped)
            while True:
                report = listen(bus, listener, seconds, stop)
                if stop.wanted:
                    raise SystemExit(stop.exit_code)
                if as_json:
                    show_json(observer.as_json(report))
                else:
                    if watch:
                        click.clear()
                    click.echo(render(report, target))
                if not watch:
                    break
        finally:
            bus.close()
    require_no_fault(report, target)


def listen(bus: ResilientBus, listener: Observer, seconds: float, stop: StopRequest) -> Report:
    """Receive frames for some seconds and return the report.

    Args:
        bus: Bus to listen to.
        listener: Observer that collects the frames.
        seconds: Listening time [s].
        stop: Stop request, which ends the listening early.
    """
    from atalante_tools.session.listening import received

    for frames, count in received(bus, seconds, stop):
        listener.accept(frames, count, time.monotonic())
    return replace(listener.report(time.monotonic(), bus.dropped), link=bus.down)


def require_no_fault(report: Report, target: Target) -> None:
    """End the command with an error if no frame was received or a fault is latched.

    Args:
        report: Report to check.
        target: Bus, for the error message.

    Raises:
        Failed: If no frame was received. The message names the lost link, if there is one.
        FaultLatched: If the supervisor or a drive is in FAULT.
    """
    if not report.frames:
        if report.link:
            raise Failed(report.link)
        raise Failed(
            f"no frame received on {target} for {report.seconds:.1f} s: "
            f"start a robot (atalante emulator {target.arguments}) and a HAL"
        )
    faults = [joint.joint for joint in report.joints if joint.drive_state == "FAULT"]
    if report.supervisor == "FAULT" or faults:
        raise FaultLatched(f"a fault is latched: {', '.join(faults) or 'supervisor'}")


def render(report: Report, target: Target) -> str:
    """Return the report as tables for the terminal.

    Args:
        report: Report to print.
        target: Bus, for the first line.
    """
    nodes = [("node", "received", "state", "DBC", "supply V", "degC", "errors", "emergency")]
    for n in report.nodes:
        dbc = _BLANK if n.dbc_ok is None else "same" if n.dbc_ok else "OTHER"
        flags = _BLANK if n.error_flags is None else f"0x{n.error_flags:04X}" if n.error_flags else "0"
        state = n.state or _BLANK
        nodes.append(
            (
                n.node,
                _received(n),
                state,
                dbc,
                _number(n.supply_v, 1),
                _number(n.temperature_degc, 0),
                flags,
                n.emergency or "",
            )
        )
    joints = [("joint", "deg", "deg/s", "Nm")]
    joints += [
        (j.joint, _number(j.position_deg, 2), _number(j.velocity_deg_s, 1), _number(j.torque_nm, 1))
        for j in report.joints
    ]
    loads = [("bus", "measured load %", "computed worst case %")]
    loads += [(bus, f"{100 * used:.1f}", f"{100 * worst:.1f}") for bus, (used, worst) in report.load.items()]
    counts = f"{report.frames} frames in {report.seconds:.1f} s, {report.crc_errors} CRC errors, {report.dropped} lost"
    if report.foreign:
        counts += f", {report.foreign} with an identifier that is not in the DBC"
    lost = [f"the link is lost: {report.link}"] if report.link else []
    return "\n\n".join([*lost, _headline(report, target), table(nodes), table(joints), table(loads), counts])


def _headline(report: Report, target: Target) -> str:
    from atalante_tools.commands.observer import LOST_AGE

    if report.supervisor is None:
        return f"{target}: no HAL (no SYNC received)"
    hal = next(n for n in report.nodes if n.kind == "master")
    if hal.age_ms is not None and hal.age_ms > LOST_AGE:
        return f"{target}: no SYNC of the HAL for {hal.age_ms} ms; it was {report.supervisor} in cycle {report.cycle}"
    parts = [f"{target}: HAL {report.supervisor}, cycle {report.cycle}"]
    if report.assistance_factor is not None:
        parts.append(f"assistance factor {report.assistance_factor:.2f}")
        parts.append(f"{report.overruns} overruns")
    if report.dead_man is not None:
        parts.append(f"dead-man switch {'pressed' if report.dead_man else 'released'}")
    return ", ".join(parts) + (f"\ndiagnostic: {report.diagnostic}" if report.diagnostic else "")


def _received(node: NodeReport) -> str:
    """Return the entry of a node in the table column "received".

    The entry describes the message with the shortest period: "yes" if the message is not late, otherwise its age. If this
    message has never been received, the entry describes the status message. Example: without a HAL, drives and sensors send
    status messages, but no state messages, because state messages are answers to the SYNC of the HAL.
    """
    if node.age_ms is not None:
        return f"{node.age_ms} ms ago" if node.late else "yes"
    if node.status_age_ms is None:
        return "never"
    return f"status {node.status_age_ms} ms ago" if node.status_late else "status only"


def _number(value: float | None, digits: int) -> str:
    return _BLANK if value is None else f"{value:.{digits}f}"

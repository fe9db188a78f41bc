"""Command `atalante pendant`: acts as the operator's pendant on the bus of a HAL that runs in another process.

keyboard -> Session -> PendantNode -> bus -> HAL
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

import click

from atalante_tools.console.options import Between, Target, target_options
from atalante_tools.console.outcome import Failed
from atalante_tools.console.stop_request import stop_requested
from atalante_tools.console.terminal import print_message

if TYPE_CHECKING:
    from atalante_dbc import Network
    from atalante_hal.bus import Bus
    from atalante_tools.session.pendant_session import Session

for_option = click.option(
    "--for",
    "seconds",
    type=Between(0.01, 86400.0),
    metavar="SECONDS",
    help="Duration of the command [s]. At the end, the command presses STOP.  [default: until Ctrl-C]",
)


@click.group()
def command() -> None:
    """Act as the operator's pendant on a bus.

    Only one pendant sends at a time: a new pendant takes over from the previous pendant. The commands `start` and `xi` keep
    the dead-man switch pressed while they run. Both commands read further commands from the keyboard: start, stop, hold, xi 0.3.

    \b
    Example: atalante pendant start -i socketcan -c vcan0
             atalante pendant xi 0.3 -i socketcan -c vcan0
             atalante pendant stop -i socketcan -c vcan0
    """


@command.command(short_help="Press the dead-man switch and START.")
@target_options(embedded=False, clock=False)
@for_option
def start(target: Target, seconds: float | None) -> None:
    """Keep the dead-man switch pressed, and press START when the HAL is in READY or HOLD.

    The command runs until Ctrl-C. At the end it presses STOP and releases the dead-man switch.

    \b
    Example: atalante pendant start -i socketcan -c vcan0
    """
    with session(target) as operator:
        operator.take_over()
        operator.start_wanted = True
        operator.run(seconds)
    raise SystemExit(operator.stop.exit_code)


@command.command(short_help="Press the dead-man switch and set the assistance factor.")
@click.argument("factor", metavar="X", type=Between(0.0, 1.0))
@target_options(embedded=False, clock=False)
@for_option
def xi(factor: float, target: Target, seconds: float | None) -> None:
    """Set the assistance factor to X, from 0 (widest guide) to 1 (full assistance).

    The command keeps the dead-man switch pressed and runs until Ctrl-C. At the end it presses STOP and releases the
    dead-man switch.

    \b
    Example: atalante pendant xi 0.3 -i socketcan -c vcan0
    """
    with session(target) as operator:
        operator.take_over()
        operator.node.assist(factor)
        print_message(f"assistance factor {factor:g}")
        operator.run(seconds)
    raise SystemExit(operator.stop.exit_code)


@command.command(short_help="Press STOP.")
@target_options(embedded=False, clock=False)
def stop(target: Target) -> None:
    """Press STOP for half a second, and print the state of the HAL before and after.

    \b
    Example: atalante pendant stop -i socketcan -c vcan0
    """
    press_once(target, "STOP")


@command.command(short_help="Press HOLD.")
@target_options(embedded=False, clock=False)
def hold(target: Target) -> None:
    """Press HOLD for half a second, and print the state of the HAL before and after.

    \b
    Example: atalante pendant hold -i socketcan -c vcan0
    """
    press_once(target, "HOLD")


def press_once(target: Target, button: str) -> None:
    """Press STOP or HOLD once, and print the state of the HAL before and after.

    Args:
        target: Bus of the robot.
        button: "STOP" or "HOLD".

    Raises:
        Failed: If no HAL is running, if another pendant keeps sending, or if the HAL is still ACTIVE.
        SystemExit: If a signal arrived.
    """
    from atalante_hal.types import SupervisorState
    from atalante_tools.session.pendant_node import Request
    from atalante_tools.session.pendant_session import PRESS_SYNCS

    with session(target) as operator:
        node = operator.node
        operator.listen()
        if node.hal is None:
            raise Failed(
                f"no SYNC received on {target}: start a HAL first, because {button} has no effect without a HAL"
            )
        before = node.hal
        node.press(Request[button])
        node.start_sending()
        operator.answer_syncs(PRESS_SYNCS)
        if operator.stop.wanted:
            raise SystemExit(operator.stop.exit_code)
        operator.check_takeover()
        after = node.hal
    if after in (SupervisorState.ACTIVE, SupervisorState.FULL_ASSIST):
        raise Failed(f"the HAL must be in HOLD after {button}, got {after.name}")
    click.echo(f"{button}: the HAL was {before.name} and is {after.name}")


@contextmanager
def session(target: Target) -> Iterator[Session]:
    """Open a pendant session on a bus, and close the bus after the block.

    Args:
        target: Bus of the robot.

    Raises:
        BusError: If the bus cannot be opened.
        ChannelMapError: If the channel map is invalid.
    """
    from atalante_hal.bus.resilient import ResilientBus
    from atalante_tools.session.pendant_node import PendantNode
    from atalante_tools.session.pendant_session import Keyboard, Session

    network, opened = open_pendant_bus(target)
    bus = ResilientBus(opened, print_message)
    try:
        with stop_requested() as stop:
            yield Session(
                PendantNode(network, bus),
                target,
                stop,
                Keyboard(_standard_input()),
                losses=lambda: bus.losses,
                reopens=lambda: bus.reopens,
            )
    finally:
        bus.close()


def open_pendant_bus(target: Target) -> tuple[Network, Bus]:
    """Load the DBC, open the bus of the pendant, and return the loaded DBC and the bus.

    Args:
        target: Interface and channel, or channel map.

    Raises:
        BusError: If the bus cannot be opened.
        ChannelMapError: If the channel map is invalid.
    """
    import atalante_dbc
    from atalante_hal.bus import open_bus
    from atalante_hal.bus.channel_map import parse_channel_map

    network = atalante_dbc.load()
    home = network.message("PENDANT_STATE").bus
    return network, open_bus(target.interface, parse_channel_map(target.channel, network.buses)[home])


def _standard_input() -> int | None:
    try:
        return sys.stdin.fileno()
    except (AttributeError, ValueError, OSError):  # stdin is closed, or has no file descriptor
        return None

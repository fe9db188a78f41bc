"""`atalante pendant`: be the operator, from any process on the bus."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

import click

from atalante_tools.console.options import Between, Target, target_options
from atalante_tools.console.outcome import Failed
from atalante_tools.console.stop_request import stop_requested
from atalante_tools.console.terminal import say

if TYPE_CHECKING:
    from atalante_dbc import Network
    from atalante_hal.bus import Bus
    from atalante_tools.session.pendant_session import Session

for_option = click.option(
    "--for",
    "seconds",
    type=Between(0.01, 86400.0),
    metavar="SECONDS",
    help="End after so long [s], with STOP; otherwise on Ctrl-C.",
)


@click.group()
def command() -> None:
    """Be the operator of the robot on a bus. One pendant speaks at a time: a new one takes over from the one before.

    While `start` and `xi` run they hold the dead-man, and take typed lines: start, stop, hold, xi 0.3.

    \b
    Example: atalante pendant start -i socketcan -c vcan0
             atalante pendant xi 0.3 -i socketcan -c vcan0
             atalante pendant stop -i socketcan -c vcan0
    """


@command.command(short_help="Hold the dead-man, press START, and stay.")
@target_options(embedded=False, clock=False)
@for_option
def start(target: Target, seconds: float | None) -> None:
    """Hold the dead-man, press START when the HAL is READY or in HOLD, and stay. Ctrl-C is STOP.

    \b
    Example: atalante pendant start -i socketcan -c vcan0
    """
    with session(target) as operator:
        operator.take()
        operator.start_wanted = True
        operator.stay(seconds)
    raise SystemExit(operator.stop.exit_code)


@command.command(short_help="Set the assistance factor, and stay.")
@click.argument("factor", metavar="X", type=Between(0.0, 1.0))
@target_options(embedded=False, clock=False)
@for_option
def xi(factor: float, target: Target, seconds: float | None) -> None:
    """Set the assistance factor to X, from 0 (patient alone) to 1 (robot alone), hold the dead-man, and stay.

    \b
    Example: atalante pendant xi 0.3 -i socketcan -c vcan0
    """
    with session(target) as operator:
        operator.take()
        operator.node.assist(factor)
        say(f"assistance factor {factor:g}")
        operator.stay(seconds)
    raise SystemExit(operator.stop.exit_code)


@command.command(short_help="Press STOP.")
@target_options(embedded=False, clock=False)
def stop(target: Target) -> None:
    """Press STOP for half a second and say what the HAL made of it.

    \b
    Example: atalante pendant stop -i socketcan -c vcan0
    """
    press_once(target, "STOP")


@command.command(short_help="Press HOLD.")
@target_options(embedded=False, clock=False)
def hold(target: Target) -> None:
    """Press HOLD for half a second and say what the HAL made of it.

    \b
    Example: atalante pendant hold -i socketcan -c vcan0
    """
    press_once(target, "HOLD")


def press_once(target: Target, button: str) -> None:
    """STOP or HOLD, as a command of its own.

    Raises:
        Failed: no HAL, or one that goes on.
    """
    from atalante_hal.types import SupervisorState
    from atalante_tools.session.pendant_node import Request
    from atalante_tools.session.pendant_session import SAY

    with session(target) as operator:
        node = operator.node
        operator.listen()
        if node.hal is None:
            raise Failed(f"no SYNC on {target}: no HAL is running there, so there is nothing to {button.lower()}")
        before = node.hal
        node.press(Request[button])
        node.speak()
        operator.speak_for(SAY)
        if operator.stop.wanted:
            raise SystemExit(operator.stop.exit_code)
        if node.refused:
            raise Failed("another pendant keeps speaking and does not give way: use that one")
        after = node.hal
    if after in (SupervisorState.ACTIVE, SupervisorState.FULL_ASSIST):
        raise Failed(f"the HAL is still {after.name} after {button}")
    click.echo(f"{button}: the HAL was {before.name} and is {after.name}")


@contextmanager
def session(target: Target) -> Iterator[Session]:
    """An operator on the bus; signals and keyboard are his."""
    from atalante_tools.session.pendant_node import PendantNode
    from atalante_tools.session.pendant_session import Keyboard, Session

    network, bus = open_pendant_bus(target)
    try:
        with stop_requested() as stop:
            yield Session(PendantNode(network, bus), target, stop, Keyboard(_standard_input()))
    finally:
        bus.close()


def open_pendant_bus(target: Target) -> tuple[Network, Bus]:
    """The network, and the one bus of it that carries the pendant. Raises `BusError`, `ChannelMapError`."""
    import atalante_dbc
    from atalante_hal.bus import open_bus
    from atalante_hal.bus.channel_map import parse_channel_map

    network = atalante_dbc.load()
    home = network.message("PENDANT_STATE").bus
    return network, open_bus(target.interface, parse_channel_map(target.channel, network.buses)[home])


def _standard_input() -> int | None:
    try:
        return sys.stdin.fileno()
    except (AttributeError, ValueError, OSError):  # closed, or not a file
        return None

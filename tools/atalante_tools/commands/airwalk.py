"""Command `atalante airwalk`: walks in the air inside one virtual guide, on any bus."""

from __future__ import annotations

import click

from atalante_tools.console.options import Target, target_options
from atalante_tools.session.airwalk import Options, run_trial, trial_options
from atalante_tools.session.shapes import SHAPE_HELP


@click.command()
@click.option(
    "--shape",
    default="constant",
    show_default=True,
    metavar="NAME|FILE",
    help=f"Shape of the guide: {SHAPE_HELP}.",
)
@target_options(embedded=True)
@trial_options(steps=30, out="runs/airwalk")
def command(shape: str, target: Target, options: Options, as_json: bool) -> None:
    """Walk in the air inside one virtual guide, with a real or an emulated robot.

    The robot starts when the operator presses START (`atalante pendant start`). The operator may change the assistance
    factor at any time. After a HOLD the command waits for the next START and counts the steps from 0 again. With -i embedded
    the command ends after a HOLD. After the last step, or after Ctrl-C, the robot is in HOLD. If a fault ends the command, the
    robot stays in FAULT.

    \b
    Example: atalante emulator -i socketcan -c vcan0     (in another terminal)
             atalante airwalk -i socketcan -c vcan0 --steps 5 --shape pinched
    """
    run_trial(target, (shape,), options, as_json=as_json)

"""Command `atalante airwalk`: walks in the air inside one virtual guide, on any bus."""

from __future__ import annotations

import click

from atalante_tools.console.options import Target, target_options
from atalante_tools.session.airwalk import SHAPE_NAMES, Options, run_trial, trial_options


@click.command()
@click.option(
    "--shape",
    default="constant",
    show_default=True,
    metavar="NAME",
    help=f"Shape of the guide: {SHAPE_NAMES}.",
)
@target_options(embedded=True)
@trial_options(steps=30, out="runs/airwalk")
def command(shape: str, target: Target, options: Options, as_json: bool) -> None:
    """Walk in the air inside one virtual guide, with a real or an emulated robot.

    The robot starts when the operator presses START (`atalante pendant start`). The operator may change the assistance
    factor at any time. After a HOLD the command waits for the next START and counts the steps from 0 again; with -i embedded
    it ends instead. After the steps or Ctrl-C the robot is in HOLD. If a fault ends the command, the robot stays in
    FAULT.

    \b
    Example: atalante emulator -i socketcan -c vcan0     (in another terminal)
             atalante airwalk -i socketcan -c vcan0 --steps 5 --shape pinched
    """
    run_trial(target, (shape,), options, as_json=as_json)

"""Command `atalante demo`: walks in the air inside each guide shape, with an emulated robot, telemetry and a recording."""

from __future__ import annotations

import click

from atalante_tools.console.options import EMBEDDED, Target, engine_option
from atalante_tools.session.airwalk import Options, run_trial, trial_options
from atalante_tools.session.shapes import SHAPE_HELP


@click.command()
@click.option(
    "--shape",
    metavar="NAME|FILE",
    multiple=True,
    help=f"Shape of the guide: {SHAPE_HELP}. Repeat the option for several shapes.  [default: all]",
)
@engine_option
@trial_options(steps=30, out="runs/demo")
def command(shape: tuple[str, ...], engine: str, options: Options, as_json: bool) -> None:
    """Walk in the air inside each guide shape with an emulated robot, faster than real time.

    The demo runs HAL, emulator, controller, telemetry (Zenoh, loopback only) and recording. Before the run it prints the
    certificate of each guide. After the run it prints the largest tracking error as a fraction of the distance to the edge of
    the guide. If the fraction is above 1.00, a joint left the guide.

    \b
    Example: atalante demo
             atalante demo --shape pinched --xi 0.25 --steps 5 --can-log demo.log
    """
    from atalante_control.guide.shapes import SHAPES

    run_trial(Target(EMBEDDED, "", lockstep=True, engine=engine), shape or tuple(SHAPES), options, as_json=as_json)

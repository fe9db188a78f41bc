"""`atalante emulator`: be the robot on a bus, until Ctrl-C."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from typing import TYPE_CHECKING, Final

import click

from atalante_tools.console.options import SEED, Between, Target, patient_options, target_options
from atalante_tools.console.stop_request import StopRequest, stop_requested
from atalante_tools.console.terminal import Progress, say

if TYPE_CHECKING:
    from atalante_control.model import Patient
    from atalante_emulator.emulator import Emulator
    from atalante_tools.commands.emulator_line import Line

#: Seconds between two status lines.
STATUS_PERIOD: Final = 1.0
#: Longest wait for a SYNC in lock-step before looking whether to stop [s].
LOOK_UP: Final = 0.1


@click.command()
@target_options(embedded=False)
@click.option("--seed", type=SEED, default=0, show_default=True, metavar="N", help="Of the sensors' noise.")
@click.option(
    "--operator/--no-operator",
    default=True,
    show_default=True,
    help="Hold the pendant too and press START when the HAL is ready; otherwise that is `atalante pendant`.",
)
@click.option(
    "--xi",
    type=Between(0.0, 1.0),
    metavar="X",
    help="Assistance factor the operator sets.  [default: none, the HAL's own stays]",
)
@patient_options(legs=False)
def command(target: Target, seed: int, operator: bool, xi: float | None, patient: Patient | None) -> None:
    """Be the robot on a bus: drives, IMUs, feet, motors and, unless told otherwise, the operator's pendant.

    With --wall a millisecond is a millisecond, HAL or not; with --lockstep time goes on with each SYNC alone. An interface that
    goes down is waited for.

    With --mass and --height its legs are as long as that patient needs them, as `atalante airwalk` with the same two expects.
    Nobody is in it: it hangs in the air and weighs what it weighs empty.

    \b
    Example: atalante emulator -i socketcan -c vcan0
             atalante emulator -i socketcan -c vcan0 --mass 75 --height 175
    """
    if xi is not None and not operator:
        raise click.UsageError("--xi is what the operator sets: leave --no-operator out, or use `atalante pendant xi`")
    import atalante_dbc
    from atalante_control.model import ExoskeletonParameters
    from atalante_hal.robot import load_robot
    from atalante_tools.session.body import open_body
    from atalante_tools.session.rig import join, open_buses

    network, robot, exoskeleton = atalante_dbc.load(), load_robot(), ExoskeletonParameters()
    other_side = f"atalante airwalk {target.arguments}"
    if patient is not None:
        exoskeleton = exoskeleton.fitted(patient)
        other_side += f" --mass {patient.mass:g} --height {patient.height:g}"
    with stop_requested() as stop, open_body(robot, exoskeleton=exoskeleton) as body:
        from atalante_emulator.emulator import Emulator
        from atalante_emulator.pendant import Operator
        from atalante_tools.commands.emulator_line import Line

        bus = Line(join(network, open_buses(network, target)), network.message("PENDANT_STATE").frame_id)
        try:
            pendant = Operator(xi) if operator else None
            emulator = Emulator(network, robot, body, bus, seed=seed, operator=pendant)
            say(f"the robot is on {target}; now, in another terminal: {other_side}")
            if not operator:
                say(f"its operator is you: atalante pendant start {target.arguments}")
            answer(emulator, target, over(stop, emulator, bus))
        finally:
            bus.close()
    raise SystemExit(stop.exit_code)


def answer(emulator: Emulator, target: Target, is_over: Callable[[], bool]) -> None:
    """Be the robot until `is_over()`."""
    if target.lockstep:
        while not is_over():
            emulator.poll(LOOK_UP)
    else:
        emulator.run(is_over)


def over(stop: StopRequest, emulator: Emulator, bus: Line) -> Callable[[], bool]:
    """Whether to stop; prints the status line on the way."""
    progress = Progress(period=STATUS_PERIOD)
    has_pendant = emulator.operator is not None

    def is_over() -> bool:
        nonlocal has_pendant
        if has_pendant and bus.pendant_given_away:
            has_pendant = False
            progress.clear()
            say("another pendant speaks: the emulated operator has put his down")
        if stop.wanted:
            progress.clear()
        elif progress.due():
            progress.show(status_line(emulator, bus))
        return stop.wanted

    return is_over


def status_line(emulator: Emulator, bus: Line) -> str:
    """Cycles, frames, drive states, and what is wrong with the interface."""
    states = Counter(state.name for state in emulator.drives.state)
    drives = ", ".join(f"{count} {name}" for name, count in states.items())
    lost = f", {emulator.frames_lost} lost" if emulator.frames_lost else ""
    down = f"; {bus.down}" if bus.down else ""
    return f"{emulator.cycle} cycles, {bus.received} frames in, {bus.sent} out{lost}; drives: {drives}{down}"

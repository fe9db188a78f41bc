"""`atalante emulator`: emulates the robot on a bus until Ctrl-C.

HAL in another process <- bus -> Line -> Emulator -> PyBullet body
"""

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

#: Time between two status lines [s].
STATUS_PERIOD: Final = 1.0
#: Longest wait for a SYNC in lock-step before the stop request is checked [s].
LOOK_UP: Final = 0.1


@click.command()
@target_options(embedded=False)
@click.option("--seed", type=SEED, default=0, show_default=True, metavar="N", help="Seed of the sensor noise.")
@click.option(
    "--operator/--no-operator",
    default=True,
    show_default=True,
    help="Emulate the pendant too, and press START when the HAL is READY. With --no-operator, use `atalante pendant`.",
)
@click.option(
    "--xi",
    type=Between(0.0, 1.0),
    metavar="X",
    help="Assistance factor set by the emulated operator, 0 to 1.  [default: the factor of the HAL]",
)
@patient_options(legs=False)
def command(target: Target, seed: int, operator: bool, xi: float | None, patient: Patient | None) -> None:
    """Emulate the robot on a bus: drives, IMUs, feet, vibration motors and the operator's pendant.

    With --wall the emulator runs in real time. With --lockstep it advances by one cycle at each SYNC of the HAL. If the
    interface goes down, the emulator waits until it is up again.

    --mass and --height adjust the leg lengths to a patient; give `atalante airwalk` the same values. The emulated
    exoskeleton is empty and suspended in the air.

    \b
    Example: atalante emulator -i socketcan -c vcan0
             atalante emulator -i socketcan -c vcan0 --mass 75 --height 175
    """
    if xi is not None and not operator:
        raise click.UsageError("--xi needs the emulated operator: remove --no-operator, or use `atalante pendant xi`")
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
            say(f"the emulated robot is on {target}; now type in another terminal: {other_side}")
            if not operator:
                say(f"to operate it, type: atalante pendant start {target.arguments}")
            answer(emulator, target, over(stop, emulator, bus))
        finally:
            bus.close()
    raise SystemExit(stop.exit_code)


def answer(emulator: Emulator, target: Target, is_over: Callable[[], bool]) -> None:
    """Emulate the robot until `is_over()` returns True.

    Args:
        emulator: Emulator on its bus.
        target: Bus and clock.
        is_over: Called once per cycle, or at the latest every `LOOK_UP` seconds.
    """
    if target.lockstep:
        while not is_over():
            emulator.poll(LOOK_UP)
    else:
        emulator.run(is_over)


def over(stop: StopRequest, emulator: Emulator, bus: Line) -> Callable[[], bool]:
    """Return the end condition of the emulator: a function that prints the status line and returns whether to stop.

    Args:
        stop: Stop request of the process.
        emulator: Emulator whose status is printed.
        bus: Bus of the emulator.
    """
    progress = Progress(period=STATUS_PERIOD)
    has_pendant = emulator.operator is not None

    def is_over() -> bool:
        nonlocal has_pendant
        if has_pendant and bus.pendant_given_away:
            has_pendant = False
            progress.clear()
            say("another pendant sends: the emulated pendant has stopped")
        if stop.wanted:
            progress.clear()
        elif progress.due():
            progress.show(status_line(emulator, bus))
        return stop.wanted

    return is_over


def status_line(emulator: Emulator, bus: Line) -> str:
    """Return the status line: cycles, frames, drive states, and the error of an interface that is down.

    Args:
        emulator: Emulator to report.
        bus: Bus of the emulator.
    """
    states = Counter(state.name for state in emulator.drives.state)
    drives = ", ".join(f"{count} {name}" for name, count in states.items())
    lost = f", {emulator.frames_lost} lost" if emulator.frames_lost else ""
    down = f"; {bus.down}" if bus.down else ""
    return f"{emulator.cycle} cycles, {bus.received} frames in, {bus.sent} out{lost}; drives: {drives}{down}"

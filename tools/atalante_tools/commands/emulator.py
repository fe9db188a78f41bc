"""Command `atalante emulator`: emulates the robot on a bus until Ctrl-C.

HAL in another process <- bus -> Line -> Emulator -> PyBullet body
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from typing import TYPE_CHECKING, Final

import click

from atalante_tools.console.options import SEED, Between, Target, patient_options, target_options
from atalante_tools.console.outcome import Failed
from atalante_tools.console.stop_request import StopRequest, stop_requested
from atalante_tools.console.terminal import Progress, say

if TYPE_CHECKING:
    from atalante_control.model import Patient
    from atalante_emulator.emulator import Emulator
    from atalante_tools.commands.emulator_line import Line

#: Period of the status line [s].
STATUS_PERIOD: Final = 1.0
#: Longest wait for a SYNC in lock-step [s]. After this time, the stop request is checked.
POLL_TIMEOUT: Final = 0.1
#: Time to listen for another robot before the first frame [s]. Without a HAL, each node sends its status every 0.1 s.
LISTEN: Final = 0.25


@click.command()
@target_options(embedded=False)
@click.option("--seed", type=SEED, default=0, show_default=True, metavar="N", help="Seed of the emulated sensor noise.")
@click.option(
    "--operator/--no-operator",
    default=True,
    show_default=True,
    help="Emulate a pendant and its operator, who presses START when the HAL is in READY. "
    "With --no-operator, `atalante pendant` must act as the pendant.",
)
@click.option(
    "--xi",
    type=Between(0.0, 1.0),
    metavar="X",
    help="Assistance factor that the emulated operator sets, 0 to 1.  [default: the HAL keeps its own factor]",
)
@patient_options(legs=False)
def command(target: Target, seed: int, operator: bool, xi: float | None, patient: Patient | None) -> None:
    """Emulate the robot on a bus: drives, IMUs, feet, vibration motors and the operator's pendant.

    With --wall the emulator runs in real time. With --lockstep it advances by one cycle at each SYNC of the HAL. If the
    interface goes down, the emulator waits until it is up again. It does not start if another robot answers on the bus.

    --mass and --height adjust the leg lengths to a patient. `atalante airwalk` requires the same values. The emulated
    exoskeleton is empty and suspended in the air.

    \b
    Example: atalante emulator -i socketcan -c vcan0
             atalante emulator -i socketcan -c vcan0 --mass 75 --height 175
    """
    if xi is not None and not operator:
        raise click.UsageError(
            "--xi requires the emulated operator: remove --no-operator, or use `atalante pendant xi`"
        )
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

        bus = Line(join(network, open_buses(network, target)), network)
        try:
            if message := bus.listen(LISTEN):
                raise Failed(f"another robot answers on {target} (received {message}): stop it first")
            pendant = Operator(xi) if operator else None
            emulator = Emulator(network, robot, body, bus, seed=seed, operator=pendant)
            say(f"the emulated robot is on {target}; now type in another terminal: {other_side}")
            if not operator:
                say(f"to operate it, type: atalante pendant start {target.arguments}")
            run(emulator, target, end_condition(stop, emulator, bus))
        finally:
            bus.close()
    raise SystemExit(stop.exit_code)


def run(emulator: Emulator, target: Target, is_over: Callable[[], bool]) -> None:
    """Run the emulator until the end condition `is_over()` returns True.

    Args:
        emulator: Emulator on its bus.
        target: Bus and clock.
        is_over: End condition. It is called in every cycle, and at least every `POLL_TIMEOUT` seconds.
    """
    if target.lockstep:
        while not is_over():
            emulator.poll(POLL_TIMEOUT)
    else:
        emulator.run(is_over)


def end_condition(stop: StopRequest, emulator: Emulator, bus: Line) -> Callable[[], bool]:
    """Return a function that returns whether the emulator must end. The function also prints the status line when it is due.

    Args:
        stop: Stop request of the process.
        emulator: Emulator whose status is printed.
        bus: Bus of the emulator.
    """
    progress = Progress(period=STATUS_PERIOD)
    has_pendant = emulator.operator is not None
    alone = True

    def is_over() -> bool:
        nonlocal has_pendant, alone
        if alone and bus.other_robot:
            alone = False
            progress.clear()
            say(f"another robot answers, too (received {bus.other_robot}): stop one of them; the HAL refuses START")
        if has_pendant and bus.pendant_displaced:
            has_pendant = False
            progress.clear()
            say("another pendant sends: the emulated pendant stopped")
        if stop.wanted:
            progress.clear()
        elif progress.due():
            progress.show(status_line(emulator, bus))
        return stop.wanted

    return is_over


def status_line(emulator: Emulator, bus: Line) -> str:
    """Return the status line with cycles, frames and drive states. Append a note about another robot or a failed interface.

    Args:
        emulator: Emulator whose status is printed.
        bus: Bus of the emulator.
    """
    states = Counter(state.name for state in emulator.drives.state)
    drives = ", ".join(f"{count} {name}" for name, count in states.items())
    lost = f", {emulator.frames_lost} lost" if emulator.frames_lost else ""
    down = f"; {bus.down}" if bus.down else ""
    other = "; another robot answers, too" if bus.other_robot else ""
    return f"{emulator.cycle} cycles, {bus.received} frames in, {bus.sent} out{lost}; drives: {drives}{other}{down}"

"""Command `atalante emulator`: emulates the robot on a bus until Ctrl-C.

HAL in another process <-> bus <-> Line <-> Emulator <-> body
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from typing import TYPE_CHECKING, Final

import click

from atalante_tools.console.options import (
    SEED,
    Between,
    GaitFiles,
    Target,
    engine_option,
    gait_options,
    patient_arguments,
    patient_options,
    target_options,
)
from atalante_tools.console.outcome import Failed
from atalante_tools.console.stop_request import StopRequest, stop_requested
from atalante_tools.console.terminal import Progress, print_message

if TYPE_CHECKING:
    from atalante_control.model import Patient
    from atalante_emulator.emulator import Emulator
    from atalante_tools.commands.emulator_line import Line

#: Period of the status line [s].
STATUS_PERIOD: Final = 1.0
#: Longest wait for a SYNC in lock-step [s]. Ctrl-C without a HAL takes effect at the end of the wait.
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
@engine_option
@click.option(
    "--ground",
    "friction",
    type=Between(0.01, 2.0),
    is_flag=False,
    flag_value=0.6,
    metavar="MU",
    help="Put the robot on the ground, with the coefficient of friction MU. Without MU, the coefficient is 0.6. A crane lowers "
    "the robot when the HAL is ACTIVE.  [default: suspended in the air]",
)
@click.option(
    "--wearer",
    type=click.Choice(("none", "passive")),
    default="none",
    show_default=True,
    help="With passive, the relaxed limbs of the wearer act on the joints as springs and dampers.",
)
@click.option(
    "--virtual-operator",
    "operator_force",
    type=Between(0.0, 1000.0),
    default=0.0,
    show_default=True,
    metavar="N",
    help="Largest horizontal force with which a virtual operator steadies the pelvis of the robot [N]. Requires --ground. "
    "With 0, there is no operator.",
)
@patient_options
@gait_options
def command(
    target: Target,
    seed: int,
    operator: bool,
    xi: float | None,
    friction: float | None,
    wearer: str,
    operator_force: float,
    patient: Patient | None,
    files: GaitFiles,
) -> None:
    """Emulate the robot on a bus: drives, IMUs, feet, vibration motors and the operator's pendant.

    With --wall the emulator runs in real time. With --lockstep it advances by one cycle at each SYNC of the HAL. If the
    interface goes down, the emulator waits until the interface is up again. The emulator does not start if another robot
    answers on the bus.

    --mass, --height, --thigh and --shank adjust the leg lengths to a patient. Without these options, --gait adjusts the leg
    lengths to the patient in the file. --network checks that the network covers the patient. Give the same values and files to
    `atalante airwalk` or `atalante walk`. In the air, the exoskeleton is empty. On the ground, the patient wears the
    exoskeleton: without a patient, the default patient of `atalante walk` (75 kg, 1.75 m).

    \b
    Example: atalante emulator -i socketcan -c vcan0
             atalante emulator -i socketcan -c vcan0 --mass 75 --height 175
             atalante emulator -i socketcan -c vcan0 --mass 75 --height 175 --ground --engine mujoco
    """
    if operator_force and friction is None:
        raise click.UsageError("--virtual-operator requires a robot on the ground: add --ground")
    if xi is not None and not operator:
        raise click.UsageError(
            "--xi requires the emulated operator: remove --no-operator, or use `atalante pendant xi`"
        )
    files.require_patient(patient)
    import atalante_dbc
    from atalante_control.model import ExoskeletonParameters, Patient
    from atalante_emulator.mechanics import Ground, Mechanics
    from atalante_emulator.wearer import LimbParameters
    from atalante_hal.robot import load_robot
    from atalante_tools.session.body import describe, open_mechanics
    from atalante_tools.session.gait_source import patient_of_files
    from atalante_tools.session.rig import join, open_buses
    from atalante_tools.session.walk_options import DEFAULT_PATIENT

    network, robot, exoskeleton = atalante_dbc.load(), load_robot(), ExoskeletonParameters()
    other_side = f"atalante {'airwalk' if friction is None else 'walk'} {target.arguments}"
    if patient is not None:
        other_side += f" {patient_arguments(patient)}"
    other_side += files.arguments
    patient = patient_of_files(files, patient, robot)
    if patient is None and friction is not None:
        patient = Patient(*DEFAULT_PATIENT)
    if patient is not None:
        exoskeleton = exoskeleton.fitted(patient)
    ground = None if friction is None else Ground(friction, operator_force=operator_force)
    mechanics = Mechanics(
        describe(robot, exoskeleton, patient if ground else None),
        target.engine,
        ground,
        LimbParameters() if wearer == "passive" else None,
    )
    with stop_requested() as stop, open_mechanics(mechanics) as body:
        from atalante_emulator.emulator import Emulator
        from atalante_emulator.pendant import Operator
        from atalante_tools.commands.emulator_line import Line

        bus = Line(join(network, open_buses(network, target)), network)
        try:
            if message := bus.listen(LISTEN):
                raise Failed(f"another robot answers on {target} (received {message}): stop it first")
            pendant = Operator(xi) if operator else None
            emulator = Emulator(
                network, robot, body, bus, seed=seed, operator=pendant, parameters=mechanics.node_parameters
            )
            mechanics.complete(emulator)
            print_message(f"the emulated robot is on {target}; now type in another terminal: {other_side}")
            if not operator:
                print_message(f"to operate it, type: atalante pendant start {target.arguments}")
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
    """Return a function that returns whether the emulator must stop.

    Each call of the returned function also prints warnings, and the status line once per `STATUS_PERIOD`.

    Args:
        stop: Stop request of the process.
        emulator: Emulator whose status is printed.
        bus: Bus of the emulator.
    """
    progress = Progress(period=STATUS_PERIOD)
    has_pendant = emulator.operator is not None
    alone = True
    received = 0  # value of `bus.received` at the last status line

    def is_over() -> bool:
        nonlocal has_pendant, alone, received
        if alone and bus.other_robot:
            alone = False
            progress.clear()
            print_message(
                f"another robot answers, too (received {bus.other_robot}): stop one of them; the HAL refuses START"
            )
        if has_pendant and bus.pendant_displaced:
            has_pendant = False
            progress.clear()
            print_message("another pendant sends: the emulated pendant stopped")
        if stop.wanted:
            progress.clear()
        elif progress.due():
            progress.show(status_line(emulator, bus, silent=bus.received == received))
            received = bus.received
        return stop.wanted

    return is_over


def status_line(emulator: Emulator, bus: Line, *, silent: bool) -> str:
    """Return the status line with cycles, frames and drive states.

    A note follows if another robot answers, if the interface failed, or if no HAL sends.

    Args:
        emulator: Emulator whose status is printed.
        bus: Bus of the emulator.
        silent: Whether no frame was received since the last status line.
    """
    states = Counter(state.name for state in emulator.drives.state)
    drives = ", ".join(f"{count} {name}" for name, count in states.items())
    lost = f", {emulator.frames_lost} lost" if emulator.frames_lost else ""
    missing = "; no SYNC received: waiting for a HAL" if silent else ""
    down = f"; {bus.down}" if bus.down else missing
    other = "; another robot answers, too" if bus.other_robot else ""
    return f"{emulator.cycle} cycles, {bus.received} frames in, {bus.sent} out{lost}; drives: {drives}{other}{down}"

"""Command `atalante vibrate`: runs one vibration motor while the robot holds its pose."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import click

from atalante_tools.console.names import find
from atalante_tools.console.options import Between, Target, json_option, target_options
from atalante_tools.console.outcome import Failed
from atalante_tools.console.stop_request import stop_requested
from atalante_tools.console.terminal import print_message, show_json

if TYPE_CHECKING:
    from atalante_hal.types import State

#: Shortest vibration for which the measured level is checked [s].
#: The slowest motor that `atalante conform` accepts has a time constant of 0.06 s.
#: In 0.1 s, such a motor reaches 80 % of the commanded level.
_CHECKED: Final = 0.1
#: Smallest accepted ratio of the highest measured level to the commanded level. If the ratio is smaller, the command fails.
_REACHED: Final = 0.5


@click.command()
@click.argument("motor")
@click.argument("level", type=Between(0.0, 1.0))
@click.option(
    "--for",
    "seconds",
    type=Between(0.01, 3600.0),
    default=1.0,
    show_default=True,
    metavar="SECONDS",
    help="Duration of the vibration [s].",
)
@target_options(embedded=True)
@json_option
def command(motor: str, level: float, seconds: float, target: Target, as_json: bool) -> None:
    """Run one vibration motor at a LEVEL from 0 (off) to 1 (strongest). All joints hold their position.

    MOTOR is left_ or right_, then thigh_ or shank_, then front or back. Example: left_thigh_front.

    The motor runs after the operator presses START (`atalante pendant start`). With -i embedded, an emulated operator
    presses START. The robot ends in HOLD. The exit code is 1 if the motor runs for 0.1 s or more and does not reach half of
    LEVEL.

    \b
    Example: atalante vibrate left_thigh_front 0.5 --for 2
    """
    import numpy as np

    from atalante_hal.robot import MOTORS, load_robot
    from atalante_tools.session.pose_hold import PoseHold
    from atalante_tools.session.rig import Watch, final_state, open_hal

    index = find(motor, MOTORS, "motor")
    robot = load_robot()
    levels = np.zeros(len(MOTORS))
    levels[index] = level
    controller = PoseHold(robot, vibration=levels)
    strongest = 0.0

    def done(state: State) -> bool:
        nonlocal strongest
        strongest = max(strongest, float(state.vibration[index]))
        return controller.elapsed >= seconds

    def describe(state: State) -> str:
        return f"{MOTORS[index]} at {state.vibration[index]:.2f}, {seconds - controller.elapsed:.0f} s left"

    fields = controller.telemetry_fields
    with open_hal(target, robot=robot, controller_fields=fields) as rig, stop_requested() as stop:
        watch = Watch(rig, stop, done, describe)
        rig.run(controller, until=watch)
        watch.conclude()
    if as_json:
        show_json(
            {
                "motor": MOTORS[index],
                "level": level,
                "measured": round(strongest, 3),
                "seconds": round(controller.elapsed, 3),
            }
        )
    else:
        click.echo(f"{MOTORS[index]}: commanded {level:.2f}, measured at most {strongest:.2f}, for {seconds:g} s")
    print_message(final_state(rig))
    if controller.elapsed >= _CHECKED and strongest < _REACHED * level:
        raise Failed(
            f"{MOTORS[index]} must reach half of the commanded level {level:g}, but at most {strongest:.3f} was measured: "
            "check the motor and the node HAPTICS"
        )

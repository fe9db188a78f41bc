"""Command `atalante jog`: moves one joint to an angle. All other joints hold their position."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

import click

from atalante_tools.console.names import find
from atalante_tools.console.options import SEED, Target, json_option, target_options
from atalante_tools.console.outcome import Failed
from atalante_tools.console.stop_request import stop_requested
from atalante_tools.console.terminal import print_message, show_json

if TYPE_CHECKING:
    from atalante_hal.robot import Robot
    from atalante_hal.types import State

#: Longest wait after the move until the joint is at rest [s].
SETTLE: Final = 1.0
#: The joint is at rest if its distance from the target angle is below RESTED[0] [rad] and its speed is below RESTED[1] [rad/s].
RESTED: Final = (math.radians(0.05), math.radians(0.5))
#: Largest accepted difference between the final and the target angle of the joint [rad]. If it is larger, the command fails.
TOLERANCE: Final = math.radians(1.0)


@click.command()
@click.argument("joint")
@click.option("--to", "degrees", type=float, required=True, metavar="DEG", help="Target angle of the joint [deg].")
@click.option(
    "--speed", type=float, default=20.0, show_default=True, metavar="DEG_S", help="Peak speed of the move [deg/s]."
)
@click.option("--seed", type=SEED, default=0, show_default=True, metavar="N", help="Seed of the emulated sensor noise.")
@target_options(embedded=True)
@json_option
def command(joint: str, degrees: float, speed: float, seed: int, target: Target, as_json: bool) -> None:
    """Move one joint to an angle in degrees. All other joints hold their position.

    JOINT is left_ or right_ plus the name of a leg joint. Hip: FH (frontal), TH (transverse), SH (sagittal). Knee: SK.
    Ankle: SA (sagittal), HA (Henke axis). Example: left_SK. For an angle out of range, the error shows the range of the joint.

    The robot moves when the operator presses START (`atalante pendant start`). With -i embedded, an emulated operator
    presses START. The robot ends in HOLD.

    \b
    Example: atalante jog left_SK --to 30
             atalante jog right_SH --to -20 --speed 10 -i socketcan -c vcan0
    """
    from atalante_hal.robot import JOINTS, load_robot
    from atalante_tools.session.pose_hold import Move, PoseHold
    from atalante_tools.session.rig import Watch, final_state, open_hal

    index = find(joint, JOINTS, "joint")
    name = JOINTS[index]
    robot = load_robot()
    move = Move(index, _angle(robot, index, name, degrees), _speed(robot, index, name, speed))
    controller = PoseHold(robot, move=move)
    start_angle: list[float] = []

    def done(state: State) -> bool:
        if not start_angle:
            start_angle.append(float(state.position[index]))
        left = controller.elapsed - controller.duration
        rested = abs(state.position[index] - move.target) < RESTED[0] and abs(state.velocity[index]) < RESTED[1]
        return left >= SETTLE or (left >= 0.0 and bool(rested))

    def describe(state: State) -> str:
        return f"{name} {math.degrees(state.position[index]):7.2f} deg, target {degrees:.2f} deg"

    fields = controller.telemetry_fields
    with open_hal(target, robot=robot, seed=seed, controller_fields=fields) as rig, stop_requested() as stop:
        watch = Watch(rig, stop, done, describe)
        rig.run(controller, until=watch)
        watch.conclude()
        reached = float(rig.hal.state.position[index])
    result = {
        "joint": name,
        "from_deg": round(math.degrees(start_angle[0]), 3),
        "to_deg": degrees,
        "reached_deg": round(math.degrees(reached), 3),
        "error_deg": round(math.degrees(reached - move.target), 3),
        "seconds": round(controller.elapsed, 3),
    }
    if as_json:
        show_json(result)
    else:
        click.echo(
            f"{name}: {result['from_deg']:.2f} -> {result['reached_deg']:.2f} deg in {result['seconds']:.2f} s, "
            f"error {result['error_deg']:+.2f} deg"
        )
    if abs(reached - move.target) > TOLERANCE:
        raise Failed(
            f"{name} must reach {degrees:g} degrees, got {math.degrees(reached):.1f}: check that the joint can move freely"
        )
    print_message(final_state(rig))


def _angle(robot: Robot, index: int, name: str, degrees: float) -> float:
    low, high = math.degrees(robot.position_min[index]), math.degrees(robot.position_max[index])
    if not low <= degrees <= high:
        raise click.UsageError(f"{name} must be from {low:.1f} to {high:.1f} degrees, got {degrees:g}")
    return math.radians(degrees)


def _speed(robot: Robot, index: int, name: str, speed: float) -> float:
    limit = math.degrees(robot.velocity_max[index])
    if not 0.0 < speed <= limit:
        raise click.UsageError(f"the speed of {name} must be above 0 and at most {limit:.0f} deg/s, got {speed:g}")
    return math.radians(speed)

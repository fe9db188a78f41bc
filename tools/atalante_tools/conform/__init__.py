"""Command `atalante conform`: acceptance test of one real or emulated node, in which this computer replaces the HAL."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

import click

from atalante_tools.console.options import Between, Target, json_option, target_options, typed
from atalante_tools.console.outcome import FAILED
from atalante_tools.console.stop_request import check_stop, ended_by
from atalante_tools.console.terminal import print_message, show_json

if TYPE_CHECKING:
    from atalante_tools.conform.node_tester import NodeTester
    from atalante_tools.conform.requirement import Requirement


@click.command()
@click.argument("node")
@target_options(embedded=True, clock=False)
@click.option(
    "--only", multiple=True, metavar="ID", help="Test only this requirement; repeat the option for more than one."
)
@click.option(
    "--without", multiple=True, metavar="ID", help="Skip this requirement; repeat the option for more than one."
)
@click.option(
    "--torque",
    type=Between(0.5, 20.0),
    default=3.0,
    show_default=True,
    metavar="NM",
    help="Largest torque commanded to a drive, in Nm.",
)
@click.option(
    "--patience",
    type=Between(0.5),
    default=30.0,
    show_default=True,
    metavar="S",
    help="Longest wait for the effect of each manual action on a real node, in seconds.",
)
@json_option
def command(
    node: str,
    target: Target,
    only: tuple[str, ...],
    without: tuple[str, ...],
    torque: float,
    patience: float,
    as_json: bool,
) -> None:
    """Test one NODE (LEFT_SK, IMU_TORSO, FOOT_LEFT, HAPTICS, PENDANT, ...) and print an acceptance report.

    The command sends SYNC and commands in place of the HAL. For the test of a drive, no patient may be in the
    exoskeleton, and the joint of the drive must be free to move by about 10 cm. The exit code is 1 if a requirement
    failed or could not be tested.

    \b
    Example: atalante conform LEFT_SK
             atalante conform LEFT_SK -i socketcan -c can0 --torque 1
    """
    if target.embedded and typed("patience"):
        raise click.UsageError(
            "--patience requires a CAN bus, because an emulated node needs no manual action: remove --patience"
        )
    from datetime import datetime

    from atalante_tools.conform.examination import make_safe, requirements_of
    from atalante_tools.conform.report import as_object, conclusion, entry, heading
    from atalante_tools.conform.requirement import Verdict, examine

    with _open_tester(node, target, torque, patience) as tester:
        check_stop()
        requirements = _chosen(requirements_of(tester), only, without)
        if not as_json:
            click.echo(heading(tester, str(target), f"{datetime.now():%Y-%m-%d %H:%M}"))
        results = []
        try:
            for result in examine(tester, requirements):
                results.append(result)
                if as_json:
                    show_json(as_object(tester, result))
                else:
                    click.echo(entry(result))
        finally:
            with ended_by(lambda: None):  # a second stop signal must not interrupt `make_safe`
                make_safe(tester)
    for skipped in without:
        print_message(f"skipped on request: {skipped.upper()}")
    print_message(conclusion(tester, results))
    if any(result.verdict is not Verdict.PASSED for result in results):
        raise SystemExit(FAILED)


def _chosen(requirements: list[Requirement], only: tuple[str, ...], without: tuple[str, ...]) -> list[Requirement]:
    from atalante_tools.console.names import find

    ids = [requirement.id for requirement in requirements]
    selected = sorted({find(name, ids, "requirement") for name in only}) if only else range(len(ids))
    skipped = {find(name, ids, "requirement") for name in without}
    chosen = [requirements[index] for index in selected if index not in skipped]
    if not chosen:
        raise click.UsageError("at least one requirement must be tested, but --only and --without leave none")
    return chosen


@contextmanager
def _open_tester(name: str, target: Target, torque: float, patience: float) -> Iterator[NodeTester]:
    import atalante_dbc
    from atalante_hal.robot import load_robot
    from atalante_tools.conform.node_tester import Limits, LockStep, NodeTester, WallClock
    from atalante_tools.conform.technician import EmulatorTechnician, HumanTechnician
    from atalante_tools.console.names import find

    network, robot, limits = atalante_dbc.load(), load_robot(), Limits(torque)
    nodes = [node for node in network.nodes if node.kind != "master"]
    node = nodes[find(name, [node.name for node in nodes], "node")]
    if target.embedded:
        from atalante_hal.bus.pair import lockstep_pair
        from atalante_tools.session.body import open_body

        with open_body(robot, engine=target.engine) as body:
            from atalante_emulator.emulator import Emulator
            from atalante_emulator.pendant import Operator

            ours, theirs = lockstep_pair()
            operator = Operator(starts=False)
            emulator = Emulator(network, robot, body, theirs, operator=operator)
            ours.step = emulator.poll
            yield NodeTester(
                network, robot, node, ours, LockStep(emulator), EmulatorTechnician(emulator, operator), limits
            )
        return
    from atalante_hal.bus import open_bus
    from atalante_hal.bus.channel_map import parse_channel_map
    from atalante_hal.loop import realtime

    bus_name = network.message(f"{node.name}_STATE").bus
    channel = (
        target.channel if "=" not in target.channel else parse_channel_map(target.channel, network.buses)[bus_name]
    )
    bus = open_bus(target.interface, channel)
    try:
        tester = NodeTester(network, robot, node, bus, WallClock(), HumanTechnician(patience), limits)
        tester.require_no_other_master()
        for problem in realtime():
            print_message(problem)
        yield tester
    finally:
        bus.close()

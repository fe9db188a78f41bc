"""Command `atalante gait solve`: optimise a gait, and show it as tables, a plot and an animation."""

from __future__ import annotations

import math
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import click

from atalante_tools.console.options import OutputFile, json_option, subject_options
from atalante_tools.console.outcome import Failed
from atalante_tools.console.stop_request import stop_requested
from atalante_tools.console.terminal import Progress, print_message, show_json, table
from atalante_tools.session.extra import extra, require_matplotlib

if TYPE_CHECKING:
    from atalante_control.gait.gait import Gait, Kind
    from atalante_control.gait.subject import Subject
    from atalante_control.gait.walk import WalkGaits
    from atalante_control.gait_optimization.result import SolvedGait
    from atalante_control.gait_optimization.verify import GaitCheck


@click.command(short_help="Optimise the gait of a patient.")
@subject_options
@click.option(
    "--kind",
    type=click.Choice(["periodic", "start", "stop", "walk"]),
    default="periodic",
    show_default=True,
    help="Step to solve: a periodic step, the start step from rest to walking, the stop step from walking to rest, or a "
    "walk with all three steps.",
)
@click.option(
    "--network",
    type=click.Path(path_type=Path, dir_okay=False),
    metavar="FILE",
    help="With --kind walk, take the periodic step from this gait network.  [default: the periodic step is solved]",
)
@click.option(
    "--out", type=OutputFile(".json"), metavar="FILE", help="Write the gait, or the walk, to this .json file."
)
@click.option(
    "--plot",
    type=OutputFile(".png", ".svg", ".pdf"),
    metavar="FILE",
    help="Plot angles, torques, centre of pressure and clearance to this .png, .svg or .pdf file.",
)
@click.option(
    "--animate", type=OutputFile(".gif"), metavar="FILE", help="Animate the step as a stick figure in this .gif file."
)
@json_option
def solve(
    subject: Subject | None,
    kind: Kind | Literal["walk"],
    network: Path | None,
    out: Path | None,
    plot: Path | None,
    animate: Path | None,
    as_json: bool,
) -> None:
    """Optimise the gait of a patient. If no gait is found, the exit code is 1 and stderr names the violated constraint.

    If a periodic step fails, it is solved again. The second solve starts from the gait of the same patient with a moderate step.
    If the second solve fails too, stderr also names the joints that are at a limit.

    The solved gait is verified with Pinocchio, independently of the optimiser. Torques are in Nm, angles in degrees.

    \b
    Example: atalante gait solve --mass 75 --height 175
             atalante gait solve --mass 58 --height 1.62 --step-length 0.12 --step-duration 0.9 --out gait.json --plot gait.png
             atalante gait solve --mass 75 --height 175 --kind start --animate start.gif
             atalante gait solve --mass 75 --height 175 --kind walk --out walk.json
    """
    if subject is None:
        raise click.UsageError("mass and height of the patient must be given: add --mass and --height")
    if network is not None and kind != "walk":
        raise click.UsageError("--network requires --kind walk")
    if kind == "walk" and (plot is not None or animate is not None):
        raise click.UsageError("--plot and --animate show a single step: use --kind periodic, start or stop")
    if plot is not None or animate is not None:
        require_matplotlib()
    from atalante_control.gait.gait import write_gait

    if kind == "walk":
        walk = _walk(subject, network, as_json)
        if out is not None:
            from atalante_control.gait.walk import write_walk

            write_walk(walk, out)
            print_message(f"walk in {out}")
        return
    solved = _solved(subject, kind, None, as_json)
    if out is not None:
        write_gait(solved.gait, out)
        print_message(f"gait in {out}")
    if plot is not None or animate is not None:
        _draw(solved, subject, plot, animate)


def _walk(subject: Subject, network: Path | None, as_json: bool) -> WalkGaits:
    """Return a verified walk, which consists of a start step, a periodic step and a stop step.

    The solver computes the steps. If a network file is given, the periodic step comes from the network.

    Raises:
        Failed: If a step has no solution or fails the verification.
        GaitError: If the steps do not fit together.
        NetworkError: If the network file is invalid, or if the subject is outside the range of the network.
    """
    from atalante_control.dynamics.gait_network import load_network
    from atalante_control.gait.gait import check_gait
    from atalante_control.gait.walk import WalkGaits, check_walk
    from atalante_control.gait_optimization.walk_verification import check_on_ground
    from atalante_hal.robot import load_robot

    robot = load_robot()
    if network is None:
        periodic = _solved(subject, "periodic", None, as_json).gait
    else:
        periodic = load_network(network).gait(subject, robot)
        check_gait(periodic, robot, str(network))
    start = _solved(subject, "start", periodic, as_json).gait
    stop = _solved(subject, "stop", periodic, as_json).gait
    walk = WalkGaits(start, periodic, stop)
    check_walk(walk, robot)
    check_on_ground(walk, subject.patient, robot, "walk")
    return walk


def _solved(subject: Subject, kind: Kind, around: Gait | None, as_json: bool) -> SolvedGait:
    """Return a solved and verified step, and print its tables or its JSON object.

    Raises:
        Failed: If the step has no solution or fails the verification.
    """
    with extra():
        from atalante_control.gait_optimization.second_start import solve_with_second_start
        from atalante_control.gait_optimization.solve import solve as optimise
    from atalante_control.gait_optimization.verify import Verifier
    from atalante_hal.robot import load_robot

    progress = Progress()
    progress.show(f"{subject}: building the nonlinear program")

    def show(iteration: int, violation: float) -> None:
        if progress.due():
            progress.show(f"{subject}: iteration {iteration}, constraints violated by up to {violation:.1e}")

    # A signal such as Ctrl-C takes effect after the solve. An interrupted optimiser would report a failed gait.
    with stop_requested() as stop:
        if kind == "periodic":
            solved = solve_with_second_start(subject, partial(optimise, progress=show))
        else:
            solved = optimise(subject, kind=kind, progress=show, around=around)
    progress.clear()
    if stop.wanted:
        raise SystemExit(stop.exit_code)
    if as_json:
        show_json({**_summary(subject, solved), "kind": kind})
    if not solved.solved:
        raise Failed(solved.status)
    checks = Verifier(load_robot(), subject.patient).verify(solved.gait, kind)
    if not as_json:
        click.echo("\n\n".join([_torques(solved), _residuals(solved), _verification(checks)]))
    print_message(f"{kind} step of {subject}: {solved.iterations} iterations, {solved.solve_s:.2f} s")
    if failed := [check.name for check in checks if not check.holds]:
        raise Failed(f"the gait fails the verification with Pinocchio: {', '.join(failed)}")
    return solved


def _summary(subject: Subject, solved: SolvedGait) -> dict[str, Any]:
    """Return the JSON object of the result. `status` is "solved" or the reason of the failure; torques are in Nm."""
    from atalante_hal.robot import JOINTS

    return {
        "status": solved.status,
        "solve_s": solved.solve_s,
        "max_residual": solved.max_residual,
        "step_length": subject.step_length,
        "step_duration": subject.step_duration,
        "peak_torque": float(solved.peak_torque.max()),
        "peak_torques": dict(zip(JOINTS, solved.peak_torque.tolist(), strict=True)),
    }


def _torques(solved: SolvedGait) -> str:
    """Return a table of peak torques and angle ranges of all joints, for the stance leg (right) and the swing leg (left)."""
    from atalante_hal.robot import LEG_JOINTS, load_robot

    limits = load_robot().torque_max
    angles = solved.gait.tables().q
    rows = []
    for i, joint in enumerate(LEG_JOINTS):
        ranges = []
        for column in (i + len(LEG_JOINTS), i):
            low, high = (math.degrees(value) for value in (angles[:, column].min(), angles[:, column].max()))
            ranges.append(f"{low:.0f} to {high:.0f}")
        stance, swing = solved.peak_torque[i + len(LEG_JOINTS)], solved.peak_torque[i]
        rows.append([joint, f"{stance:.1f}", f"{swing:.1f}", f"{limits[i]:.0f}", *ranges])
    return table([["joint", "stance Nm", "swing Nm", "limit Nm", "stance deg", "swing deg"], *rows])


def _residuals(solved: SolvedGait) -> str:
    rows = [[name, f"{residual.value:.1e}", residual.unit] for name, residual in solved.residuals.items()]
    return table([["constraint", "violated by", "unit"], *rows])


def _verification(checks: tuple[GaitCheck, ...]) -> str:
    rows = [[c.name, f"{c.value:.3g}", f"{c.limit:.3g}", c.unit, "ok" if c.holds else "FAIL"] for c in checks]
    return table([["by Pinocchio", "value", "limit", "unit", ""], *rows])


def _draw(solved: SolvedGait, subject: Subject, plot: Path | None, animate: Path | None) -> None:
    from atalante_tools.gait.figures import draw_animation, draw_plot

    for draw, file, kind in ((draw_plot, plot, "plot"), (draw_animation, animate, "animation")):
        if file is not None:
            draw(solved.gait, subject.patient, file)
            print_message(f"{kind} in {file}")

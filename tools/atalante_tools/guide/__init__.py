"""Command `atalante guide`: search for pushes that move a joint out of its virtual guide.

A guide is a corridor of joint angles around the desired motion of hip and knee. The controller must keep both joints inside.
The promise of a guide is one torque at the hip and one torque at the knee. The certificate of the guide states that no
push up to these torques moves a joint out of the guide. The adversary searches for a push up to these torques that
nevertheless moves a joint out of the guide.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from atalante_tools.console.options import SEED, Between, OutputFile, json_option, options_as, subject_options
from atalante_tools.console.outcome import Failed, InvalidUsage
from atalante_tools.console.terminal import Progress, print_message, show_json, table
from atalante_tools.session.extra import require_matplotlib
from atalante_tools.session.law import Law, law_options
from atalante_tools.session.shapes import SHAPE_HELP, SHAPE_NAMES, guide_shapes

if TYPE_CHECKING:
    from atalante_control.gait.subject import Subject
    from atalante_tools.guide.promise_check import Checked, Effort, Verdict

#: Values of the option --condition. They are a copy of the keys of `promise_check.CONDITIONS`.
#: The help text uses this copy, because `promise_check` imports the controller, and this import is slow.
CONDITION_NAMES = ("model", "friction", "mass", "both", "noise", "loss", "delay")
#: Assistance factors Xi that are checked if the user gives no option --xi.
FACTORS = (0.0, 0.25, 0.5, 0.75, 0.9, 0.95, 0.99)


@click.group()
def command() -> None:
    """Search for pushes that move a joint out of a virtual guide, on an ideal plant and on the emulated robot.

    The promise of a guide is one torque at the hip and one torque at the knee. Pushes up to these torques must leave both joints
    inside the guide.

    \b
    Example: atalante guide check --shape constant --xi 0.5 --quick
             atalante guide random --count 300
    """


@dataclass(frozen=True)
class CheckOptions:
    """Options of `atalante guide check`."""

    shapes: tuple[str, ...]  # names or files of the guide shapes; empty means all shapes of the package
    factors: tuple[float, ...]  # assistance factors; empty means `FACTORS`
    patients: bool  # whether to also check the gaits that the gait network computes for several patients
    conditions: tuple[str, ...]  # names of deviations from the model, such as "friction"; empty means all deviations
    push: tuple[float, float] | None  # largest push at hip and knee [Nm]; None means the certified torques
    steps: int | None  # number of steps per guide on the ideal plant; None: 60 if `quick` is set, otherwise 1500
    robot_steps: int | None  # number of steps per guide on the emulated robot; None: 0 if `quick` is set, otherwise 60
    seed: int  # seed of the search and of the noise
    quick: bool  # True: short search with the settings `QUICK`; False: the settings `COMPLETE`
    plot: Path | None  # picture file; None means no picture
    table: Path | None  # Markdown file for the table; None means no file
    results: Path | None  # file of the results; an interrupted check is resumed from this file; None means no file
    law: Law  # control law of the assisted joints

    def effort(self) -> Effort:
        """Return the settings for the search in each guide.

        The settings are `QUICK` or `COMPLETE`. The options --steps and --robot-steps replace the numbers of steps.
        """
        from atalante_tools.guide.promise_check import COMPLETE, QUICK

        effort = QUICK if self.quick else COMPLETE
        steps = effort.steps if self.steps is None else self.steps
        return replace(
            effort, steps=steps, robot_steps=effort.robot_steps if self.robot_steps is None else self.robot_steps
        )

    def task(self) -> dict[str, Any]:
        """Return the options that affect all verdicts. The first line of the results file contains these options."""
        return {
            "conditions": self.conditions,
            "effort": asdict(self.effort()),
            "seed": self.seed,
            "push": self.push,
            "law": asdict(self.law),
        }


_CHECK_OPTIONS = [
    click.option("--shape", "shapes", metavar="NAME|FILE", multiple=True,
                 help=f"Shape of the guide: {SHAPE_HELP}. Repeat the option for several shapes.  [default: all]"),
    click.option("--xi", "factors", type=Between(0.0, 1.0), metavar="X", multiple=True,
                 help="Assistance factor Xi. Repeat the option for several factors.  "
                      f"[default: {', '.join(f'{xi:g}' for xi in FACTORS)}]"),
    click.option("--patients", is_flag=True,
                 help="Also check gaits that the neural gait network computes for twelve patients of 58 to 91 kg."),
    click.option("--condition", "conditions", type=click.Choice(CONDITION_NAMES), multiple=True,
                 help="Deviation of plant and robot from the model. model: no deviation; friction: +-20 %; mass: +-10 %; both: "
                      "friction and mass; noise: encoder noise; loss: 1 % of the frames is lost; delay: 1 ms more delay. Repeat "
                      "the option for several conditions.  [default: all]"),
    click.option("--push", type=(Between(0.0, 500.0), Between(0.0, 500.0)), default=None, metavar="HIP KNEE",
                 help="Largest push at hip and knee [Nm].  [default: the certified torques of the guide]"),
    click.option("--steps", type=click.IntRange(1), metavar="N",
                 help="Steps on the ideal plant per guide.  [default: 1500; with --quick: 60]"),
    click.option("--robot-steps", type=click.IntRange(0), metavar="N",
                 help="Steps on the emulated robot per guide.  [default: 60; with --quick: 0]"),
    click.option("--seed", type=SEED, default=0, show_default=True, metavar="N", help="Seed of the search and of the noise."),
    click.option("--quick", is_flag=True,
                 help="Run a short search: fewer steps, no search for pushes above the push limits, and no steps on the emulated "
                      "robot (unless --robot-steps is given)."),
    click.option("--plot", type=OutputFile(".png", ".svg", ".pdf"), metavar="FILE",
                 help="Draw the last guide: its bounds, its worst step, and its safe area (safe backward image). If a "
                      "tracking error is in the safe area, the controller can still keep the joints inside the guide."),
    click.option("--table", type=OutputFile(".md"), metavar="FILE", help="Write the results as a Markdown table."),
    click.option("--results", type=OutputFile(".jsonl"), metavar="FILE",
                 help="Append each result to this file. Guides that the file already contains are not checked again, so the same "
                      "command resumes an interrupted check."),
]  # fmt: skip


@command.command(short_help="Search for the worst push within the promise of a guide.")
@options_as("options", CheckOptions, [*_CHECK_OPTIONS, law_options(), json_option, subject_options])
def check(options: CheckOptions, as_json: bool, subject: Subject | None) -> None:
    """For each guide, search for the worst push within the certified torques, and print a table of the results.

    A push acts on hip and knee of the swing leg at the same time. The torque at each joint is at most the certified torque, and
    its direction may change at any time. The result of a push is the ratio |e| / q_bound: the tracking error, divided by the
    distance from the desired angle to the edge of the guide. The promise is kept if the ratio is at most 1. The column "left at"
    is the smallest multiple of the promise that moved a joint out of the guide. The exit code is 1 if a promise is broken. With
    --push, a broken promise does not change the exit code. --literal certifies no torque: a search needs --push.

    \b
    Example: atalante guide check --shape constant --xi 0.5 --quick
             atalante guide check --shape pinched --xi 0.5 --plot worst.png
             atalante guide check --patients --results all.jsonl --table all.md
    """
    if options.plot is not None and options.results is not None:
        raise InvalidUsage(
            "--plot must not be combined with --results: a guide whose result is read from the file is not simulated, "
            "so it cannot be drawn"
        )
    if options.plot is not None:
        require_matplotlib()
    verdicts, last = [], None
    for verdict, checked in _all_checks(options, subject):
        verdicts.append(verdict)
        last = checked
        if as_json:
            show_json(asdict(verdict))
    if not as_json:
        click.echo(verdicts_table(verdicts))
    if options.law.literal:
        print_message(verdicts[0].reason)
        if options.push is None:
            print_message("no push was searched, because there are no certified torques: add --push HIP KNEE")
    if options.table is not None:
        options.table.write_text(markdown_table(verdicts), encoding="utf-8")
        print_message(f"wrote {options.table}")
    if options.plot is not None:
        assert last is not None
        _draw(last, options.plot)
    broken = [v for v in verdicts if v.broken and v.certified]
    if broken and options.push is None:
        worst = max(broken, key=lambda verdict: verdict.worst_ratio or 0.0)
        raise Failed(
            f"all {len(verdicts)} certified guides must withstand the pushes, but {len(broken)} did not; worst: {worst.shape} at "
            f"Xi {worst.xi:g} with |e| / q_bound {worst.worst_ratio:.3f} (1: edge of the guide)"
            f"{f', {worst.stopped}' if worst.stopped else ''}"
        )


def _all_checks(options: CheckOptions, subject: Subject | None) -> Iterator[tuple[Verdict, Checked | None]]:
    """Check one guide after another, and show the current guide in the progress line.

    The options select gaits, shapes and assistance factors. Each combination is one guide.

    Yields:
        Verdict on a guide, and the check with its worst step. The check is None if the verdict is from an earlier run.

    Raises:
        Failed: If the file of the results belongs to other options, or contains an invalid line.
    """
    from atalante_hal.robot import load_robot
    from atalante_tools.guide.promise_check import Task, conditions_of, patients, setup_of
    from atalante_tools.guide.promise_check import check as check_guide
    from atalante_tools.guide.results import Results

    robot, shapes = load_robot(), guide_shapes(options.shapes or SHAPE_NAMES.split(", ")).values()
    task = Task(conditions_of(options.conditions), options.effort(), options.seed, options.push)
    try:
        results = Results(options.results, options.task())
    except ValueError as error:
        raise Failed(str(error)) from error
    subjects, factors = [subject, *(patients() if options.patients else [])], options.factors or FACTORS
    progress, done, total = Progress(), 0, len(subjects) * len(shapes) * len(factors)
    for patient in subjects:
        setup = setup_of(patient, robot, options.law.config())
        for shape in shapes:
            controller = setup.controller(shape)
            for xi in factors:
                done += 1
                verdict, checked = results.find((setup.gait.name, shape.name, xi)), None
                if verdict is None:
                    progress.show(f"guide {done} of {total}: {setup.gait.name}   {shape.name:<11} Xi {xi:g}")
                    checked = check_guide(setup, controller, xi, task)
                    verdict = checked.verdict
                    results.add(verdict)
                    progress.clear()
                yield verdict, checked


def _draw(checked: Checked, plot: Path) -> None:
    """Draw the figure of a check."""
    from atalante_tools.guide.figure import draw

    draw(checked, plot)
    print_message(f"wrote {plot}")


def markdown_table(verdicts: Sequence[Verdict]) -> str:
    """Return the results of several checks as a Markdown table.

    Args:
        verdicts: One result per guide.
    """
    lines = [
        "| gait | shape | Xi | promise: hip, knee [Nm] | worst ratio: plant | robot | left at, times the promise | steps |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for v in verdicts:
        promise = "none" if v.promise_hip_nm is None else f"{v.promise_hip_nm:.1f}, {v.promise_knee_nm:.1f}"
        plant, on_robot = ("-" if ratio is None else f"{ratio:.2f}" for ratio in (v.plant_ratio, v.robot_ratio))
        on_robot += " (HOLD)" if v.stopped else ""
        left_at = "-" if v.left_at is None else f"{v.left_at:.1f}"
        lines.append(f"| {v.gait} | {v.shape} | {v.xi:g} | {promise} | {plant} | {on_robot} | {left_at} | {v.steps} |")
    return "\n".join(lines) + "\n"


def verdicts_table(verdicts: Sequence[Verdict]) -> str:
    """Return the results of several checks as a table for the terminal.

    Args:
        verdicts: One result per guide.
    """
    head = [
        "gait",
        "shape",
        "Xi",
        "certified",
        "hip Nm",
        "knee Nm",
        "worst",
        "plant",
        "robot",
        "left at",
        "steps",
        "worst push",
    ]
    rows = [
        [
            v.gait,
            v.shape,
            f"{v.xi:g}",
            "yes" if v.certified else "NO",
            *("-" if x is None else f"{x:.2f}" for x in (v.promise_hip_nm, v.promise_knee_nm)),
            *("-" if x is None else f"{x:.3f}" for x in (v.worst_ratio, v.plant_ratio, v.robot_ratio)),
            "-" if v.left_at is None else f"{v.left_at:.2f}",
            str(v.steps),
            f"{v.worst_push}, {v.worst_condition}" if v.worst_push else "-",
        ]
        for v in verdicts
    ]
    return table([head, *rows])


@command.command(name="random", short_help="Search for pushes that move a joint out of a random guide.")
@click.option("--count", type=click.IntRange(1), default=300, show_default=True, metavar="N", help="Number of shapes.")
@click.option(
    "--first", type=click.IntRange(0), default=0, show_default=True, metavar="N", help="Index of the first shape."
)
@click.option(
    "--steps",
    type=click.IntRange(1),
    default=120,
    show_default=True,
    metavar="N",
    help="Number of simulated steps per shape, on the ideal plant.",
)
@click.option("--seed", type=SEED, default=0, show_default=True, metavar="N", help="Seed of shapes and search.")
@json_option
def random_command(count: int, first: int, steps: int, seed: int, as_json: bool) -> None:
    """Check random guides. Their shapes alternate: smooth, notched (notches of 2 to 40 ms), piecewise constant.

    Each guide has a random assistance factor up to 0.95. The adversary searches for the worst push up to the promise of the
    guide, on the ideal plant. The exit code is 1 if such a push moved a joint out of a certified guide.

    \b
    Example: atalante guide random --count 300
             atalante guide random --first 17 --count 1     (repeat the check of one shape)
    """
    from atalante_hal.robot import load_robot
    from atalante_tools.guide.promise_check import Effort, Task, conditions_of, setup_of
    from atalante_tools.guide.promise_check import check as check_guide
    from atalante_tools.guide.random_shapes import random_guide

    setup = setup_of(None, load_robot())
    progress, verdicts = Progress(), []
    for number in range(first, first + count):
        shape, xi = random_guide(seed, number)
        task = Task(conditions_of(()), Effort(steps, robot_steps=0, tightness=False), seed)
        verdicts.append(check_guide(setup, setup.controller(shape), xi, task).verdict)
        certified = [v for v in verdicts if v.certified]
        left = [v for v in certified if v.broken]
        progress.show(f"shape {number + 1 - first}/{count}   certified {len(certified)}   left {len(left)}")
        if as_json:
            show_json(asdict(verdicts[-1]))
    progress.clear()
    if not as_json:
        click.echo(verdicts_table(certified))
    print_message(f"{count} shapes, {len(certified)} certified; a joint left {len(left)} of the certified guides")
    if left:
        worst = max(left, key=lambda v: v.worst_ratio or 0.0)
        raise Failed(
            f"no joint may leave a certified guide, but in {len(left)} certified guides a joint moved out; worst: "
            f"{worst.shape} at Xi {worst.xi:.3f} with |e| / q_bound {worst.worst_ratio:.3f} (1: edge of the guide)"
        )

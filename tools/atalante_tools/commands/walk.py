"""Command `atalante walk`: walks on the ground with a patient in the exoskeleton, on any bus."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from atalante_tools.console.options import (
    SEED,
    Between,
    GaitFiles,
    Target,
    gait_options,
    json_option,
    length,
    options_as,
    patient_options,
    target_options,
    typed,
)
from atalante_tools.session.law import Law, law_options
from atalante_tools.session.recording import RECORDING_OPTIONS, RecordingOptions
from atalante_tools.session.shapes import SHAPE_HELP
from atalante_tools.session.walk import walk
from atalante_tools.session.walk_options import DEFAULT_PATIENT, DEFAULT_STEP, Push, SpeedChange, WalkOptions

if TYPE_CHECKING:
    from atalante_control.gait.subject import Subject
    from atalante_control.model import Patient


def _protocol(_ctx: click.Context, _param: click.Parameter, text: str | None) -> tuple[int, int, int] | None:
    """Convert the text of the option `--protocol`, such as 112,38,225, to three numbers of steps (option callback).

    Raises:
        click.BadParameter: If the text is not three positive numbers.
    """
    if text is None:
        return None
    parts = text.split(",")
    if len(parts) != 3 or not all(part.isdecimal() and int(part) for part in parts):
        raise click.BadParameter(f"must be three positive numbers of steps like 112,38,225, got {text!r}")
    full, transition, partial = map(int, parts)
    return full, transition, partial


@click.command()
@click.option(
    "--steps",
    type=click.IntRange(1),
    default=20,
    show_default=True,
    metavar="N",
    help="Number of periodic steps. These are the steps between the start step and the stop step. With --then, N counts only "
    "the periodic steps before the first change.",
)
@click.option(
    "--xi",
    type=Between(0.0, 1.0),
    default=1.0,
    show_default=True,
    metavar="X",
    help="Assistance factor Xi of the periodic steps: 1 is full assistance. Below 1, hip and knee of the swing leg (SH, SK) "
    "may move freely inside a virtual guide, a region around the desired trajectory.",
)
@click.option(
    "--shape", default="pinched", show_default=True, metavar="NAME|FILE", help=f"Shape of the guide: {SHAPE_HELP}."
)
@click.option(
    "--protocol",
    callback=_protocol,
    metavar="A,B,C",
    help="Numbers of steps. 112,38,225 means 112 steps with full assistance, then 38 steps in which Xi falls to --xi, then 225 "
    "steps with --xi. Replaces --steps.",
)
@click.option(
    "--wearer",
    type=click.Choice(["none", "passive"]),
    default="none",
    show_default=True,
    help="Limbs of the emulated patient: none (masses only) or passive (the impedance of relaxed legs).",
)
@law_options()
@patient_options
@click.option(
    "--step-length",
    type=length,
    default=str(DEFAULT_STEP[0]),
    show_default=True,
    metavar="M",
    help="Step length, in m (0.16) or cm (16).",
)
@click.option(
    "--step-duration", type=float, default=DEFAULT_STEP[1], show_default=True, metavar="S", help="Step duration [s]."
)
@click.option(
    "--then",
    type=(click.IntRange(1), length, float),
    multiple=True,
    metavar="STEPS LENGTH DURATION",
    help="After the previous steps, walk STEPS steps with the step length LENGTH [m] and the step duration DURATION [s]. "
    "Can be repeated.  [default: no change]",
)
@gait_options
@click.option(
    "--turn",
    type=Between(-3.0, 3.0),
    default=0.0,
    show_default=True,
    metavar="DEG",
    help="Angle by which the desired walking line turns before each periodic step [deg]. A positive angle turns the "
    "line to the left.",
)
@click.option(
    "--push",
    type=Between(0.0, 1000.0),
    metavar="N",
    help="Push the pelvis of the emulated robot once with this force [N], for 0.2 s in the middle of the walk.  "
    "[default: no push]",
)
@click.option(
    "--push-direction",
    type=Between(-360.0, 360.0),
    default=0.0,
    show_default=True,
    metavar="DEG",
    help="Direction of the push relative to the walking line [deg]: 0 is forwards, 90 to the left. Requires --push.",
)
@click.option(
    "--friction",
    type=Between(0.05, 2.0),
    default=0.6,
    show_default=True,
    metavar="MU",
    help="Coefficient of friction between soles and floor of the emulated robot.",
)
@click.option(
    "--heading-reference",
    is_flag=True,
    help="Use the heading of the pelvis IMU to estimate the drift of the gyro. The pelvis IMU must have a heading "
    "reference, such as a magnetometer. With this option, the headings of the emulated IMUs do not drift.  "
    "[default: the estimated heading is the integral of the gyro rate]",
)
@click.option("--seed", type=SEED, default=0, show_default=True, metavar="N", help="Seed of the emulated sensor noise.")
@click.option(
    "--out",
    type=click.Path(path_type=Path, file_okay=False),
    metavar="DIR",
    help="Folder for recording.mcap, summary.json, trace.npz (telemetry of the controller at 100 Hz) and walk.png. Existing "
    "files are replaced.  [default: no files]",
)
@click.option(
    "--robot-process/--no-robot-process",
    default=None,
    help="Run the emulated robot in a separate process, in parallel with the HAL. On idle processor cores, a separate process "
    "makes the walk faster. The result is the same.  [default: separate process if one processor core is idle; with a CAN log "
    "or a recording rate above 100 Hz, if two cores are idle]",
)
@options_as("recording", RecordingOptions, RECORDING_OPTIONS)
@target_options(embedded=True)
@json_option
def command(
    steps: int,
    xi: float,
    shape: str,
    protocol: tuple[int, int, int] | None,
    wearer: str,
    law: Law,
    patient: Patient | None,
    step_length: float,
    step_duration: float,
    then: tuple[tuple[int, float, float], ...],
    files: GaitFiles,
    push: float | None,
    push_direction: float,
    friction: float,
    heading_reference: bool,
    turn: float,
    seed: int,
    out: Path | None,
    robot_process: bool | None,
    recording: RecordingOptions,
    target: Target,
    as_json: bool,
) -> None:
    """Walk on the ground with a patient, in a real or an emulated robot.

    The robot stands at the start and at the end of the walk. After the operator has pressed START, a crane lowers the emulated
    robot onto its feet. The robot shifts its weight, walks, and stops on both feet. Ctrl-C ends the walk with a stop step. A
    second Ctrl-C ends the command at once. The exit code is 1 if the robot falls.

    Before the walk, Pinocchio verifies the gait: joint limits, torques, ground forces, centre of pressure, friction, clearance of
    the swing foot, and the landing.

    \b
    Example: atalante walk --steps 40 --mass 75 --height 1.75
             atalante walk --gait walk.json
             atalante walk --steps 10 --then 10 0.18 0.8
    """
    emulated = {
        "--push": push is not None,
        "--wearer passive": wearer == "passive",
        "--protocol": protocol is not None,
        "--robot-process": bool(robot_process),
        "--friction": typed("friction"),
    }
    for option, given in emulated.items():
        if given and not target.embedded:
            raise click.UsageError(f"{option} requires the emulated robot of -i embedded")
    if push is None and typed("push_direction"):
        raise click.UsageError("--push-direction requires a push: add --push")
    if target.embedded and xi == 1.0 and typed("shape"):
        raise click.UsageError("--shape requires a guide, but there is none at the assistance factor 1: add --xi")
    if out is None and typed("record_rate"):
        raise click.UsageError("--record-rate requires a recording: add --out")
    if turn and law.literal:
        raise click.UsageError(
            "--turn has no effect with --literal, because --literal switches steering off: remove one of them"
        )
    if then:
        _require_speed_changes(law, files)
    if protocol is not None:
        if xi == 1.0:
            raise click.UsageError("the assistance factor at the end of --protocol must be below 1, got 1: add --xi")
        steps = sum(protocol)
    subject = _subject(patient, step_length, step_duration)
    options = WalkOptions(
        steps=steps,
        xi=xi,
        shape=shape,
        passive=wearer == "passive",
        subject=subject,
        files=files,
        seed=seed,
        friction=friction,
        push=None if push is None else Push(push, push_direction),
        law=law,
        protocol=protocol,
        recording=recording,
        robot_process=robot_process,
        heading_reference=heading_reference,
        then=tuple(SpeedChange(count, _walking_with(patient, *step)) for count, *step in then),
        turn=turn,
        out=out,
    )
    walk(target, options, as_json=as_json)


def _require_speed_changes(law: Law, files: GaitFiles) -> None:
    """Raise an error if other options do not permit `--then`.

    Raises:
        click.UsageError: If `--literal` or `--gait` was given.
    """
    if law.literal:
        raise click.UsageError(
            "--then requires the ankle stabiliser, but --literal switches it off: remove one of them"
        )
    if files.gait is not None:
        raise click.UsageError("--then requires the gaits of a network, and --gait gives one gait: remove one of them")


def _subject(patient: Patient | None, step_length: float, step_duration: float) -> Subject | None:
    """Return the patient and the step in one `Subject`, or None if there is no patient and the step is `DEFAULT_STEP`."""
    if patient is None and (step_length, step_duration) == DEFAULT_STEP:
        return None
    return _walking_with(patient, step_length, step_duration)


def _walking_with(patient: Patient | None, step_length: float, step_duration: float) -> Subject:
    """Return the patient and the step in one `Subject`. If `patient` is None, use the default patient."""
    from atalante_control.gait.subject import Subject
    from atalante_control.model import Patient

    try:
        return Subject(patient or Patient(*DEFAULT_PATIENT), step_length, step_duration)
    except ValueError as error:
        raise click.UsageError(str(error)) from error

"""Result of a walk on the ground: `HAL, controller, observation -> WalkResult -> terminal, summary.json`."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from importlib.metadata import version
from typing import TYPE_CHECKING, Any

import click

from atalante_tools.console.terminal import print_message
from atalante_tools.session.certificates import promise_fields, weakest

if TYPE_CHECKING:
    from pathlib import Path

    from atalante_control.guide.certificate import Certificate
    from atalante_control.guide.statistics import GuideStatistics
    from atalante_control.walking.controller import WalkController
    from atalante_hal.hal import Hal
    from atalante_hal.telemetry.process import Recording
    from atalante_tools.session.walk_options import WalkOptions
    from atalante_tools.session.walk_trace import WalkTrace


@dataclass
class WalkResult:
    """Result of a walk. The field names are the keys of the `--json` object, and of the object `result` in summary.json."""

    steps: int  # number of completed periodic steps
    #: step length of each gait, in walking order [m]; None if the gait file does not state it
    step_lengths_m: list[float | None]
    step_durations_s: list[float]  # step duration of each gait, in walking order [s]
    fell: bool
    outcome: str  # how the walk ended: stood, fell, stopped, hold or fault
    engine: str | None  # physics engine of the emulated robot; None means the real robot
    xi: float
    shape: str | None  # guide shape; None if `xi` is 1 and no step had a guide
    #: Assistance factor of the guide with the smallest certified hip torque. The next three fields describe this guide.
    #: None if `shape` is None.
    promise_xi: float | None
    certified: bool | None  # whether the guide is certified; None if `shape` is None
    #: Certified disturbance torque at the sagittal hip [Nm]; None if no torques are certified.
    #: Hip and knee stay in the guide under disturbances up to `promise_hip_nm` at the hip and `promise_knee_nm` at the knee.
    promise_hip_nm: float | None
    #: Certified disturbance torque at the sagittal knee [Nm], see `promise_hip_nm`; None if no torques are certified.
    promise_knee_nm: float | None
    #: largest |e| / q_bound: angle error, divided by the distance from the desired angle to the guide edge;
    #: None if no step was guided
    max_ratio: float | None
    inside: float | None  # fraction of the guided time with both joints inside the guide; None if no step was guided
    outside_cycles: int  # number of guided cycles with a joint outside the guide
    #: fraction of the guided time in which the backup torque of the guide (spring and damper) acts; None if no step was guided
    filter_active: float | None
    #: Number of steps whose start deviation was compared with its certified range (hand-over box).
    #: The start deviation is compared only in steps with a certified guide.
    hand_overs: int
    #: Number of steps whose start deviation was outside the hand-over box. The certificate does not apply to these steps.
    hand_overs_exceeded: int
    full_assist: bool  # whether a diagnostic made the HAL ramp the assistance factor to 1 (state FULL_ASSIST)
    lateral_m: float  # sideways deviation from the walking line at the last landing [m], positive to the left
    yaw_deg: float  # heading of the soles relative to the walking line at the last landing [deg], positive to the left
    #: true sideways deviation from the initial walking line at the end of the walk [m]; None if unknown, as after a fall
    true_lateral_m: float | None
    #: true heading relative to the initial walking line at the end of the walk [deg]; None if unknown, as after a fall
    true_yaw_deg: float | None
    #: root mean square of the angle between true and estimated vertical during the walk [deg]; None if unknown
    attitude_rms_deg: float | None
    distance_m: float  # distance that the robot walked along the walking line [m]
    unnoticed: int  # number of steps in which no landing of the foot was detected
    #: largest distance between the measured and the nominal divergent component of motion (DCM) [m]
    max_dcm_error_m: float
    diagnostics: dict[str, int]  # number of occurrences of each diagnostic of the HAL
    real_time_factor: float
    robot_process: bool  # whether the emulated robot ran in a process of its own, in parallel with the HAL
    #: Processor time of this process per second of the run. Waiting for a robot in another process uses processor time, too.
    cpu_per_second: float


def weakest_guide(controller: WalkController, xi: float) -> Certificate | None:
    """Return the certificate with the smallest certified hip torque of all guided steps; None if there is no guide.

    Args:
        controller: Controller after the walk.
        xi: Assistance factor of the options. It applies if no step was guided. The pendant may have set other factors.
    """
    factors = sorted(controller.statistics.guide.factors) or ([xi] if xi < 1.0 else [])
    certificates = [certificate for factor in factors for certificate in controller.certificates(factor)]
    return weakest(certificates) if certificates else None


def guide_fields(certificate: Certificate | None, statistics: GuideStatistics) -> dict[str, Any]:
    """Return the fields of `WalkResult` about the guide."""
    counted = statistics.cycles > 0
    return {
        "shape": None if certificate is None else certificate.shape,
        "promise_xi": None if certificate is None else certificate.xi,
        **promise_fields(certificate),
        "max_ratio": round(statistics.max_ratio, 3) if counted else None,
        "inside": round(statistics.inside_fraction, 6) if counted else None,
        "outside_cycles": statistics.cycles - statistics.inside,
        "filter_active": round(statistics.active_fraction, 3) if counted else None,
        "hand_overs": statistics.hand_overs,
        "hand_overs_exceeded": statistics.hand_overs_exceeded,
    }


def diagnostics(hal: Hal) -> dict[str, int]:
    """Return the number of occurrences of each diagnostic in the events of the HAL."""
    from atalante_hal.safety.diagnostics import Dtc

    codes, counts = {dtc.value for dtc in Dtc}, dict[str, int]()
    for event in hal.events:
        if event.code in codes:
            counts[event.code] = counts.get(event.code, 0) + event.count
    return counts


def show_result(result: WalkResult) -> None:
    """Print the result of a walk as one line."""
    guided = ""
    if result.max_ratio is not None:
        certified = "certified" if result.certified else "NOT CERTIFIED"
        guided = (
            f"; {result.shape} ({certified} at Xi {result.promise_xi:g}): largest |e|/q_bound {result.max_ratio:.3f}, "
            f"{result.outside_cycles} ms outside the guide"
        )
    click.echo(
        f"{result.outcome} after {result.steps} steps and {result.distance_m:.2f} m: sideways {result.lateral_m:+.3f} m, "
        f"heading {result.yaw_deg:+.2f} deg, largest DCM error {1000.0 * result.max_dcm_error_m:.0f} mm, "
        f"{result.real_time_factor:.2f} times real time{guided}"
    )


def write_result(
    out: Path, options: WalkOptions, result: WalkResult, trace: WalkTrace, recording: Recording | None
) -> None:
    """Write summary.json, the trace and the figure of a walk, and print the names of the files."""
    subject, law = None if options.subject is None else str(options.subject), asdict(options.law)
    then = [{"steps": change.steps, "subject": str(change.subject)} for change in options.then]
    given = {key: value for key, value in asdict(options).items() if key not in ("out", "recording", "law", "files")}
    given = {**given, **law, "subject": subject, "then": then, "record_rate": options.recording.record_rate}
    files = {"gait": options.files.gait, "network": options.files.network, "telemetry": options.recording.telemetry}
    for name, path in files.items():
        given[name] = None if path is None else str(path)
    recorded = None if recording is None else asdict(recording)
    content = {"options": given, "result": asdict(result), "recording": recorded, "version": version("atalante-hal")}
    (out / "summary.json").write_text(json.dumps(content, indent=2) + "\n")
    written = [] if recording is None else recording.files
    print_message(f"in {out}: {', '.join([*written, 'summary.json', *trace.write(out)])}")

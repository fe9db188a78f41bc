"""Walk of `atalante walk` on the ground, with a patient in the exoskeleton. The robot stands at the start and at the end.

gaits of the subject -> walking controller -> rig on the ground -> progress, outcome
"""

from __future__ import annotations

import math
import time
from contextlib import ExitStack
from dataclasses import asdict, replace
from typing import TYPE_CHECKING

from atalante_tools.console.options import Target
from atalante_tools.console.stop_request import stop_requested
from atalante_tools.console.terminal import print_message, show_json
from atalante_tools.session.certificates import announce, report_hand_overs
from atalante_tools.session.dial import Dial
from atalante_tools.session.recording import (
    EndpointReport,
    Outputs,
    Recorder,
    close_telemetry,
    outlet_of,
    require_complete,
    require_complete_log,
    require_format,
    start_telemetry,
    telemetry_cores,
)
from atalante_tools.session.run_folder import run_folder
from atalante_tools.session.walk_observation import Observation
from atalante_tools.session.walk_options import WalkOptions, gaits_of, sections_of
from atalante_tools.session.walk_result import (
    WalkResult,
    diagnostics,
    guide_fields,
    show_result,
    weakest_guide,
    write_result,
)
from atalante_tools.session.walk_watch import WalkWatch

if TYPE_CHECKING:
    from atalante_control.walking.controller import WalkController
    from atalante_hal.telemetry.child import TelemetryChild
    from atalante_tools.session.embedded import EmbeddedRobot


def walk(target: Target, options: WalkOptions, *, as_json: bool) -> None:
    """Walk, and print the result.

    Args:
        target: Bus and clock.
        options: Options of the user.
        as_json: Whether to print a JSON object instead of text.

    Raises:
        Failed: If the robot fell or did not walk to the end, or the recording or the CAN log is incomplete.
    """
    from atalante_hal.telemetry.child import TelemetryChild
    from atalante_tools.session.embedded import EmbeddedRobot, robot_process_wanted

    outputs = _outputs(options)
    with ExitStack() as stack:
        if options.out is not None:
            stack.enter_context(run_folder(options.out))
        two_processes = robot_process_wanted(target, telemetry_cores(outputs), options.robot_process)
        # start the subprocesses early: they import their modules while this process creates the controller
        child = None if outputs is None else stack.enter_context(TelemetryChild())
        robot = stack.enter_context(EmbeddedRobot(target.engine)) if two_processes else None
        _walk(target, options, robot, outputs, child, as_json=as_json)


def _outputs(options: WalkOptions) -> Outputs | None:
    """Return the outputs of the telemetry process; None if the user requested no output."""
    recording = options.recording
    if recording.can_log is not None:
        require_format(recording.can_log)
    if not (options.out or recording.can_log or recording.telemetry):
        return None
    file = None if options.out is None else options.out / "recording.mcap"
    return Outputs(file, recording.record_rate, recording.can_log, outlet_of(recording.telemetry))


def _walk(
    target: Target,
    options: WalkOptions,
    robot_process: EmbeddedRobot | None,
    outputs: Outputs | None,
    child: TelemetryChild | None,
    *,
    as_json: bool,
) -> None:
    """Walk, and print the result.

    Args:
        target: Bus and clock.
        options: Options of the user.
        robot_process: Subprocess of the emulated robot. None means that an emulated robot runs in this process.
        outputs: Outputs of the telemetry process; None means no outputs.
        child: Subprocess that writes the outputs.
        as_json: Whether to print a JSON object instead of text.
    """
    from atalante_control.walking.config import WALK_GUIDE, WalkConfig
    from atalante_control.walking.controller import WalkController
    from atalante_hal.robot import load_robot
    from atalante_hal.types import PERIOD
    from atalante_tools.session.body import describe
    from atalante_tools.session.rig import open_hal
    from atalante_tools.session.shapes import guide_shape
    from atalante_tools.session.walk_trace import WalkTrace

    robot = load_robot()
    patient, gaits = gaits_of(options, robot)
    then = sections_of(options, robot)
    law = options.law
    config = replace(
        WalkConfig.literal() if law.literal else WalkConfig(),
        guide=replace(WALK_GUIDE, idealization=law.idealization, feedforward=law.feedforward),
        heading_reference=options.heading_reference,
        turn=math.radians(options.turn),
    )
    controller = WalkController(robot, patient, gaits, options.steps, config, guide_shape(options.shape), then)
    walked = [gaits.step, *(section.gaits.step for section in then)]
    names = ", then ".join(gait.name for gait in walked)
    if options.xi < 1.0:  # at Xi = 1 there is no guide
        _announce(controller, options.xi, names if then else None)
    if not target.lockstep:
        controller.prepare()
    mechanics = None
    if target.embedded:
        from atalante_emulator.mechanics import HEADING_REFERENCE_PARAMETERS, Ground, Mechanics
        from atalante_emulator.wearer import LimbParameters

        ground, limbs = Ground(friction=options.friction), LimbParameters() if options.passive else None
        parameters = HEADING_REFERENCE_PARAMETERS if options.heading_reference else None
        mechanics = Mechanics(describe(robot, None, patient), target.engine, ground, limbs, parameters=parameters)
    with ExitStack() as stack:
        rig = stack.enter_context(
            open_hal(
                target,
                robot=robot,
                seed=options.seed,
                pose=controller.standing_pose.tolist(),
                assistance_factor=options.xi if options.protocol is None else 1.0,
                controller_fields=controller.telemetry_fields,
                gait_hash=gaits.step.hash32,
                robot_process=robot_process,
                mechanics=mechanics,
            )
        )
        telemetry = recorder = summary = None
        if outputs is not None:
            about = {"seed": options.seed, "steps": controller.steps_wanted, "xi": options.xi, "gaits": names}
            about.update(asdict(law))
            telemetry = start_telemetry(target, outputs, rig.hal, rig.hal.network, gaits.step.hash32, about, child)
            stack.callback(telemetry.close)
            telemetry.begin_run("walk", {"shape": options.shape, "xi": options.xi})
            recorder = Recorder(rig, telemetry, EndpointReport(telemetry))
        observation, trace = Observation(rig, controller, options.push), WalkTrace(controller)
        dial = None
        if options.protocol is not None and rig.access is not None:
            dial = Dial(rig.access, options.protocol, options.xi)

        def record() -> None:
            trace.sample(rig.hal.state.cycle)
            if recorder is not None:
                recorder.write()
            if dial is not None:
                dial.turn(controller.steps_begun)

        with stop_requested() as stop:
            watch = WalkWatch(rig, controller, observation, stop, controller.steps_wanted)
            processor = time.process_time()
            statistics = rig.run(controller, until=watch, record=record, on_stop=controller.stop)
            processor = time.process_time() - processor
        if recorder is not None and telemetry is not None:
            recorder.report_events()
            summary = close_telemetry(telemetry)
        weakest = weakest_guide(controller, options.xi)
        result = WalkResult(
            steps=controller.statistics.steps,
            step_lengths_m=[gait.parameters.get("step_length") for gait in walked],
            step_durations_s=[gait.duration for gait in walked],
            fell=observation.fell,
            outcome=watch.outcome,
            engine=target.engine if target.embedded else None,
            xi=options.xi,
            **guide_fields(weakest, controller.statistics.guide),
            full_assist=watch.full_assist,
            lateral_m=round(controller.steering.lateral, 3),
            yaw_deg=round(math.degrees(controller.steering.yaw), 2),
            **observation.true_deviation(),
            attitude_rms_deg=observation.attitude_rms_deg,
            distance_m=round(controller.steering.distance, 2),
            unnoticed=controller.statistics.unnoticed,
            max_dcm_error_m=round(controller.max_dcm_error, 4),
            diagnostics=diagnostics(rig.hal),
            real_time_factor=round(statistics.real_time_factor, 2),
            robot_process=robot_process is not None,
            cpu_per_second=round(processor / (statistics.cycles * PERIOD), 4),
        )
        if weakest is not None:
            report_hand_overs(weakest.shape, controller.statistics.guide)
        if as_json:
            show_json(asdict(result))
        else:
            show_result(result)
        if options.out is not None:
            write_result(options.out, options, result, trace, None if summary is None else summary.recording)
        watch.conclude()
        if summary is not None:
            require_complete(summary.recording)
            require_complete_log(options.recording.can_log, summary.can_log_complete)


def _announce(controller: WalkController, xi: float, gaits: str | None) -> None:
    """Print the certificate of the guide of each gait at the assistance factor `xi`.

    Args:
        controller: Controller of the walk.
        xi: Assistance factor.
        gaits: Names of the gaits. None for a walk with one gait, whose name is not printed.
    """
    if gaits is not None:
        print_message(f"one certificate for each gait: {gaits}")
    leg = "leg of exoskeleton and patient, while the pelvis moves as in the gait, until the foot touches the ground"
    announce(controller.certificates(xi), controller.config.guide.mismatch, leg)

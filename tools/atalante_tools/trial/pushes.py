"""Find the largest push that the walking robot withstands: `trial -> walks with rising force, in lock-step -> result`."""

from __future__ import annotations

from typing import Any, Final

from atalante_control.gait.subject import Subject
from atalante_control.model import Patient
from atalante_control.walking.controller import WalkController
from atalante_emulator.mechanics import Ground, Mechanics
from atalante_emulator.pendant import Operator
from atalante_emulator.wearer import LimbParameters
from atalante_hal.loop import LockStep, run
from atalante_hal.robot import load_robot
from atalante_tools.console.stop_request import check_stop, deferred
from atalante_tools.session.body import describe
from atalante_tools.session.rig import open_hal
from atalante_tools.session.walk_observation import Observation
from atalante_tools.session.walk_options import Push, solved_gaits
from atalante_tools.session.walk_result import diagnostics
from atalante_tools.trial.lockstep import Ending, target
from atalante_tools.trial.plan import STEP, PushTrial

#: Index of the pushed step. In a step with an odd index, the right leg is the stance leg.
_PUSHED: Final = 3
#: Number of periodic steps after the pushed step.
_AFTER: Final = 4


def largest_push(trial: PushTrial) -> dict[str, Any]:
    """Push the robot with each force of a trial until the robot falls or stops, and return the result.

    Each force has a walk of its own. A force counts only if the robot withstands all smaller forces, too.

    Args:
        trial: trial to run.
    """
    largest, end, found = 0.0, "stood", dict[str, int]()
    for force in trial.forces:
        check_stop()
        end, found = _pushed_walk(trial, Push(force, trial.direction, step=_PUSHED, phase=trial.phase))
        if end != "stood":
            break
        largest = force
    return {"outcome": "computed", "largest_push_n": largest, "end": end, "diagnostics": found}


def _pushed_walk(trial: PushTrial, push: Push) -> tuple[str, dict[str, int]]:
    """Walk from standing to standing with one push, and return the outcome and the number of reports of each diagnostic.

    Args:
        trial: trial with patient, seed and engine.
        push: push during the walk.
    """
    robot, patient = load_robot(), Patient(trial.mass, trial.height)
    gaits = solved_gaits(Subject(patient, *STEP))
    controller = WalkController(robot, patient, gaits, _PUSHED + 1 + _AFTER)
    with open_hal(
        target(trial.engine),
        robot=robot,
        seed=trial.seed,
        pose=controller.standing_pose.tolist(),
        operator=Operator(),
        assistance_factor=1.0,
        controller_fields=controller.telemetry_fields,
        gait_hash=gaits.step.hash32,
        mechanics=Mechanics(describe(robot, None, patient), trial.engine, Ground(), LimbParameters()),
    ) as rig:
        ending = Ending(rig, lambda: controller.done, Observation(rig, controller, push))
        with deferred():
            run(rig.hal, controller, LockStep(), until=ending)
        return ending.outcome, diagnostics(rig.hal)

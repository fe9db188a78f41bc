"""Find the largest push that the walking robot withstands: `trial -> walks with rising force, in lock-step -> result`.

All walks with the same patient, seed and engine are equal until the push. So one walk forks a waiting copy of its process (a
branch) shortly before the pushed step. The walk with each push continues from this branch.
"""

from __future__ import annotations

from functools import cache
from typing import Any, Final

from atalante_control.model import Patient
from atalante_control.walking.controller import WalkController
from atalante_emulator.mechanics import Ground, Mechanics
from atalante_emulator.pendant import Operator
from atalante_emulator.wearer import LimbParameters
from atalante_hal.loop import LockStep, run
from atalante_hal.robot import load_robot
from atalante_hal.types import State
from atalante_tools.console.stop_request import check_stop, deferred
from atalante_tools.session.body import describe
from atalante_tools.session.rig import Rig, open_hal
from atalante_tools.session.walk_observation import Observation
from atalante_tools.session.walk_options import Push
from atalante_tools.session.walk_result import diagnostics
from atalante_tools.trial.branch import Branch, Continuation, branch
from atalante_tools.trial.lockstep import Ending, gaits_of_trial, target
from atalante_tools.trial.plan import PushTrial

#: Index of the pushed step. In a step with an odd index, the right leg is the stance leg.
_PUSHED: Final = 3
#: Number of periodic steps after the pushed step.
_AFTER: Final = 4
#: Phase at which the process of the walk is copied, in the step before the pushed step.
#: Each walk with a push continues in a copy of this process.
_LEAD: Final = 0.875


def largest_push(trial: PushTrial) -> dict[str, Any]:
    """Push the robot with each force of a trial until the robot falls or stops, and return the result.

    Each force has a walk of its own. A force counts only if the robot withstands all smaller forces, too.

    Args:
        trial: trial to run.
    """
    walk = _branch(trial.mass, trial.height, trial.seed, trial.engine, trial.network)
    largest, end, found = 0.0, "stood", dict[str, int]()
    for force in trial.forces:
        check_stop()
        end, found = walk.ask(Push(force, trial.direction, step=_PUSHED, phase=trial.phase))
        if end != "stood":
            break
        largest = force
    return {"outcome": "computed", "largest_push_n": largest, "end": end, "diagnostics": found}


@cache
def _branch(mass: float, height: float, seed: int, engine: str, network: tuple[str, ...]) -> Branch:
    """Walk until shortly before the pushed step, and return a branch: a forked copy of the walk that waits at this moment.

    Args:
        mass: mass of the wearer [kg].
        height: height of the wearer [m].
        seed: seed of the sensor noise.
        engine: physics engine of the emulated robot.
        network: network of the gaits, as in `PushTrial.network`.

    Raises:
        RuntimeError: If the robot does not reach this moment.
    """
    robot, patient = load_robot(), Patient(mass, height)
    gaits = gaits_of_trial(mass, height, network)
    controller = WalkController(robot, patient, gaits, _PUSHED + 1 + _AFTER)
    with open_hal(
        target(engine),
        robot=robot,
        seed=seed,
        pose=controller.standing_pose.tolist(),
        operator=Operator(),
        assistance_factor=1.0,
        controller_fields=controller.telemetry_fields,
        gait_hash=gaits.step.hash32,
        mechanics=Mechanics(describe(robot, None, patient), engine, Ground(), LimbParameters()),
    ) as rig:
        walk = _Walk(rig, controller)
        try:
            with deferred():
                run(rig.hal, controller, LockStep(), until=walk.over)
        finally:
            if walk.continuation is not None:
                walk.finish(walk.continuation)
    if walk.branch is None:
        raise RuntimeError(f"the walk must reach the step to be pushed, got the outcome {walk.ending.outcome}")
    return walk.branch


class _Walk:
    """Walk that is forked shortly before the pushed step, so that the steps before the push are computed only once.

    The loop of the HAL calls `over` in each cycle. `over` forks the process and decides when the walk ends.

    Attributes:
        ending: end condition of the walk: all steps walked, fall or stop. A copy of the walk with a push has its own condition.
        branch: forked copy of the walk that waits before the pushed step; None before the fork.
        continuation: copy of the walk that continues with a push; None in the process of the walk without a push.
    """

    def __init__(self, rig: Rig, controller: WalkController) -> None:
        self._rig, self._controller = rig, controller
        self.branch: Branch | None = None
        self.continuation: Continuation | None = None
        self.ending = self._ending(None)

    def _ending(self, push: Push | None) -> Ending:
        return Ending(self._rig, lambda: self._controller.done, Observation(self._rig, self._controller, push))

    def over(self, state: State) -> bool:
        """Return whether the walk is over.

        The walk without a push ends at the fork. A walk that continues from the fork has a push. This walk ends when `ending`
        returns True.

        Args:
            state: state of the HAL after the cycle.
        """
        if self.continuation is None and self._controller.reached(_PUSHED - 1, _LEAD):
            one = branch()
            if isinstance(one, Branch):
                self.branch = one
                return True
            self.continuation, self.ending = one, self._ending(one.request)
        return self.ending(state)

    def finish(self, continuation: Continuation) -> None:
        """Send the outcome of the walk and the number of reports of each diagnostic, and end the process."""
        try:
            continuation.finish((self.ending.outcome, diagnostics(self._rig.hal)))
        finally:
            continuation.abandon()

"""Parts that all trials share: the connection to an emulated robot in lock-step, and the end condition of a trial."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

from atalante_hal.types import State, SupervisorState
from atalante_tools.console.options import EMBEDDED, Target
from atalante_tools.console.stop_request import check_stop
from atalante_tools.session.rig import Rig
from atalante_tools.session.walk_observation import AFTERMATH, Observation

#: If the robot is not ACTIVE after this time, the trial ends with the outcome "no start" [cycles].
_START: Final = 30_000


def target(engine: str) -> Target:
    """Return the connection settings of a trial: an emulated robot in this process, in lock-step with the HAL.

    Args:
        engine: name of the physics engine.
    """
    return Target(EMBEDDED, "", lockstep=True, engine=engine)


class Ending:
    """End condition of a trial, called once per cycle.

    Attributes:
        outcome: "stood" (on the ground) or "done" (suspended) after the last step; otherwise "fell", "hold", "fault" or
            "no start".
    """

    def __init__(self, rig: Rig, done: Callable[[], bool], observation: Observation | None = None) -> None:
        """Create the end condition.

        Args:
            rig: rig of the trial.
            done: function that returns whether the controller has ended the walk.
            observation: observer that detects a fall of a robot on the ground; None for a suspended robot.
        """
        self._rig, self._done, self._observation = rig, done, observation
        self._started, self._halted = False, 0
        self.outcome = "hold"

    def __call__(self, state: State) -> bool:
        """Return whether the trial is over.

        Args:
            state: state of the HAL after the cycle.

        Raises:
            Stopped: If a signal arrived.
        """
        check_stop()
        if self._observation is not None and self._observation.check():
            self.outcome = "fell"
            return True
        if self._rig.hal.moving:
            self._started = True
            if self._done():
                self.outcome = "stood" if self._observation is not None else "done"
                return True
            return False
        self._halted += self._started
        if not self._started and state.cycle >= _START:
            self.outcome = "no start"
            return True
        if state.supervisor is SupervisorState.FAULT:
            self.outcome = "fault"
        return self._halted > AFTERMATH or (not self._started and self.outcome == "fault")

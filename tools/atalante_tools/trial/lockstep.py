"""Parts that all trials share: connection to an emulated robot in lock-step, gaits of a subject, end condition of a trial."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Final

from atalante_control.gait.subject import Subject
from atalante_control.gait.walk import WalkGaits
from atalante_control.model import Patient
from atalante_hal.types import State, SupervisorState
from atalante_tools.console.options import EMBEDDED, Target
from atalante_tools.console.outcome import Failed
from atalante_tools.console.stop_request import check_stop
from atalante_tools.session.rig import Rig
from atalante_tools.session.walk_observation import AFTERMATH, Observation
from atalante_tools.session.walk_options import solved_gaits
from atalante_tools.trial.plan import STEP, network_of

#: Longest time until the robot is ACTIVE [cycles]. After a longer time, the trial ends with the outcome "no start".
_START: Final = 30_000


def target(engine: str) -> Target:
    """Return the connection settings of a trial: an emulated robot in this process, in lock-step with the HAL.

    Args:
        engine: name of the physics engine.
    """
    return Target(EMBEDDED, "", lockstep=True, engine=engine)


def gaits_of_trial(mass: float, height: float, network: tuple[str, ...]) -> WalkGaits:
    """Return the gaits of the subject of a trial.

    Args:
        mass: mass of the subject [kg].
        height: height of the subject [m].
        network: path and SHA-256 of the network file; empty for the network of the package.

    Raises:
        Failed: If the network file was changed after the trials were planned.
    """
    file = Path(network[0]) if network else None
    if file is not None and network_of(file) != tuple(network):
        raise Failed(f"{file} must be unchanged until the end of the trials: start the command again")
    return solved_gaits(Subject(Patient(mass, height), *STEP), file)


class Ending:
    """End condition of a trial, called once per cycle.

    Attributes:
        outcome: "stood" (on the ground) or "done" (suspended) after the last step; otherwise "fell", "hold", "fault" or
            "no start".
    """

    def __init__(self, rig: Rig, done: Callable[[], bool], observation: Observation | None = None) -> None:
        """Create the end condition of a trial.

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

"""End condition of a walk on the ground: decides after each cycle whether the walk is over, and with which outcome."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

from atalante_hal.safety.diagnostics import Dtc
from atalante_hal.safety.start import PROGRAM_ENDS, WALK_ENDS, stop_text
from atalante_hal.types import SupervisorState
from atalante_tools.console.outcome import Failed
from atalante_tools.console.terminal import print_message
from atalante_tools.session.walk_observation import AFTERMATH

if TYPE_CHECKING:
    from atalante_control.walking.controller import WalkController
    from atalante_hal.types import State
    from atalante_tools.session.rig import Rig
    from atalante_tools.session.walk_observation import Observation

_FULL_ASSIST, _FINISH_STEP, _FAULT = SupervisorState.FULL_ASSIST, SupervisorState.FINISH_STEP, SupervisorState.FAULT


class WalkWatch:
    """End condition of a walk, called once per cycle. It also prints the progress line.

    Attributes:
        outcome: How the walk ended: stood, fell, stopped, hold or fault.
        full_assist: Whether the HAL changed to full assistance.
    """

    def __init__(self, rig: Rig, controller: WalkController, observation: Observation, stop: Any, steps: int) -> None:
        """Create the end condition of one walk.

        Args:
            rig: Rig of the walk.
            controller: Controller of the walk.
            observation: Observer that detects a fall.
            stop: Stop request of the process.
            steps: Number of steps that the user requested.
        """
        from atalante_tools.console.terminal import Progress

        self._rig, self._controller, self._observation, self._stop = rig, controller, observation, stop
        self._steps, self._progress, self._started = steps, Progress(), False
        self.outcome, self._reason, self._halted = "hold", "", 0
        self._signals = 0  # number of stop signals that arrived before the motion ended
        self.full_assist = False

    def __call__(self, state: State) -> bool:
        """Return whether the walk is over. Print the progress line if it is due.

        Args:
            state: State of the robot after a cycle.
        """
        moving = self._rig.hal.moving
        if state.supervisor is _FULL_ASSIST:
            self.full_assist = True
        if moving and not self._started:
            self._started = True
            self._progress.clear()
            print_message(f"ACTIVE on {self._rig.target}; Ctrl-C ends with a stop step")
        over = self._observation.check()
        if over:
            self.outcome = "fell"
        elif moving:
            over = self._walks(state)
        else:
            over = self._halts(state)
        if over:
            self._progress.clear()
            # In ACTIVE, `hal.reason` is the reason of the start. It does not explain the end of the walk.
            if state.supervisor is not SupervisorState.ACTIVE:
                self._reason = self._reason or self._rig.hal.reason
        elif self._progress.due():
            from atalante_tools.session.rig import waiting_for

            self._progress.show(self._describe(state) if moving else waiting_for(self._rig))
        return over

    def _walks(self, state: State) -> bool:
        """Process a cycle in which the torques of the controller are sent. Return whether the walk is over."""
        if self._stop.wanted:
            # Repeat the request in each cycle, because `reset` clears a stop request that arrived just before the start.
            self._controller.stop()
        over = self._controller.done
        finishing = state.supervisor is _FINISH_STEP
        if finishing and not self._reason:
            self._reason = self._rig.hal.reason
            self._progress.clear()
            print_message(f"FINISH_STEP: {self._reason}")
        if over:
            self.outcome = "stopped" if self._stop.wanted or finishing else "stood"
        return over

    def _halts(self, state: State) -> bool:
        """Process a cycle before START or after the end of the motion. Return whether the walk is over.

        After the motion, the robot is observed for `AFTERMATH` cycles, because it may still fall. A further stop signal ends
        the observation early. The observation also ends if the bus is down, because a fall can then no longer be detected.
        """
        hal = self._rig.hal
        fault = state.supervisor is _FAULT
        if fault:
            self.outcome = "fault"
        if not self._started:
            return bool(self._stop.wanted) or fault
        if not self._halted:
            hal.end()  # a START after the end of the motion must not begin a second walk
            self._signals = self._stop.signals
            self._reason = hal.reason
            if not self._controller.walking and self._reason == stop_text(stop_requested=True):
                # The robot stands on both feet, because the walk has not begun or is complete.
                self.outcome = "stopped"
                return True
        self._halted += 1
        stopped = self._stop.signals > min(1, self._signals)
        return stopped or self._halted > AFTERMATH or Dtc.BUS_DOWN in hal.conditions.diagnostics

    def _describe(self, state: State) -> str:
        controller = self._controller
        largest = controller.statistics.guide.max_ratio
        guide = f"   Xi {state.assistance_factor:.2f}   largest |e|/q_bound {largest:.2f}" if largest else ""
        return (
            f"{controller.phase.name:<7} step {controller.statistics.steps:3d}/{self._steps}   t {state.time:6.1f} s   "
            f"{controller.steering.distance:5.2f} m   sideways {controller.steering.lateral:+.2f} m   "
            f"heading {math.degrees(controller.steering.yaw):+.1f} deg{guide}"
        )

    def conclude(self) -> None:
        """End the command with an error, unless the robot stands after all steps or after STOP of the operator.

        Raises:
            SystemExit: If a signal ended the walk, with the exit code of the signal.
            FaultLatched: If the robot is in FAULT, also after a signal.
            Failed: If the robot fell, went to HOLD during the walk, or ended the walk early without a request to stop.
        """
        from atalante_tools.console.outcome import FaultLatched
        from atalante_tools.session.rig import exit_after_signal, left_active

        if self.outcome == "fell":
            reason = f": {self._reason}" if self._reason else ""
            raise Failed(f"the robot fell in step {self._controller.statistics.steps}{reason}")
        if self.outcome == "fault":
            raise FaultLatched(f"the robot is in FAULT: {self._reason}")
        if self.outcome == "hold" and self._started and self._reason != PROGRAM_ENDS:
            raise left_active(self._rig, self._reason)
        if self._stop.wanted:
            exit_after_signal(self._rig, self._stop)
        if self.outcome == "stopped":
            stop = stop_text(stop_requested=True)
            if self._reason not in (stop, stop + WALK_ENDS):
                raise Failed(f"the robot ended the walk early and stands: {self._reason}")
            print_message("stopped by the operator, the robot stands in HOLD")

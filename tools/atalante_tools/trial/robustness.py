"""Trial of the experiment `robustness`: a walk with model errors, lost frames and pushes.

The controller uses a model with the nominal patient. The emulated robot carries a patient with another mass and stands on a floor
with random friction. Messages and motors of this robot are late, its buses lose frames, and the robot is pushed at the pelvis.
"""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from atalante_control.model import Patient
from atalante_control.walking.controller import WalkController
from atalante_control.walking.phases import Phase
from atalante_emulator.emulator import EmulatorParameters
from atalante_emulator.faults import Fault
from atalante_emulator.mechanics import GROUND_PARAMETERS, Ground, Mechanics
from atalante_emulator.motor import MotorParameters
from atalante_hal.loop import LockStep, run
from atalante_hal.robot import load_robot
from atalante_hal.types import PERIOD, State, SupervisorState, Vector
from atalante_hal.wire.cia402 import DriveState
from atalante_tools.console.stop_request import deferred
from atalante_tools.session.body import describe
from atalante_tools.session.recording import EndpointReport, Outputs, Recorder, close_telemetry, start_telemetry
from atalante_tools.session.rig import Rig, open_hal
from atalante_tools.session.walk_observation import Observation
from atalante_tools.session.walk_result import diagnostics
from atalante_tools.trial.lockstep import Ending, gaits_of_trial, target
from atalante_tools.trial.plan import RobustTrial

#: Duration of a push [s].
_PUSH: Final = 0.2
#: Time for which a robot that has fallen is observed [cycles].
_FALLEN: Final = 1000
#: First cycle with faults of the bus. Before this cycle, the robot is OFF.
_BEGINS: Final = 1
_RATE: Final = 100  # sampling rate of a recording [Hz]


def robust_walk(trial: RobustTrial, recording: Path | None = None) -> dict[str, Any]:
    """Run a trial of the experiment `robustness`, and return its result.

    Args:
        trial: trial to run.
        recording: MCAP file for the recording of the walk; None means no recording.
    """
    robot, known = load_robot(), Patient(trial.mass, trial.height)
    true = Patient(trial.mass * trial.mass_share, trial.height)
    gaits = gaits_of_trial(trial.mass, trial.height, trial.network)
    controller = WalkController(robot, known, gaits, trial.steps)
    with open_hal(
        target(trial.engine),
        robot=robot,
        seed=trial.seed,
        pose=controller.standing_pose.tolist(),
        controller_fields=controller.telemetry_fields,
        gait_hash=gaits.step.hash32,
        mechanics=Mechanics(
            describe(robot, None, true), trial.engine, Ground(friction=trial.friction), parameters=_parameters(trial)
        ),
        faults=bus_faults(trial),
    ) as rig:
        pushes = Pushes(controller, trial)
        assert rig.emulator is not None
        rig.emulator.pelvis_forces.append(pushes.wrench)
        ending = SafeEnding(rig, controller)
        telemetry = recorder = None
        if recording is not None:
            outputs = Outputs(recording, _RATE, None, {})
            telemetry = start_telemetry(rig.target, outputs, rig.hal, rig.hal.network, gaits.step.hash32, {}, None)
            telemetry.begin_run("walk", {"trial": trial.name})
            recorder = Recorder(rig, telemetry, EndpointReport(telemetry))

        def record() -> None:
            if recorder is not None:
                recorder.write()

        with deferred():
            run(rig.hal, controller, LockStep(), until=ending, record=record)
        if recorder is not None and telemetry is not None:
            recorder.report_events()
            close_telemetry(telemetry)
        return {
            "outcome": ending.outcome,
            "steps": controller.statistics.steps,
            "state": ending.state.name,
            "safe": ending.safe,
            "pushes": pushes.count,
            "max_dcm_error_m": round(controller.max_dcm_error, 4),
            "diagnostics": diagnostics(rig.hal),
            **ending.observation.true_deviation(),
        }


def _parameters(trial: RobustTrial) -> EmulatorParameters:
    """Return the parameters of a robot on the ground whose motors produce each torque with a delay of `trial.delay[2]` cycles."""
    drive = replace(GROUND_PARAMETERS.drive, motor=MotorParameters(dead_time=trial.delay[2]))
    return replace(GROUND_PARAMETERS, drive=drive)


def bus_faults(trial: RobustTrial) -> list[Fault]:
    """Return the faults of the bus: random loss of frames on all buses, in both directions, and late cyclic messages.

    Args:
        trial: trial with the probability of a loss and the delays.
    """
    import atalante_dbc

    network = atalante_dbc.load()
    states = [message.name for message in network.received_by("HAL") if message.cycle_ms == 1]
    commands = [message.name for message in network.sent_by("HAL") if message.name.startswith("COMMAND_")]
    late = [(name, by) for names, by in zip((states, commands), trial.delay[:2], strict=True) for name in names if by]
    return [
        *(Fault("drop", bus, _BEGINS, None, p=trial.loss) for bus in network.buses),
        *(Fault("delay", name, _BEGINS, None, by=by) for name, by in late),
    ]


class Pushes:
    """Pushes at the pelvis of the walking robot, at the times that the trial defines.

    Attributes:
        count: number of pushes that have begun.
    """

    def __init__(self, controller: WalkController, trial: RobustTrial) -> None:
        """Prepare the pushes.

        Args:
            controller: controller of the walk. The time of the pushes counts from the first periodic step.
            trial: trial with times, directions and force.
        """
        self._controller, self._force, self._pushes = controller, trial.force, trial.pushes
        self._cycles = self.count = 0

    def wrench(self, _hal_state: int) -> Vector:
        """Return force [N] and moment [Nm] of the push on the pelvis in this cycle, shape (6,); zeros without a push."""
        wrench = np.zeros(6)
        if self._cycles == 0 and self._controller.phase is not Phase.STEP:
            return wrench
        time, self._cycles = self._cycles * PERIOD, self._cycles + 1
        self.count = sum(begins <= time for begins, _ in self._pushes)
        if self.count and time - self._pushes[self.count - 1][0] < _PUSH:
            angle = math.radians(self._pushes[self.count - 1][1])
            wrench[:2] = self._force * math.cos(angle), self._force * math.sin(angle)
        return wrench


class SafeEnding:
    """End condition of a walk, called once per cycle. A robot that has fallen is observed for `_FALLEN` more cycles.

    Attributes:
        outcome: "stood", "fell", "hold" or "fault".
        observation: observer that detects a fall, and measures the true deviation from the walking line.
        state: state of the HAL in the last cycle.
        safe: whether the walk ended safely. Either the robot stood at the end, or the HAL stopped the controller and no drive
            follows a command.
    """

    def __init__(self, rig: Rig, controller: WalkController) -> None:
        """Create the end condition of a walk.

        Args:
            rig: rig of the walk.
            controller: controller of the walk.
        """
        self.observation = Observation(rig, controller, None)
        self._rig, self._ending = rig, Ending(rig, lambda: controller.done, self.observation)
        self._fallen = 0
        self.state, self.safe = SupervisorState.OFF, False

    @property
    def outcome(self) -> str:
        """Return the outcome of the walk."""
        return self._ending.outcome

    def __call__(self, state: State) -> bool:
        """Return whether the walk is over.

        Args:
            state: state of the HAL after the cycle.
        """
        over = self._ending(state)
        self._fallen += self.outcome == "fell"
        if over and (self.outcome != "fell" or self._fallen > _FALLEN):
            assert self._rig.emulator is not None
            enabled = DriveState.OPERATION_ENABLED in self._rig.emulator.drives.state
            self.state = state.supervisor
            stopped = state.supervisor not in (SupervisorState.ACTIVE, SupervisorState.FULL_ASSIST) and not enabled
            self.safe = self.outcome == "stood" or stopped
            return True
        return False

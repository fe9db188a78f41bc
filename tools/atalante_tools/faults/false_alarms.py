"""Walks without a fault. Every reported diagnostic is a false alarm, except the expected diagnostics.

seed -> walk in the air or on the ground -> number of reports of each diagnostic
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from atalante_hal.types import State, SupervisorState
from atalante_tools.console.options import EMBEDDED, Target
from atalante_tools.session.walk_result import diagnostics

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from atalante_emulator.mechanics import Mechanics
    from atalante_hal.leg_model import LegModel
    from atalante_hal.types import Controller

#: Number of cycles of a walk in the air. A walk of `_STEPS` steps on the ground has about the same number of cycles.
_CYCLES: Final = 60_000
_STEPS: Final = 75
#: Diagnostics that a walk without a fault may report: joint outside its guide, saturated torque, STOP of the operator.
EXPECTED: Final = frozenset({"GUIDE_OUTSIDE", "TORQUE_SATURATED", "OPERATOR_STOP"})
_SHAPES: Final = ("constant", "pinched")
_FACTORS: Final = (1.0, 0.75, 0.5, 0.25, 0.0)
#: True mass of the patient, relative to the mass for which the gait and the model in the HAL are made.
_MASSES: Final = (1.0, 0.9, 1.1)
#: In one of every `_ACTIVE` walks on the ground, the muscles of the patient are active.
_ACTIVE: Final = 4


@dataclass(frozen=True)
class Quiet:
    """Result of a walk without a fault."""

    name: str
    cycles: int  # number of cycles from power-on to the end of the walk
    state: str  # state of the HAL at the end of the walk
    counts: dict[str, int]  # diagnostic code -> number of reports
    finished: bool  # whether the robot walked to the end

    @property
    def alarms(self) -> dict[str, int]:
        """Return the number of reports of each unexpected diagnostic."""
        return {code: count for code, count in self.counts.items() if code not in EXPECTED}

    @property
    def failed(self) -> bool:
        """Return True if there was a false alarm or if the robot did not walk to the end."""
        return bool(self.alarms) or not self.finished


@dataclass(frozen=True)
class QuietTask:
    """Task to walk without a fault. The number of the task selects the walk, and is the seed of the sensor noise.

    Every second walk is on the ground, with one of the eight patients of the study. The true mass of two in three patients
    differs by 10 % from the mass that the HAL knows. In every fourth walk on the ground, the muscles of the patient are active.
    """

    number: int
    engine: str

    def __call__(self) -> Quiet:
        """Walk and return the reported diagnostics."""
        half = self.number // 2
        shape, xi = _SHAPES[half % len(_SHAPES)], _FACTORS[half % len(_FACTORS)]
        return self._on_the_ground(half, xi) if self.number % 2 else self._in_the_air(shape, xi)

    def _in_the_air(self, shape: str, xi: float) -> Quiet:
        from atalante_control.airwalk.controller import AirwalkConfig, AirwalkController
        from atalante_control.gait.gait import AIRWALK_GAIT, load_gait
        from atalante_control.guide.shapes import SHAPES
        from atalante_control.joint.leg_model import leg_model
        from atalante_emulator.mechanics import Mechanics
        from atalante_hal.robot import load_robot
        from atalante_tools.session.body import describe

        robot = load_robot()
        controller = AirwalkController(robot, load_gait(AIRWALK_GAIT, robot), SHAPES[shape], AirwalkConfig())
        mechanics, name = Mechanics(describe(robot), self.engine), f"air, {shape}, Xi {xi:g}, seed {self.number}"
        return self._run(name, controller, xi, mechanics, leg_model(), None, lambda state: state.cycle >= _CYCLES)

    def _on_the_ground(self, half: int, xi: float) -> Quiet:
        from atalante_control.gait.subject import STUDY_PATIENTS, Subject
        from atalante_control.model import Patient
        from atalante_control.walking.controller import WalkController
        from atalante_emulator.mechanics import Ground, Mechanics
        from atalante_emulator.wearer import LimbParameters
        from atalante_hal.robot import load_robot
        from atalante_tools.session.body import active_task, describe
        from atalante_tools.session.walk_options import DEFAULT_STEP, solved_gaits

        robot, patient = load_robot(), STUDY_PATIENTS[half % len(STUDY_PATIENTS)]
        gaits = solved_gaits(Subject(patient, *DEFAULT_STEP))
        controller = WalkController(robot, patient, gaits, _STEPS)
        true, active = Patient(patient.mass * _MASSES[half % len(_MASSES)], patient.height), None
        name = f"ground, {true.mass:g} kg, pinched, Xi {xi:g}, seed {self.number}"
        if half % _ACTIVE == 1:
            active, name = active_task(gaits, true, self.number), f"{name}, active"
        mechanics = Mechanics(describe(robot, None, true), self.engine, Ground(), LimbParameters(), active)
        pose = controller.standing_pose.tolist()
        return self._run(name, controller, xi, mechanics, None, pose, lambda _: controller.done)

    def _run(
        self,
        name: str,
        controller: Controller,
        xi: float,
        mechanics: Mechanics,
        legs: LegModel | None,
        pose: list[float] | None,
        done: Callable[[State], bool],
    ) -> Quiet:
        """Walk until `done` is True, the HAL leaves ACTIVE, or `2 * _CYCLES` cycles have passed."""
        from atalante_hal.loop import LockStep, run
        from atalante_tools.session.rig import open_hal

        ended, active, finished = SupervisorState.OFF, False, False
        with open_hal(
            Target(EMBEDDED, "", lockstep=True, engine=self.engine),
            seed=self.number,
            pose=pose,
            assistance_factor=xi,
            controller_fields=controller.telemetry_fields,
            mechanics=mechanics,
            legs=legs,
        ) as rig:

            def until(state: State) -> bool:
                nonlocal ended, active, finished
                ended, now = state.supervisor, state.supervisor is SupervisorState.ACTIVE
                left, active = active and not now, now
                finished = now and done(state)
                return left or done(state) or state.cycle > 2 * _CYCLES

            statistics = run(rig.hal, controller, LockStep(), until=until)
            counts = diagnostics(rig.hal)
        return Quiet(name, statistics.cycles, ended.name, counts, finished)


def quiet_tasks(cycles: int, engine: str) -> Iterator[QuietTask]:
    """Yield tasks that walk for about the given number of cycles in total.

    Args:
        cycles: number of cycles.
        engine: physics engine of the emulated robot.
    """
    for number in range(-(-cycles // _CYCLES)):
        yield QuietTask(number, engine)

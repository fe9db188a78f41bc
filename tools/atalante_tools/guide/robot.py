"""Walk of the emulated robot under pushes: `controller, pushes -> largest |e| / q_bound of each step`.

|e| / q_bound is the tracking error e of a joint, divided by the distance q_bound from the desired angle to the edge of the guide.
A joint with a ratio above 1 is outside the guide.

The robot walks in PyBullet, through the HAL in lock-step. A push is a real torque on the sagittal hip and knee of both legs.
The push is added to the torque of the motor. The swing leg gets a push of a given list, for example a push that the
search has found. The push of the stance leg is constant during a step and random from step to step, so that this leg begins its
next swing with a deviation.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final, NamedTuple

import numpy as np

from atalante_control.airwalk.controller import AirwalkController
from atalante_control.model import ExoskeletonParameters
from atalante_emulator.emulator import Emulator
from atalante_emulator.faults import Fault
from atalante_emulator.mechanics import Mechanics
from atalante_hal.dbc_names import JOINT_MESSAGES
from atalante_hal.robot import JOINTS, LEG_JOINTS
from atalante_hal.types import PERIOD, State, SupervisorState, Vector
from atalante_tools.console.options import EMBEDDED, Target
from atalante_tools.guide.episode import RATE, Push, Setup
from atalante_tools.guide.plant import HIP, KNEE, Condition
from atalante_tools.session.body import describe
from atalante_tools.session.rig import Rig, open_hal

Pair = tuple[float, float]

_LEG: Final = len(LEG_JOINTS)
#: Masses of the exoskeleton that `Condition.mass` scales.
_MASSES: Final = (
    "pelvis_mass", "frontal_hip_mass", "transverse_hip_mass", "thigh_mass", "shank_mass", "ankle_mass", "foot_mass",
)  # fmt: skip
#: Command messages. `Condition.delay` delays all frames of these messages.
#: `Condition.loss` drops random frames of these messages and of the state messages of the drives.
_COMMANDS: Final = ("COMMAND_LEFT_LEG", "COMMAND_RIGHT_LEG")


class RobotStep(NamedTuple):
    """Recorded swing of one leg of the robot."""

    ratio: float  # largest |e| / q_bound of the swing; above 1: a joint was outside the guide
    push: int  # index of the push in the list of pushes
    log: Vector  # values of each cycle, shape (cycles, n); the columns are `episode.LOG`


@dataclass(frozen=True)
class RobotWalk:
    """Walk of the robot under pushes."""

    steps: tuple[RobotStep, ...]
    stopped: str  # state of the HAL and reason, if the walk ended early; empty if all steps were walked

    @property
    def worst(self) -> RobotStep | None:
        """Return the step with the largest ratio, or None if no step was walked."""
        return max(self.steps, key=lambda step: step.ratio, default=None)


class PushedRobot:
    """Robot that walks in one guide at one assistance factor, under pushes."""

    def __init__(self, setup: Setup, controller: AirwalkController, xi: float) -> None:
        """Store the inputs of the walks.

        Args:
            setup: gait, robot and model.
            controller: controller of the guide.
            xi: assistance factor in [0, 1].
        """
        self._setup, self._controller, self._xi = setup, controller, xi

    def walk(self, box: Pair, pushes: Sequence[Push], condition: Condition, steps: int, seed: int) -> RobotWalk:
        """Walk on the emulated robot. Each swing gets the next push of the list.

        Args:
            box: largest push at hip and knee [Nm].
            pushes: pushes of the swing leg, one per step. The list is repeated if there are more steps.
            condition: deviation of the robot from the model.
            steps: number of steps of both legs.
            seed: seed of sensor noise, lost frames and pushes of the stance leg.
        """
        setup, controller = self._setup, self._controller
        hand = _Hand(controller, box, pushes, condition.friction, np.random.default_rng(seed))
        with open_hal(
            Target(EMBEDDED, "", lockstep=True),
            robot=setup.robot,
            seed=seed,
            pose=setup.gait.tables().q[0].tolist(),
            assistance_factor=self._xi,
            controller_fields=controller.telemetry_fields,
            gait_hash=setup.gait.hash32,
            faults=_faults(condition),
            mechanics=Mechanics(describe(setup.robot, _scaled(setup.exoskeleton, condition.mass))),
        ) as rig:
            assert rig.emulator is not None
            if condition.noise:
                rig.emulator.before_send.append(EncoderNoise(rig.emulator, setup.robot.gear, condition.noise, seed))
            started = False

            def over(state: State) -> bool:
                nonlocal started
                active = state.supervisor is SupervisorState.ACTIVE
                started = started or active
                return len(hand.steps) >= steps or state.supervisor is SupervisorState.FAULT or (started and not active)

            rig.run(controller, until=over, record=lambda: hand.push(rig))
            reason = "" if len(hand.steps) >= steps else f"{rig.hal.state.supervisor.name}: {rig.hal.reason}"
        return RobotWalk(tuple(hand.steps[:steps]), reason)


class _Hand:
    """Generator of the pushes on both legs, called once per cycle. It also records each finished swing."""

    def __init__(
        self,
        controller: AirwalkController,
        box: Pair,
        pushes: Sequence[Push],
        friction: float,
        generator: np.random.Generator,
    ) -> None:
        self._controller, self._box, self._pushes, self._generator = controller, box, pushes, generator
        self._friction = friction  # friction of hip and knee as a multiple of the friction of the emulated motors
        self._number, self._stance, self._cycle, self._log = -1, -1, 0, []  # type: int, int, int, list[list[float]]
        self._on_stance = (0.0, 0.0)
        self.steps: list[RobotStep] = []

    def push(self, rig: Rig) -> None:
        """Set the pushes of the next cycle.

        Args:
            rig: rig of the walk. Its last cycle is complete.
        """
        hal, controller, emulator = rig.hal, self._controller, rig.emulator
        assert emulator is not None
        error, bound, stance = (hal.record[hal.layout[f"controller.{name}"]] for name in ("error", "q_bound", "stance"))
        if not hal.moving or not bound[0] > 0.0:
            return
        phase = float(hal.record[hal.layout["controller.phase"]][0])
        if int(stance[0]) != self._stance or phase == 0.0:
            self._finish()
            self._stance, self._cycle = int(stance[0]), 0
            self._number += 1
            self._on_stance = tuple(float(self._generator.choice([-b, b])) for b in self._box)  # type: ignore[assignment]
        swing, velocity = _LEG * (1 - self._stance), emulator.body.velocity
        push = self._pushes[self._number % len(self._pushes)]
        at = min(self._cycle, len(push.signs) - 1)
        joints, desired = (swing + HIP, swing + KNEE), controller.desired
        rates = [float(velocity[joint] - desired[len(JOINTS) + joint]) for joint in joints]
        ratios = [float(e / b) for e, b in zip(error, bound, strict=True)]
        level = push.signs[at] + push.feedback @ np.array([*ratios, *(rate / RATE for rate in rates)])
        values = [b if x >= 0.0 else -b for b, x in zip(self._box, level, strict=True)]
        for i, joint in enumerate(joints):
            self._apply(emulator, joint, values[i])
            self._apply(emulator, joint - swing + _LEG * self._stance, self._on_stance[i])
        sent = hal.state.torque_sent
        assert sent is not None
        self._log.append([*map(float, error), *ratios, *values, *(float(sent[joint]) for joint in joints), *rates])
        self._cycle += 1

    def _apply(self, emulator: Emulator, joint: int, push: float) -> None:
        """Apply a push to a joint, and the additional friction that `Condition.friction` requires.

        The emulated motor keeps its own friction, so the additional friction is added to the push as an external torque.
        """
        motor, velocity = emulator.drives.parameters.motor, float(emulator.body.velocity[joint])
        of_leg = joint % _LEG
        friction = motor.coulomb[of_leg] * math.tanh(velocity / motor.friction_speed) + motor.viscous[of_leg] * velocity
        emulator.drives.motors.push(joint, push - (self._friction - 1.0) * friction)

    def _finish(self) -> None:
        if self._log:
            log = np.array(self._log)
            ratio = float(np.abs(log[:, 2:4]).max())
            self.steps.append(RobotStep(ratio, self._number % len(self._pushes), log))
        self._log = []


class EncoderNoise:
    """Noise of all joint encoders. The velocity signals get the derivative of the noise, filtered as in the drives."""

    def __init__(self, emulator: Emulator, gear: Vector, noise: float, seed: int) -> None:
        """Find the position and velocity signals of the drives, and compute the coefficient of the velocity filter.

        Args:
            emulator: emulated nodes.
            gear: motor turns per joint turn, shape (12,).
            noise: noise of the joint positions [rad rms].
            seed: seed of the noise.
        """
        codec = emulator.signals
        self._position, self._velocity = codec.slice("Position"), codec.slice("Velocity")
        bandwidth = emulator.drives.parameters.velocity_bandwidth
        self._keep = float(np.exp(-2.0 * np.pi * bandwidth * PERIOD))
        self._scale, self._generator = noise * gear, np.random.default_rng(seed)
        self._last, self._filtered = np.zeros((2, len(JOINTS)))

    def __call__(self, cycle: int, values: Vector) -> None:
        """Add the noise of a cycle.

        Args:
            cycle: number of the cycle.
            values: signals of the nodes. The noise is added in place.
        """
        noise = self._scale * self._generator.standard_normal(len(JOINTS))
        self._filtered = self._keep * self._filtered + (1.0 - self._keep) * (noise - self._last) / PERIOD
        self._last = noise
        values[self._position] += noise
        values[self._velocity] += self._filtered


def _scaled(exoskeleton: ExoskeletonParameters, mass: float) -> ExoskeletonParameters:
    return replace(exoskeleton, **{name: mass * getattr(exoskeleton, name) for name in _MASSES})


def _faults(condition: Condition) -> list[Fault]:
    """Return the communication faults that a `Condition` requires."""
    faults = []
    if condition.loss:
        faults += [Fault("drop", message, 0, None, p=condition.loss) for message in (*JOINT_MESSAGES, *_COMMANDS)]
    if condition.delay:
        faults += [Fault("delay", message, 0, None, by=condition.delay) for message in _COMMANDS]
    return faults

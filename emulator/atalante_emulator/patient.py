"""Active patient in the emulated robot: muscles make hip and knee of the swing leg follow the nominal step.

The muscles act at the sagittal hip (SH) and the sagittal knee (SK).

    joint angles, landings -> perceived error -> feedback with a delay + learned torque -> muscles -> torque, work

The patient is part of the emulator. The HAL and the controller have no access to this module. A passive patient is
`wearer.PassiveWearer` alone: limbs without muscle torque.

After each step, the learned torque u is updated with the perceived error e: `u <- f u + g e`, where f is `forgetting` and g is
`learning` times `gain`. This model describes motor adaptation as a greedy minimisation of error and effort: without error, the
effort decays (Emken, Benitez, Sideris, Bobrow, Reinkensmeyer, "Motor adaptation as a greedy optimization of error and effort",
J. Neurophysiol. 97, 2007). All experiments use the same parameters.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from atalante_emulator.bodies import Body
from atalante_emulator.wearer import LimbParameters, PassiveWearer
from atalante_hal.robot import LEG_JOINTS, MOTORS, SIDES
from atalante_hal.types import GRAVITY, PERIOD, Vector

Pair = tuple[float, float]

_SH, _SK, _LEG = LEG_JOINTS.index("SH"), LEG_JOINTS.index("SK"), len(LEG_JOINTS)
#: Thresholds of the foot load, as fractions of the weight of robot and patient.
#: Before the walk, a foot stands if its load exceeds `_STANDING`.
#: During the walk, a foot is in the air when its load is below `_AIR`, and lands when its load exceeds `_LANDED`.
_STANDING, _AIR, _LANDED = 0.25, 0.02, 0.1
#: `_MOTORS[leg][segment]` contains the indices of two vibration motors in MOTORS: front and back of the segment.
#: The legs are left and right. The segments are thigh and shank.
_MOTORS = [
    [
        [MOTORS.index(f"{side.lower()}_{segment}_{where}") for where in ("front", "back")]
        for segment in ("thigh", "shank")
    ]
    for side in SIDES
]
#: Time for which both feet must stand before the patient expects steps [cycles].
_READY: Final = 500


@dataclass(frozen=True)
class ActiveParameters:
    """Parameters of an active patient. A pair has values for sagittal hip and knee. Values without a source are assumptions.

    Raises:
        ValueError: If a parameter is out of range.
    """

    #: Feedback torque per perceived joint angle error [Nm/rad]: the stiffness of a person who resists a motion.
    gain: Pair = (150.0, 80.0)
    damping: Pair = (15.0, 8.0)  # feedback torque per rate of the joint angle error [Nm s/rad]
    #: Time from a joint angle error to the voluntary reaction [s]. Kinaesthetic reaction times are 0.12 to 0.18 s.
    delay: float = 0.15
    #: Threshold of perception [rad]. The patient perceives only joint angle errors above `threshold`.
    #: Measured thresholds at hip and knee are one to two degrees (Domingo, Lam, J. NeuroEng. Rehabil. 11, 2014).
    threshold: float = math.radians(1.0)
    #: Learning rate. Each step adds `learning` times `gain` times the perceived error to the learned torque of the leg.
    learning: float = 0.1
    forgetting: float = 0.95  # fraction of the learned torque that remains in the next step of the same leg
    noise: float = 0.1  # standard deviation of the noise torque, as a fraction of the torque (signal-dependent noise)
    noise_time: float = 0.1  # correlation time of the noise torque [s]
    #: Time constant with which the muscle torque follows the torque that the patient wants [s].
    #: Source: Zajac, Crit. Rev. Biomed. Eng. 17, 1989.
    activation: float = 0.05
    #: Largest voluntary flexion torque of each joint, divided by mass * gravity * height. Flexion is the weaker direction.
    #: Source: Anderson, Madigan, Nussbaum, J. Biomech. 40, 2007.
    strength: Pair = (0.113, 0.087)
    fraction: float = 1.0  # strength of this patient as a fraction of the strength of an able-bodied person
    #: Smallest amplitude (0 to 1) at which the patient feels a vibration motor. With infinity, the patient feels no vibration.
    #: While the patient feels a vibration motor of the thigh, the patient perceives even the smallest hip angle error.
    #: While the patient feels a vibration motor of the shank, the patient perceives even the smallest knee angle error.
    vibration: float = math.inf

    def __post_init__(self) -> None:
        for name in ("delay", "noise_time", "activation"):
            if not (math.isfinite(getattr(self, name)) and getattr(self, name) >= PERIOD):
                raise ValueError(f"{name} must be at least one cycle ({PERIOD} s), got {getattr(self, name)!r}")
        for name in ("learning", "forgetting", "noise", "fraction"):
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise ValueError(f"{name} must be from 0 to 1, got {getattr(self, name)!r}")
        if not self.vibration > 0.0:
            raise ValueError(f"vibration must be positive, got {self.vibration!r}")
        for name in ("gain", "damping", "strength"):
            if not all(math.isfinite(value) and value >= 0.0 for value in getattr(self, name)):
                raise ValueError(f"{name} must be two numbers of at least 0, got {getattr(self, name)!r}")


@dataclass(frozen=True)
class ActiveTask:
    """Task of an active patient: the person, the motion to track, and the seed of the noise. The task can be pickled."""

    mass: float  # mass of the patient [kg]
    height: float  # height of the patient [m]
    #: Hip and knee angles that the swing leg must track, shape (n + 1, 2) [rad]. Row k is for cycle k of the step.
    #: In row 0, the foot of the stance leg has just landed. In row n, the foot of the swing leg lands.
    swing: Sequence[Pair]
    seed: int = 0
    parameters: ActiveParameters = ActiveParameters()


class ActivePatient:
    """Legs of an active patient: the limbs of a passive wearer, and muscles at sagittal hip and knee of the swing leg.

    The patient feels the joint angles, the load on the feet and, with `ActiveParameters.vibration`, the vibration motors.
    When a foot lands, the step of the other leg begins.

    Attributes:
        muscle: Torques of the muscles in the last cycle, shape (12,) [Nm].
        strength: Largest magnitudes of the muscle torques of SH and SK [Nm].
        positive_work: Work of the muscles on the joints (concentric) since the start [J].
        negative_work: Magnitude of the work of the joints on the muscles (eccentric) since the start [J].
        impulse: Integral of the magnitudes of the muscle torques since the start [Nm s].
    """

    def __init__(
        self, body: Body, task: ActiveTask, limbs: LimbParameters | None = None, amplitude: Vector | None = None
    ) -> None:
        """Create the patient at rest. The patient has learned nothing.

        Args:
            body: robot with a free pelvis on a floor.
            task: person and motion.
            limbs: impedance of the relaxed limbs. With None, the default impedance is used.
            amplitude: amplitudes of the vibration motors in the order of MOTORS, shape (8,), 0 to 1. The array is read in each
                cycle. With None, no motor vibrates.
        """
        parameters = task.parameters
        self._body, self._limbs, self._p = body, PassiveWearer(limbs), parameters
        self._nominal = np.array(task.swing, dtype=np.float64)
        self._rate = np.gradient(self._nominal, PERIOD, axis=0)
        self._random = np.random.default_rng(task.seed)
        moment = parameters.fraction * task.mass * GRAVITY * task.height
        self.strength: Pair = (parameters.strength[0] * moment, parameters.strength[1] * moment)
        cycles = len(self._nominal)
        self._delay = round(parameters.delay / PERIOD)
        self._lag = PERIOD / (parameters.activation + PERIOD)
        # Axes of the following arrays: `len(SIDES)` is the leg, `cycles` is the cycle of the step, 2 is hip and knee.
        self._learned = np.zeros((len(SIDES), cycles, 2))  # learned torque of each leg [Nm]
        self._plan = np.zeros((cycles, 2))  # learned torque of the current swing leg [Nm]
        self._wobble = np.ones((cycles, 2))  # random factor on the wanted torque: 1 + noise, mean 1
        #: Joint angle error (nominal minus true) [rad], and the rate of the error [rad/s].
        self._error, self._slope = np.zeros((cycles, 2)), np.zeros((cycles, 2))
        #: Smallest joint angle error that the patient perceives [rad], for each cycle of a step.
        #: The threshold of the hip angle is 0 while the patient feels a vibration motor of the thigh.
        #: The threshold of the knee angle is 0 while the patient feels a vibration motor of the shank.
        self._threshold = np.full((cycles, 2), parameters.threshold)
        self._amplitude = np.zeros(len(MOTORS)) if amplitude is None else amplitude
        # `_swing` is the swing leg (0 left, 1 right), or -1 before the first landing. With -1, no muscle acts.
        self._swing, self._cycle, self._ready = -1, 0, 0
        self._air = [False] * len(SIDES)
        self._weight = body.mass * GRAVITY
        self.muscle = np.zeros(len(SIDES) * _LEG)
        self.positive_work = self.negative_work = self.impulse = 0.0

    def act(self, position: Vector, velocity: Vector, torque: Vector) -> None:
        """Compute the torques of limbs and muscles on the joints.

        Args:
            position: joint positions, shape (12,) [rad].
            velocity: joint velocities, shape (12,) [rad/s].
            torque: output for the torques, shape (12,) [Nm].
        """
        self._limbs.act(position, velocity, torque)
        self._feel_landings()
        wanted = self._excite(position, velocity)
        for side in range(len(SIDES)):
            for k, joint in enumerate((side * _LEG + _SH, side * _LEG + _SK)):
                goal = wanted[k] if side == self._swing else 0.0
                tension = float(self.muscle[joint])
                if tension == 0.0 and goal == 0.0:
                    continue
                tension += self._lag * (goal - tension)
                tension = min(max(tension, -self.strength[k]), self.strength[k])
                self.muscle[joint] = tension
                torque[joint] += tension
                work = PERIOD * tension * float(velocity[joint])
                self.positive_work += max(work, 0.0)
                self.negative_work += max(-work, 0.0)
                self.impulse += PERIOD * abs(tension)

    def _feel_landings(self) -> None:
        """Start the step of the other leg when a foot lands. Before the first step, both feet must stand for `_READY` cycles."""
        left, right = self._body.sole_force[:, :, 2].sum(axis=1).tolist() if self._body.touching else (0.0, 0.0)
        loads = (left / self._weight, right / self._weight)
        if self._ready < _READY:
            self._ready = self._ready + 1 if min(loads) > _STANDING else 0
            return
        for side, load in enumerate(loads):
            if load < _AIR:
                self._air[side] = True
            elif load > _LANDED and self._air[side]:
                self._air[side] = False
                self._begin(1 - side)

    def _begin(self, swing: int) -> None:
        """Learn from the last step, and begin the step of the leg `swing` (0 left, 1 right)."""
        if self._swing >= 0:
            self._learn(min(self._cycle, len(self._nominal)))
        self._swing, self._cycle = swing, 0
        self._plan = self._learned[swing]
        self._wobble = 1.0 + self._p.noise * self._noise(len(self._nominal))

    def _learn(self, cycles: int) -> None:
        """Update the learned torque of the leg `_swing` from the joint angle errors of its completed step.

        Args:
            cycles: number of cycles of the step for which errors were recorded.
        """
        felt = np.zeros_like(self._error)
        felt[:cycles] = _perceived(self._error[:cycles], self._threshold[:cycles])
        self._learned[self._swing] *= self._p.forgetting
        self._learned[self._swing] += self._p.learning * np.array(self._p.gain) * _smooth(felt)

    def _noise(self, cycles: int) -> Vector:
        """Return noise with mean 0, standard deviation 1 and the correlation time `noise_time`, shape (cycles, 2)."""
        keep = math.exp(-PERIOD / self._p.noise_time)
        window = round(5.0 * self._p.noise_time / PERIOD)
        kernel = keep ** np.arange(window)
        kernel /= math.sqrt(float(kernel @ kernel))
        white = self._random.standard_normal((cycles + window - 1, 2))
        return np.column_stack([np.convolve(white[:, k], kernel, "valid") for k in range(2)])

    def _excite(self, position: Vector, velocity: Vector) -> Pair:
        """Return the torques that the patient wants at hip and knee of the swing leg [Nm].

        Advance the step by one cycle. The muscles follow the wanted torques with a lag.
        """
        cycle = self._cycle
        if self._swing < 0 or cycle >= len(self._nominal):
            return 0.0, 0.0
        first = self._swing * _LEG
        for k, joint in enumerate((first + _SH, first + _SK)):
            self._error[cycle, k] = self._nominal[cycle, k] - position[joint]
            self._slope[cycle, k] = self._rate[cycle, k] - velocity[joint]
            if self._p.vibration <= 1.0:  # the patient feels motors whose amplitude is at least `vibration`
                felt_motor = self._amplitude[_MOTORS[self._swing][k]].max() >= self._p.vibration
                self._threshold[cycle, k] = 0.0 if felt_motor else self._p.threshold
        self._cycle += 1
        past = cycle - self._delay
        wanted = []
        for k in range(2):
            goal = float(self._plan[cycle, k])
            if past >= 0:
                error = float(self._error[past, k])
                felt = math.copysign(max(abs(error) - float(self._threshold[past, k]), 0.0), error)
                if felt:
                    goal += self._p.gain[k] * felt + self._p.damping[k] * float(self._slope[past, k])
            wanted.append(goal * float(self._wobble[cycle, k]))
        return wanted[0], wanted[1]


def _perceived(error: Vector, threshold: Vector) -> Vector:
    """Return the part of each error that exceeds its threshold of perception, with the sign of the error."""
    felt: Vector = np.sign(error) * np.maximum(np.abs(error) - threshold, 0.0)
    return felt


def _smooth(profile: Vector) -> Vector:
    """Return the moving average of each column over 0.1 s. A person cannot learn torque changes that take less time."""
    window = round(0.1 / PERIOD)
    kernel = np.full(window, 1.0 / window)
    return np.column_stack([np.convolve(column, kernel, "same") for column in profile.T])

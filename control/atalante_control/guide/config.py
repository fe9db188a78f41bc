"""Parameters of the virtual guides of a walk: gains, requested disturbance torques, assumed errors. `config -> step guides`."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from atalante_control.guide.disturbance import HandOver, Mismatch
from atalante_control.joint.idealization import Friction

Pair = tuple[float, float]


@dataclass(frozen=True)
class StepGuideConfig:
    """Parameters of the guide filters of all steps.

    Raises:
        ValueError: If a parameter is out of range.
    """

    friction: Friction = field(default_factory=Friction)
    stiffness: Pair = (2800.0, 2900.0)  # Nm/rad, stiffness of sagittal hip and knee under the stiffest backup policy
    #: stiffnesses of the softer backup policies as fractions of `stiffness`, ascending
    gentler: tuple[float, ...] = (0.78,)
    damping: Pair = (1.3, 0.85)  # damping ratios of the two modes of the backup policy
    #: Nm, requested disturbance torques at sagittal hip and knee; each guide is certified for these torques if possible
    promise: Pair = (30.0, 18.0)
    mismatch: Mismatch = field(default_factory=Mismatch)
    hand_over: HandOver = field(default_factory=HandOver)
    #: Nm, smallest allowed distance of a predicted torque from the torque limit of the robot
    torque_reserve: float = 14.0
    #: rad/s, smallest allowed distance of a predicted speed from the velocity limit of the robot
    speed_reserve: float = 0.2
    #: Gain zeta [s]. While the safety value h falls, the backup torque has the weight w + (1 - w) * zeta * (-dh/dt), at most 1.
    #: Here, w is the weight at a constant h. Example: with zeta = 0.01 s, dh/dt = -50 1/s raises the weight from 0 to 0.5.
    #: The backup torque must rise before h is negative, because a joint may leave the guide at a negative h.
    zeta: float = 0.01
    #: Factor in [0, 1] on the torque u_i, which cancels friction, gravity, centrifugal and Coriolis torques.
    #: While the backup torque has the weight w, u_i is multiplied by `idealization` * (1 - w) + w.
    idealization: float = 1.0
    #: Factor in [0, 1] on the feedforward torque u_f, which accelerates the leg along q_des.
    #: While the backup torque has the weight w, u_f is multiplied by `feedforward` * (1 - w) + w.
    feedforward: float = 1.0
    #: Value of a counter above which the controller reports that the leg has left its guide.
    #: The counter rises by 1 in each cycle in which the guide has certified torques and the safety value h is below 0.
    #: In every other cycle, the counter falls by 1, but not below 0.
    outside_cycles: int = 150
    active: float = 0.05  # weight of the backup torque above which the filter is considered active

    def __post_init__(self) -> None:
        for name in ("stiffness", "damping", "promise"):
            if not all(math.isfinite(value) and value > 0.0 for value in getattr(self, name)):
                raise ValueError(f"each value of {name!r} must be finite and above 0, got {getattr(self, name)!r}")
        for name in ("torque_reserve", "speed_reserve"):
            if not (math.isfinite(getattr(self, name)) and getattr(self, name) >= 0.0):
                raise ValueError(f"{name} must be finite and at least 0, got {getattr(self, name)!r}")
        for name in ("idealization", "feedforward"):
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise ValueError(f"intensity of {name} must be between 0 and 1, got {getattr(self, name)!r}")
        if list(self.gentler) != sorted(self.gentler) or not all(0.0 < part < 1.0 for part in self.gentler):
            raise ValueError(
                f"each value of 'gentler' must be above 0 and below 1, in ascending order, got {self.gentler!r}"
            )

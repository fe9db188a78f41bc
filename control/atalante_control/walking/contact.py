"""Detection of the stance change on the ground: `foot force, time in the step -> stance change`.

On the ground a step ends when two conditions hold: the swing foot has carried load for several consecutive cycles, and
a minimum fraction of the step has passed. If the robot is suspended, a step ends by time (`gait.step_over`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

#: Largest absolute twist that noise causes if all four cells of a foot are correct [N].
#: The twist is FL - FR - RL + RR, where FL, FR, RL and RR are the vertical forces on the cells.
_LARGEST_TWIST = 60.0


def contact_force(load: float, twist: float) -> float:
    """Return the vertical force of the floor on a foot [N]. The value of one force cell may be too large: it is corrected.

    The sole is a rigid plate on four equal cells. Wherever the floor acts, the sum of the forces on FL and RR is equal to the sum
    on FR and RL. The difference, the twist, is therefore the error of a wrong cell. A twist that is larger than the noise is
    subtracted from the load. If a cell reads too little, the result is therefore too small.

    Args:
        load: sum of the vertical forces on all cells [N].
        twist: FL - FR - RL + RR, vertical forces on the cells [N].
    """
    return load - abs(twist) if abs(twist) > _LARGEST_TWIST else load


@dataclass(frozen=True)
class ImpactConfig:
    """Thresholds of the impact detection.

    Raises:
        ValueError: If the release force is not below the impact force, or a number is out of range.
    """

    impact_force: float = 80.0  # N, smallest vertical force on the swing foot at an impact
    #: N, vertical force on the swing foot below which the foot has left the ground.
    #: Before the foot has left the ground, only an impact with a rise of at least `certain_rise` is accepted.
    release_force: float = 30.0
    debounce: int = 5  # number of consecutive cycles with sufficient force after which an impact is detected
    earliest: float = 0.5  # fraction of the step duration before which impacts are ignored
    #: Smallest rise of the vertical force at an impact [N], measured from the smallest force in the step.
    #: `certain_rise` applies while the force in the step has not been below `release_force`.
    #: The foot may then be in the air although its cells report a load, for example because a strap pulls.
    #: Without `certain_rise`, the landing of such a foot would not be detected.
    certain_rise: float = 220.0

    def __post_init__(self) -> None:
        if not 0.0 <= self.release_force < self.impact_force < math.inf:
            raise ValueError(
                f"release_force must be at least 0 N and below impact_force ({self.impact_force!r} N), "
                f"got {self.release_force!r}"
            )
        if not self.certain_rise >= self.impact_force:
            raise ValueError(
                f"certain_rise must be at least impact_force ({self.impact_force!r} N), got {self.certain_rise!r}"
            )
        if self.debounce < 1:
            raise ValueError(f"debounce must be at least 1 cycle, got {self.debounce!r}")
        if not 0.0 <= self.earliest <= 1.0:
            raise ValueError(f"earliest must be from 0 to 1 (fraction of the step duration), got {self.earliest!r}")


class ImpactDetector:
    """Debounced detector of the impact of the swing foot."""

    def __init__(self, config: ImpactConfig) -> None:
        self._config = config
        self.start_step()

    def start_step(self) -> None:
        """Reset the detector at the start of a step.

        Until the new swing foot has left the ground, only impacts with a rise of at least `certain_rise` are accepted.
        """
        self._lowest, self._count = math.inf, 0

    def update(self, vertical_force: float, phase: float) -> bool:
        """Return whether the step ends in this cycle. A force of NaN is neither a contact nor a release.

        Args:
            vertical_force: force on the swing foot, sum of its cells, upwards positive [N].
            phase: time since the stance change divided by the step duration, t / T.
        """
        config = self._config
        self._lowest = min(self._lowest, vertical_force)
        released = self._lowest < config.release_force
        least = config.impact_force if released else self._lowest + config.certain_rise
        if phase >= config.earliest and vertical_force >= least:
            self._count += 1
        else:
            self._count = 0
        return self._count >= config.debounce

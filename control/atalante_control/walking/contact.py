"""Step switch: which leg stands, and when that changes. `foot force, time in the step -> step change`.

On the ground a step ends when the swing foot has carried load for a few cycles on end; in the air, and on the ground
never before a part of the step has passed, it ends by time (`gait.step_over`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass(frozen=True)
class ImpactConfig:
    """When a foot force counts as an impact.

    Raises:
        ValueError: a release force not under the impact force, or a number out of range.
    """

    impact_force: float = 80.0  # N, vertical, on the swing foot
    release_force: float = 30.0  # N, the foot must have been lighter than this since the last change
    debounce: int = 5  # cycles on end over impact_force
    earliest: float = 0.5  # fraction of the step before which nothing counts

    def __post_init__(self) -> None:
        if not 0.0 <= self.release_force < self.impact_force < math.inf:
            raise ValueError(
                f"release_force is not negative and under impact_force, in N, "
                f"not {self.release_force!r} and {self.impact_force!r}"
            )
        if self.debounce < 1:
            raise ValueError(f"debounce is at least 1 cycle, not {self.debounce!r}")
        if not 0.0 <= self.earliest <= 1.0:
            raise ValueError(f"earliest is a fraction of the step in [0, 1], not {self.earliest!r}")


class ImpactDetector:
    """Debounced impact of the swing foot."""

    def __init__(self, config: ImpactConfig) -> None:
        self._config = config
        self.start_step()

    def start_step(self) -> None:
        """Forget the last step: the new swing foot has to leave the ground first."""
        self._released, self._count = False, 0

    def update(self, vertical_force: float, phase: float) -> bool:
        """True on the cycle the step ends. A force that is not a number counts as none.

        Args:
            vertical_force: on the swing foot, sum of its cells, upwards positive [N].
            phase: time in the step over T.
        """
        config = self._config
        if vertical_force < config.release_force:
            self._released = True
        if self._released and phase >= config.earliest and vertical_force >= config.impact_force:
            self._count += 1
        else:
            self._count = 0
        return self._count >= config.debounce

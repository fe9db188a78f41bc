"""Detection of the step change on the ground: `foot force, time in the step -> step change`.

On the ground a step ends when the swing foot has carried load for several consecutive cycles, but not before a given fraction
of the step has passed. In the air a step ends by time (`gait.step_over`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass(frozen=True)
class ImpactConfig:
    """Thresholds of the impact detection.

    Raises:
        ValueError: If the release force is not below the impact force, or a number is out of range.
    """

    impact_force: float = 80.0  # N, smallest vertical force on the swing foot that counts as an impact
    release_force: float = 30.0  # N, the force must fall below this value in a step before an impact counts
    debounce: int = 5  # number of consecutive cycles with at least impact_force that count as an impact
    earliest: float = 0.5  # fraction of the step duration before which no impact counts

    def __post_init__(self) -> None:
        if not 0.0 <= self.release_force < self.impact_force < math.inf:
            raise ValueError(
                f"release_force must be at least 0 N and below impact_force ({self.impact_force!r} N), "
                f"got {self.release_force!r}"
            )
        if self.debounce < 1:
            raise ValueError(f"debounce must be at least 1 cycle, got {self.debounce!r}")
        if not 0.0 <= self.earliest <= 1.0:
            raise ValueError(f"earliest must be a fraction of the step in [0, 1], got {self.earliest!r}")


class ImpactDetector:
    """Debounced detector of the impact of the swing foot."""

    def __init__(self, config: ImpactConfig) -> None:
        self._config = config
        self.start_step()

    def start_step(self) -> None:
        """Reset the detector. An impact counts only after the new swing foot has left the ground."""
        self._released, self._count = False, 0

    def update(self, vertical_force: float, phase: float) -> bool:
        """Return whether the step ends in this cycle. A force of NaN counts as neither contact nor release.

        Args:
            vertical_force: force on the swing foot, sum of its cells, upwards positive [N].
            phase: time since the step change divided by the step duration, t / T.
        """
        config = self._config
        if vertical_force < config.release_force:
            self._released = True
        if self._released and phase >= config.earliest and vertical_force >= config.impact_force:
            self._count += 1
        else:
            self._count = 0
        return self._count >= config.debounce

"""Statistics of the virtual guide over a walk: `tracking errors, guide, h of each cycle -> counts and extremes`."""

from __future__ import annotations

from dataclasses import dataclass, field


@dataclass
class GuideStatistics:
    """Statistics of the guide over the cycles that were added with `count`."""

    cycles: int = 0  # number of counted cycles
    inside: int = 0  # number of counted cycles with both assisted joints inside the guide
    active: int = 0  # number of counted cycles with the filter active
    max_ratio: float = 0.0  # largest |e| / q_bound
    #: smallest h in the first cycle of a step; at h >= 0, the backup policy can keep both joints inside the guide
    min_h_at_start: float = 1.0
    hand_overs_exceeded: int = 0  # number of stance changes with a larger deviation than the certificate assumes
    factors: set[float] = field(default_factory=set)  # assistance factors of all steps so far

    @property
    def inside_fraction(self) -> float:
        """Return the fraction of the counted time with both joints in the guide; 0 before the first counted cycle."""
        return self.inside / max(1, self.cycles)

    @property
    def active_fraction(self) -> float:
        """Return the fraction of the counted time with the filter active; 0 before the first counted cycle."""
        return self.active / max(1, self.cycles)

    def count(self, cycle: int, ratio: float, h: float, acting: bool) -> None:
        """Add one cycle of a step to the statistics.

        Args:
            cycle: number of cycles since the stance change.
            ratio: the larger |e| / q_bound of the two joints.
            h: safe backward image function.
            acting: whether the filter is active.
        """
        self.cycles += 1
        self.inside += ratio <= 1.0
        self.active += acting
        self.max_ratio = max(self.max_ratio, ratio)
        if cycle == 0:
            self.min_h_at_start = min(self.min_h_at_start, h)

"""Statistics of the virtual guide over a walk: `|e| / q_bound and h of each cycle -> counts, extremes`."""

from __future__ import annotations

from dataclasses import dataclass, field


@dataclass
class GuideStatistics:
    """Statistics of the guide. Each call of `count` adds one cycle."""

    cycles: int = 0  # number of counted cycles
    inside: int = 0  # number of counted cycles with both assisted joints inside the guide
    #: number of counted cycles in which the weight of the backup torque was above `StepGuideConfig.active`
    active: int = 0
    max_ratio: float = 0.0  # largest |e| / q_bound
    #: Smallest safety value h among the first cycles of all steps.
    #: If h >= 0, the backup policy (spring and damper) can keep both joints inside the guide.
    min_h_at_start: float = 1.0
    hand_overs: int = 0  # number of steps whose start was compared with the hand-over box
    #: Number of compared steps that start outside the hand-over box (`HandOver`). The certificate does not apply to them.
    hand_overs_exceeded: int = 0
    #: number of steps in which the delay of the loop was too long, so the guide did not act or ended early
    late: int = 0
    #: Assistance factors of the steps so far, without those steps that have no guide because the loop is late (`late`).
    #: In a walk on the ground, only the factors of steps that start with a guide.
    factors: set[float] = field(default_factory=set)

    @property
    def inside_fraction(self) -> float:
        """Return `inside` as a fraction of all counted cycles; 0 before the first counted cycle."""
        return self.inside / max(1, self.cycles)

    @property
    def active_fraction(self) -> float:
        """Return `active` as a fraction of all counted cycles; 0 before the first counted cycle."""
        return self.active / max(1, self.cycles)

    def count(self, cycle: int, ratio: float, h: float, acting: bool) -> None:
        """Add one cycle of a step to the statistics.

        Args:
            cycle: number of cycles since the stance change.
            ratio: the larger |e| / q_bound of the two joints.
            h: safety value of the guide filter in this cycle.
            acting: whether the weight of the backup torque is above `StepGuideConfig.active`.
        """
        self.cycles += 1
        self.inside += ratio <= 1.0
        self.active += acting
        self.max_ratio = max(self.max_ratio, ratio)
        if cycle == 0:
            self.min_h_at_start = min(self.min_h_at_start, h)

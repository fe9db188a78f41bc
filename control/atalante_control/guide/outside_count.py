"""Count of cycles outside the guide: `outside, promised -> whether the disturbance is larger than promised`."""

from __future__ import annotations


class OutsideCount:
    """Count of the cycles outside a guide with a promise. In a guide without a promise, cycles outside are not counted."""

    def __init__(self, largest: int) -> None:
        """Start with the count 0.

        Args:
            largest: largest count that is not yet reported, see `StepGuideConfig.outside_cycles`.
        """
        self._largest, self._cycles = largest, 0

    def update(self, outside: bool, promised: bool) -> bool:
        """Count one cycle. Return whether the joints have been outside the guide for too many cycles.

        The count rises in a cycle outside a guide with a promise, and falls in every other cycle.

        Args:
            outside: whether the safety value h of this cycle is negative; False in a cycle without a guide.
            promised: whether the guide of this step has a promise.
        """
        self._cycles = self._cycles + 1 if outside and promised else max(0, self._cycles - 1)
        return promised and self._cycles > self._largest

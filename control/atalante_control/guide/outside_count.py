"""Counter of the cycles with a negative safety value h. The counter has a limit."""

from __future__ import annotations


class OutsideCount:
    """Counter of the cycles with h < 0 in a guide with certified torques. In every other cycle, the counter falls.

    If the safety value h is negative, the backup policy may not be able to keep the joints inside the guide.
    """

    def __init__(self, largest: int) -> None:
        """Start with the count 0.

        Args:
            largest: largest count that is not yet reported, see `StepGuideConfig.outside_cycles`.
        """
        self._largest, self._cycles = largest, 0

    def update(self, outside: bool, promised: bool) -> bool:
        """Count one cycle. Return whether the safety value h has been negative in too many cycles.

        The count rises or falls by 1 in each cycle, and is at least 0. The result is True if the count exceeds its limit and the
        guide of this step has certified disturbance torques.

        Args:
            outside: whether the safety value h of this cycle is negative; False in a cycle without a guide.
            promised: whether the guide of this step has certified disturbance torques (a promise).
        """
        self._cycles = self._cycles + 1 if outside and promised else max(0, self._cycles - 1)
        return promised and self._cycles > self._largest

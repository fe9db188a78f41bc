"""Assistance factor that the emulated operator sets during a walk: `number of steps begun so far -> assistance factor`."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from atalante_emulator.pendant import Operator
    from atalante_tools.session.embedded.access import Access


class Dial:
    """Assistance dial of the emulated pendant. In the transition, the operator reduces the assistance factor in each step."""

    def __init__(self, operator: Operator | Access, protocol: tuple[int, int, int], xi: float) -> None:
        """Set the dial to full assistance.

        Args:
            operator: Operator of the emulated pendant, or access to the robot of this operator.
            protocol: Numbers of steps: with full assistance, in the transition, with `xi`.
            xi: Assistance factor at the end.
        """
        self._operator, self._set = operator, 1.0
        self._full, self._transition, _ = protocol
        self._xi = xi
        operator.assist(self._set)

    def turn(self, begun: int) -> None:
        """Turn the dial to the assistance factor of the next step. The robot uses a new factor only after the next stance change.

        Args:
            begun: Number of periodic steps that have begun, see `WalkController.steps_begun`. So the next step has the
                number `begun` + 1.
        """
        share = min(1.0, max(0.0, (begun + 1 - self._full) / (self._transition + 1)))
        factor = round(1.0 + share * (self._xi - 1.0), 4)
        if factor != self._set:
            self._set = factor
            self._operator.assist(factor)

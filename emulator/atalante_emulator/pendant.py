"""Emulated pendant node and its operator, with dead-man switch, buttons and assistance dial.

The node sends the same frame as a real pendant and receives the HAL state from SYNC, as a real pendant does.
"""

from __future__ import annotations

from enum import IntEnum
from typing import NamedTuple

from atalante_hal.types import Vector
from atalante_hal.wire.codec import Codec

#: Value of the signal `HalState` in which the operator presses START.
HAL_READY = 1


class Request(IntEnum):
    """Request of the operator; values of the signal `PENDANT_STATE.Request`."""

    NONE = 0
    START = 1
    STOP = 2
    HOLD = 3


class PendantSignals(NamedTuple):
    """Signals of `PENDANT_STATE`; an `assistance_factor` of None leaves the factor unchanged."""

    dead_man: bool = True
    request: Request = Request.NONE
    request_counter: int = 0
    assistance_factor: float | None = None


class Operator:
    """Emulated operator who keeps the dead-man switch pressed and presses START while the HAL is READY.

    A robot in HOLD stays there until `start()` is called, because recovery must be a decision of the operator.
    """

    #: Cycles in READY before START, and between two presses while the HAL stays READY.
    REACTION = 200

    def __init__(self, assistance_factor: float | None = None, *, starts: bool = True) -> None:
        """Press the dead-man switch and set the dial.

        Args:
            assistance_factor: assistance factor Xi on the dial, 0 to 1. None leaves it to the HAL.
            starts: whether the operator presses START when the HAL is READY.

        Raises:
            ValueError: If the factor is outside [0, 1].
        """
        self._starts = starts
        self._ready_for = 0
        #: Signals that the node sends; replaced by a new object at every change.
        self.signals = PendantSignals()
        self.assist(assistance_factor)

    def assist(self, factor: float | None) -> None:
        """Turn the assistance dial.

        Args:
            factor: assistance factor Xi, 0 to 1. None leaves it to the HAL.

        Raises:
            ValueError: If the factor is outside [0, 1].
        """
        if factor is not None and not 0.0 <= factor <= 1.0:
            raise ValueError(f"the assistance factor must be from 0 to 1, got {factor!r}")
        self.signals = self.signals._replace(assistance_factor=factor)

    def start(self) -> None:
        """Press START."""
        self._press(Request.START)

    def stop(self) -> None:
        """Press STOP; the operator presses START again only on `start()`."""
        self._starts = False
        self._press(Request.STOP)

    def hold(self) -> None:
        """Press HOLD; the operator presses START again only on `start()`."""
        self._starts = False
        self._press(Request.HOLD)

    def release(self) -> None:
        """Release the dead-man switch."""
        self.signals = self.signals._replace(dead_man=False)

    def squeeze(self) -> None:
        """Press the dead-man switch again."""
        self.signals = self.signals._replace(dead_man=True)

    def hear(self, hal_state: int) -> None:
        """Receive the HAL state of one cycle, and press START if it is time.

        Args:
            hal_state: value of the signal `HalState` in SYNC.
        """
        if hal_state != HAL_READY or not self._starts:
            self._ready_for = 0
            return
        self._ready_for += 1
        if self._ready_for % self.REACTION == 0:
            self.start()

    def _press(self, request: Request) -> None:
        counter = (self.signals.request_counter + 1) & 0xFF
        self.signals = self.signals._replace(request=request, request_counter=counter)


class PendantNode:
    """Pendant node of an operator: receives the HAL state from SYNC and sends `PENDANT_STATE`."""

    def __init__(self, operator: Operator, codec: Codec, values: Vector) -> None:
        """Connect the node to its signals.

        Args:
            operator: operator of the pendant.
            codec: codec of the 1 ms messages.
            values: array that receives the signals, shape (codec.size,).
        """
        self._operator = operator
        self._values = values
        self._sent: PendantSignals | None = None
        names = ("DeadMan", "Request", "RequestCounter", "AssistanceSet", "AssistanceFactor")
        self._indices = [codec.index("PENDANT_STATE", name) for name in names]

    def hear(self, hal_state: int) -> bool:
        """Receive the HAL state of one cycle and update the signals.

        Args:
            hal_state: value of the signal `HalState` in SYNC.

        Returns:
            Whether a signal changed.
        """
        self._operator.hear(hal_state)
        signals = self._operator.signals
        if signals is self._sent:
            return False
        self._sent = signals
        factor = signals.assistance_factor
        self._values[self._indices] = (
            signals.dead_man,
            signals.request,
            signals.request_counter,
            factor is not None,
            factor or 0.0,
        )
        return True

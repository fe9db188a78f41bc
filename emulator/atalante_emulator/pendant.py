"""Emulated pendant node, and an emulated operator who uses its dead-man switch, buttons and assistance dial.

Like a real pendant, the node sends `PENDANT_STATE` and reads the HAL state from SYNC.
"""

from __future__ import annotations

from enum import IntEnum
from typing import NamedTuple

from atalante_hal.types import Vector
from atalante_hal.wire.codec import Codec

#: Value READY of the signal `HalState`. In this state the operator presses START.
HAL_READY = 1


class Request(IntEnum):
    """Button that the operator pressed last. Each member has the value of the signal `PENDANT_STATE.Request`."""

    NONE = 0
    START = 1
    STOP = 2
    HOLD = 3


class PendantSignals(NamedTuple):
    """Signals of the message `PENDANT_STATE`. If `assistance_factor` is None, the factor of the HAL stays unchanged."""

    dead_man: bool = True
    request: Request = Request.NONE
    request_counter: int = 0
    assistance_factor: float | None = None


class Operator:
    """Emulated operator: keeps the dead-man switch pressed, and presses START while the HAL is in READY.

    In HOLD the emulated operator does not press START. Call `start()` to end HOLD.
    """

    #: Interval at which the operator presses START while the HAL is in READY [cycles]. The first press is after one interval.
    REACTION = 200

    def __init__(self, assistance_factor: float | None = None, *, starts: bool = True) -> None:
        """Press the dead-man switch and set the dial.

        Args:
            assistance_factor: assistance factor Xi on the dial, 0 to 1. With None, the factor of the HAL stays unchanged.
            starts: whether the operator presses START when the HAL is in READY.

        Raises:
            ValueError: If the factor is outside [0, 1].
        """
        self._starts = starts
        self._ready_for = 0
        #: Signals that the pendant node sends. Every change creates a new object, so the node detects changes with `is`.
        self.signals = PendantSignals()
        self.assist(assistance_factor)

    def assist(self, factor: float | None) -> None:
        """Turn the assistance dial.

        Args:
            factor: assistance factor Xi, 0 to 1. With None, the factor of the HAL stays unchanged.

        Raises:
            ValueError: If the factor is outside [0, 1].
        """
        if factor is not None and not 0.0 <= factor <= 1.0:
            raise ValueError(f"the assistance factor must be from 0 to 1, got {factor!r}")
        self.signals = self.signals._replace(assistance_factor=factor)

    def start(self) -> None:
        """Press the START button."""
        self._press(Request.START)

    def stop(self) -> None:
        """Press the STOP button. From then on, the operator presses START only when `start()` is called."""
        self._starts = False
        self._press(Request.STOP)

    def hold(self) -> None:
        """Press the HOLD button. From then on, the operator presses START only when `start()` is called."""
        self._starts = False
        self._press(Request.HOLD)

    def release(self) -> None:
        """Release the dead-man switch."""
        self.signals = self.signals._replace(dead_man=False)

    def squeeze(self) -> None:
        """Press the dead-man switch again after a release."""
        self.signals = self.signals._replace(dead_man=True)

    def receive(self, hal_state: int) -> None:
        """Read the HAL state of one cycle, and press START after every `REACTION` consecutive cycles in READY.

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
    """Emulated pendant node: passes the HAL state to the operator, and writes the signals of `PENDANT_STATE`."""

    def __init__(self, operator: Operator, codec: Codec, values: Vector) -> None:
        """Connect the node to its signals.

        Args:
            operator: operator of the pendant.
            codec: codec of the 1 ms messages.
            values: array to which the signals are written, shape (codec.size,).
        """
        self._operator = operator
        self._values = values
        self._sent: PendantSignals | None = None
        names = ("DeadMan", "Request", "RequestCounter", "AssistanceSet", "AssistanceFactor")
        self._indices = [codec.index("PENDANT_STATE", name) for name in names]

    def receive(self, hal_state: int) -> bool:
        """Read the HAL state of one cycle and update the signals.

        Args:
            hal_state: value of the signal `HalState` in SYNC.

        Returns:
            Whether a signal changed.
        """
        self._operator.receive(hal_state)
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

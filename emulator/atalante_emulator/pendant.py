"""The pendant node held by an emulated operator: what a person does with the dead-man, the buttons and the assistance dial.

Speaks the same frame as a real pendant, and hears what a pendant hears: the HAL's state in SYNC.
"""

from __future__ import annotations

from enum import IntEnum
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from atalante_hal.wire.codec import Codec

Vector = npt.NDArray[np.float64]

#: `HalState` on the wire in which an operator presses START.
HAL_READY = 1


class Request(IntEnum):
    """What the operator asks for; values of `PENDANT_STATE.Request`."""

    NONE = 0
    START = 1
    STOP = 2
    HOLD = 3


class PendantSignals(NamedTuple):
    """`PENDANT_STATE` as the node sends it; `assistance_factor` None leaves the factor as it is."""

    dead_man: bool = True
    request: Request = Request.NONE
    request_counter: int = 0
    assistance_factor: float | None = None


class Operator:
    """A patient operator: keeps the dead-man pressed, and presses START whenever the HAL says it is READY.

    A robot in HOLD is left alone until somebody calls `start()`: recovery is a decision.
    """

    #: Cycles of READY before START, and between two presses while nothing happens.
    REACTION = 200

    def __init__(self, assistance_factor: float | None = None, *, starts: bool = True) -> None:
        """Take the pendant.

        Args:
            assistance_factor: Xi in [0, 1] to set on the dial, None leaves it to the HAL.
            starts: presses START by itself when the HAL is READY.

        Raises:
            ValueError: the factor is outside [0, 1].
        """
        self._starts = starts
        self._ready_for = 0
        #: What the node sends now: another object whenever it changes.
        self.signals = PendantSignals()
        self.assist(assistance_factor)

    def assist(self, factor: float | None) -> None:
        """Turn the dial: Xi in [0, 1]; None leaves the factor to the HAL. Raises `ValueError` outside."""
        if factor is not None and not 0.0 <= factor <= 1.0:
            raise ValueError(f"the assistance factor is between 0 and 1, not {factor!r}")
        self.signals = self.signals._replace(assistance_factor=factor)

    def start(self) -> None:
        """Press START."""
        self._press(Request.START)

    def stop(self) -> None:
        """Press STOP; START is not pressed again by itself."""
        self._starts = False
        self._press(Request.STOP)

    def hold(self) -> None:
        """Press HOLD; START is not pressed again by itself."""
        self._starts = False
        self._press(Request.HOLD)

    def release(self) -> None:
        """Let the dead-man go."""
        self.signals = self.signals._replace(dead_man=False)

    def squeeze(self) -> None:
        """Press the dead-man again."""
        self.signals = self.signals._replace(dead_man=True)

    def hear(self, hal_state: int) -> None:
        """One cycle: the HAL's state, as SYNC carries it."""
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
    """The pendant in an operator's hand: hears what SYNC says, and says `PENDANT_STATE`."""

    def __init__(self, operator: Operator, codec: Codec, values: Vector) -> None:
        """Take the pendant; `values`, shape (codec.size,), are what the nodes say."""
        self._operator = operator
        self._values = values
        self._said: PendantSignals | None = None
        names = ("DeadMan", "Request", "RequestCounter", "AssistanceSet", "AssistanceFactor")
        self._places = [codec.index("PENDANT_STATE", name) for name in names]

    def hear(self, hal_state: int) -> bool:
        """One cycle, with the HAL's state as SYNC carries it; whether the pendant now says something else."""
        self._operator.hear(hal_state)
        said = self._operator.signals
        if said is self._said:
            return False
        self._said = said
        factor = said.assistance_factor
        self._values[self._places] = (
            said.dead_man,
            said.request,
            said.request_counter,
            factor is not None,
            factor or 0.0,
        )
        return True

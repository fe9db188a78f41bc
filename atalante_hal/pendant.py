"""Inputs of the operator, which the pendant node sends every cycle: dead-man switch, buttons, assistance factor.

`process image -> pendant -> state machine` is the only path for commands to the robot.

START is edge-triggered: a press is a change of `RequestCounter` between two accepted frames. The first frame is never a press. If
START is pressed while the pendant is not qualified yet, the press is stored until the pendant is qualified. The press is dropped
if the dead-man switch or START is released before that, or if the state changes.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

from atalante_hal.types import Vector
from atalante_hal.wire.process_image import ReceiveImage

#: Values of the signal Request in PENDANT_STATE: no request, and START.
_NONE, _START = 0, 1
_SIGNALS = ("DeadMan", "Request", "RequestCounter", "AssistanceFactor", "AssistanceSet")


class Demand(NamedTuple):
    """Signals of a pendant frame that can end a motion."""

    dead_man: bool  # the dead-man switch is pressed
    stop: bool  # the request is STOP, HOLD or an invalid value


def demand_of(signals: Sequence[float]) -> Demand:
    """Return the dead-man switch and the stop request of a frame.

    Args:
        signals: Signal values in the order of the message, DeadMan and Request first.

    Returns:
        Dead-man switch and stop request of the frame.
    """
    return Demand(signals[0] == 1, signals[1] not in (_NONE, _START))


def safest(demands: Iterable[Demand]) -> Demand:
    """Combine the dead-man switch and the stop request of several frames into the safest `Demand`.

    The dead-man switch counts as pressed only if it is pressed in every frame. One frame with STOP is sufficient for STOP.

    Args:
        demands: Demands of the frames, at least one.

    Returns:
        The combined demand.
    """
    dead_man, stop = zip(*demands, strict=True)
    return Demand(all(dead_man), any(stop))


class Pendant:
    """Inputs of the operator in the present cycle.

    Args:
        image: Process image with the message PENDANT_STATE.
    """

    def __init__(self, image: ReceiveImage) -> None:
        codec = image.codec
        self.row = codec.rows["PENDANT_STATE"]
        indices = [codec.index("PENDANT_STATE", name) for name in _SIGNALS]
        assert indices == list(range(indices[0], indices[0] + len(indices)))
        self._slice = slice(indices[0], indices[-1] + 1)
        #: Signal values as received, a view of the process image.
        self.signals = image.values[self._slice]
        #: Bytes of `signals` at the last call of `hear`. If `signals` has changed since then, `hear` must be called again.
        self.heard = b""
        self.dead_man = False
        self.stop_requested = False
        #: True in the cycle in which a START is accepted.
        self.started = False
        #: Assistance factor Xi in [0, 1]; None if the pendant sets no factor.
        self.assistance_factor: float | None = None
        self._press: float | None = None  # RequestCounter of the last cycle
        self._pressed = False  # True while a START is stored until the pendant is qualified

    def hear(self, present: bool, *, qualifying: bool = False, beside: Sequence[Vector] = ()) -> None:
        """Evaluate the inputs of one cycle.

        Args:
            present: True if the pendant is in time and qualified. Otherwise dead-man switch, STOP and factor do not count.
            qualifying: True if the pendant is in time but not qualified yet. A START pressed now counts once it is qualified.
            beside: Values of the process image for each further intact frame of this cycle, see `ReceiveImage.beside`. The
                safest frame of a cycle counts. START does not count until the frames of a cycle agree again.
        """
        self.started = False
        if not (present or qualifying):
            self.dead_man = self.stop_requested = False
            self.heard, self._press, self._pressed = b"", None, False
            return
        self.heard = self.signals.tobytes()
        received = self.signals.tolist()
        _, request, press, factor, factor_set = received
        others = [demand_of(values[self._slice].tolist()) for values in beside]
        demand = safest([demand_of(received), *others])
        self.dead_man, self.stop_requested = present and demand.dead_man, present and demand.stop
        if not beside:
            edge = request == _START and self._press is not None and press != self._press
            self.started = present and (edge or self._pressed)
            self._pressed = not present and (edge or self._pressed) and request == _START and demand.dead_man
            self._press = press
        elif not demand.dead_man or demand.stop:
            self._pressed = False
        if present:
            self.assistance_factor = factor if factor_set else None

    def forget_press(self) -> None:
        """Drop a stored START. The safety monitor calls this after each change of the state."""
        self._pressed = False

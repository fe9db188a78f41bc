"""Inputs of the operator, which the pendant node sends every cycle: dead-man switch, buttons, assistance factor.

`process image -> pendant -> state machine` is the only path for the operator's commands.

START is edge-triggered: a press is a frame with the request START whose `RequestCounter` differs from the previous cycle.
The first frame, and the first frame after a gap between cycles, is never a press. If START is pressed while the pendant is
not qualified yet, the press is stored until the pendant is qualified. A stored press is dropped if the dead-man switch or
START is released, or if the supervisor state changes. While two pendants may be sending, there is no press, and the next
frame counts as a first frame.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

from atalante_hal.types import Vector
from atalante_hal.wire.process_image import ReceiveImage

#: Values of the signal Request in PENDANT_STATE: no request, START and STOP.
_NONE, _START, _STOP = 0, 1, 2
_SIGNALS = ("DeadMan", "Request", "RequestCounter", "AssistanceFactor", "AssistanceSet")


class Demand(NamedTuple):
    """Signals of a pendant frame that can end a motion."""

    dead_man: bool  # the dead-man switch is pressed
    stop: bool  # the request is STOP, HOLD or an invalid value
    hold: bool  # the request is HOLD or an invalid value


def demand_of(signals: Sequence[float]) -> Demand:
    """Return the dead-man switch, the stop request and the hold request of a frame.

    Args:
        signals: Signal values of PENDANT_STATE in the order of the DBC, which begins with DeadMan and Request.

    Returns:
        Dead-man switch, stop request and hold request of the frame.
    """
    return Demand(signals[0] == 1, signals[1] not in (_NONE, _START), signals[1] not in (_NONE, _START, _STOP))


def safest(demands: Iterable[Demand]) -> Demand:
    """Combine dead-man switch, stop request and hold request of several frames into the safest `Demand`.

    The combined dead-man switch is pressed only if it is pressed in every frame. One frame with a stop request
    results in a stop request, and one frame with a hold request results in a hold request.

    Args:
        demands: Demands of the frames, at least one.

    Returns:
        The combined demand.
    """
    dead_man, stop, hold = zip(*demands, strict=True)
    return Demand(all(dead_man), any(stop), any(hold))


class Pendant:
    """Inputs of the operator in the current cycle.

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
        #: Copy of `signals` as bytes, made by the last `evaluate`; empty while the pendant is absent.
        #: If this copy differs from `signals`, the pendant has sent new inputs, and `evaluate` must be called.
        self.evaluated = b""
        self.dead_man = False
        self.stop_requested = False
        #: True if the request is HOLD or an invalid value. Then `stop_requested` is True, too.
        self.hold_requested = False
        #: True in the cycle in which a START is accepted.
        self.started = False
        #: Assistance factor Xi in [0, 1]; None if the pendant sets no factor.
        self.assistance_factor: float | None = None
        #: RequestCounter of the last evaluated frame. None before the first frame and after a gap between cycles.
        #: The RequestCounter is also None after a cycle in which two pendants may have sent frames.
        self._press: float | None = None
        self._pressed = False  # True while a press of START is stored until the pendant is qualified

    def evaluate(
        self,
        present: bool,
        *,
        qualifying: bool = False,
        new: bool = True,
        further_frames: Sequence[Vector] = (),
        two_senders: bool = False,
    ) -> None:
        """Evaluate the inputs of one cycle.

        Args:
            present: True if the pendant is in time and qualified. If False, the dead-man switch is regarded as released, STOP
                is ignored, and the assistance factor does not change.
            qualifying: True if the pendant is in time but not qualified yet. Then a press of START is stored until the
                pendant is qualified.
            new: True if a frame was accepted in this cycle. START is evaluated only in such a cycle. Without a new frame, the
                signals are those of an earlier cycle. If that cycle had further frames, the signals may come from a
                second sender.
            further_frames: Values of the process image for each further valid frame of this cycle, see
                `ReceiveImage.decode_further_frames`. All frames of the cycle are combined as in `safest`. START is not
                evaluated in a cycle with further frames.
            two_senders: True if the frames may come from two pendants, see `MessageMonitor.may_have_two_senders`. Then START is
                not evaluated, and a stored press is dropped.
        """
        self.started = False
        if not (present or qualifying):
            self.dead_man = self.stop_requested = self.hold_requested = False
            self.evaluated, self._press, self._pressed = b"", None, False
            return
        self.evaluated = self.signals.tobytes()
        received = self.signals.tolist()
        _, request, press, factor, factor_set = received
        others = [demand_of(values[self._slice].tolist()) for values in further_frames]
        demand = safest([demand_of(received), *others])
        self.dead_man, self.stop_requested = present and demand.dead_man, present and demand.stop
        self.hold_requested = present and demand.hold
        if two_senders:
            self._press, self._pressed = None, False
        elif not further_frames:
            edge = new and request == _START and self._press is not None and press != self._press
            stored = (edge or self._pressed) and request == _START and demand.dead_man
            self.started = present and (edge or stored)
            self._pressed = not present and stored
            self._press = press if new else self._press
        elif not demand.dead_man or demand.stop:
            self._pressed = False
        if present:
            self.assistance_factor = factor if factor_set else None

    def forget_start(self) -> None:
        """Ignore a START that was pressed before this call, even if its frame arrives later.

        Call this method after a gap between cycles. In the gap, the operator did not see the faults that the HAL reports now,
        so the START acknowledges nothing.
        """
        self._press, self._pressed = None, False

    def clear_press(self) -> None:
        """Drop a stored START. The safety monitor calls this method after each change of the supervisor state."""
        self._pressed = False

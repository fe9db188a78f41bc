"""The operator's requests, as the pendant node sends them every cycle: dead-man, buttons, assistance factor.

`process image -> pendant -> supervisor`: the one command path into the robot.

START is edge-triggered: a press is a change of `RequestCounter` between two accepted frames. What stands in the first frame is
no press. A press that comes while the sender is not trusted yet is kept until it is, as long as dead-man and START stay
pressed and the supervisor does not move.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

from atalante_hal.wire.codec import Vector
from atalante_hal.wire.process_image import ReceiveImage

#: Values of `PENDANT_STATE.Request`.
_NONE, _START = 0, 1
_SIGNALS = ("DeadMan", "Request", "RequestCounter", "AssistanceFactor", "AssistanceSet")


class Demand(NamedTuple):
    """What a frame of the pendant demands that may end a motion."""

    dead_man: bool
    stop: bool  # STOP or HOLD is requested, or what no pendant may request


def demand_of(signals: Sequence[float]) -> Demand:
    """Return the demand of a frame.

    Args:
        signals: DeadMan, Request and the others in the order of the message.
    """
    return Demand(signals[0] == 1, signals[1] not in (_NONE, _START))


def safest(demands: Iterable[Demand]) -> Demand:
    """Return the one demand that is as safe as each of them: the dead-man counts if all frames have it, STOP if one has."""
    dead_man, stop = zip(*demands, strict=True)
    return Demand(all(dead_man), any(stop))


class Pendant:
    """What the operator wants now."""

    def __init__(self, image: ReceiveImage) -> None:
        codec = image.codec
        self.row = codec.rows["PENDANT_STATE"]
        places = [codec.index("PENDANT_STATE", name) for name in _SIGNALS]
        assert places == list(range(places[0], places[0] + len(places)))
        self._places = slice(places[0], places[-1] + 1)
        #: The values as received; bytes other than `heard` have to be heard.
        self.signals = image.values[self._places]
        self.heard = b""
        self.dead_man = False
        self.stop_requested = False
        #: START was pressed in this cycle.
        self.started = False
        #: Xi in [0, 1]; None: the HAL keeps its own.
        self.assistance_factor: float | None = None
        self._press: float | None = None  # RequestCounter of the last cycle
        self._pressed = False  # START was pressed before the sender was trusted, or among frames that differ

    def hear(self, present: bool, *, qualifying: bool = False, beside: Sequence[Vector] = ()) -> None:
        """Take the requests of one cycle.

        Args:
            present: the node is heard in time and trusted. While it is not, dead-man, STOP and the factor do not count.
            qualifying: the node is heard in time. A START pressed meanwhile counts when the node is trusted.
            beside: values of the image as other intact frames of this cycle have them, see `ReceiveImage.beside`. The safest
                frame of a cycle counts, and no press counts before the frames of a cycle agree again.
        """
        self.started = False
        if not (present or qualifying):
            self.dead_man = self.stop_requested = False
            self.heard, self._press, self._pressed = b"", None, False
            return
        self.heard = self.signals.tobytes()
        said = self.signals.tolist()
        _, request, press, factor, factor_set = said
        others = [demand_of(values[self._places].tolist()) for values in beside]
        demand = safest([demand_of(said), *others])
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
        """Drop a START that has not counted yet: the supervisor has moved."""
        self._pressed = False

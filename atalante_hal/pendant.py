"""The operator's words, as the pendant node says them every cycle: dead-man, requests, assistance factor.

`process image -> pendant -> supervisor`: the one command path into the robot.
"""

from __future__ import annotations

from atalante_hal.image import ReceiveImage

#: Values of `PENDANT_STATE.Request`.
_START, _STOP, _HOLD = 1, 2, 3
_SIGNALS = ("DeadMan", "Request", "RequestCounter", "AssistanceFactor", "AssistanceSet")


class Pendant:
    """What the operator wants now."""

    def __init__(self, image: ReceiveImage) -> None:
        codec = image.codec
        self.row = codec.rows["PENDANT_STATE"]
        places = [codec.index("PENDANT_STATE", name) for name in _SIGNALS]
        assert places == list(range(places[0], places[0] + len(places)))
        #: The values as received; bytes other than `heard` have to be heard.
        self.signals = image.values[places[0] : places[-1] + 1]
        self.heard = b""
        self.dead_man = False
        self.stop_requested = False
        #: START was pressed in this cycle.
        self.started = False
        #: Xi in [0, 1]; None: the HAL keeps its own.
        self.assistance_factor: float | None = None
        self._press: float | None = None

    def hear(self, present: bool) -> None:
        """One cycle.

        Args:
            present: the node is heard in time and trusted. While it is not, nothing is pressed; what was pressed meanwhile does
                not count.
        """
        self.started = False
        if not present:
            self.dead_man = self.stop_requested = False
            self.heard, self._press = b"", None
            return
        self.heard = self.signals.tobytes()
        dead_man, request, press, factor, factor_set = self.signals.tolist()
        self.dead_man = dead_man == 1
        self.stop_requested = request in (_STOP, _HOLD)
        self.started = request == _START and self._press is not None and press != self._press
        self._press = press
        self.assistance_factor = factor if factor_set else None

"""Emulated haptics node: eight vibration motors that follow the commanded level with a first-order lag."""

from __future__ import annotations

import math
from dataclasses import dataclass

from atalante_hal.types import PERIOD, Vector

#: Cycles without a valid command after which the motors stop.
WATCHDOG = 50


@dataclass(frozen=True)
class HapticsParameters:
    """Time response of the emulated vibration motors."""

    rise_time: float = 0.04  # s, time constant of a small eccentric-mass motor


class Haptics:
    """Eight vibration motors; `advance` rewrites `amplitude`, shape (8,), 0 to 1."""

    def __init__(self, parameters: HapticsParameters, amplitude: Vector) -> None:
        self.amplitude = amplitude
        self._parameters = parameters

    def advance(self, level: Vector, silence: int, cycles: int) -> None:
        """Advance the amplitudes towards a constant level: a' = (level - a) / rise_time, solved exactly.

        Args:
            level: last valid command, shape (8,), 0 to 1.
            silence: age of that command, in cycles.
            cycles: time to advance, in units of `PERIOD`.
        """
        lag = math.exp(-cycles * PERIOD / self._parameters.rise_time)
        self.amplitude *= lag
        if silence < WATCHDOG:
            self.amplitude += (1.0 - lag) * level

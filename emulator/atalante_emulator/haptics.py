"""The haptics node: eight vibration motors that follow the commanded level with a first-order lag."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from atalante_emulator.body import PERIOD
from atalante_hal.compiled import compiled

Vector = npt.NDArray[np.float64]

#: Cycles without a valid command after which the motors stop.
WATCHDOG = 50


@dataclass(frozen=True)
class HapticsParameters:
    """Response of the emulated vibration motors."""

    rise_time: float = 0.04  # s, time constant of a small eccentric-mass motor


def _follow(amplitude: Vector, level: Vector, keep: float, gain: float) -> None:
    """One step of the first-order lag. Shape (8,) each."""
    for i in range(len(amplitude)):
        amplitude[i] = keep * amplitude[i] + gain * level[i]


class Haptics:
    """Eight motors. `amplitude` is shape (8,), 0 to 1."""

    def __init__(self, parameters: HapticsParameters, amplitude: Vector) -> None:
        self.amplitude = amplitude
        self._parameters = parameters
        self._follow = compiled(_follow)
        self._follow(amplitude, np.zeros(len(amplitude)), 1.0, 0.0)  # is compiled now, not in a cycle

    def advance(self, level: Vector, silence: int, cycles: int) -> None:
        """Let the motors follow a level held for some `PERIOD`s: a' = (level - a) / rise_time, solved exactly.

        Args:
            level: last valid command, shape (8,).
            silence: cycles since that command came.
            cycles: how many `PERIOD`s to advance.
        """
        lag = math.exp(-cycles * PERIOD / self._parameters.rise_time)
        self._follow(self.amplitude, level, lag, 1.0 - lag if silence < WATCHDOG else 0.0)

"""Emulated haptics node with eight vibration motors. Each motor follows its commanded level with a first-order lag."""

from __future__ import annotations

import math
from dataclasses import dataclass

from atalante_hal.types import PERIOD, Vector

#: Timeout of the vibration command [cycles], equal to the TimeoutTime of HAPTICS_COMMAND in the DBC.
#: If the last valid command is at least `WATCHDOG` cycles old, the node sets the commanded levels to 0.
WATCHDOG = 10


@dataclass(frozen=True)
class HapticsParameters:
    """Response time of the emulated vibration motors."""

    #: Time constant of a small eccentric-mass motor [s]. After one time constant, the motor has made 63 % of a change of level.
    rise_time: float = 0.04


class Haptics:
    """Vibration motors of the haptics node. `advance` updates the array `amplitude`, shape (8,), range 0 to 1."""

    def __init__(self, parameters: HapticsParameters, amplitude: Vector) -> None:
        self.amplitude = amplitude
        self._parameters = parameters
        self._in_reset = False

    def reset(self) -> None:
        """Keep the node in reset until the end of the next `advance`: its motors get no power."""
        self._in_reset = True

    def advance(self, level: Vector, silence: int, cycles: int) -> None:
        """Advance the amplitudes by a number of cycles.

        An amplitude a follows the exact solution of da/dt = (level - a) / rise_time.

        Args:
            level: last valid command, shape (8,), 0 to 1.
            silence: age of the last valid command [cycles].
            cycles: time to advance [cycles].
        """
        lag = math.exp(-cycles * PERIOD / self._parameters.rise_time)
        self.amplitude *= lag
        if silence < WATCHDOG and not self._in_reset:
            self.amplitude += (1.0 - lag) * level
        self._in_reset = False

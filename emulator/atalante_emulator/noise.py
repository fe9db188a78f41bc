"""What every sensor adds to the truth, drawn many cycles at a time."""

from __future__ import annotations

from typing import Final

import numpy as np
import numpy.typing as npt

from atalante_emulator.drive import Drives
from atalante_emulator.foot import Feet
from atalante_emulator.imu import Imus
from atalante_hal.wire.codec import Codec

Vector = npt.NDArray[np.float64]

#: Cycles drawn at once.
NOISE_CYCLES: Final = 128


class SensorNoise:
    """Noise of `NOISE_CYCLES` cycles, in the order of the codec's values."""

    def __init__(self, seed: int, codec: Codec, drives: Drives, imus: Imus, feet: Feet) -> None:
        self._noise = noise = np.zeros((NOISE_CYCLES, codec.size))
        self._drives, self._imus, self._feet = drives, imus, feet
        self._torque, self._gyro, self._accel, self._force = (
            noise[:, codec.slice(quantity)] for quantity in ("Torque", "Gyro", "Accel", "Force")
        )
        # One generator a family: another IMU model does not change what the feet feel.
        self._of_drives, self._of_imus, self._of_feet = (
            np.random.default_rng(s) for s in np.random.SeedSequence(seed).spawn(3)
        )
        self._bias = imus.draw_bias(self._of_imus)

    def add(self, cycle: int, truth: Vector, values: Vector) -> None:
        """What the sensors say in a cycle, in `values`: the truth and its noise. Shape (codec.size,)."""
        np.add(truth, self._noise[cycle % NOISE_CYCLES], values)

    def draw(self) -> None:
        """The next `NOISE_CYCLES` cycles."""
        self._drives.draw_noise(self._of_drives, self._torque)
        self._imus.draw_noise(self._of_imus, self._bias, self._gyro, self._accel)
        self._feet.draw_noise(self._of_feet, self._force)

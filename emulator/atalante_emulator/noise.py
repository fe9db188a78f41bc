"""Sensor noise of the emulated nodes. To save time, one call draws the noise of many cycles."""

from __future__ import annotations

from typing import Final

import numpy as np

from atalante_emulator.drive import Drives
from atalante_emulator.foot import Feet
from atalante_emulator.imu import Imus
from atalante_hal.types import PERIOD, Vector
from atalante_hal.wire.codec import Codec

#: Number of cycles covered by one call of `draw`.
NOISE_CYCLES: Final = 128


class SensorNoise:
    """Table of sensor noise: `NOISE_CYCLES` rows (one per cycle), and one column per signal of the codec."""

    def __init__(self, seed: int, codec: Codec, drives: Drives, imus: Imus, feet: Feet) -> None:
        noise = np.zeros((NOISE_CYCLES, codec.size))
        self._noise_of = list(noise)  # views of the rows
        self._drives, self._imus, self._feet = drives, imus, feet
        self._torque, self._gyro, self._accel, self._force = (
            noise[:, codec.slice(quantity)] for quantity in ("Torque", "Gyro", "Accel", "Force")
        )
        # Drives, IMUs and feet have separate generators, so that a change of the IMU model does not change the noise of the feet.
        self._of_drives, self._of_imus, self._of_feet, of_attitude = (
            np.random.default_rng(s) for s in np.random.SeedSequence(seed).spawn(4)
        )
        self._bias = imus.draw_bias(self._of_imus)
        self._attitude = imus.attitude_error(NOISE_CYCLES * PERIOD, of_attitude)
        self._quaternion = codec.slice("Quaternion")
        self._values: Vector | None = None  # array that the last call of `add` filled
        #: View of the IMU quaternions in `_values`, shape (IMUs, 4). If `add` gets another array, `add` renews the view.
        self._attitudes = np.zeros((0, 4))

    def add(self, cycle: int, truth: Vector, values: Vector) -> None:
        """Add the noise of a cycle to the true values.

        Args:
            cycle: number of the cycle.
            truth: values without noise, shape (codec.size,).
            values: output for the values with noise, shape (codec.size,).
        """
        np.add(truth, self._noise_of[cycle % NOISE_CYCLES], values)
        if self._attitude.active:
            if values is not self._values:
                self._values, self._attitudes = values, values[self._quaternion].reshape(-1, 4)
            self._attitude.apply(cycle % NOISE_CYCLES / NOISE_CYCLES, self._attitudes)

    def draw(self) -> None:
        """Draw the noise of the next `NOISE_CYCLES` cycles."""
        self._drives.draw_noise(self._of_drives, self._torque)
        self._imus.draw_noise(self._of_imus, self._bias, self._gyro, self._accel)
        self._feet.draw_noise(self._of_feet, self._force)
        if self._attitude.active:
            self._attitude.draw()

"""Correction of the estimated heading, which drifts during a walk because of the gyro bias.

`estimated heading, measured heading -> correction of the estimated heading`

The integral of a gyro shows changes of the heading precisely, but the bias of the gyro makes it drift without bound. A heading
reference, such as a magnetometer, has a bounded error, but this error is large and changes slowly. A Kalman filter therefore
estimates the bias of the gyro. Its state is

    d   error of the estimated heading [rad], d' = b + white noise; at the start the heading is 0 by definition, so d = 0
    b   bias of the gyro about the vertical [rad/s], b' = white noise
    o   constant offset of the measured heading [rad], because the measured heading at the start counts as 0 despite its error

The measurement is measured heading - estimated heading = o - d + error of the reference. The error of the reference changes
slowly: it has the standard deviation s and the correlation time T. A Kalman filter requires white measurement noise. With the
update interval t, white noise of the variance 2 s^2 T / t has the same spectral density at low frequencies as the error. The
filter uses this variance. After each update, the estimated heading is corrected by d.

A measurement that differs from its prediction by more than `outlier` standard deviations is not used, because iron near a
magnetometer can turn the measured heading by many degrees.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from atalante_hal.types import PERIOD


class HeadingConfig(NamedTuple):
    """Parameters of the heading filter."""

    reference: float = 0.004  # rad, standard deviation of the error of the heading reference (magnetometer)
    reference_time: float = 10.0  # s, correlation time of the error of the heading reference
    #: rad/sqrt(s), standard deviation of the integrated gyro noise after 1 s.
    #: The default corresponds to a noise density of 0.01 deg/s/sqrt(Hz).
    gyro_noise: float = 1.7e-4
    gyro_bias: float = 5.2e-5  # rad/s, standard deviation of the gyro bias at the start (0.003 deg/s)
    bias_walk: float = 1e-6  # rad/s/sqrt(s), standard deviation of the change of the gyro bias within 1 s
    #: Largest accepted difference between measured and predicted heading, in standard deviations.
    #: If this difference is larger, the measured heading is ignored.
    outlier: float = 5.0
    interval: int = 100  # cycles between two updates


class HeadingFilter:
    """Kalman filter that removes the drift of the estimated heading."""

    def __init__(self, config: HeadingConfig) -> None:
        """Compute the constant matrices of the filter.

        Args:
            config: parameters of the filter.
        """
        self._config, time = config, config.interval * PERIOD
        self._transition = np.array([[1.0, time, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
        self._process = np.diag([config.gyro_noise**2 * time, config.bias_walk**2 * time, 0.0])
        #: rad2, variance of the white noise that replaces the slow error of the heading reference, see the module docstring
        self._measurement_noise = 2.0 * config.reference**2 * config.reference_time / time
        self.reset()

    def reset(self) -> None:
        """Restart the filter. The present heading is defined as 0, so the estimated heading has no error at the start."""
        config = self._config
        self._state = np.zeros(3)
        self._covariance = np.diag([0.0, config.gyro_bias**2, config.reference**2])
        self._cycle = 0

    def correction(self, measured: float, estimated: float) -> float:
        """Return the angle by which the estimated heading must be turned in this cycle [rad].

        The filter is updated every `HeadingConfig.interval` cycles. In all other cycles, the result is 0.

        Args:
            measured: measured heading, relative to the measured heading at the start [rad].
            estimated: estimated heading [rad].
        """
        self._cycle += 1
        if self._cycle % self._config.interval:
            return 0.0
        state = self._transition @ self._state
        covariance = self._transition @ self._covariance @ self._transition.T + self._process
        difference = math.remainder(measured - estimated, math.tau)
        output = np.array([-1.0, 0.0, 1.0])
        surprise, variance = difference - output @ state, output @ covariance @ output
        if abs(surprise) <= self._config.outlier * math.sqrt(variance + self._config.reference**2):
            gain = covariance @ output / (variance + self._measurement_noise)
            state += gain * surprise
            covariance = covariance - np.outer(gain, output @ covariance)
        self._covariance = covariance
        drift, state[0] = float(state[0]), 0.0
        self._state = state
        return -drift

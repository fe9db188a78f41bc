"""Metabolism of the emulated patient: `muscle work, muscle torque -> metabolic rate -> O2, CO2 -> measured metabolic rate`.

The metabolic rate M is the rate of quiet standing plus the rate of the muscles of `patient.ActivePatient`:

    M = mass * standing + P+ / positive + P- / negative + activation * |u|

P+ is the power of muscles that shorten, P- the magnitude of the power of muscles that lengthen, |u| the sum of the magnitudes of
the muscle torques. The oxygen uptake and the carbon dioxide output follow the metabolic rate with first-order lags. The
respirometer measures oxygen uptake and carbon dioxide output with noise. From these measurements, `brockway` computes
the measured metabolic rate, as in the experiments of Gurriet et al. (RA-L 2020).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from atalante_hal.types import Vector

#: Factors of oxygen uptake and carbon dioxide output in the equation of the metabolic rate [J/l]:
#: metabolic rate [W] = OXYGEN * oxygen uptake [l/s] + CARBON_DIOXIDE * carbon dioxide output [l/s].
#: Brockway also subtracts a term for the nitrogen in the urine. This term is omitted here.
#: Source: Brockway, "Derivation of formulae used to calculate energy expenditure in man", Hum. Nutr. Clin. Nutr. 41C, 1987.
OXYGEN: Final = 16_580.0
CARBON_DIOXIDE: Final = 4_510.0
#: Sample period of all time series in this module [s].
SAMPLE: Final = 1.0


@dataclass(frozen=True)
class MetabolismParameters:
    """Parameters of metabolism and respirometer. Values without a source are assumptions."""

    #: Metabolic rate of quiet standing [W/kg].
    #: Source: walking equation of Looney et al., Med. Sci. Sports Exerc. 51, 2019.
    standing: float = 1.44
    #: Work that a shortening muscle does, divided by the metabolic energy: the muscle uses 4 J to do 1 J of work.
    #: Source: Margaria, Int. Z. Angew. Physiol. 25, 1968.
    positive: float = 0.25
    #: Work that a lengthening muscle absorbs, divided by the metabolic energy: the muscle uses 1 J to absorb 1.2 J.
    #: Source: Margaria 1968.
    negative: float = 1.20
    #: Metabolic rate of a muscle that holds a torque of 1 Nm without motion [W/Nm]: 0.054 * 10 rad/s.
    #: The largest possible joint speed is assumed to be 10 rad/s.
    #: Source of 0.054: Minetti, Alexander, J. Theor. Biol. 186, 1997.
    activation: float = 0.54
    quotient: float = 0.85  # respiratory exchange ratio, litres of CO2 per litre of O2
    oxygen_time: float = 30.0  # time constant of oxygen uptake after a change of the metabolic rate [s]
    carbon_dioxide_time: float = 60.0  # time constant of CO2 output [s], longer because body tissue stores CO2
    noise: float = 0.05  # standard deviation of each gas measurement, as a fraction of the true value


def metabolic_rate(
    positive: Vector, negative: Vector, torque: Vector, mass: float, parameters: MetabolismParameters | None = None
) -> Vector:
    """Return the metabolic rate [W] of a person who stands and uses muscles.

    Args:
        positive: power of shortening muscles, shape (n,) [W].
        negative: magnitude of the power of lengthening muscles, shape (n,) [W].
        torque: sum of the magnitudes of the muscle torques, shape (n,) [Nm].
        mass: mass of the person [kg].
        parameters: parameters of the metabolism. With None, the defaults are used.
    """
    p = parameters or MetabolismParameters()
    rate: Vector = p.standing * mass + positive / p.positive + negative / p.negative + p.activation * torque
    return rate


def treadmill_rate(speed: float, mass: float) -> float:
    """Return the metabolic rate [W] of a person who walks on a level treadmill without an exoskeleton.

    This is the equation 1.44 + 1.94 v^0.43 + 0.24 v^4 [W/kg] of Looney et al. (Med. Sci. Sports Exerc. 51, 2019), fitted to
    measurements of healthy adults. The motion of the legs is not simulated.

    Args:
        speed: walking speed [m/s].
        mass: mass of the person [kg].
    """
    return mass * (1.44 + 1.94 * math.pow(speed, 0.43) + 0.24 * math.pow(speed, 4.0))


def gas_exchange(
    rate: Vector, seed: int | Sequence[int] | None = None, parameters: MetabolismParameters | None = None
) -> tuple[Vector, Vector]:
    """Return oxygen uptake and carbon dioxide output as a respirometer measures them, each of shape (n,) [l/s].

    The person is in steady state at the first sample.

    Args:
        rate: metabolic rate in steps of `SAMPLE`, shape (n,) [W].
        seed: seed of the noise. With None, there is no noise.
        parameters: parameters of the metabolism. With None, the defaults are used.
    """
    p = parameters or MetabolismParameters()
    consumed = rate / (OXYGEN + p.quotient * CARBON_DIOXIDE)
    oxygen, carbon = _lagged(consumed, p.oxygen_time), _lagged(p.quotient * consumed, p.carbon_dioxide_time)
    if seed is not None:
        random = np.random.default_rng(seed)
        oxygen = oxygen * (1.0 + p.noise * random.standard_normal(len(rate)))
        carbon = carbon * (1.0 + p.noise * random.standard_normal(len(rate)))
    return oxygen, carbon


def brockway(oxygen: Vector, carbon_dioxide: Vector) -> Vector:
    """Return the metabolic rate [W] by the equation of Brockway (1987).

    Args:
        oxygen: oxygen uptake, shape (n,) [l/s].
        carbon_dioxide: carbon dioxide output, shape (n,) [l/s].
    """
    return OXYGEN * oxygen + CARBON_DIOXIDE * carbon_dioxide


def _lagged(series: Vector, time: float) -> Vector:
    """Apply a first-order lag to a time series. The lag starts in steady state at the first value."""
    keep, lagged = math.exp(-SAMPLE / time), series.copy()
    for i in range(1, len(series)):
        lagged[i] = keep * lagged[i - 1] + (1.0 - keep) * series[i]
    return lagged

"""Metabolic rate, gas exchange and the equation of Brockway, against values computed by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest

from atalante_emulator.metabolism import (
    MetabolismParameters,
    brockway,
    gas_exchange,
    metabolic_rate,
    treadmill_rate,
)


def test_metabolic_rate_is_the_sum_of_standing_work_and_activation() -> None:
    # 1.44 * 75 + 10 / 0.25 + 6 / 1.2 + 0.54 * 20 = 108 + 40 + 5 + 10.8
    rate = metabolic_rate(np.array([10.0, 0.0]), np.array([6.0, 0.0]), np.array([20.0, 0.0]), 75.0)
    np.testing.assert_allclose(rate, [163.8, 108.0])


def test_brockway_converts_litres_to_watts() -> None:
    # 16.58 kJ/l * 10 ml/s + 4.51 kJ/l * 8.5 ml/s = 165.8 W + 38.335 W
    np.testing.assert_allclose(brockway(np.array([0.0100]), np.array([0.0085])), [204.135])


def test_gas_exchange_in_steady_state_gives_back_the_metabolic_rate() -> None:
    rate = np.full(50, 163.8)
    oxygen, carbon = gas_exchange(rate)
    np.testing.assert_allclose(carbon / oxygen, 0.85)
    np.testing.assert_allclose(oxygen, 163.8 / (16_580.0 + 0.85 * 4_510.0))  # 8.02 ml/s
    np.testing.assert_allclose(brockway(oxygen, carbon), rate)


def test_oxygen_and_carbon_dioxide_follow_a_step_with_their_time_constants() -> None:
    rate = np.concatenate([[100.0], np.full(600, 200.0)])
    oxygen, carbon = gas_exchange(rate)
    risen = 1.0 - math.exp(-1.0)
    np.testing.assert_allclose(oxygen[30] / oxygen[0], 1.0 + risen, rtol=1e-9)
    np.testing.assert_allclose(carbon[60] / carbon[0], 1.0 + risen, rtol=1e-9)
    assert brockway(oxygen, carbon)[-1] == pytest.approx(200.0, rel=1e-3)


def test_noise_of_the_respirometer_depends_on_the_seed_alone() -> None:
    rate = np.full(2000, 100.0)
    one, same, other = (brockway(*gas_exchange(rate, seed)) for seed in (1, 1, 2))
    np.testing.assert_array_equal(one, same)
    assert not np.array_equal(one, other)
    # Oxygen carries 81.2 % of the energy, carbon dioxide 18.8 %.
    share = 16_580.0 / (16_580.0 + 0.85 * 4_510.0)
    assert one.std() == pytest.approx(100.0 * MetabolismParameters().noise * math.hypot(share, 1.0 - share), rel=0.1)
    assert one.mean() == pytest.approx(100.0, rel=0.01)


def test_walking_on_the_treadmill_costs_more_than_standing() -> None:
    # 75 kg at 0.2 m/s: 75 (1.44 + 1.94 * 0.50054 + 0.24 * 0.0016) W
    assert treadmill_rate(0.2, 75.0) == pytest.approx(180.86, abs=0.02)
    assert treadmill_rate(0.0, 75.0) == pytest.approx(75.0 * MetabolismParameters().standing)

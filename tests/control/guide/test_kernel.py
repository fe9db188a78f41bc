"""Guide kernel: the gate, the estimate of the state, and machine code against its source."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from atalante_control.guide.filter import GuideFilter
from atalante_control.guide.kernel import (
    BASE,
    COLUMNS,
    INVERSE,
    MASS,
    NEAR,
    SPEED,
    STEEPNESS,
    TAIL,
    TAIL_CYCLES,
    LegState,
    bound_blocks,
    damped_gate,
    gate,
    largest_ratio,
    leg_state,
    slide_maximum,
    tick,
    write_bounds,
)
from atalante_control.guide.prediction import FEW
from atalante_hal.compiled import compiled
from tests.control.guide.ideal_leg import controller

XI = 0.5


def state(e: tuple[float, float] = (0.0, 0.0), rate: tuple[float, float] = (0.0, 0.0), cycle: int = 300) -> LegState:
    leg = controller("constant").guide_at(XI).prediction.leg
    q, qd = leg.q[cycle], leg.qd[cycle]
    sent = 10.0, 5.0
    return LegState(*(q + e), *(qd + rate), *q, *sent, *leg.gravity[cycle])


@pytest.mark.parametrize("hip", [2, 8])
def test_leg_state_holds_the_measurements_of_sh_and_sk(hip: int):
    joint = np.arange(12.0)
    found = leg_state(hip, joint, joint + 100.0, joint + 200.0, joint + 300.0, (7.0, 2.0))
    both = (hip, hip + 1)
    pairs = [base + index for base in (0.0, 100.0, 200.0, 300.0) for index in both]
    assert found == LegState(*pairs, 7.0, 2.0)


@given(st.floats(-5.0, 1.0), st.floats(0.0, 1.0))
def test_gate_is_that_of_the_paper_between_0_and_1(h: float, xi: float):
    found = gate(h, xi)
    assert 0.0 <= found <= 1.0
    if 0.0 <= h <= 1.0:
        assert found == pytest.approx((1.0 + (xi**10 - 1.0) * h) ** 3, abs=1e-12)
    if h <= 0.0 or xi == 1.0:
        assert found == 1.0


@given(st.floats(0.0, 1.0), st.floats(-1e4, 1e4))
def test_damping_never_lowers_the_gate(value: float, rate: float):
    found = damped_gate(value, rate, 0.01)
    assert value <= found <= 1.0
    if rate >= 0.0:
        assert found == value


def every_ratio(guide: GuideFilter, cycle: int) -> list[float]:
    """Return the largest predicted ratio of error / width, torque / limit and speed / limit, without skipping any cycle ahead."""
    prediction, guard, step = guide.prediction, guide.tables.guards[0], guide.tables.step
    x, promise, start = guard.state, guard.promise, cycle // 4
    size = np.abs(np.concatenate([x[:2], x[2:4] - x[4:6], x[4:]]))
    lags = min(301, len(step) - cycle)
    e = (prediction.ahead @ (prediction.compress @ x))[:lags]
    reach = prediction.reach[start, :lags]
    d = np.repeat(prediction.slack @ size, 10, axis=0)[:lags] + reach[:, :2] + promise * reach[:, 2:]
    inverse, tail = step[cycle : cycle + lags, :4], step[cycle + lags - 1, 16:20]
    errors = [((d + e) * inverse[:, ::2]).max(), ((d - e) * inverse[:, 1::2]).max()]
    errors += [((d[-1] + e[-1]) * tail[::2]).max(), ((d[-1] - e[-1]) * tail[1::2]).max()]
    rows = FEW[FEW + cycle < len(step)]
    now, count = step[rows + cycle], len(rows)
    feedback, rate = (prediction.few_ahead[:count] @ x).reshape(count, 2, 2).swapaxes(0, 1)
    masses = now[:, [MASS, MASS + 1, MASS + 1, MASS + 2]].reshape(-1, 2, 2)
    torque = np.abs(now[:, BASE : BASE + 2] + np.einsum("nij,nj->ni", masses, feedback))
    speed = np.abs(now[:, SPEED : SPEED + 2] + rate)
    few = prediction.few_reach[start, :count]
    added = few[:, :4] + promise * few[:, 4:8]
    worst = speed + prediction.few_slack[:count] @ size + few[:, 8:10] + promise * few[:, 10:12]
    shares = [
        (torque + added[:, :2]).max() / guard.torque_limit,
        (speed + added[:, 2:]).max() / guard.speed_limit,
        worst.max() / guard.worst_speed_limit,
    ]
    return [max(0.0, *errors), *(1.0 - STEEPNESS * (1.0 - share) for share in shares)]


@pytest.mark.sample(3)
@pytest.mark.parametrize("shape", ["constant", "pinched", "asymmetric"])
def test_largest_ratio_is_that_of_all_predicted_cycles(shape: str):
    """The kernel skips cycles whose ratio cannot be the largest."""
    guide, rng, largest = controller(shape).guide_at(XI), np.random.default_rng(3), set()
    for cycle in [*rng.integers(0, 801, 40).tolist(), 0, 3, 499, 500, 600, 601, 800]:
        guide.start_step(XI, (0.02, -0.01), (0.1, 0.2), float(rng.uniform(0.0, 1.0)))
        guard = guide.tables.guards[0]
        scale = rng.choice([0.0, 0.1, 0.5, 2.0])
        guard.state[:] = scale * rng.normal(size=10) * np.repeat([0.07, 1.0, 1.0, 140.0, 140.0], 2)
        for limits in ((1e6, 1e6, 1e6), (20.0, 1e6, 1e6), (1e6, 0.5, 1e6), (1e6, 1e6, 0.5), (205.0, 3.8, 4.5)):
            guard.torque_limit, guard.speed_limit, guard.worst_speed_limit = limits
            ratios = every_ratio(guide, cycle)
            largest.add(int(np.argmax(ratios)))
            assert largest_ratio(guide.tables, cycle) == pytest.approx(max(ratios), rel=1e-12, abs=1e-12)
    assert largest == {0, 1, 2, 3}


def bounded(cycle: int, seed: int) -> tuple[GuideFilter, float]:
    """Return a filter after a prediction from a random state, and the largest ratio."""
    guide, rng = copied(controller("pinched").guide_at(XI)), np.random.default_rng(seed)
    guide.start_step(XI, (0.0, 0.0), (0.0, 0.0), 0.7)
    guard = guide.tables.guards[0]
    guard.torque_limit = guard.speed_limit = guard.worst_speed_limit = 1e6  # only the errors determine the ratio
    guard.state[:] = rng.normal(size=10) * np.repeat([0.05, 0.8, 0.8, 80.0, 80.0], 2)
    return guide, largest_ratio(guide.tables, cycle)


def copied(guide: GuideFilter) -> GuideFilter:
    """Return a filter with its own tables, which a test may change."""
    return GuideFilter(guide.config, guide.shape, guide.prediction, np.ones(3))


@pytest.mark.parametrize(("cycle", "blocks"), [(0, 31), (250, 31), (333, 31), (700, 21), (800, 11)])
def test_ratio_of_a_block_is_at_least_that_of_its_cycles(cycle: int, blocks: int):
    guide, _ = bounded(cycle, cycle)
    prediction, guard, step = guide.prediction, guide.tables.guards[0], guide.tables.step
    y, found = prediction.compress @ guard.state, [block.ratio for block in guide.tables.blocks[:blocks]]
    reach = prediction.reach[cycle // 4][:, :2] + 0.7 * prediction.reach[cycle // 4][:, 2:]
    slack = prediction.slack @ guard.magnitude
    assert int(np.argmax(found)) == bound_blocks(guide.tables, cycle, blocks)
    for number, bound in enumerate(found):
        lags = slice(10 * number, min(10 * number + 10, 301))
        inverse = step[cycle + lags.start : cycle + lags.stop, :4]
        e, d = (prediction.ahead[lags] @ y)[: len(inverse)], (slack[number] + reach[lags])[: len(inverse)]
        largest = max(((d + e) * inverse[:, ::2]).max(), ((d - e) * inverse[:, 1::2]).max())
        assert largest <= bound + 1e-12
        # The bound combines the largest disturbance and the narrowest guide of the block with the range of each table entry.
        low, high = prediction.ahead[lags].min(axis=0), prediction.ahead[lags].max(axis=0)
        middle, spread = 0.5 * (low + high) @ y, 0.5 * (high - low) @ np.abs(y)
        budget, promise = np.split(prediction.reach[cycle // 4][lags].max(axis=0), 2)
        most, narrow = slack[number] + budget + 0.7 * promise + spread, step[cycle + lags.start :][:10, :4].max(axis=0)
        expected = max(((most + middle) * narrow[::2]).max(), ((most - middle) * narrow[1::2]).max())
        assert bound == pytest.approx(expected, rel=1e-9)


def test_only_blocks_that_can_contain_the_largest_ratio_are_predicted():
    cycle, inner = 700, 20  # the last of the 21 blocks is always predicted
    guide, ratio = bounded(cycle, cycle)
    tables = guide.tables
    skipped = [number for number, block in enumerate(tables.blocks[:inner]) if block.ratio < ratio]
    assert 10 < len(skipped) < inner
    for number in skipped:
        tables.lags["ahead"][10 * number : 10 * number + 10] = 1e6
    assert largest_ratio(tables, cycle) == ratio
    for number in {*range(inner)} - {*skipped}:
        tables.lags["ahead"][10 * number : 10 * number + 10] = 1e6
    assert largest_ratio(tables, cycle) > ratio


def test_machine_code_gives_the_result_of_its_source(monkeypatch: pytest.MonkeyPatch):
    guide = controller("constant").guide_at(XI)
    guide.start_step(XI, (0.01, -0.01), (0.1, 0.1))
    tables = [guide.tables._replace(guards=guide.tables.guards.copy()) for _ in "ab"]
    for cycle in (0, 1, 2, 400, 401, 800):
        leg = state((0.02, -0.03), (0.3, 0.5), cycle)
        machine = compiled(tick)(tables[0], cycle, leg)
        np.testing.assert_allclose(machine, tick(tables[1], cycle, leg), rtol=1e-10)
        for name in ("h", "gate", "motor", "lag"):
            np.testing.assert_allclose(tables[0].guards[name], tables[1].guards[name], rtol=1e-10)


def test_gate_of_one_gives_the_backup_torque_and_gate_of_zero_the_free_torque():
    guide = controller("constant").guide_at(XI)
    guide.start_step(XI, (0.0, 0.0), (0.0, 0.0))
    far = guide.tick(300, state((0.2, 0.2)))
    assert guide.gate == 1.0
    assert guide.h < 0.0
    leg = guide.prediction.leg
    kv, dv = guide.prediction.policy.gains()
    row = guide.tables.step[300]
    mass = leg.masses(np.array(leg.q[300, 1] + 0.2))
    e, ed = np.array([0.2, 0.2]), leg.qd[300] - row[6:8]
    law = leg.inertia.velocity_torques(leg.q[300, 1] + 0.2, *leg.qd[300])
    friction = [leg.friction.torque(2 + i, leg.qd[300, i]) for i in (0, 1)]
    free = leg.gravity[300] + law + friction
    np.testing.assert_allclose(far, free + mass @ (row[4:6] - kv @ e - dv @ ed), rtol=1e-9)


def test_gate_falls_slowly_and_rises_at_once():
    guide = controller("constant").guide_at(XI)
    guide.start_step(XI, (0.0, 0.0), (0.0, 0.0))
    guide.tick(300, state((0.2, 0.2)))
    guide.tick(301, state(cycle=301))
    assert guide.gate == pytest.approx(1.0 - 1e-3 / guide.config.release)
    for cycle in range(302, 400):
        guide.tick(cycle, state(cycle=cycle))
    assert guide.gate < 0.9
    guide.tick(400, state((0.2, 0.2), cycle=400))
    assert guide.gate == 1.0


def test_gate_is_the_blend_at_the_start_of_a_step():
    guide = controller("constant").guide_at(XI)
    guide.start_step(XI, (0.0, 0.0), (0.0, 0.0))
    guide.tick(0, state(cycle=0))
    assert guide.gate == 1.0


def test_lag_of_the_measured_velocity_is_estimated_from_the_sent_torque():
    guide = controller("constant").guide_at(XI)
    guide.start_step(XI, (0.0, 0.0), (0.0, 0.0))
    loop = guide.prediction.assumptions.loop
    for cycle in range(300, 360):
        guide.tick(cycle, state(cycle=300))
    leg = guide.prediction.leg
    free = np.array(state(cycle=300)[8:10])
    free += leg.inertia.velocity_torques(leg.q[300, 1], *leg.qd[300])
    free += [leg.friction.torque(2 + i, leg.qd[300, i]) for i in (0, 1)]
    acceleration = np.linalg.solve(leg.masses(leg.q[300, 1]), np.array([10.0, 5.0]) - free)
    reference = guide.tables.step[345:358, 4:6].mean(axis=0)
    lag = guide.tables.guards[0].lag
    np.testing.assert_allclose(lag, (acceleration - reference) * loop.velocity_lag, rtol=0.1, atol=2e-3)
    assert math.isfinite(guide.h)


@pytest.mark.parametrize("cycles", [1, 2, 3, 10, 50, 61])
def test_sliding_maximum_is_that_of_each_row_and_the_following_rows(cycles: int):
    values = np.random.default_rng(cycles).uniform(size=(50, 3))
    found = values.copy()
    compiled(slide_maximum)(found, 1, 3, cycles)
    np.testing.assert_array_equal(found[:, 0], values[:, 0])
    expected = [values[row : row + cycles, 1:].max(axis=0) for row in range(len(values))]
    np.testing.assert_array_equal(found[:, 1:], expected)


def test_bounds_are_written_with_their_narrowest_places_ahead():
    bounds = np.random.default_rng(0).uniform(0.01, 0.1, size=(2, 100, 2))
    step = np.zeros((100, COLUMNS))
    compiled(write_bounds)(step, bounds)
    inverse = 1.0 / bounds.transpose(1, 0, 2).reshape(100, 4)
    np.testing.assert_array_equal(step[:, INVERSE : INVERSE + 4], inverse)
    for row in range(100):
        np.testing.assert_array_equal(step[row, NEAR : NEAR + 4], inverse[row : row + 10].max(axis=0))
        np.testing.assert_array_equal(
            step[row, TAIL : TAIL + 4], 1.03 * inverse[row : row + TAIL_CYCLES + 1].max(axis=0)
        )

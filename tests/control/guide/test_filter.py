"""Guide filter: exact flow compared with integration, properties of the gate, and invariance under disturbances.

The plant here is the one the filter assumes: two separate inertias, torque held over a cycle. What the coupled
exoskeleton does is the controller's test.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from atalante_control.gait.gait import AIRWALK_GAIT, PERIOD, bezier, derivative, load_gait
from atalante_control.gait.recentering import Deadbeat
from atalante_control.guide.backup_policy import BackupPolicy
from atalante_control.guide.certificate import HandOver, certify
from atalante_control.guide.filter import GuideConfig, GuideFilter
from atalante_control.guide.kernel import damped_gate, gate, tick
from atalante_control.guide.shapes import SHAPES, GuideShape, half_width
from atalante_hal.robot import load_robot

GAIT = load_gait(AIRWALK_GAIT, load_robot())
NOMINAL, FOLLOWING = GAIT.coefficients[2:4], GAIT.mirrored().coefficients[2:4]
DEADBEAT = Deadbeat(GAIT.duration, 0.4)
FEEDFORWARD = np.random.default_rng(5).normal(size=(2, 8)) * 15.0


def policy(inertia: float, rate: float, damping: float = 1.05, limit: float = math.inf) -> BackupPolicy:
    return BackupPolicy(inertia * rate**2, 2 * damping * inertia * rate, inertia, limit)


HIP, KNEE = policy(8.0, 28.0), policy(1.9, 44.0)
CONFIG = GuideConfig((HIP, KNEE), ((-30.0, 30.0), (-20.0, 20.0)))
LIMITED = replace(CONFIG, policies=(policy(8.0, 28.0, limit=160.0), policy(1.9, 44.0, limit=150.0)))
RINGING = replace(CONFIG, policies=(policy(8.0, 28.0, 0.3), policy(1.9, 44.0, 0.3)))


def guide(
    config: GuideConfig = CONFIG, shape: str = "constant", xi: float = 0.5, uf: np.ndarray | None = None
) -> GuideFilter:
    result = GuideFilter(config, SHAPES[shape], DEADBEAT, NOMINAL, FOLLOWING, uf)
    result.start_step(xi, (0.0, 0.0), (0.0, 0.0))
    return result


# -- the exact flow --------------------------------------------------------------------------------------------------


def integrated(
    config: GuideConfig,
    cycle: int,
    end: int,
    state: np.ndarray,
    moved: tuple[np.ndarray, np.ndarray] = (np.zeros(2), np.zeros(2)),
    uf: bool = False,
    substeps: int = 2,
) -> np.ndarray:
    """Return Runge-Kutta rollouts of e, with drive limits: shape (end - cycle + 1, joint, lower or upper extreme)."""
    j, kp, kd = (np.array([getattr(p, name) for p in config.policies])[:, None] for name in ("inertia", "kp", "kd"))
    limit = np.array([(1.0 - config.reserve) * p.torque_limit for p in config.policies])[:, None]
    push = np.array(config.disturbance)[:, ::-1]  # upper extreme first
    h = PERIOD / substeps

    def forcing(time: np.ndarray) -> np.ndarray:
        late = time > GAIT.duration
        q = [
            bezier(derivative(derivative(rows)), np.clip(t / GAIT.duration, 0.0, 1.0)) / GAIT.duration**2
            for rows, t in ((NOMINAL, time), (FOLLOWING, time - GAIT.duration))
        ]
        c0, c1 = DEADBEAT.basis(time)[2]
        q_des = np.where(late[:, None], q[1], q[0]) + np.outer(c0, moved[0]) + np.outer(c1, moved[1])
        ff = np.where(late[:, None], 0.0, bezier(FEEDFORWARD, np.minimum(time / GAIT.duration, 1.0))) * float(uf)
        return (ff / j[:, 0] - q_des)[:, :, None] + push / j

    def slope(x: np.ndarray, f: np.ndarray) -> np.ndarray:
        return np.stack([x[1], f + np.minimum(np.maximum(-kp * x[0] - kd * x[1], -limit), limit) / j])

    start = cycle * PERIOD + np.arange(substeps * (end - cycle)) * h
    stages = [forcing(start + inside) for inside in (1e-9, h / 2, h - 1e-9)]
    x = np.repeat(state[:, :, None], 2, axis=2)  # (e or e', joint, extreme)
    errors = [x[0]]
    for i, (f0, f1, f2) in enumerate(zip(*stages, strict=True), start=1):
        k1 = slope(x, f0)
        k2 = slope(x + h / 2 * k1, f1)
        k3 = slope(x + h / 2 * k2, f1)
        k4 = slope(x + h * k3, f2)
        x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
        if i % substeps == 0:
            errors.append(x[0])
    return np.array(errors)


@pytest.mark.parametrize("uf", [False, True], ids=["no feedforward", "feedforward"])
@pytest.mark.parametrize("cycle", [3, 400, 777])
def test_rollouts_agree_with_runge_kutta(cycle: int, uf: bool):
    deviation, rate = np.array([0.03, -0.05]), np.array([0.3, -0.6])
    state = np.array([[0.02, -0.03], [0.4, 0.9]])
    f = guide(uf=FEEDFORWARD if uf else None)
    f.start_step(0.5, tuple(deviation), tuple(rate))
    rolled = f.rollouts(cycle, state[0, 0], state[1, 0], state[0, 1], state[1, 1])
    points = f.grid[f.grid >= cycle]
    assert points[-1] == f.horizon
    expected = integrated(CONFIG, cycle, f.horizon, state, (deviation, rate), uf)[points - cycle]
    np.testing.assert_allclose(rolled[0], expected[:, 0, 0], atol=1e-6)
    np.testing.assert_allclose(rolled[1], -expected[:, 0, 1], atol=1e-6)
    np.testing.assert_allclose(rolled[2], expected[:, 1, 0], atol=1e-6)
    np.testing.assert_allclose(rolled[3], -expected[:, 1, 1], atol=1e-6)


def ratios(f: GuideFilter, cycle: int, errors: np.ndarray) -> np.ndarray:
    """Return the largest |e| / q_bound of each joint over the grid; `errors` has shape (cycles, joint, extreme)."""
    points = np.concatenate([[cycle], f.grid[f.grid >= cycle]])
    bounds = f.shape.bounds(f.time[points] / GAIT.duration, 0.5)
    at = errors[points - cycle]
    return np.maximum(at[:, :, 0] / bounds[:, :1], -at[:, :, 1] / bounds[:, 1:]).max(axis=0)


@pytest.mark.parametrize("shape", ["constant", "pinched", "asymmetric"])
@pytest.mark.parametrize("cycle", [0, 5, 402, 795, 800])
def test_h_is_one_minus_the_largest_ratio_squared(shape: str, cycle: int):
    f, state = guide(shape=shape), np.array([[0.01, -0.02], [-0.2, 0.4]])
    f.tick(cycle, state[0, 0], state[1, 0], state[0, 1], state[1, 1])
    expected = ratios(f, cycle, integrated(CONFIG, cycle, f.horizon, state))
    np.testing.assert_allclose(f.h, 1.0 - expected**2, atol=1e-4)
    assert f.stepped == 0


def test_h_of_a_saturating_drive_matches_the_limited_loop():
    rng = np.random.default_rng(12)
    worst_excess = 0.0
    for cycle in (0, 210, 333, 600):
        f = guide(LIMITED, "pinched")
        for _ in range(3):
            state = np.stack([rng.uniform(-0.06, 0.06, 2), rng.uniform(-0.8, 0.8, 2)])
            f.tick(cycle, state[0, 0], state[1, 0], state[0, 1], state[1, 1])
            stepped = 1.0 - ratios(f, cycle, integrated(LIMITED, cycle, f.horizon, state, substeps=1)) ** 2
            for joint in (0, 1):
                if stepped[joint] > -1.0:
                    # h is at most that of the limited loop, and slightly smaller because of grid and linear bound.
                    assert f.h[joint] <= stepped[joint] + 0.01
                    worst_excess = max(worst_excess, stepped[joint] - f.h[joint])
                else:
                    assert f.h[joint] < 0.0
    assert f.stepped > 0
    assert worst_excess < 0.05


def test_weak_drive_makes_a_safe_state_unsafe():
    """The same state is safe with an ideal drive and unsafe with a weak drive."""
    state = (200, 0.045, 0.9, 0.0, 0.0)
    ideal, weak = guide(), guide(replace(LIMITED, policies=(policy(8.0, 28.0, limit=80.0), KNEE)))
    ideal.tick(*state)
    weak.tick(*state)
    assert ideal.h[0] > 0.0 > weak.h[0]


def test_feedforward_in_the_rollout_increases_h():
    """With the feedforward of the nominal motion, P vanishes, so h is not too small."""
    needed = bezier(derivative(derivative(NOMINAL)), np.linspace(0, 1, 801)) / GAIT.duration**2 * [8.0, 1.9]
    basis = bezier(np.eye(8), np.linspace(0, 1, 801))
    f = guide(uf=np.linalg.lstsq(basis, needed, rcond=None)[0].T)
    blind = guide()
    for cycle in range(0, 800, 50):
        f.tick(cycle, 0.0, 0.0, 0.0, 0.0)
        blind.tick(cycle, 0.0, 0.0, 0.0, 0.0)
        assert min(f.h) >= min(blind.h) - 1e-12
    assert np.abs(f.solution()[:780]).max() < 1e-3


# -- the gate --------------------------------------------------------------------------------------------------------

H, XI = st.floats(-1e6, 1.0), st.floats(0.0, 1.0)


@given(H, XI, st.floats(-1e9, 1e9), st.floats(0.0, 1.0))
def test_gates_are_between_zero_and_one(h: float, xi: float, rate: float, zeta: float):
    weight = gate(h, xi)
    assert 0.0 <= weight <= 1.0
    assert weight <= damped_gate(weight, rate, zeta) <= 1.0


@given(XI)
def test_gate_follows_the_paper_inside_and_is_one_outside(xi: float):
    for h in (0.1, 0.5, 0.9, 1.0):
        assert gate(h, xi) == pytest.approx((1.0 + (xi**10 - 1.0) * h) ** 3)
    assert gate(0.0, xi) == gate(-3.0, xi) == gate(-1e9, xi) == 1.0


@given(H)
def test_full_assistance_applies_the_full_backup_policy(h: float):
    assert gate(h, 1.0) == 1.0


@given(st.floats(-1.0, 1.0), st.floats(-1.0, 1.0), XI)
def test_gate_increases_as_h_falls(a: float, b: float, xi: float):
    assert gate(min(a, b), xi) >= gate(max(a, b), xi)


@given(st.floats(-1.0, 1.0), st.floats(0.0, 0.999))
def test_gate_is_continuous_in_h_and_in_xi(h: float, xi: float):
    assert abs(gate(h + 1e-6, xi) - gate(h, xi)) < 1e-5
    assert abs(gate(h, xi + 1e-6) - gate(h, xi)) < 1e-4


@given(st.floats(0.0, 1.0), st.floats(0.0, 100.0))
def test_a_rising_h_adds_no_damping(weight: float, rate: float):
    assert damped_gate(weight, rate, 0.03) == weight


def test_derivative_term_acts_when_h_falls_and_not_across_a_step_change():
    f = guide()
    for cycle in range(50):
        f.tick(cycle, 0.0008 * cycle, 0.8, 0.0, 0.0)
    assert f.gates[0] > gate(f.h[0], 0.5) + 0.01
    f.start_step(0.5, (0.0, 0.0), (0.0, 0.0))
    f.tick(0, 0.0, 0.0, 0.0, 0.0)
    assert f.gates[0] == gate(f.h[0], 0.5)


@given(st.integers(0, 800), *[st.floats(-0.2, 0.2), st.floats(-4.0, 4.0)] * 2)
@settings(max_examples=60)
def test_torque_is_the_gated_backup_torque(cycle: int, e1: float, ed1: float, e2: float, ed2: float):
    f = SHARED
    u = f.tick(cycle, e1, ed1, e2, ed2)
    for joint, (e, ed) in enumerate(((e1, ed1), (e2, ed2))):
        p = LIMITED.policies[joint]
        backup = max(-p.torque_limit, min(p.torque_limit, -p.kp * e - p.kd * ed))
        assert u[joint] == pytest.approx(f.gates[joint] * backup)
        if f.h[joint] <= 0.0:
            assert u[joint] == pytest.approx(backup)


SHARED = guide(LIMITED)


def test_middle_of_the_guide_gets_almost_no_torque():
    f = guide(replace(CONFIG, disturbance=((-5.0, 5.0), (-2.0, 2.0))))
    for cycle in (300, 790):
        u = f.tick(cycle, 0.0, 0.0, 0.0, 0.0)
        assert max(f.gates) < 1e-3
        assert max(map(abs, u)) < 0.1


def test_tick_on_the_tables_gives_the_torque_of_the_filter():
    asked, ticked = guide(), guide()
    errors = 0.03, 0.4, -0.02, -0.3
    torque = asked.tick(100, *errors)
    assert tick(ticked.tables, 100, *errors) == torque != (0.0, 0.0)
    assert (ticked.h, ticked.gates, ticked.bounds) == (asked.h, asked.gates, asked.bounds)


def test_tick_after_the_end_of_a_step_uses_its_last_cycle():
    f = guide()
    f.tick(800, 0.01, 0.1, 0.0, 0.0)
    end = list(f.h)
    f.tick(850, 0.01, 0.1, 0.0, 0.0)
    assert f.h == end


def test_one_sided_disturbances_affect_only_their_side():
    both, up, down = (
        guide(replace(CONFIG, disturbance=((low, high), (low, high))))
        for low, high in ((-300.0, 300.0), (0.0, 300.0), (-300.0, 0.0))
    )
    for e in (0.03, -0.03):
        for f in (both, up, down):
            f.tick(700, e, 0.0, e, 0.0)
        assert both.h == [min(u, d) for u, d in zip(up.h, down.h, strict=True)]
        assert up.h != down.h
    f = guide(shape="asymmetric")
    f.tick(790, 0.03, 0.0, 0.0, 0.0)
    above = f.h[0]
    f.tick(790, -0.03, 0.0, 0.0, 0.0)
    assert f.h[0] < above


def test_ringing_loop_includes_the_worst_switching_disturbance():
    f = guide(RINGING)
    f.tick(0, 0.0, 0.0, 0.0, 0.0)
    extremes = ratios(f, 0, integrated(RINGING, 0, f.horizon, np.zeros((2, 2))))
    assert (np.array(f.h) < 1.0 - extremes**2 - 1e-3).all()


@pytest.mark.parametrize(
    "bad",
    [
        {"disturbance": ((1.0, 2.0), (-1.0, 1.0))},
        {"disturbance": ((-1.0, float("inf")), (-1.0, 1.0))},
        {"disturbance": ((-1.0, 1.0), (-float("inf"), 1.0))},
        {"disturbance": ((-1.0, 1.0), (-2.0, -1.0))},
        {"disturbance": ((math.nan, 1.0), (-1.0, 1.0))},
        {"disturbance": ((-1.0, 1.0), (-1.0, math.nan))},
        {"disturbance": ((30.0, -30.0), (-1.0, 1.0))},
        {"points": 1},
        {"zeta": -1.0},
        {"zeta": float("nan")},
        {"overlap": -1e-9},
        {"overlap": float("inf")},
        {"derivative_time": -1e-9},
        {"reserve": -1e-9},
        {"reserve": 1.0},
        {"reserve": float("nan")},
    ],
)
def test_invalid_configuration_is_rejected(bad: dict[str, object]):
    (name,) = bad
    with pytest.raises(ValueError, match=rf"{name}.* got "):
        replace(CONFIG, **bad)


@pytest.mark.parametrize("value", [-1.0, 0.0, math.nan])
def test_filter_rejects_a_shape_with_an_invalid_bound_in_a_cycle(value: float):
    """The bound is invalid only at phase 333 / 800, between the phases checked by GuideShape, and not at Xi = 0."""

    def fractions(phase: np.ndarray, width: float) -> tuple[np.ndarray, np.ndarray]:
        bad = (np.abs(phase - 0.41625) < 1e-5) & (width < half_width(0.4))
        return np.where(bad, value, 1.0), np.ones_like(phase)

    shape = GuideShape("between", "", fractions)
    with pytest.raises(ValueError, match=r"'between' must be finite and at least .* at phase 0\.4163"):
        GuideFilter(CONFIG, shape, DEADBEAT, NOMINAL, FOLLOWING)


def test_start_step_rejects_a_shape_with_an_invalid_bound():
    shape = GuideShape(
        "factor", "", lambda p, w: (np.full_like(p, 0.0 if abs(w - half_width(0.512)) < 1e-9 else 1.0), np.ones_like(p))
    )
    f = GuideFilter(CONFIG, shape, DEADBEAT, NOMINAL, FOLLOWING)
    f.start_step(0.5, (0.0, 0.0), (0.0, 0.0))
    with pytest.raises(ValueError, match=r"'factor' must be .* and Xi 0\.512"):
        f.start_step(0.512, (0.0, 0.0), (0.0, 0.0))
    assert (f.tables.step[:, :, 4:] > 0.0).all()


@pytest.mark.parametrize(
    "good",
    [
        {"disturbance": ((0.0, 0.0), (-1.0, 0.0))},
        {"points": 2},
        {"zeta": 0.0},
        {"overlap": 0.0},
        {"derivative_time": 0.0},
        {"reserve": 0.0},
    ],
)
def test_limits_of_the_configuration_are_accepted(good: dict[str, object]):
    (name,) = good
    assert getattr(replace(CONFIG, **good), name) == good[name]


# -- invariance ------------------------------------------------------------------------------------------------------

Push = Callable[[int, np.ndarray, np.ndarray], np.ndarray]
LOW, HIGH = np.array(CONFIG.disturbance).T


def pushes(seed: int) -> dict[str, Push]:
    rng = np.random.default_rng(seed)
    state = {"u": HIGH.copy(), "left": np.zeros(2)}

    def random(cycle: int, e: np.ndarray, ed: np.ndarray) -> np.ndarray:
        for joint in (0, 1):
            if state["left"][joint] <= 0:
                state["u"][joint], state["left"][joint] = rng.choice([LOW[joint], HIGH[joint]]), rng.integers(1, 150)
        state["left"] -= 1
        return state["u"]

    return {
        "up": lambda k, e, ed: HIGH,
        "down": lambda k, e, ed: LOW,
        "alternating": lambda k, e, ed: HIGH if k // 60 % 2 else LOW,
        "outwards": lambda k, e, ed: np.where(e > 0.0, HIGH, LOW),
        "with the motion": lambda k, e, ed: np.where(ed > 0.0, HIGH, LOW),
        "swing": lambda k, e, ed: np.where(e + 0.02 * ed > 0.0, HIGH, LOW),
        "late": lambda k, e, ed: np.where(ed > 0.0, HIGH, LOW) if k > 700 or k < 80 else np.zeros(2),
        "random": random,
    }


def walk(config: GuideConfig, shape: GuideShape, push: Push, hand_over: HandOver, steps: int, seed: int = 0) -> float:
    """Return the largest |e| / q_bound over steps that start at random corners of the hand-over box."""
    f = GuideFilter(config, shape, DEADBEAT, NOMINAL, FOLLOWING)
    inertia = np.array([p.inertia for p in config.policies])
    time = np.arange(801) * PERIOD
    phase = time / GAIT.duration
    q_nom, qd_nom = bezier(NOMINAL, phase), bezier(derivative(NOMINAL), phase) / GAIT.duration
    (c0, c1), (c0d, c1d), _ = DEADBEAT.basis(time)
    bounds = shape.bounds(phase, 0.5)
    corners = np.array(list(itertools.product((-1.0, 1.0), repeat=4)))
    rng, worst = np.random.default_rng(seed), 0.0
    for _ in range(steps):
        box = rng.choice(corners).reshape(2, 2) * [[hand_over.deviation], [hand_over.rate]]
        deviation, rate = box
        q_des = q_nom + np.outer(c0, deviation) + np.outer(c1, rate)
        qd_des = qd_nom + np.outer(c0d, deviation) + np.outer(c1d, rate)
        q, qd = q_nom[0] + deviation, qd_nom[0] + rate
        f.start_step(0.5, tuple(deviation), tuple(rate))
        for cycle in range(801):
            e, ed = q - q_des[cycle], qd - qd_des[cycle]
            worst = max(worst, float(np.maximum(e / bounds[cycle, 0], -e / bounds[cycle, 1]).max()))
            u = np.array(f.tick(cycle, float(e[0]), float(ed[0]), float(e[1]), float(ed[1])))
            a = (u + push(cycle, e, ed)) / inertia
            q, qd = q + qd * PERIOD + 0.5 * a * PERIOD**2, qd + a * PERIOD
    return worst


CERTIFIED = ["constant", "widening", "narrowing", "pinched", "asymmetric"]
BOX = HandOver()


@pytest.mark.exhaustive
@pytest.mark.parametrize("kind", list(pushes(0)))
@pytest.mark.parametrize("shape", CERTIFIED)
def test_certified_guide_is_never_left(shape: str, kind: str):
    assert certify(guide(LIMITED, shape), 0.5, BOX).certified
    assert walk(LIMITED, SHAPES[shape], pushes(3)[kind], BOX, 3) <= 1.0


@pytest.mark.exhaustive
@pytest.mark.parametrize("kind", ["swing", "random", "with the motion"])
def test_certified_guide_of_a_ringing_loop_is_never_left(kind: str):
    assert certify(guide(RINGING), 0.5, BOX).certified
    assert walk(RINGING, SHAPES["constant"], pushes(4)[kind], BOX, 2) <= 1.0


@pytest.mark.exhaustive
def test_uncertified_guide_is_left():
    weak = replace(CONFIG, policies=(policy(8.0, 14.0), policy(1.9, 14.0)))
    for config, shape in ((weak, "pinched"), (LIMITED, "snap")):
        assert not certify(guide(config, shape), 0.5, BOX).certified
        assert walk(config, SHAPES[shape], pushes(0)["outwards"], BOX, 1) > 1.0

"""Torque limiter: it keeps all limits, changes no torque within them, and reduces no braking torque."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from atalante_hal.robot import JOINTS, load_robot
from atalante_hal.safety.limiter import DELAY, SMALLEST_INERTIA, Limited, Limiter, highest_torque

ROBOT = load_robot()
PERIOD = 1e-3
STEP = ROBOT.torque_rate_max * PERIOD
MIDDLE = (ROBOT.position_min + ROBOT.position_max) / 2.0
AT_REST = np.array([MIDDLE, np.zeros(12)])
INERTIA = np.array(SMALLEST_INERTIA * 2)
LOOK, PAST, FASTER = ROBOT.envelope.look_ahead, ROBOT.envelope.position_margin, ROBOT.envelope.velocity_margin
FREE, CUT, REFUSED = Limited(True, False), Limited(True, True), Limited(False, False)

commands = arrays(np.float64, 12, elements=st.floats(width=64))
finite_commands = arrays(np.float64, 12, elements=st.floats(-500.0, 500.0))
motions = st.tuples(
    arrays(np.float64, 12, elements=st.floats(-2.5, 2.5)), arrays(np.float64, 12, elements=st.floats(-8.0, 8.0))
).map(np.array)
joints = pytest.mark.parametrize("joint", range(12), ids=JOINTS)


def limiter_at(torque: np.ndarray) -> Limiter:
    limiter = Limiter(ROBOT, PERIOD)
    limiter.restart(torque)
    return limiter


def moving(joint: int, position: float, velocity: float = 0.0) -> np.ndarray:
    motion = AT_REST.copy()
    motion[:, joint] = position, velocity
    return motion


def only(joint: int, value: float) -> np.ndarray:
    vector = np.zeros(12)
    vector[joint] = value
    return vector


def share(beyond: np.ndarray) -> np.ndarray:
    return 1.0 - np.clip(beyond, 0.0, 1.0)


def reach(motion: np.ndarray, limit: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the largest positive and negative torque, computed as the docstring of the limiter defines them."""
    q, v = motion
    ahead = q + LOOK * v
    up = np.minimum(share((ahead - ROBOT.position_max) / PAST), share((v - ROBOT.velocity_max) / FASTER))
    down = np.minimum(share((ROBOT.position_min - ahead) / PAST), share((-v - ROBOT.velocity_max) / FASTER))
    return up * limit, down * limit


class Prediction:
    """Limits U of both directions, computed from the inputs of the limiter by bisection of the inequality in its docstring."""

    def __init__(self, torque: np.ndarray) -> None:
        self.sent = [torque.copy()] * DELAY
        self.velocities: list[np.ndarray] = []
        self.fast: list[np.ndarray] = []

    def reach(self, velocity: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        keep = np.exp(-2.0 * np.pi * ROBOT.sensors.velocity_bandwidth * PERIOD)
        fast = (velocity - keep * self.velocities[-1]) / (1.0 - keep) if self.velocities else velocity.copy()
        acceleration = (fast - self.fast[-1]) / PERIOD if self.fast else np.zeros(12)
        self.velocities.append(velocity.copy())
        self.fast.append(fast)
        up, down = (
            self._largest(sign * self.sent[-DELAY], sign * acceleration, ROBOT.velocity_max - sign * fast)
            for sign in (1.0, -1.0)
        )
        return up, down

    @staticmethod
    def _largest(oldest: np.ndarray, acceleration: np.ndarray, room: np.ndarray) -> np.ndarray:
        low, high = np.zeros(12), np.full(12, 1000.0)
        for _ in range(80):
            u = 0.5 * (low + high)
            gained = acceleration + np.maximum(0.0, u - oldest) / INERTIA
            allowed = gained * (DELAY * PERIOD + u / (2.0 * ROBOT.torque_rate_max)) <= np.maximum(0.0, room)
            low, high = np.where(allowed, u, low), np.where(allowed, high, u)
        return low


@given(st.lists(st.tuples(commands, motions), min_size=1, max_size=20))
@example([(np.full(12, 1.7e308), AT_REST), (np.full(12, -1.7e308), AT_REST)])
def test_every_command_is_limited_as_documented(cycles: list[tuple[np.ndarray, np.ndarray]]):
    limiter = Limiter(ROBOT, PERIOD)
    saturated = 0
    prediction = Prediction(limiter.last)
    for command, motion in cycles:
        before, copy = limiter.last.copy(), command.copy()
        result = limiter.apply(command, motion)
        assert command.tobytes() == copy.tobytes()
        u = limiter.last
        if not np.isfinite(command).all():
            assert result == REFUSED
            assert u.tobytes() == before.tobytes()
            continue
        tiny = 1e-6
        predicted = prediction.reach(motion[1])
        prediction.sent.append(u.copy())
        up, down = (np.minimum(*both) for both in zip(reach(motion, ROBOT.torque_max), predicted, strict=True))
        assert (np.abs(u) <= ROBOT.torque_max).all()
        assert (np.abs(u - before) <= STEP + tiny).all()
        assert (u <= np.maximum(up, before - STEP) + tiny).all()
        assert (-u <= np.maximum(down, -before - STEP) + tiny).all()
        # The torque is not reduced by more than these limits require.
        low = np.clip(-down, before - STEP, before + STEP)
        high = np.clip(up, before - STEP, before + STEP)
        assert np.allclose(u, np.minimum(np.maximum(command, low), high), rtol=0.0, atol=tiny)
        assert result == (CUT if (u != command).any() else FREE)
        assert np.array_equal(limiter.cut, u != command)
        saturated = saturated + 1 if result.clamped else 0
        assert limiter.saturated == saturated


@given(finite_commands, motions, arrays(np.float64, 12, elements=st.floats(0.0, 400.0)))
def test_each_joint_torque_within_its_limits_is_unchanged(command: np.ndarray, motion: np.ndarray, limit: np.ndarray):
    limiter = limiter_at(np.clip(command, -limit, limit))
    limiter.derate(limit)
    up, down = reach(motion, np.minimum(limit, ROBOT.torque_max))
    inside = np.clip(command, np.maximum(-down, limiter.last - STEP), np.minimum(up, limiter.last + STEP))
    inside = np.where((inside <= up) & (inside >= -down), inside, limiter.last)
    before = limiter.last.copy()
    limiter.apply(inside, motion)
    touched = limiter.last.view(np.int64) != inside.view(np.int64)
    allowed = (np.abs(inside) <= limiter.limit) & (inside <= up) & (-inside <= down) & (np.abs(inside - before) <= STEP)
    assert not (touched & allowed).any()


shares = arrays(np.float64, 12, elements=st.floats(-1.0, 1.0))


@given(shares, shares, shares, shares, arrays(np.float64, 12, elements=st.floats(0.1, 1.0)))
def test_command_within_every_limit_is_sent_unchanged(
    torque: np.ndarray, step: np.ndarray, velocity: np.ndarray, position: np.ndarray, derated: np.ndarray
):
    """The torque reaches its derated limit. Position, predicted velocity and torque rate reach 99 % of their limits."""
    limiter = Limiter(ROBOT, PERIOD)
    limiter.derate(derated * ROBOT.torque_max)
    requested = torque * limiter.limit
    limiter.restart(requested + 0.99 * step * STEP)
    fall = ROBOT.torque_max / (2.0 * ROBOT.torque_rate_max)
    speed = 0.99 * velocity * (ROBOT.velocity_max - STEP / INERTIA * (DELAY * PERIOD + fall))
    half = (ROBOT.position_max - ROBOT.position_min) / 2.0
    ahead = MIDDLE + 0.99 * position * half
    assert limiter.apply(requested, np.array([ahead - LOOK * speed, speed])) == FREE
    assert limiter.last.tobytes() == requested.tobytes()
    assert limiter.cut.tolist() == [False] * 12
    assert limiter.saturated == 0


def test_command_within_the_limits_is_unchanged_for_1000_cycles():
    limiter = Limiter(ROBOT, PERIOD)
    rng = np.random.default_rng(0)
    torque = np.zeros(12)
    for _ in range(1000):
        torque = np.clip(torque + rng.uniform(-0.45, 0.45, 12) * STEP, -ROBOT.torque_max, ROBOT.torque_max)
        assert limiter.apply(torque, AT_REST) == FREE
        assert limiter.last.tobytes() == torque.tobytes()


@joints
@pytest.mark.parametrize("sign", [1.0, -1.0])
class TestTightThresholds:
    """A torque just below its limit is unchanged. If one torque is just above its limit, only this torque is reduced."""

    def expect(self, limiter: Limiter, torque: np.ndarray, motion: np.ndarray, cut: int | None) -> None:
        assert limiter.apply(torque, motion) == (FREE if cut is None else CUT)
        assert np.flatnonzero(limiter.cut).tolist() == ([] if cut is None else [cut])

    def test_torque_above_its_limit_is_cut(self, joint: int, sign: float):
        largest = ROBOT.torque_max[joint]
        at = only(joint, sign * largest)
        self.expect(limiter_at(at), at, AT_REST, None)
        for factor, velocity in ((1.0 + 1e-12, 0.0), (1.001, -sign), (1.001, sign)):
            over = limiter_at(at)
            self.expect(over, at * factor, moving(joint, MIDDLE[joint], velocity), joint)
            assert over.last[joint] == sign * largest

    def test_torque_above_the_derated_limit_is_cut(self, joint: int, sign: float):
        limiter = limiter_at(np.zeros(12))
        limit = ROBOT.torque_max.copy()
        limit[joint] = 7.0
        limiter.derate(limit)
        assert limiter.limit.tobytes() == limit.tobytes()
        self.expect(limiter, only(joint, sign * 7.0), AT_REST, None)
        self.expect(limiter, only(joint, sign * 7.0001), AT_REST, joint)
        assert limiter.last[joint] == sign * 7.0

    def test_torque_change_above_the_rate_limit_is_cut(self, joint: int, sign: float):
        step = STEP[joint]
        self.expect(limiter_at(np.zeros(12)), only(joint, sign * step), AT_REST, None)
        self.expect(limiter_at(only(joint, sign)), only(joint, sign * (1.0 - step)), AT_REST, None)
        for before, after in ((1.0, 1.001 + step), (-0.6 * step, 0.6 * step), (-1.5 * step, -0.25 * step)):
            over = limiter_at(only(joint, sign * before))
            self.expect(over, only(joint, sign * after), AT_REST, joint)
            assert over.last[joint] == pytest.approx(sign * (before + step))

    def test_torque_beyond_the_position_limit_is_cut(self, joint: int, sign: float):
        limit = (ROBOT.position_max if sign > 0 else ROBOT.position_min)[joint]
        full = only(joint, sign * ROBOT.torque_max[joint])
        self.expect(limiter_at(full), full, moving(joint, limit), None)
        beyond = limiter_at(full)
        self.expect(beyond, full, moving(joint, limit + sign * 1e-6), joint)
        assert sign * beyond.last[joint] == pytest.approx(ROBOT.torque_max[joint] * (1.0 - 1e-6 / PAST))

    def test_torque_towards_a_predicted_limit_violation_is_cut(self, joint: int, sign: float):
        limit = (ROBOT.position_max if sign > 0 else ROBOT.position_min)[joint]
        full = only(joint, sign * ROBOT.torque_max[joint])
        self.expect(limiter_at(full), full, moving(joint, limit - sign * (LOOK + 1e-9), sign), None)
        self.expect(limiter_at(full), full, moving(joint, limit - sign * (LOOK - 1e-6), sign), joint)
        self.expect(limiter_at(full), full, moving(joint, limit + sign * 0.9 * LOOK, -sign), None)

    def test_torque_above_the_velocity_limit_is_cut(self, joint: int, sign: float):
        fastest = sign * ROBOT.velocity_max[joint]
        full = only(joint, sign * ROBOT.torque_max[joint])
        self.expect(limiter_at(full), full, moving(joint, MIDDLE[joint], fastest), None)
        over = limiter_at(full)
        self.expect(over, full, moving(joint, MIDDLE[joint], fastest + sign * 1e-4), joint)
        assert sign * over.last[joint] == pytest.approx(ROBOT.torque_max[joint] * (1.0 - 1e-4 / FASTER))

    def test_last_torque_does_not_disable_position_and_velocity_limits(self, joint: int, sign: float):
        limit = (ROBOT.position_max if sign > 0 else ROBOT.position_min)[joint]
        fastest = ROBOT.velocity_max[joint] + FASTER
        for motion, before in (
            (moving(joint, MIDDLE[joint], sign * fastest), fastest),
            (moving(joint, limit + sign * PAST), abs(limit) + PAST),
        ):
            limiter = limiter_at(only(joint, -sign * before))
            self.expect(limiter, only(joint, sign), motion, joint)
            assert limiter.last[joint] == pytest.approx(0.0, abs=1e-9)

    @pytest.mark.parametrize("part", [0.25, 0.5, 1.0, 2.0])
    def test_torque_falls_to_zero_at_the_end_of_the_margin(self, joint: int, sign: float, part: float):
        limit = (ROBOT.position_max if sign > 0 else ROBOT.position_min)[joint]
        for motion in (
            moving(joint, limit + sign * part * PAST),
            moving(joint, MIDDLE[joint], sign * (ROBOT.velocity_max[joint] + part * FASTER)),
        ):
            limiter = limiter_at(only(joint, sign * ROBOT.torque_max[joint]))
            for _ in range(20):
                limiter.apply(only(joint, sign * ROBOT.torque_max[joint]), motion)
            assert sign * limiter.last[joint] == pytest.approx(max(0.0, 1.0 - part) * ROBOT.torque_max[joint])

    def test_torque_of_a_free_joint_is_cut_before_the_joint_is_fast(self, joint: int, sign: float):
        """A joint with 1.5 times the smallest inertia stays below 1.2 times its velocity limit at the full torque request."""
        limiter, torques, velocity, filtered, highest = limiter_at(np.zeros(12)), [0.0], 0.0, 0.0, 0.0
        keep = np.exp(-2.0 * np.pi * ROBOT.sensors.velocity_bandwidth * PERIOD)
        for _ in range(60):
            before = velocity
            velocity += torques[-1] / (1.5 * INERTIA[joint]) * PERIOD
            filtered = keep * filtered + (1.0 - keep) * 0.5 * (velocity + before)
            highest = max(highest, abs(velocity))
            limiter.apply(only(joint, sign * 1e3), moving(joint, MIDDLE[joint], filtered))
            torques.append(float(limiter.last[joint]))
        assert 0.6 * ROBOT.velocity_max[joint] < highest < 1.2 * ROBOT.velocity_max[joint]

    def test_accelerating_joint_is_cut_and_restart_forgets_the_acceleration(self, joint: int, sign: float):
        full = only(joint, sign * ROBOT.torque_max[joint])
        fast, rate = 0.5 * sign * ROBOT.velocity_max[joint], 0.2 * sign * ROBOT.velocity_max[joint]
        limiter = limiter_at(full)
        self.expect(limiter, full, moving(joint, MIDDLE[joint], fast - 2.0 * rate), None)
        self.expect(limiter, full, moving(joint, MIDDLE[joint], fast - rate), joint)
        limiter.restart(full)
        self.expect(limiter, full, moving(joint, MIDDLE[joint], fast), None)
        # The opposite torque brakes the joint.
        braking = limiter_at(-full)
        self.expect(braking, -full, moving(joint, MIDDLE[joint], fast - rate), None)
        self.expect(braking, -full, moving(joint, MIDDLE[joint], fast), None)

    def test_braking_torque_is_not_reduced_outside_the_envelope(self, joint: int, sign: float):
        limit = (ROBOT.position_max if sign > 0 else ROBOT.position_min)[joint]
        brake = only(joint, -sign * ROBOT.torque_max[joint])
        motion = moving(joint, limit + sign * PAST, sign * (ROBOT.velocity_max[joint] + 2.0 * FASTER))
        limiter = limiter_at(brake)
        self.expect(limiter, brake, motion, None)
        assert limiter.last.tobytes() == brake.tobytes()

    def test_torque_falls_at_the_rate_limit_outside_the_envelope(self, joint: int, sign: float):
        limit = (ROBOT.position_max if sign > 0 else ROBOT.position_min)[joint]
        limiter = limiter_at(only(joint, sign * 3.5 * STEP[joint]))
        left = []
        for _ in range(5):
            limiter.apply(only(joint, sign * 1e3), moving(joint, limit + sign * PAST))
            left.append(sign * limiter.last[joint] / STEP[joint])
        assert left == pytest.approx([2.5, 1.5, 0.5, 0.0, 0.0], abs=1e-9)


@pytest.mark.parametrize(
    ("room", "acceleration", "oldest", "expected"),
    [
        (1.0, 0.0, 0.0, 20.0),  # 20 / 0.1 * (0.003 + 20 / 1e4) = 1
        (1.0, 0.0, 50.0, 60.9902),
        (0.0, 0.0, 50.0, 50.0),
        (-1.0, 0.0, 50.0, 50.0),
        (-1.0, -10.0, 50.0, 51.0),  # a deceleration permits a torque that cancels the deceleration
        (-1.0, 1.0, 50.0, 0.0),
        (1.0, 100.0, 90.0, 70.0),  # 100 * (0.003 + 70 / 1e4) = 1
        (1.0, 100.0, 70.0, 70.0),
        (1.0, 1000.0, 90.0, 0.0),
        (0.3, 0.0, -20.0, 0.0),
        (2.0, 10.0, 5.0, 34.8435),  # accelerates, and may accelerate more
    ],
)
def test_highest_torque_has_the_documented_values(room: float, acceleration: float, oldest: float, expected: float):
    assert highest_torque(room, acceleration, oldest, 0.1, 0.003, 1e-4) == pytest.approx(expected, abs=1e-3)


def test_torque_falls_at_the_rate_limit_to_the_derated_limit():
    limiter = limiter_at(np.full(12, 3.5 * STEP[0]))
    limiter.derate(np.full(12, STEP[0]))
    left = []
    for _ in range(4):
        limiter.apply(np.full(12, 3.5 * STEP[0]), AT_REST)
        left.append(float(limiter.last[0] / STEP[0]))
    assert left == pytest.approx([2.5, 1.5, 1.0, 1.0])


def test_derating_never_raises_the_limit_above_that_of_the_robot():
    limiter = Limiter(ROBOT, PERIOD)
    assert limiter.limit.tobytes() == ROBOT.torque_max.tobytes()
    assert limiter.cut.dtype == np.bool_
    limiter.derate(np.full(12, 1.0))
    limiter.derate(np.full(12, 1e6))
    assert limiter.limit.tobytes() == ROBOT.torque_max.tobytes()
    assert limiter.apply(np.zeros(12), AT_REST) == FREE


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@joints
def test_one_nan_or_infinity_rejects_the_whole_command(joint: int, bad: float):
    limiter = limiter_at(np.full(12, 5.0))
    assert limiter.apply(only(joint, bad), AT_REST) == REFUSED
    for motion in (moving(joint, np.nan), moving(joint, MIDDLE[joint], np.nan)):
        assert limiter.apply(np.full(12, 5.0), motion) == REFUSED
    assert limiter.last.tobytes() == np.full(12, 5.0).tobytes()


def test_saturated_cycles_are_counted():
    limiter = Limiter(ROBOT, PERIOD)
    for cycle in range(3):
        assert limiter.apply(only(4, 1e3), AT_REST) == CUT
        assert limiter.saturated == cycle + 1
    assert limiter.apply(limiter.last.copy(), AT_REST) == FREE
    assert limiter.saturated == 0
    assert not limiter.cut.any()


def ends_outside_the_envelope(limiter: Limiter) -> None:
    assert limiter.apply(np.zeros(12), moving(0, ROBOT.position_max[0] + PAST)) == FREE


def ends_with_a_restart(limiter: Limiter) -> None:
    limiter.restart(np.zeros(12))


@pytest.mark.parametrize("end", [ends_outside_the_envelope, ends_with_a_restart])
def test_saturation_count_is_reset(end: Callable[[Limiter], None]):
    limiter = Limiter(ROBOT, PERIOD)
    limiter.apply(only(0, STEP[0] * 1.5), AT_REST)
    assert limiter.cut.any()
    end(limiter)
    assert limiter.saturated == 0
    assert not limiter.cut.any()


def test_restart_uses_the_measured_torque_within_the_limits():
    limiter = limiter_at(np.full(12, 40.0))
    assert limiter.last.tobytes() == np.full(12, 40.0).tobytes()
    assert limiter.apply(np.full(12, 41.0), AT_REST) == FREE
    limiter.derate(np.full(12, 30.0))
    limiter.restart(np.array([np.nan, np.inf, -np.inf, *np.full(9, -1e6)]))
    assert limiter.last.tolist() == [0.0, 0.0, 0.0, *[-30.0] * 9]
    limiter.restart(np.full(12, 1e6))
    assert limiter.last.tolist() == [30.0] * 12


def test_new_limiter_has_counted_no_cut() -> None:
    assert Limiter(ROBOT, PERIOD).saturated == 0

"""PID of the twelve joints, compared with its formula."""

from __future__ import annotations

import numba
import numpy as np
import pytest

from atalante_control.joint.pid import AIR_GAINS, LEFT, RIGHT, LegGains, Pid, PidGains
from atalante_hal.compiled import interpreted
from atalante_hal.types import read_only

RNG = np.random.default_rng(3)
GAINS = PidGains()
ALL = np.ones(12)


def desired(q: np.ndarray, qd: np.ndarray) -> np.ndarray:
    return np.concatenate([q, qd])


@pytest.mark.parametrize("stance", [LEFT, RIGHT])
def test_stance_and_swing_leg_have_their_gains(stance: int):
    pid = Pid(GAINS)
    pid.start_step(stance, ALL)
    q_des, qd_des, q, qd = RNG.normal(size=(4, 12)) * 0.01
    torque = pid.update(desired(q_des, qd_des), q, qd)
    for joint in range(12):
        leg = LEFT if joint < 6 else RIGHT
        gains = GAINS.stance if leg == stance else GAINS.swing
        i = joint % 6
        e = q_des[joint] - q[joint]
        expected = gains.kp[i] * e + gains.kd[i] * (qd_des[joint] - qd[joint]) + gains.ki[i] * e * 1e-3
        assert torque[joint] == pytest.approx(expected, abs=1e-12)


def test_integral_grows_with_the_error_and_stops_at_its_limit():
    pid = Pid(GAINS)
    pid.start_step(RIGHT, ALL)
    row, zero = desired(np.full(12, 0.1), np.zeros(12)), np.zeros(12)
    first = pid.update(row, zero, zero).copy()
    second = pid.update(row, zero, zero).copy()
    assert (second > first).all()
    for _ in range(6000):
        last = pid.update(row, zero, zero)
    ki = np.array([*GAINS.swing.ki, *GAINS.stance.ki]) * 1e-4
    np.testing.assert_allclose(last - (first - ki), GAINS.integral_limit, rtol=1e-9)


def test_integral_unwinds_from_its_limit_when_the_error_reverses():
    pid = Pid(GAINS)
    pid.start_step(RIGHT, ALL)
    zero = np.zeros(12)
    for _ in range(20000):
        pid.update(desired(np.full(12, 0.1), zero), zero, zero)
    cycles = 0
    while (
        pid.update(desired(np.full(12, -0.1), zero), zero, zero) + 0.1 * np.array([*GAINS.swing.kp, *GAINS.stance.kp])
        > 0
    ).any():
        cycles += 1
    slowest = min(GAINS.swing.ki) * 0.1 * 1e-3  # Nm a cycle
    assert cycles <= GAINS.integral_limit / slowest + 1


@pytest.mark.parametrize("cut", [2.0, -2.0])
@pytest.mark.parametrize("error", [0.01, -0.01])
def test_saturated_torque_stops_its_integral(cut: float, error: float):
    pid, zero, row = Pid(GAINS), np.zeros(12), desired(np.full(12, error), np.zeros(12))
    before = pid.update(row, zero, zero).copy()
    pid.store_request(before)
    sent = before.copy()
    sent[3] -= cut
    after = pid.update(row, zero, zero, sent)
    step = error * np.array([*GAINS.swing.ki, *GAINS.stance.ki]) * 1e-3
    step[3] *= cut * error < 0.0
    np.testing.assert_allclose(after - before, step, rtol=1e-9, atol=1e-15)
    assert after[3] == before[3] or cut * error < 0.0


def test_sent_torque_equal_to_the_request_leaves_the_pid_unchanged():
    one, other = Pid(GAINS), Pid(GAINS)
    for _ in range(100):
        q_des, qd_des, q, qd = RNG.normal(size=(4, 12))
        row = desired(q_des, qd_des)
        with_gravity = RNG.normal(size=12)
        other.store_request(with_gravity)
        assert one.update(row, q, qd).tobytes() == other.update(row, q, qd, with_gravity.copy()).tobytes()


def test_joint_with_share_zero_does_not_integrate():
    pid, share = Pid(GAINS), np.ones(12)
    share[2] = 0.0
    pid.start_step(RIGHT, share)
    zero, row = np.zeros(12), desired(np.full(12, 0.1), np.zeros(12))
    first = pid.update(row, zero, zero).copy()
    second = pid.update(row, zero, zero)
    assert second[2] == first[2]
    assert (np.delete(second, 2) > np.delete(first, 2)).all()


@pytest.mark.parametrize("share", [0.0, 0.25, 1.0])
def test_integral_grows_in_proportion_to_the_share(share: float):
    pid, zero, row = Pid(GAINS), np.zeros(12), desired(np.full(12, 0.1), np.zeros(12))
    pid.start_step(LEFT, np.full(12, share))
    first = pid.update(row, zero, zero).copy()
    growth = pid.update(row, zero, zero) - first
    ki = np.array([*GAINS.stance.ki, *GAINS.swing.ki])
    np.testing.assert_allclose(growth, share * ki * 0.1 * 1e-3, rtol=1e-9, atol=1e-15)


def test_reset_clears_the_integral():
    pid = Pid(GAINS)
    zero, row = np.zeros(12), desired(np.full(12, 0.1), np.zeros(12))
    first = pid.update(row, zero, zero).copy()
    for _ in range(100):
        pid.update(row, zero, zero)
    pid.reset()
    np.testing.assert_array_equal(pid.update(row, zero, zero), first)


@pytest.mark.skipif(interpreted(Pid.update), reason="nothing is compiled")
def test_read_only_state_is_not_compiled_again():
    """The HAL gives read-only arrays to a controller. A compilation in the control loop would take seconds."""
    pid, measured = Pid(PidGains()), read_only(np.full(12, 0.1))
    pid.update(np.zeros(24), measured, measured, measured)
    arrays = [kind for signature in pid._kernel.signatures for kind in signature if isinstance(kind, numba.types.Array)]
    assert arrays
    assert all(array.mutable for array in arrays)


def test_air_gains_of_stance_knee_and_ankle_are_swing_gains():
    for row in ("kp", "ki", "kd"):
        assert getattr(AIR_GAINS.stance, row)[3:] == getattr(AIR_GAINS.swing, row)[3:]


def test_invalid_gains_are_rejected():
    good = (1.0,) * 6
    for bad in ((1.0,) * 5, (1.0,) * 5 + (-1.0,), (1.0,) * 5 + (float("nan"),)):
        with pytest.raises(ValueError, match="kd must be 6 finite numbers"):
            LegGains(good, good, bad)  # type: ignore[arg-type]

"""Control loop: order of a cycle, clocks, and reactions to exceptions and late cycles."""

from __future__ import annotations

import gc
from dataclasses import replace

import numpy as np
import pytest

from atalante_hal.loop import (
    COST_BINS,
    DRIFT_CYCLES,
    DRIFT_TO_HOLD,
    GAP_TO_HOLD,
    Drift,
    LockStep,
    Statistics,
    WallClock,
    run,
)
from atalante_hal.types import Command, SupervisorState

S = SupervisorState
#: Counts the frozen objects. For all other tests, `conftest` replaces it by their number.
COUNT_FROZEN = gc.get_freeze_count


class Recorder:
    """Controller that counts its calls, and raises an exception at call `fail_at`."""

    telemetry_fields = (("calls", 1),)

    def __init__(self, fail_at: int | None = None) -> None:
        self.telemetry = np.zeros(1)
        self.resets = 0
        self.fail_at = fail_at

    def reset(self, state):
        self.resets += 1

    def update(self, state):
        self.telemetry[0] += 1
        if self.telemetry[0] == self.fail_at:
            raise ZeroDivisionError("a fault of the controller")
        return Command(np.zeros(12), np.full(8, 0.5))


class Late:
    """Clock that is late in given cycles: `lateness` has the lateness [s] by cycle number."""

    def __init__(self, lateness: dict[int, float]) -> None:
        self.lateness, self.cycle = lateness, 0

    def wait(self) -> float:
        self.cycle += 1
        return self.lateness.get(self.cycle, 0.0)


def after(cycles: int):
    return lambda state: state.cycle >= cycles


def test_controller_runs_only_in_active_and_its_telemetry_is_recorded(make_rig):
    rig = make_rig(controller_fields=Recorder.telemetry_fields)
    controller = Recorder()
    seen = []
    hal = rig.hal
    statistics = run(
        hal, controller, LockStep(), until=after(500),
        record=lambda: seen.append((hal.state.supervisor, hal.record[hal.layout["controller.calls"]][0])),
    )  # fmt: skip
    active = [calls for supervisor, calls in seen if supervisor is S.ACTIVE]
    assert controller.resets == 1
    assert active == list(range(1, len(active) + 1))
    assert len(active) > 100
    assert statistics.cycles == 500
    assert statistics.overruns == 0
    assert hal.state.supervisor is S.HOLD


def test_controller_exception_leads_to_hold_and_the_loop_continues(make_rig):
    rig = make_rig(controller_fields=Recorder.telemetry_fields)
    controller = Recorder(fail_at=10)
    run(rig.hal, controller, LockStep(), until=after(600))
    assert "ZeroDivisionError: a fault of the controller" in next(
        e.text for e in rig.hal.events if e.code == "CONTROLLER_ERROR"
    )
    assert controller.telemetry[0] == 10
    first_hold = next(e.cycle for e in rig.hal.events if e.code == "HOLD")
    failed = next(e.cycle for e in rig.hal.events if e.code == "CONTROLLER_ERROR")
    assert first_hold == failed + 1


@pytest.mark.parametrize("walking", [False, True])
@pytest.mark.parametrize(
    ("torque", "step", "error"),
    [
        (np.zeros(1), None, "ValueError: the torque must have shape (12,), got (1,)"),
        (np.zeros(()), 1, "ValueError: the torque must have shape (12,), got ()"),
        (np.zeros(12), 2.0, "TypeError: 'float' object cannot be interpreted as an integer"),
    ],
)
def test_wrong_command_is_a_controller_error_and_the_loop_continues(make_rig, torque, step, error: str, walking: bool):
    class Wrong(Recorder):
        def update(self, state):
            right = super().update(state)
            if self.telemetry[0] < 10:
                return replace(right, step=1, walking=walking)
            return replace(right, torque=torque, step=step, walking=walking)

    rig = make_rig(controller_fields=Recorder.telemetry_fields)
    assert run(rig.hal, Wrong(), LockStep(), until=after(600)).cycles == 600
    assert {e.text for e in rig.hal.events if e.code == "CONTROLLER_ERROR"} == {f"the controller raised {error}"}
    assert next(e.cycle for e in rig.hal.events if e.code == "HOLD") < 600


@pytest.mark.parametrize(
    ("lateness", "expected"),
    [
        ({400: 1.5e-3}, S.ACTIVE),
        ({400: 1.5e-3, 401: 1.5e-3}, S.ACTIVE),
        ({400: 1.5e-3, 401: 1.5e-3, 402: 1.5e-3}, S.HOLD),
        ({400: 1.1e-3, 405: 1.1e-3, 410: 1.1e-3}, S.ACTIVE),
        ({400: 4e-3}, S.ACTIVE),
        ({400: GAP_TO_HOLD + 1e-3}, S.HOLD),
        ({400: 0.9e-3, 401: 0.9e-3, 402: 0.9e-3}, S.ACTIVE),
        ({400: 4e-3, 410: 0.9e-3}, S.ACTIVE),
        ({400: 4e-3, 410: 1.1e-3}, S.HOLD),
        ({350: 4e-3, 401: 4e-3}, S.ACTIVE),
        ({352: 4e-3, 401: 4e-3}, S.HOLD),
    ],
)
def test_three_late_cycles_or_one_long_gap_lead_to_hold(make_rig, lateness, expected):
    rig = make_rig(controller_fields=Recorder.telemetry_fields)
    states = []
    statistics = run(rig.hal, Recorder(), Late(lateness), until=lambda s: states.append(s.supervisor) or s.cycle >= 420)
    assert states[390] is S.ACTIVE
    assert states[-1] is expected
    assert statistics.overruns == sum(late > 1e-3 for late in lateness.values())
    assert statistics.lateness_max == max(lateness.values())


class SimulatedTime:
    """Monotonic time of a loop whose cycles take `busy` seconds each."""

    def __init__(self, busy: float) -> None:
        self.now, self.busy = 0.0, busy

    def sleep(self, seconds: float) -> None:
        self.now += seconds

    def step(self, state) -> bool:
        self.now += self.busy if state.supervisor is S.ACTIVE else 0.0
        return state.cycle >= 600


@pytest.mark.parametrize(
    ("busy", "expected"), [(0.99e-3, S.ACTIVE), (1.05e-3, S.ACTIVE), (1.2e-3, S.HOLD), (1.9e-3, S.HOLD)]
)
def test_loop_slower_than_the_monotonic_clock_leads_to_hold(make_rig, busy, expected):
    rig = make_rig(controller_fields=Recorder.telemetry_fields)
    time, states = SimulatedTime(busy), []
    clock = WallClock(now=lambda: time.now, sleep=time.sleep)
    run(rig.hal, Recorder(), clock, until=lambda state: states.append(state.supervisor) or time.step(state))
    assert S.ACTIVE in states
    assert states[-1] is expected
    overruns = [event for event in rig.hal.events if event.code == "OVERRUN" and event.severity == "error"]
    assert bool(overruns) is (expected is S.HOLD)
    if overruns:
        assert overruns[0].value > DRIFT_TO_HOLD
        # The loop is 5 ms behind after 5 ms / (busy - 1 ms) cycles. The next cycle detects this, and one cycle later HOLD begins.
        assert states.count(S.ACTIVE) <= DRIFT_TO_HOLD / (busy - 1e-3) + 3


def test_drift_is_the_time_lost_within_the_window():
    drift = Drift()
    assert drift.add(0.0) == 0.0
    assert drift.add(0.9e-3) == pytest.approx(0.9e-3)
    assert drift.add(0.9e-3) == pytest.approx(0.9e-3), "the deadlines did not move: no more time is lost"
    assert drift.add(1.8e-3) == pytest.approx(1.8e-3)
    assert drift.add(GAP_TO_HOLD) == pytest.approx(1.8e-3 + GAP_TO_HOLD)
    assert drift.add(2.0) == pytest.approx(1.8e-3 + GAP_TO_HOLD), "a gap has its own diagnostic"
    for _ in range(DRIFT_CYCLES):
        lost = drift.add(0.0)
    assert lost == pytest.approx(0.0, abs=1e-12)


def test_cost_histogram_is_bounded_and_exact_to_a_microsecond():
    statistics = Statistics()
    size = len(statistics.costs)
    assert statistics.cost(50) == 0.0
    for microseconds in [100] * 98 + [250, 99_999]:
        statistics.costs[min(microseconds, COST_BINS)] += 1
    assert len(statistics.costs) == size
    assert statistics.cost(0) == pytest.approx(100e-6)
    assert statistics.cost(50) == pytest.approx(100e-6)
    assert statistics.cost(99) == pytest.approx(250e-6)
    assert statistics.cost(100) == pytest.approx(COST_BINS * 1e-6)


def test_cost_histogram_contains_every_cycle_of_a_run(make_rig):
    rig = make_rig(controller_fields=Recorder.telemetry_fields)
    statistics = run(rig.hal, Recorder(), LockStep(), until=after(50))
    assert sum(statistics.costs) == statistics.cycles == 50


def test_keyboard_interrupt_leaves_the_hal_in_hold(make_rig):
    rig = make_rig(controller_fields=Recorder.telemetry_fields)

    def interrupt(state):
        if state.cycle == 400:
            raise KeyboardInterrupt
        return False

    with pytest.raises(KeyboardInterrupt):
        run(rig.hal, Recorder(), LockStep(), until=interrupt)
    assert rig.hal.state.supervisor is S.HOLD


@pytest.mark.parametrize("frozen", [False, True], ids=["not frozen before", "frozen by the caller"])
def test_garbage_collector_ignores_objects_from_before_the_run(make_rig, monkeypatch, frozen):
    collected = []
    monkeypatch.setattr(gc, "collect", lambda: collected.append("collect"))
    monkeypatch.setattr(gc, "get_freeze_count", COUNT_FROZEN)
    gc.unfreeze()
    if frozen:
        gc.freeze()
    during = []
    try:
        rig = make_rig(controller_fields=Recorder.telemetry_fields)
        run(rig.hal, Recorder(), LockStep(), until=after(2), record=lambda: during.append(gc.get_freeze_count()))
        after_it = gc.get_freeze_count()
    finally:
        gc.freeze()
    assert min(during) > 0
    assert (after_it > 0) is frozen
    assert collected == ([] if frozen else ["collect"])


def test_deadlines_are_absolute_and_missed_ones_are_skipped():
    now = [10.0]
    slept = []

    def sleep_until(seconds: float) -> None:
        slept.append(seconds)
        now[0] += seconds

    clock = WallClock(1e-3, now=lambda: now[0], sleep=sleep_until)
    now[0] += 0.4e-3
    assert clock.wait() == 0.0
    assert slept[-1] == pytest.approx(0.6e-3)
    now[0] += 0.9e-3
    clock.wait()
    assert slept[-1] == pytest.approx(0.1e-3)
    now[0] += 3.5e-3
    assert clock.wait() == pytest.approx(2.5e-3)
    now[0] += 0.2e-3
    clock.wait()
    assert slept[-1] == pytest.approx(0.8e-3)


def test_cycles_missed_by_a_late_wake_up_are_skipped():
    """The process is stopped while it sleeps."""
    now, oversleeps = [0.0], [0.0]

    def sleep(seconds: float) -> None:
        now[0] += seconds + oversleeps[0]

    clock = WallClock(1e-3, now=lambda: now[0], sleep=sleep)
    oversleeps[0] = 20e-3
    assert clock.wait() == pytest.approx(20e-3)
    oversleeps[0] = 0.0
    for cycle in range(3):
        assert clock.wait() == pytest.approx(0.0, abs=1e-12), cycle
    assert now[0] == pytest.approx(24e-3)
    oversleeps[0] = 0.5e-3  # less than a period, so the deadlines are not moved
    assert clock.wait() == pytest.approx(0.5e-3)
    oversleeps[0] = 0.0
    assert clock.wait() == pytest.approx(0.0, abs=1e-12)
    assert now[0] == pytest.approx(26e-3)


def test_controller_with_wrong_telemetry_length_is_rejected_before_the_start(make_rig):
    rig = make_rig()
    with pytest.raises(
        ValueError,
        match=r"controller\.telemetry must have the length that the HAL records \(0\), got 1: construct the HAL with",
    ):
        run(rig.hal, Recorder(), LockStep(), until=after(1))
    assert rig.hal.state.cycle == 0

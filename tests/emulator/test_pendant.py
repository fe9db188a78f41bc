from __future__ import annotations

import pytest

from atalante_emulator.pendant import HAL_READY, Operator, Request
from atalante_hal.types import SupervisorState


def test_ready_on_the_wire_is_the_supervisor_s() -> None:
    assert SupervisorState.READY == HAL_READY


def test_operator_starts_a_robot_that_is_ready_and_only_then() -> None:
    operator = Operator()
    for state in SupervisorState:
        if state is not SupervisorState.READY:
            for _ in range(3 * Operator.REACTION):
                operator.receive(state)
    assert operator.signals.request is Request.NONE
    for _ in range(Operator.REACTION - 1):
        operator.receive(HAL_READY)
    assert operator.signals.request_counter == 0
    operator.receive(HAL_READY)
    assert (operator.signals.request, operator.signals.request_counter) == (Request.START, 1)


def test_operator_presses_again_while_nothing_happens() -> None:
    operator = Operator()
    for _ in range(3 * Operator.REACTION):
        operator.receive(HAL_READY)
    assert operator.signals.request_counter == 3


def test_readiness_must_last() -> None:
    operator = Operator()
    for _ in range(10):
        for _ in range(Operator.REACTION - 1):
            operator.receive(HAL_READY)
        operator.receive(SupervisorState.OFF)
    assert operator.signals.request_counter == 0


@pytest.mark.parametrize(("press", "request_"), [("stop", Request.STOP), ("hold", Request.HOLD)])
def test_after_stop_the_operator_waits_to_be_told(press: str, request_: Request) -> None:
    operator = Operator()
    getattr(operator, press)()
    for _ in range(3 * Operator.REACTION):
        operator.receive(HAL_READY)
    assert (operator.signals.request, operator.signals.request_counter) == (request_, 1)
    operator.start()
    assert (operator.signals.request, operator.signals.request_counter) == (Request.START, 2)


def test_an_operator_told_not_to_start_does_not() -> None:
    operator = Operator(starts=False)
    for _ in range(3 * Operator.REACTION):
        operator.receive(HAL_READY)
    assert operator.signals.request is Request.NONE


def test_every_press_counts_and_the_counter_wraps() -> None:
    operator = Operator()
    for press in range(300):
        operator.start()
        assert operator.signals.request_counter == (press + 1) % 256


def test_dead_man() -> None:
    operator = Operator()
    assert operator.signals.dead_man
    operator.release()
    assert not operator.signals.dead_man
    operator.squeeze()
    assert operator.signals.dead_man


def test_dial() -> None:
    operator = Operator(0.5)
    assert operator.signals.assistance_factor == 0.5
    operator.assist(None)
    assert operator.signals.assistance_factor is None
    for wrong in (-0.1, 1.1, float("nan")):
        with pytest.raises(ValueError, match="must be from 0 to 1, got"):
            operator.assist(wrong)


def test_signals_are_another_object_when_they_change_and_the_same_when_not() -> None:
    operator = Operator(0.5)
    before = operator.signals
    operator.receive(0)
    assert operator.signals is before
    operator.assist(0.6)
    assert operator.signals is not before

from __future__ import annotations

import pytest

from atalante_emulator.pendant import HAL_READY, Operator, Request
from atalante_hal.types import SupervisorState


def test_pendant_uses_the_ready_code_of_the_supervisor() -> None:
    assert SupervisorState.READY == HAL_READY


def test_operator_presses_start_only_after_ready_for_the_reaction_time() -> None:
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


def test_operator_presses_start_again_while_the_robot_stays_ready() -> None:
    operator = Operator()
    for _ in range(3 * Operator.REACTION):
        operator.receive(HAL_READY)
    assert operator.signals.request_counter == 3


def test_operator_does_not_press_start_when_ready_is_shorter_than_the_reaction() -> None:
    operator = Operator()
    for _ in range(10):
        for _ in range(Operator.REACTION - 1):
            operator.receive(HAL_READY)
        operator.receive(SupervisorState.OFF)
    assert operator.signals.request_counter == 0


@pytest.mark.parametrize(("press", "request_"), [("stop", Request.STOP), ("hold", Request.HOLD)])
def test_operator_does_not_press_start_after_stop_or_hold(press: str, request_: Request) -> None:
    operator = Operator()
    getattr(operator, press)()
    for _ in range(3 * Operator.REACTION):
        operator.receive(HAL_READY)
    assert (operator.signals.request, operator.signals.request_counter) == (request_, 1)
    operator.start()
    assert (operator.signals.request, operator.signals.request_counter) == (Request.START, 2)


def test_operator_configured_without_start_never_presses_it() -> None:
    operator = Operator(starts=False)
    for _ in range(3 * Operator.REACTION):
        operator.receive(HAL_READY)
    assert operator.signals.request is Request.NONE


def test_request_counter_increments_with_every_press_and_wraps_at_256() -> None:
    operator = Operator()
    for press in range(300):
        operator.start()
        assert operator.signals.request_counter == (press + 1) % 256


def test_dead_man_signal_follows_release_and_squeeze() -> None:
    operator = Operator()
    assert operator.signals.dead_man
    operator.release()
    assert not operator.signals.dead_man
    operator.squeeze()
    assert operator.signals.dead_man


def test_assistance_dial_accepts_zero_to_one_or_none() -> None:
    operator = Operator(0.5)
    assert operator.signals.assistance_factor == 0.5
    operator.assist(None)
    assert operator.signals.assistance_factor is None
    for wrong in (-0.1, 1.1, float("nan")):
        with pytest.raises(ValueError, match="must be from 0 to 1, got"):
            operator.assist(wrong)


def test_signals_object_is_replaced_only_when_a_value_changes() -> None:
    operator = Operator(0.5)
    before = operator.signals
    operator.receive(0)
    assert operator.signals is before
    operator.assist(0.6)
    assert operator.signals is not before

"""What the HAL makes of the operator's words."""

from __future__ import annotations

import pytest

from atalante_dbc import load
from atalante_hal.image import ReceiveImage
from atalante_hal.pendant import Pendant

NETWORK = load()
START, STOP, HOLD = 1, 2, 3


@pytest.fixture
def pendant() -> Pendant:
    names = ("LEFT_SK_STATE", "PENDANT_STATE", "IMU_TORSO_STATE")  # there are values before and after the pendant's
    return Pendant(ReceiveImage([NETWORK.message(name) for name in names]))


def say(
    pendant: Pendant, dead_man: int = 1, request: int = 0, press: int = 0, factor: float = 0.0, factor_set: int = 0
):
    pendant.signals[:] = dead_man, request, press, factor, factor_set
    pendant.hear(True)


def test_it_knows_its_row(pendant: Pendant):
    assert pendant.row == 1


def test_nothing_is_pressed_before_it_is_heard(pendant: Pendant):
    assert (pendant.dead_man, pendant.stop_requested, pendant.started, pendant.assistance_factor) == (False,) * 3 + (
        None,
    )
    assert pendant.heard == b""


def test_dead_man(pendant: Pendant):
    say(pendant, dead_man=1)
    assert pendant.dead_man
    assert pendant.heard == pendant.signals.tobytes()
    say(pendant, dead_man=0)
    assert not pendant.dead_man


@pytest.mark.parametrize("request_", [STOP, HOLD])
def test_stop_and_hold_hold_as_long_as_they_are_said(pendant: Pendant, request_: int):
    say(pendant, request=request_)
    assert pendant.stop_requested
    assert not pendant.started
    say(pendant, request=0)
    assert not pendant.stop_requested


def test_start_acts_when_it_is_pressed_and_once(pendant: Pendant):
    say(pendant, request=START, press=4)  # pressed before anybody listened
    assert not pendant.started
    say(pendant, request=START, press=5)
    assert pendant.started
    assert not pendant.stop_requested
    say(pendant, request=START, press=5)
    assert not pendant.started
    say(pendant, request=STOP, press=6)
    assert not pendant.started
    say(pendant, request=START, press=255)
    assert pendant.started
    say(pendant, request=START, press=0)
    assert pendant.started


def test_a_pendant_that_is_lost_presses_nothing_and_what_was_pressed_meanwhile_does_not_count(pendant: Pendant):
    say(pendant, request=STOP, press=1)
    pendant.hear(False)
    assert [pendant.dead_man, pendant.stop_requested, pendant.started] == [False] * 3
    assert pendant.heard == b""
    say(pendant, request=START, press=2)
    assert pendant.dead_man
    assert not pendant.started
    say(pendant, request=START, press=3)
    assert pendant.started
    pendant.hear(False)
    assert not pendant.started


def test_the_dial_rules_when_it_is_set(pendant: Pendant):
    say(pendant, factor=0.25, factor_set=1)
    assert pendant.assistance_factor == 0.25
    say(pendant, factor=0.25, factor_set=0)
    assert pendant.assistance_factor is None

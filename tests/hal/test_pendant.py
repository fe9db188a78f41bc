"""Pendant input: dead-man, stop, START presses and assistance factor."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from atalante_dbc import load
from atalante_hal.pendant import Demand, Pendant, demand_of, safest
from atalante_hal.wire.codec import Codec
from atalante_hal.wire.process_image import ReceiveImage

NETWORK = load()
#: Codec in which the values of other messages are before and after those of the pendant.
CODEC = Codec([NETWORK.message(name) for name in ("LEFT_SK_STATE", "PENDANT_STATE", "IMU_TORSO_STATE")])
START, STOP, HOLD = 1, 2, 3


@pytest.fixture
def pendant() -> Pendant:
    return Pendant(ReceiveImage(CODEC.messages))


def send(
    pendant: Pendant, dead_man: int = 1, request: int = 0, press: int = 0, factor: float = 0.0, factor_set: int = 0
):
    pendant.signals[:] = dead_man, request, press, factor, factor_set
    pendant.evaluate(True)


def test_pendant_finds_its_row_in_the_process_image(pendant: Pendant):
    assert pendant.row == 1


def test_nothing_is_pressed_before_the_first_frame(pendant: Pendant):
    assert (pendant.dead_man, pendant.stop_requested, pendant.started, pendant.assistance_factor) == (False,) * 3 + (
        None,
    )
    assert pendant.hold_requested is False
    assert pendant.evaluated == b""


def test_dead_man_follows_its_signal(pendant: Pendant):
    send(pendant, dead_man=1)
    assert pendant.dead_man
    assert pendant.evaluated == pendant.signals.tobytes()
    send(pendant, dead_man=0)
    assert not pendant.dead_man


@pytest.mark.parametrize("request_", [STOP, HOLD])
def test_stop_and_hold_requests_last_as_long_as_they_are_sent(pendant: Pendant, request_: int):
    send(pendant, request=request_)
    assert pendant.stop_requested
    assert not pendant.started
    send(pendant, request=0)
    assert not pendant.stop_requested


def test_each_start_press_counts_once(pendant: Pendant):
    send(pendant, request=START, press=4)  # pressed before the first frame
    assert not pendant.started
    send(pendant, request=START, press=5)
    assert pendant.started
    assert not pendant.stop_requested
    send(pendant, request=START, press=5)
    assert not pendant.started
    send(pendant, request=STOP, press=6)
    assert not pendant.started
    send(pendant, request=START, press=255)
    assert pendant.started
    send(pendant, request=START, press=0)
    assert pendant.started


def test_presses_while_the_pendant_is_lost_do_not_count(pendant: Pendant):
    send(pendant, request=STOP, press=1)
    pendant.evaluate(False)
    assert [pendant.dead_man, pendant.stop_requested, pendant.started] == [False] * 3
    assert pendant.evaluated == b""
    send(pendant, request=START, press=2)
    assert pendant.dead_man
    assert not pendant.started
    send(pendant, request=START, press=3)
    assert pendant.started
    pendant.evaluate(False)
    assert not pendant.started


def test_assistance_factor_follows_the_dial_only_while_it_is_set(pendant: Pendant):
    send(pendant, factor=0.25, factor_set=1)
    assert pendant.assistance_factor == 0.25
    send(pendant, factor=0.25, factor_set=0)
    assert pendant.assistance_factor is None


def others(*frames: tuple[int, int, int]) -> list[np.ndarray]:
    """Return the decoded values of further frames of a cycle. Arguments: (dead-man, request, press counter) of each frame."""
    values = np.zeros((len(frames), CODEC.size))
    columns = [CODEC.index("PENDANT_STATE", name) for name in ("DeadMan", "Request", "RequestCounter")]
    values[:, columns] = frames
    return list(values)


@given(st.lists(st.tuples(st.booleans(), st.booleans(), st.booleans()), min_size=1, max_size=4))
def test_safest_demand_contains_every_stop_and_dead_man_release(demands: list[tuple[bool, bool, bool]]):
    found = safest([Demand(*demand) for demand in demands])
    assert found.dead_man is all(dead_man for dead_man, _, _ in demands)
    assert found.stop is any(stop for _, stop, _ in demands)
    assert found.hold is any(hold for _, _, hold in demands)


@pytest.mark.parametrize(
    ("request_", "stop", "hold"),
    [
        (0, False, False),
        (START, False, False),
        (STOP, True, False),
        (HOLD, True, True),
        (4, True, True),
        (7, True, True),
    ],
)
def test_unknown_request_counts_as_hold(request_: int, stop: bool, hold: bool):
    assert demand_of([1.0, request_, 0.0, 0.0, 0.0]) == (True, stop, hold)
    assert demand_of([0.0, request_, 0.0, 0.0, 0.0]) == (False, stop, hold)


def test_hold_request_is_not_hidden_by_a_stop_of_another_frame(pendant: Pendant):
    send(pendant, request=STOP)
    assert not pendant.hold_requested
    pendant.evaluate(True, further_frames=others((1, HOLD, 0)))
    assert pendant.hold_requested
    send(pendant, request=HOLD)
    assert pendant.hold_requested
    pendant.evaluate(False, qualifying=True)
    assert not pendant.hold_requested
    send(pendant, request=HOLD)
    pendant.evaluate(False)
    assert not pendant.hold_requested


def test_safest_of_several_frames_counts_in_its_cycle(pendant: Pendant):
    pendant.signals[:] = 1, 0, 0, 0.5, 1
    pendant.evaluate(True, further_frames=others((1, STOP, 0)))
    assert (pendant.dead_man, pendant.stop_requested) == (True, True)
    pendant.evaluate(True, further_frames=others((1, 0, 0), (0, 0, 0)))
    assert (pendant.dead_man, pendant.stop_requested) == (False, False)
    pendant.evaluate(True)
    assert (pendant.dead_man, pendant.stop_requested, pendant.assistance_factor) == (True, False, 0.5)
    pendant.signals[:2] = 0, STOP
    pendant.evaluate(True, further_frames=others((1, 0, 0)))
    assert (pendant.dead_man, pendant.stop_requested) == (False, True)


def test_press_in_a_cycle_with_different_frames_counts_one_cycle_later(pendant: Pendant):
    send(pendant, press=3)
    pendant.signals[:3] = 1, START, 4
    pendant.evaluate(True, further_frames=others((1, 0, 3)))
    assert not pendant.started
    pendant.evaluate(True)
    assert pendant.started
    pendant.evaluate(True)
    assert not pendant.started


def test_press_of_a_second_sender_does_not_count(pendant: Pendant):
    send(pendant, request=START, press=3)
    pendant.signals[:3] = 1, START, 9
    pendant.evaluate(True, further_frames=others((1, START, 3)))
    assert not pendant.started
    send(pendant, request=START, press=3)
    assert not pendant.started


def qualify(pendant: Pendant, dead_man: int = 1, request: int = 0, press: int = 0):
    pendant.signals[:] = dead_man, request, press, 0.5, 1
    pendant.evaluate(False, qualifying=True)
    assert (pendant.dead_man, pendant.stop_requested, pendant.started, pendant.assistance_factor) == (False,) * 3 + (
        None,
    )
    assert pendant.evaluated == pendant.signals.tobytes()


def test_press_before_qualification_counts_once_after_it(pendant: Pendant):
    qualify(pendant, press=6)
    for _ in range(10):
        qualify(pendant, request=START, press=7)
    send(pendant, request=START, press=7)
    assert pendant.started
    send(pendant, request=START, press=7)
    assert not pendant.started


def test_press_before_a_gap_between_cycles_ends_does_not_count(pendant: Pendant):
    send(pendant, press=6)
    pendant.forget_start()
    send(pendant, request=START, press=7)
    assert not pendant.started
    send(pendant, request=START, press=8)
    assert pendant.started


def test_press_that_is_stored_before_a_gap_between_cycles_does_not_count(pendant: Pendant):
    qualify(pendant, press=6)
    qualify(pendant, request=START, press=7)
    pendant.forget_start()
    send(pendant, request=START, press=7)
    assert not pendant.started


def test_press_counter_of_the_first_frame_is_no_press(pendant: Pendant):
    for _ in range(20):
        qualify(pendant, request=START, press=7)
    send(pendant, request=START, press=7)
    assert not pendant.started


@pytest.mark.parametrize("taken_back", [(0, START, 7), (1, STOP, 8), (1, 0, 8)])
def test_press_released_before_qualification_does_not_count(pendant: Pendant, taken_back: tuple[int, int, int]):
    qualify(pendant, press=6)
    qualify(pendant, request=START, press=7)
    qualify(pendant, *taken_back)
    qualify(pendant, request=START, press=taken_back[2])
    send(pendant, request=START, press=taken_back[2])
    assert not pendant.started


@pytest.mark.parametrize("released", [(0, START, 7), (1, STOP, 7), (1, 0, 7), (0, 0, 7)])
def test_press_released_in_the_first_frame_of_a_qualified_pendant_does_not_count(
    pendant: Pendant, released: tuple[int, int, int]
):
    qualify(pendant, press=6)
    qualify(pendant, request=START, press=7)
    send(pendant, *released)
    assert not pendant.started
    send(pendant, request=START, press=7)
    assert not pendant.started


def test_press_without_dead_man_is_not_kept(pendant: Pendant):
    qualify(pendant, dead_man=0, press=6)
    qualify(pendant, dead_man=0, request=START, press=7)
    qualify(pendant, request=START, press=7)
    send(pendant, request=START, press=7)
    assert not pendant.started


def test_start_is_evaluated_only_in_a_cycle_with_a_new_frame(pendant: Pendant):
    send(pendant, request=START, press=3)
    pendant.signals[:] = 1, START, 4, 0.0, 0  # of a second sender, in a cycle with further frames
    pendant.evaluate(True, further_frames=others((1, START, 3)))
    pendant.evaluate(True, new=False)  # no frame arrives
    assert pendant.dead_man
    assert not pendant.started
    send(pendant, request=START, press=3)
    assert not pendant.started
    send(pendant, request=START, press=4)
    assert pendant.started


@pytest.mark.parametrize("further", [(), ((1, START, 5),)])
def test_first_frame_after_two_senders_is_not_a_press(pendant: Pendant, further: tuple[tuple[int, int, int], ...]):
    send(pendant, request=START, press=1)
    pendant.signals[:3] = 1, START, 5
    pendant.evaluate(True, further_frames=others(*further) if further else (), two_senders=True)
    assert not pendant.started
    send(pendant, request=START, press=5)
    assert not pendant.started
    send(pendant, request=START, press=6)
    assert pendant.started


def test_two_senders_clear_a_stored_press(pendant: Pendant):
    qualify(pendant, press=6)
    qualify(pendant, request=START, press=7)
    pendant.evaluate(False, qualifying=True, two_senders=True)
    qualify(pendant, request=START, press=7)
    send(pendant, request=START, press=7)
    assert not pendant.started


@pytest.mark.parametrize("further", [(0, 0, 0), (1, STOP, 0)])
def test_stop_of_a_second_sender_clears_a_kept_press(pendant: Pendant, further: tuple[int, int, int]):
    qualify(pendant, press=6)
    qualify(pendant, request=START, press=7)
    pendant.evaluate(False, qualifying=True, further_frames=others(further))
    qualify(pendant, request=START, press=7)
    send(pendant, request=START, press=7)
    assert not pendant.started


def test_kept_press_is_cleared_by_state_change_or_pendant_loss(pendant: Pendant):
    for drop in (pendant.clear_press, lambda: pendant.evaluate(False)):
        qualify(pendant, press=6)
        qualify(pendant, request=START, press=7)
        drop()
        qualify(pendant, request=START, press=7)
        pendant.evaluate(True)
        assert not pendant.started
        pendant.assistance_factor = None

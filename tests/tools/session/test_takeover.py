"""Takeover rule of the pendants: how another pendant is recognised, and that only one pendant still sends at the end."""

from __future__ import annotations

import itertools
from random import Random

import numpy as np
import pytest

from atalante_dbc import Network
from atalante_hal.wire.frame import Frames, new_frames
from atalante_hal.wire.process_image import TransmitImage
from atalante_tools.commands.emulator_line import PENDANT_QUIET
from atalante_tools.session.takeover import (
    DRAW_CYCLES,
    LOST_FRAMES,
    PRESENT_FRAMES,
    QUIET_CYCLES,
    RETRY_CYCLES,
    TAKEOVER_CYCLES,
    PendantReader,
    Takeover,
    pendant_messages,
)

#: Longest time from the start of the newest pendant until exactly one pendant still sends [cycles]. The longest of 12,100
#: random takeovers was 234 cycles.
SETTLED = 300


def after(rule: Takeover, *cycles: tuple[int, ...], first: int = 0) -> Takeover:
    """Run one cycle per tuple. A tuple lists the counters of the frames received after a SYNC, relative to that SYNC."""
    for tag, counters in enumerate(cycles, first):
        rule.sync(tag & 0xFF)
        for counter in counters:
            rule.answer((tag + counter) & 0xFF)
    return rule


@pytest.mark.parametrize(
    ("cycles", "sends"),
    [
        ([()] * 3, True),
        ([(0,), (), ()], True),
        ([(0,), (0,)], True),
        ([(0,), (0,), ()], False),
        ([(0, 0, 0), ()], True),
        ([(0,), (), (), (), (), (0,), ()], False),
        ([(0,), (), (), (), (), (), (0,), ()], True),
        ([(-1,), (-1,), (-1,), (-1,), ()], True),
        ([(1,), (1,), (1,), (1,), ()], True),
        ([(128,), (128,), (128,), ()], True),
        ([(-2, -1), (-2, -1), ()], True),
        ([(-1, 0), (-1, 0), ()], False),
    ],
)
def test_only_consecutive_answers_to_the_present_sync_silence_a_pendant(
    cycles: list[tuple[int, ...]], sends: bool
) -> None:
    for first in (0, 254):
        rule = after(Takeover(established=True), *cycles, first=first)
        assert rule.sends is sends
        assert not rule.lost


@pytest.mark.parametrize(("more", "lost"), [(LOST_FRAMES - 1, False), (LOST_FRAMES, True)])
def test_silent_pendant_gives_up_only_if_the_other_pendant_continues(more: int, lost: bool) -> None:
    rule = after(Takeover(established=True), *[(0,)] * (PRESENT_FRAMES + more), *[()] * (QUIET_CYCLES + 1))
    assert rule.lost is lost
    assert rule.sends is not lost


def test_a_frame_of_another_pendant_extends_the_silence() -> None:
    rule = after(Takeover(established=True), (0,), (0,), (), (), (0,), *[()] * QUIET_CYCLES)
    assert rule.silent
    assert after(rule, (), first=5 + QUIET_CYCLES).sends


def test_a_pendant_that_stopped_early_does_not_silence_a_new_pendant() -> None:
    rule = Takeover(seed=1)
    rule.start()
    for tag in range(TAKEOVER_CYCLES + DRAW_CYCLES + 1):
        assert after(rule, (0,) if tag < 10 else (), first=tag).sends
    assert rule.established


def test_pendant_retries_for_a_random_time_after_a_silence() -> None:
    times = []
    for seed in range(200):
        rule = after(Takeover(established=True, seed=seed), (0,), (0,), *[()] * (QUIET_CYCLES + 1))
        times.append(next(tag for tag in range(6, 200) if not after(rule, (0,), first=tag).sends) - 5)
    assert min(times) == RETRY_CYCLES
    assert max(times) == RETRY_CYCLES + DRAW_CYCLES - 1


def test_a_silence_is_shorter_than_the_timeout_of_the_pendant(network: Network) -> None:
    rule = Takeover(established=True, seed=1)
    sends = []
    for tag in range(20):
        rule.sync(tag)
        sends.append(rule.sends)
        if tag in (3, 4):
            rule.answer(tag)
    silence = sends.index(False)
    assert silence == 5
    assert sends[silence:] == [False] * QUIET_CYCLES + [True] * (20 - silence - QUIET_CYCLES)
    assert pendant_messages(network)[0].timeout_ms > QUIET_CYCLES + 1  # one cycle for the latency of the answer


def test_new_pendant_sends_for_a_random_time_before_it_stops() -> None:
    times = set()
    for seed in range(300):
        rule = Takeover(seed=seed)
        rule.start()
        after(rule, *[(0,)] * 200)
        assert rule.lost
        assert not rule.established
        rule = Takeover(seed=seed)
        rule.start()
        times.add(next(tag for tag in range(200) if not after(rule, (0,), first=tag).sends))
    assert min(times) == TAKEOVER_CYCLES
    assert max(times) == TAKEOVER_CYCLES + DRAW_CYCLES - 1


def settle(rules: dict[Takeover, int], cycles: int) -> int:
    """Run pendants on one bus, each from its start cycle. Return the first cycle after which only one pendant sends.

    Args:
        rules: Rule of each pendant and the cycle in which it starts to send.
        cycles: Longest time [cycles].
    """
    newest = max(rules.values())
    for cycle in range(cycles):
        for rule, start in rules.items():
            if cycle == start and not rule.established:
                rule.start()
            rule.sync(cycle & 0xFF)
        senders = [rule for rule in rules if rule.sends]
        for rule in rules:
            if senders not in ([], [rule]):
                rule.answer(cycle & 0xFF)
        left = [rule for rule in rules if not rule.lost]
        assert left, "all pendants gave up"
        if cycle > newest and len(left) == 1 and left[0].established and left[0].sends:
            return cycle
    raise AssertionError(f"{len(left)} pendants are left after {cycles} cycles")


@pytest.mark.parametrize("older", [False, True])
@pytest.mark.parametrize("newcomers", [2, 3])
def test_exactly_one_pendant_is_left_at_every_start_offset(newcomers: int, older: bool) -> None:
    for offset, seed in itertools.product(range(121), range(6)):
        random = Random(f"{offset} {seed}")
        starts = [10, 10 + offset, 10 + random.randrange(121)][:newcomers]
        rules = {Takeover(seed=random.randrange(1 << 30)): start for start in starts}
        if older:
            rules[Takeover(established=True, seed=seed)] = 0
        settle(rules, max(starts) + SETTLED)


def test_two_established_pendants_do_not_both_stop() -> None:
    for seed in range(300):
        rules = {Takeover(established=True, seed=2 * seed + i): 0 for i in range(2)}
        assert settle(rules, SETTLED) >= RETRY_CYCLES


def test_emulated_pendant_yields_to_a_simultaneous_pendant_process() -> None:
    for seed in range(100):
        emulated, process = Takeover(established=True, quiet=PENDANT_QUIET), Takeover(established=True, seed=seed)
        settle({emulated: 0, process: 0}, SETTLED)
        assert emulated.lost


def test_exactly_one_pendant_is_left_with_a_pendant_that_never_yields() -> None:
    for seed, offset in itertools.product(range(10), range(0, 121, 5)):
        hardware = Takeover(established=True)
        hardware.answer = lambda counter: False  # type: ignore[method-assign]
        rules = {hardware: 0, Takeover(seed=2 * seed): 5, Takeover(seed=2 * seed + 1): 5 + offset}
        settle(rules, 5 + offset + SETTLED)
        assert not hardware.lost


class Process:
    """Pendant process that the operating system delays: it reads the frames of the bus later, and answers only the last SYNC."""

    def __init__(self, rule: Takeover) -> None:
        self.rule = rule
        self.inbox: list[tuple[bool, int]] = []  # SYNC or not, and counter

    def run(self) -> int | None:
        """Read all frames. Return the counter of the answer."""
        answer = None
        for is_sync, counter in self.inbox:
            if is_sync:
                self.rule.sync(counter)
                answer = counter
            else:
                self.rule.answer(counter)
        self.inbox.clear()
        return answer if self.rule.sends else None


@pytest.mark.parametrize("stalls", [0.1, 0.3, 0.6])
@pytest.mark.parametrize("lost", [0.0, 0.1])
def test_exactly_one_pendant_is_left_on_a_loaded_computer(stalls: float, lost: float) -> None:
    for seed in range(40):
        random = Random(seed)
        processes = [Process(Takeover(established=True, seed=seed))]
        processes += [Process(Takeover(seed=random.randrange(1 << 30))) for _ in range(2 + seed % 2)]
        starts = [0, *[random.randrange(121) for _ in processes[1:]]]
        for cycle in range(3000):
            for process in processes:
                process.inbox.append((True, cycle & 0xFF))
            for index in random.sample(range(len(processes)), len(processes)):
                process = processes[index]
                if cycle == starts[index] and index:
                    process.rule.start()
                if random.random() < stalls or (answer := process.run()) is None:
                    continue
                for other in processes:
                    if other is not process and random.random() >= lost:
                        other.inbox.append((False, answer))
            left = [process for process in processes if not process.rule.lost]
            assert left, "all pendants gave up"
            if len(left) == 1 and cycle > max(starts):
                break
        assert len(left) == 1


# -- frames ----------------------------------------------------------------------------------------------------------


class Traffic:
    """SYNCs of a HAL and frames of another pendant."""

    def __init__(self, network: Network) -> None:
        state, sync = pendant_messages(network)
        self._state, self._sync = TransmitImage([state]), TransmitImage([sync])
        self._cycle = self._sync.codec.index(sync.name, "Cycle")

    def sync(self, cycle: int) -> Frames:
        self._sync.values[self._cycle] = cycle
        return self._sync.seal(cycle & 0xFF).copy()

    def state(self, counter: int) -> Frames:
        return self._state.seal(counter & 0xFF).copy()


def with_changed_bit(frame: Frames, bit: int) -> Frames:
    frame["data"][0, bit // 8] ^= 1 << bit % 8
    return frame


@pytest.fixture
def traffic(network: Network) -> Traffic:
    return Traffic(network)


def read(network: Network, frames: list[Frames]) -> Takeover:
    rule = Takeover(established=True)
    reader, block = PendantReader(network, rule), np.concatenate(frames)
    assert reader.read(block, len(block))
    return rule


def test_frames_are_read_in_the_order_of_the_bus(network: Network, traffic: Traffic) -> None:
    fresh = [frame for cycle in range(1, 4) for frame in (traffic.sync(cycle), traffic.state(cycle))]
    assert not read(network, fresh).sends
    late = [frame for cycle in range(1, 40) for frame in (traffic.sync(cycle), traffic.state(cycle - 1))]
    assert read(network, late).sends


@pytest.mark.parametrize("bit", range(64))
def test_damaged_frame_does_not_count_as_another_pendant(network: Network, traffic: Traffic, bit: int) -> None:
    frames = [f for c in range(1, 9) for f in (traffic.sync(c), with_changed_bit(traffic.state(c), bit))]
    assert read(network, frames).sends


def test_garbage_with_the_identifier_of_the_pendant_is_ignored(network: Network, traffic: Traffic) -> None:
    state, _ = pendant_messages(network)
    random = np.random.default_rng(0)
    frames = []
    for cycle in range(1, 300):
        garbage = new_frames(1)
        garbage["can_id"], garbage["len"], garbage["flags"] = state.frame_id, random.integers(0, 65), 4
        garbage["data"] = random.integers(0, 256, 64)
        frames += [traffic.sync(cycle), garbage]
    assert read(network, frames).sends


def test_rows_after_the_received_frames_are_ignored(network: Network, traffic: Traffic) -> None:
    rule = Takeover(established=True)
    reader = PendantReader(network, rule)
    for cycle in range(1, 9):
        assert reader.read(np.concatenate([traffic.sync(cycle), traffic.state(cycle)]), 1)
    assert rule.sends
    assert reader.tag == 8


def test_the_signals_of_another_pendant_are_kept_only_from_fresh_frames(network: Network, traffic: Traffic) -> None:
    rule = Takeover()
    reader = PendantReader(network, rule)
    reader.read(np.concatenate([traffic.sync(1), traffic.state(200)]), 2)
    reader.read(np.concatenate([traffic.sync(2), traffic.state(2)]), 2)
    assert reader.other == {}
    for cycle in range(3, 6):
        reader.read(np.concatenate([traffic.sync(cycle), traffic.state(cycle)]), 2)
    assert reader.other["DeadMan"] == 0.0
    assert rule.present

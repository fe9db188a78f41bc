"""Fault memory: active diagnostics, and when each diagnostic is logged."""

from __future__ import annotations

import random

import pytest

from atalante_hal.safety.diagnostics import Dtc, Finding
from atalante_hal.safety.events import Event
from atalante_hal.safety.fault_memory import EVENTS_KEPT, FOLD_CYCLES, EventLog, FaultMemory


@pytest.fixture
def memory() -> FaultMemory:
    return FaultMemory()


def logged(memory: FaultMemory) -> list[tuple[int, str, str, str, float]]:
    return [(e.cycle, e.code, e.node, e.severity, e.value) for e in memory.events]


def test_new_fault_memory_has_no_active_diagnostics(memory: FaultMemory):
    assert (memory.bits, memory.confirmed) == (0, frozenset())
    memory.close_cycle(1)
    assert (memory.active, memory.bits, memory.confirmed, [*memory.events]) == ({}, 0, frozenset(), [])


def test_persistent_diagnostic_is_logged_once(memory: FaultMemory):
    for cycle in range(5, 2000):
        memory.raise_dtc(cycle, Dtc.NODE_TIMEOUT, "LEFT_SK", value=cycle)
        memory.close_cycle(cycle)
        assert memory.confirmed == {Dtc.NODE_TIMEOUT}
        assert memory.bits == Dtc.NODE_TIMEOUT.bit
        assert memory.active[Dtc.NODE_TIMEOUT, "LEFT_SK"].value == cycle
    assert logged(memory) == [(5, "NODE_TIMEOUT", "LEFT_SK", "error", 5)]
    assert memory.events[0].text == "LEFT_SK: a node timed out"


@pytest.mark.parametrize("confirmed", [False, True])
def test_a_finding_is_raised_with_all_its_fields(memory: FaultMemory, confirmed: bool):
    memory.raise_finding(7, Finding(Dtc.ENC_JUMP, "LEFT_SK", 0.25, confirmed, "the encoder jumped"))
    entry = memory.active[Dtc.ENC_JUMP, "LEFT_SK"]
    assert (entry.confirmed, entry.value, entry.text, entry.cycle) == (confirmed, 0.25, "the encoder jumped", 7)


def test_active_diagnostic_has_the_latest_text(memory: FaultMemory):
    for text in ("can0 is down", "can0 was removed", ""):
        memory.raise_dtc(1, Dtc.BUS_DOWN, "HAL", text=text)
    assert memory.text_of(frozenset({Dtc.BUS_DOWN})) == "can0 was removed"
    assert [event.text for event in memory.events] == ["can0 is down"]


def test_each_error_code_of_an_emergency_is_logged(memory: FaultMemory):
    for cycle, code in enumerate((0x2310, 0x2310, 0x2320, 0x2320, 0x2330)):
        memory.raise_dtc(cycle, Dtc.EMCY_CURRENT, "LEFT_SK", value=code)
        memory.close_cycle(cycle)
    assert [(event.cycle, event.code) for event in memory.events] == [
        (0, "EMCY_2310"),
        (2, "EMCY_2320"),
        (4, "EMCY_2330"),
    ]


def test_diagnostic_ends_when_it_is_not_raised_again(memory: FaultMemory):
    memory.raise_dtc(1, Dtc.NODE_TIMEOUT, "LEFT_SK")
    memory.raise_dtc(1, Dtc.E2E_CRC, "LEFT_SA", confirmed=False)
    memory.close_cycle(1)
    assert memory.bits == Dtc.NODE_TIMEOUT.bit | Dtc.E2E_CRC.bit
    memory.raise_dtc(2, Dtc.E2E_CRC, "LEFT_SA", confirmed=False)
    memory.close_cycle(2)
    assert (memory.bits, memory.confirmed) == (Dtc.E2E_CRC.bit, frozenset())
    memory.close_cycle(3)
    assert (memory.bits, memory.active) == (0, {})


def test_pending_is_logged_as_warning_and_confirmed_as_error(memory: FaultMemory):
    for cycle, confirmed in ((1, False), (2, False), (3, True), (4, True)):
        memory.raise_dtc(cycle, Dtc.E2E_CRC, "LEFT_SK", confirmed=confirmed, text=f"in cycle {cycle}", value=cycle)
        memory.close_cycle(cycle)
        assert memory.confirmed == ({Dtc.E2E_CRC} if confirmed else frozenset())
    assert logged(memory) == [(1, "E2E_CRC", "LEFT_SK", "warning", 1), (3, "E2E_CRC", "LEFT_SK", "error", 3)]
    assert [e.text for e in memory.events] == ["in cycle 1", "in cycle 3"]


def test_diagnostic_pending_again_is_no_longer_confirmed(memory: FaultMemory):
    memory.raise_dtc(1, Dtc.E2E_CRC, "LEFT_SK")
    memory.close_cycle(1)
    memory.raise_dtc(2, Dtc.E2E_CRC, "LEFT_SK", confirmed=False)
    memory.close_cycle(2)
    assert memory.confirmed == frozenset()


@pytest.mark.parametrize("order", [(True, False), (False, True)])
def test_confirmed_overrides_pending_in_the_same_cycle(memory: FaultMemory, order: tuple[bool, bool]):
    for confirmed in order:
        memory.raise_dtc(1, Dtc.E2E_CRC, "LEFT_SK", confirmed=confirmed)
    memory.close_cycle(1)
    assert memory.confirmed == {Dtc.E2E_CRC}


def test_pending_information_keeps_its_severity(memory: FaultMemory):
    memory.raise_dtc(1, Dtc.E2E_SOME_LOST, "LEFT_SK", confirmed=False)
    memory.raise_dtc(1, Dtc.TORQUE_SATURATED, "HAL", confirmed=False)
    memory.raise_dtc(1, Dtc.TELEMETRY_DROPPED, "HAL")
    assert [e.severity for e in memory.events] == ["info", "warning", "info"]


@pytest.mark.parametrize("confirmed", [False, True])
def test_toggling_diagnostic_logs_one_event_with_a_count_per_window(memory: FaultMemory, confirmed: bool):
    for cycle in range(0, 2 * FOLD_CYCLES + 1, 2):
        memory.raise_dtc(cycle, Dtc.E2E_CRC, "LEFT_SK", confirmed=confirmed, value=cycle, text="the CRC is wrong")
        memory.close_cycle(cycle)
        memory.close_cycle(cycle + 1)
    half = FOLD_CYCLES // 2
    assert [(e.cycle, e.count) for e in memory.events] == [(0, 1), (FOLD_CYCLES, half), (2 * FOLD_CYCLES, half)]
    assert [e.value for e in memory.events] == [0, FOLD_CYCLES, 2 * FOLD_CYCLES]
    assert memory.events[1].text == f"the CRC is wrong ({half} times since the last such event)"
    severity = "error" if confirmed else "warning"
    assert {(e.code, e.node, e.severity) for e in memory.events} == {("E2E_CRC", "LEFT_SK", severity)}


def test_no_occurrence_is_lost_in_the_counts(memory: FaultMemory):
    rng, raised = random.Random(3), 0
    for cycle in range(1, 20 * FOLD_CYCLES, 2):
        if rng.random() < 0.002 if cycle // FOLD_CYCLES % 2 else rng.random() < 0.3:
            memory.raise_dtc(cycle, Dtc.BUS_FLOOD, "HAL")
            raised += 1
        memory.close_cycle(cycle)
        memory.close_cycle(cycle + 1)
    memory.log_repeats(20 * FOLD_CYCLES, final=True)
    assert sum(event.count for event in memory.events) == raised
    assert len(memory.events) <= 21


def test_window_without_repeats_logs_nothing_and_ends(memory: FaultMemory):
    for cycle in (5, 5 + FOLD_CYCLES):
        memory.raise_dtc(cycle, Dtc.E2E_CRC, "LEFT_SK")
        memory.close_cycle(cycle)
        assert not memory.window_over(cycle + FOLD_CYCLES - 1)
        assert memory.window_over(cycle + FOLD_CYCLES)
        memory.close_cycle(cycle + FOLD_CYCLES)
        assert not memory.window_over(10 * FOLD_CYCLES)
    assert [(e.cycle, e.count) for e in memory.events] == [(5, 1), (5 + FOLD_CYCLES, 1)]


def test_end_of_one_window_leaves_a_later_window_open(memory: FaultMemory):
    first, second = ("LEFT_SK", 0), ("RIGHT_SK", FOLD_CYCLES // 2)
    for node, start in (first, second):
        for cycle in (start, start + 2):
            memory.raise_dtc(cycle, Dtc.E2E_CRC, node)
            memory.close_cycle(cycle)
            memory.close_cycle(cycle + 1)
    memory.close_cycle(FOLD_CYCLES)
    assert [(e.cycle, e.node, e.count) for e in memory.events][2:] == [(FOLD_CYCLES, "LEFT_SK", 1)]
    memory.close_cycle(FOLD_CYCLES + FOLD_CYCLES // 2)
    assert [(e.cycle, e.node, e.count) for e in memory.events][3:] == [(FOLD_CYCLES * 3 // 2, "RIGHT_SK", 1)]


def test_repeats_are_logged_at_the_end_of_a_run(memory: FaultMemory):
    for cycle in (5, 7, 9):
        memory.raise_dtc(cycle, Dtc.E2E_CRC, "LEFT_SK")
        memory.close_cycle(cycle)
        memory.close_cycle(cycle + 1)
    for _ in range(2):
        memory.log_repeats(12, final=True)
        assert [(e.cycle, e.count) for e in memory.events] == [(5, 1), (12, 2)]


def test_codes_nodes_pending_and_confirmed_are_counted_separately(memory: FaultMemory):
    for cycle in (0, 2):
        for node in ("LEFT_SK", "RIGHT_SK"):
            for error in (0x2310, 0x4310):
                memory.raise_dtc(cycle, Dtc.EMCY_CURRENT, node, value=error, confirmed=cycle == 2)
                memory.close_cycle(cycle)
                memory.close_cycle(cycle + 1)
    memory.raise_dtc(4, Dtc.TORQUE_SATURATED, "HAL", confirmed=False)
    memory.raise_dtc(4, Dtc.TORQUE_SATURATED, "HAL")  # with the same severity
    assert len(memory.events) == 10


def test_each_pair_of_node_and_code_is_logged(memory: FaultMemory):
    for node in ("LEFT_SK", "LEFT_SA"):
        for dtc in (Dtc.E2E_CRC, Dtc.NODE_TIMEOUT):
            memory.raise_dtc(7, dtc, node)
    assert len(memory.events) == 4


def test_emergency_event_contains_the_error_code(memory: FaultMemory):
    memory.raise_dtc(7, Dtc.EMCY_CURRENT, "LEFT_SK", value=0x2310)
    assert memory.events[0].code == "EMCY_2310"


def test_nodes_and_texts_of_confirmed_codes_are_returned(memory: FaultMemory):
    memory.raise_dtc(1, Dtc.ENC_STUCK, "LEFT_SK", text="stuck")
    memory.raise_dtc(1, Dtc.OVER_TEMP, "LEFT_FH", confirmed=False, text="warm")
    memory.raise_dtc(1, Dtc.OVER_TEMP, "LEFT_SA", text="hot")
    memory.raise_dtc(1, Dtc.OVER_TEMP, "LEFT_HA", confirmed=False)
    both = frozenset({Dtc.ENC_STUCK, Dtc.OVER_TEMP})
    assert memory.nodes_of(both) == ["LEFT_SK", "LEFT_SA"]
    assert memory.nodes_of(frozenset({Dtc.OVER_TEMP})) == ["LEFT_SA"]
    assert memory.text_of(frozenset({Dtc.OVER_TEMP})) == "hot"
    assert memory.text_of(both) == "stuck"
    assert memory.text_of(frozenset({Dtc.BUS_OFF})) == ""


def test_code_lets_the_walk_end_only_if_it_does_for_each_of_its_nodes(memory: FaultMemory):
    drives = {"LEFT_SK"}
    memory.raise_dtc(1, Dtc.NODE_TIMEOUT, "IMU_PELVIS")
    memory.raise_dtc(1, Dtc.NODE_TIMEOUT, "LEFT_SK", confirmed=False)
    memory.raise_dtc(1, Dtc.E2E_REPEAT_RATE, "LEFT_SK")
    memory.raise_dtc(1, Dtc.OVER_TEMP, "LEFT_SK")
    memory.close_cycle(1)
    assert memory.walk_ends(drives) == {Dtc.NODE_TIMEOUT, Dtc.E2E_REPEAT_RATE}
    memory.raise_dtc(2, Dtc.NODE_TIMEOUT, "IMU_PELVIS")
    memory.raise_dtc(2, Dtc.NODE_TIMEOUT, "LEFT_SK")
    memory.close_cycle(2)
    assert memory.walk_ends(drives) == frozenset()


def test_diagnostic_without_a_value_has_value_zero(memory: FaultMemory):
    memory.raise_dtc(3, Dtc.NODE_RESET, "LEFT_SK")
    assert logged(memory) == [(3, "NODE_RESET", "LEFT_SK", "error", 0.0)]


@pytest.mark.parametrize("before", [False, True])
def test_pending_fault_does_not_hide_the_text_of_the_same_fault_confirmed_in_this_cycle(
    memory: FaultMemory, before: bool
):
    if before:
        memory.raise_dtc(3, Dtc.GUIDE_OUTSIDE, "HAL", value=7.0, text="outside")
        memory.close_cycle(3)
    memory.raise_dtc(4, Dtc.GUIDE_OUTSIDE, "HAL", value=8.0, text="outside")
    memory.raise_dtc(4, Dtc.GUIDE_OUTSIDE, "HAL", value=1.0, confirmed=False, text="hand-over")
    memory.close_cycle(4)
    entry = memory.active[Dtc.GUIDE_OUTSIDE, "HAL"]
    assert (entry.confirmed, entry.text, entry.value) == (True, "outside", 8.0)
    assert memory.text_of(frozenset({Dtc.GUIDE_OUTSIDE})) == "outside"


def test_event_log_is_bounded_and_counts_dropped_events(memory: FaultMemory):
    total = EVENTS_KEPT + 100
    for number in range(total):
        memory.raise_dtc(number * FOLD_CYCLES, Dtc.OVER_TEMP, "LEFT_SK", value=number)
        memory.close_cycle(number * FOLD_CYCLES)
        memory.close_cycle(number * FOLD_CYCLES + 1)
    events = memory.events
    assert (len(events), events.count, events.dropped) == (EVENTS_KEPT, total, 100)
    assert [event.value for event in events] == list(range(100, total))


def test_since_returns_each_event_once_while_older_ones_are_dropped():
    log, seen, number = EventLog(4), [], 0
    for burst in (0, 1, 3, 4, 2, 4):
        for _ in range(burst):
            log.append(Event(log.count, "READY", ""))
        seen += [event.cycle for event in log.since(number)]
        number = log.count
    assert seen == list(range(14))
    assert (log[0].cycle, log[-1].cycle, log.dropped) == (10, 13, 10)


@pytest.mark.parametrize(("number", "cycles"), [(0, [2, 3, 4, 5]), (1, [2, 3, 4, 5]), (4, [4, 5]), (6, []), (9, [])])
def test_since_returns_only_events_that_are_kept(number: int, cycles: list[int]):
    log = EventLog(4)
    for cycle in range(6):
        log.append(Event(cycle, "READY", ""))
    assert [event.cycle for event in log.since(number)] == cycles


def test_event_log_behaves_like_a_sequence_of_its_kept_events():
    log = EventLog()
    events = [Event(cycle, "READY", "", "info", value=cycle) for cycle in range(3)]
    for event in events:
        log.append(event)
    assert len(log) == 3
    assert [*log] == events
    assert log[-1] is events[-1]
    assert repr(log) == repr(events)


@pytest.mark.parametrize(
    ("confirmed", "pending", "worst"),
    [
        ([], [Dtc.NODE_TIMEOUT], []),
        ([Dtc.E2E_REPEATED], [], []),
        ([Dtc.HEARTBEAT_LOST, Dtc.E2E_REPEATED], [Dtc.DRIVE_FAULT], [Dtc.HEARTBEAT_LOST]),
        ([Dtc.NODE_TIMEOUT, Dtc.ENC_JUMP, Dtc.IMU_STUCK], [], [Dtc.NODE_TIMEOUT, Dtc.ENC_JUMP]),
    ],
)
def test_worst_codes_are_the_confirmed_ones_with_the_most_severe_reaction(
    memory: FaultMemory, confirmed: list[Dtc], pending: list[Dtc], worst: list[Dtc]
):
    for dtc in (*confirmed, *pending):
        memory.raise_dtc(1, dtc, "LEFT_SK", confirmed=dtc in confirmed)
    memory.close_cycle(1)
    assert memory.worst() == frozenset(worst)

"""Fault memory: active diagnostics, and when each diagnostic is logged."""

from __future__ import annotations

import pytest

from atalante_hal.safety.diagnostics import Dtc, Finding
from atalante_hal.safety.events import Event
from atalante_hal.safety.fault_memory import EVENTS_KEPT, QUIET_CONFIRMED, QUIET_PENDING, EventLog, FaultMemory


@pytest.fixture
def memory() -> FaultMemory:
    return FaultMemory()


def told(memory: FaultMemory) -> list[tuple[int, str, str, str, float]]:
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
    assert told(memory) == [(5, "NODE_TIMEOUT", "LEFT_SK", "error", 5)]
    assert memory.events[0].text == "LEFT_SK: a node timed out"


@pytest.mark.parametrize("confirmed", [False, True])
def test_a_finding_is_raised_with_all_its_fields(memory: FaultMemory, confirmed: bool):
    memory.raise_finding(7, Finding(Dtc.ENC_JUMP, "LEFT_SK", 0.25, confirmed, "the encoder jumped"))
    entry = memory.active[Dtc.ENC_JUMP, "LEFT_SK"]
    assert (entry.confirmed, entry.value, entry.text, entry.cycle) == (confirmed, 0.25, "the encoder jumped", 7)


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
    assert told(memory) == [(1, "E2E_CRC", "LEFT_SK", "warning", 1), (3, "E2E_CRC", "LEFT_SK", "error", 3)]
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


@pytest.mark.parametrize(("confirmed", "quiet"), [(False, QUIET_PENDING), (True, QUIET_CONFIRMED)])
def test_intermittent_diagnostic_is_logged_again_after_the_quiet_time(memory: FaultMemory, confirmed: bool, quiet: int):
    for cycle in range(0, 2 * quiet + 1, 2):
        memory.raise_dtc(cycle, Dtc.E2E_CRC, "LEFT_SK", confirmed=confirmed)
        memory.close_cycle(cycle)
        memory.close_cycle(cycle + 1)
    assert [e.cycle for e in memory.events] == [0, quiet, 2 * quiet]


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
    memory.raise_dtc(1, Dtc.OVER_TEMP, "LEFT_SA", text="hot")
    memory.raise_dtc(1, Dtc.OVER_TEMP, "LEFT_HA", confirmed=False)
    both = frozenset({Dtc.ENC_STUCK, Dtc.OVER_TEMP})
    assert memory.nodes_of(both) == ["LEFT_SK", "LEFT_SA"]
    assert memory.nodes_of(frozenset({Dtc.OVER_TEMP})) == ["LEFT_SA"]
    assert memory.text_of(frozenset({Dtc.OVER_TEMP})) == "hot"
    assert memory.text_of(both) == "stuck"
    assert memory.text_of(frozenset({Dtc.BUS_OFF})) == ""


def test_diagnostic_without_a_value_has_value_zero(memory: FaultMemory):
    memory.raise_dtc(3, Dtc.NODE_RESET, "LEFT_SK")
    assert told(memory) == [(3, "NODE_RESET", "LEFT_SK", "error", 0.0)]


def test_event_log_is_bounded_and_counts_dropped_events(memory: FaultMemory):
    total = EVENTS_KEPT + 100
    for number in range(total):
        memory.raise_dtc(number * QUIET_CONFIRMED, Dtc.OVER_TEMP, "LEFT_SK", value=number)
        memory.close_cycle(number * QUIET_CONFIRMED)
        memory.close_cycle(number * QUIET_CONFIRMED + 1)
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

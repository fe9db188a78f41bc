"""Transceiver: transmit table, receive budget, and failures of the bus."""

from __future__ import annotations

import numpy as np
import pytest

from atalante_dbc import load
from atalante_hal import transceiver
from atalante_hal.bus import BusDown, BusError, BusFull
from atalante_hal.safety.diagnostics import Dtc, Finding
from atalante_hal.safety.fault_memory import FaultMemory
from atalante_hal.transceiver import RECEIVE_BUDGET, HalDuplicate, Transceiver, TransmitDenied
from atalante_hal.wire.frame import FLAG_FDF, ID_ERROR, ID_EXTENDED, Frames, new_frames
from atalante_hal.wire.process_image import ReceiveImage, TransmitImage

NETWORK = load()
SURPLUS = 12
OURS = NETWORK.sent_by("HAL")
CYCLIC = [NETWORK.message(name) for name in ("LEFT_SK_STATE", "RIGHT_SK_STATE")]


class Clock:
    """Simulated clock: time passes only while the bus waits. An endless loop fails the test."""

    def __init__(self) -> None:
        self.now, self.looks = 64.0, 0

    def monotonic(self) -> float:
        self.looks += 1
        assert self.looks < 200, "endless wait"
        return self.now

    def sleep(self, seconds: float) -> None:
        self.now += seconds


class Bus:
    """Bus that stores sent frames in the list `sent`. Each `receive` returns the next frames of the list `arrivals`."""

    name, dropped, stamps = "bench", 0, np.zeros(256, np.int64)

    def __init__(self, clock: Clock) -> None:
        self.clock = clock
        self.sent: list[Frames] = []
        self.arrivals: list[Frames | BusError] = []
        self.timeouts: list[float] = []
        self.refuses: BusError | None = None

    def send(self, frames: Frames) -> None:
        if self.refuses is not None:
            raise self.refuses
        self.sent.append(frames.copy())

    def receive(self, frames: Frames, timeout: float = 0.0) -> int:
        self.timeouts.append(timeout)
        if not self.arrivals:
            self.clock.now += timeout
            return 0
        arrived = self.arrivals.pop(0)
        if isinstance(arrived, BusError):
            raise arrived
        count = min(len(arrived), len(frames))
        frames[:count] = arrived[:count]
        return count

    def close(self) -> None:
        pass


class Tap:
    def __init__(self) -> None:
        self.sent_ids: list[list[int]] = []
        self.received_ids: list[list[int]] = []

    def sent(self, frames: Frames) -> None:
        self.sent_ids.append(frames["can_id"].tolist())

    def received(self, frames: Frames, count: int) -> None:
        self.received_ids.append(frames["can_id"][:count].tolist())


class Desk:
    def __init__(self) -> None:
        self.clock = Clock()
        self.bus, self.tap, self.memory = Bus(self.clock), Tap(), FaultMemory()
        self.transceiver = Transceiver(NETWORK, "HAL", self.bus, self.tap, cyclic=len(CYCLIC), surplus=SURPLUS)
        self.cycle = 0

    def evaluate(self) -> dict[str, bool]:
        self.cycle += 1
        for finding in self.transceiver.faults():
            self.memory.raise_finding(self.cycle, finding)
        self.memory.close_cycle(self.cycle)
        return {dtc.value: entry.confirmed for (dtc, _), entry in self.memory.active.items()}


@pytest.fixture
def desk(monkeypatch: pytest.MonkeyPatch) -> Desk:
    made = Desk()
    monkeypatch.setattr(transceiver, "time", made.clock)
    return made


def test_new_transceiver_has_no_diagnostics(desk: Desk):
    assert desk.transceiver.quiet is True
    assert desk.evaluate() == {}
    assert desk.transceiver.quiet is True


def ids(*numbers: int) -> Frames:
    frames = new_frames(len(numbers))
    frames["can_id"], frames["len"], frames["flags"] = numbers, 12, 5
    return frames


# -- sending -----------------------------------------------------------------------------------------------------------


def test_only_messages_of_the_node_may_be_sent(desk: Desk):
    for message in NETWORK.messages:
        frames = TransmitImage([message]).frames
        if message in OURS:
            desk.transceiver.send(desk.transceiver.grant(frames))
        else:
            with pytest.raises(
                TransmitDenied, match=f"HAL may send only its own messages, .*, got id 0x{message.frame_id:X}"
            ):
                desk.transceiver.grant(frames)
    assert [f["can_id"][0] for f in desk.bus.sent] == [m.frame_id for m in OURS]
    assert desk.tap.sent_ids == [[m.frame_id] for m in OURS]
    assert desk.transceiver.quiet


@pytest.mark.parametrize(
    ("field", "value"), [("can_id", 0x10 | ID_EXTENDED), ("len", 12), ("flags", FLAG_FDF), ("res", 1)]
)
def test_frame_in_another_format_is_denied(desk: Desk, field: str, value: int):
    frames = TransmitImage([NETWORK.message("SYNC_LEFT_LEG")]).frames
    frames[field] = value
    with pytest.raises(TransmitDenied):
        desk.transceiver.grant(frames)


@pytest.mark.parametrize(("field", "value"), [("can_id", 0x181), ("can_id", 0x11), ("len", 12), ("flags", 0)])
def test_header_changed_after_the_grant_is_denied(desk: Desk, field: str, value: int):
    batch = desk.transceiver.grant(TransmitImage(OURS).frames)
    batch.frames[field][0] = value
    with pytest.raises(TransmitDenied, match="must keep the identifier, length and format"):
        desk.transceiver.send(batch)
    assert desk.bus.sent == []


def sync(desk: Desk):
    return desk.transceiver.grant(TransmitImage([NETWORK.message("SYNC_LEFT_LEG")]).frames)


def test_full_queue_is_confirmed_after_five_cycles_in_a_row(desk: Desk):
    batch = sync(desk)
    desk.bus.refuses = BusFull("no room", 3)
    for cycle in range(1, 8):
        desk.transceiver.send(batch)
        desk.transceiver.send(batch)
        assert not desk.transceiver.quiet
        assert desk.evaluate() == {"BUS_TX_FULL": cycle >= 5}
        assert not desk.transceiver.quiet
    assert desk.memory.events[0].text == "no room"
    assert desk.memory.events[0].value == 3
    desk.bus.refuses = None
    desk.transceiver.send(batch)
    assert desk.evaluate() == {}
    assert desk.transceiver.quiet
    desk.bus.refuses = BusFull("no room", 3)
    desk.transceiver.send(batch)
    assert desk.evaluate() == {"BUS_TX_FULL": False}


def test_bus_down_while_sending_is_confirmed_immediately(desk: Desk):
    desk.bus.refuses = BusDown("bench is down: gone")
    desk.transceiver.send(sync(desk))
    assert desk.evaluate() == {"BUS_DOWN": True}
    event = desk.memory.events[0]
    assert (event.text, event.value, event.node) == ("bench is down: gone", 0.0, "HAL")
    assert desk.tap.sent_ids == []
    assert desk.evaluate() == {}


@pytest.mark.parametrize("kind", [BusDown, BusFull])
def test_frames_accepted_before_an_error_are_logged(desk: Desk, kind: type[BusError]):
    first, second, third = (m.frame_id for m in OURS[:3])
    batch = desk.transceiver.grant(TransmitImage(OURS[:3]).frames)
    desk.bus.refuses = kind("no room", 2)
    desk.transceiver.send(batch)
    assert desk.tap.sent_ids == [[first, second]]
    desk.bus.refuses = kind("no room", 2)
    desk.bus.refuses.accepted = batch.frames[[0, 2]]
    desk.transceiver.send(batch)
    assert desk.tap.sent_ids[1:] == [[first, third]]
    desk.bus.refuses = kind("no room", 0)
    desk.transceiver.send(batch)
    assert len(desk.tap.sent_ids) == 2


def test_bus_that_is_full_and_down_has_both_faults(desk: Desk):
    desk.bus.refuses = BusDown("gone")
    desk.bus.refuses.full = BusFull("no room", 3)
    for cycle in range(1, 6):
        desk.transceiver.send(sync(desk))
        assert desk.evaluate() == {"BUS_DOWN": True, "BUS_TX_FULL": cycle >= 5}


# -- receiving ---------------------------------------------------------------------------------------------------------


def test_received_frames_are_appended(desk: Desk):
    desk.bus.arrivals = [ids(1, 2), ids(3)]
    assert desk.transceiver.receive() == 2
    assert desk.transceiver.receive(2) == 3
    assert desk.transceiver.scratch["can_id"][:3].tolist() == [1, 2, 3]
    assert desk.tap.received_ids == [[1, 2], [3]]
    assert desk.bus.timeouts == [0.0, 0.0]


def image(*received: int) -> ReceiveImage:
    made = ReceiveImage(CYCLIC)
    made.age[list(received)] = 0
    return made


def test_complete_cycle_is_returned_without_waiting(desk: Desk):
    desk.bus.arrivals = [TransmitImage(CYCLIC).frames]
    assert desk.transceiver.receive(0, image(0, 1), 1.0) == 2
    assert desk.bus.timeouts == [0.0]


def test_receive_waits_for_nodes_that_have_not_timed_out(desk: Desk):
    first, second = (m.frame_id for m in CYCLIC)
    desk.bus.arrivals = [ids(first), ids(7), ids(second), ids(8)]
    assert desk.transceiver.receive(0, image(0, 1), 60.0) == 3
    assert len(desk.bus.arrivals) == 1
    assert desk.bus.timeouts == [0.0, 60.0, 60.0]


def test_wait_ends_after_the_timeout(desk: Desk):
    first = CYCLIC[0].frame_id
    desk.bus.arrivals = [ids(first)]
    assert desk.transceiver.receive(0, image(0, 1), 60.0) == 1
    assert desk.bus.timeouts == [0.0, 60.0]
    desk.bus.arrivals = [ids(first)]
    assert desk.transceiver.receive(0, image(0, 1)) == 1
    assert desk.bus.timeouts == [0.0, 60.0, 0.0]


def test_frames_of_the_last_cycle_do_not_complete_this_cycle(desk: Desk):
    first, second = (m.frame_id for m in CYCLIC)
    desk.transceiver.scratch["can_id"][:2] = first, second
    desk.bus.arrivals = [ids(), ids(first), ids(second)]
    assert desk.transceiver.receive(2, image(0, 1), 60.0) == 4


def test_receive_does_not_wait_for_nodes_that_timed_out(desk: Desk):
    desk.bus.arrivals = [ids(CYCLIC[0].frame_id), ids(9)]
    assert desk.transceiver.receive(0, image(0), 60.0) == 1
    assert len(desk.bus.timeouts) == 1


def test_receive_waits_until_no_frame_arrives_if_no_node_has_answered_yet(desk: Desk):
    desk.bus.arrivals = [ids(1), ids(2), ids(3)]
    assert desk.transceiver.receive(0, image(), 60.0) == 3
    assert desk.bus.timeouts == pytest.approx([0.0, 0.1, 0.1, 0.1])


@pytest.mark.parametrize("refusal", [BusDown("gone"), BusFull("no room", 0)])
def test_wait_is_short_after_a_failed_sync(desk: Desk, refusal: BusError):
    desk.bus.refuses = refusal
    desk.transceiver.send(sync(desk))
    for patience, waited in ((60.0, 0.1), (0.03, 0.03)):
        desk.bus.timeouts.clear()
        assert desk.transceiver.receive(0, image(0, 1), patience) == 0
        assert desk.bus.timeouts == pytest.approx([0.0, waited])
    desk.bus.refuses = None
    desk.transceiver.send(sync(desk))
    desk.bus.timeouts.clear()
    desk.transceiver.receive(0, image(0, 1), 60.0)
    assert desk.bus.timeouts == [0.0, 60.0]


def test_wait_is_halved_for_each_sync_that_a_node_did_not_answer(desk: Desk):
    first, second = (m.frame_id for m in CYCLIC)
    alive = image(0, 1)
    for age, arrivals, patience, timeouts in (
        (1, [ids(first)], 2.0, [0.0, 1.0]),
        (2, [ids(first)], 2.0, [0.0, 0.5]),
        (5, [ids(first)], 2.0, [0.0, 0.1]),
        (2, [ids(first)], 0.03, [0.0, 0.03]),
        (2, [ids(7), ids(first), ids(second)], 2.0, [0.0, 2.0, 0.5]),
    ):
        alive.age[1] = age
        desk.bus.timeouts.clear()
        desk.bus.arrivals = arrivals
        desk.transceiver.receive(0, alive, patience)
        assert desk.bus.timeouts == pytest.approx(timeouts)


def test_dead_node_costs_less_than_twice_the_patience_until_it_times_out(desk: Desk):
    first = CYCLIC[0].frame_id
    alive = image(0, 1)
    begun = desk.clock.now
    for _ in range(2 * CYCLIC[1].timeout_ms):
        desk.bus.arrivals = [ids(first)]
        desk.transceiver.receive(0, alive, 2.0)
        alive.age[1] += 1
    assert desk.clock.now - begun == pytest.approx(2.0 + 1.0 + 0.5 + 0.25 + 0.125 + 0.1)


def test_receive_does_not_wait_without_patience(desk: Desk):
    desk.bus.arrivals = [ids(1), ids(2)]
    assert desk.transceiver.receive(0, image(0, 1), 0.0) == 1
    assert desk.bus.timeouts == [0.0]


def test_receive_is_limited_to_its_budget(desk: Desk):
    desk.bus.arrivals = [ids(*range(100)), ids(*range(100)), ids(1)]
    assert desk.transceiver.receive(0, image(), 60.0) == RECEIVE_BUDGET
    assert len(desk.bus.arrivals) == 1


def test_flood_is_confirmed_after_five_cycles_in_a_row(desk: Desk):
    usual = len(CYCLIC) + SURPLUS
    for cycle in range(1, 8):
        desk.bus.arrivals = [ids(*range(usual + 1))]
        desk.transceiver.receive()
        assert desk.evaluate() == {"BUS_FLOOD": cycle >= 5}
        assert not desk.transceiver.quiet
    event = desk.memory.events[0]
    assert (event.value, event.text) == (usual + 1, f"HAL: {Dtc.BUS_FLOOD.meaning}")
    desk.bus.arrivals = [ids(*range(usual))]
    desk.transceiver.receive()
    assert desk.evaluate() == {}
    assert desk.transceiver.quiet
    desk.bus.arrivals = [ids(*range(usual + 1))]
    desk.transceiver.receive()
    assert desk.evaluate() == {"BUS_FLOOD": False}


def test_bus_down_while_receiving_is_reported_and_not_raised(desk: Desk):
    desk.bus.arrivals = [BusDown("bench is down: gone")]
    assert desk.transceiver.receive(1) == 1
    assert desk.evaluate() == {"BUS_DOWN": True}
    event = desk.memory.events[0]
    assert (event.text, event.value, event.node) == ("bench is down: gone", 0.0, "HAL")
    for patience, paused in ((0.0, 0.0), (0.01, 0.01), (60.0, 0.1)):
        desk.bus.arrivals, begun = [BusDown("gone")], desk.bus.clock.now
        assert desk.transceiver.receive(0, image(0, 1), patience) == 0
        assert desk.bus.clock.now == begun + paused


def test_frames_received_before_an_error_of_the_bus_are_kept_and_logged(desk: Desk):
    """The bus has several channels, and one of them is lost."""
    desk.bus.arrivals, begun = [ids(1), BusDown("gone")], desk.bus.clock.now
    assert desk.transceiver.receive(0, image(0, 1), 0.01) == 1
    assert desk.transceiver.scratch["can_id"][0] == 1
    assert desk.tap.received_ids == [[1]]
    assert desk.bus.clock.now == begun + 0.01
    assert desk.evaluate() == {"BUS_DOWN": True}


def test_answers_of_the_other_channels_are_awaited_after_an_error_of_one_channel(desk: Desk):
    """A removed adapter raises the error in every call without other frames, so also before the first answer to a SYNC."""
    desk.bus.arrivals, begun = [BusDown("gone"), ids(CYCLIC[0].frame_id), BusDown("gone")], desk.bus.clock.now
    assert desk.transceiver.receive(0, image(0, 1), 0.01) == 1
    assert desk.bus.clock.now == begun + 0.01
    assert len(desk.transceiver.faults()) == 1


def test_frame_of_an_earlier_call_is_no_answer_after_an_error_of_one_channel(desk: Desk):
    answer = ids(CYCLIC[0].frame_id)
    desk.transceiver.scratch[0] = answer[0]
    desk.bus.arrivals = [BusDown("gone"), answer]
    assert desk.transceiver.receive(1, image(0), 0.01) == 2


def test_call_without_frames_logs_nothing(desk: Desk):
    desk.bus.arrivals = []
    assert desk.transceiver.receive() == 0
    assert desk.tap.received_ids == []


def test_error_after_the_whole_wait_causes_no_pause(desk: Desk):
    """Otherwise a cycle on the wall clock would take longer than its period."""

    def wait(frames: Frames, timeout: float = 0.0) -> int:
        desk.bus.clock.now += timeout
        raise BusDown("gone")

    desk.bus.receive = wait
    begun = desk.bus.clock.now
    assert desk.transceiver.receive(0, image(0, 1), 0.01) == 0
    assert desk.bus.clock.now == begun + 0.01


def test_frames_are_logged_while_the_bus_has_their_time_stamps(desk: Desk):
    """On a real bus, the answers to a SYNC arrive one after another, and each call of the bus overwrites `stamps`."""
    desk.bus.arrivals = [ids(9), ids(CYCLIC[0].frame_id, 8), ids(CYCLIC[1].frame_id)]
    assert desk.transceiver.receive(0, image(0, 1), 0.01) == 4
    assert desk.tap.received_ids == [[9], [CYCLIC[0].frame_id, 8], [CYCLIC[1].frame_id]]


@pytest.mark.parametrize(
    ("can_id", "code", "value"),
    [
        (0x7FF, "FRAME_UNKNOWN", 0x7FF),
        (0x10 | ID_EXTENDED, "FRAME_UNKNOWN", 0x10 | ID_EXTENDED),
        (0x10, "HAL_DUPLICATE", 0x10),
        (0x100, "HAL_DUPLICATE", 0x100),
        (0x700, "HAL_DUPLICATE", 0x700),
        (ID_ERROR | 0x40, "BUS_OFF", 0x40),
        (ID_ERROR | 0x44, "BUS_OFF", 0x44),
    ],
)
def test_foreign_frames_raise_their_diagnostic(desk: Desk, can_id: int, code: str, value: int):
    desk.transceiver.foreign(ids(can_id))
    assert desk.transceiver.quiet is False
    assert desk.evaluate() == {code: True}
    assert [e.value for e in desk.memory.events] == [value]
    desk.transceiver.acknowledge()
    assert desk.evaluate() == {}
    assert desk.transceiver.quiet


def test_bus_off_lasts_until_it_is_acknowledged(desk: Desk):
    desk.transceiver.foreign(ids(ID_ERROR | 0x40))
    assert desk.transceiver.faults() == [Finding(Dtc.BUS_OFF, "HAL", 0x40, True, "")]
    for _ in range(3):
        assert desk.evaluate() == {"BUS_OFF": True}
        assert not desk.transceiver.quiet
    desk.transceiver.acknowledge()
    assert desk.evaluate() == {}
    assert desk.transceiver.quiet


def test_several_foreign_frames_raise_all_diagnostics(desk: Desk):
    desk.transceiver.foreign(ids(0x7FF, ID_ERROR | 0x40, 0x100))
    assert desk.evaluate() == {"FRAME_UNKNOWN": True, "BUS_OFF": True, "HAL_DUPLICATE": True}
    assert {e.text for e in desk.memory.events} == {
        "id 0x7FF is not a message to this HAL",
        "HAL: the CAN controller is bus-off",
        "another node sends id 0x100 of this HAL",
    }


# -- listening before the start, and queued frames after a pause ---------------------------------------------------------


def test_listen_detects_another_hal_before_sending(desk: Desk):
    desk.bus.arrivals = [ids(0x181, 0x191), ids(0x700, 0x10)]
    with pytest.raises(HalDuplicate, match=r"another HAL is active on bench \(received id 0x10\): stop it first"):
        desk.transceiver.listen(60.0)
    assert desk.bus.sent == []


def test_listen_accepts_frames_of_nodes(desk: Desk):
    desk.bus.arrivals = [ids(0x181), ids(0x7FF)]
    desk.transceiver.listen(0.25)
    assert desk.bus.arrivals == []
    assert desk.bus.timeouts == [0.25] * 3
    assert desk.evaluate() == {}


def test_listen_ignores_old_frames_in_the_buffer(desk: Desk):
    desk.transceiver.scratch["can_id"].fill(0x10)
    desk.bus.arrivals = [ids(0x181)]
    desk.transceiver.listen()
    assert desk.bus.timeouts == pytest.approx([0.2, 0.2])


def test_bus_down_ends_listen(desk: Desk):
    desk.bus.arrivals = [BusDown("gone")]
    with pytest.raises(BusDown):
        desk.transceiver.listen(60.0)


def test_queued_frames_are_received_until_the_bus_is_silent(desk: Desk):
    desk.bus.arrivals = [ids(*range(RECEIVE_BUDGET)), ids(*range(RECEIVE_BUDGET)), ids(1, 5), ids(2)]
    frames = desk.transceiver.receive_queued(range(4, RECEIVE_BUDGET))
    assert frames["can_id"].tolist() == [0, 1, 2, 3, 0, 1, 2, 3, 1]
    assert desk.tap.received_ids == [list(range(RECEIVE_BUDGET))] * 2 + [[1, 5]]
    assert len(desk.bus.arrivals) == 1
    assert desk.evaluate() == {}, "queued frames are no flood"


def test_queued_frames_are_received_without_a_tap(desk: Desk):
    desk.transceiver.tap = None
    desk.bus.arrivals = [ids(1)]
    assert desk.transceiver.receive_queued([]).tobytes() == ids(1).tobytes()


def test_number_of_queued_frames_is_bounded_under_a_flood(desk: Desk):
    desk.bus.arrivals = [ids(*range(RECEIVE_BUDGET))] * (RECEIVE_BUDGET + 5)
    assert len(desk.transceiver.receive_queued([])) == RECEIVE_BUDGET**2
    assert len(desk.bus.arrivals) == 5


def test_bus_down_while_queued_frames_are_received_is_reported_and_not_raised(desk: Desk):
    desk.bus.arrivals = [BusDown("bench is down: gone")]
    assert len(desk.transceiver.receive_queued([])) == 0
    assert desk.evaluate() == {"BUS_DOWN": True}
    event = desk.memory.events[0]
    assert (event.text, event.value) == ("bench is down: gone", 0.0)


def test_queued_frames_before_a_bus_failure_are_kept(desk: Desk):
    desk.bus.arrivals = [ids(*range(RECEIVE_BUDGET)), BusDown("gone")]
    assert len(desk.transceiver.receive_queued([])) == RECEIVE_BUDGET
    assert desk.evaluate() == {"BUS_DOWN": True}


def test_transceiver_works_without_a_tap(desk: Desk):
    desk.transceiver.tap = None
    desk.bus.arrivals = [ids(1)]
    desk.transceiver.send(sync(desk))
    assert desk.transceiver.receive() == 1


def test_error_frames_are_counted_and_confirmed_after_16_cycles(desk: Desk):
    for cycle in range(1, 19):
        desk.transceiver.foreign(ids(ID_ERROR | 0x88, ID_ERROR | 0x04))
        assert not desk.transceiver.quiet
        assert desk.evaluate() == {"BUS_ERROR": cycle >= 16}
        assert desk.transceiver.error_frames == 2 * cycle
    entry = desk.memory.active[Dtc.BUS_ERROR, "HAL"]
    assert entry.value == 36
    assert entry.text == "36 error frames on bench so far: check wiring, termination and bit timing"
    for _ in range(15):
        assert not desk.transceiver.quiet
        assert desk.evaluate() == {"BUS_ERROR": True}
    assert desk.evaluate() == {}


def test_error_frames_in_a_fifth_of_the_cycles_are_never_confirmed(desk: Desk):
    for _ in range(100):
        desk.transceiver.foreign(ids(ID_ERROR | 0x08))
        assert desk.evaluate() == {"BUS_ERROR": False}
        for _ in range(4):
            assert not desk.transceiver.quiet
            assert desk.evaluate() == {}
    for _ in range(12):
        assert not desk.transceiver.quiet
        assert desk.evaluate() == {}
    assert desk.transceiver.quiet


def test_bus_off_is_not_counted_as_an_error_frame(desk: Desk):
    desk.transceiver.foreign(ids(ID_ERROR | 0x40))
    assert desk.evaluate() == {"BUS_OFF": True}
    assert desk.transceiver.error_frames == 0

"""Telemetry service, run in the process of the test: the records and events in the rings reach the sinks."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import atalante_dbc
from atalante_hal.bus.pair import lockstep_pair
from atalante_hal.hal import Hal
from atalante_hal.record_layout import Layout
from atalante_hal.robot import Robot
from atalante_hal.safety.events import EVENT_BYTES, Event, pack
from atalante_hal.telemetry.can_log import CanLog
from atalante_hal.telemetry.frames import FRAME_RECORD, RingTap
from atalante_hal.telemetry.messages import Encoder
from atalante_hal.telemetry.ring import RingReader, RingWriter
from atalante_hal.telemetry.schema import message_class
from atalante_hal.telemetry.service import Service
from atalante_hal.telemetry.sink import SinkError
from atalante_hal.wire.frame import new_frames

TYPES = {"joint_states": "JointStates", "system": "SystemState", "loop": "LoopStatistics", "events": "Event"}


@dataclass
class Sink:
    """Sink that stores its messages, and fails after `fails_at` messages."""

    fails_at: int | None = None
    got: list[tuple[str, bytes, int, int]] = field(default_factory=list)
    runs: list[tuple[int, dict[str, object]]] = field(default_factory=list)

    def put(self, key: str, payload: bytes, timestamp: int, cycle: int) -> None:
        if len(self.got) == self.fails_at:
            raise SinkError("the disk is full", "RECORD_STOPPED")
        self.got.append((key, payload, timestamp, cycle))

    def begin_run(self, number: int, about: Mapping[str, object]) -> None:
        self.runs.append((number, dict(about)))

    def close(self) -> None:
        pass

    def cycles(self, key: str) -> list[int]:
        return [cycle for found, _, _, cycle in self.got if found == key]

    def messages(self, key: str) -> list[Any]:
        return [message_class(TYPES[key]).FromString(payload) for found, payload, _, _ in self.got if found == key]


@dataclass
class ServiceBench:
    """The writers of the rings of records and events, and the service that reads both rings."""

    layout: Layout
    records: RingWriter
    events: RingWriter
    service: Service

    def write(self, cycles: range, cost_us: float = 50.0) -> None:
        record = np.zeros(self.layout.size)
        record[self.layout["cost_us"]] = cost_us
        for cycle in cycles:
            record[self.layout["cycle"]], record[self.layout["time"]] = cycle, cycle * 1e-3
            self.records.write(record)

    def begin_run(self, number: int, name: str, start_ns: int) -> None:
        self.records.add_note({"run": number, "name": name, "start_ns": start_ns, "about": {"shape": name}})

    def event(self, run: int, cycle: int, code: str) -> None:
        self.events.write(pack(Event(cycle, code, "it happened"), run))


@pytest.fixture
def layout(network: atalante_dbc.Network, robot: Robot) -> Layout:
    return Hal(network, robot, lockstep_pair()[0]).layout


@contextmanager
def bench(layout: Layout, *sinks: tuple[Sink, int], slots: int = 4096, loop_every: int = 100) -> Iterator[ServiceBench]:
    meta = {"start_ns": 1000}
    with (
        RingWriter(layout.size * 8, slots, meta=meta) as records,
        RingWriter(EVENT_BYTES, 16) as events,
        RingReader(os.dup(records.fd)) as records_out,
        RingReader(os.dup(events.fd)) as events_out,
    ):
        service = Service(
            records_out,
            events_out,
            None,
            encoder=Encoder(layout, ["NODES_WELL"]),
            sinks=sinks,
            loop_every=loop_every,
            can_log=None,
        )
        yield ServiceBench(layout, records, events, service)


class TestRates:
    @pytest.mark.parametrize(("every", "batch"), [(1, 7), (10, 1), (10, 64), (100, 300)])
    def test_each_sink_gets_its_rate_for_every_batch_size(self, layout: Layout, every: int, batch: int) -> None:
        sink, other = Sink(), Sink()
        with bench(layout, (sink, every), (other, 50)) as at:
            for first in range(1, 600, batch):
                at.write(range(first, min(first + batch, 600)))
                assert at.service.step()
        for key in ("joint_states", "imu", "foot_forces", "haptics", "system"):
            assert sink.cycles(key) == list(range(every, 600, every))
            assert other.cycles(key) == list(range(50, 600, 50))
        assert sink.cycles("loop") == other.cycles("loop") == [100, 200, 300, 400, 500]

    def test_loop_statistics_cover_every_cycle_once(self, layout: Layout) -> None:
        sink = Sink()
        with bench(layout, (sink, 10)) as at:
            at.write(range(1, 150), cost_us=40.0)
            at.service.step()
            at.write(range(150, 151), cost_us=400.0)
            at.service.step()
            at.write(range(151, 301), cost_us=40.0)
            at.service.step()
        found = sink.messages("loop")
        assert [message.cycles for message in found] == [100, 100, 100]
        assert [message.cost_max for message in found] == pytest.approx([40e-6, 400e-6, 40e-6])
        assert found[1].cost_mean == pytest.approx(43.6e-6)

    def test_step_without_records_sends_nothing(self, layout: Layout) -> None:
        sink = Sink()
        with bench(layout, (sink, 10)) as at:
            assert not at.service.step()
        assert sink.got == []


class TestBatches:
    def test_full_rings_are_read_in_alternating_batches(
        self, layout: Layout, network: atalante_dbc.Network, tmp_path: Path
    ) -> None:
        """The control loop sees progress and free slots in both rings long before the step ends."""
        cycles, frames_per_cycle = 2000, 32
        progress: list[
            tuple[int, int]
        ] = []  # number of records read from the ring of cycles and from the ring of frames

        class Observer(Sink):
            def put(self, key: str, payload: bytes, timestamp: int, cycle: int) -> None:
                progress.append((records.taken, frames.taken))

        with (
            RingWriter(layout.size * 8, 4096, meta={"start_ns": 0}) as records,
            RingWriter(EVENT_BYTES, 16) as events,
            RingWriter(FRAME_RECORD.itemsize, 4096) as frames,
            RingReader(os.dup(records.fd)) as records_out,
            RingReader(os.dup(events.fd)) as events_out,
            RingReader(os.dup(frames.fd)) as frames_out,
            CanLog(tmp_path / "run.log", network.buses, {}) as can_log,
        ):
            service = Service(
                records_out,
                events_out,
                frames_out,
                encoder=Encoder(layout, ["NODES_WELL"]),
                sinks=[(Observer(), 10)],
                loop_every=100,
                can_log=can_log,
            )
            tap = RingTap(frames, lambda: 0)
            record = np.zeros(layout.size)
            for cycle in range(cycles):
                record[layout["cycle"]] = cycle
                records.write(record)
                tap.received(new_frames(frames_per_cycle), frames_per_cycle)
            tap.flush()
            assert service.step()
            assert (records.taken, frames.taken) == (cycles, cycles * frames_per_cycle // 64)
            assert can_log.frames == cycles * frames_per_cycle
            assert not service.step()
        steps = np.diff(np.array([(0, 0), *progress]), axis=0)
        assert steps.max(axis=0).tolist() == [128, 64]

    def test_records_written_after_a_stop_do_not_delay_the_end(self, layout: Layout) -> None:
        class Refilling(Sink):
            def put(self, key: str, payload: bytes, timestamp: int, cycle: int) -> None:
                super().put(key, payload, timestamp, cycle)
                at.write(range(cycle + 1000, cycle + 1020))  # faster than the service reads

        sink = Refilling()
        with bench(layout, (sink, 10)) as at:
            at.write(range(1, 201))
            at.service.run(stop=["SIGTERM"])
        assert set(range(10, 201, 10)) <= set(sink.cycles("joint_states"))


class TestRuns:
    def test_log_time_and_number_change_with_the_first_record_of_a_run(self, layout: Layout) -> None:
        sink = Sink()
        with bench(layout, (sink, 10)) as at:
            at.begin_run(0, "constant", 5_000)
            at.write(range(21))
            at.begin_run(1, "pinched", 9_000_000_000)
            at.write(range(11))
            at.service.step()
        times = [time for key, _, time, _ in sink.got if key == "system"]
        assert times == [5_000, 10_005_000, 20_005_000, 9_000_000_000, 9_010_000_000]
        assert [(m.run, m.run_name) for m in sink.messages("system")] == [(0, "constant")] * 3 + [(1, "pinched")] * 2
        assert sink.runs == [
            (0, {"name": "constant", "start_ns": 5_000, "shape": "constant"}),
            (1, {"name": "pinched", "start_ns": 9_000_000_000, "shape": "pinched"}),
        ]

    def test_new_run_without_records_keeps_the_time_of_the_last_run(self, layout: Layout) -> None:
        sink = Sink()
        with bench(layout, (sink, 10)) as at:
            at.begin_run(0, "constant", 0)
            at.write(range(5))
            at.begin_run(1, "pinched", 7_000)
            at.service.step()
            at.write(range(5))
            at.service.step()
        assert [time for key, _, time, _ in sink.got if key == "system"] == [0, 7_000]

    def test_records_before_any_run_have_the_time_of_the_session(self, layout: Layout) -> None:
        sink = Sink()
        with bench(layout, (sink, 10)) as at:
            at.write(range(10, 11))
            at.service.step()
        assert sink.got[0][2] == 10_001_000


class TestEvents:
    def test_events_go_to_every_sink_with_the_time_of_their_run(self, layout: Layout) -> None:
        one, other = Sink(), Sink()
        with bench(layout, (one, 10), (other, 100)) as at:
            at.begin_run(0, "constant", 0)
            at.write(range(1, 8))
            at.event(0, 7, "NODE_TIMEOUT")
            at.begin_run(1, "pinched", 5_000_000_000)
            at.event(1, 0, "READY")
            at.service.step()
        for sink in (one, other):
            assert [(message.code, message.cycle) for message in sink.messages("events")] == [
                ("NODE_TIMEOUT", 7),
                ("READY", 0),
            ]
            assert [time for key, _, time, _ in sink.got if key == "events"] == [7_000_000, 5_000_000_000]


class TestLosses:
    def test_lost_cycles_are_reported_and_later_cycles_are_published(self, layout: Layout) -> None:
        sink = Sink()
        with bench(layout, (sink, 10), slots=32) as at:
            at.write(range(1, 101))
            at.service.step()
        assert sink.cycles("joint_states") == [70, 80, 90, 100]
        (event,) = sink.messages("events")
        assert (event.code, event.value, event.node, event.cycle) == ("TELEMETRY_DROPPED", 69.0, "TELEMETRY", 100)
        assert sink.messages("loop")[0].telemetry_lost == 69
        assert at.service.notices == [event.text]

    @pytest.mark.parametrize("fails_at", [0, 3, 7])
    def test_failed_sink_is_removed_and_reported_to_the_others(self, layout: Layout, fails_at: int) -> None:
        broken, working = Sink(fails_at), Sink()
        with bench(layout, (broken, 10), (working, 10)) as at:
            at.write(range(1, 301))
            at.service.step()
        assert len(broken.got) == fails_at
        assert working.cycles("joint_states") == list(range(10, 301, 10))
        (event,) = working.messages("events")
        assert (event.code, event.text, event.severity) == ("RECORD_STOPPED", "the disk is full", 2)
        assert at.service.notices == ["the disk is full"]

    def test_ring_is_emptied_after_all_sinks_failed(self, layout: Layout) -> None:
        broken = Sink(0)
        with bench(layout, (broken, 10)) as at:
            at.write(range(1, 101))
            assert at.service.step()
            assert not at.service.step()


class TestEnd:
    def test_closed_ring_is_emptied_before_the_service_ends(self, layout: Layout) -> None:
        sink = Sink()
        with bench(layout, (sink, 10)) as at:
            at.write(range(1, 31))
            at.records.finish()
            at.service.run(stop=[])
        assert sink.cycles("joint_states") == [10, 20, 30]

    def test_ring_is_emptied_before_the_service_stops_on_request(self, layout: Layout) -> None:
        sink = Sink()
        with bench(layout, (sink, 10)) as at:
            at.write(range(1, 31))
            at.service.run(stop=["SIGTERM"])
        assert sink.cycles("joint_states") == [10, 20, 30]

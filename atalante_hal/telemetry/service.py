"""Main loop of the telemetry process: reads the rings and passes the records to publisher, recorder and CAN log.

    rings -> records -> messages -> Zenoh, MCAP
          -> frames ---------------> python-can log

A sink that fails is removed and reported as an event. The other sinks continue.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from atalante_hal.safety.events import Event, unpack
from atalante_hal.telemetry.frames import batches
from atalante_hal.telemetry.process import CYCLE_NS
from atalante_hal.telemetry.ring import RingReader
from atalante_hal.telemetry.sink import EVENTS, MessageSink, SinkError

if TYPE_CHECKING:  # only for type checks, because protobuf and mcap are optional packages
    from atalante_hal.telemetry.can_log import CanLog
    from atalante_hal.telemetry.messages import Encoder
    from atalante_hal.telemetry.recorder import Recorder

_POLL = 0.005  # polling period of empty rings [s]
_WRITER_CHECK = 0.2  # shortest time between two checks whether the writer's process exists [s]
_DROPPED_EVERY = 1.0  # shortest time between two reports of lost cycles [s]
#: Largest number of records in one batch. 64 records of the frame ring contain the frames of about 128 cycles.
#: The counter of the read records changes once per batch. A change shows the control loop that this process does not hang.
#: A writer that waits for a free slot of the ring continues when the counter of the read records changes.
#: So a batch must take much less time than `process.HANGS_AFTER` and `TelemetryConfig.patience`.
_RECORDS_PER_BATCH, _FRAME_RECORDS_PER_BATCH = 128, 64


@dataclass(frozen=True)
class Run:
    """Run of a session: consecutive cycles with one name and one start time.

    The control loop sends the data of each run as a note in the ring of cycle records.
    """

    number: int
    name: str
    #: Log time of cycle 0 of the run [ns]. In lock-step, the log times of records and events are computed from it.
    #: In real time, the log time is the time of day at which a record or an event was written.
    start_ns: int
    first: int  # number of the first record of the run


class Service:
    """Main loop that reads the rings and writes to the sinks.

    Args:
        records: Reader of the ring of cycle records.
        events: Reader of the ring of events.
        frames: Reader of the ring of CAN frames; None without a CAN log.
        encoder: Encoder for the layout of the records; None if `sinks` is empty.
        sinks: Each sink for messages, with the number of cycles from one message of a stream to the next.
        loop_every: Number of cycles from one message of loop statistics to the next.
        can_log: Writer of the CAN log; None without a CAN log.
        recorder: Element of `sinks` that writes the recording; None without a recording. The service writes the number of saved
            records to the header of the ring of cycle records.
    """

    def __init__(
        self,
        records: RingReader,
        events: RingReader,
        frames: RingReader | None,
        *,
        encoder: Encoder | None,
        sinks: Sequence[tuple[MessageSink, int]],
        loop_every: int,
        can_log: CanLog | None,
        recorder: Recorder | None = None,
    ) -> None:
        self._records, self._events, self._frames = records, events, frames
        self._encoder, self._sinks, self._loop_every, self._can_log = encoder, list(sinks), loop_every, can_log
        self._runs = [Run(0, "", records.meta["start_ns"], 0)]
        self._cycle, self._timestamp = 0, self._runs[0].start_ns  # cycle number and log time [ns] of the last record
        self._lost, self._lost_reported = 0, -math.inf
        self._recorder, self._saved = recorder, 0  # `_saved`: last `recorder.saved`, the number of messages on disk
        self._handled = 0  # number of records whose messages have been passed to all sinks
        self._kept = 0  # number of saved records that this service has reported by `RingReader.keep`
        self.notices: list[str] = []  # faults, one sentence each

    def run(self, stop: Sequence[object]) -> None:
        """Handle records until the writer closes the rings, the writer's process ends, or a stop is requested.

        At the end the remaining contents of the rings are handled.

        Args:
            stop: Sequence. The loop stops as soon as it is not empty.
        """
        checked = time.monotonic()
        while not (stop or self._records.closed):
            if self.step():
                continue
            time.sleep(_POLL)
            if time.monotonic() - checked > _WRITER_CHECK:
                checked = time.monotonic()
                if not self._records.writer_alive:
                    break
        self.step()

    def settle(self) -> None:
        """Mark every record as saved if the recording is complete. Call this after the recorder was closed."""
        if self._recorder is not None and self._recorder.finished:
            self._mark_saved()

    def step(self) -> bool:
        """Process all records that the rings contain now, in batches, and return whether there were any."""
        rings = [ring for ring in (self._records, self._events, self._frames) if ring is not None]
        ends = [(ring, ring.written) for ring in rings]
        found = any(ring.position < end for ring, end in ends)
        self._handle_batch()  # without a new record, there may still be a new run
        while any(ring.position < end for ring, end in ends):
            self._handle_batch()
        return found

    def _handle_batch(self) -> None:
        """Process the oldest records of each ring."""
        # The control loop announces each run in a note, and then writes the events of the run.
        # So read the events before `_begin_runs` reads the notes. In the opposite order, the run of an event could be unknown.
        events = [unpack(bytes(event)) for event in self._events.read()]
        event_times = self._events.times.tolist()
        records = self._records.read(_RECORDS_PER_BATCH)
        first = self._records.position - len(records)
        self._begin_runs()
        if len(records) and self._encoder is not None:
            self._handle_records(self._encoder, records.view(np.float64), self._records.times, first)
        for (event, number), time_ns in zip(events, event_times, strict=True):
            run = next(run for run in reversed(self._runs) if run.number == number)
            self._put_event(event, time_ns or run.start_ns + event.cycle * CYCLE_NS)
        if self._frames is not None:
            self._handle_frames(self._frames.read(_FRAME_RECORDS_PER_BATCH))
        self._report_lost()

    # -- records --

    def _begin_runs(self) -> None:
        for note in self._records.notes():
            run = Run(note["run"], note["name"], note["start_ns"], note["from"])
            self._runs.append(run)
            about = {"name": run.name, "start_ns": run.start_ns, **note["about"]}
            for sink, _ in list(self._sinks):
                try:
                    sink.begin_run(run.number, about)
                except SinkError as error:
                    self._remove(sink, error)

    def _run_of(self, record: int) -> Run:
        """Return the run to which the record with a given number belongs."""
        return next((run for run in reversed(self._runs) if run.first <= record), self._runs[0])

    def _handle_records(
        self, encoder: Encoder, records: npt.NDArray[np.float64], times: npt.NDArray[np.int64], first: int
    ) -> None:
        """Pass the messages of every n-th cycle to each sink; each sink has its own n.

        Example: a sink with n = 10 gets the messages of the cycles 0, 10, 20 and so on. All sinks also get the loop statistics.

        Args:
            encoder: Encoder for the layout of the records.
            records: Records with consecutive numbers, shape (n, layout.size).
            times: Time of day of each record, shape (n,) [ns]; 0 in lock-step.
            first: Number of the first record.
        """
        cycles = np.rint(records[:, encoder.cycle_at]).astype(np.int64)
        due = cycles % self._loop_every == 0
        for _, every in self._sinks:
            due |= cycles % every == 0
        window_from, before = 0, self._handled
        for row in np.flatnonzero(due).tolist():
            self._handled = before + row
            cycle, run = int(cycles[row]), self._run_of(first + row)
            sample = encoder.sample(records[row], cycle, run.start_ns, run.number, run.name, int(times[row]))
            sinks = [sink for sink, every in self._sinks if cycle % every == 0]
            if sinks:
                for stream in encoder.streams:
                    self._put(sinks, stream.key, stream.encode(sample), sample.timestamp, cycle)
            if cycle % self._loop_every == 0:
                encoder.window.add(records[window_from : row + 1])
                window_from = row + 1
                payload = encoder.window.encode(sample, self._records.lost)
                self._put([sink for sink, _ in self._sinks], encoder.window.key, payload, sample.timestamp, cycle)
        self._handled = before + len(records)
        encoder.window.add(records[window_from:])
        last = self._run_of(first + len(records) - 1)
        self._cycle = int(cycles[-1])
        self._timestamp = encoder.log_time(records[-1], last.start_ns, int(times[-1]))

    def _handle_frames(self, records: npt.NDArray[np.uint8]) -> None:
        """Write the given records of the frame ring to the CAN log."""
        if self._can_log is None:
            return
        try:
            for frames, stamps, sent in batches(records):
                self._can_log.write(frames, stamps, sent)
        except SinkError as error:
            self._can_log = None
            self.report(error.code, str(error), "error")

    # -- sinks --

    def _put(self, sinks: Sequence[MessageSink], key: str, payload: bytes, timestamp: int, cycle: int) -> None:
        for sink in sinks:
            try:
                sink.put(key, payload, timestamp, cycle)
            except SinkError as error:
                self._remove(sink, error)
        if self._recorder is not None and self._recorder.saved != self._saved:
            self._saved = self._recorder.saved
            self._mark_saved()

    def _mark_saved(self) -> None:
        """Report that all handled records are saved, so that `RingWriter.kept` includes them."""
        self._records.keep(self._handled - self._kept)
        self._kept = self._handled

    def _remove(self, failed: MessageSink, error: SinkError) -> None:
        """Remove a failed sink and report its error."""
        if any(sink is failed for sink, _ in self._sinks):
            self._sinks = [(sink, every) for sink, every in self._sinks if sink is not failed]
            self.report(error.code, str(error), "error")

    def report(self, code: str, text: str, severity: str, value: float = 0.0) -> None:
        """Publish and record an event of the telemetry process itself, and add its text to the notices.

        Args:
            code: Code of the event.
            text: One sentence.
            severity: Severity, one of `events.SEVERITIES`.
            value: Measured value; its meaning depends on the code.
        """
        self.notices.append(text)
        self._put_event(Event(self._cycle, code, text, severity, "TELEMETRY", value), self._timestamp)

    def _put_event(self, event: Event, timestamp: int) -> None:
        if self._encoder is not None:
            payload = self._encoder.event(event, timestamp)
            self._put([sink for sink, _ in self._sinks], EVENTS, payload, timestamp, event.cycle)

    def _report_lost(self) -> None:
        lost = self._records.lost
        if lost > self._lost and time.monotonic() - self._lost_reported > _DROPPED_EVERY:
            text = f"telemetry lost {lost - self._lost} cycles, because it read more slowly than the loop wrote"
            self._lost, self._lost_reported = lost, time.monotonic()
            self.report("TELEMETRY_DROPPED", text, "warning", float(lost))

"""What the telemetry process does: empty the rings, and hand each record to publisher, recorder and CAN log.

    rings -> records -> messages -> Zenoh, MCAP
          -> frames ---------------> python-can log

A sink that fails is closed and reported as an event; the others go on.
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

if TYPE_CHECKING:  # these need protobuf and python-can, which a session may do without
    from atalante_hal.telemetry.can_log import CanLog
    from atalante_hal.telemetry.messages import Encoder
    from atalante_hal.telemetry.recorder import Recorder

_POLL = 0.005  # s, between looks at empty rings
_LOOK_FOR_WRITER = 0.2  # s, between looks whether the writer lives, while nothing comes
_DROPPED_EVERY = 1.0  # s, between reports of lost cycles


@dataclass(frozen=True)
class Run:
    """One run of the session."""

    number: int
    name: str
    start_ns: int  # log time of its cycle 0
    first: int  # number of its first record


class Service:
    """Rings in, sinks out.

    Args:
        records, events, frames: reading ends; `frames` only with a CAN log.
        encoder: for the layout of the records; None when there is no sink for messages.
        sinks: each with the number of cycles from one message of a stream to the next.
        loop_every: cycles from one message of loop statistics to the next.
        can_log: where the frames go.
        recorder: the one of `sinks` that writes a file; counts in the ring which records are saved.
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
        self._cycle, self._timestamp = 0, self._runs[0].start_ns  # of the record seen last
        self._lost, self._lost_reported = 0, -math.inf
        self._recorder, self._saved = recorder, 0  # messages of the recorder that were saved when last looked at
        self._handled = self._kept = (
            0  # records whose messages were all put; those of them counted as saved in the ring
        )
        self.notices: list[str] = []  # what went wrong, one sentence each

    def run(self, stop: Sequence[object]) -> None:
        """Until the writer closes the rings or is gone, or `stop` is not empty; then once more what is in the rings."""
        looked = time.monotonic()
        while not (stop or self._records.closed):
            if self.step():
                continue
            time.sleep(_POLL)
            if time.monotonic() - looked > _LOOK_FOR_WRITER:
                looked = time.monotonic()
                if not self._records.writer_alive:
                    break
        self.step()

    def settle(self) -> None:
        """Count every record as saved if the recording is finished; call it after the recorder was closed."""
        if self._recorder is not None and self._recorder.finished:
            self._keep()

    def step(self) -> bool:
        """Handle everything that is in the rings; whether there was anything."""
        # Events first: what is said about a run was written before the events in it, and is read after them.
        events = [unpack(bytes(event)) for event in self._events.read()]
        records = self._records.read()
        first = self._records.position - len(records)
        self._begin_runs()
        if len(records) and self._encoder is not None:
            self._handle_records(self._encoder, records.view(np.float64), first)
        for event, number in events:
            run = next(run for run in reversed(self._runs) if run.number == number)
            self._tell(event, run.start_ns + event.cycle * CYCLE_NS)
        logged = self._frames is not None and self._handle_frames(self._frames.read())
        self._report_lost()
        return bool(len(records) or events or logged)

    # -- records -----------------------------------------------------------------------------------------------------

    def _begin_runs(self) -> None:
        for note in self._records.notes():
            run = Run(note["run"], note["name"], note["start_ns"], note["from"])
            self._runs.append(run)
            about = {"name": run.name, "start_ns": run.start_ns, **note["about"]}
            for sink, _ in list(self._sinks):
                try:
                    sink.begin_run(run.number, about)
                except SinkError as error:
                    self._give_up(sink, error)

    def _run_of(self, record: int) -> Run:
        """The run of the record of that number."""
        return next((run for run in reversed(self._runs) if run.first <= record), self._runs[0])

    def _handle_records(self, encoder: Encoder, records: npt.NDArray[np.float64], first: int) -> None:
        """Records of consecutive numbers from `first` on. Shape (n, layout.size)."""
        cycles = np.rint(records[:, encoder.cycle_at]).astype(np.int64)
        due = cycles % self._loop_every == 0
        for _, every in self._sinks:
            due |= cycles % every == 0
        window_from, before = 0, self._handled
        for place in np.flatnonzero(due).tolist():
            self._handled = before + place
            cycle, run = int(cycles[place]), self._run_of(first + place)
            sample = encoder.sample(records[place], cycle, run.start_ns, run.number, run.name)
            sinks = [sink for sink, every in self._sinks if cycle % every == 0]
            if sinks:
                for stream in encoder.streams:
                    self._put(sinks, stream.key, stream.encode(sample), sample.timestamp, cycle)
            if cycle % self._loop_every == 0:
                encoder.window.add(records[window_from : place + 1])
                window_from = place + 1
                payload = encoder.window.encode(sample, self._records.lost)
                self._put([sink for sink, _ in self._sinks], encoder.window.key, payload, sample.timestamp, cycle)
        self._handled = before + len(records)
        encoder.window.add(records[window_from:])
        self._cycle = int(cycles[-1])
        self._timestamp = self._run_of(first + len(records) - 1).start_ns + round(records[-1, encoder.time_at] * 1e9)

    def _handle_frames(self, records: npt.NDArray[np.uint8]) -> bool:
        """Records of the frame ring; whether there were any."""
        if self._can_log is None or not len(records):
            return False
        try:
            for frames, stamps, sent in batches(records):
                self._can_log.write(frames, stamps, sent)
        except SinkError as error:
            self._can_log = None
            self.report(error.code, str(error), "error")
        return True

    # -- sinks -------------------------------------------------------------------------------------------------------

    def _put(self, sinks: Sequence[MessageSink], key: str, payload: bytes, timestamp: int, cycle: int) -> None:
        for sink in sinks:
            try:
                sink.put(key, payload, timestamp, cycle)
            except SinkError as error:
                self._give_up(sink, error)
        if self._recorder is not None and self._recorder.saved != self._saved:
            self._saved = self._recorder.saved
            self._keep()

    def _keep(self) -> None:
        """Count the records handled so far as saved."""
        self._records.keep(self._handled - self._kept)
        self._kept = self._handled

    def _give_up(self, failed: MessageSink, error: SinkError) -> None:
        """Go on without a sink."""
        if any(sink is failed for sink, _ in self._sinks):
            self._sinks = [(sink, every) for sink, every in self._sinks if sink is not failed]
            self.report(error.code, str(error), "error")

    def report(self, code: str, text: str, severity: str, value: float = 0.0) -> None:
        """An event of the telemetry process itself, which is also a notice at the end."""
        self.notices.append(text)
        self._tell(Event(self._cycle, code, text, severity, "TELEMETRY", value), self._timestamp)

    def _tell(self, event: Event, timestamp: int) -> None:
        if self._encoder is not None:
            payload = self._encoder.event(event, timestamp)
            self._put([sink for sink, _ in self._sinks], EVENTS, payload, timestamp, event.cycle)

    def _report_lost(self) -> None:
        lost = self._records.lost
        if lost > self._lost and time.monotonic() - self._lost_reported > _DROPPED_EVERY:
            text = f"telemetry did not see {lost - self._lost} cycles, they came faster than it could read"
            self._lost, self._lost_reported = lost, time.monotonic()
            self.report("TELEMETRY_DROPPED", text, "warning", float(lost))

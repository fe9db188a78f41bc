"""Telemetry in the process of the control loop: a context manager that owns the rings and the telemetry subprocess.

The subprocess (see `child` and `service`) has its own process group, so Ctrl-C in the terminal ends only the loop, which then
closes the rings. The subprocess may be killed or suspended (SIGSTOP) at any time. On the wall clock, the loop never waits for
the subprocess. In lock-step with a recording or a CAN log, the loop waits when a ring is full, for at most `patience`.

If the loop calls `tend` several times per second, a subprocess that ended or hangs is replaced. The new subprocess reads the
same rings and writes new files. The old files are kept. The new subprocess listens on the same endpoint, or on another endpoint
if the first endpoint is in use.
"""

from __future__ import annotations

import itertools
import os
import re
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from atalante_hal.closing import Closing
from atalante_hal.record_layout import Layout
from atalante_hal.safety.events import EVENT_BYTES, EVENT_SLOTS, Event, pack
from atalante_hal.telemetry.access import Access, AccessError
from atalante_hal.telemetry.child import EVENTS, FRAMES, RECORDS, TelemetryChild
from atalante_hal.telemetry.frames import FRAME_RECORD, RingTap, Stamps
from atalante_hal.telemetry.ring import RingWriter

CYCLES_PER_SECOND = 1000
CYCLE_NS = 1_000_000_000 // CYCLES_PER_SECOND
#: Gap [ns] in log time between two runs in lock-step. The gap separates the runs in a plot.
RUN_GAP_NS = 1_000_000_000


#: The subprocess counts as hung if it has read no record for `HANGS_AFTER` [s] while a ring contained records.
HANGS_AFTER = 2.0
#: Largest number of restarts in a session.
RESTARTS = 3
#: Time between two attempts of `close` to kill a subprocess that is still starting [s].
_KILLED = 0.1
#: Time limit for the subprocess to end its Zenoh session after it has sent its summary [s].
#: If the subprocess needs more time, `close` kills it.
_SESSION_END = 2.0
#: Time limit for the start of a restarted subprocess [s].
#: A subprocess that is not ready in time is ended. Then `tend` restarts the subprocess again.
_RESTART = 30.0
#: Time limit for the start of the first subprocess on the wall clock [s].
#: A subprocess that is not ready in time is ended. Then `tend` starts a new subprocess.
#: A run may begin before the subprocess is ready, see `TelemetryProcess.start`.
_JOIN = 60.0


#: Fields of the configuration that are paths.
_PATHS = ("recording", "can_log", "certificate", "private_key", "client_ca", "users")


class TelemetryError(RuntimeError):
    """Error on starting the telemetry; the message names the cause and the valid values."""


@dataclass(frozen=True)
class TelemetryConfig:
    """Configuration of the telemetry: what is published, recorded and logged, and where."""

    robot: str = "exo"  # name of the robot in the Zenoh keys atalante/<robot>/...
    publish: bool = True  # whether messages are published on Zenoh
    listen: str | None = None  # Zenoh endpoint; None means the first free port from tcp/127.0.0.1:7447 on
    stream_rate: int = 100  # publishing rate of each stream [Hz], for example 100 for every tenth cycle
    loop_rate: int = 10  # rate of the loop statistics [Hz], for example 10 for every hundredth cycle
    recording: Path | None = None  # MCAP file; None if nothing is recorded
    record_rate: int = 100  # recording rate of each stream [Hz], for example 1000 for every cycle
    can_log: Path | None = None  # log file of all CAN frames; the file suffix determines the format; None for no log
    lock_step: bool = False  # True in virtual time (lock-step): the loop waits if recorder or CAN log are too slow
    #: Number of slots of the ring of cycle records: at one record per cycle, 1024 slots store the last 1023 cycles.
    #: The ring of CAN frames has the same number of slots. Each frame record contains the frames of two or three cycles.
    slots: int = 1024
    patience: float = 5.0  # longest wait of the loop for the recorder or the CAN log in lock-step [s]
    certificate: Path | None = None  # TLS certificate, see `access.Access`
    private_key: Path | None = None  # private key of the TLS certificate, see `access.Access`
    client_ca: Path | None = None  # authority that signs the subscriber certificates, see `access.Access`
    users: Path | None = None  # users and passwords, see `access.Access`

    def __post_init__(self) -> None:
        if not re.fullmatch(r"[A-Za-z0-9_-]+", self.robot):
            raise TelemetryError(f"robot must be a name of letters, digits, - and _, got {self.robot!r}")
        for name in ("stream_rate", "loop_rate", "record_rate"):
            rate = getattr(self, name)
            if rate < 1 or CYCLES_PER_SECOND % rate:
                raise TelemetryError(
                    f"{name.replace('_', ' ')} must be a divisor of {CYCLES_PER_SECOND} Hz, such as 10, 50, 100, 200, 250, "
                    f"500 or 1000, got {rate} Hz"
                )
        try:
            access = self.access
            if self.listen is not None:
                access.check_endpoint(self.listen)
        except AccessError as error:
            raise TelemetryError(str(error)) from error

    @property
    def access(self) -> Access:
        """Return the files that restrict access to the endpoint."""
        return Access(self.certificate, self.private_key, self.client_ca, self.users)

    @property
    def requires_publisher(self) -> bool:
        """Return whether publishing was requested with an endpoint, TLS or users, so that the session must have a publisher."""
        return self.publish and (self.listen is not None or self.access != Access())

    def to_json(self) -> dict[str, Any]:
        """Return the configuration as JSON types."""
        return {name: str(value) if isinstance(value, Path) else value for name, value in asdict(self).items()}

    @classmethod
    def from_json(cls, values: Mapping[str, Any]) -> TelemetryConfig:
        """Create a configuration from the values that `to_json` returned.

        Args:
            values: Value of each field, as JSON types.

        Returns:
            The configuration.
        """
        paths = {name: Path(values[name]) for name in _PATHS if values[name] is not None}
        return cls(**{**values, **paths})


@dataclass(frozen=True)
class Recording:
    """Files of the recording of a session, and whether they are complete.

    At a recording rate below 1000 Hz not every cycle has a message. The cycles between two messages count as recorded as soon
    as the second message is recorded.
    """

    files: tuple[str, ...]  # file names in order; each restart of the subprocess begins a new file
    complete: bool  # True if there is one file, with an index and with all cycles
    #: Number of cycles that are not in the files.
    #: If a subprocess was killed, `missing_cycles` can be too high by at most the number of cycles in one MCAP chunk.
    missing_cycles: int


@dataclass(frozen=True)
class TelemetrySummary:
    """Result of a telemetry session."""

    complete: bool = False  # False if a subprocess ended without a summary; then message and frame counts are too low
    published: int = 0  # number of published messages
    recorded: int = 0  # number of recorded messages
    frames_logged: int = 0
    can_log_complete: bool = True  # False if a requested CAN log lacks frames, has several files or was not closed
    lost: int = 0  # number of cycles that telemetry lost, because it read more slowly than the loop wrote
    frames_lost: int = 0  # number of lost records with CAN frames; a record contains up to 64 frames
    restarts: int = 0  # number of restarts of the subprocess after it ended or hung
    notices: tuple[str, ...] = field(default=())  # one sentence for each fault of the session
    recording: Recording | None = None  # None if no recording was requested


class TelemetryProcess(Closing):
    """Telemetry of one session: the rings, which the loop writes, and the subprocess, which reads them.

    Use it as a context manager around all runs of the session, or call `start` and `close`.

    Args:
        config: Configuration of the telemetry.
        layout: Layout of the records passed to `write`.
        bus_of: Bus of each frame identifier, for the CAN log.
        buses: Buses of the network in the order of the DBC, for the CAN log.
        diagnostics: Names of the bits of the field "diagnostics", lowest bit first.
        about: Metadata of the recording (hashes, versions, seed).
        child: Subprocess that was started early and is not configured yet. None: `start` starts one.
    """

    def __init__(
        self,
        config: TelemetryConfig,
        layout: Layout,
        *,
        bus_of: Mapping[int, str] | None = None,
        buses: Sequence[str] = (),
        diagnostics: Sequence[str] = (),
        about: Mapping[str, object] | None = None,
        child: TelemetryChild | None = None,
    ) -> None:
        self.config, self.layout = config, layout
        self.endpoint: str | None = None  # endpoint for subscribers; a restart may change it
        self.notices: tuple[str, ...] = ()  # one sentence for each fault during the start
        self._start_ns = 0 if config.lock_step else time.time_ns()
        self._runs = 0
        self._closed = False
        self._tap: RingTap | None = None
        self._early = child  # subprocess that was started before the first call of `start`; None if there is none
        self._child: TelemetryChild | None = None
        self._restarts = 0
        self._abandoned = False  # True if the subprocess failed again after its last allowed restart
        self._faults: list[str] = []  # one sentence for each fault of a subprocess
        self._recordings: list[str] = []  # names of the recording files begun so far
        self._last_endpoint: str | None = None  # last endpoint in use; None before the first endpoint was opened
        self._restarting: threading.Thread | None = None  # thread that starts or restarts the subprocess
        #: Number of records read or lost so far, and last time at which this number had changed or no record waited [s].
        self._progress = (0, 0.0)
        meta = {
            "layout": layout.to_json(),
            "diagnostics": list(diagnostics),
            "about": {name: str(value) for name, value in (about or {}).items()},
            "start_ns": self._start_ns,
        }
        files = child.take_files() if child is not None else {}
        lossless = config.lock_step
        self.records = RingWriter(
            layout.size * 8,
            config.slots,
            lossless=lossless and config.recording is not None,
            patience=config.patience,
            meta=meta,
            fd=files.get(RECORDS),
        )
        self.events = RingWriter(EVENT_BYTES, EVENT_SLOTS, fd=files.get(EVENTS))
        self.frames: RingWriter | None = None
        if config.can_log is not None:
            frame_meta = {"buses": list(buses), "bus_of": {str(key): bus for key, bus in (bus_of or {}).items()}}
            self.frames = RingWriter(
                FRAME_RECORD.itemsize,
                config.slots,
                lossless=lossless,
                patience=config.patience,
                meta=frame_meta,
                fd=files.get(FRAMES),
            )
        elif FRAMES in files:
            os.close(files[FRAMES])

    def start(self, timeout: float = 60.0) -> None:
        """Start the subprocess and wait until it has opened its files and its Zenoh session.

        On the wall clock, a subprocess that is not ready in time begins to read later. Until then the rings keep the
        newest records, and older records are counted as lost. In lock-step a subprocess that is not ready in time is an
        error, because the loop would wait for it.

        Args:
            timeout: Longest wait [s].

        Raises:
            TelemetryError: If a requested file or endpoint cannot be opened, or, in lock-step, if the subprocess is not ready in
                time.
        """
        try:
            if self.config.lock_step:
                self.notices = self._launch(self.config, timeout)
            else:
                self._start_in_background(timeout)
        except BaseException:  # BaseException includes a KeyboardInterrupt during the wait
            self.close(0.0)
            raise

    def _start_in_background(self, timeout: float) -> None:
        """Start the subprocess in a thread and wait until the subprocess is ready.

        Args:
            timeout: Longest wait [s]. After this time, the thread continues in the background.

        Raises:
            TelemetryError: If the start fails within the timeout.
        """
        result: list[tuple[str, ...] | TelemetryError] = []

        def launch() -> None:
            try:
                notices = self._launch(self.config, _JOIN)
            except TelemetryError as error:
                result.append(error)
                self._faults.append(str(error))
                if self._child is not None:
                    self._child.close()
            else:
                result.append(notices)
                self._faults.extend(notices)

        self._restarting = threading.Thread(target=launch, daemon=True)
        self._restarting.start()
        self._restarting.join(timeout)
        if not result:
            self.notices = (
                "the telemetry process is not ready yet: the run starts now, and telemetry begins when the process is ready",
            )
        elif isinstance(result[0], TelemetryError):
            raise result[0]
        else:
            self.notices = result[0]

    def _launch(self, config: TelemetryConfig, timeout: float) -> tuple[str, ...]:
        """Start a subprocess and wait until it is ready.

        Args:
            config: Configuration of this subprocess.
            timeout: Longest wait [s].

        Returns:
            One sentence for each notice of the subprocess.

        Raises:
            TelemetryError: If a file or endpoint cannot be opened, or if the subprocess is not ready in time.
        """
        rings = {RECORDS: self.records, EVENTS: self.events, FRAMES: self.frames}
        fds = {name: ring.fd for name, ring in rings.items() if ring is not None}
        before = {"restarts": self._restarts, "endpoint": self._last_endpoint}
        self._child, self._early = self._early or TelemetryChild(fds), None
        self._child.configure({"config": config.to_json(), "rings": fds, **before})
        report = self._child.report(timeout)
        if report is None:
            limit = "at the end of the run" if self._closed else f"within {timeout:.0f} s"
            raise TelemetryError(f"the telemetry process was not ready {limit}")
        if "error" in report:
            raise TelemetryError(report["error"])
        self.endpoint = report["endpoint"]
        self._last_endpoint = self.endpoint or self._last_endpoint
        if config.recording is not None:
            self._recordings.append(config.recording.name)
        return tuple(report["notices"])

    def tend(self) -> None:
        """Restart the subprocess in the background if it has ended or hangs. Call this several times per second.

        The new subprocess reads the records that the old subprocess has not read, and writes new files with numbered names.
        It listens on the same endpoint. If this endpoint is in use, the new subprocess listens on another endpoint
        (`endpoint` changes) or does not publish (`endpoint` is None).
        """
        if self._closed or self._child is None or (self._restarting is not None and self._restarting.is_alive()):
            return
        fault = self._fault(time.monotonic())
        if not fault or self._abandoned:
            return
        restart = self._restarts < RESTARTS
        self._restarts += restart
        self._abandoned = not restart
        last = self.records.last()
        cycle = int(np.frombuffer(last)[self.layout["cycle"]][0]) if last else 0
        text = f"telemetry {fault}; it is {'restarted' if restart else f'not restarted after {RESTARTS} restarts'}"
        self._faults.append(text)
        self.event(Event(cycle, "TELEMETRY_DOWN", text, "error", "TELEMETRY", self._restarts))
        if restart:
            # The restart runs in a thread, because a restart takes longer than a cycle.
            self._restarting = threading.Thread(target=self._restart, daemon=True)
            self._restarting.start()

    def _fault(self, now: float) -> str:
        """Return the fault of the subprocess, "has ended" or "hangs"; empty if there is no fault."""
        if not self.alive:
            return "has ended"
        taken = self._taken
        if taken != self._progress[0] or taken == sum(ring.written for ring in self._rings) or not self._progress[1]:
            self._progress = taken, now
        return "hangs" if now - self._progress[1] > HANGS_AFTER else ""

    @property
    def _rings(self) -> list[RingWriter]:
        return [ring for ring in (self.frames, self.events, self.records) if ring is not None]

    @property
    def _taken(self) -> int:
        """Return the number of records that the subprocess has read or lost so far, in all rings together."""
        return sum(ring.taken for ring in self._rings)

    def _restart(self) -> None:
        assert self._child is not None
        self._child.close()
        self._progress = 0, 0.0
        config = replace(
            self.config,
            recording=_numbered(self.config.recording, self._restarts),
            can_log=_numbered(self.config.can_log, self._restarts),
        )
        try:
            self._faults.extend(self._launch(config, _RESTART))
        except TelemetryError as error:
            self._faults.append(str(error))
            self._child.close()

    def tap(self, now: Callable[[], int] = time.time_ns, stamps: Callable[[], Stamps] | None = None) -> RingTap:
        """Create the frame tap, which passes the HAL's frames to the CAN log. A new tap replaces the previous tap.

        Args:
            now: Function that returns the time of a sent frame [ns]; in lock-step the virtual time since the start of the run.
            stamps: Function that returns the receive times of the last received frames [ns], such as `lambda: bus.stamps`.
                If None, received frames also get the time `now()`.

        Returns:
            Tap for the HAL.

        Raises:
            TelemetryError: If the configuration has no CAN log.
        """
        if self.frames is None:
            raise TelemetryError("a frame tap needs a CAN log: set can_log in the telemetry configuration")
        if self._tap is not None:
            self._tap.flush()
        self._tap = RingTap(self.frames, now, stamps)
        self._tap.begin_run(self._start_ns if self.config.lock_step else 0)
        return self._tap

    def begin_run(self, name: str, about: Mapping[str, object] | None = None) -> None:
        """Begin a run, to which all following records belong.

        Example: a program that compares three shapes of the guide begins one run for each shape.

        The robot time of a run begins at 0. The log time of a run begins at the current time of day. In lock-step the
        log time begins 1 s after the log time of the last record.

        Args:
            name: Name of the run.
            about: Metadata of the run (shape, xi, seed).
        """
        if not self.config.lock_step:
            self._start_ns = time.time_ns()
        elif last := self.records.last():
            self._start_ns += round(float(np.frombuffer(last)[self.layout["time"]][0]) * 1e9) + RUN_GAP_NS
        if self._tap is not None:
            self._tap.begin_run(self._start_ns if self.config.lock_step else 0)
        facts = {key: str(value) for key, value in (about or {}).items()}
        self.records.add_note({"run": self._runs, "name": name, "start_ns": self._start_ns, "about": facts})
        self._runs += 1

    def write(self, record: memoryview | npt.NDArray[np.float64]) -> None:
        """Copy the record of a cycle to the ring. On the wall clock, add the time of day.

        Args:
            record: Values of the record, shape (layout.size,). A memoryview is copied fastest.
        """
        self.records.write(record, self._time_ns())

    def _time_ns(self) -> int:
        """Return the time of day [ns]. Return 0 in lock-step, where the log time follows from the robot time."""
        return 0 if self.config.lock_step else time.time_ns()

    def event(self, event: Event) -> None:
        """Publish and record an event.

        Args:
            event: Event of the current run.
        """
        self.events.write(pack(event, max(0, self._runs - 1)), self._time_ns())

    @property
    def alive(self) -> bool:
        """Return whether the subprocess exists, even if it is suspended. The call is too slow for every cycle."""
        return self._child is not None and self._child.alive

    @property
    def lost(self) -> int:
        """Return the number of cycles that telemetry has lost so far."""
        return self.records.lost

    def close(self, timeout: float = 10.0) -> TelemetrySummary:
        """Let the subprocess read the rings and close its files, then end the subprocess and release the rings.

        Nothing can be written afterwards. A second call has no effect. A failed subprocess raises no exception here.

        Args:
            timeout: The subprocess is killed if it reads no record for this time and does not end [s].

        Returns:
            Result of the session.
        """
        if self._closed:
            return TelemetrySummary()
        self._closed = True
        rings = self._rings
        report: dict[str, Any] | None = None
        if self._tap is not None:
            self._tap.flush()
        for ring in rings:
            ring.finish()
        self._await_start(timeout)
        if self._child is not None:
            report = self._last_report(self._child, timeout)
            self._child.close(_SESSION_END if report is not None else 0.0)
            self._child = None
        if self._early is not None:
            self._early.close()
        summary = self._summary(report if report is not None and "error" not in report else None)
        for ring in rings:
            ring.close()
        return summary

    def _await_start(self, timeout: float) -> None:
        """Wait until a start in the background has finished. If the start takes too long, kill the subprocess.

        Args:
            timeout: Longest wait [s].
        """
        if self._restarting is None:
            return
        self._restarting.join(timeout)
        while self._restarting.is_alive():
            if self._child is not None:
                self._child.kill()
            self._restarting.join(_KILLED)

    def _last_report(self, child: TelemetryChild, timeout: float) -> dict[str, Any] | None:
        """Return the summary of the subprocess. Return None if it has ended or has made no progress.

        Args:
            child: Subprocess.
            timeout: Longest wait without progress [s]. Progress means that the subprocess reads a record.
        """
        while True:
            before = self._taken
            report = child.report(timeout)
            if report is not None or self._taken == before:
                return report

    def _summary(self, report: Mapping[str, Any] | None) -> TelemetrySummary:
        """Summarise the session after its last subprocess has ended.

        Args:
            report: Last line that the last subprocess printed; None if it printed no line.

        Returns:
            Result of the session.
        """
        facts = {"lost": self.records.lost, "notices": (), "finished": False, **(report or {})}
        finished = facts.pop("finished") and not self._restarts
        logged = facts.pop("can_log_finished", False) and not self._restarts and not facts.get("frames_lost")
        notices = tuple(dict.fromkeys((*self._faults, *facts.pop("notices"))))
        missing = self.records.written - self.records.kept
        recording = Recording(tuple(self._recordings), finished and not missing, missing)
        return TelemetrySummary(
            complete=report is not None and not self._restarts,
            restarts=self._restarts,
            can_log_complete=logged or self.config.can_log is None,
            notices=notices,
            recording=recording if self.config.recording is not None else None,
            **facts,
        )

    def __enter__(self) -> Self:
        self.start()
        return self


def _numbered(path: Path | None, number: int) -> Path | None:
    """Return the file name for a restarted subprocess, such as recording-1.mcap for recording.mcap.

    Args:
        path: File of the first subprocess.
        number: First number to use. Numbers of existing files are skipped, so that no file is overwritten.
    """
    if path is None:
        return None
    stem, dot, suffixes = path.name.partition(".")
    names = (path.with_name(f"{stem}-{n}{dot}{suffixes}") for n in itertools.count(number))
    return next(name for name in names if not name.exists())

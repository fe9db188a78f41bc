"""The telemetry process as the loop's process sees it: a context manager around two or three rings and a child.

The child is a fresh interpreter (`python -m atalante_hal.telemetry`, see `service`), never a fork, in a process group of
its own: the terminal's Ctrl-C goes to the loop, which then closes the rings. It may be killed, stopped or starved at any
time: `write` never waits for it, except in lock-step with a recording or a CAN log, and there not for long. A loop that
calls `tend` now and then gets a new child for one that died or hangs: same rings, the same endpoint or, if that is taken,
another one as at the first start, files of its own beside those of the first.
"""

from __future__ import annotations

import json
import os
import re
import selectors
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Self

import numpy as np

from atalante_hal.closing import Closing
from atalante_hal.record_layout import Layout
from atalante_hal.safety.events import EVENT_BYTES, EVENT_SLOTS, Event, pack
from atalante_hal.telemetry.access import Access, AccessError
from atalante_hal.telemetry.frames import FRAME_RECORD, RingTap, Stamps
from atalante_hal.telemetry.ring import RingWriter

CYCLES_PER_SECOND = 1000
CYCLE_NS = 1_000_000_000 // CYCLES_PER_SECOND
#: Between the last record of a run in lock-step and the first of the next [ns], so that a plot shows where one ends.
RUN_GAP_NS = 1_000_000_000


#: A child that takes nothing for so long while there is something [s] hangs; so many are replaced in a session.
HANGS_AFTER = 2.0
RESTARTS = 3
#: For the child to leave its Zenoh session after it has said what became of its files [s].
_LAST_WORDS = 2.0
#: For a child that replaces another to be ready [s].
_RESTART = 30.0


#: Fields of the configuration that are files.
_PATHS = ("recording", "can_log", "certificate", "private_key", "client_ca", "users")


class TelemetryError(RuntimeError):
    """Telemetry cannot start as asked; the message says why and what is valid."""


@dataclass(frozen=True)
class TelemetryConfig:
    """What leaves the robot, and where to."""

    robot: str = "exo"  # one chunk of the Zenoh keys atalante/<robot>/...
    publish: bool = True  # on Zenoh
    listen: str | None = None  # Zenoh endpoint; None: first free port from tcp/127.0.0.1:7447 on
    stream_rate: int = 100  # Hz of robot time, messages of each stream
    loop_rate: int = 10  # Hz of robot time, loop statistics
    recording: Path | None = None  # MCAP file
    record_rate: int = 100  # Hz of robot time; 1000 is every cycle
    can_log: Path | None = None  # every frame, format by suffix
    lock_step: bool = False  # virtual time; the loop waits for a recorder and a CAN log
    slots: int = 1024  # records a ring holds: cycles that telemetry may be late
    patience: float = 5.0  # s, longest wait of the loop for a recorder in lock-step, once
    certificate: Path | None = None  # these four: see `access.Access`
    private_key: Path | None = None
    client_ca: Path | None = None
    users: Path | None = None

    def __post_init__(self) -> None:
        if not re.fullmatch(r"[A-Za-z0-9_-]+", self.robot):
            raise TelemetryError(f"the robot's name {self.robot!r} is not valid; use letters, digits, - and _")
        for name in ("stream_rate", "loop_rate", "record_rate"):
            rate = getattr(self, name)
            if rate < 1 or CYCLES_PER_SECOND % rate:
                raise TelemetryError(
                    f"{name.replace('_', ' ')} {rate} Hz is not valid; it must divide {CYCLES_PER_SECOND}, "
                    "as 1, 10, 50, 100, 200, 250, 500 and 1000 do"
                )
        try:
            access = self.access
            if self.listen is not None:
                access.check_endpoint(self.listen)
        except AccessError as error:
            raise TelemetryError(str(error)) from error

    @property
    def access(self) -> Access:
        """Who may subscribe."""
        return Access(self.certificate, self.private_key, self.client_ca, self.users)

    def to_json(self) -> dict[str, Any]:
        """As what `json.dumps` takes."""
        return {name: str(value) if isinstance(value, Path) else value for name, value in asdict(self).items()}

    @classmethod
    def from_json(cls, values: Mapping[str, Any]) -> TelemetryConfig:
        """The inverse of `to_json`."""
        paths = {name: Path(values[name]) for name in _PATHS if values[name] is not None}
        return cls(**{**values, **paths})


@dataclass(frozen=True)
class Recording:
    """What became of the recording of a session."""

    files: tuple[str, ...]  # names, in order: one of the first child and one of each child that replaced another
    complete: bool  # one file with its index, and no cycle is missing
    missing_cycles: int  # of the loop, in no file; at 100 Hz the cycles between two messages belong to the second one


@dataclass(frozen=True)
class TelemetrySummary:
    """What became of a session; `complete` is False when a child died and could not say."""

    complete: bool = False
    published: int = 0  # messages
    recorded: int = 0  # messages
    frames_logged: int = 0
    lost: int = 0  # cycles that telemetry did not see
    frames_lost: int = 0  # records of the frame ring, one a cycle
    restarts: int = 0  # children that died or hung and were replaced
    notices: tuple[str, ...] = field(default=())  # what went wrong, one sentence each
    recording: Recording | None = None  # None: no recording was asked for


class TelemetryProcess(Closing):
    """The telemetry of one session: rings to write, and the child that empties them.

    Use it as a context manager around every run of the session, or call `start` and `close`.

    Args:
        config: what leaves, and where to.
        layout: of the records that `write` gets.
        bus_of: frame id -> network bus, for the CAN log.
        buses: network buses in the order of the DBC, for the CAN log.
        diagnostics: names of the bits of the field "diagnostics", lowest first.
        about: metadata of the recording (hashes, versions, seed).
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
    ) -> None:
        self.config, self.layout = config, layout
        self.endpoint: str | None = None  # where subscribers connect, once started; a restart may change it
        self.notices: tuple[str, ...] = ()  # of the start, one sentence each
        self._start_ns = 0 if config.lock_step else time.time_ns()
        self._runs = 0
        self._closed = False
        self._tap: RingTap | None = None
        self._child: subprocess.Popen[bytes] | None = None
        self._restarts = 0
        self._mishaps: list[str] = []  # of children, one sentence each
        self._recordings: list[str] = []  # names of the files that were begun
        self._last_endpoint: str | None = None  # not None once something was published
        self._restarting: threading.Thread | None = None
        self._progress = (0, 0.0)  # records taken when `tend` looked, and since when [s]
        meta = {
            "layout": layout.to_json(),
            "diagnostics": list(diagnostics),
            "about": {name: str(value) for name, value in (about or {}).items()},
            "start_ns": self._start_ns,
        }
        lossless = config.lock_step
        self.records = RingWriter(
            layout.size * 8,
            config.slots,
            lossless=lossless and config.recording is not None,
            patience=config.patience,
            meta=meta,
        )
        #: One cycle: copies its record, shape (layout.size,), into the ring. About 1 us, less with a memoryview of it made once.
        self.write = self.records.write
        self.events = RingWriter(EVENT_BYTES, EVENT_SLOTS)
        self.frames: RingWriter | None = None
        if config.can_log is not None:
            frame_meta = {"buses": list(buses), "bus_of": {str(key): bus for key, bus in (bus_of or {}).items()}}
            self.frames = RingWriter(
                FRAME_RECORD.itemsize, config.slots, lossless=lossless, patience=config.patience, meta=frame_meta
            )

    def start(self, timeout: float = 60.0) -> None:
        """Start the child and wait until it has opened its files and its session.

        Raises:
            TelemetryError: a file or an endpoint that was asked for cannot be had, or the child was not ready in time [s].
        """
        try:
            self.notices = self._launch(self.config, timeout)
        except BaseException:  # Ctrl-C while it waits, too
            self.close(0.0)
            raise

    def _launch(self, config: TelemetryConfig, timeout: float) -> tuple[str, ...]:
        """Start a child and wait until it is ready; return its notices, one sentence each. Raises as `start`."""
        rings = {"records": self.records, "events": self.events, "frames": self.frames}
        fds = {name: ring.fd for name, ring in rings.items() if ring is not None}
        before = {"restarts": self._restarts, "endpoint": self._last_endpoint}
        order = json.dumps({"config": config.to_json(), "rings": fds, **before})
        self._child = subprocess.Popen(
            [sys.executable, "-P", "-m", "atalante_hal.telemetry", order],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            pass_fds=tuple(fds.values()),
            process_group=0,
        )
        told = self._listen(timeout)
        if told is None:
            raise TelemetryError(f"the telemetry process was not ready within {timeout:.0f} s")
        if "error" in told:
            raise TelemetryError(told["error"])
        self.endpoint = told["endpoint"]
        self._last_endpoint = self.endpoint or self._last_endpoint
        if config.recording is not None:
            self._recordings.append(config.recording.name)
        return tuple(told["notices"])

    def tend(self) -> None:
        """Look after the child; call it a few times a second. A dead one, or one that hangs, is replaced in the background.

        The replacement goes on reading where the other one stopped, into files with a number. It listens on the endpoint
        the other one had. If that is taken it does as a first child does, but does not fail: `endpoint` is then another
        one, or None.
        """
        if self._closed or self._child is None or (self._restarting is not None and self._restarting.is_alive()):
            return
        what = self._ailment(time.monotonic())
        if not what or self._restarts > RESTARTS:
            return
        self._restarts += 1
        again = self._restarts <= RESTARTS
        last = self.records.last()
        cycle = int(np.frombuffer(last)[self.layout["cycle"]][0]) if last else 0
        text = f"telemetry {what}; it is {'started again' if again else 'left alone after so many restarts'}"
        self._mishaps.append(text)
        self.event(cycle, "TELEMETRY_DOWN", text, "error", "TELEMETRY", self._restarts)
        if again:
            # Not in the loop: ending a child and starting another takes longer than a cycle.
            self._restarting = threading.Thread(target=self._restart, daemon=True)
            self._restarting.start()

    def _ailment(self, now: float) -> str:
        """What is wrong with the child, empty if nothing."""
        if not self.alive:
            return "has died"
        taken = self.records.taken
        if taken != self._progress[0] or taken == self.records.written or not self._progress[1]:
            self._progress = taken, now
        return "hangs" if now - self._progress[1] > HANGS_AFTER else ""

    def _restart(self) -> None:
        assert self._child is not None
        self._end(self._child, 0.0)
        self._progress = 0, 0.0
        config = replace(
            self.config,
            recording=_numbered(self.config.recording, self._restarts),
            can_log=_numbered(self.config.can_log, self._restarts),
        )
        try:
            self._mishaps.extend(self._launch(config, _RESTART))
        except TelemetryError as error:
            self._mishaps.append(str(error))
            self._end(self._child, 0.0)

    def tap(self, now: Callable[[], int] = time.time_ns, stamps: Callable[[], Stamps] | None = None) -> RingTap:
        """What the HAL hands its frames to, for the CAN log; one for the session.

        Args:
            now: time [ns] of frames that are sent; in lock-step virtual time since the start of the run.
            stamps: times [ns] of the frames last received, such as `lambda: bus.stamps`; without it, `now()`.

        Raises:
            TelemetryError: the configuration asks for no CAN log.
        """
        if self.frames is None:
            raise TelemetryError("there is no CAN log to tap frames for; set can_log in the telemetry configuration")
        if self._tap is not None:
            self._tap.flush()
        self._tap = RingTap(self.frames, now, stamps)
        self._tap.begin_run(self._start_ns if self.config.lock_step else 0)
        return self._tap

    def begin_run(self, name: str, about: Mapping[str, object] | None = None) -> None:
        """A run begins (e.g. a guide shape), its cycle time from 0: what is written from here on belongs to it.

        Log time goes on: from now on the wall clock, from one second after the last record in lock-step.

        Args:
            about: metadata of the run (shape, xi, seed).
        """
        if not self.config.lock_step:
            self._start_ns = time.time_ns()
        elif last := self.records.last():
            self._start_ns += round(float(np.frombuffer(last)[self.layout["time"]][0]) * 1e9) + RUN_GAP_NS
        if self._tap is not None:
            self._tap.begin_run(self._start_ns if self.config.lock_step else 0)
        facts = {key: str(value) for key, value in (about or {}).items()}
        self.records.note({"run": self._runs, "name": name, "start_ns": self._start_ns, "about": facts})
        self._runs += 1

    def event(
        self, cycle: int, code: str, text: str, severity: str = "info", node: str = "HAL", value: float = 0.0
    ) -> None:
        """Something happened: published and recorded at once, see `events.Event`."""
        self.events.write(pack(Event(cycle, code, text, severity, node, value), max(0, self._runs - 1)))

    @property
    def alive(self) -> bool:
        """Whether the child runs (or is stopped). One system call: not for every cycle."""
        return self._child is not None and self._child.poll() is None

    @property
    def lost(self) -> int:
        """Cycles that telemetry has not seen so far."""
        return self.records.lost

    def close(self, timeout: float = 10.0) -> TelemetrySummary:
        """Let the child finish its files, then end it, by force after `timeout` [s]; does not raise for what it died of.

        The rings go with it: nothing can be written afterwards. A second call does nothing.
        """
        if self._closed:
            return TelemetrySummary()
        self._closed = True
        if self._restarting is not None:
            self._restarting.join()
        rings = [ring for ring in (self.frames, self.events, self.records) if ring is not None]
        told: dict[str, Any] | None = None
        if self._tap is not None:
            self._tap.flush()
        for ring in rings:
            ring.finish()
        if self._child is not None:
            told = self._listen(timeout)
            self._end(self._child, _LAST_WORDS if told is not None else 0.0)
            self._child = None
        summary = self._summary(told if told is not None and "error" not in told else None)
        for ring in rings:
            ring.close()
        return summary

    def _summary(self, told: Mapping[str, Any] | None) -> TelemetrySummary:
        """Sum up the session when no child is left.

        Args:
            told: the last line of the child that ended by itself; None when there is none.
        """
        facts = {"lost": self.records.lost, "notices": (), "finished": False, **(told or {})}
        finished = facts.pop("finished") and not self._restarts
        notices = tuple(dict.fromkeys((*self._mishaps, *facts.pop("notices"))))
        missing = self.records.written - self.records.kept
        recording = Recording(tuple(self._recordings), finished and not missing, missing)
        return TelemetrySummary(
            complete=told is not None and not self._restarts,
            restarts=self._restarts,
            notices=notices,
            recording=recording if self.config.recording is not None else None,
            **facts,
        )

    @staticmethod
    def _end(child: subprocess.Popen[bytes], patience: float) -> None:
        try:
            child.wait(patience)
        except subprocess.TimeoutExpired:
            child.kill()
            child.wait()
        assert child.stdout is not None
        child.stdout.close()

    def _listen(self, timeout: float) -> dict[str, Any] | None:
        """The next line of the child as JSON; None when it says nothing within `timeout` [s] or is gone."""
        assert self._child is not None
        assert self._child.stdout is not None
        if self._child.stdout.closed:
            return None
        pipe, line = self._child.stdout.fileno(), b""
        give_up = time.monotonic() + timeout
        with selectors.DefaultSelector() as selector:
            selector.register(pipe, selectors.EVENT_READ)
            while not line.endswith(b"\n"):
                if not selector.select(max(0.0, give_up - time.monotonic())):
                    return None
                read = os.read(pipe, 1 << 16)
                if not read:
                    return None
                line += read
        told: dict[str, Any] = json.loads(line)
        return told

    def __enter__(self) -> Self:
        self.start()
        return self


def _numbered(path: Path | None, number: int) -> Path | None:
    """The file beside `path` of the child of that number: recording.mcap, recording-1.mcap."""
    if path is None:
        return None
    stem, dot, suffixes = path.name.partition(".")
    return path.with_name(f"{stem}-{number}{dot}{suffixes}")

"""The telemetry process: `python -m atalante_hal.telemetry ORDER`, started by `process.TelemetryProcess` and nobody else.

ORDER is JSON: the configuration, the inherited descriptors of the rings, the number of processes before this one, and the
endpoint of the last of them. One JSON line on stdout says that everything is open (or what could not be had), another at the
end what became of it.
"""

from __future__ import annotations

import contextlib
import json
import logging
import os
import signal
import sys
from typing import TYPE_CHECKING, Any

from atalante_hal.record_layout import Layout
from atalante_hal.telemetry.process import CYCLES_PER_SECOND, TelemetryConfig
from atalante_hal.telemetry.ring import RingReader
from atalante_hal.telemetry.service import Service
from atalante_hal.telemetry.sink import MessageSink, SinkError

if TYPE_CHECKING:
    from atalante_hal.telemetry.can_log import CanLog
    from atalante_hal.telemetry.messages import Encoder
    from atalante_hal.telemetry.publisher import Publisher
    from atalante_hal.telemetry.recorder import Recorder

_INSTALL = "install it with `pip install 'atalante-hal[telemetry]'`"


#: Zenoh needs ten seconds to end a session with a stopped subscriber; everything that matters is on the disk by then [s].
_LAST_WORDS = 1.0


class Outlets:
    """The sinks that a configuration asks for, opened; those that may be refused come before the one with a socket.

    Args:
        restarts: telemetry processes that this one replaces.
        before: endpoint of the last of them.

    Raises:
        SinkError: a file or an endpoint that was asked for cannot be had. Whatever is only a default (publishing on a free
            port of the loopback) becomes a notice instead, as does every endpoint of a restart: the recording goes on.
    """

    def __init__(
        self,
        config: TelemetryConfig,
        records: RingReader,
        frames: RingReader | None,
        restarts: int = 0,
        before: str | None = None,
    ) -> None:
        self.notices: list[str] = []
        self.publisher: Publisher | None = None
        self.recorder: Recorder | None = None
        self.can_log = _open_can_log(config, frames)
        self.encoder = self._make_encoder(config, records.meta)
        if self.encoder is None:
            return
        streams = self.encoder.keys
        if config.recording is not None:
            self.recorder = _open_recorder(config, streams, records.meta["about"])
        if config.publish:
            try:
                self.publisher = _open_publisher(config, streams, before)
            except SinkError as error:
                if config.listen is not None and not restarts:
                    raise
                self.notices.append(f"nothing is published: {error}")

    def _make_encoder(self, config: TelemetryConfig, meta: dict[str, Any]) -> Encoder | None:
        if not config.publish and config.recording is None:
            return None
        try:
            from atalante_hal.telemetry.messages import Encoder
        except ImportError as error:
            if config.recording is not None:
                raise SinkError("RECORD_STOPPED", f"a recording needs {error.name}: {_INSTALL}") from error
            self.notices.append(f"nothing is published, {error.name} is missing: {_INSTALL}")
            return None
        return Encoder(Layout.from_json(meta["layout"]), meta["diagnostics"])

    @property
    def endpoint(self) -> str | None:
        """Where subscribers connect."""
        return self.publisher.endpoint if self.publisher is not None else None

    def sinks(self, config: TelemetryConfig) -> list[tuple[MessageSink, int]]:
        """Recorder and publisher with the cycles between two messages of a stream."""
        pairs = ((self.recorder, config.record_rate), (self.publisher, config.stream_rate))
        return [(sink, CYCLES_PER_SECOND // rate) for sink, rate in pairs if sink is not None]

    def close_files(self) -> None:
        """Finish recording and CAN log; what fails becomes a notice."""
        for file in (self.recorder, self.can_log):
            if file is not None:
                try:
                    file.close()
                except SinkError as error:
                    self.notices.append(str(error))

    def summary(self) -> dict[str, int]:
        """Return what went where: published and recorded messages, logged frames, and whether the recording has its end."""
        return {
            "published": self.publisher.messages if self.publisher is not None else 0,
            "recorded": self.recorder.messages if self.recorder is not None else 0,
            "finished": self.recorder is not None and self.recorder.finished,
            "frames_logged": self.can_log.frames if self.can_log is not None else 0,
        }


def _open_can_log(config: TelemetryConfig, frames: RingReader | None) -> CanLog | None:
    if config.can_log is None or frames is None:
        return None
    from atalante_hal.telemetry.can_log import CanLog

    meta = frames.meta
    return CanLog(config.can_log, meta["buses"], {int(frame_id): bus for frame_id, bus in meta["bus_of"].items()})


def _open_recorder(config: TelemetryConfig, streams: list[tuple[str, str]], about: dict[str, str]) -> Recorder:
    try:
        from atalante_hal.telemetry.recorder import Recorder
    except ImportError as error:
        raise SinkError("RECORD_STOPPED", f"a recording needs {error.name}: {_INSTALL}") from error
    assert config.recording is not None
    return Recorder(config.recording, streams, {**about, "record_rate_hz": config.record_rate})


def _open_publisher(config: TelemetryConfig, streams: list[tuple[str, str]], before: str | None) -> Publisher:
    try:
        from atalante_hal.telemetry.publisher import Publisher
    except ImportError as error:
        raise SinkError("TELEMETRY_DOWN", f"{error.name} is missing: {_INSTALL}") from error
    return Publisher(config.robot, streams, config.listen, config.access, before)


def _say(line: dict[str, Any]) -> None:
    """One JSON line for the process that started this one; it may be gone."""
    with contextlib.suppress(BrokenPipeError):
        os.write(sys.stdout.fileno(), json.dumps(line).encode() + b"\n")


def _be_ordinary() -> None:
    """Do not compete with the loop, whose real-time priority a child inherits."""
    if os.sched_getscheduler(0) != os.SCHED_OTHER:
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))


def main(order: str) -> int:
    """Run until the rings are closed or SIGTERM comes. Returns the exit code."""
    stop: list[int] = []
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, lambda number, _: stop.append(number))
    logging.basicConfig(level=logging.WARNING)
    _be_ordinary()
    ordered = json.loads(order)
    config = TelemetryConfig.from_json(ordered["config"])
    fds: dict[str, int] = ordered["rings"]
    with contextlib.ExitStack() as stack:
        records, events = (stack.enter_context(RingReader(fds[name])) for name in ("records", "events"))
        frames = stack.enter_context(RingReader(fds["frames"])) if "frames" in fds else None
        try:
            outlets = Outlets(config, records, frames, ordered["restarts"], ordered["endpoint"])
        except SinkError as error:
            _say({"error": str(error)})
            return 1
        service = Service(
            records,
            events,
            frames,
            encoder=outlets.encoder,
            sinks=outlets.sinks(config),
            loop_every=CYCLES_PER_SECOND // config.loop_rate,
            can_log=outlets.can_log,
            recorder=outlets.recorder,
        )
        _say({"endpoint": outlets.endpoint, "notices": outlets.notices})
        while outlets.notices:
            service.report("TELEMETRY_DOWN", outlets.notices.pop(0), "warning")
        try:
            service.run(stop)
        finally:
            outlets.close_files()
            service.settle()
        losses = {"lost": records.lost, "frames_lost": frames.lost if frames is not None else 0}
        _say({**outlets.summary(), **losses, "notices": [*outlets.notices, *service.notices]})
        signal.setitimer(signal.ITIMER_REAL, _LAST_WORDS)  # SIGALRM ends the process wherever it waits
        if outlets.publisher is not None:
            outlets.publisher.close()
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1]))

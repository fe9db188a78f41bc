"""Telemetry process, started by `child.TelemetryChild` as `python -m atalante_hal.telemetry`.

The process imports its modules, then reads its arguments from standard input: a JSON object with the configuration, the inherited
file descriptors of the rings, the number of restarts in this session, and the endpoint of the telemetry process that this
process replaces. The process prints one JSON line when all files and sockets are open, or when a file or a socket cannot be
opened. At its end the process prints another JSON line with a summary.
"""

from __future__ import annotations

import contextlib
import importlib
import json
import logging
import os
import signal
import sys
from typing import TYPE_CHECKING, Any

from atalante_hal.record_layout import Layout
from atalante_hal.telemetry.child import EVENTS, FRAMES, RECORDS
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


#: Time limit for closing the Zenoh session [s]. Then SIGALRM ends the process. Its files are already closed.
_SESSION_END = 1.0


class Outlets:
    """Sinks of the telemetry process that are open: CAN log, recorder and publisher.

    The files are opened first, so that no socket is open if a file fails.

    Args:
        config: Telemetry configuration.
        records: Reader of the ring of cycle records.
        frames: Reader of the ring of CAN frames; None without a CAN log.
        restarts: Number of earlier telemetry processes of this session.
        before: Endpoint of the telemetry process that this process replaces; None if there is none.

    Raises:
        SinkError: If a requested file cannot be opened, or if nothing can be published at the first start although
            `TelemetryConfig.requires_publisher`. Otherwise a missing publisher is only added to `notices`.
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
        publisher_required = config.requires_publisher and not restarts
        self.encoder = self._make_encoder(config, records.meta, publisher_required)
        if self.encoder is None:
            return
        streams = self.encoder.keys
        if config.recording is not None:
            self.recorder = _open_recorder(config, streams, records.meta["about"])
        if config.publish:
            try:
                self.publisher = _open_publisher(config, streams, before)
            except SinkError as error:
                if publisher_required:
                    raise
                self.notices.append(f"nothing is published: {error}")

    def _make_encoder(self, config: TelemetryConfig, meta: dict[str, Any], publisher_required: bool) -> Encoder | None:
        if not config.publish and config.recording is None:
            return None
        try:
            from atalante_hal.telemetry.messages import Encoder
        except ImportError as error:
            if config.recording is not None:
                raise SinkError(f"a recording needs {error.name}: {_INSTALL}", "RECORD_STOPPED") from error
            text = f"nothing is published, because {error.name} is missing: {_INSTALL}"
            if publisher_required:
                raise SinkError(text, "TELEMETRY_DOWN") from error
            self.notices.append(text)
            return None
        return Encoder(Layout.from_json(meta["layout"]), meta["diagnostics"])

    @property
    def endpoint(self) -> str | None:
        """Return the endpoint to which subscribers connect; None if nothing is published."""
        return self.publisher.endpoint if self.publisher is not None else None

    def sinks(self, config: TelemetryConfig) -> list[tuple[MessageSink, int]]:
        """Return each open sink (recorder, publisher) with its message period [cycles].

        Args:
            config: Telemetry configuration with the rates.

        Returns:
            (sink, number of cycles from one message of a stream to the next) of each open sink.
        """
        pairs = ((self.recorder, config.record_rate), (self.publisher, config.stream_rate))
        return [(sink, CYCLES_PER_SECOND // rate) for sink, rate in pairs if sink is not None]

    def close_files(self) -> None:
        """Close recording and CAN log. Failures are added to `notices`."""
        for file in (self.recorder, self.can_log):
            if file is not None:
                try:
                    file.close()
                except SinkError as error:
                    self.notices.append(str(error))

    def summary(self) -> dict[str, int]:
        """Return the counts of messages and frames, and whether recording and CAN log were closed without a fault."""
        return {
            "published": self.publisher.messages if self.publisher is not None else 0,
            "recorded": self.recorder.messages if self.recorder is not None else 0,
            "finished": self.recorder is not None and self.recorder.finished,
            "frames_logged": self.can_log.frames if self.can_log is not None else 0,
            "can_log_finished": self.can_log is not None and self.can_log.finished,
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
        raise SinkError(f"a recording needs {error.name}: {_INSTALL}", "RECORD_STOPPED") from error
    assert config.recording is not None
    return Recorder(config.recording, streams, {**about, "record_rate_hz": config.record_rate})


def _open_publisher(config: TelemetryConfig, streams: list[tuple[str, str]], before: str | None) -> Publisher:
    try:
        from atalante_hal.telemetry.publisher import Publisher
    except ImportError as error:
        raise SinkError(f"{error.name} is missing: {_INSTALL}", "TELEMETRY_DOWN") from error
    return Publisher(config.robot, streams, config.listen, config.access, before)


def _print_line(line: dict[str, Any]) -> None:
    """Print one JSON line for the parent process. If the parent process has ended, do nothing."""
    with contextlib.suppress(BrokenPipeError):
        os.write(sys.stdout.fileno(), json.dumps(line).encode() + b"\n")


def _leave_realtime() -> None:
    """Switch to normal scheduling, because this process inherits the real-time scheduling of the control loop."""
    if os.sched_getscheduler(0) != os.SCHED_OTHER:
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))


def _import_outlets() -> None:
    """Import the modules of the sinks, so that the sinks open quickly. A package that is missing is reported later."""
    for name in ("messages", "recorder", "publisher"):
        with contextlib.suppress(ImportError):
            importlib.import_module(f"atalante_hal.telemetry.{name}")


def main() -> int:
    """Run the telemetry process until the rings are closed or SIGTERM arrives.

    Returns:
        Exit code: 0, or 1 if a sink could not be opened.
    """
    stop: list[int] = []
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, lambda number, _: stop.append(number))
    logging.basicConfig(level=logging.WARNING)
    _leave_realtime()
    _import_outlets()
    text = sys.stdin.read()
    if not text:
        return 0  # the control loop ended before it sent the configuration
    arguments = json.loads(text)
    fds: dict[str, int] = arguments["rings"]
    config = TelemetryConfig.from_json(arguments["config"])
    with contextlib.ExitStack() as stack:
        records, events = (stack.enter_context(RingReader(fds[name])) for name in (RECORDS, EVENTS))
        frames = stack.enter_context(RingReader(fds[FRAMES])) if FRAMES in fds else None
        try:
            outlets = Outlets(config, records, frames, arguments["restarts"], arguments["endpoint"])
        except SinkError as error:
            _print_line({"error": str(error)})
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
        _print_line({"endpoint": outlets.endpoint, "notices": outlets.notices})
        while outlets.notices:
            service.report("TELEMETRY_DOWN", outlets.notices.pop(0), "warning")
        try:
            service.run(stop)
        finally:
            outlets.close_files()
            service.settle()
        losses = {"lost": records.lost, "frames_lost": frames.lost if frames is not None else 0}
        _print_line({**outlets.summary(), **losses, "notices": [*outlets.notices, *service.notices]})
        signal.setitimer(signal.ITIMER_REAL, _SESSION_END)  # SIGALRM ends the process, even inside Zenoh
        if outlets.publisher is not None:
            outlets.publisher.close()
    return 0


if __name__ == "__main__":
    sys.exit(main())

"""Recorder of telemetry messages in an MCAP file, which also contains the protobuf schema.

One file contains all runs of a session in order of log time. Each run has a metadata record `run/<number>` with the
name and the start time of the run. Every `SystemState` message contains the number of its run. The topics are the keys
of the streams.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterable, Mapping
from pathlib import Path

from mcap.writer import CompressionType, Writer

from atalante_hal.closing import Closing
from atalante_hal.telemetry.schema import PACKAGE, descriptor_set
from atalante_hal.telemetry.sink import EVENTS, SinkError

#: Size of an MCAP chunk [bytes]. A crash of the telemetry process loses at most one chunk, about 2 s of a recording at 100 Hz.
_CHUNK_BYTES = 1 << 18


class Recorder(Closing):
    """Writer of messages to an MCAP file.

    Args:
        path: Path of the file; missing folders are created.
        streams: (key, message type) of each stream; the stream of events is always added.
        about: Metadata of the whole recording, stored under the name "session".

    Raises:
        SinkError: If the file cannot be created or written.
    """

    def __init__(self, path: Path, streams: Iterable[tuple[str, str]], about: Mapping[str, object]) -> None:
        self.path = path
        self.messages = 0
        self.saved = 0  # number of messages that remain in the file if this process is killed
        self.finished = False  # True if the file was closed without an error, with its index and every message
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._file = path.open("wb")
        except OSError as error:
            raise SinkError(f"the recording {path} cannot be created: {error.strerror}", "RECORD_STOPPED") from error
        self._writer = Writer(self._file, chunk_size=_CHUNK_BYTES, compression=CompressionType.ZSTD)
        self._channels: dict[str, int] = {}
        try:
            self._writer.start(profile="", library="atalante-hal")
            for key, message in (*streams, (EVENTS, "Event")):
                schema = self._writer.register_schema(f"{PACKAGE}.{message}", "protobuf", descriptor_set())
                self._channels[key] = self._writer.register_channel(f"/{key}", "protobuf", schema)
            self._writer.add_metadata("session", _texts(about))
            self._file.flush()
            self._length = self._file.tell()
        except OSError as error:
            raise self._failed(error) from error

    def put(self, key: str, payload: bytes, timestamp: int, cycle: int) -> None:
        """Add a message to the recording.

        Args:
            key: Key of the stream.
            payload: Encoded message.
            timestamp: Log time [ns].
            cycle: Cycle number; its lower 32 bits are stored as sequence number.

        Raises:
            SinkError: If the file cannot be written. The recorder is then closed and rejects further messages.
        """
        if self._file.closed:
            raise SinkError(f"the recording {self.path} is closed", "RECORD_STOPPED")
        try:
            self._writer.add_message(self._channels[key], timestamp, payload, timestamp, cycle & 0xFFFFFFFF)
            self.messages += 1
            if self._file.tell() != self._length:  # the file has grown, so a chunk was written
                self._file.flush()
                self._length, self.saved = self._file.tell(), self.messages
        except OSError as error:
            raise self._failed(error) from error

    def begin_run(self, number: int, about: Mapping[str, object]) -> None:
        """Write the metadata record of a run that begins.

        Args:
            number: Number of the run in the session, starting at 0.
            about: Metadata of the run.

        Raises:
            SinkError: If the file cannot be written.
        """
        try:
            self._writer.add_metadata(f"run/{number}", _texts(about))
            self._length = self._file.tell()
        except OSError as error:
            raise self._failed(error) from error

    def close(self) -> None:
        """Write the index and the statistics, and close the file.

        Raises:
            SinkError: If the end of the file cannot be written. The file then has no index, and readers scan it.
        """
        if self._file.closed:
            return
        try:
            self._writer.finish()  # type: ignore[no-untyped-call]
            self._file.close()
        except OSError as error:
            raise self._failed(error) from error
        self.saved, self.finished = self.messages, True

    def _failed(self, error: OSError) -> SinkError:
        with contextlib.suppress(OSError):  # `close` writes the buffered data, which can fail again
            self._file.close()
        return SinkError(f"the recording {self.path} stopped: {error.strerror}", "RECORD_STOPPED")


def _texts(about: Mapping[str, object]) -> dict[str, str]:
    """Convert metadata to texts, as MCAP requires."""
    return {name: str(value) for name, value in about.items()}

"""MCAP: the recording of a session, with the protobuf schema inside.

One file holds every run of a session one after the other; log time goes on from run to run, each run has a metadata record
`run/<number>` with its name and times, and `SystemState` carries the number. Topics are the keys of the streams.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterable, Mapping
from pathlib import Path

from mcap.writer import CompressionType, Writer

from atalante_hal.closing import Closing
from atalante_hal.telemetry.schema import PACKAGE, descriptor_set
from atalante_hal.telemetry.sink import EVENTS, SinkError

#: What a crash of the telemetry process can cost; about two seconds at 100 Hz.
_CHUNK_BYTES = 1 << 18


class Recorder(Closing):
    """Writes messages into an MCAP file.

    Args:
        path: of the file; its folder is made.
        streams: (key, message type) of each stream; the events come by themselves.
        about: metadata of the whole recording, under the name "session".

    Raises:
        SinkError: the file cannot be made or written.
    """

    def __init__(self, path: Path, streams: Iterable[tuple[str, str]], about: Mapping[str, object]) -> None:
        self.path = path
        self.messages = 0
        self.saved = 0  # of `messages`, those that are in the file even if this process is killed
        self.finished = False  # closed with its index: every message is in the file
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._file = path.open("wb")
        except OSError as error:
            raise SinkError("RECORD_STOPPED", f"the recording {path} cannot be made: {error.strerror}") from error
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
        """Add a message.

        Args:
            timestamp: log time [ns].

        Raises:
            SinkError: the disk is full or gone; the recorder is closed then, and refuses every further message.
        """
        if self._file.closed:
            raise SinkError("RECORD_STOPPED", f"the recording {self.path} is closed")
        try:
            self._writer.add_message(self._channels[key], timestamp, payload, timestamp, cycle & 0xFFFFFFFF)
            self.messages += 1
            if self._file.tell() != self._length:  # the chunk is full and written, with this message
                self._file.flush()
                self._length, self.saved = self._file.tell(), self.messages
        except OSError as error:
            raise self._failed(error) from error

    def begin_run(self, number: int, about: Mapping[str, object]) -> None:
        """Note that a run begins; raises as `put`."""
        try:
            self._writer.add_metadata(f"run/{number}", _texts(about))
            self._length = self._file.tell()
        except OSError as error:
            raise self._failed(error) from error

    def close(self) -> None:
        """Write index and statistics, close the file.

        Raises:
            SinkError: the disk is full; readers then scan the file instead of using its index.
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
        with contextlib.suppress(OSError):  # what the buffer still holds does not fit either
            self._file.close()
        return SinkError("RECORD_STOPPED", f"the recording {self.path} stopped: {error.strerror}")


def _texts(about: Mapping[str, object]) -> dict[str, str]:
    """MCAP metadata is text to text."""
    return {name: str(value) for name, value in about.items()}

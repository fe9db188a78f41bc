"""Interface of the message sinks (publisher and recorder), and their exception."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol

#: Key of event messages. All other keys are names of streams.
EVENTS = "events"


class SinkError(RuntimeError):
    """Error of a sink that cannot be opened or can no longer be used.

    Args:
        message: Cause and remedy, one sentence.
        code: Code of the event that reports the error, e.g. RECORD_STOPPED.
    """

    def __init__(self, message: str, code: str) -> None:
        super().__init__(message)
        self.code = code


class MessageSink(Protocol):
    """Destination of encoded messages: the publisher or the recorder."""

    def put(self, key: str, payload: bytes, timestamp: int, cycle: int) -> None:
        """Store or publish one message.

        Args:
            key: Key of the stream.
            payload: Encoded message.
            timestamp: Log time [ns].
            cycle: Cycle number.

        Raises:
            SinkError: If the sink can no longer be used.
        """

    def begin_run(self, number: int, about: Mapping[str, object]) -> None:
        """Begin a run. All following messages belong to this run.

        Args:
            number: Number of the run in the session, starting at 0.
            about: Metadata of the run.

        Raises:
            SinkError: If the sink can no longer be used.
        """

    def close(self) -> None:
        """Close the sink; a second call has no effect.

        Raises:
            SinkError: If the sink could not be closed properly.
        """

"""Where messages go: what publisher and recorder have in common, and how a sink says that it is done for."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol

#: Key of the events among the keys of the streams.
EVENTS = "events"


class SinkError(RuntimeError):
    """A sink cannot be opened or cannot go on; the message says why and what is valid.

    Args:
        code: of the event that reports it, e.g. RECORD_STOPPED.
    """

    def __init__(self, code: str, message: str) -> None:
        super().__init__(message)
        self.code = code


class MessageSink(Protocol):
    """Takes messages of several keys."""

    def put(self, key: str, payload: bytes, timestamp: int, cycle: int) -> None:
        """Take one message.

        Args:
            timestamp: log time [ns].

        Raises:
            SinkError: nothing more can be taken.
        """

    def begin_run(self, number: int, about: Mapping[str, object]) -> None:
        """A run begins; raises as `put`."""

    def close(self) -> None:
        """Finish; raises as `put`. A second call does nothing."""

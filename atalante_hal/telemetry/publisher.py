"""Zenoh: the one place where telemetry meets a network socket. Telemetry leaves here, nothing enters.

A peer that scouts nobody, gossips nothing and listens on the loopback; subscribers connect to it. Access control denies
everything but the way out of our own keys, and nothing in this process subscribes. Streams are dropped for whoever cannot
keep up; events are cached for late subscribers and their loss is noticed (advanced publisher).

Keys are `atalante/<robot>/<stream>`, payloads protobuf of `messages.proto`, encodings
`application/protobuf;atalante.v1.<Message>`.
"""

from __future__ import annotations

import json
import logging
from collections.abc import Iterable, Mapping
from contextlib import ExitStack
from typing import Any

import zenoh
import zenoh.ext

from atalante_hal.closing import Closing
from atalante_hal.telemetry.access import Access
from atalante_hal.telemetry.schema import encoding
from atalante_hal.telemetry.sink import EVENTS, SinkError

DEFAULT_HOST, DEFAULT_PORT = "127.0.0.1", 7447
#: Ports tried in turn when none is asked for: several demos on one machine must all run.
PORTS_TRIED = 16
#: Events that a late subscriber can still ask for.
EVENTS_KEPT = 256
#: Everybody who reaches the endpoint may listen.
OPEN = Access()

_log = logging.getLogger(__name__)


class Publisher(Closing):
    """A Zenoh session that publishes one key a stream. Use it as a context manager: an unclosed session outlives its process.

    Args:
        robot: name of the robot, one chunk of the keys.
        streams: (key, message type) of each stream; the events come by themselves.
        listen: Zenoh endpoint such as tcp/127.0.0.1:7447; None takes the first free port from 7447 on the loopback.
        access: TLS and users.
        before: endpoint of the publisher that this one replaces, where its subscribers reconnect; tried first when
            `listen` is None.

    Raises:
        SinkError: the endpoint cannot be listened on.
    """

    def __init__(
        self,
        robot: str,
        streams: Iterable[tuple[str, str]],
        listen: str | None = None,
        access: Access = OPEN,
        before: str | None = None,
    ) -> None:
        self.messages = 0
        self._stack = ExitStack()
        self._session, self.endpoint = _open(robot, listen, access, before)
        self._stack.enter_context(self._session)
        self._publishers: dict[str, zenoh.Publisher | zenoh.ext.AdvancedPublisher] = {
            key: self._session.declare_publisher(
                f"atalante/{robot}/{key}",
                encoding=encoding(message),
                congestion_control=zenoh.CongestionControl.DROP,
                priority=zenoh.Priority.REAL_TIME,
                express=True,
            )
            for key, message in streams
        }
        self._publishers[EVENTS] = zenoh.ext.declare_advanced_publisher(
            self._session,
            f"atalante/{robot}/{EVENTS}",
            encoding=encoding("Event"),
            congestion_control=zenoh.CongestionControl.DROP,
            express=True,
            cache=zenoh.ext.CacheConfig(EVENTS_KEPT),
            sample_miss_detection=zenoh.ext.MissDetectionConfig(heartbeat=None, sporadic_heartbeat=1.0),
            publisher_detection=True,
        )

    def put(self, key: str, payload: bytes, timestamp: int, cycle: int) -> None:
        """Publish a message; never waits for a subscriber, and keeps events for late ones. Times are in the payload.

        Raises:
            SinkError: the session has failed.
        """
        try:
            self._publishers[key].put(payload)
        except zenoh.ZError as error:
            raise SinkError("TELEMETRY_DOWN", f"Zenoh publishes no more: {error}") from error
        self.messages += 1

    def begin_run(self, number: int, about: Mapping[str, object]) -> None:
        """Nothing to do: subscribers see the run in `SystemState`."""

    def close(self) -> None:
        """End the session. With a stopped subscriber Zenoh needs ten seconds for it and raises in the end.

        Raises:
            SinkError: the session could not be ended.
        """
        try:
            self._stack.close()
        except zenoh.ZError as error:
            raise SinkError("TELEMETRY_DOWN", f"Zenoh did not end its session: {error}") from error


def configuration(robot: str, listen: str) -> dict[str, Any]:
    """Zenoh configuration of the session: who may connect, and that nothing comes in."""
    own = [f"atalante/{robot}/**", f"atalante/{robot}/**/@adv/**"]  # "**" does not match a chunk that begins with @
    return {
        "mode": "peer",
        "listen": {"endpoints": [listen]},
        "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}},
        "transport": {
            "shared_memory": {"enabled": False},  # a killed process would leave its segments in /dev/shm
            "link": {
                "tx": {
                    "queue": {
                        # Batches; the default of 2 made a put ten times slower with a subscriber there.
                        "size": {"real_time": 16},
                        # What is never dropped (undeclarations, heartbeats) waits this long [us] for a stopped subscriber,
                        # who is cut off then; by default 5 s.
                        "congestion_control": {"block": {"wait_before_close": 100_000}},
                    }
                }
            },
        },
        "access_control": {
            "enabled": True,
            "default_permission": "deny",
            "rules": [
                {
                    "id": "telemetry leaves",
                    "permission": "allow",
                    "flows": ["egress"],
                    "messages": ["put", "reply", "declare_queryable", "liveliness_token"],
                    "key_exprs": own,
                },
                {
                    # What a subscriber says to get it: its interest, by whatever wildcard, and the question for cached events.
                    "id": "subscribers ask",
                    "permission": "allow",
                    "flows": ["ingress"],
                    "messages": ["declare_subscriber", "query", "liveliness_query", "declare_liveliness_subscriber"],
                    "key_exprs": ["**", "**/@adv/**"],
                },
            ],
            "subjects": [{"id": "everybody"}],
            "policies": [{"rules": ["telemetry leaves", "subscribers ask"], "subjects": ["everybody"]}],
        },
    }


def _open(robot: str, listen: str | None, access: Access, before: str | None) -> tuple[zenoh.Session, str]:
    """A session and the endpoint it listens on."""
    if listen is not None:
        try:
            return zenoh.open(_parsed(robot, listen, access)), listen
        except zenoh.ZError as error:
            raise SinkError(
                "TELEMETRY_DOWN",
                f"Zenoh cannot listen on {listen}: {_reason(error)}; give another endpoint, such as tcp/127.0.0.1:7448",
            ) from error
    refused = ""
    ports = range(DEFAULT_PORT, DEFAULT_PORT + PORTS_TRIED)
    defaults = [f"{access.protocols[0]}/{DEFAULT_HOST}:{port}" for port in ports]
    for endpoint in dict.fromkeys([before, *defaults] if before is not None else defaults):
        try:
            return zenoh.open(_parsed(robot, endpoint, access)), endpoint
        except zenoh.ZError as error:
            refused = _reason(error)
            _log.info("%s is not free, trying the next", endpoint)
    raise SinkError(
        "TELEMETRY_DOWN", f"Zenoh found no free port from {ports[0]} to {ports[-1]} on {DEFAULT_HOST}: {refused}"
    )


def _parsed(robot: str, listen: str, access: Access) -> zenoh.Config:
    config = configuration(robot, listen)
    asked = access.transport()
    config["transport"] |= asked | {"link": {**config["transport"]["link"], **asked["link"]}}
    return zenoh.Config.from_json5(json.dumps(config))


def _reason(error: zenoh.ZError) -> str:
    """What the system said, without Zenoh's source places."""
    text = str(error)
    return "the port is taken" if "os error 98" in text else text.split(" at /")[0]

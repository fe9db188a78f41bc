"""Zenoh publisher, the only telemetry module with a network socket. The publisher sends data and accepts no commands.

The session is a Zenoh peer without scouting and gossip. By default it listens on the loopback, and subscribers connect to it.
Zenoh's access control lets this process publish only its own keys, and the process has no subscription. If a subscriber
reads too slowly, Zenoh drops messages to this subscriber. Events are cached for subscribers that connect late. Subscribers
can detect lost events (Zenoh's advanced publisher).

The key of a message is `atalante/<robot>/<stream>`. The payload is a protobuf message of `messages.proto`. The encoding
is `application/protobuf;atalante.v1.<Message>`.
"""

from __future__ import annotations

import json
import logging
import os
from collections.abc import Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from typing import Any

import zenoh
import zenoh.ext

from atalante_hal.closing import Closing
from atalante_hal.memory import anonymous_file
from atalante_hal.telemetry.access import Access
from atalante_hal.telemetry.schema import encoding
from atalante_hal.telemetry.sink import EVENTS, SinkError

DEFAULT_HOST, DEFAULT_PORT = "127.0.0.1", 7447
#: Number of ports that are tried if no endpoint is configured. So several demos can run on one machine.
PORTS_TRIED = 16
#: Number of events cached for late subscribers.
EVENTS_KEPT = 256
#: Access without TLS and without users: every client that reaches the endpoint may subscribe.
OPEN = Access()

_IN_USE = "os error 98"  # part of a Zenoh error: the port is in use

_log = logging.getLogger(__name__)


class Publisher(Closing):
    """Zenoh session with one publisher for each stream.

    Use it as a context manager, because the process does not end while a session is open.

    Args:
        robot: Name of the robot, a part of the keys.
        streams: (key, message type) of each stream; the stream of events is always added.
        listen: Zenoh endpoint, such as tcp/127.0.0.1:7447. With None, the first free port of the loopback from 7447 on is used.
        access: TLS and users.
        before: Endpoint of the earlier publisher that this publisher replaces. If `listen` is None, this endpoint is
            tried first, because the subscribers reconnect to it.

    Raises:
        SinkError: If the endpoint cannot be opened.
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
        """Publish a message without waiting for a subscriber; events are also cached for late subscribers.

        Args:
            key: Key of the stream.
            payload: Encoded message, which contains time and cycle.
            timestamp: Ignored.
            cycle: Ignored.

        Raises:
            SinkError: If the session has failed.
        """
        try:
            self._publishers[key].put(payload)
        except zenoh.ZError as error:
            raise SinkError(f"Zenoh cannot publish: {error}", "TELEMETRY_DOWN") from error
        self.messages += 1

    def begin_run(self, number: int, about: Mapping[str, object]) -> None:
        """Do nothing when a run begins, because every `SystemState` message contains the number of the run.

        Args:
            number: Ignored.
            about: Ignored.
        """

    def close(self) -> None:
        """End the session. This fails after 10 s if the process of a subscriber is suspended (SIGSTOP).

        Raises:
            SinkError: If Zenoh could not end the session.
        """
        try:
            self._stack.close()
        except zenoh.ZError as error:
            raise SinkError(f"Zenoh did not end its session: {error}", "TELEMETRY_DOWN") from error


def configuration(robot: str, listen: str) -> dict[str, Any]:
    """Return the Zenoh configuration of the session, which permits output only.

    Args:
        robot: Name of the robot, a part of the keys.
        listen: Zenoh endpoint to listen on.

    Returns:
        Configuration as JSON types, without the settings of `Access`.
    """
    # Events also use keys with the part @adv (advanced publisher). The wildcard "**" does not match this part.
    own = [f"atalante/{robot}/**", f"atalante/{robot}/**/@adv/**"]
    return {
        "mode": "peer",
        "listen": {"endpoints": [listen]},
        "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}},
        "transport": {
            "shared_memory": {"enabled": False},  # a killed process would leave shared memory in /dev/shm
            "link": {
                "tx": {
                    "queue": {
                        # Number of message batches in the queue. The default is 2.
                        # With 2 batches, publishing took ten times as long.
                        "size": {"real_time": 16},
                        # Time after which a subscriber that reads nothing is disconnected [us]. The default is 5 s.
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
                    "id": "publish telemetry",
                    "permission": "allow",
                    "flows": ["egress"],
                    "messages": ["put", "reply", "declare_queryable", "liveliness_token"],
                    "key_exprs": own,
                },
                {
                    # A subscriber may send two things: its subscription, with any wildcard, and its query for cached events.
                    "id": "subscribe and query",
                    "permission": "allow",
                    "flows": ["ingress"],
                    "messages": ["declare_subscriber", "query", "liveliness_query", "declare_liveliness_subscriber"],
                    "key_exprs": ["**", "**/@adv/**"],
                },
            ],
            "subjects": [{"id": "all clients"}],
            "policies": [{"rules": ["publish telemetry", "subscribe and query"], "subjects": ["all clients"]}],
        },
    }


def _open(robot: str, listen: str | None, access: Access, before: str | None) -> tuple[zenoh.Session, str]:
    """Open a session at the first endpoint that is not in use, and return the session and its endpoint."""
    ports = range(DEFAULT_PORT, DEFAULT_PORT + PORTS_TRIED)
    endpoints = [f"{access.protocols[0]}/{DEFAULT_HOST}:{port}" for port in ports]
    if listen is not None:
        endpoints = [listen]
    elif before is not None:
        endpoints = [before, *(endpoint for endpoint in endpoints if endpoint != before)]
    with _user_file(access) as users:
        for endpoint in endpoints:
            try:
                return zenoh.open(_parsed(robot, endpoint, access.transport(users))), endpoint
            except zenoh.ZError as error:
                if _IN_USE not in str(error):
                    reason = str(error).split(" at /")[0]  # without file name and line number of Zenoh's source code
                    raise SinkError(f"Zenoh cannot listen on {endpoint}: {reason}", "TELEMETRY_DOWN") from error
                _log.info("%s is not free", endpoint)
    if listen is not None:
        other = f"{access.protocols[0]}/{DEFAULT_HOST}:{DEFAULT_PORT + 1}"
        raise SinkError(
            f"Zenoh cannot listen on {listen}: the port is taken; give another endpoint, such as {other}",
            "TELEMETRY_DOWN",
        )
    raise SinkError(f"Zenoh found no free port from {ports[0]} to {ports[-1]} on {DEFAULT_HOST}", "TELEMETRY_DOWN")


@contextmanager
def _user_file(access: Access) -> Iterator[str]:
    """Yield the path of a file in memory: a copy of the operator's file of users, without comments."""
    descriptor = anonymous_file("atalante-users", 0)
    try:
        os.write(descriptor, "\n".join(access.user_lines()).encode())
        yield f"/proc/self/fd/{descriptor}"
    finally:
        os.close(descriptor)


def _parsed(robot: str, listen: str, restrictions: Mapping[str, Any]) -> zenoh.Config:
    config = configuration(robot, listen)
    config["transport"] |= {**restrictions, "link": {**config["transport"]["link"], **restrictions["link"]}}
    return zenoh.Config.from_json5(json.dumps(config))

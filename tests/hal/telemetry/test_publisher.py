"""Zenoh publisher on the loopback: it publishes telemetry, accepts no data, and is never blocked by a subscriber."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
import zenoh
import zenoh.ext

from atalante_hal.telemetry import publisher as publisher_module
from atalante_hal.telemetry.publisher import Publisher, configuration
from atalante_hal.telemetry.schema import message_class
from atalante_hal.telemetry.sink import SinkError

STREAMS = [("joint_states", "JointStates"), ("imu", "ImuStates")]
TRIES = 400  # largest number of polls of another thread or process, one every 50 ms


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@pytest.fixture
def publisher() -> Iterator[Publisher]:
    with Publisher("exo", STREAMS, f"tcp/127.0.0.1:{free_port()}") as opened:
        yield opened


@contextmanager
def client(publisher: Publisher, mode: str = "client") -> Iterator[zenoh.Session]:
    config = {
        "mode": mode,
        "connect": {"endpoints": [publisher.endpoint]},
        "listen": {"endpoints": []},
        "scouting": {"multicast": {"enabled": False}},
    }
    with zenoh.open(zenoh.Config.from_json5(json.dumps(config))) as session:
        yield session


def joint_states(cycle: int) -> bytes:
    return bytes(message_class("JointStates")(cycle=cycle, name=["left_FH"], position=[0.5]).SerializeToString())


def until(wanted: Callable[[], Any]) -> Any:
    for _ in range(TRIES):
        if found := wanted():
            return found
        time.sleep(0.05)
    raise AssertionError(f"timeout while waiting for {wanted.__name__}")


def drain(subscriber: Any) -> list[zenoh.Sample]:
    return list(iter(subscriber.try_recv, None))


class TestSubscribers:
    @pytest.mark.parametrize("mode", ["client", "peer"])
    @pytest.mark.parametrize("key", ["atalante/exo/joint_states", "atalante/*/joint_states", "atalante/**", "**"])
    def test_subscriber_gets_typed_messages_by_key_or_wildcard(self, publisher: Publisher, key: str, mode: str) -> None:
        with client(publisher, mode) as session, session.declare_subscriber(key) as subscriber:

            def received() -> list[zenoh.Sample]:
                publisher.put("joint_states", joint_states(7), 0, 7)
                return drain(subscriber)

            sample = until(received)[0]
            assert str(sample.key_expr) == "atalante/exo/joint_states"
            assert str(sample.encoding) == "application/protobuf;atalante.v1.JointStates"
            message = message_class("JointStates").FromString(sample.payload.to_bytes())
            assert (message.cycle, list(message.name), list(message.position)) == (7, ["left_FH"], [0.5])
            assert sample.priority == zenoh.Priority.REAL_TIME
            assert sample.congestion_control == zenoh.CongestionControl.DROP

    def test_late_subscriber_gets_earlier_events(self, publisher: Publisher) -> None:
        for number in range(5):
            publisher.put("events", b"%d" % number, 0, 0)
        with (
            client(publisher) as session,
            zenoh.ext.declare_advanced_subscriber(
                session,
                "atalante/*/events",
                history=zenoh.ext.HistoryConfig(max_samples=3, detect_late_publishers=True),
            ) as subscriber,
        ):
            got: list[bytes] = []

            def three() -> bool:
                got.extend(sample.payload.to_bytes() for sample in drain(subscriber))
                return len(got) >= 3

            until(three)
            assert got == [b"2", b"3", b"4"]

    def test_stopped_subscriber_does_not_block_and_can_resume(self, publisher: Publisher) -> None:
        program = (
            "import sys, zenoh\n"
            "config = zenoh.Config.from_json5(sys.argv[1])\n"
            "with zenoh.open(config) as session, session.declare_subscriber('**') as subscriber:\n"
            "    for sample in subscriber:\n"
            "        print(sample.payload.to_bytes()[:5].decode(), flush=True)\n"
        )
        config = {
            "mode": "client",
            "connect": {"endpoints": [publisher.endpoint]},
            "scouting": {"multicast": {"enabled": False}},
            "transport": {"shared_memory": {"enabled": False}},  # the killed process would leave it in /dev/shm
        }
        with subprocess.Popen([sys.executable, "-c", program, json.dumps(config)], stdout=subprocess.PIPE) as child:
            assert child.stdout is not None
            os.set_blocking(child.stdout.fileno(), False)

            def has_received(payload: bytes) -> Callable[[], bool]:
                def is_received() -> bool:
                    publisher.put("imu", payload, 0, 0)
                    return payload in (child.stdout.read() or b"")

                return is_received

            try:
                until(has_received(b"first"))
                child.send_signal(signal.SIGSTOP)
                for _ in range(5000):  # 20 MB, more than all buffers between publisher and subscriber can store
                    publisher.put("joint_states", b"+" * 4000, 0, 0)
                child.send_signal(signal.SIGCONT)
                until(has_received(b"again"))
            finally:
                child.kill()


class TestAccessControl:
    KEYS = ("joint_states", "imu", "events", "command", "anything/else")

    def forge(self, publisher: Publisher, count: int) -> tuple[list[bytes], list[bytes]]:
        """Let a foreign client put and delete on every key.

        Returns:
            Payloads that the telemetry process received, and payloads that another subscriber received.
        """
        with (
            publisher._session.declare_subscriber("**", zenoh.handlers.FifoChannel(10_000)) as inside,
            client(publisher) as other,
            other.declare_subscriber("**", zenoh.handlers.FifoChannel(10_000)) as watching,
            client(publisher) as attacker,
        ):
            seen: list[bytes] = []

            def watched() -> bool:
                publisher.put("joint_states", b"ours", 0, 0)
                seen.extend(sample.payload.to_bytes() for sample in drain(watching))
                return b"ours" in seen

            until(watched)
            for number in range(count):
                attacker.put(f"atalante/exo/{self.KEYS[number % len(self.KEYS)]}", b"forged")
                attacker.delete(f"atalante/exo/{self.KEYS[number % len(self.KEYS)]}")
            # The reply to this query follows all earlier puts of the client.
            list(attacker.get("atalante/exo/none", timeout=1.0))
            publisher.put("imu", b"end", 0, 0)

            def ended() -> bool:
                seen.extend(sample.payload.to_bytes() for sample in drain(watching))
                return b"end" in seen

            until(ended)
            return [sample.payload.to_bytes() for sample in drain(inside)], seen

    def test_foreign_puts_are_rejected(self, publisher: Publisher) -> None:
        inside, seen = self.forge(publisher, 200)
        assert set(inside) == {b"ours", b"end"}
        assert set(seen) == {b"ours", b"end"}

    def test_foreign_puts_arrive_without_access_control(self, monkeypatch: pytest.MonkeyPatch) -> None:
        def without_access_control(robot: str, listen: str) -> dict[str, Any]:
            return {**configuration(robot, listen), "access_control": {"enabled": False}}

        monkeypatch.setattr(publisher_module, "configuration", without_access_control)
        with Publisher("exo", STREAMS, f"tcp/127.0.0.1:{free_port()}") as publisher:
            inside, _ = self.forge(publisher, 200)
            assert inside.count(b"forged") > 0

    def test_publisher_listens_only_on_the_loopback(self, publisher: Publisher) -> None:
        port = int(publisher.endpoint.rsplit(":", 1)[1])
        listening = [local for local, state in sockets("tcp", "tcp6") if state == "0A"]
        assert [local for local in listening if local.endswith(f":{port:04X}")] == [f"0100007F:{port:04X}"]
        assert all(local.startswith("0100007F:") for local in listening)
        assert not sockets("udp", "udp6")


def sockets(*kinds: str) -> list[tuple[str, str]]:
    """Return (local address, state) of the sockets of this process, in the notation of the kernel."""
    links = []
    for fd in Path("/proc/self/fd").iterdir():
        try:
            links.append(str(fd.readlink()))
        except FileNotFoundError:  # the descriptor with which the folder itself was read
            continue
    rows = [line.split() for kind in kinds for line in Path(f"/proc/self/net/{kind}").read_text().splitlines()[1:]]
    return [(row[1], row[3]) for row in rows if f"socket:[{row[9]}]" in links]


class TestEndpoint:
    def test_requested_port_in_use_gives_an_error_message(self, publisher: Publisher) -> None:
        with pytest.raises(SinkError, match=r"cannot listen on tcp/127\.0\.0\.1:\d+: the port is taken; give another"):
            Publisher("exo", STREAMS, publisher.endpoint)

    def test_invalid_endpoint_gives_an_error_message(self) -> None:
        with pytest.raises(SinkError, match="cannot listen on nonsense"):
            Publisher("exo", STREAMS, "nonsense")

    def test_default_endpoint_is_the_next_free_port(self, monkeypatch: pytest.MonkeyPatch) -> None:
        with socket.socket() as taken:
            taken.bind(("127.0.0.1", 0))
            taken.listen()
            port = taken.getsockname()[1]
            monkeypatch.setattr(publisher_module, "DEFAULT_PORT", port)
            with Publisher("exo", STREAMS) as publisher:
                host, found = publisher.endpoint.rsplit(":", 1)
                assert host == "tcp/127.0.0.1"
                assert port < int(found) < port + publisher_module.PORTS_TRIED

    def test_no_free_port_gives_an_error_message(self, monkeypatch: pytest.MonkeyPatch) -> None:
        with socket.socket() as taken:
            taken.bind(("127.0.0.1", 0))
            taken.listen()
            monkeypatch.setattr(publisher_module, "DEFAULT_PORT", taken.getsockname()[1])
            monkeypatch.setattr(publisher_module, "PORTS_TRIED", 1)
            with pytest.raises(SinkError, match="no free port"):
                Publisher("exo", STREAMS)


def test_crashed_process_leaves_no_shared_memory() -> None:
    program = (
        "from atalante_hal.telemetry.publisher import Publisher\n"
        f"with Publisher('exo', [('imu', 'ImuStates')], 'tcp/127.0.0.1:{free_port()}') as publisher:\n"
        "    publisher.put('imu', b'x', 0, 0)\n"
        "    print([line for line in open('/proc/self/maps') if '/dev/shm/' in line])\n"
        "    raise SystemExit(7)\n"
    )
    done = subprocess.run([sys.executable, "-c", program], timeout=60, check=False, capture_output=True, text=True)
    assert done.returncode == 7
    assert done.stdout == "[]\n"

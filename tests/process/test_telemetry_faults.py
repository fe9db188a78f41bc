"""Telemetry that fails while the robot is driven (F46 to F49). The bytes on the bus are the same as without telemetry.

The full disk of F46 is simulated by a limit on the file size (RLIMIT_FSIZE), because a test may not mount a small disk.
"""

from __future__ import annotations

import os
import resource
import signal
import socket
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
from mcap.exceptions import EndOfFile
from mcap.records import Channel, Chunk, Message
from mcap.stream_reader import StreamReader

from atalante_hal.telemetry import process as process_module
from atalante_hal.telemetry.process import TelemetryConfig, TelemetryProcess
from atalante_hal.types import SupervisorState
from atalante_hal.wire.frame import Frames
from tests.process.test_telemetry_process import free_endpoint, pid_of, recorded, subscribe

CYCLES = 1500


class Sent:
    """Tap that records every byte that the HAL sent."""

    def __init__(self) -> None:
        self.bytes = bytearray()

    def sent(self, frames: Frames) -> None:
        self.bytes += frames.tobytes()

    def received(self, frames: Frames, count: int) -> None:
        pass


class DrivenRobot:
    """Robot that is driven with a telemetry process. At the end it is compared with a robot without telemetry."""

    def __init__(self, make_rig: Callable[..., Any]) -> None:
        self._make_rig = make_rig
        self.rig = self._rig()
        self.telemetry: TelemetryProcess | None = None

    def _rig(self) -> Any:
        rig = self._make_rig(seed=6)
        rig.hal.tap = Sent()
        return rig

    def start(self, config: TelemetryConfig, largest_file: int | None = None) -> TelemetryProcess:
        self.telemetry = TelemetryProcess(config, self.rig.hal.layout)
        limits = resource.getrlimit(resource.RLIMIT_FSIZE)
        resource.setrlimit(resource.RLIMIT_FSIZE, (largest_file or limits[0], limits[1]))  # the child inherits it
        try:
            self.telemetry.start()
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        self.rig.until(SupervisorState.ACTIVE)
        return self.telemetry

    def run(self, cycles: int) -> None:
        assert self.telemetry is not None
        for _ in range(cycles):
            self.rig.cycle()
            self.telemetry.write(self.rig.hal.record)
            if self.rig.hal.state.cycle % 50 == 0:
                self.telemetry.tend()

    def until(self, wanted: Callable[[], Any]) -> Any:
        """Drive until the condition holds, at most at half the real-time speed, because another process has to act."""
        for _ in range(3000):
            if found := wanted():
                return found
            self.run(10)
            time.sleep(0.02)
        raise AssertionError("the expected condition did not occur")

    def compare(self) -> None:
        state = self.rig.hal.state
        assert state.supervisor is SupervisorState.ACTIVE
        golden = self._rig()
        golden.run(state.cycle)
        assert bytes(self.rig.hal.tap.bytes) == bytes(golden.hal.tap.bytes)


class Subscriber:
    """A subprocess that subscribes to every key within a `with` block."""

    def __init__(self, telemetry: TelemetryProcess) -> None:
        self.process = subscribe(telemetry)
        os.set_blocking(self.process.stdout.fileno(), False)

    def received_lines(self) -> str:
        """Return the messages received since the last call, one message per line."""
        try:
            return os.read(self.process.stdout.fileno(), 1 << 16).decode()
        except BlockingIOError:
            return ""

    def __enter__(self) -> Subscriber:
        return self

    def __exit__(self, *_: object) -> None:
        self.process.kill()
        self.process.stdout.close()
        self.process.wait()


@pytest.fixture
def driven(make_rig: Callable[..., Any]) -> Any:
    made = DrivenRobot(make_rig)
    yield made
    if made.telemetry is not None:
        made.telemetry.close()


def test_f46_full_disk_stops_only_the_recording(driven: DrivenRobot, tmp_path: Path) -> None:
    config = TelemetryConfig(
        recording=tmp_path / "r.mcap",
        can_log=tmp_path / "r.log",
        record_rate=1000,
        lock_step=True,
        listen=free_endpoint(),
    )
    telemetry = driven.start(config, largest_file=50_000)
    with Subscriber(telemetry) as subscriber:
        driven.until(subscriber.received_lines)
        driven.run(CYCLES)
        driven.until(lambda: "events" in subscriber.received_lines())  # RECORD_STOPPED is still published
    written = telemetry.records.written
    summary = telemetry.close()
    assert summary.complete
    assert summary.notices == (f"the recording {tmp_path / 'r.mcap'} stopped: File too large",)
    assert summary.recording is not None
    assert not summary.recording.complete
    assert summary.recording.missing_cycles == written - len(cycles_without_index(tmp_path / "r.mcap"))
    driven.compare()


def test_f47_unavailable_endpoint_is_reported_and_does_not_affect_the_loop(
    driven: DrivenRobot, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The publisher listens itself, without a router. If it cannot listen, the recording contains an event."""
    program = "import atalante_hal.telemetry.publisher as p; p.DEFAULT_HOST = '203.0.113.1'\n"
    (tmp_path / "sitecustomize.py").write_text(program)  # an address this machine does not have
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    telemetry = driven.start(TelemetryConfig(recording=tmp_path / "r.mcap", lock_step=True))
    assert telemetry.endpoint is None
    assert telemetry.notices[0].startswith("nothing is published")
    driven.run(CYCLES)
    assert telemetry.close().complete
    (event,) = recorded(tmp_path / "r.mcap", "/events")
    assert event.code == "TELEMETRY_DOWN"
    driven.compare()


def test_f47_next_subscriber_receives_after_one_is_killed(driven: DrivenRobot) -> None:
    telemetry = driven.start(TelemetryConfig(listen=free_endpoint(), lock_step=True))
    for _ in range(2):
        with Subscriber(telemetry) as subscriber:
            driven.until(subscriber.received_lines)
    assert telemetry.alive
    driven.compare()


def test_f48_stopped_subscriber_does_not_affect_the_loop(driven: DrivenRobot, tmp_path: Path) -> None:
    path = tmp_path / "r.mcap"
    config = TelemetryConfig(listen=free_endpoint(), stream_rate=1000, recording=path, record_rate=1000, slots=64)
    telemetry = driven.start(config)
    with Subscriber(telemetry) as subscriber:
        driven.until(subscriber.received_lines)
        subscriber.process.send_signal(signal.SIGSTOP)
        driven.run(CYCLES)
        assert telemetry.alive
        # Telemetry is too slow: the oldest records are overwritten and counted.
        os.kill(pid_of(telemetry), signal.SIGSTOP)
        driven.run(CYCLES)
        os.kill(pid_of(telemetry), signal.SIGCONT)
        summary = telemetry.close()
    assert summary.complete
    assert summary.lost >= CYCLES - 2 * 64
    assert "TELEMETRY_DROPPED" in {event.code for event in recorded(path, "/events")}
    driven.compare()


@pytest.mark.sample(2)
@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGSTOP])
def test_f49_killed_or_stopped_telemetry_is_restarted(driven: DrivenRobot, how: signal.Signals, tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    config = TelemetryConfig(listen=free_endpoint(), recording=path, record_rate=1000, lock_step=True, patience=0.1)
    telemetry = driven.start(config)
    endpoint, first, begin = telemetry.endpoint, pid_of(telemetry), driven.rig.hal.state.cycle + 1
    driven.run(500)
    os.kill(first, how)
    driven.until(lambda: (tmp_path / "run-1.mcap").exists() and pid_of(telemetry) != first and telemetry.alive)
    with Subscriber(telemetry) as subscriber:  # the same endpoint as before
        driven.until(subscriber.received_lines)
    assert telemetry.endpoint == endpoint
    summary = telemetry.close()
    assert not summary.complete
    assert summary.restarts == 1
    assert summary.notices[0].startswith("telemetry has ended" if how is signal.SIGKILL else "telemetry hangs")
    codes = [event.code for event in recorded(tmp_path / "run-1.mcap", "/events")]
    assert "TELEMETRY_DOWN" in codes
    again = recorded(tmp_path / "run-1.mcap")
    assert [message.cycle for message in again] == list(range(again[0].cycle, driven.rig.hal.state.cycle + 1))
    # The first recording is kept without an index, because it was not finished.
    kept = cycles_without_index(path)
    assert kept[:100] == list(range(begin, begin + 100))
    assert summary.recording is not None
    assert summary.recording.files == ("run.mcap", "run-1.mcap")
    assert not summary.recording.complete
    if how is signal.SIGKILL:  # a process can be stopped at any point
        # If the process is killed right after it wrote a chunk, the cycles of this chunk count as missing.
        counted = {kept[-1], [begin - 1, *without_last_chunk(path, tmp_path / "shorter.mcap")][-1]}
        assert summary.recording.missing_cycles in {again[0].cycle - 1 - last for last in counted}
    driven.compare()


def listen_at(endpoint: str) -> socket.socket:
    """Return a socket that listens at the endpoint of telemetry."""
    host, port = endpoint.partition("/")[2].split(":")
    listener = socket.socket()
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # old connections may still be closing
    listener.bind((host, int(port)))
    listener.listen()
    return listener


@pytest.mark.sample(2)
@pytest.mark.parametrize("configured", [False, True], ids=["default endpoint", "configured endpoint"])
def test_f49_restart_with_a_taken_port_continues_the_recording(
    driven: DrivenRobot, configured: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    port = int(free_endpoint().rsplit(":", 1)[1])
    (tmp_path / "sitecustomize.py").write_text(
        f"import atalante_hal.telemetry.publisher as p; p.DEFAULT_PORT = {port}\n"
    )
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    listen = f"tcp/127.0.0.1:{port}"
    path = tmp_path / "run.mcap"
    config = TelemetryConfig(listen=listen if configured else None, recording=path, record_rate=1000, lock_step=True)
    telemetry = driven.start(config)
    assert telemetry.endpoint == listen
    first = pid_of(telemetry)
    os.kill(first, signal.SIGKILL)
    assert telemetry._child is not None
    telemetry._child.wait()
    with listen_at(listen):
        driven.until(lambda: telemetry._restarting is not None and not telemetry._restarting.is_alive())
        assert telemetry.alive
        assert pid_of(telemetry) != first
        if configured:
            assert telemetry.endpoint is None
        else:
            assert telemetry.endpoint not in (None, listen)
            with Subscriber(telemetry) as subscriber:
                driven.until(subscriber.received_lines)
        driven.run(100)
        summary = telemetry.close()
    assert summary.restarts == 1
    assert summary.recording is not None
    assert not summary.recording.complete
    again = [message.cycle for message in recorded(tmp_path / "run-1.mcap")]
    assert again == list(range(again[0], driven.rig.hal.state.cycle + 1))
    assert bool([notice for notice in summary.notices if f"cannot listen on {listen}" in notice]) is configured
    driven.compare()


def cycles_without_index(path: Path) -> list[int]:
    """Return the cycles with all their messages in a recording, which may end anywhere."""
    topics: dict[int, str] = {}
    streams: dict[str, set[int]] = {}
    with path.open("rb") as file, suppress(EndOfFile):
        for record in StreamReader(file, record_size_limit=None).records:
            if isinstance(record, Channel) and record.topic not in ("/loop", "/events"):
                topics[record.id] = record.topic
                streams.setdefault(record.topic, set())  # the end of a file repeats its channels
            elif isinstance(record, Message) and record.channel_id in topics:
                streams[topics[record.channel_id]].add(record.sequence)
    return sorted(set.intersection(*streams.values())) if streams else []


def without_last_chunk(path: Path, copy: Path) -> list[int]:
    """Return the cycles with all their messages before the last complete chunk of a recording."""
    ends: list[int] = []
    with path.open("rb") as file, suppress(EndOfFile):
        records = StreamReader(file, emit_chunks=True, record_size_limit=None).records
        ends.extend(file.tell() for record in records if isinstance(record, Chunk))
    if len(ends) < 2:
        return []
    copy.write_bytes(path.read_bytes()[: ends[-2]])
    return cycles_without_index(copy)


def test_f49_telemetry_is_not_restarted_after_three_failed_restarts(driven: DrivenRobot) -> None:
    telemetry = driven.start(TelemetryConfig(publish=False, lock_step=True))
    killed = set()

    def kill_each_process() -> bool:
        if telemetry.alive and pid_of(telemetry) not in killed:
            killed.add(pid_of(telemetry))
            os.kill(pid_of(telemetry), signal.SIGKILL)
        return telemetry._abandoned

    driven.until(kill_each_process)
    assert len(killed) == process_module.RESTARTS + 1
    summary = telemetry.close()
    assert "not restarted after 3 restarts" in summary.notices[-1]
    assert summary.restarts == process_module.RESTARTS
    driven.compare()

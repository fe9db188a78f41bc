"""Telemetry that fails while the robot is driven: F46 to F49. What passes on the bus is, to the byte, what passes without it.

The small disk of F46 is a limit on the size of files (RLIMIT_FSIZE): a mounted one needs rights that a test does not have.
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
from mcap.records import Channel, Message
from mcap.stream_reader import StreamReader

from atalante_hal.telemetry import process as process_module
from atalante_hal.telemetry.process import TelemetryConfig, TelemetryProcess
from atalante_hal.types import SupervisorState
from atalante_hal.wire.frame import Frames
from tests.process.test_telemetry_process import free_endpoint, pid_of, recorded, subscribe

CYCLES = 1500


class Sent:
    """Every byte the HAL sent."""

    def __init__(self) -> None:
        self.bytes = bytearray()

    def sent(self, frames: Frames) -> None:
        self.bytes += frames.tobytes()

    def received(self, frames: Frames, count: int) -> None:
        pass


class Drive:
    """A robot that is driven with telemetry beside it, and at the end another without, for comparison."""

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
        """Drive on until it is so; half of real time at most, for another process has to do something."""
        for _ in range(3000):
            if found := wanted():
                return found
            self.run(10)
            time.sleep(0.02)
        raise AssertionError("it did not happen")

    def compare(self) -> None:
        state = self.rig.hal.state
        assert state.supervisor is SupervisorState.ACTIVE
        golden = self._rig()
        golden.run(state.cycle)
        assert bytes(self.rig.hal.tap.bytes) == bytes(golden.hal.tap.bytes)


class Subscriber:
    """Another process that subscribes to everything, for the length of a block."""

    def __init__(self, telemetry: TelemetryProcess) -> None:
        self.process = subscribe(telemetry)
        os.set_blocking(self.process.stdout.fileno(), False)

    def heard(self) -> str:
        """What it has got since the last time, a line a message."""
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
def drive(make_rig: Callable[..., Any]) -> Any:
    made = Drive(make_rig)
    yield made
    if made.telemetry is not None:
        made.telemetry.close()


def test_f46_a_full_disk_ends_the_recording_alone(drive: Drive, tmp_path: Path) -> None:
    config = TelemetryConfig(
        recording=tmp_path / "r.mcap",
        can_log=tmp_path / "r.log",
        record_rate=1000,
        lock_step=True,
        listen=free_endpoint(),
    )
    telemetry = drive.start(config, largest_file=50_000)
    with Subscriber(telemetry) as subscriber:
        drive.until(subscriber.heard)
        drive.run(CYCLES)
        drive.until(lambda: "events" in subscriber.heard())  # RECORD_STOPPED goes out where it still can
    written = telemetry.records.written
    summary = telemetry.close()
    assert summary.complete
    assert summary.notices == (f"the recording {tmp_path / 'r.mcap'} stopped: File too large",)
    assert summary.recording is not None
    assert not summary.recording.complete
    assert summary.recording.missing_cycles == written - len(cycles_without_index(tmp_path / "r.mcap"))
    drive.compare()


def test_f47_an_endpoint_that_cannot_be_had_is_told_and_changes_nothing(
    drive: Drive, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """There is no router to lose: who publishes listens, and who cannot says so where it still can."""
    program = "import atalante_hal.telemetry.publisher as p; p.DEFAULT_HOST = '203.0.113.1'\n"
    (tmp_path / "sitecustomize.py").write_text(program)  # an address this machine does not have
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    telemetry = drive.start(TelemetryConfig(recording=tmp_path / "r.mcap", lock_step=True))
    assert telemetry.endpoint is None
    assert telemetry.notices[0].startswith("nothing is published")
    drive.run(CYCLES)
    assert telemetry.close().complete
    (event,) = recorded(tmp_path / "r.mcap", "/events")
    assert event.code == "TELEMETRY_DOWN"
    drive.compare()


def test_f47_a_subscriber_that_dies_is_followed_by_the_next(drive: Drive) -> None:
    telemetry = drive.start(TelemetryConfig(listen=free_endpoint(), lock_step=True))
    for _ in range(2):
        with Subscriber(telemetry) as subscriber:
            drive.until(subscriber.heard)
    assert telemetry.alive
    drive.compare()


def test_f48_a_stopped_subscriber_costs_the_loop_nothing(drive: Drive, tmp_path: Path) -> None:
    path = tmp_path / "r.mcap"
    config = TelemetryConfig(listen=free_endpoint(), stream_rate=1000, recording=path, record_rate=1000, slots=64)
    telemetry = drive.start(config)
    with Subscriber(telemetry) as subscriber:
        drive.until(subscriber.heard)
        subscriber.process.send_signal(signal.SIGSTOP)
        drive.run(CYCLES)
        assert telemetry.alive
        # Telemetry itself cannot follow: the oldest is overwritten, and how much is known.
        os.kill(pid_of(telemetry), signal.SIGSTOP)
        drive.run(CYCLES)
        os.kill(pid_of(telemetry), signal.SIGCONT)
        summary = telemetry.close()
    assert summary.complete
    assert summary.lost >= CYCLES - 2 * 64
    assert "TELEMETRY_DROPPED" in {event.code for event in recorded(path, "/events")}
    drive.compare()


@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGSTOP])
def test_f49_telemetry_that_dies_or_hangs_is_started_again(drive: Drive, how: signal.Signals, tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    config = TelemetryConfig(listen=free_endpoint(), recording=path, record_rate=1000, lock_step=True, patience=0.1)
    telemetry = drive.start(config)
    endpoint, first, begin = telemetry.endpoint, pid_of(telemetry), drive.rig.hal.state.cycle + 1
    drive.run(500)
    os.kill(first, how)
    drive.until(lambda: (tmp_path / "run-1.mcap").exists() and pid_of(telemetry) != first and telemetry.alive)
    with Subscriber(telemetry) as subscriber:  # where the other one was
        drive.until(subscriber.heard)
    assert telemetry.endpoint == endpoint
    summary = telemetry.close()
    assert not summary.complete
    assert summary.restarts == 1
    assert summary.notices[0].startswith("telemetry has ended" if how is signal.SIGKILL else "telemetry hangs")
    codes = [event.code for event in recorded(tmp_path / "run-1.mcap", "/events")]
    assert "TELEMETRY_DOWN" in codes
    again = recorded(tmp_path / "run-1.mcap")
    assert [message.cycle for message in again] == list(range(again[0].cycle, drive.rig.hal.state.cycle + 1))
    # What the first child had written is there, without an index: it was not asked.
    kept = cycles_without_index(path)
    assert kept[:100] == list(range(begin, begin + 100))
    assert summary.recording is not None
    assert summary.recording.files == ("run.mcap", "run-1.mcap")
    assert not summary.recording.complete
    if how is signal.SIGKILL:  # a stopped one may be stopped anywhere
        assert summary.recording.missing_cycles == again[0].cycle - 1 - kept[-1]
    drive.compare()


def squat(endpoint: str) -> socket.socket:
    """A program that is not ours, listening where telemetry did."""
    host, port = endpoint.partition("/")[2].split(":")
    squatter = socket.socket()
    squatter.setsockopt(
        socket.SOL_SOCKET, socket.SO_REUSEADDR, 1
    )  # what was connected may still be waiting for its end
    squatter.bind((host, int(port)))
    squatter.listen()
    return squatter


@pytest.mark.parametrize("asked", [False, True], ids=["default endpoint", "endpoint asked for"])
def test_f49_a_restart_whose_port_is_taken_records_on(
    drive: Drive, asked: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    port = int(free_endpoint().rsplit(":", 1)[1])
    (tmp_path / "sitecustomize.py").write_text(
        f"import atalante_hal.telemetry.publisher as p; p.DEFAULT_PORT = {port}\n"
    )
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    listen = f"tcp/127.0.0.1:{port}"
    path = tmp_path / "run.mcap"
    config = TelemetryConfig(listen=listen if asked else None, recording=path, record_rate=1000, lock_step=True)
    telemetry = drive.start(config)
    assert telemetry.endpoint == listen
    first = pid_of(telemetry)
    os.kill(first, signal.SIGKILL)
    assert telemetry._child is not None
    telemetry._child.wait()
    with squat(listen):
        drive.until(lambda: telemetry._restarting is not None and not telemetry._restarting.is_alive())
        assert telemetry.alive
        assert pid_of(telemetry) != first
        if asked:
            assert telemetry.endpoint is None
        else:
            assert telemetry.endpoint not in (None, listen)
            with Subscriber(telemetry) as subscriber:
                drive.until(subscriber.heard)
        drive.run(100)
        summary = telemetry.close()
    assert summary.restarts == 1
    assert summary.recording is not None
    assert not summary.recording.complete
    again = [message.cycle for message in recorded(tmp_path / "run-1.mcap")]
    assert again == list(range(again[0], drive.rig.hal.state.cycle + 1))
    assert bool([notice for notice in summary.notices if f"cannot listen on {listen}" in notice]) is asked
    drive.compare()


def cycles_without_index(path: Path) -> list[int]:
    """Cycles that have all their messages in a recording, which may end anywhere."""
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


def test_f49_a_child_that_never_lives_is_given_up(drive: Drive) -> None:
    telemetry = drive.start(TelemetryConfig(publish=False, lock_step=True))
    killed = set()

    def given_up() -> bool:
        if telemetry.alive and pid_of(telemetry) not in killed:
            killed.add(pid_of(telemetry))
            os.kill(pid_of(telemetry), signal.SIGKILL)
        return telemetry._restarts > process_module.RESTARTS

    drive.until(given_up)
    assert len(killed) == process_module.RESTARTS + 1
    assert "not restarted after 3 restarts" in telemetry.close().notices[-1]
    drive.compare()

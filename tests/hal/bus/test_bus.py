"""Behaviour of every bus, run on each transport, and the special behaviour of some transports.

`FrameReceiver` contains the tests of receiving, and `FrameSender` contains the tests of sending. The subclasses of a transport
only create its two ends. The SocketCAN subclasses are in tests/vcan, because they need a kernel with SocketCAN.
"""

from __future__ import annotations

import errno
import gzip
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import ClassVar

import can
import numpy as np
import pytest

from atalante_dbc import Message, Network
from atalante_dbc.network import FD_LENGTHS
from atalante_hal.bus import Bus, BusAbsent, BusDown, BusError, BusFull, open_bus
from atalante_hal.bus.batch import is_legal
from atalante_hal.bus.channel_map import ChannelMapError, open_channels, parse_channel_map
from atalante_hal.bus.joined import JoinedBus
from atalante_hal.bus.pair import PairBus, lockstep_pair
from atalante_hal.bus.python_can import PythonCanBus, message_of
from atalante_hal.bus.replay import LogUnreadable, ReplayBus
from atalante_hal.bus.resilient import ResilientBus
from atalante_hal.bus.shared import shared_pair
from atalante_hal.bus.wrapped import WrappedBus
from atalante_hal.wire.frame import FLAG_BRS, FLAG_ESI, FLAG_FDF, ID_ERROR, ID_EXTENDED, ID_REMOTE, Frames, new_frames

BUSES = ("left_leg", "right_leg", "left_sense", "right_sense")


def random_frames(count: int, seed: int = 0, lengths: tuple[int, ...] = FD_LENGTHS) -> Frames:
    """Return CAN FD frames with random identifiers, lengths and payloads. Bytes after the payload are 0."""
    rng = np.random.default_rng(seed)
    frames = new_frames(count)
    frames["can_id"] = rng.integers(0, 0x800, count)
    frames["len"] = rng.choice(lengths, count)
    frames["flags"] = FLAG_FDF | FLAG_BRS
    frames["data"] = rng.integers(0, 256, (count, 64))
    frames["data"][np.arange(64) >= frames["len"][:, None]] = 0
    return frames


def other_frames() -> Frames:
    """Return frames that the robot does not use, but that a bus must transfer: classic, extended, remote, ESI."""
    frames = new_frames(5)
    frames["can_id"] = [0x123, 0x7FF, 0x12345678 | ID_EXTENDED, 0x42 | ID_REMOTE, 0x1FFFFFFF | ID_EXTENDED]
    frames["len"] = [8, 0, 5, 0, 64]
    frames["flags"] = [0, 0, 0, 0, FLAG_FDF | FLAG_ESI]
    frames["data"][0, :8] = np.arange(8)
    frames["data"][2, :5] = 0xA5
    frames["data"][4] = np.arange(64)
    return frames


def receive_all(bus: Bus, count: int, timeout: float = 5.0) -> Frames:
    """Receive exactly `count` frames, with as many calls as necessary."""
    received = new_frames(count)
    have = 0
    while have < count:
        part = new_frames(count - have)
        got = bus.receive(part, timeout)
        assert got, f"only {have} of {count} frames arrived"
        received[have : have + got] = part[:got]
        have += got
    return received


class FrameReceiver:
    """Tests of receiving, for every bus; subclasses define `deliver`."""

    def deliver(self, frames: Frames) -> Bus:
        """Return a bus on which exactly these frames have arrived."""
        raise NotImplementedError

    def test_frames_arrive_bit_for_bit_in_order(self) -> None:
        sent = random_frames(40, seed=1)
        assert receive_all(self.deliver(sent), 40).tobytes() == sent.tobytes()

    def test_classic_extended_remote_and_esi_frames_keep_their_kind(self) -> None:
        sent = other_frames()
        assert receive_all(self.deliver(sent), 5).tobytes() == sent.tobytes()

    def test_short_frame_contains_no_bytes_of_a_longer_earlier_frame(self) -> None:
        long, short = random_frames(1, lengths=(64,)), other_frames()[:1].copy()
        bus = self.deliver(np.concatenate([long, short]))
        frame = new_frames(1)
        for expected in (long, short):
            assert bus.receive(frame, 5.0) == 1
            assert frame.tobytes() == expected.tobytes()

    def test_frames_beyond_the_buffer_are_returned_by_the_next_receive(self) -> None:
        sent = random_frames(10, seed=2)
        bus = self.deliver(sent)
        block = new_frames(4)
        got: list[bytes] = []
        while len(got) < 10:
            count = bus.receive(block, 5.0)
            assert 0 < count <= 4
            got += [record.tobytes() for record in block[:count]]
        assert b"".join(got) == sent.tobytes()

    def test_buffer_beyond_the_received_frames_is_unchanged(self) -> None:
        block = random_frames(8, seed=3)
        before = block[2:].tobytes()
        assert self.deliver(random_frames(2)).receive(block, 5.0) in (1, 2)
        assert block[2:].tobytes() == before

    def test_receive_without_frames_returns_zero(self) -> None:
        bus = self.deliver(random_frames(3))
        receive_all(bus, 3)
        assert bus.receive(new_frames(4)) == 0
        assert bus.receive(new_frames(4), 0.002) == 0

    def test_time_stamps_are_integer_nanoseconds_and_never_decrease(self) -> None:
        bus = self.deliver(random_frames(30))
        block = new_frames(8)
        stamps: list[int] = []
        while len(stamps) < 30:
            count = bus.receive(block, 5.0)
            assert count
            stamps += bus.stamps[:count].tolist()
        assert bus.stamps.dtype == np.int64
        assert len(bus.stamps) >= len(block)
        assert stamps == sorted(stamps)

    def test_no_frame_is_dropped_if_all_are_received(self) -> None:
        bus = self.deliver(random_frames(20))
        receive_all(bus, 20)
        assert bus.dropped == 0

    def test_receive_rejects_buffers_that_are_not_contiguous_frames(self) -> None:
        bus = self.deliver(random_frames(2))
        with pytest.raises(TypeError, match="contiguous"):
            bus.receive(new_frames(8)[::2])
        with pytest.raises(TypeError, match="new_frames"):
            bus.receive(np.zeros(4, np.uint64))
        receive_all(bus, 2)

    def test_receive_on_a_closed_bus_raises_bus_down(self) -> None:
        bus = self.deliver(random_frames(2))
        bus.close()
        bus.close()
        with pytest.raises(BusDown, match="closed"):
            bus.receive(new_frames(1))


class FrameSender:
    """Tests of sending, for every bus; subclasses define the fixture `ends`."""

    @pytest.fixture
    def ends(self) -> Iterator[tuple[Bus, Bus]]:
        """Yield two connected buses."""
        raise NotImplementedError

    def deliver(self, frames: Frames) -> Bus:
        self.sender.send(frames)
        return self.receiver

    @pytest.fixture(autouse=True)
    def _wire(self, ends: tuple[Bus, Bus]) -> None:
        self.sender, self.receiver = ends

    def test_frames_are_transferred_in_both_directions(self) -> None:
        for source, sink in ((self.sender, self.receiver), (self.receiver, self.sender)):
            sent = random_frames(22, seed=4)
            source.send(sent)
            assert receive_all(sink, 22).tobytes() == sent.tobytes()

    def test_own_frames_are_not_received(self) -> None:
        self.sender.send(random_frames(3))
        receive_all(self.receiver, 3)
        assert self.sender.receive(new_frames(3), 0.002) == 0

    def test_sent_array_may_be_overwritten_immediately(self) -> None:
        frames = random_frames(4, seed=5, lengths=(12,))
        expected = b""
        for cycle in range(5):
            frames["data"][:, 0] = cycle
            frames["can_id"] += 1
            expected += frames.tobytes()
            self.sender.send(frames)
        assert receive_all(self.receiver, 20).tobytes() == expected

    def test_one_send_transmits_300_frames(self) -> None:
        sent = random_frames(300, seed=6)
        self.sender.send(sent)
        assert receive_all(self.receiver, 300).tobytes() == sent.tobytes()

    def test_send_without_frames_sends_nothing(self) -> None:
        self.sender.send(new_frames(0))
        assert self.receiver.receive(new_frames(2), 0.002) == 0

    @pytest.mark.parametrize(
        ("can_id", "length", "flags"),
        [
            (0x100, 13, FLAG_FDF),
            (0x100, 65, FLAG_FDF),
            (0x100, 12, 0),
            (0x100, 8, FLAG_BRS),
            (0x800, 8, FLAG_FDF),
            (0x100 | ID_REMOTE, 0, FLAG_FDF),
        ],
    )
    def test_batch_with_an_invalid_frame_is_rejected_as_a_whole(self, can_id: int, length: int, flags: int) -> None:
        frames = random_frames(3, seed=7)
        self.sender.send(frames)
        receive_all(self.receiver, 3)
        frames[2] = (can_id, length, flags, 0, 0)
        with pytest.raises(ValueError, match=r"frame 2 .*is not a valid CAN frame: with FDF"):
            self.sender.send(frames)
        assert self.receiver.receive(new_frames(3), 0.002) == 0

    def test_send_rejects_arrays_that_are_not_contiguous_frames(self) -> None:
        with pytest.raises(TypeError, match="contiguous"):
            self.sender.send(random_frames(8)[::2])
        with pytest.raises(TypeError, match="new_frames"):
            self.sender.send(np.zeros(4, np.uint64))

    def test_send_on_a_closed_bus_raises_bus_down(self) -> None:
        self.sender.close()
        with pytest.raises(BusDown, match="closed"):
            self.sender.send(random_frames(1))

    def test_send_without_a_receiver_raises_nothing(self) -> None:
        self.receiver.close()
        self.sender.send(random_frames(3))

    def test_bus_has_a_name(self) -> None:
        assert self.sender.name


class FrameWaiter:
    """Tests of waiting, for every bus that waits. The lock-step pair and the replay never wait."""

    sender: Bus
    receiver: Bus

    def test_receive_waits_for_the_first_frame(self) -> None:
        sent = random_frames(1, seed=8)
        later = threading.Timer(0.02, self.sender.send, (sent,))
        later.start()
        frame = new_frames(1)
        count = self.receiver.receive(frame, 30.0)
        later.join()
        assert count == 1
        assert frame.tobytes() == sent.tobytes()


class TestPairBus(FrameSender, FrameReceiver):
    @pytest.fixture
    def ends(self) -> Iterator[tuple[Bus, Bus]]:
        one, other = lockstep_pair()
        yield one, other
        one.close()
        other.close()


class TestSharedBus(FrameSender, FrameReceiver, FrameWaiter):
    @pytest.fixture
    def ends(self) -> Iterator[tuple[Bus, Bus]]:
        one, other = shared_pair()
        yield one, other
        one.close()
        other.close()


class TestWrappedBus(FrameSender, FrameReceiver):
    @pytest.fixture
    def ends(self) -> Iterator[tuple[Bus, Bus]]:
        one, other = map(WrappedBus, lockstep_pair())
        yield one, other
        one.close()
        other.close()


class TestPythonCanVirtual(FrameSender, FrameReceiver, FrameWaiter):
    @pytest.fixture
    def ends(self, request: pytest.FixtureRequest) -> Iterator[tuple[Bus, Bus]]:
        channel = request.node.name
        one, other = open_bus("virtual", channel), open_bus("virtual", channel)
        yield one, other
        one.close()
        other.close()


def network_of(bus_of: dict[int, str]) -> Network:
    """Return a network with one message per identifier, on the given bus."""
    messages = tuple(
        Message(f"M{i}", frame_id, 8, "HAL", (), bus, "cyclic", 1, 0, 0, i, "")
        for i, (frame_id, bus) in enumerate(bus_of.items())
    )
    return Network((), messages, BUSES, 1_000_000, 5_000_000, 0)


class TestJoinedBus(FrameSender, FrameReceiver, FrameWaiter):
    """A joined bus with two channels. All frames of these tests are on one channel, so that their order is defined."""

    @pytest.fixture
    def ends(self, request: pytest.FixtureRequest) -> Iterator[tuple[Bus, Bus]]:
        network = network_of(dict.fromkeys([*range(0x800), *other_frames()["can_id"].tolist()], "right_leg"))
        joined = []
        for _ in range(2):
            legs, senses = (open_bus("virtual", f"{request.node.name} {part}") for part in ("legs", "senses"))
            joined.append(JoinedBus(network, dict(zip(BUSES, (legs, legs, senses, senses), strict=True))))
        yield joined[0], joined[1]
        for bus in joined:
            bus.close()


class TestReplayLog(FrameReceiver):
    suffix: ClassVar[str] = ".log"

    @pytest.fixture(autouse=True)
    def _folder(self, tmp_path: Path) -> Iterator[None]:
        self.folder = tmp_path
        self.opened: list[Bus] = []
        yield
        for bus in self.opened:
            bus.close()

    def deliver(self, frames: Frames) -> Bus:
        self.opened.append(ReplayBus(write_log(self.folder / f"recording{self.suffix}", frames)))
        return self.opened[-1]


class TestReplayAsc(TestReplayLog):
    suffix = ".asc"


class TestReplayBlf(TestReplayLog):
    suffix = ".blf"


class TestReplayZipped(TestReplayLog):
    suffix = ".log.gz"


def write_log(path: Path, frames: Frames) -> Path:
    """Write a log of these frames, 1 ms apart, with python-can."""
    with can.Logger(path) as log:
        for index, (can_id, length, flags, _, data) in enumerate(frames.tolist()):
            message = message_of(can_id, length, flags, bytes(data))
            message.timestamp = 1_700_000_000.0 + index * 1e-3
            message.channel = 0
            log.on_message_received(message)
    return path


def test_pair_steps_the_peer_only_if_no_frame_is_queued() -> None:
    hal, emulator = lockstep_pair()
    inbox, answer = new_frames(8), random_frames(3, seed=9)
    steps = []

    def step() -> None:
        steps.append(emulator.receive(inbox))
        emulator.send(answer)

    hal.step = step
    hal.send(random_frames(2))
    frames = new_frames(2)
    assert hal.receive(frames) == 2
    assert hal.receive(frames) == 1
    assert steps == [2]
    assert hal.receive(frames) == 2
    assert steps == [2, 0]


def test_pair_returns_zero_frames_if_the_peer_sends_none() -> None:
    hal, _ = lockstep_pair()
    hal.step = lambda: None
    assert hal.receive(new_frames(1)) == 0


def test_pair_time_stamps_are_the_receivers_simulated_time() -> None:
    one, other = lockstep_pair()
    one.send(random_frames(3))
    other.now_ns = 123_456_789_000
    other.receive(new_frames(3))
    other.now_ns += 1_000_000
    assert other.stamps[:3].tolist() == [123_456_789_000] * 3


def test_pair_without_simulated_time_stamps_frames_with_the_time_of_day() -> None:
    one, other = lockstep_pair()
    one.send(random_frames(3))
    before = time.time_ns()
    other.receive(new_frames(3))
    assert before <= other.stamps[0] <= time.time_ns()
    assert other.stamps[:3].tolist() == [other.stamps[0]] * 3


def test_full_pair_rejects_whole_batches() -> None:
    one, other = lockstep_pair(capacity=10)
    sent = random_frames(4)
    one.send(sent)
    one.send(sent)
    with pytest.raises(BusFull, match="is full, with 8 frames") as refusal:
        one.send(sent)
    assert refusal.value.sent == 0
    assert receive_all(other, 3).tobytes() == sent[:3].tobytes()
    one.send(sent)
    assert receive_all(other, 9).tobytes() == np.concatenate([sent[3:], sent, sent]).tobytes()
    assert other.receive(new_frames(1)) == 0


def test_pair_transfers_frames_of_many_short_lived_arrays() -> None:
    one, other = lockstep_pair()
    for seed in range(200):
        sent, received = random_frames(3, seed), new_frames(3)
        one.send(sent)
        assert other.receive(received) == 3
        assert received.tobytes() == sent.tobytes()


def test_virtual_bus_drops_and_counts_invalid_frames() -> None:
    with can.Bus(interface="virtual", channel="made-up", protocol=can.CanProtocol.CAN_FD) as sender:
        bus = PythonCanBus("virtual", "made-up")
        for data, is_fd in ((bytes(13), True), (bytes(9), False), (bytes(12), True), (bytes(70), True)):
            sender.send(can.Message(arbitration_id=1, is_extended_id=False, is_fd=is_fd, data=data))
        received = new_frames(4)
        assert bus.receive(received) == 1
        assert received["len"][0] == 12
        assert bus.dropped == 3
        bus.close()


def test_full_virtual_bus_reports_the_number_of_sent_frames() -> None:
    listener = PythonCanBus("virtual", "full", rx_queue_size=5)
    bus = PythonCanBus("virtual", "full")
    with pytest.raises(BusFull, match="accepted 5 of 8 frames") as refusal:
        bus.send(random_frames(8))
    assert refusal.value.sent == 5
    bus.close()
    listener.close()


@pytest.mark.parametrize("code", [errno.ENODEV, None])
def test_lost_virtual_bus_reports_the_number_of_sent_frames(code: int | None, monkeypatch: pytest.MonkeyPatch) -> None:
    bus = PythonCanBus("virtual", "lost")
    answers = iter([None, None, can.CanOperationError("gone", code) if code else OSError("gone")])

    def send(message: can.Message, timeout: float) -> None:
        if (error := next(answers)) is not None:
            raise error

    monkeypatch.setattr(bus._bus, "send", send)
    with pytest.raises(BusDown, match="is down: gone") as refusal:
        bus.send(random_frames(4))
    assert refusal.value.sent == 2
    bus.close()


@pytest.mark.parametrize(
    ("interface", "options", "sentence"),
    [
        ("pigeon", {}, "no CAN interface 'pigeon'; use one of .*socketcan.*vector"),
        ("pcan", {}, "cannot open pcan:x for CAN FD: .*atalante doctor -i pcan"),
        (
            "virtual",
            {"protocol": can.CanProtocol.CAN_20},
            "virtual:x supports classic CAN only, but CAN FD is required",
        ),
    ],
)
def test_error_at_opening_names_the_valid_choices(interface: str, options: dict[str, object], sentence: str) -> None:
    with pytest.raises(BusAbsent, match=sentence):
        open_bus(interface, "x", **options)


def test_replay_returns_one_cycle_at_a_time(tmp_path: Path) -> None:
    frames = random_frames(11, lengths=(12,))
    frames["can_id"] = [0x181, 0x10, 0x181, 0x182, 0x10, 0x10, 0x181, 0x182, 0x183, 0x184, 0x10]
    bus = ReplayBus(write_log(tmp_path / "run.log", frames), cycle_id=0x10)
    block = new_frames(4)
    counts, stamps = [], []
    while not bus.ended:
        count = bus.receive(block)
        counts.append(count)
        stamps += bus.stamps[:count].tolist()
    assert counts == [1, 3, 1, 4, 1, 1]
    assert bus.receive(block) == 0
    assert np.diff(stamps) == pytest.approx(1_000_000, abs=1000)


def test_send_to_a_replay_is_rejected(tmp_path: Path) -> None:
    bus = ReplayBus(write_log(tmp_path / "run.log", random_frames(2)))
    with pytest.raises(BusError, match="recording: nothing can be sent"):
        bus.send(random_frames(1))
    bus.close()


def test_replay_counts_records_that_are_not_valid_frames(tmp_path: Path) -> None:
    log = tmp_path / "run.log"
    log.write_text("(1.0) can0 100##5000102030405060708090A0B0C\n(1.1) can0 101##500\n", encoding="ascii")
    bus = ReplayBus(log)
    block = new_frames(4)
    assert bus.receive(block) == 1
    assert block["can_id"][0] == 0x101
    assert bus.dropped == 1


def broken_logs(folder: Path) -> dict[str, tuple[Path, str]]:
    whole = {suffix: write_log(folder / f"whole{suffix}", random_frames(400)) for suffix in (".log", ".asc", ".blf")}
    cases = {
        "missing": (folder / "nowhere.log", "nowhere.log cannot be opened as a CAN log: No such file"),
        "folder": (folder, "the log format must be"),
        "suffix": (
            folder / "run.pcap",
            "the log format must be one that python-can can read, such as .log .*, got '.pcap'",
        ),
        "no suffix": (folder / "run", "the log format must be"),
        "csv": (folder / "run.csv", "cannot store CAN FD frames completely; record the log as .log, .asc or .blf"),
        "db": (folder / "run.db", "cannot store CAN FD frames completely"),
    }
    for suffix, path in whole.items():
        cut, empty, noise = (folder / f"{name}{suffix}" for name in ("cut", "empty", "noise"))
        content = path.read_bytes()
        cut.write_bytes(content[: len(content) * 2 // 3 - (content[len(content) * 2 // 3 - 1] == ord("\n"))])
        empty.write_bytes(b"")
        noise.write_bytes(np.random.default_rng(1).bytes(4000) + b"\n")
        cases[f"cut {suffix}"] = (cut, "cut.* is truncated")
        cases[f"empty {suffix}"] = (empty, "empty")
        cases[f"noise {suffix}"] = (noise, "cannot be read beyond frame 0|not a .blf log")
    relative = folder / "relative.asc"
    relative.write_text(whole[".asc"].read_text().replace("timestamps absolute", "timestamps relative"))
    cases["relative .asc"] = (relative, 'relative.asc: the time stamps must be absolute, got "timestamps relative"')
    return cases


def test_invalid_log_is_rejected_with_one_sentence(tmp_path: Path) -> None:
    for name, (path, sentence) in broken_logs(tmp_path).items():
        with pytest.raises(LogUnreadable, match=sentence) as refusal:
            ReplayBus(path)
        assert "\n" not in str(refusal.value), name


@pytest.mark.parametrize("suffix", [".asc", ".asc.gz"])
def test_asc_log_is_replayed_with_every_sent_frame_once_and_its_format(suffix: str, tmp_path: Path) -> None:
    text = "".join(
        (
            "date Sat Nov 28 10:00:00.000 am 2026\n",
            "base hex  timestamps absolute\n",
            " 0.010000 1  101             Rx   d 2 00 01\n",
            " 0.020000 1  102             TxRq d 2 00 02\n",
            " 0.020000 1  102             Tx   d 2 00 02\n",
            " 0.030000 CANFD   1 Rx  103   0 0 2  2 00 03  240000  130        0 0 0 0 0 0\n",
            " 0.040000 CANFD   1 Rx  104   1 0 8  8 00 04 00 00 00 00 00 00  0 0 3000 0 0 0 0 0\n",
        )
    )
    path = tmp_path / f"run{suffix}"
    path.write_bytes(gzip.compress(text.encode()) if suffix == ".asc.gz" else text.encode())
    bus, frames = ReplayBus(path), new_frames(8)
    assert bus.receive(frames) == 4
    assert frames["can_id"][:4].tolist() == [0x101, 0x102, 0x103, 0x104]
    assert frames["flags"][:4].tolist() == [0, 0, 0, FLAG_FDF | FLAG_BRS]
    bus.close()


@pytest.mark.parametrize("suffix", [".blf", ".blf.gz"])
def test_blf_log_that_was_not_closed_is_rejected(suffix: str, tmp_path: Path) -> None:
    """The recorder is killed: only full containers are in the file, and the header still states no data."""
    path = tmp_path / f"killed{suffix}"
    with (tmp_path / "open.blf").open("wb") as file:
        writer = can.BLFWriter(file, max_container_size=4096)
        for can_id, length, flags, _, data in random_frames(400).tolist():
            writer.on_message_received(message_of(can_id, length, flags, bytes(data)))
        file.flush()
        content = (tmp_path / "open.blf").read_bytes()
    path.write_bytes(gzip.compress(content) if suffix == ".blf.gz" else content)
    with pytest.raises(LogUnreadable, match=f"killed{suffix} was not closed by its recorder"):
        ReplayBus(path)


def test_complete_zipped_blf_log_is_replayed(tmp_path: Path) -> None:
    content = write_log(tmp_path / "run.blf", np.repeat(random_frames(1), 2000)).read_bytes()
    zipped = tmp_path / "run.blf.gz"
    zipped.write_bytes(gzip.compress(content))
    assert zipped.stat().st_size < len(content)
    bus = ReplayBus(zipped, capacity=4000)
    assert bus.receive(new_frames(4000)) == 2000
    bus.close()


def test_truncated_zipped_log_is_replayed_up_to_its_end(tmp_path: Path) -> None:
    content = write_log(tmp_path / "run.log", random_frames(2000)).read_bytes()
    zipped = gzip.compress(content)
    broken = tmp_path / "run.log.gz"
    broken.write_bytes(zipped[: len(zipped) // 2])
    bus = ReplayBus(broken)
    assert receive_all(bus, 500)["len"].tolist() == random_frames(2000)["len"][:500].tolist()
    with pytest.raises(LogUnreadable, match="cannot be read beyond frame"):
        receive_all(bus, 1500)


def test_error_frame_keeps_its_error_flag() -> None:
    frames = new_frames(1)
    frames["can_id"], frames["len"] = ID_ERROR, 8
    one, other = open_bus("virtual", "errors"), open_bus("virtual", "errors")
    one.send(frames)
    assert receive_all(other, 1)["can_id"][0] & ID_ERROR
    one.close()
    other.close()


def test_valid_lengths_and_identifiers_are_those_of_iso_11898() -> None:
    assert [n for n in range(256) if is_legal(0x100, n, FLAG_FDF)] == [*range(9), 12, 16, 20, 24, 32, 48, 64]
    assert [n for n in range(256) if is_legal(0x100, n, 0)] == list(range(9))
    assert [i for i in (0x7FF, 0x800, 0x800 | ID_EXTENDED) if is_legal(i, 8, 0)] == [0x7FF, 0x800 | ID_EXTENDED]


def test_channel_map_of_one_channel_assigns_it_to_all_buses() -> None:
    assert parse_channel_map("vcan0", BUSES) == dict.fromkeys(BUSES, "vcan0")


def test_channel_map_accepts_the_buses_in_any_order() -> None:
    text = "right_leg=can1, left_leg=can0,right_sense=can3,left_sense=can0"
    assert list(parse_channel_map(text, BUSES).items()) == [
        ("left_leg", "can0"),
        ("right_leg", "can1"),
        ("left_sense", "can0"),
        ("right_sense", "can3"),
    ]


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("", "empty entry; write one channel for all"),
        ("left_leg=can0,,right_leg=can1", "empty entry"),
        ("can0,can1", "must name the bus of each channel"),
        ("left_leg=can0,can1", "must be BUS=CHANNEL, got 'can1'"),
        ("left_leg=", "must be BUS=CHANNEL"),
        ("left_arm=can0", "must be one of left_leg, right_leg, left_sense, right_sense, got 'left_arm'"),
        ("left_leg=can0,left_leg=can1", "must assign left_leg once, got it twice: can0 and can1"),
        ("left_leg=can0,right_sense=can1", "no channel for right_leg, left_sense; write left_leg=can0,right_leg=can1"),
    ],
)
def test_invalid_channel_map_is_rejected_with_the_valid_form(text: str, sentence: str) -> None:
    with pytest.raises(ChannelMapError, match=sentence):
        parse_channel_map(text, BUSES)


def test_each_channel_is_opened_once() -> None:
    buses = open_channels("virtual", parse_channel_map("map-test", BUSES))
    assert list(buses) == list(BUSES)
    assert len({id(bus) for bus in buses.values()}) == 1
    buses["left_leg"].close()


def test_channels_are_closed_if_one_cannot_be_opened(monkeypatch: pytest.MonkeyPatch) -> None:
    opened: list[Bus] = []

    def open_first_two(interface: str, channel: str) -> Bus:
        if len(opened) == 2:
            raise BusAbsent("there is no interface can2")
        opened.append(lockstep_pair()[0])
        return opened[-1]

    monkeypatch.setattr("atalante_hal.bus.channel_map.open_bus", open_first_two)
    with pytest.raises(BusAbsent, match="can2"):
        open_channels("socketcan", {bus: f"can{index}" for index, bus in enumerate(BUSES)})
    assert len(opened) == 2
    for bus in opened:
        with pytest.raises(BusDown):
            bus.receive(new_frames(1))


def four_pairs(network: Network) -> tuple[JoinedBus, dict[str, PairBus], dict[str, PairBus]]:
    """Return a joined bus, the channels of its four buses, and the far end of each channel."""
    pairs = {bus: lockstep_pair(capacity=8, names=(bus, f"{bus} peer")) for bus in BUSES}
    near, far = ({bus: ends[end] for bus, ends in pairs.items()} for end in (0, 1))
    return JoinedBus(network, near), near, far


def frames_of(network: Network, *names: str) -> Frames:
    """Return empty frames of these messages."""
    frames = new_frames(len(names))
    for frame, name in zip(frames, names, strict=True):
        message = network.message(name)
        frame["can_id"], frame["len"], frame["flags"] = message.frame_id, message.length, FLAG_FDF | FLAG_BRS
    return frames


def test_joined_bus_sends_each_frame_to_the_bus_of_its_message(network: Network) -> None:
    joined, _, far = four_pairs(network)
    frames = frames_of(network, *(m.name for m in network.messages if m.cycle_ms == 1))
    for cycle in range(3):
        frames["data"][:, 3] = cycle
        joined.send(frames)
        for bus, end in far.items():
            expected = frames[[network.messages[i].bus == bus for i in _message_indices(network, frames)]]
            assert receive_all(end, len(expected)).tobytes() == expected.tobytes()
            assert end.receive(new_frames(1)) == 0


def _message_indices(network: Network, frames: Frames) -> list[int]:
    ids = [m.frame_id for m in network.messages]
    return [ids.index(frame_id) for frame_id in frames["can_id"].tolist()]


def test_joined_bus_receives_frames_and_time_stamps_of_every_channel(network: Network) -> None:
    joined, near, far = four_pairs(network)
    for cycle in range(4):  # four cycles, because each call of `receive` starts with another of the four channels
        for index, bus in enumerate(BUSES):
            frames = frames_of(network, *[m.name for m in network.messages if m.bus == bus and m.cycle_ms == 1][:2])
            far[bus].send(frames)
            near[bus].now_ns = 1000 * cycle + index
        block = new_frames(16)
        assert joined.receive(block) == 8
        buses = [network.messages[i].bus for i in _message_indices(network, block[:8])]
        assert sorted(buses) == sorted(BUSES * 2)
        assert joined.stamps[:8].tolist() == [1000 * cycle + BUSES.index(bus) for bus in buses]


def test_joined_bus_rejects_a_batch_with_an_unknown_frame(network: Network) -> None:
    joined, _, far = four_pairs(network)
    frames = frames_of(network, "SYNC_LEFT_LEG", "SYNC_RIGHT_LEG")
    frames["can_id"][1] = 0x7FE
    with pytest.raises(ValueError, match=r"frame 1 \(id 0x7FE\) is not a message of the network"):
        joined.send(frames)
    assert far["left_leg"].receive(new_frames(1)) == 0


def test_joined_bus_uses_the_other_channels_if_one_is_full_or_closed(network: Network) -> None:
    joined, near, far = four_pairs(network)
    syncs = frames_of(network, *(f"SYNC_{bus.upper()}" for bus in BUSES))
    for _ in range(8):
        joined.send(syncs)
        for bus in BUSES[1:]:
            receive_all(far[bus], 1)
    with pytest.raises(BusFull, match="the receive queue of left_leg peer is full, with 8 frames") as refusal:
        joined.send(syncs)
    assert refusal.value.sent == 3
    for bus in BUSES[1:]:
        receive_all(far[bus], 1)
    near[BUSES[0]].close()
    with pytest.raises(BusDown, match="left_leg is closed"):
        joined.send(syncs)
    for bus in BUSES[1:]:
        receive_all(far[bus], 1)


@pytest.mark.parametrize("kind", [BusDown, BusFull])
def test_error_of_a_joined_bus_contains_the_accepted_frames(network: Network, kind: type[BusError]) -> None:
    joined, near, far = four_pairs(network)
    names = ("SYNC_LEFT_LEG", "COMMAND_LEFT_LEG", "SYNC_RIGHT_LEG", "COMMAND_RIGHT_LEG")
    frames = frames_of(network, *names)
    if kind is BusDown:
        near["left_leg"].close()
        accepted = ["SYNC_RIGHT_LEG", "COMMAND_RIGHT_LEG"]
    else:
        limited = FirstFrameBus(near["left_leg"])
        joined = JoinedBus(network, near | {"left_leg": limited})
        accepted = ["SYNC_LEFT_LEG", "SYNC_RIGHT_LEG", "COMMAND_RIGHT_LEG"]
    with pytest.raises(kind) as refusal:
        joined.send(frames)
    sent = refusal.value.accepted_of(frames)
    assert [network.messages[i].name for i in _message_indices(network, sent)] == accepted
    assert refusal.value.sent == len(accepted)
    assert sum(end.receive(new_frames(8)) for end in far.values()) == len(accepted)


class FirstFrameBus(WrappedBus):
    """Bus whose transmit queue has room for one frame."""

    def send(self, frames: Frames) -> None:
        """Send the first frame and reject the others."""
        super().send(frames[:1].copy())
        raise BusFull("no room", 1)


@pytest.mark.parametrize(("full", "down"), [("left_leg", "right_leg"), ("right_leg", "left_leg")])
def test_joined_bus_with_a_full_and_a_closed_channel_reports_both(network: Network, full: str, down: str) -> None:
    joined, near, _ = four_pairs(network)
    syncs = frames_of(network, "SYNC_LEFT_LEG", "SYNC_RIGHT_LEG", "SYNC_LEFT_SENSE")
    for _ in range(8):
        near[full].send(frames_of(network, f"SYNC_{full.upper()}"))
    near[down].close()
    with pytest.raises(BusDown, match=f"{down} is closed") as refusal:
        joined.send(syncs)
    assert refusal.value.full is not None
    assert str(refusal.value.full).startswith(f"{full} cannot send")
    for error in (refusal.value, refusal.value.full):
        assert error.accepted_of(syncs)["can_id"].tolist() == syncs["can_id"][2:].tolist()
    assert f"{down} is closed" in joined.down
    lossy = ResilientBus(joined)
    with pytest.raises(BusFull, match=f"{full} cannot send"):
        lossy.send(syncs)
    assert f"{down} is closed" in lossy.down


@pytest.mark.parametrize(("other", "down"), [("left_leg", "right_leg"), ("right_leg", "left_leg")])
def test_joined_bus_raises_the_error_of_the_lost_channel_first(network: Network, other: str, down: str) -> None:
    class Failing(WrappedBus):
        def send(self, frames: Frames) -> None:
            raise BusError("the kernel reports an error")

    channels: dict[str, Bus] = {bus: lockstep_pair(capacity=8, names=(bus, f"{bus} peer"))[0] for bus in BUSES}
    channels[down].close()
    channels[other] = Failing(channels[other])
    with pytest.raises(BusDown, match=f"{down} is closed"):
        JoinedBus(network, channels).send(frames_of(network, "SYNC_LEFT_LEG", "SYNC_RIGHT_LEG", "SYNC_LEFT_SENSE"))


def test_joined_bus_requires_a_channel_for_every_bus(network: Network) -> None:
    with pytest.raises(ValueError, match="; right_leg is missing"):
        JoinedBus(network, {"left_leg": lockstep_pair()[0]})

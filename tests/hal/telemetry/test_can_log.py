"""CAN log: every frame that the HAL sent or received is logged without change, in every format."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

import can
import numpy as np
import pytest

import atalante_dbc
from atalante_dbc.network import FD_LENGTHS
from atalante_hal.telemetry.can_log import FORMATS, CanLog, check_format
from atalante_hal.telemetry.frames import FRAME_RECORD, FRAMES_PER_RECORD, RingTap, batches
from atalante_hal.telemetry.ring import RingReader, RingWriter
from atalante_hal.telemetry.sink import SinkError
from atalante_hal.wire.frame import FLAG_BRS, FLAG_ESI, FLAG_FDF, ID_ERROR, ID_EXTENDED, ID_REMOTE, Frames, new_frames


def random_frames(network: atalante_dbc.Network, count: int, seed: int = 0) -> Frames:
    rng = np.random.default_rng(seed)
    frames = new_frames(count)
    frames["can_id"] = rng.choice([message.frame_id for message in network.messages], count)
    frames["len"] = rng.choice(FD_LENGTHS, count)
    frames["flags"] = FLAG_FDF | FLAG_BRS
    frames["data"] = rng.integers(0, 256, (count, 64))
    return frames


def open_log(path: Path, network: atalante_dbc.Network) -> CanLog:
    return CanLog(path, network.buses, {message.frame_id: message.bus for message in network.messages})


def read(path: Path) -> list[can.Message]:
    return list(can.LogReader(path))


class TestFormats:
    @pytest.mark.parametrize("suffix", FORMATS)
    def test_every_frame_is_read_back(self, suffix: str, network: atalante_dbc.Network, tmp_path: Path) -> None:
        path = tmp_path / "logs" / f"run{suffix}"
        frames = random_frames(network, 500)
        stamps = np.arange(500) * 1_000_000 + 5_000_000_000
        sent = (np.arange(500) % 3 == 0).astype(np.uint8)
        with open_log(path, network) as log:
            log.write(frames[:200], stamps[:200], sent[:200])
            log.write(frames[200:], stamps[200:], sent[200:])
            assert log.frames == 500
        found = read(path)
        assert len(found) == 500
        by_name = suffix.startswith(".log")
        buses = {message.frame_id: message.bus for message in network.messages}
        for message, frame, is_sent in zip(found, frames, sent, strict=True):
            assert message.arbitration_id == frame["can_id"]
            assert not message.is_extended_id
            assert bytes(message.data) == bytes(frame["data"][: frame["len"]])
            assert message.is_fd
            assert message.bitrate_switch
            assert message.is_rx != is_sent
            bus = buses[message.arbitration_id]
            assert message.channel == (bus if by_name else network.buses.index(bus))
        first = found[0].timestamp
        times = np.array([message.timestamp - first for message in found])
        np.testing.assert_allclose(times, np.arange(500) * 1e-3, atol=2e-6)

    def test_classic_extended_remote_and_error_frames_keep_their_kind(
        self, network: atalante_dbc.Network, tmp_path: Path
    ) -> None:
        frames = new_frames(5)
        frames["can_id"] = 0x123, 0x123 | ID_EXTENDED, 0x123 | ID_REMOTE, ID_ERROR | 0x4, 0x180
        frames["len"] = 3, 8, 0, 8, 12
        frames["flags"] = 0, 0, 0, 0, FLAG_FDF | FLAG_ESI
        frames["data"] = 0xA5
        path = tmp_path / "odd.log"
        with open_log(path, network) as log:
            log.write(frames, np.zeros(5, np.int64), np.zeros(5, np.uint8))
        found = read(path)
        assert [message.is_fd for message in found] == [False, False, False, False, True]
        assert [message.is_extended_id for message in found[:3]] == [False, True, False]
        assert [message.is_remote_frame for message in found] == [False, False, True, False, False]
        assert [message.is_error_frame for message in found] == [False, False, False, True, False]
        assert [len(message.data) for message in found[:2]] == [3, 8]
        assert found[4].error_state_indicator
        assert not found[4].bitrate_switch
        assert {message.channel for message in found if not message.is_error_frame} == {"foreign"}

    @pytest.mark.parametrize("suffix", [".log", ".blf"])
    def test_same_frames_give_the_same_file(self, suffix: str, network: atalante_dbc.Network, tmp_path: Path) -> None:
        frames = random_frames(network, 2000)
        for name in ("one", "two"):
            with open_log(tmp_path / f"{name}{suffix}", network) as log:
                log.write(frames, np.arange(2000) * 1_000_000, np.zeros(2000, np.uint8))
        assert (tmp_path / f"one{suffix}").read_bytes() == (tmp_path / f"two{suffix}").read_bytes()

    @pytest.mark.parametrize("suffix", FORMATS)
    def test_frame_older_than_the_first_frame_keeps_the_time_of_the_log(
        self, suffix: str, network: atalante_dbc.Network, tmp_path: Path
    ) -> None:
        begin = 1_700_000_000_000_000_000
        stamps = np.array([begin, begin - 300_000, begin + 1_000_000])
        with open_log(tmp_path / f"run{suffix}", network) as log:
            log.write(random_frames(network, 3), stamps, np.array([1, 0, 0], np.uint8))
        times = np.array([message.timestamp for message in read(tmp_path / f"run{suffix}")])
        assert np.allclose(times - times[0], [0.0, 0.0, 1e-3], atol=0.5e-3)

    @pytest.mark.parametrize("name", ["run.db", "run.csv", "run.trc", "run.blf.gz", "run.txt", "run", "run.log.bz2"])
    def test_lossy_format_is_rejected_with_the_valid_formats(self, name: str, tmp_path: Path) -> None:
        with pytest.raises(SinkError, match=r"end its name in one of \.log, \.asc, \.blf"):
            check_format(tmp_path / name)

    def test_file_that_cannot_be_created_gives_an_error_message(
        self, network: atalante_dbc.Network, tmp_path: Path
    ) -> None:
        (tmp_path / "file").touch()
        with pytest.raises(SinkError, match="cannot be created"):
            open_log(tmp_path / "file" / "run.log", network)

    @pytest.mark.parametrize("suffix", FORMATS)
    def test_file_that_another_run_writes_is_rejected_and_unchanged(
        self, suffix: str, network: atalante_dbc.Network, tmp_path: Path
    ) -> None:
        path = tmp_path / f"run{suffix}"
        frames, stamps, sent = random_frames(network, 100), np.arange(100), np.zeros(100, np.uint8)
        with open_log(path, network) as log:
            log.write(frames, stamps, sent)
            with pytest.raises(SinkError, match="another run writes"):
                open_log(path, network)
        assert len(read(path)) == 100
        with open_log(path, network) as log:  # the lock is released
            log.write(frames[:5], stamps[:5], sent[:5])
        assert len(read(path)) == 5

    def test_full_disk_gives_an_error_message(self, network: atalante_dbc.Network, tmp_path: Path) -> None:
        path = tmp_path / "full.log"
        path.symlink_to("/dev/full")
        frames = random_frames(network, 1000)
        log = open_log(path, network)
        with pytest.raises(SinkError, match="No space left on device") as refused:
            log.write(frames, np.zeros(1000, np.int64), np.zeros(1000, np.uint8))
        assert refused.value.code == "RECORD_STOPPED"
        log.close()


class TestTap:
    """The path of frames from the HAL through the ring to the log."""

    @staticmethod
    def emptied(reader: RingReader) -> tuple[Frames, np.ndarray, np.ndarray]:
        parts: list[Sequence[np.ndarray]] = [tuple(part.copy() for part in batch) for batch in batches(reader.read())]
        frames, stamps, sent = (np.concatenate([part[column] for part in parts]) for column in range(3))
        return frames, stamps, sent

    def test_frames_keep_bytes_order_direction_and_time(self, network: atalante_dbc.Network) -> None:
        received, commands = random_frames(network, 40, 1), random_frames(network, 7, 2)
        now = [100]
        stamps = np.arange(40) + 50
        with (
            RingWriter(FRAME_RECORD.itemsize, 8) as ring,
            RingReader(os.dup(ring.fd)) as reader,
        ):
            tap = RingTap(ring, lambda: now[0], lambda: stamps)
            tap.begin_run(1000)
            tap.received(received, 22)
            tap.sent(commands)
            tap.flush()
            assert ring.written == 1
            frames, times, sent = self.emptied(reader)
        assert frames.tobytes() == received[:22].tobytes() + commands.tobytes()
        assert times.tolist() == [*range(1050, 1072), *[1100] * 7]
        assert sent.tolist() == [0] * 22 + [1] * 7

    @pytest.mark.parametrize("count", [0, 1, FRAMES_PER_RECORD, FRAMES_PER_RECORD + 1, 3 * FRAMES_PER_RECORD + 5])
    def test_many_frames_are_split_into_several_records(self, network: atalante_dbc.Network, count: int) -> None:
        frames = random_frames(network, max(count, 1))
        stamps = np.arange(max(count, 1))
        with RingWriter(FRAME_RECORD.itemsize, 16) as ring, RingReader(os.dup(ring.fd)) as reader:
            tap = RingTap(ring, lambda: 7, lambda: stamps)
            tap.received(frames, count)
            tap.flush()
            tap.flush()
            assert ring.written == -(-count // FRAMES_PER_RECORD)
            if count:
                found, times, _ = self.emptied(reader)
                assert found.tobytes() == frames[:count].tobytes()
                assert times.tolist() == list(range(count))

    def test_array_may_be_overwritten_after_the_call(self, network: atalante_dbc.Network) -> None:
        frames = random_frames(network, 3)
        kept = frames.tobytes()
        with RingWriter(FRAME_RECORD.itemsize, 4) as ring, RingReader(os.dup(ring.fd)) as reader:
            tap = RingTap(ring, lambda: 7)
            tap.sent(frames)
            frames["data"] = 0
            tap.flush()
            assert self.emptied(reader)[0].tobytes() == kept

    def test_new_run_keeps_the_time_stamps_of_earlier_frames(self, network: atalante_dbc.Network) -> None:
        frames = random_frames(network, 1)
        with RingWriter(FRAME_RECORD.itemsize, 4) as ring, RingReader(os.dup(ring.fd)) as reader:
            tap = RingTap(ring, lambda: 7)
            tap.sent(frames)
            tap.begin_run(1000)
            tap.sent(frames)
            tap.flush()
            assert self.emptied(reader)[1].tolist() == [7, 1007]

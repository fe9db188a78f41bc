"""Ring buffer: records are read in order, overwritten records are counted, and no end waits for a process that has ended."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from atalante_hal.telemetry.ring import NOTES_BYTES, RingError, RingReader, RingWriter

SIZE = 24


def record(number: int, size: int = SIZE) -> bytes:
    """Return a record that repeats one number, so that a mixture of two records is visible."""
    return np.full(size // 8, number, "<i8").tobytes()


@contextmanager
def ends(
    slots: int = 8, *, size: int = SIZE, lossless: bool = False, patience: float = 5.0
) -> Iterator[tuple[RingWriter, RingReader]]:
    with (
        RingWriter(size, slots, lossless=lossless, patience=patience) as writer,
        RingReader(os.dup(writer.fd)) as reader,
    ):
        yield writer, reader


def numbers(read: np.ndarray) -> list[int]:
    """Return the number of each record, and check that no record is mixed."""
    values = np.ascontiguousarray(read).view("<i8")
    assert (values == values[:, :1]).all()
    return [int(number) for number in values[:, 0]]


class TestOrder:
    def test_everything_written_is_read_once_in_order(self) -> None:
        with ends() as (writer, reader):
            assert len(reader.read()) == 0
            got = []
            for number in range(100):
                writer.write(record(number))
                if number % 7 == 6:
                    got += numbers(reader.read())
            got += numbers(reader.read())
        assert got == list(range(100))

    def test_limited_read_returns_the_oldest_records_and_continues(self) -> None:
        with ends(8) as (writer, reader):
            for number in range(10):
                writer.write(record(number))
            assert numbers(reader.read(2)) == [3, 4]
            assert (writer.taken, writer.lost, reader.position) == (5, 3, 5)
            for number in range(10, 13):
                writer.write(record(number))
            assert numbers(reader.read(4)) == [6, 7, 8, 9]
            assert numbers(reader.read(4)) == [10, 11, 12]
            assert (writer.taken, writer.lost) == (13, 4)

    @pytest.mark.parametrize("size", [1, 7, 8, 20, 4096])
    def test_record_of_any_size_is_read_unchanged(self, size: int) -> None:
        rng = np.random.default_rng(size)
        sent = [rng.integers(0, 256, size, np.uint8) for _ in range(5)]
        with ends(size=size) as (writer, reader):
            for payload in sent:
                writer.write(payload)
            np.testing.assert_array_equal(reader.read(), sent)

    @pytest.mark.parametrize("size", [1, 8, 20])
    def test_time_of_each_record_is_read_with_it(self, size: int) -> None:
        with ends(4, size=size) as (writer, reader):
            for number in range(6):
                writer.write(bytes(size), number * 10**18)
            writer.write(b"\xff" * size)
            assert reader.read().tolist() == [[0] * size, [0] * size, [255] * size]
            assert reader.times.tolist() == [4 * 10**18, 5 * 10**18, 0]
            assert reader.read().tolist() == reader.times.tolist() == []

    def test_vector_of_floats_is_written_unchanged(self) -> None:
        with ends() as (writer, reader):
            writer.write(np.array([1.5, -2.0, np.inf]))
            assert reader.read().view(np.float64).tolist() == [[1.5, -2.0, np.inf]]

    def test_record_of_another_size_is_rejected(self) -> None:
        with ends() as (writer, reader):
            with pytest.raises(IndexError):
                writer.write(record(1, SIZE + 8))
            assert len(reader.read()) == 0

    def test_last_returns_the_newest_record(self) -> None:
        with ends(2) as (writer, _):
            assert writer.last() == b""
            for number in range(5):
                writer.write(record(number))
                assert writer.last() == record(number)

    @pytest.mark.parametrize(("size", "slots"), [(0, 8), (8, 1)])
    def test_invalid_sizes_are_rejected(self, size: int, slots: int) -> None:
        with pytest.raises(RingError, match="must have at least 2 slots of at least 1 byte"):
            RingWriter(size, slots)


class TestOverwriting:
    def test_oldest_records_are_overwritten_and_counted(self) -> None:
        with ends(8) as (writer, reader):
            for number in range(20):
                writer.write(record(number))
            assert numbers(reader.read()) == list(range(13, 20))
            assert writer.lost == reader.lost == 13
            writer.write(record(20))
            assert numbers(reader.read()) == [20]
            assert writer.lost == 13

    def test_read_and_lost_records_add_up_to_written(self) -> None:
        rng = np.random.default_rng(5)
        with ends(8) as (writer, reader):
            written, got = 0, []
            for burst in rng.integers(0, 30, 200):
                for _ in range(burst):
                    writer.write(record(written))
                    written += 1
                got += numbers(reader.read())
                assert len(got) + reader.lost == written == writer.written
        assert got == sorted(set(got))

    def test_record_overwritten_during_the_read_counts_as_lost(self) -> None:
        with ends(4) as (writer, reader):
            for number in range(3):
                writer.write(record(number))
            reader._records = _Overtaken(reader._records, lambda: [writer.write(record(n)) for n in (3, 4)])
            assert numbers(reader.read()) == [2]
            assert reader.lost == 2
            reader._records = reader._records.array
            assert numbers(reader.read()) == [3, 4]
            assert reader.lost == 2

    def test_half_written_record_is_not_read(self) -> None:
        with ends(4) as (writer, reader):
            for number in range(6):
                writer.write(record(number))
            _write_half(writer)
            assert numbers(reader.read()) == [3, 4, 5]
            assert reader.lost == 3


class _Overtaken:
    """Records of a ring that a writer overwrites after the reader has copied them, and before it checks the counter again."""

    def __init__(self, array: np.ndarray, between: object) -> None:
        self.array, self._between = array, between

    def __len__(self) -> int:
        return len(self.array)

    def __getitem__(self, rows: slice) -> np.ndarray:
        found = self.array[rows].copy()
        between, self._between = self._between, lambda: None
        between()
        return found


def _write_half(writer: RingWriter) -> None:
    """Write the first bytes of a record without storing the counter, like a writer that is stopped during `write`."""
    writer._map[writer._offset : writer._offset + 8] = b"\xff" * 8


class TestLossless:
    def test_lossless_writer_waits_for_the_reader(self) -> None:
        with ends(4, lossless=True, patience=60.0) as (writer, reader):
            got: list[int] = []
            full = threading.Event()

            def read() -> None:
                full.wait()
                while len(got) < 500:
                    got.extend(numbers(reader.read()))

            thread = threading.Thread(target=read)
            thread.start()
            for number in range(500):
                if number == 3:
                    full.set()
                writer.write(record(number))
            thread.join()
            assert got == list(range(500))
            assert writer.lossless
            assert writer.lost == 0

    def test_writer_stops_waiting_for_a_reader_that_does_not_read(self) -> None:
        with ends(4, lossless=True, patience=0.05) as (writer, reader):
            for number in range(100):
                writer.write(record(number))
            assert not writer.lossless
            assert numbers(reader.read()) == [97, 98, 99]
            assert reader.lost == 97

    def test_writer_does_not_wait_without_a_reader(self) -> None:
        with RingWriter(SIZE, 4, lossless=True, patience=3600.0) as writer:
            for number in range(100):
                writer.write(record(number))
            assert not writer.lossless

    def test_writer_does_not_wait_for_a_closed_reader(self) -> None:
        with RingWriter(SIZE, 4, lossless=True, patience=3600.0) as writer:
            RingReader(os.dup(writer.fd)).close()
            for number in range(100):
                writer.write(record(number))
            assert not writer.lossless


class TestNotes:
    def test_note_contains_the_number_of_the_next_record(self) -> None:
        with ends() as (writer, reader):
            writer.add_note({"run": 0})
            writer.write(record(0))
            writer.write(record(1))
            writer.add_note({"run": 1})
            reader.read()
            assert reader.notes() == [{"run": 0, "from": 0}, {"run": 1, "from": 2}]
            assert reader.notes() == []
            writer.add_note({"run": 2})
            assert reader.notes() == [{"run": 2, "from": 2}]

    def test_note_beyond_the_limit_is_rejected(self) -> None:
        with ends() as (writer, reader):
            for _ in range(60):
                writer.add_note({"text": "x" * 1000})
            with pytest.raises(RingError, match=str(NOTES_BYTES)):
                writer.add_note({"text": "x" * 8000})
            writer.write(record(7))
            assert len(reader.notes()) == 60
            assert numbers(reader.read()) == [7]

    def test_metadata_is_read_unchanged(self) -> None:
        meta = {"layout": [["position", 12]], "name": "é"}
        with RingWriter(SIZE, meta=meta) as writer, RingReader(os.dup(writer.fd)) as reader:
            assert reader.meta == meta
            assert (reader.record_size, reader.slots) == (SIZE, 1024)


class TestEnds:
    def test_reader_detects_that_the_writer_finished(self) -> None:
        with ends() as (writer, reader):
            assert not reader.closed
            writer.finish()
            assert reader.closed

    def test_reader_can_read_after_the_writer_closed(self) -> None:
        writer = RingWriter(SIZE, 4)
        writer.write(record(3))
        reader = RingReader(os.dup(writer.fd))
        writer.close()
        writer.close()
        with reader:
            assert reader.closed
            assert numbers(reader.read()) == [3]

    def test_file_that_is_no_ring_is_rejected(self, tmp_path: Path) -> None:
        for size in (10, 4096):
            path = tmp_path / f"{size}"
            path.write_bytes(b"\1" * size)
            with pytest.raises(RingError, match="not a telemetry ring"):
                RingReader(os.open(path, os.O_RDWR))

    def test_shared_memory_has_no_name(self) -> None:
        with RingWriter(SIZE, 4) as writer:
            link = os.readlink(f"/proc/self/fd/{writer.fd}")
        assert link.endswith("(deleted)")


READER = """
import os, sys
from atalante_hal.telemetry.ring import RingReader
reader = RingReader(int(sys.argv[1]))
print("attached", flush=True)
got = 0
while sys.stdin.readline():
    got += len(reader.read())
    print(got, reader.lost, reader.writer_alive, flush=True)
"""


MIXTURES = """
import sys
from atalante_hal.telemetry.ring import RingReader
reader = RingReader(int(sys.argv[1]))
print("attached", flush=True)
got = mixed = 0
while not reader.closed or reader.position < reader.written:
    values = reader.read().view("<i8")
    got += len(values)
    mixed += int((values != values[:, :1]).any(axis=1).sum())
print(got, reader.lost, mixed, flush=True)
"""


@contextmanager
def reader_process(writer: RingWriter, program: str = READER) -> Iterator[subprocess.Popen[str]]:
    with subprocess.Popen(
        [sys.executable, "-c", program, str(writer.fd)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        pass_fds=(writer.fd,),
    ) as child:
        assert child.stdout is not None
        assert child.stdout.readline() == "attached\n"
        try:
            yield child
        finally:
            child.kill()


def ask(child: subprocess.Popen[str]) -> list[str]:
    assert child.stdin is not None
    assert child.stdout is not None
    child.stdin.write("\n")
    child.stdin.flush()
    return child.stdout.readline().split()


class TestAcrossProcesses:
    def test_records_arrive_in_another_process(self) -> None:
        with RingWriter(SIZE, 8) as writer, reader_process(writer) as child:
            for number in range(5):
                writer.write(record(number))
            assert ask(child) == ["5", "0", "True"]
            for number in range(20):
                writer.write(record(number))
            assert ask(child) == ["12", "13", "True"]
            assert writer.lost == 13

    def test_slow_reader_never_reads_mixed_records(self) -> None:
        size = 1 << 16
        payloads = [np.full(size // 8, number, "<i8") for number in range(16)]
        with RingWriter(size, 4) as writer, reader_process(writer, MIXTURES) as child:
            for turn in range(20_000):
                writer.write(payloads[turn % 16])
            writer.finish()
            assert child.stdout is not None
            got, lost, mixed = map(int, child.stdout.readline().split())
        assert got + lost == 20_000
        assert lost > 0
        assert mixed == 0

    def test_second_reader_is_rejected(self) -> None:
        with RingWriter(SIZE, 8) as writer, reader_process(writer), pytest.raises(RingError, match="one reader"):
            RingReader(os.dup(writer.fd))

    def test_writer_does_not_wait_for_a_killed_reader(self) -> None:
        with RingWriter(SIZE, 4, lossless=True, patience=3600.0) as writer, reader_process(writer) as child:
            assert writer.reader_alive
            child.send_signal(signal.SIGKILL)
            _wait_for_the_end(child)  # the process is a zombie: its process id still exists, but its lock is released
            assert not writer.reader_alive
            for number in range(100):
                writer.write(record(number))
            assert not writer.lossless

    def test_wait_for_a_stopped_reader_times_out(self) -> None:
        with RingWriter(SIZE, 4, lossless=True, patience=0.05) as writer, reader_process(writer) as child:
            child.send_signal(signal.SIGSTOP)
            for number in range(100):
                writer.write(record(number))
            assert writer.reader_alive
            assert not writer.lossless
            child.send_signal(signal.SIGCONT)
            assert ask(child) == ["3", "97", "True"]

    def test_records_of_a_killed_writer_can_be_read(self) -> None:
        program = (
            "import os, signal, sys\n"
            "from atalante_hal.telemetry.ring import RingWriter\n"
            "writer = RingWriter(24, 8)\n"
            "[writer.write(bytes(24)) for _ in range(3)]\n"
            "print(writer.fd, flush=True)\n"
            "sys.stdin.readline()\n"
        )
        with subprocess.Popen(
            [sys.executable, "-c", program], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        ) as child:
            assert child.stdout is not None
            number = int(child.stdout.readline())
            with RingReader(os.open(f"/proc/{child.pid}/fd/{number}", os.O_RDWR)) as reader:
                assert reader.writer_alive
                child.send_signal(signal.SIGKILL)
                _wait_for_the_end(child)
                assert not reader.writer_alive
                assert not reader.closed
                assert len(reader.read()) == 3


def _wait_for_the_end(child: subprocess.Popen[str]) -> None:
    """Wait until the process has ended, and leave it as a zombie."""
    os.waitid(os.P_PID, child.pid, os.WEXITED | os.WNOWAIT)


def test_control_process_imports_no_network_recording_or_can_library() -> None:
    program = (
        "import sys\n"
        "import atalante_hal.telemetry.process, atalante_hal.telemetry.ring, atalante_hal.record_layout\n"
        "print(*({'zenoh', 'mcap', 'google.protobuf', 'can', 'socket'} & set(sys.modules)))\n"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.split() == []

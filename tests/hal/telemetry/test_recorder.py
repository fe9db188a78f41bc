"""MCAP recorder: messages are read back with the schema in the file, and a full disk is reported once."""

from __future__ import annotations

import resource
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import numpy as np
import pytest
from mcap.exceptions import EndOfFile
from mcap.reader import NonSeekingReader, make_reader
from mcap_protobuf.decoder import DecoderFactory

from atalante_hal.telemetry.recorder import Recorder
from atalante_hal.telemetry.schema import message_class
from atalante_hal.telemetry.sink import SinkError

STREAMS = [("joint_states", "JointStates"), ("system", "SystemState")]


def joint_states(cycle: int) -> bytes:
    return bytes(message_class("JointStates")(cycle=cycle, position=[cycle / 4] * 12).SerializeToString())


@contextmanager
def file_size_limit(size: int) -> Iterator[None]:
    """Simulate a full disk: writing beyond `size` bytes fails."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def test_messages_are_read_back_by_a_generic_mcap_decoder(tmp_path: Path) -> None:
    path = tmp_path / "run" / "recording.mcap"
    with Recorder(path, STREAMS, {}) as recorder:
        for cycle in range(0, 5000, 10):
            recorder.put("joint_states", joint_states(cycle), cycle * 1_000_000, cycle)
        recorder.put("events", message_class("Event")(code="NODE_TIMEOUT").SerializeToString(), 7, 7)
        assert recorder.messages == 501
    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        decoded = list(reader.iter_decoded_messages(topics=["/joint_states"]))
        assert [message.cycle for _, _, _, message in decoded] == list(range(0, 5000, 10))
        assert all(list(message.position) == [message.cycle / 4] * 12 for _, _, _, message in decoded)
        assert all(record.log_time == message.cycle * 1_000_000 for _, _, record, message in decoded)
        assert all(record.sequence == message.cycle for _, _, record, message in decoded)
        ((schema, channel, _, event),) = reader.iter_decoded_messages(topics=["/events"])
        assert (schema.name, schema.encoding, channel.message_encoding) == ("atalante.v1.Event", "protobuf", "protobuf")
        assert event.code == "NODE_TIMEOUT"


def test_session_and_runs_are_recorded_as_metadata(tmp_path: Path) -> None:
    path = tmp_path / "recording.mcap"
    with Recorder(path, STREAMS, {"dbc_hash": 0xABC, "seed": 3}) as recorder:
        recorder.begin_run(0, {"name": "constant", "xi": 0.5})
        recorder.put("joint_states", joint_states(1), 1, 1)
        recorder.begin_run(1, {"name": "pinched", "xi": 0.5})
    with path.open("rb") as file:
        found = {record.name: record.metadata for record in make_reader(file).iter_metadata()}
    assert found == {
        "session": {"dbc_hash": "2748", "seed": "3"},
        "run/0": {"name": "constant", "xi": "0.5"},
        "run/1": {"name": "pinched", "xi": "0.5"},
    }


def test_file_of_a_killed_recorder_contains_the_flushed_messages(tmp_path: Path) -> None:
    path = tmp_path / "recording.mcap"
    rng = np.random.default_rng(1)
    recorder = Recorder(path, STREAMS, {})
    for cycle in range(20_000):
        payload = message_class("JointStates")(cycle=cycle, position=rng.random(12)).SerializeToString()
        recorder.put("joint_states", payload, cycle, cycle)
    torn = tmp_path / "torn.mcap"
    torn.write_bytes(path.read_bytes())  # the file as it would be if the recorder were killed now
    recorder.close()
    cycles = []
    with torn.open("rb") as file:
        messages = NonSeekingReader(file, decoder_factories=[DecoderFactory()]).iter_decoded_messages(
            log_time_order=False
        )
        with suppress(EndOfFile):
            cycles.extend(message.cycle for _, _, _, message in messages)
    assert cycles == list(range(len(cycles)))
    assert len(cycles) > 10_000


def test_full_disk_stops_the_recording_with_an_error_message(tmp_path: Path) -> None:
    path = tmp_path / "recording.mcap"
    rng = np.random.default_rng(1)

    def fill(recorder: Recorder) -> None:
        for cycle in range(100_000):  # 5 MB and more
            payload = message_class("JointStates")(cycle=cycle, position=rng.random(12)).SerializeToString()
            recorder.put("joint_states", payload, cycle, cycle)

    with file_size_limit(1_000_000):
        recorder = Recorder(path, STREAMS, {})
        with pytest.raises(SinkError, match=r"recording.mcap stopped: ") as refused:
            fill(recorder)
        assert refused.value.code == "RECORD_STOPPED"
        recorder.close()
    assert path.stat().st_size <= 1_000_000


def test_file_that_cannot_be_created_gives_an_error_message(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(SinkError, match="cannot be created: File exists"):
        Recorder(tmp_path / "file" / "recording.mcap", STREAMS, {})
    with pytest.raises(SinkError, match="stopped: No space left on device"):
        Recorder(Path("/dev/full"), STREAMS, {})


def test_second_close_does_not_change_the_file(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path / "recording.mcap", STREAMS, {})
    recorder.close()
    size = recorder.path.stat().st_size
    recorder.close()
    assert recorder.path.stat().st_size == size

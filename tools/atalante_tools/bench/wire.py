"""Benchmarks of the HAL cycle, and of four stages of the cycle: decode, encode, E2E check, telemetry record."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Final

import numpy as np

from atalante_hal.compiled import compiled
from atalante_hal.telemetry.ring import RingWriter
from atalante_hal.types import SupervisorState
from atalante_hal.wire.codec import Codec
from atalante_hal.wire.e2e import COUNTER_BYTE, CRC_BYTES, crc, data_id_bytes, intact, protected_spans
from atalante_tools.bench.generated_c import COMPILER, GeneratedC, available
from atalante_tools.bench.measure import Effort, Measurement, require, timed
from atalante_tools.bench.nodes import FilterOnly, RecordedHal, Recording, active_hal, walk

#: Number of cycles that are timed together as one block.
_BLOCK: Final = 10
#: Number of repetitions of a short Python function in a block.
_MANY: Final = 100
#: Number of repetitions of a C function in a block.
_MANY_IN_C: Final = 1000
#: Fields of the robot state that must be equal in the HAL and in the baseline.
_COMPARED: Final = (
    "position", "velocity", "torque", "temperature", "drive_state", "imu_quaternion", "imu_gyro", "imu_accel", "foot_force",
)  # fmt: skip


def hal_cycle(effort: Effort) -> Measurement:
    """Measure a whole HAL cycle: receive, E2E check, decode, guide filter for two joints, limiter, encode, send."""
    from atalante_tools.bench.python_can_hal import PythonCanHal, VirtualNodes

    recorded, hal_step = _hal()
    recording = Recording(walk())
    nodes, baseline = VirtualNodes(recording), PythonCanHal(walk(), recording, FilterOnly(walk()))

    # Both blocks measure processor time, not wall time.
    # A block of the baseline is long, so its wall time on a loaded machine would include the time of other processes.
    def hal_block() -> float:
        recorded.bus.prepare(_BLOCK)
        start = time.thread_time()
        for _ in range(_BLOCK):
            hal_step()
        return (time.thread_time() - start) / _BLOCK

    def baseline_block() -> float:
        frames = nodes.answer(_BLOCK)
        start = time.thread_time()
        for count in frames:
            baseline.cycle(count)
        return (time.thread_time() - start) / _BLOCK

    baseline_block(), baseline_block()
    sent_before, played, cycles = recorded.bus.sent, recorded.recording.cycles, recorded.hal.state.cycle
    measured = effort.interleave(hal_block, baseline_block)
    _check_hal(recorded)
    sent, answered = recorded.bus.sent - sent_before, recorded.recording.cycles - played
    elapsed = recorded.hal.state.cycle - cycles
    require(
        answered == elapsed and sent >= 7 * elapsed,
        f"the bus must have {elapsed} answers and {7 * elapsed} sent frames, got {answered} and {sent}",
    )
    require(baseline.rejected == 0, f"the baseline rejected {baseline.rejected} frames")
    while recorded.recording.pose != recording.pose:
        baseline.cycle(*nodes.answer(1))
    _check_same_state(recorded, baseline)
    baseline.bus.shutdown()
    nodes.close()
    return measured


def decode_cycle(effort: Effort) -> Measurement:
    """Measure the time to decode all messages that the HAL receives in a cycle, and to check the range of every signal."""
    if (missing := _no_compiler()) is not None:
        return missing
    recording = Recording(walk())
    codec = Codec(recording.cyclic)
    frames = recording.frames[: len(recording.cyclic)]
    recording.play()
    generated = GeneratedC(codec)
    by_codec, by_c = np.empty(codec.size), np.empty(codec.size)
    require(codec.decode(frames, by_codec), "all signals of the recording must be in their range")
    generated.decode(frames, by_c, 1)
    require(generated.inside, "the generated C code reports signals outside their range")
    require(np.allclose(by_codec, by_c, rtol=1e-12, atol=0.0), "the generated C code decodes different values")
    return effort.interleave(
        timed(lambda: codec.decode(frames, by_codec), _MANY), lambda: generated.decode(frames, by_c, _MANY_IN_C)
    )


def encode_cycle(effort: Effort) -> Measurement:
    """Measure the time to encode all messages that the HAL sends in a cycle, and to check the range of every signal."""
    if (missing := _no_compiler()) is not None:
        return missing
    codec = Codec([m for m in walk().network.sent_by("HAL") if m.cycle_ms == 1])
    low = np.array([s.minimum for _, s in codec.signals])
    high = np.array([s.maximum for _, s in codec.signals])
    values = np.random.default_rng(0).uniform(low, high)
    by_codec, by_c = codec.template(), codec.template()
    generated = GeneratedC(codec)
    codec.encode(values, by_codec)
    generated.encode(values, by_c, 1)
    require(generated.inside, "the generated C code reports values outside their range")
    decoded = np.empty((2, codec.size))
    for frames, out in zip((by_codec, by_c), decoded, strict=True):
        codec.decode(frames, out)
    # The generated C code truncates and the codec rounds, so the raw values may differ by one.
    resolution = np.array([s.factor for _, s in codec.signals])
    require(
        (np.abs(decoded[0] - decoded[1]) <= 1.001 * resolution).all(), "the generated C code encodes different values"
    )
    return effort.interleave(
        timed(lambda: codec.encode(values, by_codec), _MANY), lambda: generated.encode(values, by_c, _MANY_IN_C)
    )


def e2e_check(effort: Effort) -> Measurement:
    """Measure the time to check CRC and counter of all messages that the HAL receives in a cycle."""
    recording = Recording(walk())
    recording.play()
    count = len(recording.cyclic)
    octets, spans = recording.frames[:count].view(np.uint8), protected_spans(recording.cyclic)
    expected = octets[spans[:, 0] + COUNTER_BYTE].astype(np.int64)
    check_all = compiled(intact)

    def compiled_check() -> bool:
        return check_all(octets, spans, expected)

    check, remark = _frame_checker()
    payloads = [(f["data"][: m.length], m.data_id) for f, m in zip(recording.frames, recording.cyclic, strict=False)]

    def frame_by_frame() -> bool:
        valid = True
        for (data, data_id), counter in zip(payloads, expected, strict=True):
            payload = data.tobytes()
            valid &= check(payload, data_id) and payload[COUNTER_BYTE] == counter
        return valid

    require(compiled_check() and frame_by_frame(), "a valid cycle was rejected")
    recording.frames[count // 2]["data"][5] ^= 1
    require(not compiled_check() and not frame_by_frame(), "a damaged frame was accepted")
    recording.frames[count // 2]["data"][5] ^= 1
    measured = effort.interleave(timed(compiled_check, _MANY), timed(frame_by_frame, _BLOCK))
    require(compiled_check() and frame_by_frame(), "a valid cycle was rejected after the benchmark")
    return Measurement(measured.value, measured.baseline, remark)


def ring_write(effort: Effort) -> Measurement:
    """Measure the time to write one record into the shared-memory ring."""
    recorded, cycle = _hal()
    record = recorded.hal.record
    with RingWriter(record.nbytes) as ring:
        measured = effort.interleave(timed(lambda: ring.write(record), _MANY), timed(cycle, _BLOCK))
        ring.write(record)
        require(ring.last() == record.tobytes(), "the last record of the ring must equal the record written")
        require(
            ring.written >= effort.rounds() * _MANY,
            f"the ring must hold at least {effort.rounds() * _MANY} records, got {ring.written}",
        )
    _check_hal(recorded)
    return measured


def _hal() -> tuple[RecordedHal, Callable[[], object]]:
    recorded, controller = active_hal(), FilterOnly(walk())
    read, write, update = recorded.hal.read, recorded.hal.write, controller.update

    def cycle() -> None:
        write(update(read()))

    for _ in range(2 * _BLOCK):
        cycle()
    return recorded, cycle


def _check_hal(recorded: RecordedHal) -> None:
    hal = recorded.hal
    state = hal.state
    require(
        state.supervisor is SupervisorState.ACTIVE,
        f"the HAL must end in ACTIVE, got {state.supervisor.name}: {hal.reason}",
    )
    require(hal.crc_errors == 0 and state.valid.all(), "the HAL rejected frames of the recording")


def _check_same_state(recorded: RecordedHal, baseline: object) -> None:
    """Check that the HAL and the baseline decode the same robot state from the same recorded pose.

    Raises:
        BenchmarkError: If a value differs.
    """
    from atalante_tools.bench.python_can_hal import PythonCanHal

    assert isinstance(baseline, PythonCanHal)
    state = recorded.hal.state
    for name in _COMPARED:
        require(
            np.allclose(getattr(state, name), getattr(baseline, name), rtol=1e-9, atol=1e-12),
            f"the baseline has a different {name}",
        )


def _no_compiler() -> Measurement | None:
    if available():
        return None
    return Measurement(None, None, (f"not measured: install {COMPILER}",))


def _frame_checker() -> tuple[Callable[[bytes, int], bool], tuple[str, ...]]:
    """Return the baseline function of the benchmark `e2e_check`, and the remarks for the report.

    The function checks the CRC of one payload. Its arguments are payload and Data ID.
    """
    try:
        import e2e
    except ModuleNotFoundError:
        return _check_crc, ("autosar-e2e is not installed; the baseline is binascii.crc_hqx, frame by frame",)
    return e2e.p05.e2e_p05_check, ()


def _check_crc(payload: bytes, data_id: int) -> bool:
    return crc(payload[CRC_BYTES:], data_id_bytes(data_id)) == int.from_bytes(payload[:CRC_BYTES], "little")

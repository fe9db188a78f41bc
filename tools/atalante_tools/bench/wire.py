"""Benchmarks of what happens to frames: the HAL's cycle and its stages."""

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
from atalante_tools.bench.nodes import FilterOnly, RecordedRig, Recording, active_rig, walk

#: Cycles of a block: the mix of slow messages repeats after ten.
_BLOCK: Final = 10
#: Repetitions inside a block where a single one is short.
_MANY: Final = 100
_MANY_IN_C: Final = 1000
#: What both sides read of the robot.
_COMPARED: Final = (
    "position", "velocity", "torque", "temperature", "drive_state", "imu_quaternion", "imu_gyro", "imu_accel", "foot_force",
)  # fmt: skip


def hal_cycle(effort: Effort) -> Measurement:
    """Receive, E2E, decode, filter on two joints, limiter, encode, send."""
    from atalante_tools.bench.python_can_hal import PythonCanHal, VirtualNodes

    rig, ours = _hal()
    recording = Recording(walk())
    nodes, theirs = VirtualNodes(recording), PythonCanHal(walk(), recording, FilterOnly(walk()))

    def our_block() -> float:
        rig.bus.prepare(_BLOCK)
        begun = time.perf_counter()
        for _ in range(_BLOCK):
            ours()
        return (time.perf_counter() - begun) / _BLOCK

    def their_block() -> float:
        frames = nodes.answer(_BLOCK)
        begun = time.perf_counter()
        for count in frames:
            theirs.cycle(count)
        return (time.perf_counter() - begun) / _BLOCK

    their_block(), their_block()
    heard, played, cycles = rig.bus.heard, rig.recording.cycles, rig.hal.state.cycle
    measured = effort.interleave(our_block, their_block)
    _check_hal(rig)
    sent, answered = rig.bus.heard - heard, rig.recording.cycles - played
    elapsed = rig.hal.state.cycle - cycles
    require(
        answered == elapsed and sent >= 7 * elapsed, f"{sent} frames sent and {answered} answers in {elapsed} cycles"
    )
    require(theirs.refused == 0, f"the baseline refused {theirs.refused} frames")
    while rig.recording.pose != recording.pose:
        theirs.cycle(*nodes.answer(1))
    _check_same_state(rig, theirs)
    theirs.bus.shutdown()
    nodes.close()
    return measured


def decode_cycle(effort: Effort) -> Measurement:
    """Everything the HAL receives in a cycle, to physical values, with the range of each signal looked at."""
    if (missing := _no_compiler()) is not None:
        return missing
    recording = Recording(walk())
    codec = Codec(recording.cyclic)
    frames = recording.frames[: len(recording.cyclic)]
    recording.play()
    generated = GeneratedC(codec)
    ours, theirs = np.empty(codec.size), np.empty(codec.size)
    require(codec.decode(frames, ours), "the recording has signals outside their range")
    generated.decode(frames, theirs, 1)
    require(generated.inside, "the generated C finds signals outside their range")
    require(np.allclose(ours, theirs, rtol=1e-12, atol=0.0), "the generated C decodes other values")
    return effort.interleave(
        timed(lambda: codec.decode(frames, ours), _MANY), lambda: generated.decode(frames, theirs, _MANY_IN_C)
    )


def encode_cycle(effort: Effort) -> Measurement:
    """Everything the HAL sends in a cycle, from physical values, with the range of each signal looked at."""
    if (missing := _no_compiler()) is not None:
        return missing
    codec = Codec([m for m in walk().network.sent_by("HAL") if m.cycle_ms == 1])
    low = np.array([s.minimum for _, s in codec.signals])
    high = np.array([s.maximum for _, s in codec.signals])
    values = np.random.default_rng(0).uniform(low, high)
    ours, theirs = codec.template(), codec.template()
    generated = GeneratedC(codec)
    codec.encode(values, ours)
    generated.encode(values, theirs, 1)
    require(generated.inside, "the generated C finds values outside their range")
    decoded = np.empty((2, codec.size))
    for frames, out in zip((ours, theirs), decoded, strict=True):
        codec.decode(frames, out)
    # The generated C truncates where we round.
    resolution = np.array([s.factor for _, s in codec.signals])
    require((np.abs(decoded[0] - decoded[1]) <= 1.001 * resolution).all(), "the generated C encodes other values")
    return effort.interleave(
        timed(lambda: codec.encode(values, ours), _MANY), lambda: generated.encode(values, theirs, _MANY_IN_C)
    )


def e2e_check(effort: Effort) -> Measurement:
    """CRC and counter of everything the HAL receives in a cycle."""
    recording = Recording(walk())
    recording.play()
    count = len(recording.cyclic)
    octets, spans = recording.frames[:count].view(np.uint8), protected_spans(recording.cyclic)
    expected = octets[spans[:, 0] + COUNTER_BYTE].astype(np.int64)
    check_all = compiled(intact)

    def ours() -> bool:
        return check_all(octets, spans, expected)

    check, remark = _frame_checker()
    payloads = [(f["data"][: m.length], m.data_id) for f, m in zip(recording.frames, recording.cyclic, strict=False)]

    def theirs() -> bool:
        good = True
        for (data, data_id), counter in zip(payloads, expected, strict=True):
            payload = data.tobytes()
            good &= check(payload, data_id) and payload[COUNTER_BYTE] == counter
        return good

    require(ours() and theirs(), "a good cycle is refused")
    recording.frames[count // 2]["data"][5] ^= 1
    require(not ours() and not theirs(), "a damaged frame passes")
    recording.frames[count // 2]["data"][5] ^= 1
    measured = effort.interleave(timed(ours, _MANY), timed(theirs, _BLOCK))
    require(ours() and theirs(), "a good cycle is refused after the benchmark")
    return Measurement(measured.value, measured.baseline, remark)


def ring_write(effort: Effort) -> Measurement:
    """One record into the shared-memory ring."""
    rig, cycle = _hal()
    record = rig.hal.record
    with RingWriter(record.nbytes) as ring:
        measured = effort.interleave(timed(lambda: ring.write(record), _MANY), timed(cycle, _BLOCK))
        ring.write(record)
        require(ring.last() == record.tobytes(), "the ring does not hold what was written")
        require(ring.written >= effort.rounds() * _MANY, f"the ring counts {ring.written} records only")
    _check_hal(rig)
    return measured


def _hal() -> tuple[RecordedRig, Callable[[], object]]:
    rig, controller = active_rig(), FilterOnly(walk())
    read, write, update = rig.hal.read, rig.hal.write, controller.update

    def cycle() -> None:
        write(update(read()))

    for _ in range(2 * _BLOCK):
        cycle()
    return rig, cycle


def _check_hal(rig: RecordedRig) -> None:
    hal = rig.hal
    state = hal.state
    require(state.supervisor is SupervisorState.ACTIVE, f"the HAL ended in {state.supervisor.name}: {hal.reason}")
    require(hal.crc_errors == 0 and state.valid.all(), "the HAL refused frames of the recording")
    require(walk().guide.stepped == 0, "the filter saturated, which is another benchmark")


def _check_same_state(rig: RecordedRig, theirs: object) -> None:
    """Both sides in the same pose of the recording must hold the same numbers."""
    from atalante_tools.bench.python_can_hal import PythonCanHal

    assert isinstance(theirs, PythonCanHal)
    state = rig.hal.state
    for name in _COMPARED:
        require(
            np.allclose(getattr(state, name), getattr(theirs, name), rtol=1e-9, atol=1e-12),
            f"the baseline reads another {name}",
        )


def _no_compiler() -> Measurement | None:
    if available():
        return None
    return Measurement(None, None, (f"not measured: install {COMPILER}",))


def _frame_checker() -> tuple[Callable[[bytes, int], bool], tuple[str, ...]]:
    """Whether a frame's CRC is right, the way one checks it frame by frame."""
    try:
        import e2e
    except ModuleNotFoundError:
        return _check_alone, ("autosar-e2e is not installed; the baseline is crc_hqx frame by frame",)
    return e2e.p05.e2e_p05_check, ()


def _check_alone(payload: bytes, data_id: int) -> bool:
    return crc(payload[CRC_BYTES:], data_id_bytes(data_id)) == int.from_bytes(payload[:CRC_BYTES], "little")

"""Benchmarks of the CAN log validator, with other decoders as baselines.

The log has 1.3 million frames. The log repeats a short recording of the emulated robot in the state ACTIVE. The copied
frames get new alive counters and CRCs, because otherwise the validator would report repeated frames.
"""

from __future__ import annotations

import itertools
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path

import numpy as np
import numpy.typing as npt

from atalante_dbc.network import FD_LENGTHS
from atalante_hal.wire.e2e import COUNTER_BYTE, CRC_BYTES
from atalante_hal.wire.frame import FRAME_BYTES, HEADER_BYTES, Frames, new_frames
from atalante_tools.bench.measure import Block, Effort, Measurement, require
from atalante_tools.canlog.column_codec import crc_differences, crc_of_zeros
from atalante_tools.canlog.plan import Plan
from atalante_tools.canlog.validate.project import Project

#: Length of the recording [cycles] in a normal run, and in a quick run. Both lengths are multiples of all message periods.
_CYCLES, _QUICK_CYCLES = 2000, 300
#: Number of copies of the recording in the log of a normal run, and in the log of a quick run.
_REPEATED, _QUICK_REPEATED = 25, 2
#: Number of frames that the baseline of python-can and cantools decodes per block. It is small, because the baseline is slow.
_SLICE = 30_000
_MS = 1_000_000  # one millisecond [ns]
_BEGIN = 1_700_000_000 * 1000 * _MS


def validate_log(effort: Effort) -> Measurement:
    """Measure the CPU time to read, decode and check a candump log with all rules.

    The baseline reads and decodes the same log with python-can and cantools.

    Args:
        effort: number of rounds, and whether the log is short.

    Returns:
        CPU seconds per frame.
    """
    import can
    import cantools
    from cantools.database.can import Database

    with _log(effort) as (path, frames):
        database = cantools.database.load_file(_dbc())
        assert isinstance(database, Database)

        def baseline() -> float:
            begin, count = time.process_time(), 0
            with can.LogReader(path) as reader:
                for message in itertools.islice(reader, _SLICE):
                    database.decode_message(message.arbitration_id, bytes(message.data))
                    count += 1
            return (time.process_time() - begin) / count

        return effort.interleave(_validation(path, frames), baseline, share=0.02)


def validate_against_mdf(effort: Effort) -> Measurement:
    """Measure the CPU time to check a candump log, compared with the asammdf decoder.

    The baseline decodes the same frames from an MF4 file, without parsing text and without checking rules.

    Args:
        effort: number of rounds, and whether the log is short.

    Returns:
        CPU seconds per frame.
    """
    try:
        from asammdf import MDF
    except ImportError:
        return Measurement(None, None, ("asammdf and canmatrix are not installed: pip install asammdf canmatrix",))
    with _log(effort) as (path, frames):
        mdf = path.with_suffix(".mf4")
        _write_mdf(mdf, frames)

        def baseline() -> float:
            begin = time.process_time()
            source = MDF(mdf)
            found = source.extract_bus_logging({"CAN": [(_dbc(), 0)]})
            require(len(found.groups) > 40, f"asammdf must find more than 40 messages, got {len(found.groups)}")
            elapsed = time.process_time() - begin
            found.close()
            source.close()
            return elapsed / len(frames)

        return effort.interleave(_validation(path, frames), baseline, share=0.02)


def _validation(path: Path, frames: Frames) -> Block:
    """Return a block that measures the validation of a log. The block fails if the validator reports a finding."""
    from atalante_dbc.foreign import catalogue
    from atalante_tools.canlog.validate.run import validate_log

    plan = Plan(catalogue(_dbc()))

    def block() -> float:
        begin = time.process_time()
        result = validate_log(path, plan, Project())
        elapsed = time.process_time() - begin
        require(
            result.validator.frames == len(frames), f"{result.validator.frames} of {len(frames)} frames were checked"
        )
        require(not result.findings, f"the log must have no findings, got {[f.as_json() for f in result.findings][:3]}")
        return elapsed / len(frames)

    return block


def _dbc() -> Path:
    from atalante_dbc import DBC_FILE

    return DBC_FILE


@contextmanager
def _log(effort: Effort) -> Iterator[tuple[Path, Frames]]:
    """Yield the path of a temporary candump log, and the frames of this log."""
    cycles, repeated = (_QUICK_CYCLES, _QUICK_REPEATED) if effort.quick else (_CYCLES, _REPEATED)
    frames, cycle, sent = _repeat(*_record(cycles), cycles, repeated)
    with tempfile.TemporaryDirectory(prefix="atalante-bench-") as folder:
        path = Path(folder) / "run.log"
        _write(path, frames, _BEGIN + cycle * _MS, sent)
        yield path, frames


class _Tap:
    """Recorder of all frames that the HAL sends and receives: stores content, cycle and direction of each frame."""

    def __init__(self) -> None:
        self.cycle = 0
        self.recorded: list[tuple[Frames, int, bool]] = []

    def sent(self, frames: Frames) -> None:
        self.recorded.append((frames.copy(), self.cycle, True))

    def received(self, frames: Frames, count: int) -> None:
        self.recorded.append((frames[:count].copy(), self.cycle, False))


@cache
def _record(cycles: int) -> tuple[Frames, npt.NDArray[np.int64], npt.NDArray[np.bool_]]:
    """Record the CAN frames while the robot holds its pose in the state ACTIVE.

    The pose controller compensates gravity, so the joints end where they began. Therefore the recording can be repeated
    without a jump.

    Args:
        cycles: number of cycles in ACTIVE.

    Returns:
        The frames, the cycle of each frame (the first cycle is 0), and the mask of the frames that the HAL sent; shape
        (n,) each.
    """
    from atalante_hal.types import SupervisorState
    from atalante_tools.console.options import EMBEDDED, Target
    from atalante_tools.session.pose_hold import PoseHold
    from atalante_tools.session.rig import open_hal

    tap = _Tap()
    with open_hal(Target(EMBEDDED, "", True), tap=tap) as rig:
        hal, held = rig.hal, 0
        controller = PoseHold(hal.robot)
        while held < cycles:
            tap.cycle = held
            state = hal.read()
            if state.supervisor is SupervisorState.ACTIVE:
                if not held:
                    controller.reset(state)
                hal.write(controller.update(state))
                held += 1
            else:
                hal.hold()
                tap.recorded.clear()
            require(
                hal.state.cycle < cycles + 2000,
                f"the robot must be ACTIVE within 2000 cycles, got {hal.state.supervisor.name}",
            )
    recorded = tap.recorded
    frames = np.concatenate([f for f, _, _ in recorded])
    counts = [len(f) for f, _, _ in recorded]
    return frames, np.repeat([c for _, c, _ in recorded], counts), np.repeat([s for _, _, s in recorded], counts)


def _repeat(
    frames: Frames, cycle: npt.NDArray[np.int64], sent: npt.NDArray[np.bool_], cycles: int, times: int
) -> tuple[Frames, npt.NDArray[np.int64], npt.NDArray[np.bool_]]:
    """Repeat the recorded frames, and give the copies the alive counters and CRCs of one continuous run.

    The given arrays have shape (n,), the returned arrays have shape (times * n,).
    """
    whole = new_frames(len(frames) * times)
    whole.view("<u8").reshape(times, -1)[:] = frames.view("<u8")
    octets = whole.view(np.uint8).reshape(-1, FRAME_BYTES)
    from atalante_dbc import load

    for message in load().messages:
        rows = np.flatnonzero(whole["can_id"] == message.frame_id)
        if not len(rows):
            continue
        of = octets[rows]
        of[:, HEADER_BYTES + COUNTER_BYTE] = np.arange(len(rows))
        of[:, HEADER_BYTES : HEADER_BYTES + CRC_BYTES] = 0
        crcs = crc_differences(of.reshape(-1).view(whole.dtype), message.length)
        crcs ^= np.uint16(crc_of_zeros(message.length, message.data_id))
        of[:, HEADER_BYTES : HEADER_BYTES + CRC_BYTES] = crcs[:, None].view(np.uint8)
        octets[rows] = of
    offset = np.repeat(np.arange(times) * cycles, len(frames))
    return whole, np.tile(cycle, times) + offset, np.tile(sent, times)


def _write(path: Path, frames: Frames, stamps: npt.NDArray[np.int64], sent: npt.NDArray[np.bool_]) -> None:
    """Write frames in the format of candump, with one channel per bus.

    Args:
        path: file to write.
        frames: frames of the log, shape (n,).
        stamps: time stamp of each frame [ns], shape (n,).
        sent: mask of the frames that the HAL sent, shape (n,).
    """
    from atalante_dbc import load

    head = {m.frame_id: f"{m.bus} {m.frame_id:03X}##1" for m in load().messages}
    data, lines = frames["data"].tobytes().hex().upper(), []
    columns = (frames["can_id"].tolist(), frames["len"].tolist(), stamps.tolist(), sent.tolist())
    for row, (can_id, length, stamp, is_sent) in enumerate(zip(*columns, strict=True)):
        seconds, rest = divmod(stamp // 1000, 10**6)
        payload = data[128 * row : 128 * row + 2 * length]
        lines.append(f"({seconds}.{rest:06d}) {head[can_id]}{payload} {'T' if is_sent else 'R'}\n")
    path.write_text("".join(lines))


def _write_mdf(path: Path, frames: Frames) -> None:
    """Write frames to an MF4 file for bus logging, in the layout of python-can."""
    from asammdf import MDF, Signal
    from asammdf.blocks.v4_blocks import SourceInformation
    from asammdf.blocks.v4_constants import BUS_TYPE_CAN, SOURCE_BUS
    from can.io.mf4 import STD_DTYPE

    samples = np.zeros(len(frames), STD_DTYPE)
    for name, column in (
        ("BusChannel", 1),
        ("ID", frames["can_id"]),
        ("DataLength", frames["len"]),
        ("DLC", np.searchsorted(FD_LENGTHS, frames["len"])),
        ("DataBytes", frames["data"]),
        ("EDL", 1),
        ("BRS", 1),
    ):
        samples[f"CAN_DataFrame.{name}"] = column
    file = MDF(version="4.10")
    source = SourceInformation(source_type=SOURCE_BUS, bus_type=BUS_TYPE_CAN)
    stamps = np.arange(len(frames)) * 4e-5
    file.append(Signal(name="CAN_DataFrame", samples=samples, timestamps=stamps, source=source))
    file.save(path, overwrite=True)
    file.close()

"""Check of a log or a live bus: pass all frames to the validator and return the report."""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

import numpy as np

from atalante_hal.bus import Bus, BusError, open_bus
from atalante_hal.bus.resilient import ResilientBus
from atalante_hal.wire.frame import new_frames
from atalante_tools.canlog.plan import Plan
from atalante_tools.canlog.reader.chunk import NO_DIRECTION, Chunk, concatenated
from atalante_tools.canlog.reader.log import Log, open_log
from atalante_tools.canlog.validate.lock_step import LockStepClock
from atalante_tools.canlog.validate.project import Project
from atalante_tools.canlog.validate.report import Report, report
from atalante_tools.canlog.validate.validator import Validator

#: `_CHECK_PERIOD` is the period of the checks on a live bus [s]. `_RECEIVE_TIMEOUT` is the longest wait for a frame [s].
_CHECK_PERIOD, _RECEIVE_TIMEOUT = 0.5, 0.02
_LIVE_FRAMES = 4096  # size of the receive buffer [frames]


def validate_log(
    path: Path,
    plan: Plan,
    project: Project,
    *,
    node: str | None = None,
    progress: Callable[[float, int], None] = lambda share, frames: None,
) -> Report:
    """Check one log.

    Args:
        path: file of the log.
        plan: compiled DBC.
        project: thresholds, silenced rules and channel names.
        node: report missing messages of this node only; None means all nodes.
        progress: called after each chunk with the share of the log that has been read (0 to 1) and the number of
            checked frames.

    Raises:
        LogError: If the file cannot be opened as a log.
    """
    log = open_log(path)
    validator = Validator(plan, project, node=node, keeps_flags=log.keeps_flags, keeps_errors=log.keeps_errors)
    for chunk, share in _read_ahead(log):
        validator.check(chunk, log.channels.names)
        progress(share, validator.frames)
    validator.finish(log.remarks)
    return report(str(path), validator)


def _read_ahead(log: Log) -> Iterator[tuple[Chunk, float]]:
    """Yield each chunk of a log together with the share of the log that has been read, 0 to 1.

    A thread reads the next chunk while the caller checks the current chunk. Both threads spend most of their time in
    numpy operations and compiled functions, which release the interpreter lock. The first chunk is read in the thread of the
    caller, because its reader may compile a function. A stop signal interrupts a compilation only in the main thread.
    """
    chunks = log.chunks()
    first = next(chunks, None)
    if first is None:
        return
    share = log.position / max(1, log.size)
    ready: queue.Queue[tuple[Chunk, float] | BaseException | None] = queue.Queue(maxsize=1)
    abandoned = threading.Event()

    def offer(item: tuple[Chunk, float] | BaseException | None) -> None:
        while not abandoned.is_set():
            try:
                ready.put(item, timeout=0.1)
            except queue.Full:
                continue
            return

    def read() -> None:
        try:
            for chunk in chunks:
                offer((chunk, log.position / max(1, log.size)))
                if abandoned.is_set():
                    return
        except BaseException as error:  # noqa: BLE001 - raised again in the thread of the caller
            offer(error)
        else:
            offer(None)

    reader = threading.Thread(target=read, name="log reader", daemon=True)
    reader.start()
    try:
        yield first, share
        while (item := ready.get()) is not None:
            if isinstance(item, BaseException):
                raise item
            yield item
    finally:
        abandoned.set()
        reader.join()


def listen(
    buses: Mapping[str, Bus],
    plan: Plan,
    project: Project,
    *,
    name: str,
    stopped: Callable[[], bool],
    node: str | None = None,
    lockstep: bool = False,
    progress: Callable[[int], None] = lambda frames: None,
    notice: Callable[[str], None] = lambda message: None,
) -> Report:
    """Check the frames of one or more open buses until `stopped` returns True. This function sends no frames.

    After the loss of a link, the check continues when the link is back. The report contains a finding for each channel
    that lost its link.

    Args:
        buses: open bus of each channel name.
        plan: compiled DBC.
        project: thresholds, silenced rules and channel names.
        name: name of the report.
        stopped: function that is called in every iteration; True ends the loop.
        node: report missing messages of this node only; None means all nodes.
        lockstep: whether the times are checked in robot time (see `lock_step`) instead of by the time stamps of the bus.
        progress: called after each check with the number of checked frames.
        notice: called with a message when a link is lost or back.

    Raises:
        ValueError: If `lockstep` is True and no SYNC message in the DBC has a cycle number.
    """
    clock = LockStepClock(plan) if lockstep else None
    validator = Validator(plan, project, node=node)
    links = {channel: ResilientBus(bus, notice) for channel, bus in buses.items()}
    names, scratch = list(links), new_frames(_LIVE_FRAMES)
    received: list[Chunk] = []
    next_time = time.monotonic() + _CHECK_PERIOD
    failure = ""
    while not stopped() and not failure:
        for channel, bus in enumerate(links.values()):
            try:
                count = bus.receive(scratch, _RECEIVE_TIMEOUT if len(links) == 1 else 0.0)
            except BusError as error:
                failure = str(error)
                break
            if count:
                received.append(_chunk(bus, scratch[:count], channel))
        if len(links) > 1 and not received:
            time.sleep(_RECEIVE_TIMEOUT / 10)
        if time.monotonic() >= next_time:
            next_time += _CHECK_PERIOD
            _check_received(validator, received, names, clock)
            progress(validator.frames)
    _check_received(validator, received, names, clock)
    validator.finish((), dropped=sum(bus.dropped for bus in links.values()))
    for label, link in links.items():
        if link.losses:
            text = f"the link of {label} was lost {link.losses} times" + (
                f" and is not back: {link.down}" if link.down else ""
            )
            validator.findings.add_log("log-truncated", validator.end, link.losses, text)
    if failure:
        validator.findings.add_log("log-truncated", validator.end, 1, f"listening ended with a bus error: {failure}")
    return report(name, validator, live=True)


def _chunk(bus: Bus, frames: np.ndarray, channel: int) -> Chunk:
    count = len(frames)
    stamps = bus.stamps[:count].copy()
    return Chunk(frames.copy(), stamps, np.full(count, channel, np.uint8), np.full(count, NO_DIRECTION, np.int8))


def _check_received(validator: Validator, received: list[Chunk], names: list[str], clock: LockStepClock | None) -> None:
    if not received:
        return
    chunk = concatenated(received)
    received.clear()
    if clock is not None:
        chunk = clock.restamp(chunk)
    validator.check(chunk.select(np.argsort(chunk.stamps, kind="stable")), names)


def open_channels(interface: str, channels: str) -> dict[str, Bus]:
    """Open one or more channels of a CAN interface.

    Args:
        interface: interface of python-can.
        channels: one channel such as `can0`, or several named channels such as `left_leg=can0,right_leg=can1`.

    Returns:
        Open buses by the name of the channel.

    Raises:
        BusAbsent: If a channel cannot be opened. The other channels are then closed.
    """
    opened: dict[str, Bus] = {}
    try:
        for entry in channels.split(","):
            name, _, channel = entry.strip().rpartition("=")
            opened[name or channel] = open_bus(interface, channel)
    except BusError:
        for bus in opened.values():
            bus.close()
        raise
    return opened

"""From a log or a live bus to a report: the loop that feeds the judge."""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

import numpy as np

from atalante_hal.bus import Bus, BusError, open_bus
from atalante_hal.frame import WORDS, new_frames
from atalante_tools.validate.chunk import NOT_SAID, Chunk
from atalante_tools.validate.judge import Judge
from atalante_tools.validate.log import Log, open_log
from atalante_tools.validate.plan import Plan
from atalante_tools.validate.project import Project
from atalante_tools.validate.report import Report, report

#: A live bus is judged this often [s], and looked at this often while nothing comes.
_JUDGE_EVERY, _LOOK_UP = 0.5, 0.02
_LIVE_FRAMES = 4096


def judge_log(
    path: Path,
    plan: Plan,
    project: Project,
    *,
    node: str | None = None,
    progress: Callable[[float, int], None] = lambda share, frames: None,
) -> Report:
    """Judge one log.

    Args:
        progress: told the share of the log that has been read, and the frames so far.

    Raises:
        LogError: it cannot be opened as a log at all.
    """
    log = open_log(path)
    judge = Judge(plan, project, node=node, keeps_flags=log.keeps_flags)
    for chunk, share in _ahead(log):
        judge.judge(chunk, log.channels.names)
        progress(share, judge.frames)
    judge.finish(log.remarks)
    return report(str(path), judge)


def _ahead(log: Log) -> Iterator[tuple[Chunk, float]]:
    """The chunks of a log, one of them read while the one before is judged: numpy lets both go on at once."""
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
            for chunk in log.chunks():
                offer((chunk, log.position / max(1, log.size)))
                if abandoned.is_set():
                    return
        except BaseException as error:  # noqa: BLE001 - raised again in the thread that judges
            offer(error)
        else:
            offer(None)

    reader = threading.Thread(target=read, name="log reader", daemon=True)
    reader.start()
    try:
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
    over: Callable[[], bool],
    node: str | None = None,
    progress: Callable[[int], None] = lambda frames: None,
) -> Report:
    """Judge what comes over one or more open buses until `over()`. Sends nothing.

    Args:
        buses: channel name -> bus.
        progress: told the frames so far.
    """
    judge = Judge(plan, project, node=node)
    names, scratch = list(buses), new_frames(_LIVE_FRAMES)
    pieces: list[Chunk] = []
    next_time = time.monotonic() + _JUDGE_EVERY
    failure = ""
    while not over() and not failure:
        for channel, bus in enumerate(buses.values()):
            try:
                count = bus.receive(scratch, _LOOK_UP if len(buses) == 1 else 0.0)
            except BusError as error:
                failure = str(error)
                break
            if count:
                pieces.append(_piece(bus, scratch[:count], channel))
        if len(buses) > 1 and not pieces:
            time.sleep(_LOOK_UP / 10)
        if time.monotonic() >= next_time:
            next_time += _JUDGE_EVERY
            _judge(judge, pieces, names)
            progress(judge.frames)
    _judge(judge, pieces, names)
    judge.finish((), dropped=sum(bus.dropped for bus in buses.values()))
    if failure:
        judge.findings.add_log("log-truncated", judge.end, 1, f"listening ended early: {failure}")
    return report(name, judge, live=True)


def _piece(bus: Bus, frames: np.ndarray, channel: int) -> Chunk:
    count = len(frames)
    stamps = bus.stamps[:count].copy()
    return Chunk(frames.copy(), stamps, np.full(count, channel, np.uint8), np.full(count, NOT_SAID, np.int8))


def _judge(judge: Judge, pieces: list[Chunk], names: list[str]) -> None:
    if not pieces:
        return
    frames = new_frames(sum(map(len, pieces)))
    words = [piece.frames.view("<u8").reshape(-1, WORDS) for piece in pieces]
    np.concatenate(words, out=frames.view("<u8").reshape(-1, WORDS))
    chunk = Chunk(
        frames,
        np.concatenate([piece.stamps for piece in pieces]),
        np.concatenate([piece.channels for piece in pieces]),
        np.concatenate([piece.sent for piece in pieces]),
    )
    pieces.clear()
    judge.judge(chunk.select(np.argsort(chunk.stamps, kind="stable")), names)


def open_channels(interface: str, channels: str) -> dict[str, Bus]:
    """Buses of `can0`, or of `left_leg=can0,right_leg=can1` by the names given.

    Raises:
        BusAbsent: one cannot be opened; those already open are closed.
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

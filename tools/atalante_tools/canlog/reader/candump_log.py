"""Reader of candump logs in chunks of frames."""

from __future__ import annotations

import gzip
import io
import zlib
from collections.abc import Iterator

from atalante_tools.canlog.reader import candump
from atalante_tools.canlog.reader.candump import MARGIN
from atalante_tools.canlog.reader.chunk import Chunk, concatenated
from atalante_tools.canlog.reader.log_file import LogFile

#: Maximum number of bytes that one call of `candump.parse` parses. These bytes usually contain the frames of one chunk.
_TEXT_BYTES = 1 << 23


def read(log: LogFile, chunk_frames: int) -> Iterator[Chunk]:
    """Yield the frames of a candump log in chunks.

    Args:
        log: log to read; channels, position and remarks are updated.
        chunk_frames: minimum number of frames per chunk; only the last chunk may be smaller.
    """
    text = bytearray(_TEXT_BYTES + MARGIN)
    memory = memoryview(text)
    unreadable, example = 0, b""
    gathered: list[Chunk] = []
    kept, line_too_long = 0, False
    broken = ""
    with _open(log) as file:
        while True:
            got, broken = _fill(file, memory[kept:_TEXT_BYTES])
            log.position = file.tell() if not log.compressed else log.position
            if not got:
                break  # end of the file or read error; `broken` is the error text, empty at the end of the file
            end = kept + got
            stop = text.rfind(b"\n", kept, end) + 1
            if not stop:
                kept = end
                if kept == _TEXT_BYTES:
                    if not line_too_long:
                        example = example if unreadable else bytes(memory[:100])
                        unreadable += 1
                    kept, line_too_long = 0, True
                continue
            start = 0
            if line_too_long:  # skip the rest of the line that was too long
                start = text.index(b"\n") + 1
                line_too_long = False
            parsed = candump.parse(text, start, stop, log.channels)
            example = example if unreadable else parsed.first_unreadable
            unreadable += parsed.unreadable
            if len(parsed.chunk):
                gathered.append(parsed.chunk)
            kept = end - stop
            memory[:kept] = bytes(memory[stop:end])
            if sum(map(len, gathered)) >= chunk_frames:
                yield concatenated(gathered)
                gathered.clear()
    if gathered:
        yield concatenated(gathered)
    last_line = bytes(memory[:kept]).strip()
    _remark(log, unreadable, example, last_line, broken)


def _remark(log: LogFile, unreadable: int, example: bytes, last_line: bytes, broken: str) -> None:
    if unreadable:
        log.remark(
            "log-unreadable",
            f"{log.path} has {unreadable} lines that are not CAN frames and were not checked; the first is {_shown(example)}",
            unreadable,
            -1,
        )
    if broken:
        log.remark("log-truncated", f"{log.path} is truncated: {broken}", 1, -1)
    elif last_line:
        log.remark(
            "log-truncated",
            f"{log.path} ends within a line, which was not checked: {_shown(last_line)}",
            1,
            -1,
        )


def _open(log: LogFile) -> io.RawIOBase | gzip.GzipFile:
    return gzip.GzipFile(log.path) if log.compressed else io.FileIO(log.path)


def _fill(file: io.RawIOBase | gzip.GzipFile, memory: memoryview) -> tuple[int, str]:
    """Read from the file until the given memory is full or the file ends.

    Returns:
        The number of bytes read, and the text of the read error. The text is empty if bytes were read or the file has ended.
    """
    if not isinstance(file, gzip.GzipFile):
        try:
            return file.readinto(memory) or 0, ""
        except OSError as error:
            return 0, str(error)
    total = 0
    while total < len(memory):
        try:
            got = file.readinto1(memory[total:])
        except (OSError, EOFError, zlib.error) as error:
            return total, "" if total else str(error)
        if not got:
            break
        total += got
    return total, ""


def _shown(line: bytes) -> str:
    text = line.decode("ascii", "replace").strip()
    return repr(text if len(text) <= 60 else text[:57] + "...")

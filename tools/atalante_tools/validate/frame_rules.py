"""Is it a frame of this network at all: identifier, bus, sender, flags, length. First stage of judging.

Nearly all frames of a log are exactly what the DBC says and are done with one comparison of their header word; the functions
here look at the others.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from atalante_hal.frame import FD_LENGTHS, FLAG_BRS, FLAG_ESI, FLAG_FDF, ID_ERROR, ID_REMOTE, as_words
from atalante_tools.validate.buses import Homes
from atalante_tools.validate.chunk import NOT_SAID, SENT, Chunk
from atalante_tools.validate.findings import MOST, OTHERS, Findings
from atalante_tools.validate.plan import UNKNOWN, Plan, Rows

Places = npt.NDArray[np.intp]

_FD_LENGTH = np.isin(np.arange(256), FD_LENGTHS)
_CLASSIC_LENGTH = np.arange(256) <= 8
#: linux/can/error.h: class "problem of a controller", and in byte 1 its receive or transmit buffer overflow.
_CONTROLLER, _OVERFLOW = 0x4, 0x3
_NUMBER = 0x1FFF_FFFF
#: Share of the frames marked as sent that must be one node's for the log to be that node's.
_RECORDER = 0.99


@dataclass(frozen=True)
class Sorted:
    """Result of the first stage."""

    good: Places | None  # places of the frames that can be decoded; None: all
    rejected_rows: Rows  # messages whose frame came and was refused; shape (k,)
    rejected_places: Places  # shape (k,)


class FrameRules:
    """Judges headers; remembers which node recorded the log."""

    def __init__(self, plan: Plan, findings: Findings, homes: Homes, *, keeps_flags: bool) -> None:
        self._plan, self._findings, self._homes, self._keeps_flags = plan, findings, homes, keeps_flags
        layouts = plan.layouts
        #: What the DBC says about FDF and BRS: 0, 1, or `UNKNOWN` where it says nothing.
        fd = [UNKNOWN if m.fd is None else int(m.fd) for m in layouts]
        switch = [UNKNOWN if m.bit_rate_switch is None else int(m.bit_rate_switch) for m in layouts]
        # One more than there are messages: rows of frames that are none are looked up as well.
        self._fd, self._switch = np.array([*fd, UNKNOWN], np.int8), np.array([*switch, UNKNOWN], np.int8)
        self._length, self._sender = np.append(plan.lengths, 0), np.append(plan.sender_of_row, UNKNOWN)
        #: Node that recorded the log; None: not known yet, "": several or none.
        self.recorder: str | None = None
        self.direction_seen = False

    def rows(self, chunk: Chunk) -> Rows:
        """Row of each frame, `UNKNOWN` for identifiers nobody has and for error frames."""
        can_ids = chunk.frames["can_id"]
        if int(can_ids.max(initial=0)) < ID_ERROR:
            return self._plan.rows(can_ids)
        rows = self._plan.rows(can_ids & np.uint32(~ID_REMOTE & 0xFFFFFFFF))
        rows[(can_ids & np.uint32(ID_ERROR)) != 0] = UNKNOWN
        return rows

    def judge(self, chunk: Chunk, rows: Rows, channel_names: list[str]) -> Sorted:
        """Report what is wrong with headers and tell which frames can be decoded."""
        self._homes.learn(chunk, rows, channel_names)
        self._judge_sender(chunk, rows)
        headers = as_words(chunk.frames)[:, 0]
        perfect = (headers == self._plan.headers[rows]) & (rows != UNKNOWN)
        away = self._homes.strangers(chunk, rows)
        places = np.flatnonzero(~perfect | away)
        if not len(places):
            return Sorted(None, np.empty(0, np.int16), np.empty(0, np.intp))
        return self._judge_imperfect(chunk, rows, away, places, channel_names)

    def _judge_imperfect(
        self, chunk: Chunk, rows: Rows, away: npt.NDArray[np.bool_], places: Places, channel_names: list[str]
    ) -> Sorted:
        part, of, away = chunk.select(places), rows[places].copy(), away[places]
        errors = (part.frames["can_id"] & np.uint32(ID_ERROR)) != 0
        self._report_errors(part.select(errors))
        nobody = (of == UNKNOWN) & ~errors
        if bool(nobody.any()):
            of[nobody] = self._report_unknown(part.select(nobody))
        decodable = ~errors & ~nobody
        refused = decodable & (of >= len(self._plan.layouts))
        if bool(refused.any()):
            self._report("unsupported", part, of, refused, part.frames["len"])
        decodable &= ~refused
        if bool((decodable & away).any()):
            wrong = np.flatnonzero(decodable & away)
            names = np.array(channel_names, object)[part.channels]
            self._report("wrong-bus", part, of, wrong, names, np.zeros(len(part)))
        decodable &= ~away
        remote = decodable & ((part.frames["can_id"] & np.uint32(ID_REMOTE)) != 0)
        self._report("frame-remote", part, of, remote)
        decodable &= ~remote
        self._judge_flags(part, of, decodable)
        decodable &= self._judge_length(part, of, decodable)
        keep = np.ones(len(chunk), np.bool_)
        keep[places[~decodable]] = False
        bad = ~decodable & (of >= 0) & (of < len(self._plan.layouts))
        return Sorted(np.flatnonzero(keep), of[bad], places[bad])

    def _judge_flags(self, part: Chunk, of: Rows, decodable: npt.NDArray[np.bool_]) -> None:
        if not self._keeps_flags:
            return
        at = np.where(decodable, of, 0)
        flags = part.frames["flags"]
        is_fd, switches = (flags & FLAG_FDF) != 0, (flags & FLAG_BRS) != 0
        self._report("frame-fdf", part, of, decodable & (self._fd[at] == ~is_fd))
        self._report("frame-brs", part, of, decodable & is_fd & (self._switch[at] == ~switches))
        self._report("frame-esi", part, of, decodable & ((flags & FLAG_ESI) != 0))

    def _judge_length(self, part: Chunk, of: Rows, decodable: npt.NDArray[np.bool_]) -> npt.NDArray[np.bool_]:
        lengths = part.frames["len"]
        is_fd = ((part.frames["flags"] & FLAG_FDF) != 0) | (not self._keeps_flags)
        legal = np.where(is_fd, _FD_LENGTH[lengths], _CLASSIC_LENGTH[lengths])
        expected: npt.NDArray[np.int64] = self._length[np.where(decodable, of, 0)]
        self._report("length-legal", part, of, decodable & ~legal, lengths)
        wrong = decodable & legal & (lengths != expected)
        self._report("length", part, of, wrong, lengths, np.abs(lengths.astype(np.int64) - expected))
        fits: npt.NDArray[np.bool_] = legal & (lengths == expected)
        return fits

    def _judge_sender(self, chunk: Chunk, rows: Rows) -> None:
        """A log in which one node marks what it sent: nobody else may send that node's messages."""
        sent = chunk.sent == SENT
        known = (rows >= 0) & (rows < len(self._plan.layouts))
        of_sender = self._sender[np.where(known, rows, 0)]
        if self.recorder is None:
            self.direction_seen = self.direction_seen or bool((chunk.sent != NOT_SAID).any())
            senders = of_sender[sent & known]
            if not len(senders):
                return
            counts = np.bincount(senders[senders >= 0], minlength=1)
            node = int(np.argmax(counts))
            alone = len(counts) and counts[node] >= _RECORDER * len(senders)
            self.recorder = self._plan.senders[node] if alone and self._plan.senders else ""
        if not self.recorder:
            return
        node = self._plan.senders.index(self.recorder)
        wrong = known & (of_sender != UNKNOWN) & (chunk.sent != NOT_SAID) & (sent != (of_sender == node))
        if bool(wrong.any()):
            self._findings.add_rows("sender", rows[wrong], chunk.stamps[wrong])

    # -- reports -----------------------------------------------------------------------------------------------------

    def _report(
        self,
        rule: str,
        part: Chunk,
        of: Rows,
        where: npt.NDArray[np.bool_] | Places,
        shown: npt.NDArray[np.generic] | None = None,
        badness: npt.NDArray[np.generic] | None = None,
    ) -> None:
        rows = of[where]
        if len(rows):
            self._findings.add_rows(
                rule,
                rows,
                part.stamps[where],
                shown=None if shown is None else shown[where],
                badness=None if badness is None else badness[where],
            )

    def _report_unknown(self, part: Chunk) -> Rows:
        """Identifiers of no message; returns the rows of those that have one with the other identifier length."""
        can_ids = part.frames["can_id"] & np.uint32(~ID_REMOTE & 0xFFFFFFFF)
        found = self._plan.rows_in_other_format(can_ids)
        twins = found != UNKNOWN
        if bool(twins.any()):
            self._findings.add_rows("frame-ide", found[twins], part.stamps[twins])
        strange, stamps = can_ids[~twins] & np.uint32(_NUMBER), part.stamps[~twins]
        numbers, counts = np.unique(strange, return_counts=True)
        named = numbers[np.argsort(-counts, kind="stable")[:MOST]]
        for number in named.tolist():
            self._add_unknown(f"{number:#x}", stamps[strange == number])
        if len(named) < len(numbers):
            self._add_unknown(OTHERS, stamps[~np.isin(strange, named)])
        return found

    def _add_unknown(self, name: str, stamps: npt.NDArray[np.int64]) -> None:
        self._findings.add("unknown-id", name, stamps, shown=[name], badness=np.zeros(1))

    def _report_errors(self, part: Chunk) -> None:
        if not len(part):
            return
        payload = as_words(part.frames)[:, 1]
        lost = ((part.frames["can_id"] & np.uint32(_CONTROLLER)) != 0) & (
            (payload >> np.uint64(8) & np.uint64(_OVERFLOW)) != 0
        )
        for rule, where in (("dropped", lost), ("error-frame", ~lost)):
            if bool(where.any()):
                self._findings.add(rule, "", part.stamps[where])

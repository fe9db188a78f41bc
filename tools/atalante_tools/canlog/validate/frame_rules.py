"""Rules for frame headers: identifier, bus, sender, flags and length. These rules are the first stage of the validator.

The header word of nearly all frames equals the header word expected by the DBC. In all other frames, each header
property is checked separately.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from atalante_dbc.network import FD_LENGTHS
from atalante_hal.wire.frame import FLAG_BRS, FLAG_ESI, FLAG_FDF, ID_ERROR, ID_EXTENDED, ID_MASK, ID_REMOTE, as_words
from atalante_tools.canlog.plan import UNKNOWN, Plan, Rows
from atalante_tools.canlog.reader.chunk import NO_DIRECTION, SENT, Chunk
from atalante_tools.canlog.validate.buses import ChannelMap
from atalante_tools.canlog.validate.findings import MAX_UNKNOWN_IDS, OTHERS, Findings

Indices = npt.NDArray[np.intp]

_FD_LENGTH = np.isin(np.arange(256), FD_LENGTHS)
_CLASSIC_LENGTH = np.arange(256) <= 8
#: `_CONTROLLER` is a bit in the identifier of an error frame. It means "controller problem" (linux/can/error.h).
#: `_OVERFLOW` is two bits in payload byte 1 of an error frame. They mean "receive overflow" and "transmit overflow".
_CONTROLLER, _OVERFLOW = 0x4, 0x3
#: The recorder is the node that wrote the log. The log marks the frames of the recorder as sent.
#: A node counts as the recorder if its share of the frames that the log marks as sent is at least `_RECORDER` (0 to 1).
_RECORDER = 0.99


@dataclass(frozen=True)
class Sorted:
    """Result of the header check: frames that can be decoded, and rejected frames."""

    good: Indices | None  # indices of the frames of the chunk that can be decoded; None means all frames
    rejected_rows: Rows  # message index (position in the arrays of `Plan`) of each rejected frame, shape (k,)
    rejected_indices: Indices  # position of each rejected frame in the chunk, shape (k,)


class FrameRules:
    """Rules for frame headers. This class also identifies the node that recorded the log."""

    def __init__(self, plan: Plan, findings: Findings, channel_map: ChannelMap, *, keeps_flags: bool) -> None:
        self._plan, self._findings, self._channel_map, self._keeps_flags = plan, findings, channel_map, keeps_flags
        layouts = plan.layouts
        #: Expected FDF and BRS flags of each message: 0, 1, or `UNKNOWN` if the DBC does not define the flag.
        fd = [UNKNOWN if m.fd is None else int(m.fd) for m in layouts]
        switch = [UNKNOWN if m.bit_rate_switch is None else int(m.bit_rate_switch) for m in layouts]
        # For a frame that cannot be decoded, the rules read element 0 of these arrays, and ignore the result.
        # Each array has an additional last element. So element 0 exists even if the DBC has no message.
        self._fd, self._switch = np.array([*fd, UNKNOWN], np.int8), np.array([*switch, UNKNOWN], np.int8)
        self._length, self._sender = np.append(plan.lengths, 0), np.append(plan.sender_of_row, UNKNOWN)
        #: Node that recorded the log; None if not known yet; empty if the node cannot be determined (see `_RECORDER`).
        self.recorder: str | None = None
        self.direction_seen = False

    def rows(self, chunk: Chunk) -> Rows:
        """Return the message index of each frame; `UNKNOWN` for error frames and unknown identifiers. Shape (n,)."""
        can_ids = chunk.can_ids
        if int(can_ids.max(initial=0)) < ID_ERROR:
            return self._plan.rows(can_ids)
        rows = self._plan.rows(can_ids & np.uint32(~ID_REMOTE & 0xFFFFFFFF))
        rows[(can_ids & np.uint32(ID_ERROR)) != 0] = UNKNOWN
        return rows

    def check(self, chunk: Chunk, rows: Rows, channel_names: list[str]) -> Sorted:
        """Report the frames with a wrong header.

        Args:
            chunk: n frames of the log.
            rows: index of the message of each frame in the plan (result of `rows`), shape (n,).
            channel_names: known channels of the log.

        Returns:
            The frames that can be decoded, and the rejected frames.
        """
        self._channel_map.update(chunk, rows, channel_names)
        self._check_sender(chunk, rows)
        matches = (chunk.headers == self._plan.headers[rows]) & (rows != UNKNOWN)
        on_wrong_channel = self._channel_map.on_wrong_channel(chunk, rows)
        indices = np.flatnonzero(~matches | on_wrong_channel)
        if not len(indices):
            return Sorted(None, np.empty(0, np.int16), np.empty(0, np.intp))
        return self._check_imperfect(chunk, rows, on_wrong_channel, indices, channel_names)

    def _check_imperfect(
        self,
        chunk: Chunk,
        rows: Rows,
        on_wrong_channel: npt.NDArray[np.bool_],
        indices: Indices,
        channel_names: list[str],
    ) -> Sorted:
        part, part_rows, on_wrong_channel = chunk.select(indices), rows[indices].copy(), on_wrong_channel[indices]
        errors = (part.frames["can_id"] & np.uint32(ID_ERROR)) != 0
        self._report_errors(part.select(errors))
        unknown = (part_rows == UNKNOWN) & ~errors
        if bool(unknown.any()):
            part_rows[unknown] = self._report_unknown(part.select(unknown))
        decodable = ~errors & ~unknown
        unsupported = decodable & (part_rows >= len(self._plan.layouts))
        if bool(unsupported.any()):
            self._report("unsupported", part, part_rows, unsupported, part.frames["len"])
        decodable &= ~unsupported
        if bool((decodable & on_wrong_channel).any()):
            wrong = np.flatnonzero(decodable & on_wrong_channel)
            names = np.array(channel_names, object)[part.channels]
            self._report("wrong-bus", part, part_rows, wrong, names, np.zeros(len(part)))
        decodable &= ~on_wrong_channel
        remote = decodable & ((part.frames["can_id"] & np.uint32(ID_REMOTE)) != 0)
        self._report("frame-remote", part, part_rows, remote)
        decodable &= ~remote
        self._check_flags(part, part_rows, decodable)
        decodable &= self._check_length(part, part_rows, decodable)
        keep = np.ones(len(chunk), np.bool_)
        keep[indices[~decodable]] = False
        bad = ~decodable & (part_rows >= 0) & (part_rows < len(self._plan.layouts))
        return Sorted(np.flatnonzero(keep), part_rows[bad], indices[bad])

    def _check_flags(self, part: Chunk, part_rows: Rows, decodable: npt.NDArray[np.bool_]) -> None:
        if not self._keeps_flags:
            return
        at = np.where(decodable, part_rows, 0)
        flags = part.frames["flags"]
        is_fd, switches = (flags & FLAG_FDF) != 0, (flags & FLAG_BRS) != 0
        self._report("frame-fdf", part, part_rows, decodable & (self._fd[at] == ~is_fd))
        self._report("frame-brs", part, part_rows, decodable & is_fd & (self._switch[at] == ~switches))
        self._report("frame-esi", part, part_rows, decodable & ((flags & FLAG_ESI) != 0))

    def _check_length(self, part: Chunk, part_rows: Rows, decodable: npt.NDArray[np.bool_]) -> npt.NDArray[np.bool_]:
        lengths = part.frames["len"]
        is_fd = ((part.frames["flags"] & FLAG_FDF) != 0) | (not self._keeps_flags)
        legal = np.where(is_fd, _FD_LENGTH[lengths], _CLASSIC_LENGTH[lengths])
        expected: npt.NDArray[np.int64] = self._length[np.where(decodable, part_rows, 0)]
        self._report("length-legal", part, part_rows, decodable & ~legal, lengths)
        wrong = decodable & legal & (lengths != expected)
        self._report("length", part, part_rows, wrong, lengths, np.abs(lengths.astype(np.int64) - expected))
        fits: npt.NDArray[np.bool_] = legal & (lengths == expected)
        return fits

    def _check_sender(self, chunk: Chunk, rows: Rows) -> None:
        """Report frames with a wrong direction mark (sent or received).

        If at least 99 % of the frames marked as sent come from one node, this node is the recorder of the log. Then all
        messages of the recorder must be marked as sent, and all other messages must be marked as received.
        """
        sent = chunk.sent == SENT
        known = (rows >= 0) & (rows < len(self._plan.layouts))
        of_sender = self._sender[np.where(known, rows, 0)]
        if self.recorder is None:
            self.direction_seen = self.direction_seen or bool((chunk.sent != NO_DIRECTION).any())
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
        wrong = known & (of_sender != UNKNOWN) & (chunk.sent != NO_DIRECTION) & (sent != (of_sender == node))
        if bool(wrong.any()):
            self._findings.add_rows("sender", rows[wrong], chunk.stamps[wrong])

    # -- reports -----------------------------------------------------------------------------------------------------

    def _report(
        self,
        rule: str,
        part: Chunk,
        part_rows: Rows,
        where: npt.NDArray[np.bool_] | Indices,
        shown: npt.NDArray[np.generic] | None = None,
        badness: npt.NDArray[np.generic] | None = None,
    ) -> None:
        rows = part_rows[where]
        if len(rows):
            self._findings.add_rows(
                rule,
                rows,
                part.stamps[where],
                shown=None if shown is None else shown[where],
                badness=None if badness is None else badness[where],
            )

    def _report_unknown(self, part: Chunk) -> Rows:
        """Report identifiers that are not in the DBC.

        Returns:
            Index of the message with the same identifier in the other format (11 or 29 bits), otherwise `UNKNOWN`.
            Shape (k,).
        """
        can_ids = part.frames["can_id"] & np.uint32(~ID_REMOTE & 0xFFFFFFFF)
        found = self._plan.rows_in_other_format(can_ids)
        twins = found != UNKNOWN
        if bool(twins.any()):
            self._findings.add_rows("frame-ide", found[twins], part.stamps[twins])
        strange, stamps = can_ids[~twins], part.stamps[~twins]
        numbers, counts = np.unique(strange, return_counts=True)
        named = numbers[np.argsort(-counts, kind="stable")[:MAX_UNKNOWN_IDS]]
        for number in named.tolist():
            # Show a 29-bit identifier with eight digits. So 0x000007f0 has 29 bits, and 0x7f0 has 11 bits.
            name = f"{number & ID_MASK:#010x}" if number & ID_EXTENDED else f"{number:#x}"
            self._add_unknown(name, stamps[strange == number])
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

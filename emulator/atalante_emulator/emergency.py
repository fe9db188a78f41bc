"""Emergency messages of the nodes: error codes of CiA 301 and CiA 402, and the reaction of a drive to each.

A node sends one emergency when an error begins, and one with code 0 when no error is left. An error that stands (its cause
persists) cannot be acknowledged.
"""

from __future__ import annotations

from collections.abc import Sequence
from enum import Enum
from typing import Final, NamedTuple

ERROR_RESET: Final = 0x0000
CURRENT: Final = 0x2310  # continuous over-current
UNDER_VOLTAGE: Final = 0x3220  # DC link too low for normal operation
NO_VOLTAGE: Final = 0x3222  # DC link too low for the power stage
OVER_TEMPERATURE: Final = 0x4310  # drive too hot
ENCODER: Final = 0x7305  # incremental sensor 1
COMMAND_LOST: Final = 0x8110  # CAN overrun: objects lost
LIFE_GUARD: Final = 0x8130  # SYNC timed out
TWO_SENDERS: Final = 0x8150  # identifier collision: two sources of one command
COMMAND_REFUSED: Final = 0x8200  # protocol error: command damaged, or meant for another node
COMMAND_TIMEOUT: Final = 0x8250  # command timed out

#: Bits of the CiA 301 error register by first hex digit of the code: the generic bit and the bit of that class.
_REGISTER: Final = {0x2: 0x03, 0x3: 0x05, 0x4: 0x09, 0x7: 0x21, 0x8: 0x11}
_GENERIC: Final = 0x01

#: Calls of `Errors.turn` after which a notice is over, and after which the same notice may be sent again.
_OVER, _FORGOTTEN = 2, 3


class FaultReaction(Enum):
    """Local reaction of a drive to an error."""

    NONE = "continues"
    HOLD = "latches a local hold of its position"
    LOWER = "switches its power stage off, and the brake lets the joint sink"


def reaction_to(code: int) -> FaultReaction:
    """Return the reaction of a drive to an error.

    A drive holds its joint if it can. It cannot with a current, temperature or encoder error, or without voltage.

    Args:
        code: emergency error code.
    """
    if code in (COMMAND_LOST, COMMAND_REFUSED):
        return FaultReaction.NONE
    if code == NO_VOLTAGE or code >> 12 in (0x2, 0x4, 0x7):
        return FaultReaction.LOWER
    return FaultReaction.HOLD


def register_of(codes: Sequence[int]) -> int:
    """Return the CiA 301 error register (object 0x1001) of a set of errors.

    Args:
        codes: emergency error codes of all active errors.
    """
    register = 0
    for code in codes:
        register |= _REGISTER.get(code >> 12, _GENERIC)
    return register


class Emergency(NamedTuple):
    """Content of an emergency message: name of the node, CiA 301 error register, error code."""

    node: str
    register: int
    code: int


class Errors:
    """Active errors of several nodes; the emergencies to send are appended to `outbox`."""

    def __init__(self, nodes: Sequence[str], outbox: list[Emergency]) -> None:
        self._nodes, self._outbox = nodes, outbox
        self._active: list[dict[int, bool]] = [{} for _ in nodes]  # code -> whether its cause persists
        self._noticed: dict[tuple[int, int], int] = {}  # (node, code) -> calls of `turn` since the last notice

    def begin(self, node: int, code: int, *, stands: bool = False) -> None:
        """Begin an error and report it if it is new.

        Args:
            node: index of the node.
            code: emergency error code.
            stands: whether the cause persists until `end`.
        """
        active = self._active[node]
        new = code not in active
        active[code] = stands
        if new:
            self._report(node, code)

    def end(self, node: int, code: int) -> None:
        """Mark the cause of an error as gone.

        Args:
            node: index of the node.
            code: emergency error code.
        """
        if code in self._active[node]:
            self._active[node][code] = False

    def acknowledge(self, node: int) -> None:
        """Remove the errors whose cause is gone, and report code 0 if none is left.

        Args:
            node: index of the node.
        """
        active = self._active[node]
        self._active[node] = {code: True for code, stands in active.items() if stands}
        if active and not self._active[node]:
            self._report(node, ERROR_RESET)

    def stand(self, node: int) -> bool:
        """Return whether the cause of any error of a node persists.

        Args:
            node: index of the node.
        """
        return any(self._active[node].values())

    def has(self, node: int, code: int) -> bool:
        """Return whether an error is active and its cause persists.

        Args:
            node: index of the node.
            code: emergency error code.
        """
        return self._active[node].get(code, False)

    def forget(self, node: int) -> None:
        """Remove all errors of a node that restarts, without a report.

        Args:
            node: index of the node.
        """
        self._active[node] = {}

    def notice(self, node: int, code: int) -> None:
        """Report an error that causes no reaction, at most once per inhibit time.

        Args:
            node: index of the node.
            code: emergency error code.
        """
        turns = self._noticed.get((node, code))
        if turns is None:
            self._noticed[node, code] = 0
            self._report(node, code)
        elif turns < _OVER:
            self._noticed[node, code] = 0

    def turn(self) -> None:
        """Advance the age of all notices by one, and report code 0 for those that are over."""
        if not self._noticed:
            return
        self._noticed = {which: turns + 1 for which, turns in self._noticed.items() if turns + 1 < _FORGOTTEN}
        over = [node for (node, _), turns in self._noticed.items() if turns == _OVER and not self._active[node]]
        for node in dict.fromkeys(over):
            self._report(node, ERROR_RESET)

    def _report(self, node: int, code: int) -> None:
        register = register_of([*self._active[node], code] if code != ERROR_RESET else [])
        self._outbox.append(Emergency(self._nodes[node], register, code))

"""What goes wrong in a node and is told by an emergency: codes of CiA 301 and CiA 402, and what a drive does about each.

An error is told once when it begins and, when no error is left, once with code 0. One that stands (its cause is still there)
cannot be acknowledged.
"""

from __future__ import annotations

from collections.abc import Sequence
from enum import Enum
from typing import Final, NamedTuple

ERROR_RESET: Final = 0x0000
CURRENT: Final = 0x2310  # continuous over-current
UNDER_VOLTAGE: Final = 0x3220  # DC link too low to go on
NO_VOLTAGE: Final = 0x3222  # DC link too low for the power stage
OVER_TEMPERATURE: Final = 0x4310  # drive too hot
ENCODER: Final = 0x7305  # incremental sensor 1
COMMAND_LOST: Final = 0x8110  # CAN overrun: objects lost
LIFE_GUARD: Final = 0x8130  # no SYNC any more
TWO_SENDERS: Final = 0x8150  # identifier collision: two sources of one command
COMMAND_REFUSED: Final = 0x8200  # protocol error: damaged, or not this node's
COMMAND_TIMEOUT: Final = 0x8250  # no command any more

#: Bits of the CiA 301 error register by class of code: the generic one, and that of the class if it has one.
_REGISTER: Final = {0x2: 0x03, 0x3: 0x05, 0x4: 0x09, 0x7: 0x21, 0x8: 0x11}
_GENERIC: Final = 0x01

#: Turns of `Errors.turn` after which a notice is over, and after which the next may be told: the inhibit time, each.
_OVER, _FORGOTTEN = 2, 3


class Reaction(Enum):
    """What a drive does by itself about an error."""

    NONE = "goes on"
    HOLD = "holds its position, latched"
    LOWER = "switches its power stage off: the brake lets the joint down"


def reaction_to(code: int) -> Reaction:
    """Of a drive to an error it has. A drive that can hold holds; one that lacks current, cooling or its encoder cannot."""
    if code in (COMMAND_LOST, COMMAND_REFUSED):
        return Reaction.NONE
    if code == NO_VOLTAGE or code >> 12 in (0x2, 0x4, 0x7):
        return Reaction.LOWER
    return Reaction.HOLD


def register_of(codes: Sequence[int]) -> int:
    """CiA 301 error register (object 0x1001) of the errors there are."""
    register = 0
    for code in codes:
        register |= _REGISTER.get(code >> 12, _GENERIC)
    return register


class Emergency(NamedTuple):
    """What the emergency message of a node says: CiA 301 error register, error code."""

    node: str
    register: int
    code: int


class Errors:
    """The errors of several nodes; what is to be told goes to `outbox`."""

    def __init__(self, nodes: Sequence[str], outbox: list[Emergency]) -> None:
        self._nodes, self._outbox = nodes, outbox
        self._active: list[dict[int, bool]] = [{} for _ in nodes]  # code -> it stands
        self._noticed: dict[tuple[int, int], int] = {}  # node and code -> turns since

    def begin(self, node: int, code: int, *, stands: bool = False) -> None:
        """An error begins; `stands`: until `end`."""
        active = self._active[node]
        new = code not in active
        active[code] = stands
        if new:
            self._tell(node, code)

    def end(self, node: int, code: int) -> None:
        """The cause of an error is gone."""
        if code in self._active[node]:
            self._active[node][code] = False

    def acknowledge(self, node: int) -> None:
        """Forget the errors whose cause is gone."""
        active = self._active[node]
        self._active[node] = {code: True for code, stands in active.items() if stands}
        if active and not self._active[node]:
            self._tell(node, ERROR_RESET)

    def stand(self, node: int) -> bool:
        """Whether the cause of an error is still there."""
        return any(self._active[node].values())

    def has(self, node: int, code: int) -> bool:
        """Whether an error has begun and its cause is still there."""
        return self._active[node].get(code, False)

    def forget(self, node: int) -> None:
        """All of a node that begins anew."""
        self._active[node] = {}

    def notice(self, node: int, code: int) -> None:
        """Tell something that asks for nothing, but not more often than the inhibit time allows."""
        turns = self._noticed.get((node, code))
        if turns is None:
            self._noticed[node, code] = 0
            self._tell(node, code)
        elif turns < _OVER:
            self._noticed[node, code] = 0

    def turn(self) -> None:
        """An inhibit time has gone by."""
        if not self._noticed:
            return
        self._noticed = {which: turns + 1 for which, turns in self._noticed.items() if turns + 1 < _FORGOTTEN}
        over = [node for (node, _), turns in self._noticed.items() if turns == _OVER and not self._active[node]]
        for node in dict.fromkeys(over):
            self._tell(node, ERROR_RESET)

    def _tell(self, node: int, code: int) -> None:
        register = register_of([*self._active[node], code] if code != ERROR_RESET else [])
        self._outbox.append(Emergency(self._nodes[node], register, code))

"""Emergency messages of the nodes: error codes of CiA 301 and CiA 402, and the reaction of a drive to each code.

A node sends an emergency when an error begins, and an emergency with code 0 when its last error ends. An error with a local
reaction ends when the HAL acknowledges it. The HAL cannot acknowledge an error while its cause persists.
"""

from __future__ import annotations

from collections.abc import Sequence
from enum import Enum
from typing import Final, NamedTuple

ERROR_RESET: Final = 0x0000
CURRENT: Final = 0x2310  # continuous over-current
UNDER_VOLTAGE: Final = 0x3220  # supply voltage too low to follow commands; the drive can still hold its joint
NO_VOLTAGE: Final = 0x3222  # supply voltage too low for the power stage, so the motor has no torque
OVER_TEMPERATURE: Final = 0x4310  # drive too hot
ENCODER: Final = 0x7305  # incremental sensor 1
COMMAND_LOST: Final = 0x8110  # CAN overrun: objects lost
LIFE_GUARD: Final = 0x8130  # SYNC timed out
TWO_SENDERS: Final = 0x8150  # identifier collision: two nodes send the same command
COMMAND_REJECTED: Final = 0x8200  # protocol error: command with wrong CRC, length or value range
COMMAND_TIMEOUT: Final = 0x8250  # command timed out

#: Class of an error code (its first hex digit) -> value of the CiA 301 error register.
#: In each value of the error register, bit 0 ("any error") and the bit of the class are set. The bits of the classes are:
#: class 0x2 (current) bit 1, 0x3 (voltage) bit 2, 0x4 (temperature) bit 3, 0x7 (device profile) bit 5, 0x8 (communication) bit 4.
_REGISTER: Final = {0x2: 0x03, 0x3: 0x05, 0x4: 0x09, 0x7: 0x21, 0x8: 0x11}
_GENERIC: Final = 0x01

# A warning has an age. `Errors.warn` starts a new warning at age 0, and `Errors.advance` adds 1 to the ages of all warnings.
# At age 0 or 1, a warning is active. `Errors.warn` with the same error code sets the age back to 0, and reports nothing.
# At age 2 (`_ENDED`), `Errors.advance` reports the end of the warning. `Errors.warn` with the same error code does nothing.
# At age 3 (`_REPEATABLE`), the warning is deleted. `Errors.warn` with the same error code then reports a new warning.
_ENDED, _REPEATABLE = 2, 3


class FaultReaction(Enum):
    """Local reaction of a drive to an error."""

    NONE = "continues"
    HOLD = "latches a local hold of its position"
    LOWER = "switches its power stage off, and its brake lets the joint sink slowly"


def reaction_to(code: int) -> FaultReaction:
    """Return the reaction of a drive to an error.

    A drive cannot hold its joint without supply voltage, or with an error of motor current, temperature or encoder.
    After such an error, the drive lowers its joint.

    Args:
        code: emergency error code.
    """
    if code in (COMMAND_LOST, COMMAND_REJECTED):
        return FaultReaction.NONE
    if code == NO_VOLTAGE or code >> 12 in (0x2, 0x4, 0x7):
        return FaultReaction.LOWER
    return FaultReaction.HOLD


def register_of(codes: Sequence[int]) -> int:
    """Return the value of the CiA 301 error register (object 0x1001) for a set of active errors.

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
    """Active errors of several nodes.

    When an error or a warning begins, and when a warning or the last error of a node ends, an emergency message is added to
    `outbox`, the list of emergency messages to send.
    """

    def __init__(self, nodes: Sequence[str], outbox: list[Emergency]) -> None:
        self._nodes, self._outbox = nodes, outbox
        #: _active[node]: error code of each active error -> whether the cause of the error still exists.
        self._active: list[dict[int, bool]] = [{} for _ in nodes]
        self._warnings: dict[tuple[int, int], int] = {}  # (node index, error code) -> age of the warning, see `_ENDED`

    def begin(self, node: int, code: int, *, persists: bool = False) -> None:
        """Begin an error, and report it unless it is already active.

        Args:
            node: index of the node.
            code: emergency error code.
            persists: True if the cause lasts until a call of `end`.
        """
        active = self._active[node]
        new = code not in active
        active[code] = persists
        if new:
            self._report(node, code)

    def end(self, node: int, code: int) -> None:
        """Record that the cause of an error no longer exists. The error stays active until a call of `acknowledge`.

        Args:
            node: index of the node.
            code: emergency error code.
        """
        if code in self._active[node]:
            self._active[node][code] = False

    def acknowledge(self, node: int) -> None:
        """Remove each error of a node if the cause of the error no longer exists.

        If the node then has no active error or warning left, report this by an emergency with code 0.

        Args:
            node: index of the node.
        """
        active = self._active[node]
        self._active[node] = {code: True for code, persists in active.items() if persists}
        if active and not self._active_codes(node):
            self._report(node, ERROR_RESET)

    def any_persists(self, node: int) -> bool:
        """Return whether the cause of at least one error of a node still exists.

        Args:
            node: index of the node.
        """
        return any(self._active[node].values())

    def has(self, node: int, code: int) -> bool:
        """Return whether the error with the given code is active in a node and the cause of the error still exists.

        Args:
            node: index of the node.
            code: emergency error code.
        """
        return self._active[node].get(code, False)

    def clear(self, node: int) -> None:
        """Remove all errors and warnings of a node that restarts. The node does not report this removal.

        Args:
            node: index of the node.
        """
        self._active[node] = {}
        self._warnings = {warning: age for warning, age in self._warnings.items() if warning[0] != node}

    def warn(self, node: int, code: int) -> None:
        """Report a warning, which is an error without a reaction of the node.

        While a warning with the same code is in the list of warnings, the new warning is not reported, see `_ENDED`.

        Args:
            node: index of the node.
            code: emergency error code.
        """
        age = self._warnings.get((node, code))
        if age is None:
            self._warnings[node, code] = 0
            self._report(node, code)
        elif age < _ENDED:
            self._warnings[node, code] = 0

    def advance(self) -> None:
        """Add 1 to the age of all warnings. If a warning ends, send an emergency message with code 0.

        A node that still has an active error or another active warning does not report the end.
        """
        if not self._warnings:
            return
        self._warnings = {warning: age + 1 for warning, age in self._warnings.items() if age + 1 < _REPEATABLE}
        over = [node for (node, _), age in self._warnings.items() if age == _ENDED and not self._active_codes(node)]
        for node in dict.fromkeys(over):
            self._report(node, ERROR_RESET)

    def _active_codes(self, node: int) -> list[int]:
        """Return the codes of all active errors and warnings of a node."""
        warnings = [code for (other, code), age in self._warnings.items() if other == node and age < _ENDED]
        return [*self._active[node], *warnings]

    def _report(self, node: int, code: int) -> None:
        register = register_of([*self._active_codes(node), code] if code != ERROR_RESET else [])
        self._outbox.append(Emergency(self._nodes[node], register, code))

"""One cycle of an emulated drive, as a transition of an exhaustive search.

The search tries every input from the HAL and from the link. The HAL may be silent, may be frozen, or may send any controlword.
A frame may be lost, late or damaged, or may come from a second sender. Each transition calls the functions of a real `Drives`.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache
from typing import Final, NamedTuple

import numpy as np

from atalante_emulator import emergency
from atalante_emulator.drive import WATCHDOG, DriveParameters, Drives, DriveSignals
from atalante_emulator.emergency import FaultReaction, reaction_to
from atalante_hal.robot import JOINTS, load_robot
from atalante_hal.wire.cia402 import Controlword, DriveState
from atalante_tools.faults.reachability.search import Exploration, Transition, explore

#: Controlword that CiA 402 does not define.
UNKNOWN_WORD: Final = 0x55
#: Errors that the search injects, as (error code, True if the cause of the error persists).
#: Each `FaultReaction` of a drive is triggered by at least one of these errors.
_ERRORS: Final = (
    (emergency.CURRENT, False),
    (emergency.OVER_TEMPERATURE, True),
    (emergency.UNDER_VOLTAGE, True),
    (emergency.COMMAND_REJECTED, False),
)
#: Cycle number used in all steps of the search. The results of the search do not depend on it.
_CYCLE: Final = 1000
_POWERED: Final = (DriveState.OPERATION_ENABLED, DriveState.QUICK_STOP_ACTIVE)
_OFF_WORDS: Final = (Controlword.DISABLE_VOLTAGE, Controlword.SHUTDOWN, Controlword.SWITCH_ON)

WATCHDOG_PROPERTY: Final = "a drive is enabled only with a valid command and a SYNC of the last 5 cycles"
HOLD_PROPERTY: Final = "a drive with power keeps power until a valid command or an error switches it off"
LATCH_PROPERTY: Final = "a local hold ends only on QUICK STOP and then ENABLE OPERATION"


class Drive(NamedTuple):
    """State of a drive between two cycles."""

    state: DriveState
    latched: bool  # whether the drive ignores ENABLE OPERATION, because it left its enabled state without a command
    missed: int  # age of the last valid command [cycles]; ages above `WATCHDOG` are stored as `WATCHDOG`
    unsynced: int  # number of consecutive cycles without SYNC; numbers above `WATCHDOG` are stored as `WATCHDOG`
    errors: tuple[int, ...]  # codes of the errors whose cause persists


class DriveObserver(NamedTuple):
    """Values with which `_violation` checks the safety properties of the drive.

    The search counts these values itself. The counters of the drive could be wrong, so they are not used.
    """

    command_age: int = WATCHDOG  # number of cycles since the last valid command was sent
    sync_age: int = 0  # number of cycles since the last SYNC
    unacknowledged: bool = False  # whether a local hold has begun, and the HAL has not sent QUICK STOP since then


class DriveCycle(NamedTuple):
    """Inputs of a drive in one cycle."""

    word: int | None = None  # controlword of a valid new command; None: no valid command arrives
    delay: int = 0  # delay of the command [cycles]
    sync: bool = True  # whether SYNC arrives
    second_sender: bool = False  # whether the drive detects commands of two senders
    error: tuple[int, bool] | None = None  # code of an error that begins in this cycle, and whether its cause persists
    ended: int | None = None  # code of the error whose cause ends in this cycle
    rest: bool = False  # the joint comes to rest


class DriveStep(NamedTuple):
    """State of the search: state of the drive, and the values for the check of the safety properties."""

    drive: Drive
    observer: DriveObserver = DriveObserver()


class DriveSteps:
    """Transition function of one drive, the left frontal hip. All drives of a leg receive the same frames, so one is enough."""

    def __init__(self) -> None:
        count = len(JOINTS)
        self._drives = Drives(load_robot(), DriveParameters(), DriveSignals(*np.zeros((5, count))))
        self._drives.sample(np.zeros(count))
        #: `_step` with a cache of all results.
        self.step = cache(self._step)
        self._word, self._target, self._limit = np.zeros((3, count))

    def search(self) -> Exploration[DriveStep, DriveCycle]:
        """Search for a violation of `WATCHDOG_PROPERTY`, `HOLD_PROPERTY` or `LATCH_PROPERTY`."""
        start = Drive(DriveState.SWITCH_ON_DISABLED, False, WATCHDOG, 0, ())
        return explore([DriveStep(start)], self._successors)

    def _step(self, before: Drive, cycle: DriveCycle) -> Drive:
        """Return the state of the drive after one cycle.

        Args:
            before: state before the cycle.
            cycle: inputs of the cycle.
        """
        drives = self._drives
        drives.state = [DriveState.SWITCH_ON_DISABLED] * len(JOINTS)
        drives.latched = [False] * len(JOINTS)
        drives.state[0], drives.latched[0] = before.state, before.latched
        drives.missed[0] = before.missed
        drives._unsynced[0], drives._unsynced_at[0] = before.unsynced, _CYCLE - 1
        drives.errors._active = [
            dict.fromkeys(before.errors, True) if drive == 0 else {} for drive in range(len(JOINTS))
        ]
        drives.emergencies.clear()
        drives._states_changed()
        if cycle.error is not None:
            code, persists = cycle.error
            drives.fail(0, code, persists=persists)
        if cycle.ended is not None:
            drives.recover(0, cycle.ended)
        if cycle.second_sender:
            drives.hold(0, emergency.TWO_SENDERS)
        if not cycle.sync:
            drives.miss_sync(0, _CYCLE)
        self._word.fill(Controlword.DISABLE_VOLTAGE)
        self._word[0] = 0 if cycle.word is None else cycle.word
        drives.command((cycle.word is not None, True), self._word, self._target, self._limit, (cycle.delay, 0))
        if cycle.rest:
            drives._check_rest()
        return Drive(
            drives.state[0],
            drives.latched[0],
            min(drives.missed[0], WATCHDOG),
            0 if cycle.sync else min(drives._unsynced[0], WATCHDOG),
            tuple(sorted(code for code, persists in drives.errors._active[0].items() if persists)),
        )

    def _successors(self, state: DriveStep) -> Iterator[Transition[DriveStep, DriveCycle]]:
        before, observer = state
        for cycle in inputs_of(before):
            after = self.step(before, cycle)
            command_age = cycle.delay if cycle.word is not None else min(observer.command_age + 1, WATCHDOG)
            sync_age = 0 if cycle.sync else min(observer.sync_age + 1, WATCHDOG)
            holds = after.state is DriveState.QUICK_STOP_ACTIVE
            stopped_alone = holds and (
                before.state is DriveState.OPERATION_ENABLED and cycle.word != Controlword.QUICK_STOP
            )
            unacknowledged = holds and (observer.unacknowledged or stopped_alone)
            unacknowledged = unacknowledged and cycle.word != Controlword.QUICK_STOP
            yield Transition(
                cycle,
                DriveStep(after, DriveObserver(command_age, sync_age, unacknowledged)),
                _violation(before, after, cycle, DriveObserver(command_age, sync_age, observer.unacknowledged)),
            )


def _violation(before: Drive, after: Drive, cycle: DriveCycle, now: DriveObserver) -> str:
    enabled = after.state is DriveState.OPERATION_ENABLED
    # A command may enable a drive while SYNC is missing. The drive must start its local hold in the next cycle.
    if enabled and (
        now.command_age >= WATCHDOG or (now.sync_age >= WATCHDOG and before.state is DriveState.OPERATION_ENABLED)
    ):
        return WATCHDOG_PROPERTY
    if enabled and before.state is DriveState.QUICK_STOP_ACTIVE and now.unacknowledged:
        return LATCH_PROPERTY
    switched_off = cycle.word in _OFF_WORDS
    failed = cycle.error is not None and reaction_to(cycle.error[0]) is FaultReaction.LOWER
    if before.state in _POWERED and after.state not in _POWERED and not (switched_off or failed):
        return HOLD_PROPERTY
    return ""


def inputs_of(before: Drive) -> Iterator[DriveCycle]:
    """Yield all combinations of inputs of one cycle. In each cycle, at most one error begins or ends.

    Args:
        before: state of the drive.
    """
    for word in (None, *Controlword, UNKNOWN_WORD):
        for delay in range(WATCHDOG) if word is not None else (0,):
            for sync in (True, False):
                plain = DriveCycle(word, delay, sync)
                yield plain
                if delay == 0:
                    yield plain._replace(second_sender=True)
                    yield plain._replace(rest=True)
                    yield from (plain._replace(error=error) for error in _ERRORS)
                    yield from (plain._replace(ended=code) for code in before.errors)

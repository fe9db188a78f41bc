"""Phases of a walk from standing to standing, as a pure function: `phase, facts of the cycle -> next phase`.

The order of the phases is POSTURE, STAND, SHIFT, START, STEP (repeated), STOP, BACK, REST. A step ends when the swing foot lands,
or at a timeout after the nominal end of the step. STAND ends when both feet have carried load for some
time. If the walk must end before the weight shift, REST follows directly on STAND. POSTURE, SHIFT and
BACK end by time. REST does not end.
"""

from __future__ import annotations

from enum import IntEnum
from typing import NamedTuple


class Phase(IntEnum):
    """Phase of a walk."""

    POSTURE = 0  # motion from the measured pose to the standing pose; the robot may be suspended
    STAND = 1  # standing pose, until both feet carry load
    SHIFT = 2  # weight shift onto the right foot
    START = 3  # step from rest into the gait
    STEP = 4  # step of the periodic gait
    STOP = 5  # step from the gait to rest
    BACK = 6  # weight shift to the middle between the feet
    REST = 7  # standing pose after the walk


#: Phases in which one foot swings.
STEPPING = frozenset({Phase.START, Phase.STEP, Phase.STOP})
#: Phases in which a stop request does not end the walk at once. The walk continues until the robot stands on both feet.
WALKING = STEPPING | {Phase.SHIFT, Phase.BACK}


class Facts(NamedTuple):
    """Times and events that decide whether a phase ends in the current cycle.

    The progress of a step is measured in rows of its table, because step timing can change the number of rows per cycle.
    """

    #: Progress of the phase. In a step: row of the phase table. In all other phases: cycles since the start of the phase.
    elapsed: int
    nominal: int  # nominal duration of the phase in cycles
    rest: int  # cycles to wait after a weight shift
    timeout: int  # cycles from the nominal end of a step to its end without a detected landing
    landed: bool  # the swing foot has landed
    loaded: bool  # both feet have carried load for long enough
    stopping: bool  # the walk must end


def next_phase(phase: Phase, facts: Facts) -> Phase | None:
    """Return the phase that starts in this cycle, or None if the current phase continues.

    Each STEP is a phase of its own. At the end of a STEP, the function can therefore return STEP again.

    Args:
        phase: current phase.
        facts: times and events of this cycle.
    """
    if phase in STEPPING:
        if not facts.landed and facts.elapsed < facts.nominal + facts.timeout:
            return None
        if phase is Phase.STOP:
            return Phase.BACK
        return Phase.STOP if facts.stopping else Phase.STEP
    if phase is Phase.POSTURE:
        return Phase.STAND if facts.elapsed >= facts.nominal else None
    if phase is Phase.STAND:
        return Phase.REST if facts.stopping else Phase.SHIFT if facts.loaded else None
    if phase is Phase.SHIFT and facts.elapsed >= facts.nominal + facts.rest:
        return Phase.BACK if facts.stopping else Phase.START
    if phase is Phase.BACK and facts.elapsed >= facts.nominal + facts.rest:
        return Phase.REST
    return None

"""Further judgements of single scenarios: one sentence when they fail."""

from __future__ import annotations

import math
from typing import Final

from atalante_hal.robot import JOINTS, LEG_JOINTS
from atalante_hal.safety.diagnostics import Dtc
from atalante_hal.types import SupervisorState
from atalante_hal.wire.cia402 import Controlword, DriveState
from atalante_tools.faults.observation import Observation

_KNEE: Final = JOINTS.index("left_SK")
#: Cycles without a command after which a drive has to hold; written a second time on purpose.
_WATCHDOG: Final = 5
_LEFT_LEG: Final = slice(0, len(LEG_JOINTS))


def guide_kept(seen: Observation) -> str | None:
    """While the robot walks, no assisted joint leaves its guide by more than half a degree."""
    walking = [state is SupervisorState.ACTIVE for state in seen.states[seen.first - 1 :]]
    exits = math.degrees(max(seen.guide_exit[seen.first - 1 :][walking], default=0.0))
    return f"the guide was left by {exits:.2f} deg" if exits > 0.5 else None


def guide_regained(seen: Observation) -> str | None:
    """Both assisted joints are in their guide again in the end, and were out of it before."""
    exits = seen.guide_exit[seen.first - 1 :]
    if exits.max() <= 0.0:
        return "the guide was never left"
    return f"a joint is still {math.degrees(exits[-1]):.1f} deg outside its guide" if exits[-1] > 0.0 else None


def data_stays_fresh(seen: Observation) -> str | None:
    """No data of the HAL is older than this cycle while it lasts."""
    ages = seen.age[seen.first - 1 : seen.over]
    return f"data was {ages.max()} cycles old" if ages.max() else None


def not_enabled_in_motion(seen: Observation) -> str | None:
    """The left knee's drive, once off, stays off until the operator starts again."""
    enabled = seen.drive_state[seen.first : seen.quiet, _KNEE] == DriveState.OPERATION_ENABLED
    return f"the drive was enabled in cycle {seen.first + 1 + int(enabled.argmax())}" if enabled.any() else None


def drives_notice_two_senders(seen: Observation) -> str | None:
    """Not the HAL alone: a drive of the left leg tells that it hears two sources of commands."""
    told = [event.node for event in seen.events if event.code == Dtc.HAL_DUPLICATE and event.node.startswith("LEFT_")]
    return None if told else "no drive of the left leg told that it hears two sources of commands"


def full_queue_is_confirmed(seen: Observation) -> str | None:
    """The full queue itself is a reason to hold, and not only the silence that follows from it."""
    loud = any(event.code == Dtc.BUS_TX_FULL and event.severity == Dtc.BUS_TX_FULL.severity for event in seen.events)
    return None if loud else "the full queue was noticed and never confirmed"


def left_leg_holds_by_itself(seen: Observation) -> str | None:
    """Every drive of the left leg is in its own hold in the fifth cycle, and stays there until the operator starts again."""
    fifth = seen.first + _WATCHDOG - 1
    held = (seen.drive_state[fifth - 1 : seen.quiet, _LEFT_LEG] == DriveState.QUICK_STOP_ACTIVE).all(axis=1)
    return None if held.all() else f"a drive of the left leg did not hold in cycle {fifth + int(held.argmin())}"


def start_is_refused(seen: Observation) -> str | None:
    """START is refused with a reason, and no command enables a drive from then on."""
    refused = next((event for event in seen.events if event.code == "START_REFUSED"), None)
    if refused is None:
        return "no START was refused"
    for cycle in range(refused.cycle, seen.last + 1):
        if Controlword.ENABLE_OPERATION in seen.commands.words(cycle):
            return f"a drive was enabled in cycle {cycle}, after {refused.text}"
    return None


def limit_follows_the_heat(seen: Observation) -> str | None:
    """The torque limit sent to the left knee is never above what the temperature it reported allows."""
    cycles, limit = seen.commands.limit_of(_KNEE)
    for cycle, sent in zip(cycles.tolist(), limit.tolist(), strict=True):
        allowed = seen.robot.torque_limit(seen.temperature[cycle - 1])[_KNEE]
        if cycle >= seen.first and sent > allowed + 0.02:
            return f"a limit of {sent:.1f} Nm left in cycle {cycle}, and {allowed:.1f} Nm were allowed"
    return None

"""Additional checks of single scenarios; each returns a sentence if it fails, else None."""

from __future__ import annotations

import math
from typing import Final

from atalante_hal.robot import JOINTS, LEG_JOINTS
from atalante_hal.safety.diagnostics import Dtc
from atalante_hal.types import SupervisorState
from atalante_hal.wire.cia402 import Controlword, DriveState
from atalante_tools.faults.observation import Observation

_KNEE: Final = JOINTS.index("left_SK")
#: Cycles without a command after which a drive must hold; not imported from the drive, to be an independent check.
_WATCHDOG: Final = 5
_LEFT_LEG: Final = slice(0, len(LEG_JOINTS))


def guide_kept(seen: Observation) -> str | None:
    """Check that assisted joints of the walking robot leave their guide by at most half a degree.

    Args:
        seen: observation of the run.
    """
    walking = [state is SupervisorState.ACTIVE for state in seen.states[seen.first - 1 :]]
    exits = math.degrees(max(seen.guide_exit[seen.first - 1 :][walking], default=0.0))
    return f"a joint was {exits:.2f} deg outside its guide" if exits > 0.5 else None


def guide_regained(seen: Observation) -> str | None:
    """Check that an assisted joint left its guide and that both are inside at the end.

    Args:
        seen: observation of the run.
    """
    exits = seen.guide_exit[seen.first - 1 :]
    if exits.max() <= 0.0:
        return "no joint left its guide"
    return f"a joint is still {math.degrees(exits[-1]):.1f} deg outside its guide" if exits[-1] > 0.0 else None


def data_stays_fresh(seen: Observation) -> str | None:
    """Check that all data of the HAL is of the same cycle during the fault.

    Args:
        seen: observation of the run.
    """
    ages = seen.age[seen.first - 1 : seen.over]
    return f"data was {ages.max()} cycles old" if ages.max() else None


def not_enabled_in_motion(seen: Observation) -> str | None:
    """Check that the drive of the left knee stays off until the operator presses START.

    Args:
        seen: observation of the run.
    """
    enabled = seen.drive_state[seen.first : seen.quiet, _KNEE] == DriveState.OPERATION_ENABLED
    return f"the drive was enabled in cycle {seen.first + 1 + int(enabled.argmax())}" if enabled.any() else None


def drives_notice_two_senders(seen: Observation) -> str | None:
    """Check that at least one drive of the left leg reports that two nodes send it commands.

    A report by the HAL is not sufficient.

    Args:
        seen: observation of the run.
    """
    nodes = [event.node for event in seen.events if event.code == Dtc.HAL_DUPLICATE and event.node.startswith("LEFT_")]
    return None if nodes else "no drive of the left leg reported two senders of commands"


def full_queue_is_confirmed(seen: Observation) -> str | None:
    """Check that the full queue itself is a confirmed diagnostic, and not only the timeouts that follow.

    Args:
        seen: observation of the run.
    """
    confirmed = any(e.code == Dtc.BUS_TX_FULL and e.severity == Dtc.BUS_TX_FULL.severity for e in seen.events)
    return None if confirmed else "the full queue was never confirmed"


def left_leg_holds_by_itself(seen: Observation) -> str | None:
    """Check that all drives of the left leg are in local hold from the fifth cycle until the operator's START.

    Args:
        seen: observation of the run.
    """
    fifth = seen.first + _WATCHDOG - 1
    held = (seen.drive_state[fifth - 1 : seen.quiet, _LEFT_LEG] == DriveState.QUICK_STOP_ACTIVE).all(axis=1)
    return None if held.all() else f"a drive of the left leg did not hold in cycle {fifth + int(held.argmin())}"


def start_is_refused(seen: Observation) -> str | None:
    """Check that a START is rejected with a reason, and that no command enables a drive afterwards.

    Args:
        seen: observation of the run.
    """
    refused = next((event for event in seen.events if event.code == "START_REFUSED"), None)
    if refused is None:
        return "no START was rejected"
    for cycle in range(refused.cycle, seen.last + 1):
        if Controlword.ENABLE_OPERATION in seen.commands.words(cycle):
            return f"a drive was enabled in cycle {cycle}, after {refused.text}"
    return None


def limit_follows_the_heat(seen: Observation) -> str | None:
    """Check that the torque limit sent to the left knee is never above the limit of its reported temperature.

    Args:
        seen: observation of the run.
    """
    cycles, limit = seen.commands.limit_of(_KNEE)
    for cycle, sent in zip(cycles.tolist(), limit.tolist(), strict=True):
        allowed = seen.robot.torque_limit(seen.temperature[cycle - 1])[_KNEE]
        if cycle >= seen.first and sent > allowed + 0.02:
            return f"the torque limit in cycle {cycle} must be at most {allowed:.1f} Nm, got {sent:.1f} Nm"
    return None

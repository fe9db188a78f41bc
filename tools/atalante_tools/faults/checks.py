"""Additional checks for some fault scenarios. A check returns None if it passes, and a sentence if it fails."""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from atalante_hal.robot import JOINTS, LEG_JOINTS
from atalante_hal.safety.diagnostics import Dtc
from atalante_hal.types import SupervisorState
from atalante_hal.wire.cia402 import Controlword, DriveState
from atalante_tools.faults.observation import Observation

_KNEE: Final = JOINTS.index("left_SK")
#: Largest permitted motion of a joint while the drives are being enabled [rad].
_SAG: Final = math.radians(1.0)
#: Largest accepted number of cycles from START to the event START_FAILED, for a drive that cannot be enabled.
_FAILED: Final = 20
#: Number of cycles without a command after which a drive must hold its position by itself (local hold).
#: `_WATCHDOG` is not imported from the emulated drive, so that an error in the emulator cannot change the check.
_WATCHDOG: Final = 5
#: Largest accepted true speed of a joint, as a multiple of its velocity limit.
_TOO_FAST: Final = 1.2
_LEFT_LEG: Final = slice(0, len(LEG_JOINTS))


def guide_kept(run: Observation) -> str | None:
    """Check that no assisted joint is more than 0.5 deg outside its guide while the robot walks.

    Args:
        run: observation of the run.
    """
    walking = [state is SupervisorState.ACTIVE for state in run.states[run.first - 1 :]]
    exits = math.degrees(max(run.guide_exit[run.first - 1 :][walking], default=0.0))
    return f"a joint was {exits:.2f} deg outside its guide" if exits > 0.5 else None


def guide_regained(run: Observation) -> str | None:
    """Check that an assisted joint left its guide, and that all assisted joints are inside at the end of the run.

    Args:
        run: observation of the run.
    """
    exits = run.guide_exit[run.first - 1 :]
    if exits.max() <= 0.0:
        return "no joint left its guide"
    return f"a joint is still {math.degrees(exits[-1]):.1f} deg outside its guide" if exits[-1] > 0.0 else None


def data_stays_fresh(run: Observation) -> str | None:
    """Check that the data age of all messages is 0 during the fault.

    Args:
        run: observation of the run.
    """
    ages = run.age[run.first - 1 : run.over]
    return f"data must have age 0, got {ages.max()} cycles" if ages.max() else None


def not_enabled_in_motion(run: Observation) -> str | None:
    """Check that the left knee drive is never enabled between the start of the fault and the operator's next START.

    Args:
        run: observation of the run.
    """
    enabled = run.drive_state[run.first : run.last_before_start, _KNEE] == DriveState.OPERATION_ENABLED
    return f"the drive was enabled in cycle {run.first + 1 + int(enabled.argmax())}" if enabled.any() else None


def drives_report_two_senders(run: Observation) -> str | None:
    """Check that at least one drive of the left leg reports that two senders command this drive.

    A report by the HAL alone is not sufficient.

    Args:
        run: observation of the run.
    """
    nodes = [event.node for event in run.events if event.code == Dtc.HAL_DUPLICATE and event.node.startswith("LEFT_")]
    return None if nodes else "no drive of the left leg reported two senders of commands"


def full_queue_is_confirmed(run: Observation) -> str | None:
    """Check that the HAL confirms the diagnostic code BUS_TX_FULL.

    Diagnostics of the timeouts that follow from a full transmit queue are not sufficient.

    Args:
        run: observation of the run.
    """
    confirmed = any(e.code == Dtc.BUS_TX_FULL and e.severity == Dtc.BUS_TX_FULL.severity for e in run.events)
    return None if confirmed else f"{Dtc.BUS_TX_FULL} was never confirmed"


def left_leg_in_local_hold(run: Observation) -> str | None:
    """Check that all drives of the left leg hold their position from the fifth faulty cycle until the operator's START.

    Args:
        run: observation of the run.
    """
    fifth = run.first + _WATCHDOG - 1
    held = (run.drive_state[fifth - 1 : run.last_before_start, _LEFT_LEG] == DriveState.QUICK_STOP_ACTIVE).all(axis=1)
    return None if held.all() else f"a drive of the left leg did not hold in cycle {fifth + int(held.argmin())}"


def start_is_rejected(run: Observation) -> str | None:
    """Check that the HAL rejects START with a reason, and that no later command enables a drive.

    Args:
        run: observation of the run.
    """
    refused = next((event for event in run.events if event.code == "START_REFUSED"), None)
    if refused is None:
        return "no START was rejected"
    for cycle in range(refused.cycle, run.last + 1):
        if Controlword.ENABLE_OPERATION in run.commands.words(cycle):
            return f"a drive was enabled in cycle {cycle}, after {refused.text}"
    return None


def nothing_sags(run: Observation) -> str | None:
    """Check that no joint moves by more than 1 deg while the robot restarts after the fault.

    The time from START of the operator until ACTIVE is checked. If the robot does not become ACTIVE, the check ends 40
    cycles after START.

    Args:
        run: observation of the run.
    """
    assert run.pressed is not None
    begin = run.pressed - 1
    moving = [state is SupervisorState.ACTIVE for state in run.states[begin : begin + 40]]
    end = begin + (moving.index(True) if any(moving) else len(moving))
    sag = np.abs(run.position[begin:end] - run.position[begin]).max(axis=0)
    joint = int(sag.argmax())
    return f"{JOINTS[joint]} moved by {math.degrees(sag[joint]):.2f} deg after START" if sag[joint] > _SAG else None


def encoders_keep_their_reference(run: Observation) -> str | None:
    """Check that the HAL reports no encoder jump.

    After a reported jump, the HAL does not use the encoder until the encoder jumps back or its drive restarts.

    Args:
        run: observation of the run.
    """
    nodes = sorted({event.node for event in run.events if event.code == Dtc.ENC_JUMP})
    return f"no encoder jumped, but {Dtc.ENC_JUMP} names {', '.join(nodes)}" if nodes else None


def no_joint_is_too_fast(run: Observation) -> str | None:
    """Check that no joint moves faster than 1.2 times its velocity limit.

    Args:
        run: observation of the run.
    """
    highest = (np.abs(run.velocity) / run.robot.velocity_max).max(axis=0)
    joint = int(highest.argmax())
    share = float(highest[joint])
    return f"{JOINTS[joint]} reached {share:.2f} times its velocity limit" if share > _TOO_FAST else None


def start_fails_and_names_the_hip(run: Observation) -> str | None:
    """Check that START fails within `_FAILED` cycles, with an event START_FAILED that names the left sagittal hip.

    In HOLD, all other drives must then hold. In READY, all other drives must be switched off again.

    Args:
        run: observation of the run.
    """
    assert run.pressed is not None
    failed = [event for event in run.events if event.code == "START_FAILED" and event.cycle >= run.pressed]
    if not failed or failed[0].cycle - run.pressed > _FAILED:
        return f"START_FAILED must come within {_FAILED} cycles, got {[event.cycle - run.pressed for event in failed]}"
    if not failed[0].text.endswith(": left_SH is in SWITCHED_ON"):
        return f"START_FAILED must name left_SH, got {failed[0].text!r}"
    others = np.delete(run.drive_state[failed[0].cycle + 2], JOINTS.index("left_SH"))
    holds = run.state(failed[0].cycle) is SupervisorState.HOLD
    expected = DriveState.QUICK_STOP_ACTIVE if holds else DriveState.SWITCH_ON_DISABLED
    return None if (others == expected).all() else f"a drive was not in {expected.name} after START_FAILED"


def never_active(run: Observation) -> str | None:
    """Check that the robot was never in ACTIVE.

    Args:
        run: observation of the run.
    """
    return "the robot was in ACTIVE" if SupervisorState.ACTIVE in run.states else None


def limit_follows_temperature(run: Observation) -> str | None:
    """Check that the torque limits sent to the left knee drive follow the temperature that this drive reports.

    A sent limit must be at most the robot's torque limit at the reported temperature.

    Args:
        run: observation of the run.
    """
    cycles, limit = run.commands.limit_of(_KNEE)
    for cycle, sent in zip(cycles.tolist(), limit.tolist(), strict=True):
        allowed = run.robot.torque_limit(run.temperature[cycle - 1])[_KNEE]
        if cycle >= run.first and sent > allowed + 0.02:
            return f"the torque limit in cycle {cycle} must be at most {allowed:.1f} Nm, got {sent:.1f} Nm"
    return None

"""Refusal of a start: the function `refusal` decides in each cycle whether the drives may be enabled.

    pendant, diagnostics, nodes, drive state, reported torque -> refusal -> safety monitor, event START_REFUSED or START_FAILED

The button START begins a start. A start takes several cycles and has two parts, so that no joint sags. First every drive is
enabled and holds its position: a drive that is enabled earlier than the others gets QUICK STOP until all drives produce torque
(see `words_towards_operation`). Then all drives get ENABLE OPERATION in the same cycle. The torque command of each drive is then
the torque that the drive reports. So a START is refused if a reported torque is impossible. The start ends if no drive changes
its state for `STALLED_CYCLES`.
"""

from __future__ import annotations

from collections.abc import Collection
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from atalante_hal.robot import JOINTS, Robot
from atalante_hal.types import SupervisorState, Vector
from atalante_hal.wire.cia402 import Controlword, DriveState, controlword_towards_operation

#: Time limit of a start [cycles]. In READY and HOLD, the limit covers the enabling of all drives and the direction test.
ENABLE_CYCLES = 200
#: A start in READY or HOLD ends if no drive has changed its state for `STALLED_CYCLES` cycles.
#: Even if four consecutive commands and then four consecutive answers of a drive are lost, the start does not end.
STALLED_CYCLES = 10
#: Largest speed of a joint at which START is accepted in HOLD [rad/s]. The test of the joint directions needs joints at rest.
#: A joint whose drive is off may be faster, because it sinks. After START, its drive first stops the joint and holds it.
AT_REST = 0.3
#: Prefix of the event text for a refused START.
REFUSED = "START refused: "
#: Reason of a HOLD that the program requests because it is ending.
PROGRAM_ENDS = "the program is ending"
#: Suffix of the reason of FINISH_STEP if the operator requests the end of a walk on the ground. The next HOLD keeps the reason.
WALK_ENDS = ", so the walk ends on both feet"
_S = SupervisorState
#: States in which START acknowledges faults, but enables no drive.
#: In LOWER and FAULT, an active diagnostic does not end the start, because an acknowledged fault may stay active for some cycles.
_ACKNOWLEDGING = (_S.LOWER, _S.FAULT)
#: States in which START enables the drives.
_ENABLING = (_S.READY, _S.HOLD)
#: States in which a drive produces torque. In all other states a drive can only brake its joint.
POWERED = (DriveState.OPERATION_ENABLED, DriveState.QUICK_STOP_ACTIVE)
_NAMES = {float(state): state.name for state in DriveState}


def powered(drive_state: Vector) -> npt.NDArray[np.bool_]:
    """Return which drives produce torque.

    Args:
        drive_state: values of `DriveState`, shape (12,).

    Returns:
        True for each drive in a state of `POWERED`, shape (12,).
    """
    return np.isin(drive_state, POWERED)


class StartRequest(NamedTuple):
    """Conditions of a start in one cycle, as the safety monitor has evaluated them."""

    supervisor: SupervisorState  # state of the state machine
    pressed: bool  # True in the cycle in which START is pressed, False in the later cycles of this start
    cycles_left: int  # number of cycles left until all drives must be enabled
    stalled: int  # number of cycles since any drive last changed its state
    ending: bool  # True if the program is ending
    stop_requested: bool  # True if the operator requests STOP or HOLD
    dead_man: bool  # True if the dead-man switch is pressed and the pendant has not timed out
    diagnostic: str  # text of the worst confirmed diagnostic that demands a reaction; empty if there is none
    nodes_ready: bool  # True if every required node is trusted and has sent its status
    missing: Collection[str]  # DBC names of the nodes that make `nodes_ready` False
    drive_state: Vector  # (12,) values of `DriveState`
    torque: Vector  # (12,) Nm, torque reported by each drive
    velocity: Vector  # (12,) rad/s, velocity of each joint


class Refusal(NamedTuple):
    """Event that is logged when a start is refused or fails."""

    code: str  # START_FAILED if a drive was not enabled in time or a direction test failed, otherwise START_REFUSED
    severity: str  # severity of the event, one of `events.SEVERITIES`
    text: str  # one sentence for the operator


def refusal(robot: Robot, request: StartRequest) -> Refusal | None:
    """Return the reason to end the current start in this cycle; None if the start may continue.

    In the cycle in which START is pressed, diagnostics are ignored in all states except OFF, because the same START may
    have acknowledged them. A released dead-man switch, a STOP or the end of the program ends the start at once.

    Args:
        robot: torque limits, and `idle_torque`, the largest torque that an idle drive may report.
        request: conditions of the start in this cycle.
    """
    if request.pressed:
        reason = _stop_reason(request) or (request.diagnostic if request.supervisor is _S.OFF else "")
        if not reason and request.supervisor is _S.HOLD:
            reason = moving_joint(request.velocity, powered(request.drive_state))
    else:
        reason = _reason(request)
        if not reason and (text := _failure(request)):
            return Refusal("START_FAILED", "error", text)
    if not reason and request.supervisor in _ENABLING:
        reason = implausible_torque(robot, request.drive_state, request.torque)
    return Refusal("START_REFUSED", "warning", REFUSED + reason) if reason else None


def _reason(request: StartRequest) -> str:
    """Return why the start must end, or an empty text if it may continue. The drive torques are not checked here."""
    if reason := _stop_reason(request):
        return reason
    if request.supervisor in _ACKNOWLEDGING:
        return ""
    if request.diagnostic or request.nodes_ready:
        return request.diagnostic
    return missing_text(request.missing)


def _failure(request: StartRequest) -> str:
    """Return why the start failed and which drives delay it. Return an empty text if the start may continue."""
    if not request.cycles_left:
        within = f"within {ENABLE_CYCLES} cycles"
    elif request.supervisor in _ENABLING and request.stalled >= STALLED_CYCLES:
        within = f"and no drive changed its state for {STALLED_CYCLES} cycles"
    else:
        return ""
    if request.supervisor in _ENABLING and (request.drive_state == DriveState.OPERATION_ENABLED).all():
        return f"the direction test of the joints did not end {within}"
    return f"the drives were not enabled {within}: {_not_enabled(request.drive_state)}"


def _not_enabled(drive_state: Vector) -> str:
    """Return a text with the names and states of the drives that delay the start, see `words_towards_operation`.

    Args:
        drive_state: values of `DriveState`, shape (12,).
    """
    on = powered(drive_state)
    before = ~(on | (drive_state == DriveState.SWITCHED_ON))
    late = next((late for late in (before, ~on, drive_state != DriveState.OPERATION_ENABLED) if late.any()), on)
    return ", ".join(f"{JOINTS[i]} is in {_name(float(drive_state[i]))}" for i in np.flatnonzero(late).tolist())


def _name(drive_state: float) -> str:
    return _NAMES.get(drive_state, f"state {drive_state:g}")


def words_towards_operation(drive_state: Vector) -> list[Controlword]:
    """Return the next controlword of each drive towards OPERATION ENABLED. The drives wait for each other, so no joint sags.

    If all drives produce torque, all get ENABLE OPERATION. Until then, a drive that produces torque gets QUICK STOP and holds
    its position. A drive in SWITCHED ON waits until every other drive is in SWITCHED ON or produces torque.

    Args:
        drive_state: values of `DriveState`, shape (12,).
    """
    on = powered(drive_state)
    if on.all():
        return [Controlword.ENABLE_OPERATION] * len(on)
    waits = not (on | (drive_state == DriveState.SWITCHED_ON)).all()
    return [
        Controlword.QUICK_STOP
        if holds
        else Controlword.SWITCH_ON
        if waits and state == DriveState.SWITCHED_ON
        else controlword_towards_operation(state)
        for state, holds in zip(drive_state.astype(int).tolist(), on.tolist(), strict=True)
    ]


def _stop_reason(request: StartRequest) -> str:
    """Return why the operator or the program forbids a start, or an empty text."""
    if request.ending:
        return PROGRAM_ENDS
    if request.stop_requested or not request.dead_man:
        return stop_text(request.stop_requested)
    return ""


def missing_text(missing: Collection[str]) -> str:
    """Return which nodes prevent READY, as one sentence.

    Args:
        missing: DBC names of the nodes that prevent READY.
    """
    return f"no answer or not trusted yet: {', '.join(sorted(missing))}"


def entry_text(state: SupervisorState, missing: Collection[str], stop_requested: bool) -> str:
    """Return why the robot entered a state, as one sentence.

    The caller uses this sentence only if no diagnostic caused the change of the state.

    Args:
        state: state that was entered.
        missing: DBC names of the nodes that prevent READY.
        stop_requested: True if STOP or HOLD was requested.
    """
    match state:
        case _S.OFF:
            return missing_text(missing)
        case _S.READY:
            return "every required node answers and no diagnostic prevents a start"
        case _S.ACTIVE:
            return "the operator pressed START"
        case _S.FINISH_STEP:
            return stop_text(stop_requested) + WALK_ENDS
        case _:
            return "the operator acknowledged the fault with START"


def moving_joint(velocity: Vector, on: npt.NDArray[np.bool_]) -> str:
    """Return a sentence about the fastest joint whose drive is on; empty if every joint whose drive is on is at rest.

    Args:
        velocity: joint velocities, shape (12,) [rad/s].
        on: whether the drive of each joint is on, shape (12,).
    """
    speed = np.where(on & np.isfinite(velocity), np.abs(velocity), 0.0)
    joint = int(np.argmax(speed))
    if speed[joint] <= AT_REST:
        return ""
    moving, most = np.degrees(speed[joint]), np.degrees(AT_REST)
    return f"{JOINTS[joint]} still moves at {moving:.0f} deg/s; must be at most {most:.0f} deg/s"


def stop_text(stop_requested: bool) -> str:
    """Return the reason of an operator stop, as one sentence.

    Args:
        stop_requested: True if STOP or HOLD was requested, False if the dead-man switch is not pressed.
    """
    return "the operator asked to stop" if stop_requested else "the dead-man switch was released or the pendant is lost"


def implausible_torque(robot: Robot, drive_state: Vector, torque: Vector) -> str:
    """Return a sentence about a drive whose reported torque is impossible in its state; empty if there is no such drive.

    Args:
        robot: torque limits, and `idle_torque`, the largest torque that an idle drive may report.
        drive_state: values of `DriveState`, shape (12,).
        torque: torque reported by each drive, shape (12,) [Nm at the joint].
    """
    idle = robot.thresholds.idle_torque
    on = powered(drive_state)
    allowed = np.where(on, robot.torque_max, 0.0) + idle
    wrong = np.flatnonzero(~(np.abs(torque) <= allowed))  # `~(... <= ...)` is also True for NaN
    if not wrong.size:
        return ""
    joint = int(wrong[0])
    state = _name(float(drive_state[joint]))
    limit = f"its limit of {robot.torque_max[joint]:.0f} Nm" if on[joint] else f"{idle:g} Nm, because it is not enabled"
    return f"the drive of {JOINTS[joint]} reports {torque[joint]:.0f} Nm in {state}; must be within {limit}"

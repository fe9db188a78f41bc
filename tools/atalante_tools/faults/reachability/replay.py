"""Conversion of a counterexample to a test case of a walk: each input becomes an operator action or an injected fault.

A counterexample lists the inputs, cycle by cycle, with which a search has violated a safety property. The test case replays the
inputs while the emulated robot walks.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from atalante_emulator.faults import Fault
from atalante_emulator.pendant import Request
from atalante_hal.safety.diagnostics import Reaction
from atalante_hal.wire.cia402 import DriveState
from atalante_tools.faults.reachability.drive_steps import DriveCycle, DriveStep
from atalante_tools.faults.reachability.explorations import Cycle
from atalante_tools.faults.reachability.hal_steps import Environment, PendantFrame
from atalante_tools.faults.scenario import Case, HostFault, OperatorAction, Stimulus

_BUTTON: Final = {Request.START: "start", Request.STOP: "stop", Request.HOLD: "hold"}
#: Number of cycles for which a run continues after the last input of the counterexample.
OBSERVED: Final = 20


class NotReplayable(ValueError):  # noqa: N818
    """Raised if a counterexample has an input that cannot be replayed, for example a frame of a second sender."""


def case_of(cycles: Sequence[Cycle]) -> Case:
    """Convert a counterexample to a test case. The robot must walk at the start of the counterexample.

    Args:
        cycles: inputs of each cycle.

    Raises:
        NotReplayable: If an input cannot be replayed, for example a frame of a second sender.
    """
    stimuli: list[Stimulus] = []
    dead_man = True
    for number, cycle in enumerate(cycles):
        frames, environment = cycle.frames, cycle.environment
        if environment.reaction is Reaction.HOLD:
            stimuli.append(HostFault("raise", number, value="ValueError"))
        elif environment.reaction is Reaction.INFO and not environment.enabled:
            stimuli.append(Fault("leave_operation", "LEFT_SK", number, 1, state="QUICK_STOP_ACTIVE"))
        elif environment != Environment(walking=environment.walking, finished=environment.finished):
            raise NotReplayable(f"cycle {number + 1} cannot be replayed: no fault of the emulator causes {environment}")
        if not frames:
            stimuli.append(Fault("drop", "PENDANT_STATE", number, 1))
            continue
        if any(frame.sender or frame.age or frame != frames[0] for frame in frames):
            raise NotReplayable(f"cycle {number + 1} cannot be replayed: no fault of the emulator causes {frames}")
        if len(frames) > 1:
            stimuli.append(Fault("duplicate", "PENDANT_STATE", number, 1))
        stimuli += _actions(frames[0], dead_man, number)
        dead_man = frames[0].dead_man
    return Case("counterexample", tuple(stimuli), observed=OBSERVED)


def drive_case_of(trace: Sequence[tuple[DriveCycle, DriveStep]]) -> Case:
    """Convert a counterexample of a drive to a test case. The case starts in the cycle after the drive was enabled.

    Args:
        trace: inputs and state of each cycle.

    Raises:
        NotReplayable: If a cycle after the drive was enabled contains anything other than the loss of the command.
    """
    states = [step.drive.state for _, step in trace]
    enabled = states.index(DriveState.OPERATION_ENABLED)
    lost = trace[enabled + 1 :]
    for cycle, _ in lost:
        if cycle != DriveCycle():
            raise NotReplayable(
                f"the counterexample cannot be replayed: each cycle must have exactly one fault, a lost command, got {cycle}"
            )
    return Case("counterexample", (Fault("drop", "COMMAND_LEFT_LEG", 0, len(lost)),), observed=OBSERVED)


def _actions(frame: PendantFrame, dead_man: bool, number: int) -> list[Stimulus]:
    actions: list[Stimulus] = []
    if frame.dead_man != dead_man:
        actions.append(OperatorAction("squeeze" if frame.dead_man else "release", number))
    if frame.pressed:
        actions.append(OperatorAction(_BUTTON[Request(frame.request)], number))
    return actions

"""One cycle of the HAL, as a transition of an exhaustive search: pendant frames, E2E check, safety monitor and commands.

The functions under test run in a real `Hal`. A step writes a state into this HAL, calls its functions with real frames, and
reads the state back. The other nodes are inputs: they answer or not, their drives are enabled or not, and any diagnostic may
be active in any cycle.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache
from typing import Final, NamedTuple

import numpy as np

import atalante_dbc
from atalante_emulator.pendant import Request
from atalante_hal.dbc_names import JOINT_NODES
from atalante_hal.hal import Hal
from atalante_hal.pendant import Pendant
from atalante_hal.robot import load_robot
from atalante_hal.safety.diagnostics import Dtc, Finding, Reaction
from atalante_hal.safety.direction import DirectionProof
from atalante_hal.safety.fault_memory import FaultMemory
from atalante_hal.safety.safety_monitor import RECALL_CYCLES
from atalante_hal.safety.state_machine import MOVING
from atalante_hal.types import Command, SupervisorState
from atalante_hal.wire.cia402 import Controlword, DriveState
from atalante_hal.wire.e2e import FULL, NOTHING, REQUALIFY, SETTLED, Check, Qualification
from atalante_hal.wire.frame import Frames, new_frames
from atalante_hal.wire.process_image import NEVER, TransmitImage
from atalante_tools.faults.reachability.no_bus import NoBus

#: Age at which pendant data times out [cycles of 1 ms]. The search does not distinguish higher ages.
LOST: Final = atalante_dbc.load().message("PENDANT_STATE").timeout_ms
#: Cycle number used in all steps of the search. All counters are relative to `_CYCLE`, so the results do not depend on it.
_CYCLE: Final = 1001
_TAG: Final = _CYCLE & 0xFF
#: `_PRESSES` is the RequestCounter in the last accepted frame of the pendant.
#: `_ROGUE_PRESSES` is the RequestCounter in a frame in which a second sender reports a press.
_PRESSES, _ROGUE_PRESSES = 10, 12
#: Codes of the remaining time in which a pressed START can change the supervisor state: none, one cycle, several cycles.
NO_START, LAST_START, START = 0, 1, 2
#: Remaining number of cycles in which a pressed START can change the supervisor state, by code (`NO_START`, ...).
#: The search writes the number of cycles into `SafetyMonitor.start_cycles_left`.
START_CYCLES: Final = {NO_START: 0, LAST_START: 1, START: 100}
#: Error counters of the pendant (`Qualification`) that the search tries. The key is True if the HAL trusts the pendant.
QUALIFICATIONS: Final = {
    False: (Qualification(0, 0, False), Qualification(0, REQUALIFY - 1, False)),
    True: (SETTLED, Qualification(FULL - 4, 0, True)),
}
#: Last frame that the HAL checked for a press of a button. `_NONE`: no frame. `_LATEST`: the last accepted frame.
#: `_OLDER`: a frame before the last accepted frame. `_ROGUE`: a frame of a second sender.
#: If the RequestCounter of the next frame differs from the RequestCounter of the checked frame, a button was pressed.
_NONE, _LATEST, _OLDER, _ROGUE = range(4)
#: RequestCounter (counter of button presses) in the checked frame, for each of `_NONE`, `_LATEST`, `_OLDER` and `_ROGUE`.
_EVALUATED: Final = {_NONE: None, _LATEST: _PRESSES, _OLDER: _PRESSES - 1, _ROGUE: _ROGUE_PRESSES}


class Reception(NamedTuple):
    """Part of the search state: what the HAL has received from the pendant."""

    age: int = 0  # age of the last accepted frame [cycles]; `LOST` after the timeout
    dead_man: bool = True  # whether the dead-man switch is pressed in the last accepted frame
    request: int = Request.START  # `Request` of the last accepted frame
    evaluated: int = _LATEST  # last frame that the HAL checked for a press: `_NONE`, `_LATEST`, `_OLDER` or `_ROGUE`
    rogue: bool = False  # whether the last accepted frame has the RequestCounter of a second sender
    stored: bool = False  # whether a press of START is stored until the HAL trusts the pendant
    trusted: bool = True  # whether the HAL trusts the pendant
    #: `Request` in the last intact frame of the genuine pendant, not of a second sender
    own_request: int = Request.START


#: Reception after the pendant has timed out. The content of its last frame then has no effect.
SILENT: Final = Reception(LOST, False, 0, _NONE, trusted=False, own_request=0)


class PendantFrame(NamedTuple):
    """Pendant frame that arrives in a cycle."""

    age: int  # number of cycles since the pendant sampled the content of the frame
    dead_man: bool  # whether the dead-man switch is pressed
    request: int  # `Request` of the frame
    pressed: bool  # whether a button was pressed since the last accepted frame
    sender: str = ""  # "" for the pendant, "rogue" for a second sender, "damaged" for a frame with a wrong CRC


class Inputs(NamedTuple):
    """Inputs of the operator, as computed by `Pendant.evaluate`."""

    dead_man: bool  # whether the dead-man switch is pressed
    stop: int  # stop request: 0 none, 1 STOP, 2 HOLD
    started: bool  # whether a press of START is accepted in this cycle


class Supervision(NamedTuple):
    """Part of the search state: state of the safety monitor of the HAL.

    The search follows only one drive, the left frontal hip.
    """

    supervisor: SupervisorState
    start: int  # remaining time in which a pressed START can take effect: `NO_START`, `LAST_START` or `START`
    enabling: bool = False  # whether drives are being enabled (`SafetyMonitor.enabling`)
    lowered: bool = False  # whether the HAL keeps the left frontal hip drive off, so that its joint sinks


class Environment(NamedTuple):
    """Inputs of the safety monitor that do not come from the pendant."""

    reaction: Reaction = Reaction.INFO  # reaction of the worst confirmed diagnostic
    mine: bool = False  # whether the worst diagnostic belongs to the left frontal hip drive; False: to another drive
    nodes_ready: bool = True  # whether all nodes except the pendant have sent a status message
    enabled: bool = True  # whether all drives are in OPERATION ENABLED
    walking: bool = False  # whether the robot walks on the ground
    finished: bool = True  # whether the walking step is finished


class Decision(NamedTuple):
    """Result of one cycle of the safety monitor."""

    after: Supervision
    prevented: bool  # whether a diagnostic prevents the HAL from enabling drives
    entered: bool  # whether the supervisor state changed; a change deletes a stored START


class _ScriptedPendant(Pendant):
    """Pendant that returns the inputs which the search has set."""

    def evaluate(self, present: bool, **others: object) -> None:
        """Do nothing. The search has already set the inputs of the operator.

        Args:
            present: has no effect.
            **others: have no effect.
        """

    def clear_press(self) -> None:
        """Do nothing. The search deletes a stored press of START in `HalSteps._without_press`."""


class HalSteps:
    """Transition function of the HAL."""

    def __init__(self) -> None:
        network, robot = atalante_dbc.load(), load_robot()
        self._hal = Hal(network, robot, NoBus())
        self._monitor = self._hal._safety_monitor
        # Leave out the direction test at the end of a start. The test changes no controlword, so the search misses no case.
        self._monitor.proof = DirectionProof(robot, ())
        self._image = self._hal._image
        self._pendant = self._monitor._pendant
        self._scripted = _ScriptedPendant(self._image)
        self._row = self._pendant.row
        self._transmit = TransmitImage([network.message("PENDANT_STATE")])
        codec = self._transmit.codec
        self._at = [codec.index("PENDANT_STATE", name) for name in ("DeadMan", "Request", "RequestCounter")]
        self._buffer = new_frames(8)
        self._dtc = {reaction: next(d for d in Dtc if d.reaction is reaction) for reaction in Reaction}
        self._parts = self._hal._parts
        values, layout = self._parts.values, self._parts.layout
        self._drive_state, self._torque = values[layout["drive_state"]], values[layout["torque"]]
        self._frame = cache(self._sealed)
        #: `_receive` and `_without_press` with a cache of all results. `_processed` is the cached form of `_process`.
        self.receive, self.without_press = cache(self._receive), cache(self._without_press)
        self._processed = cache(self._process)

    # -- pendant -----------------------------------------------------------------------------------------------------

    def _receive(self, before: Reception, frames: tuple[PendantFrame, ...]) -> tuple[tuple[Reception, Inputs], ...]:
        """Return all pairs of `Reception` and `Inputs` that are possible after these frames arrive.

        The field `own_request` belongs to the pendant, not to the HAL. This field is therefore computed here. The HAL then
        runs only once for states that differ only in `own_request`.

        Args:
            before: state before the cycle.
            frames: frames that arrive, in order.
        """
        own = [frame.request for frame in frames if not (frame.sender or frame.age)]
        return tuple(
            (after if after.age == LOST else after._replace(own_request=_own_request(before, own, after)), inputs)
            for after, inputs in self._processed(before._replace(own_request=0), frames)
        )

    def _process(self, before: Reception, frames: tuple[PendantFrame, ...]) -> tuple[tuple[Reception, Inputs], ...]:
        """Return all pairs of `Reception` and `Inputs` that the HAL may compute from these frames.

        Several pairs are possible, because some counters of the HAL are not part of a search state. For these counters,
        every value that leads to another pair is tried. The tests check the choice of the values.

        The field `own_request` is 0 in each pair. The method `_receive` sets this field.

        Args:
            before: state before the cycle.
            frames: frames that arrive, in order.
        """
        ages = (before.age,) if before.age < LOST else (LOST, 200, NEVER)
        # While the HAL suspects two senders, it stores no RequestCounter, so `evaluated` is `_NONE`.
        two_senders = before.evaluated == _NONE or any(frame.sender == "rogue" for frame in frames)
        evidences = (0, FULL - 16) if two_senders else (0,)
        return tuple(
            dict.fromkeys(
                self._received(before, frames, age, trust, evidence)
                for age in ages
                for trust in QUALIFICATIONS[before.trusted]
                for evidence in evidences
            )
        )

    def _received(
        self, before: Reception, frames: tuple[PendantFrame, ...], age: int, trust: Qualification, evidence: int
    ) -> tuple[Reception, Inputs]:
        hal, monitor, image, row, pendant = self._hal, self._monitor, self._image, self._row, self._pendant
        self._reset()
        monitor._pendant = pendant
        hal._state.supervisor = SupervisorState.OFF
        monitor._heartbeats.all_reported = False
        accepted = _TAG - 1 - age & 0xFF
        image._e2e.expected[row] = NOTHING if age == NEVER else accepted + 1 & 0xFF
        image._e2e.silent[row] = min(age, NEVER)
        old = self._frame(PendantFrame(0, before.dead_man, before.request, before.rogue, "rogue"), accepted)
        image.frames[row] = old[0]
        pendant.signals[:3] = before.dead_man, before.request, _ROGUE_PRESSES if before.rogue else _PRESSES
        pendant.signals[3:] = 0.0
        image.age[row] = age
        pendant._press = _EVALUATED[before.evaluated]
        pendant._pressed = before.stored
        monitor._message_monitor.qualification[row] = trust
        monitor._message_monitor._evidence[row] = evidence
        for index, frame in enumerate(frames):
            self._buffer[index] = self._frame(frame, _TAG - frame.age & 0xFF)[0]
        image.new_cycle()
        image.accept_each(self._buffer, len(frames), _TAG)
        self._others_answer()
        monitor._evaluate(())
        dead_man, request, presses = pendant.signals[:3].tolist()
        rogue = presses == _ROGUE_PRESSES
        latest = _PRESSES if rogue else presses
        evaluated = {None: _NONE, latest: _LATEST, _ROGUE_PRESSES: _ROGUE}.get(pendant._press, _OLDER)
        trusted = monitor._message_monitor.is_trusted(row)
        now = int(image.age[row])
        if now < LOST:
            after = Reception(now, dead_man == 1, int(request), evaluated, rogue, pendant._pressed, trusted, 0)
        else:
            after = SILENT._replace(evaluated=evaluated, stored=pendant._pressed, trusted=trusted)
        stop = 2 if pendant.hold_requested else int(pendant.stop_requested)
        return after, Inputs(pendant.dead_man, stop, pendant.started)

    def _without_press(self, state: Reception) -> Reception:
        """Delete a stored press of START, as the HAL does at each change of the supervisor state.

        Args:
            state: data received from the pendant, before the change.

        Returns:
            The same data without the press.
        """
        pendant = self._pendant
        pendant._press, pendant._pressed = _EVALUATED[state.evaluated], state.stored
        pendant.clear_press()
        evaluated = next(key for key, presses in _EVALUATED.items() if presses == pendant._press)
        return state._replace(evaluated=evaluated, stored=pendant._pressed)

    def _sealed(self, frame: PendantFrame, counter: int) -> Frames:
        values = self._transmit.values
        values.fill(0.0)
        pressed = _ROGUE_PRESSES if frame.sender == "rogue" else _PRESSES + 1
        values[self._at] = frame.dead_man, frame.request, pressed if frame.pressed else _PRESSES
        sealed = self._transmit.seal(counter).copy()
        if frame.sender == "damaged":
            sealed["data"][0, 3] ^= 1
        return sealed

    # -- safety monitor ----------------------------------------------------------------------------------------------

    def decide(self, before: Supervision, inputs: Inputs, environment: Environment) -> Iterator[Decision]:
        """Yield the possible results of the safety monitor in one cycle.

        Args:
            before: state before the cycle.
            inputs: inputs of the operator.
            environment: all other inputs.
        """
        hal, monitor, pendant = self._hal, self._monitor, self._scripted
        self._reset()
        monitor._pendant = pendant
        pendant.dead_man, pendant.stop_requested = inputs.dead_man, inputs.stop > 0
        pendant.hold_requested, pendant.started = inputs.stop == 2, inputs.started
        self._write(before)
        monitor.walking = environment.walking
        monitor.step, monitor._finish = None if environment.finished else 1, (1, _CYCLE + 1)
        monitor._heartbeats.all_reported = environment.nodes_ready
        if not environment.enabled:
            self._drive_state[1] = DriveState.QUICK_STOP_ACTIVE
        findings = [
            Finding(self._dtc[environment.reaction], JOINT_NODES[0 if environment.mine else 1], 0.0, True, "input")
        ]
        monitor._evaluate(findings)
        left = monitor.start_cycles_left
        lowered = JOINT_NODES[0] in monitor.lowered
        for start in {NO_START} if not left else {LAST_START, START} if before.start == START else {min(left, START)}:
            after = Supervision(hal._state.supervisor, start, monitor.enabling, lowered)
            yield Decision(after, monitor.start_prevented, after.supervisor is not before.supervisor)

    def command(self, state: Supervision, prevented: bool, drive: DriveState, controller: str) -> tuple[int, bool]:
        """Return the controlword that the HAL sends to the drive, and whether drives are being enabled.

        Args:
            state: state of the safety monitor in this cycle.
            prevented: whether a diagnostic prevents the HAL from enabling drives.
            drive: state that the drive reports.
            controller: "torque", or "raise" if the controller raises an exception.
        """
        hal = self._hal
        self._reset()
        self._write(state)
        if prevented:
            hal._safety_monitor.memory.raise_dtc(_CYCLE, self._dtc[Reaction.HOLD], JOINT_NODES[1])
            hal._safety_monitor.memory.close_cycle(_CYCLE)
        self._drive_state[0] = drive
        if not hal.moving:
            hal.hold()
        elif controller == "raise":
            hal.fail(ValueError("input"))
        else:
            hal.write(Command(np.zeros(12), np.zeros(8)))
        return int(hal._commands.control[0]), self._monitor.enabling

    def _reset(self) -> None:
        """Reset the HAL to values without a fault. The caller then writes the search state into the HAL."""
        hal, monitor = self._hal, self._monitor
        hal._state.cycle = _CYCLE
        monitor.memory = FaultMemory()
        monitor._reports.clear()
        monitor.start_cycles_left, monitor.enabling, monitor.moving, monitor.walking = 0, False, False, False
        monitor.recalled = -RECALL_CYCLES  # cycle of the last QUICK_STOP, long ago, so that ACTIVE is not delayed
        # `_stalled` counts cycles in which no drive changes its state. A high count ends a start. The search does not use it.
        # Instead, it tries both results in each cycle: the start ends (`LAST_START`), and the start continues (`START`).
        monitor._stalled = 0
        monitor._ending = monitor._duplicate_found = monitor._ramping = monitor._proof_begun = False
        monitor.lowered.clear()
        monitor._kept_off.clear()
        rows = len(self._image.check)
        monitor._message_monitor.qualification = [SETTLED] * rows
        monitor._message_monitor._evidence = [0] * rows
        self._drive_state[:] = DriveState.OPERATION_ENABLED
        self._torque[:] = 0.0
        self._parts.motion[:] = 0.0
        # A step must not depend on the pendant frames of an earlier step.
        monitor._message_monitor._disturbed.clear()
        monitor._message_monitor._was_trusted = [True] * rows
        self._image.refused, self._image.error_passive, self._image._offered = [], [], None
        self._image.age.fill(0)
        self._image.check.fill(Check.OK)

    def _others_answer(self) -> None:
        """Mark the data of every node except the pendant as new."""
        image, row = self._image, self._row
        age, check = int(image.age[row]), int(image.check[row])
        image.age.fill(0)
        image.check.fill(Check.OK)
        image.age[row], image.check[row] = age, check

    def _write(self, state: Supervision) -> None:
        monitor = self._monitor
        self._hal._state.supervisor = state.supervisor
        monitor.moving = state.supervisor in MOVING
        monitor.start_cycles_left, monitor.enabling = START_CYCLES[state.start], state.enabling
        if state.lowered:
            monitor.lowered.add(JOINT_NODES[0])
            if state.supervisor not in (SupervisorState.LOWER, SupervisorState.FAULT):
                monitor._kept_off.add(JOINT_NODES[0])


def _own_request(before: Reception, own: list[int], after: Reception) -> int:
    """Return the `Request` in the last intact frame of the genuine pendant. Frames of a second sender do not count.

    Args:
        before: state before the cycle.
        own: requests of the frames that the genuine pendant sent in this cycle.
        after: state after the cycle. Its last accepted frame has not timed out.
    """
    return (before.own_request, *own)[-1] if after.rogue else after.request


#: Controlword with which a drive follows the torque commands of the HAL.
ENERGISING: Final = int(Controlword.ENABLE_OPERATION)

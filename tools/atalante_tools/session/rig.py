"""A HAL ready to run, whatever carries its frames: `target -> buses -> Hal`, and the emulated robot when it is embedded.

There is one HAL code path: an embedded robot differs from a real one in the bus alone. It lives in this process, where its
emulator can be looked into, or in one of its own, where its body moves while the HAL works; the bytes on the bus are the same.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import atalante_dbc
from atalante_dbc import Network
from atalante_hal.bus import Bus
from atalante_hal.bus.channel_map import open_channels, parse_channel_map
from atalante_hal.bus.joined import JoinedBus
from atalante_hal.bus.pair import lockstep_pair
from atalante_hal.hal import Hal
from atalante_hal.loop import LockStep, Statistics, WallClock, realtime, run
from atalante_hal.robot import Robot, load_robot
from atalante_hal.safety.safety_monitor import REFUSED
from atalante_hal.transceiver import FrameTap
from atalante_hal.types import Controller, State, SupervisorState
from atalante_tools.console.options import Target
from atalante_tools.console.outcome import Failed, FaultLatched
from atalante_tools.console.stop_request import StopRequest, check_stop, ended_by
from atalante_tools.console.terminal import Progress, say
from atalante_tools.session.body import describe, open_body
from atalante_tools.session.embedded import EmbeddedRobot, SpawnConfig

if TYPE_CHECKING:
    from atalante_control.model import ExoskeletonParameters
    from atalante_emulator.emulator import Emulator
    from atalante_emulator.faults import Fault
    from atalante_emulator.pendant import Operator

#: How long the nodes may take to answer a SYNC [s]: on the wall clock half a cycle, in lock-step as long as a slow machine needs.
PATIENCE: Final = 0.5e-3
LOCKSTEP_PATIENCE: Final = 2.0


@dataclass
class Rig:
    """A HAL on its bus; `emulator` and `operator` are those of a robot embedded in this process."""

    target: Target
    hal: Hal
    emulator: Emulator | None = None
    operator: Operator | None = None

    def run(
        self, controller: Controller, *, until: Callable[[State], bool], record: Callable[[], None] = lambda: None
    ) -> Statistics:
        """`loop.run` on the clock of the target; ends in HOLD. On the wall clock the process asks for real-time rights.

        A signal makes the HAL refuse every START and go to HOLD; no further signal cuts that short. `until` has to look at the
        stop request.

        Raises:
            Stopped: a signal arrived before; the robot was not driven.
        """
        with ended_by(self.hal.end) as stop:
            stop.check()
            if self.target.lockstep:
                return run(self.hal, controller, LockStep(), until=until, record=record)
            for refused in realtime():
                say(refused)
            return run(self.hal, controller, WallClock(), until=until, record=record)


@contextmanager
def open_hal(
    target: Target,
    *,
    network: Network | None = None,
    robot: Robot | None = None,
    seed: int = 0,
    pose: Sequence[float] | None = None,
    operator: Operator | None = None,
    assistance_factor: float = 1.0,
    controller_fields: Sequence[tuple[str, int]] = (),
    gait_hash: int = 0,
    tap: FrameTap | None = None,
    faults: Sequence[Fault] = (),
    robot_process: EmbeddedRobot | None = None,
    exoskeleton: ExoskeletonParameters | None = None,
) -> Iterator[Rig]:
    """Assemble a HAL for a command and take it apart in order.

    Args:
        network, robot: read from the project's files unless given.
        seed: of the embedded robot's noise.
        pose: joint angles the embedded robot starts from, shape (12,) [rad].
        operator: who holds the embedded pendant; one who starts as soon as the HAL is ready unless given.
        assistance_factor, controller_fields, gait_hash, tap: see `Hal`.
        faults: of the embedded robot.
        robot_process: a process that is to be the embedded robot, with an operator who starts as soon as the HAL is ready;
            closed in the end. None: this process is.
        exoskeleton: the embedded robot's legs; as they come from the factory unless given.

    Raises:
        ValueError: an operator of this process for a robot in another.
        FaultError: the network has no such target or signal.
        BusError, ChannelMapError: the buses cannot be opened, or another HAL is at work on them.
        Failed: the embedded robot needs PyBullet and it is not installed.
        Stopped: a signal arrived before or meanwhile.
    """
    check_stop()  # an import may have lost its exception, as may what is made here
    network = network or atalante_dbc.load()
    robot = robot or load_robot()
    with ExitStack() as stack:
        emulator = None
        if robot_process is not None:
            stack.enter_context(robot_process)
            if operator is not None:
                raise ValueError("the operator of a robot in a process of its own is there, too: leave `operator` out")
            robot_process.begin(SpawnConfig(network, robot, describe(robot, exoskeleton), pose, seed, faults))
            bus: Bus = robot_process.bus
        elif target.embedded:
            ours, theirs = lockstep_pair()
            bus = ours
            body = stack.enter_context(open_body(robot, pose, exoskeleton))
            from atalante_emulator.emulator import Emulator
            from atalante_emulator.pendant import Operator

            operator = operator or Operator()
            emulator = Emulator(network, robot, body, theirs, seed=seed, operator=operator, faults=faults)
            ours.step = emulator.poll
        else:
            bus = join(network, open_buses(network, target))
        stack.callback(bus.close)
        hal = Hal(
            network,
            robot,
            bus,
            patience=LOCKSTEP_PATIENCE if target.lockstep else PATIENCE,
            assistance_factor=assistance_factor,
            controller_fields=controller_fields,
            gait_hash=gait_hash,
            tap=tap,
        )
        if robot_process is None and not target.embedded:
            hal.listen()
        check_stop()
        yield Rig(target, hal, emulator, operator if emulator else None)


def open_buses(network: Network, target: Target) -> dict[str, Bus]:
    """The open bus of each of `network.buses`. Raises `BusError`, `ChannelMapError`."""
    return open_channels(target.interface, parse_channel_map(target.channel, network.buses))


def join(network: Network, buses: dict[str, Bus]) -> Bus:
    """One bus for all: itself if it is one already."""
    first, *others = {id(bus): bus for bus in buses.values()}.values()
    return JoinedBus(network, buses) if others else first


class Watch:
    """Asked once a cycle whether a run goes on; meanwhile says what the run is waiting for, or how far it is.

    A run ends when `done(state)`, asked while ACTIVE, says so; when somebody wants to stop; and when the robot leaves ACTIVE
    or is in FAULT. After the run `conclude` turns all but the first into the command's end.
    """

    def __init__(
        self, rig: Rig, stop: StopRequest, done: Callable[[State], bool], describe: Callable[[State], str]
    ) -> None:
        self._rig, self._stop, self._done, self._describe = rig, stop, done, describe
        self._progress = Progress()
        self._started = False
        self._finished = False
        self._state, self._reason = SupervisorState.OFF, ""

    def __call__(self, state: State) -> bool:
        """Whether the run is over."""
        active = self._rig.hal.moving
        if self._stop.wanted:
            over = True
        elif active:
            if not self._started:
                self._started = True
                self._progress.clear()
                say(f"ACTIVE on {self._rig.target}; Ctrl-C ends in HOLD")
            over = self._finished = self._done(state)
        else:
            over = self._started or state.supervisor is SupervisorState.FAULT
        if over:
            self._progress.clear()
            self._state, self._reason = state.supervisor, self._rig.hal.reason
        elif self._progress.due():
            self._progress.show(self._describe(state) if active else waiting_for(self._rig))
        return over

    def conclude(self) -> None:
        """End the command unless its work was done.

        Raises:
            SystemExit: with the code of the signal.
            FaultLatched, Failed: with the reason.
        """
        if self._stop.wanted:
            say("stopped, the robot is in HOLD")
            raise SystemExit(self._stop.exit_code)
        if self._state is SupervisorState.FAULT:
            raise FaultLatched(f"the robot is in FAULT: {self._reason}")
        if not self._finished:
            raise Failed(f"the robot went to HOLD: {self._reason}")


def waiting_for(rig: Rig) -> str:
    """What keeps the robot from ACTIVE, one sentence with what to type."""
    hal, target = rig.hal, rig.target
    if hal.state.supervisor is SupervisorState.OFF:
        missing = hal.missing()
        if hal.silent:
            return f"no node answers on {target}; an emulated robot is `atalante emulator {target.arguments}`"
        return f"waiting for {', '.join(missing)}" if missing else f"OFF: {hal.reason}"
    if hal.reason.startswith(REFUSED):
        return f"{hal.state.supervisor.name}: {hal.reason}"
    waits = f"{hal.state.supervisor.name}: waiting for the operator"
    return (
        f"{waits} of the embedded robot"
        if target.embedded
        else f"{waits}, who is `atalante pendant start {target.arguments}`"
    )

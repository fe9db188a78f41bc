"""Rig of a run: `target -> buses -> Hal`, with an emulated robot when the target is embedded.

The HAL code path is the same for every target: an embedded robot differs from a real one only in the bus. It runs in this
process, where tests can inspect the emulator, or in a subprocess, where its physics runs in parallel with the HAL. The bytes on
the bus are the same.
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
from atalante_hal.safety.start import REFUSED
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

#: Longest wait for the answers to a SYNC on the wall clock: half a cycle [s].
PATIENCE: Final = 0.5e-3
#: Longest wait for the answers to a SYNC in lock-step, long enough for a slow machine [s].
LOCKSTEP_PATIENCE: Final = 2.0


@dataclass
class Rig:
    """HAL on its bus.

    Attributes:
        target: Bus and clock.
        hal: The HAL.
        emulator: Emulator of a robot embedded in this process; None: any other robot.
        operator: Emulated operator of that robot; None: any other robot.
    """

    target: Target
    hal: Hal
    emulator: Emulator | None = None
    operator: Operator | None = None

    def run(
        self, controller: Controller, *, until: Callable[[State], bool], record: Callable[[], None] = lambda: None
    ) -> Statistics:
        """Run the loop on the clock of the target. It ends in HOLD.

        On the wall clock the process requests real-time priority and locked memory. A signal makes the HAL refuse every START
        and change to HOLD; further signals do not interrupt this. `until` must read the stop request.

        Args:
            controller: Controller that is updated in every cycle.
            until: End condition, called with the state after every cycle.
            record: Called after every cycle, to record it.

        Returns:
            Statistics of the loop.

        Raises:
            Stopped: If a signal arrived before the run; the robot was not driven.
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
    """Open the buses, create the HAL and, for an embedded target, the emulated robot. Close everything after the block.

    Args:
        target: Bus and clock.
        network: Network; None: read from the project's DBC.
        robot: Robot parameters; None: read from the project's file.
        seed: Seed of the sensor noise of the embedded robot.
        pose: Initial joint angles of the embedded robot, shape (12,) [rad]; None: all zero.
        operator: Emulated operator of the embedded robot; None: one that presses START as soon as the HAL is READY.
        assistance_factor: Initial assistance factor Xi, 0 to 1.
        controller_fields: Name and size of each telemetry field of the controller.
        gait_hash: Hash of the gait that the HAL reports.
        tap: Recorder of all frames; None: frames are not recorded.
        faults: Faults to inject into the embedded robot.
        robot_process: Subprocess that runs the embedded robot and is closed after the block. Its operator presses START as soon
            as the HAL is READY. None: the embedded robot runs in this process.
        exoskeleton: Geometry and masses of the embedded robot; None: default leg lengths.

    Raises:
        ValueError: If both `operator` and `robot_process` are given.
        FaultError: If a fault names a target or signal that the network does not have.
        BusError: If a bus cannot be opened, or another HAL uses it.
        ChannelMapError: If the channel map is invalid.
        Failed: If the embedded robot needs PyBullet and it is not installed.
        Stopped: If a signal arrived before or during the start.
    """
    check_stop()  # the exception of a signal may have been lost during imports
    network = network or atalante_dbc.load()
    robot = robot or load_robot()
    with ExitStack() as stack:
        emulator = None
        if robot_process is not None:
            stack.enter_context(robot_process)
            if operator is not None:
                raise ValueError(
                    "operator must be None for a robot in a subprocess, which creates its own: remove `operator`"
                )
            robot_process.begin(SpawnConfig(network, robot, describe(robot, exoskeleton), pose, seed, faults))
            bus: Bus = robot_process.bus
        elif target.embedded:
            hal_end, robot_end = lockstep_pair()
            bus = hal_end
            body = stack.enter_context(open_body(robot, pose, exoskeleton))
            from atalante_emulator.emulator import Emulator
            from atalante_emulator.pendant import Operator

            operator = operator or Operator()
            emulator = Emulator(network, robot, body, robot_end, seed=seed, operator=operator, faults=faults)
            hal_end.step = emulator.poll
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
    """Open the bus of each name in `network.buses`.

    Args:
        network: Network with the bus names.
        target: Interface and channel, or channel map.

    Raises:
        BusError: If a bus cannot be opened.
        ChannelMapError: If the channel map is invalid.
    """
    return open_channels(target.interface, parse_channel_map(target.channel, network.buses))


def join(network: Network, buses: dict[str, Bus]) -> Bus:
    """Return one bus that sends and receives on all buses.

    Args:
        network: Network that assigns messages to buses.
        buses: Open bus of each name; the same object if several names share a channel.
    """
    first, *others = {id(bus): bus for bus in buses.values()}.values()
    return JoinedBus(network, buses) if others else first


class Watch:
    """End condition of a run, called once per cycle. It prints the progress, or what the run is waiting for.

    A run ends when `done(state)` returns True while ACTIVE, when a signal arrives, or when the robot leaves ACTIVE or is in
    FAULT. After the run `conclude` raises an error unless the run ended by `done`.
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
        """Return whether the run is over.

        Args:
            state: State of the robot after a cycle.
        """
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
        """End the command with an error unless the run was completed.

        Raises:
            SystemExit: If a signal ended the run, with its exit code.
            FaultLatched: If the robot is in FAULT.
            Failed: If the robot left ACTIVE early.
        """
        if self._stop.wanted:
            say("stopped, the robot is in HOLD")
            raise SystemExit(self._stop.exit_code)
        if self._state is SupervisorState.FAULT:
            raise FaultLatched(f"the robot is in FAULT: {self._reason}")
        if not self._finished:
            raise Failed(f"the robot went to HOLD: {self._reason}")


def waiting_for(rig: Rig) -> str:
    """Return what the run is waiting for before ACTIVE, with the command to type.

    Args:
        rig: Rig whose robot is not ACTIVE yet.
    """
    hal, target = rig.hal, rig.target
    if hal.state.supervisor is SupervisorState.OFF:
        missing = hal.missing()
        if hal.silent:
            return (
                f"no node answers on {target}; to start an emulated robot, type `atalante emulator {target.arguments}`"
            )
        return f"waiting for {', '.join(missing)}" if missing else f"OFF: {hal.reason}"
    if hal.reason.startswith(REFUSED):
        return f"{hal.state.supervisor.name}: {hal.reason}"
    waits = f"{hal.state.supervisor.name}: waiting for START"
    return (
        f"{waits} of the emulated operator"
        if target.embedded
        else f"{waits}; type `atalante pendant start {target.arguments}`"
    )

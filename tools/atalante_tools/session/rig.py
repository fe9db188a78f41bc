"""Setup of a run: opens the buses of a target and creates the HAL. For an embedded target it also creates the emulated robot.

    target -> buses -> Hal -> Rig

The HAL runs the same code for every target. An embedded robot runs in this process, or in a subprocess in parallel with the
HAL. The bytes on the bus are the same in all cases.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, NoReturn

import atalante_dbc
from atalante_dbc import Network
from atalante_hal.bus import Bus
from atalante_hal.bus.channel_map import open_channels, parse_channel_map
from atalante_hal.bus.joined import JoinedBus
from atalante_hal.bus.pair import lockstep_pair
from atalante_hal.hal import Hal
from atalante_hal.leg_model import LegModel
from atalante_hal.loop import LockStep, Statistics, WallClock, realtime, run
from atalante_hal.robot import Robot, load_robot
from atalante_hal.safety.diagnostics import Dtc
from atalante_hal.safety.start import REFUSED
from atalante_hal.transceiver import FrameTap
from atalante_hal.types import Controller, State, SupervisorState
from atalante_tools.console.options import Target
from atalante_tools.console.outcome import Failed, FaultLatched
from atalante_tools.console.stop_request import StopRequest, check_stop, ended_by
from atalante_tools.console.terminal import Progress, print_message
from atalante_tools.session.body import describe, open_mechanics
from atalante_tools.session.embedded import EmbeddedRobot, SpawnConfig
from atalante_tools.session.embedded.access import Access, LocalAccess

if TYPE_CHECKING:
    from atalante_emulator.emulator import Emulator
    from atalante_emulator.faults import Fault
    from atalante_emulator.mechanics import Mechanics
    from atalante_emulator.pendant import Operator

#: Text about the state of the drives, printed if the bus is down when a run ends.
UNCONFIRMED: Final = (
    "no HOLD was confirmed, because the bus is down: each enabled drive holds its position by itself after its watchdog "
    "timeout"
)
#: Longest wait for the answers to a SYNC in real time [s], half a cycle.
PATIENCE: Final = 0.5e-3
#: Longest wait for the answers to a SYNC in lock-step [s].
#: `LOCKSTEP_PATIENCE` is large, because the process of the emulated robot may run on a slow computer.
LOCKSTEP_PATIENCE: Final = 2.0


@dataclass
class Rig:
    """HAL with its open bus, and the emulated robot if it runs in this process.

    Attributes:
        target: Bus and clock.
        hal: HAL of the run.
        access: Access to an embedded robot that bypasses the bus. The robot runs in this process or in another process. None if
            the robot is not embedded.
        emulator: Emulator of a robot in this process. None if the robot is real or in another process.
        operator: Emulated operator of a robot in this process. None if the robot is real or in another process.
    """

    target: Target
    hal: Hal
    access: Access | None = None
    emulator: Emulator | None = None
    operator: Operator | None = None

    def run(
        self,
        controller: Controller,
        *,
        until: Callable[[State], bool],
        record: Callable[[], None] = lambda: None,
        on_stop: Callable[[], None] | None = None,
    ) -> Statistics:
        """Run the control loop on the clock of the target. If the robot moved, the run ends in HOLD.

        On the wall clock, the process requests real-time priority and locked memory. After the first stop signal, the
        HAL rejects every START and changes to HOLD, and the run ends. Further signals do not interrupt this change. If
        `on_stop` is given, the first signal only calls `on_stop`, and the second signal leads to HOLD.

        Args:
            controller: Controller that computes the command of every cycle.
            until: End condition, called with the state after every cycle.
            record: Function called after every cycle to record it.
            on_stop: Function called at the first stop signal; must only set a flag. If None, the first signal ends the run.

        Returns:
            Statistics of the loop.

        Raises:
            Stopped: If a signal arrived before the run. The robot then did not move.
        """
        first = [] if on_stop is None else [on_stop]
        #: True after the signal that leads to HOLD. Not in every HOLD: `until` may observe whether a robot in HOLD falls.
        held = self.hal.ending

        def end() -> None:
            nonlocal held
            if first:
                first.pop()()
            else:
                held = True
                self.hal.end()

        def over(state: State) -> bool:
            # In HOLD, the end condition `until` may never become true, for example if it waits for a number of steps.
            return until(state) or (held and not self.hal.moving)

        with ended_by(end) as stop:
            stop.check()
            if self.target.lockstep:
                return run(self.hal, controller, LockStep(), until=over, record=record)
            for refused in realtime():
                print_message(refused)
            return run(self.hal, controller, WallClock(), until=over, record=record)


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
    mechanics: Mechanics | None = None,
    legs: LegModel | None = None,
) -> Iterator[Rig]:
    """Open the buses and create the HAL. For an embedded target, also create the emulated robot. Close them after the block.

    Args:
        target: Bus and clock.
        network: Nodes and messages. If None, they are read from the DBC of the project.
        robot: Robot parameters. If None, they are read from the robot file of the project.
        seed: Seed of the sensor noise of the embedded robot.
        pose: Initial joint angles of the embedded robot, shape (12,) [rad]. None means all zero.
        operator: Emulated operator of the embedded robot. None means an operator who presses START when the HAL is in READY.
        assistance_factor: Initial assistance factor Xi, 0 to 1.
        controller_fields: Name and size of each telemetry field of the controller.
        gait_hash: Hash of the gait that the HAL reports.
        tap: Recorder of all frames. If None, frames are not recorded.
        faults: Faults to inject into the embedded robot.
        robot_process: Subprocess for the embedded robot, which is closed after the block. Its operator presses START when the
            HAL is in READY. If None, the embedded robot runs in this process.
        mechanics: Engine, exoskeleton, wearer and ground of the embedded robot. None means an empty exoskeleton with default leg
            lengths that is suspended at its pelvis and simulated in the engine of the target.
        legs: Model of the legs for the HAL, see `Hal`.

    Raises:
        ValueError: If both `operator` and `robot_process` are given.
        FaultError: If the target or a signal of a fault is not in the network.
        BusError: If a bus cannot be opened, or another HAL uses it.
        ChannelMapError: If the channel map is invalid.
        Failed: If the physics engine of the embedded robot is not installed.
        Stopped: If a signal arrived before or during the start.
    """
    # A stop signal raises `Stopped`, but an imported module may have caught this exception. Then raise `Stopped` again.
    check_stop()
    network = network or atalante_dbc.load()
    robot = robot or load_robot()
    with ExitStack() as stack:
        emulator = None
        access: Access | None = None
        if robot_process is not None:
            stack.enter_context(robot_process)
            if operator is not None:
                raise ValueError(
                    f"operator must be None for a robot in a subprocess, got {operator!r}: the subprocess has its own operator"
                )
            robot_process.begin(SpawnConfig(network, robot, mechanics or _suspended(robot, target), pose, seed, faults))
            bus: Bus = robot_process.bus
            access = robot_process.access
        elif target.embedded:
            hal_end, robot_end = lockstep_pair()
            bus = hal_end
            mechanics = mechanics or _suspended(robot, target)
            body = stack.enter_context(open_mechanics(mechanics, pose))
            from atalante_emulator.emulator import Emulator
            from atalante_emulator.pendant import Operator

            operator = operator or Operator()
            emulator = Emulator(
                network, robot, body, robot_end,
                seed=seed, operator=operator, parameters=mechanics.node_parameters, faults=faults,
            )  # fmt: skip
            mechanics.complete(emulator)
            hal_end.step = emulator.poll
            access = LocalAccess(emulator, operator)
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
            legs=legs,
        )
        if robot_process is None and not target.embedded:
            hal.listen()
        check_stop()
        yield Rig(target, hal, access, emulator, operator if emulator else None)


def _suspended(robot: Robot, target: Target) -> Mechanics:
    from atalante_emulator.mechanics import Mechanics

    return Mechanics(describe(robot), target.engine)


def open_buses(network: Network, target: Target) -> dict[str, Bus]:
    """Open all buses of the network, and return them by name.

    Args:
        network: Network with the bus names.
        target: Interface and channel, or channel map.

    Raises:
        BusError: If a bus cannot be opened.
        ChannelMapError: If the channel map is invalid.
    """
    return open_channels(target.interface, parse_channel_map(target.channel, network.buses))


def join(network: Network, buses: dict[str, Bus]) -> Bus:
    """Combine the open buses into one bus object, which sends and receives on all of them.

    Args:
        network: Nodes and messages. Each message is assigned to a bus.
        buses: Bus name -> open bus. Several names may share one bus object.
    """
    first, *others = dict.fromkeys(buses.values())
    return JoinedBus(network, buses) if others else first


class Watch:
    """End condition of a run, called once per cycle. It also prints a progress line.

    A run ends when `done(state)` returns True while the robot is ACTIVE, when a signal arrives, or when the robot is in FAULT. If
    the robot leaves ACTIVE for another state, the run ends, too. With `resumes`, the run waits for START of the operator instead.
    After the run, `conclude` raises an error if the run ended before `done` returned True.
    """

    def __init__(
        self,
        rig: Rig,
        stop: StopRequest,
        done: Callable[[State], bool],
        describe: Callable[[State], str],
        *,
        resumes: bool = False,
    ) -> None:
        """Create the end condition of one run.

        Args:
            rig: Rig of the run.
            stop: Stop request of the process.
            done: Function that returns whether the run is complete; called in each cycle in ACTIVE.
            describe: Function that returns the progress line in ACTIVE.
            resumes: Whether the run continues when the operator presses START in HOLD. If False, HOLD ends the run.
        """
        self._rig, self._stop, self._done, self._describe = rig, stop, done, describe
        self._resumes = resumes
        self._progress = Progress()
        self._started = False
        self._finished = self._stopped = False
        self._state, self._reason = SupervisorState.OFF, ""

    def __call__(self, state: State) -> bool:
        """Return whether the run is over. Print the progress line if it is due.

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
                print_message(f"ACTIVE on {self._rig.target}; Ctrl-C ends in HOLD")
            over = self._finished = self._done(state)
        elif self._started and self._resumes and state.supervisor is not SupervisorState.FAULT:
            self._started = over = False
            self._progress.clear()
            print_message(f"{state.supervisor.name}: {self._rig.hal.reason}")
        else:
            over = self._started or state.supervisor is SupervisorState.FAULT
        if over:
            self._progress.clear()
            self._state, self._reason, self._stopped = state.supervisor, self._rig.hal.reason, self._stop.wanted
        elif self._progress.due():
            self._progress.show(self._describe(state) if active else waiting_for(self._rig))
        return over

    def conclude(self) -> None:
        """Raise an error if the run ended before the function `done` returned True.

        Raises:
            SystemExit: If a signal ended the run, or arrived after its end, with the exit code of the signal.
            FaultLatched: If the robot is in FAULT, also after a signal.
            Failed: If the robot left ACTIVE early without a signal.
        """
        if self._state is SupervisorState.FAULT:
            raise FaultLatched(f"the robot is in FAULT: {self._reason}")
        if not (self._finished or self._stopped):
            raise left_active(self._rig, self._reason)
        if self._stop.wanted:
            exit_after_signal(self._rig, self._stop)


def exit_after_signal(rig: Rig, stop: StopRequest) -> NoReturn:
    """Print the state of the robot, and end the command with the exit code of the stop signal.

    Args:
        rig: Rig of the run.
        stop: Stop request of the process.

    Raises:
        SystemExit: Always.
    """
    print_message(f"stopped, {final_state(rig)}")
    raise SystemExit(stop.exit_code)


def final_state(rig: Rig) -> str:
    """Return a text for the user with the state of the robot at the end of a run.

    While the bus is down, the state of the drives is unknown.

    Args:
        rig: Rig of the run.
    """
    if Dtc.BUS_DOWN in rig.hal.conditions.diagnostics:
        return UNCONFIRMED
    return f"the robot is in {rig.hal.state.supervisor.name}"


def left_active(rig: Rig, reason: str) -> Failed:
    """Return the error of a run in which the robot left ACTIVE early.

    Args:
        rig: Rig of the run.
        reason: Reason why the HAL went to HOLD.
    """
    if Dtc.BUS_DOWN in rig.hal.conditions.diagnostics:
        return Failed(f"the HAL went to HOLD: {reason}; {UNCONFIRMED}")
    return Failed(f"the robot went to HOLD: {reason}")


def waiting_for(rig: Rig) -> str:
    """Return a text for the user with the reason why the robot is not ACTIVE yet.

    If the user can change this with a command, the text contains the command.

    Args:
        rig: Rig of the run.
    """
    hal, target = rig.hal, rig.target
    if Dtc.BUS_DOWN in hal.conditions.diagnostics:
        return f"{hal.state.supervisor.name}: {hal.reason}"
    if hal.state.supervisor is SupervisorState.OFF:
        missing = hal.missing()
        if hal.silent:
            return (
                f"no node answers on {target}; to start an emulated robot, type `atalante emulator {target.arguments}`"
            )
        return f"waiting for {', '.join(missing)}" if missing else f"OFF: {hal.reason}"
    if hal.reason.startswith(REFUSED):
        return f"{hal.state.supervisor.name}: {hal.reason}"
    if missing := hal.missing():
        return f"{hal.state.supervisor.name}: waiting for {', '.join(missing)}"
    waits = f"{hal.state.supervisor.name}: waiting for START"
    return (
        f"{waits} of the emulated operator"
        if target.embedded
        else f"{waits}; type `atalante pendant start {target.arguments}`"
    )

"""Parts of the pytest fixtures: the bus with a robot, a HAL loop that runs cycle by cycle, and a recording of all frames.

An emulated robot runs in lock-step with the HAL. On a CAN interface, the emulated robot is polled before every
`receive` of the HAL.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np

from atalante_dbc import Network
from atalante_hal.bus import Bus, BusError, Stamps
from atalante_hal.bus.pair import PairBus, lockstep_pair
from atalante_hal.hal import Hal
from atalante_hal.loop import Clock
from atalante_hal.robot import Robot
from atalante_hal.telemetry.can_log import CanLog
from atalante_hal.types import PERIOD, Command, Controller, State, SupervisorState
from atalante_hal.wire.frame import Frames, new_frames
from atalante_tools.console.options import Target
from atalante_tools.session.body import open_body
from atalante_tools.session.pose_hold import PoseHold
from atalante_tools.session.rig import join, open_buses

if TYPE_CHECKING:
    from atalante_emulator.emulator import Emulator

#: Longest time for which the emulated robot waits for the frames of one cycle on a CAN interface [s].
_POLL: Final = 0.01
#: Time to listen on a CAN interface before the emulated robot uses it [s]. The interface is free if no frame arrives.
_QUIET: Final = 0.15
#: Largest number of frames in a recording (about 30 s).
KEPT: Final = 600_000
#: Interval between the time stamps of two consecutive frames of one cycle in a recording [ns].
_FRAME_NS: Final = 20_000


class BusInUse(BusError):  # noqa: N818
    """Raised if frames of another robot are on the bus, so that an emulated robot cannot use the bus."""


def open_bus(network: Network, target: Target, *, emulated: bool) -> tuple[Bus, Bus | None]:
    """Open the bus for the HAL. If the robot is emulated, open the bus for the robot, too.

    Args:
        network: nodes and messages of the DBC.
        target: interface and channels.
        emulated: whether the robot is emulated.

    Returns:
        Bus for the HAL, and bus for the emulated robot. For a real robot, the second bus is None.

    Raises:
        BusError: If the bus cannot be opened.
        BusInUse: If the robot is emulated but another robot sends frames on the bus.
    """
    if target.embedded:
        return lockstep_pair()
    hal_bus = join(network, open_buses(network, target))
    if not emulated:
        return hal_bus, None
    # The nodes of a real robot send heartbeats even if no HAL sends SYNC. So a received frame shows that a robot is connected.
    scratch = new_frames(1)
    if hal_bus.receive(scratch, _QUIET):
        hal_bus.close()
        raise BusInUse(
            f"{target} must carry no frames before the emulated robot starts, got frame {int(scratch['can_id'][0]):#x}. A real "
            "robot is probably connected. Run the tests with an emulated robot on another bus, and mark the tests of the real "
            "robot with @pytest.mark.hil."
        )
    return hal_bus, join(network, open_buses(network, target))


@contextmanager
def emulated_robot(network: Network, robot: Robot, robot_bus: Bus, engine: str) -> Iterator[Emulator]:
    """Create the emulated robot, with an operator who presses START when the HAL is READY.

    Args:
        network: nodes and messages of the DBC.
        robot: joint properties.
        robot_bus: bus of the robot.
        engine: name of the physics engine.
    """
    # Open the body before the imports. If the engine is not installed, `open_body` raises an error that names the package.
    with open_body(robot, engine=engine) as body:
        from atalante_emulator.emulator import Emulator
        from atalante_emulator.pendant import Operator

        yield Emulator(network, robot, body, robot_bus, operator=Operator())


def connect(hal_bus: Bus, emulator: Emulator) -> Callable[[], object] | None:
    """Connect the emulated robot to the bus of the HAL.

    Args:
        hal_bus: bus of the HAL.
        emulator: emulated robot that answers the HAL.

    Returns:
        Function to call before every receive of the HAL. None for a `PairBus`, which calls the emulator directly.
    """
    if isinstance(hal_bus, PairBus):
        hal_bus.step = emulator.poll
        return None
    return lambda: emulator.poll(_POLL)


class Stepper:
    """HAL loop that a test advances cycle by cycle. The default `controller` holds the pose in which the robot became ACTIVE."""

    def __init__(self, hal: Hal, clock: Clock) -> None:
        self.hal = hal
        self._clock = clock
        self.controller: Controller = PoseHold(hal.robot)
        self._active = False

    @property
    def state(self) -> State:
        """Return the state that the HAL read in the last cycle."""
        return self.hal.state

    @property
    def codes(self) -> list[str]:
        """Return the diagnostic code of each event that the HAL still keeps, at most `fault_memory.EVENTS_KEPT` codes."""
        return [event.code for event in self.hal.events]

    def cycle(self) -> State:
        """Run one cycle and return the state that the HAL read in this cycle."""
        self._clock.wait()
        state = self.hal.read()
        if self.hal.moving:
            if not self._active:
                self.controller.reset(state)
            command: Command = self.controller.update(state)
            self.hal.write(command)
            self._active = True
        else:
            self.hal.hold()
            self._active = False
        return state

    def run(self, cycles: int) -> State:
        """Run a number of cycles and return the last state of the HAL.

        Args:
            cycles: number of cycles.
        """
        for _ in range(cycles):
            self.cycle()
        return self.state

    def until(self, wanted: SupervisorState, cycles: int = 2000) -> State:
        """Run cycles until the HAL reaches a state, and return the last state.

        Args:
            wanted: state to wait for.
            cycles: largest number of cycles.

        Raises:
            AssertionError: If the state is not reached within `cycles`.
        """
        for _ in range(cycles):
            if self.cycle().supervisor is wanted:
                return self.state
        missing = ", ".join(self.hal.missing()) or "none"
        raise AssertionError(
            f"the HAL must be {wanted.name} within {cycles} cycles, got {self.state.supervisor.name}: {self.hal.reason}; "
            f"missing nodes: {missing}"
        )


class Recording:
    """`FrameTap` that records all frames between HAL and nodes, and keeps the last `KEPT` frames."""

    def __init__(self, network: Network) -> None:
        self._network = network
        self._batches: list[tuple[Frames, Stamps, bool]] = []
        self._count = 0
        self._cycle, self._in_cycle = 0, 0
        #: Function that returns the number of the current HAL cycle. The time stamps are computed from this number.
        self.cycle: Callable[[], int] = lambda: 0

    def sent(self, frames: Frames) -> None:
        """Record sent frames; see `FrameTap.sent`.

        Args:
            frames: frames of the HAL, shape (n,).
        """
        self._add(frames, sent=True)

    def received(self, frames: Frames, count: int) -> None:
        """Record received frames; see `FrameTap.received`.

        Args:
            frames: receive buffer.
            count: number of frames in the receive buffer.
        """
        self._add(frames[:count], sent=False)

    def _add(self, frames: Frames, *, sent: bool) -> None:
        cycle = self.cycle()
        if cycle != self._cycle:
            self._cycle, self._in_cycle = cycle, 0
        begin = round(cycle * PERIOD * 1e9) + self._in_cycle * _FRAME_NS
        self._in_cycle += len(frames)
        self._batches.append((frames.copy(), begin + _FRAME_NS * np.arange(len(frames), dtype=np.int64), sent))
        self._count += len(frames)
        while self._count > KEPT:
            self._count -= len(self._batches.pop(0)[0])

    def __len__(self) -> int:
        """Return the number of recorded frames."""
        return self._count

    def of(self, message: str) -> Frames:
        """Return the recorded frames of one message, oldest first, shape (n,).

        Args:
            message: name of the message.

        Raises:
            KeyError: If there is no such message.
        """
        frame_id = self._network.message(message).frame_id
        batches = [frames[frames["can_id"] == frame_id] for frames, _, _ in self._batches]
        return np.concatenate(batches) if batches else new_frames(0)

    def save(self, path: Path) -> Path:
        """Write the recording to a CAN log.

        Args:
            path: file to write; its suffix selects the format.

        Returns:
            The path.

        Raises:
            SinkError: If the file cannot be written.
        """
        network = self._network
        with CanLog(path, network.buses, {m.frame_id: m.bus for m in network.messages}) as log:
            for frames, stamps, sent in self._batches:
                log.write(frames, stamps, np.full(len(frames), sent, np.uint8))
        return path

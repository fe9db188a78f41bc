"""What the pytest plugin's fixtures are made of: a bus with the robot on it, the loop in steps, a recording.

With an emulated robot everything is in lock-step: on a wire it is polled whenever the HAL listens.
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
from atalante_hal.hal import PERIOD, Hal
from atalante_hal.loop import Clock
from atalante_hal.robot import Robot
from atalante_hal.telemetry.can_log import CanLog
from atalante_hal.types import Command, Controller, State, SupervisorState
from atalante_hal.wire.frame import Frames, new_frames
from atalante_tools.console.options import Target
from atalante_tools.session.body import open_body
from atalante_tools.session.pose_hold import PoseHold
from atalante_tools.session.rig import join, open_buses

if TYPE_CHECKING:
    from atalante_emulator.emulator import Emulator

#: How long the emulated robot listens on a wire for a cycle [s], and how long a wire must be quiet before it is put there.
_POLL: Final = 0.01
_QUIET: Final = 0.15
#: Frames a recording keeps: the last half minute or so.
KEPT: Final = 600_000
#: Time between two frames of a cycle in a recording of virtual time [ns].
_FRAME_NS: Final = 20_000


class WireTaken(BusError):  # noqa: N818
    """Somebody is on the bus an emulated robot was to be put on."""


def open_line(network: Network, target: Target, *, emulated: bool) -> tuple[Bus, Bus | None]:
    """The HAL's bus, and the end for an emulated robot unless a real one is there.

    Raises:
        BusError: the bus is not there.
        WireTaken: an emulated robot is wanted where somebody talks already.
    """
    if target.embedded:
        return lockstep_pair()
    ours = join(network, open_buses(network, target))
    if not emulated:
        return ours, None
    # A robot sends heartbeats whether it is asked or not.
    scratch = new_frames(1)
    if ours.receive(scratch, _QUIET):
        ours.close()
        raise WireTaken(
            f"somebody sends {int(scratch['can_id'][0]):#x} on {target}: a test that wants the robot that is there says "
            "@pytest.mark.hil, all others need a bus of their own"
        )
    return ours, join(network, open_buses(network, target))


@contextmanager
def emulated_robot(network: Network, robot: Robot, theirs: Bus) -> Iterator[Emulator]:
    """The emulated robot at its end, with an operator who starts it as soon as it is ready."""
    with open_body(robot) as body:  # says what to install where there is no PyBullet
        from atalante_emulator.emulator import Emulator
        from atalante_emulator.pendant import Operator

        yield Emulator(network, robot, body, theirs, operator=Operator())


def answering(ours: Bus, emulator: Emulator) -> Callable[[], object] | None:
    """What makes the emulated robot answer on a wire: to be called whenever the HAL listens. None: the pair does it itself."""
    if isinstance(ours, PairBus):
        ours.step = emulator.poll
        return None
    return lambda: emulator.poll(_POLL)


class Stepper:
    """The HAL's loop, some cycles at a time. Unless `controller` is another, the robot holds the pose it became active in."""

    def __init__(self, hal: Hal, clock: Clock) -> None:
        self.hal = hal
        self._clock = clock
        self.controller: Controller = PoseHold(hal.robot)
        self._active = False

    @property
    def state(self) -> State:
        """Of the last cycle."""
        return self.hal.state

    @property
    def codes(self) -> list[str]:
        """Return the diagnostic codes of the events so far, the newest `fault_memory.EVENTS_KEPT` of them."""
        return [event.code for event in self.hal.events]

    def cycle(self) -> State:
        """One cycle."""
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
        """Some cycles; the state of the last one."""
        for _ in range(cycles):
            self.cycle()
        return self.state

    def until(self, wanted: SupervisorState, cycles: int = 2000) -> State:
        """Cycles until the supervisor is in a state.

        Raises:
            AssertionError: it is not within `cycles`; says why.
        """
        for _ in range(cycles):
            if self.cycle().supervisor is wanted:
                return self.state
        missing = ", ".join(self.hal.missing()) or "none"
        raise AssertionError(
            f"not {wanted.name} after {cycles} cycles but {self.state.supervisor.name}: {self.hal.reason}; "
            f"missing nodes: {missing}"
        )


class Recording:
    """Every frame that passed between the HAL and the nodes (a `hal.FrameTap`); the oldest go when there are too many."""

    def __init__(self, network: Network) -> None:
        self._network = network
        self._batches: list[tuple[Frames, Stamps, bool]] = []
        self._count = 0
        self._cycle, self._in_cycle = 0, 0
        #: The HAL's cycle, from which frames have their time: that of the robot, not of the wall.
        self.cycle: Callable[[], int] = lambda: 0

    def sent(self, frames: Frames) -> None:
        """As `FrameTap.sent`."""
        self._add(frames, sent=True)

    def received(self, frames: Frames, count: int) -> None:
        """As `FrameTap.received`."""
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
        """Frames kept."""
        return self._count

    def of(self, message: str) -> Frames:
        """The frames of one message, oldest first. Shape (n,).

        Raises:
            KeyError: there is no such message.
        """
        frame_id = self._network.message(message).frame_id
        batches = [frames[frames["can_id"] == frame_id] for frames, _, _ in self._batches]
        return np.concatenate(batches) if batches else new_frames(0)

    def save(self, path: Path) -> Path:
        """Write a CAN log; the suffix says in what format.

        Raises:
            SinkError: it cannot be written.
        """
        network = self._network
        with CanLog(path, network.buses, {m.frame_id: m.bus for m in network.messages}) as log:
            for frames, stamps, sent in self._batches:
                log.write(frames, stamps, np.full(len(frames), sent, np.uint8))
        return path

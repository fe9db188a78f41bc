"""The embedded robot in a process of its own, so that its body moves while the HAL and the controller work.

    HAL <- SharedBus -> python -m atalante_tools.session.embedded: emulator -> body

The child is a fresh interpreter, in a process group of its own: the terminal's Ctrl-C goes to the loop, which ends in HOLD and
then closes the bus. Whichever side dies, the other notices by the bus, and nothing is left behind.

The two never share a core: each waits for the other in turn, and a system that thinks they belong together puts them on one,
where they go several times slower and stay.
"""

from __future__ import annotations

import os
import pickle
import subprocess
import sys
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

from atalante_dbc import Network
from atalante_hal.bus import BusDown
from atalante_hal.bus.shared import SharedBus, descriptors
from atalante_hal.closing import Closing
from atalante_hal.robot import Robot
from atalante_tools.console.outcome import Failed
from atalante_tools.session.body import require_engine

if TYPE_CHECKING:
    from atalante_emulator.faults import Fault

#: Longest wait for an answer to a SYNC, until the robot is there, and until it has gone [s].
_PATIENCE, _START, _END = 2.0, 60.0, 5.0


@dataclass(frozen=True)
class SpawnConfig:
    """The robot that is wanted."""

    network: Network
    robot: Robot
    urdf: str
    pose: Sequence[float] | None  # rad, shape (12,)
    seed: int
    faults: Sequence[Fault]


class EmbeddedRobot(Closing):
    """The child, and `bus`, the HAL's end of the bus to it; as a context manager it is there for the block.

    Starting it early is worth while: until `begin` it loads what it needs.
    """

    _open: ClassVar[list[EmbeddedRobot]] = []
    _cores: ClassVar[set[int]] = set()  # of this thread, before the first of those that are open

    def __init__(self) -> None:
        """Start the child.

        Raises:
            Failed: PyBullet is not installed.
        """
        require_engine()
        memory, ours, theirs = descriptors()
        self._child = subprocess.Popen(
            [sys.executable, "-P", "-m", "atalante_tools.session.embedded", str(memory), str(theirs)],
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            pass_fds=(memory, theirs),
            process_group=0,
        )
        self._begun = False
        os.close(theirs)  # or its end would stay open when it dies
        self.bus = SharedBus("embedded", memory, ours, 0)
        self.bus.patience = _PATIENCE
        self._part_from_child()

    def _part_from_child(self) -> None:
        """Give the child cores of its own, shared with other robots that are open: the next loads while the last walks."""
        if not self._open:
            EmbeddedRobot._cores = os.sched_getaffinity(0)
        self._open.append(self)
        kept, given = halves(self._cores)
        os.sched_setaffinity(self._child.pid, given)
        os.sched_setaffinity(0, kept)

    @property
    def pid(self) -> int:
        """Of the child."""
        return self._child.pid

    def begin(self, order: SpawnConfig) -> None:
        """Make the robot.

        Raises:
            Failed: it cannot be made; the message says why.
        """
        pipe = self._child.stdin
        assert pipe is not None
        self._begun = True
        # Should the child have died, the bus says so.
        with suppress(BrokenPipeError), pipe:
            pickle.dump(order, pipe)
        try:
            self.bus.meet(_START)
        except BusDown as error:
            raise Failed(str(error)) from error

    def close(self) -> None:
        """Close the bus and see the child off; a second call does nothing. By the thread that made it."""
        self.bus.close()
        if self in self._open:
            self._open.remove(self)
            if not self._open:
                os.sched_setaffinity(0, self._cores)
        if not self._begun:
            self._child.kill()  # it is of no use, and nobody waits until it has loaded everything
        try:
            self._child.wait(_END)
        except subprocess.TimeoutExpired:
            self._child.kill()
            self._child.wait()
        if self._child.stdin is not None:
            self._child.stdin.close()


def halves(cores: set[int]) -> tuple[set[int], set[int]]:
    """The cores of this thread and of the child, both all of them where there is but one; the odd one is this thread's."""
    place = (len(cores) + 1) // 2
    first, others = set(sorted(cores)[:place]), set(sorted(cores)[place:])
    return first, others or first

"""Embedded robot in a subprocess, so that its physics runs in parallel with the HAL and the controller.

    HAL <- SharedBus -> python -m atalante_tools.session.embedded: emulator -> body

The child is a new interpreter in a separate process group. Ctrl-C therefore reaches only the parent, whose loop ends in HOLD and
then closes the bus. If either process ends, the other detects it on the bus and ends too.

The two processes run on different cores. They wait for each other in turn, so the scheduler of the system would otherwise put
both on one core, where they run several times slower.
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

#: Longest wait for the answer to a SYNC, for the start of the robot, and for the end of the child [s].
_PATIENCE, _START, _END = 2.0, 60.0, 5.0


@dataclass(frozen=True)
class SpawnConfig:
    """Description of the robot that the child creates; sent through its stdin."""

    network: Network
    robot: Robot
    urdf: str
    pose: Sequence[float] | None  # initial joint angles, shape (12,), rad; None: all zero
    seed: int
    faults: Sequence[Fault]


class EmbeddedRobot(Closing):
    """Subprocess with the embedded robot; a context manager that closes it after the block.

    Create it early, because the child imports its modules while the parent prepares the run.

    Attributes:
        bus: End of the HAL on the bus to the child.
    """

    _open: ClassVar[list[EmbeddedRobot]] = []
    _cores: ClassVar[set[int]] = set()  # cores of this thread before the first open robot

    def __init__(self) -> None:
        """Start the child.

        Raises:
            Failed: If PyBullet is not installed.
        """
        require_engine()
        memory, parent_bell, child_bell = descriptors()
        self._child = subprocess.Popen(
            [sys.executable, "-P", "-m", "atalante_tools.session.embedded", str(memory), str(child_bell)],
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            pass_fds=(memory, child_bell),
            process_group=0,
        )
        self._begun = False
        os.close(child_bell)  # with a copy left open here, the end of the child could not be detected
        self.bus = SharedBus("embedded", memory, parent_bell, 0)
        self.bus.patience = _PATIENCE
        self._part_from_child()

    def _part_from_child(self) -> None:
        """Assign different cores to this thread and the child. All open robots share the cores of the children."""
        if not self._open:
            EmbeddedRobot._cores = os.sched_getaffinity(0)
        self._open.append(self)
        own_cores, child_cores = halves(self._cores)
        os.sched_setaffinity(self._child.pid, child_cores)
        os.sched_setaffinity(0, own_cores)

    @property
    def pid(self) -> int:
        """Return the process identifier of the child."""
        return self._child.pid

    def begin(self, order: SpawnConfig) -> None:
        """Send the description to the child, and wait until the robot exists.

        Args:
            order: Robot to create.

        Raises:
            Failed: If the child cannot create the robot; the message contains the reason.
        """
        pipe = self._child.stdin
        assert pipe is not None
        self._begun = True
        # If the child has already ended, ignore the broken pipe: `meet` below raises `BusDown` with the reason.
        with suppress(BrokenPipeError), pipe:
            pickle.dump(order, pipe)
        try:
            self.bus.meet(_START)
        except BusDown as error:
            raise Failed(str(error)) from error

    def close(self) -> None:
        """Close the bus and wait for the end of the child. A second call does nothing.

        Call it from the thread that created this object, because it restores the cores of that thread.
        """
        self.bus.close()
        if self in self._open:
            self._open.remove(self)
            if not self._open:
                os.sched_setaffinity(0, self._cores)
        if not self._begun:
            self._child.kill()  # without a robot the child is still importing, and waiting for it is useless
        try:
            self._child.wait(_END)
        except subprocess.TimeoutExpired:
            self._child.kill()
            self._child.wait()
        if self._child.stdin is not None:
            self._child.stdin.close()


def halves(cores: set[int]) -> tuple[set[int], set[int]]:
    """Split processor cores between this thread and the child.

    Args:
        cores: Available cores.

    Returns:
        Cores of this thread (the larger half) and cores of the child. Both are the same core if there is only one.
    """
    count = (len(cores) + 1) // 2
    first, others = set(sorted(cores)[:count]), set(sorted(cores)[count:])
    return first, others or first

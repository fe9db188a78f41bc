"""Embedded robot in a subprocess. The physics of the robot runs in parallel with the HAL and the controller.

    HAL       <-> SharedBus <-> emulator and body (python -m atalante_tools.session.embedded)
    operator  <-> RemoteAccess, ServedAccess <-> pushes, dial, true motion

The subprocess ("child") is a new Python interpreter in a separate process group. Ctrl-C therefore reaches only the parent. The
loop of the parent ends in HOLD and then closes the bus. If one process ends, the other process detects it on the bus and ends.

The two processes are assigned to different cores. Otherwise the scheduler of Linux puts both on one core, because they wait
for each other. Then both run several times slower.
"""

from __future__ import annotations

import os
import pickle
import subprocess
import sys
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

from atalante_dbc import Network
from atalante_hal.bus import BusDown
from atalante_hal.bus.shared import SharedBus, descriptors
from atalante_hal.closing import Closing
from atalante_hal.robot import Robot
from atalante_tools.console.options import PYBULLET, Target
from atalante_tools.console.outcome import Failed
from atalante_tools.session.body import require_engine
from atalante_tools.session.embedded.access import RemoteAccess, access_memory

if TYPE_CHECKING:
    from atalante_emulator.faults import Fault
    from atalante_emulator.mechanics import Mechanics

#: `_PATIENCE` is the longest wait for the answer to a SYNC [s].
#: `_START` is the longest wait for the creation of the robot [s].
#: `_END` is the longest wait for the end of the child after the bus is closed [s].
_PATIENCE, _START, _END = 2.0, 60.0, 5.0
#: `_LOAD` is the file with the load of the computer. The load is read `_LOAD_SAMPLES` times, every `_LOAD_INTERVAL` [s].
_LOAD, _LOAD_SAMPLES, _LOAD_INTERVAL = Path("/proc/loadavg"), 5, 2e-3


@dataclass(frozen=True)
class SpawnConfig:
    """Description from which the child process creates the robot. The child reads this description from its stdin."""

    network: Network
    robot: Robot
    mechanics: Mechanics
    pose: Sequence[float] | None  # initial joint angles, shape (12,) [rad]. None means all zero.
    seed: int
    faults: Sequence[Fault]


class EmbeddedRobot(Closing):
    """Subprocess with the embedded robot. Used as a context manager, this object closes itself after the block.

    Create this object early, because the child then imports its modules while the parent prepares the run.

    Attributes:
        bus: HAL side of the bus to the child.
        access: Access to the robot that bypasses the bus.
    """

    _open: ClassVar[list[EmbeddedRobot]] = []
    _cores: ClassVar[set[int]] = set()  # cores on which this thread was allowed to run before the first child started

    def __init__(self, engine: str = PYBULLET) -> None:
        """Start the child process.

        Args:
            engine: Name of the physics engine, the same as in the `SpawnConfig`.

        Raises:
            Failed: If the engine is not installed.
        """
        require_engine(engine)
        memory, parent_socket, child_socket = descriptors()
        access = access_memory()
        self._child = subprocess.Popen(
            [
                sys.executable,
                "-P",
                "-m",
                "atalante_tools.session.embedded",
                str(memory),
                str(child_socket),
                str(access),
            ],
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            pass_fds=(memory, child_socket, access),
            process_group=0,
        )
        self._begun = False
        # Close the child's socket in this process; the child has its own copy. An open copy would hide the end of the child.
        os.close(child_socket)
        self.bus = SharedBus("embedded", memory, parent_socket, 0)
        self.bus.patience = _PATIENCE
        self.access = RemoteAccess(self.bus, access)
        self._part_from_child()

    def _part_from_child(self) -> None:
        """Assign different processor cores to this thread and to the child. All children share the same cores."""
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

    def begin(self, config: SpawnConfig) -> None:
        """Send the description of the robot to the child, and wait until the child has created the robot.

        Args:
            config: Description of the robot to create.

        Raises:
            Failed: If the child cannot create the robot. The message contains the reason.
        """
        pipe = self._child.stdin
        assert pipe is not None
        self._begun = True
        # The pipe is broken if the child has already ended. Then `wait_until_served` raises `BusDown` with the reason.
        with suppress(BrokenPipeError), pipe:
            pickle.dump(config, pipe)
        try:
            self.bus.wait_until_served(_START)
        except BusDown as error:
            raise Failed(str(error)) from error

    def close(self) -> None:
        """Close the bus and wait for the end of the child. A second call has no effect.

        Only the thread that created this object may call this method, because the method restores the cores of this thread.
        """
        self.bus.close()
        if self in self._open:
            self._open.remove(self)
            if not self._open:
                os.sched_setaffinity(0, self._cores)
        if not self._begun:
            self._child.kill()  # the child has not created the robot yet, so it can be ended immediately
        try:
            self._child.wait(_END)
        except subprocess.TimeoutExpired:
            self._child.kill()
            self._child.wait()
        if self._child.stdin is not None:
            self._child.stdin.close()


def robot_process_wanted(target: Target, others: int, chosen: bool | None = None) -> bool:
    """Return whether an emulated robot gets its own process.

    Call this before other processes of the run start, because these processes keep cores busy.

    Args:
        target: Bus and clock. Only an embedded robot can get its own process.
        others: Number of other processes, see `cores_are_idle`.
        chosen: Choice of the user. With None, the number of idle cores decides.
    """
    return target.embedded and (cores_are_idle(others) if chosen is None else chosen)


def cores_are_idle(others: int, load: Path = _LOAD) -> bool:
    """Return whether the computer has enough idle processor cores for all processes of the run.

    This process already uses one core for the HAL. The robot needs one idle core, and each further process needs one, too.

    On a busy computer two processes that wait for each other are slower than one process, because the scheduler runs other
    programs in between.

    Args:
        others: Number of other processes that will run during the whole run, such as the telemetry process.
        load: File of Linux with the number of threads that run or wait for a core.
    """
    if len(os.sched_getaffinity(0)) < 2 + others:
        return False
    samples = []
    for _ in range(_LOAD_SAMPLES):
        try:
            samples.append(int(load.read_text().split()[3].partition("/")[0]))
        except (OSError, IndexError, ValueError):
            return True  # if the load cannot be read, the cores are assumed to be idle
        time.sleep(_LOAD_INTERVAL)
    busy = max(1, min(samples))  # smallest number of running threads over all samples; this thread is counted, too
    return (os.cpu_count() or 1) - busy >= 1 + others


def halves(cores: set[int]) -> tuple[set[int], set[int]]:
    """Divide processor cores between this thread and the child.

    Args:
        cores: Numbers of the available cores.

    Returns:
        Cores of this thread (the larger half) and cores of the child. If there is only one core, both get this core.
    """
    count = (len(cores) + 1) // 2
    first, others = set(sorted(cores)[:count]), set(sorted(cores)[count:])
    return first, others or first

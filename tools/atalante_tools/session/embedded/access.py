"""Access to an emulated robot that bypasses the bus: push its pelvis, turn the assistance dial, and read its true motion.

    push, dial -> emulated robot -> true attitude of the pelvis, true position of the feet

`LocalAccess` accesses an emulator in this process. `RemoteAccess` accesses an emulator in a subprocess through shared memory,
whose other end is a `ServedAccess`. Both kinds of access act in the same cycles, so the bytes on the bus are the same.
"""

from __future__ import annotations

import math
import mmap
import os
from collections.abc import Callable
from typing import TYPE_CHECKING, Final, NamedTuple, Protocol

import numpy as np

from atalante_hal.bus.shared import SharedBus
from atalante_hal.memory import anonymous_file
from atalante_hal.robot import IMUS
from atalante_hal.types import Vector

if TYPE_CHECKING:
    from atalante_emulator.emulator import Emulator
    from atalante_emulator.pendant import Operator

#: Index of the pelvis IMU in `IMUS`.
_PELVIS: Final = IMUS.index("pelvis")
#: Requests to the emulator (values of `_Shared.question`): run a cycle, return the true attitude, or return the true stance.
_CYCLE, _ATTITUDE, _STANCE = 0.0, 1.0, 2.0
#: Number of values in the memory that both processes share.
_SIZE: Final = 14


class Stance(NamedTuple):
    """True position of the robot on the ground."""

    x: float  # x of the point midway between the feet, in world axes [m]
    y: float  # y of the point midway between the feet, in world axes [m]
    yaw: float  # mean heading of both feet: angle from the world x axis, positive to the left [rad]


class Access(Protocol):
    """Access to an emulated robot that bypasses the bus: push its pelvis, turn the assistance dial, read its true motion."""

    def push(self, wrench: Callable[[], Vector]) -> None:
        """Push the pelvis in every cycle from now on, with the wrench that the function `wrench` returns.

        Args:
            wrench: Function that returns force [N] and moment [Nm] on the pelvis, in world axes, shape (6,). The
                function is called after the HAL has begun a cycle and before the body moves, at least once per cycle.
        """

    def assist(self, factor: float | None) -> None:
        """Turn the assistance dial of the emulated operator.

        Args:
            factor: Assistance factor Xi, 0 to 1. With None, the factor of the HAL stays unchanged.
        """

    def attitude(self) -> tuple[float, float, float, float]:
        """Return the true attitude of the pelvis after the last cycle, as quaternion xyzw from pelvis to world axes."""

    def stance(self) -> Stance:
        """Return the true position of the feet after the last cycle."""


class LocalAccess:
    """Access to an emulator in this process."""

    def __init__(self, emulator: Emulator, operator: Operator) -> None:
        """Connect to the emulator.

        Args:
            emulator: Emulator of the robot.
            operator: Operator who turns the assistance dial.
        """
        self._emulator, self._operator = emulator, operator

    def push(self, wrench: Callable[[], Vector]) -> None:
        """Push the pelvis, see `Access.push`."""
        self._emulator.pelvis_forces.append(lambda _hal_state: wrench())

    def assist(self, factor: float | None) -> None:
        """Turn the assistance dial, see `Access.assist`."""
        self._operator.assist(factor)

    def attitude(self) -> tuple[float, float, float, float]:
        """Return the true attitude of the pelvis, see `Access.attitude`."""
        # The axes of the pelvis IMU are parallel to the axes of the pelvis.
        x, y, z, w = self._emulator.body.imu[_PELVIS, :4].tolist()
        return x, y, z, w

    def stance(self) -> Stance:
        """Return the true position of the feet, see `Access.stance`."""
        from atalante_emulator.bodies.links import FOOT_LINKS

        x = y = ahead = left = 0.0
        for link in FOOT_LINKS:
            motion = self._emulator.body.motion(link)
            i, j, k, w = motion.attitude.tolist()
            x, y = x + 0.5 * float(motion.position[0]), y + 0.5 * float(motion.position[1])
            ahead, left = ahead + 1.0 - 2.0 * (j * j + k * k), left + 2.0 * (i * j + w * k)
        return Stance(x, y, math.atan2(left, ahead))


class _Shared(NamedTuple):
    """Fields of the memory that both processes share. Each field is a view of this memory.

    Before the HAL requests a step (`SharedBus.run_step`), it writes all fields except `answer`. The emulator reads these fields
    at the start of the step, and writes `answer` before the end of the step. As on a `SharedBus`, stores must become visible in
    program order.
    """

    question: Vector  # request to the emulator: `_CYCLE`, `_ATTITUDE` or `_STANCE`, shape (1,)
    #: Number of calls of `assist` so far, and assistance factor of the last call, shape (2,).
    #: If the factor is NaN, the assistance factor of the HAL stays unchanged.
    dial: Vector
    pushes: Vector  # 1 if the pelvis is pushed, otherwise 0, shape (1,)
    wrench: Vector  # force [N] and moment [Nm] on the pelvis, shape (6,)
    #: answer to `_ATTITUDE`: quaternion xyzw of the pelvis; answer to `_STANCE`: x [m], y [m], yaw [rad], unused; shape (4,)
    answer: Vector


def access_memory() -> int:
    """Create the memory of a `RemoteAccess` and its `ServedAccess`. Return the file descriptor of the memory."""
    return anonymous_file("atalante-access", np.dtype(np.float64).itemsize * _SIZE)


def _attach(memory: int) -> _Shared:
    """Return views of the memory, and close the file descriptor. The memory is released with the views."""
    values = np.frombuffer(mmap.mmap(memory, 0), np.float64)
    os.close(memory)
    return _Shared(values[:1], values[1:3], values[3:4], values[4:10], values[10:_SIZE])


class RemoteAccess:
    """Access to an emulator in a subprocess, at the other end of a `SharedBus`."""

    def __init__(self, bus: SharedBus, memory: int) -> None:
        """Attach to the memory that both processes share.

        Args:
            bus: Bus to the subprocess. This process is the client.
            memory: File descriptor of `access_memory`. This object closes it.
        """
        self._bus, self._shared = bus, _attach(memory)

    def push(self, wrench: Callable[[], Vector]) -> None:
        """Push the pelvis, see `Access.push`."""
        output = self._shared.wrench

        def write() -> None:
            output[:] = wrench()

        self._shared.pushes[0] = 1.0
        self._bus.before_request = write

    def assist(self, factor: float | None) -> None:
        """Turn the assistance dial, see `Access.assist`."""
        dial = self._shared.dial
        dial[0], dial[1] = dial[0] + 1.0, math.nan if factor is None else factor

    def attitude(self) -> tuple[float, float, float, float]:
        """Return the true attitude of the pelvis, see `Access.attitude`. Block until the emulator has answered."""
        x, y, z, w = self._ask(_ATTITUDE)
        return x, y, z, w

    def stance(self) -> Stance:
        """Return the true position of the feet, see `Access.stance`. Block until the emulator has answered."""
        return Stance(*self._ask(_STANCE)[:3])

    def _ask(self, question: float) -> list[float]:
        shared = self._shared
        shared.question[0] = question
        try:
            self._bus.run_step()
        finally:
            shared.question[0] = _CYCLE
        answer: list[float] = shared.answer.tolist()
        return answer


class ServedAccess:
    """Server in the process of the emulator: executes the requests that the HAL process sends with its `RemoteAccess`."""

    def __init__(self, memory: int, emulator: Emulator, operator: Operator) -> None:
        """Attach to the memory that both processes share.

        Args:
            memory: File descriptor of `access_memory`. This object closes it.
            emulator: Emulator of the robot.
            operator: Operator who turns the assistance dial.
        """
        self._shared, self._emulator = _attach(memory), emulator
        self._local = LocalAccess(emulator, operator)
        self._turns, self._pushed, self._wrench = 0.0, False, np.zeros(6)

    def step(self) -> None:
        """Process a request of the HAL process.

        If the request is a question, answer with the true attitude or stance. Otherwise apply dial and wrench, and run one cycle.
        """
        shared = self._shared
        question = shared.question[0]
        if question == _ATTITUDE:
            shared.answer[:] = self._local.attitude()
        elif question == _STANCE:
            shared.answer[:3] = self._local.stance()
        else:
            self._apply()
            self._emulator.poll()

    def _apply(self) -> None:
        """Apply the dial and the wrench that the HAL wrote to the shared memory.

        The wrench is copied, because the HAL may write a new wrench while the emulator still runs the cycle.
        """
        shared = self._shared
        turns, factor = shared.dial.tolist()
        if turns != self._turns:
            self._turns = turns
            self._local.assist(None if math.isnan(factor) else factor)
        if shared.pushes[0]:
            self._wrench[:] = shared.wrench
            if not self._pushed:
                self._pushed = True
                self._local.push(lambda: self._wrench)

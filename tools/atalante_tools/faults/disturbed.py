"""Faults of the host: wrappers of controller, clock and bus that fail in chosen cycles."""

from __future__ import annotations

import builtins
from collections.abc import Sequence
from typing import Final

import numpy as np

from atalante_hal.bus import Bus, BusDown, BusFull
from atalante_hal.bus.wrapped import WrappedBus
from atalante_hal.robot import JOINTS
from atalante_hal.types import PERIOD, Command, Controller, State, Vector
from atalante_hal.wire.frame import Frames
from atalante_tools.faults.scenario import Host

#: Selection of the joint that the fault `shake` acts on; the left hip is heavy enough to stay in place.
_HIP: Final = np.array([joint == "left_SH" for joint in JOINTS], np.float64)


class Moment:
    """Timing of the host faults of a case, in HAL cycles."""

    def __init__(self, faults: Sequence[Host], begins: int) -> None:
        self._faults, self._begins = faults, begins
        self.cycle = 0  # present cycle, set by the owner
        #: First cycle in which a fault acted; None: not yet.
        self.struck: int | None = None

    def of(self, *kinds: str) -> Host | None:
        """Return the active fault of one of these kinds, None if there is none.

        Args:
            *kinds: kinds of `Host` faults.
        """
        since = self.cycle - self._begins
        for fault in self._faults:
            over = fault.cycles is not None and since >= fault.start + fault.cycles
            if fault.kind in kinds and since >= fault.start and not over:
                if self.struck is None:
                    self.struck = since + self._begins
                return fault
        return None


class DisturbedController:
    """Controller with the faults `raise`, `raise_in_reset`, `ask`, `shake` and `shape`."""

    def __init__(self, controller: Controller, now: Moment) -> None:
        self._controller, self._now = controller, now
        self.telemetry_fields = controller.telemetry_fields

    @property
    def telemetry(self) -> Vector:
        """Telemetry of the wrapped controller."""
        return self._controller.telemetry

    def reset(self, state: State) -> None:
        """Reset the wrapped controller, or raise.

        Args:
            state: state of the HAL.
        """
        self._controller.reset(state)
        self._raise(self._now.of("raise_in_reset"))

    def update(self, state: State) -> Command:
        """Return the command of the wrapped controller or a wrong one, or raise.

        Args:
            state: state of the HAL.
        """
        command = self._controller.update(state)
        self._raise(self._now.of("raise"))
        wrong = self._now.of("ask", "shake", "shape")
        if wrong is None:
            return command
        if wrong.kind == "shake":
            return Command(command.torque + _HIP * float(wrong.value) * (-1.0) ** state.cycle, command.vibration)
        if wrong.kind == "shape":
            return Command(np.zeros(int(wrong.value)), command.vibration)
        return Command(np.full(len(JOINTS), float(wrong.value)), command.vibration)

    @staticmethod
    def _raise(fault: Host | None) -> None:
        if fault is not None:
            raise getattr(builtins, str(fault.value))("injected fault of the controller")


class DisturbedClock:
    """Lock-step clock with the faults `late` and `slow`."""

    def __init__(self, now: Moment) -> None:
        self._now = now
        self._behind = 0.0  # s, delay of a slow loop against its deadlines

    def wait(self) -> float:
        """Return how late the cycle begins [s], as `WallClock.wait` would."""
        asked = self._now.of("late", "slow")
        if asked is None:
            self._behind = 0.0
            return 0.0
        if asked.kind == "late":
            return float(asked.value)
        self._behind += float(asked.value) - PERIOD
        late = self._behind
        if late > PERIOD:
            self._behind = 0.0
        return late


class DisturbedBus(WrappedBus):
    """HAL's end of the bus with the faults `bus_down` and `bus_full`."""

    def __init__(self, bus: Bus, now: Moment) -> None:
        super().__init__(bus)
        self._now = now

    def send(self, frames: Frames) -> None:
        """Send frames, or raise.

        Args:
            frames: frames to send, shape (n,).

        Raises:
            BusDown: If the fault `bus_down` is active.
            BusFull: If the fault `bus_full` is active.
        """
        refused = self._now.of("bus_down", "bus_full")
        if refused is None:
            super().send(frames)
        elif refused.kind == "bus_down":
            raise BusDown("injected fault: the interface is down")
        else:
            raise BusFull("injected fault: the transmit queue is full")

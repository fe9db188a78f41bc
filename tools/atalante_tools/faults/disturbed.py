"""Injection of host faults: wrappers that make the controller, clock or bus of the HAL fail in chosen cycles."""

from __future__ import annotations

import builtins
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Final

import numpy as np

from atalante_emulator.faults import Fault
from atalante_hal.bus import Bus, BusDown, BusFull
from atalante_hal.bus.wrapped import WrappedBus
from atalante_hal.robot import JOINTS
from atalante_hal.types import PERIOD, Command, Controller, State, Vector
from atalante_hal.wire.frame import Frames
from atalante_tools.faults.scenario import HostFault, OperatorAction, Stimulus

if TYPE_CHECKING:
    from atalante_emulator.pendant import Operator

#: Mask of the joint that the fault `shake` disturbs, shape (12,): 1 for the left sagittal hip, 0 for all other joints.
_HIP: Final = np.array([joint == "left_SH" for joint in JOINTS], np.float64)
#: Torque request of the fault `full_torque`, above the torque limit of every joint [Nm].
_TOO_MUCH: Final = 1e3


class HostFaults:
    """Faults of the computer that runs the HAL (such as a late cycle), and the HAL cycles in which each fault is active."""

    def __init__(self, faults: Sequence[HostFault], begins: int) -> None:
        self.schedule(faults, begins)
        self.cycle = 0  # current HAL cycle, set by the runner
        #: First HAL cycle in which a fault was active; None if no fault was active yet.
        self.first_active: int | None = None

    def schedule(self, faults: Sequence[HostFault], begins: int) -> None:
        """Replace all faults with new faults.

        Args:
            faults: new faults. Their `start` counts from `begins`.
            begins: HAL cycle in which the case begins.
        """
        self._faults, self._begins = faults, begins

    def of(self, *kinds: str) -> HostFault | None:
        """Return the first active fault of one of the given kinds, or None.

        Args:
            *kinds: accepted values of `HostFault.kind`.
        """
        since = self.cycle - self._begins
        for fault in self._faults:
            over = fault.cycles is not None and since >= fault.start + fault.cycles
            if fault.kind in kinds and since >= fault.start and not over:
                if self.first_active is None:
                    self.first_active = since + self._begins
                return fault
        return None


class TimedStimuli:
    """Faults and operator actions of a case that begins in a given HAL cycle.

    Attributes:
        faults: faults of the emulated robot. Their `start` counts in cycles of the robot.
        host_faults: faults of the computer that runs the HAL.
        presses: actions of the operator, by HAL cycle. More actions can be added.
    """

    def __init__(self, stimuli: Sequence[Stimulus], begins: int) -> None:
        """Schedule the faults and actions of a case.

        Args:
            stimuli: faults and operator actions. Their `start` counts from the start of the case.
            begins: HAL cycle in which the case begins, from 1.
        """
        self.presses: defaultdict[int, list[str]] = defaultdict(list)
        self.host_faults = HostFaults((), begins)
        self.schedule(stimuli, begins)

    def schedule(self, stimuli: Sequence[Stimulus], begins: int) -> None:
        """Replace all faults with new faults. Add operator actions to the existing actions.

        Args:
            stimuli: faults and operator actions. Their `start` counts from `begins`.
            begins: HAL cycle in which the case begins, from 1.
        """
        self.faults = [one.starting(begins - 1 + one.start) for one in stimuli if isinstance(one, Fault)]
        self.host_faults.schedule([one for one in stimuli if isinstance(one, HostFault)], begins)
        for one in stimuli:
            if isinstance(one, OperatorAction):
                self.presses[begins + one.start].append(one.kind)

    def prepare(self, cycle: int, operator: Operator) -> None:
        """Set the number of the next cycle, and execute the operator actions of the next cycle.

        Args:
            cycle: number of the next HAL cycle.
            operator: operator of the emulated pendant.
        """
        self.host_faults.cycle = cycle
        for press in self.presses.get(cycle, ()):
            getattr(operator, press)()


class DisturbedController:
    """Controller that injects the faults `raise`, `raise_in_reset`, `request`, `full_torque`, `shake` and `shape`."""

    def __init__(self, controller: Controller, now: HostFaults) -> None:
        self._controller, self._now = controller, now
        self.telemetry_fields = controller.telemetry_fields

    @property
    def telemetry(self) -> Vector:
        """Return the telemetry of the wrapped controller."""
        return self._controller.telemetry

    def reset(self, state: State) -> None:
        """Reset the wrapped controller, then raise an exception if `raise_in_reset` is active.

        Args:
            state: state of the HAL.
        """
        self._controller.reset(state)
        self._raise(self._now.of("raise_in_reset"))

    def update(self, state: State) -> Command:
        """Return the command of the wrapped controller. During a fault, return wrong torques or raise an exception.

        Only the torques are wrong. The other fields are those of the wrapped controller, because they tell the HAL whether the
        robot walks, in which step, and whether a joint is outside its guide.

        Args:
            state: state of the HAL.
        """
        command = self._controller.update(state)
        self._raise(self._now.of("raise"))
        wrong = self._now.of("request", "full_torque", "shake", "shape")
        if wrong is None:
            return command
        if wrong.kind == "shake":
            return replace(command, torque=command.torque + _HIP * float(wrong.value) * (-1.0) ** state.cycle)
        if wrong.kind == "full_torque":
            joint = str(wrong.value).lstrip("-")
            torque = command.torque.copy()
            torque[JOINTS.index(joint)] = -_TOO_MUCH if str(wrong.value).startswith("-") else _TOO_MUCH
            return replace(command, torque=torque)
        if wrong.kind == "shape":
            return replace(command, torque=np.zeros(int(wrong.value)))
        return replace(command, torque=np.full(len(JOINTS), float(wrong.value)))

    @staticmethod
    def _raise(fault: HostFault | None) -> None:
        if fault is not None:
            raise getattr(builtins, str(fault.value))("injected fault of the controller")


class DisturbedClock:
    """Clock of the HAL loop that injects the faults `late` (a cycle begins late) and `slow` (a cycle takes too long).

    The clock only reports delays to the HAL. No real time passes.
    """

    def __init__(self, now: HostFaults) -> None:
        self._now = now
        self._behind = 0.0  # accumulated delay of the loop during the fault `slow` [s]

    def wait(self) -> float:
        """Return the time from the deadline to the start of the cycle [s], as `WallClock.wait` does."""
        fault = self._now.of("late", "slow")
        if fault is None:
            self._behind = 0.0
            return 0.0
        if fault.kind == "late":
            return float(fault.value)
        self._behind += float(fault.value) - PERIOD
        late = self._behind
        if late > PERIOD:
            self._behind = 0.0
        return late


class DisturbedBus(WrappedBus):
    """Bus of the HAL that injects the faults `bus_down` and `bus_full`."""

    def __init__(self, bus: Bus, now: HostFaults) -> None:
        super().__init__(bus)
        self._now = now

    def send(self, frames: Frames) -> None:
        """Send frames, or raise an error if a fault is active.

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
            raise BusDown(f"{self.name} is down: injected fault")
        else:
            raise BusFull("injected fault: the transmit queue is full")

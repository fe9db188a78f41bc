"""Faults of the host, in their cycles and in no other."""

from __future__ import annotations

import math

import numpy as np
import pytest

from atalante_hal.bus import BusDown, BusFull
from atalante_hal.bus.pair import lockstep_pair
from atalante_hal.robot import JOINTS
from atalante_hal.types import Command
from atalante_hal.wire.frame import new_frames
from atalante_tools.faults.disturbed import DisturbedBus, DisturbedClock, DisturbedController, HostFaults
from atalante_tools.faults.scenario import HostFault

BEGINS = 10


class Still:
    telemetry, telemetry_fields = np.zeros(3), (("nothing", 3),)

    def __init__(self) -> None:
        self.resets = 0

    def reset(self, state) -> None:
        self.resets += 1

    def update(self, state) -> Command:
        return Command(np.ones(12), np.zeros(8))


class AtCycle:
    """All a controller here reads of a state."""

    def __init__(self, cycle: int) -> None:
        self.cycle = cycle


def at(moment: HostFaults, cycle: int) -> HostFaults:
    moment.cycle = cycle
    return moment


def test_a_fault_is_on_from_its_start_for_its_cycles_and_remembers_when_it_struck() -> None:
    moment = HostFaults([HostFault("late", 2, 3, 1.0)], BEGINS)
    assert [cycle for cycle in range(20) if at(moment, cycle).of("late")] == [12, 13, 14]
    assert moment.first_active == 12
    assert at(HostFaults([HostFault("late", 0, None)], BEGINS), 10**6).of("late")
    assert at(HostFaults([HostFault("late", 0, None)], BEGINS), 9).of("late") is None
    assert at(moment, 12).of("raise", "request") is None


@pytest.mark.parametrize(
    ("fault", "torque"),
    [
        (HostFault("request", value=math.nan), [math.nan] * 12),
        (HostFault("shake", value=5.0), [6.0 if joint == "left_SH" else 1.0 for joint in JOINTS]),
        (HostFault("shape", value=3), [0.0] * 3),
        (HostFault("late", value=1.0), [1.0] * 12),
    ],
)
def test_what_the_controller_asks_for(fault: HostFault, torque: list[float]) -> None:
    controller = DisturbedController(Still(), at(HostFaults([fault], BEGINS), BEGINS))
    assert np.array_equal(controller.update(AtCycle(BEGINS)).torque, torque, equal_nan=True)
    assert controller.telemetry is Still.telemetry
    assert controller.telemetry_fields == Still.telemetry_fields


def test_the_controller_raises_where_it_is_asked_to() -> None:
    inner = Still()
    controller = DisturbedController(
        inner, at(HostFaults([HostFault("raise_in_reset", value="KeyError")], BEGINS), BEGINS)
    )
    with pytest.raises(KeyError):
        controller.reset(AtCycle(BEGINS))
    assert inner.resets == 1
    controller.update(AtCycle(BEGINS))
    controller = DisturbedController(inner, at(HostFaults([HostFault("raise", value="MemoryError")], BEGINS), BEGINS))
    controller.reset(AtCycle(BEGINS))
    with pytest.raises(MemoryError):
        controller.update(AtCycle(BEGINS))


def test_the_clock_is_late_when_asked() -> None:
    moment = HostFaults([HostFault("late", 0, 1, 4e-3)], BEGINS)
    clock = DisturbedClock(moment)
    assert [at(moment, cycle) and clock.wait() for cycle in (9, 10, 11)] == [0.0, 4e-3, 0.0]


def test_the_bus_refuses_when_asked_and_is_the_bus_otherwise() -> None:
    ours, theirs = lockstep_pair()
    moment = HostFaults([HostFault("bus_full", 0, 1), HostFault("bus_down", 1, 1)], BEGINS)
    bus, frames = DisturbedBus(ours, moment), new_frames(2)
    assert bus.name == ours.name
    for cycle, error in ((10, BusFull), (11, BusDown)):
        moment.cycle = cycle
        with pytest.raises(error):
            bus.send(frames)
    moment.cycle = 12
    bus.send(frames)
    assert theirs.receive(new_frames(8)) == 2

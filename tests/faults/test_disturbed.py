"""Tests of the host faults, which are faults of the computer of the HAL: each acts in its cycles and in no other."""

from __future__ import annotations

import math
from dataclasses import replace

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


class ConstantController:
    telemetry, telemetry_fields = np.zeros(3), (("nothing", 3),)

    def __init__(self) -> None:
        self.resets = 0

    def reset(self, state) -> None:
        self.resets += 1

    def update(self, state) -> Command:
        return Command(np.ones(12), np.zeros(8))


class StateAtCycle:
    """The part of a state that the controllers in this file read."""

    def __init__(self, cycle: int) -> None:
        self.cycle = cycle


def at(host_faults: HostFaults, cycle: int) -> HostFaults:
    host_faults.cycle = cycle
    return host_faults


def test_host_fault_is_active_in_its_cycles_and_records_the_first() -> None:
    host_faults = HostFaults([HostFault("late", 2, 3, 1.0)], BEGINS)
    assert [cycle for cycle in range(20) if at(host_faults, cycle).of("late")] == [12, 13, 14]
    assert host_faults.first_active == 12
    assert at(HostFaults([HostFault("late", 0, None)], BEGINS), 10**6).of("late")
    assert at(HostFaults([HostFault("late", 0, None)], BEGINS), 9).of("late") is None
    assert at(host_faults, 12).of("raise", "request") is None


@pytest.mark.parametrize(
    ("fault", "torque"),
    [
        (HostFault("request", value=math.nan), [math.nan] * 12),
        (HostFault("shake", value=5.0), [6.0 if joint == "left_SH" else 1.0 for joint in JOINTS]),
        (HostFault("shape", value=3), [0.0] * 3),
        (HostFault("late", value=1.0), [1.0] * 12),
    ],
)
def test_disturbed_controller_requests_the_faulty_torque(fault: HostFault, torque: list[float]) -> None:
    controller = DisturbedController(ConstantController(), at(HostFaults([fault], BEGINS), BEGINS))
    assert np.array_equal(controller.update(StateAtCycle(BEGINS)).torque, torque, equal_nan=True)
    assert controller.telemetry is ConstantController.telemetry
    assert controller.telemetry_fields == ConstantController.telemetry_fields


@pytest.mark.parametrize(
    "fault", [HostFault("request", value=9.0), HostFault("shake", value=9.0), HostFault("full_torque", value="left_SK")]
)
def test_wrong_torque_changes_no_other_field_of_the_command(fault: HostFault) -> None:
    """Without `walking` and `step`, the HAL would enter HOLD in a step. Without `outside`, it would report no GUIDE_OUTSIDE."""
    command = Command(np.ones(12), np.full(8, 0.5), 3, True, True, True, True)
    inner = ConstantController()
    inner.update = lambda state: command
    controller = DisturbedController(inner, at(HostFaults([fault], BEGINS), BEGINS))
    sent = controller.update(StateAtCycle(BEGINS))
    assert not np.array_equal(sent.torque, np.ones(12))
    assert replace(sent, torque=command.torque) == command
    assert np.array_equal(command.torque, np.ones(12))


def test_disturbed_controller_raises_in_reset_or_update() -> None:
    inner = ConstantController()
    controller = DisturbedController(
        inner, at(HostFaults([HostFault("raise_in_reset", value="KeyError")], BEGINS), BEGINS)
    )
    with pytest.raises(KeyError):
        controller.reset(StateAtCycle(BEGINS))
    assert inner.resets == 1
    controller.update(StateAtCycle(BEGINS))
    controller = DisturbedController(inner, at(HostFaults([HostFault("raise", value="MemoryError")], BEGINS), BEGINS))
    controller.reset(StateAtCycle(BEGINS))
    with pytest.raises(MemoryError):
        controller.update(StateAtCycle(BEGINS))


def test_disturbed_clock_is_late_in_the_cycle_of_the_fault() -> None:
    host_faults = HostFaults([HostFault("late", 0, 1, 4e-3)], BEGINS)
    clock = DisturbedClock(host_faults)
    assert [at(host_faults, cycle) and clock.wait() for cycle in (9, 10, 11)] == [0.0, 4e-3, 0.0]


def test_disturbed_bus_raises_during_faults_and_sends_otherwise() -> None:
    ours, theirs = lockstep_pair()
    host_faults = HostFaults([HostFault("bus_full", 0, 1), HostFault("bus_down", 1, 1)], BEGINS)
    bus, frames = DisturbedBus(ours, host_faults), new_frames(2)
    assert bus.name == ours.name
    for cycle, error in ((10, BusFull), (11, BusDown)):
        host_faults.cycle = cycle
        with pytest.raises(error):
            bus.send(frames)
    host_faults.cycle = 12
    bus.send(frames)
    assert theirs.receive(new_frames(8)) == 2

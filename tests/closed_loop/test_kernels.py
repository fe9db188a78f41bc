"""Kernels of the control loop: they create no arrays, because the loop must not allocate memory and counts no references."""

from __future__ import annotations

from atalante_control.airwalk.controller import AirwalkController
from atalante_control.gait.gait import AIRWALK_GAIT, load_gait
from atalante_control.gait.walk import DEFAULT_WALK, load_walk
from atalante_control.guide.shapes import PINCHED
from atalante_control.model import Patient
from atalante_control.walking.controller import WalkController
from atalante_dbc import Network
from atalante_hal import compiled
from atalante_hal.bus.pair import lockstep_pair
from atalante_hal.hal import Hal
from atalante_hal.robot import Robot


def test_kernels_of_the_loop_create_no_arrays(network: Network, robot: Robot) -> None:
    Hal(network, robot, lockstep_pair()[0])
    AirwalkController(robot, load_gait(AIRWALK_GAIT, robot), PINCHED)
    WalkController(robot, Patient(75.0, 1.75), load_walk(DEFAULT_WALK, robot), 1)
    creates = {
        f"{kernel.__module__}.{kernel.__qualname__}": found for kernel, found in compiled._CREATES_ARRAYS.items()
    }
    ours = {name: found for name, found in creates.items() if name.startswith("atalante_")}
    assert {"atalante_hal.wire.process_image.accept_exact", "atalante_control.walking.kernel.act"} <= ours.keys()
    assert [name for name, found in ours.items() if found] == []

"""Modules and machine code of the commands, loaded once for all terminals that a test forks."""

from __future__ import annotations

import gc
import importlib

from atalante_control.airwalk.controller import AirwalkController
from atalante_control.gait.gait import AIRWALK_GAIT, load_gait
from atalante_control.guide.shapes import SHAPES
from atalante_dbc import Network
from atalante_hal.bus.pair import lockstep_pair
from atalante_hal.loop import LockStep, run
from atalante_hal.robot import Robot
from atalante_hal.types import SupervisorState
from atalante_tools.console.options import EMBEDDED, Target
from atalante_tools.session.pendant_node import PendantNode
from atalante_tools.session.rig import open_hal

#: Modules that the commands import when they need them.
MODULES = (
    "atalante_control.gait.subject",
    "atalante_control.guide.shape_file",
    "atalante_hal.telemetry.process",
    "atalante_tools.canlog.validate",
    "atalante_tools.cli",
    "atalante_tools.commands.airwalk",
    "atalante_tools.commands.emulator",
    "atalante_tools.commands.emulator_line",
    "atalante_tools.commands.jog",
    "atalante_tools.commands.pendant",
    "atalante_tools.commands.status",
    "atalante_tools.session.airwalk",
    "atalante_tools.session.pendant_session",
)


def load_commands(network: Network, robot: Robot) -> None:
    """Import the modules of the commands, and load their machine code with a short run of HAL, emulator and pendant.

    Args:
        network: Nodes and messages of the DBC.
        robot: Robot parameters.
    """
    for name in MODULES:
        importlib.import_module(name)
    controller = AirwalkController(robot, load_gait(AIRWALK_GAIT, robot), SHAPES["constant"])
    controller.certificate(0.5)
    target = Target(EMBEDDED, "", lockstep=True)
    with open_hal(target, network=network, robot=robot, controller_fields=controller.telemetry_fields) as rig:
        run(rig.hal, controller, LockStep(), until=lambda state: state.supervisor is SupervisorState.ACTIVE)
    near, _ = lockstep_pair()
    PendantNode(network, near).poll()
    gc.collect()
    gc.freeze()  # a collection in a forked terminal would copy every page that contains an object

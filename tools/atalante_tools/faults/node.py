"""Fault scenarios of a whole node: restart, no frames, lost heartbeat and wrong DBC."""

from __future__ import annotations

from typing import Final

from atalante_emulator.faults import Fault
from atalante_hal.dbc_names import FOOT_NODES, IMU_NODES, JOINT_NODES
from atalante_hal.types import SupervisorState
from atalante_tools.faults.checks import not_enabled_in_motion
from atalante_tools.faults.scenario import Case, OperatorAction, Scenario

_KNEE: Final = "LEFT_SK"
_ACTIVE: Final = SupervisorState.ACTIVE
_HOLD: Final = SupervisorState.HOLD
_SENSORS: Final = (*IMU_NODES, *FOOT_NODES)
#: Time without a frame after which the HAL reports a timeout of an IMU or a foot [cycles].
_SENSOR_TIMEOUT: Final = 10

SCENARIOS: Final = (
    Scenario(
        "F18",
        (
            *(
                Case(
                    f"at {phase / 10:.0%} of a step",
                    (Fault("reset", _KNEE, 0, 30),),
                    phase / 10,
                    node=_KNEE,
                    detected=32,
                    checks=(not_enabled_in_motion,),
                )
                for phase in range(10)
            ),
            Case("restart after 2 cycles", (Fault("reset", _KNEE, 0, 2),), node=_KNEE, checks=(not_enabled_in_motion,)),
        ),
    ),
    Scenario(
        "F19",
        (
            *(Case(drive, (Fault("silence", drive),), node=drive, recovers=False) for drive in JOINT_NODES),
            *(
                Case(
                    sensor,
                    (Fault("silence", sensor),),
                    detected=_SENSOR_TIMEOUT,
                    reacted=_SENSOR_TIMEOUT,
                    node=sensor,
                    recovers=False,
                )
                for sensor in _SENSORS
            ),
        ),
        permanent=Case("IMU_TORSO", (Fault("silence", "IMU_TORSO"),)),
    ),
    Scenario(
        "F20",
        (
            Case("drive", (Fault("heartbeat_lost", _KNEE),), node=_KNEE, observed=300),
            Case("foot", (Fault("heartbeat_lost", "FOOT_LEFT"),), node="FOOT_LEFT", observed=300),
            Case(
                "START without heartbeat",
                (Fault("heartbeat_lost", _KNEE), OperatorAction("stop", 400)),
                state=_HOLD,
                reacted=401,
                node=_KNEE,
                recovers=False,
            ),
            Case(
                "START with heartbeat",
                (Fault("heartbeat_lost", _KNEE, 0, 420), OperatorAction("stop", 400)),
                state=_HOLD,
                reacted=401,
                node=_KNEE,
                observed=150,
            ),
        ),
        permanent=Case("permanent", (Fault("heartbeat_lost", _KNEE),)),
    ),
    Scenario(
        "F53",
        tuple(
            Case(
                node, (Fault("dbc_hash", node),), None, detected=300, reacted=1, node=node, recovers=False, observed=300
            )
            for node in (_KNEE, "IMU_PELVIS", "FOOT_RIGHT", "HAPTICS", "PENDANT")
        ),
    ),
)

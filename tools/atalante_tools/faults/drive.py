"""Scenarios of drive faults: state changes, emergencies, over-temperature, under-voltage, lost and damaged commands."""

from __future__ import annotations

from typing import Final

from atalante_emulator.faults import Fault
from atalante_hal.robot import LEG_JOINTS
from atalante_hal.types import SupervisorState
from atalante_tools.faults.checks import (
    encoders_keep_their_reference,
    guide_kept,
    left_leg_in_local_hold,
    limit_follows_temperature,
    never_active,
    not_enabled_in_motion,
    nothing_sags,
    start_fails_and_names_the_hip,
)
from atalante_tools.faults.scenario import Case, HostFault, OperatorAction, Scenario

_S = SupervisorState
#: Joint that hardly moves while the left leg swings. Therefore the HAL recognises a jump of the joint encoder as a fault, and
#: rejects the new position.
_STILL: Final = "RIGHT_FH"
_KNEE: Final = "LEFT_SK"
_HIP: Final = "LEFT_SH"
_IMU: Final = "IMU_TORSO"
_COMMAND: Final = "COMMAND_LEFT_LEG"
#: Time from the end of the fault to START [cycles], if a knee sinks in LOWER or FAULT.
#: At START, the knee is then at rest, and its drive can be enabled again.
_LOWERED: Final = 4500
#: Time from the end of the fault to START [cycles], if the HAL has switched off the faulty drive.
#: The joint of this drive may still be sinking when START is pressed. START enables the drive, which then holds the joint.
_UNTIL_START: Final = 600
#: Time from HOLD until all joints are at rest [cycles].
_AT_REST: Final = 60

#: Dictionary from case name to faults. Each fault restarts a drive during the walk. A restarted drive must be enabled again.
_RESTARTED: Final = {
    "one drive restarted": (Fault("reset", _HIP, 0, 3),),
    "two drives restarted": (Fault("reset", _HIP, 0, 3), Fault("reset", "RIGHT_SK", 0, 3)),
}


def _start_with(name: str, node: str, fault: Fault | float) -> Case:
    """Return a test case in which the first START fails.

    If `fault` is a number, it is the true torque of the motor divided by the torque that the drive reports.
    """
    return Case(
        name,
        (fault if isinstance(fault, Fault) else Fault("torque_weak", node, 0, share=fault),),
        phase=None,
        detected=450,
        reacted=450,
        node=node,
        recovers=False,
        checks=(never_active,),
    )


SCENARIOS: Final = (
    Scenario(
        "F21",
        (
            *(
                Case(
                    f"{name}, {code:#06x}",
                    (Fault("emergency", _KNEE, 0, 100, code=code),),
                    state=state,
                    dtc=dtc,
                    node=_KNEE,
                    recovers=recovers,
                    observed=observed,
                )
                for name, code, state, dtc, observed, recovers in (
                    ("current", 0x2310, _S.FAULT, "EMCY_2310", _LOWERED, True),
                    ("voltage", 0x3210, _S.HOLD, "EMCY_3210", 60, True),
                    ("temperature", 0x4210, _S.LOWER, "OVER_TEMP", 60, False),
                    ("encoder", 0x7305, _S.LOWER, "EMCY_7305", _LOWERED, True),
                    ("communication", 0x8100, _S.HOLD, "EMCY_8100", 60, True),
                    ("software", 0x6100, _S.FAULT, "EMCY_6100", 60, True),
                )
            ),
            Case(
                "same emergency before and after a restart",
                (
                    Fault("emergency", _IMU, 0, 700, code=0x3210),
                    Fault("reset", _IMU, 100, 30),
                    OperatorAction("start", 200),
                    Fault("emergency", _IMU, 600, 100, code=0x3210),
                ),
                first_faulty=600,
                dtc="EMCY_3210",
                node=_IMU,
            ),
        ),
    ),
    Scenario(
        "F22",
        (
            *(
                Case(state, (Fault("leave_operation", _KNEE, 0, 1, state=state),), node=_KNEE)
                for state in (
                    "NOT_READY_TO_SWITCH_ON",
                    "SWITCH_ON_DISABLED",
                    "READY_TO_SWITCH_ON",
                    "SWITCHED_ON",
                    "QUICK_STOP_ACTIVE",
                )
            ),
            *(
                Case(
                    state,
                    (Fault("leave_operation", _KNEE, 0, 1, state=state),),
                    state=_S.FAULT,
                    dtc="DRIVE_FAULT",
                    node=_KNEE,
                )
                for state in ("FAULT_REACTION_ACTIVE", "FAULT")
            ),
        ),
    ),
    Scenario(
        "F23",
        (
            Case("one leg", (Fault("drop", "SYNC_LEFT_LEG", 0, 50),), checks=(left_leg_in_local_hold,)),
            Case(
                "all buses",
                tuple(
                    Fault("drop", f"SYNC_{side}_{part}", 0, 50)
                    for side in ("LEFT", "RIGHT")
                    for part in ("LEG", "SENSE")
                ),
                checks=(left_leg_in_local_hold,),
            ),
        ),
        permanent=Case("one leg", (Fault("drop", "SYNC_LEFT_LEG"),)),
    ),
    # A drive detects lost commands by the gap in the alive counter of the next command.
    # Example: if the commands of the cycles 1 and 2 are lost, the command of cycle 3 shows the gap, so `detected` is 3.
    Scenario("F24", tuple(Case(f"{n} frames", (Fault("drop", _COMMAND, 0, n),), detected=n + 1) for n in range(1, 5))),
    Scenario(
        "F25",
        (
            Case("5 frames", (Fault("drop", _COMMAND, 0, 5),), checks=(left_leg_in_local_hold,)),
            Case("200 frames", (Fault("drop", _COMMAND, 0, 200),), checks=(left_leg_in_local_hold,)),
            Case("permanent", (Fault("drop", _COMMAND),), recovers=False, checks=(left_leg_in_local_hold,)),
            Case(
                "growing delay",
                (Fault("delay", _COMMAND, 0, 20, by=4), Fault("delay", _COMMAND, 20, 80, by=8)),
                first_faulty=20,
                checks=(left_leg_in_local_hold,),
            ),
        ),
        permanent=Case("left leg", (Fault("drop", _COMMAND),)),
    ),
    Scenario(
        "F26",
        (
            *(Case(f"{bits} bits, 4 frames", (Fault("flip", _COMMAND, 0, 4, bits=bits),)) for bits in (1, 2, 16)),
            Case("one in ten", (Fault("flip", _COMMAND, 0, 300, p=0.1),), detected=60),
        ),
        permanent=Case("every frame", (Fault("flip", _COMMAND),)),
    ),
    Scenario(
        "F35",
        (
            *(
                Case(
                    f"{torque:g} Nm on {node}",
                    (Fault("push", node, 0, 60, torque=torque),),
                    state=_S.ACTIVE,
                    detected=60,
                    observed=400,
                    checks=(guide_kept,),
                )
                for node, torque in (("LEFT_SH", -180.0), ("LEFT_SH", 180.0), (_KNEE, -110.0), (_KNEE, 110.0))
            ),
            Case(
                "90 Nm on the knee, 400 cycles", (Fault("push", _KNEE, 0, 400, torque=90.0),), detected=60, reacted=400
            ),
        ),
        permanent=Case("40 Nm on the knee", (Fault("push", _KNEE, torque=40.0),)),
    ),
    Scenario(
        "F36",
        (
            Case("250 cycles", (HostFault("shake", 0, 250, 1000.0),)),
            Case("100 cycles", (HostFault("shake", 0, 100, 1000.0),), state=_S.ACTIVE),
        ),
        permanent=Case("1000 Nm", (HostFault("shake", 0, None, 1000.0),)),
    ),
    Scenario(
        "F38",
        (
            Case(
                "100 degC",
                (Fault("over_temperature", _KNEE, 0, 400, degrees=100.0),),
                node=_KNEE,
                checks=(limit_follows_temperature,),
            ),
            Case(
                "up to 105 degC, 1 K per cycle",  # the drive exceeds 90 degC after 65 cycles, and then reduces its torque limit
                (Fault("heat_ramp", _KNEE, 0, 400, rate=1000.0, up_to=105.0),),
                node=_KNEE,
                detected=70,
                checks=(limit_follows_temperature,),
            ),
        ),
    ),
    Scenario(
        "F39",
        (Case("130 degC", (Fault("over_temperature", _KNEE, 0, 200, degrees=130.0),), node=_KNEE, recovers=False),),
    ),
    Scenario(
        "F40",
        (
            Case("30 V", (Fault("under_voltage", "battery", 0, 200, volts=30.0),)),
            Case("one drive", (Fault("under_voltage", _KNEE, 0, 200, volts=30.0),), node=_KNEE),
            Case(
                "battery removed",
                (Fault("battery_removed", "battery", 0, 600),),
                dtc="SUPPLY_LOW",
                detected=300,
                reacted=450,
            ),
        ),
    ),
    Scenario(
        "F68",
        tuple(
            Case(
                f"{state}, lost frames: {lost}",
                (Fault("leave_operation", _KNEE, 0, 1, state=state), Fault("drop", f"{_KNEE}_STATE", 0, lost)),
                node=_KNEE,
                checks=(not_enabled_in_motion,),
            )
            for state in ("SWITCHED_ON", "QUICK_STOP_ACTIVE")
            for lost in (1, 3, 4)
        ),
    ),
    Scenario(
        "F69",
        (
            *(
                Case(
                    f"{cycles} cycles late, {name}",
                    (*stimuli, Fault("enable_delay", _HIP, 0, by=cycles)),
                    node=_HIP,
                    dtc="NODE_RESET",
                    checks=(nothing_sags,),
                )
                for cycles in (1, 7)
                for name, stimuli in _RESTARTED.items()
            ),
            *(
                Case(
                    f"never, {name}",
                    (*stimuli, Fault("enable_delay", _HIP, 0, by=100_000)),
                    node=_HIP,
                    dtc="NODE_RESET",
                    recovers=False,
                    checks=(nothing_sags, start_fails_and_names_the_hip),
                )
                for name, stimuli in _RESTARTED.items()
            ),
            Case(
                "never, first START",
                (Fault("enable_delay", _HIP, 0, by=100_000),),
                phase=None,
                state=_S.READY,
                dtc="START_FAILED",
                detected=300,
                reacted=300,
                recovers=False,
                checks=(nothing_sags, start_fails_and_names_the_hip),
            ),
        ),
    ),
    Scenario(
        "F72",
        (
            *(_start_with(f"LEFT_{joint} reversed", f"LEFT_{joint}", -1.0) for joint in LEG_JOINTS),
            *(_start_with(f"LEFT_{joint} dead", f"LEFT_{joint}", 0.0) for joint in ("SK", "SA", "HA")),
            *(
                _start_with(
                    f"encoders of {joint} exchanged",
                    f"LEFT_{joint}",
                    Fault("encoder_swapped", f"LEFT_{joint}", other=f"RIGHT_{joint}"),
                )
                for joint in ("SA", "HA")
            ),
        ),
    ),
    # The transverse hips (TH) have no case. Left and right TH have nearly the same position, so exchanged encoders show no jump.
    Scenario(
        "F85",
        tuple(
            Case(
                f"encoders of {joint} exchanged{' in HOLD' if hold else ''}",
                (*hold, Fault("encoder_swapped", f"LEFT_{joint}", start, other=f"RIGHT_{joint}")),
                node=f"LEFT_{joint}",
                detected=start + 5,
                reacted=start + 5,
                recovers=False,
            )
            for hold, start in (((), 0), ((OperatorAction("hold"),), _AT_REST))
            for joint in LEG_JOINTS
            if joint != "TH"
        ),
    ),
    # Only the frontal hip (FH) and the sagittal hip (SH) have a case with a reversed motor.
    # With a reversed motor, each of TH, SK, SA and HA exceeds its velocity limit before the HAL can react.
    Scenario(
        "F84",
        tuple(
            Case(
                f"{node} in HOLD with {share:g} times its torque",
                (OperatorAction("hold"), Fault("torque_weak", node, _AT_REST, 600, share=share)),
                node=node,
                detected=_AT_REST + 200,
                observed=_UNTIL_START,
            )
            for node, share in (
                *((f"LEFT_{joint}", -1.0) for joint in ("FH", "SH")),
                *((f"LEFT_{joint}", 0.0) for joint in ("FH", "SH", "SK")),
            )
        ),
    ),
    # If the torque of the knee motor is ten or more cycles late, the position control of the knee drive becomes unstable.
    Scenario(
        "F74",
        tuple(
            Case(
                f"knee in HOLD, {late} cycles late",
                (OperatorAction("hold"), Fault("torque_late", _KNEE, 0, 600, by=late)),
                node=_KNEE,
                observed=_UNTIL_START,
            )
            for late in (10, 12)
        ),
    ),
    # The HAL detects a torque error above a fifth of the breakaway torque of the joint.
    Scenario(
        "F75",
        tuple(
            Case(
                f"{node} with {share:g} times its torque",
                (Fault("torque_wrong", node, 0, 600, share=share),),
                node=node,
                observed=_UNTIL_START,
            )
            for node, share in (
                *((f"LEFT_{joint}", -1.0) for joint in LEG_JOINTS),
                *((f"LEFT_{joint}", 0.0) for joint in LEG_JOINTS),
                (_KNEE, 0.4),
                (_KNEE, 1.6),
                (_HIP, 0.4),
                (_HIP, 1.6),
            )
        ),
    ),
    # A faulty motor is visible only in the motion of its joint, because its drive still reports the commanded torque.
    # The commanded torque of the Henke ankle (HA) is below the dry friction, so HA moves little and the detection takes longer.
    # The sagittal ankle (SA) has no case with a reversed motor, because this case would fail the check `limit_violations`:
    # SA would exceed the velocity limit before the HAL can detect the fault.
    Scenario(
        "F82",
        tuple(
            Case(
                f"{node} with {share:g} times its torque",
                (Fault("torque_weak", node, 0, 600, share=share),),
                node=node,
                detected=cycles,
                reacted=cycles,
                observed=_UNTIL_START,
            )
            for node, share, cycles in (
                *((f"LEFT_{joint}", -1.0, 30) for joint in ("FH", "TH", "SH", "SK")),
                ("LEFT_HA", -1.0, 60),
                *((f"LEFT_{joint}", 0.0, 100) for joint in ("FH", "TH", "SH", "SK", "SA")),
                ("LEFT_FH", 0.4, 300),
            )
        ),
    ),
    # Each push accelerates the joint above its top speed within the time limit of F71, which is 25 cycles.
    Scenario(
        "F71",
        tuple(
            Case(
                f"{torque:g} Nm on {node}",
                (Fault("push", node, 0, 60, torque=torque),),
                node=node,
                checks=(encoders_keep_their_reference,),
            )
            for node, torque in ((_KNEE, 150.0), ("LEFT_HA", 25.0), ("LEFT_SA", 50.0))
        ),
    ),
    # The encoder also jumps in the cycle in which the drive fails, so the HAL rejects the position of this cycle.
    Scenario(
        "F87",
        (
            Case(
                "FAULT while the encoder jumps for 4 cycles",
                (
                    Fault("encoder_jump", _STILL, 0, 4, by=0.3),
                    Fault("leave_operation", _STILL, 0, 1, state="FAULT"),
                ),
                node=_STILL,
            ),
            *(
                Case(
                    f"{name} after a permanent jump",
                    (Fault("encoder_jump", _STILL, by=0.3), *stimuli),
                    state=state,
                    dtc=dtc,
                    node=_STILL,
                    detected=101,
                    reacted=101,
                    observed=300,
                    recovers=False,
                )
                for name, stimuli, state, dtc in (
                    ("FAULT", (Fault("leave_operation", _STILL, 100, 1, state="FAULT"),), _S.FAULT, "DRIVE_FAULT"),
                    ("100 degC", (Fault("over_temperature", _STILL, 100, degrees=100.0),), _S.HOLD, "DERATED"),
                    (
                        "130 degC, with START,",
                        (Fault("over_temperature", _STILL, 100, degrees=130.0), OperatorAction("start", 200)),
                        _S.LOWER,
                        "OVER_TEMP",
                    ),
                )
            ),
        ),
    ),
)

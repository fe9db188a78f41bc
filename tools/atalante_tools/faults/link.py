"""Scenarios of communication faults: lost, repeated, late, damaged and foreign frames."""

from __future__ import annotations

from typing import Final

from atalante_emulator.faults import Fault
from atalante_hal.dbc_names import JOINT_NODES
from atalante_hal.robot import CELLS
from atalante_hal.types import SupervisorState
from atalante_hal.wire.frame import FLAG_BRS, FLAG_ESI, FLAG_FDF
from atalante_tools.faults.checks import (
    data_stays_fresh,
    drives_report_two_senders,
    guide_kept,
    left_leg_in_local_hold,
)
from atalante_tools.faults.scenario import Case, OperatorAction, Scenario, invalid_code

_HOLD: Final = SupervisorState.HOLD
_ACTIVE: Final = SupervisorState.ACTIVE
_OFF: Final = SupervisorState.OFF
_BUSES: Final = ("left_leg", "right_leg", "left_sense", "right_sense")
#: Drive for the faults that affect a single drive.
_KNEE: Final = "LEFT_SK"
#: State message of the drive `_KNEE`.
_STATE: Final = "LEFT_SK_STATE"
#: Raw code that the drive `_KNEE` sends if it has no valid position.
_NO_POSITION: Final = invalid_code(_STATE, "Position")
#: Message with the command of the drive `_KNEE`.
_COMMAND: Final = "COMMAND_LEFT_LEG"
_PENDANT: Final = "PENDANT"
#: Flags of a CAN FD frame from a node that is error passive.
_ERROR_PASSIVE: Final = FLAG_FDF | FLAG_BRS | FLAG_ESI


def _lost(name: str, message: str, frames: int | None, *, node: str, recovers: bool = True) -> Case:
    return Case(name, (Fault("drop", message, 0, frames),), node=node, recovers=recovers)


SCENARIOS: Final = (
    Scenario(
        "F01",
        (
            _lost("one frame", _STATE, 1, node=_KNEE),
            *(
                Case(
                    f"1 % of all frames, seed {seed}",
                    tuple(Fault("drop", bus, 0, 800, p=0.01) for bus in _BUSES),
                    detected=800,
                    seed=seed,
                    checks=(guide_kept,),
                )
                for seed in range(3)
            ),
        ),
    ),
    Scenario(
        "F02",
        (
            Case(
                "10 %",
                (Fault("drop", _KNEE, 0, 1000, p=0.1),),
                state=_ACTIVE,
                dtc="",
                detected=1,
                reacted=1,
                checks=(guide_kept,),
            ),
            *(
                Case(
                    f"{p:.0%}, seed {seed}",
                    (Fault("drop", _KNEE, 0, within, p=p),),
                    dtc="E2E_LOSS_RATE|NODE_TIMEOUT",
                    node=_KNEE,
                    detected=within,
                    reacted=within,
                    seed=seed,
                    checks=(guide_kept,),
                )
                for p, within in ((0.2, 1000), (0.3, 400), (0.4, 200), (0.5, 150))
                for seed in range(2)
            ),
        ),
    ),
    Scenario("F03", tuple(_lost(f"{n} frames", _STATE, n, node=_KNEE) for n in range(1, 5))),
    Scenario(
        "F04",
        (
            *(_lost(drive, f"{drive}_STATE", 5, node=drive) for drive in JOINT_NODES),
            # Frames of a swing leg are lost. Injected forces load the right foot, so the HAL treats the left leg as swing leg.
            # After 5 lost frames in a row, the swing leg finishes its step (FINISH_STEP). The tenth lost frame leads to HOLD.
            *(
                Case(
                    f"{frames or 'all'} frames of the swing leg",
                    (
                        Fault("value", "FOOT_RIGHT_STATE", 0, None, **{f"{cell}_ForceZ": 150.0 for cell in CELLS}),
                        Fault("drop", _STATE, 20, frames),
                    ),
                    first_faulty=20,
                    state=state,
                    dtc=dtc,
                    node=_KNEE,
                    reacted=reacted,
                    recovers=False,
                    observed=40,  # less than 100, because the HAL reports constant forces as a fault after 100 cycles
                    suspended=True,
                )
                for frames, state, dtc, reacted in (
                    (5, SupervisorState.FINISH_STEP, "JOINT_TIMEOUT", 5),
                    (None, _HOLD, "NODE_TIMEOUT", 10),
                )
            ),
        ),
        permanent=_lost("permanent", _STATE, None, node=_KNEE, recovers=False),
    ),
    Scenario(
        "F05",
        (Case(_KNEE, (Fault("duplicate", _STATE, 0, 10),), node=_KNEE, checks=(data_stays_fresh,)),),
        permanent=Case("permanent", (Fault("duplicate", _STATE),)),
    ),
    Scenario(
        "F06",
        (
            Case("0 cycles", (), dtc="", state=_ACTIVE, observed=200),
            # The HAL detects the delay when the first delayed frame arrives, `k` cycles after the start of the fault.
            *(
                Case(f"{k} cycles", (Fault("delay", _STATE, 0, 200, by=k),), node=_KNEE, detected=k + 1, state=_ACTIVE)
                for k in range(1, 5)
            ),
            *(Case(f"{k} cycles", (Fault("delay", _STATE, 0, 200, by=k),), node=_KNEE, detected=k + 1) for k in (5, 6)),
        ),
        permanent=Case("by 4 cycles, permanent", (Fault("delay", _STATE, 0, None, by=4),)),
    ),
    # The first frame with a frozen counter still has the expected counter value. The second frame is the first faulty frame.
    Scenario(
        "F07",
        (
            Case(
                "4 cycles",
                (Fault("freeze_counter", _STATE, 0, 5),),
                first_faulty=1,
                dtc="E2E_REPEATED",
                detected=1,
                state=_ACTIVE,
            ),
            Case("50 cycles", (Fault("freeze_counter", _STATE, 0, 51),), first_faulty=1, node=_KNEE),
        ),
        permanent=Case("permanent", (Fault("freeze_counter", _STATE),)),
    ),
    Scenario(
        "F08",
        (
            *(
                Case(f"{bits} bits", (Fault("flip", _STATE, 0, 4, bits=bits),), node=_KNEE)
                for bits in (1, 2, 3, 4, 8, 64)
            ),
            Case("5 cycles", (Fault("flip", _STATE, 0, 5),), state=_HOLD, reacted=5, node=_KNEE),
        ),
        permanent=Case("permanent", (Fault("flip", _STATE),)),
    ),
    Scenario(
        "F09",
        (Case("another knee", (Fault("masquerade", _STATE, 0, 4, like="RIGHT_SK_STATE"),), node=_KNEE),),
        permanent=Case("permanent", (Fault("masquerade", _STATE, like="RIGHT_SK_STATE"),)),
    ),
    Scenario(
        "F10",
        (
            *(Case(f"{n} bytes", (Fault("length", _STATE, 0, 4, bytes=n),), node=_KNEE) for n in (0, 8, 16, 64)),
            Case("classic CAN", (Fault("flags", _STATE, 0, 4, flags=0),), node=_KNEE),
        ),
        permanent=Case("permanent", (Fault("length", _STATE, bytes=8),)),
    ),
    Scenario(
        "F11",
        tuple(
            Case(name, (Fault("foreign", "left_leg", 0, 200, can_id=can_id, count=count),))
            for name, can_id, count in (
                ("lowest priority", 0x7FF, 1),
                ("several", 0x500, 8),
                ("extended", 0x1234567, 1),
            )
        ),
        permanent=Case("permanent", (Fault("foreign", "left_leg", can_id=0x7FF),)),
    ),
    Scenario(
        "F12",
        (
            Case("undefined drive state", (Fault("raw", _STATE, 0, 4, DriveState=255),), node=_KNEE),
            Case("invalid position", (Fault("raw", _STATE, 0, 4, Position=_NO_POSITION),), node=_KNEE),
        ),
        permanent=Case("permanent", (Fault("raw", _STATE, Position=_NO_POSITION),)),
    ),
    Scenario(
        "F13",
        (
            Case("one leg", (Fault("flood", "left_leg", 0, 100),), checks=(left_leg_in_local_hold,)),
            Case("one sensor bus", (Fault("flood", "right_sense", 0, 100),), reacted=10),
            Case("one leg, permanent", (Fault("flood", "left_leg"),), recovers=False, checks=(left_leg_in_local_hold,)),
        ),
        permanent=Case("one leg", (Fault("flood", "left_leg"),)),
    ),
    Scenario(
        "F14",
        (
            Case("another HAL's SYNC", (Fault("inject", "SYNC_LEFT_LEG", 0, 20),)),
            Case(
                "before the start of the HAL",
                (Fault("inject", "SYNC_LEFT_LEG", 2),),
                None,
                reacted=1,
                detected=300,
                state=_OFF,
                recovers=False,
                observed=300,
            ),
        ),
        permanent=Case("another HAL's SYNC", (Fault("inject", "SYNC_LEFT_LEG"),)),
    ),
    Scenario(
        "F15",
        (
            Case("permanent", (Fault("bus_off", "left_leg"),), recovers=False),
            Case("for 100 cycles", (Fault("bus_off", "left_leg", 0, 100),)),
            Case(
                "before the start, for 3 cycles",
                (Fault("bus_off", "left_leg", 5, 3),),
                phase=None,
                first_faulty=5,
                state=_OFF,
                observed=200,
            ),
        ),
        permanent=Case("one bus", (Fault("bus_off", "left_leg"),)),
    ),
    Scenario(
        "F51",
        (
            Case(
                "right counter, 200 Nm",
                (Fault("inject", _COMMAND, 0, 20, SK_TargetTorque=200.0),),
                checks=(left_leg_in_local_hold, drives_report_two_senders),
            ),
            Case("counter 5 ahead", (Fault("inject", _COMMAND, 0, 20, ahead=5, SK_TargetTorque=-200.0),)),
            Case("one frame", (Fault("inject", _COMMAND, 0, 1, SK_TargetTorque=200.0),)),
        ),
        permanent=Case("permanent", (Fault("inject", _COMMAND, SK_TargetTorque=200.0),)),
    ),
    Scenario(
        "F63",
        (
            *(
                Case(
                    f"{node}, {copies + 1} frames in every cycle",
                    (Fault("duplicate", f"{node}_STATE", 0, 200, copies=copies),),
                    node=node,
                )
                for node, copies in ((_KNEE, 1), (_KNEE, 11), (_PENDANT, 1), ("FOOT_LEFT", 1), ("IMU_TORSO", 3))
            ),
            Case(
                "for 10 cycles",
                (Fault("duplicate", _STATE, 0, 10),),
                state=_ACTIVE,
                dtc="E2E_REPEATED",
                detected=1,
                checks=(data_stays_fresh,),
            ),
        ),
        permanent=Case("permanent", (Fault("duplicate", _STATE),)),
    ),
    Scenario(
        "F64",
        (
            *(
                Case(
                    f"{count} per cycle",
                    tuple(Fault("error_frame", "left_leg", 0, 200, error=0x88) for _ in range(count)),
                )
                for count in (1, 8)
            ),
            Case("for 5 cycles", (Fault("error_frame", "left_leg", 0, 5, error=0x88),), state=_ACTIVE),
        ),
        permanent=Case("permanent", (Fault("error_frame", "left_leg", error=0x88),)),
    ),
    Scenario(
        "F65",
        (
            *(
                Case(
                    f"{node}, in every frame",
                    (Fault("flags", f"{node}_STATE", 0, 200, flags=_ERROR_PASSIVE),),
                    node=node,
                )
                for node in (_KNEE, _PENDANT, "IMU_PELVIS")
            ),
            Case(
                "for 10 cycles",
                (Fault("flags", _STATE, 0, 10, flags=_ERROR_PASSIVE),),
                state=_ACTIVE,
                node=_KNEE,
                checks=(data_stays_fresh,),
            ),
        ),
        permanent=Case("permanent", (Fault("flags", _STATE, flags=_ERROR_PASSIVE),)),
    ),
    # A second sender copies the last frame of a node, changes signals of the copy, and adds `ahead` to its alive counter.
    # If `ahead` is 1, the copy has the counter of the node's next frame. If `ahead` is 0, the copy has
    # the counter of the node's last frame.
    Scenario(
        "F58",
        (
            *(
                Case(f"{node}, {order}", (Fault("inject", f"{node}_STATE", 0, 50, ahead=ahead, **signals),), node=node)
                for node, signals in (
                    (_KNEE, {"Temperature": 31.0}),
                    ("IMU_PELVIS", {"Temperature": 31.0}),
                    ("FOOT_RIGHT", {"Temperature": 31.0}),
                    (_PENDANT, {"AssistanceFactor": 0.25}),
                )
                for order, ahead in (("first", 1), ("late", 0))
            ),
            Case("another position", (Fault("inject", _STATE, 0, 50, Position=0.0),), node=_KNEE),
            Case("independent counter", (Fault("inject", _STATE, 0, 50, ahead=7),), node=_KNEE),
            *(
                Case(
                    f"{name}, {order}",
                    (*presses, Fault("inject", "PENDANT_STATE", 0, 3, ahead=ahead, **signals)),
                    node=_PENDANT,
                    dtc="OPERATOR_STOP",
                    detected=1,
                    reacted=1,
                )
                for name, presses, signals in (
                    ("a second pendant releases the dead-man", (), {"DeadMan": 0}),
                    ("a second pendant sends STOP", (), {"Request": 2}),
                    ("a second pendant withholds STOP", (OperatorAction("stop"),), {"Request": 0}),
                )
                for order, ahead in (("first", 1), ("late", 0))
            ),
            Case(
                "before the start of the HAL",
                (Fault("inject", _STATE, 2, Temperature=31.0),),
                None,
                detected=10,
                reacted=1,
                node=_KNEE,
                state=_OFF,
                recovers=False,
                observed=300,
            ),
        ),
        permanent=Case("permanent", (Fault("inject", _STATE, Temperature=31.0),)),
    ),
)

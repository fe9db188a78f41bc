"""Scenarios of sensor faults: stuck, jumping or drifting encoders, and failed IMUs and force cells."""

from __future__ import annotations

import math
from typing import Final

from atalante_emulator.faults import Fault
from atalante_hal.dbc_names import FOOT_NODES, IMU_NODES
from atalante_hal.robot import CELLS
from atalante_hal.types import SupervisorState
from atalante_tools.faults.checks import start_is_rejected
from atalante_tools.faults.scenario import MID_SWING, Case, OperatorAction, Scenario, invalid_code

_ACTIVE: Final = SupervisorState.ACTIVE
_HOLD: Final = SupervisorState.HOLD
_KNEE: Final = "LEFT_SK"
#: Joint that hardly moves while the left leg swings, so that a small jump of the joint encoder is detectable.
_STILL: Final = "RIGHT_FH"
#: Probability that a frame arrives twice. The HAL tolerates `_OFTEN` permanently. Above 0.2, it reports fault F63.
_OFTEN: Final = 0.15
#: Dictionary from a part of the case name to a permanent communication fault. During this fault, the HAL must still detect a
#: drifting encoder.
#: Two of these faults delay messages that the sensor checks use: the messages of a joint drive and of the pelvis IMU.
#: Frames are doubled at random, because the HAL stops the walk if a message arrives twice in every cycle (fault F63).
_TOLERATED: Final = {
    "FOOT_LEFT often doubled": Fault("duplicate", "FOOT_LEFT_STATE", p=_OFTEN),
    "FOOT_LEFT a cycle late": Fault("delay", "FOOT_LEFT_STATE"),
    "IMU_TORSO often doubled": Fault("duplicate", "IMU_TORSO_STATE", p=_OFTEN),
    "PENDANT often doubled": Fault("duplicate", "PENDANT_STATE", p=_OFTEN),
    "PENDANT a cycle late": Fault("delay", "PENDANT_STATE"),
    "unknown frames": Fault("foreign", "left_leg", can_id=0x7FF),
    f"{_STILL} a cycle late": Fault("delay", f"{_STILL}_STATE"),
    "IMU_PELVIS a cycle late": Fault("delay", "IMU_PELVIS_STATE"),
}


def _imu(kind: str, cycles: int, *, tolerated: int) -> tuple[Case, ...]:
    """Return one test case per IMU, and one test case with a short fault during which the walk must continue."""
    return (
        *(Case(imu, (Fault(kind, imu, 0, cycles),), node=imu) for imu in IMU_NODES),
        Case(f"for {tolerated} cycles", (Fault(kind, IMU_NODES[0], 0, tolerated),), state=_ACTIVE, node=IMU_NODES[0]),
    )


def _stuck(node: str, cycles: int) -> tuple[Fault, ...]:
    """Return two faults: a stuck encoder, and a later restart of the drive. The restart initialises the encoder again."""
    return Fault("encoder_stuck", node, 0, cycles), Fault("reset", node, cycles + 30, 3)


#: Vertical force on each cell of a foot that stands on its toes [N].
_ON_TOES: Final = (290.0, 290.0, 10.0, 10.0)


def _standing(foot: str, cycles: int) -> tuple[Fault, ...]:
    """Return faults that simulate a foot that stands on its toes.

    The soles of a robot in the air are not level, so a foot cannot stand on its whole sole. The forces change every 50
    cycles, because a constant force is a fault.

    Args:
        foot: name of the foot node.
        cycles: duration [cycles].
    """
    return tuple(
        Fault(
            "value",
            f"{foot}_STATE",
            start,
            50,
            **{f"{cell}_ForceZ": force + start / 50 % 2 for cell, force in zip(CELLS, _ON_TOES, strict=True)},
        )
        for start in range(0, cycles, 50)
    )


def _every(cycles: int, kind: str, target: str, count: int, **parameters: float) -> tuple[Fault, ...]:
    """Return periodic faults. Each fault lasts one cycle, and a fault begins every `cycles` cycles.

    Args:
        cycles: interval of the faults [cycles].
        kind: kind of the faults.
        target: target of the faults.
        count: number of faults.
        parameters: parameters of the faults.
    """
    return tuple(Fault(kind, target, cycles * number, 1, **parameters) for number in range(count))


def _never_ready(name: str, fault: Fault, *, node: str) -> Case:
    """Return a case of an IMU that is faulty from power-on: the HAL stays in OFF and rejects START."""
    return Case(
        f"{name}, from power-on",
        (fault,),
        phase=None,
        state=SupervisorState.OFF,
        node=node,
        detected=80,
        reacted=80,
        recovers=False,
        checks=(start_is_rejected,),
    )


SCENARIOS: Final = (
    Scenario(
        "F27",
        (
            *(Case(node, _stuck(node, 200), node=node) for node in ("LEFT_SH", "RIGHT_SH")),
            # If the knee encoder is stuck, the guide commands the largest torque of the drive.
            # At a large torque, the HAL detects a stuck encoder within 20 cycles.
            *(
                Case(f"{_KNEE} at {phase:g} T", _stuck(_KNEE, 200), node=_KNEE, phase=phase, detected=20, reacted=20)
                for phase in (0.1, MID_SWING, 0.65, 0.8)
            ),
            *(
                Case(
                    f"{node} with little load",
                    _stuck(node, 300),
                    node=node,
                    detected=within,
                    reacted=within,
                )
                for node, within in (
                    ("RIGHT_SK", 150),
                    ("RIGHT_TH", 240),
                    ("RIGHT_FH", 260),
                    ("RIGHT_SA", 80),
                    ("LEFT_HA", 200),
                )
            ),
        ),
    ),
    Scenario(
        "F28",
        (
            Case(
                "3.5 mrad, a possible motion",
                (Fault("encoder_jump", _STILL, 0, 1, by=3.5e-3),),
                dtc="",
                state=_ACTIVE,
            ),
            *(
                Case(
                    f"{1e3 * by:g} mrad for {cycles} cycles",
                    (Fault("encoder_jump", _STILL, 0, cycles, by=by),),
                    state=_ACTIVE,
                    node=_STILL,
                )
                for by, cycles in ((5e-3, 1), (-5e-3, 1), (0.01, 1), (-0.1, 4), (1.0, 4))
            ),
            *(
                Case(f"{1e3 * by:g} mrad for 100 cycles", (Fault("encoder_jump", _STILL, 0, 100, by=by),), node=_STILL)
                # The HAL accepts a joint motion of at most 22.5 mrad within five cycles. Each of these jumps is larger.
                for by in (0.025, -0.025, 0.1, -1.0)
            ),
            # In the cycle in which the encoder jumps back, the drives begin to hold their position.
            *(
                Case(f"{1e3 * by:g} mrad for 5 cycles", (Fault("encoder_jump", _STILL, 0, 5, by=by),), node=_STILL)
                for by in (0.3, -0.3)
            ),
            Case(
                "25 mrad, permanent",
                (Fault("encoder_jump", _STILL, by=0.025),),
                node=_STILL,
                observed=400,
                recovers=False,
                checks=(start_is_rejected,),
            ),
            Case(
                "25 mrad, permanent, and a restart of the drive",
                (Fault("encoder_jump", _STILL, by=0.025), Fault("reset", _STILL, 100, 3)),
                node=_STILL,
                observed=400,
            ),
        ),
        permanent=Case("25 mrad", (Fault("encoder_jump", _STILL, by=0.025),)),
    ),
    Scenario(
        "F29",
        tuple(
            Case(
                f"{node}, {rate:g} rad/s",
                (Fault("encoder_drift", node, rate=rate),),
                recovers=False,
            )
            for node, rate in (("LEFT_SH", 0.1), (_KNEE, -0.1), ("RIGHT_SH", -0.1), ("RIGHT_SK", 0.1))
        ),
    ),
    Scenario(
        "F83",
        tuple(
            Case(
                f"{side}_SH {rate:+g} deg/s and {side}_SK {-rate:+g} deg/s",
                (
                    Fault("encoder_drift", f"{side}_SH", rate=math.radians(rate)),
                    Fault("encoder_drift", f"{side}_SK", rate=math.radians(-rate)),
                ),
                node=f"{side}_SK",
                recovers=False,
            )
            for side in ("LEFT", "RIGHT")
            for rate in (2.5, -2.5)
        ),
    ),
    Scenario(
        "F30", _imu("imu_invalid", 30, tolerated=5), permanent=Case("torso", (Fault("imu_invalid", IMU_NODES[0]),))
    ),
    Scenario(
        "F31", _imu("imu_saturated", 30, tolerated=5), permanent=Case("torso", (Fault("imu_saturated", IMU_NODES[0]),))
    ),
    Scenario("F32", tuple(Case(imu, (Fault("imu_frozen", imu, 0, 200),), node=imu) for imu in IMU_NODES)),
    Scenario(
        "F33",
        tuple(
            Case(
                f"{foot} {cell} at {force:g} N",
                (Fault("cell_stuck", foot, 0, 300, cell=cell, force=force),),
                node=foot,
            )
            for foot in FOOT_NODES
            for cell, force in zip(CELLS, (400.0, 0.0, -50.0, 61.0), strict=True)
        ),
    ),
    # The robot is suspended. Injected foot forces simulate that both feet are on the ground.
    # Fault F34 (both feet report swing) begins when the injected forces end.
    # After 140 cycles without ground contact, the HAL regards the robot as lifted on purpose, and F34 ends.
    Scenario(
        "F34",
        tuple(
            Case(
                name,
                (*_standing(FOOT_NODES[0], left), *_standing(FOOT_NODES[1], right)),
                first_faulty=600,
                observed=1000,
                suspended=True,
            )
            for name, left, right in (
                ("both feet lift", 600, 600),
                ("the left foot lifts", 600, 550),
                ("the right foot lifts", 550, 600),
            )
        ),
    ),
    Scenario(
        "F76",
        tuple(
            Case(f"{foot}, all cells -200 N", (Fault("cell_offset", foot, 0, 300, force=-200.0),), node=foot)
            for foot in FOOT_NODES
        ),
    ),
    Scenario(
        "F77",
        tuple(
            Case(f"{foot}, all cells +200 N", (Fault("cell_offset", foot, 0, 1000, force=200.0),), node=foot)
            for foot in FOOT_NODES
        ),
    ),
    Scenario(
        "F57",
        (
            Case(
                "0.3 rad/s, possible with the filter of the drive",
                (Fault("value", f"{_STILL}_STATE", 0, 100, Velocity=30.0),),
                dtc="",
                state=_ACTIVE,
            ),
            *(
                Case(
                    f"{rate:g} rad/s", (Fault("value", f"{_STILL}_STATE", 0, 100, Velocity=100.0 * rate),), node=_STILL
                )
                for rate in (0.7, -0.7)
            ),
        ),
    ),
    Scenario(
        "F62",
        (
            Case(
                "LEFT_SA by 1 rad, before START",
                (Fault("encoder_jump", "LEFT_SA", by=1.0),),
                phase=None,
                state=SupervisorState.OFF,
                node="LEFT_SA",
                observed=400,
                recovers=False,
                checks=(start_is_rejected,),
            ),
            # The encoder drifts, so the controller moves the real joint in the opposite direction, to its end stop.
            # POSITION_RANGE: the reported position leaves its range.
            # TORQUE_MOTION: the torque does not move the joint, as with a dead motor.
            Case(
                "RIGHT_SA at 2 rad/s",
                (Fault("encoder_drift", "RIGHT_SA", rate=2.0),),
                state=SupervisorState.LOWER,
                dtc="TORQUE_MOTION|POSITION_RANGE",
                node="RIGHT_SA",
                detected=400,
                reacted=400,
                recovers=False,
                checks=(start_is_rejected,),
            ),
        ),
    ),
    Scenario(
        "F59",
        (
            *(
                Case(
                    f"{torque:g} Nm from a drive that is off",
                    (Fault("value", f"{_STILL}_STATE", Torque=torque),),
                    phase=None,
                    detected=300,
                    reacted=300,
                    observed=100,
                    recovers=False,
                    checks=(start_is_rejected,),
                )
                for torque in (-400.0, 5.0)
            ),
            Case(
                "-400 Nm from a drive that holds",
                (OperatorAction("hold"), Fault("value", f"{_STILL}_STATE", 20, Torque=-400.0)),
                state=_HOLD,
                detected=5,
                reacted=5,
                recovers=False,
                checks=(start_is_rejected,),
            ),
        ),
    ),
    Scenario(
        "F60",
        (
            *(
                Case(
                    f"{name}, and a velocity error of 0.7 rad/s",
                    (Fault("value", f"{_STILL}_STATE", 0, 100, Velocity=70.0), disturbance),
                    node=_STILL,
                )
                for name, disturbance in _TOLERATED.items()
            ),
            *(
                Case(
                    f"{name}, and an encoder drift of 0.1 rad/s",
                    (disturbance, Fault("encoder_drift", "LEFT_SH", rate=0.1)),
                    state=SupervisorState.FULL_ASSIST,
                    dtc="ENC_DRIFT",
                    detected=1000,
                    reacted=1000,
                    recovers=False,
                )
                for name, disturbance in _TOLERATED.items()
            ),
        ),
    ),
    Scenario(
        "F66",
        (
            Case(
                "every second position of a joint is invalid",
                _every(2, "raw", f"{_STILL}_STATE", 40, Position=invalid_code(f"{_STILL}_STATE", "Position")),
                node=_STILL,
            ),
            Case(
                "every second frame of an IMU is invalid",
                _every(2, "imu_invalid", "IMU_PELVIS", 40),
                state=SupervisorState.FULL_ASSIST,
                dtc="IMU_INVALID",
                node="IMU_PELVIS",
            ),
        ),
    ),
    Scenario(
        "F70",
        (
            # Only the position on the bus jumps. A jump of the encoder itself would also raise the diagnostic ENC_VELOCITY.
            Case(
                "every second position of a joint jumps",
                _every(2, "value", f"{_STILL}_STATE", 40, Position=10.0),
                node=_STILL,
            ),
            *(
                Case(
                    f"every second frame of an IMU, {name}",
                    _every(2, kind, "IMU_PELVIS" + message, 40, **parameters),
                    state=SupervisorState.FULL_ASSIST,
                    dtc=dtc,
                    node="IMU_PELVIS",
                )
                for name, kind, message, dtc, parameters in (
                    ("saturated", "imu_saturated", "", "IMU_SATURATED", {}),
                    ("without attitude", "value", "_STATE", "IMU_INVALID", {"QuaternionW": 0.0}),
                )
            ),
            Case(
                "every fifth position of a joint jumps",
                _every(5, "value", f"{_STILL}_STATE", 60, Position=10.0),
                state=_ACTIVE,
                node=_STILL,
            ),
        ),
    ),
    Scenario(
        "F67",
        (
            Case("one sample", (Fault("value", f"{_KNEE}_STATE", 0, 1, Temperature=130.0),), state=_ACTIVE, node=_KNEE),
            Case(
                "every fifth sample",
                _every(5, "value", f"{_KNEE}_STATE", 60, Temperature=130.0),
                state=_ACTIVE,
                node=_KNEE,
            ),
            Case("every second sample", _every(2, "value", f"{_KNEE}_STATE", 60, Temperature=130.0), node=_KNEE),
            Case(
                "every sample", (Fault("value", f"{_KNEE}_STATE", 0, 100, Temperature=112.0),), node=_KNEE, reacted=20
            ),
        ),
    ),
    Scenario(
        "F80",
        (
            *(
                _never_ready(f"{imu}, wrong sign along Z", Fault("imu_inverted", imu, axis="Z"), node=imu)
                for imu in IMU_NODES[:2]
            ),
            *(
                Case(
                    f"{imu}, wrong sign along Z, from power-on",
                    (Fault("imu_inverted", imu, axis="Z"),),
                    phase=None,
                    node=imu,
                    recovers=False,
                )
                for imu in IMU_NODES[2:]
            ),
            *(
                _never_ready(
                    f"{imu}, turned in its mount", Fault("imu_turned", imu, axis="X", degrees=5.0), node="IMU_TORSO"
                )
                for imu in IMU_NODES[:2]
            ),
            Case(
                "IMU_TORSO, wrong sign while walking",
                (Fault("imu_inverted", "IMU_TORSO", axis="Z"),),
                detected=1100,
                reacted=1100,
                recovers=False,
            ),
        ),
    ),
    Scenario(
        "F61",
        (
            Case(
                "IMU_LEFT_TIBIA, permanent",
                (Fault("imu_invalid", "IMU_LEFT_TIBIA"),),
                node="LEFT_FH",
                observed=200,
                recovers=False,
            ),
        ),
    ),
)

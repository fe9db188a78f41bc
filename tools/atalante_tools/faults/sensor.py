"""Scenarios of sensor faults: stuck, jumping or drifting encoders, and failed IMUs and force cells."""

from __future__ import annotations

from typing import Final

from atalante_emulator.faults import Fault
from atalante_hal.robot import CELLS, FEET, IMUS
from atalante_hal.types import SupervisorState
from atalante_tools.faults.checks import start_is_refused
from atalante_tools.faults.scenario import Case, Press, Scenario

_ACTIVE: Final = SupervisorState.ACTIVE
_HOLD: Final = SupervisorState.HOLD
_KNEE: Final = "LEFT_SK"
#: Joint that hardly moves while the left leg swings, so that its motion does not hide a small jump.
_QUIET: Final = "RIGHT_FH"
_IMUS: Final = tuple(f"IMU_{name.upper()}" for name in IMUS)
_FEET: Final = tuple(f"FOOT_{name.upper()}" for name in FEET)
#: Forces of the cells of a foot on the ground [N].
_STANDS: Final = {f"{cell}_ForceZ": 150.0 for cell in CELLS}
#: Permanent faults of other nodes; the last two affect messages that the checks themselves use.
_RIDDEN_THROUGH: Final = {
    "FOOT_LEFT doubled": Fault("duplicate", "FOOT_LEFT_STATE"),
    "FOOT_LEFT a cycle late": Fault("delay", "FOOT_LEFT_STATE"),
    "IMU_TORSO doubled": Fault("duplicate", "IMU_TORSO_STATE"),
    "PENDANT doubled": Fault("duplicate", "PENDANT_STATE"),
    "PENDANT a cycle late": Fault("delay", "PENDANT_STATE"),
    "an unknown frame": Fault("foreign", "left_leg", can_id=0x7FF),
    f"{_QUIET} a cycle late": Fault("delay", f"{_QUIET}_STATE"),
    "IMU_PELVIS a cycle late": Fault("delay", "IMU_PELVIS_STATE"),
}


def _imu(kind: str, cycles: int, *, ridden: int) -> tuple[Case, ...]:
    """Return a case for each IMU, and one with a short fault during which the walk must continue."""
    return (
        *(Case(imu, (Fault(kind, imu, 0, cycles),), node=imu) for imu in _IMUS),
        Case(f"for {ridden} cycles", (Fault(kind, _IMUS[0], 0, ridden),), state=_ACTIVE, node=_IMUS[0]),
    )


def _stuck(node: str, cycles: int) -> tuple[Fault, ...]:
    """Return a stuck encoder that jumps to the true position at the end, and a restart that references it."""
    return Fault("encoder_stuck", node, 0, cycles), Fault("reset", node, cycles + 30, 3)


SCENARIOS: Final = (
    Scenario(
        "F27",
        (
            *(Case(node, _stuck(node, 200), node=node) for node in ("LEFT_SH", _KNEE, "RIGHT_SH")),
            *(
                Case(
                    f"{node}, which has little to do",
                    _stuck(node, 300),
                    node=node,
                    noticed=within,
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
                "3.5 mrad, what the joint can move",
                (Fault("encoder_jump", _QUIET, 0, 1, by=3.5e-3),),
                dtc="",
                state=_ACTIVE,
            ),
            *(
                Case(
                    f"{1e3 * by:g} mrad for {cycles} cycles",
                    (Fault("encoder_jump", _QUIET, 0, cycles, by=by),),
                    state=_ACTIVE,
                    node=_QUIET,
                )
                for by, cycles in ((5e-3, 1), (-5e-3, 1), (0.01, 1), (-0.1, 4), (1.0, 4))
            ),
            *(
                Case(f"{1e3 * by:g} mrad for good", (Fault("encoder_jump", _QUIET, 0, 100, by=by),), node=_QUIET)
                for by in (0.025, -0.025, 0.1, -1.0)  # a joint can move 20 mrad in five cycles
            ),
            Case(
                "25 mrad that stay",
                (Fault("encoder_jump", _QUIET, by=0.025),),
                node=_QUIET,
                watched=400,
                recovers=False,
                checks=(start_is_refused,),
            ),
            Case(
                "25 mrad that stay, and the drive restarts",
                (Fault("encoder_jump", _QUIET, by=0.025), Fault("reset", _QUIET, 100, 3)),
                node=_QUIET,
                watched=400,
            ),
        ),
        lasting=Case("25 mrad", (Fault("encoder_jump", _QUIET, by=0.025),)),
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
    Scenario("F30", _imu("imu_invalid", 30, ridden=5), lasting=Case("torso", (Fault("imu_invalid", _IMUS[0]),))),
    Scenario("F31", _imu("imu_saturated", 30, ridden=5), lasting=Case("torso", (Fault("imu_saturated", _IMUS[0]),))),
    Scenario("F32", tuple(Case(imu, (Fault("imu_frozen", imu, 0, 200),), node=imu) for imu in _IMUS)),
    Scenario(
        "F33",
        tuple(
            Case(
                f"{foot} {cell} at {force:g} N",
                (Fault("cell_stuck", foot, 0, 300, cell=cell, force=force),),
                node=foot,
            )
            for foot in _FEET
            for cell, force in zip(CELLS, (400.0, 0.0, -50.0, 61.0), strict=True)
        ),
    ),
    # Both feet report contact for 60 cycles, then swing. Missing contact alone is no fault: after a second, it is cleared.
    Scenario(
        "F34",
        tuple(
            Case(
                name,
                tuple(Fault("value", f"{foot}_STATE", 0, 60, **_STANDS) for foot in feet),
                begins=60,
                watched=1000,
            )
            for name, feet in (
                ("both feet lift", _FEET),
                ("the left foot lifts", _FEET[:1]),
                ("the right foot lifts", _FEET[1:]),
            )
        ),
    ),
    Scenario(
        "F57",
        (
            Case(
                "0.3 rad/s, which may be the drive's filter",
                (Fault("value", f"{_QUIET}_STATE", 0, 100, Velocity=30.0),),
                dtc="",
                state=_ACTIVE,
            ),
            *(
                Case(
                    f"{rate:g} rad/s", (Fault("value", f"{_QUIET}_STATE", 0, 100, Velocity=100.0 * rate),), node=_QUIET
                )
                for rate in (0.7, -0.7)
            ),
        ),
    ),
    Scenario(
        "F62",
        (
            Case(
                "LEFT_SA by 1 rad, before the start",
                (Fault("encoder_jump", "LEFT_SA", by=1.0),),
                phase=None,
                state=SupervisorState.OFF,
                node="LEFT_SA",
                watched=400,
                recovers=False,
                checks=(start_is_refused,),
            ),
            # The controller follows the encoder until the joint reaches its limits.
            Case(
                "RIGHT_SA at 2 rad/s",
                (Fault("encoder_drift", "RIGHT_SA", rate=2.0),),
                node="RIGHT_SA",
                noticed=400,
                reacted=400,
                recovers=False,
                checks=(start_is_refused,),
            ),
        ),
    ),
    Scenario(
        "F59",
        (
            *(
                Case(
                    f"{torque:g} Nm of a drive that is off",
                    (Fault("value", f"{_QUIET}_STATE", Torque=torque),),
                    phase=None,
                    noticed=300,
                    reacted=300,
                    watched=100,
                    recovers=False,
                    checks=(start_is_refused,),
                )
                for torque in (-400.0, 5.0)
            ),
            Case(
                "-400 Nm of a drive that holds",
                (Press("hold"), Fault("value", f"{_QUIET}_STATE", 20, Torque=-400.0)),
                state=_HOLD,
                noticed=5,
                reacted=5,
                recovers=False,
                checks=(start_is_refused,),
            ),
        ),
    ),
    Scenario(
        "F60",
        (
            *(
                Case(
                    f"{name}, and a velocity 0.7 rad/s off",
                    (Fault("value", f"{_QUIET}_STATE", 0, 100, Velocity=70.0), disturbance),
                    node=_QUIET,
                )
                for name, disturbance in _RIDDEN_THROUGH.items()
            ),
            *(
                Case(
                    f"{name}, and a drift of 0.1 rad/s",
                    (disturbance, Fault("encoder_drift", "LEFT_SH", rate=0.1)),
                    state=SupervisorState.FULL_ASSIST,
                    dtc="ENC_DRIFT",
                    noticed=1000,
                    reacted=1000,
                    recovers=False,
                )
                for name, disturbance in _RIDDEN_THROUGH.items()
            ),
        ),
    ),
    Scenario(
        "F61",
        (
            Case(
                "IMU_LEFT_TIBIA for good",
                (Fault("imu_invalid", "IMU_LEFT_TIBIA"),),
                node="LEFT_FH",
                watched=200,
                recovers=False,
            ),
        ),
    ),
)

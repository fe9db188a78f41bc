"""Sensors that stand still, jump, drift, freeze or say nothing of use."""

from __future__ import annotations

from typing import Final

from atalante_emulator.faults import Fault
from atalante_hal.robot import CELLS, FEET, IMUS
from atalante_hal.types import SupervisorState
from atalante_tools.faults.scenario import Case, Scenario

_ACTIVE: Final = SupervisorState.ACTIVE
_HOLD: Final = SupervisorState.HOLD
_KNEE: Final = "LEFT_SK"
#: A joint that hardly moves while the left leg swings: what it may jump by is told sharply.
_QUIET: Final = "RIGHT_FH"
_IMUS: Final = tuple(f"IMU_{name.upper()}" for name in IMUS)
_FEET: Final = tuple(f"FOOT_{name.upper()}" for name in FEET)
#: What the cells of a foot say under somebody's weight [N].
_STANDS: Final = {f"{cell}_ForceZ": 150.0 for cell in CELLS}


def _imu(kind: str, cycles: int, *, ridden: int) -> tuple[Case, ...]:
    """Each IMU, and one for a time that is ridden through."""
    return (
        *(Case(imu, (Fault(kind, imu, 0, cycles),), node=imu) for imu in _IMUS),
        Case(f"for {ridden} cycles", (Fault(kind, _IMUS[0], 0, ridden),), state=_ACTIVE, node=_IMUS[0]),
    )


SCENARIOS: Final = (
    Scenario(
        "F27",
        (
            *(
                Case(node, (Fault("encoder_stuck", node, 0, 200),), node=node)
                for node in ("LEFT_SH", _KNEE, "RIGHT_SH")
            ),
            *(
                Case(
                    f"{node}, which has little to do",
                    (Fault("encoder_stuck", node, 0, 300),),
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
                for by in (0.025, -0.025, 0.1, -1.0)  # five times what the joint can move in a cycle are 20 mrad
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
    # They stand for 60 cycles, then both swing. Hanging alone is no fault, and after a second of it this one is forgotten.
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
)

"""What a drive owes its joint: CiA 402, torque within the limit, and the latched hold when its HAL is not heard."""

from __future__ import annotations

from typing import Final

from atalante_tools.conform import drive_commands as commands
from atalante_tools.conform import drive_states as states
from atalante_tools.conform import drive_torque as torques
from atalante_tools.conform.axis import FOLLOW, LEGAL, ROUTES, STAY
from atalante_tools.conform.bench import Bench
from atalante_tools.conform.drive_commands import LATCHED, RIDDEN, UNKNOWN, ignores
from atalante_tools.conform.drive_states import STOP
from atalante_tools.conform.requirement import Requirement

CIA402: Final = "IEC 61800-7-201"
E2E: Final = "AUTOSAR E2E Profile 5"


def requirements(bench: Bench) -> list[Requirement]:
    """Of a drive, in the order of a first commissioning."""
    torque = bench.limits.torque
    return [
        Requirement(
            "DRIVE-01",
            "Starts in SWITCH ON DISABLED.",
            "state before the first command",
            f"{CIA402} transition 1",
            states.starts_disabled,
        ),
        Requirement(
            "DRIVE-02",
            f"Makes every transition of the standard, within {FOLLOW} cycles, and stays there.",
            f"all {len(LEGAL)} commands that move, from {len(ROUTES)} states",
            CIA402,
            states.makes_legal_transitions,
        ),
        Requirement(
            "DRIVE-03",
            "Refuses every command that is no transition of its state.",
            f"all {len(ROUTES) * 6 - len(LEGAL)} others, {STAY} cycles each",
            CIA402,
            states.refuses_illegal_transitions,
        ),
        Requirement(
            "DRIVE-04",
            f"Stops within {STOP} cycles of QUICK STOP.",
            "QUICK_STOP in OPERATION ENABLED",
            "fault matrix F56",
            states.stops_quickly,
        ),
        Requirement(
            "DRIVE-05",
            "Holds its position while QUICK STOP ACTIVE.",
            f"QUICK_STOP after 10 cycles of {torque:g} Nm, position at the joint over 100 cycles",
            f"{CIA402} quick stop option code 6",
            states.holds_its_position,
        ),
        Requirement(
            "DRIVE-06",
            "Makes no torque unless OPERATION ENABLED.",
            f"{torque:g} Nm commanded in SWITCH ON DISABLED, READY TO SWITCH ON, SWITCHED ON",
            CIA402,
            torques.makes_no_torque_disabled,
        ),
        Requirement(
            "DRIVE-07",
            "Makes the torque that is commanded, with its sign.",
            f"0, +{torque:g}, -{torque:g}, +{torque / 2:g} Nm for 12 cycles each",
            "DBC TargetTorque",
            torques.follows_torque,
        ),
        Requirement(
            "DRIVE-08",
            "Never makes more than MaxTorque, whatever the target.",
            f"targets at both ends of the DBC range, MaxTorque {torque:g} and 0 Nm",
            "DBC MaxTorque",
            torques.respects_the_limit,
        ),
        Requirement(
            "DRIVE-09",
            "Takes a MaxTorque at the end of its range.",
            f"target {torque:g} Nm under MaxTorque {torque:g} Nm and at the end of the DBC range",
            "DBC MaxTorque",
            torques.takes_the_largest_limit,
        ),
        Requirement(
            "DRIVE-10",
            "Does not act on a controlword outside its range.",
            f"codes {', '.join(map(str, UNKNOWN))} in OPERATION ENABLED and SWITCH ON DISABLED",
            "DBC Controlword range",
            commands.ignores_unknown_controlwords,
        ),
        Requirement(
            "DRIVE-11",
            "Does not act on a command with an invalid code.",
            "2 commands with each of Controlword, TargetTorque, MaxTorque invalid",
            "DBC InvalidRaw",
            commands.ignores_invalid_codes,
        ),
        Requirement(
            "DRIVE-12",
            f"Rides through {RIDDEN} lost commands with the last one.",
            f"{RIDDEN} cycles without command at {torque:g} Nm",
            "fault matrix F24",
            commands.rides_through,
        ),
        Requirement(
            "DRIVE-13",
            f"Latches a local hold after {LATCHED} lost commands.",
            f"{LATCHED} cycles without command in OPERATION ENABLED",
            "fault matrix F25",
            commands.latches,
        ),
        Requirement(
            "DRIVE-14",
            "Leaves the latched hold for QUICK_STOP and then ENABLE_OPERATION alone.",
            "every other command first, then ENABLE_OPERATION alone, then both",
            "fault matrix F25",
            commands.releases_only_when_acknowledged,
        ),
        Requirement(
            "DRIVE-15",
            "Tells the latched hold by one emergency 0x8250.",
            "EMCY after 20 cycles without command",
            "CiA 301 EMCY, RPDO timeout",
            commands.tells_the_latch,
        ),
        Requirement(
            "DRIVE-16",
            "Rides through 3 ms without SYNC and latches the hold in 20 ms without.",
            "silence in OPERATION ENABLED",
            "fault matrix F23",
            commands.latches_without_sync,
        ),
        Requirement(
            "DRIVE-17",
            "Ignores commands with a wrong CRC; they do not feed its watchdog.",
            "2, then 10 commands with one bit damaged, from all over the payload",
            f"{E2E}, fault matrix F26",
            ignores(lambda axis, number: axis.push(flip=24 + 37 * number)),
        ),
        Requirement(
            "DRIVE-18",
            "Ignores commands protected for another message.",
            "2, then 10 commands with the other leg's Data ID",
            f"{E2E}, fault matrix F09",
            ignores(lambda axis, _: axis.push(data_id=axis.other_data_id)),
        ),
        Requirement(
            "DRIVE-19",
            "Ignores another command with the counter of the last, or holds: it is another sender's.",
            "2, then 10 commands with the counter of the last good one",
            f"{E2E}, fault matrix F05, F51",
            ignores(lambda axis, _: axis.push(counter=axis.bench.command.counter), or_holds=True),
        ),
        Requirement(
            "DRIVE-20",
            "Ignores a command that is out of sequence.",
            "one command 100 counts ahead",
            f"{E2E}, MaxDelta",
            commands.ignores_a_jump,
        ),
        Requirement(
            "DRIVE-21",
            "Ignores commands of another length.",
            "2, then 10 commands of 32 and 64 bytes, CRC right for that length",
            "DBC length, fault matrix F10",
            ignores(lambda axis, number: axis.push(length=(32, 64)[number % 2])),
        ),
        Requirement(
            "DRIVE-22",
            "Goes to FAULT, without torque, and tells it by an emergency 0x4xxx when it is too hot.",
            "heated in OPERATION ENABLED by the technician",
            f"{CIA402} transition 13, fault matrix F39",
            states.trips_when_hot,
        ),
        Requirement(
            "DRIVE-23",
            "Leaves FAULT for FAULT_RESET alone.",
            "every other command first",
            f"{CIA402} transition 15",
            states.leaves_fault_when_reset,
        ),
    ]

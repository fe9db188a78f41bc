"""Requirements for a drive: CiA 402 state machine, torque, torque limit, loss of commands or SYNC, and measured motion."""

from __future__ import annotations

from typing import Final

from atalante_tools.conform import drive_commands as commands
from atalante_tools.conform import drive_motion as motion
from atalante_tools.conform import drive_states as states
from atalante_tools.conform import drive_torque as torques
from atalante_tools.conform.axis import FOLLOW, LEGAL, ROUTES, STAY
from atalante_tools.conform.drive_commands import LATCHED, TOLERATED, UNKNOWN, ignores
from atalante_tools.conform.drive_states import STOP
from atalante_tools.conform.node_tester import NodeTester
from atalante_tools.conform.requirement import E2E, Requirement

CIA402: Final = "IEC 61800-7-201"


def requirements(tester: NodeTester) -> list[Requirement]:
    """Return the requirements for a drive, in the order of the tests."""
    torque = tester.limits.torque
    return [
        Requirement(
            "DRIVE-01",
            "Starts in SWITCH ON DISABLED.",
            "drive state before the first command",
            f"{CIA402} transition 1",
            states.starts_disabled,
        ),
        Requirement(
            "DRIVE-02",
            f"Makes every transition of the standard within {FOLLOW} cycles and keeps the new state.",
            f"all {len(LEGAL)} commands with a transition, from {len(ROUTES)} states",
            CIA402,
            states.makes_legal_transitions,
        ),
        Requirement(
            "DRIVE-03",
            "Keeps its state on every command without a transition.",
            f"all {len(ROUTES) * 6 - len(LEGAL)} commands without a transition, {STAY} cycles each",
            CIA402,
            states.refuses_illegal_transitions,
        ),
        Requirement(
            "DRIVE-04",
            f"Is in QUICK STOP ACTIVE within {STOP} cycles of the command.",
            "QUICK_STOP in OPERATION ENABLED",
            "fault matrix F56",
            states.stops_quickly,
        ),
        Requirement(
            "DRIVE-05",
            "Holds its position in QUICK STOP ACTIVE.",
            f"QUICK_STOP after 10 cycles of {torque:g} Nm, joint position over 100 cycles",
            f"{CIA402} quick stop option code 6",
            states.holds_its_position,
        ),
        Requirement(
            "DRIVE-06",
            "Makes no torque outside OPERATION ENABLED.",
            f"{torque:g} Nm commanded in SWITCH ON DISABLED, READY TO SWITCH ON, SWITCHED ON",
            CIA402,
            torques.makes_no_torque_disabled,
        ),
        Requirement(
            "DRIVE-07",
            "Makes the commanded torque with the right sign.",
            f"0, +{torque:g}, -{torque:g}, +{torque / 2:g} Nm for 12 cycles each",
            "DBC TargetTorque",
            torques.follows_torque,
        ),
        Requirement(
            "DRIVE-08",
            "Limits the torque to MaxTorque for any target and keeps the sign of the target.",
            f"targets at both ends of the DBC range, MaxTorque {torque:g} and 0 Nm",
            "DBC MaxTorque",
            torques.respects_the_limit,
        ),
        Requirement(
            "DRIVE-09",
            "Accepts the largest MaxTorque of the DBC range.",
            f"target {torque:g} Nm with MaxTorque {torque:g} Nm and with the largest MaxTorque of the DBC",
            "DBC MaxTorque",
            torques.takes_the_largest_limit,
        ),
        Requirement(
            "DRIVE-10",
            "Ignores a controlword outside the DBC range.",
            f"codes {', '.join(map(str, UNKNOWN))} in OPERATION ENABLED and SWITCH ON DISABLED",
            "DBC Controlword range",
            commands.ignores_unknown_controlwords,
        ),
        Requirement(
            "DRIVE-11",
            "Ignores a command with an invalid code.",
            "2 commands each with the invalid code of Controlword, TargetTorque, MaxTorque",
            "DBC InvalidRaw",
            commands.ignores_invalid_codes,
        ),
        Requirement(
            "DRIVE-12",
            f"Repeats the last command for {TOLERATED} lost commands.",
            f"{TOLERATED} cycles without command at {torque:g} Nm",
            "fault matrix F24",
            commands.tolerates_lost_commands,
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
            "Leaves the latched hold only on QUICK_STOP followed by ENABLE_OPERATION.",
            "all other commands, then ENABLE_OPERATION alone, then QUICK_STOP and ENABLE_OPERATION",
            "fault matrix F25",
            commands.releases_only_when_acknowledged,
        ),
        Requirement(
            "DRIVE-15",
            "Sends exactly one emergency 0x8250 for the latched hold.",
            "EMCY after 20 cycles without command",
            "CiA 301 EMCY, RPDO timeout",
            commands.reports_the_latch,
        ),
        Requirement(
            "DRIVE-16",
            "Keeps OPERATION ENABLED for 3 ms without SYNC and latches the hold within 20 ms.",
            "no SYNC and no command in OPERATION ENABLED",
            "fault matrix F23",
            commands.latches_without_sync,
        ),
        Requirement(
            "DRIVE-17",
            "Ignores commands with a wrong CRC; they do not reset its watchdog.",
            "2, then 10 commands with one bit flipped, spread over the payload",
            f"{E2E}, fault matrix F26",
            ignores(lambda axis, number: axis.bad_command(flip=24 + 37 * number)),
        ),
        Requirement(
            "DRIVE-18",
            "Ignores commands protected for another message.",
            "2, then 10 commands with the other leg's Data ID",
            f"{E2E}, fault matrix F09",
            ignores(lambda axis, _: axis.bad_command(data_id=axis.other_data_id)),
        ),
        Requirement(
            "DRIVE-19",
            "Ignores a command of a second sender (changed command, unchanged counter), or latches the hold.",
            "2, then 10 commands with the counter of the last valid command",
            f"{E2E}, fault matrix F05, F51",
            ignores(lambda axis, _: axis.bad_command(counter=axis.tester.command.counter), may_hold=True),
        ),
        Requirement(
            "DRIVE-20",
            "Ignores a command out of sequence.",
            "one command 100 counts ahead",
            f"{E2E}, MaxDelta",
            commands.ignores_a_jump,
        ),
        Requirement(
            "DRIVE-21",
            "Ignores commands of a wrong length.",
            "2, then 10 commands of 32 and 64 bytes, CRC valid for that length",
            "DBC length, fault matrix F10",
            ignores(lambda axis, number: axis.bad_command(length=(32, 64)[number % 2])),
        ),
        Requirement(
            "DRIVE-22",
            "Goes to FAULT without torque and sends one emergency 0x4xxx at the trip temperature.",
            "overheated by the technician in OPERATION ENABLED",
            f"{CIA402} transition 13, fault matrix F39",
            states.trips_when_hot,
        ),
        Requirement(
            "DRIVE-23",
            "Leaves FAULT only on FAULT_RESET.",
            f"cooled below {tester.robot.derating.start:g} degC, then all other commands, then FAULT_RESET",
            f"{CIA402} transition 15",
            states.leaves_fault_when_reset,
        ),
        Requirement(
            "DRIVE-24",
            f"Latches a local hold when commands are {LATCHED} cycles late; a command has the counter of the next SYNC.",
            f"three times {TOLERATED} cycles without command, then commands with the counter that follows the last command",
            "fault matrix F25",
            commands.latches_late_commands,
        ),
        Requirement(
            "DRIVE-25",
            f"Reports a velocity that is the change of its position (within {motion.RATIO * 100:g} %).",
            f"all state frames received so far, in windows of {motion.WINDOW} ms",
            "DBC Position, Velocity",
            motion.reports_consistent_motion,
        ),
    ]

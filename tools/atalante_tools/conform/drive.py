"""What a drive owes its joint: CiA 402, torque within the limit, and the latched hold when its HAL is not heard."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Final

from atalante_hal.cia402 import Controlword, DriveState
from atalante_hal.frame import Frames
from atalante_tools.conform.axis import (
    FOLLOW,
    LEGAL,
    ROUTES,
    Axis,
    always,
    mean_torque,
    names_of,
    state_of,
    torque_of,
)
from atalante_tools.conform.bench import Bench, NotTested
from atalante_tools.conform.frames import Heard
from atalante_tools.conform.requirement import Outcome, Requirement
from atalante_tools.conform.technician import Action

_S, _C = DriveState, Controlword
CIA402: Final = "IEC 61800-7-201"
E2E: Final = "AUTOSAR E2E Profile 5"

#: Controlwords outside the range: known ones with the highest bit set, as a sloppy mask would let through, and the last.
UNKNOWN: Final = (0x82, 0x86, 0x87, 0x8F, 0xFE)
#: Cycles a drive may take for a quick stop.
STOP: Final = 5
#: Cycles for which a command that must not move is repeated.
_STAY: Final = 8
#: Cycles from a command to the state frame that shows it, at the most, when nothing has to switch.
_SHOWN: Final = 3
#: Commands a drive rides through without, and those after which it holds by itself.
RIDDEN, LATCHED = 4, 5
#: Difference of measured and wanted torque that is noise [Nm].
_NOISE: Final = 0.3
#: A joint that holds may give way by this much [rad].
_GIVE: Final = math.radians(1.0)
#: CiA 301 emergency code of a lost HAL: its command came no more (RPDO timeout).
COMMAND_TIMEOUT: Final = 0x8250
#: Class of emergency codes of temperatures.
TEMPERATURE_CLASS: Final = 0x4000


def requirements(bench: Bench) -> list[Requirement]:
    """Of a drive, in the order of a first commissioning."""
    torque = bench.limits.torque
    return [
        Requirement(
            "DRIVE-01",
            "Starts in SWITCH ON DISABLED.",
            "state before the first command",
            f"{CIA402} transition 1",
            starts_disabled,
        ),
        Requirement(
            "DRIVE-02",
            f"Makes every transition of the standard, within {FOLLOW} cycles, and stays there.",
            f"all {len(LEGAL)} commands that move, from {len(ROUTES)} states",
            CIA402,
            makes_legal_transitions,
        ),
        Requirement(
            "DRIVE-03",
            "Refuses every command that is no transition of its state.",
            f"all {len(ROUTES) * 6 - len(LEGAL)} others, {_STAY} cycles each",
            CIA402,
            refuses_illegal_transitions,
        ),
        Requirement(
            "DRIVE-04",
            f"Stops within {STOP} cycles of QUICK STOP.",
            "QUICK_STOP in OPERATION ENABLED",
            "fault matrix F56",
            stops_quickly,
        ),
        Requirement(
            "DRIVE-05",
            "Holds its position while QUICK STOP ACTIVE.",
            f"QUICK_STOP after 10 cycles of {torque:g} Nm, position at the joint over 100 cycles",
            f"{CIA402} quick stop option code 6",
            holds_its_position,
        ),
        Requirement(
            "DRIVE-06",
            "Makes no torque unless OPERATION ENABLED.",
            f"{torque:g} Nm commanded in SWITCH ON DISABLED, READY TO SWITCH ON, SWITCHED ON",
            CIA402,
            makes_no_torque_disabled,
        ),
        Requirement(
            "DRIVE-07",
            "Makes the torque that is commanded, with its sign.",
            f"0, +{torque:g}, -{torque:g}, +{torque / 2:g} Nm for 12 cycles each",
            "DBC TargetTorque",
            follows_torque,
        ),
        Requirement(
            "DRIVE-08",
            "Never makes more than MaxTorque, whatever the target.",
            f"targets at both ends of the DBC range, MaxTorque {torque:g} and 0 Nm",
            "DBC MaxTorque",
            respects_the_limit,
        ),
        Requirement(
            "DRIVE-09",
            "Takes a MaxTorque at the end of its range.",
            f"target {torque:g} Nm under MaxTorque {torque:g} Nm and at the end of the DBC range",
            "DBC MaxTorque",
            takes_the_largest_limit,
        ),
        Requirement(
            "DRIVE-10",
            "Does not act on a controlword outside its range.",
            f"codes {', '.join(map(str, UNKNOWN))} in OPERATION ENABLED and SWITCH ON DISABLED",
            "DBC Controlword range",
            ignores_unknown_controlwords,
        ),
        Requirement(
            "DRIVE-11",
            "Does not act on a command with an invalid code.",
            "2 commands with each of Controlword, TargetTorque, MaxTorque invalid",
            "DBC InvalidRaw",
            ignores_invalid_codes,
        ),
        Requirement(
            "DRIVE-12",
            f"Rides through {RIDDEN} lost commands with the last one.",
            f"{RIDDEN} cycles without command at {torque:g} Nm",
            "fault matrix F24",
            rides_through,
        ),
        Requirement(
            "DRIVE-13",
            f"Latches a local hold after {LATCHED} lost commands.",
            f"{LATCHED} cycles without command in OPERATION ENABLED",
            "fault matrix F25",
            latches,
        ),
        Requirement(
            "DRIVE-14",
            "Leaves the latched hold for QUICK_STOP and then ENABLE_OPERATION alone.",
            "every other command first, then ENABLE_OPERATION alone, then both",
            "fault matrix F25",
            releases_only_when_acknowledged,
        ),
        Requirement(
            "DRIVE-15",
            "Tells the latched hold by one emergency 0x8250.",
            "EMCY after 20 cycles without command",
            "CiA 301 EMCY, RPDO timeout",
            tells_the_latch,
        ),
        Requirement(
            "DRIVE-16",
            "Rides through 3 ms without SYNC and latches the hold in 20 ms without.",
            "silence in OPERATION ENABLED",
            "fault matrix F23",
            latches_without_sync,
        ),
        Requirement(
            "DRIVE-17",
            "Ignores commands with a wrong CRC; they do not feed its watchdog.",
            "2, then 10 commands with one bit damaged, from all over the payload",
            f"{E2E}, fault matrix F26",
            _ignores(lambda axis, number: axis.push(flip=24 + 37 * number)),
        ),
        Requirement(
            "DRIVE-18",
            "Ignores commands protected for another message.",
            "2, then 10 commands with the other leg's Data ID",
            f"{E2E}, fault matrix F09",
            _ignores(lambda axis, _: axis.push(data_id=axis.other_data_id)),
        ),
        Requirement(
            "DRIVE-19",
            "Ignores another command with the counter of the last, or holds: it is another sender's.",
            "2, then 10 commands with the counter of the last good one",
            f"{E2E}, fault matrix F05, F51",
            _ignores(lambda axis, _: axis.push(counter=axis.bench.command.counter), or_holds=True),
        ),
        Requirement(
            "DRIVE-20",
            "Ignores a command that is out of sequence.",
            "one command 100 counts ahead",
            f"{E2E}, MaxDelta",
            ignores_a_jump,
        ),
        Requirement(
            "DRIVE-21",
            "Ignores commands of another length.",
            "2, then 10 commands of 32 and 64 bytes, CRC right for that length",
            "DBC length, fault matrix F10",
            _ignores(lambda axis, number: axis.push(length=(32, 64)[number % 2])),
        ),
        Requirement(
            "DRIVE-22",
            "Goes to FAULT, without torque, and tells it by an emergency 0x4xxx when it is too hot.",
            "heated in OPERATION ENABLED by the technician",
            f"{CIA402} transition 13, fault matrix F39",
            trips_when_hot,
        ),
        Requirement(
            "DRIVE-23",
            "Leaves FAULT for FAULT_RESET alone.",
            "every other command first",
            f"{CIA402} transition 15",
            leaves_fault_when_reset,
        ),
    ]


# -- CiA 402 -----------------------------------------------------------------------------------------------------------


def starts_disabled(bench: Bench) -> Outcome:
    """DRIVE-01."""
    heard = bench.states(bench.heard) or bench.states(bench.idle(10))
    return Outcome(always(heard, _S.SWITCH_ON_DISABLED), names_of(heard))


def makes_legal_transitions(bench: Bench) -> Outcome:
    """DRIVE-02."""
    axis, slowest, wrong = Axis(bench), 0, []
    for (state, controlword), (number, goal) in LEGAL.items():
        axis.go(state)
        took = axis.follow(controlword, goal)
        stayed = axis.run(_STAY, controlword)
        if took is None or not always(stayed, goal):
            wrong.append(f"{number} ({state.name}, {controlword.name}): {names_of(stayed)}")
        slowest = max(slowest, took or FOLLOW)
    text = f"wrong: {'; '.join(wrong)}" if wrong else f"all, the slowest in {slowest} cycles"
    return Outcome(not wrong, text)


def refuses_illegal_transitions(bench: Bench) -> Outcome:
    """DRIVE-03."""
    axis, wrong, tried = Axis(bench), [], 0
    for state in ROUTES:
        axis.go(state)
        for controlword in Controlword:
            if (state, controlword) in LEGAL:
                continue
            tried += 1
            heard = axis.run(_STAY, controlword)
            if not always(heard, state):
                wrong.append(f"({state.name}, {controlword.name}): {names_of(heard)}")
                axis.go(state)
    return Outcome(not wrong, f"obeyed: {'; '.join(wrong)}" if wrong else f"all {tried} refused")


def stops_quickly(bench: Bench) -> Outcome:
    """DRIVE-04."""
    axis = Axis(bench)
    axis.enable()
    took = axis.follow(_C.QUICK_STOP, _S.QUICK_STOP_ACTIVE)
    return Outcome(took is not None and took <= STOP, f"{took or f'more than {FOLLOW}'} cycles")


def holds_its_position(bench: Bench) -> Outcome:
    """DRIVE-05."""
    axis = Axis(bench)
    axis.enable()
    axis.run(10, _C.ENABLE_OPERATION, bench.limits.torque)
    if axis.follow(_C.QUICK_STOP, _S.QUICK_STOP_ACTIVE) is None:
        raise NotTested("the drive does not go to QUICK_STOP_ACTIVE; see DRIVE-02")
    heard = axis.run(100, _C.QUICK_STOP)
    positions = [h.values["Position"] / bench.robot.gear[axis.joint] for h in heard]
    gave = max(positions) - min(positions) if positions else math.inf
    return Outcome(gave <= _GIVE and always(heard, _S.QUICK_STOP_ACTIVE), f"moved {math.degrees(gave):.2f} degrees")


# -- torque ------------------------------------------------------------------------------------------------------------


def makes_no_torque_disabled(bench: Bench) -> Outcome:
    """DRIVE-06."""
    axis, most = Axis(bench), 0.0
    stay = {
        _S.SWITCH_ON_DISABLED: _C.DISABLE_VOLTAGE,
        _S.READY_TO_SWITCH_ON: _C.SHUTDOWN,
        _S.SWITCHED_ON: _C.SWITCH_ON,
    }
    for state, controlword in stay.items():
        axis.go(state)
        axis.run(3, controlword)  # what was left of a hold
        most = max(most, torque_of(axis.run(10, controlword, bench.limits.torque)), key=abs)
    return Outcome(abs(most) <= _NOISE, f"at the most {most:.2f} Nm")


def follows_torque(bench: Bench) -> Outcome:
    """DRIVE-07."""
    axis, most, found, passed = Axis(bench), bench.limits.torque, [], True
    axis.enable()
    for wanted in (0.0, most, -most, most / 2.0):
        heard = axis.run(12, _C.ENABLE_OPERATION, wanted)[2 * _SHOWN :]
        mean = mean_torque(heard)
        passed &= abs(mean - wanted) <= _NOISE
        found.append(f"{wanted:+g}: {mean:+.2f} Nm")
    return Outcome(passed, ", ".join(found))


def respects_the_limit(bench: Bench) -> Outcome:
    """DRIVE-08."""
    axis, found, passed = Axis(bench), [], True
    target = bench.command.message.signal(axis.signal("TargetTorque"))
    axis.enable()
    for limit in (bench.limits.torque, 0.0):
        for wanted in (target.maximum, target.minimum):
            most = torque_of(axis.run(12, _C.ENABLE_OPERATION, wanted, limit)[2 * _SHOWN :])
            passed &= limit / 2.0 <= abs(most) <= limit + _NOISE
            found.append(f"{wanted:+.0f} Nm under {limit:g} Nm: {most:+.2f} Nm")
    return Outcome(passed, ", ".join(found))


def takes_the_largest_limit(bench: Bench) -> Outcome:
    """DRIVE-09."""
    axis, wanted = Axis(bench), bench.limits.torque
    axis.enable()
    usual = mean_torque(axis.run(12, _C.ENABLE_OPERATION, wanted)[2 * _SHOWN :])
    most = bench.command.message.signal(axis.signal("MaxTorque")).maximum
    heard = axis.run(12, _C.ENABLE_OPERATION, wanted, most)
    made = mean_torque(heard[2 * _SHOWN :])
    passed = abs(made - usual) <= _NOISE and always(heard, _S.OPERATION_ENABLED)
    return Outcome(passed, f"{made:+.2f} Nm as against {usual:+.2f} Nm, {names_of(heard)}")


# -- commands that are none --------------------------------------------------------------------------------------------


def ignores_unknown_controlwords(bench: Bench) -> Outcome:
    """DRIVE-10."""
    axis, wrong = Axis(bench), []
    for state, stay in ((_S.OPERATION_ENABLED, _C.ENABLE_OPERATION), (_S.SWITCH_ON_DISABLED, _C.DISABLE_VOLTAGE)):
        axis.go(state)
        for code in UNKNOWN:
            heard = [*axis.send(axis.word(stay, raw={"Controlword": code})), *axis.run(2 * _SHOWN, stay)]
            if not always(heard, state):
                wrong.append(f"{code} in {state.name}: {names_of(heard)}")
    return Outcome(not wrong, f"acted on {'; '.join(wrong)}" if wrong else "all refused")


def ignores_invalid_codes(bench: Bench) -> Outcome:
    """DRIVE-11."""
    axis, found, passed = Axis(bench), [], True
    message = bench.command.message
    axis.enable()
    for quantity in ("Controlword", "TargetTorque", "MaxTorque"):
        code = message.signal(axis.signal(quantity)).invalid_raw
        assert code is not None
        # A target above the limit: whoever took the invalid MaxTorque for a limit would make it.
        limit, wanted = bench.limits.torque / 3.0, bench.limits.torque
        heard = axis.run(6, _C.ENABLE_OPERATION, 0.0, limit)[2 * _SHOWN :]
        for _ in range(2):
            heard += axis.send(axis.word(_C.ENABLE_OPERATION, wanted, limit, raw={quantity: code}))
        heard += axis.run(2 * _SHOWN, _C.ENABLE_OPERATION, 0.0, limit)
        most = torque_of(heard)
        passed &= abs(most) <= _NOISE and always(heard, _S.OPERATION_ENABLED)
        found.append(f"{quantity}: {most:+.2f} Nm, {names_of(heard)}")
    return Outcome(passed, "; ".join(found))


def _ignores(bad: Callable[[Axis, int], Frames], *, or_holds: bool = False) -> Callable[[Bench], Outcome]:
    """Two bad commands change nothing; ten of them, and nothing else, latch the hold. `or_holds`: so may the first."""

    def test(bench: Bench) -> Outcome:
        axis = Axis(bench)
        axis.enable()
        heard = [h for number in range(2) for h in axis.send(bad(axis, number))]
        heard += axis.run(2 * _SHOWN, _C.ENABLE_OPERATION)
        holds = [h for h in heard if or_holds and state_of(h) == _S.QUICK_STOP_ACTIVE]
        obeys = [h for h in heard if h not in holds]
        most = torque_of(obeys)
        if abs(most) > _NOISE or any(state_of(h) != _S.OPERATION_ENABLED for h in obeys) or not heard:
            return Outcome(False, f"acted on: {most:+.2f} Nm, {names_of(heard)}")
        if holds:
            return Outcome(True, f"{most:+.2f} Nm, {names_of(heard)}")
        axis.run(4, _C.ENABLE_OPERATION)
        heard = [h for number in range(2 * LATCHED) for h in axis.send(bad(axis, number))]
        fed = always(heard, _S.OPERATION_ENABLED)
        return Outcome(not fed, f"{most:+.2f} Nm; {'fed the watchdog' if fed else 'latched without a good one'}")

    return test


def ignores_a_jump(bench: Bench) -> Outcome:
    """DRIVE-20."""
    axis = Axis(bench)
    axis.enable()
    heard = axis.send(axis.push(counter=(bench.command.counter + 100) & 0xFF))
    heard += axis.run(2 * _SHOWN, _C.ENABLE_OPERATION)
    most = torque_of(heard)
    return Outcome(abs(most) <= _NOISE and always(heard, _S.OPERATION_ENABLED), f"{most:+.2f} Nm, {names_of(heard)}")


# -- when the HAL is not heard -----------------------------------------------------------------------------------------


def rides_through(bench: Bench) -> Outcome:
    """DRIVE-12."""
    axis, wanted = Axis(bench), bench.limits.torque
    axis.enable()
    before = mean_torque(axis.run(12, _C.ENABLE_OPERATION, wanted)[2 * _SHOWN :])
    heard = bench.states([h for _ in range(RIDDEN) for h in bench.cycle()])
    heard += axis.run(2 * _SHOWN, _C.ENABLE_OPERATION, wanted)
    least = min((h.values["Torque"] for h in heard), default=math.nan)
    passed = always(heard, _S.OPERATION_ENABLED) and least >= before - _NOISE
    return Outcome(passed, f"at least {least:+.2f} of {before:+.2f} Nm, {names_of(heard)}")


def latches(bench: Bench) -> Outcome:
    """DRIVE-13."""
    axis = Axis(bench)
    axis.enable()
    heard = bench.states([h for _ in range(LATCHED) for h in bench.cycle()])
    heard += axis.run(2 * _SHOWN, _C.ENABLE_OPERATION)
    stopped = any(state_of(h) == _S.QUICK_STOP_ACTIVE for h in heard)
    return Outcome(stopped, names_of(heard))


def releases_only_when_acknowledged(bench: Bench) -> Outcome:
    """DRIVE-14."""
    axis = Axis(bench)
    _latch(axis)
    for controlword in (_C.ENABLE_OPERATION, _C.SHUTDOWN, _C.SWITCH_ON, _C.FAULT_RESET, _C.ENABLE_OPERATION):
        heard = axis.run(_STAY, controlword)
        if not always(heard, _S.QUICK_STOP_ACTIVE):
            return Outcome(False, f"{controlword.name} alone: {names_of(heard)}")
    axis.run(FOLLOW, _C.QUICK_STOP)
    took = axis.follow(_C.ENABLE_OPERATION, _S.OPERATION_ENABLED)
    text = "stays after QUICK_STOP and ENABLE_OPERATION" if took is None else f"enabled {took} cycles after both"
    return Outcome(took is not None, text)


def tells_the_latch(bench: Bench) -> Outcome:
    """DRIVE-15."""
    axis = Axis(bench)
    axis.enable()
    first = len(bench.heard)
    bench.idle(20)
    told = _emergencies(bench, first)
    return Outcome(told == [COMMAND_TIMEOUT], f"emergencies: {_codes(told)}")


def latches_without_sync(bench: Bench) -> Outcome:
    """DRIVE-16."""
    axis = Axis(bench)
    axis.enable()
    for _ in range(3):
        bench.silent_cycle()
    short = axis.run(2 * _SHOWN, _C.ENABLE_OPERATION)
    for _ in range(20):
        bench.silent_cycle()
    long = axis.run(2 * _SHOWN, _C.ENABLE_OPERATION)
    # Whether it stays in the hold is DRIVE-14.
    passed = always(short, _S.OPERATION_ENABLED) and any(state_of(h) == _S.QUICK_STOP_ACTIVE for h in long)
    return Outcome(passed, f"after 3 ms {names_of(short)}, after 20 ms {names_of(long)}")


def _latch(axis: Axis) -> None:
    """Bring the latched hold about by silence of the HAL. Raises `NotTested`."""
    axis.enable()
    heard = axis.bench.states(axis.bench.idle(4 * LATCHED))
    if not heard or state_of(heard[-1]) != _S.QUICK_STOP_ACTIVE:
        raise NotTested("the drive does not latch a hold when commands stay away")


# -- fault -------------------------------------------------------------------------------------------------------------


def trips_when_hot(bench: Bench) -> Outcome:
    """DRIVE-22."""
    axis = Axis(bench)
    axis.enable()
    first = len(bench.heard)

    def is_faulty(heard: list[Heard]) -> bool:
        return any(state_of(h) == _S.FAULT for h in bench.states(heard))

    def enabled() -> list[Heard]:
        return bench.cycle(axis.word(_C.ENABLE_OPERATION))

    if not bench.ask(Action.OVERHEAT, is_faulty, enabled):
        return Outcome(False, "does not trip")
    axis.run(2 * _SHOWN, _C.ENABLE_OPERATION, bench.limits.torque)
    made = torque_of(axis.run(2 * _SHOWN, _C.ENABLE_OPERATION, bench.limits.torque))
    told = _emergencies(bench, first)
    hot = [code for code in told if code & 0xF000 == TEMPERATURE_CLASS]
    return Outcome(len(hot) == 1 and abs(made) <= _NOISE, f"emergencies: {_codes(told)}; {made:+.2f} Nm in FAULT")


def leaves_fault_when_reset(bench: Bench) -> Outcome:
    """DRIVE-23."""
    axis = Axis(bench)
    heard = axis.run(_SHOWN, _C.ENABLE_OPERATION)
    if not always(heard[-1:], _S.FAULT):
        raise NotTested("the drive is not in FAULT; see DRIVE-22")
    bench.technician.please(Action.COOL, bench.node.name)
    for controlword in Controlword:
        if controlword is not _C.FAULT_RESET:
            heard = axis.run(_STAY, controlword)
            if not always(heard, _S.FAULT):
                return Outcome(False, f"{controlword.name}: {names_of(heard)}")

    def is_reset(heard: list[Heard]) -> bool:
        return any(state_of(h) == _S.SWITCH_ON_DISABLED for h in bench.states(heard))

    def reset() -> list[Heard]:
        return bench.cycle(axis.word(_C.FAULT_RESET))

    passed = bench.until(is_reset, reset)
    return Outcome(passed, "SWITCH_ON_DISABLED after FAULT_RESET alone" if passed else "stays in FAULT")


def _emergencies(bench: Bench, first: int) -> list[int]:
    return [
        int(h.values["ErrorCode"])
        for h in bench.heard[first:]
        if h.message is bench.emergency_message and h.values and h.values["ErrorCode"]
    ]


def _codes(codes: list[int]) -> str:
    return ", ".join(f"{code:#06x}" for code in codes) or "none"

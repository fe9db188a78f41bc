"""What every node owes the bus: start-up, heartbeat, an answer to every SYNC, E2E, formats, and calm under nonsense."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from itertools import pairwise
from typing import Final

import numpy as np

from atalante_hal.wire.frame import FLAG_BRS, FLAG_FDF, ID_EXTENDED, Frames, new_frames
from atalante_tools.conform.bench import Bench, NotTested
from atalante_tools.conform.frames import Heard
from atalante_tools.conform.requirement import Outcome, Requirement
from atalante_tools.conform.technician import Action

#: NMT states in the heartbeat (CiA 301).
NMT: Final = {0: "BOOTUP", 4: "STOPPED", 5: "OPERATIONAL", 127: "PRE_OPERATIONAL"}
#: Cycles without any frame after which a node counts as switched off.
_OFF: Final = 250
#: Undisturbed cycles on which heartbeat and answers are judged.
_HEARTBEAT_CYCLES, _ANSWER_CYCLES = 520, 200
#: Allowed difference of the heartbeat's mean period, and of one period, from the DBC's.
_MEAN, _ONE = 0.1, 0.5
#: Foreign frames a cycle, and cycles, of the flood: as many as a wire has room for beside the cyclic set.
_FLOOD, _FLOOD_CYCLES = 6, 100
#: Bits of SYNC that are damaged: of its CRC, of the HAL's state, of the cycle's number.
_DAMAGED: Final = (0, 5, 10, 15, *range(24, 32), *range(48, 56))
#: Wrong SYNCs of a kind.
_WRONG: Final = len(_DAMAGED)
#: Defects named one by one in a result; the rest are counted.
_NAMED: Final = 3


def requirements(bench: Bench) -> tuple[list[Requirement], list[Requirement]]:
    """Those to test before and after what is special about the node: at rest, and over everything heard."""
    node, state = bench.node.name, bench.state_message
    e2e, frame = "AUTOSAR E2E Profile 5", f"DBC {state.name}"
    before = [
        Requirement(
            "NODE-01",
            "Begins with one BOOTUP heartbeat, then says OPERATIONAL.",
            "switch the node on, read its first two heartbeats",
            "CiA 301 boot-up",
            boots_up,
        ),
        Requirement(
            "NODE-02",
            "Reports the hash of this network description.",
            "DbcHash of the heartbeat",
            "fault matrix F53",
            has_our_hash,
        ),
        Requirement(
            "NODE-03",
            f"Sends its heartbeat every {bench.status_message.cycle_ms} ms (mean within 10 %, each within 50 %).",
            f"SYNC alone for {_HEARTBEAT_CYCLES} ms",
            f"DBC {bench.status_message.name} GenMsgCycleTime",
            keeps_its_heartbeat,
        ),
        Requirement(
            "NODE-04",
            "Answers every SYNC of its bus with one state frame."
            if state.cycle_ms == 1
            else f"Sends its state every {state.cycle_ms} ms.",
            f"SYNC alone for {_ANSWER_CYCLES} ms",
            f"{frame} GenMsgCycleTime",
            answers_every_sync,
        ),
        Requirement("NODE-05", "Raises no emergency at rest.", "everything heard so far", "CiA 301 EMCY", is_calm),
    ]
    if state.cycle_ms == 1:
        before += [
            Requirement(
                "NODE-06",
                "Says no state without SYNC.",
                "10 ms of silence",
                "DBC SYNC: the nodes of this bus sample and answer",
                is_silent_without_sync,
            ),
            Requirement(
                "NODE-07",
                "Does not answer a SYNC with a wrong CRC.",
                f"every other SYNC with one bit damaged, {_WRONG} times",
                e2e,
                _ignores_sync(lambda b, i: b.sync_frame(flip=_DAMAGED[i])),
            ),
            Requirement(
                "NODE-08",
                "Does not answer a repeated SYNC.",
                f"every other SYNC with the counter of the last, {_WRONG} times",
                e2e,
                _ignores_sync(lambda b, _: b.sync_frame(counter=b.sync.counter)),
            ),
            Requirement(
                "NODE-09",
                "Does not answer a SYNC of another length or of classic CAN.",
                f"every other SYNC 7, 12, 16 or 64 bytes long or classic, {_WRONG} times",
                "DBC SYNC length, VFrameFormat",
                _ignores_sync(_sync_of_another_length),
            ),
        ]
    before.append(
        Requirement(
            "NODE-10",
            "Is not disturbed by frames of other identifiers.",
            f"{_FLOOD} random foreign frames before each of {_FLOOD_CYCLES} SYNCs: 11 and 29 bit, FD and classic",
            "fault matrix F11",
            stands_a_flood,
        )
    )
    everything = "every frame heard in this examination"
    after = [
        Requirement(
            "NODE-11",
            "Counts every frame of each message on by one; an answer to SYNC carries the low byte of its Cycle as counter.",
            everything,
            e2e,
            _all(_counter_defects),
        ),
        Requirement(
            "NODE-12",
            "Protects every frame with the CRC over payload and Data ID.",
            everything,
            e2e,
            _all(lambda heard: [f"{h.message.name} in cycle {h.cycle}" for h in heard if not h.crc_right]),
        ),
        Requirement(
            "NODE-13",
            "Sends CAN FD frames with bit rate switch, of exactly the length of the DBC.",
            everything,
            "DBC length, VFrameFormat",
            _all(
                lambda heard: [
                    f"{h.message.name} in cycle {h.cycle}" for h in heard if not (h.length_right and h.format_right)
                ]
            ),
        ),
        Requirement(
            "NODE-14",
            "Keeps every signal inside its range and sends no invalid code.",
            everything,
            "DBC ranges, InvalidRaw",
            _all(lambda heard: [f"{h.message.name}.{name} in cycle {h.cycle}" for h in heard for name in h.outside]),
        ),
        Requirement(
            "NODE-15",
            "Sends reserved bits as 0.",
            everything,
            f"DBC layout of the messages of {node}",
            _all(lambda heard: [f"{h.message.name} in cycle {h.cycle}" for h in heard if not h.reserved_zero]),
        ),
    ]
    return before, after


# -- start-up and heartbeat --------------------------------------------------------------------------------------------


def boots_up(bench: Bench) -> Outcome:
    """NODE-01."""
    if not bench.technician.fresh:
        silent = 0

        def is_off(heard: list[Heard]) -> bool:
            nonlocal silent
            silent = 0 if heard else silent + 1
            return silent >= _OFF

        bench.ask(Action.POWER_UP, is_off)
    bench.technician.fresh = False
    bench.heard.clear()
    if not bench.until(lambda _: len(_statuses(bench)) >= 2):
        return Outcome(False, f"{len(_statuses(bench))} heartbeats within {bench.technician.patience:g} s")
    said = [NMT.get(int(h.values["NodeState"]), "no NMT state") for h in _statuses(bench)]
    return Outcome(said == ["BOOTUP", "OPERATIONAL"], ", then ".join(said))


def has_our_hash(bench: Bench) -> Outcome:
    """NODE-02."""
    heard = _statuses(bench) or _statuses(bench, bench.idle(2 * bench.status_message.cycle_ms))
    if not heard:
        raise NotTested("no heartbeat was heard")
    said, ours = int(heard[-1].values["DbcHash"]), bench.network.hash32
    return Outcome(said == ours, f"{said:#010x}" if said == ours else f"{said:#010x}, this network is {ours:#010x}")


def keeps_its_heartbeat(bench: Bench) -> Outcome:
    """NODE-03."""
    period = bench.status_message.cycle_ms * 1e-3
    times = [h.time for h in _statuses(bench, bench.idle(_HEARTBEAT_CYCLES))]
    gaps = np.diff(times)
    if len(gaps) < _HEARTBEAT_CYCLES // bench.status_message.cycle_ms // 2:
        return Outcome(False, f"{len(times)} heartbeats in {_HEARTBEAT_CYCLES} ms")
    mean, worst = float(gaps.mean()), float(gaps[np.argmax(np.abs(gaps - period))])
    passed = abs(mean - period) <= _MEAN * period and abs(worst - period) <= _ONE * period
    return Outcome(passed, f"mean {mean * 1e3:.1f} ms, worst {worst * 1e3:.1f} ms")


def answers_every_sync(bench: Bench) -> Outcome:
    """NODE-04."""
    return _answered(bench, bench.idle(_ANSWER_CYCLES), _ANSWER_CYCLES)


def is_calm(bench: Bench) -> Outcome:
    """NODE-05."""
    raised = [h for h in bench.heard if h.message is bench.emergency_message]
    return Outcome(not raised, f"{len(raised)} emergencies" if raised else "no emergency")


# -- SYNC and strangers ------------------------------------------------------------------------------------------------


def is_silent_without_sync(bench: Bench) -> Outcome:
    """NODE-06."""
    bench.silent_cycle()  # the answer to the last SYNC may still be on its way
    heard = bench.states([h for _ in range(10) for h in bench.silent_cycle()])
    bench.idle(2)
    return Outcome(not heard, f"{len(heard)} state frames in 10 ms of silence")


def stands_a_flood(bench: Bench) -> Outcome:
    """NODE-10."""
    random = np.random.default_rng(0)
    known = [m.frame_id for m in bench.network.messages]
    heard = [h for _ in range(_FLOOD_CYCLES) for h in bench.cycle(before=_strangers(random, known))]
    return _answered(bench, heard, _FLOOD_CYCLES)


def _ignores_sync(wrong: Callable[[Bench, int], Frames]) -> Callable[[Bench], Outcome]:
    """Right and wrong SYNCs in turn: the wrong ones are not answered, the right ones are."""

    def test(bench: Bench) -> Outcome:
        answers: Counter[bool] = Counter()
        for number in range(_WRONG):
            answers[False] += len(bench.states(bench.cycle(sync=wrong(bench, number))))
            answers[True] += len(bench.states(bench.cycle()))
        text = f"{answers[False]} of {_WRONG} wrong ones answered, {answers[True]} of {_WRONG} right ones"
        return Outcome(answers[False] == 0 and answers[True] == _WRONG, text)

    return test


def _sync_of_another_length(bench: Bench, number: int) -> Frames:
    kind = number % 5
    return bench.sync_frame(classic=True) if kind == 4 else bench.sync_frame(length=(7, 12, 16, 64)[kind])


def _strangers(random: np.random.Generator, known: list[int]) -> Frames:
    """Random frames that are no message of the network; the first has the highest priority there is."""
    frames = new_frames(_FLOOD)
    frames["data"][:, :8] = random.integers(0, 256, (_FLOOD, 8), np.uint8)
    for place, frame in enumerate(frames):
        extended = bool(random.integers(2))
        can_id = int(random.integers(1 << (29 if extended else 11))) if place else 0
        while can_id in known:
            can_id = int(random.integers(1 << 11))
        frame["can_id"] = can_id | (ID_EXTENDED if extended else 0)
        fd = bool(random.integers(2))
        frame["flags"], frame["len"] = (FLAG_FDF | FLAG_BRS, 8) if fd else (0, int(random.integers(9)))
    return frames


# -- over everything heard ---------------------------------------------------------------------------------------------


def _all(defects_of: Callable[[list[Heard]], list[str]]) -> Callable[[Bench], Outcome]:
    """A law that every frame has to keep."""

    def test(bench: Bench) -> Outcome:
        if bench.dropped:
            raise NotTested(f"this computer lost {bench.dropped} frames")
        if not bench.heard:
            raise NotTested("the node said nothing")
        defects = defects_of(bench.heard)
        named = ", ".join(defects[:_NAMED]) + ", ..." * (len(defects) > _NAMED)
        frames = f"{len(bench.heard)} frames"
        return Outcome(not defects, f"{len(defects)} of {frames}: {named}" if defects else f"{frames}, all right")

    return test


def _counter_defects(heard: list[Heard]) -> list[str]:
    by_message: dict[str, list[Heard]] = {}
    for h in heard:
        if h.message.cycle_ms != 1:
            by_message.setdefault(h.message.name, []).append(h)
    return [
        f"{h.message.name} {h.counter} in cycle {h.cycle}, which ends in {h.cycle & 0xFF}"
        for h in heard
        if h.message.cycle_ms == 1 and h.counter != h.cycle & 0xFF
    ] + [
        f"{name} {after.counter} after {before.counter} in cycle {after.cycle}"
        for name, frames in by_message.items()
        for before, after in pairwise(frames)
        if (after.counter - before.counter) & 0xFF != 1
    ]


def _statuses(bench: Bench, heard: list[Heard] | None = None) -> list[Heard]:
    return [h for h in (bench.heard if heard is None else heard) if h.message is bench.status_message and h.values]


def _answered(bench: Bench, heard: list[Heard], cycles: int) -> Outcome:
    """Whether state frames came when they should, `heard` in `cycles` cycles."""
    every = bench.state_message.cycle_ms
    at = [h.cycle for h in heard if h.message is bench.state_message]
    if every == 1:
        per_cycle = Counter(at)
        wrong = cycles - sum(count == 1 for count in per_cycle.values())
        return Outcome(wrong == 0, f"{len(at)} answers to {cycles} SYNCs, {wrong} SYNCs without exactly one")
    gaps = [after - before for before, after in pairwise(at)]
    passed = len(at) >= cycles // every - 1 and all(abs(gap - every) <= every // 2 for gap in gaps)
    return Outcome(passed, f"{len(at)} in {cycles} ms, {min(gaps, default=0)} to {max(gaps, default=0)} ms apart")

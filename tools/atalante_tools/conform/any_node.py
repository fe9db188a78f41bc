"""Requirements for every node: start-up, heartbeat, answer to SYNC, E2E protection, frame format, foreign frames."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from itertools import dropwhile, pairwise
from typing import Final

import numpy as np

from atalante_hal.wire.frame import FLAG_BRS, FLAG_FDF, ID_EXTENDED, Frames, new_frames
from atalante_tools.conform.frames import ReceivedFrame
from atalante_tools.conform.node_tester import NodeTester, NotTested
from atalante_tools.conform.requirement import E2E, Outcome, Requirement
from atalante_tools.conform.technician import Action

#: NMT states in the heartbeat (CiA 301).
NMT: Final = {0: "BOOTUP", 4: "STOPPED", 5: "OPERATIONAL", 127: "PRE_OPERATIONAL"}
#: A node is considered to be switched off if it sends no frame in `_OFF` consecutive cycles.
_OFF: Final = 250
#: `_HEARTBEAT_CYCLES` is the duration of the heartbeat test [cycles].
#: `_ANSWER_CYCLES` is the duration of the test that checks the answers to SYNC [cycles].
_HEARTBEAT_CYCLES, _ANSWER_CYCLES = 520, 200
#: Largest accepted deviations of the measured heartbeat period, as a fraction of the period in the DBC.
#: `_MEAN` limits the deviation of the mean of all measured periods, `_SINGLE` the deviation of each period.
_MEAN, _SINGLE = 0.1, 0.5
#: The flood test sends `_FLOOD` random frames in each of `_FLOOD_CYCLES` cycles. The bus load stays below 100 %.
_FLOOD, _FLOOD_CYCLES = 6, 100
#: Bit numbers in the SYNC payload. To damage SYNC number k, a test inverts only the bit `_DAMAGED[k]`.
#: The bits belong to the CRC (0 to 15), the HAL state or the cycle number.
_DAMAGED: Final = (0, 5, 10, 15, *range(24, 32), *range(48, 56))
#: Number of defective SYNCs in each SYNC test. The test sends one valid SYNC after each defective SYNC.
_WRONG: Final = len(_DAMAGED)
#: A test result describes only the first 3 defects. It also gives the number of all defects.
_LISTED: Final = 3


def requirements_at_rest(tester: NodeTester) -> list[Requirement]:
    """Return the requirements for all nodes, tested while the node is at rest."""
    state = tester.state_message
    requirements = [
        Requirement(
            "NODE-01",
            "Sends one BOOTUP heartbeat after power-up, then OPERATIONAL.",
            "power the node up, read its first two heartbeats",
            "CiA 301 boot-up",
            boots_up,
        ),
        Requirement(
            "NODE-02",
            "Reports the hash of this network description.",
            "DbcHash of the heartbeat",
            "fault matrix F53",
            reports_the_dbc_hash,
        ),
        Requirement(
            "NODE-03",
            f"Sends its heartbeat every {tester.status_message.cycle_ms} ms (mean within 10 %, each within 50 %).",
            f"only SYNC sent for {_HEARTBEAT_CYCLES} ms",
            f"DBC {tester.status_message.name} GenMsgCycleTime",
            keeps_its_heartbeat,
        ),
        Requirement(
            "NODE-04",
            "Answers every SYNC of its bus with one state frame."
            if state.cycle_ms == 1
            else f"Sends its state every {state.cycle_ms} ms.",
            f"only SYNC sent for {_ANSWER_CYCLES} ms",
            f"DBC {state.name} GenMsgCycleTime",
            answers_every_sync,
        ),
        Requirement(
            "NODE-05", "Sends no emergency at rest.", "all frames received so far", "CiA 301 EMCY", raises_no_emergency
        ),
    ]
    if state.cycle_ms == 1:
        requirements += [
            Requirement(
                "NODE-06",
                "Sends no state frame without SYNC.",
                "10 ms without SYNC",
                "DBC SYNC: the nodes of this bus sample and answer",
                is_silent_without_sync,
            ),
            Requirement(
                "NODE-07",
                "Does not answer a SYNC with a wrong CRC.",
                f"every second SYNC with one bit flipped, {_WRONG} times",
                E2E,
                _ignores_sync(lambda b, i: b.sync_frame(flip=_DAMAGED[i])),
            ),
            Requirement(
                "NODE-08",
                "Does not answer a repeated SYNC.",
                f"every second SYNC with the counter of the previous SYNC, {_WRONG} times",
                E2E,
                _ignores_sync(lambda b, _: b.sync_frame(counter=b.sync.counter)),
            ),
            Requirement(
                "NODE-09",
                "Does not answer a SYNC with a wrong length or in classic CAN format.",
                f"every second SYNC 7, 12, 16 or 64 bytes long or in classic CAN format, {_WRONG} times",
                "DBC SYNC length, VFrameFormat",
                _ignores_sync(_sync_of_another_length),
            ),
        ]
    requirements.append(
        Requirement(
            "NODE-10",
            "Answers every SYNC while frames with unknown identifiers are on the bus.",
            f"{_FLOOD} random frames before each of {_FLOOD_CYCLES} SYNCs: 11-bit and 29-bit identifiers, CAN FD and classic CAN",
            "fault matrix F11",
            tolerates_foreign_frames,
        )
    )
    return requirements


def requirements_on_all_frames(tester: NodeTester) -> list[Requirement]:
    """Return the requirements for all nodes, tested on all frames received in the examination."""
    all_frames = "all frames received in this examination"
    return [
        Requirement(
            "NODE-11",
            "Increments each counter by 1 per frame; the counter of an answer to SYNC is the low byte of Cycle.",
            all_frames,
            E2E,
            _all(_counter_defects),
        ),
        Requirement(
            "NODE-12",
            "Protects every frame with a CRC over payload and Data ID.",
            all_frames,
            E2E,
            _all(_crc_defects),
        ),
        Requirement(
            "NODE-13",
            "Sends CAN FD data frames with 11-bit identifier, bit rate switch and the length given in the DBC.",
            all_frames,
            "DBC length, VFrameFormat",
            _all(_format_defects, with_unexpected=True),
        ),
        Requirement(
            "NODE-14",
            "Sends every signal within its range and never with its invalid code.",
            all_frames,
            "DBC ranges, InvalidRaw",
            _all(_range_defects),
        ),
        Requirement(
            "NODE-15",
            "Sends every reserved bit as 0.",
            all_frames,
            f"DBC layout of the messages of {tester.node.name}",
            _all(
                lambda received: [
                    f"{frame.message.name} in cycle {frame.cycle}" for frame in received if not frame.reserved_zero
                ]
            ),
        ),
        Requirement(
            "NODE-16",
            "Reports OPERATIONAL in every heartbeat after the boot-up.",
            all_frames,
            "CiA 301 heartbeat",
            stays_operational,
        ),
    ]


# -- start-up and heartbeat --------------------------------------------------------------------------------------------


def boots_up(tester: NodeTester) -> Outcome:
    """Test NODE-01: the node sends one BOOTUP heartbeat after power-up, then OPERATIONAL."""
    if not tester.technician.fresh:
        silent = 0

        def is_off(received: list[ReceivedFrame]) -> bool:
            nonlocal silent
            silent = 0 if received else silent + 1
            return silent >= _OFF

        tester.request(Action.POWER_UP, is_off)
    tester.technician.fresh = False
    tester.received.clear()
    tester.unexpected.clear()
    if not tester.run_until(lambda _: len(_statuses(tester)) >= 2):
        return Outcome(False, f"{len(_statuses(tester))} heartbeats within {tester.technician.patience:g} s")
    reported = [_nmt_state(frame) for frame in _statuses(tester)]
    return Outcome(reported == ["BOOTUP", "OPERATIONAL"], ", then ".join(reported))


def reports_the_dbc_hash(tester: NodeTester) -> Outcome:
    """Test NODE-02: the node reports the same DBC hash as this computer."""
    received = _statuses(tester) or _statuses(tester, tester.idle(2 * tester.status_message.cycle_ms))
    if not received:
        raise NotTested("no heartbeat received")
    reported, ours = int(received[-1].values["DbcHash"]), tester.network.hash32
    text = f"{reported:#010x}" if reported == ours else f"{reported:#010x}, expected {ours:#010x}"
    return Outcome(reported == ours, text)


def keeps_its_heartbeat(tester: NodeTester) -> Outcome:
    """Test NODE-03: the node sends heartbeats with the period in the DBC."""
    period = tester.status_message.cycle_ms * 1e-3
    times = [frame.time for frame in _statuses(tester, tester.idle(_HEARTBEAT_CYCLES))]
    gaps = np.diff(times)
    if len(gaps) < _HEARTBEAT_CYCLES // tester.status_message.cycle_ms // 2:
        return Outcome(False, f"{len(times)} heartbeats in {_HEARTBEAT_CYCLES} ms")
    mean, worst = float(gaps.mean()), float(gaps[np.argmax(np.abs(gaps - period))])
    passed = abs(mean - period) <= _MEAN * period and abs(worst - period) <= _SINGLE * period
    return Outcome(passed, f"mean {mean * 1e3:.1f} ms, worst {worst * 1e3:.1f} ms")


def answers_every_sync(tester: NodeTester) -> Outcome:
    """Test NODE-04: the node sends one state frame per SYNC.

    If the DBC gives the state frame a period above 1 ms, test instead that the node keeps this period.
    """
    return _answered(tester, tester.idle(_ANSWER_CYCLES), _ANSWER_CYCLES)


def raises_no_emergency(tester: NodeTester) -> Outcome:
    """Test NODE-05: the node has sent no emergency message so far."""
    if not tester.received:
        tester.idle(_ANSWER_CYCLES)
    raised = [frame for frame in tester.received if frame.message is tester.emergency_message]
    codes = ", ".join(
        f"{int(frame.values['ErrorCode']):#06x}" if frame.values else "wrong length" for frame in raised[:_LISTED]
    )
    more = ", ..." * (len(raised) > _LISTED)
    return Outcome(not raised, f"{len(raised)} emergencies: {codes}{more}" if raised else "no emergency")


# -- SYNC and foreign frames -------------------------------------------------------------------------------------------


def is_silent_without_sync(tester: NodeTester) -> Outcome:
    """Test NODE-06: the node sends no state frame without SYNC."""
    tester.silent_cycle()  # the answer to the last SYNC may still arrive
    received = tester.states([frame for _ in range(10) for frame in tester.silent_cycle()])
    text = f"{len(received)} state frames in 10 ms without SYNC"
    answers = tester.states(tester.idle(2))
    if not (received or answers):
        raise NotTested(f"{text}, and no state frame of the DBC length after SYNC; see NODE-04 and NODE-13")
    return Outcome(not received, text)


def tolerates_foreign_frames(tester: NodeTester) -> Outcome:
    """Test NODE-10: the node answers every SYNC while frames with unknown identifiers are on the bus."""
    random = np.random.default_rng(0)
    known = [m.frame_id for m in tester.network.messages]
    received = [frame for _ in range(_FLOOD_CYCLES) for frame in tester.cycle(before=_foreign_frames(random, known))]
    return _answered(tester, received, _FLOOD_CYCLES)


def _ignores_sync(wrong: Callable[[NodeTester, int], Frames]) -> Callable[[NodeTester], Outcome]:
    """Return a test that sends defective and valid SYNCs alternately. The node must answer only the valid SYNCs."""

    def test(tester: NodeTester) -> Outcome:
        answers: Counter[bool] = Counter()
        for number in range(_WRONG):
            answers[False] += len(tester.states(tester.cycle(sync=wrong(tester, number))))
            answers[True] += len(tester.states(tester.cycle()))
        text = f"{answers[False]} of {_WRONG} wrong SYNCs answered, {answers[True]} of {_WRONG} right SYNCs answered"
        return Outcome(answers[False] == 0 and answers[True] == _WRONG, text)

    return test


def _sync_of_another_length(tester: NodeTester, number: int) -> Frames:
    kind = number % 5
    return tester.sync_frame(classic=True) if kind == 4 else tester.sync_frame(length=(7, 12, 16, 64)[kind])


def _foreign_frames(random: np.random.Generator, known: list[int]) -> Frames:
    """Return random frames with unknown identifiers. The first frame has the highest bus priority. Shape (_FLOOD,)."""
    frames = new_frames(_FLOOD)
    frames["data"][:, :8] = random.integers(0, 256, (_FLOOD, 8), np.uint8)
    for index, frame in enumerate(frames):
        extended = bool(random.integers(2))
        can_id = int(random.integers(1 << (29 if extended else 11))) if index else 0
        while can_id in known:
            can_id = int(random.integers(1 << 11))
        frame["can_id"] = can_id | (ID_EXTENDED if extended else 0)
        fd = bool(random.integers(2))
        frame["flags"], frame["len"] = (FLAG_FDF | FLAG_BRS, 8) if fd else (0, int(random.integers(9)))
    return frames


# -- all frames received --------------------------------------------------------------------------------------------------


def _all(
    defects_of: Callable[[list[ReceivedFrame]], list[str]], *, with_unexpected: bool = False
) -> Callable[[NodeTester], Outcome]:
    """Return a test of all received frames. The test passes if `defects_of` returns no defect.

    Args:
        defects_of: function that returns a text for each defect of the received frames.
        with_unexpected: True if each frame in `NodeTester.unexpected` is a defect.
    """

    def test(tester: NodeTester) -> Outcome:
        if tester.dropped:
            raise NotTested(f"this computer lost {tester.dropped} frames")
        unexpected = tester.unexpected if with_unexpected else []
        count = len(tester.received) + len(unexpected)
        if not count:
            raise NotTested("no frame of the node was received")
        defects = unexpected + defects_of(tester.received)
        named = ", ".join(defects[:_LISTED]) + ", ..." * (len(defects) > _LISTED)
        frames = f"{count} frames"
        return Outcome(not defects, f"{len(defects)} of {frames}: {named}" if defects else f"{frames}, no defect")

    return test


def stays_operational(tester: NodeTester) -> Outcome:
    """Test NODE-16: all heartbeats after the boot-up report OPERATIONAL."""
    states = [(_nmt_state(frame), frame.cycle) for frame in _statuses(tester)]
    after_boot = list(dropwhile(lambda state: state[0] == "BOOTUP", states))
    if not after_boot:
        raise NotTested("no heartbeat was received after the boot-up message")
    wrong = [f"{state} in cycle {cycle}" for state, cycle in after_boot if state != "OPERATIONAL"]
    count = f"{len(after_boot)} heartbeats"
    return Outcome(
        not wrong, f"{len(wrong)} of {count}: {', '.join(wrong[:_LISTED])}" if wrong else f"{count}, no defect"
    )


def _counter_defects(received: list[ReceivedFrame]) -> list[str]:
    by_message: dict[str, list[ReceivedFrame]] = {}
    for frame in received:
        if frame.message.cycle_ms != 1:
            by_message.setdefault(frame.message.name, []).append(frame)
    return [
        f"{frame.message.name} {_counter_text(frame)} in cycle {frame.cycle}, expected {frame.cycle & 0xFF}"
        for frame in received
        if frame.message.cycle_ms == 1 and frame.counter != frame.cycle & 0xFF
    ] + [
        f"{name} {_counter_text(after)} after {_counter_text(before)} in cycle {after.cycle}"
        for name, frames in by_message.items()
        for before, after in pairwise(frames)
        if (after.counter - before.counter) & 0xFF != 1
    ]


def _counter_text(frame: ReceivedFrame) -> str:
    return str(frame.counter) if frame.counter >= 0 else "without counter"


def _nmt_state(status: ReceivedFrame) -> str:
    state = int(status.values["NodeState"])
    return NMT.get(state, f"unknown NMT state {state}")


def _crc_defects(received: list[ReceivedFrame]) -> list[str]:
    return [
        f"{frame.message.name} in cycle {frame.cycle} ("
        + (f"{frame.crc:#06x}, expected {frame.crc_expected:#06x})" if frame.crc >= 0 else "no CRC)")
        for frame in received
        if not frame.crc_valid
    ]


def _format_defects(received: list[ReceivedFrame]) -> list[str]:
    defects = []
    for frame in received:
        wrong = [] if frame.length_valid else [f"{frame.length} bytes, expected {frame.message.length}"]
        wrong += [] if frame.format_valid else [frame.format]
        if wrong:
            defects.append(f"{frame.message.name} in cycle {frame.cycle} ({'; '.join(wrong)})")
    return defects


def _range_defects(received: list[ReceivedFrame]) -> list[str]:
    defects = []
    for frame in received:
        for name in frame.out_of_range:
            signal = frame.message.signal(name)
            text = f"{frame.values[name]:g}, range {signal.minimum:g} to {signal.maximum:g}"
            defects.append(f"{frame.message.name}.{name} in cycle {frame.cycle} ({text})")
    return defects


def _statuses(tester: NodeTester, received: list[ReceivedFrame] | None = None) -> list[ReceivedFrame]:
    return [
        frame
        for frame in (tester.received if received is None else received)
        if frame.message is tester.status_message and frame.values
    ]


def _answered(tester: NodeTester, received: list[ReceivedFrame], cycles: int) -> Outcome:
    """Return the outcome of a test of the state frames. The test passes if the node sent one state frame in each period.

    With a period of 1 ms, exactly one state frame must answer each SYNC. With a longer period, each gap between two state
    frames may deviate from the period by at most half a period, and at least `cycles // period - 1` state frames are required.

    Args:
        tester: tester of the node.
        received: frames received in the test.
        cycles: duration of the test [cycles].
    """
    period = tester.state_message.cycle_ms
    at = [frame.cycle for frame in received if frame.message is tester.state_message]
    if period == 1:
        per_cycle = Counter(at)
        wrong = cycles - sum(count == 1 for count in per_cycle.values())
        return Outcome(wrong == 0, f"{len(at)} answers to {cycles} SYNCs, {wrong} SYNCs without exactly one answer")
    gaps = [after - before for before, after in pairwise(at)]
    passed = len(at) >= cycles // period - 1 and all(abs(gap - period) <= period // 2 for gap in gaps)
    return Outcome(
        passed, f"{len(at)} frames in {cycles} ms, gaps of {min(gaps, default=0)} to {max(gaps, default=0)} ms"
    )

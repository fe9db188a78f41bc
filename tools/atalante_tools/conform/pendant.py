"""Requirements for the pendant: its dead-man switch, its assistance dial, and its requests after a button press."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

from atalante_tools.conform.frames import ReceivedFrame
from atalante_tools.conform.node_tester import NodeTester, NotTested
from atalante_tools.conform.requirement import Outcome, Requirement
from atalante_tools.conform.technician import Action

#: Values of `PENDANT_STATE.Request`.
START, STOP, HOLD = 1, 2, 3
#: Time after a button press in which the pendant must not send a second request [cycles].
_AFTER: Final = 50
SOURCE: Final = "DBC PENDANT_STATE"


def requirements(_tester: NodeTester) -> list[Requirement]:
    """Return the requirements for the pendant. A technician presses the buttons."""
    return [
        Requirement("PENDANT-01", "Sends no request without a press.", "200 ms untouched", SOURCE, sends_no_request),
        Requirement(
            "PENDANT-02",
            "Reports the dead-man switch, released and pressed.",
            "released and pressed once",
            "fault matrix F56",
            reports_the_dead_man,
        ),
        Requirement(
            "PENDANT-03",
            "Reports START once per press.",
            "START pressed",
            SOURCE,
            _reports_press(Action.PRESS_START, START),
        ),
        Requirement(
            "PENDANT-04",
            "Reports STOP once per press.",
            "STOP pressed",
            SOURCE,
            _reports_press(Action.PRESS_STOP, STOP),
        ),
        Requirement(
            "PENDANT-05",
            "Reports HOLD once per press.",
            "HOLD pressed",
            SOURCE,
            _reports_press(Action.PRESS_HOLD, HOLD),
        ),
        Requirement(
            "PENDANT-06",
            "Sets the assistance factor when the dial is turned.",
            "dial turned",
            SOURCE,
            sets_the_factor,
        ),
    ]


def sends_no_request(tester: NodeTester) -> Outcome:
    """Test PENDANT-01: the request counter of the pendant does not change without a button press."""
    received = tester.states(tester.idle(200))
    if not received:
        raise NotTested("no state frame of the DBC length received; see NODE-04 and NODE-13")
    counters = {int(frame.values["RequestCounter"]) for frame in received}
    return Outcome(len(counters) == 1, f"{len(counters) - 1} requests in {len(received)} frames")


def reports_the_dead_man(tester: NodeTester) -> Outcome:
    """Test PENDANT-02: the pendant reports the dead-man switch as released and as pressed."""

    def reports(pressed: bool) -> Callable[[list[ReceivedFrame]], bool]:
        return lambda received: any(bool(frame.values["DeadMan"]) is pressed for frame in tester.states(received))

    if not tester.run_until(reports(True)):
        tester.request(Action.SQUEEZE_DEAD_MAN, reports(True))
    for action, pressed in ((Action.RELEASE_DEAD_MAN, False), (Action.SQUEEZE_DEAD_MAN, True)):
        if not tester.request(action, reports(pressed)):
            return Outcome(False, f"{'pressing' if pressed else 'releasing'} the dead-man switch is not reported")
    return Outcome(True, "released, then pressed")


def sets_the_factor(tester: NodeTester) -> Outcome:
    """Test PENDANT-06: turning the dial changes the assistance factor."""
    before = _last(tester, tester.idle(3))["AssistanceFactor"]

    def is_set(received: list[ReceivedFrame]) -> bool:
        return any(
            frame.values["AssistanceSet"] and frame.values["AssistanceFactor"] != before
            for frame in tester.states(received)
        )

    passed = tester.request(Action.TURN_DIAL, is_set)
    now = _last(tester, tester.idle(3))["AssistanceFactor"]
    return Outcome(passed, f"factor {before:g} -> {now:g}")


def _reports_press(action: Action, request: int) -> Callable[[NodeTester], Outcome]:
    def test(tester: NodeTester) -> Outcome:
        before = _last(tester, tester.idle(3))["RequestCounter"]

        def is_reported(received: list[ReceivedFrame]) -> bool:
            return any(frame.values["RequestCounter"] != before for frame in tester.states(received))

        if not tester.request(action, is_reported):
            return Outcome(False, "the press is not reported")
        now = _last(tester, tester.idle(_AFTER))
        presses = int(now["RequestCounter"] - before) & 0xFF
        return Outcome(
            presses == 1 and now["Request"] == request, f"{presses} requests, request code {now['Request']:g}"
        )

    return test


def _last(tester: NodeTester, received: list[ReceivedFrame]) -> dict[str, float]:
    states = tester.states(received)
    if not states:
        raise NotTested("no state frame of the DBC length received; see NODE-04 and NODE-13")
    return states[-1].values

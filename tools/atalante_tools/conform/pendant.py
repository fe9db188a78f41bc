"""What the pendant owes the operator: every press is told once, the dead-man at once, and nothing is said that nobody did."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

from atalante_tools.conform.bench import Bench, NotTested
from atalante_tools.conform.frames import Heard
from atalante_tools.conform.requirement import Outcome, Requirement
from atalante_tools.conform.technician import Action

#: Values of `PENDANT_STATE.Request`.
START, STOP, HOLD = 1, 2, 3
#: Cycles after a press in which nothing more may be told.
_AFTER: Final = 50
SOURCE: Final = "DBC PENDANT_STATE"


def requirements(_bench: Bench) -> list[Requirement]:
    """Of the pendant. A technician has to press."""
    return [
        Requirement("PENDANT-01", "Asks for nothing by itself.", "200 ms untouched", SOURCE, asks_for_nothing),
        Requirement(
            "PENDANT-02",
            "Tells the dead-man, released and pressed.",
            "both once",
            "fault matrix F56",
            tells_the_dead_man,
        ),
        Requirement(
            "PENDANT-03", "Tells START once a press.", "START pressed", SOURCE, _tells(Action.PRESS_START, START)
        ),
        Requirement("PENDANT-04", "Tells STOP once a press.", "STOP pressed", SOURCE, _tells(Action.PRESS_STOP, STOP)),
        Requirement("PENDANT-05", "Tells HOLD once a press.", "HOLD pressed", SOURCE, _tells(Action.PRESS_HOLD, HOLD)),
        Requirement(
            "PENDANT-06",
            "Sets the assistance factor when the dial is turned.",
            "dial turned",
            SOURCE,
            sets_the_factor,
        ),
    ]


def asks_for_nothing(bench: Bench) -> Outcome:
    """PENDANT-01."""
    heard = bench.states(bench.idle(200))
    counters = {int(h.values["RequestCounter"]) for h in heard}
    return Outcome(len(counters) == 1, f"{len(counters) - 1} requests in {len(heard)} frames")


def tells_the_dead_man(bench: Bench) -> Outcome:
    """PENDANT-02."""

    def says(pressed: bool) -> Callable[[list[Heard]], bool]:
        return lambda heard: any(bool(h.values["DeadMan"]) is pressed for h in bench.states(heard))

    if not bench.until(says(True)):
        bench.ask(Action.SQUEEZE_DEAD_MAN, says(True))
    for action, pressed in ((Action.RELEASE_DEAD_MAN, False), (Action.SQUEEZE_DEAD_MAN, True)):
        if not bench.ask(action, says(pressed)):
            return Outcome(False, f"{'pressing' if pressed else 'releasing'} it does not show")
    return Outcome(True, "released, then pressed")


def sets_the_factor(bench: Bench) -> Outcome:
    """PENDANT-06."""
    before = _last(bench, bench.idle(3))["AssistanceFactor"]

    def is_set(heard: list[Heard]) -> bool:
        return any(h.values["AssistanceSet"] and h.values["AssistanceFactor"] != before for h in bench.states(heard))

    passed = bench.ask(Action.TURN_DIAL, is_set)
    now = _last(bench, bench.idle(3))["AssistanceFactor"]
    return Outcome(passed, f"factor {before:g} -> {now:g}")


def _tells(action: Action, request: int) -> Callable[[Bench], Outcome]:
    def test(bench: Bench) -> Outcome:
        before = _last(bench, bench.idle(3))["RequestCounter"]

        def is_told(heard: list[Heard]) -> bool:
            return any(h.values["RequestCounter"] != before for h in bench.states(heard))

        if not bench.ask(action, is_told):
            return Outcome(False, "the press does not show")
        now = _last(bench, bench.idle(_AFTER))
        presses = int(now["RequestCounter"] - before) & 0xFF
        return Outcome(presses == 1 and now["Request"] == request, f"{presses} presses, request {now['Request']:g}")

    return test


def _last(bench: Bench, heard: list[Heard]) -> dict[str, float]:
    states = bench.states(heard)
    if not states:
        raise NotTested("no state frame was heard")
    return states[-1].values

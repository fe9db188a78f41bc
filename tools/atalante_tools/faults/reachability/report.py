"""Report of the exhaustive searches: `python -m atalante_tools.faults.reachability.report` prints a Markdown table."""

from __future__ import annotations

from typing import Any, Final

from atalante_tools.faults.reachability.drive_steps import (
    HOLD_PROPERTY,
    LATCH_PROPERTY,
    WATCHDOG_PROPERTY,
    DriveSteps,
)
from atalante_tools.faults.reachability.explorations import (
    MOVE_PROPERTY,
    RESTART_PROPERTY,
    STOP_PROPERTY,
    OperatorPath,
)
from atalante_tools.faults.reachability.search import Exploration

#: Name of each search -> safety properties that the search checks in every reachable state.
SEARCHES: Final = {
    "moves": (MOVE_PROPERTY, RESTART_PROPERTY),
    "stops": (STOP_PROPERTY,),
    "drive": (WATCHDOG_PROPERTY, HOLD_PROPERTY, LATCH_PROPERTY),
}


def search(name: str, path: OperatorPath) -> Exploration[Any, Any]:
    """Run one search.

    Args:
        name: key of `SEARCHES`.
        path: transition function of the searches `moves` and `stops`. The path stores its results, so the
            second of these searches is faster.
    """
    match name:
        case "moves":
            return path.moves()
        case "stops":
            return path.stops()
        case _:
            return DriveSteps().search()


def main() -> None:
    """Print one table row per search: number of states, number of transitions, and properties.

    If a search finds a counterexample, print its trace and exit with code 1.
    """
    print("| search | states | transitions | properties |\n| --- | --- | --- | --- |")
    path = OperatorPath()
    for name, properties in SEARCHES.items():
        found = search(name, path)
        print(f"| {name} | {found.states} | {found.transitions} | {'; '.join(properties)} |")
        if found.broken:
            print(f"\nviolated: {found.broken}")
            for number, (cycle, state) in enumerate(found.trace, 1):
                print(f"cycle {number}: {cycle}\n  -> {state}")
            raise SystemExit(1)


if __name__ == "__main__":
    main()

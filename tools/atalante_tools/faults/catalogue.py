"""All scenarios by fault ID. A fault has a scenario if `scenario` is in the column Proof of FAULTS.md."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

from atalante_tools.faults import drive, host, link, node, operator, sensor
from atalante_tools.faults.scenario import Scenario

SCENARIOS: Final[Mapping[str, Scenario]] = {
    scenario.id: scenario for group in (link, node, sensor, drive, host, operator) for scenario in group.SCENARIOS
}

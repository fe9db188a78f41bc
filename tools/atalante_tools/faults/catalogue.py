"""All scenarios by fault ID. A row of the fault matrix FAULTS.md has one scenario if its proof is `scenario`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

from atalante_tools.faults import drive, host, link, node, operator, sensor
from atalante_tools.faults.scenario import Scenario

SCENARIOS: Final[Mapping[str, Scenario]] = {
    scenario.id: scenario for group in (link, node, sensor, drive, host, operator) for scenario in group.SCENARIOS
}

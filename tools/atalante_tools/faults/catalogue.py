"""All scenarios by fault ID. Each row of the fault matrix FAULTS.md with the proof `scenario` has one scenario."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

from atalante_tools.faults import drive, host, link, node, operator, sensor
from atalante_tools.faults.scenario import Scenario

SCENARIOS: Final[Mapping[str, Scenario]] = {
    scenario.id: scenario for group in (link, node, sensor, drive, host, operator) for scenario in group.SCENARIOS
}

"""All scenarios by ID, one for each row of the matrix whose proof is a run."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

from atalante_tools.faults import drive, host, link, node, operator, sensor
from atalante_tools.faults.scenario import Scenario

SCENARIOS: Final[Mapping[str, Scenario]] = {
    scenario.id: scenario for group in (link, node, sensor, drive, host, operator) for scenario in group.SCENARIOS
}

"""Plausibility: what frames that are intact say, judged against physics, history and each other."""

from atalante_hal.safety.plausibility.finding import Finding
from atalante_hal.safety.plausibility.plausibility import Plausibility

__all__ = ["Finding", "Plausibility"]

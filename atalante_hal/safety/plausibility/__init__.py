"""Plausibility checks, which compare received values with physical limits, earlier values and other sensors."""

from atalante_hal.safety.diagnostics import Finding
from atalante_hal.safety.plausibility.plausibility import Plausibility

__all__ = ["Finding", "Plausibility"]

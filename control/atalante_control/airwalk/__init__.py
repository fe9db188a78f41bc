"""Airwalk: walking while suspended in the air. Controller, its parts, compiled kernel and telemetry."""

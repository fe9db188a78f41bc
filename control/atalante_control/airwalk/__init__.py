"""Airwalk (walking while suspended in the air): controller, its compiled kernel, and telemetry."""

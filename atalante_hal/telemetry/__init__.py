"""Telemetry: a ring out of the loop, and the process that publishes and records what is in it."""

"""Frames of a log or a live bus against the DBC: `log -> judge (rules) -> findings -> report`."""

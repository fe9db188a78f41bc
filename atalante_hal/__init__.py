"""Robot side of the stack: bus, codec, E2E, HAL, supervisor, 1 kHz loop and telemetry."""

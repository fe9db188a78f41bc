"""Robot side of the stack: bus, codec, E2E protection, HAL, state machine, 1 kHz loop and telemetry."""

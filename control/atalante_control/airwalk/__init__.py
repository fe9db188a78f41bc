"""Walking suspended in the air: the controller, its compiled kernel and its telemetry."""

"""Walk in the air: the controller, its step kernel and its telemetry."""

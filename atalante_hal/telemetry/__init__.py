"""Telemetry, the way out of the HAL: the loop writes shared-memory rings, a separate process publishes and records them.

`ring`, `frames` and `process` are for the loop's process and import no network, recording or CAN
library; `publisher` (Zenoh), `recorder` (MCAP), `can_log` (python-can) and `messages` (protobuf) live in the telemetry
process alone.
"""

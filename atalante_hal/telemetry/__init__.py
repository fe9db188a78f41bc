"""Telemetry: the loop writes to shared-memory rings, and a separate process publishes and records their contents.

`ring`, `frames` and `process` are used in the process of the loop and import no network, recording or CAN library. `publisher`
(Zenoh), `recorder` (MCAP), `can_log` (python-can) and `messages` (protobuf) are used only in the telemetry process.
"""

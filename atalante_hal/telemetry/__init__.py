"""Telemetry: the loop writes to ring buffers in shared memory, and a separate process publishes and records the data.

`ring`, `frames` and `process` are used in the process of the loop. They import no library for networks, recordings or CAN.
`publisher` (Zenoh), `recorder` (MCAP), `can_log` (python-can) and `messages` (protobuf) are used only in the telemetry process.
"""

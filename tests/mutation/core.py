"""The safety core, and the tests that have to notice a change of it: what is mutated, and what has to be covered whole."""

from __future__ import annotations

_PLAUSIBILITY = ("finding", "encoders", "imus", "legs", "feet", "stillness", "unchecked", "plausibility")
#: The safety core: files that are judged together, and the tests that have to notice a change of them.
CORE = {
    "e2e": (("atalante_hal/wire/e2e.py",), ("test_e2e.py", "test_image.py")),
    "process_image": (("atalante_hal/wire/process_image.py",), ("test_image.py",)),
    "message_monitor": (
        ("atalante_hal/safety/message_monitor.py", "atalante_hal/safety/fault_memory.py"),
        ("test_judgement.py", "test_fault_memory.py"),
    ),
    "plausibility": (
        tuple(f"atalante_hal/safety/plausibility/{name}.py" for name in _PLAUSIBILITY),
        ("test_plausibility.py", "test_ridden_through.py"),
    ),
    "heartbeats": (("atalante_hal/safety/heartbeats.py",), ("test_heartbeats.py",)),
    "transceiver": (("atalante_hal/transceiver.py",), ("test_transceiver.py",)),
    "pendant": (("atalante_hal/pendant.py",), ("test_hal_pendant.py",)),
    "state_machine": (
        ("atalante_hal/safety/state_machine.py", "atalante_hal/safety/diagnostics.py", "atalante_hal/wire/cia402.py"),
        ("test_supervisor.py", "test_diagnostics.py", "test_cia402.py"),
    ),
    "limiter": (("atalante_hal/safety/limiter.py",), ("test_limiter.py",)),
    "guide": (
        ("atalante_control/guide/filter.py", "atalante_control/guide/kernel.py"),
        ("test_guide.py", "test_guide_kernel.py"),
    ),
    "drive": (
        ("atalante_emulator/drive.py", "atalante_emulator/emergency.py", "atalante_emulator/collision.py"),
        ("test_drive.py", "test_emergency.py", "test_collision.py"),
    ),
}

"""The safety core, and the tests that have to notice a change of it: what is mutated, and what has to be covered whole."""

from __future__ import annotations

_PLAUSIBILITY = ("finding", "encoders", "imus", "legs", "feet", "stillness", "unchecked", "plausibility")
#: The safety core: files that are judged together, and the tests that have to notice a change of them.
CORE = {
    "e2e": (("atalante_hal/e2e.py",), ("test_e2e.py", "test_image.py")),
    "image": (("atalante_hal/image.py",), ("test_image.py",)),
    "judgement": (
        ("atalante_hal/judgement.py", "atalante_hal/fault_memory.py"),
        ("test_judgement.py", "test_fault_memory.py"),
    ),
    "plausibility": (
        tuple(f"atalante_hal/plausibility/{name}.py" for name in _PLAUSIBILITY),
        ("test_plausibility.py", "test_ridden_through.py"),
    ),
    "heartbeats": (("atalante_hal/heartbeats.py",), ("test_heartbeats.py",)),
    "transceiver": (("atalante_hal/transceiver.py",), ("test_transceiver.py",)),
    "pendant": (("atalante_hal/pendant.py",), ("test_hal_pendant.py",)),
    "supervisor": (
        ("atalante_hal/supervisor.py", "atalante_hal/diagnostics.py", "atalante_hal/cia402.py"),
        ("test_supervisor.py", "test_diagnostics.py", "test_cia402.py"),
    ),
    "limiter": (("atalante_hal/limiter.py",), ("test_limiter.py",)),
    "guide": (
        ("atalante_control/guide.py", "atalante_control/guide_kernel.py"),
        ("test_guide.py", "test_guide_kernel.py"),
    ),
    "drive": (
        ("atalante_emulator/drive.py", "atalante_emulator/emergency.py", "atalante_emulator/collision.py"),
        ("test_drive.py", "test_emergency.py", "test_collision.py"),
    ),
}

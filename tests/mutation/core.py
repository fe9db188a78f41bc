"""Safety core: the files for mutation testing and coverage, and the tests that must detect errors in them."""

from __future__ import annotations

_PLAUSIBILITY = (
    "signals",
    "encoders",
    "imus",
    "inertial",
    "trunk",
    "fall",
    "knees",
    "legs",
    "feet",
    "support",
    "soles",
    "stillness",
    "unchecked",
    "rejections",
    "plausibility",
)
_PLAUSIBILITY_TESTS = (
    "encoders",
    "imus",
    "inertial",
    "trunk",
    "fall",
    "knees",
    "legs",
    "feet",
    "support",
    "soles",
    "stillness",
    "rejections",
    "plausibility",
    "ridden_through",
)
#: Part of the safety core -> files of the part, and the tests that must detect a change of these files.
CORE = {
    "e2e": (("atalante_hal/wire/e2e.py",), ("hal/wire/test_e2e.py", "hal/wire/test_process_image.py")),
    "process_image": (("atalante_hal/wire/process_image.py",), ("hal/wire/test_process_image.py",)),
    "message_monitor": (
        ("atalante_hal/safety/message_monitor.py", "atalante_hal/safety/fault_memory.py"),
        ("hal/safety/test_message_monitor.py", "hal/safety/test_fault_memory.py"),
    ),
    "plausibility": (
        tuple(f"atalante_hal/safety/plausibility/{name}.py" for name in _PLAUSIBILITY),
        tuple(f"hal/safety/plausibility/test_{name}.py" for name in _PLAUSIBILITY_TESTS),
    ),
    "heartbeats": (("atalante_hal/safety/heartbeats.py",), ("hal/safety/test_heartbeats.py",)),
    "transceiver": (("atalante_hal/transceiver.py",), ("hal/test_transceiver.py",)),
    "pendant": (("atalante_hal/pendant.py",), ("hal/test_pendant.py",)),
    "state_machine": (
        ("atalante_hal/safety/state_machine.py", "atalante_hal/safety/diagnostics.py", "atalante_hal/wire/cia402.py"),
        ("hal/safety/test_state_machine.py", "hal/safety/test_diagnostics.py", "hal/wire/test_cia402.py"),
    ),
    "hold_stability": (("atalante_hal/safety/hold_stability.py",), ("hal/safety/test_hold_stability.py",)),
    "torque_tracking": (("atalante_hal/safety/torque_tracking.py",), ("hal/safety/test_torque_tracking.py",)),
    "torque_motion": (
        ("atalante_hal/safety/torque_motion.py", "atalante_hal/safety/leg_torques.py"),
        ("hal/safety/test_torque_motion.py", "hal/safety/test_leg_torques.py"),
    ),
    "direction": (("atalante_hal/safety/direction.py",), ("hal/safety/test_direction.py",)),
    "limiter": (("atalante_hal/safety/limiter.py",), ("hal/safety/test_limiter.py",)),
    "guide": (
        ("atalante_control/guide/filter.py", "atalante_control/guide/kernel.py"),
        ("control/guide/test_filter.py", "control/guide/test_kernel.py"),
    ),
    "drive": (
        ("atalante_emulator/drive.py", "atalante_emulator/emergency.py", "atalante_emulator/collision.py"),
        ("emulator/test_drive.py", "emulator/test_emergency.py", "emulator/test_collision.py"),
    ),
}

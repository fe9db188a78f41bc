"""F50: no network message affects the control. 100,000 forged puts while the robot moves change no byte on the bus."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from typing import Any

from atalante_hal.telemetry.process import TelemetryConfig, TelemetryProcess
from atalante_hal.types import SupervisorState
from atalante_hal.wire.frame import Frames

PUTS = 100_000
CYCLES = 3000  # smallest number of cycles; the run continues while the attacker runs

#: Program that connects, prints "in", and then puts, deletes and queries all existing keys and some unknown keys.
ATTACKER = """
import json, random, sys, zenoh
rng = random.Random(1)
keys = [f"atalante/exo/{name}" for name in json.loads(sys.argv[2])]
keys += ["atalante/exo/command", "atalante/command", "atalante/**/command", "atalante/**", "**", "exo/command", "hal/state"]
payloads = [b"", b"\\0", b"x" * 1000, json.dumps({"torque": [400.0] * 12}).encode(), bytes(range(256))]
with zenoh.open(zenoh.Config.from_json5(sys.argv[1])) as session:
    with session.declare_subscriber("atalante/**") as subscriber:
        subscriber.recv()
    print("in", flush=True)
    for number in range(int(sys.argv[3])):
        key = rng.choice(keys)
        kind = number % 50
        if kind == 0:
            session.delete(key)
        elif kind == 1:
            session.liveliness().declare_token("atalante/exo/command")
        elif kind == 2:
            session.get(key.replace("**", "x"), payload=rng.choice(payloads), timeout=0.1)
        else:
            session.put(key, rng.choice(payloads), encoding="application/protobuf;atalante.v1.Command")
    print("done", flush=True)
"""


class Recorder:
    """Tap that keeps every byte between HAL and nodes, in both directions."""

    def __init__(self) -> None:
        self.bytes: list[bytes] = []

    def sent(self, frames: Frames) -> None:
        self.bytes.append(frames.tobytes())

    def received(self, frames: Frames, count: int) -> None:
        # The bytes after the payload are undefined.
        for frame in frames[:count]:
            self.bytes.append(frame["can_id"].tobytes() + frame["data"][: frame["len"]].tobytes())


def test_f50_forged_puts_on_every_key_do_not_change_any_byte(make_rig: Callable[..., Any]) -> None:
    rig = make_rig(seed=4)
    rig.hal.tap = attacked = Recorder()
    rig.until(SupervisorState.ACTIVE)
    streams = ["joint_states", "imu", "foot_forces", "haptics", "guide", "controller", "system", "loop", "events"]
    with TelemetryProcess(TelemetryConfig(slots=64), rig.hal.layout) as telemetry:
        config = {
            "mode": "client",
            "connect": {"endpoints": [telemetry.endpoint]},
            "scouting": {"multicast": {"enabled": False}},
            "transport": {"shared_memory": {"enabled": False}},
        }
        command = [sys.executable, "-c", ATTACKER, json.dumps(config), json.dumps(streams), str(PUTS)]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as attacker:
            assert attacker.stdout is not None
            begun = rig.hal.state.cycle
            # The attacker starts after its first telemetry sample.
            while attacker.poll() is None or rig.hal.state.cycle - begun < CYCLES:
                rig.cycle()
                telemetry.write(rig.hal.record)
            assert attacker.stdout.read() == "in\ndone\n"
        assert telemetry.alive
        assert telemetry.close().published > 0
    cycles = rig.hal.state.cycle
    assert rig.hal.state.supervisor is SupervisorState.ACTIVE

    golden = make_rig(seed=4)
    golden.hal.tap = undisturbed = Recorder()
    golden.run(cycles)
    assert golden.hal.state.supervisor is SupervisorState.ACTIVE
    assert attacked.bytes == undisturbed.bytes
    assert rig.hal.record.tobytes() == golden.hal.record.tobytes()

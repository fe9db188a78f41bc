"""Subscribe to the joint states of a running HAL with Zenoh and protobuf, and without any module of this project.

Run it:  atalante airwalk --steps 100                          in one terminal
         python examples/subscribe.py                       in another terminal, from the root of the project
         python examples/subscribe.py tcp/192.0.2.7:7447    for a HAL on another computer

Waits for the HAL. Prints the cycle number and the twelve joint angles [rad], 100 times per second of robot time.
Stop it with Ctrl-C.
"""

import argparse
import json
import os
import signal
import sys
from pathlib import Path

import zenoh
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory

DESCRIPTORS = Path("atalante_hal/telemetry/messages.binpb")
parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("endpoint", nargs="?", default="tcp/127.0.0.1:7447")
endpoint = parser.parse_args().endpoint
if not DESCRIPTORS.is_file():
    parser.error(f"the program must be started in the root of the project, got {Path.cwd()} without {DESCRIPTORS}")
settings = {
    "mode": "client",
    # With timeout_ms = -1, Zenoh tries to connect without a time limit.
    # Without `retry`, Zenoh would wait up to 4 s between two attempts.
    "connect": {
        "endpoints": [endpoint],
        "timeout_ms": -1,
        "retry": {"period_init_ms": 100, "period_max_ms": 200},
    },
    "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}},  # connect to the endpoint only
    "transport": {"shared_memory": {"enabled": False}},  # disabled, because Ctrl-C would leave files in /dev/shm
}

signal.signal(signal.SIGINT, signal.SIG_DFL)  # Ctrl-C ends the program, also while `zenoh.open` waits
pool = descriptor_pool.DescriptorPool()
for file in descriptor_pb2.FileDescriptorSet.FromString(DESCRIPTORS.read_bytes()).file:
    pool.Add(file)
try:
    config = zenoh.Config.from_json5(json.dumps(settings))
except zenoh.ZError:
    parser.error(f"the endpoint must be like tcp/192.0.2.7:7447, got {endpoint}")
print(f"connecting to {endpoint}", file=sys.stderr)
with zenoh.open(config) as session, session.declare_subscriber("atalante/*/joint_states") as subscriber:
    for sample in subscriber:
        message_type = pool.FindMessageTypeByName(str(sample.encoding).split(";")[1])
        states = message_factory.GetMessageClass(message_type).FromString(sample.payload.to_bytes())
        try:
            print(states.cycle, dict(zip(states.name, states.position, strict=True)), flush=True)
        except BrokenPipeError:  # the program that reads the output has ended, for example `head`
            # Python flushes stdout at the exit. With /dev/null as stdout, this flush raises no error.
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            break

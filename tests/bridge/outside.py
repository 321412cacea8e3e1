"""A program that is no part of a run and knows nothing of netcosim: hears positions, sends torques.

    python outside.py ENDPOINT AGENTS [bad]

With `bad`, it first sends messages that must be refused.
"""

import json
import struct
import sys

import zenoh

endpoint, agents = sys.argv[1], sys.argv[2].split(",")
config = zenoh.Config()
config.insert_json5("mode", '"client"')
config.insert_json5("connect/endpoints", json.dumps([endpoint]))
config.insert_json5("scouting/multicast/enabled", "false")

JSON = zenoh.Encoding.APPLICATION_JSON
FLOATS = zenoh.Encoding.APPLICATION_OCTET_STREAM
BAD = [
    (b"[1.0]", JSON),
    (b"[1.0, NaN]", JSON),
    (b"[1.0, 1e999]", JSON),
    (b'{"valeu": [1, 2]}', JSON),
    (b"\x80\x04\x95\x00.", zenoh.Encoding.APPLICATION_PYTHON_SERIALIZED_OBJECT),
    (struct.pack("<2d", 1.0, 2.0), FLOATS),
    (b"[" * 100_000, JSON),
    (b"\xff\xfe", JSON),
]

with zenoh.open(config) as session:
    heard = {agent: session.declare_subscriber(f"lab/{agent}/p") for agent in agents}
    for payload, encoding in BAD if "bad" in sys.argv else ():
        session.put(f"lab/{agents[0]}/u", payload, encoding=encoding)
    session.put("lab/ready", b"1")
    print("ready", flush=True)
    while True:
        for agent, subscriber in heard.items():
            message = json.loads(subscriber.recv().payload.to_bytes())
            torque = [-0.5 * x for x in message["value"]]
            answer = {"value": torque, "tick": message["tick"]}
            session.put(f"lab/{agent}/u", json.dumps(answer), encoding=JSON)

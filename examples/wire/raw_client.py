"""Read and command a cell with Zenoh and msgpack only, as from any language: `python raw_client.py panda 7489`."""

import sys

import msgpack
import zenoh

cell, port = sys.argv[1:]
config = zenoh.Config.from_json5(f'{{mode: "client", connect: {{endpoints: ["tcp/127.0.0.1:{port}"]}}}}')
with zenoh.open(config) as session:
    joints = session.declare_subscriber(f"{cell}/joint_states").recv()
    print("joints", msgpack.unpackb(joints.payload.to_bytes())["position"])
    for key, body in (("gripper/command", {"id": "raw-1", "width": 0.03}), ("gripper/command", {"nonsense": 1})):
        for reply in session.get(f"{cell}/{key}", payload=msgpack.packb(body)):
            print(key, msgpack.unpackb((reply.ok or reply.err).payload.to_bytes()))

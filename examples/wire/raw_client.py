"""Read and command a cell with Zenoh and msgpack only: `python raw_client.py panda tcp/127.0.0.1:7489`."""
import sys

import msgpack
import zenoh

with zenoh.open(zenoh.Config.from_json5(f'{{mode: "client", connect: {{endpoints: ["{sys.argv[2]}"]}}}}')) as session:
    joints = session.declare_subscriber(f"{sys.argv[1]}/joint_states").recv()
    print("joints", msgpack.unpackb(joints.payload.to_bytes())["position"])
    for body in ({"id": "raw-1", "width": 0.03}, {"nonsense": 1}):
        for reply in session.get(f"{sys.argv[1]}/gripper/command", payload=msgpack.packb(body)):
            print(msgpack.unpackb((reply.ok or reply.err).payload.to_bytes()))

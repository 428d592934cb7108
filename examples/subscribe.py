"""Receive every reconstructor that the service publishes, check it, and print its registration.

Run: ``python examples/subscribe.py [ENDPOINT] [SYSTEM]``. It only listens and sends no
acknowledgement, which is left to the RTC.
"""

import hashlib
import sys
import time

import msgpack
import numpy as np
import zenoh

endpoint, system = [*sys.argv[1:], *("tcp/127.0.0.1:7447", "flao-lbt")[len(sys.argv) - 1 :]]
config = zenoh.Config()
config.insert_json5("mode", '"client"')
config.insert_json5("connect/endpoints", f'["{endpoint}"]')
config.insert_json5("scouting/multicast/enabled", "false")
parts, manifests = {}, {}


def take(sample):
    """Collect chunks and manifests in any order; print a matrix when it is complete."""
    _, _, _, _, matrix_id, kind, *index = str(sample.key_expr).split("/")
    mine = parts.setdefault(matrix_id, {})
    if kind == "chunk":
        mine[int(index[0])] = sample.payload.to_bytes()
    else:
        manifests[matrix_id] = msgpack.unpackb(sample.payload.to_bytes())
    manifest = manifests.get(matrix_id)
    if manifest is not None and len(mine) == manifest["n_chunks"]:
        data = b"".join(mine[k] for k in range(manifest["n_chunks"]))
        right = hashlib.sha256(data).hexdigest() == manifest["sha256"]
        matrix = np.frombuffer(data, "<f4").reshape(manifest["shape"])
        print(matrix_id, matrix.shape, manifest["alpha"], "right" if right else "WRONG", flush=True)


with zenoh.open(config) as session:
    subscriber = session.declare_subscriber(f"ao/v1/{system}/cm/**", take)
    while True:
        time.sleep(1.0)

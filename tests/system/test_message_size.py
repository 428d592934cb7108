"""A message longer than any of the contract is dropped by the link, and costs it no memory."""

import json
import queue
import socket

import zenoh

from service.link.session import MAX_MESSAGE_BYTES, Endpoint, open_session
from service.wire import BATCH_LIMIT, CHUNK_LIMIT


def test_a_message_beyond_the_limit_is_dropped_and_those_after_it_come():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        endpoint = f"tcp/127.0.0.1:{probe.getsockname()[1]}"
    config = zenoh.Config()
    for key, value in {
        "mode": "client",
        "connect/endpoints": [endpoint],
        "scouting/multicast/enabled": False,
    }.items():
        config.insert_json5(key, json.dumps(value))
    received = queue.Queue()
    longest = max(CHUNK_LIMIT, BATCH_LIMIT)
    with open_session(Endpoint(system="x", listen=(endpoint,))) as service:
        subscriber = service.declare_subscriber("a", lambda m: received.put(len(m.payload)))
        with zenoh.open(config) as viewer:
            block = zenoh.CongestionControl.BLOCK
            for n_bytes in (longest, MAX_MESSAGE_BYTES + 10_000_000, 1000):
                viewer.put("a", bytes(n_bytes), congestion_control=block)
            assert [received.get(timeout=30.0) for _ in range(2)] == [longest, 1000]
            assert received.empty()
        subscriber.undeclare()

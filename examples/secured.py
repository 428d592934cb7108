"""An RTC on a secured link: its certificate, what it signs, and what it checks; docs/rtc.md."""

import hmac
import json
import time
from pathlib import Path

import msgpack
import zenoh


def connect(settings, file=None):  # file: zenoh's own configuration with certificate and key
    config = zenoh.Config.from_file(file) if file else zenoh.Config()
    for name, value in settings.items():
        config.insert_json5(name, json.dumps(value))
    return zenoh.open(config)


class Signing:
    """Signs and checks with the secret that RTC and service share; without one does neither."""

    def __init__(self, file=None):
        self.secret = Path(file).read_bytes().split()[0] if file else None
        self.start, self.n, self.came = time.time_ns(), 0, {}

    def mac(self, role, key, data):
        return hmac.digest(self.secret, f"{role}\0{key}\0".encode() + data, "sha256")

    def sign(self, key, message, rows=b""):  # the bytes of a message, and what travels beside it
        if self.secret is None:
            return msgpack.packb(message)
        signature = {"signer": self.start, "signed_n": self.n, "signed_for": 0, "mac": bytes(32)}
        self.n += 1
        data = msgpack.packb({**message, **signature})[:-32]
        return data + self.mac("rtc", key, data + rows)

    def check(self, key, data):  # return the message without its signature, or raise ValueError
        if self.secret is None:
            return data
        said = msgpack.unpackb(data)
        if not {"signer", "signed_n", "signed_for", "mac"} <= said.keys():
            raise ValueError("signature: none")
        if not hmac.compare_digest(data[-32:], self.mac("service", key, data[:-32])):
            raise ValueError("signature: wrong")
        n, came = said["signed_n"], self.came.setdefault(said["signer"], [-1])
        if said["signed_for"] != self.start or n in came or n < max(came) - 7:
            raise ValueError("signature: sent before")
        came[:] = [*came[-7:], n]
        return msgpack.packb(dict(list(said.items())[:-4]))

    def vouched(self, key, data, use):  # return what comes of a message, or why it is not used
        try:
            return use(self.check(key, data))
        except ValueError as error:
            rejected = {"sha256": None, "state": "rejected", "frame_seq": None, "accepted": False}
            return {"v": 1, "id": None, "reason": str(error), "start_seq": None, **rejected}

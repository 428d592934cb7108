"""Security of an RTC's link: certificates, and signatures of messages (docs/rtc.md)."""

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
    """Signing and checking of messages with the secret that RTC and service share.

    Without a secret, messages are sent and accepted unsigned.
    """

    def __init__(self, file=None):
        self.secret = Path(file).read_bytes().split()[0] if file else None
        self.start, self.n_signed, self.received = time.time_ns(), 0, {}

    def mac(self, role, key, data):
        return hmac.digest(self.secret, f"{role}\0{key}\0".encode() + data, "sha256")

    def sign(self, key, message, rows=b""):  # rows: payload that is sent with the message
        if self.secret is None:
            return msgpack.packb(message)
        signature = {"signer": self.start, "signed_n": self.n_signed, "signed_for": 0}
        signature["mac"] = bytes(32)  # last, so that it can be replaced at the end of the bytes
        self.n_signed += 1
        data = msgpack.packb({**message, **signature})[:-32]
        return data + self.mac("rtc", key, data + rows)

    def check(self, key, data):  # return the message without its signature, or raise ValueError
        if self.secret is None:
            return data
        message = msgpack.unpackb(data)
        if not {"signer", "signed_n", "signed_for", "mac"} <= message.keys():
            raise ValueError("signature: none")
        if not hmac.compare_digest(data[-32:], self.mac("service", key, data[:-32])):
            raise ValueError("signature: wrong")
        # A replay has a number that has been received, is too old, or was meant for an earlier
        # start of this RTC.
        n, received = message["signed_n"], self.received.setdefault(message["signer"], [-1])
        if message["signed_for"] != self.start or n in received or n < max(received) - 7:
            raise ValueError("signature: sent before")
        received[:] = [*received[-7:], n]
        return msgpack.packb(dict(list(message.items())[:-4]))

    def use_checked(self, key, data, use):  # return the reply of ``use``, or a refusal
        try:
            return use(self.check(key, data))
        except ValueError as error:
            rejected = {"sha256": None, "state": "rejected", "frame_seq": None, "accepted": False}
            return {"v": 1, "id": None, "reason": str(error), "start_seq": None, **rejected}

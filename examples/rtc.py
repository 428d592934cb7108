"""A whole RTC, from docs/rtc.md alone: ``python -m examples.rtc ENDPOINT SYSTEM PLANT.npz``.

PLANT.npz has a telescope and the ``matrix`` (n_controlled, n_slopes) to begin with. On a secured
link two more: zenoh's configuration (rtc.json5), and the file of the secret, if one is shared.
"""

import functools
import hashlib
import sys
import threading
import time

import msgpack
import numpy as np
import zenoh
import zenoh.ext

from examples.secured import Signing, connect
from examples.telescope import Telescope

endpoint, system, file, *secured = sys.argv[1:]
signing = Signing(*secured[1:])
plant, root, start_ns, lock = np.load(file), f"ao/v1/{system}", time.time_ns(), threading.Lock()
telescope, R, (n_slopes, n) = Telescope(plant), plant["matrix"], plant["response"].shape
c, hz, most_m, seq, n_next, used = np.zeros((2, n)), 500.0, 50e-9, 0, len(R), {}
ids = {"v": 1, "basis_id": "plant-1", "config_id": "plant-1"}
now = {"session": str(start_ns), "loop": "closed", "frame_rate_hz": hz, "delay_frames": 2.0, **ids}
now |= {"leak": 0.99, "gains": [0.4] * len(R) + [0.0] * (n - len(R)), "n_controlled": len(R)}
now |= {"n_slopes": n_slopes, "n_modes": n, "cm_id": f"own-{start_ns}", "magnitude": None}
now |= {"flux": None, "dither": None, "max_dither_m": most_m, "max_dither_modes": 8}


def obey(kind, asked):  # or return why not
    global n_next
    if kind == "loop" and len(asked["gains"] or now["gains"]) != n:
        return f"range: {len(asked['gains'])} gains, expected {n}"
    if kind == "loop":
        if asked["loop"] == "open" and now["loop"] == "closed":  # that begins a session
            c[:], now["dither"], now["session"] = 0.0, None, str(time.time_ns())
        n_next = asked["n_controlled"] or n_next
        now.update({key: asked[key] for key in ("gains", "leak", "loop") if asked[key] is not None})
    elif asked["action"] == "stop":
        now["dither"] = None
    elif now["dither"]:
        return "busy: a dither plays"
    elif asked["kind"] != "sine" or max(asked["modes"]) >= n or max(asked["amplitude_m"]) > most_m:
        return f"range: expected sines of modes below {n} and at most {most_m} m"
    else:
        now["dither"] = {**asked, "start_seq": seq + 20}
    return ""


@functools.cache  # the same again is answered as before, and not carried out again
def reply(kind, data):
    name, reason = None, ""
    try:
        asked = msgpack.unpackb(data)
        name = asked["id"]
        reason = obey(kind, asked) if asked["v"] == 1 else "v: expected 1"
    except Exception as error:
        reason = f"{'missing' if isinstance(error, KeyError) else 'range'}: {error}"
    start = None if reason else seq + 20
    return {"v": 1, "id": name, "accepted": not reason, "reason": reason, "start_seq": start}


def in_use():  # the matrix that the loop multiplies with, and its manifest
    data = R.astype("<f4").tobytes()
    told = {"id": now["cm_id"], "sha256": hashlib.sha256(data).hexdigest(), "shape": R.shape, **ids}
    told |= {"dtype": "<f4", "n_chunks": 1, "chunk_bytes": len(data), "created_ns": start_ns}
    told |= {"system": system, "alpha": None, "sigma": None, "im_id": None, "parent": None}
    return data, told


def answer(query):
    with query, lock:
        key, chunk, data = str(query.key_expr), query.parameters.get("chunk"), b""
        if key.endswith("applied"):
            data, told = in_use()
        else:
            obeyed = functools.partial(reply, key.split("/")[-1])
            told = signing.vouched(key, query.payload.to_bytes(), obeyed)
        query.reply(key, data if chunk else signing.sign(key, told))


@functools.cache
def swap(commit):  # every part is asked for, and none waited for
    global R
    said = {"v": 1, "id": None, "sha256": None, "state": "rejected", "frame_seq": None}
    try:
        told = msgpack.unpackb(commit)
        asked = [session.get(f"{root}/cm/{told['id']}?chunk={k}") for k in range(told["n_chunks"])]
        data = b"".join(part.ok.payload.to_bytes() for parts in asked for part in parts if part.ok)
        said |= {"id": told["id"], "sha256": told["sha256"]}
        said["reason"] = "range: id, sum, shape, basis, configuration, system, or not finite"
        terms = {**ids, "shape": [n_next, n_slopes], "system": system}
        right = hashlib.sha256(data).hexdigest() == told["sha256"] and terms.items() <= told.items()
        matrix = np.frombuffer(data, "<f4")
        if right and np.isfinite(matrix).all() and used.setdefault(told["id"], commit) == commit:
            with lock:
                R = matrix.reshape(told["shape"])
                c[:, len(R) :] = 0.0
                now.update(cm_id=told["id"], n_controlled=len(R))
                said |= {"state": "applied", "reason": "", "frame_seq": seq}
    except Exception as error:
        said["reason"] = f"range: {error}"
    return said


def take(commits):  # in a thread of its own: it waits
    for commit in commits:
        key, ack = str(commit.key_expr), f"{root}/cm/ack"
        said = signing.vouched(key, commit.payload.to_bytes(), swap) | {"session": now["session"]}
        session.put(ack, signing.sign(ack, said), congestion_control=block)


def frame():  # slopes, commands and dither; then the loop's answer, two frames later
    told, u = now["dither"], np.zeros(n)
    if told and seq >= told["start_seq"] + round(told["duration_s"] * hz):
        now["dither"] = None
    elif told and seq >= told["start_seq"]:
        turns = np.array(told["frequency_hz"]) * (seq - told["start_seq"]) / hz
        u[told["modes"]] = np.array(told["amplitude_m"]) * 2**0.5 * np.sin(2 * np.pi * turns)
    s, row = telescope.expose(c[0] + u), [*c[0] + u, *u]
    c[:] = c[1], now["leak"] * c[1]
    c[1, : len(R)] -= (now["loop"] == "closed") * np.array(now["gains"])[: len(R)] * (R @ s)
    return [*s, *row]


retry = {"period_init_ms": 200, "period_increase_factor": 1.5, "period_max_ms": 1000}
where = {"endpoints": [endpoint], "timeout_ms": -1, "retry": retry}
settings = {"mode": "client", "connect": where, "timestamping": {"enabled": True}}
session, block = connect(settings, *secured[:1]), zenoh.CongestionControl.BLOCK
recovery = {"cache": zenoh.ext.CacheConfig(round(hz / 2)), "publisher_detection": True}
recovery["sample_miss_detection"] = zenoh.ext.MissDetectionConfig(heartbeat=0.2)
frames = zenoh.ext.declare_advanced_publisher(session, f"{root}/tel/frames", **recovery)
commits = session.declare_subscriber(f"{root}/cm/*/commit")
threading.Thread(target=take, args=[commits], daemon=True).start()
keys = f"{root}/cmd/rtc/dither", f"{root}/cmd/rtc/loop", f"{root}/rtc/cm/applied"
held = [session.declare_queryable(key, answer) for key in keys]
held += [session.liveliness().declare_token(f"{root}/alive/rtc")]
while True:
    rows = []
    with lock:
        head = {"session": now["session"], "cm_id": now["cm_id"], "seq0": seq, "n": 10, **ids}
        head |= {"t0_ns": start_ns + round(seq * 1e9 / hz), "dt_ns": round(1e9 / hz)}
        head |= {"n_slopes": n_slopes, "n_modes": n, "dither": True}
        for _ in range(10):
            rows += frame()
            seq += 1
        now.update(seq=seq - 1, t_ns=head["t0_ns"] + 9 * head["dt_ns"])
        status = signing.sign(f"{root}/tel/status", now)
    payload = np.array(rows, "<f4").tobytes()
    frames.put(payload, attachment=signing.sign(f"{root}/tel/frames", head, payload))
    if seq % 100 == 0:
        session.put(f"{root}/tel/status", status)
    time.sleep(max(0.0, start_ns / 1e9 + seq / hz - time.time()))

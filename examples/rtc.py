"""A whole RTC, from docs/rtc.md alone: ``python examples/rtc.py ENDPOINT SYSTEM PLANT.npz``.

PLANT.npz stands for the telescope: ``response`` (n_slopes, n_modes), slope per metre, ``sigma_m``
(n_modes,) of the turbulence, and the ``matrix`` (n_controlled, n_slopes) to begin with.
"""

import hashlib
import json
import sys
import threading
import time

import msgpack
import numpy as np
import zenoh
import zenoh.ext

endpoint, system, file = sys.argv[1:]
plant, rng, lock, root = np.load(file), np.random.default_rng(), threading.Lock(), f"ao/v1/{system}"
D, sigma_m, R = plant["response"], plant["sigma_m"], plant["matrix"].astype("<f4")
(n_slopes, n), rows, hz, lead, most_m = D.shape, len(R), 500.0, 20, 50e-9
c, turbulence, seq, start_ns = np.zeros((2, n)), np.zeros(n), 0, time.time_ns()
ids, answered, used, parts = {"basis_id": "plant-1", "config_id": "plant-1"}, {}, {}, {}
status = {"v": 1, "session": f"{start_ns:x}", "seq": None, "t_ns": start_ns, "loop": "closed"}
status |= {"frame_rate_hz": hz, "delay_frames": 2.0, "leak": 0.99, "n_slopes": n_slopes, **ids}
status |= {"gains": [0.4] * rows + [0.0] * (n - rows), "n_modes": n, "n_controlled": rows}
status |= {"cm_id": f"own-{start_ns:x}", "dither": None, "max_dither_m": most_m}
status |= {"max_dither_modes": 8, "magnitude": None, "flux": None}


def dither(k):  # metres, of frame k; one that is over ends
    told, u = status["dither"], np.zeros(n)
    k -= told["start_seq"] if told else 0
    if told and 0 <= k < round(told["duration_s"] * hz):
        turns = np.array(told["frequency_hz"]) * k / hz
        u[told["modes"]] = np.array(told["amplitude_m"]) * 2**0.5 * np.sin(2 * np.pi * turns)
    elif told and k >= 0:
        status["dither"] = None
    return u


def obey(kind, asked):  # return why not
    global rows
    if kind == "dither" and asked["action"] == "stop":
        status["dither"] = None
    elif kind == "dither" and status["dither"]:
        return f"busy: {status['dither']['id']} plays"
    elif kind == "dither" and asked["kind"] != "sine":
        return "unsupported: random signs"
    elif kind == "dither":
        if max(asked["modes"]) >= n or max(asked["amplitude_m"]) > most_m:
            return f"range: modes up to {n - 1}, amplitude_m up to {most_m}"
        status["dither"] = {**asked, "start_seq": seq + lead}
    elif len(asked["gains"] or status["gains"]) != n:
        return f"range: {len(asked['gains'])} gains, expected {n}"
    else:
        if asked["loop"] == "open" and status["loop"] == "closed":  # that begins a session
            c[:], status["dither"], status["session"] = 0.0, None, f"{time.time_ns():x}"
        rows = asked["n_controlled"] or rows
        status.update({k: asked[k] for k in ("gains", "leak", "loop") if asked[k] is not None})
    return ""


def on_command(query):
    name, reason = None, ""
    with query, lock:
        try:
            asked = msgpack.unpackb(query.payload.to_bytes())
            name, kind = asked["id"], str(query.key_expr).split("/")[-1]
            if name not in answered:
                reason = obey(kind, asked) if asked["v"] == 1 else "v: expected 1"
        except KeyError as error:
            reason = f"missing: {error}"
        except Exception as error:
            reason = f"range: {error}"
        start = None if reason else seq + lead
        said = {"v": 1, "id": name, "accepted": not reason, "reason": reason, "start_seq": start}
        query.reply(
            query.key_expr, msgpack.packb(answered.setdefault(name, said) if name else said)
        )


def acknowledge(told, state, reason="", frame=None):
    said = {"v": 1, "session": status["session"], "state": state, "reason": reason}
    said |= {"id": told.get("id"), "sha256": told.get("sha256"), "frame_seq": frame}
    session.put(f"{root}/cm/ack", msgpack.packb(said), congestion_control=block)


def on_chunk(sample):
    *_, name, _, k = str(sample.key_expr).split("/")
    parts.setdefault(name, {})[int(k)] = sample.payload.to_bytes()


def on_commit(sample):  # what follows may wait: not in zenoh's thread
    threading.Thread(target=swap, args=[sample.payload.to_bytes()]).start()


def swap(data):
    global R
    try:
        told = msgpack.unpackb(data)
        name, wanted, shape = told["id"], range(told["n_chunks"]), told["shape"]
        before, frame = used.get(name, (None, None))
    except Exception as error:
        return acknowledge({}, "rejected", f"range: {error}")
    if before is not None and before == told["sha256"]:
        return acknowledge(told, "applied", "", frame)
    have, end_s = parts.setdefault(name, {}), time.time() + 2.0
    while not before and any(k not in have for k in wanted) and time.time() < end_s:
        time.sleep(0.01)
    for k in wanted:  # what is missing is asked for
        if k not in have and not before:
            for reply in session.get(f"{root}/cm/{name}?chunk={k}", timeout=2.0):
                have[k] = reply.ok.payload.to_bytes() if reply.ok else b""
    data = b"".join(have.get(k, b"") for k in wanted)
    right = hashlib.sha256(data).hexdigest() == told["sha256"] and ids.items() <= told.items()
    if before or not right or shape != [rows, n_slopes]:
        return acknowledge(told, "rejected", "range: id, sha256, shape, basis or configuration")
    with lock:
        R, frame = np.frombuffer(data, "<f4").reshape(shape), seq
        c[:, rows:] = 0.0
        status.update(cm_id=name, n_controlled=rows)
    used[name] = told["sha256"], frame
    return acknowledge(told, "applied", "", frame)


def on_applied(query):
    data = R.tobytes()
    told = {"v": 1, "id": status["cm_id"], "shape": R.shape, "dtype": "<f4", "n_chunks": 1, **ids}
    told |= {"chunk_bytes": len(data), "sha256": hashlib.sha256(data).hexdigest(), "system": system}
    told |= dict.fromkeys(("alpha", "sigma", "im_id", "parent")) | {"created_ns": start_ns}
    with query:
        query.reply(query.key_expr, data if query.parameters.get("chunk") else msgpack.packb(told))


config, block = zenoh.Config(), zenoh.CongestionControl.BLOCK
retry = {"period_init_ms": 200, "period_increase_factor": 1.5, "period_max_ms": 1000}
connect = {"endpoints": [endpoint], "retry": retry, "timeout_ms": -1}
for key, value in {"mode": "client", "connect": connect, "timestamping/enabled": True}.items():
    config.insert_json5(key, json.dumps(value))
session = zenoh.open(config)
keep = {"cache": zenoh.ext.CacheConfig(round(5 * hz / 10)), "publisher_detection": True}
keep["sample_miss_detection"] = zenoh.ext.MissDetectionConfig(heartbeat=0.2)
frames = zenoh.ext.declare_advanced_publisher(session, f"{root}/tel/frames", **keep)
held = [session.declare_subscriber(f"{root}/cm/*/chunk/*", on_chunk)]
held += [session.declare_subscriber(f"{root}/cm/*/commit", on_commit)]
held += [session.declare_queryable(f"{root}/cmd/rtc/dither", on_command)]
held += [session.declare_queryable(f"{root}/cmd/rtc/loop", on_command)]
held += [session.declare_queryable(f"{root}/rtc/cm/applied", on_applied)]
held += [session.liveliness().declare_token(f"{root}/alive/rtc")]
start_ns = time.time_ns()
while True:
    batch = np.zeros((10, n_slopes + 2 * n), "<f4")
    with lock:
        head = {"v": 1, "session": status["session"], "seq0": seq, "n": 10, "dither": True, **ids}
        head |= {"n_slopes": n_slopes, "n_modes": n, "cm_id": status["cm_id"]}
        head |= {"t0_ns": start_ns + round(seq * 1e9 / hz), "dt_ns": round(1e9 / hz)}
        for row in batch:
            turbulence = 0.998 * turbulence + 0.063 * sigma_m * rng.standard_normal(n)
            u = dither(seq)
            s = D @ (c[0] + u + turbulence) + 2e-3 * rng.standard_normal(n_slopes)
            row[:] = np.concatenate([s, c[0] + u, u])
            after = status["leak"] * c[1]
            after[: len(R)] -= np.array(status["gains"])[: len(R)] * (R @ s)
            c[:] = c[1], after * (status["loop"] == "closed")
            seq += 1
        status.update(seq=seq - 1, t_ns=head["t0_ns"] + 9 * head["dt_ns"])
        told = msgpack.packb(status)
    frames.put(batch.tobytes(), attachment=msgpack.packb(head))
    if seq % 100 == 0:
        session.put(f"{root}/tel/status", told)
    time.sleep(max(0.0, start_ns / 1e9 + seq / hz - time.time()))

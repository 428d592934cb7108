"""A whole RTC, from docs/rtc.md alone: ``python -m examples.rtc ENDPOINT SYSTEM PLANT.npz``.

PLANT.npz contains the telescope (see examples/telescope.py) and the first reconstructor ``matrix``
(n_controlled, n_slopes). A secured link needs two more arguments: zenoh's configuration
(rtc.json5), and the file of the secret if messages are signed.
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

RATE_HZ, BATCH, MAX_DITHER_M, ANNOUNCED_FRAMES = 500.0, 10, 50e-9, 20

endpoint, system, file, *secured = sys.argv[1:]
signing, root = Signing(*secured[1:]), f"ao/v1/{system}"
plant, start_ns, lock = np.load(file), time.time_ns(), threading.Lock()
telescope, matrix, (n_slopes, n) = Telescope(plant), plant["matrix"], plant["response"].shape
commands_m = np.zeros((2, n))  # of the next two exposures: the loop has a delay of two frames
seq, n_next, used_ids = 0, len(matrix), {}  # ids of matrices and commands, with their bytes

ids = {"v": 1, "basis_id": "plant-1", "config_id": "plant-1"}
status = {"session": str(start_ns), "loop": "closed", "frame_rate_hz": RATE_HZ, **ids}
status |= {"delay_frames": 2.0, "leak": 0.99, "n_controlled": len(matrix)}
status |= {"gains": [0.4] * len(matrix) + [0.0] * (n - len(matrix)), "cm_id": f"own-{start_ns}"}
status |= {"n_slopes": n_slopes, "n_modes": n, "magnitude": None, "flux": None}
status |= {"dither": None, "max_dither_m": MAX_DITHER_M, "max_dither_modes": 8}


# --- commands


def execute(kind, command):
    """Carry out a command; return the reason of a refusal, empty if there is none."""
    global n_next
    if kind == "loop":
        gains = command["gains"] or status["gains"]
        if len(gains) != n:
            return f"range: {len(gains)} gains, expected {n}"
        # Opening the loop zeroes the integrator, which begins a session.
        if command["loop"] == "open" and status["loop"] == "closed":
            commands_m[:], status["dither"], status["session"] = 0.0, None, str(time.time_ns())
        # The number of modes changes together with the matrix that has as many rows.
        n_next = command["n_controlled"] or n_next
        changes = {key: command[key] for key in ("gains", "leak", "loop")}
        status.update({key: value for key, value in changes.items() if value is not None})
    elif command["action"] == "stop":
        status["dither"] = None
    elif status["dither"]:
        return "busy: another dither is running"
    elif (
        command["kind"] != "sine"
        or max(command["modes"]) >= n
        or len(command["modes"]) > status["max_dither_modes"]
        or max(command["amplitude_m"]) > MAX_DITHER_M
        or max(command["frequency_hz"]) >= RATE_HZ / 2
    ):
        return f"range: expected at most 8 sines of modes below {n} and at most {MAX_DITHER_M} m"
    else:
        # Announced some frames ahead, so that the reply comes before the dither begins.
        status["dither"] = {**command, "start_seq": seq + ANNOUNCED_FRAMES}
    return ""


@functools.cache  # a repeated command gets the same reply and is not carried out again
def reply(kind, data):
    """Return the reply to the bytes of a command."""
    command_id, reason = None, ""
    try:
        command = msgpack.unpackb(data)
        command_id = command["id"]
        reason = "" if command["v"] == 1 else "v: expected 1"
        if used_ids.setdefault(command_id, data) != data:
            reason = "id: it was used for another command"
        reason = reason or execute(kind, command)
    except Exception as error:
        reason = f"{'missing' if isinstance(error, KeyError) else 'range'}: {error}"
    start = None if reason else seq + ANNOUNCED_FRAMES
    accepted = {"accepted": not reason, "reason": reason, "start_seq": start}
    return {"v": 1, "id": command_id, **accepted}


def describe_matrix():
    """Return the bytes of the reconstructor in use, and its manifest."""
    data = matrix.astype("<f4").tobytes()
    manifest = {"id": status["cm_id"], "sha256": hashlib.sha256(data).hexdigest(), **ids}
    manifest |= {"shape": matrix.shape, "dtype": "<f4", "n_chunks": 1, "chunk_bytes": len(data)}
    manifest |= {"system": system, "alpha": None, "sigma": None, "im_id": None, "parent": None}
    return data, {**manifest, "created_ns": start_ns}


def answer(query):
    """Answer a query of the service: a command, or one for the reconstructor in use."""
    with query, lock:
        key, chunk, data = str(query.key_expr), query.parameters.get("chunk"), b""
        if key.endswith("applied"):
            data, message = describe_matrix()
        else:
            handle = functools.partial(reply, key.split("/")[-1])
            message = signing.use_checked(key, query.payload.to_bytes(), handle)
        query.reply(key, data if chunk else signing.sign(key, message))


# --- reconstructors


@functools.cache  # a repeated commit is acknowledged again and not applied again
def swap(commit):
    """Apply the reconstructor of a commit between two frames; return the acknowledgement.

    Chunks that were published before are ignored: all are queried, which is simpler.
    """
    global matrix
    ack = {"v": 1, "id": None, "sha256": None, "state": "rejected", "frame_seq": None}
    try:
        new = msgpack.unpackb(commit)
        queries = [session.get(f"{root}/cm/{new['id']}?chunk={k}") for k in range(new["n_chunks"])]
        chunks = [chunk.ok for replies in queries for chunk in replies if chunk.ok]
        data = b"".join(chunk.payload.to_bytes() for chunk in chunks)
        ack |= {"id": new["id"], "sha256": new["sha256"]}
        ack["reason"] = "range: id, sum, shape, basis, configuration, system, or not finite"
        # A matrix for another basis, sensor or number of modes would be applied to the wrong
        # slopes or modes, which can destroy the loop in a few frames.
        expected = {**ids, "shape": [n_next, n_slopes], "dtype": "<f4", "system": system}
        valid = hashlib.sha256(data).hexdigest() == new["sha256"]
        valid = valid and expected.items() <= new.items()
        numbers = np.frombuffer(data, "<f4")
        valid = valid and np.isfinite(numbers).all()
        if valid and used_ids.setdefault(new["id"], commit) == commit:
            with lock:
                matrix = numbers.reshape(new["shape"])
                commands_m[:, len(matrix) :] = 0.0  # modes that are no longer controlled
                status.update(cm_id=new["id"], n_controlled=len(matrix))
                ack |= {"state": "applied", "reason": "", "frame_seq": seq}
    except Exception as error:
        ack["reason"] = f"range: {error}"
    return ack


def take_commits(commits):
    """Apply commits as they come; runs in a thread of its own, because queries block."""
    for commit in commits:
        key, ack_key = str(commit.key_expr), f"{root}/cm/ack"
        ack = signing.use_checked(key, commit.payload.to_bytes(), swap)
        ack = signing.sign(ack_key, ack | {"session": status["session"]})
        session.put(ack_key, ack, congestion_control=zenoh.CongestionControl.BLOCK)


# --- the loop


def run_frame():
    """Run one frame of the loop; return its row of telemetry: slopes, commands, dither."""
    dither, dither_m = status["dither"], np.zeros(n)
    if dither and seq >= dither["start_seq"] + round(dither["duration_s"] * RATE_HZ):
        status["dither"] = None
    elif dither and seq >= dither["start_seq"]:
        phase = 2 * np.pi * np.array(dither["frequency_hz"]) * (seq - dither["start_seq"]) / RATE_HZ
        dither_m[dither["modes"]] = np.array(dither["amplitude_m"]) * 2**0.5 * np.sin(phase)
    played_m = commands_m[0] + dither_m
    slopes = telescope.expose(played_m)
    commands_m[:] = commands_m[1], status["leak"] * commands_m[1]
    if status["loop"] == "closed":
        gains = np.array(status["gains"])[: len(matrix)]
        commands_m[1, : len(matrix)] -= gains * (matrix @ slopes)
    return [*slopes, *played_m, *dither_m]


def run_batch():
    """Run a batch of frames; return its header, its rows, and the signed status after it."""
    global seq
    rows = []
    with lock:
        header = {"session": status["session"], "cm_id": status["cm_id"], "seq0": seq, **ids}
        header |= {"t0_ns": start_ns + round(seq * 1e9 / RATE_HZ), "dt_ns": round(1e9 / RATE_HZ)}
        header |= {"n": BATCH, "n_slopes": n_slopes, "n_modes": n, "dither": True}
        for _ in range(BATCH):
            rows += run_frame()
            seq += 1
        status.update(seq=seq - 1, t_ns=header["t0_ns"] + (BATCH - 1) * header["dt_ns"])
        signed_status = signing.sign(f"{root}/tel/status", status)
    return header, np.array(rows, "<f4").tobytes(), signed_status


retry = {"period_init_ms": 200, "period_increase_factor": 1.5, "period_max_ms": 1000}
where = {"endpoints": [endpoint], "timeout_ms": -1, "retry": retry}
settings = {"mode": "client", "connect": where, "timestamping": {"enabled": True}}
session = connect(settings, *secured[:1])
# The cache and the heartbeat let the service recover frames that the network has lost.
recovery = {"cache": zenoh.ext.CacheConfig(round(RATE_HZ / 2)), "publisher_detection": True}
recovery["sample_miss_detection"] = zenoh.ext.MissDetectionConfig(heartbeat=0.2)
frames = zenoh.ext.declare_advanced_publisher(session, f"{root}/tel/frames", **recovery)
commits = session.declare_subscriber(f"{root}/cm/*/commit")
threading.Thread(target=take_commits, args=[commits], daemon=True).start()
keys = f"{root}/cmd/rtc/dither", f"{root}/cmd/rtc/loop", f"{root}/rtc/cm/applied"
declared = [session.declare_queryable(key, answer) for key in keys]
# The token comes last: the service sends commands as soon as it sees it.
declared += [session.liveliness().declare_token(f"{root}/alive/rtc")]
start_ns = time.time_ns()  # of the first frame: waiting for the router is no part of the loop
while True:
    header, payload, signed_status = run_batch()
    frames.put(payload, attachment=signing.sign(f"{root}/tel/frames", header, payload))
    if seq % 100 == 0:
        session.put(f"{root}/tel/status", signed_status)
    time.sleep(max(0.0, start_ns / 1e9 + seq / RATE_HZ - time.time()))

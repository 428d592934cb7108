"""Malformed input of every kind, by the million: ``make fuzz`` counts what becomes of it.

Each kind reads bytes as the service does and may only refuse them with an error of its own. What
else comes out, a crash, an answer 5xx or memory that stays, is a finding. ``--guided KIND`` has
atheris look for inputs that reach new code, where it is installed.
"""

import argparse
import asyncio
import gzip
import io
import json
import logging
import os
import random
import re
import resource
import sys
import tempfile
import time
import zlib
from collections import Counter
from collections.abc import Callable
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from urllib.parse import unquote

import h5py
import numpy as np
import structlog

from pyrcal.fitting.recorded import check_sealed
from service.errors import PyrcalError
from service.files.container import opened
from service.files.toml import read_toml
from service.instrument import load_instrument
from service.wire import (
    Acknowledgement,
    CommandKind,
    Manifest,
    MeasuredManifest,
    ReferencesInUse,
    Reply,
    Status,
    command_id,
    decode,
    decode_command,
    decode_frames,
)
from tests.support.forged import TWO_BY_THREE, fits_bytes

ROOT = Path(__file__).parents[1]
VECTORS = ROOT / "docs" / "rtc"


@dataclass(frozen=True)
class Kind:
    """One kind of input."""

    name: str
    share: int
    """Of each thousand inputs."""

    seeds: Callable[[], list[bytes]]
    read: Callable[[bytes], None]
    """Raises PyrcalError for what it refuses; nothing else."""


# --- the wire


def messages():
    return [path.read_bytes() for path in sorted(VECTORS.glob("*.msgpack"))]


READERS = (
    *(partial(decode, kind) for kind in (Status, Acknowledgement, Manifest, MeasuredManifest)),
    *(partial(decode, kind) for kind in (Reply, ReferencesInUse)),
    *(partial(decode_command, kind) for kind in CommandKind),
    command_id,
)


def read_message(data):
    """Read as one of all the messages there are: an RTC may send any under any key."""
    READERS[zlib.crc32(data) % len(READERS)](data)


SPLIT = b"\0|\0"
"""Between payload and attachment of a batch."""


def batches():
    names = [path.with_suffix("") for path in sorted(VECTORS.glob("frames*.msgpack"))]
    return [
        n.with_suffix(".bin").read_bytes() + SPLIT + n.with_suffix(".msgpack").read_bytes()
        for n in names
    ]


def read_batch(data):
    payload, _, attachment = data.partition(SPLIT)
    decode_frames(payload, attachment or None)


# --- files


def _in_file(suffix, read):
    def from_bytes(data):
        with tempfile.NamedTemporaryFile(dir=_memory(), suffix=suffix) as file:
            file.write(data)
            file.flush()
            read(Path(file.name))

    return from_bytes


def _memory():
    return "/dev/shm" if os.access("/dev/shm", os.W_OK) else None


def read_arrays(path):
    check_sealed(path)
    with opened(path) as file:
        for array in list(file.arrays.values())[:3]:
            array.numbers()


def hdf5_files():
    made = io.BytesIO()
    with h5py.File(made, "w") as file:
        file["interaction_matrix"] = np.arange(12.0).reshape(4, 3)
        file["group/flux"] = np.ones(4, np.float32)
        file["packed"] = h5py.SoftLink("/group/flux")
        file.create_dataset("chunked", data=np.ones((8, 8)), chunks=(4, 4), compression="gzip")
        file.attrs["double_pass"] = True
    return [made.getvalue()]


def fits_files():
    plain = fits_bytes(TWO_BY_THREE | {"EXTNAME": "'IM'"})
    more = fits_bytes({"BITPIX": -32, "NAXIS": 1, "NAXIS1": 9, "PCOUNT": 0, "GCOUNT": 1})
    part = more.replace(b"SIMPLE  =                    T", b"XTENSION= 'IMAGE   '          ")
    return [plain, plain + part, gzip.compress(plain, mtime=0)]


def npy_files():
    made = []
    for array in (np.arange(12.0).reshape(4, 3), np.asfortranarray(np.ones((2, 5), ">f4"))):
        file = io.BytesIO()
        np.save(file, array)
        made.append(file.getvalue())
    return made


def toml_files():
    packaged = sorted((ROOT / "service").rglob("*.toml"))
    return [path.read_bytes() for path in packaged if b"[wfs]" in path.read_bytes()]


def read_instrument(path):
    read_toml(path)
    load_instrument(str(path))


# --- REST


def requests():
    described = json.loads((ROOT / "docs" / "openapi.json").read_text(encoding="utf-8"))
    made = []
    for path, operations in described["paths"].items():
        if path in {"/v1/stream", "/v1/keys/{name}"}:  # one never ends, one revokes
            continue
        for method in operations.keys() & {"get", "post", "put", "delete"}:
            target = path.replace("{id}", "cm-1").replace("{other}", "cm-2").replace("{name}", "a")
            head = f"{method.upper()} {target}?since_ns=1&limit=3\n"
            body = '{"by": "ada", "reason": "why", "mode": "auto", "n_modes": 3, "t_ns_utc": 5}'
            made.append(f"{head}content-type: application/json\nif-match: *\n\n{body}".encode())
    return made


_TARGET = re.compile(rb"[\x21-\x7e]+")
_HEADER = re.compile(rb"[-!#$%&'*+.^_`|~0-9a-zA-Z]+:[\t\x20-\x7e\x80-\xff]*")
"""What h11 lets through (tests/unit/test_api_admission.py has real connections)."""


class Rest:
    """The real application on an archive of its own; its RTC accepts what it is asked."""

    def __init__(self):
        from tests.support.api_schemathesis import application

        self._folder = tempfile.TemporaryDirectory(dir=_memory())
        self._made = application(Path(self._folder.name), keys=None)
        self._app = self._made.__enter__()
        self._loop = asyncio.new_event_loop()

    def read(self, data):
        self._loop.run_until_complete(asyncio.wait_for(self._ask(data), 20.0))

    async def _ask(self, data):
        head, _, body = data.partition(b"\n\n")
        first, *lines = head.split(b"\n")
        method, _, target = first.partition(b" ")
        path, _, query = target.partition(b"?")
        headers = [tuple(p.strip() for p in line.partition(b":")[::2]) for line in lines]
        if not (_TARGET.fullmatch(target) and all(_HEADER.fullmatch(line) for line in lines)):
            raise PyrcalError("the server's parser refuses it")
        scope = {
            "type": "http",
            "http_version": "1.1",
            "method": method.decode("latin1").upper(),
            "path": unquote(path.decode("ascii")),
            "raw_path": path,
            "root_path": "",
            "scheme": "http",
            "query_string": query,
            "headers": [(b"host", b"localhost"), *((k.lower(), v) for k, v in headers)],
            "client": ("127.0.0.1", 1),
            "server": ("127.0.0.1", 80),
        }
        if scope["path"] == "/v1/stream":
            return
        sent, pieces = [], [{"type": "http.request", "body": body, "more_body": False}]

        async def receive():
            return pieces.pop() if pieces else {"type": "http.disconnect"}

        async def send(message):
            sent.append(message)

        await self._app(scope, receive, send)
        if not sent:  # a file is not sent to one who has gone, as this one has
            return
        status = sent[0]["status"]
        if status >= 500 and scope["path"] != "/readyz":
            raise AssertionError(f"{status}: {sent[-1].get('body', b'')[:300]!r}")
        if status >= 400:
            raise PyrcalError(str(status))

    def close(self):
        self._made.__exit__(None, None, None)
        self._loop.close()
        self._folder.cleanup()


@contextmanager
def rest():
    """Give what reads a request."""
    asked = Rest()
    try:
        yield asked.read
    finally:
        asked.close()


KINDS = (
    Kind("messages", 780, messages, read_message),
    Kind("frames", 150, batches, read_batch),
    Kind("hdf5", 6, hdf5_files, _in_file(".h5", read_arrays)),
    Kind("fits", 6, fits_files, _in_file(".fits", read_arrays)),
    Kind("npy", 20, npy_files, _in_file(".npy", read_arrays)),
    Kind("toml", 24, toml_files, _in_file(".toml", read_instrument)),
)


# --- what is wrong with them


NUMBERS = (b"-1", b"0", b"999999999999999999999", b"1e999", b"NaN", b"9223372036854775807")


BYTES = (0, 1, 0x7F, 0x80, 0xC1, 0xFF, 0xDD, 0xDF)
"""Ends of ranges; what begins a map or an array of msgpack, or nothing there."""


def mutated(data, rng, others):
    """Return a seed with up to four things wrong."""
    made = bytearray(data)
    for _ in range(rng.randint(1, 4)):
        place = rng.randrange(len(made) + 1)
        match rng.randrange(7):
            case 0 if made:
                byte = made[place % len(made)] ^ 1 << rng.randrange(8)
                made[place % len(made)] = rng.choice((byte, byte, byte, *BYTES))
            case 1:
                del made[place:]
            case 2:
                del made[place : place + rng.randint(1, 16)]
            case 3:
                made[place:place] = rng.randbytes(rng.randint(1, 8))
            case 4:
                made[place:place] = made[place : place + rng.randint(1, 200)]
            case 5:
                other = rng.choice(others)
                start = rng.randrange(len(other))
                made[place:] = other[start : start + 4000]
            case _:
                made[place : place + rng.randint(0, 8)] = rng.choice(NUMBERS)
    return bytes(made)


@dataclass
class Outcome:
    """What became of the inputs of one kind."""

    n_inputs: int = 0
    n_refused: int = 0
    longest_s: float = 0.0
    findings: Counter = field(default_factory=Counter)


def tried(kind, n_inputs, rng, corpus=None):
    """Read so many mutations of a kind's seeds; return what became of them."""
    seeds, outcome = kind.seeds(), Outcome()
    for _ in range(n_inputs):
        data = mutated(rng.choice(seeds), rng, seeds)
        began_s = time.process_time()
        try:
            kind.read(data)
        except PyrcalError:
            outcome.n_refused += 1
        except Exception as error:  # noqa: BLE001 - that is what is looked for
            found = f"{type(error).__name__}: {error!s:.200}"
            outcome.findings[found] += 1
            if corpus is not None and outcome.findings[found] == 1:
                (corpus / f"{kind.name}-{len(outcome.findings)}").write_bytes(data)
        outcome.n_inputs += 1
        outcome.longest_s = max(outcome.longest_s, time.process_time() - began_s)
    return outcome


def held_mb():
    with open("/proc/self/statm", encoding="ascii") as file:
        return int(file.read().split()[1]) * resource.getpagesize() / 1e6


def guided(kind, options):
    """Have atheris look for inputs that reach new code; never returns."""
    import atheris  # the one who asks for it has installed it

    def one(data):
        with suppress(PyrcalError):
            kind.read(data)

    corpus = Path(tempfile.mkdtemp(prefix=f"pyrcal-{kind.name}-"))
    for k, seed in enumerate(kind.seeds()):
        (corpus / str(k)).write_bytes(seed)
    atheris.instrument_all()
    atheris.Setup([sys.argv[0], str(corpus), "-max_len=20000", *options], one)
    atheris.Fuzz()


HEAD = "| kind | inputs | refused | findings | longest, s of processor time | memory kept, MB |"


def counted(kind, n_inputs, rng, corpus):
    """Try a kind, print its row, and return how much was found."""
    tried(kind, min(n_inputs, 500), rng)  # what is kept once is no leak
    before_mb, files_before = held_mb(), len(os.listdir("/proc/self/fd"))
    found = tried(kind, n_inputs, rng, corpus)
    kept_mb, n_files = held_mb() - before_mb, len(os.listdir("/proc/self/fd")) - files_before
    if n_files > 0:
        found.findings[f"{n_files} files stay open"] += 1
    n_findings = sum(found.findings.values())
    numbers = (kind.name, found.n_inputs, found.n_refused, n_findings, f"{found.longest_s:.2f}")
    print("|", " | ".join(map(str, numbers)), f"| {kept_mb:+.1f} |", flush=True)
    for text, n in found.findings.most_common(8):
        print(f"    {n} x {text}", file=sys.stderr)
    return found.n_inputs, n_findings


def main():
    """Do what the command line asks for."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--inputs", type=int, default=1_050_000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--corpus", type=Path, help="folder for what is found")
    parser.add_argument(
        "--commands", metavar="READER", nargs="?", const="", help="commands on files"
    )
    parser.add_argument("--guided", help="kind, with atheris; what else is given is libFuzzer's")
    options, more = parser.parse_known_args()
    structlog.configure(wrapper_class=structlog.make_filtering_bound_logger(logging.CRITICAL))
    if options.commands is not None:
        from tests.malformed_commands import every_reader

        n_findings = every_reader(
            min(options.inputs, 100_000), options.seed, options.corpus, options.commands
        )
        return min(n_findings, 1)
    if options.guided:
        guided(next(kind for kind in KINDS if kind.name == options.guided), more)
    rng, rows = random.Random(options.seed), []
    print(HEAD, "| --- " * 6 + "|", sep="\n")
    with rest() as read:
        for kind in (*KINDS, Kind("rest", 14, requests, read)):
            n_inputs = options.inputs * kind.share // 1000
            rows.append(counted(kind, n_inputs, rng, options.corpus))
    n_inputs, n_findings = map(sum, zip(*rows, strict=True))
    print(f"\n{n_inputs} inputs, {n_findings} findings")
    return min(n_findings, 1)


if __name__ == "__main__":
    sys.exit(main())

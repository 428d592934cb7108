"""Every command that reads a file, on mutated files: ``make fuzz ARGS=--commands``.

Each reader is a command line and the good files that it reads. A file is mutated as bytes, as the
arrays in it (NaN, zeros, other shapes, types and sizes, one missing), or as text (other numbers,
lines left out). A finding is an exception, an exit status that the command does not document, a
refusal without a line on standard error, an answer that is no JSON where JSON was asked for, or a
file that a refused command leaves behind.
"""

import io
import json
import os
import random
import re
import signal
import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Callable
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path

import h5py
import numpy as np
from astropy.io import fits

from tests.malformed import mutated

ROOT = Path(__file__).parents[1]
IMPORTED = ROOT / "pyrcal" / "samples" / "data"
LONGEST_S = 60.0
"""Processor time after which a command counts as one that does not end."""

REFUSED = 2
UNSURE = frozenset({0, 1, REFUSED})
WRITES = frozenset({0, REFUSED})


@dataclass(frozen=True)
class Reader:
    """A command that reads files."""

    name: str
    files: Callable[[], dict[str, bytes]]
    """Returns its good files by their path in a folder."""

    words: tuple[str, ...]
    """The command line; ``{}`` stands for the folder."""

    statuses: frozenset[int] = UNSURE
    mutated: str = ""
    """Pattern of the files that are mutated; empty: all."""


# --- good files


BENCH = """
[instrument]
name = "small"
diameter_m = 2.0
stop = "telescope"

[wfs]
kind = "shack-hartmann"
n_subapertures = 5
wavelength_m = 650e-9
valid_subapertures = "mask.h5:/valid"

[mirror]
layout = "grid"
n_across = 4
pitch_m = 0.6
diameter_m = 2.4
influence = "gaussian"
coupling = 0.3
basis = "zonal"

[slopes]
orientation = "auto"
"""


def as_npy(values):
    made = io.BytesIO()
    np.save(made, values)
    return made.getvalue()


def as_npz(**arrays):
    made = io.BytesIO()
    np.savez(made, **arrays)
    return made.getvalue()


def as_hdf5(attrs=None, **arrays):
    made = io.BytesIO()
    with h5py.File(made, "w") as file:
        for name, values in arrays.items():
            file[name] = values
        file.attrs.update(attrs or {})
    return made.getvalue()


def as_fits(*images):
    units = [fits.PrimaryHDU(), *(fits.ImageHDU(values, name=name) for name, values in images)]
    made = io.BytesIO()
    fits.HDUList(units).writeto(made)
    return made.getvalue()


@cache
def bench():
    """Instrument, mask and matrix of a bench that is fitted in a second."""
    from service.instrument import load_instrument
    from service.model.interaction import RtcInteractionModel
    from service.model.misregistration import Misregistration
    from service.model.modes import modal_basis
    from service.model.pupil import rtc_valid_subapertures

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "bench.toml"
        path.write_text(BENCH.replace('valid_subapertures = "mask.h5:/valid"\n', ""))
        about = load_instrument(path)
    model = RtcInteractionModel(about, modal_basis(about), pupil_sampling=4, detector_nodes=4)
    alpha = Misregistration(shift_x_subap=0.1, shift_y_subap=-0.05, rotation_rad=0.01)
    matrix = np.asarray(model.interaction_matrix(alpha), float)
    return matrix, rtc_valid_subapertures(about), about.mirror.positions_m


def instrument_files():
    _, valid, _ = bench()
    return {"bench.toml": BENCH.encode(), "mask.h5": as_hdf5(valid=valid.astype(np.uint8))}


def beside_instrument(name, make):
    return lambda: {**instrument_files(), name: make(bench()[0])}


def noted(matrix):
    n = matrix.shape[1]
    extra = {"modes": np.arange(n), "noise": np.full(n, 1e3)}
    return as_hdf5({"double_pass": False}, interaction_matrix=matrix, **extra)


def imported(*names):
    return lambda: {name: (IMPORTED / name).read_bytes() for name in names}


def cubes():
    """Arrays by role: slopes, mask and modes as a cube."""
    rng, side = np.random.default_rng(1), 6
    rows, columns = np.mgrid[:side, :side] - (side - 1) / 2
    valid = np.hypot(rows, columns) <= side / 2
    return {
        "matrix": rng.normal(size=(2 * int(valid.sum()), 5)),
        "valid": valid.astype(np.uint8),
        "modes": rng.normal(size=(5, 12, 12)).astype(np.float32),
    }


def frames():
    """Camera frames of a pyramid, the light, and positions of actuators."""
    from tests.support.import_cacao import CUBE, LIGHT, PLACES

    return {"matrix": CUBE, "light": LIGHT, "positions": PLACES[:, 1:]}


def cacao_files():
    from tests.support import import_cacao as made_import_cacao

    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        made_import_cacao.a_list_of_actuators(folder)
        np.savetxt(folder / "act2Dpos.txt", made_import_cacao.PLACES)
        return {f"conf/{one.name}": one.read_bytes() for one in sorted(folder.iterdir())}


def cacao_maps():
    from tests.support import import_cacao as made_import_cacao

    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        made_import_cacao.a_grid(folder)
        return {f"conf/{one.name}": one.read_bytes() for one in sorted(folder.iterdir())}


def pyrtc_files():
    with np.load(IMPORTED / "pyrtc-valid.npz") as file:
        side = file["data"].shape[-1]
    rng = np.random.default_rng(2)
    with np.load(IMPORTED / "pyrtc-im.npz") as file:
        n_modes = file["data"].shape[-1]
    return {
        **imported("pyrtc-im.npz", "pyrtc-valid.npz")(),
        "modes.npy": as_npy(rng.normal(size=(n_modes, 2 * side, 2 * side))),
    }


SMALL = str(ROOT / "tests" / "system" / "small.toml")
TRACKED = str(ROOT / "tests" / "unit" / "runtime" / "small.toml")


@cache
def telemetry():
    """A second of random telemetry of the small instrument."""
    from service.instrument import load_instrument
    from service.model.pupil import rtc_valid_subapertures

    about = load_instrument(TRACKED)
    n_slopes, n_modes = 2 * int(rtc_valid_subapertures(about).sum()), 6
    rng, n = np.random.default_rng(3), 120
    t = np.arange(n) / 500.0
    dither = np.zeros((n, n_modes))
    dither[:, 2] = 1e-8 * np.sin(2.0 * np.pi * 40.0 * t)
    return {
        "slopes": rng.normal(size=(n, n_slopes)).astype(np.float32),
        "commands_m": 1e-8 * rng.normal(size=(n, n_modes)) + dither,
        "dither_m": dither,
        "reconstructor": 1e-8 * rng.normal(size=(4, n_slopes)),
        "seq": np.arange(n) + 100,
        "gains": np.full(4, 0.4),
        "dither_modes": np.array([2]),
        "dither_frequencies_hz": np.array([40.0]),
        "dither_amplitude_m": np.array([1e-8]),
        "frame_rate_hz": np.array(500.0),
        "delay_frames": np.array(2.0),
    }


def recording():
    from service.files.recording import RecordedKind, RecordingWriter
    from service.wire import encode, encode_frames
    from tests.support import fitted_aot as made_aot

    with tempfile.TemporaryDirectory() as name:
        path = Path(name) / "night.h5"
        with RecordingWriter(path, system="small") as recorder:
            recorder.put(RecordedKind.MATRIX, made_aot.MATRIX.tobytes(), encode(made_aot.MANIFEST))
            recorder.put(RecordedKind.STATUS, encode(made_aot.STATUS))
            for k in range(0, made_aot.N_FRAMES, 20):
                payload = encode_frames(made_aot.header(k), made_aot.ROWS[k : k + 20])
                recorder.put(RecordedKind.FRAMES, *payload)
        return {"night.h5": path.read_bytes()}


def aot_matrix():
    from tests.support import import_files as made_import_files

    with tempfile.TemporaryDirectory() as name:
        path = Path(name) / "it.fits"
        matrix = made_import_files.MATRIX.reshape(2, -1, 5)
        made_import_files.aot_file(path, interaction_matrix=matrix)
        return {"it.fits": path.read_bytes()}


@cache
def aot_telemetry():
    from service.instrument import load_instrument
    from tests.support import played_aot as made_aot_played

    with tempfile.TemporaryDirectory() as name:
        made_aot_played.Hand(load_instrument(TRACKED)).read(Path(name), load_instrument(TRACKED))
        return {"hand.fits": (Path(name) / "hand.fits").read_bytes()}


def session():
    from tests.support import pyrtc as made_pyrtc_played

    ids = range(100, 160)
    with tempfile.TemporaryDirectory() as name:
        folder = made_pyrtc_played.session_in(
            Path(name) / "s",
            signals=made_pyrtc_played.counted(ids, made_pyrtc_played.N_SLOPES),
            commands=made_pyrtc_played.counted(ids, made_pyrtc_played.N_MODES),
            facts={"delay_frames": 2.0, "leak": 0.99, "frame_rate_hz": 500.0},
        )
        return {
            f"s/{one.relative_to(folder)}": one.read_bytes()
            for one in sorted(folder.rglob("*"))
            if one.is_file()
        }


@cache
def system_files():
    from tests.support import systems

    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        head, first, _, third = systems.SYSTEM.partition("[[mirrors]]")[0].split("[[sensors]]")
        mirror = '[[mirrors]]\nname = "dm1"\naltitude_m = 0.0\nshift_m = [0.0, 0.0]\n'
        about = systems.written(folder, "[[sensors]]".join([head, first, third]) + mirror, 5)
        rng = np.random.default_rng(1)
        values = systems.moved(about, rng, 0.05)
        matrices = [systems.matrix(about, pair, values, 3) for pair in about.pairs]
        systems.recorded(folder / "all.h5", matrices, about)
        return {one.name: one.read_bytes() for one in sorted(folder.iterdir())}


@cache
def fit_outputs():
    from pyrcal.fitting.report import document, fill_fit
    from service.files.documents import json_text
    from tests.support.made import a_fit, a_report

    n = bench()[0].shape[1]
    maps = np.full((2, 5, 5), 0.02)
    report = a_report(
        a_fit(
            modes=np.arange(n),
            gains=np.ones(n),
            residual_by_mode=np.zeros(n),
            residual_map=maps,
            synthetic=bench()[0],
            measured=bench()[0],
            valid=bench()[1],
        )
    )
    made = io.BytesIO()
    with h5py.File(made, "w") as file:
        fill_fit(file, report)
    return json_text(document(report)).encode(), made.getvalue()


def with_alpha(name, number):
    return lambda: {**instrument_files(), name: fit_outputs()[number]}


def flux_files():
    rng = np.random.default_rng(4)
    flux = rng.uniform(80.0, 100.0, size=(4, 12, 12))
    tiny = ROOT / "tests" / "data" / "tiny"
    return {
        "flux.h5": as_hdf5(flux=flux),
        "tiny.toml": (tiny / "tiny.toml").read_bytes().replace(b'"auto"', b"{ flip_y = true }"),
    }


def settings():
    return {"settings.toml": (ROOT / "deploy" / "pyrcal.toml").read_bytes()}


def keys():
    from pyrcal.__main__ import main

    with tempfile.TemporaryDirectory() as name:
        with redirect_stdout(io.StringIO()), redirect_stderr(io.StringIO()):
            main(["key", "add", "ada", "--data-dir", name, "--scope", "operate"])
        folder = Path(name)
        return {
            f"var/{one.relative_to(folder)}": one.read_bytes()
            for one in sorted(folder.rglob("*"))
            if one.is_file()
        }


def archive():
    folder = ROOT / "tests" / "data" / "archive"
    return {
        f"var/{one.relative_to(folder)}": one.read_bytes()
        for one in sorted(folder.rglob("*"))
        if one.is_file() and one.name != "README.md"
    }


_OF_FILES = ("--diameter-m", "2", "--output", "{}/out")
_FIT = ("fit", "{}/bench.toml")

READERS = (
    *(
        Reader(
            f"fit, {kind}",
            beside_instrument(name, make),
            (*_FIT, "{}/" + name, "--json", "--threads=1"),
            mutated=rf"^{name}$",
        )
        for kind, name, make in (
            ("HDF5", "im.h5", noted),
            ("NumPy", "im.npy", as_npy),
            ("FITS", "im.fits", lambda m: as_fits(("INTERACTION_MATRIX", m))),
        )
    ),
    Reader(
        "fit, instrument file",
        beside_instrument("im.h5", noted),
        (*_FIT, "{}/im.h5", "--json", "--threads=1", "--memory-gb=1"),
        mutated="bench|mask",
    ),
    Reader(
        "reconstruct, light",
        flux_files,
        (
            *("reconstruct", "{}/tiny.toml", "0,0,0,1", "--modes=8", "--output", "{}/out.h5"),
            *("--flux-map", "{}/flux.h5"),
        ),
        WRITES,
        mutated="flux",
    ),
    Reader(
        "conventions",
        beside_instrument("im.h5", noted),
        ("conventions", "{}/bench.toml", "{}/im.h5"),
    ),
    Reader(
        "instrument check",
        instrument_files,
        ("instrument", "check", "{}/bench.toml", "--memory-gb=0.5"),
        frozenset({0, 1}),
    ),
    Reader(
        "instrument check, pyramid",
        flux_files,
        ("instrument", "check", "{}/tiny.toml", "--memory-gb=0.1"),
        frozenset({0, 1}),
        mutated="toml",
    ),
    Reader(
        "import oopao, pyramid",
        imported("oopao-pyramid.npz"),
        ("import", "oopao", "{}/oopao-pyramid.npz", "--output", "{}/out"),
        WRITES,
    ),
    Reader(
        "import oopao, lenslets",
        imported("oopao-lenslets.npz"),
        ("import", "oopao", "{}/oopao-lenslets.npz", "--output", "{}/out"),
        WRITES,
    ),
    Reader(
        "import specula",
        imported("specula-im.fits", "specula-pup.fits", "specula-ifunc.fits"),
        (
            "import",
            "specula",
            "{}/specula-im.fits",
            "{}/specula-pup.fits",
            "{}/specula-ifunc.fits",
            *_OF_FILES,
        ),
        WRITES,
    ),
    Reader(
        "import synim",
        imported("synim-im.fits", "synim-subap.fits", "synim-ifunc.fits"),
        (
            "import",
            "synim",
            "{}/synim-im.fits",
            "{}/synim-subap.fits",
            "{}/synim-ifunc.fits",
            *_OF_FILES,
        ),
        WRITES,
    ),
    Reader("import cacao, pixels", cacao_files, ("import", "cacao", "{}/conf", *_OF_FILES), WRITES),
    Reader("import cacao, maps", cacao_maps, ("import", "cacao", "{}/conf", *_OF_FILES), WRITES),
    Reader(
        "import pyrtc",
        pyrtc_files,
        (
            "import",
            "pyrtc",
            "{}/pyrtc-im.npz",
            "{}/pyrtc-valid.npz",
            "modes={}/modes.npy",
            *_OF_FILES,
        ),
        WRITES,
    ),
    Reader(
        "import files, npz",
        lambda: {"all.npz": as_npz(**cubes())},
        ("import", "files", "{}/all.npz", *_OF_FILES),
        WRITES,
    ),
    Reader(
        "import files, npy",
        lambda: {f"{k}.npy": as_npy(v) for k, v in cubes().items()},
        ("import", "files", "{}", *_OF_FILES),
        WRITES,
    ),
    Reader(
        "import files, HDF5",
        lambda: {"all.h5": as_hdf5(**cubes())},
        ("import", "files", "{}/all.h5", *_OF_FILES),
        WRITES,
    ),
    Reader(
        "import files, FITS",
        lambda: {"all.fits": as_fits(*cubes().items())},
        ("import", "files", "{}/all.fits", *_OF_FILES),
        WRITES,
    ),
    Reader(
        "import files, frames",
        lambda: {"all.npz": as_npz(**frames())},
        ("import", "files", "{}/all.npz", *_OF_FILES),
        WRITES,
    ),
    Reader("import aot", aot_matrix, ("import", "aot", "{}/it.fits", *_OF_FILES), WRITES),
    Reader(
        "track, npz",
        lambda: {"t.npz": as_npz(**telemetry())},
        ("track", TRACKED, "{}/t.npz", "--json"),
    ),
    Reader(
        "track, HDF5",
        lambda: {"t.h5": as_hdf5(**telemetry())},
        ("track", TRACKED, "{}/t.h5", "--json"),
    ),
    Reader("track, recording", recording, ("track", TRACKED, "{}/night.h5", "--json")),
    Reader("track, AOT", aot_telemetry, ("track", SMALL, "{}/hand.fits", "--json")),
    Reader("track, pyRTC session", session, ("track", SMALL, "{}/s", "--json")),
    Reader(
        "track, settings",
        lambda: {**recording(), **settings()},
        ("track", TRACKED, "{}/night.h5", "--json", "--config", "{}/settings.toml"),
        mutated="settings",
    ),
    Reader(
        "fit-system, file",
        system_files,
        ("fit-system", "{}/system.toml", "{}/all.h5", "--json", "--threads=1"),
        mutated="toml",
    ),
    Reader(
        "fit-system, matrices",
        system_files,
        ("fit-system", "{}/system.toml", "{}/all.h5", "--json", "--threads=1"),
        mutated="h5",
    ),
    Reader(
        "reconstruct, JSON",
        with_alpha("alpha.json", 0),
        ("reconstruct", "{}/bench.toml", "{}/alpha.json", "--modes=10", "--output", "{}/out.h5"),
        WRITES,
        mutated="alpha",
    ),
    Reader(
        "reconstruct, HDF5",
        with_alpha("alpha.h5", 1),
        ("reconstruct", "{}/bench.toml", "{}/alpha.h5", "--modes=10", "--output", "{}/out.h5"),
        WRITES,
        mutated="alpha",
    ),
    Reader("archive verify", archive, ("archive", "verify", "--data-dir", "{}/var")),
    Reader("archive list", archive, ("archive", "list", "--json", "--data-dir", "{}/var")),
    Reader("key list", keys, ("key", "list", "--data-dir", "{}/var")),
)


# --- what is wrong with them


_NUMBER = re.compile(r"-?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?")
_TEXT_NUMBERS = (
    *("0", "-1", "1e308", "nan", "inf", "-inf", "1e-300", "99999999999999999999", "true"),
    *('"x"', "[]", "[1, 2]", '""', '"unknown"', "0.5", "3", "1000000", "{}"),
)


def mutated_text(data, rng):
    text = data.decode("utf-8", "replace")
    for _ in range(rng.randint(1, 2)):
        lines = text.splitlines(keepends=True)
        found = list(_NUMBER.finditer(text))
        match rng.randrange(5):
            case 0 | 1 if found:
                one = rng.choice(found)
                text = text[: one.start()] + rng.choice(_TEXT_NUMBERS) + text[one.end() :]
            case 2 if lines:
                del lines[rng.randrange(len(lines))]
                text = "".join(lines)
            case 3 if lines:
                lines.insert(rng.randrange(len(lines)), rng.choice(lines))
                text = "".join(lines)
            case _:
                words = re.findall(r'"[^"\n]*"', text)
                if words:
                    text = text.replace(rng.choice(words), rng.choice([*words, '"x"', "7"]), 1)
    return text.encode()


def mutated_array(values, rng):
    """Return an array with one thing wrong, or None for one that is missing."""
    values = np.array(values)
    if values.dtype.kind not in "iufb":
        return rng.choice([None, np.array(3), np.array("x")])
    wide = values.astype(float)
    if not values.size:
        return wide
    place = tuple(rng.randrange(n) for n in values.shape)
    axis = rng.randrange(values.ndim) if values.ndim else 0
    bad = rng.choice([np.nan, np.inf, -np.inf, 0.0, 1e300, 1e-300, -1.0, 1e20, 2**63])
    match rng.randrange(16):
        case 0:
            wide[place] = bad
        case 1 if values.ndim:
            np.moveaxis(wide, axis, 0)[place[axis]] = bad
        case 2:
            wide[...] = bad
        case 3:
            return None
        case 4 if values.ndim:
            return np.delete(values, place[axis], axis=axis)
        case 5 if values.ndim:
            return np.repeat(values, 2, axis=axis)
        case 6:
            return values.T
        case 7:
            return values[None]
        case 8 if values.ndim:
            return values[place[0]]
        case 9:
            return np.take(values, [], axis=axis) if values.ndim else np.zeros(0, values.dtype)
        case 10:
            return wide.astype(rng.choice([np.complex128, np.int8, np.bool_, ">f4", np.float16]))
        case 11:
            return wide * rng.choice([-1.0, 1e9, 1e-9, 1e150, 1e-150])
        case 12 if values.ndim:
            one, other = rng.randrange(values.shape[axis]), place[axis]
            np.moveaxis(wide, axis, 0)[one] = np.moveaxis(wide, axis, 0)[other]
        case 13:
            return values.ravel()
        case 14 if values.ndim:
            return np.moveaxis(wide, axis, 0)[:1]
        case _:
            wide += np.abs(wide).max() * np.random.default_rng(rng.randrange(9)).normal(
                size=wide.shape
            )
    return wide


def mutated_arrays(data, suffix, rng):
    """Return a file of arrays of which one is wrong."""
    if suffix == ".npy":
        made = mutated_array(np.load(io.BytesIO(data)), rng)
        return b"" if made is None else as_npy(made)
    if suffix == ".npz":
        with np.load(io.BytesIO(data)) as file:
            arrays = {name: file[name] for name in file.files}
        name = rng.choice(sorted(arrays))
        made = mutated_array(arrays.pop(name), rng)
        return as_npz(**arrays, **({} if made is None else {name: made}))
    if suffix == ".h5":
        buffer = io.BytesIO(data)
        with h5py.File(buffer, "r+") as file:
            names = []
            file.visititems(lambda n, item: names.append(n) if hasattr(item, "shape") else None)
            if rng.random() < 0.2 and len(file.attrs):
                name = rng.choice(sorted(file.attrs))
                file.attrs[name] = rng.choice([np.nan, -1, "x", 1e300, np.arange(3.0)])
            elif names:
                name = rng.choice(names)
                try:
                    made = mutated_array(file[name][()], rng)
                    del file[name]
                    if made is not None and made.dtype.kind != "U":
                        file[name] = made
                except (ValueError, TypeError, OSError):  # one that cannot be written like that
                    pass
        return buffer.getvalue()
    with fits.open(io.BytesIO(data), memmap=False) as units:
        one = rng.choice(list(units))
        if one.data is not None and one.data.dtype.names:
            column = rng.choice(one.data.dtype.names)
            with np.errstate(all="ignore"):
                if one.data[column].dtype.kind == "f":
                    one.data[column] = rng.choice([np.nan, 0.0, -1.0, 1e30])
        elif one.data is not None:
            made = mutated_array(one.data, rng)
            if made is None or made.dtype.kind in "cUb":
                made = np.zeros(1)
            one.data = made
        cards = [c for c in one.header if c not in {"SIMPLE", "XTENSION", "BITPIX", "NAXIS", ""}]
        if cards and (one.data is None or rng.random() < 0.3):
            key = rng.choice([c for c in cards if not c.startswith("NAXIS")] or cards)
            one.header[key] = rng.choice([0, -1, "x", 1e30, True, 7])
        made = io.BytesIO()
        units.writeto(made, output_verify="ignore")
    return made.getvalue()


_ARRAYS = {".npy", ".npz", ".h5", ".fits"}
_TEXTS = {".toml", ".json", ".txt", ".bash", ""}


def spoilt(name, data, rng):
    """Return a file with something wrong, or None for one that is not there."""
    if rng.random() < 0.01:
        return None
    if not data:
        return rng.randbytes(40)
    suffix = Path(name).suffix
    if rng.random() < 0.3 or suffix not in _ARRAYS | _TEXTS:
        return mutated(data, rng, [data])
    try:
        with warnings.catch_warnings(), np.errstate(all="ignore"):
            warnings.simplefilter("ignore")
            return (
                mutated_text(data, rng) if suffix in _TEXTS else mutated_arrays(data, suffix, rng)
            )
    except Exception:  # noqa: BLE001 - the mutation cannot be written: another is made
        return mutated(data, rng, [data])


# --- what becomes of it


class _TooLongError(BaseException):
    pass


@contextmanager
def _limited():
    def stop(*_):
        raise _TooLongError

    before = signal.signal(signal.SIGPROF, stop)
    signal.setitimer(signal.ITIMER_PROF, LONGEST_S)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0.0)
        signal.signal(signal.SIGPROF, before)


def run(words):
    """Run a command in this process; return exit status or finding, answer and what was said."""
    from pyrcal.__main__ import main

    answer, said = io.StringIO(), io.StringIO()
    try:
        with redirect_stdout(answer), redirect_stderr(said), _limited():
            status = main(words)
    except SystemExit as error:
        status = error.code if isinstance(error.code, int) else 1
    except _TooLongError:
        status = f"not done after {LONGEST_S:.0f} s of processor time"
    except BaseException as error:  # noqa: BLE001 - that is what is looked for
        place = traceback.extract_tb(error.__traceback__)
        own = [one for one in place if "site-packages" not in one.filename][-1]
        where = f"{Path(own.filename).name}:{own.lineno}"
        status = f"{type(error).__name__} at {where}: {str(error)[:160]}"
    return status, answer.getvalue(), said.getvalue()


def finding_of(reader, words, folder):
    """Return what is wrong with how a command ends, or None."""
    before = set(folder.rglob("*"))
    status, answer, said = run(words)
    if not isinstance(status, int):
        return status, None
    if status not in reader.statuses:
        return f"exit status {status}", status
    if "Traceback" in said or "Traceback" in answer:
        return "a traceback is printed", status
    if status == REFUSED:
        if not said.strip():
            return "refused without a line", status
        # SQLite's own files are removed by the next writer; a damaged file is renamed, not lost
        meant = {*folder.rglob("*.sqlite-*"), *folder.rglob("*.damaged")}
        left = set(folder.rglob("*")) - before - meant
        if left:
            return f"refused, and {min(one.name for one in left)} left behind", status
    elif "--json" in words:
        try:
            json.loads(answer, parse_constant=_no_number)
        except ValueError as error:
            return f"no JSON: {error}", status
    return None, status


def _no_number(text):
    raise ValueError(f"{text} is none of JSON")


@dataclass
class Outcome:
    """What became of the mutated files of one reader."""

    statuses: Counter = field(default_factory=Counter)
    findings: Counter = field(default_factory=Counter)
    longest_s: float = 0.0


def tried(reader, n_inputs, seed, kept=None):
    """Run a reader on so many mutations; return what became of them."""
    rng, outcome = random.Random(f"{reader.name} {seed}"), Outcome()
    good = reader.files()
    names = sorted(name for name in good if re.search(reader.mutated, name))
    memory = "/dev/shm" if os.access("/dev/shm", os.W_OK) else None
    for number in range(n_inputs + 1):
        with tempfile.TemporaryDirectory(dir=memory) as path:
            folder, files = Path(path), dict(good)
            if number:  # the first are the good files themselves
                name = rng.choice(names)
                files[name] = spoilt(name, files[name], rng)
            for name, data in files.items():
                if data is not None:
                    (folder / name).parent.mkdir(parents=True, exist_ok=True)
                    (folder / name).write_bytes(data)
            began_s = time.process_time()
            finding, status = finding_of(
                reader, [w.replace("{}", path) for w in reader.words], folder
            )
            outcome.longest_s = max(outcome.longest_s, time.process_time() - began_s)
            outcome.statuses[status] += 1
            if finding is not None:
                finding = finding.replace(path, "")
                outcome.findings[finding] += 1
                if kept is not None and outcome.findings[finding] == 1:
                    _keep(kept / re.sub(r"\W+", "-", reader.name), files, finding, number)
            if not number and status not in {0, 1}:
                outcome.findings[f"the good files: exit status {status}"] += 1
    return outcome


def _keep(folder, files, finding, number):
    place = folder / str(number)
    place.mkdir(parents=True, exist_ok=True)
    (place / "finding.txt").write_text(finding)
    for name, data in files.items():
        if data is not None:
            (place / name).parent.mkdir(parents=True, exist_ok=True)
            (place / name).write_bytes(data)


HEAD = "| reader | inputs | exit status 0 | 1 | 2 | findings | longest, s of processor time |"


def every_reader(n_inputs, seed, kept, only=""):
    """Try all readers, print a row for each, and return the number of findings."""
    print(HEAD, "| --- " * 7 + "|", sep="\n", flush=True)
    total = 0
    for reader in READERS:
        if only not in reader.name:
            continue
        found = tried(reader, n_inputs, seed, kept)
        counts = [found.statuses[k] for k in (0, 1, 2)]
        n_findings = sum(found.findings.values())
        total += n_findings
        row = (reader.name, n_inputs, *counts, n_findings, f"{found.longest_s:.1f}")
        print("|", " | ".join(map(str, row)), "|", flush=True)
        for text, n in found.findings.most_common():
            print(f"    {n} x {text}", file=sys.stderr, flush=True)
    return total

"""Write matrices and whole bundles into cacao's streams, and restore what was there before.

cacao copies its modes when the process that multiplies them starts, and does not read the streams
again. A matrix is therefore in use once that process has been replaced after the streams were
written. The process is recorded in a folder and survives this program. What acts at once, the gains
of the modes and the reference of the slopes, is written afterwards, and the previous values are
kept under the name of the previous matrix. A program that ends in between writes the rest when it
runs again.
"""

from __future__ import annotations

import io
import json
import time
from pathlib import Path
from typing import Any, Final

import msgpack
import numpy as np
import structlog
from numpy.typing import NDArray

from cacao_bridge.settings import Settings, load_index, load_modes
from cacao_bridge.streams import Stream, StreamError, create, path_of
from pyrcal.rtc.identity import Identity, Reconstructor
from service.errors import ConfigurationError
from service.files.bundle import RECONSTRUCTOR, Bundle, Place, read_bundle, why_not
from service.files.durable import replace_file
from service.wire import Manifest, checksum, decode, encode, validate_id

Array32 = NDArray[np.float32]

GAINS, REFERENCE = "gain_factor", "reference_slopes"
"""Names in a bundle."""


class Parts:
    """Gains and reference of matrices, in a folder and in cacao's streams."""

    def __init__(self, settings: Settings, index: NDArray[np.int64]) -> None:
        self._names, self._loop, self._index = settings.streams, settings.loop, index
        self._folder = Path(settings.calibration.folder)

    @property
    def takes(self) -> frozenset[str]:
        """Return the parts of a bundle that this loop can use."""
        can = {GAINS: self._names.gains and self._loop.gain > 0.0, REFERENCE: self._names.reference}
        return frozenset(name for name, has in can.items() if has)

    def keep_of(self, name: str, bundle: Bundle) -> None:
        """Keep the parts of a bundle other than its matrix, in the layout of cacao's streams.

        Raises
        ------
        StreamError
            If a stream that it needs is not there, or has another size.
        OSError
            If the disk refuses.
        """
        kept: dict[str, Array32] = {}
        if GAINS in self.takes and GAINS in bundle.arrays:
            gains = self._stream(self._names.gains).latest().copy()
            factors = bundle.arrays[GAINS]
            if gains.size < len(factors):
                found = f"{self._names.gains}: found {gains.size} gains"
                raise StreamError(f"{found}, expected {len(factors)}")
            gains.reshape(-1)[: len(factors)] = self._loop.gain * factors
            kept[self._names.gains] = gains
        if REFERENCE in bundle.arrays:
            reference = self._stream(self._names.reference).latest().copy()
            if reference.size <= self._index.max():
                found = f"{self._names.reference}: found {reference.size} values"
                raise StreamError(f"{found}, expected at least {self._index.max() + 1}")
            values = bundle.arrays[REFERENCE] / self._loop.slope_per_value
            reference.reshape(-1)[self._index] = values
            kept[self._names.reference] = reference
        self._keep(name, kept)

    def keep_now(self, name: str) -> None:
        """Keep what the streams have now as what belongs to a matrix."""
        streams = [one for one in (self._names.gains, self._names.reference) if one]
        self._keep(name, {one: self._stream(one).latest() for one in streams})

    def set(self, name: str) -> None:
        """Set what is kept with a matrix; what is so already is not written again.

        Raises
        ------
        StreamError
            If a stream is not there, or has another size by now.
        """
        path = self._path(name)
        if not path.exists():
            return
        with np.load(path, allow_pickle=False) as kept:
            parts = {one: kept[one] for one in kept.files}
        for one, values in parts.items():
            stream = self._stream(one)
            # All sizes are checked before the first is written: half of a calibration is another
            # loop.
            if stream.n_values != values.size:
                raise StreamError(
                    f"{one}: found {stream.n_values} values, expected {values.size} of {name}"
                )
        for one, values in parts.items():
            stream = self._stream(one, writable=True)
            if not np.array_equal(stream.latest().ravel(), values.ravel()):
                stream.write(values)

    def _keep(self, name: str, parts: dict[str, Array32]) -> None:
        buffer = io.BytesIO()
        np.savez(buffer, **parts)  # type: ignore[arg-type]
        replace_file(self._path(name), buffer.getvalue())

    def _path(self, name: str) -> Path:
        return self._folder / f"{name}.parts.npz"

    def _stream(self, name: str, *, writable: bool = False) -> Stream:
        return Stream(path_of(name, self._names.directory), writable=writable)


_log = structlog.get_logger("cacao")

_STATE: Final = "state.json"
_CONSENT: Final = "apply"
_ORDER: Final = "order"
"""File that names the matrix to be written on an operator's order, with all its parts."""

_KEYWORD: Final = "PYRCAL"


class Calibration:
    """The matrix in use, the one that waits, and the streams that cacao reads at its start."""

    def __init__(self, settings: Settings, identity: Identity) -> None:
        """Raise ``ConfigurationError`` if a file of the settings is not what it should be."""
        self._settings, self._identity = settings, identity
        self._unit = np.float32(settings.loop.metre_per_unit / settings.loop.slope_per_value)
        """Metres per slope for a command of 1 per value."""
        self.index, self.dm_modes = load_index(settings), load_modes(settings)
        self._folder = Path(settings.calibration.folder)
        self._parts = Parts(settings, self.index)
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
            self._known: dict[str, Any] = json.loads((self._folder / _STATE).read_text("utf-8"))
        except FileNotFoundError:
            self._known = {"in_use": None, "waiting": None, "written": False, "process": None}
        except (OSError, ValueError) as error:
            raise ConfigurationError(f"calibration.folder: {self._folder}: {error}") from error
        self.in_use: Reconstructor | None = None

    @property
    def waiting(self) -> str | None:
        """The matrix that has come and is not in use."""
        found: str | None = self._known["waiting"]
        return found

    def stage(self, matrix: Reconstructor) -> None:
        """Keep a matrix that fits; it takes the place of one that waits."""
        name = matrix.manifest.id
        if self.waiting not in {None, name}:
            _log.warning("matrix.superseded", id=self.waiting, by=name)
        keep(self._folder, matrix)
        self._know(waiting=name, written=False, ordered=None)
        if self._settings.calibration.interlock == "operator":
            _log.warning("matrix.waits", id=name, text=f"pyrcal cacao --config FILE --apply {name}")

    def look(self, process: int, shape: tuple[int, ...]) -> str | None:
        """Write what may be written; return the id of a matrix just taken up, or None.

        Parameters
        ----------
        process
            The one that multiplies now.
        shape
            Of a frame of slopes.

        Raises
        ------
        StreamError
            If the streams of cacao's modes cannot be read or written.
        """
        self._obey()
        # cacao copies the matrix when this process starts: another process means another copy.
        restarted = process != self._known["process"]
        if restarted or self.in_use is None:
            before = self._known["in_use"]
            self.in_use = self._found(restarted=restarted)
            name = self.in_use.manifest.id
            self._take_up(name, before, process)
            if name != before:
                self._set_parts()
                return name
        self._set_parts()
        if self.waiting is not None and not self._known["written"] and self._may():
            self._write(self._kept(self.waiting), shape)
            self._know(written=True)
            _log.warning("matrix.written", id=self.waiting, text="restart cacao's loop to use it")
        return None

    def _take_up(self, name: str, before: str | None, process: int) -> None:
        """Know that a matrix is in use; what the one before ran with is kept first."""
        news: dict[str, Any] = {"waiting": None} if name == self.waiting else {}
        if name != before and before is not None:
            _log.warning("matrix.taken-up", id=name, before=before, process=process)
            ordered = self._known.get("ordered") == name
            if ordered:
                self._parts.keep_now(before)
            news |= {"before": before, "owed": name if ordered else None, "ordered": None}
        self._know(process=process, in_use=name, **news)

    def _set_parts(self) -> None:
        """Set what belongs to the matrix in use, if that is still to be done."""
        owed = self._known.get("owed")
        if owed is not None:
            self._parts.set(owed)
            self._know(owed=None)
            _log.warning("parts.set", id=owed)

    def _obey(self) -> None:
        """Prepare the matrix that an operator has approved."""
        path = self._folder / _ORDER
        if not path.exists():
            return
        name = path.read_text("utf-8").strip()
        if name == self._known["in_use"]:
            _log.warning("matrix.in-use-already", id=name)
        else:
            # Read only for its error: an unreadable matrix must not replace the one that waits.
            self._kept(name)
            self._know(waiting=name, written=False, ordered=name)
        # Removed last: the order remains if the matrix cannot be read or the bridge stops here.
        path.unlink()

    def _may(self) -> bool:
        if self._settings.calibration.interlock == "restart":
            return True
        if self._known.get("ordered") == self.waiting:
            return True
        consent = self._folder / _CONSENT
        if not consent.exists():
            return False
        name = consent.read_text("utf-8").strip()
        # Used once, also if it names another matrix: it must not hold for a later one.
        consent.unlink()
        if name != self.waiting:
            _log.error("matrix.not-that-one", found=name, expected=self.waiting)
        return name == self.waiting

    def _found(self, *, restarted: bool) -> Reconstructor:
        """Return the matrix that the multiplying process has copied."""
        recorded = self._known["in_use"]
        if recorded is not None and not restarted:
            return self._kept(recorded)
        stream = Stream(self._path(self._settings.streams.modes_wfs))
        cube = stream.latest().reshape(stream.shape[0], -1)
        if self.index.max() >= cube.shape[1]:
            found = f"{self._settings.streams.modes_wfs}: {cube.shape[1]} values a slice"
            raise StreamError(f"{found}, expected at least {self.index.max() + 1}")
        # The numbers decide: the process may have started before or after the streams were written.
        for name in (self.waiting, recorded):
            if name is not None:
                kept = self._kept(name)
                if np.array_equal(self._slices(kept, cube.shape[1]), cube):
                    return kept
        return self._foreign(cube)

    def _foreign(self, cube: Array32) -> Reconstructor:
        """Return numbers that another program has written, under an id of their own."""
        matrix = np.ascontiguousarray(cube[:, self.index] * self._unit)
        # The checksum makes the same numbers have the same id after each restart of the bridge.
        name = f"own-{checksum(matrix)[:12]}"
        own = Reconstructor.own(name, matrix, self._identity, created_ns=0)
        keep(self._folder, own)
        return own

    def _slices(self, of: Reconstructor, n_values: int) -> Array32:
        """Return a matrix in cacao's layout: one slice a mode, 0 where there is no slope."""
        cube = np.zeros((len(of.matrix), n_values), dtype=np.float32)
        cube[:, self.index] = of.matrix / self._unit
        return cube

    def _write(self, of: Reconstructor, shape: tuple[int, ...]) -> None:
        name, streams = of.manifest.id, self._settings.streams
        cube = self._slices(of, int(np.prod(shape)))
        keywords = {_KEYWORD: (checksum(of.matrix)[:15], name)}
        modes = self.dm_modes[: len(of.matrix)]
        # The mirror's modes as well: their number must be that of the matrix.
        create(self._path(streams.modes_dm), modes, keywords)
        create(self._path(streams.modes_wfs), cube.reshape(-1, *shape), keywords)

    def _path(self, name: str) -> Path:
        return path_of(name, self._settings.streams.directory)

    def _kept(self, name: str) -> Reconstructor:
        try:
            manifest = json.loads((self._folder / f"{name}.json").read_text("utf-8"))
            matrix = np.load(self._folder / f"{name}.npy", allow_pickle=False)
        except (OSError, ValueError) as error:
            raise StreamError(f"{self._folder}: matrix {name} cannot be read: {error}") from error
        return Reconstructor(manifest=decode(Manifest, msgpack.packb(manifest)), matrix=matrix)

    def _know(self, **what: Any) -> None:  # noqa: ANN401  as JSON has them
        self._known |= what
        replace_file(self._folder / _STATE, json.dumps(self._known).encode())


def keep(folder: Path, matrix: Reconstructor) -> None:
    """Write the numbers, with their sources."""
    # Numbers before sources: a matrix whose manifest exists is complete.
    numbers, name = io.BytesIO(), matrix.manifest.id
    np.save(numbers, matrix.matrix, allow_pickle=False)
    replace_file(folder / f"{name}.npy", numbers.getvalue())
    told = json.dumps(msgpack.unpackb(encode(matrix.manifest)), indent=1)
    replace_file(folder / f"{name}.json", told.encode())


def order(folder: Path, name: str) -> None:
    """Have the bridge, now or when it runs, bring a matrix of the folder into cacao's streams."""
    replace_file(folder / _ORDER, name.encode())


def known(folder: Path) -> dict[str, Any]:
    """Return what the bridge knows of its matrices.

    Raises
    ------
    ConfigurationError
        If it has not run on this folder.
    """
    try:
        found: dict[str, Any] = json.loads((folder / _STATE).read_text("utf-8"))
    except (OSError, ValueError) as error:
        raise ConfigurationError(f"calibration.folder: {folder}: {error}") from error
    return found


def consent(settings: Settings, name: str) -> str:
    """Let the waiting matrix be written into cacao's streams; return its id.

    Raises
    ------
    ConfigurationError
        If none waits, or another.
    """
    folder = Path(settings.calibration.folder)
    waiting = known(folder).get("waiting")
    if waiting is None or name not in {"waiting", waiting}:
        raise ConfigurationError(f"--apply: found {name}, expected {waiting or 'none: none waits'}")
    (folder / _CONSENT).write_text(waiting, "utf-8")
    return str(waiting)


def apply(settings: Settings, path: Path) -> str:
    """Have the bridge bring a bundle into cacao, all of it or nothing; return its id.

    Raises
    ------
    MatrixError
        If it is no bundle, or not as it was written.
    ConfigurationError
        If it does not fit this loop; nothing is changed then.
    StreamError
        If a stream that it needs is not there, or has another size.
    """
    bundle = read_bundle(path)
    name = validate_id(bundle.id, f"the bundle {path}")
    index, modes, wire = load_index(settings), load_modes(settings), settings.wire
    parts = Parts(settings, index)
    place = Place(
        system=wire.system,
        config_id=wire.config_id,
        n_slopes=len(index),
        modes=modes.reshape(len(modes), -1),
        takes=parts.takes,
    )
    why = why_not(bundle, place)
    if why:
        hint = " ([streams] gains and [loop] gain, [streams] reference)" * ("no place" in why)
        raise ConfigurationError(f"{path}: {why}{hint}; nothing was changed")
    folder = Path(settings.calibration.folder)
    if name == known(folder)["in_use"]:
        raise ConfigurationError(f"{path}: {name} is in use already; nothing was changed")
    matrix = bundle.arrays[RECONSTRUCTOR].astype(np.float32)
    kept = folder / f"{name}.npy"
    if kept.exists() and not np.array_equal(np.load(kept, allow_pickle=False), matrix):
        raise ConfigurationError(
            f"{path}: {folder} has other numbers under {name}: ids are never reused; nothing was "
            "changed"
        )
    # Parts before the matrix: the order comes last, so that a program that ends in between has
    # changed nothing.
    parts.keep_of(name, bundle)
    if not kept.with_suffix(".json").exists():  # the service's own sources say more
        identity = Identity(system=wire.system, basis_id=wire.basis_id, config_id=wire.config_id)
        keep(folder, Reconstructor.own(name, matrix, identity, created_ns=time.time_ns()))
    order(folder, name)
    return name


def roll_back(settings: Settings) -> str:
    """Have the bridge bring back what was in use before, all of it; return its id.

    Raises
    ------
    ConfigurationError
        If nothing was.
    """
    folder = Path(settings.calibration.folder)
    before = known(folder).get("before")
    if before is None:
        raise ConfigurationError(f"{folder}: found no matrix before the one in use")
    order(folder, before)
    return str(before)

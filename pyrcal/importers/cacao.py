"""Import a loop of cacao: an example folder, or the ``conf`` folder of a running loop.

Files are recognised by their names, in any letter case, as ``.fits``, ``.fits.gz`` or ``.fits.fz``,
with any prefix (``aol1_``, ``dmloop.``). A response of single actuators is preferred to one of
modes. cacao's files have no units: strokes are unknown, and only shapes are compared.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import islice
from pathlib import Path

import numpy as np

from pyrcal.fitting.recorded import file_sha256
from pyrcal.importers.files import Reported, from_arrays
from pyrcal.importers.imported import Array, Imported
from pyrcal.importers.layouts import check_binary, plane_of
from service.errors import MatrixError
from service.files.container import opened

_SUFFIX = re.compile(r"\.(?:fits|fit)(?:\.gz|\.fz)?$", re.IGNORECASE)

_VARIABLES = re.compile(r"^\s*export\s+CACAO_(\w+)=[\"']?([^\"'#\n]*)", re.MULTILINE)

MAX_DEPTH = 6
"""Largest depth of nested folders that are searched."""

MAX_FILES = 10_000


@dataclass(frozen=True, slots=True, kw_only=True)
class _Kind:
    """A response file of cacao, and the meaning of its columns."""

    response: str
    """Pattern of the end of the file's name, lower case."""

    modes: str | None
    """Pattern of the name of the modes' file; None if each column is one actuator."""

    words: str


RESPONSES = (
    _Kind(response=r"zrespm-h|rmzrec_modeswfs", modes=None, words="actuators, from Hadamard pokes"),
    _Kind(response=r"respm|zrespm", modes=None, words="actuators"),
    _Kind(
        response=r"rmmodeswfs|rmmeas_modeswfs|rmwfs",
        modes=r"rmmodesdm|rmmeas_modesdm|rmdm",
        words="poked modes",
    ),
    _Kind(response=r"cmmodeswfs|modeswfs", modes=r"cmmodesdm|modesdm|dmmodes", words="modes"),
    _Kind(response=r"lorm", modes=r"lormmodes", words="low-order modes"),
)
"""Kinds of responses in order of preference."""

PICTURES = {
    "valid": (r"wfsmask", "mask of valid subapertures or lit pixels"),
    "actuators": (r"dmmask|dmmaskctrl", "mask of actuators"),
    "light": (r"wfsref", "mean frame"),
}
"""Patterns and purposes of other files that are used, by role."""

NOT_USED = {
    r"dmmask-?extr": "its actuators are extrapolated, not controlled",
    r"wfsdark|wfsdarkraw": "wfsref and the response are without it already",
    r"rmsyn_.*|.*_sfe?|.*_sfme": "derived from a model or from the files taken",
}

POSITIONS = re.compile(r"act2dpos\.txt$", re.IGNORECASE)
INFLUENCE = r"influ_sim|influ"


@dataclass(slots=True, kw_only=True)
class _Folder:
    """Contents of a folder, and the files used so far."""

    root: Path
    files: dict[Path, str]
    """FITS files by path, each with its name in lower case without suffixes."""

    texts: list[Path]
    variables: dict[str, str]
    taken: list[str] = field(default_factory=list)
    used: set[Path] = field(default_factory=set)
    copies: dict[Path, Path] = field(default_factory=dict)
    """Files with the same bytes as another file, and that other file."""

    def find(self, pattern: str) -> list[Path]:
        """Return files whose name is the pattern, or ends with it after a separator."""
        whole = re.compile(rf"(?:.*[._-])?(?:{pattern})")
        found = [path for path, name in self.files.items() if whole.fullmatch(name)]
        exact = [path for path in found if re.fullmatch(pattern, self.files[path])]
        # An exact name has priority over one that only ends with the pattern.
        return exact or found

    def one(self, pattern: str, purpose: str) -> Path | None:
        """Return the one file of a pattern; None if there is none.

        Raises
        ------
        MatrixError
            If there are several that differ.
        """
        found: list[Path] = []
        for name in pattern.split("|"):
            found = self._distinct(self.find(name))
            if found:
                break
        if len(found) > 1:
            names = ", ".join(self.name(path) for path in sorted(found))
            raise MatrixError(
                f"{self.root}: found {len(found)} files for {purpose}: {names}; expected one: give "
                "a folder that holds one, or --response NAME"
            )
        return found[0] if found else None

    def _distinct(self, paths: Sequence[Path]) -> list[Path]:
        """Return the files without links to and copies of the others: ``conf`` has many."""
        # Links first: they need no checksum, for which whole files are read.
        real = {path.resolve(): path for path in paths}
        if len(real) < 2:
            return list(real.values())
        copies: dict[str, Path] = {}
        for path in real:
            first = copies.setdefault(file_sha256(path), path)
            if first != path:
                self.copies[path] = first
        return [real[path] for path in copies.values()]

    def read(self, path: Path, purpose: str) -> Array:
        """Return the only array of a FITS file, and record its purpose."""
        with opened(path) as container:
            if len(container.arrays) != 1:
                raise MatrixError(f"{path}: found {container.listing()}, expected one array")
            (stored,) = container.arrays.values()
            values = stored.numbers()
        self.used.add(path.resolve())
        self.taken.append(f"took {self.name(path)} {values.shape}: {purpose}")
        self.taken += filter(None, [stored.remark])
        return values

    def name(self, path: Path) -> str:
        """Return a path below the folder."""
        return str(path.relative_to(self.root))

    def ignored(self) -> list[str]:
        """Return a note for each file that was not used."""
        notes = []
        for path, name in sorted(self.files.items()):
            # A copy of a file that was used holds nothing that is missing: it needs no note.
            real = self.copies.get(path.resolve(), path.resolve())
            if real in self.used:
                continue
            reasons = (why for what, why in NOT_USED.items() if re.fullmatch(what, name))
            notes.append(f"ignored {self.name(path)}: {next(reasons, 'not needed')}")
        return notes


def from_cacao(folder: str | Path, reported: Reported, response: str | None = None) -> Imported:
    """Return the mirror and the response of a folder of cacao's.

    Parameters
    ----------
    folder
        An example folder, or the ``conf`` folder of a loop.
    reported
        What the files do not say.
    response
        Name of the response to use, without its suffix; None for the first of `RESPONSES`.

    Raises
    ------
    MatrixError
        If a file is missing or there are several, or shapes do not belong together.
    """
    found = _survey(Path(folder))
    matrix, kind = _response(found, response)
    arrays: dict[str, Array] = {"matrix": matrix}
    for role in ("valid", "light"):
        picture = _picture(found, role)
        if picture is not None:
            arrays[role] = picture
    notes: list[str] = []
    modes = None if kind.modes is None else _modes(found, kind.modes, kind.words)
    arrays |= _mirror(found, matrix, modes, reported.diameter_m, notes)
    sensor = reported.sensor or _sensor(found.variables, notes)
    if "light" in arrays and arrays["light"].shape != matrix.shape[1:]:
        notes.append(f"wfsref has shape {arrays['light'].shape}, the response another: ignored")
        del arrays["light"]
    elif found.variables.get("WFSSTREAM_PROCESSED") == "ON":
        # These are reference slopes, not an image of the light.
        arrays.pop("light", None)
    # Pokes outside the mask are left out; messages and matrix.h5 count as the files do.
    numbers = arrays.pop("numbers", None)
    reported = replace(reported, sensor=sensor)
    imported = from_arrays(f"cacao, {folder}", arrays, reported, numbers)
    return replace(imported, inventory=(*found.taken, *found.ignored())).with_notes(*notes)


def _picture(found: _Folder, role: str) -> Array | None:
    """Return an image ``(ny, nx)`` of the folder; None if there is none."""
    pattern, purpose = PICTURES[role]
    path = found.one(pattern, f"the {purpose}")
    if path is None:
        return None
    values = plane_of(found.read(path, purpose))
    if role != "light":
        check_binary(values, str(path))
    return values


def _survey(folder: Path) -> _Folder:
    if not folder.is_dir():
        raise MatrixError(f"{folder}: found no folder, expected one of cacao's")
    files: dict[Path, str] = {}
    texts: list[Path] = []
    # Not all are listed: a wrong folder, such as a home, would be searched for minutes.
    paths = list(islice(folder.rglob("*"), MAX_FILES + 1))
    if len(paths) > MAX_FILES:
        raise MatrixError(f"{folder}: found more than {MAX_FILES} files, expected a conf folder")
    # Sorted, so that the same files are taken on every machine.
    for path in sorted(paths):
        if len(path.relative_to(folder).parts) > MAX_DEPTH or not path.is_file():
            continue
        if _SUFFIX.search(path.name):
            files[path] = _SUFFIX.sub("", path.name).lower()
        elif path.suffix in {".txt", ".bash"}:
            texts.append(path)
    variables: dict[str, str] = {}
    found = _Folder(root=folder, files=files, texts=texts, variables=variables)
    script = next((path for path in texts if path.name.lower().startswith("cacaovars")), None)
    if script is not None:
        # Limited, because any file of this name is read.
        text = script.read_text(encoding="utf-8", errors="replace")[:1_000_000]
        variables.update((key, value.strip()) for key, value in _VARIABLES.findall(text))
        found.taken.append(
            f"took {found.name(script)}: loop {variables.get('LOOPNAME', '(no name)')}, mirror "
            f"{variables.get('DMxsize', '?')} x {variables.get('DMysize', '?')}, sensor stream "
            f"{variables.get('WFSSTREAM', '?')}"
        )
    return found


def _response(found: _Folder, requested: str | None) -> tuple[Array, _Kind]:
    """Return the response ``(n, ny, nx)`` and the meaning of its columns."""
    if requested is not None:
        name = _SUFFIX.sub("", requested).lower()
        kinds = [
            kind for kind in RESPONSES if re.fullmatch(rf"(?:.*[._-])?(?:{kind.response})", name)
        ]
        # The name says what the columns are, so one of no known kind cannot be used.
        path = found.one(re.escape(name), "the response")
        if path is None or not kinds:
            names = ", ".join(sorted(set(found.files.values()))) or "no FITS file"
            raise MatrixError(f"{found.root}: found {names}, expected the response {requested}")
        return _cube(found, path, kinds[0]), kinds[0]
    for kind in RESPONSES:
        path = found.one(kind.response, f"the response of {kind.words}")
        # A response of modes is of no use without the modes that were poked.
        if path is None or (kind.modes is not None and not found.find(kind.modes)):
            continue
        return _cube(found, path, kind), kind
    names = ", ".join(found.name(path) for path in sorted(found.files)[:12]) or "no FITS file"
    raise MatrixError(
        f"{found.root}: found {names}; expected a response: respM, zrespM-H, or RMmodesWFS, "
        "CMmodesWFS, loRM with their modes RMmodesDM, CMmodesDM, loRMmodes"
    )


def _cube(found: _Folder, path: Path, kind: _Kind) -> Array:
    values = found.read(path, f"response of {kind.words}")
    if values.ndim != 3:
        raise MatrixError(
            f"{path}: found shape {values.shape}, expected (n, ny, nx): the response of a list of "
            "signals, without an image of the sensor, cannot be imported"
        )
    return values


def _modes(found: _Folder, pattern: str, words: str) -> Array:
    path = found.one(pattern, f"the {words}")
    if path is None:
        raise MatrixError(f"{found.root}: found no {pattern}, expected the modes poked")
    return found.read(path, f"{words} on the mirror")


def _mirror(
    found: _Folder, matrix: Array, modes: Array | None, diameter_m: float, notes: list[str]
) -> dict[str, Array]:
    """Return positions ``(n_actuators, 2)`` and, of modes, ``mode_to_actuator``; the mask's."""
    picture = _picture(found, "actuators")
    mask = None if picture is None else picture > 0
    shape = _grid(found, matrix, modes, mask)
    if shape is not None:
        return _on_grid(found, shape, matrix, modes, mask, diameter_m, notes)
    n_actuators = len(matrix) if modes is None else int(np.prod(modes.shape[1:]))
    strokes = {} if modes is None else {"mode_to_actuator": modes.reshape(len(modes), -1).T}
    listed = _positions(found, n_actuators)
    if listed is not None:
        notes.append(
            f"the positions of the actuators are in units of the pupil's radius, {diameter_m / 2:g}"
            " m: the fitted magnification gives the true unit"
        )
        return {"positions": listed * diameter_m / 2.0, **strokes}
    path = found.one(INFLUENCE, "influence functions")
    if path is not None:
        functions = found.read(path, "influence functions")
        if len(functions) == n_actuators:
            return {"modes": functions, **strokes}
    raise MatrixError(
        f"{found.root}: found a list of {n_actuators} actuators without positions; expected "
        f"act2Dpos.txt (number, x, y of each), influ_sim.fits, or a mirror on a grid: a dmmask of "
        "its shape, or CACAO_DMxsize and CACAO_DMysize with CACAO_DMSPATIAL=1 in cacaovars.bash"
    )


def _grid(
    found: _Folder, matrix: Array, modes: Array | None, mask: Array | None
) -> tuple[int, int] | None:
    """Return rows and columns of the mirror's grid; None if its actuators are a list."""
    if modes is not None:
        if modes.ndim != 3:
            raise MatrixError(f"{found.root}: found modes {modes.shape}, expected (n, ny, nx)")
        rows, columns = modes.shape[1:]
        if mask is not None and mask.shape != (rows, columns):
            raise MatrixError(
                f"{found.root}: found modes {modes.shape} and a mask of actuators {mask.shape}, "
                "expected (n_modes, ny, nx) and (ny, nx)"
            )
        return None if min(rows, columns) == 1 else (rows, columns)
    # A response of single actuators has no picture of the mirror: its mask, or its stated size, is
    # taken where it has as many points as there are pokes.
    shapes = [] if mask is None else [mask.shape]
    if found.variables.get("DMSPATIAL") == "1":
        shapes.append(
            tuple(int(_number(found.variables, key) or 0) for key in ("DMysize", "DMxsize"))
        )
    for rows, columns in shapes:
        if rows * columns == len(matrix) and min(rows, columns) > 1:
            return rows, columns
    return None


def _on_grid(
    found: _Folder,
    shape: tuple[int, int],
    matrix: Array,
    modes: Array | None,
    mask: Array | None,
    diameter_m: float,
    notes: list[str],
) -> dict[str, Array]:
    inside = np.ones(shape, dtype=bool) if mask is None else np.asarray(mask)
    row, column = np.nonzero(inside)
    # α is relative to the middle of the grid unless the file states the beam's own.
    # Without a stated radius the outermost actuators are at the edge of the pupil.
    radius = _number(found.variables, "DM_beam_rad") or (max(shape) - 1) / 2.0
    stated_centres = (_number(found.variables, f"DM_beam_{axis}cent") for axis in "xy")
    grid = ((n - 1) / 2.0 for n in reversed(shape))
    middle = [own if at is None else at for at, own in zip(stated_centres, grid, strict=True)]
    pitch_m = diameter_m / 2.0 / radius
    notes.append(
        f"the pitch of the actuators is unknown: {pitch_m:.4g} m, so that {2 * radius + 1:g} of "
        "them span diameter_m; the fitted magnification gives the true pitch"
    )
    arrays: dict[str, Array] = {"positions": (np.column_stack([column, row]) - middle) * pitch_m}
    if modes is not None:
        arrays["mode_to_actuator"] = modes[:, inside].T
        return arrays
    if not inside.all():
        notes.append(
            f"{int((~inside).sum())} of {inside.size} pokes are outside the mask of actuators: "
            "left out"
        )
        arrays["matrix"] = matrix[inside.ravel()]
        arrays["numbers"] = np.flatnonzero(inside)
    return arrays


def _positions(found: _Folder, n_actuators: int) -> Array | None:
    """Return x and y of each actuator as the text file lists them; None without a file."""
    path = next((path for path in found.texts if POSITIONS.search(path.name)), None)
    if path is None:
        return None
    try:
        table = np.loadtxt(path, ndmin=2)
    except ValueError as error:
        raise MatrixError(f"{path}: found {error}, expected number, x, y in a row") from error
    if table.shape != (n_actuators, 3) or not np.isfinite(table).all():
        raise MatrixError(
            f"{path}: found shape {table.shape}, expected number, x, y of {n_actuators} actuators"
        )
    # Sorted by number: the rows of the file need not be in the order of the columns.
    table = table[np.argsort(table[:, 0])]
    # Some files count actuators from 0, others from 1.
    if not np.array_equal(table[:, 0], np.arange(n_actuators) + table[0, 0]):
        raise MatrixError(f"{path}: expected each actuator's number once, in column 1")
    found.taken.append(f"took {found.name(path)}: positions of {n_actuators} actuators")
    return np.asarray(table[:, 1:])


_MAX_NUMBER = 1e5
"""Actuators across a mirror; a larger number is a slip."""


def _number(variables: Mapping[str, str], key: str) -> float | None:
    """Return a number above 0 of cacaovars; None if there is none, or it cannot be."""
    # A line may go on after its value.
    words = variables.get(key, "").split()[:1]
    try:
        number = float("".join(words))
    except ValueError:
        return None
    return number if 0.0 < number <= _MAX_NUMBER else None


def _sensor(variables: Mapping[str, str], notes: list[str]) -> str:
    """Return the kind of sensor that the name of its stream suggests."""
    stream = variables.get("WFSSTREAM", "")
    kind = "shack-hartmann" if re.search("sh_?wfs|shack", stream, re.IGNORECASE) else "pyramid"
    because = f"as its stream {stream} is named" if kind != "pyramid" else "give --sensor if not"
    notes.append(f"the sensor is taken as a {kind}, {because}")
    return kind

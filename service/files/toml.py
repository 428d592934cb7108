"""Read TOML against a pydantic schema, and the arrays it refers to.

Whatever is wrong with either is one line that says where, what was found and what was expected.
"""

from __future__ import annotations

import difflib
import json
import re
import tomllib
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import is_dataclass
from ipaddress import ip_network
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NoReturn, TypeVar, get_args, get_type_hints

from pydantic import AfterValidator, BaseModel, ConfigDict, StringConstraints, ValidationError
from pydantic_core import ErrorDetails

from service.errors import ConfigurationError, MatrixError

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from service.files.container import Container, StoredArray

_EXPECTED = "Input should be "

_HDF5 = re.compile(r"(?P<path>.+):/(?P<name>.+)")
_FITS = re.compile(
    r"(?P<path>.+?\.(?:fits|fit|fts)(?:\.(?:gz|fz))?)(?::/?(?P<name>.+))?", re.IGNORECASE
)
_NUMPY = re.compile(r"(?P<path>.+\.npy)(?P<name>)", re.IGNORECASE)
_FORMS = (_NUMPY, _FITS, _HDF5)


class Table(BaseModel):
    """One table of a file: frozen, no unknown keys, no guessing between types, finite numbers."""

    model_config = ConfigDict(
        extra="forbid",
        frozen=True,
        strict=True,
        allow_inf_nan=False,
        use_attribute_docstrings=True,
        defer_build=True,  # of what is asked for: to build them all takes longer than an answer
    )


Id = Annotated[str, StringConstraints(pattern=r"^[A-Za-z0-9._-]{1,64}$")]
"""An id as the wire allows it."""


def _known_network(text: str) -> str:
    try:
        ip_network(text)
    except ValueError as error:
        expected = "an address or a network, like 127.0.0.1 or 10.0.7.0/24"
        raise ValueError(f"found {text!r}, expected {expected}") from error
    return text


Network = Annotated[str, AfterValidator(_known_network)]
"""An IP address, or all of a network."""

Schema = TypeVar("Schema", bound=Table)
Place = Callable[[tuple[str, ...]], str]
"""Says where a value came from, given its key path."""


MAX_TOML_BYTES = 4_000_000

MAX_TOML_DEPTH = 32
"""Tables and arrays within each other."""

_DEEP_KEY = re.compile(rf"""(?<![\w"'-])(?:[\w"'-]++[ \t]*+\.[ \t]*+){{{MAX_TOML_DEPTH}}}""")
"""A dotted key that takes the parser a time that grows with the square of its length."""


def read_toml(path: Path) -> dict[str, Any]:
    """Return the tables of a TOML file.

    Raises
    ------
    ConfigurationError
        If the file cannot be read, is not TOML, too large or too deep.
    """
    where, at_most = str(path), f"at most {MAX_TOML_DEPTH} tables and arrays within each other"
    try:
        with path.open("rb") as file:
            # One byte more than allowed shows that the file is larger, without reading all of it.
            written = file.read(MAX_TOML_BYTES + 1)
        if len(written) > MAX_TOML_BYTES:
            refuse(where, "a larger file", f"at most {MAX_TOML_BYTES / 1e6:g} MB of TOML")
        text = written.decode()
        if _DEEP_KEY.search(text):
            refuse(where, "a longer dotted key", at_most)
        tables = tomllib.loads(text)
    except OSError as error:
        raise ConfigurationError(f"{path}: cannot be read: {error.strerror or error}") from error
    except UnicodeDecodeError as error:
        raise ConfigurationError(f"{path}: not UTF-8 text: {error}") from error
    except ValueError as error:  # of a number of 5000 digits it is not the parser's own
        raise ConfigurationError(f"{path}: not valid TOML: {error}") from error
    except RecursionError:
        refuse(where, "more", at_most)
    if _is_deep(tables):
        refuse(where, "more", at_most)
    return tables


def _is_deep(tables: dict[str, Any]) -> bool:
    level: list[Any] = [tables]
    for _ in range(MAX_TOML_DEPTH):
        values = (v for t in level for v in (t.values() if isinstance(t, dict) else t))
        level = [value for value in values if isinstance(value, (dict, list))]
    return bool(level)


def validated(schema: type[Schema], data: Mapping[str, Any], place: Place) -> Schema:
    """Return ``data`` as a ``schema``.

    Raises
    ------
    ConfigurationError
        One line: where, what was found, what was expected; the first problem of several.
    """
    try:
        # as JSON: arrays become tuples there, and texts names or paths, however strict
        return schema.model_validate_json(json.dumps(data, default=_in_json))
    except ValidationError as error:
        # a misspelt key is also a missing one: what was written says more
        problems = sorted(
            error.errors(include_url=False), key=lambda problem: problem["type"] == "missing"
        )
        refuse_all([_line(schema, problem, place) for problem in problems], error)


def refuse_all(lines: Sequence[str], cause: Exception) -> NoReturn:
    """Raise the error of the first line, which counts the others and has them all.

    Raises
    ------
    ConfigurationError
        Always.
    """
    more = f" (and {len(lines) - 1} more)" if len(lines) > 1 else ""
    raise ConfigurationError(lines[0] + more, tuple(lines)) from cause


def _in_json(value: object) -> object:
    """Return a path as its text; what else JSON lacks, TOML's dates, as no key takes it."""
    return str(value) if isinstance(value, Path) else [str(value)]


def in_file(path: Path) -> Place:
    """Return a place that names this file and the dotted key."""
    return lambda key: f"{path}: {'.'.join(key)}" if key else str(path)


def refuse(place: str, found: str, expected: str) -> NoReturn:
    """Raise the one-line error for a value that the schema alone cannot judge."""
    raise ConfigurationError(f"{place}: found {found}, expected {expected}")


def nearest(word: str, known: Iterable[str]) -> str:
    """Return ``, did you mean ...?`` for the nearest known word, or what is known."""
    known = sorted(known)
    close = difflib.get_close_matches(word, known, n=1)
    return f", did you mean {close[0]}?" if close else f"; known: {', '.join(known)}"


def reference_parts(text: str) -> re.Match[str] | None:
    """Return the ``path`` and ``name`` that a reference is made of; None: it is none."""
    return next((found for form in _FORMS if (found := form.fullmatch(text))), None)


def read_dataset(reference: str, folder: Path, where: str) -> NDArray[Any]:
    """Return the numeric array at ``reference``, in this machine's byte order.

    Parameters
    ----------
    reference
        ``path:/dataset``, ``path.fits:EXTNAME``, ``path.npy``; relative paths start at ``folder``.
    folder
        Folder of the instrument file.
    where
        File and key of the reference, for the messages.

    Raises
    ------
    ConfigurationError
        If the reference has another form, or the file or dataset is missing, damaged or not
        numeric.
    """
    # h5py takes long to import, and most TOML files refer to no array.
    from service.files.container import opened

    parts = reference_parts(reference)
    if parts is None:
        expected = "path:/dataset of an HDF5 file, path.fits:EXTNAME, or path.npy"
        refuse(where, repr(reference), expected)
    try:
        with opened(folder / parts["path"]) as container:
            stored = _find_array(container, parts["name"], where)
            if stored.dtype.kind not in "biuf":
                refuse(where, f"type {stored.dtype} in {stored.where}", "numbers")
            values = stored.read()
    except MatrixError as error:
        raise ConfigurationError(f"{where}: {error}") from error
    # FITS arrays are big-endian, which some libraries refuse.
    return values.astype(values.dtype.newbyteorder("="), copy=False)


def _find_array(container: Container, name: str | None, where: str) -> StoredArray:
    found = container.find(name) if name else next(iter(container.arrays.values()), None)
    if found is None:
        missing = f"no dataset /{name.strip('/')}" if name else "no image"
        refuse(where, f"{missing} in {container.path}", f"one; it holds {container.listing()}")
    return found


def _line(schema: type[Table], problem: ErrorDetails, place: Place) -> str:
    key = tuple(str(part) for part in problem["loc"])
    where = place(key)
    kind, message = problem["type"], problem["msg"]
    if kind in {"extra_forbidden", "unexpected_keyword_argument"}:
        return f"{where}: unknown key{nearest(key[-1], _known_keys(schema, key[:-1]))}"
    if kind == "missing":
        return f"{where}: missing, this key is mandatory"
    if kind == "value_error":
        return f"{where}: {message.removeprefix('Value error, ')}"
    if kind in {"model_type", "dataclass_type"}:
        return f"{where}: found {problem['input']!r}, expected a table [{'.'.join(key)}]"
    if kind == "string_pattern_mismatch":
        message = f"text that matches {problem['ctx']['pattern']}"
    elif kind == "tuple_type":
        message = "an array"
    return f"{where}: found {problem['input']!r}, expected {message.removeprefix(_EXPECTED)}"


def _known_keys(schema: type[Table], key: tuple[str, ...]) -> Iterable[str]:
    known = _types_of(schema)
    for part in (part for part in key if not part.isdigit()):
        alternatives = (known[part], *get_args(known[part]))
        known = next(found for found in map(_types_of, alternatives) if found)
    return known


def _types_of(table: Any) -> Mapping[str, Any]:  # noqa: ANN401  any type, or none
    """Return the type of each key of a table; none where it is no table."""
    if not (is_dataclass(table) or (isinstance(table, type) and issubclass(table, Table))):
        return {}
    return {name: kind for name, kind in get_type_hints(table).items() if name[0] != "_"}

"""Read HDF5, FITS, NumPy and MATLAB files alike.

Their arrays have names and can be looked at before they are read.
"""

from __future__ import annotations

import math
import warnings
import zlib
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from tokenize import TokenError
from typing import Any, NoReturn, Protocol

import h5py
import numpy as np
import scipy
from numpy.typing import NDArray

from service.errors import MatrixError, list_first
from service.files import FileKind, kind_of
from service.files.whole import open_hdf5
from service.model.misregistration import COVARIANCE_SCALE, PARAMETERS

MAX_BYTES = 4 << 30
"""Largest array that is read: a cube of 400 full frames of 512 x 512 is a tenth of it."""

ROOMY_BYTES = 64 << 20
"""An array that takes no more in memory is read, however few bytes the file has of it."""

MAX_SWELLING = 1000
"""Bytes in memory for each in the file, of larger ones: gzip does not compress noise any better."""

MAX_PARTS = 1000
"""Parts (HDUs) of a FITS file."""

_LISTED = 12
"""Arrays of a file that a message names."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class StoredArray:
    """One array of a file, not read yet."""

    where: str
    """File and array, for messages."""

    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    stored_bytes: int
    """Size in the file, compressed."""

    load: Callable[[], NDArray[Any]]
    """Returns it as the file has it, unchecked."""

    at_once: tuple[int, ...] = ()
    """Shape of what is unpacked at once, which may exceed ``shape``; empty: all of it."""

    remark: str = ""
    """Notes on the values for the user; empty if there are none."""

    unit: str = ""
    """Unit of the values as a FITS file has it; empty if there is none."""

    def numbers(self) -> NDArray[np.float64]:
        """Return it as native float64, whatever its byte order.

        Raises
        ------
        MatrixError
            If it holds no numbers, is too large, or the file is damaged there.
        """
        if self.dtype.kind not in "iuf":
            raise MatrixError(f"{self.where}: found type {self.dtype}, expected real numbers")
        return np.asarray(self.read(), dtype=np.float64)

    def read(self) -> NDArray[Any]:
        """Return it as the file has it, unless it could not be that large.

        Raises
        ------
        MatrixError
            If it is too large, claims more than the file can hold, or the file is damaged there.
        """
        # At least 8 bytes each: the numbers become float64.
        n_bytes = max(math.prod(self.shape), math.prod(self.at_once)) * max(self.dtype.itemsize, 8)
        most = min(MAX_BYTES, max(ROOMY_BYTES, MAX_SWELLING * self.stored_bytes))
        if n_bytes > most:
            raise MatrixError(
                f"{self.where}: found shape {self.shape}, {n_bytes / 1e9:.1f} GB in memory, of "
                f"{self.stored_bytes} bytes in the file; expected at most {most / 1e9:.2g} GB"
            )
        try:
            return self.load()
        except (OSError, RuntimeError, TypeError, ValueError, LookupError) as error:
            raise MatrixError(f"{self.where}: damaged: {error}") from error


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Container:
    """The arrays of a file, and what it says about itself."""

    path: Path
    arrays: Mapping[str, StoredArray]
    """Arrays by name: in HDF5 the path without its first slash; in FITS the EXTNAME or, if an image
    has none, its number."""

    find: Callable[[str], StoredArray | None]
    """Returns the array of a name, or None: in HDF5 links are followed, in FITS any case and the
    number of an image will do."""

    facts: Mapping[str, Any]
    """HDF5 attributes of the file, or keywords of the primary FITS header in lower case."""

    is_fits: bool = False
    """True if images may have no name."""

    columns: Callable[[], Mapping[str, StoredArray]] = dict
    """Returns the columns of the first FITS table by name in lower case."""

    def listing(self) -> str:
        """Return what is in the file, in words."""
        if not self.arrays:
            return "no array at all"
        return list_first((f"{name} {a.shape}" for name, a in self.arrays.items()), _LISTED)


class _ImageHdu(Protocol):
    """The used part of astropy's HDU, which has no type information."""

    shape: tuple[int, ...]
    size: int
    """Size of the data as the header has it, bytes."""

    header: Mapping[str, Any]
    data: NDArray[Any]


@contextmanager
def opened(path: Path) -> Iterator[Container]:
    """Open an HDF5, FITS, NumPy or MATLAB file, known by its content and not by its name.

    Raises
    ------
    MatrixError
        If there is no such file, it is none of them, or it is damaged.
    """
    readers = {
        FileKind.HDF5: _hdf5,
        FileKind.FITS: _fits,
        FileKind.NUMPY: _numpy,
        FileKind.MATLAB: _matlab,
    }
    with readers[kind_of(path)](path) as container:
        yield container


@contextmanager
def _hdf5(path: Path) -> Iterator[Container]:
    try:
        file = open_hdf5(path)
    except OSError as error:
        raise MatrixError(f"{path}: damaged HDF5 file: {error}") from error
    arrays: dict[str, StoredArray] = {}

    def find(name: str) -> StoredArray | None:
        where = f"{path}:/{name.strip('/')}"
        try:
            return _dataset(file.get(name.strip("/") or "/"), where)
        except (OSError, RuntimeError, ValueError) as error:
            raise MatrixError(f"{where}: a link that leads nowhere: {error}") from error

    with file:
        try:
            for name, item in datasets(file, path):
                array = _dataset(item, f"{path}:/{name}")
                if array is not None:
                    arrays[name] = array
            facts = attributes(file, path)
        except (OSError, RuntimeError, LookupError, TypeError, ValueError) as error:
            raise MatrixError(f"{path}: damaged HDF5 file: {error}") from error
        yield Container(path=path, arrays=arrays, find=find, facts=facts)


def _dataset(item: object, where: str) -> StoredArray | None:
    # A dataset without a shape is HDF5's empty one (a null dataspace).
    if not isinstance(item, h5py.Dataset) or item.shape is None:
        return None
    return StoredArray(
        where=where,
        shape=item.shape,
        dtype=item.dtype,
        stored_bytes=item.id.get_storage_size(),
        load=partial(item.__getitem__, ()),
        at_once=item.chunks or (),
    )


@contextmanager
def _fits(path: Path) -> Iterator[Container]:
    try:
        from astropy.io import fits  # takes long to import: who has HDF5 need not wait
    except ImportError as error:
        raise MatrixError(
            f"{path}: a FITS file needs astropy; expected it to be installed: pip install astropy"
        ) from error
    with path.open("rb") as raw, warnings.catch_warnings():
        # astropy warns of a truncated file and goes on; what else it warns of does no harm
        warnings.simplefilter("ignore")
        warnings.filterwarnings("error", message=".*truncated")
        try:
            file = fits.open(raw, memmap=False, lazy_load_hdus=True)
        except FITS_DAMAGE as error:
            raise MatrixError(f"{path}: damaged FITS file: {error}") from error
        arrays: dict[str, StoredArray] = {}
        known: dict[str, StoredArray] = {}
        try:
            for number, hdu in enumerate(file):
                _check_part(hdu, number, path)
                if hdu.is_image and getattr(hdu, "shape", ()):  # a damaged one has none
                    name = str(hdu.header.get("EXTNAME", number))
                    array = _image(hdu, f"{path}[{name}]", path.stat().st_size)
                    # EXTNAME need not be unique.
                    arrays[str(number) if name in arrays else name] = array
                    known.setdefault(name.lower(), array)
                    known[str(number)] = array
            facts = {str(key).lower(): value for key, value in file[0].header.items()}
        except (*FITS_DAMAGE, fits.VerifyError) as error:
            reason = str(error).replace("\n", " ")
            raise MatrixError(f"{path}: damaged FITS file: {reason}") from error
        yield Container(
            path=path,
            arrays=arrays,
            find=lambda name: known.get(name.strip("/").lower()),
            facts=facts,
            is_fits=True,
            columns=partial(_columns, file, path),
        )


def _check_part(hdu: _ImageHdu, number: int, path: Path) -> None:
    """Refuse a part after which astropy would go backwards and read the same part for ever."""
    if hdu.size < 0:
        raise MatrixError(f"{path}[{number}]: found data of {hdu.size} bytes, expected 0 or more")
    if number >= MAX_PARTS:
        raise MatrixError(f"{path}: found more than {MAX_PARTS} parts, expected no more")


def _image(hdu: _ImageHdu, where: str, file_bytes: int) -> StoredArray:
    return StoredArray(
        where=where,
        shape=hdu.shape,
        dtype=np.dtype(f"f{8 if abs(hdu.header['BITPIX']) > 32 else 4}"),
        stored_bytes=file_bytes,
        load=partial(_data, hdu),
        remark=f"{where}: {LOSSY}" if _is_lossy(hdu) else "",
        unit=str(hdu.header.get("BUNIT", "")),
    )


def _columns(file: Any, path: Path) -> dict[str, StoredArray]:  # noqa: ANN401  astropy's list
    # Only images have no columns; an image that is packed into a table is one of them.
    tables = [hdu for hdu in file if not hdu.is_image and hasattr(hdu, "columns")]
    if not tables:
        return {}
    try:
        values = tables[0].data
        return {
            one.name.lower(): StoredArray(
                where=f"{path}:{one.name}",
                shape=values[one.name].shape,
                dtype=values[one.name].dtype,
                stored_bytes=path.stat().st_size,
                load=partial(values.field, one.name),
                unit=one.unit or "",
            )
            for one in tables[0].columns
        }
    except FITS_DAMAGE as error:
        raise MatrixError(f"{path}: damaged FITS table: {error}") from error


LOSSY = (
    "compressed with loss: values are rounded to a fraction of their noise, or of the signal where "
    "there is none; fpack -g -q 0 loses nothing"
)


def _is_lossy(hdu: _ImageHdu) -> bool:
    """Return True if an image was rounded before it was compressed."""
    packed = getattr(hdu, "compressed_data", None)
    return packed is not None and "ZSCALE" in packed.names


def _data(hdu: _ImageHdu) -> NDArray[Any]:
    """Return an image; what cannot be unpacked raises ValueError."""
    try:
        return hdu.data
    except Exception as error:  # cfitsio's own exceptions have no common class
        raise ValueError(str(error).replace("\n", " ")) from error


FITS_DAMAGE = (OSError, EOFError, ValueError, TypeError, LookupError, Warning, zlib.error)
"""Exceptions that astropy raises for a damaged file, compressed or not."""

NUMPY_DAMAGE = (OSError, EOFError, ValueError, TypeError, OverflowError, SyntaxError, TokenError)
"""Exceptions that a damaged NumPy header raises: it is parsed by Python."""


@contextmanager
def _numpy(path: Path) -> Iterator[Container]:
    """Open the one array of a NumPy file; nothing that would have to be unpickled."""
    try:
        # Unpickling would execute code of the file's author.
        array = np.load(path, mmap_mode="r", allow_pickle=False)
    except NUMPY_DAMAGE as error:
        reason = str(error).replace("\n", " ")
        raise MatrixError(f"{path}: damaged NumPy file: {reason}") from error
    stored = StoredArray(
        where=str(path),
        shape=array.shape,
        dtype=array.dtype,
        stored_bytes=array.nbytes,
        load=lambda: array,
    )
    arrays = {DATASET: stored}
    yield Container(path=path, arrays=arrays, find=arrays.get, facts={})


@contextmanager
def _matlab(path: Path) -> Iterator[Container]:
    """Open a MATLAB file: of version 7.3, which is HDF5, or an older one."""
    if h5py.is_hdf5(path):
        with _hdf5(path) as found:
            yield _reverse_axes(found)
        return
    try:
        loaded = dict(_list_fields("", scipy.io.loadmat(path)))
    except Exception as error:  # scipy's reader raises whatever damaged numbers lead to
        raise MatrixError(f"{path}: damaged MATLAB file: {error}") from error
    arrays = {
        name: StoredArray(
            where=f"{path}:{name}",
            shape=values.T.shape,
            dtype=values.dtype,
            stored_bytes=values.nbytes,
            load=partial(np.transpose, values),
        )
        for name, values in loaded.items()
    }
    yield _reverse_axes(Container(path=path, arrays=arrays, find=arrays.get, facts={}))


def _list_fields(prefix: str, values: Mapping[str, Any]) -> Iterator[tuple[str, NDArray[Any]]]:
    """Yield variables, and fields of structs by names like ``tel.D``; words in structs alone."""
    for name, one in values.items():
        if not isinstance(one, np.ndarray):
            continue
        if one.dtype.names and one.size == 1:
            fields = {field: one[field].item() for field in one.dtype.names}
            yield from _list_fields(f"{prefix}{name}.", fields)
        elif one.dtype.kind in ("biufU" if prefix else "biuf"):
            yield prefix + name, one


def _reverse_axes(found: Container) -> Container:
    """Return the arrays of MATLAB, whose first axis is the last one in HDF5."""
    # Groups like "#refs#" hold what cells and objects refer to; the others are structs.
    arrays = {
        name.replace("/", "."): _reversed(one)
        for name, one in found.arrays.items()
        if name[0] != "#"
    }
    return replace(
        found, arrays=arrays, find=lambda name: arrays.get(name.strip("/").replace("/", "."))
    )


def _reversed(stored: StoredArray) -> StoredArray:
    shape = stored.shape[::-1]
    # MATLAB has no vectors: theirs are matrices of one row or column.
    if len(shape) == 2 and 1 in shape:
        shape = (max(shape),)
    return replace(stored, shape=shape, load=lambda: stored.load().T.reshape(shape))


# --- a measured interaction matrix, with what its file says of the measurement


Array = NDArray[np.float64]

DATASET = "interaction_matrix"
"""Array that is read unless another name is given; the archive writes it."""


# --- what pyrcal writes


def put_covariance(file: h5py.File, covariance: NDArray[np.float64]) -> None:
    """Write the covariance ``(4, 4)`` of a registration in boundary units."""
    description = "(4, 4) of the parameters, in the units of their names"
    put_array(file, "covariance", covariance * COVARIANCE_SCALE, description)
    file["covariance"].attrs["parameters"] = PARAMETERS


def put_array(file: h5py.File, name: str, values: NDArray[Any], description: str) -> None:
    """Write an array with a sentence that says what it holds."""
    file[name] = values
    file[name].attrs["description"] = description


MAX_DEPTH = 32
"""Groups within groups of an HDF5 file."""

MAX_OBJECTS = 10_000
"""Groups, datasets and links of an HDF5 file, and attributes of it."""


def datasets(file: h5py.File, path: Path) -> Iterator[tuple[str, h5py.Dataset]]:
    """Yield the datasets of an HDF5 file with their names; no link leads anywhere else.

    Raises
    ------
    MatrixError
        If its groups are too many, or too deep.
    """
    seen = {h5py.h5o.get_info(file.id).addr}
    open_groups = [("", file["/"])]
    while open_groups:
        prefix, group = open_groups.pop()
        check_number(len(seen) + len(group), path)
        if prefix.count("/") > MAX_DEPTH:
            _refuse(str(path), f"more than {MAX_DEPTH} groups within each other", "no more")
        within = []
        for name in group:
            # Soft and external links may lead out of the file, or in a circle.
            if not isinstance(group.get(name, getlink=True), h5py.HardLink):
                continue
            item = group[name]
            address = h5py.h5o.get_info(item.id).addr
            # Hard links may also form a circle of groups.
            if address in seen:
                continue
            seen.add(address)
            if isinstance(item, h5py.Dataset):
                yield f"{prefix}{name}", item
            elif isinstance(item, h5py.Group):
                within.append((f"{prefix}{name}/", item))
        # Reversed, because the stack is read from its end: groups come in the order of the file.
        open_groups += reversed(within)


def check_number(n_objects: int, path: Path) -> None:
    """Refuse an HDF5 file of too many things.

    Raises
    ------
    MatrixError
        If it has so many.
    """
    if n_objects > MAX_OBJECTS:
        _refuse(str(path), f"more than {MAX_OBJECTS} groups, datasets or links", "no more")


def attributes(file: h5py.File, path: Path) -> dict[str, Any]:
    """Return the attributes of an HDF5 file.

    Raises
    ------
    MatrixError
        If they are too many.
    """
    if len(file.attrs) > MAX_OBJECTS:
        _refuse(str(path), f"{len(file.attrs)} attributes", f"at most {MAX_OBJECTS}")
    return dict(file.attrs)


def _refuse(where: str, found: str, expected: str) -> NoReturn:
    raise MatrixError(f"{where}: found {found}, expected {expected}")

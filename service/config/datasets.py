"""Arrays that an instrument file refers to: ``file.h5:/dataset``, relative to the file itself."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from service.config.strict import refuse
from service.errors import ConfigurationError


def read_dataset(reference: str, folder: Path, where: str) -> NDArray[Any]:
    """Return the numeric array behind ``reference``.

    Parameters
    ----------
    reference
        ``path:/dataset``; a relative path starts at ``folder``.
    folder
        Where the instrument file lies.
    where
        The file and key that hold the reference, for the messages.

    Raises
    ------
    ConfigurationError
        If the reference has another form, or the file or dataset is missing, damaged or not
        numeric.
    """
    name, separator, dataset = reference.rpartition(":/")
    if not separator or not name or not dataset:
        refuse(where, repr(reference), "path:/dataset of an HDF5 file")
    path = folder / name
    if not path.is_file():
        raise ConfigurationError(f"{where}: {path}: no such file")
    try:
        with h5py.File(path, "r") as file:
            item = file.get(dataset)
            if not isinstance(item, h5py.Dataset):
                held = ", ".join(sorted(file)) or "nothing"
                refuse(where, f"no dataset /{dataset} in {path} (it holds {held})", "one")
            values = np.asarray(item[()])
    except OSError as error:
        raise ConfigurationError(f"{where}: {path}: not a readable HDF5 file: {error}") from error
    if values.dtype.kind not in "biuf":
        refuse(where, f"type {values.dtype} in {path}:/{dataset}", "numbers")
    return values

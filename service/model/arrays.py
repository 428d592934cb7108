"""Array library that computes the rows of D: NumPy, or another with the array API standard.

Torch and CuPy compute on a GPU if there is one. Only the work done row by row goes there; the rest
of the model is NumPy and SciPy.
"""

from __future__ import annotations

import importlib
import importlib.util
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from service.errors import ModelError
from service.model.kinds import ArrayLibrary

Foreign = Any
"""An array of the library that was chosen."""

_COMPAT = "array_api_compat"


@dataclass(frozen=True, slots=True)
class Arrays:
    """A library by the module that has its functions as the standard names them."""

    module: str = "numpy"

    @property
    def xp(self) -> Any:  # noqa: ANN401 - a module
        """Its functions."""
        return importlib.import_module(self.module)

    def there(self, array: NDArray[Any]) -> Foreign:
        """Return an array of NumPy as one of the library, on its device."""
        if self.module == "numpy":
            return array
        return self.xp.asarray(np.ascontiguousarray(array), device=_device(self.module))

    def here(self, array: Foreign) -> NDArray[Any]:
        """Return an array of the library as NumPy's."""
        if self.module.startswith(_COMPAT):
            array = importlib.import_module(_COMPAT).to_device(array, "cpu")
        return np.asarray(array)


NUMPY = Arrays()


def arrays_of(library: ArrayLibrary | str) -> Arrays:
    """Return the library of this name.

    Raises
    ------
    ModelError
        If it is not installed, or finds no device.
    """
    name = ArrayLibrary(library)
    if name is ArrayLibrary.NUMPY:
        return NUMPY
    for needed in (_COMPAT, name):
        if importlib.util.find_spec(needed) is None:
            raise ModelError(
                f'array library "{name}": found no {needed} in this environment; expected it '
                f"installed: pip install 'pyrcal[array]' {name}, or take \"numpy\""
            )
    found = Arrays(f"{_COMPAT}.{name}")
    try:
        # Tried now: a library can be imported and still lack a driver for its device.
        found.there(np.zeros(1, np.float32))
    except Exception as error:
        raise ModelError(
            f'array library "{name}": it does not work here ({error!r}); mend its installation or '
            'driver, or take "numpy"'
        ) from error
    return found


@cache
def _device(module: str) -> Any:  # noqa: ANN401 - as the library names them
    """Return where a library computes; None: where it does by itself."""
    if not module.endswith(".torch"):
        return None
    return "cuda" if importlib.import_module("torch").cuda.is_available() else "cpu"

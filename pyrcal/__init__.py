"""The library: optical model, fits of measured matrices, reconstructors.

Modules are imported when a name is first used.
"""

from importlib import import_module
from typing import TYPE_CHECKING

from service import __version__
from service.errors import (
    ConfigurationError,
    MatrixError,
    ModelError,
    PyrcalError,
    StorageError,
)

if TYPE_CHECKING:
    from pyrcal.client.rest import Service
    from pyrcal.fitting.design import dither_sigma, interaction_matrix
    from pyrcal.fitting.fit_file import fit, fit_file
    from pyrcal.fitting.fitted import Fit
    from pyrcal.fitting.matrix import FitOptions
    from pyrcal.fitting.report import FitReport, KnownFit, read_fit
    from pyrcal.importers.oopao import from_oopao, to_oopao
    from pyrcal.playback.player import Track
    from pyrcal.playback.track import track
    from service.config.settings import Settings
    from service.control.reconstructor import (
        Inversion,
        InversionMethod,
        Prior,
        Recipe,
        reconstruct,
    )
    from service.control.reconstructor import Recipe as InversionOptions
    from service.files.bundle import Bundle, read_bundle, write_bundle
    from service.instrument.reader import load_instrument
    from service.model.arrays import arrays_of
    from service.model.arrays import arrays_of as array_backend
    from service.model.instrument import Instrument
    from service.model.interaction import RtcInteractionModel
    from service.model.misregistration import Misregistration
    from service.model.modes import modal_basis
    from service.model.slopes import Orientation

__all__ = [
    "Bundle",
    "ConfigurationError",
    "Fit",
    "FitOptions",
    "FitReport",
    "Instrument",
    "Inversion",
    "InversionMethod",
    "InversionOptions",
    "KnownFit",
    "MatrixError",
    "Misregistration",
    "ModelError",
    "Orientation",
    "Prior",
    "PyrcalError",
    "Recipe",
    "RtcInteractionModel",
    "Service",
    "Settings",
    "StorageError",
    "Track",
    "__version__",
    "array_backend",
    "arrays_of",
    "dither_sigma",
    "fit",
    "fit_file",
    "from_oopao",
    "interaction_matrix",
    "load_instrument",
    "modal_basis",
    "read_bundle",
    "read_fit",
    "reconstruct",
    "to_oopao",
    "track",
    "write_bundle",
]

_HOMES = {
    "Bundle": "service.files.bundle",
    "Fit": "pyrcal.fitting.fitted",
    "FitOptions": "pyrcal.fitting.matrix",
    "FitReport": "pyrcal.fitting.report",
    "Instrument": "service.model.instrument",
    "Inversion": "service.control.reconstructor",
    "InversionMethod": "service.control.reconstructor",
    "InversionOptions": "service.control.reconstructor",
    "KnownFit": "pyrcal.fitting.report",
    "Misregistration": "service.model.misregistration",
    "Orientation": "service.model.slopes",
    "Prior": "service.control.reconstructor",
    "Recipe": "service.control.reconstructor",
    "RtcInteractionModel": "service.model.interaction",
    "Service": "pyrcal.client.rest",
    "Settings": "service.config.settings",
    "Track": "pyrcal.playback.player",
    "array_backend": "service.model.arrays",
    "arrays_of": "service.model.arrays",
    "dither_sigma": "pyrcal.fitting.design",
    "fit": "pyrcal.fitting.fit_file",
    "fit_file": "pyrcal.fitting.fit_file",
    "from_oopao": "pyrcal.importers.oopao",
    "interaction_matrix": "pyrcal.fitting.design",
    "load_instrument": "service.instrument.reader",
    "modal_basis": "service.model.modes",
    "read_bundle": "service.files.bundle",
    "read_fit": "pyrcal.fitting.report",
    "reconstruct": "service.control.reconstructor",
    "to_oopao": "pyrcal.importers.oopao",
    "track": "pyrcal.playback.track",
    "write_bundle": "service.files.bundle",
}

_RENAMED = {"InversionOptions": "Recipe", "array_backend": "arrays_of"}
"""Public names that differ from the names in their modules."""

_MODULES = {"conventions"}
"""Modules that are available without an explicit import."""


def __getattr__(name: str) -> object:
    """Import a name of the library when it is first used."""
    if name in _MODULES:
        return import_module(f"{__name__}.{name}")
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(_HOMES[name]), _RENAMED.get(name, name))

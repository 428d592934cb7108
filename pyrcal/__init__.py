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
    # "as" the same name marks a name as public for type checkers.
    from pyrcal.client.rest import Service as Service
    from pyrcal.fitting.design import dither_sigma as dither_sigma
    from pyrcal.fitting.design import interaction_matrix as interaction_matrix
    from pyrcal.fitting.fit_file import fit as fit
    from pyrcal.fitting.fit_file import fit_file as fit_file
    from pyrcal.fitting.fit_system import fit_system_files as fit_system
    from pyrcal.fitting.fitted import Fit as Fit
    from pyrcal.fitting.matrix import FitOptions as FitOptions
    from pyrcal.fitting.report import FitReport as FitReport
    from pyrcal.fitting.report import KnownFit as KnownFit
    from pyrcal.fitting.report import read_fit as read_fit
    from pyrcal.importers.cacao import from_cacao as from_cacao
    from pyrcal.importers.files import Reported as Reported
    from pyrcal.importers.oopao import from_oopao as from_oopao
    from pyrcal.importers.oopao import to_oopao as to_oopao
    from pyrcal.importers.specula import from_specula as from_specula
    from pyrcal.importers.specula import from_synim as from_synim
    from pyrcal.playback.report import Track as Track
    from pyrcal.playback.track import track as track
    from pyrcal.twins.make import twin as twin
    from pyrcal.twins.report import Twin as Twin
    from pyrcal.twins.specula_model import to_specula as to_specula
    from service.config.settings import Settings as Settings
    from service.control.reconstructor import Inversion as Inversion
    from service.control.reconstructor import InversionMethod as InversionMethod
    from service.control.reconstructor import Prior as Prior
    from service.control.reconstructor import Recipe as InversionOptions
    from service.control.reconstructor import reconstruct as reconstruct
    from service.files.bundle import Bundle as Bundle
    from service.files.bundle import read_bundle as read_bundle
    from service.files.bundle import write_bundle as write_bundle
    from service.instrument.reader import load_instrument as load_instrument
    from service.model.arrays import arrays_of as array_backend
    from service.model.instrument import Instrument as Instrument
    from service.model.interaction import RtcInteractionModel as RtcInteractionModel
    from service.model.misregistration import Misregistration as Misregistration
    from service.model.modes import modal_basis as modal_basis
    from service.model.slopes import Orientation as Orientation

_HOMES = {
    "Bundle": "service.files.bundle",
    "Fit": "pyrcal.fitting.fitted",
    "FitOptions": "pyrcal.fitting.matrix",
    "FitReport": "pyrcal.fitting.report",
    "Instrument": "service.model.instrument",
    "Inversion": "service.control.reconstructor",
    "InversionMethod": "service.control.reconstructor",
    "KnownFit": "pyrcal.fitting.report",
    "Misregistration": "service.model.misregistration",
    "Orientation": "service.model.slopes",
    "Prior": "service.control.reconstructor",
    "Reported": "pyrcal.importers.files",
    "RtcInteractionModel": "service.model.interaction",
    "Service": "pyrcal.client.rest",
    "Settings": "service.config.settings",
    "Track": "pyrcal.playback.report",
    "Twin": "pyrcal.twins.report",
    "dither_sigma": "pyrcal.fitting.design",
    "fit": "pyrcal.fitting.fit_file",
    "fit_file": "pyrcal.fitting.fit_file",
    "from_cacao": "pyrcal.importers.cacao",
    "from_oopao": "pyrcal.importers.oopao",
    "from_specula": "pyrcal.importers.specula",
    "from_synim": "pyrcal.importers.specula",
    "interaction_matrix": "pyrcal.fitting.design",
    "load_instrument": "service.instrument.reader",
    "modal_basis": "service.model.modes",
    "read_bundle": "service.files.bundle",
    "read_fit": "pyrcal.fitting.report",
    "reconstruct": "service.control.reconstructor",
    "to_oopao": "pyrcal.importers.oopao",
    "to_specula": "pyrcal.twins.specula_model",
    "track": "pyrcal.playback.track",
    "twin": "pyrcal.twins.make",
    "write_bundle": "service.files.bundle",
}

_RENAMED = {
    "fit_system": ("pyrcal.fitting.fit_system", "fit_system_files"),
    "InversionOptions": ("service.control.reconstructor", "Recipe"),
    "array_backend": ("service.model.arrays", "arrays_of"),
}
"""Public names that differ from the names in their modules."""

__all__ = [
    "ConfigurationError",
    "InversionOptions",
    "MatrixError",
    "ModelError",
    "PyrcalError",
    "StorageError",
    "__version__",
    "array_backend",
    "fit_system",
    *_HOMES,
]


def __getattr__(name: str) -> object:
    """Import a name of the library when it is first used."""
    if name == "conventions":
        return import_module("pyrcal.conventions")
    if name not in _HOMES and name not in _RENAMED:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module, own_name = _RENAMED.get(name) or (_HOMES[name], name)
    return getattr(import_module(module), own_name)

"""The library: optical model, fits of measured matrices, reconstructors.

Nothing is imported before it is asked for.
"""

from importlib import import_module
from typing import TYPE_CHECKING

from service import __version__
from service.errors import PyrcalError

if TYPE_CHECKING:
    from pyrcal.client.rest import Service
    from pyrcal.offline.design import dither_sigma, interaction_matrix
    from pyrcal.offline.fit_file import fit_file
    from pyrcal.offline.importers.oopao import from_oopao, to_oopao
    from pyrcal.offline.matrix import FitOptions
    from pyrcal.offline.report import read_fit
    from pyrcal.playback.player import Track
    from pyrcal.playback.track import track
    from service.config.instrument import load_instrument
    from service.control.reconstructor import Recipe, reconstruct
    from service.files.bundle import Bundle, read_bundle, write_bundle
    from service.model.arrays import arrays_of
    from service.model.interaction import RtcInteractionModel
    from service.model.misregistration import Misregistration
    from service.model.modes import modal_basis

__all__ = [
    "Bundle",
    "FitOptions",
    "Misregistration",
    "PyrcalError",
    "Recipe",
    "RtcInteractionModel",
    "Service",
    "Track",
    "__version__",
    "arrays_of",
    "dither_sigma",
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
    "FitOptions": "pyrcal.offline.matrix",
    "Misregistration": "service.model.misregistration",
    "Recipe": "service.control.reconstructor",
    "RtcInteractionModel": "service.model.interaction",
    "Service": "pyrcal.client.rest",
    "Track": "pyrcal.playback.player",
    "arrays_of": "service.model.arrays",
    "dither_sigma": "pyrcal.offline.design",
    "fit_file": "pyrcal.offline.fit_file",
    "from_oopao": "pyrcal.offline.importers.oopao",
    "interaction_matrix": "pyrcal.offline.design",
    "load_instrument": "service.config.instrument",
    "modal_basis": "service.model.modes",
    "read_bundle": "service.files.bundle",
    "read_fit": "pyrcal.offline.report",
    "reconstruct": "service.control.reconstructor",
    "to_oopao": "pyrcal.offline.importers.oopao",
    "track": "pyrcal.playback.track",
    "write_bundle": "service.files.bundle",
}


def __getattr__(name: str) -> object:
    """Import a name of the library when it is first used."""
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(_HOMES[name]), name)

"""The pyramid of 8 subapertures that OOPAO simulated, as test_import_oopao fits it."""

import pytest

import pyrcal
from pyrcal.importers.oopao import from_saved
from pyrcal.importers.saved import read_npz
from tests.support.repository import ROOT

SAVED = ROOT / "pyrcal" / "samples" / "data" / "oopao-pyramid.npz"


@pytest.fixture(scope="session")
def dump():
    return read_npz(SAVED)


@pytest.fixture(scope="session")
def bench(dump, tmp_path_factory):
    """Instrument and fit."""
    saved = from_saved(dump, "it").save(tmp_path_factory.mktemp("bench"))
    instrument = pyrcal.load_instrument(saved.instrument)
    return instrument, pyrcal.fit_file(instrument, saved.matrix, pyrcal.FitOptions()).fit

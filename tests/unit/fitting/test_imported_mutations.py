"""What is wrong in a file is not mended by an importer: it is refused, or stays to be named."""

from types import SimpleNamespace

import numpy as np
import pytest

from pyrcal.importers.aot import from_aot
from pyrcal.importers.cacao import from_cacao
from pyrcal.importers.files import Reported, from_arrays
from service.errors import MatrixError
from service.model.modes import modal_basis
from tests.support.mutations import MATRICES, good

REPORTED = Reported(
    diameter_m=3.0, sensor="pyramid", stop="telescope", obscuration_ratio=0.1, unit="m"
)


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    return good(tmp_path_factory.mktemp("good"))


def arrays(files, matrix):
    return {
        "matrix": matrix,
        "valid": files.valid,
        "positions": files.instrument.mirror.positions_m,
        "mode_to_actuator": modal_basis(files.instrument).mode_to_actuator,
    }


def by_arrays(files, matrix, *_):
    return from_arrays("it", arrays(files, matrix), REPORTED)


def by_aot(files, matrix, monkeypatch, _):
    """A file as aotpy reads it: the standard's order, subapertures first."""
    image = SimpleNamespace
    given = arrays(files, matrix)
    places = np.full(files.valid.shape, -1)
    places[files.valid] = np.arange(files.valid.sum())
    n_valid = int(files.valid.sum())
    if matrix.shape == files.matrix.shape:
        matrix = matrix.reshape(2, n_valid, -1).swapaxes(0, 1)

    class Pyramid(SimpleNamespace):
        pass

    loop = image(
        uid="loop",
        interaction_matrix=image(data=matrix),
        modes_to_commands=image(data=given["mode_to_actuator"]),
        input_sensor=Pyramid(
            uid="sensor",
            subaperture_mask=image(data=places),
            wavelength=750e-9,
            transformation_matrix=None,
        ),
        commanded_corrector=image(
            influence_function=None,
            transformation_matrix=None,
            actuator_coordinates=[image(x=x, y=y) for x, y in given["positions"]],
        ),
    )
    telescope = image(enclosing_diameter=3.0, obstruction_diameter=0.3)
    system = image(loops=[loop], main_telescope=telescope)
    monkeypatch.setattr("pyrcal.importers.aot.read_system", lambda _: system)
    return from_aot("it.fits", REPORTED)


def by_cacao(files, matrix, _, folder):
    """A loop's cubes: slopes as maps side by side, one for each mode."""
    fits = pytest.importorskip("astropy.io.fits")
    if matrix.shape == files.matrix.shape:
        n_modes, maps = matrix.shape[1], np.zeros((2, *files.valid.shape, matrix.shape[1]))
        maps[:, files.valid] = matrix.reshape(2, -1, n_modes)
        matrix = np.moveaxis(np.concatenate(maps, axis=1), -1, 0)
    modes = np.random.default_rng(4).normal(size=(40, 13, 13))
    for name, values in (
        ("CMmodesWFS", matrix),
        ("CMmodesDM", modes),
        ("wfsmask", np.hstack([files.valid, files.valid]).astype(np.uint8)),
        ("dmmask", np.ones((13, 13), np.uint8)),
    ):
        fits.writeto(folder / f"aol1_{name}.fits", values)
    return from_cacao(folder, REPORTED)


IMPORTERS = {"arrays": by_arrays, "aot": by_aot, "cacao": by_cacao}


@pytest.mark.parametrize("importer", IMPORTERS)
def test_a_good_matrix_passes_unchanged(importer, files, monkeypatch, tmp_path):
    found = IMPORTERS[importer](files, files.matrix, monkeypatch, tmp_path)
    np.testing.assert_array_equal(found.arrays["interaction_matrix"], files.matrix)


@pytest.mark.parametrize("name", MATRICES)
@pytest.mark.parametrize("importer", IMPORTERS)
def test_a_mutation_is_refused_or_passes_unchanged_to_where_its_rule_names_it(
    importer, name, files, monkeypatch, tmp_path
):
    mutated = np.asarray(MATRICES[name][0](files))
    try:
        found = IMPORTERS[importer](files, mutated, monkeypatch, tmp_path)
    except MatrixError as error:
        refusal = str(error)
    else:
        refusal = ""
    if refusal:
        assert "found" in refusal
        assert "\n" not in refusal
        return
    matrix = found.arrays["interaction_matrix"]
    if mutated.shape != matrix.shape:  # a layout that is told by its shape, and said
        assert any("turned" in note or "maps" in note for note in found.notes)
        np.testing.assert_array_equal(matrix, files.matrix)
    else:
        np.testing.assert_array_equal(matrix, mutated)

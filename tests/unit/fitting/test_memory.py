"""What a fit or a reconstructor takes is known, and refused in one line, before it is begun."""

import tracemalloc
from dataclasses import replace

import pytest

from pyrcal.arguments import command_line
from pyrcal.fitting import fit, fit_file, reconstruct
from pyrcal.fitting.matrix import FitOptions, fit_matrix
from pyrcal.fitting.memory import bytes_of_fit, bytes_of_reconstruction, check_reconstruction
from service.control.reconstructor import invert
from service.errors import ModelError
from service.estimation.reference import Reference
from service.model import pupil
from service.model.interaction import InteractionModel
from service.model.kinds import Influence
from service.model.local import tiles_of
from service.model.memory import PROGRAM_BYTES
from service.model.misregistration import Misregistration
from service.model.modes import modal_basis
from service.model.slopes import Orientation, SlopeRecipe
from tests.support.memory import instrument_of
from tests.support.reconstruct import TINY


@pytest.fixture(autouse=True)
def _cold():
    """Forget pupils and tiles of earlier tests, which a peak would leave out."""
    pupil._drawn.cache_clear()
    tiles_of.cache_clear()


@pytest.mark.parametrize("n_modes", [400, 60])
@pytest.mark.parametrize("sampling", [2, 4])
def test_the_estimate_is_within_a_fifth_of_the_measured_peak(n_modes, sampling):
    instrument = instrument_of(Influence.GAUSSIAN, 400)
    expected = bytes_of_reconstruction(instrument, n_modes, sampling) - PROGRAM_BYTES
    tracemalloc.start()
    try:
        model = InteractionModel(
            instrument, modal_basis(instrument), pupil_sampling=sampling, detector_nodes=sampling
        )
        invert(model.interaction_matrix(Misregistration(rotation_rad=0.1)), n_modes)
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert expected == pytest.approx(peak, rel=0.2)


@pytest.mark.parametrize("gain_map", [False, pytest.param(True, marks=pytest.mark.long)])
def test_the_estimate_of_a_fit_is_within_a_fifth_of_the_measured_peak(gain_map):
    plain = SlopeRecipe(orientation=Orientation())
    instrument = replace(instrument_of(Influence.GAUSSIAN, 200), slopes=plain)
    alpha = Misregistration(shift_x_subap=0.3, rotation_rad=0.02)
    measured = InteractionModel(instrument, modal_basis(instrument)).interaction_matrix(alpha)
    expected = bytes_of_fit(instrument, 200, gain_map=gain_map) - PROGRAM_BYTES
    tracemalloc.start()
    try:
        options = FitOptions(gain_map=gain_map, start=alpha)
        fit_matrix(instrument, Reference(matrix=measured.astype(float)), options)
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert expected == pytest.approx(peak, rel=0.2)


def test_a_fit_that_is_too_large_is_refused_in_one_line_before_it_is_begun(monkeypatch):
    monkeypatch.setattr(fit_file, "fit_matrix", None)
    words = ["fit", str(TINY), str(TINY.with_suffix(".h5")), "--memory-gb", "0.13"]
    with pytest.raises(ModelError) as refused:
        fit.main(command_line().parse_args(words))
    text = str(refused.value)
    assert "tiny: found 40 modes, whose fit takes 0." in text
    assert "expected at most --memory-gb 0.13: allow more, or fit fewer (--modes)" in text
    assert "\n" not in text


def test_too_large_is_refused_in_one_line_before_modes_are_made(monkeypatch, tmp_path):
    monkeypatch.setattr(reconstruct, "cached_basis", None)
    words = ["reconstruct", str(TINY), "0,0,0,1", "--modes", "30", "--memory-gb", "0.05"]
    options = command_line().parse_args([*words, "--output", str(tmp_path / "cm.h5")])
    with pytest.raises(ModelError) as refused:
        reconstruct.main(options)
    text = str(refused.value)
    assert "the inverse of 30 of them take 0." in text
    assert "expected at most --memory-gb 0.05: allow more, or ask for fewer modes" in text
    assert "\n" not in text


def test_thousands_of_modes_are_refused_or_allowed():
    instrument = instrument_of(Influence.GAUSSIAN, 400)
    check_reconstruction(instrument, 400, 2, 6.0)
    with pytest.raises(ModelError, match="D and the inverse of 400"):
        check_reconstruction(instrument, 400, 2, 0.14)

"""What a reconstructor takes is known, and refused in one line, before it is begun."""

import tracemalloc

import pytest

from pyrcal.arguments import command_line
from pyrcal.offline import reconstruct
from pyrcal.offline.memory import bytes_of_reconstruction, check_reconstruction
from service.control.reconstructor import invert
from service.errors import ModelError
from service.model.interaction import InteractionModel
from service.model.kinds import Influence
from service.model.memory import PROGRAM_BYTES
from service.model.misregistration import Misregistration
from service.model.modes import modal_basis
from tests.unit.model.test_memory import instrument_of
from tests.unit.offline.test_reconstruct import TINY


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


def test_too_large_is_refused_in_one_line_before_modes_are_made(monkeypatch, tmp_path):
    monkeypatch.setattr(reconstruct, "modal_basis", None)
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

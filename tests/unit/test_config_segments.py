"""Segmented mirrors of instrument files, and the instruments of the ELT."""

import re

import numpy as np
import pytest

from service.instrument import load_instrument, packaged_file
from service.instrument.mirrors import grid
from service.model.pupil import valid_subapertures
from tests.unit.test_config import ABOUT, MIRROR, WFS, refusal, write

__all__ = ["write"]


@pytest.mark.long
def test_the_packaged_instruments_of_the_elt_are_what_their_sources_say():
    """Of Deo et al. 2021, table 2, 6020 valid subapertures: 3 % more than behind our spider."""
    metis, micado = load_instrument("metis-elt"), load_instrument("micado-elt")
    assert (metis.wfs.n_subapertures, metis.wfs.pupil_separation_subap) == (90, 108)
    assert (micado.wfs.n_subapertures, micado.wfs.wavelength_m) == (92, 658e-9)
    assert micado.slopes.kind.n_planes * valid_subapertures(micado).sum() == pytest.approx(
        24_080, rel=0.03
    )
    for elt in (metis, micado):
        assert elt.diameter_m == pytest.approx(512 * 0.0762, rel=1e-3)
        assert (elt.mirror.pitch_m, elt.mirror.shape.coupling) == (0.54, 0.24)
        assert len(elt.mirror.positions_m) == 4410
        assert elt.spiders_deg == elt.mirror.segments_deg
        assert (elt.modes.n_modes, elt.loop.frame_rate_hz, elt.loop.delay_frames) == (4300, 500, 2)
        assert [remark.split(": ")[1] for remark in elt.remarks] == ["mirror.segments_deg"]


@pytest.mark.parametrize(("name", "sources"), [("metis-elt", "SOFD"), ("micado-elt", "SOD")])
def test_every_value_of_the_packaged_instruments_of_the_elt_names_its_source(name, sources):
    lines = packaged_file(name).read_text(encoding="utf-8").splitlines()
    values = [line for line in lines if "=" in line and not line.startswith("#")]
    named = re.compile(rf"# (\[[{sources}]\]|assumed)")
    assert [value for value in values if not named.search(value)] == [f'name = "{name}"']


SEGMENTED = MIRROR + 'influence = "gaussian"\n'


@pytest.mark.parametrize(
    ("keys", "complaint"),
    [
        ("segments_deg = [10.0]\n", "expected at least two gaps"),
        ("segments_deg = [10.0, 370.0]\n", "expected at least two gaps"),
        ("segments_deg = [10.0, 10.001]\n", "actuators in 1 segments"),
    ],
)
def test_segments_that_cannot_be_are_refused(write, keys, complaint):
    assert complaint in refusal(load_instrument, write(ABOUT + WFS + SEGMENTED + keys))


def test_segments_belong_to_functions_that_end(write):
    complaint = refusal(
        load_instrument, write(ABOUT + WFS + MIRROR + "segments_deg = [0.0, 180.0]\n")
    )
    assert 'mirror.segments_deg: belongs to influence = "gaussian"' in complaint


def test_no_actuator_of_a_grid_stands_on_a_gap(write):
    """Of 11 x 11 on a circle the middle row goes, 11 of 97."""
    keys = "segments_deg = [0.0, 180.0]\n"
    positions = load_instrument(write(ABOUT + WFS + SEGMENTED + keys)).mirror.positions_m
    assert np.abs(positions[:, 1]).min() == pytest.approx(0.8)
    assert len(positions) == len(grid(11, 0.8, 8.8)) - 11

import sys

import numpy as np
import pytest

from service.errors import ConfigurationError
from sim_rtc import truth
from sim_rtc.assembly import build_telescope
from sim_rtc.options import parse_options
from sim_rtc.truth import moments, write_snapshot


@pytest.fixture(scope="module")
def telescope(small_instrument):
    """The small telescope, its pyramid diffractive, in seeing that 77 actuators can correct."""
    words = ["--plant", "diffractive", "--alpha", "0,0,0,1", "--seed", "1", "--n-controlled", "30"]
    options = parse_options([*words, "--seeing", "0.4", "--spiders", "4:0.3"])
    return build_telescope(options, small_instrument)


@pytest.fixture(scope="module")
def seen(telescope):
    return list(moments(telescope))


@pytest.fixture
def seen_again(seen, monkeypatch):
    monkeypatch.setattr(truth, "moments", lambda _telescope: iter(seen))


def test_the_loop_is_seen_to_close(telescope, seen):
    assert [moment.frame for moment in seen] == [0, 20, 60, 300]
    assert seen[-1].error_nm < 0.6 * seen[0].error_nm
    for moment in seen:
        assert moment.images.shape == (20, 20)
        lit = np.isfinite(moment.residual_nm)
        # The arms are dark, from the centre to the edge.
        middle = moment.residual_nm.shape[0] // 2
        assert not lit[middle, middle:].any()
        assert lit.sum() > 400
        assert np.isfinite(moment.slopes[0]).sum() == telescope.plant.valid.sum()


@pytest.mark.usefixtures("seen_again")
def test_the_contact_sheet_is_written(telescope, tmp_path):
    pytest.importorskip("matplotlib")
    path = tmp_path / "loop.png"
    write_snapshot(telescope, path)
    assert path.read_bytes().startswith(b"\x89PNG")


def test_without_matplotlib_it_says_what_to_install(telescope, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    with pytest.raises(ConfigurationError, match="extra 'plots'"):
        write_snapshot(telescope, tmp_path / "loop.png")


def test_a_file_that_cannot_be_written_is_named(telescope, seen, tmp_path, monkeypatch):
    pytest.importorskip("matplotlib")
    monkeypatch.setattr(truth, "moments", lambda _telescope: iter(seen[:1]))
    with pytest.raises(ConfigurationError, match=r"--snapshot: cannot write .*no.such"):
        write_snapshot(telescope, tmp_path / "no/such/loop.png")

"""The fit of an upload, without the process around it."""

import pickle
import zipfile
from dataclasses import replace

import numpy as np
import pytest

from service.config import load_instrument, packaged_instrument
from service.errors import MatrixError
from service.files.jobs import UPLOAD, FitAsked
from service.files.upload import UploadFitter
from service.fit.options import FitOptions
from tests.data.tiny.make import ALPHA, HERE
from tests.numerics import small_instrument

ASKED = FitAsked(options=FitOptions(modes=np.arange(15)))


def fitter(own):
    made = UploadFitter(
        own=own,
        load_instrument=load_instrument,
        packaged_instrument=packaged_instrument,
        most_bytes=1_000_000,
        threads=1,
    )
    return pickle.loads(pickle.dumps(made))


def uploaded(folder, *files):
    if len(files) == 1:
        (folder / UPLOAD).write_bytes(files[0].read_bytes())
        return folder
    with zipfile.ZipFile(folder / UPLOAD, "w") as archive:
        for file in files:
            archive.write(file, file.name)
    return folder


def test_a_matrix_alone_belongs_to_the_services_own_instrument(tmp_path):
    own = load_instrument(HERE / "tiny.toml")
    found = fitter(own)(uploaded(tmp_path, HERE / "tiny.h5"), ASKED)
    assert found["n_modes_used"] == 15
    assert abs(found["rotation_deg"] - ALPHA["rotation_deg"]) < 0.2


def test_an_instrument_may_come_with_the_matrix(tmp_path):
    folder = uploaded(tmp_path, HERE / "tiny.toml", HERE / "tiny.h5")
    found = fitter(small_instrument())(folder, ASKED)
    assert abs(found["rotation_deg"] - ALPHA["rotation_deg"]) < 0.2


def test_a_packaged_instrument_may_be_named(tmp_path):
    asked = FitAsked(options=FitOptions(), instrument="flao-lbt")
    with pytest.raises(MatrixError, match=r"found shape \(224, 40\); expected \(1408 slopes"):
        fitter(small_instrument())(uploaded(tmp_path, HERE / "tiny.h5"), asked)


def test_refusals_do_not_tell_where_the_service_keeps_its_files(tmp_path):
    (tmp_path / "other.h5").write_bytes(b"x")
    folder = uploaded(tmp_path, HERE / "tiny.toml", tmp_path / "other.h5")
    with pytest.raises(MatrixError) as error:
        fitter(small_instrument())(folder, ASKED)
    assert str(error.value).startswith("other.h5: found something else")


def test_a_file_of_the_server_is_no_packaged_instrument(tmp_path, monkeypatch):
    monkeypatch.chdir(HERE)
    asked = replace(ASKED, instrument="tiny.toml")
    with pytest.raises(
        MatrixError, match=r"instrument tiny\.toml: neither a packaged name .*flao-lbt"
    ):
        fitter(small_instrument())(uploaded(tmp_path, HERE / "tiny.h5"), asked)

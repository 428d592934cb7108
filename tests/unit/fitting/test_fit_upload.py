import io
import json
import os
import subprocess
import time
import zipfile
from dataclasses import replace

import h5py
import pytest

from pyrcal.fitting import fit_file
from pyrcal.fitting.fit_upload import MOST_FILES, fit_upload, open_upload
from service.cli.serve import FIT_PROGRAM
from service.errors import ConfigurationError, MatrixError
from service.files.fit_folder import DOCUMENT, FIGURES, STAGE, UPLOAD, FitRequest
from service.instrument import load_instrument
from service.model.instrument import instrument_sha256
from tests.data.tiny.make import ALPHA, HERE
from tests.support.numerics import flao_basis

TOML = '[wfs]\nvalid_subapertures = "mask.h5:/mask"\n[mirror]\nmodes = "modes.fits"\n'


@pytest.fixture
def unpacked(tmp_path):
    folder = tmp_path / "unpacked"
    folder.mkdir()
    return folder


def zipped(tmp_path, **contents):
    path = tmp_path / "upload"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in contents.items():
            archive.writestr(name.replace("__", "/").replace("_dot_", "."), content)
    return path


def refused(path, folder, reference=None, most=1_000_000):
    with pytest.raises((MatrixError, ConfigurationError)) as error:
        open_upload(path, folder, reference, most)
    assert "\n" not in str(error.value)
    return str(error.value)


def test_a_file_alone_is_the_measured_one(tmp_path, unpacked):
    path = tmp_path / "upload"
    with h5py.File(path, "w") as file:
        file["D"] = [1.0]
    upload = open_upload(path, unpacked, None, 100)
    assert upload.reference == path
    assert upload.instrument is None


def test_in_an_archive_what_the_instrument_refers_to_is_not_the_measured_file(tmp_path, unpacked):
    path = zipped(
        tmp_path, my_dot_toml=TOML, mask_dot_h5="m", modes_dot_fits="c", night_dot_h5="measured"
    )
    upload = open_upload(path, unpacked, None, 1_000_000)
    assert upload.instrument == unpacked / "my.toml"
    assert upload.reference.read_text() == "measured"


def test_where_several_could_be_it_the_measured_file_is_named(tmp_path, unpacked):
    path = zipped(tmp_path, a_dot_toml="", b_dot_h5="b", c_dot_h5="c")
    text = refused(path, unpacked)
    assert "b.h5, c.h5" in text
    assert "reference=" in text
    (again := unpacked / "again").mkdir()
    assert open_upload(path, again, "c.h5", 1_000_000).reference.read_text() == "c"


def test_a_name_that_is_not_in_the_archive_is_refused(tmp_path, unpacked):
    path = zipped(tmp_path, a_dot_toml="", b_dot_h5="b")
    assert "found ../b.h5" in refused(path, unpacked, "../b.h5")


def test_an_instrument_must_not_refer_to_the_servers_own_files(tmp_path, unpacked):
    toml = '[mirror]\nmodes = "/srv/secret.h5:/modes"\n'
    path = zipped(tmp_path, a_dot_toml=toml, b_dot_h5="b")
    assert "refers to /srv/secret.h5" in refused(path, unpacked)


@pytest.mark.parametrize("name", ["folder__im_dot_h5", "..__im_dot_h5", "__etc__im_dot_h5"])
def test_an_archive_has_no_folders(tmp_path, unpacked, name):
    assert "without folders" in refused(zipped(tmp_path, a_dot_toml="", **{name: "b"}), unpacked)


def test_an_archive_that_swells_is_refused_before_it_does(tmp_path, unpacked):
    path = zipped(tmp_path, a_dot_toml="", b_dot_h5="0" * 2_000_000)
    assert path.stat().st_size < 10_000
    assert "2 MB" in refused(path, unpacked)
    assert not list(unpacked.iterdir())


def test_an_archive_of_many_files_is_refused(tmp_path, unpacked):
    path = zipped(tmp_path, **{f"f{k}": "" for k in range(MOST_FILES + 1)})
    assert f"found {MOST_FILES + 1} files" in refused(path, unpacked)


@pytest.mark.parametrize("n_tomls", [0, 2])
def test_an_archive_has_one_instrument(tmp_path, unpacked, n_tomls):
    path = zipped(tmp_path, b_dot_h5="b", **{f"i{k}_dot_toml": "" for k in range(n_tomls)})
    assert f"found {n_tomls} .toml files" in refused(path, unpacked)


def test_a_damaged_archive_is_refused(tmp_path, unpacked):
    whole = zipped(tmp_path, a_dot_toml="", b_dot_h5="b" * 1000).read_bytes()
    path = tmp_path / "upload"
    path.write_bytes(whole[: len(whole) // 2])
    assert "damaged" in refused(path, unpacked)


def test_a_locked_archive_is_refused(tmp_path, unpacked):
    content = bytearray(zipped(tmp_path, a_dot_toml="x = 1").read_bytes())
    with zipfile.ZipFile(io.BytesIO(bytes(content))) as archive:
        place = archive.start_dir + 8
    content[6] |= 1
    content[place] |= 1
    path = tmp_path / "upload"
    path.write_bytes(bytes(content))
    assert "encrypted" in refused(path, unpacked)


def reaching(path):
    with h5py.File(path, "w") as file:
        file["mask"] = h5py.ExternalLink("/srv/secret.h5", "/mask")
    return path.read_bytes()


def test_a_matrix_that_is_a_link_to_the_servers_own_files_is_refused(tmp_path, unpacked):
    path = tmp_path / "upload"
    reaching(path)
    assert "/mask: found a link to another file, /srv/secret.h5" in refused(path, unpacked)


def test_so_is_a_mask_of_an_archive(tmp_path, unpacked):
    mask = reaching(tmp_path / "made.h5")
    path = zipped(tmp_path, my_dot_toml=TOML, mask_dot_h5=mask, modes_dot_fits="c", im_dot_h5="m")
    text = refused(path, unpacked)
    assert "mask.h5:/mask: found a link to another file" in text


@pytest.mark.parametrize(
    "toml",
    [
        '[mirror]\nmodes = ["/srv/secret.h5:/modes"]\n',
        '[mirror.more]\nmodes = "/srv/secret.h5:/modes"\n',
        'modes = "../../secret.h5:/modes"\n',
        '[instrument]\npupil = "/srv/secret.npy"\n',
        '[instrument]\npupil = "/srv/secret.fits"\n',
    ],
)
def test_a_reference_is_found_wherever_it_stands_in_the_instrument_file(tmp_path, unpacked, toml):
    path = zipped(tmp_path, a_dot_toml=toml, b_dot_h5="b")
    assert "secret." in refused(path, unpacked)


ASKED = {
    **dict.fromkeys(("dataset", "start", "instrument", "reference")),
    "method": "joint",
    "modes": "0:15",
    "gain_map": False,
    "anamorphosis": True,
}
OWN = HERE / "tiny.toml"
REQUEST = FitRequest(
    asked=ASKED,
    own_instrument=str(OWN),
    own_sha256=instrument_sha256(load_instrument(OWN)),
    max_bytes=1_000_000,
    threads=1,
    nice=0,
    memory_mb=4000,
)


def fitted(folder, **asked):
    """Fit what lies there in this process, and return the document."""
    fit_upload(folder, replace(REQUEST, asked=ASKED | asked))
    return json.loads((folder / DOCUMENT).read_text())


def uploaded(folder, *files):
    if len(files) == 1:
        (folder / UPLOAD).write_bytes(files[0].read_bytes())
        return folder
    with zipfile.ZipFile(folder / UPLOAD, "w") as archive:
        for file in files:
            archive.write(file, file.name)
    return folder


def test_a_matrix_alone_belongs_to_the_services_own_instrument(tmp_path):
    found = fitted(uploaded(tmp_path, HERE / "tiny.h5"))
    assert found["n_modes_used"] == 15
    assert abs(found["rotation_deg"] - ALPHA["rotation_deg"]) < 0.2
    drawn = json.loads((tmp_path / FIGURES).read_text())
    assert drawn["own_instrument"]
    assert drawn["modes"] == list(range(15))
    assert (tmp_path / STAGE).read_text() == "figures"


def test_an_instrument_file_that_has_changed_since_is_told_and_is_not_the_services_own(tmp_path):
    folder = uploaded(tmp_path, HERE / "tiny.h5")
    fit_upload(folder, replace(REQUEST, own_sha256="of another day"))
    told = json.loads((folder / DOCUMENT).read_text())["notes"][-1]
    assert told == "the instrument file has changed since the service began: read as it is now"
    assert not json.loads((folder / FIGURES).read_text())["own_instrument"]


def test_an_instrument_may_come_with_the_matrix(tmp_path):
    folder = uploaded(tmp_path, HERE / "tiny.toml", HERE / "tiny.h5")
    assert abs(fitted(folder)["rotation_deg"] - ALPHA["rotation_deg"]) < 0.2
    assert not json.loads((folder / FIGURES).read_text())["own_instrument"]


def test_a_packaged_instrument_may_be_named(tmp_path, monkeypatch):
    monkeypatch.setattr(fit_file, "cached_basis", lambda _instrument: flao_basis())
    with pytest.raises(MatrixError, match=r"found shape \(224, 40\); expected \(1408 slopes"):
        fitted(uploaded(tmp_path, HERE / "tiny.h5"), modes=None, instrument="flao-lbt")


def test_refusals_do_not_tell_where_the_service_keeps_its_files(tmp_path):
    (tmp_path / "other.h5").write_bytes(b"x")
    folder = uploaded(tmp_path, HERE / "tiny.toml", tmp_path / "other.h5")
    with pytest.raises(MatrixError) as error:
        fitted(folder)
    assert str(error.value).startswith("other.h5: found text that begins 'x'")


def test_a_file_of_the_server_is_no_packaged_instrument(tmp_path, monkeypatch):
    monkeypatch.chdir(HERE)
    with pytest.raises(
        MatrixError, match=r"instrument tiny\.toml: neither a packaged name .*flao-lbt"
    ):
        fitted(uploaded(tmp_path, HERE / "tiny.h5"), instrument="tiny.toml")


# --- as the service starts it


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({}, None),
        ({"own_instrument": "nobodys"}, "instrument nobodys: neither a packaged name"),
        ({"memory_mb": 60}, "needs more memory than 60 MB, the most it may have"),
    ],
)
def test_the_program_leaves_its_answer_or_says_why_there_is_none(tmp_path, change, said):
    folder = uploaded(tmp_path, HERE / "tiny.h5")
    replace(REQUEST, **change).write(folder)
    begun = subprocess.run(
        [*FIT_PROGRAM, str(folder)], stdin=open_end(), capture_output=True, text=True, check=False
    )
    if said is None:
        assert begun.returncode == 0, begun.stderr
        assert json.loads((folder / DOCUMENT).read_text())["n_modes_used"] == 15
    else:
        assert begun.returncode == 2
        assert begun.stderr.splitlines()[-1].startswith(said)
        assert not (folder / DOCUMENT).exists()


def test_the_program_ends_with_the_service_and_is_as_nice_as_asked(tmp_path):
    folder = uploaded(tmp_path, HERE / "tiny.h5")
    os.mkfifo(folder / "slow.h5")  # whoever opens it waits for ever
    (folder / UPLOAD).unlink()
    (folder / UPLOAD).symlink_to(folder / "slow.h5")
    replace(REQUEST, nice=3).write(folder)
    with subprocess.Popen([*FIT_PROGRAM, str(folder)], stdin=subprocess.PIPE) as process:
        while not (folder / STAGE).exists():
            assert process.poll() is None
            time.sleep(0.02)
        assert os.getpriority(os.PRIO_PROCESS, process.pid) == os.nice(0) + 3
        process.stdin.close()
        assert process.wait(30.0) == 2


def open_end():
    """Return a pipe that nobody closes before this process ends, as the service holds one."""
    end, _ = os.pipe()
    return end

"""``pyrcal fit-system``: files in, where everything is out."""

import json
from dataclasses import replace

import h5py
import numpy as np
import pytest

from pyrcal.__main__ import main
from pyrcal.fitting.fit_system import fit_pairs, locate_matrices
from pyrcal.fitting.fitted import Registration
from pyrcal.fitting.system import ARCSEC_RAD, STAR
from pyrcal.fitting.system_file import load_system
from pyrcal.fitting.system_report import document, fill_system, table
from service.errors import ConfigurationError
from service.model.misregistration import Misregistration
from tests.support import systems
from tests.support.made import a_fit, a_report

NOISE = 0.005
"""Of the largest slope."""

PYRAMID = """
[wfs]
kind = "pyramid"
n_subapertures = 10
pupil_separation_subap = 14
wavelength_m = 750e-9
modulation_lambda_over_d = 3.0
"""

SYSTEM = systems.SYSTEM.replace(
    """
[[sensors]]
name = "lgs2"
star_arcsec = [-12.0, 18.0]
star_height_m = 90e3
""",
    "",
).replace('name = "ngs"', 'name = "ngs"\ninstrument = "pyramid.toml"')
SYSTEM = SYSTEM.replace('name = "dm1"', 'name = "dm1"\nfixed = true')
"""A Shack-Hartmann on a laser star, a pyramid on a natural one."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Two sensors of different kinds with two mirrors, and noisy matrices of all four pairs."""
    folder = tmp_path_factory.mktemp("system")
    systems.written(folder, n_subapertures=8)
    before, _wfs, after = (folder / "ground.toml").read_text().partition("[wfs]")
    mirror = after.partition("[mirror]")[2]
    (folder / "pyramid.toml").write_text(f"{before}{PYRAMID}[mirror]{mirror}")
    system = systems.written(folder, SYSTEM, n_subapertures=8)
    rng = np.random.default_rng(1)
    values = systems.moved(system, rng, 0.05)
    matrices = [systems.matrix(system, pair, values) for pair in system.pairs]
    noisy = [one + NOISE * one.max() * rng.normal(size=one.shape) for one in matrices]
    systems.recorded(folder / "im.h5", noisy, system)
    for pair, one in zip(system.pairs, noisy, strict=True):
        np.save(folder / "im_{}_{}.npy".format(*system.names(pair)), one)
    np.save(folder / "values.npy", values)
    return folder


def asked(folder, reference, *options):
    return main(["fit-system", str(folder / "system.toml"), str(folder / reference), *options])


@pytest.fixture(scope="module")
def answered(folder):
    written = ["--output", str(folder / "fit.h5"), "--plot", str(folder / "fit.png")]
    return asked(folder, "im.h5", *written)


def test_a_system_of_two_kinds_of_sensor_is_found(folder, answered):
    """Every number within 4 σ of the truth, and σ of some use."""
    assert answered == 0
    values = np.load(folder / "values.npy")
    with h5py.File(folder / "fit.h5") as file:
        found = json.loads(file.attrs["document"])
        names = list(file["values"].attrs["parameters"])
        sigma = np.sqrt(np.diag(file["covariance"][()]))
        assert file.attrs["accepted"]
        assert "residual_map" in file["pairs/ngs/dm2"]
    assert found["verdict"].startswith("accepted: 4 pairs agree")
    assert found["not_seen"] == []
    shift = found["mirrors"]["dm2"]["shift_x_m"]
    true = values[-4]
    assert abs(shift["value"] - true) < 4 * shift["sigma"]
    turned = found["sensors"]["lgs1"]["rotation_deg"]
    assert turned["nominal"] == pytest.approx(6.0)
    assert abs(turned["value"] - np.rad2deg(values[2])) < 4 * turned["sigma"]
    assert turned["sigma"] == pytest.approx(sigma[names.index("lgs1.rotation_deg")])
    assert 0 < turned["sigma"] < 0.5
    assert found["sensors"]["ngs"]["star_height_m"]["value"] is None


def test_figures_are_drawn(folder, answered):
    assert (folder / "fit.png").stat().st_size > 20_000


def test_each_pair_may_have_a_file_of_its_own(folder):
    system = load_system(folder / "system.toml")
    found = locate_matrices(system, folder / "im_{sensor}_{mirror}.npy", None)
    with h5py.File(folder / "im.h5") as file:
        for pair, stored in zip(system.pairs, found, strict=True):
            one = file["{}/{}/interaction_matrix".format(*system.names(pair))]
            np.testing.assert_array_equal(np.load(stored.path), one)


def test_matrices_of_another_pair_are_refused(folder, capsys):
    """The two mirrors exchanged: another number of actuators is seen."""
    with h5py.File(folder / "im.h5") as file, h5py.File(folder / "mixed.h5", "w") as mixed:
        for sensor in file:
            for mirror, other in (("dm1", "dm2"), ("dm2", "dm1")):
                name = f"{sensor}/{{}}/interaction_matrix"
                mixed[name.format(mirror)] = file[name.format(other)][:, :60]
    assert asked(folder, "mixed.h5") in {1, 2}
    said = capsys.readouterr()
    assert "refused: " in said.out or "lgs1 x dm" in said.err


def refusal(folder, capsys, *arguments):
    assert asked(folder, *arguments) == 2
    line = capsys.readouterr().err.strip()
    assert "\n" not in line
    return line


def test_a_pair_that_is_missing_is_named(folder, capsys):
    with h5py.File(folder / "im.h5") as file, h5py.File(folder / "few.h5", "w") as few:
        file.copy("lgs1", few)
    line = refusal(folder, capsys, "few.h5")
    assert "ngs x dm1: found no dataset ngs/dm1/interaction_matrix in " in line
    line = refusal(folder, capsys, "{sensor}_to_{mirror}.npy")
    assert "lgs1 x dm1: found no file " in line
    assert "expected the matrix of this pair" in line


def test_one_matrix_for_all_pairs_is_refused(folder, capsys):
    line = refusal(folder, capsys, "im.h5", "--dataset", "lgs1/{mirror}/interaction_matrix")
    assert "found one matrix for several pairs, expected {sensor} and {mirror}" in line


def test_a_matrix_of_another_shape_names_its_pair(folder, capsys):
    with h5py.File(folder / "im.h5") as file, h5py.File(folder / "short.h5", "w") as short:
        for sensor in file:
            file.copy(sensor, short)
        del short["lgs1/dm1/interaction_matrix"]
        short["lgs1/dm1/interaction_matrix"] = file["lgs1/dm1/interaction_matrix"][:-2]
    line = refusal(folder, capsys, "short.h5")
    assert "lgs1 x dm1: " in line
    assert "found shape (" in line


def told_by(system, values, asked_for):
    """Return a fit of any pair that tells the truth, and notes where the pupil was taken to lie."""
    told = dict(zip(system.pairs, system.alphas(values), strict=True))

    def fit(pair, about):
        asked_for.append((pair, about.pupil_shift_subap))
        alpha = Misregistration.from_vector(told[pair])
        return a_report(a_fit(alpha=alpha, covariance=np.diag([1e-6, 1e-6, 1e-8, 1e-8])))

    return fit


def test_pairs_of_a_shifted_sensor_are_fitted_again_with_the_pupil_there(folder):
    system, asked_for = load_system(folder / "system.toml"), []
    values = system.nominal.copy()
    values[system.of_sensor(1)][:2] = [0.3, -0.1]
    report = fit_pairs(system, told_by(system, values, asked_for))
    first, again = asked_for[:4], asked_for[4:]
    assert [one for _, one in first] == [None] * 4
    assert [pair for pair, _ in again] == [pair for pair in system.pairs if pair.sensor == 1]
    assert np.array([one for _, one in again]) == pytest.approx(np.tile([0.3, -0.1], (2, 1)))
    assert report.accepted


def test_pairs_that_disagree_are_refused_and_the_worst_is_named(folder):
    system = load_system(folder / "system.toml")
    fit = told_by(system, system.nominal, [])
    wrong = system.pairs[3]

    def one_wrong(pair, about):
        report = fit(pair, about)
        moved = report.fit.alpha.add_step(np.array([0.0, 0.0, 0.01, 0.0]) * (pair == wrong))
        return replace(report, fit=replace(report.fit, alpha=moved))

    report = fit_pairs(system, one_wrong)
    assert not report.accepted
    assert report.verdict.startswith("refused: the pairs disagree (chi2 ")
    assert "rotation_deg by " in report.verdict


def test_a_refused_pair_is_left_out_and_named(folder):
    system = load_system(folder / "system.toml")
    asked_for = []
    fit = told_by(system, system.nominal, asked_for)

    def one_refused(pair, about):
        report = fit(pair, about)
        if pair == system.pairs[1]:
            refused = {"accepted": False, "alpha": Misregistration(shift_x_subap=0.8)}
            refused["registration"] = Registration(
                determined=False,
                reason="too much noise",
                sigma_statistical=np.ones(4),
                sigma_systematic=np.ones(4),
            )
            report = replace(report, fit=replace(report.fit, **refused))
        return report

    report = fit_pairs(system, one_refused)
    assert report.verdict == "refused: 1 of 4 pairs: lgs1 x dm2: too much noise"
    assert np.isnan(report.found.misfit[1]).all()
    assert "  refused" in table(report)
    assert len(asked_for) == 4  # nor does it say where the pupil lies


def test_a_pair_refused_with_the_pupil_elsewhere_keeps_its_first_fit(folder):
    system = load_system(folder / "system.toml")
    values = system.nominal.copy()
    values[system.of_sensor(1)][:2] = [0.3, -0.1]
    fit = told_by(system, values, [])

    def refused_elsewhere(pair, about):
        report = fit(pair, about)
        if about.pupil_shift_subap is None:
            return report
        verdict = 'refused: with stop = "mirror" the misfit is 10%'
        return replace(report, fit=replace(report.fit, accepted=False, verdict=verdict))

    report = fit_pairs(system, refused_elsewhere)
    assert report.accepted
    assert "stop" not in report.verdict


@pytest.mark.parametrize("off_arcsec", [2.0, -5.0])
def test_a_star_that_is_elsewhere_is_named_and_no_pupil_is_moved(folder, off_arcsec):
    system, asked_for = load_system(folder / "system.toml"), []
    values = system.nominal.copy()
    values[system.of_sensor(0)][STAR] += np.array([off_arcsec, 0.0]) * ARCSEC_RAD
    report = fit_pairs(system, told_by(system, values, asked_for))
    assert not report.accepted
    assert len(asked_for) == len(system.pairs)
    assert f"the star of lgs1 is {off_arcsec:+.2f}, " in report.verdict
    assert "stop" not in report.verdict


def test_a_sensor_without_an_accepted_pair_has_no_values(folder, tmp_path):
    system = load_system(folder / "system.toml")
    fit = told_by(system, system.nominal, [])

    def without_ngs(pair, about):
        report = fit(pair, about)
        if pair.sensor == 0:
            return report
        return replace(report, fit=replace(report.fit, accepted=False, converged=False))

    report = fit_pairs(system, without_ngs)
    assert report.unmeasured == {"ngs"}
    found = document(report)
    for number in ("shift_x_subap", "rotation_deg", "magnification"):
        assert found["sensors"]["ngs"][number]["value"] is None
        assert found["sensors"]["ngs"][number]["sigma"] is None
        assert found["sensors"]["lgs1"][number]["sigma"] > 1e-6
    assert "ngs shift_x_subap" not in table(report)
    with h5py.File(tmp_path / "out.h5", "w") as file:
        fill_system(file, report)
        of_ngs = [name.startswith("ngs.shift") for name in file["values"].attrs["parameters"]]
        assert np.isnan(file["values"][()][of_ngs]).all()


@pytest.mark.parametrize(
    ("star", "unit"), [("[9.7e-5, 0.0]", "like radians (20 arcs"), ("[2e4, 0.0]", "milliarcsec")]
)
def test_a_star_in_another_unit_is_refused_by_its_size(star, unit, tmp_path):
    text = systems.SYSTEM.replace("[20.0, 0.0]", star)
    with pytest.raises(
        ConfigurationError, match=r"sensors\.0\.star_arcsec: found a star "
    ) as error:
        systems.written(tmp_path, text)
    assert unit in str(error.value)

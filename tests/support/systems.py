"""A system of stars and mirrors at altitudes, small enough to be fitted in a second a pair."""

import h5py
import numpy as np

from pyrcal.fitting.system_file import load_system
from service.model.interaction import RtcInteractionModel
from service.model.misregistration import Misregistration

TELESCOPE = """
[instrument]
name = "{name}"
diameter_m = 8.0
stop = "telescope"

[wfs]
kind = "shack-hartmann"
n_subapertures = {n_subapertures}
wavelength_m = 589e-9

[mirror]
layout = "grid"
n_across = {n_across}
pitch_m = {pitch_m}
diameter_m = {width_m}
influence = "gaussian"
coupling = 0.35
basis = "zonal"

[slopes]
orientation = {{ sign = 1 }}
"""

SYSTEM = """
[system]
name = "small"
instrument = "ground.toml"

[[sensors]]
name = "lgs1"
star_arcsec = [20.0, 0.0]
star_height_m = 90e3
rotation_deg = 6.0

[[sensors]]
name = "lgs2"
star_arcsec = [-12.0, 18.0]
star_height_m = 90e3

[[sensors]]
name = "ngs"
star_arcsec = [-10.0, -15.0]

[[mirrors]]
name = "dm1"

[[mirrors]]
name = "dm2"
instrument = "high.toml"
altitude_m = 9000.0
rotation_deg = -4.0
"""


def written(folder, system=SYSTEM, n_subapertures=10):
    """Write the files of a system into a folder, and return it as it is read."""
    ground = {"name": "ground", "n_across": 9, "pitch_m": 1.05, "width_m": 9.6}
    high = {"name": "high", "n_across": 11, "pitch_m": 1.1, "width_m": 11.2}
    for about in (ground, high):
        text = TELESCOPE.format(**about, n_subapertures=n_subapertures)
        (folder / f"{about['name']}.toml").write_text(text)
    (folder / "system.toml").write_text(system)
    return load_system(folder / "system.toml")


def moved(system, rng, size_subap=0.1):
    """Return numbers of a system of which the free ones are a little off, at random."""
    values = system.nominal.copy()
    free = np.array([parameter.free for parameter in system.parameters])
    unit = np.array([parameter.subap for parameter in system.parameters])
    values[free] += size_subap * unit[free] * rng.normal(size=free.sum())
    return values


def matrix(system, pair, values, sampling=4):
    """Return D of a pair whose map is that of these numbers, all in the drawing."""
    there = system.at(values)
    model = RtcInteractionModel(
        there.instrument(pair), there.basis(pair), pupil_sampling=sampling, detector_nodes=sampling
    )
    return np.asarray(model.interaction_matrix(Misregistration()), dtype=np.float64)


def recorded(path, matrices, system):
    """Write the matrices of all pairs into one file."""
    with h5py.File(path, "w") as file:
        for pair, one in zip(system.pairs, matrices, strict=True):
            sensor, mirror = system.names(pair)
            file[f"{sensor}/{mirror}/interaction_matrix"] = one

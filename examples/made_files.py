"""Write files like those of a bench, made by pyrcal's own model at a known registration.

Run: ``python -m examples.made_files papyrus FOLDER`` for three files like PAPYRUS's published ones,
or ``python -m examples.made_files cacao FOLDER`` for a ``conf`` folder like cacao's. Names and
shapes are those of the real files. Each mode or actuator has noise of 10 % of its signal.
"""

import sys
from dataclasses import replace
from pathlib import Path
from tempfile import NamedTemporaryFile

import numpy as np
from astropy.io import fits

import pyrcal
from service.model.kinds import SlopeOrder
from service.model.slopes import SlopeRecipe

MODES = (1, 5, 10, 20, 30, 50, 80, 100, 150)
ALPHA = pyrcal.Misregistration(
    shift_x_subap=-0.10, shift_y_subap=0.05, rotation_rad=np.deg2rad(1.2), magnification=0.995
)

CACAO = """
[instrument]
name = "bench"
diameter_m = 2.0
stop = "telescope"
[wfs]
kind = "pyramid"
n_subapertures = 24
pupil_separation_subap = 30
wavelength_m = 750e-9
modulation_lambda_over_d = 3.0
[mirror]
layout = "grid"
n_across = 12
pitch_m = 0.18182
diameter_m = 2.3
influence = "gaussian"
coupling = 0.3
basis = "zonal"
"""

CACAO_VARIABLES = """
export CACAO_LOOPNAME="bench"
export CACAO_DMxsize="12"
export CACAO_DMysize="12"
export CACAO_DMSPATIAL="1"
export CACAO_WFSSTREAM="camera"
"""


def frames_of(instrument, columns, centres, n_pixels, pixels_per_subap):
    """Return camera frames of the model's response with noise, and which pixels see light.

    ``centres`` are row and column of the middle of each pupil image.
    """
    recipe = SlopeRecipe(order=SlopeOrder.IMAGES)
    instrument = replace(instrument, slopes=recipe)
    model = pyrcal.RtcInteractionModel(instrument, pyrcal.modal_basis(instrument))
    matrix = np.asarray(model.interaction_matrix(ALPHA))
    matrix = matrix if columns is None else matrix[:, list(columns)]
    noise = np.random.default_rng(3).normal(size=matrix.shape)
    matrix = matrix + 0.1 * np.linalg.norm(matrix, axis=0) * noise / np.linalg.norm(noise, axis=0)
    valid, lit = model.valid, np.zeros((n_pixels, n_pixels), dtype=bool)
    n, count = len(valid), matrix.shape[1]
    half = n * pixels_per_subap // 2
    frames = np.zeros((count, n_pixels, n_pixels))
    for image, (row, column) in zip(np.split(matrix, 4), centres, strict=True):
        maps = np.zeros((count, n, n))
        maps[:, valid] = image.T
        at = (slice(row - half, row + half), slice(column - half, column + half))
        block = maps.repeat(pixels_per_subap, axis=1).repeat(pixels_per_subap, axis=2)
        frames[(slice(None), *at)] += block
        lit[at] |= valid.repeat(pixels_per_subap, axis=0).repeat(pixels_per_subap, axis=1)
    return frames, lit


def papyrus(folder):
    """Write what PAPYRUS has published: camera of 240 x 240 pixels, nine modes, M2C, mask."""
    instrument = pyrcal.load_instrument("papyrus")
    centres = ((53, 53), (50, 183), (186, 55), (182, 187))
    frames, lit = frames_of(instrument, MODES, centres, 240, 2)
    listed = "_".join(str(mode) for mode in MODES)
    np.save(folder / f"int_mat_{listed}.npy", frames.reshape(len(MODES), -1).T)
    np.save(folder / "M2C.npy", pyrcal.modal_basis(instrument).mode_to_actuator)
    np.save(folder / "valid_pixel.npy", lit)


def cacao(folder):
    """Write a ``conf`` folder: response of a mirror of 12 x 12 actuators on 64 x 64 pixels."""
    with NamedTemporaryFile("w", suffix=".toml") as file:
        file.write(CACAO)
        file.flush()
        instrument = pyrcal.load_instrument(file.name)
    positions = instrument.analytic_mirror.positions_m
    frames, lit = frames_of(instrument, None, ((17, 17), (17, 47), (47, 17), (47, 47)), 64, 1)
    at = np.rint(positions / 0.18182 + 5.5).astype(int)
    cube, mask = np.zeros((144, 64, 64), np.float32), np.zeros((12, 12), np.float32)
    cube[at[:, 1] * 12 + at[:, 0]] = frames
    mask[at[:, 1], at[:, 0]] = 1.0
    fits.writeto(folder / "zrespM-H.fits", cube)
    fits.writeto(folder / "wfsref.fits", lit.astype(np.float32))
    fits.writeto(folder / "dmmask.fits", mask)
    (folder / "cacaovars.bash").write_text(CACAO_VARIABLES)


if __name__ == "__main__":
    made, where = sys.argv[1:]
    Path(where).mkdir(parents=True, exist_ok=True)
    {"papyrus": papyrus, "cacao": cacao}[made](Path(where))

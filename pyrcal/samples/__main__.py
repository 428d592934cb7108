"""Write the sample files of one tutorial into a folder.

Run: ``python -m pyrcal.samples NAME FOLDER``. ``oopao``, ``specula`` and ``synim`` are copies of
files that these codes wrote. ``papyrus`` and ``cacao`` have names and shapes of real files; their
response is that of pyrcal's model at a known registration, with noise of 10 % of the signal of each
mode or actuator.
"""

from __future__ import annotations

import argparse
import shutil
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from tempfile import NamedTemporaryFile
from typing import Any

import numpy as np
from astropy.io import fits
from numpy.typing import NDArray

from service.instrument import load_instrument
from service.model.instrument import Instrument
from service.model.interaction import RtcInteractionModel
from service.model.kinds import SlopeOrder
from service.model.misregistration import Misregistration
from service.model.modes import modal_basis
from service.model.slopes import SlopeRecipe

MODES = (1, 5, 10, 20, 30, 50, 80, 100, 150)
ALPHA = Misregistration(
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
"""

MODES_CACAO = 60

CACAO_VARIABLES = """
export CACAO_LOOPNAME="bench"
export CACAO_DMxsize="12"
export CACAO_DMysize="12"
export CACAO_DMSPATIAL="1"
export CACAO_WFSSTREAM="camera"
"""


def _compute_frames(
    instrument: Instrument,
    columns: Iterable[int] | None,
    centres: Iterable[tuple[int, int]],
    n_pixels: int,
    pixels_per_subap: int,
) -> tuple[NDArray[Any], NDArray[np.bool_]]:
    """Return camera frames of the model's response with noise, and the mask of lit pixels.

    ``centres`` are row and column of the middle of each pupil image.
    """
    recipe = SlopeRecipe(order=SlopeOrder.IMAGES)
    instrument = replace(instrument, slopes=recipe)
    model = RtcInteractionModel(instrument, modal_basis(instrument))
    matrix = np.asarray(model.interaction_matrix(ALPHA))
    matrix = matrix if columns is None else matrix[:, list(columns)]
    # A fixed seed: the tutorials print the numbers of these files.
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


def _write_papyrus(folder: Path) -> None:
    """Write files like PAPYRUS's: camera of 240 x 240 pixels, nine modes, M2C, mask."""
    instrument = load_instrument("papyrus")
    centres = ((53, 53), (50, 183), (186, 55), (182, 187))
    frames, lit = _compute_frames(instrument, MODES, centres, 240, 2)
    listed = "_".join(str(mode) for mode in MODES)
    np.save(folder / f"int_mat_{listed}.npy", frames.reshape(len(MODES), -1).T)
    basis: Any = modal_basis(instrument)  # of an analytic mirror: it has actuators
    np.save(folder / "M2C.npy", basis.mode_to_actuator)
    np.save(folder / "valid_pixel.npy", lit)


def _write_cacao(folder: Path) -> None:
    """Write a ``conf`` folder: response of a mirror of 12 x 12 actuators on 64 x 64 pixels."""
    zonal, modal = (_described(f'{CACAO}basis = "{basis}"\n') for basis in ("zonal", "KL"))
    positions = zonal.analytic_mirror.positions_m
    frames, lit = _compute_frames(zonal, None, ((17, 17), (17, 47), (47, 17), (47, 47)), 64, 1)
    # cacao lists actuators row by row over the whole grid.
    column, row = np.rint(positions / zonal.analytic_mirror.pitch_m + 5.5).astype(int).T
    cube, mask = np.zeros((144, 64, 64), np.float32), np.zeros((12, 12), np.float32)
    # The sum of a frame of cacao is 1, and a command of 1 moves the mirror by a micrometre.
    cube[row * 12 + column] = frames * 4.0 / lit.sum() * 2e-6
    mask[row, column] = 1.0
    strokes: Any = modal_basis(modal)  # of an analytic mirror: it has actuators
    modes = np.zeros((MODES_CACAO, 12, 12), np.float32)
    modes[:, row, column] = strokes.mode_to_actuator[:, :MODES_CACAO].T
    fits.writeto(folder / "zrespM-H.fits", cube, overwrite=True)
    fits.writeto(folder / "wfsref.fits", (lit / lit.sum()).astype(np.float32), overwrite=True)
    fits.writeto(folder / "dmmask.fits", mask, overwrite=True)
    fits.writeto(folder / "CMmodesDM.fits", modes, overwrite=True)
    (folder / "cacaovars.bash").write_text(CACAO_VARIABLES)


def _described(text: str) -> Instrument:
    """Return an instrument of which there is no file; it is read from a file only."""
    with NamedTemporaryFile("w", suffix=".toml") as file:
        file.write(text)
        file.flush()
        return load_instrument(file.name)


def _copy(pattern: str, folder: Path) -> None:
    for path in sorted((Path(__file__).parent / "data").glob(pattern)):
        shutil.copyfile(path, folder / path.name)


_SAMPLES: dict[str, Callable[[Path], None]] = {
    "oopao": partial(_copy, "oopao-pyramid.npz"),
    "specula": partial(_copy, "specula-*.fits"),
    "synim": partial(_copy, "synim-*.fits"),
    "papyrus": _write_papyrus,
    "cacao": _write_cacao,
}


def main(arguments: Sequence[str] | None = None) -> None:
    """Write the files of the sample that the command line names."""
    parser = argparse.ArgumentParser(prog="python -m pyrcal.samples", description=__doc__)
    parser.add_argument("name", choices=_SAMPLES, help="sample")
    parser.add_argument("folder", type=Path, help="folder of the files; made if necessary")
    options = parser.parse_args(arguments)
    options.folder.mkdir(parents=True, exist_ok=True)
    _SAMPLES[options.name](options.folder)


if __name__ == "__main__":
    main()

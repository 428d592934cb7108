"""Fit α from objects of OOPAO, and close OOPAO's loop with pyrcal's reconstructor.

Needs OOPAO and pyrcal in one environment: ``python -m examples.oopao var/oopao``. A pyramid is
calibrated, the mirror is moved by 0.3 subaperture, and the loop is closed with three
reconstructors: the one from before the move, OOPAO's own measured again, and pyrcal's.
"""

import argparse
import subprocess
import sys
from pathlib import Path

import h5py
import numpy as np
from OOPAO.Atmosphere import Atmosphere
from OOPAO.calibration.compute_KL_modal_basis import compute_KL_basis
from OOPAO.calibration.InteractionMatrix import InteractionMatrix
from OOPAO.DeformableMirror import DeformableMirror
from OOPAO.MisRegistration import MisRegistration
from OOPAO.Pyramid import Pyramid
from OOPAO.Source import Source
from OOPAO.Telescope import Telescope

import pyrcal

N_SUBAPERTURES, N_MODES, GAIN, STROKE_M = 16, 150, 0.5, 1e-9


def build():
    tel = Telescope(
        resolution=6 * N_SUBAPERTURES, diameter=4.0, samplingTime=1e-3, centralObstruction=0.2
    )
    ngs = Source("I", magnitude=6)
    ngs * tel
    atm = Atmosphere(
        telescope=tel,
        r0=0.15,
        L0=25.0,
        windSpeed=[10.0],
        fractionalR0=[1.0],
        windDirection=[30.0],
        altitude=[0.0],
    )
    atm.initializeAtmosphere(tel)
    dm = DeformableMirror(telescope=tel, nSubap=N_SUBAPERTURES)
    wfs = Pyramid(
        nSubap=N_SUBAPERTURES, telescope=tel, lightRatio=0.5, modulation=3.0, n_pix_separation=4
    )
    return tel, ngs, atm, dm, wfs


def alpha_of(tel, dm, wfs, calib, modes_to_commands, folder):
    """Return the fit of an interaction matrix of OOPAO. A user of OOPAO needs no more than this."""
    saved = pyrcal.from_oopao(tel, dm, wfs, calib, modes_to_commands).save(folder)
    instrument = pyrcal.load_instrument(saved.instrument)
    return pyrcal.fit_file(instrument, saved.matrix, pyrcal.FitOptions()).fit


def reconstructor(folder):
    """Return pyrcal's reconstructor ``(n_modes, n_slopes)`` at the fitted registration."""
    for words in (
        ["fit", "instrument.toml", "matrix.h5", "--output", "fit.h5"],
        ["reconstruct", "instrument.toml", "fit.h5", "--modes", N_MODES, "--output", "cm.h5"],
    ):
        command = [sys.executable, "-m", "pyrcal", *map(str, words)]
        subprocess.run(command, cwd=folder, check=True, stdout=subprocess.DEVNULL)
    with h5py.File(folder / "cm.h5") as file:
        return file["reconstructor"][...]


def residual_nm(tel, ngs, atm, dm, wfs, modal_reconstructor, modes_to_commands, n_frames):
    """Return the residual wavefront of a loop, nm RMS over the second half of the frames."""
    rng = np.random.default_rng(1)
    atm.generateNewPhaseScreen(seed=int(rng.integers(1 << 30)))
    dm.coefs = 0.0
    ngs * tel * dm * wfs
    signal, left = wfs.signal, []
    for _ in range(n_frames):
        atm.update()
        ngs**atm * tel * dm * wfs
        left.append(np.std(ngs.OPD[tel.pupil == 1]) * 1e9)
        # one frame of delay: the command uses the slopes of the frame before
        dm.coefs = dm.coefs - GAIN * modes_to_commands @ modal_reconstructor @ signal
        signal = wfs.signal
    return float(np.sqrt(np.mean(np.square(left[n_frames // 2 :]))))


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--frames", type=int, default=200)
    given = parser.parse_args()
    tel, ngs, atm, dm, wfs = build()
    modes_to_commands = compute_KL_basis(tel, atm, dm)[:, :N_MODES]
    calib = InteractionMatrix(
        ngs, tel, dm, wfs, modes_to_commands, stroke=STROKE_M, single_pass=False
    )
    before = alpha_of(tel, dm, wfs, calib, modes_to_commands, given.folder / "before")
    print("before:", before.alpha, before.verdict)

    moved = MisRegistration()
    moved.shiftX = 0.3 * tel.D / N_SUBAPERTURES
    dm = dm.apply_mis_registration(moved)
    again = InteractionMatrix(
        ngs, tel, dm, wfs, modes_to_commands, stroke=STROKE_M, single_pass=False
    )
    after = alpha_of(tel, dm, wfs, again, modes_to_commands, given.folder / "moved")
    print("moved: ", after.alpha, after.verdict)
    print("OOPAO: ", pyrcal.to_oopao(after.alpha, tel, wfs))

    matrices = {
        "before": calib.M,
        "OOPAO's own": again.M,
        "pyrcal's": reconstructor(given.folder / "moved"),
    }
    for name, matrix in matrices.items():
        left = residual_nm(tel, ngs, atm, dm, wfs, matrix, modes_to_commands, given.frames)
        print(f"{name}: {left:.1f} nm")


if __name__ == "__main__":
    main()

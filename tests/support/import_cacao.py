"""What tests of several modules share of unit.fitting.test_import_cacao."""

from __future__ import annotations

import numpy as np
from astropy.io import fits

from tests.support.discs import four_discs

N_PX, RADIUS_PX = 64, 14.0


CENTRES = [(15.5, 16.0), (15.8, 48.2), (47.6, 15.7), (48.0, 47.9)]


LIGHT = four_discs(N_PX, CENTRES, 2 * RADIUS_PX, 6.0)


CUBE = np.random.default_rng(1).normal(size=(12, N_PX, N_PX)).astype(np.float32) * LIGHT


ANGLES = 2 * np.pi * np.arange(12) / 12


PLACES = np.column_stack([np.arange(12), 0.8 * np.cos(ANGLES), 0.8 * np.sin(ANGLES)])


VARIABLES = """
export CACAO_LOOPNAME="bench"
export CACAO_DMxsize="{x}" # + TT
export CACAO_DMysize="{y}"
export CACAO_DMSPATIAL="{spatial}"
export CACAO_WFSSTREAM="{stream}"    # Hardware stream
export CACAO_WFSSTREAM_PROCESSED="{processed}"
"""


def compressed(path, values):
    fits.HDUList([fits.PrimaryHDU(), fits.CompImageHDU(values)]).writeto(path)


def a_list_of_actuators(folder):
    """An example folder whose response is of camera pixels, whose mirror is a list."""
    compressed(folder / "respM.fits.fz", CUBE.astype(np.float32))
    fits.writeto(folder / "WFSref.fits.gz", LIGHT.astype(np.float32))
    fits.writeto(folder / "wfsdark.fits", np.ones((N_PX, N_PX), np.float32))
    (folder / "cacaovars.bash").write_text(
        VARIABLES.format(x=12, y=1, spatial=0, stream="camera", processed="OFF")
    )


def a_grid(folder, *, spatial="1"):
    """An example folder with maps of slopes ``(n, 2n)`` of a mirror of 4 x 4 actuators."""
    rows, columns = np.mgrid[:6, :6] - 2.5
    valid = np.hypot(rows, columns) < 3.0
    maps = np.random.default_rng(2).normal(size=(16, 6, 12)) * np.hstack([valid, valid])
    maps[5] = 0.0
    fits.writeto(folder / "loop.zrespM.fits", maps.astype(np.float32))
    fits.writeto(folder / "wfsmask.fits", np.hstack([valid, valid]).astype(np.float32))
    (folder / "cacaovars.loop.bash").write_text(
        VARIABLES.format(x=4, y=4, spatial=spatial, stream="shwfs_slopes", processed="ON")
    )
    return maps, valid

"""What tests of several modules share of unit.cacao.test_calibration."""

from __future__ import annotations

import numpy as np

from cacao_bridge.calibration import Calibration
from cacao_bridge.settings import Settings
from cacao_bridge.streams import Stream, create, path_of
from pyrcal.rtc.identity import Identity, Reconstructor
from service.wire import Manifest, layout_of

N_SLOPES, N_MODES, SHAPE = 4, 5, (2, 3)


INDEX = np.array([0, 2, 3, 5])


UNIT = 1e-6


IDENTITY = Identity(system="small", basis_id="b", config_id="c")


def settings_in(folder, interlock="operator"):
    np.save(folder / "modes.npy", np.arange(N_MODES * 6, dtype=np.float64).reshape(N_MODES, 2, 3))
    np.save(folder / "index.npy", INDEX)
    return Settings.model_validate(
        {
            "wire": {"system": "small", "basis_id": "b", "config_id": "c"},
            "streams": {"directory": str(folder)},
            "loop": {
                "frame_rate_hz": 500.0,
                "delay_frames": 2.0,
                "n_slopes": N_SLOPES,
                "n_modes": N_MODES,
                "metre_per_unit": UNIT,
            },
            "calibration": {
                "folder": str(folder / "matrices"),
                "dm_modes": str(folder / "modes.npy"),
                "slopes_index": str(folder / "index.npy"),
                "interlock": interlock,
            },
        }
    )


def matrix(name, seed, rows=3):
    numbers = np.random.default_rng(seed).normal(size=(rows, N_SLOPES)).astype(np.float32)
    manifest = Manifest(
        id=name,
        layout=layout_of(numbers, 1000),
        alpha=None,
        sigma=None,
        im_id="im-1",
        parent="p",
        basis_id="b",
        config_id="c",
        system="small",
        created_ns=5,
    )
    return Reconstructor(manifest=manifest, matrix=numbers)


def begun(settings, folder):
    """cacao runs with slices of its own, in process 100."""
    create(path_of("aol1_modesWFS", str(folder)), np.ones((3, *SHAPE), np.float32), {})
    calibration = Calibration(settings, IDENTITY)
    own = calibration.look(100, SHAPE)
    assert own is not None
    assert own.startswith("own-")
    np.testing.assert_allclose(calibration.in_use.matrix, np.full((3, 4), UNIT))
    return calibration, own


def in_stream(folder, name="aol1_modesWFS"):
    return Stream(path_of(name, str(folder)))

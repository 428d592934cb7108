"""Bring a bundle into cacao as one piece, and what was there before back as one."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np

from cacao_bridge.calibration import keep, known, order
from cacao_bridge.parts import Parts
from cacao_bridge.settings import Settings, load_index, load_modes
from pyrcal.rtc.identity import Identity, Reconstructor
from service.errors import ConfigurationError
from service.files.bundle import RECONSTRUCTOR, Place, read_bundle, why_not
from service.wire import validate_id


def apply(settings: Settings, path: Path) -> str:
    """Have the bridge bring a bundle into cacao, all of it or nothing; return its id.

    Raises
    ------
    MatrixError
        If it is no bundle, or not as it was written.
    ConfigurationError
        If it does not fit this loop; nothing is changed then.
    StreamError
        If a stream that it needs is not there, or has another size.
    """
    bundle = read_bundle(path)
    name = validate_id(bundle.id, f"the bundle {path}")
    index, modes, wire = load_index(settings), load_modes(settings), settings.wire
    parts = Parts(settings, index)
    place = Place(
        system=wire.system,
        config_id=wire.config_id,
        n_slopes=len(index),
        modes=modes.reshape(len(modes), -1),
        takes=parts.takes,
    )
    why = why_not(bundle, place)
    if why:
        hint = " ([streams] gains and [loop] gain, [streams] reference)" * ("no place" in why)
        raise ConfigurationError(f"{path}: {why}{hint}; nothing was changed")
    folder = Path(settings.calibration.folder)
    if name == known(folder)["in_use"]:
        raise ConfigurationError(f"{path}: {name} is in use already; nothing was changed")
    matrix = bundle.arrays[RECONSTRUCTOR].astype(np.float32)
    kept = folder / f"{name}.npy"
    if kept.exists() and not np.array_equal(np.load(kept, allow_pickle=False), matrix):
        raise ConfigurationError(
            f"{path}: {folder} has other numbers under {name}: ids are never reused; nothing was "
            "changed"
        )
    # Parts before the matrix: the order comes last, so that a program that ends in between has
    # changed nothing.
    parts.keep_of(name, bundle)
    if not kept.with_suffix(".json").exists():  # the service's own sources say more
        identity = Identity(system=wire.system, basis_id=wire.basis_id, config_id=wire.config_id)
        keep(folder, Reconstructor.own(name, matrix, identity, created_ns=time.time_ns()))
    order(folder, name)
    return name


def roll_back(settings: Settings) -> str:
    """Have the bridge bring back what was in use before, all of it; return its id.

    Raises
    ------
    ConfigurationError
        If nothing was.
    """
    folder = Path(settings.calibration.folder)
    before = known(folder).get("before")
    if before is None:
        raise ConfigurationError(f"{folder}: found no matrix before the one in use")
    order(folder, before)
    return str(before)

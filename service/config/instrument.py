"""The instrument file: from TOML to ``service.model.instrument.Instrument``."""

from __future__ import annotations

from importlib import resources
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from service.config import layouts
from service.config.datasets import read_dataset
from service.config.instrument_schema import (
    InstrumentFile,
    MirrorTable,
    OrientationTable,
    WfsTable,
)
from service.config.strict import Place, in_file, read_toml, refuse, validated
from service.errors import ConfigurationError
from service.model.instrument import (
    Influence,
    Instrument,
    KarhunenLoeve,
    Mirror,
    Pyramid,
    Stop,
)

_NOT_YET: dict[tuple[str, str], tuple[object, ...]] = {
    ("wfs", "input"): ("slopes",),
    ("wfs", "pupil_centres_px"): (),
    ("wfs", "pixels_per_subaperture"): (1,),
    ("mirror", "mode_to_actuator"): (),
    ("mirror", "basis"): ("KL",),
    ("mirror", "nominal_rotation_deg"): (0.0,),
    ("mirror", "parity"): (1,),
    ("mirror", "stroke"): ("known",),
    ("mirror", "modes"): (),
    ("mirror", "modes_pitch_m"): (),
    ("mirror", "modes_kind"): (),
    ("mirror", "influence_functions"): (),
    ("slopes", "order"): ("xy",),
    ("slopes", "orientation"): (None, OrientationTable()),
    ("slopes", "normalisation"): ("global",),
    ("loop", "frame_rate_hz"): (),
    ("loop", "delay_frames"): (),
    ("loop", "n_controlled"): (),
}
"""Keys of the format that are not honoured yet, and the values that ask for nothing more."""

_LAYOUT_KEYS = {
    "rings": {"first_ring", "last_ring", "pitch_m"},
    "grid": {"n_across", "pitch_m", "diameter_m"},
    "positions": {"positions", "pitch_m"},
}


class _Source(NamedTuple):
    folder: Path
    """What file references are relative to."""

    place: Place


def load_instrument(name_or_path: str | Path) -> Instrument:
    """Return the instrument that a packaged name (``flao-lbt``) or a TOML file describes.

    Anything that has a folder or ends in ``.toml`` is a path; references to HDF5 datasets in it
    (``mask.h5:/valid_subapertures``) are relative to the file.

    Raises
    ------
    ConfigurationError
        One line with the file and the key: unknown, missing, of the wrong type, out of range, or
        not supported by this version.
    """
    path = Path(name_or_path)
    if path.suffix == ".toml" or path.name != str(name_or_path):
        return _read(path)
    packaged = resources.files("service") / "instruments"
    resource = packaged / f"{name_or_path}.toml"
    if not resource.is_file():
        names = sorted(Path(r.name).stem for r in packaged.iterdir() if r.name.endswith(".toml"))
        raise ConfigurationError(
            f"instrument {name_or_path}: neither a packaged name ({', '.join(names)}) "
            "nor the path of a .toml file"
        )
    with resources.as_file(resource) as path:
        return _read(path)


def _read(path: Path) -> Instrument:
    source = _Source(path.parent, in_file(path))
    data = read_toml(path)
    tables = validated(InstrumentFile, data, source.place)
    _refuse_unsupported(tables, source)
    mirror = _mirror(tables.mirror, source)
    n_max = len(mirror.positions_m) - 1
    if tables.modes.n_modes > n_max:
        refuse(
            source.place(("modes", "n_modes")),
            str(tables.modes.n_modes),
            f"at most {n_max}: {n_max + 1} actuators make {n_max} modes without piston",
        )
    about = tables.instrument
    return Instrument(
        name=about.name,
        diameter_m=about.diameter_m,
        obscuration_ratio=about.obscuration_ratio,
        stop=Stop(about.stop),
        double_pass=about.double_pass,
        wfs=_pyramid(tables.wfs, source),
        mirror=mirror,
        modes=KarhunenLoeve(**tables.modes.model_dump()),
        basis_id=about.basis_id,
        config_id=about.config_id,
    )


def _refuse_unsupported(tables: InstrumentFile, source: _Source) -> None:
    for (section, key), harmless in _NOT_YET.items():
        table = getattr(tables, section)
        if key not in table.model_fields_set or getattr(table, key) in harmless:
            continue
        only = f" (only {harmless[0]!r})" if harmless and harmless[0] is not None else ""
        raise ConfigurationError(
            f"{source.place((section, key))}: not supported by this version{only}"
        )


def _pyramid(table: WfsTable, source: _Source) -> Pyramid:
    diameter = table.pupil_diameter_subap or float(table.n_subapertures)
    if table.pupil_separation_subap < diameter:
        refuse(
            source.place(("wfs", "pupil_separation_subap")),
            f"{table.pupil_separation_subap:g}",
            f"at least the pupil's diameter, {diameter:g} subapertures: the images would overlap",
        )
    mask = None
    if table.valid_subapertures != "auto":
        if "flux_threshold" in table.model_fields_set:
            raise ConfigurationError(
                f"{source.place(('wfs', 'flux_threshold'))}: has no meaning beside a mask file "
                "(wfs.valid_subapertures): remove one of the two"
            )
        mask = _mask(table, source)
    return Pyramid(
        n_subapertures=table.n_subapertures,
        wavelength_m=table.wavelength_m,
        modulation_lambda_over_d=table.modulation_lambda_over_d,
        pupil_separation_subap=table.pupil_separation_subap,
        pupil_diameter_subap=table.pupil_diameter_subap,
        flux_threshold=table.flux_threshold,
        valid_subapertures=mask,
    )


def _mask(table: WfsTable, source: _Source) -> NDArray[np.bool_]:
    where = source.place(("wfs", "valid_subapertures"))
    values = read_dataset(table.valid_subapertures, source.folder, where)
    n = table.n_subapertures
    if values.shape != (n, n):
        refuse(where, f"shape {values.shape}", f"(n_subapertures, n_subapertures) = ({n}, {n})")
    if not np.isin(values, (0, 1)).all():
        refuse(where, "values other than 0 and 1", "a mask, 1 where a subaperture is valid")
    if not values.any():
        refuse(where, "no valid subaperture", "at least one")
    return values.astype(bool)


def _mirror(table: MirrorTable, source: _Source) -> Mirror:
    _check_mirror_keys(table, source)
    positions = _positions(table, source)
    pair = layouts.coincident(positions)
    if pair is not None:
        refuse(
            source.place(("mirror",)),
            f"actuators {pair[0]} and {pair[1]} in the same place",
            "every actuator in a place of its own",
        )
    return Mirror(
        positions_m=positions,
        pitch_m=table.pitch_m or layouts.typical_pitch(positions),
        influence=Influence(table.influence),
        coupling=table.coupling,
    )


def _check_mirror_keys(table: MirrorTable, source: _Source) -> None:
    if table.layout is None:
        refuse(
            source.place(("mirror",)), "none of them", "one of layout, modes, influence_functions"
        )
    foreign = set().union(*_LAYOUT_KEYS.values()) - _LAYOUT_KEYS[table.layout]
    for key in sorted(foreign & table.model_fields_set):
        owners = [f'"{name}"' for name, keys in _LAYOUT_KEYS.items() if key in keys]
        raise ConfigurationError(
            f"{source.place(('mirror', key))}: belongs to layout = {' or '.join(owners)}, "
            f'found layout = "{table.layout}"'
        )
    if "coupling" in table.model_fields_set and table.influence != "gaussian":
        raise ConfigurationError(
            f"{source.place(('mirror', 'coupling'))}: belongs to influence = "
            f'"gaussian", found influence = "{table.influence}"'
        )


def _positions(table: MirrorTable, source: _Source) -> NDArray[np.float64]:
    if table.layout == "positions":
        return _listed_positions(table, source)
    if table.layout == "grid":
        n_across, pitch_m, diameter_m = _mandatory(
            table, ("n_across", "pitch_m", "diameter_m"), source
        )
        positions = layouts.grid(n_across, pitch_m, diameter_m)
    else:
        if table.last_ring < table.first_ring:
            refuse(
                source.place(("mirror", "last_ring")),
                str(table.last_ring),
                f"at least first_ring = {table.first_ring}",
            )
        positions = layouts.rings(table.first_ring, table.last_ring, table.pitch_m or 0.30)
    _check_number(len(positions), source.place(("mirror",)))
    return positions


def _listed_positions(table: MirrorTable, source: _Source) -> NDArray[np.float64]:
    where = source.place(("mirror", "positions"))
    (reference,) = _mandatory(table, ("positions",), source)
    values = read_dataset(reference, source.folder, where)
    if values.ndim != 2 or values.shape[1] != 2:
        refuse(where, f"shape {values.shape}", "(n_actuators, 2), x and y in metres")
    if not np.isfinite(values).all():
        refuse(where, "a position that is not finite", "metres in the pupil plane")
    _check_number(len(values), where)
    return values.astype(np.float64)


def _mandatory(table: MirrorTable, keys: tuple[str, ...], source: _Source) -> tuple[Any, ...]:
    for key in keys:
        if getattr(table, key) is None:
            raise ConfigurationError(
                f"{source.place(('mirror', key))}: missing, "
                f'layout = "{table.layout}" needs {", ".join(keys)}'
            )
    return tuple(getattr(table, key) for key in keys)


def _check_number(n_actuators: int, where: str) -> None:
    if n_actuators < 4:
        refuse(where, f"{n_actuators} actuators", "at least 4: tip, tilt and something to correct")

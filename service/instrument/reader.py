"""Read an instrument file, with its pupil, into ``service.model.instrument.Instrument``."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from service.errors import ConfigurationError, ModelError
from service.files.toml import read_dataset, refuse, refuse_all
from service.instrument import schema as schema
from service.instrument.mirrors import Pupil, own_modes, read_mirror
from service.instrument.paths import and_sensor_mode, packaged_file
from service.instrument.schema import AboutTable, LawTable, Section, law_of, remarks_on_law
from service.model.aperture import check_mask
from service.model.instrument import (
    Instrument,
    Mirror,
    PupilMap,
    SensorDescription,
    SensorMode,
    TabulatedModes,
)
from service.model.kinds import KarhunenLoeve, LoopFacts
from service.model.sensors.kind import SensorKind
from service.model.slopes import Orientation, SlopeRecipe

_LIT_FRACTION = 0.5
"""Illumination of a point, of the largest, above which it belongs to the pupil."""

_WIDTHS = (0.8, 1.1)
"""Plausible width of a map's light divided by ``diameter_m``, along its longer axis; the corners of
a segmented pupil extend beyond it."""

_MIN_AXIS_RATIO = 0.5
"""Smallest ratio of the axes of an elliptical pupil; off-axis telescopes have 0.7 and more."""

_OFF_CENTRE = 0.05
"""Tolerated distance of a map's light from the middle of its array, as a fraction of the diameter.
"""


def read_pupil(file: Section[AboutTable], subaperture_m: float) -> PupilMap | None:
    """Return the pupil's map; None: it is a ring, perhaps with arms before it.

    Raises
    ------
    ConfigurationError
        One line: a key that contradicts another, or a map that is no pupil of this telescope.
    """
    about = file.table
    if (about.spiders_m is None) != (not about.spiders_deg):
        missing, other = ("spiders_m", "spiders_deg")
        if about.spiders_m is not None:
            missing, other = other, missing
        raise ConfigurationError(f"{file.where(missing)}: missing; instrument.{other} requires it")
    if about.pupil is None:
        if about.pupil_pitch_m is not None:
            raise ConfigurationError(
                f"{file.where('pupil_pitch_m')}: has no meaning without instrument.pupil"
            )
        return None
    file.refuse_useless(("obscuration_ratio", "spiders_m"), "together with instrument.pupil")
    return _read_pupil_map(file, subaperture_m)


def _read_pupil_map(file: Section[AboutTable], subaperture_m: float) -> PupilMap:
    where, diameter_m = file.where("pupil"), file.table.diameter_m
    lit = np.asarray(file.array("pupil"), dtype=np.float64)
    if lit.ndim != 2 or min(lit.shape) < 2:
        refuse(where, f"shape {lit.shape}", "(ny, nx), a map of the pupil")
    if not np.isfinite(lit).all() or lit.min() < 0.0 or lit.max() > 1.0:
        refuse(where, "values that are not 0 to 1", "the share of each point that is lit")
    # Extent of the light: a map in another unit or off its centre shows there.
    rows, columns = (np.flatnonzero((lit > _LIT_FRACTION).any(axis=axis)) for axis in (1, 0))
    if not rows.size:
        refuse(where, "no lit point", f"a pupil of {diameter_m:g} m")
    pitch_m = file.table.pupil_pitch_m or diameter_m / max(lit.shape)
    if pitch_m > subaperture_m:
        file.refuse(
            "pupil_pitch_m",
            f"{pitch_m:.3g} m between points",
            f"at most a subaperture, {subaperture_m:.3g} m",
        )
    x_m, y_m = ((place[-1] - place[0] + 1) * pitch_m for place in (columns, rows))
    longer_m, ratio = max(x_m, y_m), min(x_m, y_m) / max(x_m, y_m)
    if not _WIDTHS[0] <= longer_m / diameter_m <= _WIDTHS[1] or ratio < _MIN_AXIS_RATIO:
        stated = file.table.pupil_pitch_m is not None
        refuse(
            where,
            f"light over {x_m:.3g} m along x and {y_m:.3g} m along y",
            f"about diameter_m = {diameter_m:g} along the longer axis and at least "
            f"{_MIN_AXIS_RATIO:g} of it along the other: {'correct' if stated else 'give'} "
            "pupil_pitch_m, metres in the pupil plane between two points",
        )
    for name, place, n in (("y", rows, lit.shape[0]), ("x", columns, lit.shape[1])):
        aside_m = ((place[0] + place[-1]) / 2 - (n - 1) / 2) * pitch_m
        if abs(aside_m) > _OFF_CENTRE * diameter_m:
            refuse(
                where,
                f"light {aside_m:+.3g} m from the centre of the array along {name}",
                "a map that is centred on the pupil",
            )
    return PupilMap(lit=lit, pitch_m=pitch_m)


def load_instrument(name_or_path: str | Path) -> Instrument:
    """Return the instrument that a packaged name (``flao-lbt``) or a TOML file describes.

    Anything that has a folder or ends in ``.toml`` is a path; references to datasets in it
    (``mask.h5:/valid_subapertures``) are relative to the file. ``soul-lbt@soul-bin2`` is in that
    mode of its sensor, without one in the first.

    Raises
    ------
    ConfigurationError
        One line with the file and the key: unknown, missing, of the wrong type, out of range, or
        in contradiction to another.
    """
    file = schema.read_instrument_file(name_or_path)
    section, kind = file.section, file.kind
    about, wfs = section(schema.AboutTable).table, section(kind.table)
    values = asdict(about)
    del values["pupil"], values["pupil_pitch_m"]
    instrument = Instrument(
        **values,
        **_made(_parts(file)),
        unknown=tuple(one for one in schema.unknown_values(kind) if one in file.unknown),
    )
    # A remark, not a refusal: light and flux threshold of a real sensor may well cut another mask.
    difference = check_mask(instrument)
    if difference is not None:
        instrument = replace(instrument, remarks=(*instrument.remarks, difference))
    whole = _in_first_mode(instrument, wfs, kind)
    _, mode = and_sensor_mode(name_or_path)
    try:
        return whole if mode is None else whole.in_mode(mode)
    except ModelError as error:
        raise ConfigurationError(f"{wfs.path}: {error}") from error


def _parts(file: schema.InstrumentFile) -> Mapping[str, Callable[[], Any]]:
    """Return how each part of an instrument is made; what one needs of another is made once."""
    section, kind = file.section, file.kind
    about, wfs = section(schema.AboutTable), section(kind.table)
    diameter_m, is_simulated = about.table.diameter_m, "fft_grid" in wfs.given
    pupil = Pupil(diameter_m, diameter_m / wfs.table.pupil_diameter, is_simulated)
    sensor = cache(lambda: _sensor(wfs, kind, pupil))
    mirror = cache(lambda: read_mirror(section(schema.MirrorTable), pupil))
    modes = cache(lambda: _modes(section(KarhunenLoeve), mirror()[0]))

    @cache
    def frames() -> object | None:
        with schema.refused_at(wfs.path, wfs.name):
            return kind.model.frames(wfs.table, wfs.given)

    return {
        "wfs": sensor,
        "mirror": lambda: mirror()[0],
        "modes": modes,
        "frames": frames,
        "law": lambda: law_of(section(LawTable).table),
        "pupil": lambda: read_pupil(about, pupil.subaperture_m),
        "slopes": lambda: _slopes(
            section(schema.SlopesTable), kind, has_frames=frames() is not None
        ),
        "loop": lambda: _loop(section(LoopFacts), modes().n_modes),
        "remarks": lambda: (
            *mirror()[1],
            *_list_assumptions(file, sensor(), mirror()[0]),
            *remarks_on_law(section(LawTable)),
        ),
    }


def _made(parts: Mapping[str, Callable[[], Any]]) -> dict[str, Any]:
    """Return the parts made, or refuse with everything that is wrong.

    Raises
    ------
    ConfigurationError
        Of the first part that cannot be made; it has the others.
    """
    made: dict[str, Any] = {}
    refused: dict[str, ConfigurationError] = {}
    # Every part is tried, so that one run shows all mistakes of a file.
    for name, make in parts.items():
        try:
            made[name] = make()
        except ConfigurationError as error:
            refused.setdefault(str(error), error)  # once, though another part needed this one
    if refused:
        refuse_all(list(refused), next(iter(refused.values())))
    return made


def _in_first_mode(
    instrument: Instrument, file: schema.Section[Any], kind: SensorKind
) -> Instrument:
    """Return the instrument with the modes of its sensor, in the first of them."""
    with schema.refused_at(file.path, file.name):
        modes = kind.model.in_modes(file.table, instrument.wfs)
    if not modes:
        return instrument
    if instrument.config_id is not None:
        raise ConfigurationError(
            f"{file.path}: instrument.config_id: has no effect together with [[wfs.mode]], each "
            "of which has its own: remove one of the two"
        )
    whole = replace(
        instrument,
        sensor_modes=tuple(
            _complete_mode(mode, mask, f"{file.where('mode')}[{k}]", file.path.parent, instrument)
            for k, (mode, mask) in enumerate(modes)
        ),
    )
    return whole.sensor_modes[0].of(whole)


def _complete_mode(
    mode: SensorMode, reference: str, where: str, folder: Path, instrument: Instrument
) -> SensorMode:
    """Return a mode with its own mask, and what it does not say of the loop as ``[loop]`` has it.

    Raises
    ------
    ConfigurationError
        If it controls more modes than there are, or its mask is missing or not its own.
    """
    loop = instrument.loop or LoopFacts()
    # What a mode does not say of its loop is as in [loop].
    n_controlled = mode.loop.n_controlled or loop.n_controlled
    rate_hz = mode.loop.frame_rate_hz or loop.frame_rate_hz
    if (n_controlled or 0) > instrument.modes.n_modes:
        expected = f"at most the {instrument.modes.n_modes} modes of the basis"
        refuse(f"{where}.n_controlled", str(n_controlled), expected)
    wfs, at = mode.wfs, f"{where}.valid_subapertures"
    if reference != "auto":
        mask = _mask(read_dataset(reference, folder, at), at, wfs.n_subapertures)
        wfs = replace(wfs, valid_subapertures=mask)
    elif mode.binning > 1 and wfs.valid_subapertures is not None:
        raise ConfigurationError(
            f"{at}: missing; a mask of the finest subapertures (wfs.valid_subapertures) says "
            "nothing of binned ones"
        )
    mode_loop = replace(loop, frame_rate_hz=rate_hz, n_controlled=n_controlled)
    return replace(mode, wfs=wfs, loop=mode_loop)


def _list_assumptions(
    file: schema.InstrumentFile, sensor: SensorDescription, mirror: Mirror | TabulatedModes
) -> Iterator[str]:
    """Yield what the file does not say, and what is taken instead."""
    wfs = file.section(file.kind.table)
    for key, text in file.kind.list_assumptions(wfs.table, wfs.given):
        yield f"{wfs.where(key)}: {text}"
    values = {f"wfs.{key}": getattr(sensor, key, None) for key in file.kind.unknown}
    values["mirror.coupling"] = mirror.shape.coupling if isinstance(mirror, Mirror) else None
    for key in sorted(file.unknown):
        taken = values.get(key)
        words = "allows for it in its uncertainty" if taken is None else f"takes {taken:g}"
        if key == "wfs.modulation_ellipse":
            words = "takes a circle"
        elif key == "wfs.static_aberration_nm":
            words = "takes a flat wavefront"
        yield (
            f"{wfs.path}: {key}: unknown; a fit of a measured matrix finds it, everything else "
            f"{words}"
        )


def packaged_instrument(name: str) -> Instrument:
    """Return the instrument of a packaged name, which is never that of a file of this machine.

    Raises
    ------
    ConfigurationError
        If none has this name.
    """
    return load_instrument(packaged_file(name))


def _modes(file: schema.Section[KarhunenLoeve], mirror: Mirror | TabulatedModes) -> KarhunenLoeve:
    """Return the turbulence, and as many modes as the user's basis or ``[modes]`` has."""
    where, own, table = file.where("n_modes"), own_modes(mirror), file.table
    if own is not None:
        if "n_modes" in file.given:
            refuse(where, f"it together with an own basis of {own} modes", "it for KL modes only")
        # The user's own basis has its number of modes; only the turbulence is read here.
        return replace(table, n_modes=own)
    n_max = len(mirror.positions_m) - 1 if isinstance(mirror, Mirror) else 0
    if "n_modes" not in file.given:
        # of the last modes the actuators make the sensor sees little, and the model says less
        return replace(table, n_modes=min(table.n_modes, 9 * n_max // 10))
    if table.n_modes > n_max:
        refuse(
            where,
            str(table.n_modes),
            f"at most {n_max}: {n_max + 1} actuators make {n_max} modes without piston",
        )
    return table


def _slopes(
    file: schema.Section[schema.SlopesTable], sensor: SensorKind, *, has_frames: bool
) -> SlopeRecipe:
    table = file.table
    if table.kind not in sensor.signals:
        file.refuse("kind", f"{table.kind} of a {sensor.name}", " or ".join(sensor.signals))
    if not sensor.normalised:
        file.refuse_useless(["normalisation"], f'with kind = "{sensor.name}"')
    if has_frames:
        why = 'with wfs.input = "frames", whose slopes are computed by the service'
        file.refuse_useless(["order"], why)
    orientation = None
    if table.orientation is not None:
        flips = table.orientation.model_dump(exclude={"sign"})
        sign_x, sign_y = table.orientation.sign
        orientation = Orientation(**flips, sign_x=sign_x, sign_y=sign_y)
    orders = table.kind.orders
    order = table.order or orders[0]
    if order not in orders:
        file.refuse("order", f'{order} with kind = "{table.kind}"', " or ".join(orders))
    return SlopeRecipe(order=order, orientation=orientation, normalisation=table.normalisation)


def _loop(file: schema.Section[LoopFacts], n_modes: int) -> LoopFacts | None:
    if not file.given:
        return None
    table = file.table
    if table.n_controlled is not None and table.n_controlled > n_modes:
        file.refuse(
            "n_controlled", str(table.n_controlled), f"at most the {n_modes} modes of the basis"
        )
    return table


def _sensor(file: schema.Section[Any], kind: SensorKind, pupil: Pupil) -> SensorDescription:
    with schema.refused_at(file.path, file.name):
        sensor = kind.model.read_sensor(file.table, file.given, pupil.subaperture_m)
    # The mask of the RTC decides if there is one: its slopes are listed by it.
    if file.table.valid_subapertures == "auto":
        return sensor
    file.refuse_useless(["flux_threshold"], "together with a mask file (wfs.valid_subapertures)")
    where = file.where("valid_subapertures")
    mask = _mask(file.array("valid_subapertures"), where, file.table.n_subapertures)
    return replace(sensor, valid_subapertures=mask)


def _mask(values: NDArray[Any], where: str, n: int) -> NDArray[np.bool_]:
    if values.shape != (n, n):
        refuse(where, f"shape {values.shape}", f"(n_subapertures, n_subapertures) = ({n}, {n})")
    if not np.isin(values, (0, 1)).all():
        refuse(where, "values other than 0 and 1", "a mask, 1 where a subaperture is valid")
    if not values.any():
        refuse(where, "no valid subaperture", "at least one")
    return values.astype(bool)

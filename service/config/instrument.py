"""From the instrument file to ``service.model.instrument.Instrument``."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, fields, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from service.config import packaged_file
from service.config.instrument_schema import (
    UNKNOWN,
    AboutTable,
    Centres,
    InstrumentFile,
    MirrorTable,
    Section,
    SlopesTable,
    WfsTable,
    read_instrument_file,
)
from service.config.mirrors import Pupil, own_modes, read_mirror
from service.config.sources import refuse
from service.errors import ConfigurationError, ModelError
from service.model.described import USUAL_SEPARATION, KarhunenLoeve, LoopFacts, PyramidNumbers
from service.model.detector_windows import by_quadrant
from service.model.instrument import (
    FrameWindows,
    Instrument,
    Mirror,
    Pyramid,
    TabulatedModes,
)
from service.model.slopes import Orientation, SlopeRecipe

_SEPARATION_TOLERANCE = 0.1

_FRAME_KEYS = ("pupil_centres_px", "pixels_per_subaperture")


def load_instrument(name_or_path: str | Path) -> Instrument:
    """Return the instrument that a packaged name (``flao-lbt``) or a TOML file describes.

    Anything that has a folder or ends in ``.toml`` is a path; references to datasets in it
    (``mask.h5:/valid_subapertures``) are relative to the file.

    Raises
    ------
    ConfigurationError
        One line with the file and the key: unknown, missing, of the wrong type, out of range, or
        in contradiction to another.
    """
    said = read_instrument_file(name_or_path)
    section = said.section
    about, wfs = section(AboutTable).said, section(WfsTable)
    pupil = Pupil(about.diameter_m, about.diameter_m / wfs.said.pupil_diameter)
    pyramid = _pyramid(wfs)
    mirror, about_mirror = read_mirror(section(MirrorTable), pupil)
    modes = _modes(section(KarhunenLoeve), mirror)
    return Instrument(
        **asdict(about),
        wfs=pyramid,
        mirror=mirror,
        modes=modes,
        slopes=_slopes(section(SlopesTable), wfs.said),
        frames=_frames(wfs),
        loop=_loop(section(LoopFacts), modes.n_modes),
        unknown=tuple(one for one in UNKNOWN if one in said.unknown),
        remarks=(*about_mirror, *_assumed(said, pyramid, mirror)),
    )


def _assumed(
    said: InstrumentFile, pyramid: Pyramid, mirror: Mirror | TabulatedModes
) -> Iterator[str]:
    """Yield what the file does not say, and what is taken instead."""
    wfs = said.section(WfsTable)
    centres = wfs.said.input == "frames" and wfs.said.pupil_centres_px is not None
    if "pupil_separation_subap" not in wfs.given and not centres:
        yield (
            f"{wfs.where('pupil_separation_subap')}: not told, taken as "
            f"{pyramid.image_separation_subap:g} ({USUAL_SEPARATION:g} pupil diameters)"
        )
    values = {
        "wfs.wavelength_m": pyramid.wavelength_m,
        "wfs.modulation_lambda_over_d": pyramid.modulation_lambda_over_d,
        "mirror.coupling": mirror.shape.coupling if isinstance(mirror, Mirror) else None,
    }
    for key in sorted(said.unknown):
        yield (
            f"{wfs.path}: {key}: unknown; a fit of a measured matrix finds it, everything else "
            f"takes {values[key]:g}"
        )


def packaged_instrument(name: str) -> Instrument:
    """Return the instrument of a packaged name, which is never that of a file of this machine.

    Raises
    ------
    ConfigurationError
        If none has this name.
    """
    return load_instrument(packaged_file(name))


def _modes(file: Section[KarhunenLoeve], mirror: Mirror | TabulatedModes) -> KarhunenLoeve:
    """Return the turbulence, and as many modes as the user's basis or ``[modes]`` has."""
    where, own, table = file.where("n_modes"), own_modes(mirror), file.said
    if own is not None:
        if "n_modes" in file.given:
            refuse(where, f"it beside a basis of its own {own} modes", "it for KL modes only")
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


def _slopes(file: Section[SlopesTable], wfs: WfsTable) -> SlopeRecipe:
    table = file.said
    if wfs.input == "frames" and "order" in file.given:
        raise ConfigurationError(
            f'{file.where("order")}: has no meaning beside wfs.input = "frames", '
            "whose slopes are made here"
        )
    orientation = None
    if table.orientation is not None:
        flips = table.orientation.model_dump(exclude={"sign"})
        sign_x, sign_y = table.orientation.sign
        orientation = Orientation(**flips, sign_x=sign_x, sign_y=sign_y)
    orders = table.kind.orders
    order = table.order or orders[0]
    if order not in orders:
        refuse(file.where("order"), f'{order} beside kind = "{table.kind}"', " or ".join(orders))
    return SlopeRecipe(order=order, orientation=orientation, normalisation=table.normalisation)


def _frames(file: Section[WfsTable]) -> FrameWindows | None:
    table = file.said
    if table.input == "slopes":
        for key in _FRAME_KEYS:
            if key in file.given and getattr(table, key) != 1:
                raise ConfigurationError(
                    f'{file.where(key)}: belongs to input = "frames", found input = "slopes"'
                )
        return None
    centres = None
    if table.pupil_centres_px is not None:
        centres = _by_quadrant(table.pupil_centres_px, file).reshape(4, 2)
    return FrameWindows(centres_px=centres, pixels_per_subaperture=table.pixels_per_subaperture)


def _by_quadrant(centres_px: Centres, file: Section[WfsTable]) -> NDArray[np.float64]:
    try:
        return by_quadrant(np.array(centres_px))
    except ModelError as error:
        raise ConfigurationError(f"{file.where('pupil_centres_px')}: {error}") from error


def _loop(file: Section[LoopFacts], n_modes: int) -> LoopFacts | None:
    if not file.given:
        return None
    table = file.said
    if table.n_controlled is not None and table.n_controlled > n_modes:
        refuse(
            file.where("n_controlled"),
            str(table.n_controlled),
            f"at most the {n_modes} modes of the basis",
        )
    return table


def _pyramid(file: Section[WfsTable]) -> Pyramid:
    table = file.said
    diameter, separation = table.pupil_diameter, _separation(file)
    if separation < diameter:
        refuse(
            file.where("pupil_separation_subap"),
            f"{separation:g}",
            f"at least the pupil's diameter, {diameter:g} subapertures: the images would overlap",
        )
    mask = None
    if table.valid_subapertures != "auto":
        if "flux_threshold" in file.given:
            raise ConfigurationError(
                f"{file.where('flux_threshold')}: has no meaning beside a mask file "
                "(wfs.valid_subapertures): remove one of the two"
            )
        mask = _mask(file)
    optics = {field.name: getattr(table, field.name) for field in fields(PyramidNumbers)}
    return Pyramid(**optics | {"pupil_separation_subap": separation}, valid_subapertures=mask)


def _separation(file: Section[WfsTable]) -> float:
    """Return the images' distance: as given, or as the images on the frames lie."""
    table = file.said
    stated = table.image_separation_subap
    if table.pupil_centres_px is None or table.input == "slopes":
        return stated
    centres = _by_quadrant(table.pupil_centres_px, file)
    sides = (centres[1, :, 0] - centres[0, :, 0], centres[:, 1, 1] - centres[:, 0, 1])
    measured = float(np.mean(sides)) / table.pixels_per_subaperture
    if "pupil_separation_subap" not in file.given:
        return measured
    if abs(measured / stated - 1.0) > _SEPARATION_TOLERANCE:
        refuse(
            file.where("pupil_separation_subap"),
            f"{stated:g}",
            f"about {measured:.1f}, the distance of wfs.pupil_centres_px",
        )
    return stated


def _mask(file: Section[WfsTable]) -> NDArray[np.bool_]:
    where, n = file.where("valid_subapertures"), file.said.n_subapertures
    values = file.array("valid_subapertures")
    if values.shape != (n, n):
        refuse(where, f"shape {values.shape}", f"(n_subapertures, n_subapertures) = ({n}, {n})")
    if not np.isin(values, (0, 1)).all():
        refuse(where, "values other than 0 and 1", "a mask, 1 where a subaperture is valid")
    if not values.any():
        refuse(where, "no valid subaperture", "at least one")
    return values.astype(bool)

"""Fits of matrices drawn at random, by four codes and the simulator, against their truth.

Each seed is another registration of a bench of 12 subapertures and 13 x 13 Gaussian actuators, of
which every second of 40 KL modes is pushed and pulled: by an FFT pyramid that shares no code with
the model (``fft``), or by OOPAO, HCIPy or SPECULA with their own optics, masks, slopes and axes. A
condition displaces the pupil images or the actuators, or adds noise. ``diffractive`` is the
simulated telescope of ``tests/data/tiny`` with its usual imperfections. Both kinds of stop in turn.

``python -m pyrcal_studies.drawn_fits images --codes fft oopao --rms 0.05 --draws 40`` appends a
line of JSON for each fit to ``var/drawn``; fits that are there already are not made again. With
``--table`` it prints the tables of all that is there. Campaigns: images, actuators,
noise, modulations, far (registrations 2.5 times as far from nominal), moving (the mirror's image
moves from the first column to the last), mistold (instrument files with one thing wrong), stated
(the same behind a spider, with all that a file states), small (the telescope).
"""

from __future__ import annotations

import argparse
import hashlib
import json
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, replace
from functools import cache
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from pyrcal.fitting.fit_file import fit
from pyrcal.fitting.fitted import Fit
from pyrcal.fitting.matrix import FitOptions, fit_matrix
from pyrcal_studies.campaign.rows import RowFile
from pyrcal_studies.fft_pyramid import slopes_of
from pyrcal_studies.image_offsets import (
    TRUTH,
    N,
    as_told,
    basis,
    bench,
    camera,
    displacements,
    filmed,
    model_of,
)
from pyrcal_studies.peers import LISTINGS, ROOT, environment, mirror_points, variables
from pyrcal_studies.peers_pushpull import JOB, Bench, Measured, read_product, write_job
from service.estimation.reference import Reference
from service.instrument import load_instrument
from service.model.instrument import Instrument, PupilMap
from service.model.kinds import Influence, InfluenceShape, Normalisation, SlopeOrder, Stop
from service.model.misregistration import BOUNDARY_SCALE, Misregistration, rotation
from service.model.modes import karhunen_loeve_basis
from service.model.pupil import instrument_pupil, valid_subapertures
from service.model.sensors.pyramid.description import FrameWindows
from service.model.slopes import Orientation, SlopeRecipe
from sim_rtc.telescope.mirror import misplace_actuators
from tests.data.tiny.make import push_pull

Array = NDArray[Any]

FOLDER = ROOT / "var" / "drawn"
CODES = ("fft", "oopao", "hcipy", "specula")
TINY = ROOT / "tests" / "data" / "tiny" / "tiny.toml"

EVERY = 2
"""Every second mode of the bench is pushed."""

MAX_SIGMA = 3.0
SEPARATION = 18
"""Between the centres of neighbouring images of a peer, subapertures; the FFT pyramid has 17."""

TINY_MODES, TINY_NOISE = 40, 5e-5
"""Modes of the simulated telescope, and RMS of a slope averaged over all pushes of one."""


@cache
def strokes(moving: str | None = None) -> Array:
    """Return the modes that are pushed as strokes of the actuators ``(n_actuators, n_modes)``.

    The image of a mirror that moves is met by modes, or by single actuators.
    """
    if moving in POKES:
        return np.eye(len(bench(Stop.TELESCOPE).analytic_mirror.positions_m))
    return karhunen_loeve_basis(bench(Stop.MIRROR)).mode_to_actuator[:, ::EVERY]


POKES = ("actuators row by row", "actuators in random order")
MOVEMENT = np.array([0.05, 0.0, np.deg2rad(0.2), 0.0])
"""Of α from the first column to the last: x, y in subapertures, rotation, magnification."""

FAR = 2.5
"""Registrations of the campaign ``far`` over those of the others; magnification is the same."""


_POINTS = 80
"""Across a peer's pupil: OOPAO's metre is longer by one in so many."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Mistelling:
    """One thing that a user says and that is not so."""

    words: str
    tell: Callable[[Instrument], Instrument]
    """From the instrument as it is to the one that is told."""

    image: tuple[tuple[float, float], tuple[float, float]] = ((1.0, 0.0), (0.0, 1.0))
    """What the told coordinates of actuators are of the true ones, but for their size."""

    size: float = 1.0
    """How much larger the mirror is told to be."""


def _coupling(value: float) -> Callable[[Instrument], Instrument]:
    return lambda about: replace(
        about,
        mirror=replace(
            about.analytic_mirror,
            shape=InfluenceShape(influence=Influence.GAUSSIAN, coupling=value),
        ),
    )


def _modulation(radius: float) -> Callable[[Instrument], Instrument]:
    return lambda about: replace(about, wfs=replace(about.wfs, modulation_lambda_over_d=radius))


def _other_wavelength(about: Instrument) -> Instrument:
    return replace(about, wfs=replace(about.wfs, wavelength_m=900e-9))


def _sized(factor: float) -> Callable[[Instrument], Instrument]:
    def tell(about: Instrument) -> Instrument:
        mirror = about.analytic_mirror
        return replace(
            about,
            mirror=replace(
                mirror, positions_m=mirror.positions_m * factor, pitch_m=mirror.pitch_m * factor
            ),
        )

    return tell


def _other_stop(about: Instrument) -> Instrument:
    return replace(about, stop=Stop.MIRROR if about.stop is Stop.TELESCOPE else Stop.TELESCOPE)


def _other_order(about: Instrument) -> Instrument:
    order = SlopeOrder.YX if about.slopes.order is SlopeOrder.XY else SlopeOrder.XY
    return replace(about, slopes=replace(about.slopes, order=order))


def _mirrored(about: Instrument) -> Instrument:
    mirror = about.analytic_mirror
    return replace(about, mirror=replace(mirror, positions_m=mirror.positions_m * [-1.0, 1.0]))


def _diameter(factor: float) -> Callable[[Instrument], Instrument]:
    return lambda about: replace(about, diameter_m=about.diameter_m * factor)


def _pupil(factor: float) -> Callable[[Instrument], Instrument]:
    return lambda about: replace(
        about,
        wfs=replace(about.wfs, pupil_diameter_subap=about.wfs.pupil_diameter * factor),
    )


ARM_M, ARMS_DEG = 0.2, (0.0, 90.0, 180.0, 270.0)
"""Width and directions of the arms of a spider, the same in all axes that a code may have."""

MISTELLINGS = (
    Mistelling(words="coupling 0.20", tell=_coupling(0.2)),
    Mistelling(words="coupling 0.50", tell=_coupling(0.5)),
    Mistelling(words="modulation 2", tell=_modulation(2.0)),
    Mistelling(words="modulation 6", tell=_modulation(6.0)),
    Mistelling(words="the other stop", tell=_other_stop),
    Mistelling(words="pitch 5 % large", tell=_sized(1.05), size=1.05),
    Mistelling(words="wavelength 900 nm", tell=_other_wavelength),
    Mistelling(
        words="OOPAO's metre", tell=_sized(_POINTS / (_POINTS - 1)), size=_POINTS / (_POINTS - 1)
    ),
    Mistelling(words="order of slopes", tell=_other_order),
    Mistelling(words="mirror image", tell=_mirrored, image=((-1.0, 0.0), (0.0, 1.0))),
    Mistelling(words="diameter 2 % large", tell=_diameter(1.02), size=1.0 / 1.02),
    Mistelling(words="pupil image 2 % small", tell=_pupil(0.98), size=0.98),
)


def _arms(turn_deg: float, ratio: float = 1.0) -> Callable[[Instrument], Instrument]:
    angles = tuple((angle + turn_deg) % 360.0 for angle in ARMS_DEG)
    return lambda about: replace(about, spiders_m=ratio * ARM_M, spiders_deg=angles)


def _map(turn_deg: float) -> Callable[[Instrument], Instrument]:
    def tell(about: Instrument) -> Instrument:
        lit = instrument_pupil(_arms(turn_deg)(about), 8).amplitude
        pupil = PupilMap(lit=lit, pitch_m=about.subaperture_m / 8)
        return replace(about, pupil=pupil, spiders_m=None, spiders_deg=(), obscuration_ratio=0.0)

    return tell


def _hole(ratio: float) -> Callable[[Instrument], Instrument]:
    return lambda about: replace(about, obscuration_ratio=ratio)


def _on_the_grid(about: Instrument) -> Instrument:
    return as_told(about, np.zeros((2, 2, 2)))


def _listed(order: Callable[[int], Array]) -> Callable[[Instrument], Instrument]:
    """Return how a file lists the modes that were pushed, in an order of their numbers."""

    def tell(about: Instrument) -> Instrument:
        mirror = about.analytic_mirror
        listed = strokes()[:, order(strokes().shape[1])]
        return replace(about, mirror=replace(mirror, mode_to_actuator=listed))

    return tell


def _exchanged(n_modes: int) -> Array:
    order = np.arange(n_modes)
    order[[3, 7]] = order[[7, 3]]
    return order


def _without_arms(about: Instrument) -> Instrument:
    return replace(about, spiders_m=None, spiders_deg=())


def _thin_plate(about: Instrument) -> Instrument:
    shape = InfluenceShape(influence=Influence.THIN_PLATE)
    return replace(about, mirror=replace(about.analytic_mirror, shape=shape))


OUTLINES = (
    Mistelling(words="no arms", tell=_without_arms),
    Mistelling(words="arms that are not there", tell=_arms(0.0)),
    Mistelling(words="thin plate", tell=_thin_plate),
)
"""Further wrong files for ``pyrcal_studies.advice_followed``."""

ORDERS = (
    Mistelling(words="modes in reverse", tell=_listed(lambda n: np.arange(n)[::-1])),
    Mistelling(words="modes one place off", tell=_listed(lambda n: np.roll(np.arange(n), 1))),
    Mistelling(words="two modes exchanged", tell=_listed(_exchanged)),
    Mistelling(words="pairs of modes exchanged", tell=_listed(lambda n: np.arange(n) ^ 1)),
    Mistelling(words="modes in any order", tell=_listed(np.random.default_rng(39).permutation)),
)
"""Orders of the modes that a file may have."""


def _other_normalisation(about: Instrument) -> Instrument:
    local = about.slopes.normalisation is Normalisation.LOCAL
    divisor = Normalisation.GLOBAL if local else Normalisation.LOCAL
    return replace(about, slopes=replace(about.slopes, normalisation=divisor))


STATED = (
    *(Mistelling(words=f"arms turned by {turn:g} deg", tell=_arms(turn)) for turn in (1, -4, 8)),
    Mistelling(words="arms twice as wide", tell=_arms(0.0, 2.0)),
    *(Mistelling(words=f"map turned by {turn:g} deg", tell=_map(turn)) for turn in (-2, 6)),
    Mistelling(words="images on the grid", tell=_on_the_grid),
    Mistelling(words="modulation 0", tell=_modulation(0.0)),
    Mistelling(words="modulation 3", tell=_modulation(3.0)),
    *(Mistelling(words=f"hole {ratio:g}", tell=_hole(ratio)) for ratio in (0.1, 0.3)),
    Mistelling(words="the other normalisation", tell=_other_normalisation),
    Mistelling(words="pupil image 3 % large", tell=_pupil(1.03), size=1.03),
)
"""What a file says of a bench with arms; with seven of ``MISTELLINGS`` and no mistake at all."""

AS_IT_IS = Mistelling(words="nothing", tell=lambda about: about)


def error(alpha: Misregistration, truth: Misregistration, told: Mistelling) -> Array:
    """Return found less true ``(4,)``, numeric units, in the axes found and the metre told.

    No matrix tells which way round sensor and drawing are together: of the eight ways the nearest
    counts, as long as sensor and drawing are mirrored together.
    """
    turn = rotation(truth.rotation_rad)
    errors = []
    for flip, quarters in product((1.0, -1.0), range(4)):
        axes = np.diag([flip, 1.0]) @ np.linalg.matrix_power([[0.0, -1.0], [1.0, 0.0]], quarters)
        seen = axes @ turn @ np.array(told.image)
        if np.linalg.det(seen) < 0.0:
            continue
        expected = np.array(
            [
                *(axes @ truth.vector[:2]),
                np.arctan2(seen[1, 0], seen[0, 0]),
                truth.magnification / told.size,
            ]
        )
        off = alpha.vector - expected
        off[2] = (off[2] + np.pi) % (2.0 * np.pi) - np.pi
        errors.append(off)
    return np.asarray(min(errors, key=lambda off: float(np.abs(off[:3]).sum())))


TOLD = {one.words: one for one in (AS_IT_IS, *MISTELLINGS, *STATED, *ORDERS, *OUTLINES)}
"""Instrument files with one thing wrong."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Condition:
    """What differs from a perfect bench, and what the instrument file says of it."""

    images_px: float = 0.0
    """RMS displacement of the pupil images along either axis, pixels."""

    images: str = "unknown"
    """``unknown`` without the key, ``told``, or ``frames``: located in the mean frame."""

    position_error: float = 0.0
    """RMS error of an actuator's position along either axis, pitches."""

    noise: float = 0.0
    """RMS of the noise over the RMS of the signal, of the whole matrix."""

    stroke_m: float = 1e-9
    """RMS stroke of each push and pull."""

    modulation_lambda_over_d: float = 3.0
    """Radius of the modulation circle."""

    far: bool = False
    """True with registrations ``FAR`` times as far from nominal."""

    moving: str | None = None
    """What is pushed, and in which order, while the mirror's image moves; None: it rests."""

    arms: bool = False
    """True with the four arms of a spider."""

    told: str = AS_IT_IS.words
    """What the instrument file says that is not so."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Draw:
    """One matrix of one code."""

    code: str
    """``fft``, the package of a peer, or ``diffractive``."""

    condition: Condition
    """What differs from a perfect bench."""

    seed: int
    """Of all that is drawn."""

    @property
    def stop(self) -> Stop:
        """Telescope and mirror in turn."""
        return Stop.TELESCOPE if self.condition.moving else list(Stop)[self.seed % 2]

    @property
    def alpha(self) -> Misregistration:
        """Truth, within 0.6 subapertures, 3 deg and 2 %; that of the middle if it moves."""
        if self.condition.images == "frames":
            return TRUTH
        x, y, turned, size = np.random.default_rng([36, self.seed]).uniform(-1.0, 1.0, size=4)
        reach = FAR if self.condition.far else 1.0
        shift = 0.6 * reach * np.array([x, y])
        if self.code in LISTINGS:
            shift = np.rint(4.0 * shift) / 4.0  # SPECULA's images move by whole samples
        return Misregistration.from_vector(
            np.array([*shift, np.deg2rad(3.0 * reach * turned), 1.0 + 0.02 * size])
        )

    @property
    def offsets(self) -> Array:
        """Displacement of each image ``(2, 2, 2)``: row, column; (columns, rows), pixels."""
        rms = self.condition.images_px
        return displacements(self.seed, rms) if rms else np.zeros((2, 2, 2))

    @property
    def telescope(self) -> Instrument:
        """The bench as it is."""
        about = bench(self.stop)
        return _arms(0.0)(about) if self.condition.arms else about

    @property
    def bench(self) -> Bench:
        """What a peer is told of the optics."""
        alpha, offsets = self.alpha, self.offsets.reshape(4, 2)
        moved = self.stop is Stop.MIRROR
        return Bench(
            diameter_m=4.0,
            obscuration_ratio=0.2,
            n_subapertures=N,
            pupil_separation_subap=SEPARATION,
            wavelength_m=750e-9,
            modulation_lambda_over_d=self.condition.modulation_lambda_over_d,
            n_modulation=24,
            sampling=4,
            stroke_m=self.condition.stroke_m,
            image_shift_subap=(alpha.shift_x_subap, alpha.shift_y_subap) if moved else (0.0, 0.0),
            image_offsets_px=tuple(map(tuple, offsets.tolist())) if offsets.any() else (),
            arm_subap=ARM_M / 4.0 * N if self.condition.arms else 0.0,
        )

    @property
    def product(self) -> Path:
        """File with the matrix of a peer, its name made of all that the matrix depends on."""
        drawn = [self.condition.position_error, *([FAR] if self.condition.far else [])]
        asked = json.dumps([asdict(self.bench), *drawn])
        digest = hashlib.sha256(asked.encode()).hexdigest()[:10]
        return FOLDER / self.code / f"{self.seed:04d}-{digest}.npz"

    @property
    def shapes_m(self) -> Array:
        """Modes on the pupil ``(n_modes, n, n)``, metres per metre, drawn where the mirror is."""
        mirror = bench(self.stop).analytic_mirror
        rng = np.random.default_rng([37, self.seed])
        moved = misplace_actuators(mirror, self.condition.position_error, rng)
        told = self.bench
        pushed = strokes(self.condition.moving)

        def seen(alpha: Misregistration, columns: Array) -> Array:
            points = mirror_points(told, alpha, self.stop) * (told.diameter_m / N)
            apart = np.linalg.norm(points[:, None] - moved.positions_m, axis=2)
            heights = mirror.shape.coupling ** ((apart / mirror.pitch_m) ** 2)
            return np.asarray((heights @ columns).T.reshape(-1, told.n_pupil, told.n_pupil))

        if self.condition.moving is None:
            return seen(self.alpha, pushed)
        parts = np.linspace(-0.5, 0.5, pushed.shape[1])
        if self.condition.moving == POKES[1]:
            parts = rng.permutation(parts)
        vectors = self.alpha.vector + parts[:, None] * MOVEMENT
        each = (
            seen(Misregistration.from_vector(vector), column[:, None])
            for vector, column in zip(vectors, pushed.T, strict=True)
        )
        return np.concatenate(list(each))


def measured(draws: list[Draw]) -> Iterator[tuple[Draw, Measured]]:
    """Yield the matrix of every draw of one code.

    Matrices of peers are kept. A peer measures all that are missing in one process.
    """
    code = draws[0].code
    if code not in LISTINGS:
        for draw in draws:
            yield draw, _tiny_matrix(draw) if code == "diffractive" else _fft_matrix(draw)
        return
    missing = [draw for draw in draws if not draw.product.exists()]
    if missing:
        _run_peer(code, missing)
    for draw in draws:
        yield draw, _with_noise(draw, read_product(draw.product)[0])


def _run_peer(code: str, draws: list[Draw]) -> None:
    interpreter, folder = environment(code), FOLDER / code
    folder.mkdir(parents=True, exist_ok=True)
    for draw in draws:
        write_job(folder / f"{draw.product.stem}{JOB}", draw.bench, shapes_m=draw.shapes_m)
    subprocess.run(
        [str(interpreter), "-m", "pyrcal_studies.peers_pushpull", code, str(folder)],
        cwd=ROOT,
        env=variables(),
        stdout=subprocess.DEVNULL,
        check=True,
    )


def _with_noise(draw: Draw, found: Measured) -> Measured:
    """Return the matrix of a peer with noise that is equal in all slopes."""
    rng = np.random.default_rng([38, draw.seed])
    noise = draw.condition.noise * np.sqrt(np.mean(found.matrix**2))
    return replace(found, matrix=found.matrix + noise * rng.standard_normal(found.matrix.shape))


def _fft_matrix(draw: Draw) -> Measured:
    """Return the matrix of the FFT pyramid, with the noise of photons."""
    told, stroke_m = draw.bench, draw.condition.stroke_m
    model = model_of(draw.telescope)
    pyramid = camera(model, draw.offsets, N, told.modulation_lambda_over_d)
    pushes = [
        [pyramid.images(sign * stroke_m * shape, told.image_shift_subap) for sign in (1.0, -1.0)]
        for shape in draw.shapes_m
    ]
    matrix = _from_images(pushes, model.valid, stroke_m)
    if draw.condition.noise:
        # of N photons in a subaperture a slope has a variance of 1 / N, a difference of two twice
        # as much
        share = draw.condition.noise * np.sqrt(np.mean(matrix**2)) * 2.0 * stroke_m
        flux = pushes[0][0].sum(axis=(0, 2))[model.valid].mean()
        photons = 2.0 / (share**2 * flux)
        rng = np.random.default_rng([38, draw.seed])
        pushes = [[rng.poisson(photons * one) / photons for one in pair] for pair in pushes]
        matrix = _from_images(pushes, model.valid, stroke_m)
    return _measured(matrix, model.valid, told.wavelength_m)


def _from_images(pushes: list[list[Array]], valid: NDArray[np.bool_], stroke_m: float) -> Array:
    columns = [slopes_of(push, valid) - slopes_of(pull, valid) for push, pull in pushes]
    return np.stack(columns, axis=1) / (2.0 * stroke_m)


def _tiny_matrix(draw: Draw) -> Measured:
    about = _tiny(draw)
    matrix = push_pull(about, draw.alpha, TINY_MODES, TINY_NOISE, draw.seed)
    return _measured(matrix, valid_subapertures(about), about.wfs.wavelength_m)


def _measured(matrix: Array, valid: NDArray[np.bool_], wavelength_m: float) -> Measured:
    return Measured(
        matrix=matrix,
        valid=valid,
        wavelength_m=wavelength_m,
        version="",
        seconds=0.0,
        detector_from_pupil=np.eye(2),
    )


def _tiny(draw: Draw) -> Instrument:
    about = load_instrument(TINY)
    wfs = replace(about.wfs, modulation_lambda_over_d=draw.condition.modulation_lambda_over_d)
    return replace(about, wfs=wfs, slopes=SlopeRecipe(orientation=Orientation()))


def instrument_of(draw: Draw, found: Measured) -> Instrument:
    """Return what a user of the code knows; a peer's axes are searched for."""
    if draw.code == "diffractive":
        return _tiny(draw)
    about = draw.telescope
    wfs = replace(
        about.wfs,
        wavelength_m=found.wavelength_m,
        modulation_lambda_over_d=draw.condition.modulation_lambda_over_d,
        valid_subapertures=found.valid,
    )
    # strokes, so that a wrong mirror changes the influence functions alone
    pushed = strokes(draw.condition.moving)
    about = replace(about, wfs=wfs, mirror=replace(about.analytic_mirror, mode_to_actuator=pushed))
    listing = LISTINGS.get(draw.code)
    if listing is not None:
        about = replace(
            about,
            wfs=replace(about.wfs, pupil_separation_subap=float(SEPARATION)),
            mirror=replace(about.analytic_mirror, nominal_rotation_rad=None, parity=None),
            slopes=SlopeRecipe(
                order=SlopeOrder(listing.order), normalisation=Normalisation(listing.normalisation)
            ),
        )
    if draw.condition.images == "told":
        about = as_told(about, draw.offsets)
    return TOLD[draw.condition.told].tell(about)


def fitted(draw: Draw, found: Measured) -> Fit:
    """Return the fit of a measured matrix."""
    about = instrument_of(draw, found)
    return fit_matrix(about, Reference(matrix=found.matrix), FitOptions(explain=True))


def fitted_frames(draw: Draw) -> Fit:
    """Return the fit of detector frames, the images located in the mean frame."""
    instrument = replace(bench(Stop.TELESCOPE), frames=FrameWindows())
    frames, rest = filmed(instrument, draw.offsets, EVERY)
    modes = np.arange(0, basis().n_modes, EVERY)
    return fit(instrument, frames, modes=modes, flux_frame=rest, threads=1)


def row(draw: Draw, found: Fit, cpu_s: float) -> dict[str, Any]:
    """Return what is kept of a fit."""
    return {
        "code": draw.code,
        "condition": asdict(draw.condition),
        "seed": draw.seed,
        "accepted": found.accepted,
        "error": (
            error(found.alpha, draw.alpha, TOLD[draw.condition.told]) * BOUNDARY_SCALE
        ).tolist(),
        "sigma": (found.sigma * BOUNDARY_SCALE).tolist(),
        "residual": found.residual_fraction,
        "said": found.recommendation,
        "cpu_s": round(cpu_s, 1),
    }


def _images(given: argparse.Namespace) -> Iterator[Condition]:
    for rms, images in product(given.rms, given.images):
        yield Condition(images_px=rms, images=images)


def _actuators(given: argparse.Namespace) -> Iterator[Condition]:
    for position_error in given.position_errors:
        yield Condition(position_error=position_error)


def _noise(given: argparse.Namespace) -> Iterator[Condition]:
    for noise, stroke_nm in product(given.noise, given.strokes_nm):
        yield Condition(noise=noise, stroke_m=stroke_nm * 1e-9)


def _modulations(given: argparse.Namespace) -> Iterator[Condition]:
    for radius in given.modulations:
        yield Condition(modulation_lambda_over_d=radius)


def _far(given: argparse.Namespace) -> Iterator[Condition]:
    yield Condition(far=True)


def _moving(given: argparse.Namespace) -> Iterator[Condition]:
    yield from (Condition(moving=order) for order in ("modes in order", *POKES))


def _mistold(given: argparse.Namespace) -> Iterator[Condition]:
    yield from (Condition(told=words) for words in TOLD)


def _stated(given: argparse.Namespace) -> Iterator[Condition]:
    for words in (AS_IT_IS.words, *(one.words for one in (*MISTELLINGS[:7], *STATED, *ORDERS))):
        yield Condition(
            arms=True,
            images_px=0.2 if words == "images on the grid" else 0.0,
            modulation_lambda_over_d=0.0 if words == "modulation 3" else 3.0,
            told=words,
        )


CAMPAIGNS: dict[str, Callable[[argparse.Namespace], Iterator[Condition]]] = {
    "images": _images,
    "actuators": _actuators,
    "noise": _noise,
    "modulations": _modulations,
    "small": _modulations,
    "far": _far,
    "moving": _moving,
    "mistold": _mistold,
    "stated": _stated,
}


def run(name: str, given: argparse.Namespace) -> None:
    """Measure and fit what is not there yet, and append a line for each fit."""
    file = _kept(name)
    known = {_key(one) for one in file.rows}
    codes = ["diffractive"] if name == "small" else given.codes
    for condition, code in product(CAMPAIGNS[name](given), codes):
        seeds = range(given.first_seed, given.first_seed + given.draws)
        draws = [Draw(code=code, condition=condition, seed=seed) for seed in seeds]
        draws = [one for one in draws if (code, str(asdict(condition)), one.seed) not in known]
        # The axes of a code's detector are found by a poke, which an unmodulated pyramid spreads.
        if code in LISTINGS and condition.modulation_lambda_over_d == 0.0:
            continue
        for draw, found, cpu_s in _fits(draws):
            file.add(row(draw, found, cpu_s))


def _fits(draws: list[Draw]) -> Iterator[tuple[Draw, Fit, float]]:
    if not draws:
        return
    if draws[0].condition.images == "frames":
        for draw in draws:
            yield draw, fitted_frames(draw), 0.0
        return
    for draw, found in measured(draws):
        begun = time.process_time()
        done = fitted(draw, found)
        yield draw, done, time.process_time() - begun


def _kept(name: str) -> RowFile:
    return RowFile(FOLDER / f"{name}.jsonl")


def _key(one: dict[str, Any]) -> tuple[str, str, int]:
    return one["code"], str(one["condition"]), one["seed"]


def table(found: list[dict[str, Any]]) -> Iterator[str]:
    """Yield a table in Markdown, a row for each condition and code."""
    plain = asdict(Condition())
    yield (
        "| condition | code | accepted | within 3 σ | accepted beyond 3 σ | largest over σ | RMS "
        "over σ: x, y, rotation, magnification | largest error: shift (subap), rotation (deg), "
        "magnification | largest σ of a shift |"
    )
    yield "|" + " --- |" * 9
    for words, code in dict.fromkeys((str(one["condition"]), one["code"]) for one in found):
        these = [one for one in found if (str(one["condition"]), one["code"]) == (words, code)]
        condition = these[0]["condition"]
        named = ", ".join(
            f"{key} {value}" for key, value in condition.items() if value != plain[key]
        )
        yield f"| {named or 'nothing'} | {code} | {_cells(these)} |"


def _cells(these: list[dict[str, Any]]) -> str:
    errors = np.abs([one["error"] for one in these])
    sigma = np.array([one["sigma"] for one in these])
    worst = (errors / sigma).max(axis=1)
    accepted = np.array([one["accepted"] for one in these])
    rms = np.sqrt(np.mean((errors / sigma) ** 2, axis=0))
    return " | ".join(
        [
            f"{accepted.sum()} of {len(these)}",
            str(np.sum(worst < MAX_SIGMA)),
            str(np.sum(accepted & (worst >= MAX_SIGMA))),
            f"{worst.max():.1f}",
            ", ".join(f"{value:.2f}" for value in rms),
            f"{errors[:, :2].max():.4f}, {errors[:, 2].max():.4f}, {errors[:, 3].max():.5f}",
            f"{sigma[:, :2].max():.4f}",
        ]
    )


def main() -> int:
    """Measure and fit, or print the table of all that is there."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("campaign", choices=CAMPAIGNS)
    parser.add_argument("--codes", nargs="+", choices=CODES, default=CODES)
    parser.add_argument("--draws", type=int, default=40, help="of each code and condition")
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--rms", nargs="+", type=float, default=[0.0, 0.05, 0.1, 0.2, 0.3])
    parser.add_argument("--images", nargs="+", default=["told", "unknown"])
    parser.add_argument("--position-errors", nargs="+", type=float, default=[0.0, 0.02])
    parser.add_argument("--noise", nargs="+", type=float, default=[0.05, 0.3, 1.0])
    parser.add_argument("--strokes-nm", nargs="+", type=float, default=[1.0, 100.0])
    parser.add_argument("--modulations", nargs="+", type=float, default=[3.0, 0.0])
    parser.add_argument("--table", action="store_true", help="print the table, measure nothing")
    given = parser.parse_args()
    if not given.table:
        with threadpool_limits(1):
            run(given.campaign, given)
    print("\n".join(table(_kept(given.campaign).rows)))
    return 0


if __name__ == "__main__":
    sys.exit(main())

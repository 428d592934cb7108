"""Divide the power that a fit leaves over among its causes, and advise what to measure next.

Causes are taken one after the other, each from what the ones before leave: uneven light, a mirror
whose shape differs from the command, one image of a pyramid that differs from the others, and white
noise. The rest is unexplained.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pyrcal.fitting.methods import Settled, draw_planes
from pyrcal.fitting.noise import noise_sigma
from pyrcal.fitting.solver import nuisances_of
from service.model.modes import ModalBasis

Array = NDArray[np.float64]

MIN_LEFT_OVER = 0.02
"""Smallest residual that is divided, as RMS share of the signal: models of one instrument differ by
about 0.01."""

MAX_FUNCTIONS = 1000
"""Largest number of actuators that are fitted to every column, for the time that this takes."""

RIDGES = (0.01, 0.1, 1.0, 10.0)
"""Trial weights of zero strokes, over the mean response of an actuator."""

N_FOLDS = 5
"""Number of parts of the pupil that are predicted from the others."""

MIN_BLOCK_SUBAP = 2
"""Smallest side of the blocks that a part consists of, subapertures."""

IMAGE_RATIO = 1.3
"""Power left over by one image, over the mean of the others, above which it is named."""

DIFFERENCES = 3
"""Order of the differences of neighbours along each axis that show white noise."""

MIN_SHARE = 0.01
"""Share of the power left over above which a cause is reported."""

_LIGHT_STEPS = 4

_IMAGES = ("-x -y", "+x -y", "-x +y", "+x +y")


@dataclass(frozen=True, slots=True, kw_only=True)
class Cause:
    """A part of the power that is left over, and what to measure to reduce it."""

    words: str
    """Cause, as a noun phrase."""

    share: float
    """Part of the power that a model with even light leaves over, 0 to 1."""

    sigma: float
    """1 σ of ``share``, from its scatter between modes."""

    remedy: str
    """Advice on what to measure or change to reduce it, as an imperative."""


def explain_left_over(settled: Settled, noise: Array | None = None) -> tuple[Cause, ...]:
    """Return the causes of what a fit leaves over, the largest first and the unexplained last.

    Shares are whole per cents that add up to 100. They refer to even light, whether or not the fit
    has a gain map. Returns no causes if less than ``MIN_LEFT_OVER`` of the signal is left over.

    Parameters
    ----------
    settled
        The fit.
    noise
        ``(n_modes,)`` 1 σ of one element of each column from repeated measurements; None if
        unknown.
    """
    if settled.share < MIN_LEFT_OVER:
        return ()
    known, left = [], 1.0
    for one in _divide_power(settled, noise):
        # The excess of one image contains noise, which has been counted.
        share = round(min(one.share, left), 2)
        if share > MIN_SHARE:
            known.append(replace(one, share=share))
            left = round(left - share, 2)
    unexplained = Cause(
        words="unexplained",
        share=left,
        sigma=float(np.sqrt(sum(one.sigma**2 for one in known))),
        remedy="push more modes, and some with half the stroke",
    )
    return (*sorted(known, key=lambda one: -one.share), unexplained)


def _divide_power(settled: Settled, noise: Array | None) -> Iterator[Cause]:
    """Yield the causes of what is left over, each of what the ones before leave."""
    target, model = settled.target, _model_at_best(settled)
    # Columns of unit weight, because every mode counts alike.
    scale = np.sqrt(target.weights)
    before = np.sum((target.project(model, model[:0, None]).residual * scale) ** 2, axis=0)

    def make_cause(power: Array, words: str, remedy: str) -> Cause:
        share, n_modes = power / before.sum(), len(power)
        scatter = np.std(share, ddof=1) * np.sqrt(n_modes) if n_modes > 1 else 0.0
        # Shapes that are fitted to noise predict nothing, and a negative part is none.
        return Cause(
            words=words, share=max(float(share.sum()), 0.0), sigma=float(scatter), remedy=remedy
        )

    lit, light = _fit_light(settled, model)
    residual = target.project(lit, model[:0, None]).residual * scale
    with_light = np.sum(residual**2, axis=0)
    words = f"uneven light, a gain from {light.min():.2f} to {light.max():.2f} over the pupil"
    remedy = "measure the mean frame, and give it to the twin (light=FILE) or fit (--flux-map)"
    yield make_cause(before - with_light, words, remedy)
    residual = residual - _predict_shapes(settled, residual, light)
    left = np.sum(residual**2, axis=0)
    words = "a mirror shape that differs from the command"
    remedy = "measure the influence functions, or push every actuator"
    yield make_cause(with_light - left, words, remedy)
    planes = draw_planes(residual, target)
    if noise is None:
        white = _measure_noise(residual, planes)
    else:
        white = len(residual) * (noise * scale) ** 2
    white = white * min(1.0, float(left.sum() / max(white.sum(), np.finfo(float).tiny)))
    yield make_cause(white, "white noise", "average more pushes")
    for excess, words in _find_image(planes):
        remedy = "look at this image under even light: ghosts and plates make fringes"
        yield make_cause(excess, words, remedy)


def advise_measurement(causes: Sequence[Cause]) -> str:
    """Return what to measure next to halve the power that is left over; empty without causes."""
    chosen: list[Cause] = []
    for one in causes[:-1]:  # without the unexplained, which no single measurement reduces
        if sum(known.share for known in chosen) < 0.5:
            chosen.append(one)
    if not causes:
        return ""
    steps = "; ".join(one.remedy for one in chosen or causes)
    shares = " and ".join(f"{one.words} ({one.share:.0%})" for one in chosen)
    total = sum(one.share for one in chosen)
    if total < 0.5:
        return f"{total:.0%} of the power left over has a known cause, which is not half: {steps}"
    shares = chosen[0].words if len(chosen) == 1 else shares
    return f"{total:.0%} of the power left over comes from {shares}: {steps}"


def _model_at_best(settled: Settled) -> Array:
    """Return D with the small changes of the nuisances, without the gain map, float64."""
    solution, nuisances = settled.solution, settled.nuisances
    values = nuisances.linear(solution.nuisances)
    changes = np.tensordot(values, solution.near[4:], axes=1)
    return np.asarray(solution.matrix + changes, dtype=np.float64)


def _fit_light(settled: Settled, model: Array) -> tuple[Array, Array]:
    """Return a model with the gain over the pupil that fits best, and that gain ``(n_slopes,)``."""
    target, kind = settled.target, settled.models.instrument.slopes.kind
    maps = nuisances_of(target.valid, kind, gain_map=True).maps
    gain = np.ones(len(model))
    # The free gain of each mode makes this a nonlinear problem, though hardly.
    for _ in range(_LIGHT_STEPS):
        seen = target.project(model * gain[:, None], maps[:, :, None] * model, np.float32)
        gain = gain + seen.best_step @ maps
    return model * gain[:, None], gain


def _predict_shapes(settled: Settled, residual: Array, light: Array) -> Array:
    """Return the residual ``(n_rows, n_modes)`` that free strokes of all actuators predict.

    Each part of the pupil is predicted from the others. A part consists of blocks as wide as the
    distance of two actuators: an actuator is then measured outside a block into which it reaches,
    and errors that are narrower than an actuator predict nothing.
    """
    models, target = settled.models, settled.target
    basis, spacing = models.basis, float(MIN_BLOCK_SUBAP)
    if isinstance(basis, ModalBasis) and len(basis.mode_to_actuator) <= MAX_FUNCTIONS:
        basis = basis.of_actuators
        mirror = models.instrument.analytic_mirror
        spacing = mirror.pitch_m / models.instrument.subaperture_m
    model = models.model(models.cheap_sampling, basis, once=True)
    functions = np.asarray(model.interaction_matrix(settled.solution.alpha), np.float64)
    functions = (functions * light[:, None])[target.rows]
    y, x = np.nonzero(target.valid)
    side = max(MIN_BLOCK_SUBAP, int(np.ceil(spacing)))
    # Neighbouring blocks belong to different parts.
    fold = np.tile((y // side + 2 * (x // side)) % N_FOLDS, len(target.rows) // len(y))[target.rows]
    predicted = np.zeros((len(RIDGES), *residual.shape))
    for k in range(N_FOLDS):
        known, out = functions[fold != k], functions[fold == k]
        size, axes = np.linalg.eigh(known.T @ known)
        onto = axes.T @ (known.T @ residual[fold != k])
        for ridge, found in zip(RIDGES, predicted, strict=True):
            held = size + ridge * size.mean()
            found[fold == k] = out @ (axes @ (onto / held[:, None]))
    return min(predicted, key=lambda found: float(np.sum((residual - found) ** 2)))


def _measure_noise(residual: Array, planes: Array) -> Array:
    """Return the power of white noise in each column of a residual, ``(n_modes,)``.

    It is bounded twice. The singular values of a few columns hardly show structure that differs
    from column to column, and differences of neighbours hardly show structure that is as fine as
    a subaperture: on PAPYRUS the first bound is 0.67 of the residual, the second 0.08.
    """
    spread = np.full(residual.shape[1], noise_sigma(residual) ** 2 * len(residual))
    differences = np.diff(planes, DIFFERENCES, axis=1)
    differences = np.diff(differences, DIFFERENCES, axis=2)
    known = np.isfinite(differences)
    if not known.any():
        return spread
    # Noise of variance 1 has differences of this variance along each axis.
    grown = math.comb(2 * DIFFERENCES, DIFFERENCES)
    squares = np.where(known, differences, 0.0) ** 2 / grown**2
    fine = np.sum(squares, axis=(0, 1, 2)) / np.sum(known, axis=(0, 1, 2)) * len(residual)
    return np.asarray(fine * min(1.0, float(spread.sum() / fine.sum())))


def _find_image(planes: Array) -> Iterator[tuple[Array, str]]:
    """Yield the excess ``(n_modes,)`` of an image of a pyramid that leaves more than the others."""
    if len(planes) != len(_IMAGES):
        return
    squares = np.nan_to_num(planes) ** 2
    power = squares.sum(axis=(1, 2))
    worst = int(np.argmax(power.sum(axis=1)))
    others = np.delete(power, worst, axis=0).mean(axis=0)
    if power[worst].sum() < IMAGE_RATIO * others.sum():
        return
    image = squares[worst].sum(axis=2)
    half = len(image) // 2
    sides = {
        "left": image[:, :half],
        "right": image[:, -half:],
        "lower": image[:half],
        "upper": image[-half:],
    }
    side = max(sides, key=lambda one: float(sides[one].sum()))
    is_lopsided = sides[side].sum() > IMAGE_RATIO * image.sum() / 2.0
    where = f", mostly in its {side} half" if is_lopsided else ""
    yield power[worst] - others, f"the image at {_IMAGES[worst]} unlike the others{where}"

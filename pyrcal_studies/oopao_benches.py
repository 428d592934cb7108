"""Benches that OOPAO simulates, saved as docs/tutorials/oopao.md says, with a known registration.

Run by an interpreter that has OOPAO, from the repository's root: ``python -m
pyrcal_studies.oopao_benches FOLDER [CASE ...]``; then ``pyrcal import oopao`` and ``pyrcal fit``.
"""

from __future__ import annotations

import json
import sys
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from OOPAO.DeformableMirror import DeformableMirror
from OOPAO.MisRegistration import MisRegistration
from OOPAO.Pyramid import Pyramid
from OOPAO.Source import Source
from OOPAO.Telescope import Telescope
from OOPAO.Zernike import Zernike

Array = NDArray[np.float64]

DIAMETER_M, POINTS, N_MODES = 0.6, 2, 40
"""Of the pupil; points along a subaperture; modes, the smoothest of the mirror."""

STROKE_M = 1e-9
COUPLING = 0.36


@dataclass(frozen=True, slots=True, kw_only=True)
class Case:
    """One bench."""

    modulation: float
    """λ/D in OOPAO's unit: 1 - 1 / n of that of a pupil of n points."""

    ellipse: tuple[float, float, float] | None = None
    """Semi-axes, and degrees from +x to the first one, instead of the circle."""

    rooftop: float = 0.0
    """In OOPAO's unit."""

    processing: str = "slopesMaps"
    subapertures: int = 18
    actuators: int = 9
    """Along a diameter."""

    separation_px: int = 8
    """Pixels between the pupil images."""

    alpha: tuple[float, float, float, float] = (0.3, -0.2, 1.0, 1.02)
    """Shift x and y, subapertures, rotation, degrees, magnification."""

    noise: float = 0.0
    """RMS of the noise over that of the signal of each mode."""

    faces_px: tuple[tuple[float, ...], tuple[float, ...]] | None = None
    """Arguments of ``apply_shift_wfs``, x and y of each face; None for a regular grid of images."""

    unit_m: float = 1.0
    """OPD of a unit command, metres; negative if commands have the other sign."""

    seed: int = 7
    """Seed of the noise."""

    aberration_rad: float = 0.0
    """RMS of a static aberration of OOPAO's Zernike polynomials 3 to 12, counted from tip: drawn
    coefficients."""


OFF_GRID = 0.5
"""Share of the drawn benches of whole frames whose pupil images are off a regular grid."""

FREE = "-free"
"""End of the name of a bench that is simulated without its noise."""

DRAWN = "drawn-"
"""Start of the name of a bench that is drawn, before its seed."""

WHOLE = "fullFrame_sum_flux"

CASES = {
    "unmodulated": Case(modulation=0.0),
    "half": Case(modulation=0.5),
    "one": Case(modulation=1.0),
    "three": Case(modulation=3.0),
    "ellipse-4-5": Case(modulation=4.0, ellipse=(4.0, 5.0, 30.0)),
    "ellipse-3-4": Case(modulation=3.0, ellipse=(3.0, 4.0, 0.0)),
    "rooftop": Case(modulation=0.0, rooftop=1.0),
    "rooftop-three": Case(modulation=3.0, rooftop=1.0),
    # A rooftop and an aberration together darken one of the four images.
    "whole-dark-image": Case(
        modulation=0.0,
        rooftop=0.5,
        aberration_rad=0.3,
        processing=WHOLE,
        subapertures=36,
        actuators=11,
        separation_px=16,
        alpha=(0.42, -1.1, 0.7, 1.12),
        noise=0.03,
    ),
    "whole-unmodulated": Case(modulation=0.0, processing=WHOLE),
    "whole-three": Case(modulation=3.0, processing=WHOLE),
    "unmodulated-aberrated": Case(modulation=0.0, aberration_rad=0.5),
    "three-aberrated": Case(modulation=3.0, aberration_rad=1.0),
    "whole-five-noise": Case(
        modulation=5.0,
        processing=WHOLE,
        subapertures=20,
        actuators=17,
        alpha=(0.4, 0.33, 90.0, 0.9),
        noise=0.1,
    ),
    "whole-unmodulated-noise": Case(
        modulation=0.0,
        processing="fullFrame",
        subapertures=36,
        actuators=11,
        separation_px=16,
        alpha=(0.0, -1.2, 180.0, 1.12),
        noise=0.1,
    ),
    "whole-ellipse-noise": Case(
        modulation=4.0,
        ellipse=(4.0, 5.0, 20.0),
        processing=WHOLE,
        subapertures=20,
        actuators=11,
        alpha=(0.3, 0.0, 2.0, 1.05),
        noise=0.1,
    ),
}


def draw_case(seed: int) -> Case:
    """Return a bench whose kind follows from its seed, and whose values are drawn."""
    rng, kind = np.random.default_rng(seed), seed % 8
    modulation = (0.0, 3.0, 5.0, 4.0)[kind % 4]
    whole, noise = kind >= 3, 0.1 * (seed // 8 % 2)
    subapertures, actuators = (36, 11) if kind in {0, 5, 6} else (20, (11, 17)[seed // 4 % 2])
    pitch_subap = subapertures / (actuators - 1)
    shift = rng.uniform(-pitch_subap / 3, pitch_subap / 3, 2)
    turned = float(rng.choice([0.0, 90.0, 180.0]) + rng.normal(0.0, 1.5))
    off_px = rng.uniform(-3.0, 3.0, (2, 4)) * (whole and rng.random() < OFF_GRID)
    return Case(
        modulation=modulation,
        ellipse=(4.0, 5.0, float(rng.uniform(0.0, 180.0))) if kind % 4 == 3 else None,
        processing=str(rng.choice(["fullFrame", WHOLE])) if whole else "slopesMaps",
        subapertures=subapertures,
        actuators=actuators,
        separation_px=2 * round(subapertures / 4.5),
        alpha=(float(shift[0]), float(shift[1]), turned, float(rng.uniform(0.9, 1.12))),
        noise=noise,
        faces_px=(tuple(off_px[0]), tuple(off_px[1])) if np.any(off_px) else None,
        unit_m=float(rng.choice([-1.0, 1.0]) * 10 ** rng.uniform(-7.0, -5.0)),
        seed=seed,
    )


def measure(case: Case) -> dict[str, Any]:
    """Return what the tutorial saves of a bench: its objects, its modes and its matrix."""
    n_points = case.subapertures * POINTS
    telescope = Telescope(resolution=n_points, diameter=DIAMETER_M)
    star = Source(optBand="R", magnitude=0)
    star**telescope
    subaperture_m = DIAMETER_M / case.subapertures * n_points / (n_points - 1)
    x_subap, y_subap, rotation_deg, magnification = case.alpha
    moved = MisRegistration()
    moved.shiftX, moved.shiftY = -x_subap * subaperture_m, -y_subap * subaperture_m
    moved.rotationAngle = rotation_deg
    moved.radialScaling = moved.tangentialScaling = magnification - 1.0
    plain, mirror = (
        DeformableMirror(
            telescope=telescope,
            nSubap=case.actuators - 1,
            mechCoupling=COUPLING,
            misReg=where,
            print_dm_properties=False,
        )
        for where in (MisRegistration(), moved)
    )
    sensor = Pyramid(
        nSubap=case.subapertures,
        telescope=telescope,
        modulation=case.modulation,
        lightRatio=0.0 if case.processing.startswith("full") else 0.3,
        postProcessing=case.processing,
        n_pix_separation=case.separation_px,
        rooftop=case.rooftop,
        user_modulation_path=None if case.ellipse is None else _path(*case.ellipse),
    )
    if case.faces_px is not None:
        sensor.apply_shift_wfs(sx=list(case.faces_px[0]), sy=list(case.faces_px[1]))
    _, _, axes = np.linalg.svd(plain.modes, full_matrices=False)
    modes = axes[:N_MODES].T / (plain.modes @ axes[:N_MODES].T).std(axis=0)
    aberration = _draw_aberration(telescope, case.aberration_rad)
    columns = []
    for shape in (mirror.modes @ modes).T:
        phase = 2 * np.pi / star.wavelength * STROKE_M * shape.reshape(n_points, n_points)
        signals = []
        for sign in (1.0, -1.0):
            sensor.wfs_measure(phase_in=aberration + sign * phase)
            signals.append(np.array(sensor.signal, dtype=float))
        columns.append((signals[0] - signals[1]) / (2 * STROKE_M))
    matrix = np.stack(columns, axis=1)
    noise = np.random.default_rng(case.seed).standard_normal(matrix.shape)
    matrix += case.noise * matrix.std(axis=0) * noise
    matrix *= case.unit_m
    owners = {"tel": telescope, "ngs": star, "dm": plain, "dm.misReg": plain.misReg, "wfs": sensor}
    names = {
        "tel": "D resolution pupil pupilReflectivity",
        "ngs": "wavelength",
        "dm": "modes initial_coordinates nActAlongDiameter mechCoupling sign flip_ flip_lr",
        "dm.misReg": "rotationAngle shiftX shiftY anamorphosisAngle radialScaling"
        " tangentialScaling",
        "wfs": "tag nSubap modulation user_modulation_path n_pix_separation n_pix_edge binning"
        " postProcessing rooftop validI4Q validSignal",
    }
    kept: dict[str, Any] = {"calib.D": matrix.astype(np.float32), "M2C": modes}
    # A picture of the modulated spot, on OOPAO's grid of the focal plane.
    kept["spot"] = np.array(sensor.modulation_camera_intensity)
    kept |= {"case": json.dumps(asdict(case)), "frame": np.array(sensor.cam.frame)}
    for owner, listed in names.items():
        for name in listed.split():
            value = getattr(owners[owner], name, None)
            if value is not None:
                kept[f"{owner}.{name}"] = value
    return kept


def _draw_aberration(telescope: Telescope, rms_rad: float) -> Array:
    """Return the static aberration over the pupil's array, radians."""
    polynomials = Zernike(telescope, 12)
    polynomials.computeZernike(telescope)
    drawn = polynomials.modesFullRes[:, :, 2:] @ np.random.default_rng(2).standard_normal(10)
    scaled: Array = rms_rad * drawn / drawn[telescope.pupil > 0].std()
    return scaled


def _path(first: float, second: float, angle_deg: float) -> list[list[float]]:
    """Return as many points on an ellipse as OOPAO takes on a circle of its longer axis."""
    n_points = 4 * int(np.ceil(2 * np.pi * max(first, second) / 4))
    t = 2 * np.pi * np.arange(n_points) / n_points
    path = np.exp(1j * np.deg2rad(angle_deg)) * (first * np.cos(t) + 1j * second * np.sin(t))
    return [[float(point.real), float(point.imag)] for point in path]


def main() -> None:
    """Write the dumps of all benches, or of those that are named."""
    folder, *named = sys.argv[1:]
    for name in named or CASES:
        drawn = name.removeprefix(DRAWN)
        case = draw_case(int(drawn)) if drawn != name else CASES[name.removesuffix(FREE)]
        if name.endswith(FREE):
            case = replace(case, noise=0.0)
        np.savez(Path(folder) / f"{name}.npz", **measure(case))


if __name__ == "__main__":
    main()

"""What the paper says, word for word, and its values with their places.

Every quotation is the paper's text with the TeX mathematics written plainly (:func:`plain`). A test
compares all of them, and those on the page, with the paper's source where it is at hand.

LaTeX numbers the equations 1 to 10 in the order in which they stand. The labels in the source
(``eq:1`` is equation 1, but ``eq:2`` is equation 3) are not the printed numbers.

References
----------
Heritier et al. 2018, MNRAS 481, 2829.
"""

from __future__ import annotations

import re
from dataclasses import dataclass


@dataclass(frozen=True, slots=True, kw_only=True)
class Quote:
    """A passage of the paper, and the values in it."""

    text: str
    """Verbatim, mathematics written plainly."""

    where: str
    """Section, equation, table or figure."""

    values: tuple[float, ...] = ()
    """The values of the passage, in its order."""


def plain(tex: str) -> str:
    """Return TeX as plain text: symbols, degrees and percent, single spaces."""
    text = re.sub(r"\\(?:cite|label)\{[^}]*\}|\\footnote\{[^}]*\}", "", tex)
    text = re.sub(r"\\ref\{fig:(\w+)\}", r"[\1]", text)
    text = re.sub(r"\$?\^\\circ\s*\$?", "°", text)
    text = text.replace(r"\%", "%").replace(r"\lambda", "λ").replace(r"\chi", "χ")
    text = text.replace(r"\alpha", "α").replace(r"\delta", "δ")
    text = re.sub(r"\\(?:boldsymbol|textbf)\{([^{}]*(?:\{[^{}]*\})?[^{}]*)\}", r"\1", text)
    text = text.replace(r"\{", "(").replace(r"\}", ")")
    text = re.sub(r"[${}\\&~]", " ", text)
    text = re.sub(r"\s+", " ", text)
    return re.sub(r"\s+([%°.,);])", r"\1", text)


QUOTES = {
    "actuators": Quote(text="composed of 663 valid actuators", where="3.1", values=(663,)),
    "modes": Quote(text="the 594 modes on the ASM", where="3.1", values=(594,)),
    "subapertures": Quote(
        text="30 by 30 subapertures (1 pixel per subaperture) and 36 pixels separating each pupil "
        "image centres",
        where="3.1",
        values=(30, 36),
    ),
    "wavelength": Quote(text="operates at 750 nm", where="3.1", values=(750,)),
    "modulation": Quote(text="Tip/Tilt modulation", where="3.1", values=(3,)),
    "double_pass": Quote(text="the WFS signals are normalised with a factor 2", where="3.1"),
    "eigenvalues": Quote(
        text="the distribution of eigen values is flatter and the knee of the curve occurs for a "
        "larger eigen mode number",
        where="3.1",
    ),
    "condition": Quote(
        text="a lower conditioning number (8.1 vs 8.85)", where="figure 3", values=(8.1, 8.85)
    ),
    "slopes_rms": Quote(
        text="Both WFS have the same sensitivity to the KL modes.", where="figure 4"
    ),
    "border": Quote(
        text="a rotation of 1° corresponds to a shift of around 25% of a subaperture on the border "
        "of the pupil",
        where="3.2",
        values=(1, 25),
    ),
    "drop": Quote(
        text="the first mis-registration value after the drop of performance when controlling 594 "
        "modes ( 0.8° for the rotation and 40% for the shift)",
        where="3.2",
        values=(0.8, 40),
    ),
    "high_modes": Quote(
        text="the high order modes are the most impacted by the mis-registrations and get "
        "amplified "
        "even to higher values than the incoming turbulence",
        where="3.2",
    ),
    "rule": Quote(
        text="less than 10% of a subaperture for the shifts and less than 0.1° for the rotation "
        "which corresponds to a shift of 2.5% on the border of the pupil",
        where="3.2",
        values=(10, 0.1, 2.5),
    ),
    "magnification": Quote(
        text="the impact of a magnification becomes significant when controlling a high number of "
        "modes only",
        where="3.2",
    ),
    "rough": Quote(
        text="(+/- 1 subaperture shift and +/- 2° of rotation)", where="4", values=(1, 2)
    ),
    "third": Quote(
        text="Applying a third estimation does not change the value of the estimated parameters",
        where="4.3",
    ),
    "quadratic": Quote(text="showing a quadratic behaviour around each optimal value", where="4.3"),
    "gains": Quote(
        text="As a last step, we also tuned the modal gains of the pyramid model",
        where="4.3",
    ),
    "maps": Quote(text="shows only negligible differences", where="4.4"),
    "features": Quote(
        text="some parts of the pupils gathered less signals than others, the bottom left part, "
        "the "
        "central obscuration and behind the spiders of the retro-reflector",
        where="figure 10",
    ),
    "simulator": Quote(
        text="a residual variance of 128 nm in the synthetic case and 147 nm using the "
        "experimental "
        "reconstructor",
        where="4.4",
        values=(128, 147),
    ),
    "illumination": Quote(
        text="take in consideration the imperfect illumination identified on the experimental "
        "interaction matrix",
        where="4.4",
    ),
    "best": Quote(
        text="For each parameter, the optimal value provides the best AO performance", where="4.4"
    ),
    "same": Quote(
        text="We also retrieve the same sensitivity to the mis-registrations as in the synthetic "
        "case",
        where="4.4",
    ),
    "conditions": Quote(
        text="a star of magnitude 7 is simulated using an external fibre and a retro-reflector. A "
        "disturbance signal is then applied on the ASM to simulate a turbulence with a seeing of "
        '1" in the visible',
        where="5",
        values=(7, 1),
    ),
    "groups": Quote(
        text="for the Tip/Tilt, the following modes up to 100 and for the remaining modes up to "
        "400",
        where="5",
        values=(100, 400),
    ),
    "ramp": Quote(
        text="applying a ramp of gain values and select the one minimizing the RMSE of the "
        "residual "
        "slopes",
        where="5",
    ),
    "no_tuning": Quote(
        text="used the corresponding values for our synthetic interaction matrix with no further "
        "tuning",
        where="5",
    ),
    "positions": Quote(
        text="These are computed from the DM positions which include the correction for the "
        "vibrations of the telescope.",
        where="5",
    ),
    "not_considered": Quote(
        text="These modes should then not be considered for the performance comparison.", where="5"
    ),
    "better": Quote(
        text="the pseudo-synthetic interaction matrix provided a slightly better correction than "
        "the experimental one",
        where="5",
    ),
    "more": Quote(
        text="to correct up to 500 modes and get stable closed-loop with high order correction",
        where="5",
        values=(500,),
    ),
    "patterns": Quote(
        text="using system modes or Hadamard patterns to maximize the signal provides a consistent "
        "gain in calibration time",
        where="2.1",
    ),
    "flux": Quote(text="could be done using flux considerations", where="4"),
    "number": Quote(
        text="There is a need to study the number and type of signals required", where="6"
    ),
    "noise": Quote(
        text="the impact of the noise on the parameters estimation will also have to be "
        "investigated",
        where="6",
    ),
    "tracking": Quote(
        text="especially the tracking of these parameters during the operation, if possible "
        "without "
        "injecting any perturbation",
        where="6",
    ),
    "elt": Quote(text="with respectively 4356 and 4702 actuators", where="1", values=(4356, 4702)),
}

START = Quote(
    text="α_ rot =64.5°, α_x=0%, α_y=0%, α_ magn = 100%",
    where="equation 9",
    values=(0.0, 0.0, 64.5, 100.0),
)
FOUND = Quote(
    text="α_ rot =65.08°, α_x=-92%, α_y=35%,α_ magn = 98%",
    where="equation 10",
    values=(-92.0, 35.0, 65.08, 98.0),
)
"""Shift along x and y (% of a subaperture), rotation (deg), magnification (%)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Step:
    """A line of Table 1."""

    symbol: str
    step: float
    value: float
    unit: str


TABLE_1 = (
    Step(symbol="α_rot", step=0.125, value=65.33, unit="°"),
    Step(symbol="α_x", step=25, value=-100, unit="%"),
    Step(symbol="α_y", step=25, value=25, unit="%"),
    Step(symbol="α_rot", step=0.1, value=65.08, unit="°"),
    Step(symbol="α_x", step=2, value=-92, unit="%"),
    Step(symbol="α_y", step=2, value=35, unit="%"),
    Step(symbol="α_rot", step=0.025, value=65.08, unit="°"),
    Step(symbol="α_x", step=2, value=-92, unit="%"),
    Step(symbol="α_y", step=2, value=35, unit="%"),
    Step(symbol="α_magn", step=0.45, value=98, unit="%"),
)

TABLE_2 = {
    "PSIM 400 Modes": (195.0, 41.7, 30.1),
    "LBT 400 Modes": (216.0, 42.1, 30.8),
    "PSIM 500 Modes": (228.3, 42.5, 27.39),
}
"""WFE, tip and tilt removed, 50 KL removed; nm."""

COLUMNS = ("WFE", "TT rem.", "50 KL rem.")


def table_1_lines() -> list[str]:
    """Return the lines of Table 1 as the paper prints them, mathematics written plainly."""
    return [
        f"{number} {step.symbol.replace('_rot', '_ rot').replace('_magn', '_ magn')} "
        f"{step.step:g}{step.unit} {step.value:g}{step.unit}"
        for number, step in enumerate(TABLE_1, start=1)
    ]


def table_2_lines() -> list[str]:
    """Return the lines of Table 2 in the same way."""
    return [
        f"{name} {' '.join(f'{value:g} nm' for value in values)}"
        for name, values in TABLE_2.items()
    ]

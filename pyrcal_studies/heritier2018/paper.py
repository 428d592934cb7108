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
    "wavelength": Quote(text="operates at 750 nm", where="3.1", values=(750,)),
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
    "drop": Quote(
        text="the first mis-registration value after the drop of performance when controlling 594 "
        "modes ( 0.8° for the rotation and 40% for the shift)",
        where="3.2",
        values=(0.8, 40),
    ),
    "magnification": Quote(
        text="the impact of a magnification becomes significant when controlling a high number of "
        "modes only",
        where="3.2",
    ),
    "rough": Quote(
        text="(+/- 1 subaperture shift and +/- 2° of rotation)", where="4", values=(1, 2)
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
    "not_considered": Quote(
        text="These modes should then not be considered for the performance comparison.", where="5"
    ),
    "patterns": Quote(
        text="using system modes or Hadamard patterns to maximize the signal provides a consistent "
        "gain in calibration time",
        where="2.1",
    ),
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

"""The paper's own values, each with where it is said.

Those marked ``AS_QUOTED`` are taken from the project's issue, which gives the number without the
line of the table it stands in.

References
----------
Heritier et al. 2018, MNRAS 481, 2829.
"""

from __future__ import annotations

from dataclasses import dataclass

AS_QUOTED = "as quoted in the project's issue"


@dataclass(frozen=True, slots=True, kw_only=True)
class Quoted:
    """A value of the paper."""

    values: tuple[float, ...]
    unit: str
    where: str
    """Place in the paper, or who quotes it."""

    @property
    def text(self) -> str:
        """The values as they are shown in a table."""
        numbers = " / ".join(f"{value:g}" for value in self.values)
        return f"{numbers} {self.unit}".rstrip()

    def distance(self, value: float) -> float:
        """Return how far a value of ours is from the nearest of them; 0 between two of them."""
        low, high = min(self.values), max(self.values)
        return max(low - value, value - high, 0.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class Row:
    """A line of the paper's Table 2: a reconstructor at the telescope, by day."""

    name: str
    """PSIM: inverse of the synthetic matrix; LBT: of the measured one."""

    errors_nm: tuple[float, float, float]
    """Wavefront error: of all modes, tip and tilt removed, the first 50 modes removed."""


TABLE_2 = {
    "synthetic": Row(name="PSIM, 400 modes", errors_nm=(195.0, 41.7, 30.1)),
    "measured": Row(name="LBT, 400 modes", errors_nm=(216.0, 42.1, 30.8)),
    "more": Row(name="PSIM, 500 modes", errors_nm=(228.3, 42.5, 27.39)),
}
"""Table 2, as quoted in the project's issue."""

REGISTRATION = {
    "shift_x_subap": Quoted(values=(-92.0,), unit="%", where=AS_QUOTED),
    "shift_y_subap": Quoted(values=(35.0,), unit="%", where=AS_QUOTED),
    "rotation_deg": Quoted(values=(65.08,), unit="deg", where=AS_QUOTED),
    "magnification": Quoted(values=(98.0,), unit="%", where=AS_QUOTED),
}
START = Quoted(values=(64.5,), unit="deg", where=AS_QUOTED)
BORDER_RULE = Quoted(values=(25.0,), unit="% of a subaperture per degree", where=AS_QUOTED)
CONDITION_SYNTHETIC = Quoted(values=(8.1,), unit="", where=AS_QUOTED)
CONDITION_MEASURED = Quoted(values=(8.85,), unit="", where=AS_QUOTED)
SIMULATED_SYNTHETIC = Quoted(values=(128.0,), unit="nm", where=f"simulation, {AS_QUOTED}")
SIMULATED_MEASURED = Quoted(values=(147.0,), unit="nm", where=f"simulation, {AS_QUOTED}")
MARKED_ROTATION = Quoted(values=(0.8,), unit="deg", where=AS_QUOTED)
MARKED_SHIFT = Quoted(values=(40.0,), unit="%", where=AS_QUOTED)

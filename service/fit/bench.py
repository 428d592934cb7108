"""The models of one fit: from coarse and cheap to as fine as the answer needs."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property

from service.fit.joint import Counter
from service.fit.lowest import Lowest, lowest_of
from service.model.instrument import Instrument, Stop
from service.model.interaction import InteractionModel
from service.model.modes import Basis
from service.model.pupil import Illumination
from service.model.pyramid import Mapper

COARSE, CHEAP, FINE = 1, 2, 3
"""Pupil points per subaperture, and nodes, of the models for far steps, derivatives, residuals.
Against 8 points the fine one is biased by 0.02 % of a subaperture and 0.004 % of magnification."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Other:
    """A change of the instrument file."""

    words: str
    """Key and value, as the file would say them."""

    says_what_moves: bool = False
    """Whether a registration means something else with it."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Bench:
    """One instrument and the modes to be fitted, at several samplings; each made when needed."""

    instrument: Instrument
    """Its orientation settled."""

    basis: Basis
    """Only the modes that are fitted."""

    illumination: Illumination | None = None
    mapper: Mapper = map
    counter: Counter = field(default_factory=Counter)

    def model(
        self, sampling: int, basis: Basis | None = None, instrument: Instrument | None = None
    ) -> InteractionModel:
        """Return a model of this sampling; ``basis`` and ``instrument`` stand in for the own."""
        return InteractionModel(
            instrument or self.instrument,
            basis or self.basis,
            pupil_sampling=sampling,
            detector_nodes=sampling,
            illumination=self.illumination,
            mapper=self.mapper,
        )

    @cached_property
    def lowest(self) -> Lowest:
        """The smoothest shapes of the modes."""
        return lowest_of(self.model(COARSE))

    @cached_property
    def far(self) -> InteractionModel:
        """Leads from afar: the smoothest shapes on the coarse grid."""
        return self.model(COARSE, self.lowest.shapes)

    @cached_property
    def cheap(self) -> InteractionModel:
        """For derivatives near the solution."""
        return self.model(CHEAP)

    @cached_property
    def fine(self) -> InteractionModel:
        """Decides."""
        return self.model(FINE)

    @property
    def others(self) -> dict[Other, Instrument]:
        """Instruments that this one may be taken for, by what to change in the file."""
        wfs = self.instrument.wfs
        radius = wfs.modulation_lambda_over_d
        stop = Stop.TELESCOPE if self.instrument.stop is Stop.MIRROR else Stop.MIRROR
        moves = Other(words=f'stop = "{stop}"', says_what_moves=True)
        found = {moves: replace(self.instrument, stop=stop)}
        for factor in (0.5, 2.0) if radius > 0.0 else ():
            changed = replace(wfs, modulation_lambda_over_d=factor * radius)
            turned = Other(words=f"modulation_lambda_over_d = {factor * radius:g}")
            found[turned] = replace(self.instrument, wfs=changed)
        return found

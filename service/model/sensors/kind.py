"""The keys of a kind of sensor in an instrument file.

Loaded when a command line starts: all that needs mathematics is behind ``SensorKind.model``.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any, ClassVar

if TYPE_CHECKING:
    from service.model.kinds import SignalKind
    from service.model.sensors.model import SensorModel


class SensorKind(ABC):
    """One kind of wavefront sensor, as an instrument file has it."""

    name: ClassVar[str]
    """``wfs.kind`` of an instrument file."""

    table: ClassVar[type[Any]]
    """Type of the ``[wfs]`` table: a dataclass that pydantic can read.

    Every kind has ``n_subapertures``, ``pupil_diameter`` (subapertures) and ``valid_subapertures``:
    a mask ``path:/dataset``, or "auto", by ``flux_threshold``, which no mask allows.
    """

    unknown: ClassVar[Mapping[str, float | None]] = {}
    """Keys that may be "unknown", with the value assumed until a measured matrix determines it;
    None if a missing key means the same."""

    signals: ClassVar[tuple[SignalKind, ...]]
    """Kinds of signals of its subapertures."""

    normalised: ClassVar[bool] = False
    """True if signals are divided by a flux; ``slopes.normalisation`` selects which."""

    @property
    @abstractmethod
    def model(self) -> SensorModel:
        """Optics and light of the sensor; imported at the first use."""

    def as_read(self, written: Mapping[str, Any]) -> Mapping[str, Any]:
        """Return ``[wfs]`` as it is to be held against the table.

        Raises
        ------
        ModelError
            One line that begins with the key.
        """
        return written

    def list_assumptions(self, table: Any, given: frozenset[str]) -> Iterator[tuple[str, str]]:  # noqa: ANN401
        """Yield keys that the table leaves out, and what is taken instead."""
        yield from ()

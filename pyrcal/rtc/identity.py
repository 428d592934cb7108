"""Names that telemetry and reconstructors carry: system, modal basis, sensor, references."""

from __future__ import annotations

import uuid
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from service.wire import CHUNK_LIMIT, Manifest, layout_of

Array32 = NDArray[np.float32]


@dataclass(frozen=True, slots=True, kw_only=True)
class Identity:
    """System, modal basis, sensor configuration and reference slopes of an RTC.

    The service accepts telemetry, and the RTC a reconstructor, only if the first three agree.
    """

    system: str
    """Name of the AO system; part of every key on the link."""

    basis_id: str
    """Name of the modal basis. It must change when the basis changes."""

    config_id: str
    """Name of the sensor configuration. It must change when the sensor's geometry changes."""

    reference_id: str | None = None
    """Name of the reference slopes. It must change when they change; None if they have no name."""

    double_pass: bool = False
    """True if the light is reflected by the mirror twice, as with a retro-reflector by day."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Reconstructor:
    """A control matrix with its manifest."""

    manifest: Manifest
    """Id, registration, checksum and shape of the matrix."""

    matrix: Array32
    """``(n_controlled, n_slopes)``, metres of OPD per unit of slope."""

    @classmethod
    def own(
        cls,
        name: str,
        matrix: Array32,
        identity: Identity,
        *,
        created_ns: int,
        alpha: Mapping[str, float] | None = None,
    ) -> Self:
        """Return a reconstructor that the RTC has by itself, not from the service.

        Parameters
        ----------
        name
            Id of the matrix; a different matrix needs a different id.
        matrix
            ``(n_controlled, n_slopes)``, metres of OPD per unit of slope.
        identity
            Names of the RTC.
        created_ns
            Nanoseconds since the Unix epoch, UTC.
        alpha
            Registration that the matrix was made for; None if it is not known.
        """
        manifest = Manifest(
            id=name,
            layout=layout_of(matrix, CHUNK_LIMIT),
            alpha=alpha,
            sigma=None,
            im_id=None,
            parent=None,
            basis_id=identity.basis_id,
            config_id=identity.config_id,
            system=identity.system,
            created_ns=created_ns,
        )
        return cls(manifest=manifest, matrix=matrix)


def new_session() -> str:
    """Return a session name that no other session has."""
    return uuid.uuid4().hex[:16]

"""Import calibration files of pyRTC: ``.npz`` with a record since 2.0, bare ``.npy`` before.

A bare array has no description, so its role must be given. Before 2.0, Shack-Hartmann sensors with
an even number of pixels had their reference off by half a pixel; a matrix is a difference, so it is
not affected.
"""

from __future__ import annotations

import json
from collections.abc import Mapping

import numpy as np

from pyrcal.importers.imported import Array
from service.errors import MatrixError

RECORD, DATA, FORMAT = "pyrtc_calibration", "data", 2
KINDS = {"interaction_matrix": "matrix", "valid_sub_aps": "valid"}
"""Roles by the kind in pyRTC's record."""


def calibration_of(arrays: Mapping[str, Array], where: str) -> tuple[str, Array]:
    """Return the role and the array of a calibration file of pyRTC 2.

    Raises
    ------
    MatrixError
        If it has no record, or one that is newer or of another calibration.
    """
    try:
        record = json.loads(str(np.asarray(arrays[RECORD])[()]))
        kind, version, values = record["kind"], int(record["format"]), arrays[DATA]
    except (KeyError, TypeError, ValueError) as error:
        raise MatrixError(
            f"{where}: found no record of pyRTC 2 ({RECORD}), expected one, or ROLE=FILE"
        ) from error
    if version > FORMAT or kind not in KINDS:
        raise MatrixError(
            f"{where}: found {kind} of format {version}, expected {' or '.join(KINDS)} of format "
            f"{FORMAT}"
        )
    return KINDS[kind], values

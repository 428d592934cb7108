"""A record survives the archive, whatever it holds."""

import json

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from service.archive.serialisation import from_json, to_json
from service.model.misregistration import Misregistration
from service.records.products import GateVerdict, MatrixState, ReconstructorRecord

numbers = st.floats(-10, 10)
radii = st.floats(0, allow_nan=False)
alphas = st.builds(
    Misregistration,
    shift_x_subap=numbers,
    shift_y_subap=numbers,
    rotation_rad=numbers,
    magnification=st.floats(0.5, 2),
)
verdicts = st.builds(
    GateVerdict,
    accepted=st.booleans(),
    worst_pole_radius=radii,
    aligned_pole_radius=radii,
    bound=radii,
    n_points=st.integers(0, 1000),
    reason=st.text(),
)
records = st.builds(
    ReconstructorRecord,
    id=st.from_regex(r"[A-Za-z0-9._-]{1,64}", fullmatch=True),
    state=st.sampled_from(MatrixState),
    n_modes=st.integers(1, 5000),
    created_ns_utc=st.integers(0, 2**63 - 1),
    alpha=st.none() | alphas,
    sigma=st.none() | st.lists(st.floats(0, 10), min_size=4, max_size=4).map(np.array),
    parent=st.none() | st.text(),
    sha256=st.text(),
    condition_number=st.none() | radii,
    gate=st.none() | verdicts,
    reason=st.text(),
    published_ns_utc=st.none() | st.integers(0, 2**63 - 1),
    applied_frame_seq=st.none() | st.integers(0, 2**63 - 1),
)


@given(records)
def test_a_record_comes_back_from_json_as_it_was(record):
    found = from_json(to_json(record), ReconstructorRecord)
    for name in set(ReconstructorRecord.__slots__) - {"alpha", "sigma"}:
        assert getattr(found, name) == getattr(record, name), name
    for name, vector in (("alpha", "vector"), ("sigma", "real")):
        value, expected = getattr(found, name), getattr(record, name)
        assert (value is None) == (expected is None)
        if expected is not None:
            np.testing.assert_allclose(
                getattr(value, vector), getattr(expected, vector), rtol=1e-14, atol=1e-300
            )


@given(records)
def test_angles_leave_in_degrees(record):
    values = json.loads(to_json(record))
    if record.alpha is not None:
        rotation_deg = values["alpha"]["rotation_deg"]
        np.testing.assert_allclose(rotation_deg, np.rad2deg(record.alpha.rotation_rad), rtol=1e-14)

from dataclasses import replace

import numpy as np
import pytest

from pyrcal.rtc.identity import Identity
from pyrcal.rtc.staging import Staging, Terms
from service.wire import AckState, Manifest, layout_of, split
from sim_rtc.computer.reconstructors import ReferenceSchedule, compute_truncated_inverse

TERMS = Terms(
    session="s1",
    identity=Identity(system="small", basis_id="basis", config_id="sensor"),
    n_slopes=12,
    n_controlled=(8, 6),
)
MATRIX = np.random.default_rng(1).standard_normal((6, 12)).astype(np.float32)
CHUNK_BYTES = 100


def manifest(matrix=MATRIX, **changes):
    return (
        Manifest(
            id="m1",
            layout=layout_of(matrix, CHUNK_BYTES),
            alpha=None,
            sigma=None,
            im_id=None,
            parent=None,
            basis_id="basis",
            config_id="sensor",
            system="small",
            created_ns=1,
        )
        if not changes
        else replace(manifest(matrix), **changes)
    )


@pytest.fixture
def staging():
    return Staging(lambda: TERMS, limit_bytes=4 * 12 * 8)


def send(staging, matrix=MATRIX, leave_out=(), matrix_id="m1"):
    outcomes = [
        staging.chunk(matrix_id, k, data)
        for k, data in enumerate(split(matrix, CHUNK_BYTES))
        if k not in leave_out
    ]
    return outcomes[-1]


def states(outcome):
    return [verdict.state for verdict in outcome.acknowledgements]


@pytest.mark.parametrize("commit_first", [True, False])
def test_a_whole_matrix_is_staged_in_whatever_order_it_comes(staging, commit_first):
    if commit_first:
        assert staging.commit(manifest(), 0.0).acknowledgements == []
        outcome = send(staging)
    else:
        assert send(staging).acknowledgements == []
        outcome = staging.commit(manifest(), 0.0)
    assert states(outcome) == [AckState.STAGED]
    np.testing.assert_array_equal(outcome.staged[0].matrix, MATRIX)
    applied = staging.applied("m1", 1230)
    assert (applied.state, applied.frame_seq) == (AckState.APPLIED, 1230)
    assert staging.commit(manifest(), 5.0).acknowledgements == [applied]


def test_missing_chunks_are_asked_for_after_two_seconds_and_given_up_after_four(staging):
    staging.commit(manifest(), 10.0)
    send(staging, leave_out=(1,))
    assert staging.poll(11.9).missing == []
    assert staging.poll(12.0).missing == [("m1", (1,))]
    assert staging.poll(13.9).missing == []
    outcome = staging.poll(14.0)
    assert states(outcome) == [AckState.REJECTED]
    assert outcome.acknowledgements[0].reason == "missing: chunks [1], 1 in all"


def test_an_asked_for_chunk_completes_the_matrix(staging):
    staging.commit(manifest(), 10.0)
    send(staging, leave_out=(1,))
    staging.poll(12.0)
    outcome = staging.chunk("m1", 1, split(MATRIX, CHUNK_BYTES)[1])
    assert states(outcome) == [AckState.STAGED]
    assert staging.poll(20.0).acknowledgements == []


def test_a_chunk_of_the_wrong_length_is_asked_for_again(staging):
    staging.chunk("m1", 0, b"short")
    staging.commit(manifest(), 0.0)
    send(staging, leave_out=(0,))
    assert staging.poll(2.0).missing == [("m1", (0,))]


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"basis_id": "other"}, "id: basis_id 'other', expected 'basis'"),
        ({"config_id": "other"}, "id: config_id 'other', expected 'sensor'"),
        ({"system": "big"}, "id: system 'big', expected 'small'"),
        (
            {"layout": layout_of(MATRIX[:5], CHUNK_BYTES)},
            "range: shape [5, 12], expected [8, 12] or [6, 12]",
        ),
    ],
)
def test_what_does_not_fit_is_rejected_at_once(staging, changes, reason):
    outcome = staging.commit(manifest(**changes), 0.0)
    assert states(outcome) == [AckState.REJECTED]
    assert outcome.acknowledgements[0].reason == reason
    assert send(staging).acknowledgements == []


def test_other_bytes_than_announced_are_rejected(staging):
    staging.commit(manifest(), 0.0)
    outcome = send(staging, 2 * MATRIX)
    assert states(outcome) == [AckState.REJECTED]
    assert "sha256" in outcome.acknowledgements[0].reason


def test_an_id_is_never_used_again_for_another_matrix(staging):
    send(staging)
    staging.commit(manifest(), 0.0)
    outcome = staging.commit(manifest(2 * MATRIX), 1.0)
    assert states(outcome) == [AckState.REJECTED]
    assert outcome.acknowledgements[0].reason.startswith("id: m1 was used with sha256")
    assert states(staging.commit(manifest(), 2.0)) == [AckState.STAGED]


def test_a_new_session_voids_what_is_not_applied(staging):
    send(staging)
    staging.commit(manifest(), 0.0)
    staging.void()
    assert staging.applied("m1", 10) is None
    assert staging.commit(manifest(), 1.0).acknowledgements == []


def test_only_a_few_matrices_are_collected_at_a_time(staging):
    for name in "abcdef":
        send(staging, leave_out=(0,), matrix_id=name)
    for name in "abcdef":
        staging.commit(manifest(id=name), 0.0)
    # a and b were forgotten, c to f pushed out by them in turn.
    assert len(staging.poll(2.0).missing) == 4


def test_the_inverse_leaves_directions_the_sensor_hardly_sees():
    rng = np.random.default_rng(2)
    left, _ = np.linalg.qr(rng.standard_normal((20, 5)))
    right, _ = np.linalg.qr(rng.standard_normal((5, 5)))
    values = np.array([4.0, 3.0, 2.0, 1.0, 1e-4])
    inverse = compute_truncated_inverse((left * values @ right.T).astype(np.float32))
    identity = inverse @ (left * values @ right.T)
    np.testing.assert_allclose(identity, right[:, :4] @ right[:, :4].T, atol=1e-3)


def test_a_schedule_of_references_makes_a_shape_of_the_given_strength_at_each_time():
    """20 %: the RMS of 200 shapes of 20 modes, of which the first is strongest."""
    rng = np.random.default_rng(1)
    interaction = np.linalg.qr(rng.normal(size=(60, 30)))[0]
    matrix = np.linalg.pinv(interaction).astype(np.float32)
    schedule = ReferenceSchedule(matrix, rms_m=1e-7, period_s=15.0, named_by="config_id", seed=1)
    assert schedule.next(14.9) is None
    shapes_m, names = [], []
    for k in range(1, 201):
        references, name = schedule.next(15.0 * k)
        assert schedule.next(15.0 * k) is None
        shapes_m.append(matrix @ references)
        names.append(name)
    assert names[:2] == [{"config_id": "references-1"}, {"config_id": "references-2"}]
    shapes_m = np.array(shapes_m)
    assert np.sqrt(np.mean(np.sum(shapes_m**2, axis=1))) == pytest.approx(1e-7, rel=0.2)
    np.testing.assert_allclose(shapes_m[:, [0, 1, *range(22, 30)]], 0.0, atol=1e-12)

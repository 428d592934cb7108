"""However frames arrive, what is drained is in order, true to its number, and accounted for."""

from collections import Counter
from dataclasses import replace

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from service.link.ring import FrameRing
from service.wire import FrameBatch, FrameHeader

CAPACITY = 64
PATIENCE_S = 0.5


def batch(seq0, n, bad=()):
    header = FrameHeader(
        session="s",
        seq0=seq0,
        n=n,
        t0_ns=10**9 + seq0 * 1000,
        dt_ns=1000,
        n_slopes=2,
        n_modes=1,
        dither=False,
        cm_id=None,
        basis_id="b",
        config_id="c",
    )
    rows = np.repeat(np.arange(seq0, seq0 + n, dtype=np.float32)[:, None], 3, axis=1)
    rows[[i for i in range(n) if seq0 + i in bad]] = np.nan
    return FrameBatch(header=header, rows=rows)


STEPS = st.lists(
    st.tuples(
        st.integers(-40, 20),  # where the batch begins, relative to the newest frame so far
        st.integers(1, 20),
        st.sampled_from([0.0, 0.0, 0.01, 0.6]),  # seconds until it comes
        st.booleans(),  # whether the consumer looks afterwards
    ),
    max_size=60,
)


@settings(max_examples=150)
@given(steps=STEPS, bad=st.sets(st.integers(900, 1400), max_size=20))
def test_frames_come_out_once_in_order_and_every_number_is_accounted_for(steps, bad):
    first, now_s, sent = 1000, 0.0, 1
    counts = Counter()
    ring = FrameRing(batch(first, 1).header, CAPACITY, counts)
    ring.store(batch(first, 1, bad), now_s)
    head, blocks = first + 1, []
    for offset, n, wait_s, look in steps:
        now_s += wait_s
        seq0 = max(0, head + offset)
        ring.store(batch(seq0, n, bad), now_s)
        sent += n
        head = max(head, seq0 + n)
        if look:
            blocks += ring.take(now_s, PATIENCE_S, 10**6)
    delivered = np.concatenate(
        [b.first_seq + np.arange(b.n_frames) for b in blocks] or [np.empty(0)]
    )
    values = np.concatenate([b.slopes[:, 0] for b in blocks] or [np.empty(0)])
    assert np.all(np.diff(delivered) > 0)
    assert np.array_equal(values, delivered)
    assert not set(delivered) & bad
    for block in blocks:
        assert block.t0_ns_utc == 10**9 + block.first_seq * 1000
    assert counts["received"] + counts["nonfinite"] + counts["duplicate"] + counts["late"] == sent
    assert counts["received"] + counts["nonfinite"] + counts["lost"] == head - first
    assert len(delivered) + counts["overwritten"] + ring.undelivered == counts["received"]


@given(change=st.sampled_from(["reference_id", "config_id"]), n_before=st.integers(1, 20))
def test_new_references_begin_a_block_by_whichever_id_they_are_named(change, n_before):
    one, other = batch(0, n_before), batch(n_before, 7)
    ring = FrameRing(one.header, CAPACITY, Counter())
    ring.store(one, 0.0)
    ring.store(replace(other, header=replace(other.header, **{change: "ncpa-2"})), 0.0)
    blocks = ring.take(0.0, PATIENCE_S, 10**6)
    named = [(block.first_seq, block.n_frames, block.reference_name) for block in blocks]
    assert named == [(0, n_before, "c"), (n_before, 7, "ncpa-2")]
    assert not blocks[1].follows(blocks[0])


@given(order=st.permutations(range(8)))
def test_batches_in_any_order_come_out_as_one_block_when_the_first_came_first(order):
    counts = Counter()
    ring = FrameRing(batch(0, 5).header, CAPACITY, counts)
    ring.store(batch(0, 5), 0.0)
    for k in order:
        ring.store(batch(5 + 5 * k, 5), 0.0)
    (block,) = ring.take(0.0, PATIENCE_S, 10**6)
    assert (block.first_seq, block.n_frames) == (0, 45)
    assert counts["lost"] == 0

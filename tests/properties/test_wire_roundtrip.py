"""Whatever travels comes out as it went in, and no bytes whatever do more than raise WireError."""

import string
from dataclasses import fields
from functools import partial

import msgpack
import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from service.errors import WireError
from service.model.misregistration import PARAMETERS
from service.wire import (
    Acknowledgement,
    AckState,
    AlarmMessage,
    ChunkAssembler,
    CommandKind,
    FrameHeader,
    GainsMessage,
    LoopRequest,
    Manifest,
    MeasuredManifest,
    RampRequest,
    ReferencesInUse,
    ReferencesRequest,
    Reply,
    StateMessage,
    Status,
    checksum,
    command_id,
    decode,
    decode_command,
    decode_frames,
    encode,
    encode_frames,
    layout_of,
    split,
)

IDS = st.text(string.ascii_letters + string.digits + "._-", min_size=1, max_size=64).filter(
    lambda name: name not in {"ack", "current"}
)
OPAQUE = st.text(min_size=1, max_size=128).filter(str.isprintable)
COUNTS = st.integers(0, 2**62)
HEADERS = st.builds(
    FrameHeader,
    session=OPAQUE,
    seq0=COUNTS,
    n=st.integers(1, 50),
    t0_ns=COUNTS,
    dt_ns=st.integers(1, 10**12),
    n_slopes=st.integers(1, 30),
    n_modes=st.integers(1, 20),
    dither=st.booleans(),
    cm_id=st.none() | IDS,
    basis_id=OPAQUE,
    config_id=OPAQUE,
)
MATRICES = hnp.arrays(
    np.float32,
    hnp.array_shapes(min_dims=2, max_dims=2, max_side=12),
    elements=st.floats(width=32, allow_nan=False, allow_infinity=False),
)
NUMBERS = st.floats(allow_nan=False, allow_infinity=False)
REGISTRATIONS = st.fixed_dictionaries(
    dict.fromkeys(PARAMETERS[:3], NUMBERS)
    | {"magnification": st.floats(0.1, 10.0, allow_nan=False)}
)


@given(header=HEADERS, seed=st.integers(0, 2**32 - 1))
def test_frames_come_out_bit_for_bit(header, seed):
    shape = (header.n, header.n_columns)
    bits = np.random.default_rng(seed).integers(0, 2**32, shape, dtype=np.uint32)
    payload, attachment = encode_frames(header, bits.view(np.float32))
    batch = decode_frames(payload, attachment)
    assert batch.header == header
    assert np.array_equal(batch.rows.view(np.uint32), bits)


@given(matrix=MATRICES, chunk_bytes=st.integers(1, 100), data=st.data())
def test_a_matrix_survives_any_cutting_any_order_and_repetition(matrix, chunk_bytes, data):
    layout = layout_of(matrix, chunk_bytes)
    parts = list(enumerate(split(matrix, chunk_bytes)))
    assert len(parts) == layout.n_chunks
    order = data.draw(st.permutations(parts + parts[:3]))
    announced = data.draw(st.integers(0, len(order)))
    assembler = ChunkAssembler()
    for index, part in order[:announced]:
        assembler.add(index, part)
    assembler.announce(layout)
    for index, part in order[announced:]:
        assembler.add(index, part)
    assert assembler.missing() == ()
    assert np.array_equal(assembler.matrix().view(np.uint32), matrix.view(np.uint32))


@given(
    matrix=MATRICES,
    chunk_bytes=st.integers(1, 100),
    name=IDS,
    alpha=st.none() | REGISTRATIONS,
    parent=st.none() | IDS,
    basis_id=OPAQUE,
    created_ns=COUNTS,
)
def test_manifests_come_out_as_they_went_in(
    matrix, chunk_bytes, name, alpha, parent, basis_id, created_ns
):
    manifest = Manifest(
        id=name,
        layout=layout_of(matrix, chunk_bytes),
        alpha=alpha,
        sigma=alpha,
        im_id=None,
        parent=parent,
        basis_id=basis_id,
        config_id=basis_id,
        system=name,
        created_ns=created_ns,
    )
    assert decode(Manifest, encode(manifest)) == manifest


@given(name=IDS, session=OPAQUE, frame_seq=st.none() | COUNTS, reason=OPAQUE)
def test_acknowledgements_come_out_as_they_went_in(name, session, frame_seq, reason):
    acknowledgement = Acknowledgement(
        session=session,
        id=name,
        sha256="0123456789abcdef" * 4,
        state=AckState.REJECTED if frame_seq is None else AckState.APPLIED,
        reason=reason,
        frame_seq=frame_seq,
    )
    assert decode(Acknowledgement, encode(acknowledgement)) == acknowledgement


@given(
    name=IDS,
    gains=st.none() | st.lists(st.floats(0.0, 2.0), max_size=20).map(tuple),
    leak=st.none() | st.floats(0.0, 1.0),
    n_controlled=st.none() | COUNTS,
)
def test_loop_commands_come_out_as_they_went_in(name, gains, leak, n_controlled):
    command = LoopRequest(id=name, gains=gains, leak=leak, n_controlled=n_controlled)
    assert decode_command(CommandKind.LOOP, encode(command)) == command


@given(
    name=IDS,
    edges=st.lists(st.integers(0, 2**62), min_size=2, max_size=8, unique=True),
    order=st.randoms(use_true_random=False),
    gains=st.lists(st.floats(1e-6, 2.0), min_size=1, max_size=20).map(tuple),
    frames_per_gain=st.integers(1, 1_000_000),
)
def test_ramp_commands_come_out_as_they_went_in(name, edges, order, gains, frames_per_gain):
    edges = sorted(edges)[: len(edges) // 2 * 2]
    groups = list(zip(edges[::2], edges[1::2], strict=True))
    order.shuffle(groups)
    command = RampRequest(
        id=name, groups=tuple(groups), gains=gains, frames_per_gain=frames_per_gain
    )
    assert decode_command(CommandKind.RAMP, encode(command)) == command


@given(matrix=MATRICES, name=IDS, own=OPAQUE, ramp_s=st.floats(0.0, 60.0))
def test_references_come_out_as_they_went_in(matrix, name, own, ramp_s):
    slopes = matrix.ravel().astype("<f4")
    offset = {"slopes": slopes.tobytes(), "sha256": checksum(slopes)}
    command = ReferencesRequest(id=name, reference_id=name, config_id=own, ramp_s=ramp_s, **offset)
    received = decode_command(CommandKind.REFERENCES, encode(command))
    assert received == command
    assert np.array_equal(received.offset.view(np.uint32), slopes.view(np.uint32))
    in_use = ReferencesInUse(reference_id=own, **offset)
    assert decode(ReferencesInUse, encode(in_use)) == in_use


LEAVES = (
    st.none() | st.booleans() | st.integers(-(2**63), 2**64 - 1) | st.floats() | st.text()
) | st.binary()
RECORDS = (
    *(FrameHeader, Manifest, LoopRequest, RampRequest, Acknowledgement, Status),
    ReferencesRequest,
)
KEYS = st.sampled_from(
    [f.name for record in RECORDS for f in fields(record)]
    + ["v", "shape", "dtype", "n_chunks", "chunk_bytes", "action", "kind", "modes", "accepted"]
)
TREES = st.recursive(
    LEAVES, lambda below: st.lists(below, max_size=4) | st.dictionaries(KEYS, below, max_size=8)
)
MESSAGES = st.dictionaries(KEYS, TREES, max_size=25).map(
    lambda values: msgpack.packb({"v": 1} | values)
)
DECODERS = st.sampled_from(
    [
        *(
            partial(decode, kind)
            for kind in (
                Status,
                Acknowledgement,
                StateMessage,
                AlarmMessage,
                GainsMessage,
                Manifest,
                MeasuredManifest,
                ReferencesInUse,
                Reply,
            )
        ),
        command_id,
        *(lambda data, kind=kind: decode_command(kind, data) for kind in CommandKind),
        lambda data: decode_frames(b"", data),
    ]
)


@settings(max_examples=200)
@given(decoder=DECODERS, data=st.binary(max_size=300) | MESSAGES | TREES.map(msgpack.packb))
def test_no_bytes_do_more_than_raise_a_wire_error(decoder, data):
    try:
        decoder(data)
    except WireError as error:
        assert str(error).split(":")[0] in {"missing", "v", "id", "range"}  # noqa: PT017

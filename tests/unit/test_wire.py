"""The wire contract: what travels, and what is refused with which words."""

from dataclasses import replace

import msgpack
import numpy as np
import pytest

from service.errors import WireError
from service.wire import (
    ChunkAssembler,
    CommandKind,
    DitherKind,
    DitherRequest,
    DitherStatus,
    FrameHeader,
    Keys,
    Loop,
    Manifest,
    MeasuredManifest,
    OffloadRequest,
    Pattern,
    Pointing,
    RampRequest,
    Role,
    StateMessage,
    Status,
    checksum,
    command_id,
    decode,
    decode_command,
    decode_frames,
    encode,
    encode_frames,
    essentials,
    layout_of,
    split,
)

ALPHA = {"shift_x_subap": 0.1, "shift_y_subap": -0.2, "rotation_deg": 65.3, "magnification": 1.005}
MATRIX = np.arange(12, dtype=np.float32).reshape(3, 4)

HEADER = FrameHeader(
    session="s1",
    seq0=1000,
    n=2,
    t0_ns=1_800_000_000_000_000_000,
    dt_ns=1_000_000,
    n_slopes=3,
    n_modes=2,
    dither=True,
    cm_id="r-1",
    basis_id="kl/594",
    config_id="mask 1",
)
ROWS = np.arange(14, dtype=np.float32).reshape(2, 7)

DITHER = DitherRequest(
    id="d-1",
    kind=DitherKind.SINE,
    modes=(501, 450),
    amplitude_m=(5e-9, 4e-9),
    frequency_hz=(250.0, 240.0),
    duration_s=5.0,
)

STATUS = Status(
    session="s1",
    seq=5000,
    t_ns=1_800_000_000_000_000_000,
    loop=Loop.CLOSED,
    frame_rate_hz=1000.0,
    delay_frames=2.0,
    gains=(0.4, 0.4, 0.0),
    leak=0.99,
    n_slopes=4,
    n_modes=3,
    n_controlled=2,
    cm_id=None,
    basis_id="kl/594",
    config_id="mask 1",
    dither=DitherStatus(request=DITHER, start_seq=4000),
    max_dither_m=2e-8,
    max_dither_modes=4,
    magnitude=None,
    flux=np.arange(16, dtype="<f4").tobytes(),
)

MANIFEST = Manifest(
    id="r-1",
    layout=layout_of(MATRIX, 20),
    alpha=ALPHA,
    sigma=ALPHA,
    im_id=None,
    parent="r-0",
    basis_id="kl/594",
    config_id="mask 1",
    system="flao-lbt",
    created_ns=7,
)


MEASURED = MeasuredManifest(
    id="m-1",
    layout=layout_of(MATRIX, 20),
    reason=None,
    modes=(0, 5, 9, 2),
    amplitude_m=(1e-8,) * 4,
    n_average=4,
    pattern=Pattern.PUSH_PULL_MODAL,
    double_pass=True,
    session="s1",
    basis_id="kl/594",
    config_id="mask 1",
    system="flao-lbt",
    created_ns=7,
)


def changed(data, **changes):
    """The same message with some keys changed, or left out where the value is Ellipsis."""
    values = msgpack.unpackb(data) | changes
    return msgpack.packb({k: v for k, v in values.items() if v is not ...})


# ---------------------------------------------------------------- frames


def test_a_decoded_batch_shares_the_received_bytes_and_names_their_parts():
    payload, attachment = encode_frames(HEADER, ROWS)
    batch = decode_frames(payload, attachment)
    assert batch.header == HEADER
    assert np.shares_memory(batch.rows, np.frombuffer(payload, np.float32))
    assert batch.slopes.tolist() == [[0, 1, 2], [7, 8, 9]]
    assert batch.commands_m.tolist() == [[3, 4], [10, 11]]
    assert batch.dither_m.tolist() == [[5, 6], [12, 13]]


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"v": 2}, "v: 2 .*, expected 1"),
        ({"v": True}, "v: True"),
        ({"seq0": -1}, "seq0 is -1 .*, expected an integer from 0"),
        ({"seq0": 1.5}, "seq0 is 1.5 .*, expected an integer"),
        ({"n": 51}, "n is 51 .*, expected an integer from 1 to 50"),
        ({"n": 3}, "has 56 bytes, expected 84 for 3 rows of 7 float32"),
        ({"dither": False}, "has 56 bytes, expected 40"),
        ({"dither": 1}, "dither is 1 .*, expected true or false"),
        ({"dt_ns": 0}, "dt_ns is 0"),
        ({"cm_id": "a/b"}, "id: 'a/b' in key 'cm_id'"),
        ({"cm_id": "current"}, "id: 'current' in key 'cm_id' .* is reserved"),
        ({"basis_id": ""}, "basis_id is ''"),
        ({"session": None}, "session is None"),
        ({"n_slopes": 2_000_000}, "n_slopes is 2000000"),
        ({"junk": "x" * 5000}, "has 51.. bytes, expected at most 4096"),
    ],
)
def test_a_bad_attachment_is_refused_by_key_found_and_expected(changes, words):
    payload, attachment = encode_frames(HEADER, ROWS)
    with pytest.raises(WireError, match=words):
        decode_frames(payload, changed(attachment, **changes))


def test_an_unknown_key_is_ignored():
    payload, attachment = encode_frames(HEADER, ROWS)
    assert decode_frames(payload, changed(attachment, new_in_v1_1=3)).header == HEADER


@pytest.mark.parametrize("attachment", [b"", b"\xc1", b"\x91", b"\xff\xff", b"\x81\x01\x02"])
def test_bytes_that_are_no_message_are_refused(attachment):
    with pytest.raises(WireError, match=r"is not msgpack|expected a map"):
        decode_frames(b"", attachment)


def test_a_batch_without_attachment_or_beyond_the_limit_is_refused_unread():
    with pytest.raises(WireError, match="missing: attachment"):
        decode_frames(b"", None)
    with pytest.raises(WireError, match="4000001 bytes, expected at most 4000000"):
        decode_frames(bytes(4_000_001), b"not even looked at")


def test_rows_of_another_shape_than_the_header_says_are_not_sent():
    with pytest.raises(WireError, match=r"shape \(2, 6\), expected \(2, 7\)"):
        encode_frames(HEADER, ROWS[:, :6])


# ---------------------------------------------------------------- status, acknowledgement, reply


def test_a_status_keeps_everything_it_says():
    assert decode(Status, encode(STATUS)) == STATUS
    assert STATUS.flux_images.shape == (4, 2, 2)
    assert STATUS.flux_images[3, 1, 1] == 15.0


def test_the_state_says_what_alpha_is_worth_and_one_of_before_that_is_read_too():
    said = StateMessage(
        system="flao",
        t_ns=1,
        mode="auto",
        alpha=ALPHA,
        sigma=ALPHA,
        in_use="cm-1",
        validity="stale",
    )
    assert decode(StateMessage, encode(said)) == said
    assert decode(StateMessage, changed(encode(said), validity=...)) == replace(said, validity=None)


def test_an_rtc_may_say_where_the_telescope_looks_or_know_nothing_of_it():
    looking = replace(STATUS, pointing=Pointing(elevation_deg=61.5, azimuth_deg=-20.0))
    assert decode(Status, encode(looking)) == looking
    for unknown in (..., None):
        assert decode(Status, changed(encode(looking), pointing=unknown)) == STATUS


def test_an_rtc_may_say_what_is_wrong_on_its_side():
    troubled = replace(STATUS, trouble="aol1_imWFS2: its counter stands at 7")
    assert decode(Status, encode(troubled)) == troubled
    assert b"trouble" not in encode(STATUS), "who has none says what was said before there was one"
    assert decode(Status, changed(encode(troubled), trouble=None)) == STATUS


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"pointing": {"elevation_deg": 60.0}}, "missing: key 'azimuth_deg' in 'pointing'"),
        (
            {"pointing": {"elevation_deg": 91.0, "azimuth_deg": 0.0}},
            "elevation_deg is 91.0 .*, expected a finite number from -90 to 90",
        ),
        ({"gains": [0.4, 0.4]}, "gains is a list of 2 .*, expected one for each of 3 modes"),
        ({"gains": [0.4, float("nan"), 0.1]}, "gains is nan"),
        ({"gains": "high"}, "gains is 'high' .*, expected a list"),
        ({"leak": 1.01}, "leak is 1.01 .*, expected a finite number from 0 to 1"),
        ({"frame_rate_hz": 0}, "frame_rate_hz is 0 .*, expected a finite number > 0"),
        ({"frame_rate_hz": True}, "frame_rate_hz is True"),
        ({"loop": "ajar"}, "loop is 'ajar' .*, expected one of open, closed, partial"),
        ({"loop": ["open"]}, "loop is a list of 1"),
        ({"n_controlled": 4}, "n_controlled is 4 .*, expected an integer from 0 to 3"),
        ({"flux": b"123"}, "flux is a bytes of 3 .*, expected bytes of four square"),
        ({"dither": {"id": "d-1"}}, "missing: key 'action' in 'dither' of a status"),
        ({"extra": "x" * 65_536}, "expected at most 65536"),
    ],
)
def test_a_bad_status_is_refused_by_key_found_and_expected(changes, words):
    with pytest.raises(WireError, match=words):
        decode(Status, changed(encode(STATUS), **changes))


def test_before_the_first_frame_a_status_has_no_number():
    assert decode(Status, changed(encode(STATUS), seq=None)).seq is None


def test_the_images_of_a_status_come_on_top_of_its_limit():
    images = np.ones((4, 130, 130), "<f4").tobytes()
    status = decode(Status, changed(encode(STATUS), flux=images))
    assert status.flux_images.shape == (4, 130, 130)
    with pytest.raises(WireError, match="besides its flux, expected at most 65536"):
        decode(Status, changed(encode(STATUS), flux=images, more="x" * 65536))


def test_what_must_not_be_missed_of_a_status_differs_in_nothing_else():
    data = encode(STATUS)
    assert essentials(data) == essentials(changed(data, seq=9, magnitude=3.0, gains=[0.1] * 3))
    for change in ({"loop": "open"}, {"cm_id": "x"}, {"session": "x"}, {"dither": None}):
        assert essentials(data) != essentials(changed(data, **change)), change
    with pytest.raises(WireError):
        essentials(b"junk")


def test_numbers_from_numpy_travel_as_plain_ones_and_anything_else_is_refused():
    status = replace(STATUS, leak=np.float32(0.5), seq=np.int64(3), gains=np.full(3, 0.25))
    received = decode(Status, encode(status))
    assert (received.leak, received.seq, received.gains) == (0.5, 3, (0.25, 0.25, 0.25))
    with pytest.raises(WireError, match="of type object cannot travel"):
        encode(replace(STATUS, leak=object()))


# ---------------------------------------------------------------- commands


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"modes": []}, "^range: modes is a list of 0 .*, expected at least one mode"),
        ({"modes": [3, 3]}, "none twice"),
        ({"amplitude_m": [5e-9]}, "^range: amplitude_m is a list of 1 .* each of 2 modes"),
        ({"amplitude_m": [5e-9, 0.0]}, "amplitude_m is 0.0"),
        ({"duration_s": float("inf")}, "duration_s is inf"),
        ({"seed": 3}, "seed is 3 .*, expected nil, it does not apply"),
        ({"seed": ...}, "^missing: key 'seed'"),
        ({"id": "über"}, "^id: "),
        ({"v": None}, "^v: None"),
    ],
)
def test_the_refusal_of_a_command_begins_with_a_word_a_reply_may_use(changes, words):
    with pytest.raises(WireError, match=words):
        decode_command(CommandKind.DITHER, changed(encode(DITHER), **changes))


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"groups": []}, "^range: groups is a list of 0 .*, expected one or more"),
        ({"groups": [[0, 5], [5, 9]]}, "none overlapping another"),
        ({"groups": [[9, 5]]}, "first <= last"),
        ({"groups": [[0, 1, 2]]}, "expected pairs of integers"),
        ({"groups": [[-1, 2]]}, "groups is -1 "),
        ({"gains": []}, "^range: gains is a list of 0 .*, expected one or more gains"),
        ({"gains": [0.0]}, "gains is 0.0"),
        ({"frames_per_gain": 0}, "^range: frames_per_gain is 0"),
        ({"groups": ...}, "^missing: key 'groups'"),
    ],
)
def test_a_ramp_that_tries_nothing_or_one_mode_twice_is_refused(changes, words):
    ramp = RampRequest(id="r-1", groups=((0, 1),), gains=(0.2,), frames_per_gain=5)
    with pytest.raises(WireError, match=words):
        decode_command(CommandKind.RAMP, changed(encode(ramp), **changes))


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"rotation_deg": float("nan")}, "^range: rotation_deg"),
        ({"magnification": "1"}, "^range: magnification"),
        ({"shift_y_subap": ...}, "^missing: key 'shift_y_subap'"),
    ],
)
def test_a_move_by_no_number_is_refused(changes, words):
    move = OffloadRequest(
        id="o-1", shift_x_subap=0.1, shift_y_subap=0.0, rotation_deg=0.0, magnification=0.0
    )
    with pytest.raises(WireError, match=words):
        decode_command(CommandKind.OFFLOAD, changed(encode(move), **changes))


def test_the_id_of_an_otherwise_useless_command_can_still_be_read():
    assert command_id(changed(encode(DITHER), v=2, modes=...)) == "d-1"
    assert command_id(b"\xc1") is None


# ---------------------------------------------------------------- manifests and chunks


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"n_chunks": 2}, r"n_chunks is 2 .*, expected 3 for shape \(3, 4\)"),
        ({"shape": [3]}, "expected two axes"),
        ({"shape": [1_000_000, 1_000_000]}, "at most 2147483648 bytes"),
        ({"dtype": "<f8"}, "dtype is '<f8' .*, expected '<f4'"),
        ({"chunk_bytes": 4_000_001}, "chunk_bytes is 4000001"),
        ({"alpha": {"shift_x_subap": 0.0}}, "missing: key 'shift_y_subap' in 'alpha'"),
        ({"alpha": ALPHA | {"magnification": 0.0}}, "magnification is 0.0"),
        ({"alpha": 3}, "'alpha' of the manifest of a reconstructor is 3 .*, expected a map"),
        ({"id": "x" * 65}, "id: "),
        ({"id": "../../etc"}, "id: "),
    ],
)
def test_a_bad_manifest_is_refused_by_key_found_and_expected(changes, words):
    with pytest.raises(WireError, match=words):
        decode(Manifest, changed(encode(MANIFEST), **changes))


def test_a_matrix_is_cut_into_equal_parts_and_a_shorter_last_one():
    assert [len(part) for part in split(MATRIX, 20)] == [20, 20, 8]
    assert b"".join(split(MATRIX, 20)) == MATRIX.tobytes()


def test_a_measured_manifest_names_its_columns_or_why_there_are_none():
    data = encode(MEASURED)
    assert decode(MeasuredManifest, data) == MEASURED
    with pytest.raises(WireError, match="one for each of 4 measured modes"):
        decode(MeasuredManifest, changed(data, modes=[0], amplitude_m=[1e-8]))
    failed = decode(MeasuredManifest, changed(data, n_chunks=0, reason="no light", sha256=None))
    assert (failed.layout.n_chunks, failed.reason) == (0, "no light")


def test_a_matrix_stored_by_columns_travels_by_rows():
    by_columns = np.asfortranarray(MATRIX)
    assert checksum(by_columns) == checksum(MATRIX)
    assert split(by_columns, 48) == [MATRIX.tobytes()]


def test_a_matrix_that_is_not_finite_or_not_flat_cannot_travel():
    with pytest.raises(WireError, match="1 non-finite"):
        layout_of(np.array([[1.0, np.nan]], np.float32), 20)
    with pytest.raises(WireError, match=r"shape \(12,\)"):
        layout_of(MATRIX.ravel(), 20)
    with pytest.raises(WireError, match="chunk_bytes is 0"):
        layout_of(MATRIX, 0)


def assembler_with(parts, layout=None):
    assembler = ChunkAssembler(limit_bytes=1000)
    for index, part in parts:
        assembler.add(index, part)
    if layout is not None:
        assembler.announce(layout)
    return assembler


def test_parts_that_do_not_fit_the_manifest_are_dropped_so_that_they_can_be_asked_for():
    assembler = assembler_with([(0, bytes(20)), (1, bytes(7)), (9, bytes(20))])
    with pytest.raises(WireError, match="chunk 1 has 7 bytes, expected 20"):
        assembler.announce(MANIFEST.layout)
    assert assembler.missing() == (1, 2)
    with pytest.raises(WireError, match="chunk 3, expected 0 to 2"):
        assembler.add(3, bytes(20))


def test_a_matrix_with_missing_parts_a_wrong_sum_or_bad_numbers_is_refused():
    parts = list(enumerate(split(MATRIX, 20)))
    with pytest.raises(WireError, match=r"missing: 2 chunks are here, expected chunks \(2,\)"):
        assembler_with(parts[:2], MANIFEST.layout).matrix()
    with pytest.raises(WireError, match="expected a manifest"):
        assembler_with(parts).matrix()
    swapped = [(0, parts[1][1]), (1, parts[0][1]), parts[2]]
    with pytest.raises(WireError, match="sha256"):
        assembler_with(swapped, MANIFEST.layout).matrix()
    bad = MATRIX.copy()
    bad[1, 1] = np.inf
    data = changed(encode(MANIFEST), sha256=checksum(bad))
    layout = decode(Manifest, data).layout
    with pytest.raises(WireError, match="1 numbers of the matrix are not finite"):
        assembler_with(list(enumerate(split(bad, 20))), layout).matrix()


def test_the_memory_of_an_assembler_is_bounded():
    assembler = ChunkAssembler(limit_bytes=50)
    assembler.add(0, bytes(40))
    assert assembler.missing() == (), "nobody has said yet how many there are"
    with pytest.raises(WireError, match="brings the matrix to 80 bytes, expected at most 50"):
        assembler.add(1, bytes(40))
    with pytest.raises(WireError, match="4000001 bytes, expected 1 to 4000000"):
        assembler.add(2, bytes(4_000_001))
    big = layout_of(np.zeros((4, 4), np.float32), 20)
    with pytest.raises(WireError, match="is 64 bytes, expected at most 50"):
        assembler.announce(big)


# ---------------------------------------------------------------- keys


def test_keys_are_those_of_the_contract():
    keys = Keys("flao-lbt")
    root = "ao/v1/flao-lbt"
    assert keys.frames == f"{root}/tel/frames"
    assert keys.status == f"{root}/tel/status"
    assert keys.chunk("r-1", 3) == f"{root}/cm/r-1/chunk/3"
    assert keys.commit("r-1") == f"{root}/cm/r-1/commit"
    assert keys.acknowledgement == f"{root}/cm/ack"
    assert keys.current == f"{root}/cm/current"
    assert keys.applied == f"{root}/rtc/cm/applied"
    assert keys.command(CommandKind.DITHER) == f"{root}/cmd/rtc/dither"
    assert keys.measured_chunk("m", 0) == f"{root}/im/m/chunk/0"
    assert keys.measured_commit("m") == f"{root}/im/m/commit"
    assert (keys.state, keys.alarm) == (f"{root}/state", f"{root}/alarm")
    assert keys.gains == f"{root}/gains"
    assert keys.alive(Role.RTC) == f"{root}/alive/rtc"


def test_keys_of_matrices_are_read_back():
    keys = Keys("flao-lbt")
    assert keys.matrix_id_of(keys.chunk("r-1", 3)) == "r-1"
    assert keys.chunk_index_of(keys.measured_chunk("m", 12)) == 12
    assert keys.chunk_index_of(keys.commit("r-1")) is None


@pytest.mark.parametrize("name", ["", "a b", "a/b", "a*", "ack", "current", "x" * 65, "ü", "a\n"])
def test_what_is_no_id_never_becomes_part_of_a_key(name):
    with pytest.raises(WireError, match=r"^id: "):
        Keys("flao-lbt").chunk(name, 0)
    with pytest.raises(WireError, match=r"^id: "):
        Keys(name)


@pytest.mark.parametrize("tail", ["cm/r-1/chunk/-1", "cm/r-1/chunk/1e3", "im/r-1/chunk/9999999"])
def test_a_chunk_number_is_a_plain_number(tail):
    keys = Keys("flao-lbt")
    with pytest.raises(WireError, match="range: chunk"):
        keys.chunk_index_of(f"{keys.root}/{tail}")


def test_a_key_of_another_system_names_no_matrix():
    with pytest.raises(WireError, match="is no key of a matrix of ao/v1/flao-lbt"):
        Keys("flao-lbt").matrix_id_of("ao/v1/other/cm/r-1/commit")

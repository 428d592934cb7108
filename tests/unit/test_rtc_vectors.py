"""The bytes of docs/rtc: what three writers make of them, and what must be refused."""

import re
import shutil
import subprocess

import numpy as np
import pytest

from pyrcal.rtc.identity import Identity
from pyrcal.rtc.staging import Staging, Terms
from pyrcal_studies.contract_tables import MESSAGES, rows_of
from service import wire
from service.errors import WireError
from service.records.alarms import ALARMS
from service.wire import CommandKind, Keys
from service.wire.codec import MESSAGE_LIMIT
from sim_rtc.computer.telemetry import Batch, frames_of
from tests.vectors import FOLDER, PAGE, Vector, anchors_of, packed, vectors

EVERY = vectors()
GOOD = [vector for vector in EVERY if vector.refused is None]
BAD = [vector for vector in EVERY if vector.refused is not None]
WRITTEN = [vector for vector in GOOD if not vector.told.get("read_only")]
KEYS = Keys("bench")

KINDS = {
    "status": wire.Status,
    "commit": wire.Manifest,
    "ack": wire.Acknowledgement,
    "reply": wire.Reply,
    "im-commit": wire.MeasuredManifest,
    "references-in-use": wire.ReferencesInUse,
    "state": wire.StateMessage,
    "gains": wire.GainsMessage,
    "alarm": wire.AlarmMessage,
}


def read(vector):
    """What the service makes of a vector: the record, whose matrix, if any, is whole."""
    if vector.kind == "frames":
        return wire.decode_frames(vector.payload, vector.message)
    if vector.kind in KINDS:
        record = wire.decode(KINDS[vector.kind], vector.message)
    else:
        record = wire.decode_command(CommandKind(vector.kind), vector.message)
    if vector.parts:
        assembled(vector, record.layout)
    return record


def assembled(vector, layout):
    parts = wire.ChunkAssembler()
    for index in reversed(range(len(vector.parts))):
        parts.add(index, vector.parts[index])
    parts.announce(layout)
    return parts.matrix()


def fullest(kind):
    """The message of a kind with the most keys."""
    of_kind = [vector for vector in WRITTEN if vector.kind == kind]
    return max(of_kind, key=lambda vector: len(vector.told["message"]))


def named(name):
    (vector,) = [vector for vector in EVERY if vector.name == name]
    return vector


@pytest.mark.parametrize("vector", EVERY, ids=lambda vector: vector.name)
def test_the_files_are_as_plain_msgpack_and_struct_write_them(vector):
    for name, data in vector.files.items():
        assert (FOLDER / name).read_bytes() == data, "run python -m tests.vectors"


def test_no_file_is_of_nothing():
    files = {name for vector in EVERY for name in vector.files}
    assert {p.name for p in FOLDER.iterdir() if p.suffix in {".msgpack", ".bin"}} == files


@pytest.mark.parametrize("vector", WRITTEN, ids=lambda vector: vector.name)
def test_what_the_service_reads_it_writes_in_the_same_bytes(vector):
    record = read(vector)
    if vector.kind == "frames":
        assert wire.encode_frames(record.header, record.rows) == (vector.payload, vector.message)
    else:
        assert wire.encode(record) == vector.message


def test_a_map_without_pointing_or_with_more_is_read_as_the_other():
    plain = read(named("status-minimal"))
    assert read(named("status-without-pointing")) == plain
    integers = read(named("status-integers"))
    assert (integers.frame_rate_hz, integers.magnitude) == (1000.0, 8.5)


@pytest.mark.parametrize("vector", BAD, ids=lambda vector: vector.name)
def test_what_must_be_refused_is_refused_in_the_words_of_its_file(vector):
    with pytest.raises(WireError) as refusal:
        read(vector)
    assert str(refusal.value) == vector.refused


@pytest.mark.parametrize("name", [name for name in MESSAGES if name != "stop"])
def test_every_key_of_the_pages_tables_must_be_there_unless_it_says_otherwise(name):
    example = fullest(name)
    told = {row[0].strip("`"): row[3] for row in rows_of(name)}
    assert set(told) == set(example.told["message"])
    for key, nil in told.items():
        without = {k: v for k, v in example.told["message"].items() if k != key}
        vector = Vector(example.name, {**example.told, "message": without})
        if "absent" in nil:
            read(vector)
        else:
            with pytest.raises(WireError, match=f"^missing: key '{key}'"):
                read(vector)


@pytest.mark.parametrize("name", [name for name in MESSAGES if name != "stop"])
def test_every_key_that_may_be_nil_is_read_so_and_no_other(name):
    """A key whose nil depends on others (frame_seq, seed, n_average) may be refused for that."""
    example = fullest(name)
    for key, _, _, nil, _ in rows_of(name):
        nothing = {**example.told["message"], key.strip("`"): None}
        vector = Vector(example.name, {**example.told, "message": nothing})
        if not nil.startswith(("yes", "may")) and key not in READ_AS_EMPTY.get(name, ()):
            with pytest.raises(WireError):
                read(vector)


READ_AS_EMPTY = {"ack": ("`reason`",), "reply": ("`reason`",)}
"""nil is read as an empty text there."""


@pytest.mark.parametrize("name", ["frames", "frames-plain"])
def test_the_simulators_frames_are_those_bytes(name):
    vector = named(name)
    told, rows = vector.told["message"], np.array(vector.told["rows"], dtype=np.float32)
    n_slopes, n_modes = told["n_slopes"], told["n_modes"]
    names = ("basis_id", "config_id", "reference_id")
    identity = Identity(system="bench", **{name: told.get(name) for name in names})
    batch = Batch(
        identity=identity,
        session=told["session"],
        seq0=told["seq0"],
        slopes=rows[:, :n_slopes],
        commands_m=rows[:, n_slopes : n_slopes + n_modes],
        dither_m=rows[:, n_slopes + n_modes :] if told["dither"] else None,
        cm_id=told["cm_id"],
        n_clipped=0,
        closed=True,
        n_controlled=2,
        optics=None,
        phase_m=np.zeros(1),
    )
    made = frames_of(batch, told["t0_ns"], told["dt_ns"])
    assert wire.encode_frames(*made) == (vector.payload, vector.message)


def staging(n_controlled=2):
    told = named("commit").told["message"]
    identity = Identity(system="bench", basis_id=told["basis_id"], config_id=told["config_id"])
    terms = Terms(
        session="s-2027-01-15-1", identity=identity, n_slopes=4, n_controlled=(n_controlled,)
    )
    return Staging(lambda: terms, limit_bytes=10_000)


def taken(vector, staging):
    """What the simulated RTC says of a matrix, its last chunk first and its commit in between."""
    manifest = wire.decode(wire.Manifest, vector.message)
    first, *others = reversed(list(enumerate(vector.parts)))
    said = (
        staging.chunk(manifest.id, *first).acknowledgements
        + staging.commit(manifest, 0.0).acknowledgements
    )
    for part in others:
        said += staging.chunk(manifest.id, *part).acknowledgements
    return [wire.encode(each) for each in said]


def test_the_simulator_stages_the_matrix_and_says_so_in_those_bytes():
    vector, matrices = named("commit"), staging()
    assert taken(vector, matrices) == [named("ack-staged").message]
    applied = matrices.applied("cm-1", 1200)
    assert wire.encode(applied) == named("ack-applied").message


def test_the_simulator_rejects_a_commit_it_cannot_read_in_those_bytes():
    said = staging().unreadable("missing: key 'shape'")
    assert wire.encode(said) == named("ack-unreadable").message


@pytest.mark.parametrize("name", ["refused-commit-sum", "refused-commit-finite"])
def test_the_simulator_rejects_what_must_be_refused_in_those_words(name):
    vector = named(name)
    (said,) = taken(vector, staging())
    rejected = wire.decode(wire.Acknowledgement, said)
    assert (rejected.state, rejected.reason) == ("rejected", vector.refused)


@pytest.mark.skipif(shutil.which("cc") is None, reason="there is no C compiler")
def test_the_example_in_c_writes_those_bytes(tmp_path):
    source = FOLDER.parents[1] / "examples" / "telemetry.c"
    strict = ["-std=c99", "-Wall", "-Wextra", "-Werror"]
    subprocess.run(["cc", *strict, str(source), "-o", str(tmp_path / "telemetry")], check=True)
    subprocess.run([str(tmp_path / "telemetry"), str(tmp_path)], check=True)
    for name in ("frames.bin", "frames.msgpack", "status-minimal.msgpack"):
        assert (tmp_path / name).read_bytes() == (FOLDER / name).read_bytes(), name


@pytest.mark.skipif(shutil.which("cc") is None, reason="there is no C compiler")
def test_the_example_in_c_calls_zenoh_as_it_is_declared():
    root = FOLDER.parents[1]
    strict = ["-std=c11", "-Wall", "-Wextra", "-Werror", "-DWITH_ZENOH", "-fsyntax-only"]
    declared = f"-I{root / 'tests' / 'data' / 'zenoh'}"
    subprocess.run(["cc", *strict, declared, str(root / "examples" / "telemetry.c")], check=True)


def test_a_status_of_64_subapertures_with_light_and_800_modes_is_read():
    told = {
        **named("status-full").told["message"],
        "flux": {"f4": [1.0] * (4 * 64 * 64)},
        "gains": [0.5] * 4000,
        "n_modes": 4000,
    }
    data = packed(told)
    assert len(data) > MESSAGE_LIMIT
    assert wire.decode(wire.Status, data).flux_images.shape == (4, 64, 64)


def test_the_page_has_every_key_and_every_word():
    page = PAGE.read_text(encoding="utf-8")
    for key in (
        KEYS.frames,
        KEYS.status,
        KEYS.current,
        KEYS.acknowledgement,
        KEYS.applied,
        KEYS.references_in_use,
        KEYS.references,
    ):
        assert f"`{key.removeprefix(KEYS.root + '/')}`" in page, key
    for kind in CommandKind:
        assert f"`cmd/rtc/{kind}`" in page, kind
    for key in ("cm/{id}/chunk/{k}", "cm/{id}/commit", "im/{id}/commit", "alive/rtc", "state"):
        assert f"`{key}`" in page, key


def test_every_alarm_that_the_page_names_is_one():
    page = PAGE.read_text(encoding="utf-8")
    table = page.partition("| Alarm | Requirements |")[2].partition("What the service waits for")[0]
    named = re.findall(r"^\| `([a-z-]+)` \|", table, flags=re.MULTILINE)
    assert len(named) > 10
    assert set(named) <= set(ALARMS)


def test_every_link_into_the_page_leads_somewhere():
    page = PAGE.read_text(encoding="utf-8")
    assert set(re.findall(r"\]\(#([^)]+)\)", page)) <= anchors_of(page)

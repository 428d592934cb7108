import json

import pytest

from pyrcal.demo.truth import TruthFile


def line(second, error_nm, cm_id="a", kind="truth"):
    return json.dumps(
        {
            "kind": kind,
            "t_ns_utc": round(second * 1e9),
            "wavefront_error_nm": error_nm,
            "cm_id": cm_id,
        }
    )


@pytest.fixture
def path(tmp_path):
    return tmp_path / "truth.jsonl"


def test_a_file_that_is_not_there_yet_is_empty(path):
    truth = TruthFile(path)
    truth.read()
    assert truth.last is None
    assert truth.wavefront_error_nm("a") is None


def test_only_whole_lines_are_read_and_each_once(path):
    truth = TruthFile(path)
    path.write_text(line(0, 1.0) + "\n" + line(1, 2.0)[:10], encoding="utf-8")
    truth.read()
    truth.read()
    assert [entry["wavefront_error_nm"] for entry in truth.lines] == [1.0]
    path.write_text(line(0, 1.0) + "\n" + line(1, 2.0) + "\n", encoding="utf-8")
    truth.read()
    assert [entry["wavefront_error_nm"] for entry in truth.lines] == [1.0, 2.0]


def test_a_restarted_simulator_begins_the_file_anew(path):
    truth = TruthFile(path)
    path.write_text(line(0, 1.0) + "\n" + line(1, 2.0) + "\n", encoding="utf-8")
    truth.read()
    path.unlink()
    path.write_text(line(9, 3.0) + "\n", encoding="utf-8")
    truth.read()
    assert truth.last["wavefront_error_nm"] == 3.0
    assert len(truth.lines) == 3


def test_the_wavefront_error_is_the_rms_after_the_loop_has_settled(path):
    entries = [(0.0, 900.0), (0.5, 900.0), (1.0, 30.0), (1.5, 40.0)]
    path.write_text("".join(line(*entry) + "\n" for entry in entries), encoding="utf-8")
    truth = TruthFile(path)
    truth.read()
    assert truth.wavefront_error_nm("a") == pytest.approx((1250.0) ** 0.5)
    assert truth.wavefront_error_nm("a", settling_s=5.0) is None
    assert truth.wavefront_error_nm("b") is None


def test_swaps_are_kept_apart(path):
    path.write_text(line(0, 1.0) + "\n" + line(1, 2.0, kind="swap") + "\n", encoding="utf-8")
    truth = TruthFile(path)
    truth.read()
    assert len(truth.swaps) == 1
    assert truth.last["wavefront_error_nm"] == 1.0

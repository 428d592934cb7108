"""The pages of ``make soak`` and ``make load``: what they say follows from what was seen."""

from dataclasses import replace

import pytest

from benchmarks import load, soak
from benchmarks.load import Phase, Seen
from benchmarks.standing import Sample, size_mb

FIRST = Sample(
    t_s=0.0,
    service_mb=500.0,
    others_mb=200.0,
    service_cpu_s=10.0,
    worker_cpu_s=20.0,
    archive_mb=5.0,
    load=2.0,
    threads=20,
    files=40,
    frames_received=1000,
    frames_lost=3,
    frames_overwritten=0,
    windows=1,
    reconstructors=2,
    alarms=(),
)


def samples(mb_per_s=0.0, archive_mb_per_s=0.0, *, warm_up_mb=0.0):
    """An hour, a sample a minute; 3 frames were lost before the first."""
    return [
        replace(
            FIRST,
            t_s=t_s,
            service_mb=600.0 + mb_per_s * t_s - warm_up_mb * (t_s < 300.0),
            archive_mb=5.0 + archive_mb_per_s * t_s,
            frames_received=1000 + 1000 * int(t_s),
        )
        for t_s in (60.0 * k for k in range(61))
    ]


def verdicts(seen):
    return {row.what: row.reached for row in soak.judge(seen)}


def test_a_quiet_hour_reaches_all_and_its_warm_up_is_no_growth():
    assert all(verdicts(samples(archive_mb_per_s=19.0 / 3600.0, warm_up_mb=200.0)).values())


def test_what_is_not_reached_is_said_for_itself():
    grows = verdicts(samples(mb_per_s=1.1 / 600.0))
    assert [reached for what, reached in grows.items() if "memory" in what] == [False]
    writes = verdicts(samples(archive_mb_per_s=21.0 / 3600.0))
    assert [reached for what, reached in writes.items() if "archive" in what] == [False]
    lost = samples()
    lost[-1] = replace(lost[-1], frames_lost=4)
    assert [reached for what, reached in verdicts(lost).items() if "frames" in what] == [False]


def test_a_short_run_is_told_as_the_hour_that_it_would_be():
    archive = soak.judge(samples(archive_mb_per_s=12.0 / 3600.0)[:21])[-1]
    assert archive.found.startswith("12.0 MB, from the 4.0 MB")


def test_the_page_of_a_long_run_has_its_length_its_load_and_a_picture(tmp_path):
    seen = samples()
    text = soak.section(seen, soak.judge(seen), {"answers": 7}, cores=2)
    assert "| 60 minutes |" in text
    assert "load 2.0 to 2.0" in text
    assert "0, 0 of 3600000" in text
    soak.plot(tmp_path / "soak.png", seen)
    assert (tmp_path / "soak.png").read_bytes().startswith(b"\x89PNG")


def phase(answer_s, stop_s, lost=0):
    seen = Seen(answers_s=[answer_s] * 99 + [0.2], stops_s=[stop_s], turned_out=4)
    after = replace(FIRST, t_s=30.0, frames_received=31_000, frames_lost=3 + lost)
    return Phase(seen=seen, before=FIRST, after=after, own_cores=0.2)


def test_load_is_judged_and_drawn(tmp_path):
    assert [row.reached for row in load.judge(phase(0.01, 0.1))] == [True, True, True]
    loaded = phase(0.06, 1.2, lost=1)
    rows = load.judge(loaded)
    assert [row.reached for row in rows] == [False, False, False]
    text = load.section(loaded, rows, cores=2)
    assert "| frames lost, overwritten | 1, 0 of 30000 | 0, 0 |" in text
    load.plot(tmp_path / "load.png", loaded)
    assert (tmp_path / "load.png").read_bytes().startswith(b"\x89PNG")


def test_a_folder_is_as_large_as_the_disk_says(tmp_path):
    (tmp_path / "below").mkdir()
    (tmp_path / "below" / "a").write_bytes(b"x" * 1_000_000)
    assert size_mb(tmp_path) == pytest.approx(1.0, abs=0.05)

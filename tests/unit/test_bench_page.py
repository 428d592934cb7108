"""The page of ``make bench``: what it says follows from what was measured."""

from benchmarks.bench_page import Alone, Row, page, plot

ROW = Row(
    what="D of 594 modes",
    peer="OOPAO, push-pull",
    own_s=(0.2, 0.25, 0.2),
    peer_s=(60.0, 50.0, 80.0),
    remark="1.5 % differ",
)


def test_the_ratio_is_of_each_round_and_its_median_and_range_are_told():
    assert ROW.spread == (300.0, 200.0, 400.0)
    text = page([ROW], [Alone(what="memory", found="296 MB", asked="-")], ["one thread"])
    assert "| 0.2 | OOPAO, push-pull | 60 | **300** (200 to 400) | 1.5 % differ |" in text
    assert "| memory | 296 MB | - |" in text
    assert text.endswith("- one thread\n")


def test_it_is_drawn(tmp_path):
    plot(tmp_path / "bench.png", [ROW, ROW])
    assert (tmp_path / "bench.png").read_bytes().startswith(b"\x89PNG")

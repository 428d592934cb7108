"""The page of ``make bench``: what it says follows from what was measured."""

from dataclasses import replace

from benchmarks.bench import Alone, Row, plot, section

ROW = Row(
    what="D of 594 modes",
    peer="OOPAO, push-pull",
    own_s=(0.2, 0.25, 0.2),
    peer_s=(60.0, 50.0, 80.0),
    remark="1.5 % differ",
)


def test_the_ratio_is_of_each_round_and_peers_share_a_row():
    assert ROW.spread == (300.0, 200.0, 400.0)
    other = replace(ROW, peer="HCIPy", peer_s=(40.0, 50.0, 40.0))
    text = section([ROW, other], [Alone(what="memory", found="296 MB", asked="-")], ["one thread"])
    row = "| 0.2 | OOPAO, push-pull 60; HCIPy 40 | 300 (200 to 400); 200 (200 to 200) |"
    assert row in text
    assert "- OOPAO, push-pull: 1.5 % differ\n- HCIPy: 1.5 % differ\n" in text
    assert "- memory: 296 MB; target -" in text
    assert text.endswith("- one thread")


def test_it_is_drawn(tmp_path):
    plot(tmp_path / "bench.png", [ROW, ROW])
    assert (tmp_path / "bench.png").read_bytes().startswith(b"\x89PNG")

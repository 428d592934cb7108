import pytest

from sim_rtc.faults import FaultKind
from sim_rtc.options import parse_options


def test_faults_are_read_in_any_number_and_a_recording_beside_them():
    options = parse_options(
        ["--fault", "lost@3:0.5", "--fault", "clock@4:-0.5", "--record", "night.h5"]
    )
    assert [(f.kind, f.values[0]) for f in options.faults] == [
        (FaultKind.LOST, 0.5),
        (FaultKind.CLOCK, -0.5),
    ]
    assert options.record.name == "night.h5"
    assert parse_options([]).faults == ()


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (["--fault", "lots@3"], "argument --fault: found 'lots@3'; expected KIND@T"),
        (["--fault", "lost@3:2"], "expected SHARE from 0 to 1"),
        (["--replay", "a.h5", "--record", "b.h5"], "--replay: plays a file as it is"),
    ],
)
def test_impossible_ones_are_refused_in_one_line(words, text, capsys):
    with pytest.raises(SystemExit, match="2"):
        parse_options(words)
    said = capsys.readouterr().err
    assert text in said
    assert said.count("\n") == 1


def test_the_manual_explains_faults_and_recordings(capsys):
    with pytest.raises(SystemExit, match="0"):
        parse_options(["--help"])
    manual = capsys.readouterr().out
    assert all(f"    {kind} " in manual for kind in FaultKind)
    assert "/messages" in manual
    assert "swmr=True" in manual

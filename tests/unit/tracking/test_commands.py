"""Commands that no state of the service could make sense of are not made."""

import pytest

from service.tracking import commands as cmd
from service.tracking.products import ModeSet
from service.wire import DitherKind, Pattern

BINARY, SINE = DitherKind.BINARY, Pattern.SINE
SENSELESS = [
    (cmd.StartDither, {"modes": (3, 3)}, "modes without any of them twice"),
    (cmd.StartDither, {"modes": ModeSet.ALL}, "at most 64 modes with sine"),
    (cmd.StartDither, {"modes": tuple(range(65))}, "at most 64 modes with sine"),
    (cmd.StartDither, {"modes": (3, 4), "frequency_hz": (200.0,)}, "1 given for 2"),
    (cmd.StartDither, {"frequency_hz": (200.0,)}, "1 given for 0"),
    (cmd.StartDither, {"total_amplitude_m": 1e-9}, "amplitude_m of each mode"),
    (cmd.StartDither, {"kind": BINARY, "amplitude_m": 1e-9}, "no amplitude_m and no frequency_hz"),
    (cmd.MeasureNoisy, {"id": "n", "modes": (1, 1)}, "modes without any of them twice"),
    (cmd.Measure, {"id": "m", "modes": (1, 1)}, "modes without any of them twice"),
    (cmd.Measure, {"id": "m", "pattern": SINE, "n_average": 3}, "no n_average with a sine"),
    (cmd.Measure, {"id": "m", "duration_s": 3.0}, "no frequency_hz and no duration_s with push"),
    (cmd.SetLoop, {}, "at least one of loop, gains"),
    (cmd.SetLoop, {"gains": (cmd.GainGroup(first=0, last=1, gain=0.1),) * 2}, "mode 0 is"),
    (cmd.ModeGroup, {"first": 3, "last": 2}, "first <= last"),
    (
        cmd.Ramp,
        {"groups": (cmd.ModeGroup(first=5, last=20), cmd.ModeGroup(first=0, last=10))},
        "no mode in two groups: mode 5 is",
    ),
    (cmd.Refit, {"reason": "so\x1b[2J"}, r"found '\\x1b' in reason, expected printable"),
    (cmd.SetMode, {"mode": "auto", "by": "a\nb"}, r"found '\\n' in by"),
]


@pytest.mark.parametrize(("kind", "said", "why"), SENSELESS)
def test_what_makes_no_sense_in_any_state_is_no_command(kind, said, why):
    with pytest.raises(ValueError, match=why):
        kind(**said)


def test_a_command_has_its_fields_by_name():
    command = cmd.SetPointing(elevation_deg=61.5, azimuth_deg=-20.0, by="the mount")
    said = {"elevation_deg": 61.5, "azimuth_deg": -20.0, "by": "the mount", "reason": ""}
    assert command.as_fields() == said

"""The text of ``--help`` besides the options."""

from __future__ import annotations

import argparse
import re
from collections.abc import Collection, Iterator, Sequence
from typing import Any

from typing_extensions import override

from service.parser import OneLineParser
from sim_rtc.faults import manual as fault_manual
from sim_rtc.telescope.detector import FLAO_PRESETS

_USAGE = "pyrcal sim [options]"

_DESCRIPTION = """\
Simulated real-time computer of an adaptive telescope. It closes the loop on frozen-flow turbulence
at the frame rate, sends telemetry and accepts all commands of docs/rtc.md. The true misregistration
is not sent.
"""

_PRESETS = "\n".join(
    f"    to R = {preset.faintest:4.1f}: {preset.frame_rate_hz:5.0f} Hz, binning {preset.binning}, "
    f"{preset.n_controlled} modes"
    for preset in FLAO_PRESETS
)

_EPILOG = f"""\
plants
  linear       one matrix, real time at 1 kHz; an optical gain of its own invention.
  diffractive  the field of the sensor for every frame: the optical gain is what the residual
               wavefront makes it, centroids are those of noisy pixels. Other influence functions
               and pupil grid than the service's. 150 to 200 frames a second of FLAO on one core;
               timestamps follow the loop's own time.

presets
  --preset flao looks at the magnitude:
{_PRESETS}
  The larger the residual the lower the optical gain: a faint star wants --gain 1 or more.

registration
  X,Y in subapertures, rotation in degrees from +x towards +y, magnification as a ratio. A jump
  T:dx,dy,drot_deg,dmag happens at T seconds of loop time, at the next batch of 10 frames; its
  optics take a few seconds to compute, so a jump in the first seconds comes late. A drift, a
  flexure and a random walk move in linear steps of 2 s or less between exact optics 20 s or less
  apart. All of them add up.

mirror
  The diffractive plant has a plate under tension, the linear one the drawing's influence functions.
  --influence replaces either by those of a file: maps of OPD per OPD asked of the actuator, in the
  order of the instrument's actuators, a row along +x, the middle of the arrays the middle of the
  mirror, gone on smoothly past its edge. Modes are the strokes of the commands matrix on them.
  --position-error moves each function; a dead actuator goes where the surface bends least.

scenes
  onsky: a star through frozen-flow turbulence, the mirror seen once. daytime: a fibre and a
  retro-reflector; the light meets the mirror twice, so a command's slopes double and --gain is
  0.2 unless given (the loop gain stays). There is no atmosphere: a turbulence of --seeing, as the
  sensor sees it, is played on the mirror, and tip, tilt and focus vibrate. The command column is
  all that is on the mirror: integrator, dither and played turbulence; the dither column is the
  dither alone. Wavefront errors in the truth file are those at the sensor, after both passes.

atmosphere
  Screens are extruded row by row from noise that is never used twice: nothing repeats, however
  long the run. Profiles: single (12 m/s), three-layer, paranal-like (five layers); a linear plant
  works as hard as the sum of their speeds (12, 41, 67 m/s: .12, .21, .28 ms of processor time
  a frame). Seeing is that at 500 nm for an infinite outer scale; between two --seeing-at it changes
  smoothly, then stays.

imperfections
  ideal: none. usual (the default): light uneven by 10 %, actuators off by 2 % of their pitch,
  optical gain .6 to .9. realistic: light uneven by 20 %, actuators off by 2 %, optical gain .45 to
  .75, 6 dead pixels, 0.1 subapertures of radial distortion, 0.2 % of anamorphosis, 10 % more
  modulation, slope axes turned by 1 deg, 30 nm of non-common path. An option of its own overrides
  its part of the set. --truth realistic means --imperfections realistic (a truth file of that name
  is ./realistic).

vibrations
  tip rises along +x, tilt along +y. Strength is in nm RMS of wavefront at the sensor; DAMPING is
  that of the resonance noise shakes (default 0.01), 0 a pure sine. By day the default is tip:13:60,
  tilt:22:40 and focus:47:15, by night none; --vibration none switches them off.
light
  A star of R = 0 gives 2.1e10 photons per second and square metre in the band (600 to 900 nm); a
  quarter of them are detected. The linear plant adds their noise to its slopes, the diffractive one
  counts electrons in every pixel.

truth file
  One JSON object a line. The first is the setup: scene, imperfections, movements. Then, twice a
  second, registration, seeing, wavefront error (RMS and peak, nm) over the pupil and matrix in use;
  and for each reconstructor swap the peaks one second before and after it.

{fault_manual()}
recording
  --record writes everything that is sent (frames, status, acknowledgements, liveliness, matrices
  in use) byte for byte to HDF5, from when a service is there. It is flushed twice a second and
  survives a kill -9; read it with h5py.File(FILE, "r", swmr=True), also while it is written:
    /messages  time_s, kind (0 frames, 1 status, 2 acknowledgement, 3 liveliness, 4 matrix),
               start, payload_bytes, attachment_bytes
    /bytes     all payloads, each followed by its attachment
    /dropped   messages that were not written
  --replay plays it, faults included, under the recorded session, sequence and timestamps, at
  --speed (0: as fast as it goes; above 2 a service gives up windows that it has no time to fit).
  It begins when the service says what it knows, or after 20 s. It serves the recorded matrix;
  commands and reconstructors are refused: "unsupported: a replay". A service in mode hold that
  finds the recorded dither in the status adopts it and gives the answers of that night.

examples
  pyrcal sim --alpha 0.12,-0.08,0.2,1.003 --truth truth.jsonl
      a night of one layer at 1 kHz, the truth written beside it
  pyrcal sim --seed 7 --mag 10 --jump 30:0.2,0,0,0 --seconds 60
      a fainter star, a fifth of a subaperture of slip after half a minute
  pyrcal sim --scene daytime --imperfections realistic
      fibre and retro-reflector, nothing as it was drawn
  pyrcal sim --profile three-layer --seeing-at 60:1.5 --spiders 3:0.2 --vibration tip:13:50
      a night that gets worse, behind a spider, on a telescope that shakes
  pyrcal sim --flexure 0.2,0,0.1,0:600 --walk 0.02,0.02,0.01,0
      a registration that follows the elevation and wanders
  pyrcal sim --record night.h5 --fault lost@30:0.05,10 --fault restart@60:2
      a link that loses one batch in twenty for 10 s, then a restart, all of it on file
  pyrcal sim --replay night.h5 --speed 2
      the same again, twice as fast
  pyrcal sim --plant diffractive --influence p45.h5:/influence --dead-actuators 14,222
      the mirror as the laboratory has measured it, two of its actuators off
  pyrcal sim --plant diffractive --snapshot loop.png
      a picture of the sensor's light, slopes and residual wavefront as the loop closes

exit status
  0 it ended as asked (time is up, SIGINT, SIGTERM); 2 an option that cannot be.
"""


class Parser(OneLineParser):
    """Parser of the simulator's command line, whose help is a manual."""

    def __init__(self) -> None:
        super().__init__(
            prog="sim_rtc",
            description=_DESCRIPTION,
            epilog=_EPILOG,
            formatter_class=_Formatter,
            allow_abbrev=False,
        )

    def read(self, given: Sequence[str]) -> dict[str, Any]:
        """Return what was given, by the names of the fields.

        A value that begins with a minus sign is tied to its option: argparse takes it for another.
        """
        joined: list[str] = []
        for argument in given:
            if joined and joined[-1].startswith("--") and re.match(r"-[\d.]", argument):
                joined[-1] += f"={argument}"
            else:
                joined.append(argument)
        return vars(self.parse_args(joined))

    @override
    def usage_parts(self, left_out: Collection[str] = (), *, short: bool = False) -> Iterator[str]:
        yield _USAGE


class _Formatter(argparse.RawDescriptionHelpFormatter):
    """Formats help in the width of the manual, independently of the terminal."""

    def __init__(self, prog: str) -> None:
        super().__init__(prog, max_help_position=34, width=100)

"""The text of ``--help`` besides the options."""

from __future__ import annotations

import argparse
import re
from collections.abc import Iterator, Sequence
from typing import Any

from typing_extensions import override

from service.parser import OneLineParser
from sim_rtc.faults import manual as fault_manual

_USAGE = "pyrcal sim [options]"

_DESCRIPTION = """\
Simulated real-time computer of an adaptive telescope. It closes the loop on frozen-flow turbulence
at the frame rate, sends telemetry and accepts all commands of docs/rtc.md. The true misregistration
is not sent.
"""

_EPILOG = f"""\
plants
  linear       one matrix, in real time at 1 kHz; the optical gain is a given function of the mode.
  diffractive  the field of the sensor is propagated for each frame: the optical gain follows from
               the residual wavefront, slopes from noisy pixels. Influence functions and pupil grid
               differ from those of the service. 150 to 200 frames a second of FLAO on one core;
               timestamps follow loop time.

registration
  X,Y in subapertures, rotation in degrees from +x towards +y, magnification as a ratio. A jump
  T:dx,dy,drot_deg,dmag happens at T seconds of loop time, at the next batch of 10 frames; its
  optics take a few seconds to compute, so a jump in the first seconds comes late. Drift, flexure
  and random walk are interpolated linearly, in steps of 2 s or less, between exact optics at most
  20 s apart. All of them add up.

mirror
  The diffractive plant models a plate under tension, the linear one has the influence functions of
  the instrument file. --influence replaces both by those of a file: maps of OPD per commanded OPD,
  in the order of the instrument's actuators, rows along +x, centred on the mirror and continued
  smoothly beyond its edge. Modes are the strokes of the commands matrix on them.
  --position-error moves each function; a dead actuator takes the stroke of least bending.

scenes
  onsky: a star through frozen-flow turbulence, one reflection on the mirror. daytime: a fibre and a
  retro-reflector; two reflections on the mirror double the slopes of a command, so --gain is 0.2 by
  default (the loop gain is the same). There is no atmosphere: turbulence of --seeing, as seen by
  the sensor, is played on the mirror, and tip, tilt and focus vibrate. The command column contains
  integrator, dither and played turbulence; the dither column contains the dither only. Wavefront
  errors in the truth file are those at the sensor, after both reflections.

atmosphere
  Screens are extruded row by row from new noise, so nothing repeats in a long run. Profiles: single
  (12 m/s), three-layer, paranal-like (five layers); the processor time of a linear plant grows with
  the sum of the wind speeds (12, 41, 67 m/s: 0.12, 0.21, 0.28 ms a frame). Seeing is given at
  500 nm for an infinite outer scale; it changes smoothly between two --seeing-at, then stays.

imperfections
  ideal: none. usual (the default): uneven illumination, 10 %, actuators displaced by 2 % of their
  pitch, optical gain 0.6 to 0.9. realistic: uneven illumination, 20 %, actuators displaced by 2 %,
  optical gain 0.45 to 0.75, 6 dead pixels, 0.1 subapertures of radial distortion, 0.2 % of
  anamorphosis, 10 % more modulation, slope axes rotated by 1 deg, 30 nm of non-common path
  aberration. A single option overrides its part of the set. --truth realistic means --imperfections
  realistic (write ./realistic for a truth file of that name).

vibrations
  tip rises along +x, tilt along +y. Strength is in nm RMS of wavefront at the sensor; DAMPING is
  that of a resonance excited by noise (default 0.01), 0 is a pure sine. The default is tip:13:60,
  tilt:22:40 and focus:47:15 with --scene daytime, else none; --vibration none switches them off.

light
  A star of R = 0 gives 2.1e10 photons per second and square metre in the band (600 to 900 nm); a
  quarter of them are detected. The linear plant adds their noise to its slopes, the diffractive one
  counts electrons in every pixel.

truth file
  One JSON object a line. The first is the setup: scene, imperfections, movements. Then, twice a
  second, registration, seeing, wavefront error (RMS and peak, nm) over the pupil and matrix in use;
  for each swap of the reconstructor, the peaks one second before and after it.

{fault_manual()}
recording
  --record writes everything that is sent (frames, status, acknowledgements, liveliness, matrices
  in use) byte for byte to HDF5, once a service is present. It is flushed twice a second and
  survives kill -9; read it with h5py.File(FILE, "r", swmr=True), also while it is written:
    /messages  time_s, kind (0 frames, 1 status, 2 acknowledgement, 3 liveliness, 4 matrix),
               start, payload_bytes, attachment_bytes
    /bytes     all payloads, each followed by its attachment
    /dropped   messages that were not written
  --replay plays it, faults included, under the recorded session, sequence and timestamps, at
  --speed (0: as fast as possible; above 2 a service skips windows that it has no time to fit). It
  begins when the service publishes its state, or after 20 s. It serves the recorded matrix;
  commands and reconstructors are refused: "unsupported: a replay". A service in mode hold adopts
  the recorded dither from the status and gives the results of that night.

examples
  pyrcal sim --alpha 0.12,-0.08,0.2,1.003 --truth truth.jsonl
      one turbulent layer at 1 kHz, with a truth file
  pyrcal sim --seed 7 --mag 10 --jump 30:0.2,0,0,0 --seconds 60
      a fainter star, and a shift of 0.2 subapertures after 30 s
  pyrcal sim --scene daytime --imperfections realistic
      fibre and retro-reflector, with realistic imperfections
  pyrcal sim --profile three-layer --seeing-at 60:1.5 --spiders 3:0.2 --vibration tip:13:50
      seeing that gets worse, a spider, and a vibration
  pyrcal sim --flexure 0.2,0,0.1,0:600 --walk 0.02,0.02,0.01,0
      a registration with flexure and a random walk
  pyrcal sim --record night.h5 --fault lost@30:0.05,10 --fault restart@60:2
      a link that loses one batch in twenty for 10 s, then a restart of the RTC, recorded
  pyrcal sim --replay night.h5 --speed 2
      replay of that recording, twice as fast
  pyrcal sim --plant diffractive --influence p45.h5:/influence --dead-actuators 14,222
      measured influence functions, two dead actuators

examples
  pyrcal sim --instrument flao-lbt --seconds 60
  pyrcal sim --instrument flao-lbt --plant diffractive --record night.h5 --seconds 60

exit status
  0 ended as requested (time is up, SIGINT, SIGTERM); 2 wrong option.
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
    def usage_parts(self) -> Iterator[str]:
        yield _USAGE


class _Formatter(argparse.RawDescriptionHelpFormatter):
    """Formats help in the width of the manual, independently of the terminal."""

    def __init__(self, prog: str) -> None:
        super().__init__(prog, max_help_position=34, width=100)

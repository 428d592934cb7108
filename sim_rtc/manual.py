"""The manual of the simulated RTC: what ``--help`` says besides the options."""

from __future__ import annotations

from sim_rtc.options_device import PRESETS
from sim_rtc.options_rehearsal import EPILOG as REHEARSAL
from sim_rtc.options_scene import EPILOG as SCENES

USAGE = "pyrcal sim [options]    (or: python -m sim_rtc [options])"

DESCRIPTION = """\
Simulated real-time computer of an adaptive telescope with a pyramid sensor. It closes the loop on
frozen-flow turbulence at the frame rate, publishes telemetry over zenoh, and takes dithers, loop
commands, gain ramps, measurements and reconstructors, as the service's wire contract says. Its
mirror is mis-registered on the sensor by an amount that it tells nobody on the wire.
"""

EPILOG = f"""\
plants
  linear       one matrix, real time at 1 kHz; an optical gain of its own invention.
  diffractive  the field of the pyramid for every frame: the optical gain is what the residual
               wavefront makes it. Other influence functions and pupil grid than the service's.
               150 to 200 frames a second on one core; timestamps follow the loop's own time.

presets
  --preset flao looks at the magnitude:
{PRESETS}
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

{SCENES}
light
  A star of R = 0 gives 2.1e10 photons per second and square metre in the band (600 to 900 nm); a
  quarter of them are detected. The linear plant adds their noise to its slopes, the diffractive one
  counts electrons in every pixel.

truth file
  One JSON object a line. The first is the setup: scene, imperfections, movements. Then, twice a
  second, registration, seeing, wavefront error (RMS and peak, nm) over the pupil and matrix in use;
  and for each reconstructor swap the peaks one second before and after it.

{REHEARSAL}
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
      a picture of pupil images, slopes and residual wavefront as the loop closes

exit status
  0 it ended as asked (time is up, SIGINT, SIGTERM); 2 an option that cannot be.
"""

"""Bench with a simulated telescope of OOPAO in a loop of pyRTC, run frame by frame.

Needs ``pip install pyrtcao==2.1.0 oopao==1.0.0``. Both packages are GPL-3.0-or-later; they are
imported here and never copied.
"""

import contextlib
import io
import os
from collections import deque

os.environ.update(OOPAO_BACKEND="cpu", OOPAO_PRECISION="32")  # read at import
os.environ.setdefault("PYRTC_LOG_LEVEL", "WARNING")

import h5py
import numpy as np

with contextlib.redirect_stdout(io.StringIO()):  # OOPAO prints a banner
    from OOPAO.Atmosphere import Atmosphere
    from OOPAO.calibration.compute_KL_modal_basis import compute_KL_basis
    from OOPAO.calibration.InteractionMatrix import InteractionMatrix
    from OOPAO.DeformableMirror import DeformableMirror
    from OOPAO.MisRegistration import MisRegistration
    from OOPAO.Pyramid import Pyramid
    from OOPAO.Source import Source
    from OOPAO.Telescope import Telescope
from pyrtc.hardware.oopao_interface import OOPAOSystemContext, OOPAOWFCorrector, OOPAOWFSensor
from pyrtc.loop import Loop
from pyrtc.slopes_process import SlopesProcess
from pyrtc.streams import clear_shms
from pyrtc.utils import generate_circular_aperture_mask

N, SAMPLING, SEPARATION = 12, 4, 4
"""Subapertures across the pupil, pupil samples across each, pixels between two pupil images."""

DIAMETER_M, MODULATION, COUPLING, R0_M, OUTER_SCALE_M, MAGNITUDE = 3.6, 2.0, 0.35, 0.15, 25.0, 4.0
RATE_HZ, GAIN, LEAK, DELAY = 500.0, 0.5, 0.99, 2
STROKE_M = 1e-9
MASK = generate_circular_aperture_mask(N, N / 2, 0.0)
"""Valid pixels of pyRTC; OOPAO's pyramid is configured with the same."""

POINTS = N * SAMPLING
GRID = (POINTS - 1) / POINTS
"""Ratio of lengths in OOPAO to real ones.

OOPAO counts a pupil of ``POINTS`` pixels as ``POINTS - 1`` steps, which makes its mirror smaller
and its modulation wider by this ratio.
"""

INSTRUMENT = f"""
[instrument]
name = "oopao"
diameter_m = {DIAMETER_M}
stop = "telescope"

[wfs]
kind = "pyramid"
n_subapertures = {N}
pupil_separation_subap = {N + SEPARATION}
wavelength_m = {{star.wavelength}}
modulation_lambda_over_d = {MODULATION / GRID}
valid_subapertures = "oopao.h5:/valid"

[mirror]
layout = "positions"
positions = "oopao.h5:/positions"
pitch_m = {{pitch_m}}
influence = "gaussian"
coupling = {COUPLING}
mode_to_actuator = "oopao.h5:/modes"

[modes]
r0_m = {R0_M}
outer_scale_m = {OUTER_SCALE_M}

[slopes]
orientation = "auto"
"""


class Bench:
    """Telescope, mirror and loop, with a misregistration that pyrcal has to estimate."""

    def __init__(self, shift_subap=(0.0, 0.0), rotation_deg=0.0):
        with contextlib.redirect_stdout(io.StringIO()):
            self._build_telescope(shift_subap, rotation_deg)
            self._build_loop()
        self.take_reference()

    def _build_telescope(self, shift_subap, rotation_deg):
        self.telescope = Telescope(POINTS, DIAMETER_M, samplingTime=1.0 / RATE_HZ)
        self.star = Source("H", MAGNITUDE)
        self.star * self.telescope
        layers = {"windSpeed": [10, 15], "windDirection": [30, 100], "altitude": [0, 5000]}
        self.air = Atmosphere(
            self.telescope, R0_M, OUTER_SCALE_M, fractionalR0=[0.7, 0.3], **layers
        )
        self.air.initializeAtmosphere(self.telescope)
        self.aligned = DeformableMirror(self.telescope, N, mechCoupling=COUPLING)
        self.modes = compute_KL_basis(self.telescope, self.air, self.aligned)
        self.n_modes = self.modes.shape[1]
        elsewhere = MisRegistration()
        metres = -DIAMETER_M / N / GRID
        elsewhere.shiftX, elsewhere.shiftY = (metres * shift for shift in shift_subap)
        elsewhere.rotationAngle = rotation_deg
        self.mirror = self.aligned.apply_mis_registration(elsewhere)
        self.pyramid = Pyramid(
            N, self.telescope, MODULATION, 0.5, n_pix_separation=SEPARATION, userValidSignal=MASK
        )
        self.pyramid.compute_focal_plane, self.pyramid.nJobs = False, 1

    def _build_loop(self):
        """Make pyRTC's components in the order of its streams, without starting their threads."""
        self.streams = {
            name: f"pyrcal-{os.getpid()}-{name}"
            for name in ("wfs_raw", "wfs", "signal", "signal_2d", "wfc", "wfc_2d")
        }
        shared = {"input_streams": self.streams, "output_streams": self.streams, "functions": []}
        parts = {"tel": self.telescope, "tel_psf": self.telescope, "ngs": self.star}
        parts |= {"src": self.star, "atm": self.air, "dm": self.mirror, "wfs": self.pyramid}
        context = OOPAOSystemContext({}, {}, **parts)
        side = len(self.pyramid.cam.frame)
        self.camera = OOPAOWFSensor({"width": side, "height": side, **shared}, context)
        low, high = ((side + sign * (N + SEPARATION)) // 2 for sign in (-1, 1))
        pupils = [f"{x},{y}" for x in (low, high) for y in (low, high)]
        slopes = {
            "type": "PYWFS",
            "signal_type": "slopes",
            "pupils": pupils,
            "pupils_radius": N // 2,
        }
        self.slopes = SlopesProcess({**slopes, **shared})
        mirror = {"name": "mirror", "num_actuators": len(self.modes), "num_modes": self.n_modes}
        mirror |= {"frame_delay": DELAY - 1, **shared}
        self.corrector = OOPAOWFCorrector(mirror, context)
        self.corrector.set_m2c(self.modes)
        self.loop = Loop({"gain": GAIN, "leaky_gain": 1.0 - LEAK, **shared})
        self.context = context

    def write_instrument(self, folder):
        """Write the instrument file ``oopao.toml`` with the nominal geometry of the mirror."""
        with h5py.File(folder / "oopao.h5", "w") as file:
            file["positions"] = self.aligned.coordinates * GRID
            file["modes"] = self.modes
            file["valid"] = MASK
        path = folder / "oopao.toml"
        path.write_text(INSTRUMENT.format(pitch_m=self.aligned.pitch * GRID, star=self.star))
        return path

    def take_reference(self):
        """Set the reference slopes to those of a flat wavefront, without noise."""
        self.context.remove_atmosphere()
        self.camera.expose()
        self.slopes.compute_signal()
        self.set_reference(self.slopes.read(False))

    def set_reference(self, signal):
        """Subtract ``signal`` ``(n_slopes,)`` from the slopes from now on."""
        self.reference = np.array(signal, np.float32)
        flat = np.zeros(self.slopes.ref_slopes.shape, np.float32)
        self.slopes.set_ref_slopes(self.slopes.compute_signal_2d(signal, out=flat))

    def measure_with_oopao(self, mirror):
        """Return OOPAO's interaction matrix of a mirror ``(n_slopes, n_modes)``, without noise."""
        with contextlib.redirect_stdout(io.StringIO()):
            self.context.remove_atmosphere()
            parts = (self.star, self.telescope, mirror, self.pyramid, self.modes, STROKE_M)
            return InteractionMatrix(*parts, invert=False, single_pass=False).D

    def use(self, matrix, gain=GAIN):
        """Set the reconstructor of the loop, ``matrix`` ``(n_controlled, n_slopes)``."""
        self.loop.cm[:] = 0.0
        self.loop.cm[: len(matrix)] = matrix
        self.loop.num_active_modes = len(matrix)
        self.loop.set_gain(gain)  # pyRTC multiplies gain and matrix only here

    def begin(self, seed):
        """Start a new realisation of turbulence with a flat mirror and the loop closed."""
        self.context.add_atmosphere()
        self.air.generateNewPhaseScreen(seed)
        self.pyramid.cam.photonNoise = True
        self.pyramid.cam.random_state_photon_noise = np.random.RandomState(seed)
        self.flatten()
        self.loop.start()

    def flatten(self):
        """Set the mirror flat and the integrator to zero."""
        self.corrector.flat[:] = 0.0
        self.played = deque([np.zeros(self.n_modes)] * DELAY, DELAY)
        for _ in range(DELAY):
            self.loop.send_to_wfc(self.loop.flat)
            self.corrector.send_to_hardware()

    def frame(self, dither_m):
        """Run one frame; return its slopes, and commands and dither as they were on the mirror.

        ``dither_m`` ``(n_modes,)`` is added to the command that reaches the mirror ``DELAY`` frames
        later.
        """
        self.camera.expose()
        self.slopes.compute_signal()
        row = (
            self.slopes.read(False),
            self.corrector.C2M @ self.corrector.current_shape,
            self.played[0],
        )
        row = np.concatenate(row)
        if self.loop.running:
            self.loop.leaky_integrator()
        else:
            self.loop.send_to_wfc(self.loop.flat)
        # The flat of the corrector is added after the integrator, which must not hold the dither.
        self.corrector.flat[:] = self.modes @ dither_m
        self.corrector.send_to_hardware()
        self.played.append(dither_m)
        return row

    @property
    def residual_m(self):
        """Residual wavefront of the last frame, metres RMS over the pupil."""
        return float(np.std(self.star.OPD[self.telescope.pupil > 0]))

    def close(self):
        """Close pyRTC's components and remove their shared memory."""
        for part in (self.loop, self.corrector, self.slopes, self.camera):
            part.close()
        clear_shms(self.streams.values())

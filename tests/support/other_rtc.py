"""A stranger whose modes are others than the file says, beside its own loop without a service.

Everything on the wire is the stranger's, from the contract alone. The telescope is the simulator's
linear one, which is not the service's model of it; the RTC's first matrix inverts what was measured
there. The same turbulence and the same noise go through a second loop, which nobody touches: what a
service does to the first one shows against it.
"""

import functools

import numpy as np

from tests.support.stranger import INSTRUMENT, Stranger, small_telescope

STROKE_M = 10e-6


@functools.cache
def true_response(shift_x=0.0, shift_y=0.0, rotation_deg=0.0, magnification=1.0):
    """Return what the simulator's sensor makes of its mirror ``(n_slopes, n_modes)``."""
    from service.instrument import load_instrument
    from sim_rtc.assembly import build_telescope
    from sim_rtc.options import parse_options

    alpha = f"--alpha={shift_x},{shift_y},{rotation_deg},{magnification}"
    words = [f"--instrument={INSTRUMENT}", "--plant=linear", "--seed=3", alpha]
    telescope = build_telescope(parse_options(words), load_instrument(str(INSTRUMENT)))
    return np.array(telescope.optics.at(0.0).slopes_per_command, dtype=np.float64)


class OtherRtc(Stranger):
    """An RTC whose mode k is mode ``order[k]`` of the file, times ``scale[k]``.

    ``loads`` is what its loop makes of a matrix that it is sent.
    """

    def __init__(self, endpoint, *, order=None, scale=1.0, strength=1.0, loads=None):
        here, by_day = (
            strength * true_response(*alpha)
            for alpha in ((0.12, -0.08, 0.3, 1.004), (0.05, -0.03, 0.1, 1.001))
        )
        _, variance_m2 = small_telescope()
        order = np.arange(len(variance_m2)) if order is None else np.array(order)
        scale = scale * np.ones(len(order))
        super().__init__(
            endpoint,
            here[:, order] * scale,
            variance_m2[order] / scale**2,
            assumed=by_day[:, order] * scale,
            gain=0.4,
        )
        self.wavefront_m = np.abs(scale)
        self.loads = loads or (lambda matrix: matrix)
        self.errors = []
        """(monotonic s, RMS wavefront in m, the same without a service) of each batch."""

        self._own, self._own_gains = self.matrix.copy(), self.gains.copy()
        self._alone = np.zeros((2, self.n_modes))
        self._played = (self.cm_id, self.matrix)

    def worse_s(self, ratio=1.1, stretch=12):
        """Return for how long at most its loop was worse than without a service, seconds."""
        errors = np.array(self.errors)
        n = len(errors) // stretch * stretch
        if n == 0:
            return 0.0
        power = (errors[:n, 1:] ** 2).reshape(-1, stretch, 2).mean(axis=1)
        most = run = 0
        for flag in power[:, 0] > ratio**2 * power[:, 1]:
            run = run + 1 if flag else 0
            most = max(most, run)
        return most * stretch * self.per_batch / self.rate_hz

    def _advance(self):
        n, seq0 = self.per_batch, self.seq
        slopes = np.empty((n, self.n_slopes))
        commands, dithers = np.empty((n, self.n_modes)), np.zeros((n, self.n_modes))
        kick, powers = np.sqrt(1.0 - self.memory**2) * self.sigma_m, np.zeros(2)
        if self._played[0] != self.cm_id:
            self._played = (self.cm_id, self.loads(self.matrix))
        for k in range(n):
            self._turbulence *= self.memory
            self._turbulence += kick * self.rng.standard_normal(self.n_modes)
            noise = self.slope_noise * self.rng.standard_normal(self.n_slopes)
            dithers[k] = self._dither_at(seq0 + k)
            commands[k] = np.clip(self._integrator + dithers[k], -STROKE_M, STROKE_M)
            seen = np.array([commands[k], self._alone[0]]) + self._turbulence
            powers += np.sum((seen * self.wavefront_m)[:, : len(self._own)] ** 2, axis=1)
            read = seen @ self.response.T + noise
            slopes[k] = read[0]
            answer = np.zeros(self.n_modes)
            if self.closed:
                answer = self._answer(self._next, self._played[1], self.gains, read[0])
            self._integrator, self._next = self._next, answer
            alone = self._answer(self._alone[1], self._own, self._own_gains, read[1])
            self._alone = np.array([self._alone[1], alone])
        self.seq += n
        rms = np.sqrt(powers / n)
        self.errors.append((self.t_ns(self.seq) * 1e-9, *rms))
        return self.header(seq0, n), slopes, commands, dithers

    def _answer(self, decided, matrix, gains, slopes):
        answer, m = self.leak * decided, len(matrix)
        answer[:m] -= gains[:m] * (matrix @ slopes)
        return np.clip(answer, -STROKE_M, STROKE_M)

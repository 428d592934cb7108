"""Settings that must hold before any test module imports numpy."""

import os
import signal

# Two shared cores and several processes per test: nested BLAS threads make everything slower.
for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[_name] = "1"
# A shell's background job inherits SIGINT as ignored, and would hand it on to the programs that the
# system tests interrupt.
signal.signal(signal.SIGINT, signal.default_int_handler)

"""Settings that must hold before any test module imports numpy."""

import os

# Two shared cores and several processes per test: nested BLAS threads make everything slower.
for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[_name] = "1"

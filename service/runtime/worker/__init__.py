"""The heavy work, in a process of its own: fitting, computing reconstructors, judging them.

A compute thread beside the ingest raises its latency thirty-fold; a nice'd process leaves it
alone.
"""

from service.runtime.worker.optics_worker import OpticsWorker
from service.runtime.worker.process import Done, run_job, start_worker
from service.runtime.worker.records import Compute, Conditions, Made, Sampling

__all__ = [
    "Compute",
    "Conditions",
    "Done",
    "Made",
    "OpticsWorker",
    "Sampling",
    "run_job",
    "start_worker",
]

"""The heavy work, in a process of its own: fitting, computing reconstructors, judging them.

A compute thread beside the ingest raises its latency thirty-fold; a nice'd process leaves it
alone. The executor is the seam: anything with ``submit`` may take its place.
"""

from service.worker.bench import Workbench
from service.worker.margin import InUse, Margin
from service.worker.process import Done, be_polite, run_job, start_worker
from service.worker.records import Compute, Description, Made

__all__ = [
    "Compute",
    "Description",
    "Done",
    "InUse",
    "Made",
    "Margin",
    "Workbench",
    "be_polite",
    "run_job",
    "start_worker",
]

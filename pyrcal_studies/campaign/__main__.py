"""The campaign of windows: ``python -m pyrcal_studies.campaign --help``.

Three hundred windows of FLAO on the diffractive plant take about two hours of one core.
"""

from __future__ import annotations

import sys

from pyrcal_studies.campaign.night import main
from service.program import status_of

if __name__ == "__main__":
    # what processes import must not lie in this module
    sys.exit(status_of(main, "python -m pyrcal_studies.campaign"))

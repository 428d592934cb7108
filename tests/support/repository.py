"""What tests of several modules share of unit.test_house."""

from __future__ import annotations

from pathlib import Path

import service

ROOT = Path(service.__file__).parent.parent


HELD = ("service", "pyrcal", "check_rtc")

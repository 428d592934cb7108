"""TODO."""

from __future__ import annotations

import pytest

from tests.support.api import FakeService, a_snapshot


@pytest.fixture
def service(archive):
    return FakeService(a_snapshot(archive_failures=3, archive_waiting=2), archive=archive)

from __future__ import annotations

from collections.abc import Iterator

import pytest

from pyrcal_studies.heritier2018 import telescope
from tests.support.numerics import small_basis, small_instrument


@pytest.fixture
def small_telescope(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """The study's telescope is the small instrument, whose frames take a fraction of a ms."""
    monkeypatch.setattr(telescope, "instrument", small_instrument)
    monkeypatch.setattr(telescope, "basis", small_basis)
    telescope.forget()
    yield
    telescope.forget()

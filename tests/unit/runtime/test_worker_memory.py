"""An instrument too large for the memory that the worker may take."""

from __future__ import annotations

import pytest

from service.errors import ModelError
from service.files.disk_cache import DiskCache
from service.runtime.worker.optics_worker import OpticsWorker
from service.runtime.worker.records import Compute
from tests.support.numerics import small_instrument


def test_it_is_refused_in_one_line_before_anything_is_computed(monkeypatch):
    monkeypatch.setattr(DiskCache, "basis", None)
    with pytest.raises(ModelError) as refused:
        OpticsWorker(small_instrument(), Compute(memory_gb=0.05))
    text = str(refused.value)
    assert text.startswith("small: found ")
    assert "slopes and 40 modes, whose D and derivatives take 0.1 GB" in text
    assert "expected at most compute.memory_gb = 0.05: allow more" in text
    assert "\n" not in text


def test_a_quarter_of_the_memory_is_kept_for_each_of_four_sensors():
    assert Compute(memory_gb=2.0).kept_bytes == 0.5e9

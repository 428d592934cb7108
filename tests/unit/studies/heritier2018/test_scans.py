from __future__ import annotations

from studies.heritier2018.scans import pull_reason


def test_errors_beyond_sigma_are_the_telescopes_only_if_the_ideal_one_is_free_of_them() -> None:
    assert "displaced actuators" in pull_reason(1.2)
    assert "is in the model" in pull_reason(4.0)

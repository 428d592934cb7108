"""``pyrcal check-rtc`` names one violation of the contract, and blames no RTC that is right."""

import pytest

from tests.support.broken_rtc import VIOLATIONS
from tests.support.checker import checked_beside, late_with_the_machine, write_plant

pytestmark = [pytest.mark.system, pytest.mark.slow, pytest.mark.timeout(180)]

FETCHES = ("query", "push")
PUSH_ONLY = {"no query"}


def checked(folder, violation, fetch, *options):
    plant = write_plant(folder / "plant.npz")
    words = ["tests.support.broken_rtc", violation, fetch]
    options = ("--yes", "--open-loop", "--seconds", "2", *options)
    return checked_beside(folder, lambda at: [*words, at, "small", str(plant)], *options)


@pytest.mark.parametrize("fetch", FETCHES)
@pytest.mark.parametrize("violation", VIOLATIONS)
def test_a_violation_is_named(tmp_path, violation, fetch):
    if violation in PUSH_ONLY and fetch != "push":
        pytest.skip("such an RTC has no matrix at all without its queries")
    check, words, _ = VIOLATIONS[violation]
    status, checks, text = checked(tmp_path, violation, fetch, "--only", check)
    assert status == 1, text
    assert checks[check]["outcome"] == "wrong", text
    assert words in checks[check]["found"], text


@pytest.mark.parametrize("fetch", FETCHES)
def test_an_rtc_that_is_right_is_not_blamed(tmp_path, fetch):
    _, checks, text = checked(tmp_path, "none", fetch)
    wrong = {name for name, one in checks.items() if one["outcome"] == "wrong"}
    if "delivery" in wrong and late_with_the_machine(checks["delivery"]):
        wrong.remove("delivery")
    assert wrong == set(), text
    assert checks["finite"]["outcome"] == checks["rejection"]["outcome"] == "ok", text

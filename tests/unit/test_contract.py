"""The contract's numbered requirements: each is verified, and in the way that docs/rtc.md says."""

import ast
import re

from check_rtc.check import as_document, format_line
from check_rtc.requirements import REQUIREMENTS, fine
from pyrcal_studies.sequence_diagrams import DIAGRAMS, FOLDER, draw_diagram
from tests.support.repository import ROOT

PAGE = (ROOT / "docs" / "rtc.md").read_text(encoding="utf-8")

STATED = {
    int(number): (text, {way.strip("` ") for way in ways.split(",")})
    for number, text, ways in re.findall(
        r"^- \*\*R-(\d+)\*\* (.+) \(([^()]+)\)$", PAGE, re.MULTILINE
    )
}
"""Text of each requirement, and how it is verified."""

SIMULATED = "system/test_sim_rtc.py"
COMPUTER = "unit/sim_rtc/computer"

TESTS = {
    2: (SIMULATED, "test_it_waits_for_the_service_outlives_it_and_ends_cleanly"),
    6: (SIMULATED, "test_a_connection_left_over_under_its_name_does_not_silence_it_for_ever"),
    10: ("unit/test_wire.py", "test_an_unknown_key_is_ignored"),
    24: (
        f"{COMPUTER}/test_real_time_computer.py",
        "test_opening_begins_a_session_with_an_empty_integrator_and_nothing_pending",
    ),
    27: (
        f"{COMPUTER}/test_reconstructors.py",
        "test_a_new_session_voids_what_is_not_applied",
    ),
    34: (f"{COMPUTER}/test_loop.py", "test_the_dither_is_applied_but_never_integrated"),
    44: (
        f"{COMPUTER}/test_real_time_computer.py",
        "test_a_command_is_carried_out_once_for_ten_minutes",
    ),
    46: (
        "unit/rtc/test_basic_computer.py",
        "test_a_dither_is_played_from_its_first_frame_whatever_the_batch",
    ),
    47: (
        f"{COMPUTER}/test_activities_dither.py",
        "test_a_binary_sequence_repeats_with_its_seed_whatever_the_blocks",
    ),
    48: (
        f"{COMPUTER}/test_real_time_computer.py",
        "test_a_second_dither_is_refused_until_the_first_is_stopped",
    ),
    53: (
        f"{COMPUTER}/test_real_time_computer.py",
        "test_the_number_of_modes_waits_for_a_matrix_of_that_shape",
    ),
    55: (
        f"{COMPUTER}/test_gains.py",
        "test_while_one_runs_another_is_refused_and_so_is_what_would_spoil_it",
    ),
    60: (
        f"{COMPUTER}/test_gains.py",
        "test_opening_the_loop_ends_it_with_what_is_chosen_and_what_was_there",
    ),
    64: (
        f"{COMPUTER}/test_real_time_computer.py",
        "test_the_image_is_moved_by_who_can_and_refused_by_who_cannot",
    ),
    83: (
        f"{COMPUTER}/test_real_time_computer.py",
        "test_a_second_offset_replaces_the_first_from_where_its_ramp_is",
    ),
    85: (
        f"{COMPUTER}/test_real_time_computer.py",
        "test_an_offset_stays_when_the_loop_opens_and_ends_with_the_rtc",
    ),
    87: (
        f"{COMPUTER}/test_real_time_computer.py",
        "test_an_offset_waits_for_the_end_of_a_measurement",
    ),
    73: (f"{COMPUTER}/test_real_time_computer.py", "test_modes_that_are_given_up_go_to_zero"),
    77: ("unit/test_wire.py", "test_a_measured_manifest_names_its_columns_or_why_there_are_none"),
    78: ("unit/test_signing.py", "test_each_side_takes_what_the_other_signs"),
    80: ("unit/test_signing.py", "test_an_order_of_before_the_rtcs_restart_is_refused"),
}
"""Test of each requirement that docs/rtc.md says is verified by one."""


def test_requirements_are_numbered_without_a_gap_and_say_must_or_should():
    assert sorted(STATED) == list(range(1, len(STATED) + 1))
    assert len(STATED) == PAGE.count("**R-")
    for number, (text, _) in STATED.items():
        assert re.search(r"\b(must|may|should)\b", text), number


def test_every_requirement_is_verified_by_a_check_or_a_test_or_by_inspection():
    for number, (_, ways) in STATED.items():
        checks = {name for name, one in REQUIREMENTS.items() if number in one.numbers}
        assert ways - {"test", "inspection"} == checks, number
        assert ("test" in ways) == (number in TESTS), number
        assert ("inspection" in ways) == (ways == {"inspection"}), number


def test_every_check_verifies_requirements_of_the_page():
    for name, one in REQUIREMENTS.items():
        assert one.numbers, name
        assert set(one.numbers) <= set(STATED), name
        assert list(one.numbers) == sorted(set(one.numbers)), name


def test_the_tests_that_verify_requirements_are_there():
    for number, (path, name) in TESTS.items():
        tree = ast.parse((ROOT / "tests" / path).read_text(encoding="utf-8"))
        names = {each.name for each in ast.walk(tree) if isinstance(each, ast.FunctionDef)}
        names |= {each.name for each in ast.walk(tree) if isinstance(each, ast.AsyncFunctionDef)}
        assert name in names, (number, name)


def test_a_result_names_its_requirements():
    result = fine("columns", "slopes lag +0.01 frames")
    numbers = REQUIREMENTS["columns"].labels
    assert as_document(result)["requirements"] == list(numbers)
    assert f"[{', '.join(numbers)}: " in format_line(result)


def test_requirements_named_elsewhere_on_the_page_exist():
    named = {int(number) for number in re.findall(r"\bR-(\d+)\b", PAGE)}
    assert named <= set(STATED)
    drawn = {int(n) for one in DIAGRAMS.values() for n in re.findall(r"R-(\d+)", draw_diagram(one))}
    assert drawn <= set(STATED)


def test_the_page_can_be_read_in_half_an_hour_and_shows_every_diagram():
    assert len(PAGE.split()) <= 5000
    for name, diagram in DIAGRAMS.items():
        assert f"(rtc/{name}.svg)" in PAGE
        text = (FOLDER / f"{name}.svg").read_text(encoding="utf-8")
        assert text == draw_diagram(diagram), "run python -m pyrcal_studies.sequence_diagrams"

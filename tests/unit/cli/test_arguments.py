"""What strangers have written never reaches a terminal as it is."""

import contextlib
import logging

import h5py
import numpy as np
import pytest
import structlog

from pyrcal.__main__ import main
from service.cli.serve import log_to_the_terminal
from service.errors import MatrixError, say, shown

EVIL = "\x1b]0;title\x07 \u202egnp.exe\u2066 two\nlines\r\x9b2J\x00\u2028"


def harmless(text):
    return all(character.isprintable() or character == "\n" for character in text)


def test_what_moves_a_cursor_or_turns_the_writing_is_shown_as_what_it_is():
    assert shown(EVIL) == (r"\x1b]0;title\x07 \u202egnp.exe\u2066 two\nlines\r\x9b2J\x00\u2028")


@pytest.mark.parametrize("text", ["α ± 3σ, 65.08°", "subapertures\xa0", "日本 ΠΟΛ", "é", ""])
def test_letters_of_any_alphabet_stay(text):
    assert shown(text) == text


def test_lines_stay_where_they_are_the_programs_own():
    assert shown("a\nb\x1b", keep="\n") == "a\nb\\x1b"


def test_names_in_a_file_reach_the_terminal_as_what_they_are(tmp_path, capsys):
    path = tmp_path / "evil.h5"
    with h5py.File(path, "w") as file:
        file[EVIL.replace("\x00", "")] = np.zeros((3, 4))
    assert main(["fit", "flao-lbt", str(path)]) == 2
    told = capsys.readouterr()
    assert "gnp.exe" in told.err
    assert harmless(told.err + told.out)
    assert told.err.count("\n") == 1


def test_notes_are_harmless(capsys):
    say(f"note: {EVIL}")
    told = capsys.readouterr().err
    assert harmless(told)
    assert told.count("\n") == 1


@pytest.fixture
def logged(capsys):
    handlers = list(logging.getLogger().handlers)

    def after(log):
        log_to_the_terminal()  # to the standard error of this moment
        log()
        return capsys.readouterr().err

    yield after
    structlog.reset_defaults()
    logging.getLogger().handlers[:] = handlers


def test_a_line_of_the_log_is_one_line_whatever_the_rtc_says(logged):
    blank = "".join(EVIL.split())
    told = logged(lambda: structlog.get_logger().warning("rtc.refused", a=EVIL, b=blank, n=3))
    assert "rtc.refused" in told
    assert "gnp.exe" in told
    assert harmless(told)
    assert told.count("\n") == 1


def test_a_fault_keeps_its_lines_and_nothing_else(logged):
    fault = MatrixError(EVIL)
    told = logged(lambda: structlog.get_logger().error("deed.broken", exc_info=fault))
    assert "MatrixError" in told
    assert harmless(told)


def test_what_libraries_log_goes_the_same_way(logged):
    told = logged(lambda: logging.getLogger("uvicorn.error").error("request to %s", EVIL))
    assert "request to" in told
    assert harmless(told)


def test_a_log_on_a_full_disk_does_not_stop_what_is_logged(monkeypatch, logged):
    with open("/dev/full", "w", encoding="utf-8", buffering=1) as full:
        monkeypatch.setattr("sys.stderr", full)
        logged(lambda: structlog.get_logger().warning("archive-failed", text="disk full"))
        monkeypatch.undo()
        with contextlib.suppress(OSError):
            full.close()

"""What commands share about words, files and the terminal."""

from __future__ import annotations

import argparse
import re
import sys
from collections.abc import Sequence
from typing import NoReturn

from typing_extensions import override

from service.errors import shown


class OneLineParser(argparse.ArgumentParser):
    """Says what is wrong in one line, without the usage that would push it off the screen."""

    @override
    def error(self, message: str) -> NoReturn:
        """End the program with status 2."""
        self.exit(2, f"{self.prog}: {message}; {self.prog} --help\n")


_NEGATIVE = re.compile(r"-[\d.][-+\d.eE]*,.*")


def with_negative_numbers(given: Sequence[str]) -> list[str]:
    """Return command-line words such that argparse takes ``-0.3,0.1,65,1`` for a value.

    It takes it for an option; a word with a blank in it, never.
    """
    return [f" {word}" if _NEGATIVE.fullmatch(word) else word for word in given]


def say(line: str) -> None:
    """Tell the user something beside the answer."""
    sys.stderr.write(f"{shown(line)}\n")


def show_progress(step: str) -> None:
    """Tell somebody who watches how far it is; a log needs no such lines."""
    if sys.stderr.isatty():
        say(f"... {step}")

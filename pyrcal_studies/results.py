"""Tell which results cannot be repeated, and which are older than the code that they measure.

A section of ``docs/results`` names its command after ``**Command**``; a section without one is made
by that of the section before it, or by the first one of its page. Behind a command are a module
and all modules of this repository that it imports. A section is old if one of them has been
committed since its newest line was. A section whose command takes half an hour or more says so, as
the docstring of the module or the help of the target does.

Run: ``python -m pyrcal_studies.results --check``. It prints the old sections, those first whose
code has changed most, and ends with status 1 if a section with measured values has no command, or
one that does not exist.
"""

from __future__ import annotations

import ast
import re
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from itertools import islice, pairwise
from pathlib import Path

from pyrcal_studies.shared import study_parser

ROOT = Path(__file__).parents[1]
FOLDER = ROOT / "docs" / "results"

_COMMAND = re.compile(r"`((?:[A-Z_]+=\S+ )*(?:python -m|make|pyrcal) [^`]+)`")
_HEADING = re.compile(r"^#{2,3} (.+)$", re.M)
_MEASURED = re.compile(r"\*\*Measured\*\*|^\| -{3}", re.M)
_LONG = re.compile(r"\btakes? [^.;]*?(?<!quarter of an )\bhours?\b")
_PACKAGES = {path.parent.name for path in ROOT.glob("*/*.py")}


@dataclass(frozen=True, slots=True, kw_only=True)
class Section:
    """A section of a page of results."""

    page: Path
    title: str
    lines: range
    """Of the page, from 1."""

    text: str
    commands: tuple[str, ...]
    """Its own, or those of the section before it."""

    @property
    def name(self) -> str:
        """Page and title, as messages have them."""
        return f"{self.page.name}: {self.title}"

    @property
    def has_values(self) -> bool:
        """True if it says what was measured, or has a table."""
        return _MEASURED.search(self.text) is not None

    @property
    def says_that_it_takes_long(self) -> bool:
        """True if the text has a duration in hours."""
        return _LONG.search(self.text) is not None


def sections(page: Path) -> Iterator[Section]:
    """Yield the sections of a page in their order."""
    text = page.read_text("utf-8")
    before = tuple(found[1] for found in islice(_COMMAND.finditer(text), 1))
    starts = [*(found.start() for found in _HEADING.finditer(text)), len(text)]
    for start, end in pairwise(starts):
        part = text[start:end]
        own = tuple(found[1] for found in _COMMAND.finditer(part.partition("**Command**")[2]))
        before = own or before
        first = text.count("\n", 0, start) + 1
        yield Section(
            page=page,
            title=part.splitlines()[0].lstrip("# "),
            lines=range(first, first + part.rstrip().count("\n") + 1),
            text=part,
            commands=before,
        )


def pages() -> list[Path]:
    """Return the pages of results; the index only quotes them."""
    return sorted(page for page in FOLDER.glob("*.md") if page.name != "README.md")


def files_behind(command: str) -> frozenset[Path]:
    """Return the files of a command: its module, or test, and all that they import.

    Raises
    ------
    LookupError
        If there is no such module, test or target.
    """
    match [word for word in command.split() if not re.match(r"[A-Z_]+=", word)]:
        case ["make", target, *_]:
            recipe = _recipe(target)
            module = recipe and re.search(r"-m (\S+)", recipe[2])
            if module is None:
                raise LookupError(f"make {target}: no such target that runs a module")
            return files_behind(f"python -m {module[1]}")
        case ["pyrcal", *_]:
            return _imported(ROOT / "pyrcal" / "arguments.py") | _imported(_file("pyrcal.demo"))
        case ["python", "-m", "pytest", *rest]:
            tests = [ROOT / word.partition("::")[0] for word in rest if word.startswith("tests")]
            if not tests or not all(test.exists() for test in tests):
                raise LookupError(f"{command}: no such test")
            every = [file for test in tests for file in ([test, *test.rglob("*.py")])]
            return frozenset().union(*(_imported(file) for file in every if file.is_file()))
        case ["python", "-m", module, *_]:
            return _imported(_file(module))
        case _:
            pass
    raise LookupError(f"{command}: neither a module, a target nor a command of pyrcal")


def takes_long(command: str) -> bool:
    """Return True if the description of a command says that it takes half an hour or more."""
    match command.split():
        case ["make", target, *_] if recipe := _recipe(target):
            text = recipe[1]
        case ["python", "-m", module, *_] if module != "pytest":
            text = ast.get_docstring(ast.parse(_file(module).read_text("utf-8"))) or ""
        case _:
            return False
    return _LONG.search(" ".join(text.split())) is not None


def _recipe(target: str) -> re.Match[str] | None:
    """Return the help and the first line of a target of the Makefile as groups 1 and 2."""
    return re.search(rf"^{target}:(.*)\n\t(.+)", (ROOT / "Makefile").read_text(), re.M)


def _file(module: str) -> Path:
    stem = ROOT / module.replace(".", "/")
    for path in (stem / "__main__.py", stem.with_suffix(".py")):
        if path.exists():
            return path
    raise LookupError(f"python -m {module}: no such module")


def _imported(file: Path) -> frozenset[Path]:
    """Return a file and all files of the repository that it imports, whatever the order."""
    found, left = set[Path](), {file}
    while left:
        found |= left
        left = set[Path]().union(*map(_imports, left)) - found
    return frozenset(found)


@cache
def _imports(file: Path) -> frozenset[Path]:
    names: list[str] = []
    for node in ast.walk(ast.parse(file.read_text("utf-8"))):
        if isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module:
            names += [node.module, *(f"{node.module}.{alias.name}" for alias in node.names)]
    stems = [ROOT / name.replace(".", "/") for name in names if name.split(".")[0] in _PACKAGES]
    paths = [path for stem in stems for path in (stem / "__init__.py", stem.with_suffix(".py"))]
    return frozenset(path for path in paths if path.exists())


def _git(*words: str) -> str:
    return subprocess.run(
        ["git", *words], cwd=ROOT, capture_output=True, text=True, check=True
    ).stdout


def _written(page: Path) -> list[int]:
    """Return the time of the commit of each line of a page, seconds."""
    blamed = _git("blame", "--line-porcelain", "--", str(page))
    return [
        int(line.split()[1]) for line in blamed.splitlines() if line.startswith("committer-time ")
    ]


@cache
def _changes(files: frozenset[Path]) -> list[int]:
    """Return the times of the commits of these files, newest first."""
    times = _git("log", "--no-merges", "--format=%ct", "--", *map(str, files))
    return [int(line) for line in times.split()]


def check() -> int:
    """Print what is old and what cannot be repeated; return the exit status."""
    wrong, old = [], []
    for page in pages():
        written = _written(page)
        for one in sections(page):
            try:
                files = frozenset[Path]().union(*map(files_behind, one.commands))
            except LookupError as error:
                wrong.append(f"{one.name}: {error}")
                continue
            if not files and one.has_values:
                wrong.append(f"{one.name}: no command")
            newest = max(written[line - 1] for line in one.lines)
            later = sum(at > newest for at in _changes(files)) if files else 0
            if later:
                day = time.strftime("%Y-%m-%d %H:%M", time.gmtime(newest))
                old.append((later, f"{later} commits since {day}: {one.name}"))
    for _, text in sorted(old, reverse=True):
        print(text)
    for text in wrong:
        print("cannot be repeated:", text, file=sys.stderr)
    return 1 if wrong else 0


def main() -> int:
    """Check the pages of results."""
    parser = study_parser("pyrcal_studies.results", __doc__)
    parser.add_argument("--check", action="store_true", required=True, help="check all sections")
    parser.parse_args()
    return check()


if __name__ == "__main__":
    sys.exit(main())

"""How pip makes a wheel of pyrcal: setuptools' way, with the manual built into it first.

The service shows the manual at ``/manual/``; it is made from ``docs/``, which is in a checkout and
in no wheel. Where it has been built already (``make docs``, a source archive) nothing more is
needed; an editable installation takes what ``make docs`` builds beside it.
"""

from __future__ import annotations

import contextlib
import os
import re
import runpy
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path

from setuptools import build_meta
from setuptools.build_meta import (
    build_editable,
    get_requires_for_build_editable,
    prepare_metadata_for_build_editable,
    prepare_metadata_for_build_wheel,
)

__all__ = [
    "build_editable",
    "build_sdist",
    "build_wheel",
    "get_requires_for_build_editable",
    "get_requires_for_build_sdist",
    "get_requires_for_build_wheel",
    "prepare_metadata_for_build_editable",
    "prepare_metadata_for_build_wheel",
]

ROOT = Path(__file__).parent
MANUAL = ROOT / "service" / "web" / "manual"

Settings = dict[str, str | list[str] | None] | None


def _manual_is_built() -> bool:
    return (MANUAL / "index.html").is_file()


def _needed_by_the_manual() -> list[str]:
    """Return Sphinx with its extensions, and what pyrcal needs: the API reference imports it.

    Sphinx and its extensions are pinned to the versions of ``constraints.txt``, with which the
    manual was built last: an installation from a checkout must not depend on a newer Sphinx.
    """
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    lines = (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines()
    pinned = {_distribution(line): line for line in lines if "==" in line}
    extensions = [pinned[_distribution(r)] for r in project["optional-dependencies"]["docs"]]
    return [*project["dependencies"], *extensions]


def _distribution(requirement: str) -> str:
    """Return the normalised name (PEP 503) of the package that a requirement names."""
    name = re.match(r"[\w.-]+", requirement)
    return re.sub(r"[-_.]+", "-", name[0]).lower() if name else ""


def get_requires_for_build_wheel(config_settings: Settings = None) -> list[str]:
    """Return what a wheel needs: Sphinx, unless the manual is there."""
    needed = build_meta.get_requires_for_build_wheel(config_settings)
    return needed if _manual_is_built() else [*needed, *_needed_by_the_manual()]


def get_requires_for_build_sdist(config_settings: Settings = None) -> list[str]:
    """Return what a source archive needs, which has the manual, too."""
    needed = build_meta.get_requires_for_build_sdist(config_settings)
    return needed if _manual_is_built() else [*needed, *_needed_by_the_manual()]


def build_wheel(
    wheel_directory: str, config_settings: Settings = None, metadata_directory: str | None = None
) -> str:
    """Build the manual, then the wheel with it; return the wheel's name."""
    _build_manual()
    with _commit_file():
        return build_meta.build_wheel(wheel_directory, config_settings, metadata_directory)


def build_sdist(sdist_directory: str, config_settings: Settings = None) -> str:
    """Build the manual, then the source archive with it; return the archive's name."""
    _build_manual()
    with _commit_file():
        return build_meta.build_sdist(sdist_directory, config_settings)


@contextlib.contextmanager
def _commit_file() -> Iterator[None]:
    """Write the commit into the package for the time of a build, so that ``--version`` names it.

    The environment variable ``PYRCAL_COMMIT`` gives the commit where git has no checkout (a
    container image). A source archive contains the file, and its wheel keeps it.
    """
    version = runpy.run_path(str(ROOT / "service" / "version.py"))
    path: Path = version["COMMIT_FILE"]
    commit = os.environ.get("PYRCAL_COMMIT") or version["describe_checkout"](ROOT)
    if not commit:
        yield
        return
    path.write_text(commit + "\n", encoding="utf-8")
    try:
        yield
    finally:
        path.unlink()


def _build_manual() -> None:
    if not _manual_is_built():
        # Without -W: a warning stops `make docs`, not the installation of a user.
        options = ["-q", "-d", "build/manual"]
        command = [sys.executable, "-m", "sphinx", *options, "docs", str(MANUAL)]
        subprocess.run(command, cwd=ROOT, check=True)

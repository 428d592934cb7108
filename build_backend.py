"""How pip makes a wheel of pyrcal: setuptools' way, with the manual built into it first.

The service shows the manual at ``/manual/``; it is made from ``docs/``, which is in a checkout and
in no wheel. Where it has been built already (``make docs``, a source archive) nothing more is
needed; an editable installation takes what ``make docs`` builds beside it.
"""

from __future__ import annotations

import subprocess
import sys
import tomllib
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
    """Return Sphinx with its extensions, and what pyrcal needs: the API reference imports it."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    return [*project["dependencies"], *project["optional-dependencies"]["docs"]]


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
    return build_meta.build_wheel(wheel_directory, config_settings, metadata_directory)


def build_sdist(sdist_directory: str, config_settings: Settings = None) -> str:
    """Build the manual, then the source archive with it; return the archive's name."""
    _build_manual()
    return build_meta.build_sdist(sdist_directory, config_settings)


def _build_manual() -> None:
    if not _manual_is_built():
        options = ["-q", "-W", "-d", "build/manual"]
        command = [sys.executable, "-m", "sphinx", *options, "docs", str(MANUAL)]
        subprocess.run(command, cwd=ROOT, check=True)

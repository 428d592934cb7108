"""Version of the installed code, with the commit it was made of."""

import subprocess
from functools import cache
from pathlib import Path

from service import __version__

_PACKAGE = Path(__file__).parent
COMMIT_FILE = _PACKAGE / "commit.txt"
"""Output of ``git describe`` at build time; the build backend writes it into every wheel."""


@cache
def software_version() -> str:
    """Return the version with the commit as its local part (PEP 440), such as "0.1.0+8ad82d30".

    ".modified" follows if tracked files differ from the commit. Without a commit file and outside
    a git checkout it is the plain version.
    """
    commit = describe_checkout(_PACKAGE.parent)
    # A checkout may contain a commit file that a build left there: git knows better.
    if not commit and COMMIT_FILE.is_file():
        commit = COMMIT_FILE.read_text(encoding="utf-8").strip()
    return f"{__version__}+{commit.replace('-', '.')}" if commit else __version__


def describe_checkout(root: Path) -> str:
    """Return the commit checked out in ``root``, with "-modified" if files differ, or ""."""
    if not (root / ".git").exists():
        return ""
    # Without optional locks git writes nothing, so a checkout may be read-only or in use.
    git = ["git", "--no-optional-locks", "-C", str(root)]
    describe = [*git, "describe", "--always", "--exclude=*", "--dirty=-modified"]
    try:
        answer = subprocess.run(describe, capture_output=True, text=True, check=True, timeout=5)
    except (OSError, subprocess.SubprocessError):
        return ""  # git is not installed, or refuses a checkout of another user
    return answer.stdout.strip()

"""What studies and benchmarks share: command line, pictures, sections of the pages of results.

A section is what a page has between ``<!-- begin: NAME -->`` and ``<!-- end: NAME -->``. The text
around it (target, conditions, limits) is written by hand.
"""

from __future__ import annotations

import argparse
import re
import socket
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from matplotlib.figure import Figure

RESULTS = Path(__file__).parents[1] / "docs" / "results"

MAX_BYTES = 95_000
"""Size of a picture; the manual takes pictures below 100 kB."""


def study_parser(module: str, text: str | None) -> argparse.ArgumentParser:
    """Return the parser of ``python -m MODULE``; ``text`` is the module's docstring."""
    summary = (text or "").strip().partition("\n\n")[0]
    return argparse.ArgumentParser(prog=f"python -m {module}", description=summary)


def save_picture(figure: Figure, path: Path, dpi: int = 80) -> None:
    """Write a picture with as many colours as ``MAX_BYTES`` allow."""
    from PIL import Image  # matplotlib brings it

    figure.savefig(path, dpi=dpi)
    with Image.open(path) as image:
        picture = image.convert("RGB")
    for colours in (256, 128, 96, 48):
        picture.quantize(colours, dither=Image.Dither.NONE).save(path, optimize=True)
        if path.stat().st_size <= MAX_BYTES:
            break


def free_port() -> int:
    """Return a TCP port of loopback that nobody uses now."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        return int(server.getsockname()[1])


def write_section(page: Path, name: str, text: str) -> None:
    """Replace the marked section ``name`` of a page; ValueError unless the page has it once."""
    begin, end = f"<!-- begin: {name} -->", f"<!-- end: {name} -->"
    old = page.read_text(encoding="utf-8")
    parts = re.split(f"({re.escape(begin)}\n.*?{re.escape(end)})", old, flags=re.DOTALL)
    if len(parts) != 3:
        raise ValueError(f"{page}: found {len(parts) // 2} sections {name!r}; expected one")
    page.write_text(f"{parts[0]}{begin}\n{text.strip()}\n{end}{parts[2]}", encoding="utf-8")

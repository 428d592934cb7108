"""One HTML file that needs nothing else: figures are PNG inside it."""

from __future__ import annotations

import base64
import html
import io
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_DPI = 110

_STYLE = """
body { font: 15px/1.5 system-ui, "DejaVu Sans", sans-serif; color: #1b1f24; background: #fff;
  max-width: 1080px; margin: 2rem auto; padding: 0 1.2rem; }
h1 { font-size: 1.7rem; line-height: 1.25; margin-bottom: .3rem; }
h2 { font-size: 1.25rem; margin-top: 2.6rem; border-top: 1px solid #d0d7de; padding-top: 1rem; }
h3 { font-size: 1rem; margin: 1.6rem 0 .4rem; }
nav a { margin-right: 1rem; } a { color: #0757ae; }
figure { margin: 1rem 0; } figure img { max-width: 100%; height: auto; display: block; }
figcaption { color: #4b535d; font-size: .9rem; margin-top: .3rem; }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; margin: .6rem 0; font-size: .92rem; }
th, td { padding: .28rem .7rem; border-bottom: 1px solid #d8dee4; text-align: right;
  vertical-align: top; }
th { border-bottom: 2px solid #8c959f; font-weight: 600; }
th:first-child, td:first-child, td.words, th.words { text-align: left; }
.why { border-left: 3px solid #bf8700; padding: .1rem 0 .1rem .8rem; margin: .7rem 0; }
.agrees { border-left: 3px solid #1a7f37; padding: .1rem 0 .1rem .8rem; margin: .7rem 0; }
"""


@dataclass(frozen=True, slots=True, kw_only=True)
class Section:
    """A heading and what stands under it."""

    anchor: str
    """Of links to it, one word."""

    title: str
    body: str
    """HTML."""


def canvas(width_in: float, height_in: float) -> Figure:
    """Return an empty figure; matplotlib is needed from here on and not before."""
    from matplotlib.figure import Figure

    return Figure(figsize=(width_in, height_in), layout="constrained")


def page(title: str, opening: str, sections: Sequence[Section]) -> str:
    """Return the whole file; ``opening`` is HTML before the first heading."""
    links = "".join(f'<a href="#{s.anchor}">{html.escape(s.title)}</a>' for s in sections)
    bodies = "".join(
        f'<section id="{s.anchor}"><h2>{html.escape(s.title)}</h2>\n{s.body}</section>\n'
        for s in sections
    )
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{html.escape(title)}</title><style>{_STYLE}</style></head>\n"
        f"<body><h1>{html.escape(title)}</h1>\n{opening}<nav>{links}</nav>\n{bodies}</body></html>\n"
    )


def heading(text: str) -> str:
    """Return a heading inside a section."""
    return f"<h3>{html.escape(text)}</h3>\n"


def paragraph(text: str) -> str:
    """Return a paragraph of plain text."""
    return f"<p>{html.escape(text)}</p>\n"


def remark(text: str, *, agrees: bool) -> str:
    """Return a sentence on how ours compares with the paper's."""
    return f'<p class="{"agrees" if agrees else "why"}">{html.escape(text)}</p>\n'


def table(head: Sequence[str], rows: Iterable[Sequence[str]], *, words: Sequence[int] = ()) -> str:
    """Return a table of plain text; ``words`` are columns that read as text, not numbers."""

    def cells(values: Sequence[str], tag: str) -> str:
        return "".join(
            f"<{tag}{' class=words' if k in words else ''}>{html.escape(value)}</{tag}>"
            for k, value in enumerate(values)
        )

    body = "".join(f"<tr>{cells(row, 'td')}</tr>\n" for row in rows)
    return f'<div class="scroll"><table><tr>{cells(head, "th")}</tr>\n{body}</table></div>\n'


def picture(figure: Figure, caption: str) -> str:
    """Return a figure with its caption, the image inside the text."""
    data = io.BytesIO()
    figure.savefig(data, format="png", dpi=_DPI)
    encoded = base64.b64encode(data.getvalue()).decode()
    alternative = html.escape(caption.split(".")[0], quote=True)
    return (
        f'<figure><img alt="{alternative}" src="data:image/png;base64,{encoded}">'
        f"<figcaption>{html.escape(caption)}</figcaption></figure>\n"
    )

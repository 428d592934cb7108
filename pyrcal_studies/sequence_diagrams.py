"""Draws the sequence diagrams of docs/rtc.md as SVG: start, telemetry, swap, rollback, loss.

Run: ``python -m pyrcal_studies.sequence_diagrams``; a test compares the files. Every diagram has a
white panel of its own, so that it can be read on a dark page.
"""

from __future__ import annotations

from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Final

FOLDER: Final = Path(__file__).parents[1] / "docs" / "rtc"

_WIDTH, _ROW, _TOP = 900, 46, 74
"""Width of a diagram, height of a step and of the head, pixels."""

_INK, _LINE, _NOTE = "#1d2433", "#5b6478", "#fff4d6"


@dataclass(frozen=True, slots=True)
class Message:
    """Arrow from one participant to another."""

    source: int
    target: int
    text: str
    detail: str = ""
    """Second line: a time limit, or the requirement."""

    lost: bool = False
    """True if it never arrives."""


@dataclass(frozen=True, slots=True)
class Note:
    """What a participant does by itself."""

    at: int
    text: str


@dataclass(frozen=True, slots=True)
class Diagram:
    """Sequence diagram with two or three participants."""

    title: str
    participants: tuple[str, ...]
    steps: tuple[Message | Note, ...]


_RTC, _SERVICE = 0, 1
_PAIR: Final = ("RTC", "pyrcal service")

DIAGRAMS: Final[dict[str, Diagram]] = {
    "start": Diagram(
        "Start: the RTC comes to a running service",
        _PAIR,
        (
            Note(_SERVICE, "router, queryables, then the token alive/service"),
            Message(_RTC, _SERVICE, "zenoh session", "retried at least once a second (R-1)"),
            Note(_RTC, "subscribers and queryables are declared"),
            Message(_RTC, _SERVICE, "token alive/rtc", "last of all (R-4)"),
            Message(_RTC, _SERVICE, "tel/status, tel/frames", "session, basis_id, config_id"),
            Message(_RTC, _SERVICE, "query cm/current", "once per session (R-74)"),
            Message(_SERVICE, _RTC, "manifest, or an error reply", "then as after a commit"),
            Message(_SERVICE, _RTC, "query rtc/cm/applied, and each chunk"),
            Message(_RTC, _SERVICE, "manifest and numbers in use", "within 2 s (R-75)"),
            Note(_SERVICE, "compares signs, order, units and modes with the model"),
            Message(_SERVICE, _RTC, "query cmd/rtc/dither, start"),
            Message(_RTC, _SERVICE, "reply: accepted, start_seq", "within 1 s (R-42)"),
        ),
    ),
    "telemetry": Diagram(
        "Telemetry: frames, status and a dither at 1 kHz",
        _PAIR,
        (
            Message(_RTC, _SERVICE, "tel/frames: seq0 = 4000, n = 20", "10 to 100 a second (R-19)"),
            Message(_RTC, _SERVICE, "tel/frames: seq0 = 4020, n = 20"),
            Message(_RTC, _SERVICE, "tel/status: seq = 4039", "1 to 10 a second (R-36)"),
            Message(_SERVICE, _RTC, "query cmd/rtc/dither, start, id d-1"),
            Message(
                _RTC, _SERVICE, "reply: accepted, start_seq = 4050", "ahead of frames sent (R-45)"
            ),
            Message(_RTC, _SERVICE, "tel/frames: seq0 = 4040, n = 10", "dither false (R-18)"),
            Message(
                _RTC, _SERVICE, "tel/frames: seq0 = 4050, n = 20", "dither true: its columns (R-17)"
            ),
            Message(_RTC, _SERVICE, "tel/status: dither d-1 from 4050", "at once (R-36, R-40)"),
            Note(_RTC, "the dither ends by itself after its duration (R-46)"),
            Message(_RTC, _SERVICE, "tel/status: dither nil"),
        ),
    ),
    "swap": Diagram(
        "Swap: a reconstructor in two phases",
        _PAIR,
        (
            Message(
                _SERVICE, _RTC, "cm/cm-7/chunk/0 ... chunk/k", "any order, also after the commit"
            ),
            Message(_SERVICE, _RTC, "cm/cm-7/commit: manifest", "time 0"),
            Message(_RTC, _SERVICE, "query cm/cm-7?chunk=1, if it is missing", "at 2 s (R-65)"),
            Message(_SERVICE, _RTC, "bytes of chunk 1"),
            Note(_RTC, "checks length, SHA-256, shape, ids, finite numbers (R-66)"),
            Message(_RTC, _SERVICE, "cm/ack: staged", "may be left out"),
            Note(_RTC, "swaps between two frames; integrator and gains stay (R-67)"),
            Message(
                _RTC,
                _SERVICE,
                "cm/ack: applied, frame_seq = 9120",
                "within 2 s, at most 3 s (R-68)",
            ),
            Message(
                _RTC, _SERVICE, "tel/frames: seq0 = 9120, cm_id = cm-7", "a new batch (R-18, R-69)"
            ),
            Message(_RTC, _SERVICE, "tel/status: cm_id = cm-7"),
            Note(_SERVICE, "probation: 4 s of telemetry against the matrix before"),
        ),
    ),
    "rollback": Diagram(
        "Rollback: the earlier numbers under a new id",
        _PAIR,
        (
            Note(_SERVICE, "cm-7 makes the loop worse than cm-6 did"),
            Message(_SERVICE, _RTC, "chunks with the numbers of cm-6, id cm-8"),
            Message(_SERVICE, _RTC, "cm/cm-8/commit", "ids are never reused (R-11)"),
            Message(_RTC, _SERVICE, "cm/ack: applied, frame_seq", "within 2 s (R-68)"),
            Message(_RTC, _SERVICE, "tel/frames with cm_id = cm-8"),
            Note(_SERVICE, "mode hold, alarm probation; the loop is checked for 4 s"),
            Message(_SERVICE, _RTC, "cmd/rtc/loop: open, if the loop is lost all the same"),
            Message(_RTC, _SERVICE, "tel/status: open, in a new session", "integrator 0 (R-51)"),
        ),
    ),
    "loss": Diagram(
        "Loss: of a batch, of the link, of the RTC",
        _PAIR,
        (
            Message(_RTC, _SERVICE, "tel/frames: seq0 = 500, n = 20", lost=True),
            Message(
                _RTC, _SERVICE, "tel/frames: seq0 = 520, n = 20", "held back for at most 0.5 s"
            ),
            Message(_SERVICE, _RTC, "request for what is missing", "advanced publisher only"),
            Message(_RTC, _SERVICE, "tel/frames: seq0 = 500, n = 20"),
            Note(_SERVICE, "router ends: the link is lost"),
            Note(_RTC, "the loop continues at its full rate (R-2)"),
            Message(
                _RTC, _SERVICE, "zenoh session; same session, later seq0", "within 10 s (R-1, R-23)"
            ),
            Note(_RTC, "RTC ends: its token disappears, rtc-vanished"),
            Message(_RTC, _SERVICE, "token; new session, any seq0", "new integrator (R-22)"),
            Note(_SERVICE, "new session counts: pending dithers, matrices are void (R-27)"),
        ),
    ),
}


def draw_diagram(diagram: Diagram) -> str:
    """Return a diagram as the text of an SVG file."""
    height = _TOP + _ROW * len(diagram.steps) + 26
    spread = _WIDTH - 2 * 150
    lanes = [150 + spread * k // (len(diagram.participants) - 1) for k in (0, 1)]
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {_WIDTH} {height}" role="img" '
        f'font-family="system-ui, sans-serif"><title>{escape(diagram.title)}</title>',
        '<defs><marker id="a" markerWidth="10" markerHeight="10" refX="9" refY="5" orient="auto">'
        f'<path d="M0,0 L10,5 L0,10 z" fill="{_INK}"/></marker></defs>',
        f'<rect width="{_WIDTH}" height="{height}" rx="6" fill="#ffffff"/>',
    ]
    for x, name in zip(lanes, diagram.participants, strict=True):
        parts += [
            f'<line x1="{x}" y1="52" x2="{x}" y2="{height - 14}" stroke="{_LINE}" '
            'stroke-dasharray="4 4"/>',
            f'<rect x="{x - 90}" y="16" width="180" height="36" rx="6" fill="#e8f1fb" '
            f'stroke="{_LINE}"/>',
            _text(x, 39, name, 15, weight=600),
        ]
    for k, step in enumerate(diagram.steps):
        y = _TOP + _ROW * k + 24
        parts += (
            _draw_note(step, lanes, y) if isinstance(step, Note) else _draw_arrow(step, lanes, y)
        )
    return "\n".join([*parts, "</svg>"]) + "\n"


def _draw_arrow(step: Message, lanes: list[int], y: int) -> list[str]:
    start, end = lanes[step.source], lanes[step.target]
    if step.lost:
        end = (start + 3 * end) // 4
    middle = (lanes[0] + lanes[1]) // 2
    parts = [
        f'<line x1="{start}" y1="{y}" x2="{end}" y2="{y}" stroke="{_INK}" stroke-width="1.6" '
        + ('stroke-dasharray="6 4"/>' if step.lost else 'marker-end="url(#a)"/>'),
        _text(middle, y - 7, step.text, 14),
    ]
    if step.detail:
        parts.append(_text(middle, y + 15, step.detail, 12, fill=_LINE))
    if step.lost:
        parts.append(_text(end + 14, y + 6, "✕ lost", 14, fill="#b3261e", anchor="start"))
    return parts


def _draw_note(step: Note, lanes: list[int], y: int) -> list[str]:
    width = 24 + 7.0 * len(step.text)
    x = lanes[step.at] - width / 2
    x = min(max(x, 10.0), _WIDTH - 10.0 - width)
    return [
        f'<rect x="{x:.0f}" y="{y - 20}" width="{width:.0f}" height="28" rx="4" fill="{_NOTE}" '
        f'stroke="#c9a227"/>',
        _text(round(x + width / 2), y - 1, step.text, 13),
    ]


def _text(
    x: int,
    y: int,
    text: str,
    size: int,
    *,
    weight: int = 400,
    fill: str = _INK,
    anchor: str = "middle",
) -> str:
    return (
        f'<text x="{x}" y="{y}" font-size="{size}" font-weight="{weight}" fill="{fill}" '
        f'text-anchor="{anchor}">{escape(text)}</text>'
    )


def main() -> None:
    """Write all diagrams."""
    for name, diagram in DIAGRAMS.items():
        (FOLDER / f"{name}.svg").write_text(draw_diagram(diagram), encoding="utf-8")


if __name__ == "__main__":
    main()

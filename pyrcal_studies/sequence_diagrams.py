"""Draws the sequence diagrams of docs/rtc.md as SVG: start, telemetry, swap, rollback, loss.

Run: ``python -m pyrcal_studies.sequence_diagrams``; a test compares the files. Every diagram has a
white panel of its own, so that it can be read on a dark page.
"""

from __future__ import annotations

from html import escape
from pathlib import Path
from typing import Final

FOLDER: Final = Path(__file__).parents[1] / "docs" / "rtc"

_WIDTH, _ROW, _TOP = 900, 46, 74
"""Width of a diagram, height of a step and of the head, pixels."""

_RTC, _SERVICE = 150, 750
"""Positions of the lines of the two participants, pixels."""

_INK, _LINE, _NOTE = "#1d2433", "#5b6478", "#fff4d6"


DIAGRAMS: Final = {
    "start": """
Start: the RTC comes to a running service
service: router, queryables, then the token alive/service
-> zenoh session | retried at least once a second (R-1)
rtc: subscribers and queryables are declared
-> token alive/rtc | last of all (R-4)
-> tel/status, tel/frames | session, basis_id, config_id
-> query cm/current | once per session (R-74)
<- manifest, or an error reply | then as after a commit
<- query rtc/cm/applied, and each chunk
-> manifest and numbers in use | within 2 s (R-75)
service: compares signs, order, units and modes with the model
<- query cmd/rtc/dither, start
-> reply: accepted, start_seq | within 1 s (R-42)
""",
    "telemetry": """
Telemetry: frames, status and a dither at 1 kHz
-> tel/frames: seq0 = 4000, n = 20 | 10 to 100 a second (R-19)
-> tel/frames: seq0 = 4020, n = 20
-> tel/status: seq = 4039 | 1 to 10 a second (R-36)
<- query cmd/rtc/dither, start, id d-1
-> reply: accepted, start_seq = 4050 | ahead of frames sent (R-45)
-> tel/frames: seq0 = 4040, n = 10 | dither false (R-18)
-> tel/frames: seq0 = 4050, n = 20 | dither true: its columns (R-17)
-> tel/status: dither d-1 from 4050 | at once (R-36, R-40)
rtc: the dither ends by itself after its duration (R-46)
-> tel/status: dither nil
""",
    "swap": """
Swap: a reconstructor in two phases
<- cm/cm-7/chunk/0 ... chunk/k | any order, also after the commit
<- cm/cm-7/commit: manifest | time 0
-> query cm/cm-7?chunk=1, if it is missing | at 2 s (R-65)
<- bytes of chunk 1
rtc: checks length, SHA-256, shape, ids, finite numbers (R-66)
-> cm/ack: staged | may be left out
rtc: swaps between two frames; integrator and gains stay (R-67)
-> cm/ack: applied, frame_seq = 9120 | within 2 s, at most 3 s (R-68)
-> tel/frames: seq0 = 9120, cm_id = cm-7 | a new batch (R-18, R-69)
-> tel/status: cm_id = cm-7
service: probation: 4 s of telemetry against the matrix before
""",
    "rollback": """
Rollback: the earlier numbers under a new id
service: cm-7 makes the loop worse than cm-6 did
<- chunks with the numbers of cm-6, id cm-8
<- cm/cm-8/commit | ids are never reused (R-11)
-> cm/ack: applied, frame_seq | within 2 s (R-68)
-> tel/frames with cm_id = cm-8
service: mode hold, alarm probation; the loop is checked for 4 s
<- cmd/rtc/loop: open, if the loop is lost all the same
-> tel/status: open, in a new session | integrator 0 (R-51)
""",
    "loss": """
Loss: of a batch, of the link, of the RTC
-x tel/frames: seq0 = 500, n = 20
-> tel/frames: seq0 = 520, n = 20 | held back for at most 0.5 s
<- request for what is missing | advanced publisher only
-> tel/frames: seq0 = 500, n = 20
service: router ends: the link is lost
rtc: the loop continues at its full rate (R-2)
-> zenoh session; same session, later seq0 | within 10 s (R-1, R-23)
rtc: RTC ends: its token disappears, rtc-vanished
-> token; new session, any seq0 | new integrator (R-22)
service: new session counts: pending dithers, matrices are void (R-27)
""",
}
"""Diagrams by the name of their file: title, then one step a line.

``->`` is a message from the RTC to the service, ``<-`` one to the RTC, ``-x`` one that never
arrives; its second line follows ``|``. ``rtc:`` and ``service:`` are what they do by themselves.
"""


def draw_diagram(text: str) -> str:
    """Return a diagram as the text of an SVG file."""
    title, *steps = text.strip().splitlines()
    height = _TOP + _ROW * len(steps) + 26
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {_WIDTH} {height}" role="img" '
        f'font-family="system-ui, sans-serif"><title>{escape(title)}</title>',
        '<defs><marker id="a" markerWidth="10" markerHeight="10" refX="9" refY="5" orient="auto">'
        f'<path d="M0,0 L10,5 L0,10 z" fill="{_INK}"/></marker></defs>',
        f'<rect width="{_WIDTH}" height="{height}" rx="6" fill="#ffffff"/>',
    ]
    for x, name in ((_RTC, "RTC"), (_SERVICE, "pyrcal service")):
        parts += [
            f'<line x1="{x}" y1="52" x2="{x}" y2="{height - 14}" stroke="{_LINE}" '
            'stroke-dasharray="4 4"/>',
            f'<rect x="{x - 90}" y="16" width="180" height="36" rx="6" fill="#e8f1fb" '
            f'stroke="{_LINE}"/>',
            _text(x, 39, name, 15, weight=600),
        ]
    for k, step in enumerate(steps):
        y = _TOP + _ROW * k + 24
        arrow, note = step[:2], step.partition(": ")
        if arrow in {"->", "-x", "<-"}:
            parts += _draw_arrow(arrow, *step[3:].partition(" | ")[::2], y)
        else:
            parts += _draw_note({"rtc": _RTC, "service": _SERVICE}[note[0]], note[2], y)
    return "\n".join([*parts, "</svg>"]) + "\n"


def _draw_arrow(arrow: str, text: str, detail: str, y: int) -> list[str]:
    start, end = (_SERVICE, _RTC) if arrow == "<-" else (_RTC, _SERVICE)
    lost = arrow == "-x"
    if lost:
        end = (start + 3 * end) // 4
    middle = (_RTC + _SERVICE) // 2
    parts = [
        f'<line x1="{start}" y1="{y}" x2="{end}" y2="{y}" stroke="{_INK}" stroke-width="1.6" '
        + ('stroke-dasharray="6 4"/>' if lost else 'marker-end="url(#a)"/>'),
        _text(middle, y - 7, text, 14),
    ]
    if detail:
        parts.append(_text(middle, y + 15, detail, 12, fill=_LINE))
    if lost:
        parts.append(_text(end + 14, y + 6, "✕ lost", 14, fill="#b3261e", anchor="start"))
    return parts


def _draw_note(lane: int, text: str, y: int) -> list[str]:
    width = 24 + 7.0 * len(text)
    x = min(max(lane - width / 2, 10.0), _WIDTH - 10.0 - width)
    return [
        f'<rect x="{x:.0f}" y="{y - 20}" width="{width:.0f}" height="28" rx="4" fill="{_NOTE}" '
        f'stroke="#c9a227"/>',
        _text(round(x + width / 2), y - 1, text, 13),
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

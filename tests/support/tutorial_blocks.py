"""The blocks of a tutorial in their order, and the comparison of outputs with those printed."""

import re
from itertools import zip_longest

BLOCK = re.compile(
    r"(?P<mark><!-- (?:not run:|printed by) [^\n]+ -->\n)?^```(?P<kind>\w+)\n(?P<text>.*?)^```",
    re.M | re.S,
)
ENDING = re.compile(r"^<!-- printed by (\w+) at its end -->\n```text\n(.*?)^```", re.M | re.S)
"""Output of a command that ran beside the page, after Ctrl-C."""

NUMBER = re.compile(r"(?<![\w.])[-+]?(?:\d+\.?\d*|\.\d+)(?:e[-+]?\d+)?(?![\w])")


def steps(page):
    """Each block that runs: (kind, text, output printed after it or None)."""
    found = list(BLOCK.finditer(page.read_text("utf-8")))
    for block, after in zip_longest(found, found[1:]):
        if block["kind"] in {"sh", "python"} and not block["mark"]:
            follows = after is not None and after["kind"] == "text" and not after["mark"]
            printed = after["text"] if follows else None
            yield block["kind"], block["text"], printed


def parts(line):
    """A line without its numbers, and the numbers as written."""
    return " ".join(NUMBER.sub("#", line).split()), NUMBER.findall(line)


def close(written, found):
    """Whether two numbers agree within 5 %, or three units of the last digit that is written."""
    one, other = float(written), float(found)
    digits = len(re.sub(r"e.*", "", written).partition(".")[2])
    return abs(one - other) <= max(0.05 * abs(one), 3.0 * 10.0**-digits)


def agrees(line, candidate):
    """Whether a line is the printed one; "..." within it stands for any text.

    Numbers are compared up to the first "...".
    """
    shape, _ = parts(line)
    other, values = parts(candidate)
    pieces = [re.escape(piece.strip()) for piece in shape.split("...")]
    _, numbers = parts(line.partition("...")[0])
    return bool(re.fullmatch(" ?.* ?".join(pieces), other)) and all(map(close, numbers, values))


def missing_lines(printed, output):
    """The lines of ``printed`` that ``output`` does not have, in their order; "..." skips some."""
    lines = iter(output.splitlines())
    missing = []
    for line in printed.splitlines():
        if line.strip() in {"", "..."}:
            continue
        rest = list(lines)
        for k, candidate in enumerate(rest):
            if agrees(line, candidate):
                lines = iter(rest[k + 1 :])
                break
        else:
            missing.append(line)
            lines = iter(rest)
    return missing

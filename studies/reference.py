"""Writes the reference pages of the manual: settings, instrument file, commands, REST, alarms."""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import is_dataclass
from itertools import chain
from typing import Any

from check_rtc.__main__ import check_parser
from pyrcal.arguments import OTHER_PROGRAMS, command_line
from service.config.instrument_schema import WHOLE
from service.config.settings import Settings
from service.config.sources import Table
from service.tracking.alarms import ALARMS
from studies.contract_tables import described, table
from studies.demo.arguments import demo_parser

Schema = Mapping[str, Any]

_LIMITS = {"exclusiveMinimum": ">", "minimum": "≥", "exclusiveMaximum": "<", "maximum": "≤"}

_HEAD = ("key", "type", "default", "meaning")

_OPTION = ("argument", "meaning")

_COMMON = "Commands that ask a running service"

_OFTEN = 20
"""What so many commands say in the same words stands once, before them."""


def page(title: str, *parts: str) -> str:
    """Return a page that is written by this program."""
    note = "Written by `python -m studies.pages` from what the program goes by; change that."
    return "\n\n".join([f"# {title}", note, *parts]) + "\n"


# --- settings and instrument files


def settings() -> str:
    """Return docs/reference/settings.md: every key of the service's settings."""
    intro = (
        "Command line > environment > TOML file > defaults. A key `port` in the section `[api]` is "
        "`PYRCAL_API__PORT` in the environment; values other than text are written as in TOML "
        '(`PYRCAL_DITHER__MODES="[501, 450]"`). An unknown key, a wrong type or a number out of '
        "range is refused with one line that names the file and the key."
    )
    return page("Settings", intro, *_tables(Settings))


def instrument() -> str:
    """Return docs/reference/instrument.md: every key of an instrument file."""
    intro = (
        "A TOML file that tells of the telescope, the pyramid, the mirror and how the RTC lists "
        "slopes. What has no default must be there. [Fitting a measured "
        "matrix](../integrate/fitting.md) has the smallest one, and what orientation means. A "
        "reference to data is `path:/dataset`, relative to the file."
    )
    return page("The instrument file", intro, *_tables(WHOLE))


def _tables(whole: type[Table]) -> Iterator[str]:
    """Yield the sections of a file, each with its keys."""
    schema = whole.model_json_schema()
    kinds: dict[str, Schema] = schema["$defs"]
    for section, place in schema["properties"].items():
        of_each = place.get("items", place)
        kind = kinds[of_each["$ref"].rpartition("/")[2]]
        yield f"## [{section}]" if of_each is place else f"## [[{section}]]"
        about = _text(kind).partition(": ")[2]
        yield about[:1].upper() + about[1:]
        needed = kind.get("required", ())
        record = whole.model_fields[section].annotation
        told = _told(record) if isinstance(record, type) and is_dataclass(record) else {}
        yield table(
            _HEAD,
            [
                (
                    f"`{key}`",
                    _type(field, kinds),
                    "needed" if key in needed else _default(field),
                    _text({"description": told.get(key, "")} | field),
                )
                for key, field in kind["properties"].items()
            ],
        )


def _told(record: type) -> dict[str, str]:
    """Return what a record says of its fields, or those it is made of."""
    told = [described(base) for base in reversed(record.__mro__[:-1])]
    return {key: text for texts in told for key, text in texts.items() if text}


def _type(field: Schema, kinds: Mapping[str, Schema]) -> str:
    if "$ref" in field:
        return _type(kinds[field["$ref"].rpartition("/")[2]], kinds)
    for word in ("anyOf", "prefixItems"):
        if word in field:
            several = [_type(each, kinds) for each in field[word] if each.get("type") != "null"]
            return (" or " if word == "anyOf" else ", ").join(dict.fromkeys(several))
    if "enum" in field:
        return ", ".join(f"`{value}`" for value in field["enum"])
    if "const" in field:
        return f"`{field['const']}`"
    if field["type"] == "array":
        return f"list of {_type(field['items'], kinds)}" if "items" in field else "list"
    if field["type"] == "object" and "properties" in field:
        return "table of " + ", ".join(f"`{key}`" for key in field["properties"])
    limits = [f"{sign} {field[limit]:g}" for limit, sign in _LIMITS.items() if limit in field]
    return " ".join([field["type"], ", ".join(limits)]).strip()


def _default(field: Schema) -> str:
    value = field.get("default")
    match value:
        case None | []:
            return ""
        case bool():
            return f"`{str(value).lower()}`"
        case str() if field.get("format") == "path":
            return f"`{value}`"
        case _:
            return f"`{value}`"


def _text(field: Schema) -> str:
    text = " ".join(field.get("description", "").replace("``", "`").split())
    return text.replace("; None:", "; left out:").replace("None:", "Left out:")


# --- the command line


def commands() -> str:
    """Return docs/reference/cli.md: every command with its options."""
    intro = (
        "`make` puts `pyrcal` into `.venv/bin`. Each command tells the same with `--help`; "
        "`pyrcal sim --help` and `pyrcal campaign --help` are manuals of their own. What commands "
        "that ask a running service have in common stands once, before the others; `--who` and "
        "`--why` are of those that order something."
    )
    parsers = dict(_parsers(command_line())) | {
        "pyrcal demo": demo_parser(),
        "pyrcal check-rtc": check_parser(),
    }
    told = {name: _texts(parser) for name, parser in parsers.items()}
    rows = {name: list(_options(parser)) for name, parser in parsers.items()}
    often = {
        line: None
        for lines in (told, rows)
        for line, n in Counter(chain.from_iterable(lines.values())).items()
        if n >= _OFTEN
    }
    parts = [f"## {_COMMON}", *(line for line in often if isinstance(line, str))]
    parts.append(table(_OPTION, [line for line in often if isinstance(line, tuple)]))
    for name in parsers:
        parts += [f"## {name}", *(text for text in told[name] if text not in often)]
        own = [row for row in rows[name] if row not in often]
        parts += [table(_OPTION, own)] if own else []
    return page("The command line", intro, *parts)


def _texts(parser: argparse.ArgumentParser) -> list[str]:
    texts = [" ".join((text or "").split()) for text in (parser.description, parser.epilog)]
    return [text for text in texts if text]


def _parsers(parser: argparse.ArgumentParser) -> Iterator[tuple[str, argparse.ArgumentParser]]:
    """Yield every command that is not another program, by its words."""
    below = [a for a in parser._actions if isinstance(a, argparse._SubParsersAction)]  # noqa: SLF001
    if not below:  # argparse tells its arguments nowhere else
        yield parser.prog, parser
    for action in below:
        for name, each in action.choices.items():
            if name not in OTHER_PROGRAMS:
                yield from _parsers(each)


def _options(parser: argparse.ArgumentParser) -> Iterator[tuple[str, str]]:
    for action in parser._actions:  # noqa: SLF001 - argparse tells its arguments nowhere else
        if action.help == argparse.SUPPRESS or "--help" in action.option_strings:
            continue
        values = ",".join(map(str, action.choices)) if action.choices else ""
        value = action.metavar or values or ("" if action.nargs == 0 else action.dest.upper())
        word = " ".join([", ".join(action.option_strings), str(value)]).strip().replace("|", r"\|")
        if action.dest == "threads":  # its default is of the machine that writes the page
            yield f"`{word}`", action.help or ""
            continue
        yield f"`{word}`", (action.help or "") % {**vars(action), "prog": parser.prog}


# --- REST


def rest(described: Schema) -> str:
    """Return docs/integrate/rest.md: what may be asked over REST, from its OpenAPI document."""
    intro = (
        "At `http://127.0.0.1:8080`, unless the settings say otherwise. `/docs` shows every field "
        "and tries it; [openapi.json](../openapi.json) is for programs. Errors are "
        "`application/problem+json`."
    )
    by_tag: dict[str, list[tuple[str, str]]] = {}
    for path, operations in described["paths"].items():
        for method, operation in operations.items():
            text = f"{operation['summary']}.".replace("``", "`")
            row = (f"`{method.upper()} {path}`", text)
            by_tag.setdefault(operation["tags"][0], []).append(row)
    parts = []
    for tag, rows in by_tag.items():
        parts += [f"## {tag[:1].upper()}{tag[1:]}", table(("request", "answer"), rows)]
    return page("REST", intro, *parts)


# --- alarms


def runbook(acts: Mapping[str, str]) -> str:
    """Return docs/operate/runbook.md: what to do about each alarm; ``acts``: what it may forbid."""
    parts = [
        "An alarm lasts as long as what it tells of. It is on the page, in `GET /v1/state`, on "
        "the wire (`ao/v1/{system}/alarm`), and in [the metrics](monitoring.md). Its text has the "
        "numbers; here is what each means and what to do.",
        "## What an alarm may forbid",
        table(("word", "what it forbids while the alarm lasts"), list(acts.items())),
    ]
    for name, kind in ALARMS.items():
        forbids = ", ".join(f"`{act}`" for act in acts if act in kind.blocks)
        head = [f"*{kind.severity.value}*", forbids and f"forbids {forbids}"]
        head.append(f"the {kind.responsible} can end it" if kind.responsible else "")
        means = kind.means[:1].upper() + kind.means[1:]
        do = f"**Do**: {kind.do}."
        parts += [f"## {name}", "; ".join(part for part in head if part), f"{means}.", do]
    return page("Runbook: what to do about an alarm", *parts)

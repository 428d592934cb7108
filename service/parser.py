"""Command lines of all programs of pyrcal: options, usage, help with examples, short errors.

The usage names operands first, in their order, then required options, then the others. An error
names the closest valid word. Quick to import.
"""

from __future__ import annotations

import argparse
import shutil
import textwrap
from collections.abc import Iterable, Iterator, Sequence
from typing import Any, NamedTuple, NoReturn

from typing_extensions import override


class Words(NamedTuple):
    """An option or an operand: ``--name VALUE``, a flag ``--name``, ``operand VALUE``."""

    form: str
    purpose: str | None
    group: str
    """Title of the options among which it is listed; empty for the command's own."""

    how: dict[str, Any]
    """Further keyword arguments of argparse."""


def words(form: str, purpose: str | None = None, **how: Any) -> Words:  # noqa: ANN401 - argparse's own
    """Return an option or an operand; one with ``choices`` is not a flag."""
    return Words(form, purpose, "", how)


def in_group(title: str, *every: Words) -> tuple[Words, ...]:
    """Return options that the help lists under a title of their own."""
    return tuple(one._replace(group=title) for one in every)


class HelpFormatter(argparse.HelpFormatter):
    """Formatter that marks required options and keeps lines that begin with two blanks."""

    def __init__(self, prog: str) -> None:
        super().__init__(prog, max_help_position=30, width=_text_width())

    @override
    def _get_help_string(self, action: argparse.Action) -> str:
        text = action.help or ""
        return f"{text} (required)".strip() if action.option_strings and action.required else text


class OneLineParser(argparse.ArgumentParser):
    """Parser that reports an error on one line, without the usage.

    Parameters
    ----------
    options
        Its options and operands; those of a list exclude each other.
    examples
        Words after the name of the command that make examples, which end the help.
    module
        Module whose ``main`` performs the command.
    """

    def __init__(
        self,
        *given: Any,  # noqa: ANN401 - argparse's own
        options: Iterable[Words | list[Words]] = (),
        examples: Iterable[str] = (),
        module: str = "",
        **more: Any,  # noqa: ANN401 - argparse's own
    ) -> None:
        more.setdefault("formatter_class", HelpFormatter)
        super().__init__(*given, **more)
        self._positionals.title = "arguments"
        self.examples = tuple(f"{self.prog} {words}".rstrip() for words in examples)
        if module:
            self.set_defaults(module=module)
        groups: dict[str, Any] = {"": self}
        for one in options:
            if isinstance(one, list):
                exclusive = self.add_mutually_exclusive_group()
                for each in one:
                    _add(exclusive, each)
            else:
                if one.group not in groups:
                    groups[one.group] = self.add_argument_group(one.group)
                _add(groups[one.group], one)

    def add_commands(self, dest: str, *rows: tuple[str, str, str, Sequence[Words]]) -> None:
        """Add commands below this one: name, purpose, words of an example, options."""
        commands = self.add_subparsers(dest=dest, required=True, metavar="COMMAND")
        for name, purpose, example, options in rows:
            commands.add_parser(name, help=purpose, examples=[example], options=options)

    def usage_parts(self) -> Iterator[str]:
        """Yield the usage part by part."""
        yield self.prog
        shown = self.shown_actions()
        yield from (operand_text(action) for action in shown if not action.option_strings)
        options = [action for action in shown if action.option_strings]
        yield from (option_text(action) for action in options if action.required)
        exclusive = [group._group_actions for group in self._mutually_exclusive_groups]  # noqa: SLF001
        for action in options:
            among = next((each for each in exclusive if action in each), [action])
            if not action.required and action is among[0]:
                yield f"[{' | '.join(map(option_text, among))}]"

    def shown_actions(self) -> list[argparse.Action]:
        """Return the operands and options that users give, without ``--help``."""
        return [
            a for a in self._actions if a.help != argparse.SUPPRESS and "-h" not in a.option_strings
        ]

    @override
    def format_usage(self) -> str:
        return "\n".join(wrap_usage(["usage:", *self.usage_parts()], _text_width())) + "\n"

    @override
    def format_help(self) -> str:
        self.usage = argparse.SUPPRESS
        text = f"{self.format_usage()}\n{super().format_help().lstrip()}"
        if not self.examples:
            return text
        return "\n".join(
            [f"{text.rstrip()}\n", "examples:", *(f"  {e}" for e in self.examples), ""]
        )

    @override
    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        options, unknown = super().parse_known_args(args, namespace)
        if unknown:
            known = (word for action in self._actions for word in action.option_strings)
            kind = "an unknown option" if unknown[0].startswith("-") else "one argument too many"
            self.error(f"found {unknown[0]!r}, {kind}{closest(unknown[0], known)}")
        return options, unknown

    @override
    def _check_value(self, action: argparse.Action, value: Any) -> None:
        if action.choices is not None and value not in action.choices:
            raise argparse.ArgumentError(action, self.explain_choice(action, str(value)))

    def explain_choice(self, action: argparse.Action, value: str) -> str:
        """Return what is wrong with a value that is none of the choices."""
        known = list(map(str, action.choices or ()))
        listed = ", ".join(map(repr, known))
        return f"found {value!r}, expected one of {listed}{closest(value, known)}"

    @override
    def error(self, message: str) -> NoReturn:
        """End the program with status 2."""
        self.exit(2, f"{self.prog}: {message}; see {self.prog} --help\n")


def _add(to: Any, one: Words) -> None:  # noqa: ANN401 - argparse's own, whose type is private
    """Add an option or an operand to a parser, or to a group of its options."""
    name, _, value = one.form.partition(" ")
    flag = name.startswith("-") and not value and "choices" not in one.how
    named = {"metavar": value} if value else {"action": "store_true"} if flag else {}
    to.add_argument(name, help=one.purpose, **named, **one.how)


def closest(found: str, known: Iterable[str]) -> str:
    """Return the end of a message: the known word that is most like the one found, if any is."""
    from difflib import get_close_matches

    near = get_close_matches(found, list(known), n=1, cutoff=0.7)
    return f"; did you mean {near[0]}" if near else ""


def wrap_usage(parts: Iterable[str], width: int) -> list[str]:
    """Return the parts of a usage on lines of a width; no part is broken."""
    text = " ".join(part.replace(" ", "\N{NO-BREAK SPACE}") for part in parts)
    lines = textwrap.wrap(
        text, width, subsequent_indent=" " * 8, break_long_words=False, break_on_hyphens=False
    )
    return [line.replace("\N{NO-BREAK SPACE}", " ") for line in lines]


def _text_width() -> int:
    return max(min(shutil.get_terminal_size().columns, 100) - 2, 40)


def operand_text(action: argparse.Action) -> str:
    """Return an operand as the usage shows it."""
    if isinstance(action, argparse._SubParsersAction):  # noqa: SLF001 - argparse tells it nowhere else
        return (
            "COMMAND ..." if len(action.choices) > _FEW else f"{{{'|'.join(action.choices)}}} ..."
        )
    name = _value(action)
    forms = {"?": f"[{name}]", "*": f"[{name} ...]", "+": f"{name} ..."}
    return forms.get(str(action.nargs), name)


_FEW = 8
"""Largest number of commands that a usage names one by one."""


def option_text(action: argparse.Action) -> str:
    """Return an option as the usage shows it, without brackets."""
    if action.nargs == 0:
        return action.option_strings[0]
    value = _value(action)
    return f"{action.option_strings[0]} {f'[{value}]' if action.nargs == '?' else value}"


def _value(action: argparse.Action) -> str:
    """Return the placeholder of a value: its own, the choices, or the option's name."""
    if action.metavar:
        return str(action.metavar)
    return f"{{{'|'.join(map(str, action.choices))}}}" if action.choices else action.dest.upper()

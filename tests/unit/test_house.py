"""The house: one name for one thing, one place for one name.

What is not so yet is listed here by name. No list may grow, and what has been mended leaves it.
"""

import ast
import re
from collections import defaultdict
from string import Formatter
from typing import get_args

import grimp
import pytest

from service.records.alarms import ALARMS
from service.records.commands import Instruction
from service.records.events import Event
from service.records.messages import ABOUT, SENTENCES
from tests.support.repository import HELD, ROOT

WORDS_TOO = {"acquisition", "archive-failed", "dither", "margin"}
"""Alarms whose name means something else, too: a word of the wire, of REST, of a file."""


def test_the_name_of_an_alarm_is_written_once():
    where = defaultdict(list)
    quoted = re.compile(f'"({"|".join(ALARMS.keys() - WORDS_TOO)})"')
    for top in HELD:
        for path in (ROOT / top).rglob("*.py"):
            text = path.read_text(encoding="utf-8")
            if quoted.search(text) is None:  # few files name any: the others need no parsing
                continue
            for node in ast.walk(ast.parse(text)):
                if isinstance(node, ast.Constant) and node.value in ALARMS.keys() - WORDS_TOO:
                    where[node.value].append(str(path.relative_to(ROOT)))
    places = (["service/records/alarms.py"], ["service/tracking/alarm_rules.py"])
    assert {name: found for name, found in where.items() if found not in places} == {}
    assert where


def test_records_lie_at_the_ground():
    """Who names the state imports neither the planner of dithers nor an estimator."""
    # Without its cache, which two sets of packages share: it keeps modules that are gone.
    imports = grimp.build_graph("service", cache_dir=None)
    ground = {"numpy", "service.errors", "service.model.misregistration"}
    for module in imports.find_descendants("service.records"):
        for imported in imports.find_modules_directly_imported_by(module):
            if imported.startswith("service.") and imported not in ground:
                assert imported.startswith(("service.records.", "service.wire"))
    assert len(imports.find_upstream_modules("service.records.state")) <= 13
    assert len(imports.find_upstream_modules("service.link.intake")) <= 25


def test_no_test_module_imports_another():
    """What tests share is in ``tests/support``."""
    imports = re.compile(
        r"^\s*(from tests\S*\.test_\w+ import|from tests\S* import test_)", re.MULTILINE
    )
    modules = list((ROOT / "tests").rglob("*.py"))
    assert [str(path) for path in modules if imports.search(path.read_text("utf-8"))] == []
    assert len(modules) > 300


KINDS = {kind.__name__ for kind in (*get_args(Event), Instruction)}
"""Names of all events and commands."""


def kinds_asked_for(source):
    """Yield each kind of event or command that some code asks whether an event is."""
    for node in ast.walk(ast.parse(source)):
        match node:
            case ast.MatchClass(cls=asked) | ast.Call(ast.Name("isinstance"), [_, asked]):
                yield from KINDS & names_in(asked)
            case ast.Compare(left=left, comparators=others) if "type(" in ast.unparse(node):
                yield from KINDS & names_in(left, *others)


def names_in(*nodes):
    """Return the last parts of the names in expressions."""
    parts = (part for node in nodes for part in ast.walk(node))
    return {getattr(part, "attr", getattr(part, "id", None)) for part in parts}


@pytest.mark.parametrize(
    ("source", "kinds"),
    [
        ("isinstance(event, ev.Tick)", {"Tick"}),
        ("isinstance(event, (cmd.SetMode, Status))", {"SetMode", "Status"}),
        ("isinstance(event, ev.Tick | ev.RtcVanished)", {"Tick", "RtcVanished"}),
        ("match it:\n case ev.Answered(reply=None) | Reject(): pass", {"Answered", "Reject"}),
        ("type(event) is ev.Tick", {"Tick"}),
        ("type(event) in {ev.Tick, Reject}", {"Tick", "Reject"}),
        ("match reply:\n case wire.Reply(): pass", set()),
        ("isinstance(value, bool)", set()),
        ("ev.Tick()", set()),
    ],
)
def test_a_look_at_an_event_is_found(source, kinds):
    assert set(kinds_asked_for(source)) == kinds


def test_no_module_of_the_tracker_asks_what_an_event_is():
    """The tables of ``service.tracker`` say who is given an event, which it is there."""
    folder = ROOT / "service" / "tracking"
    sources = {
        path: path.read_text("utf-8")
        for path in (*folder.rglob("*.py"), folder.parent / "tracker.py")
    }
    asked = {path.stem: set(kinds_asked_for(source)) for path, source in sources.items()}
    assert len(asked) > 25
    # An order is looked at before the step, to refuse it.
    assert asked.pop("interlocks") == {"SetLoop"}
    assert {module: kinds for module, kinds in asked.items() if kinds} == {}
    for path, source in sources.items():
        for node in ast.walk(ast.parse(source)):
            if isinstance(node, ast.arg) and node.annotation and path.stem != "tracker":
                assert "Event" not in names_in(node.annotation), f"{path.name}, {node.lineno}"


PACKAGES = ("service", "pyrcal", "check_rtc", "sim_rtc", "cacao_bridge")


def test_no_import_by_name_closes_a_circle():
    """A name handed to ``import_module`` is an import that the contracts do not see."""
    imports = grimp.build_graph(*PACKAGES, cache_dir=None)
    by_name = {
        (module, name)
        for module in imports.modules
        for name in names_imported(module, has_children=bool(imports.find_children(module)))
        if name in imports.modules
    }
    for importer, imported in by_name:
        imports.add_import(importer=importer, imported=imported)
    closed = [
        imports.find_shortest_chain(importer=imported, imported=importer)
        for importer, imported in by_name
    ]
    assert list(filter(None, closed)) == []
    assert ("service.instrument", "service.instrument.reader") in by_name


def names_imported(module, *, has_children):
    """Yield every text of a module that imports by name: any may be such a name."""
    path = ROOT / module.replace(".", "/")
    text = (path / "__init__.py" if has_children else path.with_suffix(".py")).read_text("utf-8")
    if "import_module" not in text and "__import__" not in text:
        return
    own = {"__name__": module, "__package__": module if has_children else module.rpartition(".")[0]}
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Constant):
            yield node.value
        elif isinstance(node, ast.JoinedStr):
            parts = [
                part.value if isinstance(part, ast.Constant) else own.get(ast.unparse(part.value))
                for part in node.values
            ]
            yield "".join(part or "?" for part in parts)


def composed():
    """Return names of values by code of a message in service, all texts, and names of lines."""
    codes, texts, lines = defaultdict(list), set(), set()
    for path in (ROOT / "service").rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            texts |= {node.value} if is_text(node) else set()
            if not isinstance(node, ast.Call):
                continue
            called = getattr(node.func, "attr", getattr(node.func, "id", ""))
            first = node.args[0] if node.args else None
            names = [one.value for one in ast.walk(first or node.func) if is_text(one)]
            if called == "compose":
                about = {ABOUT} if len(node.args) > 1 else set()
                for code in names:
                    codes[code].append(about | {word.arg for word in node.keywords})
            elif called in {"log", "warn", "logged", "_note", "as_message"}:
                lines |= set(names)
    return codes, texts, lines


def is_text(node):
    return isinstance(node, ast.Constant) and isinstance(node.value, str)


def test_each_message_has_its_sentence_and_each_sentence_its_values():
    codes, texts, lines = composed()
    assert codes.keys() <= SENTENCES.keys() <= texts
    for code, sentence in SENTENCES.items():
        names = {name for _, name, _, _ in Formatter().parse(sentence) if name is not None}
        # What makes it another message need not be said.
        assert all(given - {ABOUT} == names - {ABOUT} for given in codes[code]), code
        assert all(names & {ABOUT} <= given for given in codes[code]), code
    # A line without a code of its own has its name as code, and its text as the sentence.
    assert not lines & SENTENCES.keys()
    assert len(lines) > 60


CUTS = {"startswith", "endswith", "removeprefix", "removesuffix", "partition", "rpartition"}

WORDS = {"text", "reason", "verdict", "message", "detail", "note", "line", "error", "words", "id"}

WORDS_READ = {
    "service/files/toml.py": "messages of msgspec, which has no codes",
    "service/link/session.py": "messages of zenoh and of the operating system, which have no codes",
    "service/runtime/cluster.py": "the first line of an error of Dask is shown",
    "service/tracking/dither_request.py": "only the id is known of a dither that nobody follows",
    "service/wire/commands.py": "a refusal begins with its code (R-43)",
    "service/tracking/transitions.py": "a table in the source, written as text",
    "pyrcal/fitting/arguments.py": "words of the command line",
    "pyrcal/fitting/fit_file.py": "an error begins with the name of its file",
    "pyrcal/fitting/fit_table.py": "notes of importers repeat what a fit has found",
    "pyrcal/maintenance/archive.py": "an error begins with the name of its file",
    "pyrcal/maintenance/commission_page.py": "the audit trail keeps sentences only",
}

READERS = {
    "service/config/link_tables.py": "addresses",
    "service/config/settings.py": "names of environment variables",
    "service/files/__init__.py": "ranges of rows that a user writes",
    "service/files/toml.py": "places in a file",
    "service/link/guard.py": "addresses",
    "service/link/leader_election.py": "pattern of names of services",
    "service/link/session.py": "messages of zenoh, which have no codes",
    "service/program.py": "addresses in messages of zenoh",
    "service/records/events.py": "names of classes",
    "service/web/authentication.py": "addresses",
    "service/web/commands.py": "routes",
    "service/web/connections.py": "pattern of ids of requests",
    "service/web/keys.py": "pattern of names of keys",
    "service/web/page.py": "JSON",
    "service/wire/keys.py": "pattern of ids",
    "pyrcal/arguments.py": "negative numbers on the command line",
    "pyrcal/client/orders.py": "routes",
    "pyrcal/client/remote.py": "names of classes",
    "pyrcal/importers/cacao.py": "names of files, and scripts",
    "pyrcal/importers/layouts.py": "names of files",
}


def last_name(node):
    """Return the name at the end of an expression, of what a call is made on or with."""
    while isinstance(node, ast.Call):
        if isinstance(node.func, ast.Attribute):
            node = node.func.value
        else:
            node = node.args[0] if getattr(node.func, "id", "") == "str" else node.func
    return getattr(node, "attr", getattr(node, "id", ""))


def reads_words(node):
    """Return True if an expression cuts, or looks into, an id or a sentence."""
    if isinstance(node, ast.Call) and getattr(node.func, "attr", "") in CUTS:
        name = last_name(node.func.value)
    elif isinstance(node, ast.Compare) and isinstance(node.ops[0], ast.In | ast.NotIn):
        name = last_name(node.comparators[0])
    else:
        return False
    return name in WORDS or name.endswith("_id")


def test_nothing_but_people_reads_sentences_and_ids():
    """Codes, values and fields say what a program has to know."""
    readers, patterns = set(), set()
    for top in ("service", "pyrcal"):
        for path in (ROOT / top).rglob("*.py"):
            if "manual" in path.parts:
                continue
            name = path.relative_to(ROOT).as_posix()
            tree = ast.parse(path.read_text(encoding="utf-8"))
            if any(reads_words(node) for node in ast.walk(tree)):
                readers.add(name)
            imported = (n for n in ast.walk(tree) if isinstance(n, ast.Import))
            if any(one.name == "re" for n in imported for one in n.names):
                patterns.add(name)
    assert readers == WORDS_READ.keys()
    assert patterns == READERS.keys()

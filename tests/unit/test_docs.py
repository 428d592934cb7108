"""The manual: its commands are understood, its files are read, its links lead somewhere."""

import argparse
import json
import re
import shlex
import subprocess
import sys
import tomllib
from importlib.util import find_spec

import httpx
import pytest

from cacao_bridge.__main__ import arguments_parser
from cacao_bridge.settings import load as load_bridge
from check_rtc.__main__ import check_parser
from pyrcal.arguments import command_line, with_negative_numbers
from pyrcal.demo.arguments import demo_parser
from pyrcal.fitting.system_file import load_system
from service.api import create_app
from service.config import load_settings
from service.instrument import load_instrument
from service.records.alarms import ALARMS
from service.web import page
from sim_rtc.options import parse_options
from tests.support.api import assert_problem
from tests.support.manual import DOCS, PAGES, blocks_of, commands
from tests.support.repository import ROOT

READ_WHOLE = tuple(
    f"{page.stem}-" for name in ("tutorials", "howto") for page in (DOCS / name).glob("*.md")
)
"""Pages whose blocks build on each other: tests/system/test_manual.py runs them."""

SHELL_ALONE = {
    *("buildah", "cd", "chown", "dask", "docker", "export", "git", "grep", "install", "mkdir"),
    *("mmdebstrap", "openssl", "runuser", "sed", "systemctl", "useradd", "zip"),
}
"""Programs of others: that the shell understands them is all that is looked at."""


PARSER = command_line()
REST = json.loads((DOCS / "openapi.json").read_text(encoding="utf-8"))["paths"]


def blocks(kind, *, run=False):
    """Every fenced block of a kind: (page and number, text); those alone that can be ``run``."""
    for path in PAGES:
        for number, (text, why) in enumerate(blocks_of(path, kind)):
            if not (run and why):
                yield pytest.param(text, id=f"{path.stem}-{number}")


def check_pyrcal(words):
    """See that a command line is understood."""
    name, *rest = words
    try:
        match name:
            case "demo":
                demo_parser().parse_args(with_negative_numbers(rest))
            case "check-rtc":
                check_parser().parse_args(rest)
            case "cacao":
                arguments_parser().parse_args(rest)
            case "sim":
                parse_options([word.replace("bench.toml", "flao-lbt") for word in rest])
            case _:
                PARSER.parse_args(with_negative_numbers(words))
    except SystemExit as ended:
        if ended.code:  # --help ends with 0
            raise AssertionError(words) from ended


def check_make(words):
    targets = re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text("utf-8"), re.M)
    target = next(word for word in words if "=" not in word)
    assert target in targets
    given = [shlex.split(word.partition("=")[2]) for word in words if word.startswith("ARGS=")]
    if target == "demo" and given:
        check_pyrcal(["demo", *given[0]])


async def check_curl(words, client):
    """Ask the application: whatever it is that is not there, the request itself is right."""
    method, url, body, headers = "GET", "", None, {}
    words = iter(words)
    for word in words:
        if word == "-X":
            method = next(words)
        elif word == "-d":
            body = next(words)
        elif word == "-H":
            name, _, value = next(words).partition(": ")
            headers[name] = value
        elif word in {"-o", "-T"}:
            next(words)
        else:
            assert not word.startswith("-"), word
            url = word
    assert re.match(r"http://(127\.0\.0\.1|ao-pc):8080/", url), f"{url!r} is no URL"
    path = re.sub(r"^http://[^/]*", "", url)
    if path.startswith("/v1/fits"):  # a desk of its own, which is not there
        assert method.lower() in REST[re.sub(r"ID|\?.*", lambda m: "{id}" * (m[0] == "ID"), path)]
        return
    answer = await client.request(method, path, content=body, headers=headers)
    if answer.status_code == 404:
        assert answer.json()["type"] == "urn:pyrcal:problem:unknown-id", (path, answer.text)
    else:
        assert answer.status_code in {200, 202, 204}, (method, path, body, answer.text)


@pytest.mark.parametrize("text", list(blocks("sh")))
async def test_a_command_of_the_manual_is_understood(text, client):
    for program, *words in commands(text):
        match program.removeprefix(".venv/bin/").removeprefix("/opt/pyrcal/bin/"):
            case "pyrcal":
                check_pyrcal(words)
            case "make":
                check_make(words)
            case "curl":
                await check_curl(words, client)
            case "python" | "python3":
                assert find_spec(words[words.index("-m") + 1])
            case "pip":
                files = [word for word in words if word.endswith((".lock", ".txt"))]
                assert all((ROOT / file).is_file() for file in files)
            case other:
                assert other in SHELL_ALONE, other


@pytest.mark.parametrize("text", list(blocks("sh")))
def test_a_block_of_the_manual_is_one_that_the_shell_reads(text):
    subprocess.run(["bash", "-n"], input=text, text=True, check=True)


@pytest.mark.parametrize(
    "text", [block for block in blocks("toml") if ".h5:/" not in block.values[0]]
)
def test_a_file_of_the_manual_is_read(text, tmp_path):
    """By whoever reads it for a user: an instrument, a system, the bridge to cacao, the service.

    Files that name arrays are read with the page that makes them: tests/system/test_manual.py.
    """
    path = tmp_path / "it.toml"
    path.write_text(text, encoding="utf-8")
    if text.startswith("[instrument]"):
        assert load_instrument(path).modes.n_modes > 100
    elif text.startswith("[system]"):
        for name in re.findall(r'"(\w+\.toml)"', text):
            other = DOCS / "howto" / "systems.md"
            (tmp_path / name).write_text(next(blocks_of(other, "toml"))[0], encoding="utf-8")
        assert len(load_system(path).pairs) > 1
    elif text.startswith("[wire]"):
        assert load_bridge(path)
    else:
        assert load_settings(path, {})


@pytest.mark.parametrize(
    "text", [block for block in blocks("python", run=True) if not block.id.startswith(READ_WHOLE)]
)
def test_what_the_manual_writes_in_python_runs(text, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    exec(compile(text, "the manual", "exec"), {})


NEEDS_MORE = {"docker", "git", "pip"}


@pytest.mark.parametrize("text", list(blocks("python")))
def test_what_the_manual_writes_in_python_is_python(text):
    compile(text, "the manual", "exec")


def test_a_block_that_is_not_run_says_why():
    """The mark stands on the line before the block, and nowhere else; the rest is understood by
    the programs themselves, and run where it works on files: tests/system/test_manual.py.
    """
    for path in PAGES:
        for text, why in blocks_of(path, "sh"):
            words = {word for line in commands(text) for word in line[:3]}
            assert why or not words & NEEDS_MORE, (path, text)
    for path in PAGES:
        marked = [
            why for kind in ("sh", "toml", "python") for _, why in blocks_of(path, kind) if why
        ]
        assert len(marked) == path.read_text("utf-8").count("<!-- not run"), path


@pytest.mark.parametrize(
    "page", sorted((DOCS / "tutorials").glob("[!i]*.md")), ids=lambda page: page.stem
)
def test_the_last_command_of_a_tutorial_is_run(page):
    """By tests/system/test_manual.py; that of ``elt`` alone needs 15 GB and ten minutes."""
    *_, (_, why) = blocks_of(page, "sh")
    assert (why is None) == (page.stem != "elt")


def test_the_layout_on_the_architecture_page_is_that_of_the_code():
    """Its layers are those that the import contracts hold; its folders are those with code."""
    (layout,) = re.findall(
        r"^## Layout\n```\n(.*?)^```",
        (DOCS / "developer" / "architecture.md").read_text("utf-8"),
        re.M | re.S,
    )
    drawn, folders = re.split(r"\n(?=pyrcal/)", layout)
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))
    (contract,) = [
        c
        for c in project["tool"]["importlinter"]["contracts"]
        if c["type"] == "layers" and c["containers"] == ["service"]
    ]
    layers = [set(re.split(r" [:|] ", layer)) for layer in contract["layers"]]
    assert [
        set(layer.split(", ")) for layer in re.sub(r"service/|\s+", " ", drawn).strip().split(" > ")
    ] == layers
    with_code = {path.parent.name for path in ROOT.glob("*/*.py")} - {"service", "docs"}
    assert with_code | {"docs", "deploy", "tests"} == set(re.findall(r"^(\w+)/", folders, re.M))


def test_each_command_has_its_options_and_an_example_on_a_page():
    """The pages are generated, and compared with the code elsewhere."""
    index = (DOCS / "reference" / "cli.md").read_text("utf-8")
    for leaf in leaves(PARSER):
        name = leaf.prog.split()[1]
        page = (DOCS / "reference" / "cli" / f"{name}.md").read_text("utf-8")
        assert f"(cli/{name}.md)" in index
        (text,) = re.findall(rf"^usage: {leaf.prog}\b.*?^```", page, re.M | re.S) or [page]
        assert re.search("^examples:?$", text, re.M), leaf.prog
        options = [
            action.option_strings[0] for action in leaf.shown_actions() if action.option_strings
        ]
        assert not [option for option in options if option not in text]


def leaves(parser):
    """Every command below a parser."""
    below = [a for a in parser._actions if isinstance(a, argparse._SubParsersAction)]
    for action in below:
        for each in action.choices.values():
            yield from leaves(each)
    if not below:
        yield parser


def test_the_first_screen_of_the_readme_shows_pictures_and_tells_two_commands():
    first = "\n".join((ROOT / "README.md").read_text("utf-8").splitlines()[:40])
    pictures = re.findall(r"!\[[^]]+\]\(([^)]+)\)", first)
    assert len(pictures) == 3
    assert all((ROOT / picture).is_file() for picture in pictures)
    (text,) = re.findall(r"^```sh\n(.*?)^```", first, re.M | re.S)
    assert len(list(commands(text))) == 2


@pytest.mark.long
def test_every_page_can_be_read_and_every_link_leads_somewhere(tmp_path):
    """Sphinx itself says what does not; the HTML is made by make docs."""
    words = ["-q", "-W", "--keep-going", "-b", "dummy", "-d", str(tmp_path / "trees")]
    done = subprocess.run(
        [sys.executable, "-m", "sphinx", *words, str(ROOT / "docs"), str(tmp_path / "out")],
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr


def headings(name):
    """The anchors of a page, as Sphinx makes them."""
    text = (DOCS / f"{name}.md").read_text(encoding="utf-8")
    for title in re.findall(r"^##+ (.*)$", text, re.M):
        words = re.findall(r"[a-z0-9]+", title.lower())
        yield "-".join(words)


def test_the_help_of_the_page_leads_into_the_manual():
    text = (page.FILES / "index.html").read_text(encoding="utf-8")
    links = re.findall(r'href="manual/(?:([a-z/]+)\.html)?(?:#([a-z0-9-]+))?"', text)
    assert len(links) > 4
    for name, anchor in links:
        assert (DOCS / f"{name or 'index'}.md").is_file(), name
        assert not anchor or anchor in headings(name), anchor


def test_every_alarm_is_in_the_runbook():
    assert set(ALARMS) <= set(headings("operate/runbook"))


def test_a_picture_is_small():
    pictures = list((ROOT / "docs").rglob("*.png"))
    assert {path.name for path in pictures if path.stat().st_size > 100_000} == set()


async def test_the_manual_is_served_once_it_is_built(service, monkeypatch, tmp_path):
    monkeypatch.setattr(page, "MANUAL", tmp_path)
    transport = httpx.ASGITransport(create_app(service))
    async with httpx.AsyncClient(transport=transport, base_url="http://localhost") as client:
        answer = await client.get("/manual/")
        assert_problem(answer, 503, "http", "make docs")
        (tmp_path / "index.html").write_text("built", encoding="utf-8")
        answer = await client.get("/manual/")
        assert (answer.status_code, answer.text) == (200, "built")
        assert "script-src 'self'" in answer.headers["content-security-policy"]
        assert "unsafe" not in answer.headers["content-security-policy"]
        assert (await client.get("/manual/../../pyproject.toml")).status_code == 404

"""The container image: what the build is let see is what the Dockerfile copies and pip needs."""

import re
import shlex
import tomllib
from pathlib import Path, PurePosixPath

import pytest

from pyrcal.arguments import OTHER_PROGRAMS
from service.config import load_settings

ROOT = Path(__file__).parents[2]


def as_regex(pattern: str) -> re.Pattern[str]:
    """Docker's patterns: ``*`` within a name, ``**`` over any number of folders."""
    pieces = re.split(r"(\*\*/|\*\*|\*|\?)", pattern.strip("/"))
    meanings = {"**/": "(?:.*/)?", "**": ".*", "*": "[^/]*", "?": "[^/]"}
    return re.compile("".join(meanings.get(piece, re.escape(piece)) for piece in pieces))


def let_through(path: str, ignore: str) -> bool:
    """As Docker decides: the last line that matches the path, or a folder above it, counts."""
    above = [str(p) for p in PurePosixPath(path).parents][:-1]
    ignored = False
    for line in ignore.split():
        keeps, pattern = line.startswith("!"), as_regex(line.lstrip("!"))
        if any(pattern.fullmatch(name) for name in (path, *above)):
            ignored = not keeps
    return not ignored


def copied() -> list[str]:
    """Return the sources of every COPY from the checkout."""
    lines = (ROOT / "Dockerfile").read_text().replace("\\\n", " ").splitlines()
    words = [shlex.split(line)[1:] for line in lines if re.match("COPY (?!--from)", line)]
    return [source for line in words for source in line[:-1] if not source.startswith("--")]


MANUAL = ROOT / "service" / "web" / "manual"
DOCKERFILE = (ROOT / "Dockerfile").read_text()
IGNORE = (ROOT / ".dockerignore").read_text()


@pytest.mark.parametrize("source", copied())
def test_what_the_dockerfile_copies_is_let_into_the_build(source):
    assert (ROOT / source).exists()
    assert let_through(source, IGNORE), f".dockerignore leaves out {source}"


def test_every_file_of_the_packages_is_copied():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    packages = project["tool"]["setuptools"]["packages"]["find"]["include"]
    files = [
        path.relative_to(ROOT).as_posix()
        for package in packages
        for path in (ROOT / package.rstrip("*")).rglob("*")
        if path.is_file()
        and "__pycache__" not in path.parts
        and MANUAL not in path.parents  # built anew there
    ]
    assert len(files) > 150
    assert [name for name in files if not let_through(name, IGNORE)] == []
    assert {name.split("/")[0] for name in files} <= set(copied())


def test_what_pip_reads_besides_is_copied():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert {"pyproject.toml", project["readme"], *project["license-files"]} <= set(copied())
    assert {"deploy/requirements.lock", "deploy/build.lock", "MANIFEST.in"} <= set(copied())


def test_what_pip_fetches_is_what_was_tested_byte_for_byte():
    text = DOCKERFILE.replace("\\\n", " ")
    assert re.search(r"^ARG BASE=\S+@sha256:[0-9a-f]{64}$", text, re.MULTILINE)
    fetching = [
        line for line in re.findall(r"pip install[^&\n]*", text) if "--no-index" not in line
    ]
    assert len(fetching) == 2
    assert all("--require-hashes" in line for line in fetching)


def test_the_image_is_nobody_s_root_and_asks_whether_the_service_goes_on():
    assert re.findall(r"^USER (\S+)$", DOCKERFILE, re.MULTILINE) == ["10001:10001"]
    assert "/healthz" in DOCKERFILE.partition("HEALTHCHECK")[2]


@pytest.mark.parametrize("module", [module for module, _ in OTHER_PROGRAMS.values()])
def test_every_program_that_pyrcal_can_become_is_in_the_image(module):
    assert module.split(".")[0] in copied()


def of_the_image():
    text = (ROOT / "Dockerfile").read_text().replace("\\\n", " ")
    line = next(line for line in text.splitlines() if line.startswith("ENV "))
    return dict(word.split("=", 1) for word in shlex.split(line)[1:])


def test_the_image_lets_nobody_onto_the_link_without_a_certificate():
    zenoh = load_settings(None, of_the_image()).zenoh
    assert zenoh.listen == ("tls/0.0.0.0:7447",)
    assert zenoh.tls.key == Path("/var/lib/pyrcal/tls/service-key.pem")
    assert not zenoh.anyone_may_command_the_mirror


def test_the_manual_publishes_the_link_on_named_addresses_alone():
    """``-p 7447:7447`` is every address, and past many a firewall."""
    pages = [ROOT / "README.md", *(ROOT / "docs").rglob("*.md")]
    found = [port for page in pages for port in re.findall(r"(\S*):7447:7447", page.read_text())]
    assert "127.0.0.1" in found
    assert not [port for port in found if not re.search(r"[0-9.]+$", port)]
    assert not [page for page in pages if re.search(r"-p[ =]7447", page.read_text())]


@pytest.mark.parametrize("path", [".git/config", "var/index.sqlite", "service/__pycache__/a.pyc"])
def test_nothing_else_is_sent_to_the_build(path):
    assert not let_through(path, IGNORE)

"""What every command understands. Nothing here takes long to import: help and errors come at once.

What the program calls methods, data sets and limits stands here as text; a test compares it.
"""

from __future__ import annotations

import argparse
import math
import os
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NoReturn

from typing_extensions import override

from service import __version__
from service.commands.remote import declare
from service.errors import ConfigurationError
from service.files import kind_of
from service.files.request import parse_alpha, parse_arms, parse_modes

OTHER_PROGRAMS = {
    "demo": ("studies.demo", "the main job, end to end, on a simulated telescope"),
    "sim": ("sim_rtc", "the simulated RTC"),
    "campaign": ("studies.campaign", "many simulated nights"),
}
"""Module and purpose of what is run in this program's place, with options of its own."""


def command_line() -> argparse.ArgumentParser:
    """Return what reads ``pyrcal``'s command line; ``command`` names the command that is meant."""
    parser = OneLineParser(
        prog="pyrcal", description="Calibration service of an adaptive telescope."
    )
    parser.add_argument("--version", action="version", version=f"pyrcal {__version__}")
    parser.add_argument(
        "--completion",
        action=_Completion,
        choices=("bash", "zsh", "fish", "tcsh"),
        help="print what teaches a shell these words: source <(pyrcal --completion bash)",
    )
    commands = parser.add_subparsers(dest="command", required=True)
    _describe_run(commands.add_parser("run", help="the service"))
    declare(commands)
    _describe_key(commands.add_parser("key", help="who may ask: make, list, revoke API keys"))
    _describe_archive(commands.add_parser("archive", help="what is kept, and is it sound?"))
    _describe_check(commands.add_parser("check-rtc", help="does an RTC keep the contract?"))
    _describe_fit(commands.add_parser("fit", help="the registration in a measured matrix"))
    _describe_reconstruct(
        commands.add_parser("reconstruct", help="a reconstructor for a known registration")
    )
    for name, (_, purpose) in OTHER_PROGRAMS.items():
        commands.add_parser(name, help=f"{purpose}: pyrcal {name} --help", add_help=False)
    return parser


def _describe_run(run: argparse.ArgumentParser) -> None:
    run.description = (
        "Run the service. Precedence: command line > environment (PYRCAL_<SECTION>__<KEY>) > "
        "TOML file > defaults."
    )
    run.add_argument("--config", type=Path, metavar="FILE", help="settings, TOML")
    run.add_argument("--instrument", metavar="NAME|FILE", help="packaged name or TOML file")
    run.add_argument("--mode", choices=["auto", "propose", "hold"], help="default: propose")
    run.add_argument("--data-dir", metavar="DIR", help="products, index, audit trail; default var")
    run.add_argument("--listen", metavar="ENDPOINT", help="zenoh, default tcp/127.0.0.1:7447")
    run.add_argument("--connect", metavar="ENDPOINT", help="an observatory's own zenoh router")
    run.add_argument("--host", help="of the REST API, default 127.0.0.1")
    run.add_argument("--port", type=int, help="of the REST API, default 8080")
    run.add_argument(
        "--log-format",
        choices=["auto", "text", "json"],
        help="default: text on a terminal, else a JSON object a line",
    )


def _of_a_folder() -> argparse.ArgumentParser:
    """Return what commands that work in a service's folder have in common."""
    where = argparse.ArgumentParser(add_help=False)
    where.add_argument("--config", type=Path, metavar="FILE", help="the service's settings, TOML")
    where.add_argument("--data-dir", metavar="DIR", help="the service's data_dir, default var")
    return where


def _describe_key(key: argparse.ArgumentParser) -> None:
    key.description = (
        "Make, list and revoke the keys of those who may ask a service, in its data_dir. A running "
        "service goes by them at once. docs/operating.md says how a key is shown."
    )
    key.epilog = "Exit status: 0 done, 2 it cannot be done."
    where = _of_a_folder()
    actions = key.add_subparsers(dest="action", required=True)
    add = actions.add_parser("add", parents=[where], help="make a key, and show it this once")
    revoke = actions.add_parser("revoke", parents=[where], help="make one worthless")
    actions.add_parser("list", parents=[where], help="who has a key, and for what")
    for action in (add, revoke):
        action.add_argument("name", metavar="NAME", help="of the person, program or place")
    add.add_argument(
        "--scope",
        choices=("read", "operate", "admin"),
        required=True,
        help="read: look; operate: give orders, too; admin: also see who has a key, and revoke one",
    )


def _describe_archive(archive: argparse.ArgumentParser) -> None:
    archive.description = (
        "Look through the matrices in a service's data_dir, check them, remove what is old. Reads "
        "beside a running service; prune refuses, for the service does it by itself."
    )
    archive.epilog = "Exit status: 0 done, 1 something is damaged, 2 it cannot be done."
    where = _of_a_folder()
    where.add_argument("--json", action="store_true", help="print JSON")
    actions = archive.add_subparsers(dest="action", required=True)
    actions.add_parser("list", parents=[where], help="all, oldest first, and why one stays")
    show = actions.add_parser("show", parents=[where], help="what is known of one")
    show.add_argument("id", metavar="ID")
    actions.add_parser("verify", parents=[where], help="read all of them and compare checksums")
    aot = actions.add_parser("aot", parents=[where], help="α and telemetry as an AOT FITS file")
    aot.add_argument("output", type=Path, metavar="FILE.fits")
    aot.add_argument("--instrument", metavar="NAME|FILE", help="default: that of the settings")
    aot.add_argument("--recording", type=Path, metavar="FILE", help="of pyrcal sim --record")
    aot.add_argument("--skip", type=_seconds, default=0.0, metavar="S", help="of the recording")
    aot.add_argument(
        "--seconds", type=_seconds, default=10.0, metavar="S", help="of it, default %(default)g"
    )
    aot.add_argument("--night", metavar="DATE", help="of the evening, UTC; else of the recording")
    prune = actions.add_parser("prune", parents=[where], help="remove what [archive] lets go")
    prune.add_argument("--dry-run", action="store_true", help="only say what would go")


_CHECK_EPILOG = """
One line for each thing that docs/rtc.md asks: what was found, what the contract says, where it
stands. WRONG breaks the contract, seen is allowed and worth a look, skipped says why. What moves
anything says so first and asks; where nobody can be asked it is skipped unless --yes. Exit status:
0 nothing is wrong, 1 something is, 2 nothing could be checked.
"""


def _describe_check(check: argparse.ArgumentParser) -> None:
    check.description = (
        "Listen to an RTC in the service's place, ask it things, and say whether it keeps the "
        "contract of docs/rtc.md. End the service first, or --connect to its router with --passive."
    )
    check.epilog = _CHECK_EPILOG
    check.add_argument(
        "--instrument", default="flao-lbt", metavar="NAME|FILE", help="default %(default)s"
    )
    check.add_argument(
        "--system", metavar="NAME", help="of the keys, default the instrument's name"
    )
    where = check.add_mutually_exclusive_group()
    where.add_argument("--listen", metavar="ENDPOINT", help="default tcp/127.0.0.1:7447")
    where.add_argument("--connect", metavar="ENDPOINT", help="a router that is there already")
    check.add_argument(
        "--seconds", type=_seconds, default=8.0, metavar="S", help="to listen, default %(default)g"
    )
    check.add_argument(
        "--wait", type=_seconds, default=30.0, metavar="S", help="for the RTC, default %(default)g"
    )
    check.add_argument(
        "--only", type=_names, default=(), metavar="CHECK,...", help="these checks and no others"
    )
    check.add_argument("--passive", action="store_true", help="only listen: ask and move nothing")
    check.add_argument(
        "--open-loop", action="store_true", help="also what opens the loop: loop, measure"
    )
    check.add_argument("--yes", action="store_true", help="move what is said without asking")
    check.add_argument("--json", action="store_true", help="print one JSON object at the end")


_FIT = """
Find where the mirror lies on the sensor from a measured interaction matrix: shift, rotation and
magnification with 1 sigma, the gain of every mode, what is left over, and whether to believe it.
"""

_FIT_EPILOG = """
REFERENCE holds (n_slopes, n_modes), slope per metre of OPD, in the RTC's own order and axes, as
the array 'interaction_matrix' or the one that --dataset names. What is printed on standard output
is the answer; progress goes to standard error. Exit status: 0 accepted, 1 fitted but refused (the
verdict says why), 2 input that cannot be used. docs/fitting.md explains format, orientation and
verdicts.
"""

_RECONSTRUCT = """
Compute the noise-free interaction matrix for a registration, invert it, and write both with
everything they were made of. As many modes as the basis has may be controlled, however few were
measured.
"""


def _describe_fit(fit: argparse.ArgumentParser) -> None:
    fit.description, fit.epilog = _FIT, _FIT_EPILOG
    fit.add_argument("instrument", metavar="INSTRUMENT", help="TOML file, or a packaged name")
    fit.add_argument("reference", metavar="REFERENCE", type=Path, help="HDF5, FITS or NumPy file")
    fit.add_argument("--dataset", metavar="NAME", help="of the matrix, default interaction_matrix")
    fit.add_argument(
        "--method",
        choices=("joint", "paper", "sensitivity"),
        default="joint",
        help="joint: all four together (default); paper: one at a time, with parabolas; "
        "sensitivity: projection on sensitivity matrices",
    )
    fit.add_argument(
        "--modes",
        type=_read_by(parse_modes),
        metavar="FIRST:END",
        help="basis indices to use, like 0:400 (400 is not) or 3,5,9; default all",
    )
    fit.add_argument(
        "--start",
        type=_read_by(parse_alpha),
        metavar="X,Y,ROT,MAG",
        help="where to begin: subapertures, degrees, ratio",
    )
    fit.add_argument(
        "--flux-map",
        type=Path,
        metavar="FILE",
        help="mean counts of the four pupil images, array flux (4, n, n): the model is lit as it "
        "says",
    )
    turned = fit.add_mutually_exclusive_group()
    turned.add_argument(
        "--flux-reference",
        type=Path,
        metavar="FILE",
        help="a flux map of another day: by how much the light is turned since is told",
    )
    turned.add_argument(
        "--arms",
        type=_read_by(parse_arms),
        metavar="WIDTH:DEG,DEG...",
        help="the spider's arms at rotation 0: the rotation is told that their shadows in the "
        "flux map have",
    )
    fit.add_argument("--gain-map", action="store_true", help="fit a gain over the pupil, too")
    fit.add_argument("--anamorphosis", action="store_true", help="fit a stretched image, too")
    fit.add_argument("--json", action="store_true", help="print one JSON object, not a table")
    fit.add_argument("--plot", type=Path, metavar="FILE.png", help="write the paper's figures")
    fit.add_argument("--output", type=Path, metavar="FILE.h5", help="write all that was found")
    fit.add_argument(
        "--threads",
        type=_count,
        default=os.cpu_count() or 1,
        metavar="N",
        help="default: one for every core",
    )


def _describe_reconstruct(make: argparse.ArgumentParser) -> None:
    make.description = _RECONSTRUCT
    make.epilog = "Exit status: 0 written, 2 input that cannot be used."
    make.add_argument("instrument", metavar="INSTRUMENT", help="TOML file, or a packaged name")
    make.add_argument(
        "alpha",
        metavar="ALPHA",
        help="X,Y,ROT,MAG (subapertures, degrees, ratio), or a file that pyrcal fit wrote with "
        "--json or --output",
    )
    make.add_argument(
        "--modes",
        type=_count,
        required=True,
        metavar="N",
        help="the first N modes",
    )
    make.add_argument("--output", type=Path, required=True, metavar="FILE.h5")
    make.add_argument(
        "--method",
        choices=("svd", "map"),
        default="svd",
        help="svd: least squares, weak singular values left out (default); map: with noise and "
        "turbulence as priors",
    )
    make.add_argument(
        "--max-condition", type=float, default=100.0, help="of svd, default %(default)g"
    )
    make.add_argument(
        "--slope-noise",
        type=float,
        default=0.05,
        metavar="RMS",
        help="of map: 1 sigma of one slope in one frame, default %(default)g",
    )
    make.add_argument(
        "--no-gains",
        action="store_true",
        help="leave the columns as the model has them; by default they take the gains of the fit",
    )
    make.add_argument(
        "--flux-map", type=Path, metavar="FILE", help="as of pyrcal fit: the model is lit like it"
    )
    make.add_argument(
        "--reference", type=Path, metavar="FILE", help="the measured matrix, for its checksum"
    )


def _count(text: str) -> int:
    if not text.isdecimal() or int(text) == 0:
        raise argparse.ArgumentTypeError(f"found {text!r}, expected a whole number above 0")
    return int(text)


def _seconds(text: str) -> float:
    try:
        seconds = float(text)
    except ValueError:
        seconds = math.nan
    if not 0.0 < seconds <= 3600.0:
        raise argparse.ArgumentTypeError(f"found {text!r}, expected seconds above 0 and up to 3600")
    return seconds


def _names(text: str) -> tuple[str, ...]:
    return tuple(name.strip() for name in text.split(",") if name.strip())


def _read_by(parse: Callable[[str], object]) -> Callable[[str], object]:
    """Return a function that reads a text; what it refuses argparse prints as it is."""

    def read(text: str) -> object:
        try:
            return parse(text)
        except ValueError as error:
            raise argparse.ArgumentTypeError(str(error)) from error

    return read


def check_files(options: argparse.Namespace) -> None:
    """Refuse files that cannot be what they are given as, before anything large is imported.

    Raises
    ------
    PyrcalError
        One line that names the file.
    """
    if options.command in {"fit", "reconstruct"}:
        from service.config.instrument_schema import read_instrument_file

        read_instrument_file(options.instrument)
    for path in _paths(options, "output", "plot"):
        if not path.absolute().parent.is_dir():
            raise ConfigurationError(f"{path}: found no folder {path.parent}, expected it to exist")
    measured = ("reference",) if options.command == "fit" else ()
    for path in _paths(options, "flux_map", "flux_reference", *measured):
        kind_of(path)
    if options.command == "reconstruct" and not Path(options.alpha).is_file():
        try:
            parse_alpha(options.alpha)
        except ValueError as error:
            raise ConfigurationError(f"ALPHA: no such file, and {error}") from error


def _paths(options: argparse.Namespace, *names: str) -> list[Path]:
    """Return the files of these names that were given."""
    found = [getattr(options, name, None) for name in names]
    return [path for path in found if path is not None]


# --- words and the terminal


class OneLineParser(argparse.ArgumentParser):
    """Says what is wrong in one line, without the usage that would push it off the screen."""

    @override
    def error(self, message: str) -> NoReturn:
        """End the program with status 2."""
        self.exit(2, f"{self.prog}: {message}; {self.prog} --help\n")


class _Completion(argparse.Action):
    """Prints the completion of this command line, and ends the program."""

    @override
    def __call__(
        self, parser: argparse.ArgumentParser, _options: object, shell: object, *_: object
    ) -> NoReturn:
        import shtab

        print(shtab.complete(parser, str(shell)))
        parser.exit()


_NEGATIVE = re.compile(r"-[\d.][-+\d.eE]*,.*")


def with_negative_numbers(given: Sequence[str]) -> list[str]:
    """Return command-line words such that argparse takes ``-0.3,0.1,65,1`` for a value.

    It takes it for an option; a word with a blank in it, never.
    """
    return [f" {word}" if _NEGATIVE.fullmatch(word) else word for word in given]

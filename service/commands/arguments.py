"""What every command understands. Nothing here takes long to import: help and errors come at once.

What the program calls methods, data sets and limits stands here as text; a test compares it.
"""

from __future__ import annotations

import argparse
import os
import re
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import NoReturn, TypeVar

from typing_extensions import override

from service import __version__
from service.commands.remote import add, declare, words
from service.errors import ConfigurationError
from service.files import kind_of, parse_alpha, parse_arms, parse_modes

_Read = TypeVar("_Read")

_ENDPOINT = re.compile(r"[\w-]+/\S+")
"""Of zenoh: a protocol and an address."""

OTHER_PROGRAMS = {
    "demo": ("studies.demo", "the main job, end to end, on a simulated telescope"),
    "sim": ("sim_rtc", "the simulated RTC"),
    "check-rtc": ("check_rtc", "whether an RTC keeps the contract"),
    "cacao": ("cacao_bridge", "the bridge to a loop of cacao's"),
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
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    _describe_run(commands.add_parser("run", help="the service"))
    declare(commands)
    _describe_key(commands.add_parser("key", help="who may ask: make, list, revoke API keys"))
    _describe_archive(commands.add_parser("archive", help="what is kept, and is it sound?"))
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
    formats = "default: text on a terminal, else a JSON object a line"
    add(
        run,
        words("--config FILE", "settings, TOML", type=Path),
        words("--instrument NAME|FILE", "packaged name or TOML file"),
        words("--mode", "default: propose", choices=["auto", "propose", "hold"]),
        words("--data-dir DIR", "products, index, audit trail; default var"),
        words("--listen ENDPOINT", "zenoh, default tcp/127.0.0.1:7447", type=endpoint),
        words("--connect ENDPOINT", "an observatory's own zenoh router", type=endpoint),
        words("--host HOST", "of the REST API, default 127.0.0.1"),
        words("--port PORT", "of the REST API, default 8080", type=port),
        words("--log-format", formats, choices=["auto", "text", "json"]),
    )


_OF_A_FOLDER = (
    words("--config FILE", "the service's settings, TOML", type=Path),
    words("--data-dir DIR", "the service's data_dir, default var"),
)
"""What commands that work in a service's folder have in common."""

_OF_ITS_KEYS = (
    _OF_A_FOLDER[0],
    words("--data-dir DIR", "the service's data_dir, default that of the one that runs, else var"),
)


def _describe_key(key: argparse.ArgumentParser) -> None:
    key.description = (
        "Make, list and revoke the keys of those who may ask a service, in its data_dir. A running "
        "service goes by them at once. docs/operating.md says how a key is shown."
    )
    key.epilog = "Exit status: 0 done, 2 it cannot be done."
    name = words("name NAME", "of the person, program or place")
    scope = words(
        "--scope",
        "read: look; operate: give orders, too; admin: also see who has a key, and revoke one",
        choices=("read", "operate", "admin"),
        required=True,
    )
    actions = key.add_subparsers(dest="action", required=True)
    for action, purpose, more in (
        ("add", "make a key, and show it this once", (name, scope)),
        ("revoke", "make one worthless", (name,)),
        ("list", "who has a key, and for what", ()),
    ):
        add(actions.add_parser(action, help=purpose), *_OF_ITS_KEYS, *more)


def _describe_archive(archive: argparse.ArgumentParser) -> None:
    archive.description = (
        "Look through the matrices in a service's data_dir, check them, remove what is old. Reads "
        "beside a running service; prune refuses, for the service does it by itself."
    )
    archive.epilog = "Exit status: 0 done, 1 something is damaged, 2 it cannot be done."
    aot = (
        words("output FILE.fits", type=Path),
        words("--instrument NAME|FILE", "default: that of the settings"),
        words("--recording FILE", "of pyrcal sim --record", type=Path),
        words("--skip S", "of the recording", type=seconds, default=0.0),
        words("--seconds S", "of it, default %(default)g", type=seconds, default=10.0),
        words("--night DATE", "of the evening, UTC; else of the recording"),
    )
    actions = archive.add_subparsers(dest="action", required=True)
    for action, purpose, more in (
        ("list", "all, oldest first, and why one stays", ()),
        ("show", "what is known of one", (words("id ID"),)),
        ("verify", "read all of them and compare checksums", ()),
        ("aot", "α and telemetry as an AOT FITS file", aot),
        ("prune", "remove what [archive] lets go", (words("--dry-run", "only say what would go"),)),
    ):
        parser = actions.add_parser(action, help=purpose)
        add(parser, *_OF_A_FOLDER, words("--json", "print JSON"), *more)


_FIT = """
Find where the mirror lies on the sensor from a measured interaction matrix: shift, rotation and
magnification with 1 sigma, the gain of every mode, what is left over, and whether to believe it.
"""

_FIT_EPILOG = """
REFERENCE holds (n_slopes, n_modes), slope per metre of OPD, in the RTC's own order and axes, as
the array 'interaction_matrix' or the one that --dataset names. What is printed on standard output
is the answer; progress goes to standard error. Exit status: 0 accepted, 1 fitted but refused (the
verdict says why), 2 input that cannot be used. OOPAO's metre is (n - 1)/n of ours for a pupil of n
points: its mirror comes out that much smaller. docs/fitting.md explains format, orientation and
verdicts.
"""

_RECONSTRUCT = """
Compute the noise-free interaction matrix for a registration, invert it, and write both with
everything they were made of. As many modes as the basis has may be controlled, however few were
measured.
"""

_INSTRUMENT = words("instrument INSTRUMENT", "TOML file, or a packaged name")


def _describe_fit(fit: argparse.ArgumentParser) -> None:
    fit.description, fit.epilog = _FIT, _FIT_EPILOG
    methods = (
        "joint: all four together (default); paper: one at a time, with parabolas; "
        "sensitivity: projection on sensitivity matrices"
    )
    modes = "basis indices to use, like 0:400 (400 is not) or 3,5,9; default all"
    start = "where to begin: subapertures, degrees, ratio"
    flux = "mean counts of the four pupil images, array flux (4, n, n): the model is lit as it says"
    reference = "a flux map of another day: by how much the light is turned since is told"
    arms = (
        "the spider's arms at rotation 0: the rotation is told that their shadows in the "
        "flux map have"
    )
    add(
        fit,
        _INSTRUMENT,
        words("reference REFERENCE", "HDF5, FITS or NumPy file", type=Path),
        words("--dataset NAME", "of the matrix, default interaction_matrix"),
        words("--method", methods, choices=("joint", "paper", "sensitivity"), default="joint"),
        words("--modes FIRST:END", modes, type=_read_by(parse_modes)),
        words("--start X,Y,ROT,MAG", start, type=_read_by(parse_alpha)),
        words("--flux-map FILE", flux, type=Path),
    )
    add(
        fit.add_mutually_exclusive_group(),
        words("--flux-reference FILE", reference, type=Path),
        words("--arms WIDTH:DEG,DEG...", arms, type=_read_by(parse_arms)),
    )
    cores = os.cpu_count() or 1
    add(
        fit,
        words("--gain-map", "fit a gain over the pupil, too"),
        words("--anamorphosis", "fit a stretched image, too"),
        words("--json", "print one JSON object, not a table"),
        words("--plot FILE.png", "write the paper's figures", type=Path),
        words("--output FILE.h5", "write all that was found", type=Path),
        words("--threads N", "default: one for every core", type=_count, default=cores),
    )


def _describe_reconstruct(make: argparse.ArgumentParser) -> None:
    make.description = _RECONSTRUCT
    make.epilog = "Exit status: 0 written, 2 input that cannot be used."
    alpha = (
        "X,Y,ROT,MAG (subapertures, degrees, ratio), or a file that pyrcal fit wrote with "
        "--json or --output"
    )
    methods = (
        "svd: least squares, weak singular values left out (default); map: with noise and "
        "turbulence as priors"
    )
    noise = "of map: 1 sigma of one slope in one frame, default %(default)g"
    gains = "leave the columns as the model has them; by default they take the gains of the fit"
    condition = words(
        "--max-condition MAX_CONDITION", "of svd, default %(default)g", type=float, default=100.0
    )
    add(
        make,
        _INSTRUMENT,
        words("alpha ALPHA", alpha),
        words("--modes N", "the first N modes", type=_count, required=True),
        words("--output FILE.h5", type=Path, required=True),
        words("--method", methods, choices=("svd", "map"), default="svd"),
        condition,
        words("--slope-noise RMS", noise, type=float, default=0.05),
        words("--no-gains", gains),
        words("--flux-map FILE", "as of pyrcal fit: the model is lit like it", type=Path),
        words("--reference FILE", "the measured matrix, for its checksum", type=Path),
    )


def _such(
    read: Callable[[str], _Read], holds: Callable[[_Read], object], expected: str
) -> Callable[[str], _Read]:
    """Return a function that reads a text and refuses what is no number, or not as expected."""

    def reading(text: str) -> _Read:
        with suppress(ValueError):
            if holds(found := read(text)):
                return found
        raise argparse.ArgumentTypeError(f"found {text!r}, expected {expected}")

    return reading


def _whole(text: str) -> int:
    return int(text) if text.isdecimal() else -1


_count = _such(_whole, lambda n: n > 0, "a whole number above 0")
port = _such(_whole, lambda n: 0 <= n <= 65535, "a port, 0 to 65535")
seconds = _such(float, lambda s: 0.0 < s <= 3600.0, "seconds above 0 and up to 3600")
endpoint = _such(str, _ENDPOINT.fullmatch, "an endpoint like tcp/127.0.0.1:7447")


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
    _check_settings(options)
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


def _check_settings(options: argparse.Namespace) -> None:
    """Refuse an instrument that nobody has, and settings that are not there."""
    if getattr(options, "instrument", None) is not None:
        from service.config import instrument_path

        instrument_path(options.instrument)  # a wrong name is told without the schema
    for path in _paths(options, "config"):
        if not path.exists():
            raise ConfigurationError(f"{path}: cannot be read: no such file")


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

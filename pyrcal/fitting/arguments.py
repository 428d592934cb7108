"""Arguments of the offline commands; quick to import.

Names of methods and data sets are repeated here as text, so that the modules need not be imported;
a test compares them.
"""

from __future__ import annotations

import argparse
import math
import os
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pyrcal.options import add, words
from service.errors import ConfigurationError
from service.files import kind_of, numbers_in, parse_alpha, parse_modes
from service.model.kinds import ArrayLibrary
from service.model.sensors.registry import KINDS
from service.program import check_settings, port, such, whole

if TYPE_CHECKING:
    from pyrcal.fitting.light_rotation import Arms

_memory_gb = such(float, lambda gb: gb > 0.0, "GB above 0")
_MEMORY = "refuse what takes more, before it is begun; default %(default)g"

_ARRAY = "what computes rows of D; torch and cupy use a GPU, default %(default)s"

_count = such(whole, lambda n: n > 0, "a whole number above 0")
seconds = such(float, lambda s: 0.0 < s <= 3600.0, "seconds above 0 and up to 3600")


def declare(commands: Any) -> None:  # noqa: ANN401 - argparse's own
    """Add these commands to a command line."""
    _describe_archive(
        commands.add_parser("archive", help="list, verify, prune or export what is archived")
    )
    _describe_bundle(commands.add_parser("bundle", help="write or check a calibration as one file"))
    _describe_certificates(
        commands.add_parser("certificates", help="make certificates for the link to the RTC")
    )
    _describe_fit(commands.add_parser("fit", help="fit the registration to a measured matrix"))
    _describe_fit_system(
        commands.add_parser("fit-system", help="fit several sensors and mirrors together")
    )
    _describe_reconstruct(
        commands.add_parser("reconstruct", help="compute a reconstructor for a registration")
    )
    _describe_conventions(
        commands.add_parser("conventions", help="hold a measured matrix against the conventions")
    )
    _describe_instrument(
        commands.add_parser("instrument", help="write, check or draw an instrument file")
    )
    _describe_import(
        commands.add_parser("import", help="make an instrument file and a matrix of another code's")
    )


_OF_A_FOLDER = (
    words("--config FILE", "the service's settings, TOML", type=Path),
    words("--data-dir DIR", "the service's data_dir, default var"),
)
"""Options of commands that work in a service's folder."""


def _describe_archive(archive: argparse.ArgumentParser) -> None:
    archive.set_defaults(module="pyrcal.maintenance.archive")
    archive.description = (
        "List, check, export and prune the matrices in a service's data_dir. They work while "
        "the service runs, except prune, which the service does by itself."
    )
    archive.epilog = "Exit status: 0 done, 1 something is damaged, 2 it cannot be done."
    aot = (
        words("output FILE.fits", type=Path),
        words("--instrument NAME|FILE", "default: that of the settings"),
        words("--recording FILE", "a file of pyrcal sim --record", type=Path),
        words("--skip S", "seconds of the recording to skip", type=seconds, default=0.0),
        words("--seconds S", "seconds to take, default %(default)g", type=seconds, default=10.0),
        words("--night DATE", "date of the evening, UTC; default that of the recording"),
    )
    actions = archive.add_subparsers(dest="action", required=True)
    for action, purpose, more in (
        ("list", "list all, oldest first, and why one stays", ()),
        ("show", "show one", (words("id ID"),)),
        ("verify", "read all and compare checksums", ()),
        ("aot", "write α and telemetry as AOT FITS", aot),
        ("prune", "remove what [archive] lets go", (words("--dry-run", "only say what would go"),)),
    ):
        parser = actions.add_parser(action, help=purpose)
        add(parser, *_OF_A_FOLDER, words("--json", "print JSON"), *more)


def _describe_bundle(bundle: argparse.ArgumentParser) -> None:
    bundle.set_defaults(module="pyrcal.maintenance.bundles")
    bundle.description = (
        "Write a reconstructor with its gains, basis, registration, verdict and provenance into "
        "one file with checksums, or check such a file. Works while the service runs; for one on "
        "another machine, 'pyrcal export reconstructor in-use --format hdf5' brings the source. "
        "docs/integrate/bundle.md says what is in it."
    )
    bundle.epilog = (
        "Exit status: 0 done, 2 it cannot be done, or the file is not as it was written."
    )
    actions = bundle.add_subparsers(dest="action", required=True)
    add(
        actions.add_parser("write", help="write one"),
        *_OF_A_FOLDER,
        words("source ID|in-use|FILE.h5", "a reconstructor of the archive, or an exported one"),
        words(
            "output FILE", "FITS where it ends in .fits, else HDF5; never overwritten", type=Path
        ),
        words("--instrument NAME|FILE", "default: that of the settings"),
        words("--interaction-matrix", "with D at its registration"),
        words("--reference FILE.npy", "with the RTC's reference slopes (n_slopes,)", type=Path),
    )
    add(
        actions.add_parser("check", help="read one, hold it against its checksums, show it"),
        words("bundle FILE", type=Path),
        words("--json", "print JSON"),
    )


def _describe_certificates(certificates: argparse.ArgumentParser) -> None:
    certificates.set_defaults(module="pyrcal.maintenance.certificates")
    certificates.description = (
        "Make an authority, a certificate for each role on the link (service, rtc, viewer), and "
        "the settings that use them. Again in the same folder: the authority that is there signs "
        "new ones. docs/operate/link.md says where each file belongs."
    )
    certificates.epilog = "Exit status: 0 done, 2 it cannot be done."
    actions = certificates.add_subparsers(dest="action", required=True)
    hosts = (
        "names or addresses under which the service is reached, with commas; default %(default)s"
    )
    for action, purpose, more in (
        (
            "new",
            "make them",
            (
                words("--host NAME,...", hosts, default="127.0.0.1"),
                words("--zenoh-port PORT", "default %(default)s", type=port, default=7447),
                words("--days N", "that they hold, default %(default)s", type=_count, default=365),
            ),
        ),
        ("show", "show whose they are and until when they hold", ()),
    ):
        add(actions.add_parser(action, help=purpose), words("folder FOLDER", type=Path), *more)


_FIT = """
Fit the registration of the mirror on the sensor to a measured interaction matrix: shift, rotation
and magnification with 1 sigma, the gain of every mode, the residual, and a verdict.
"""

_FIT_EPILOG = """
REFERENCE holds (n_slopes, n_modes), slope per metre of OPD, in the RTC's own order and axes, as
the array 'interaction_matrix' or the one that --dataset names. What is printed on standard output
is the answer; progress goes to standard error. Exit status: 0 accepted, 1 fitted but refused (the
verdict says why), 2 input that cannot be used. docs/integrate/fitting.md explains format,
orientation and verdicts.
"""

_RECONSTRUCT = """
Compute the noise-free interaction matrix for a registration, invert it, and write both with
everything they were made of. As many modes as the basis has may be controlled, however few were
measured.
"""

_INSTRUMENT = words("instrument INSTRUMENT", "TOML file, or a packaged name")

_OF_AN_ANSWER = (
    words("--json", "print one JSON object, not a table"),
    words("--plot FILE.png", "write the figures", type=Path),
    words("--output FILE.h5", "write everything found", type=Path),
    words("--threads N", "default: one for every core", type=_count, default=os.cpu_count() or 1),
)
"""Options of commands that fit a registration."""


def _describe_fit(fit: argparse.ArgumentParser) -> None:
    fit.set_defaults(module="pyrcal.fitting.fit")
    fit.description, fit.epilog = _FIT, _FIT_EPILOG
    methods = (
        "joint: all four together (default); paper: the ten scans of "
        "Heritier et al. 2018, Table 1, without free gains; "
        "sensitivity: projection on sensitivity matrices"
    )
    modes = "basis indices to use, like 0:400 (400 is not) or 3,5,9; default all"
    start = "start of the fit: subapertures, degrees, ratio"
    flux = "mean counts of a pyramid's four images, array flux (4, n, n), to light the model"
    reference = "a flux map of another day: report how far the light has turned since"
    arms = "the spider's arms at rotation 0: report the rotation of their shadows in the flux map"
    add(
        fit,
        _INSTRUMENT,
        words("reference REFERENCE", "HDF5, FITS or NumPy file", type=Path),
        words("--dataset NAME", "dataset of the matrix, default interaction_matrix"),
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
    add(
        fit,
        words("--gain-map", "also fit a smooth gain over the pupil"),
        words(
            "--gain G",
            "integrator gain of the loop that the reconstructor is checked in",
            type=float,
            default=0.5,
        ),
        words("--no-anamorphosis", "take the image for as stretched as the instrument file says"),
        words("--anamorphosis", "as without it: the stretch is always fitted"),
        words("--memory-gb GB", _MEMORY, type=_memory_gb, default=6.0),
        *_OF_AN_ANSWER,
    )


_FIT_SYSTEM = """
Find the position of each sensor, mirror and star of a system from the measured interaction matrix
of every sensor with every mirror: each pair is fitted as by pyrcal fit, and the positions follow by
weighted least squares. Directions that no pair can observe are listed.
"""

_FIT_SYSTEM_EPILOG = """
Exit status: 0 accepted, 1 fitted but refused (the verdict says why), 2 input that cannot be used.
docs/integrate/systems.md explains the file, the gauge and verdicts.
"""


def _describe_fit_system(fit: argparse.ArgumentParser) -> None:
    fit.set_defaults(module="pyrcal.fitting.fit_system")
    fit.description, fit.epilog = _FIT_SYSTEM, _FIT_SYSTEM_EPILOG
    reference = (
        "the matrices: a file for each pair, {sensor} and {mirror} in its name standing for "
        "theirs, or one HDF5 file of all"
    )
    dataset = "of each matrix; default {sensor}/{mirror}/interaction_matrix in one file of all"
    add(
        fit,
        words("system SYSTEM", "TOML file of sensors and mirrors", type=Path),
        words("reference REFERENCE", reference, type=Path),
        words("--dataset NAME", dataset),
        *_OF_AN_ANSWER,
    )


def _describe_reconstruct(make: argparse.ArgumentParser) -> None:
    make.set_defaults(module="pyrcal.fitting.reconstruct")
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
        words("--memory-gb GB", _MEMORY, type=_memory_gb, default=6.0),
        words("--array LIBRARY", _ARRAY, choices=tuple(ArrayLibrary), default="numpy"),
        words("--no-gains", gains),
        words("--flux-map FILE", "as of pyrcal fit, to light the model", type=Path),
        words("--reference FILE", "the measured matrix, for its checksum", type=Path),
        words(
            "--specula PUPDATA.fits",
            "write SPECULA's Intmat and Recmat, too: its PupData or SubapData gives the order",
            type=Path,
        ),
    )


def _describe_conventions(hold: argparse.ArgumentParser) -> None:
    hold.set_defaults(module="pyrcal.conventions")
    hold.description = (
        "Hold a measured matrix, and the modes of its instrument file, against the numbered rules "
        "of docs/understand/conventions.md; say which are broken, and by how much."
    )
    hold.epilog = "Exit status: 0 all are kept, 1 some are broken, 2 input that cannot be used."
    add(
        hold,
        _INSTRUMENT,
        words("reference REFERENCE", "HDF5, FITS or NumPy file", type=Path),
        words("--dataset NAME", "dataset of the matrix, default interaction_matrix"),
    )


def _describe_instrument(instrument: argparse.ArgumentParser) -> None:
    instrument.set_defaults(module="pyrcal.instruments.program")
    instrument.description = "Write a commented instrument file, check one, or draw it."
    instrument.epilog = (
        "Exit status: 0 done, 1 something is wrong with the instrument file, 2 a file cannot be "
        "written."
    )
    kind = words("--kind KIND", "kind of sensor", choices=tuple(KINDS), default="pyramid")
    memory = "compute the matrix if that takes no more, default %(default)g"
    actions = instrument.add_subparsers(dest="action", required=True)
    for action, purpose, more in (
        ("new", "write a file with every key", (words("file FILE.toml", type=Path), kind)),
        (
            "check",
            "say everything that is wrong with it, and what it implies",
            (_INSTRUMENT, words("--memory-gb GB", memory, type=float, default=4.0)),
        ),
        (
            "show",
            "draw pupil, subapertures, actuators",
            (_INSTRUMENT, words("picture PICTURE.png", type=Path)),
        ),
    ):
        add(actions.add_parser(action, help=purpose), *more)


def _describe_import(bring: argparse.ArgumentParser) -> None:
    bring.set_defaults(module="pyrcal.importers.program")
    bring.description = (
        "Write an instrument file and a measured matrix, as pyrcal fit takes them, from what other "
        "codes have saved. What is not known is said as unknown; docs/integrate explains each."
    )
    bring.epilog = "Exit status: 0 written, 2 input that cannot be used."
    folder = words("--output DIR", "folder of both files, made", type=Path, required=True)
    saved = words("file FILE.npz", "np.savez of what docs/integrate/oopao.md lists", type=Path)
    known = "files, known by what is in them"
    roles = "a file or folder with arrays of known names, or ROLE=FILE: matrix, valid, light, "
    roles += "modes, positions, mode_to_actuator"
    own = words("files FILE", known, type=_role_and_path, nargs="+")
    named = words("files [ROLE=]FILE", roles, type=_role_and_path, nargs="+")
    described = words(
        "--instrument NAME|FILE",
        "telescope, sensor and mirror as a packaged instrument or a file describes them",
    )
    basis = words(
        "--basis BASIS",
        "of positions alone: zonal, a column for each actuator, or KL, pyrcal's own modes",
        choices=("zonal", "KL"),
    )
    unit = words("--unit UNIT", "of the commands, OPD; default: unknown", choices=("m", "um", "nm"))
    sources = bring.add_subparsers(dest="source", required=True)
    for source, purpose, more in (
        ("oopao", "from objects that were saved", (saved,)),
        ("specula", "from Intmat, PupData or SubapData, IFunc, M2C", (own, *_REPORTED)),
        ("synim", "the same, of SynIM", (own, *_REPORTED)),
        (
            "cacao",
            "from an example folder, or the conf folder of a loop",
            (
                words("folder CONF", type=Path),
                words("--response NAME", "such as loRM; default: of single actuators if there is"),
                *_REPORTED,
            ),
        ),
        (
            "pyrtc",
            "from calibrations of pyRTC 2, or bare arrays",
            (named, unit, described, basis, *_REPORTED),
        ),
        (
            "aot",
            "from an AOT file",
            (
                words("file FILE.fits", type=Path),
                words("--loop N|UID", "of several loops: its number, from 1, or its uid"),
                words("--positions FILE", "of actuators, x and y in metres", type=Path),
                unit,
                *_REPORTED,
            ),
        ),
        ("files", "from NumPy, FITS or HDF5 files", (named, unit, described, basis, *_REPORTED)),
        ("npz", "the same as files", (named, unit, described, basis, *_REPORTED)),
    ):
        add(sources.add_parser(source, help=purpose), *more, folder)


def _read_by(parse: Callable[[str], object]) -> Callable[[str], object]:
    """Return a reader whose refusals argparse prints as they are."""

    def read(text: str) -> object:
        try:
            return parse(text)
        except ValueError as error:
            raise argparse.ArgumentTypeError(str(error)) from error

    return read


_REPORTED = (
    words("--diameter-m D", "of the pupil; needed without --instrument", type=float),
    words(
        "--modes FIRST:END",
        "basis index of each column, like 0:400 or 3,5,9; default the first ones",
        type=_read_by(parse_modes),
    ),
    words("--sensor KIND", "default: as the files say, else pyramid", choices=tuple(KINDS)),
    words(
        "--stop STOP",
        "what limits the beam, default %(default)s",
        choices=("telescope", "mirror"),
        default="telescope",
    ),
    words("--obscuration RATIO", "linear; default: read from the mask", type=float),
    words("--wavelength-m W", "default: unknown", type=float),
    words("--modulation RADIUS", "of a pyramid, λ/D; default: unknown", type=float),
    words("--pupil-subap N", "pupil's diameter, subapertures; default the mask's", type=float),
    words("--pixels-per-subap N", "of camera frames; default: by the actuators", type=_count),
)
"""Options for values that no file contains."""


def _role_and_path(text: str) -> tuple[str | None, Path]:
    """Return what a file is for, where that is said, and the file."""
    role, sign, path = text.partition("=")
    return (role, Path(path)) if sign else (None, Path(text))


def parse_arms(text: str) -> Arms:
    """Return the spider's arms ``WIDTH:DEG,DEG,...``: subapertures, degrees from +x towards +y.

    Raises
    ------
    ValueError
        If it is not a width above 0 and at least one finite angle.
    """
    first, _, rest = text.partition(":")
    width, angles = numbers_in(first), numbers_in(rest)
    if not angles or len(width) != 1 or width[0] <= 0.0:
        expected = "expected WIDTH:DEG,DEG,... of the spider's arms, like 0.9:90,210,330"
        raise ValueError(f"found {text.strip()!r}, {expected}")
    from pyrcal.fitting.light_rotation import Arms

    return Arms(angles_rad=tuple(math.radians(a) for a in angles), width_subap=width[0])


def check_files(options: argparse.Namespace) -> None:
    """Refuse files that cannot be what they are given as, before anything large is imported.

    Raises
    ------
    PyrcalError
        One line that names the file.
    """
    check_settings(options)
    if options.command in {"fit", "reconstruct"}:
        from service.instrument.schema import read_instrument_file

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

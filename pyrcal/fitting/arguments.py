"""Arguments of the commands that work on files; quick to import.

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

from service.errors import ConfigurationError
from service.files import kind_of, numbers_in, parse_alpha, parse_modes
from service.model.kinds import ArrayLibrary
from service.model.sensors.registry import KINDS
from service.parser import in_group, words
from service.program import check_settings, port, such, whole

if TYPE_CHECKING:
    from pyrcal.fitting.light_rotation import Arms

_memory_gb = such(float, lambda gb: gb > 0.0, "GB above 0")
_count = such(whole, lambda n: n > 0, "a whole number above 0")
seconds = such(float, lambda s: 0.0 < s <= 3600.0, "seconds above 0 and up to 3600")


ARCHIVE = "archive options"
"""Title of the options that say where a service keeps its files."""

DESCRIPTION = "description options"
"""Title of the options for values that no file contains."""

INSTRUMENT = "instrument file (TOML) or a packaged name"
"""Meaning of the operand that most of these commands have."""

_INSTRUMENT = words("instrument INSTRUMENT", INSTRUMENT)
_OF_SETTINGS = words("--instrument NAME|FILE", "default: that of the settings")
_JSON = words("--json", "print JSON")
_REFERENCE = words("reference REFERENCE", "HDF5, FITS, NumPy or MATLAB file", type=Path)
_DATASET = words("--dataset NAME", "dataset of the matrix, default interaction_matrix")
_MEMORY = words(
    "--memory-gb GB", "limit of memory, default %(default)g", type=_memory_gb, default=6.0
)

_THREADS = words(
    "--threads N", "default: one for each core", type=_count, default=os.cpu_count() or 1
)

_OF_A_FOLDER = in_group(
    ARCHIVE,
    words("--config FILE", "settings of the service, TOML", type=Path),
    words("--data-dir DIR", "data_dir of the service, default var"),
)
"""Options of commands that work in a service's folder."""

_OF_AN_ANSWER = (
    _JSON,
    words("--plot FILE.png", "write the figures", type=Path),
    words("--output FILE.h5", "write all results", type=Path),
    _THREADS,
)
"""Options of commands that fit a registration."""


def declare(commands: Any) -> None:  # noqa: ANN401 - argparse's own
    """Add these commands to a command line."""
    for describe in (
        _describe_archive,
        _describe_bundle,
        _describe_commission,
        _describe_certificates,
        _describe_fit,
        _describe_fit_system,
        _describe_reconstruct,
        _describe_conventions,
        _describe_instrument,
        _describe_import,
        _describe_twin,
    ):
        describe(commands)


def _describe_archive(commands: Any) -> None:  # noqa: ANN401 - argparse's own
    archive = commands.add_parser(
        "archive",
        help="list, verify, prune or export archived matrices",
        module="pyrcal.maintenance.archive",
        description="List, check, export and prune the matrices in the data_dir of a service. All "
        "work while the service runs, except prune, which the service does by itself.",
        epilog="Exit status: 0 done; 1 something is damaged; 2 it cannot be done.",
    )
    aot = (
        words("output FILE.fits", type=Path),
        _OF_SETTINGS,
        words("--recording FILE", "a file of pyrcal sim --record", type=Path),
        words("--skip S", "seconds of the recording to skip", type=seconds, default=0.0),
        words("--seconds S", "seconds to take, default %(default)g", type=seconds, default=10.0),
        words("--night DATE", "UTC date of the evening; default: that of the recording"),
    )
    dry_run = words("--dry-run", "only list what would be removed")
    every = (_JSON, *_OF_A_FOLDER)
    one = words("id ID", "its id, as in archive list")
    archive.add_commands(
        "action",
        ("list", "list all matrices, oldest first, and why some are kept", "", every),
        ("show", "show one matrix", "cm-3", (one, *every)),
        ("verify", "read all files and compare checksums", "--data-dir var", every),
        ("aot", "write registration and telemetry as AOT FITS", "night.fits", (*aot, *every)),
        ("prune", "remove what [archive] no longer keeps", "--dry-run", (dry_run, *every)),
    )


def _describe_bundle(commands: Any) -> None:  # noqa: ANN401 - argparse's own
    bundle = commands.add_parser(
        "bundle",
        help="write or check a calibration bundle (one file)",
        module="pyrcal.maintenance.bundles",
        description="Write a reconstructor with its gains, basis, registration, verdict and "
        "provenance into one file with checksums, or check such a file. docs/howto/bundle.md "
        "describes it.",
        epilog="Exit status: 0 done; 2 it cannot be done, or a checksum is wrong.",
    )
    reference = "include the reference slopes of the RTC (n_slopes,)"
    written = (
        words("source ID|in-use|FILE.h5", "a reconstructor of the archive, or an exported one"),
        words(
            "output FILE", "FITS if its name ends in .fits, else HDF5; never overwritten", type=Path
        ),
        _OF_SETTINGS,
        words("--interaction-matrix", "include the interaction matrix at its registration"),
        words("--reference FILE.npy", reference, type=Path),
        *_OF_A_FOLDER,
    )
    checked = (words("bundle FILE", type=Path), _JSON)
    bundle.add_commands(
        "action",
        ("write", "write a bundle", "in-use calibration.h5 --interaction-matrix", written),
        ("check", "read a bundle, compare its checksums, show it", "calibration.h5", checked),
    )


def _describe_commission(commands: Any) -> None:  # noqa: ANN401 - argparse's own
    output, usual = "--output FILE.html", Path("commissioning.html")
    commands.add_parser(
        "commission",
        help="judge a commissioning and write its report",
        module="pyrcal.maintenance.commission",
        description="Compare the archive of a night and the output of pyrcal check-rtc and pyrcal "
        "fit with the limits in docs/operate/commissioning.md, and write a report. Needs the extra "
        "'plots'.",
        epilog="Exit status: 0 all criteria pass; 1 a criterion fails or has no data; 2 the report "
        "cannot be made.",
        examples=["--check-rtc check.json --fit fit.json"],
        options=(
            _OF_SETTINGS,
            words("--check-rtc FILE.json", "output of pyrcal check-rtc --json", type=Path),
            words("--fit FILE.json", "output of pyrcal fit --json", type=Path),
            words(
                "--night DATE",
                "UTC date of the evening; default: the newest night with measurements",
            ),
            words("--since TIME", "from this time on, RFC 3339, like 2026-03-01T20:00:00Z"),
            words("--until TIME", "up to this time"),
            words(output, "default %(default)s", type=Path, default=usual),
            _JSON,
            *_OF_A_FOLDER,
        ),
    )


def _describe_certificates(commands: Any) -> None:  # noqa: ANN401 - argparse's own
    certificates = commands.add_parser(
        "certificates",
        help="make certificates for the link to the RTC",
        module="pyrcal.maintenance.certificates",
        description="Make an authority, a certificate for each role on the link (service, rtc, "
        "viewer), and settings that use them. An authority in the folder is used again. "
        "docs/operate/link.md says where each file belongs.",
        epilog="Exit status: 0 done; 2 it cannot be done.",
    )
    hosts = "names or addresses of the service; default %(default)s"
    folder = words("folder FOLDER", "folder of the certificates", type=Path)
    made = (
        folder,
        words("--host NAME,...", hosts, default="127.0.0.1"),
        words("--zenoh-port PORT", "of the link, default %(default)s", type=port, default=7447),
        words("--days N", "validity, days; default %(default)s", type=_count, default=365),
    )
    certificates.add_commands(
        "action",
        ("new", "make certificates", "certificates", made),
        ("show", "show the owner and the end of each certificate", "certificates", (folder,)),
    )


_FIT = """
Fit the registration of the mirror on the sensor to a measured interaction matrix: shift, rotation
and magnification with 1 sigma, the gain of every mode, the residual, and a verdict.
"""

_FIT_EPILOG = """
REFERENCE holds (n_slopes, n_modes), slope per metre of OPD, in the RTC's own order and axes, as
the array 'interaction_matrix' or the one that --dataset names. The result goes to standard output,
progress to standard error. Exit status: 0 accepted; 1 fitted but refused (the verdict says why); 2
input that cannot be used. docs/howto/fitting.md explains format, orientation and verdicts.
"""


def _describe_fit(commands: Any) -> None:  # noqa: ANN401 - argparse's own
    methods = (
        "joint: all parameters together (default); paper: the ten scans of Heritier et al. 2018, "
        "Table 1, without free gains; sensitivity: projection on sensitivity matrices"
    )
    modes = "basis indices to use, like 0:400 (end excluded) or 3,5,9; default all"
    start = "start of the fit: subapertures, degrees, ratio"
    flux = "counts of the four pupil images, array flux (4, n, n)"
    reference = "earlier flux map; reports the rotation of the illumination"
    arms = "spider arms; reports the rotation of their shadows"
    gain = "integrator gain for the stability check, default %(default)g"
    commands.add_parser(
        "fit",
        help="fit the registration to a measured matrix",
        module="pyrcal.fitting.fit",
        description=_FIT,
        epilog=_FIT_EPILOG,
        examples=(
            "flao-lbt matrix.h5 --output fit.h5",
            "bench.toml matrix.fits --modes 0:400 --plot fit.png",
        ),
        options=(
            _INSTRUMENT,
            _REFERENCE,
            _DATASET,
            words("--method", methods, choices=("joint", "paper", "sensitivity"), default="joint"),
            words("--modes FIRST:END", modes, type=_read_by(parse_modes)),
            words("--start X,Y,ROT,MAG", start, type=_read_by(parse_alpha)),
            words("--flux-map FILE", flux, type=Path),
            [
                words("--flux-reference FILE", reference, type=Path),
                words("--arms WIDTH:DEG,DEG...", arms, type=_read_by(parse_arms)),
            ],
            words("--gain-map", "also fit a smooth gain over the pupil"),
            words("--gain G", gain, type=float, default=0.5),
            words("--no-anamorphosis", "keep the anamorphosis of the instrument file"),
            words("--anamorphosis", argparse.SUPPRESS),
            _MEMORY,
            *_OF_AN_ANSWER,
        ),
    )


def _describe_fit_system(commands: Any) -> None:  # noqa: ANN401 - argparse's own
    reference = "one HDF5 file, or one for each pair, with {sensor} and {mirror} in its name"
    dataset = "dataset of each matrix; default {sensor}/{mirror}/interaction_matrix in one file"
    commands.add_parser(
        "fit-system",
        help="fit several sensors and mirrors together",
        module="pyrcal.fitting.fit_system",
        description="Estimate the position of each sensor, mirror and star of a system from the "
        "measured interaction matrix of each sensor with each mirror. Each pair is fitted as by "
        "pyrcal fit. Directions that no pair observes are listed.",
        epilog="Exit status: 0 accepted; 1 fitted but refused (the verdict says why); 2 input that "
        "cannot be used. docs/howto/systems.md explains the file, the gauge and verdicts.",
        examples=["system.toml matrices.h5 --json"],
        options=(
            words("system SYSTEM", "TOML file of sensors and mirrors", type=Path),
            words("reference REFERENCE", reference, type=Path),
            words("--dataset NAME", dataset),
            *_OF_AN_ANSWER,
        ),
    )


def _describe_reconstruct(commands: Any) -> None:  # noqa: ANN401 - argparse's own
    alpha = (
        "X,Y,ROT,MAG (subapertures, degrees, ratio), or a file that pyrcal fit wrote with "
        "--json or --output"
    )
    methods = (
        "svd: least squares without weak singular values (default); map: maximum a posteriori, "
        "with the noise of the slopes and the turbulence as prior"
    )
    condition = "with svd: largest condition number, default %(default)g"
    noise = "with map: 1 sigma of one slope in one frame, default %(default)g"
    array = "library for the matrix; torch and cupy use a GPU; default %(default)s"
    specula = "also write SPECULA's Intmat and Recmat, with the slopes in the order of this file"
    commands.add_parser(
        "reconstruct",
        help="compute a reconstructor for a registration",
        module="pyrcal.fitting.reconstruct",
        description="Compute the noise-free interaction matrix for a registration, and the "
        "reconstructor. The model also gives the columns of modes that were not measured, so all "
        "modes of the basis can be controlled.",
        epilog="Exit status: 0 written; 2 input that cannot be used.",
        examples=(
            "flao-lbt fit.h5 --modes 500 --output cm.h5",
            "flao-lbt 0.1,-0.05,0.2,1.002 --modes 400 --output cm.h5",
        ),
        options=(
            _INSTRUMENT,
            words("alpha ALPHA", alpha),
            words("--modes N", "control the first N modes", type=_count, required=True),
            words("--output FILE.h5", "file to write", type=Path, required=True),
            words("--method", methods, choices=("svd", "map"), default="svd"),
            words("--max-condition C", condition, type=float, default=100.0),
            words("--slope-noise RMS", noise, type=float, default=0.05),
            _MEMORY,
            words("--array LIBRARY", array, choices=tuple(ArrayLibrary), default="numpy"),
            words("--no-gains", "do not multiply the columns by the fitted gains"),
            words("--flux-map FILE", "illumination, as in pyrcal fit", type=Path),
            words("--reference FILE", "measured matrix, whose checksum is recorded", type=Path),
            words("--specula PUPDATA.fits", specula, type=Path),
        ),
    )


def _describe_conventions(commands: Any) -> None:  # noqa: ANN401 - argparse's own
    commands.add_parser(
        "conventions",
        help="check a measured matrix against the conventions",
        module="pyrcal.conventions",
        description="Check a measured matrix, and the modes of its instrument file, against the "
        "numbered rules of docs/reference/conventions.md; print which are broken, and by how much.",
        epilog="Exit status: 0 all are kept; 1 some are broken; 2 input that cannot be used.",
        examples=["bench.toml matrix.h5"],
        options=(_INSTRUMENT, _REFERENCE, _DATASET),
    )


def _describe_instrument(commands: Any) -> None:  # noqa: ANN401 - argparse's own
    instrument = commands.add_parser(
        "instrument",
        help="write, check or draw an instrument file",
        module="pyrcal.instruments.program",
        description="Write a commented instrument file, check one, or draw it.",
        epilog="Exit status: 0 done; 1 something is wrong with the instrument file; 2 a file "
        "cannot be written.",
    )
    kind = words(
        "--kind KIND", "kind of sensor, default pyramid", choices=tuple(KINDS), default="pyramid"
    )
    memory = "compute the matrix only if that takes no more, default %(default)g"
    checked = (
        _INSTRUMENT,
        words("--memory-gb GB", memory, type=float, default=4.0),
        words("--light FRAME", "mean frame of the pupil images: print their places", type=Path),
    )
    new = words("file FILE.toml", "file to write", type=Path)
    drawn = (_INSTRUMENT, words("picture PICTURE.png", "picture to write", type=Path))
    purpose = "print all errors of the file, and what follows from it"
    instrument.add_commands(
        "action",
        ("new", "write a file with all keys", "bench.toml", (new, kind)),
        ("check", purpose, "bench.toml", checked),
        ("show", "draw pupil, subapertures, actuators", "bench.toml bench.png", drawn),
    )


def _describe_import(commands: Any) -> None:  # noqa: ANN401 - argparse's own
    bring = commands.add_parser(
        "import",
        help="import instrument and matrix of another code",
        module="pyrcal.importers.program",
        description="Write an instrument file and a measured matrix for pyrcal fit from files of "
        "another code. Missing parameters are marked unknown. docs/howto/importing.md explains "
        "each code.",
        epilog="Exit status: 0 written; 2 input that cannot be used.",
    )
    roles = "file or folder with arrays of known names, or ROLE=FILE with a role of matrix, valid, "
    roles += "light, modes, positions, mode_to_actuator"
    saved = words("file FILE", ".npz or .mat with the names in docs/tutorials/oopao.md", type=Path)
    own = words("files FILE", "files, recognised by their content", type=_role_and_path, nargs="+")
    named = words("files [ROLE=]FILE", roles, type=_role_and_path, nargs="+")
    response = words("--response NAME", "such as loRM; default: of single actuators if present")
    loop = words("--loop N|UID", "if there are several loops: number, from 1, or uid")
    positions = words("--positions FILE", "of the actuators, x and y in metres", type=Path)
    conf = words("folder CONF", "conf folder", type=Path)
    file = words("file FILE.fits", "AOT file", type=Path)
    arrays = (named, *_OF_ARRAYS)
    of_pixels, of_spots = (
        f"im.fits {data}.fits ifunc.fits{more} --diameter-m 8.2"
        for data, more in (("pupdata", " m2c.fits"), ("subapdata", ""))
    )
    by_name = "matrix=im.npy positions=xy.npy --unit um --diameter-m 8.2"
    specula = "from Intmat, PupData or SubapData, IFunc, M2C of SPECULA"
    cacao = "from the conf folder of a cacao loop, or an example folder"
    folder = words("--output DIR", "new folder for both files", type=Path, required=True)
    bring.add_commands(
        "source",
        *(
            (source, purpose, f"{example} --output imported", (*more, folder, *about))
            for source, purpose, example, more, about in (
                ("oopao", "from saved OOPAO objects", "system.npz", (saved,), ()),
                ("specula", specula, of_pixels, (own,), _DESCRIBED),
                ("synim", "from the same files of SynIM", of_spots, (own,), _DESCRIBED),
                ("cacao", cacao, "conf --diameter-m 8.2", (conf, response), _DESCRIBED),
                (
                    "pyrtc",
                    "from calibrations of pyRTC 2",
                    "calibration --instrument bench.toml",
                    arrays,
                    _DESCRIBED,
                ),
                (
                    "aot",
                    "from an AOT file",
                    "telemetry.fits --diameter-m 8.2",
                    (file, loop, positions, _UNIT),
                    _DESCRIBED,
                ),
                ("files", "from NumPy, FITS or HDF5 files", by_name, arrays, _DESCRIBED),
            )
        ),
    )


def _describe_twin(commands: Any) -> None:  # noqa: ANN401 - argparse's own
    roles = "folder or files of the bench, or ROLE=FILE with a role of matrix, valid, light, "
    roles += "modes, mode_to_actuator, positions, pupil, sky_pupil, spot"
    output = "folder to write: a new one, or that of an earlier twin"
    check = "let OOPAO and SPECULA, where installed, measure the matrices of their models"
    commands.add_parser(
        "twin",
        help="make models of a bench from its files",
        module="pyrcal.twins.make",
        description="Fit everything that a model of a bench needs to its measured matrix, and "
        "write a report, an instrument file with corrected values, and models that OOPAO and "
        "SPECULA run.",
        epilog="Exit status: 0 accepted; 1 written but refused (the report says why); 2 input that "
        "cannot be used. docs/howto/twin.md explains files and results.",
        examples=("bench --diameter-m 0.6 --unit m --output twin",),
        options=(
            words("files [ROLE=]FILE", roles, type=_role_and_path, nargs="+"),
            words("--output DIR", output, type=Path, required=True),
            words("--check", check),
            words("--python FILE", "interpreter that has them; default this one", type=Path),
            *_OF_ARRAYS,
            *_DESCRIBED,
            _THREADS,
        ),
    )


def _read_by(parse: Callable[[str], object]) -> Callable[[str], object]:
    """Return a reader whose refusals argparse prints as they are."""

    def read(text: str) -> object:
        try:
            return parse(text)
        except ValueError as error:
            raise argparse.ArgumentTypeError(str(error)) from error

    return read


_UNIT = words(
    "--unit UNIT", "unit of the commands, OPD; default: unknown", choices=("m", "um", "nm")
)

_OF_ARRAYS = (
    _UNIT,
    words("--instrument NAME|FILE", "description of telescope, sensor and mirror"),
    words(
        "--basis BASIS",
        "if only positions are given: one column for each actuator, or KL modes",
        choices=("zonal", "KL"),
    ),
)
"""Options of commands that take arrays by role."""

_DESCRIBED = in_group(
    DESCRIPTION,
    words("--diameter-m D", "of the pupil; required without --instrument", type=float),
    words(
        "--modes FIRST:END",
        "basis index of each column, like 0:400 or 3,5,9; default the first ones",
        type=_read_by(parse_modes),
    ),
    words("--sensor KIND", "default: that of the files, else pyramid", choices=tuple(KINDS)),
    words(
        "--stop STOP",
        "aperture stop, default %(default)s",
        choices=("telescope", "mirror"),
        default="telescope",
    ),
    words("--obscuration RATIO", "linear; default: from the mask", type=float),
    words("--wavelength-m W", "default: unknown", type=float),
    words("--modulation RADIUS", "of a pyramid, λ/D; default: unknown", type=float),
    words("--pupil-subap N", "pupil diameter, subapertures; default: from the mask", type=float),
    words(
        "--pixels-per-subap N", "of camera frames; default: from the actuator pitch", type=_count
    ),
)


def _role_and_path(text: str) -> tuple[str | None, Path]:
    """Return what a file is for, if that is stated, and the file."""
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

"""The bridge's settings, TOML."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Final, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from service.config.link_tables import CredentialsTable
from service.files.toml import Id, Table, in_file, read_toml, refuse, validated

Positive = Annotated[float, Field(gt=0.0)]
Counted = Annotated[int, Field(ge=1, le=1_000_000)]
Opaque = Annotated[str, Field(min_length=1, max_length=128)]
Name = Annotated[str, Field(min_length=1, max_length=79, pattern=r"^[^/]+$")]
Optional = Annotated[str, Field(max_length=79, pattern=r"^[^/]*$")]


OF_THE_SUM: Final = "mult (c - gain m)"
"""A law of the integrator in which mult holds for the new command, too."""


class WireTable(Table):
    """The service, and how this loop is called there."""

    connect: str = "tcp/127.0.0.1:7447"
    """Its zenoh router."""

    system: Id
    """The ``{system}`` of the keys: ``[instrument] name`` of the instrument file."""

    basis_id: Opaque
    """Name of the modal basis. Choose another when the modes, their order or their scale change."""

    config_id: Opaque
    """Name of the sensor configuration. Choose another when mask, binning or modulation change."""


class StreamsTable(Table):
    """Names of cacao's streams; they differ between its versions and between loops."""

    directory: str = ""
    """Folder of the streams; empty for ``$MILK_SHM_DIR``, else ``/milk/shm``."""

    slopes: Name = "aol1_imWFS2"
    """Slopes that modes_wfs multiplies, reference subtracted."""

    commands: Name = "aol1_modevalDM"
    """Commands of the loop: one number per mode, or the mirror's actuators."""

    multiplied: Name = "aol1_modevalWFS"
    """Output of the process that multiplies slopes. Its restart shows that a matrix was taken up.
    """

    modes_wfs: Name = "aol1_modesWFS"
    """The reconstructor, one slice a mode: written here."""

    modes_dm: Name = "aol1_DMmodes"
    """The modes of the mirror, one slice a mode: written here."""

    gains: Optional = "aol1_mgain"
    """Gain of each mode; empty: ``[loop] gain``."""

    reference: Optional = ""
    """Reference subtracted from the slopes, like ``aol1_wfsrefc``; empty if this loop has none. A
    new one is named to the service (``reference_id``)."""

    factors: Optional = "aol1_mmult"
    """Factor of each mode's command in every frame; empty to use ``[loop] leak``."""

    dither: Optional = ""
    """A channel of the mirror that is the bridge's own, like ``dm01disp05``; empty: no dither."""


class LoopTable(Table):
    """Facts of the loop that the streams do not contain."""

    frame_rate_hz: Positive
    delay_frames: Annotated[float, Field(ge=1.0, le=20.0)]
    """From an exposure to the one that the answer to it is on the mirror for."""

    n_slopes: Counted
    n_modes: Counted
    """Number of modes of the basis, controlled or not."""

    metre_per_unit: Positive
    """OPD of a mode whose command is 1, metres; cacao's mirrors count in micrometres."""

    slope_per_value: Positive = 1.0
    """Slope or normalised pixel, as the instrument file has it, of a value of 1 in a frame. Frames
    of cacao whose sum is 1 need the number of valid subapertures: there the mean is 1."""

    commands_are: Literal["modes", "actuators"] = "modes"
    counter_offset: int | None = None
    """Counter of a frame of ``slopes`` minus that of the ``commands`` that answer it. If left out,
    it is read from the commands' trace."""

    law: Literal["mult c - gain m", "mult (c - gain m)"] = "mult c - gain m"
    """Law of the modal filter: that of today's cacao, or the earlier one."""

    gain: Annotated[float, Field(ge=0.0)] = 0.0
    """Gain of every mode if there is no stream of gains; otherwise the factor of a bundle's gains.
    """

    leak: Annotated[float, Field(ge=0.0, le=1.0)] = 1.0
    max_dither_m: Annotated[float, Field(ge=0.0)] = 50e-9
    """Most that is played on one mode, metres RMS."""


class CalibrationTable(Table):
    """Matrices on their way to cacao."""

    folder: str
    """Each matrix that came, with where it comes from, and which is in use."""

    dm_modes: str
    """NumPy file ``(n_modes, ...)``: the basis in the mirror's own units, as modes_dm has it."""

    slopes_index: str = ""
    """NumPy file ``(n_slopes,)``: places of the slopes in a frame; empty: all of it is slopes."""

    interlock: Literal["operator", "restart"] = "operator"
    """Condition for writing the streams: an operator's order, or the arrival of a matrix."""


class Settings(Table):
    """Everything in the file."""

    wire: WireTable
    streams: StreamsTable = StreamsTable()
    loop: LoopTable
    calibration: CalibrationTable
    zenoh: CredentialsTable = CredentialsTable()


def load(path: Path) -> Settings:
    """Return the settings in a file.

    Raises
    ------
    ConfigurationError
        One line: where, what was found, what was expected.
    """
    return validated(Settings, read_toml(path), in_file(path))


def load_modes(settings: Settings) -> NDArray[np.float32]:
    """Return the basis ``(n_modes, ...)`` in the mirror's units.

    Raises
    ------
    ConfigurationError
        If the file holds something else.
    """
    modes = _array(settings.calibration.dm_modes, "calibration.dm_modes")
    n_modes = settings.loop.n_modes
    if modes.ndim not in {2, 3} or len(modes) != n_modes or not np.all(np.isfinite(modes)):
        expected = f"{n_modes} modes of one or two axes, all finite"
        refuse("calibration.dm_modes", f"shape {modes.shape}", expected)
    return np.ascontiguousarray(modes, dtype=np.float32)


def load_index(settings: Settings) -> NDArray[np.int64]:
    """Return the places ``(n_slopes,)`` of the slopes in a frame.

    Raises
    ------
    ConfigurationError
        If the file holds something else.
    """
    n_slopes, key = settings.loop.n_slopes, "calibration.slopes_index"
    if not settings.calibration.slopes_index:
        return np.arange(n_slopes)
    index = _array(settings.calibration.slopes_index, key)
    sound = index.shape == (n_slopes,) and np.issubdtype(index.dtype, np.integer)
    if not sound or index.min() < 0 or len(np.unique(index)) != n_slopes:
        found = f"{index.dtype} {index.shape}"
        refuse(key, found, f"{n_slopes} places from 0 on, none twice")
    return index.astype(np.int64)


def _array(file: str, key: str) -> NDArray[np.generic]:
    try:
        array: NDArray[np.generic] = np.load(file, allow_pickle=False)
    except (OSError, ValueError) as error:
        refuse(key, f"{file}: {error!s:.120}", "a NumPy file of numbers")
    return array

"""The settings: command line > environment > TOML file > defaults."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Literal, get_args, get_origin

from pydantic import Field, model_validator

from service.config.link_tables import ZenohTable
from service.errors import ConfigurationError
from service.files.toml import Id, Network, Table, in_file, nearest, read_toml, validated
from service.model.kinds import ArrayLibrary

PREFIX = "PYRCAL_"
"""Prefix of the environment variables: ``PYRCAL_<SECTION>__<KEY>``, like ``PYRCAL_API__PORT``."""

OF_CLIENTS = {"PYRCAL_URL", "PYRCAL_API_KEY"}
"""Variables of clients, which are no settings of a service."""

Positive = Annotated[float, Field(gt=0.0)]


class ServiceTable(Table):
    """``[service]``: general."""

    instrument: str = Field(default="flao-lbt", min_length=1)
    """Packaged name, or path of an instrument file."""

    system: Id | None = None
    """``{system}`` of the contract's keys; None: the instrument's name."""

    mode: Literal["auto", "propose", "hold"] = "propose"
    """Mode at the start."""

    data_dir: Path = Path("var")
    """Folder of matrices, index and audit trail."""

    cache_dir: Path | None = None
    """Folder of cached computations, which may be deleted; None: ``pyrcal`` in the user's cache."""

    log_format: Literal["auto", "text", "json"] = "auto"
    """Format of the log; auto: text on a terminal, else JSON."""


class ApiTable(Table):
    """``[api]``: REST and the page."""

    host: str = Field(default="127.0.0.1", min_length=1)
    """Address to listen on."""

    port: int = Field(default=8080, ge=0, le=65535)
    """TCP port; 0: any free one."""

    allowed_hosts: tuple[str, ...] = ()
    """Names that requests may use besides loopback and ``host``, without a port."""

    trusted_proxies: tuple[Network, ...] = ()
    """Addresses and networks of proxies whose ``X-Forwarded-For`` and ``-Proto`` are used."""


class DitherTable(Table):
    """``[dither]``: the small modulation that measures α."""

    enabled: bool = True
    """Dither without an order."""

    budget_m: float = Field(default=8e-9, gt=0.0, le=2e-7)
    """Largest RMS of all modes together, OPD."""

    sigma_shift_subap: Positive = 0.01
    """1 σ of each shift to keep."""

    sigma_rotation_deg: Positive = 0.02
    """1 σ of the rotation."""

    sigma_magnification: Positive = 0.001
    """1 σ of the magnification."""

    longest_pause_s: float = Field(default=0.0, ge=0.0, le=3600.0)
    """Longest pause between two windows, during which a jump is not seen."""

    amplitude_m: float | None = Field(default=None, gt=0.0, le=1e-7)
    """RMS of each mode, OPD; None: as the precision requires, within the budget."""

    modes: tuple[Annotated[int, Field(ge=0)], ...] | None = None
    """0-based basis indices; None: four that the loop does not control."""

    frequencies_hz: tuple[Positive, ...] | None = None
    """One for each mode; None: 0.2 to 0.35 of the frame rate."""

    avoid_hz: tuple[Positive, ...] = ()
    """Vibrations to avoid, besides those found in the slopes."""

    window_s: float = Field(default=2.0, ge=0.1, le=60.0)
    """Shortest window."""

    longest_window_s: float = Field(default=20.0, ge=0.1, le=300.0)
    """Longest window, for faint stars and small budgets."""

    @model_validator(mode="after")
    def _one_frequency_for_each_mode(self) -> DitherTable:
        n_frequencies = len(self.frequencies_hz or ())
        if self.frequencies_hz is not None and n_frequencies != len(self.modes or ()):
            raise ValueError(
                f"found {n_frequencies} frequencies_hz for {len(self.modes or ())} modes, "
                "expected one for each"
            )
        return self

    @model_validator(mode="after")
    def _amplitude_within_the_budget(self) -> DitherTable:
        n_modes = len(self.modes or range(4))
        total_m = (self.amplitude_m or 0.0) * n_modes**0.5
        if total_m > self.budget_m * (1.0 + 1e-9):
            raise ValueError(
                f"found amplitude_m for {1e9 * total_m:.3g} nm RMS of {n_modes} modes together, "
                f"expected no more than budget_m, {1e9 * self.budget_m:.3g} nm"
            )
        return self


class TrackingTable(Table):
    """``[tracking]``: drift of α and errors of the model."""

    drift_subap_per_minute: Positive = 0.05
    """Random walk of each shift, 1 σ after a minute."""

    drift_deg_per_minute: Positive = 0.05
    """Drift of the rotation."""

    drift_magnification_per_minute: Positive = 0.0005
    """Drift of the magnification."""

    floor_shift_subap: float | None = Field(default=None, ge=0.0)
    """Model error of each shift, 1 σ; None: as measured, larger for a coarse mirror."""

    floor_rotation_deg: float | None = Field(default=None, ge=0.0)
    """Model error of the rotation."""

    floor_magnification: float | None = Field(default=None, ge=0.0)
    """Model error of the magnification."""

    anamorphosis: bool = False
    """Track the anamorphosis, too; otherwise it is that of the instrument file."""

    bias_memory_s: Positive = 3600.0
    """Time in which the learnt bias of the passive estimate decays to 1/e."""

    flexure_subap_per_degree: float = Field(default=0.02, ge=0.0)
    """Shift per degree of elevation, 1 σ."""

    flexure_deg_per_degree: float = Field(default=0.01, ge=0.0)
    """Flexure of the rotation."""

    flexure_magnification_per_degree: float = Field(default=1e-4, ge=0.0)
    """Flexure of the magnification."""

    slew_limit_deg: Positive = 5.0
    """Motion of the telescope after which α is invalid until the next window."""

    stale_shift_subap: Positive | None = None
    """1 σ of a shift, beyond the model error, from which α is stale; None: 0.05 for 500 modes on
    30 subapertures, more for fewer modes."""

    stale_rotation_deg: Positive | None = None
    """The same of the rotation; None: 0.1 for 500 modes."""

    stale_magnification: Positive | None = None
    """The same of the magnification; None: 0.003 for 500 modes."""


class AcquisitionTable(Table):
    """``[acquisition]``: estimation of an unknown α."""

    auto: bool = True
    """Begin without an order, in mode auto, when the loop diverges or α is out of range."""

    amplitude_m: float = Field(default=50e-9, gt=0.0, le=2e-7)
    """RMS of each of up to eight modes, OPD, if the RTC allows it; not limited by the budget."""


class ControlTable(Table):
    """``[control]``: reconstructors."""

    n_modes_target: int = Field(default=500, ge=1)
    """Modes to control."""

    pole_radius_bound: float = Field(default=0.95, gt=0.0, lt=1.0)
    """Largest pole radius of the closed loop within α ± 3σ."""

    method: Literal["svd", "map"] = "svd"
    """Inversion; map weighs noise and turbulence."""

    max_condition: float = Field(default=100.0, gt=1.0)
    """svd: largest over smallest singular value used."""

    slope_noise: Positive = 0.05
    """map: 1 σ of one slope in one frame; the turbulence is that of ``[modes]``."""

    update_gain_nm: Positive = 0.5
    """Gain in wavefront error that justifies a new reconstructor."""

    update_margin: float = Field(default=0.08, gt=0.0, lt=1.0)
    """Gain in stability margin that does, as a share of the new margin."""

    update_shift_subap: Positive | None = None
    """Change of a shift that does in any case; None: 0.08 for 500 modes on 30 subapertures, more
    for fewer modes."""

    update_rotation_deg: Positive | None = None
    """Change of the rotation; None: 0.08 for 500 modes."""

    update_magnification: Positive | None = None
    """Change of the magnification; None: 0.005 for 500 modes."""

    wind_m_s: Positive = 15.0
    """Wind for the expected wavefront error."""

    minimum_interval_s: float = Field(default=5.0, ge=0.0)
    """Shortest time between two reconstructors."""

    open_lost_loop: bool | None = None
    """Have a loop opened that a new matrix has lost and the previous one does not restore; None:
    only in mode auto."""


Size = Annotated[float, Field(ge=0.0)]
FourAxes = tuple[Size, Size, Size, Size]
"""Shift x and y in subapertures, rotation in degrees, magnification."""


class OffloadTable(Table):
    """``[offload]``: correction by moving the mirror's image, with a lens or a stage, in mode auto.

    The four values: shift x and y (subapertures), rotation (degrees), magnification.
    """

    enabled: bool = False
    """Request moves."""

    gain: float = Field(default=0.8, gt=0.0, le=1.0)
    """Share of the distance to the nominal registration requested at once."""

    dead_band: FourAxes = (0.015, 0.015, 0.015, 0.002)
    """Largest distance without a request."""

    most_step: FourAxes = (0.1, 0.1, 0.2, 0.005)
    """Largest single move."""

    reach: FourAxes = (1.0, 1.0, 1.0, 0.02)
    """Largest sum of all moves, across restarts; 0: cannot be moved."""

    settle_s: float = Field(default=3.0, ge=0.0, le=50.0)
    """Time from the reply until the image is at rest, unless the reply states it."""


class ComputeTable(Table):
    """``[compute]``: processor time and sampling of the optics."""

    threads: int = Field(default=2, ge=1, le=256)
    """Threads of the worker process."""

    cluster: str | None = Field(default=None, pattern=r"^(tcp|tls)://\S+:\d+$")
    """Dask scheduler, ``tcp://HOST:PORT``, whose workers help with D from 70 subapertures on
    (extra ``cluster``)."""

    array: ArrayLibrary = ArrayLibrary.NUMPY
    """Library that computes a pyramid's rows of D; torch and cupy use a GPU (extra ``array``)."""

    nice: int = Field(default=10, ge=0, le=19)
    """Niceness of the worker."""

    pupil_sampling: int = Field(default=3, ge=1, le=16)
    """Pupil points per subaperture."""

    detector_nodes: int = Field(default=3, ge=1, le=16)
    """Quadrature nodes per detector pixel and axis."""

    memory_gb: Positive = 6.0
    """Memory for modes, D and its derivatives; an instrument that needs more is refused."""

    working_point_modes: int | None = Field(default=None, ge=1)
    """Modes of the loop around whose residual the response is computed, which is slower and less
    biased on sky; None: around a flat wavefront."""


class FitsTable(Table):
    """``[fits]``: fits of uploaded matrices."""

    upload_limit_mb: int = Field(default=512, ge=1, le=100_000)
    """Largest upload, also unpacked."""

    waiting: int = Field(default=4, ge=1, le=100)
    """Largest number of unfinished fits."""

    time_limit_s: Positive = 600.0
    """Longest fit."""

    memory_limit_mb: int = Field(default=4000, ge=500, le=1_000_000)
    """Largest memory of a fit."""


class ReferencesTable(Table):
    """``[references]``: reference slopes for a shape that the loop holds."""

    worst_seeing_arcsec: float = Field(default=1.2, ge=0.3, le=5.0)
    """Worst seeing expected in the night: a shape with which the loop would not survive it is
    refused."""

    ramp_s: float = Field(default=1.0, ge=0.0, le=60.0)
    """Duration of the ramp to other references."""


class ArchiveTable(Table):
    """``[archive]``: retention."""

    keep_days: float = Field(default=0.0, ge=0.0)
    """Age at which matrices are removed, except those in use, referenced, pinned or newest; 0:
    never."""

    keep_gb: float = Field(default=100.0, ge=0.0)
    """Largest size of all matrices, of which the oldest go first; 0: no limit."""

    reserve_gb: float = Field(default=2.0, ge=0.0)
    """Free space below which there is an alarm."""

    noon_utc_h: int = Field(default=12, ge=0, le=23)
    """UTC hour of local noon, at which a night begins."""

    last_telemetry_s: float = Field(default=60.0, ge=0.0, le=3600.0)
    """Telemetry kept in memory for recordings that begin in the past."""

    last_telemetry_mb: int = Field(default=96, ge=0, le=1_000_000)
    """Memory for it; 0: none. FLAO at 1 kHz needs 10 MB a second."""


Scalar = bool | float | str


class RuleTable(Table):
    """``[[rules]]``: alarms of your own."""

    name: Id
    """Its alarm is ``rule.NAME``."""

    when: tuple[str, Literal["==", "!=", "<", "<=", ">", ">="], Scalar] = Field(strict=False)
    """Name of a value (``PUT /v1/values/{name}``) or field (``state.elevation_deg``), comparison,
    other value."""

    blocks: tuple[Literal["measure", "decide", "send_new", "send_known", "ask"], ...] = ()
    """Actions that it forbids, explained in docs/operate/runbook.md."""

    severity: Literal["warning", "serious", "critical"] = "serious"
    """Severity of the alarm."""

    text: str = Field(min_length=1, max_length=300)
    """Text: what is wrong and what to do."""

    unknown: Literal["holds", "does-not-hold"] = "holds"
    """Result of the rule while the value is unknown."""

    @model_validator(mode="after")
    def _compared_with_sense(self) -> RuleTable:
        name, how, than = self.when
        if name.startswith("state.") and name not in STATE_FIELDS:
            raise ValueError(f"found {name!r} in when{nearest(name, STATE_FIELDS)}")
        if how not in {"==", "!="} and (isinstance(than, bool | str)):
            raise ValueError(f"found {than!r} after {how}, expected a number")
        expected = STATE_FIELDS.get(name)
        if expected is not None and isinstance(than, str) is not (expected is str):
            raise ValueError(f"found {than!r} for {name}, expected a {_WORD[expected]}")
        return self


STATE_FIELDS: dict[str, type] = {
    "state.mode": str,
    "state.loop": str,
    "state.n_controlled": float,
    "state.magnitude": float,
    "state.elevation_deg": float,
    "state.azimuth_deg": float,
}
"""Fields of the state that a rule may use."""

_WORD = {str: "text", float: "number"}


class Settings(Table):
    """Everything the user may decide about the service."""

    service: ServiceTable = Field(default_factory=ServiceTable)
    zenoh: ZenohTable = Field(default_factory=ZenohTable)
    api: ApiTable = Field(default_factory=ApiTable)
    dither: DitherTable = Field(default_factory=DitherTable)
    tracking: TrackingTable = Field(default_factory=TrackingTable)
    acquisition: AcquisitionTable = Field(default_factory=AcquisitionTable)
    control: ControlTable = Field(default_factory=ControlTable)
    offload: OffloadTable = Field(default_factory=OffloadTable)
    compute: ComputeTable = Field(default_factory=ComputeTable)
    fits: FitsTable = Field(default_factory=FitsTable)
    references: ReferencesTable = Field(default_factory=ReferencesTable)
    archive: ArchiveTable = Field(default_factory=ArchiveTable)
    rules: tuple[RuleTable, ...] = ()

    @model_validator(mode="after")
    def _one_kind_for_each_value(self) -> Settings:
        names = [rule.name for rule in self.rules]
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice:
            raise ValueError(f"found rules {', '.join(twice)} twice, expected a name for each")
        kinds: dict[str, type] = {}
        for rule in self.rules:
            about, _, than = rule.when
            # bool first: in Python a bool is an int.
            kind = bool if isinstance(than, bool) else str if isinstance(than, str) else float
            if kinds.setdefault(about, kind) is not kind:
                raise ValueError(f"found {than!r} for {about}: another rule compares it otherwise")
        return self


_Key = tuple[str, ...]


def load_settings(
    path: Path | None,
    env: Mapping[str, str],
    command_line: Mapping[str, object] | None = None,
) -> Settings:
    """Return the settings: command line > environment > TOML file > defaults.

    Parameters
    ----------
    path
        TOML file; None: no file.
    env
        Environment variables; those that begin with ``PYRCAL_`` count. A value is read as TOML
        where its key takes more than text: ``PYRCAL_DITHER__MODES="[501, 450]"``.
    command_line
        Values by dotted key: ``{"api.port": 8080}``.

    Raises
    ------
    ConfigurationError
        One line that names the key and the file, variable or command line it came from.
    """
    tables = read_toml(path) if path is not None else {}
    file_place = in_file(path) if path is not None else ".".join
    overrides: dict[_Key, tuple[str, object]] = {}
    for name in sorted(n for n in env if n.startswith(PREFIX) and n not in OF_CLIENTS):
        key = _environment_key(name)
        overrides[key] = (f"environment: {name}", _environment_value(key, env[name]))
    for dotted, value in (command_line or {}).items():
        overrides[tuple(dotted.split("."))] = (f"command line: {dotted}", value)
    # What the command line says has replaced the environment here already.
    for (section, name), (_, value) in overrides.items():
        table = tables.setdefault(section, {})
        # A section that is no table in the file is left to the validation, which names it.
        if isinstance(table, dict):
            table[name] = value

    def place(key: _Key) -> str:
        origin = overrides.get(key[:2])
        # An error names the source of the value that counted, not the file that it replaced.
        return origin[0] if origin is not None else file_place(key)

    return validated(Settings, tables, place)


def _environment_key(name: str) -> _Key:
    match = re.fullmatch(r"([A-Z]+)__([A-Z0-9_]+)", name.removeprefix(PREFIX))
    if match is None:
        raise ConfigurationError(
            f"environment: {name}: expected {PREFIX}<SECTION>__<KEY>, like {PREFIX}API__PORT"
        )
    section, key = match[1].lower(), match[2].lower()
    # Rules are a list of tables, which no single key can address.
    if section not in Settings.model_fields or section == "rules":
        raise ConfigurationError(
            f"environment: {name}: unknown section {section}"
            f"{nearest(section, Settings.model_fields)}"
        )
    return section, key


def _environment_value(key: _Key, text: str) -> object:
    section, name = key
    field = type(getattr(Settings(), section)).model_fields.get(name)
    if field is not None and _takes_text(field.annotation):
        return text
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        return text


def _takes_text(annotation: object) -> bool:
    if get_origin(annotation) is tuple:
        return False
    alternatives = {annotation, *get_args(annotation)}
    return bool(alternatives & {str, Path, Id}) or get_origin(annotation) is Literal

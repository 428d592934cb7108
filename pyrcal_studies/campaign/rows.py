"""The rows of a campaign: a file that a run which was ended goes on with, and a table of it."""

from __future__ import annotations

import argparse
import json
import multiprocessing
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from pyrcal_studies.shared import study_parser
from service.errors import ClusterError, say
from service.runtime.cluster import Cluster

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

Row = dict[str, Any]
Plan = TypeVar("Plan", bound="DataclassInstance")
Result = TypeVar("Result")

UNITS = np.array([100.0, 100.0, 1000.0, 100.0])
"""An α is printed in % of a subaperture, thousandths of a degree, %."""


class RowFile:
    """Rows in a file, one JSON object a line; file and folder are made if they are not there."""

    def __init__(self, path: Path) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()  # a path that cannot be written is refused before anything is played
        self._path = path
        self.rows: list[Row] = [json.loads(line) for line in path.read_text().splitlines()]
        """All there are, those of earlier runs first."""

    def missing(self, plans: Iterable[Plan]) -> list[Plan]:
        """Return those of these records that no row is of; a row has the fields of its record.

        What an older row does not have yet was as it is by default.
        """
        every = list(plans)
        usual = {field.name: field.default for field in fields(every[0])} if every else {}
        done = {json.dumps([row.get(*each) for each in usual.items()]) for row in self.rows}
        return [p for p in every if json.dumps([getattr(p, name) for name in usual]) not in done]

    def add(self, *rows: Row) -> None:
        """Keep more rows; they are in the file when this returns."""
        self.rows += rows
        with self._path.open("a") as file:
            file.writelines(json.dumps(row) + "\n" for row in rows)


def played(
    play: Callable[[Plan], Result], plans: Sequence[Plan], workers: int, cluster: str | None = None
) -> Iterator[Result]:
    """Yield what comes of each plan, as it comes; several workers are processes of their own.

    With the address of a ``cluster`` plans are tasks of its workers; what is left when it is gone
    is played here.

    Raises
    ------
    ClusterError
        If there is no such cluster, or it runs another version; nothing has been played then.
    """
    left = dict(enumerate(plans))
    if cluster is not None and left:
        with Cluster(cluster) as helpers:
            try:
                for number, result in helpers.each(play, plans):
                    del left[number]
                    yield result
            except ClusterError as error:
                sys.stderr.write("\n")
                say(f"{error}; the other {len(left)} are played here, --workers {workers}")
    if workers == 1:
        yield from map(play, left.values())
        return
    with ProcessPoolExecutor(workers, multiprocessing.get_context("spawn")) as executor:
        for finished in as_completed([executor.submit(play, plan) for plan in left.values()]):
            yield finished.result()


def campaign_parser(name: str, text: str | None) -> argparse.ArgumentParser:
    """Return the parser of a campaign; ``text`` is its module's docstring."""
    parser = study_parser(f"pyrcal_studies.campaign{name and '.'}{name}", text)
    usual = Path(f"var/{name or 'campaign'}.jsonl")
    parser.add_argument("--output", type=Path, default=usual, help=f"rows, resumed ({usual})")
    parser.add_argument("--table", type=Path, metavar="FILE.md", help="of all rows")
    return parser


def complete(
    play: Callable[[Plan], Row | list[Row]], plans: Iterable[Plan], given: argparse.Namespace
) -> list[Row]:
    """Play what is not in ``--output`` yet, and return all rows of it."""
    file = RowFile(given.output)
    missing = file.missing(plans)
    started = time.monotonic()
    workers, cluster = getattr(given, "workers", 1), getattr(given, "cluster", None)
    for k, found in enumerate(played(play, missing, workers, cluster), start=1):
        file.add(*(found if isinstance(found, list) else [found]))
        left_s = (time.monotonic() - started) / k * (len(missing) - k)
        sys.stderr.write(f"\r{k} of {len(missing)}, {left_s / 60:.0f} min left   ")
    sys.stderr.write("\n")
    return file.rows


def add_workers(parser: argparse.ArgumentParser, usual: int) -> None:
    """Add the options that say where nights are played."""
    parser.add_argument("--workers", type=int, default=usual, help="processes here")
    parser.add_argument(
        "--cluster",
        metavar="tcp://HOST:PORT",
        help="a running Dask scheduler, whose workers play them (extra 'cluster')",
    )


def grouped(rows: Iterable[Row], plan: type[DataclassInstance], *but: str) -> list[list[Row]]:
    """Return rows in groups that agree in all fields of their record, those of ``but`` apart."""
    names = [field.name for field in fields(plan) if field.name not in but]
    groups: dict[str, list[Row]] = {}
    for row in rows:
        groups.setdefault(json.dumps([row.get(name) for name in names]), []).append(row)
    return list(groups.values())


def heading(*columns: str) -> str:
    """Return the head of a Markdown table."""
    return line(*columns) + "|---" * len(columns) + "|\n"


def line(*cells: object) -> str:
    """Return a line of a Markdown table."""
    return f"| {' | '.join(map(str, cells))} |\n"


def four(values: NDArray[np.float64]) -> str:
    """Return the four numbers of an α as one cell."""
    return " ".join(f"{value:.2f}" for value in values)


def tell(text: str, path: Path | None, program: str) -> None:
    """Print a table; with a ``path`` also write it there, below the command that made it."""
    sys.stdout.write(text)
    if path is not None:
        path.write_text(f"Made by `{' '.join([program, *sys.argv[1:]])}`.\n\n{text}")


def floats(text: str) -> tuple[float, ...]:
    """Return the numbers with commas between them."""
    return tuple(float(word) for word in text.split(","))


def words(text: str) -> tuple[str, ...]:
    """Return the words with commas between them."""
    return tuple(text.split(","))


def range_of(text: str) -> range:
    """Return the range that ``FIRST:END`` names; END is not in it."""
    first, end = text.split(":")
    return range(int(first), int(end))

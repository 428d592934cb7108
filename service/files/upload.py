"""The fit of an upload, as it runs in a process of its own."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from service.errors import MatrixError, PyrcalError
from service.files.jobs import UPLOAD, FitAsked
from service.files.parcel import opened_parcel
from service.files.report import document
from service.files.run import fit_file
from service.model.instrument import Instrument


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class UploadFitter:
    """Fits what was uploaded into a folder; can be pickled."""

    own: Instrument
    """The service's own instrument."""

    load_instrument: Callable[[Path], Instrument]
    """Reads that of an upload."""

    packaged_instrument: Callable[[str], Instrument]
    """Reads a packaged one; a name is never a file of this machine."""

    most_bytes: int
    """Of the files of an archive together."""

    threads: int
    """That share the work."""

    def __call__(self, folder: Path, asked: FitAsked) -> dict[str, Any]:
        """Return the document of the fit.

        Raises
        ------
        MatrixError
            If something in the upload cannot be used, said without the service's own paths.
        """
        unpacked = folder / "unpacked"
        unpacked.mkdir()
        try:
            parcel = opened_parcel(folder / UPLOAD, unpacked, asked.reference, self.most_bytes)
            if asked.instrument is not None:
                instrument = self.packaged_instrument(asked.instrument)
            elif parcel.instrument is not None:
                instrument = self.load_instrument(parcel.instrument)
            else:
                instrument = self.own
            report = fit_file(
                instrument,
                parcel.reference,
                asked.options,
                dataset=asked.dataset,
                threads=self.threads,
            )
        except PyrcalError as error:
            said = str(error).replace(f"{unpacked}/", "").replace(f"{folder}/", "")
            raise MatrixError(said) from error
        return document(report)

"""Outside judges: interaction matrices of OOPAO, HCIPy and SPECULA, fitted as any user's would be.

Each peer, in an environment of its own under ``var/peers``, measures modes of the FLAO mirror by
push-pull at a known registration, with its own pyramid, detector, valid pixels, slopes and signs.
``pyrcal fit`` gets the matrix, and an instrument file that says what a user of that peer knows.
Matrices and environments are kept; the first run takes an hour, later ones minutes.
Run: ``python -m pyrcal_studies.peers``, or with ``--peers hcipy`` for some of them.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import venv
from pathlib import Path

from pyrcal_studies.peers_cases import Case, bench, cases, digest, job_arrays
from pyrcal_studies.peers_fits import Answer, ask, kept_answers
from pyrcal_studies.peers_page import page
from pyrcal_studies.peers_pushpull import Measured, read_product, write_job

ROOT = Path(__file__).resolve().parent.parent
KEPT = ROOT / "var" / "peers"
PAGE = KEPT / "peers.md"

REQUIREMENTS = {
    "oopao": "OOPAO==1.0.0",
    "hcipy": "hcipy==0.7.1",
    "specula": "specula==1.1.0",
    "synim": "synim==2.0.0",
}
"""What is installed for each peer."""

FITTED = ("oopao", "hcipy", "specula")
"""Peers with a pyramid, whose matrices of FLAO are fitted here: SynIM's sensors are lenslets."""

_ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")


def environment(peer: str) -> Path:
    """Return the interpreter that has the peer, made at the first call."""
    folder = KEPT / peer / "venv"
    interpreter, stamp = folder / "bin" / "python", folder / "installed"
    if not stamp.exists() or stamp.read_text() != REQUIREMENTS[peer]:
        venv.create(folder, with_pip=True, clear=True)
        pip = [str(interpreter), "-m", "pip", "install", "--quiet", "--disable-pip-version-check"]
        subprocess.run([*pip, REQUIREMENTS[peer]], check=True)
        stamp.write_text(REQUIREMENTS[peer])
    return interpreter


def variables() -> dict[str, str]:
    """Return the environment variables of a peer's process: one thread, no window."""
    return {**os.environ, **dict.fromkeys(_ONE_THREAD, "1"), "MPLBACKEND": "Agg"}


def measured(case: Case) -> Path:
    """Return the file with the peer's matrix, measured now unless it is kept."""
    folder = KEPT / case.peer
    kept = folder / f"{case.name}-{digest(case, REQUIREMENTS[case.peer])}.npz"
    if not kept.exists():
        print(f"{case.name}: measuring", file=sys.stderr, flush=True)
        interpreter = environment(case.peer)
        job = folder / f"{case.name}-job.npz"
        write_job(job, bench(case), **job_arrays(case))
        command = [str(interpreter), "-m", f"pyrcal_studies.peers_{case.peer}", str(job), str(kept)]
        subprocess.run(
            command,
            cwd=ROOT,
            env=variables(),
            stdout=subprocess.DEVNULL,
            check=True,
        )
        job.unlink()
    return kept


def main() -> int:
    """Measure, fit, and write the page."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--peers", nargs="+", choices=FITTED, default=None)
    parser.add_argument("--page", type=Path, default=PAGE)
    parser.add_argument(
        "--page-only", action="store_true", help="fit nothing: the page of the last run's answers"
    )
    given = parser.parse_args()
    matrices: list[tuple[Case, Measured]] = []
    answers: list[Answer] = []
    for case in (case for peer in given.peers or FITTED for case in cases(peer)):
        matrix, beside = read_product(measured(case))
        matrices.append((case, matrix))
        folder = KEPT / "files" / case.name
        if given.page_only:
            answers += kept_answers(case, folder)
            continue
        print(f"{case.name}: fitting", file=sys.stderr, flush=True)
        answers += ask(case, matrix, beside.get("influence_functions"), folder)
    given.page.parent.mkdir(parents=True, exist_ok=True)
    given.page.write_text(page(matrices, answers))
    print(given.page)
    return 0 if all(answer.as_asked for answer in answers) else 1


if __name__ == "__main__":
    sys.exit(main())

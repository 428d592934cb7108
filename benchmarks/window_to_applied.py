"""From the end of a window of telemetry until the matrix that it led to closes the loop.

Run after a demo: ``python -m benchmarks.window_to_applied var/demo/data``, for any data folder of a
night. It reads what the archive has: ends of the windows that were taken in, and when a matrix was
made and applied.
"""

from __future__ import annotations

import argparse
import sqlite3
import sys
from pathlib import Path


def waits(data: Path) -> list[tuple[str, float, float]]:
    """Return for each matrix made from a window: id, seconds until made, until applied.

    Both from the end of the last window that had come in when it was made.
    """
    connection = sqlite3.connect(f"{(data / 'index.sqlite').as_uri()}?mode=ro", uri=True)
    try:
        ends = [row[0] for row in connection.execute("SELECT t_ns_utc FROM estimate ORDER BY 1")]
        made, applied = (
            {
                text.replace(",", " ").split()[0]: t_ns
                for t_ns, text in connection.execute(
                    "SELECT t_ns_utc, text FROM audit WHERE name = ? ORDER BY 1", (name,)
                )
            }
            for name in ("reconstructor.made", "reconstructor.applied")
        )
    finally:
        connection.close()
    found = []
    for name in made.keys() & applied.keys():
        before = [end for end in ends if end < made[name]]
        if before:
            found.append(
                (name, (made[name] - before[-1]) / 1e9, (applied[name] - before[-1]) / 1e9)
            )
    return sorted(found)


def main() -> int:
    """Print a line for each matrix."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.window_to_applied")
    parser.add_argument("data", type=Path, help="data folder of a service")
    for name, made_s, applied_s in waits(parser.parse_args().data.resolve()):
        sys.stdout.write(
            f"{name}: made {made_s:.2f} s after the window, applied {applied_s:.2f} s\n"
        )
    return 0


if __name__ == "__main__":
    sys.exit(main())

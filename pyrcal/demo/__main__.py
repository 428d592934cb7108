"""Run: ``pyrcal demo --seconds 120``; ``pyrcal demo --help`` says what else there is."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence

from pyrcal.arguments import with_negative_numbers
from pyrcal.demo.arguments import demo_parser
from service.program import imported_and_run


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the demo; return 0 if the main job was done, 1 if not, 2 if it makes no sense."""
    words = sys.argv[1:] if arguments is None else arguments
    options = demo_parser().parse_args(with_negative_numbers(words))

    def load() -> Callable[[], int]:
        from pyrcal.demo.run import run_demo

        return lambda: run_demo(options)

    return imported_and_run(load, own_process=arguments is None)


if __name__ == "__main__":
    sys.exit(main())

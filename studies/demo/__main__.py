"""Run: ``pyrcal demo --seconds 60``; ``pyrcal demo --help`` says what else there is."""

from __future__ import annotations

import signal
import sys
from collections.abc import Sequence

from service.commands.arguments import with_negative_numbers
from service.errors import PyrcalError, shown
from studies.demo.arguments import demo_parser


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the demo; return 0 if the main job was done, 1 if not, 2 if it makes no sense."""
    words = sys.argv[1:] if arguments is None else arguments
    options = demo_parser().parse_args(with_negative_numbers(words))
    if arguments is None:  # nothing has begun that an interrupt could cut in two
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    from studies.demo.run import run_demo

    if arguments is None:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        return run_demo(options)
    except PyrcalError as error:
        sys.stderr.write(f"pyrcal: {shown(str(error))}\n")
        return 2
    except KeyboardInterrupt:
        return 130


if __name__ == "__main__":
    sys.exit(main())

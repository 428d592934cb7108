"""What stands for ``pyrcal fit`` in these tests: its first word says what it does."""

import json
import sys
import time
from pathlib import Path


def telling(folder):
    """Say what lies in the folder of an upload, instead of fitting it."""
    request = json.loads((folder / "request.json").read_text())
    content = (folder / "upload").read_bytes()
    verdict = f"accepted: {len(content)} bytes of {request['asked']['dataset']}"
    (folder / "document.json").write_text(json.dumps({"verdict": verdict}))
    (folder / "figures.json").write_text("{}")


def at_a_stage(folder):
    (folder / "stage").write_text("orientation")
    time.sleep(60.0)


def sleeping(_folder):
    time.sleep(60.0)


def silent(_folder):
    pass


def refusing(_folder):
    sys.exit("a warning of a library\ntransposed")


if __name__ == "__main__":
    globals()[sys.argv[1]](Path(sys.argv[2]))

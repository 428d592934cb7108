"""The test vectors of docs/rtc, by plain msgpack and struct: nothing here knows the service.

``python -m tests.vectors`` writes the bytes that each readable file describes.
"""

import json
import re
import struct
from dataclasses import dataclass
from pathlib import Path

import msgpack

FOLDER = Path(__file__).parents[1] / "docs" / "rtc"
PAGE = FOLDER.parent / "rtc.md"


@dataclass(frozen=True)
class Vector:
    """One message: what its readable file says, and the bytes it describes by name of file."""

    name: str
    told: dict

    @property
    def kind(self):
        return self.told["kind"]

    @property
    def refused(self):
        return self.told.get("refused")

    @property
    def message(self):
        """The msgpack map, or the attachment of frames."""
        told = self.told["message"]
        return bytes.fromhex(told["raw"]) if "raw" in told else packed(told)

    @property
    def payload(self):
        """The raw rows of frames."""
        rows = floats(self.told["rows"])
        return rows[: len(rows) - self.told.get("cut", 0)]

    @property
    def parts(self):
        """The chunks of a matrix."""
        if "matrix" not in self.told:
            return []
        data, size = floats(self.told["matrix"]), self.told["message"]["chunk_bytes"]
        return [data[k : k + size] for k in range(0, len(data), size)]

    @property
    def files(self):
        """All its bytes by name of file."""
        files = {f"{self.name}.msgpack": self.message}
        if self.kind == "frames":
            files[f"{self.name}.bin"] = self.payload
        files |= {f"{self.name}-chunk-{k}.bin": part for k, part in enumerate(self.parts)}
        return files


def floats(rows):
    """Little-endian float32, row after row."""
    numbers = [float(number) for row in rows for number in row]
    return struct.pack(f"<{len(numbers)}f", *numbers)


def packed(told):
    """A msgpack map; JSON has no bytes, and no floats of 32 bits."""
    packer = msgpack.Packer()
    data = packer.pack_map_header(len(told))
    for key, value in told.items():
        data += packer.pack(key)
        if isinstance(value, dict) and "f4" in value:
            data += packer.pack(floats([value["f4"]]))
        elif isinstance(value, dict) and "float32" in value:
            data += b"\xca" + struct.pack(">f", value["float32"])
        else:
            data += packer.pack(value)
    return data


def anchors_of(page):
    """The anchors of a page's headings, as they are linked to."""
    heads = re.findall(r"^#+ (.+)$", page, flags=re.MULTILINE)
    return {re.sub(r"[^a-z0-9 -]", "", head.lower()).replace(" ", "-") for head in heads}


def vectors():
    """All of them, in the order of their names."""
    return [
        Vector(path.stem, json.loads(path.read_text(encoding="utf-8")))
        for path in sorted(FOLDER.glob("*.json"))
    ]


if __name__ == "__main__":
    for path in (*FOLDER.glob("*.msgpack"), *FOLDER.glob("*.bin")):
        path.unlink()
    for vector in vectors():
        for name, data in vector.files.items():
            (FOLDER / name).write_bytes(data)

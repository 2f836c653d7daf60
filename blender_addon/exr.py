# SPDX-License-Identifier: GPL-3.0-or-later
"""Images in the layout that the penumbra binary reads and writes: one part, scan lines, ZIP or none, 32-bit floats.

Blender's own loader gives no pixels for a file with several layers. Rows are bottom up here, as Blender has them.
"""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import numpy as np

_MAGIC = 20000630
_ROWS_OF_BLOCK = {0: 1, 2: 1, 3: 16}  # compression: none, ZIPS, ZIP


class ImageError(ValueError):
    """The file is not an image of this layout."""


def read(path: Path) -> tuple[dict[str, np.ndarray], dict[str, str]]:
    """Channels by name, each (height, width) with the bottom row first, and the header's text attributes."""
    data = Path(path).read_bytes()
    try:
        return _parse(memoryview(data), Path(path))
    except (struct.error, IndexError, ValueError, zlib.error) as error:
        raise ImageError(f"{path}: {error}") from error


def _text_until_nul(data: memoryview, at: int) -> tuple[str, int]:
    end = at
    while data[end] != 0:
        end += 1
    return bytes(data[at:end]).decode(), end + 1


def _parse(data: memoryview, path: Path) -> tuple[dict[str, np.ndarray], dict[str, str]]:
    magic, version = struct.unpack_from("<ii", data)
    # Bits 9, 11 and 12: tiles, deep data, several parts.
    if magic != _MAGIC or version & 0x1A00:
        raise ImageError(f"{path}: not an OpenEXR image of scan lines in one part")
    attributes: dict[str, memoryview] = {}
    at = 8
    while data[at] != 0:
        name, at = _text_until_nul(data, at)
        _, at = _text_until_nul(data, at)
        (size,) = struct.unpack_from("<i", data, at)
        attributes[name] = data[at + 4 : at + 4 + size]
        at += 4 + size
    at += 1
    names = []
    channels = attributes["channels"]
    cursor = 0
    while channels[cursor] != 0:
        name, cursor = _text_until_nul(channels, cursor)
        (pixel_type,) = struct.unpack_from("<i", channels, cursor)
        if pixel_type != 2:
            raise ImageError(f"{path}: channel {name} is not of 32-bit floats")
        names.append(name)
        cursor += 16
    compression = attributes["compression"][0]
    if compression not in _ROWS_OF_BLOCK:
        raise ImageError(f"{path}: compression {compression}; expected none or ZIP")
    left, top, right, bottom = struct.unpack("<4i", attributes["dataWindow"])
    width, height = right - left + 1, bottom - top + 1
    if not (0 < width <= 1 << 17 and 0 < height <= 1 << 17):
        raise ImageError(f"{path}: {width} x {height} pixels")
    rows = _ROWS_OF_BLOCK[compression]
    offsets = struct.unpack_from(f"<{-(-height // rows)}Q", data, at)
    pixels = np.empty((height, len(names), width), "<f4")
    for offset in offsets:
        y, size = struct.unpack_from("<ii", data, offset)
        first = y - top
        count = min(rows, height - first)
        block = data[offset + 8 : offset + 8 + size]
        expected = count * len(names) * width * 4
        raw = bytes(block) if size == expected else _unzip(block, expected)
        pixels[first : first + count] = np.frombuffer(raw, "<f4").reshape(count, len(names), width)
    texts = {name: bytes(value).decode(errors="replace") for name, value in attributes.items() if name.startswith("penumbra:")}
    return {name: np.ascontiguousarray(pixels[::-1, i]) for i, name in enumerate(names)}, texts


def _unzip(block: memoryview, expected: int) -> bytes:
    """Undoes OpenEXR's ZIP: deflate, a running sum of bytes, and two halves that hold the even and the odd bytes."""
    coded = np.frombuffer(zlib.decompress(block), np.uint8)
    if coded.size != expected:
        raise ValueError(f"a block of {coded.size} bytes; expected {expected}")
    # coded[i] = value[i] − value[i − 1] + 128, modulo 256.
    steps = coded.copy()
    steps[1:] -= 128
    halves = np.cumsum(steps, dtype=np.uint8)
    raw = np.empty_like(halves)
    middle = (expected + 1) // 2
    raw[0::2], raw[1::2] = halves[:middle], halves[middle:]
    return raw.tobytes()


def write(path: Path, channels: dict[str, np.ndarray]) -> None:
    """Writes channels of (height, width) with the bottom row first, without compression."""
    names = sorted(channels)
    height, width = channels[names[0]].shape
    channel_list = b"".join(name.encode() + b"\0" + struct.pack("<iiii", 2, 0, 1, 1) for name in names) + b"\0"
    window = struct.pack("<4i", 0, 0, width - 1, height - 1)
    attributes = [
        ("channels", "chlist", channel_list),
        ("compression", "compression", b"\0"),
        ("dataWindow", "box2i", window),
        ("displayWindow", "box2i", window),
        ("lineOrder", "lineOrder", b"\0"),
        ("pixelAspectRatio", "float", struct.pack("<f", 1.0)),
        ("screenWindowCenter", "v2f", struct.pack("<2f", 0.0, 0.0)),
        ("screenWindowWidth", "float", struct.pack("<f", 1.0)),
    ]
    # Bit 10: names of more than 31 bytes.
    long_names = any(len(name.encode()) > 31 for name in names)
    header = struct.pack("<ii", _MAGIC, 2 | (1 << 10 if long_names else 0))
    for name, kind, value in attributes:
        header += name.encode() + b"\0" + kind.encode() + b"\0" + struct.pack("<i", len(value)) + value
    header += b"\0"
    rows = np.stack([np.asarray(channels[name], "<f4")[::-1] for name in names], axis=1)
    row_bytes = len(names) * width * 4
    first = len(header) + 8 * height
    offsets = first + (8 + row_bytes) * np.arange(height, dtype="<u8")
    blocks = np.zeros(height, np.dtype([("y", "<i4"), ("size", "<i4"), ("row", "<f4", (len(names), width))]))
    blocks["y"], blocks["size"], blocks["row"] = np.arange(height), row_bytes, rows
    Path(path).write_bytes(header + offsets.tobytes() + blocks.tobytes())

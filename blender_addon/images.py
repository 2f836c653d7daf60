# SPDX-License-Identifier: GPL-3.0-or-later
"""Arrays as Blender's images, shown in Image Editors and in the corner of 3D views."""

from __future__ import annotations

import bpy
import numpy as np


def rgba(values: np.ndarray, alpha: np.ndarray | None = None) -> np.ndarray:
    """(height, width, 4) float32 of grey (height, width) or colours (height, width, 3)."""
    height, width = values.shape[:2]
    pixels = np.ones((height, width, 4), np.float32)
    pixels[..., :3] = values if values.ndim == 3 else values[..., None]
    if alpha is not None:
        pixels[..., 3] = alpha
    return pixels


# A property of our images: the name that they were asked for, which another image of the user's may have.
_TAG = "penumbra"


def _own(name: str) -> bpy.types.Image | None:
    return next((image for image in bpy.data.images if image.get(_TAG) == name), None)


def put(name: str, pixels: np.ndarray) -> bpy.types.Image:
    """Our float image of that name, with these pixels: (height, width, 4), bottom row first, linear."""
    height, width = pixels.shape[:2]
    image = _own(name)
    if image is not None and (image.source != "GENERATED" or not image.is_float):
        bpy.data.images.remove(image)
        image = None
    if image is None:
        image = bpy.data.images.new(name, width, height, alpha=True, float_buffer=True)
        image[_TAG] = name
    if tuple(image.size) != (width, height):
        image.scale(width, height)
    image.pixels.foreach_set(np.ascontiguousarray(pixels, np.float32).reshape(-1))
    image.update()
    return image


def put_png(name: str, png: bytes) -> bpy.types.Image:
    """Our image of that name, with a PNG's pixels, kept in the .blend."""
    image = _own(name)
    if image is not None:
        bpy.data.images.remove(image)
    image = bpy.data.images.new(name, 1, 1)
    image[_TAG] = name
    image.pack(data=png, data_len=len(png))
    image.source = "FILE"
    return image


def _areas(kind: str) -> list[bpy.types.Area]:
    windows = bpy.context.window_manager.windows if bpy.context.window_manager else ()
    return [area for window in windows for area in window.screen.areas if area.type == kind]


def show(name: str) -> None:
    """Puts an image into the Image Editors that show none of their own, or one of Penumbra's."""
    image = bpy.data.images.get(name)
    for area in _areas("IMAGE_EDITOR"):
        space = area.spaces.active
        if space.image is None or space.image.name.startswith("Penumbra"):
            space.image = image


def redraw() -> None:
    """Draws anew where previews and their progress are seen."""
    for kind in ("VIEW_3D", "IMAGE_EDITOR", "PROPERTIES"):
        for area in _areas(kind):
            area.tag_redraw()

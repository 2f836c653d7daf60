# SPDX-License-Identifier: GPL-3.0-or-later
"""The preview in the corner of 3D views, its figures beside it."""

from __future__ import annotations

import blf
import bpy
from gpu_extras.presets import draw_texture_2d

import gpu

from . import preview

# Of the view's width that the picture takes at most.
_WIDTH_FRACTION = 0.45
_MARGIN_PX = 12
_FONT = 0

_handle = None


def _set_font_size(points: float) -> None:
    if bpy.app.version >= (4, 0, 0):
        blf.size(_FONT, points)
    else:
        blf.size(_FONT, int(points), 72)


def _draw() -> None:
    current = preview.Preview.current
    context = bpy.context
    if current is None or current.scene_name != context.scene.name or not context.scene.penumbra.show_in_view:
        return
    scale = context.preferences.system.ui_scale
    margin = _MARGIN_PX * scale
    line_height = 16 * scale
    lines = current.caption if current.images else ([current.message] if current.message else [])
    # Right of the tools, which lie over the view.
    tools = next((region for region in context.area.regions if region.type == "TOOLS"), None)
    x = margin + (tools.width if tools is not None and tools.width > 1 else 0)
    y = margin
    _set_font_size(11 * scale)
    blf.enable(_FONT, blf.SHADOW)
    blf.shadow(_FONT, 3, 0.0, 0.0, 0.0, 0.9)
    for line in reversed(lines):
        blf.position(_FONT, x, y, 0)
        blf.color(_FONT, 1.0, 1.0, 1.0, 1.0)
        blf.draw(_FONT, line)
        y += line_height
    blf.disable(_FONT, blf.SHADOW)
    image = bpy.data.images.get(current.images[0]) if current.images else None
    if image is None or not image.has_data:
        return
    width = min(image.size[0], _WIDTH_FRACTION * context.region.width)
    height = width * image.size[1] / image.size[0]
    gpu.state.blend_set("NONE")
    draw_texture_2d(gpu.texture.from_image(image), (x, y + 0.25 * line_height), width, height, **_as_srgb())


def _as_srgb() -> dict[str, bool]:
    """A linear image in a view whose pixels are sRGB: Blender 5 converts on request, and before it images did so themselves."""
    return {"is_scene_linear_with_rec709_srgb_target": True} if bpy.app.version >= (5, 0, 0) else {}


def register() -> None:
    """Draws over 3D views from now on."""
    global _handle
    if not bpy.app.background:
        _handle = bpy.types.SpaceView3D.draw_handler_add(_draw, (), "WINDOW", "POST_PIXEL")


def unregister() -> None:
    """Draws no more."""
    global _handle
    if _handle is not None:
        bpy.types.SpaceView3D.draw_handler_remove(_handle, "WINDOW")
        _handle = None

# SPDX-License-Identifier: GPL-3.0-or-later
"""What of a material a Lambertian surface with cut-outs needs: base colour and alpha, as numbers or from image textures."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import bpy
import numpy as np

from . import glb

_DEFAULT_COLOR = (0.8, 0.8, 0.8)
# What Blender stores as it is in files that glTF takes as they are.
_MAGIC = {b"\x89PNG": "image/png", b"\xff\xd8\xff": "image/jpeg"}
# Images that glTF can't have as they are go through numpy, with 16 bytes a texel.
_MOST_TEXELS = 1 << 26
# Colour spaces of stored values that are linear and of sRGB's primaries, as versions of Blender name them.
_LINEAR_SPACES = {"Linear", "Linear Rec.709"}
# Shaders whose colour is that of a Lambertian surface, or stands for it.
_WITH_COLOR = {"BSDF_PRINCIPLED", "BSDF_DIFFUSE"}
_WRAPS = {"REPEAT": "REPEAT", "EXTEND": "CLAMP_TO_EDGE", "MIRROR": "MIRRORED_REPEAT"}


class _NotSupported(ValueError):
    """What a node does that is not carried over; the message completes "material 'name': "."""


def _source(socket: Any) -> Any:
    """The socket that feeds one, reroutes and muted nodes left out; none where nothing does."""
    while socket is not None and socket.is_linked and socket.links and not socket.links[0].is_muted:
        socket = socket.links[0].from_socket
        if socket.node.mute:
            # What it passes through.
            inner = (link.from_socket for link in socket.node.internal_links if link.to_socket == socket)
            socket = next(inner, None)
        elif socket.node.type == "REROUTE":
            socket = socket.node.inputs[0]
        else:
            return socket
    return None


def _has_nodes(material: bpy.types.Material) -> bool:
    # Always on from Blender 5 on, where asking is deprecated.
    return (bpy.app.version >= (5, 0, 0) or material.use_nodes) and material.node_tree is not None


def _surface(material: bpy.types.Material) -> tuple[Any, Any]:
    """The shader node that stands for a material of nodes, if one does, and the socket of its alpha, if it has one."""
    tree = material.node_tree
    output = tree.get_output_node("CYCLES") or tree.get_output_node("ALL")
    shader = _node(output.inputs["Surface"]) if output else None
    if shader is not None and shader.type == "MIX_SHADER":
        # As cut-outs were made before the Alpha of Principled BSDF: the factor tells what is not transparent.
        first, second = _node(shader.inputs[1]), _node(shader.inputs[2])
        if first is not None and second is not None and first.type == "BSDF_TRANSPARENT":
            return second, shader.inputs[0]
    return shader, shader.inputs.get("Alpha") if shader is not None else None


def _is_invisible(material: bpy.types.Material, shader: Any) -> bool:
    """Whether light passes through its surface as if there were none: it is transparent, or bounds a volume alone."""
    tree = material.node_tree
    output = tree.get_output_node("CYCLES") or tree.get_output_node("ALL")
    if shader is None:
        return output is not None and _node(output.inputs["Volume"]) is not None
    return (
        shader.type == "BSDF_TRANSPARENT"
        and _source(shader.inputs["Color"]) is None
        and min(shader.inputs["Color"].default_value[:3]) > 0.5
    )


def _node(socket: Any) -> Any:
    source = _source(socket)
    return source.node if source is not None else None


def _placement(node: Any) -> tuple[str, tuple[tuple[float, float], float, tuple[float, float]] | None]:
    """Name of the UV map of an image texture ("": the one that renders), and how it is moved, turned and scaled."""
    moved = None
    at = _node(node.inputs["Vector"])
    if at is not None and at.type == "MAPPING":
        sockets = [at.inputs[name] for name in ("Location", "Rotation", "Scale")]
        if at.vector_type != "POINT" or any(socket.is_linked for socket in sockets):
            raise _NotSupported("its texture's mapping is not of type Point, or comes from nodes")
        location, rotation, scale = (tuple(socket.default_value) for socket in sockets)
        if rotation[0] != 0.0 or rotation[1] != 0.0:
            raise _NotSupported("its texture is turned out of the plane")
        moved = ((location[0], location[1]), rotation[2], (scale[0], scale[1]))
        at = _node(at.inputs["Vector"])
        if at is None:
            raise _NotSupported("its texture's coordinates are not a UV map")
    if at is None:
        return "", moved
    if at.type == "UVMAP" and not at.from_instancer:
        return at.uv_map, moved
    if at.type == "TEX_COORD" and not at.from_instancer and at.object is None:
        source = _source(node.inputs["Vector"])
        if source.node.type == "MAPPING":
            source = _source(source.node.inputs["Vector"])
        if source.name == "UV":
            return "", moved
    raise _NotSupported("its texture's coordinates are not a UV map")


def _check_image(node: Any) -> None:
    image = node.image
    if image is None:
        raise _NotSupported("its texture has no image")
    if image.source not in {"FILE", "GENERATED"}:
        raise _NotSupported(f"image {image.name!r} is {image.source.lower()}, which is not supported")
    if node.projection != "FLAT":
        raise _NotSupported("its texture is not projected flat")
    if node.extension not in _WRAPS:
        raise _NotSupported(f"its texture's extension {node.extension.lower()} is not supported")
    if not image.size[0] or not image.size[1]:
        raise _NotSupported(f"image {image.name!r} can't be read")


def _file(image: bpy.types.Image) -> bytes | Path | None:
    """The image file itself, or where it is, if glTF may have it as it is."""
    if image.source != "FILE" or image.is_dirty or image.is_float or image.colorspace_settings.name != "sRGB":
        return None
    if image.packed_file is not None:
        data = bytes(image.packed_file.data)
        return data if any(data.startswith(magic) for magic in _MAGIC) else None
    path = Path(bpy.path.abspath(image.filepath, library=image.library))
    try:
        with path.open("rb") as file:
            start = file.read(4)
    except OSError:
        return None
    return path if any(start.startswith(magic) for magic in _MAGIC) else None


def _pixels(image: bpy.types.Image) -> np.ndarray:
    """(height, width, 4), bottom row first, as stored."""
    width, height = image.size
    if width * height > _MOST_TEXELS:
        raise _NotSupported(f"image {image.name!r} is too large unless it is saved as PNG or JPEG, in sRGB")
    values = np.empty(width * height * 4, np.float32)
    image.pixels.foreach_get(values)
    return values.reshape(height, width, 4)


def _is_linear(image: bpy.types.Image) -> bool:
    return image.is_float or image.colorspace_settings.name != "sRGB"


def _linear(values: np.ndarray) -> np.ndarray:
    return np.where(values <= 0.04045, values / 12.92, ((np.maximum(values, 0.0) + 0.055) / 1.055) ** 2.4)


def _srgb(values: np.ndarray) -> np.ndarray:
    clipped = np.clip(values, 0.0, 1.0)
    return np.where(clipped <= 0.0031308, 12.92 * clipped, 1.055 * clipped ** (1.0 / 2.4) - 0.055)


def _opacity(socket: Any) -> np.ndarray:
    """What an image texture's output is as a number, (height, width)."""
    image = socket.node.image
    pixels = _pixels(image)
    if socket.name == "Alpha":
        return pixels[..., 3]
    colors = pixels[..., :3] if _is_linear(image) else _linear(pixels[..., :3])
    return colors @ np.array([0.2126, 0.7152, 0.0722], np.float32)


def _cutoff(socket: Any) -> tuple[Any, float]:
    """The output of the image texture that an alpha comes from, and the value below which there is no surface."""
    source, cutoff = _source(socket), 0.5
    if source is not None and source.node.type == "MATH" and source.node.operation in {"GREATER_THAN", "ROUND"}:
        math = source.node
        if math.operation == "GREATER_THAN":
            if _source(math.inputs[1]) is not None:
                raise _NotSupported("the threshold of its alpha comes from nodes")
            cutoff = math.inputs[1].default_value
        source = _source(math.inputs[0])
    if source is None or source.node.type != "TEX_IMAGE":
        raise _NotSupported("its alpha comes from nodes")
    _check_image(source.node)
    if source.name == "Alpha" and source.node.image.alpha_mode == "NONE":
        raise _NotSupported(f"image {source.node.image.name!r} has its alpha turned off")
    return source, cutoff


class Reader:
    """Materials as they are read; what isn't carried over is told once in `warnings`."""

    def __init__(self, warnings: list[str]) -> None:
        self.warnings = warnings
        self.images: dict[tuple, glb.Image] = {}

    def material(self, material: bpy.types.Material | None) -> glb.Material:
        """Base colour and cut-out of a material; of none, the one that Blender shows instead."""
        if material is None:
            return glb.Material("default", _DEFAULT_COLOR)
        made = glb.Material(material.name, tuple(material.diffuse_color)[:3])
        if not _has_nodes(material):
            return made
        shader, alpha = _surface(material)
        if _is_invisible(material, shader):
            made.cutoff, made.alpha = 0.5, 0.0
            return made
        inputs = shader.inputs if shader is not None and shader.type in _WITH_COLOR else ()
        color = next((s for s in inputs if s.name in {"Base Color", "Color"} and s.type == "RGBA"), None)
        if color is None:
            self._warn(material, "no base colour is found; its viewport colour is used")
        elif _source(color) is None:
            made.color = tuple(color.default_value)[:3]
        image_output = None
        if color is not None and _source(color) is not None:
            try:
                image_output = self._color_image(color)
            except _NotSupported as reason:
                self._warn(material, f"{reason}; its viewport colour is used")
        own_alpha = shader.inputs.get("Alpha") if shader is not None else None
        if own_alpha not in {None, alpha} and (_source(own_alpha) is not None or own_alpha.default_value < 1.0):
            self._warn(material, "it is mixed with a Transparent BSDF; its own alpha is left out")
        alpha_output, cutoff = None, 0.5
        if alpha is not None and _source(alpha) is not None:
            try:
                alpha_output, cutoff = _cutoff(alpha)
            except _NotSupported as reason:
                self._warn(material, f"{reason}; it is taken as opaque")
        elif alpha is not None and alpha.default_value < 1.0:
            if alpha.default_value > 0.0:
                self._warn(material, "transparency is not supported; it is taken as opaque")
            else:
                made.cutoff, made.alpha = 0.5, 0.0
        plain = dataclasses.replace(made)
        try:
            self._add_texture(made, image_output, alpha_output, cutoff)
        except _NotSupported as reason:
            self._warn(material, f"{reason}; its texture is left out")
            color = plain.color if image_output is None else tuple(material.diffuse_color)[:3]
            made = dataclasses.replace(plain, color=color)
        return made

    def _warn(self, material: bpy.types.Material, message: str) -> None:
        text = f"material {material.name!r}: {message}"
        if text not in self.warnings:
            self.warnings.append(text)

    def _color_image(self, socket: Any) -> Any:
        source = _source(socket)
        if source is None or source.node.type != "TEX_IMAGE" or source.name != "Color":
            raise _NotSupported("its base colour comes from nodes")
        _check_image(source.node)
        image = source.node.image
        space = image.colorspace_settings
        if not (image.is_float or space.is_data or space.name in {"sRGB", *_LINEAR_SPACES}):
            raise _NotSupported(f"image {image.name!r} is in {space.name}; only sRGB and linear Rec.709 are read")
        return source

    def _add_texture(self, made: glb.Material, color: Any, alpha: Any, cutoff: float) -> None:
        first = color or alpha
        if first is None:
            return
        node = first.node
        placement = _placement(node)
        if color is not None and alpha is not None and alpha.node != color.node:
            other = alpha.node
            same_reading = (other.extension, other.interpolation) == (node.extension, node.interpolation)
            if _placement(other) != placement or not same_reading or tuple(other.image.size) != tuple(node.image.size):
                raise _NotSupported("colour and alpha come from textures of different sizes or places")
        made.uv_map, made.moved = placement
        made.wrap, made.is_smooth = _WRAPS[node.extension], node.interpolation != "Closest"
        if color is not None:
            made.color = (1.0, 1.0, 1.0)
        if alpha is not None:
            made.cutoff = cutoff
        made.image = self._image(color, alpha)

    def _image(self, color: Any, alpha: Any) -> glb.Image:
        is_one_file = color is not None and (alpha is None or (alpha.node.image == color.node.image and alpha.name == "Alpha"))
        key = tuple((output.node.image.name_full, output.name) if output else None for output in (color, alpha))
        if key not in self.images:
            file = _file(color.node.image) if is_one_file else None
            self.images[key] = glb.Image(file=file) if file is not None else glb.Image(rgba=self._rgba(color, alpha))
        return self.images[key]

    @staticmethod
    def _rgba(color: Any, alpha: Any) -> np.ndarray:
        width, height = (color or alpha).node.image.size
        rgba = np.full((height, width, 4), 255, np.uint8)
        if color is not None:
            image = color.node.image
            stored = _pixels(image)[..., :3]
            rgba[..., :3] = np.rint(255.0 * (_srgb(stored) if _is_linear(image) else np.clip(stored, 0.0, 1.0)))
        if alpha is not None:
            rgba[..., 3] = np.rint(255.0 * np.clip(_opacity(alpha), 0.0, 1.0))
        # PNG and glTF begin at the top.
        return np.ascontiguousarray(rgba[::-1])

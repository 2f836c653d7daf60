# SPDX-License-Identifier: GPL-3.0-or-later
"""A scene as arrays, and the binary glTF file that the penumbra binary reads. Nothing here imports bpy.

Everything is in Blender's axes (Z up, metres); the file's (Y up) differ by a rotation in front of the nodes' transforms, so
that vertices are written as they are.
"""

from __future__ import annotations

import json
import math
import struct
import zlib
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from . import lights

# World of the file from world of Blender: X stays, up is Y, and −Z is Blender's +Y.
FILE_FROM_BLENDER = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])

_FLOAT, _UINT = 5126, 5125
_LINEAR, _NEAREST = 9729, 9728
_WRAPS = {"REPEAT": 10497, "CLAMP_TO_EDGE": 33071, "MIRRORED_REPEAT": 33648}
_ARRAY_BUFFER, _ELEMENT_ARRAY_BUFFER = 34962, 34963
# More copies of a mesh than this go into one node (EXT_mesh_gpu_instancing): JSON for each would cost more than the geometry.
_COPIES_AS_NODES = 64


class SceneTooLarge(ValueError):
    """It doesn't fit the format; the message is one line for the user."""


@dataclass
class Mesh:
    """Triangles by vertex index, with the material of each run of triangles."""

    positions: np.ndarray  # (vertices, 3) float32
    triangles: np.ndarray  # (triangles, 3) uint32
    normals: np.ndarray | None = None  # (vertices, 3) float32; none: flat
    uvs: dict[str, np.ndarray] = field(default_factory=dict)  # by name of the UV map: (vertices, 2) float32
    parts: list[tuple[int, int, int]] = field(default_factory=list)  # first triangle, count, material


@dataclass(eq=False)
class Image:
    """A texture's image: a PNG or JPEG file, or where it is, or texels, (height, width, 4) uint8 with the top row first."""

    file: bytes | Path | None = None
    rgba: np.ndarray | None = None


@dataclass
class Material:
    """A Lambertian surface: linear colour, times that of its image; cut out where alpha is below the cut-off."""

    name: str
    color: tuple[float, float, float]
    alpha: float = 1.0
    cutoff: float | None = None  # none: opaque
    image: Image | None = None
    uv_map: str = ""  # where the image is; "": the one that renders
    moved: tuple[tuple[float, float], float, tuple[float, float]] | None = (
        None  # Blender's location, angle, scale of coordinates
    )
    wrap: str = "REPEAT"
    is_smooth: bool = True


@dataclass
class Copy:
    """A mesh placed in the world. `name` is what light linking refers to."""

    name: str
    mesh: int
    world_from_mesh: np.ndarray  # 4x4


@dataclass
class Light:
    """A light: its `PENUMBRA_lights` block and its rigid placement."""

    name: str
    block: dict[str, Any]
    world_from_light: np.ndarray  # 4x4, rotation and translation only


@dataclass
class Camera:
    """A camera that looks along local −Z: `fov_y` in radians, or half the height of a parallel view in metres."""

    world_from_camera: np.ndarray  # 4x4, rotation and translation only
    near: float
    far: float
    fov_y: float | None = None
    half_height: float | None = None


@dataclass
class Scene:
    """What is rendered."""

    meshes: list[Mesh] = field(default_factory=list)
    copies: list[Copy] = field(default_factory=list)
    lights: list[Light] = field(default_factory=list)
    cameras: list[Camera] = field(default_factory=list)
    materials: list[Material] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)

    @property
    def triangle_count(self) -> int:
        """Triangles of all copies."""
        return sum(len(self.meshes[copy.mesh].triangles) for copy in self.copies)


def rigid(matrix: np.ndarray) -> np.ndarray:
    """Rotation and translation of a matrix, its columns made unit and right-angled; −Z (where it looks) is kept."""
    z = matrix[:3, 2] / np.linalg.norm(matrix[:3, 2])
    y = matrix[:3, 1] - (matrix[:3, 1] @ z) * z
    y /= np.linalg.norm(y)
    result = np.eye(4)
    result[:3, 0], result[:3, 1], result[:3, 2], result[:3, 3] = np.cross(y, z), y, z, matrix[:3, 3]
    return result


class _Buffer:
    """The file's one buffer: arrays in a row, each at a multiple of four bytes."""

    def __init__(self) -> None:
        self.arrays: list[np.ndarray] = []
        self.views: list[dict[str, Any]] = []
        self.accessors: list[dict[str, Any]] = []
        self.length = 0

    def add(self, array: np.ndarray, *, kind: str, target: int | None, bounds: bool = False) -> int:
        """Index of the accessor of a new array."""
        array = np.ascontiguousarray(array)
        view = {"buffer": 0, "byteOffset": self.length, "byteLength": array.nbytes}
        if target is not None:
            view["target"] = target
        accessor = {
            "bufferView": len(self.views),
            "componentType": _FLOAT if array.dtype == np.float32 else _UINT,
            "count": array.size if kind == "SCALAR" else len(array),
            "type": kind,
        }
        if bounds:
            # In double precision JSON says exactly what the floats are.
            accessor["min"] = [float(array[:, axis].min()) for axis in range(array.shape[1])]
            accessor["max"] = [float(array[:, axis].max()) for axis in range(array.shape[1])]
        self.arrays.append(array)
        self.views.append(view)
        self.accessors.append(accessor)
        self.length += array.nbytes
        return len(self.accessors) - 1

    def add_bytes(self, data: bytes) -> int:
        """Index of the view of a file's bytes."""
        padded = np.frombuffer(data + b"\0" * (-len(data) % 4), np.uint8)
        self.views.append({"buffer": 0, "byteOffset": self.length, "byteLength": len(data)})
        self.arrays.append(padded)
        self.length += padded.nbytes
        return len(self.views) - 1


def _matrix(world_from_local: np.ndarray) -> list[float]:
    """glTF's column-major matrix in the file's axes."""
    return (FILE_FROM_BLENDER @ world_from_local).T.ravel().tolist()


def _decomposed(matrices: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
    """Translations, rotations (x, y, z, w) and scales of 4x4 matrices; none where one of them shears or mirrors."""
    linear = matrices[:, :3, :3]
    scales = np.linalg.norm(linear, axis=1)
    if not (scales > 0.0).all() or (np.linalg.det(linear) <= 0.0).any():
        return None
    rotations = linear / scales[:, None, :]
    # Blender's matrices are of 32-bit floats: right angles hold to a few of their roundings.
    if np.abs(rotations.transpose(0, 2, 1) @ rotations - np.eye(3)).max() > 8 * np.finfo(np.float32).eps:
        return None
    # Shepperd 1978: through the largest of the four components, which loses no digits.
    m = rotations
    diagonal = np.stack([m[:, 0, 0], m[:, 1, 1], m[:, 2, 2]], axis=1)
    trace = diagonal.sum(axis=1)
    squares = np.concatenate([1 + 2 * diagonal - trace[:, None], (1 + trace)[:, None]], axis=1)
    x, y, z = m[:, 2, 1] - m[:, 1, 2], m[:, 0, 2] - m[:, 2, 0], m[:, 1, 0] - m[:, 0, 1]
    xy, yz, zx = m[:, 0, 1] + m[:, 1, 0], m[:, 1, 2] + m[:, 2, 1], m[:, 2, 0] + m[:, 0, 2]
    products = np.stack(
        [
            np.stack([squares[:, 0], xy, zx, x], axis=1),
            np.stack([xy, squares[:, 1], yz, y], axis=1),
            np.stack([zx, yz, squares[:, 2], z], axis=1),
            np.stack([x, y, z, squares[:, 3]], axis=1),
        ],
        axis=1,
    )
    quaternions = products[np.arange(len(m)), squares.argmax(axis=1)]
    quaternions /= np.linalg.norm(quaternions, axis=1, keepdims=True)
    return matrices[:, :3, 3], quaternions, scales


def _copy_nodes(scene: Scene, buffer: _Buffer, extensions: set[str]) -> list[dict[str, Any]]:
    """A node for each copy, or one for many copies of a mesh under one name."""
    groups: dict[tuple[str, int], list[Copy]] = {}
    for copy in scene.copies:
        groups.setdefault((copy.name, copy.mesh), []).append(copy)
    nodes = []
    for (name, mesh), copies in groups.items():
        parts = None
        if len(copies) > _COPIES_AS_NODES:
            parts = _decomposed(FILE_FROM_BLENDER @ np.stack([copy.world_from_mesh for copy in copies]))
        if parts is None:
            nodes += [{"name": name, "mesh": mesh, "matrix": _matrix(copy.world_from_mesh)} for copy in copies]
            continue
        attributes = {
            attribute: buffer.add(array.astype(np.float32), kind=kind, target=None)
            for (attribute, kind), array in zip((("TRANSLATION", "VEC3"), ("ROTATION", "VEC4"), ("SCALE", "VEC3")), parts)
        }
        extensions.add("EXT_mesh_gpu_instancing")
        nodes.append({"name": name, "mesh": mesh, "extensions": {"EXT_mesh_gpu_instancing": {"attributes": attributes}}})
    return nodes


def _camera(camera: Camera, aspect: float) -> dict[str, Any]:
    if camera.fov_y is not None:
        lens = {"yfov": camera.fov_y, "aspectRatio": aspect, "znear": camera.near, "zfar": camera.far}
        return {"type": "perspective", "perspective": lens}
    lens = {"ymag": camera.half_height, "xmag": camera.half_height * aspect, "znear": camera.near, "zfar": camera.far}
    return {"type": "orthographic", "orthographic": lens}


def _png(rgba: np.ndarray) -> bytes:
    """Texels as a PNG file."""
    height, width, _ = rgba.shape
    # Each row begins with its filter: none.
    rows = np.zeros((height, 1 + 4 * width), np.uint8)
    rows[:, 1:] = rgba.reshape(height, -1)

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = struct.pack(">IIBBBBB", width, height, 8, 6, 0, 0, 0)
    pixels = zlib.compress(rows.tobytes(), 1)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", pixels) + chunk(b"IEND", b"")


class _Materials:
    """Materials as the file has them, with each image once."""

    def __init__(self, buffer: _Buffer, extensions: set[str]) -> None:
        self.buffer = buffer
        self.extensions = extensions
        self.images: list[dict[str, Any]] = []
        self.samplers: list[dict[str, Any]] = []
        self.textures: list[dict[str, Any]] = []
        self.image_of: dict[int, int] = {}

    def add(self, material: Material) -> dict[str, Any]:
        """The file's material."""
        pbr = {"baseColorFactor": [*material.color, material.alpha], "metallicFactor": 0.0}
        made: dict[str, Any] = {"name": material.name, "pbrMetallicRoughness": pbr}
        if material.cutoff is not None:
            made |= {"alphaMode": "MASK", "alphaCutoff": material.cutoff}
        if material.image is not None:
            pbr["baseColorTexture"] = self._texture(material)
        return made

    def _texture(self, material: Material) -> dict[str, Any]:
        wrap, closest = _WRAPS[material.wrap], _LINEAR if material.is_smooth else _NEAREST
        sampler = {"magFilter": closest, "minFilter": closest, "wrapS": wrap, "wrapT": wrap}
        texture = {"sampler": _index(self.samplers, sampler), "source": self._image(material.image)}
        info: dict[str, Any] = {"index": _index(self.textures, texture)}
        if material.moved is not None:
            (x, y), angle, (scale_x, scale_y) = material.moved
            # Blender's v points up, glTF's down, with 1 - v in its place before and after.
            offset = [x - math.sin(angle) * scale_y, 1.0 - y - math.cos(angle) * scale_y]
            info["extensions"] = {
                "KHR_texture_transform": {"offset": offset, "rotation": angle, "scale": [scale_x, scale_y]},
            }
            self.extensions.add("KHR_texture_transform")
        return info

    def _image(self, image: Image) -> int:
        if id(image) not in self.image_of:
            data = _png(image.rgba) if image.rgba is not None else image.file
            data = data.read_bytes() if isinstance(data, Path) else data
            kind = "image/png" if data.startswith(b"\x89PNG") else "image/jpeg"
            self.image_of[id(image)] = len(self.images)
            self.images.append({"bufferView": self.buffer.add_bytes(data), "mimeType": kind})
        return self.image_of[id(image)]


def _index(entries: list[dict[str, Any]], entry: dict[str, Any]) -> int:
    """Where an entry is in a list, to which it is added where it isn't."""
    if entry not in entries:
        entries.append(entry)
    return entries.index(entry)


def write(path: Path, scene: Scene, *, aspect: float) -> None:
    """Writes the scene as a .glb. `aspect`: width over height of the image."""
    buffer = _Buffer()
    extensions: set[str] = set()
    meshes = []
    for mesh in scene.meshes:
        attributes = {"POSITION": buffer.add(mesh.positions, kind="VEC3", target=_ARRAY_BUFFER, bounds=True)}
        if mesh.normals is not None:
            attributes["NORMAL"] = buffer.add(mesh.normals, kind="VEC3", target=_ARRAY_BUFFER)
        coordinates = {name: buffer.add(uv, kind="VEC2", target=_ARRAY_BUFFER) for name, uv in mesh.uvs.items()}
        primitives = []
        for first, count, material in mesh.parts:
            indices = mesh.triangles[first : first + count].reshape(-1)
            accessor = buffer.add(indices, kind="SCALAR", target=_ELEMENT_ARRAY_BUFFER)
            own = attributes
            if scene.materials[material].image is not None:
                own = attributes | {"TEXCOORD_0": coordinates[scene.materials[material].uv_map]}
            primitives.append({"attributes": own, "indices": accessor, "material": material})
        meshes.append({"primitives": primitives})
    materials = _Materials(buffer, extensions)
    made_materials = [materials.add(material) for material in scene.materials]
    nodes = _copy_nodes(scene, buffer, extensions)
    area_lights = []
    for light in scene.lights:
        node: dict[str, Any] = {"name": light.name, "matrix": _matrix(light.world_from_light)}
        node["extensions"] = {"PENUMBRA_lights": light.block}
        extensions.add("PENUMBRA_lights")
        area = lights.area_extension(light.block, name=light.name)
        if area is not None:
            node["extensions"]["EXT_lights_area"] = {"light": len(area_lights)}
            area_lights.append(area)
            extensions.add("EXT_lights_area")
        nodes.append(node)
    for i, camera in enumerate(scene.cameras):
        nodes.append({"name": f"camera {i}", "camera": i, "matrix": _matrix(camera.world_from_camera)})
    document: dict[str, Any] = {
        "asset": {"version": "2.0", "generator": "Penumbra add-on"},
        "scene": 0,
        "scenes": [{"nodes": list(range(len(nodes)))}],
        "nodes": nodes,
        "meshes": meshes,
        "materials": made_materials,
        "textures": materials.textures,
        "samplers": materials.samplers,
        "images": materials.images,
        "cameras": [_camera(camera, aspect) for camera in scene.cameras],
        "accessors": buffer.accessors,
        "bufferViews": buffer.views,
        "buffers": [{"byteLength": buffer.length}] if buffer.length else [],
    }
    if area_lights:
        document["extensions"] = {"EXT_lights_area": {"lights": area_lights}}
    if extensions:
        document["extensionsUsed"] = sorted(extensions)
    document = {key: value for key, value in document.items() if value != []}
    text = json.dumps(document, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    total = 12 + 8 + len(text) + 8 + buffer.length
    if total >= 1 << 32:
        raise SceneTooLarge(f"the scene takes {total / 1e9:.1f} GB; a .glb holds 4.3: hide what casts no visible shadow")
    with open(path, "wb") as file:
        file.write(struct.pack("<4sII", b"glTF", 2, total))
        file.write(struct.pack("<I4s", len(text), b"JSON") + text)
        file.write(struct.pack("<I4s", buffer.length, b"BIN\0"))
        for array in buffer.arrays:
            file.write(memoryview(array).cast("B"))

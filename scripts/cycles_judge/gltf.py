"""glTF files: reading what Blender's importer drops (area lights), and writing GLB scenes."""

import base64
import binascii
import json
import struct
import urllib.parse
from pathlib import Path

import numpy as np

from . import Fault
from .lights import LUMENS_PER_WATT, Block

FLOAT = 5126
UNSIGNED_INT = 5125


class Document:
    """A glTF document with one binary buffer, to be read from a file or built up."""

    def __init__(self) -> None:
        self.json: dict = {"asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": []}], "nodes": []}
        self.binary = bytearray()

    @classmethod
    def read(cls, path: Path) -> "Document":
        """Reads a .gltf or .glb file; all its buffers become one."""
        document = cls()
        try:
            data = path.read_bytes()
            binary = b""
            if data[:4] == b"glTF":
                text, binary = _glb_chunks(data)
            else:
                text = data
            document.json = json.loads(text)
            # Where each of the file's buffers begins in ours.
            starts = []
            for buffer in document.json.get("buffers", []):
                document._align()
                starts.append(len(document.binary))
                document.binary += _buffer(path, buffer, binary)
            for view in document.json.get("bufferViews", []):
                view["byteOffset"] = starts[view["buffer"]] + view.get("byteOffset", 0)
                view["buffer"] = 0
            document.json.pop("buffers", None)
        except (OSError, binascii.Error) as error:
            raise Fault(f"{path}: {error}") from error
        except (KeyError, IndexError, TypeError, AttributeError, ValueError, struct.error) as error:
            raise Fault(f"{path}: is not a glTF file that can be read: {type(error).__name__} {error}") from error
        return document

    def write(self, path: Path) -> None:
        """Writes a GLB file."""
        self._align()
        document = dict(self.json)
        if self.binary:
            document["buffers"] = [{"byteLength": len(self.binary)}]
        text = json.dumps(document, separators=(",", ":")).encode()
        text += b" " * (-len(text) % 4)
        chunks = struct.pack("<II", len(text), 0x4E4F534A) + text
        if self.binary:
            chunks += struct.pack("<II", len(self.binary), 0x004E4942) + bytes(self.binary)
        path.write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks)

    def mesh(
        self,
        name: str,
        positions: np.ndarray,
        triangles: np.ndarray | None = None,
        normals: np.ndarray | None = None,
        matrix: np.ndarray | None = None,
    ) -> None:
        """Adds a mesh on a node of its own; without triangles every three positions are one, without normals it is flat."""
        attributes = {"POSITION": self._accessor(np.asarray(positions, "<f4"), "VEC3")}
        if normals is not None:
            attributes["NORMAL"] = self._accessor(np.asarray(normals, "<f4"), "VEC3")
        primitive: dict = {"attributes": attributes}
        if triangles is not None:
            primitive["indices"] = self._accessor(np.asarray(triangles, "<u4").reshape(-1), "SCALAR")
        meshes = self.json.setdefault("meshes", [])
        meshes.append({"name": name, "primitives": [primitive]})
        self.node(name, np.eye(4) if matrix is None else matrix, mesh=len(meshes) - 1)

    def camera(self, name: str, world_from_camera: np.ndarray, fov_y: float) -> None:
        """Adds a perspective camera; `fov_y` in radians."""
        cameras = self.json.setdefault("cameras", [])
        cameras.append({"name": name, "type": "perspective", "perspective": {"yfov": fov_y, "znear": 1e-3}})
        self.node(name, world_from_camera, camera=len(cameras) - 1)

    def orthographic_camera(self, name: str, world_from_camera: np.ndarray, half_height: float, aspect: float) -> None:
        """Adds a parallel camera that shows `half_height` metres above and below its axis; `aspect` is width over height."""
        cameras = self.json.setdefault("cameras", [])
        view = {"xmag": half_height * aspect, "ymag": half_height, "znear": 0.0, "zfar": 1e6}
        cameras.append({"name": name, "type": "orthographic", "orthographic": view})
        self.node(name, world_from_camera, camera=len(cameras) - 1)

    def light(self, name: str, world_from_light: np.ndarray, block: Block) -> None:
        """Adds a light as Penumbra's own block."""
        used = self.json.setdefault("extensionsUsed", [])
        if "PENUMBRA_lights" not in used:
            used.append("PENUMBRA_lights")
        self.node(name, world_from_light, extensions={"PENUMBRA_lights": {"version": 1} | block})

    def node(self, name: str, matrix: np.ndarray, **members: object) -> None:
        """Adds a node at the root of the scene."""
        self.json["nodes"].append(
            {"name": name, "matrix": [float(value) for value in np.asarray(matrix).T.reshape(-1)]} | members
        )
        self.json["scenes"][self.json.get("scene", 0)].setdefault("nodes", []).append(len(self.json["nodes"]) - 1)

    def shown(self) -> list[tuple[dict, np.ndarray]]:
        """The nodes of the scene, each with its world_from_node, in the file's order."""
        nodes = self.json.get("nodes", [])
        scenes = self.json.get("scenes")
        roots = scenes[self.json.get("scene", 0)].get("nodes", []) if scenes else range(len(nodes))
        world: dict[int, np.ndarray] = {}
        stack = [(index, np.eye(4)) for index in roots]
        while stack:
            index, parent = stack.pop()
            if index in world:
                raise Fault(f"nodes[{index}] has two parents")
            world[index] = parent @ _local(nodes[index])
            stack += [(child, world[index]) for child in nodes[index].get("children", [])]
        return [(nodes[index], world[index]) for index in sorted(world)]

    def lights(self) -> list[tuple[str, np.ndarray, Block]]:
        """The lights: name, world_from_light (rigid) and Penumbra's block. Duplicate names get #2, #3, …"""
        extensions = self.json.get("extensions", {})
        area = extensions.get("EXT_lights_area", {}).get("lights", [])
        punctual = extensions.get("KHR_lights_punctual", {}).get("lights", [])
        found = []
        for index, (node, world_from_node) in enumerate(self.shown()):
            own = node.get("extensions", {})
            ext = area[own["EXT_lights_area"]["light"]] if "EXT_lights_area" in own else None
            khr = punctual[own["KHR_lights_punctual"]["light"]] if "KHR_lights_punctual" in own else None
            if "PENUMBRA_lights" in own:
                block = own["PENUMBRA_lights"]
            elif ext is not None:
                block = _area_block(ext, max(np.linalg.norm(world_from_node[:3, :3], axis=0)))
            elif khr is not None:
                block = _punctual_block(khr, node.get("extras"))
            else:
                continue
            named = [(light or {}).get("name") for light in (ext, khr)]
            name = next((name for name in named if name), None) or node.get("name") or f"node{index}"
            found.append((name, rigid(world_from_node), block))
        names: set[str] = set()
        return [(_unique(name, names), matrix, block) for name, matrix, block in found]

    def cameras(self) -> list[tuple[str, np.ndarray, dict]]:
        """The cameras: name, world_from_camera (rigid) and glTF's camera."""
        found = []
        for node, world_from_node in self.shown():
            if "camera" in node:
                camera = self.json["cameras"][node["camera"]]
                found.append((camera.get("name") or node.get("name") or "camera", rigid(world_from_node), camera))
        return found

    def drop_appearance(self) -> None:
        """Drops materials, textures and the vertex attributes that only they need."""
        for member in ("materials", "textures", "images", "samplers"):
            self.json.pop(member, None)
        for mesh in self.json.get("meshes", []):
            for primitive in mesh["primitives"]:
                primitive.pop("material", None)
                kept = {name: at for name, at in primitive["attributes"].items() if name in ("POSITION", "NORMAL")}
                primitive["attributes"] = kept

    def _align(self) -> None:
        self.binary += b"\0" * (-len(self.binary) % 4)

    def _accessor(self, array: np.ndarray, kind: str) -> int:
        self._align()
        views = self.json.setdefault("bufferViews", [])
        views.append({"buffer": 0, "byteOffset": len(self.binary), "byteLength": array.nbytes})
        self.binary += array.tobytes()
        accessor = {
            "bufferView": len(views) - 1,
            "componentType": FLOAT if array.dtype.kind == "f" else UNSIGNED_INT,
            "count": len(array),
            "type": kind,
        }
        if kind == "VEC3":
            accessor |= {"min": array.min(axis=0).tolist(), "max": array.max(axis=0).tolist()}
        accessors = self.json.setdefault("accessors", [])
        accessors.append(accessor)
        return len(accessors) - 1


def rigid(matrix: np.ndarray) -> np.ndarray:
    """Rotation and translation of a matrix whose axes are square to each other."""
    result = np.eye(4)
    result[:3, 3] = matrix[:3, 3]
    result[:3, :3] = matrix[:3, :3] / np.linalg.norm(matrix[:3, :3], axis=0)
    if abs(np.linalg.det(result[:3, :3]) - 1.0) > 1e-4:
        raise Fault("a light or camera is mirrored or sheared")
    return result


def looking(eye: tuple, target: tuple, up: tuple = (0.0, 1.0, 0.0)) -> np.ndarray:
    """The rigid transform at `eye` whose -Z points to `target`, +Y as near to `up` as can be."""
    z = np.subtract(eye, target).astype(float)
    z /= np.linalg.norm(z)
    x = np.cross(up, z)
    if np.linalg.norm(x) < 1e-7:
        x = np.cross((0.0, 0.0, -1.0), z)
    x /= np.linalg.norm(x)
    matrix = np.eye(4)
    matrix[:3, :3] = np.stack([x, np.cross(z, x), z], axis=1)
    matrix[:3, 3] = eye
    return matrix


def _glb_chunks(data: bytes) -> tuple[bytes, bytes]:
    chunks: dict[int, bytes] = {}
    at = 12
    while at + 8 <= len(data):
        length, kind = struct.unpack_from("<II", data, at)
        chunks.setdefault(kind, data[at + 8 : at + 8 + length])
        at += 8 + length
    return chunks[0x4E4F534A], chunks.get(0x004E4942, b"")


def _buffer(path: Path, buffer: dict, binary: bytes) -> bytes:
    uri = buffer.get("uri")
    if uri is None:
        return binary[: buffer["byteLength"]]
    if uri.startswith("data:"):
        return base64.b64decode(uri.split(",", 1)[1])
    return (path.parent / urllib.parse.unquote(uri)).read_bytes()


def _local(node: dict) -> np.ndarray:
    if "matrix" in node:
        return np.array(node["matrix"], float).reshape(4, 4).T
    x, y, z, w = node.get("rotation", (0.0, 0.0, 0.0, 1.0))
    rotation = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )
    matrix = np.eye(4)
    matrix[:3, :3] = rotation * np.array(node.get("scale", (1.0, 1.0, 1.0)))
    matrix[:3, 3] = node.get("translation", (0.0, 0.0, 0.0))
    return matrix


def _area_block(light: dict, scale: float) -> Block:
    height = light.get("size", 1.0) * scale
    aspect = light.get("rect", {}).get("aspect", 1.0) if light["type"] == "rect" else 1.0
    radiance = [value * light.get("intensity", 1000.0) / LUMENS_PER_WATT for value in light.get("color", (1.0, 1.0, 1.0))]
    return {"shape": light["type"], "width": height * aspect, "height": height, "radiance": radiance}


def _punctual_block(light: dict, node_extras: object) -> Block:
    def extra(member: str) -> float:
        for extras in (node_extras, light.get("extras")):
            if isinstance(extras, dict) and isinstance(extras.get(member), (int, float)):
                return float(extras[member])
        return 0.0

    emitted = [value * light.get("intensity", 1.0) / LUMENS_PER_WATT for value in light.get("color", (1.0, 1.0, 1.0))]
    if light["type"] == "directional":
        return {"shape": "sun", "angle": extra("angle"), "irradiance": emitted}
    radius = extra("radius")
    if light["type"] == "point":
        return {"shape": "sphere" if radius > 0.0 else "point", "radius": radius, "intensity": emitted}
    spot = light.get("spot", {})
    cones = {"inner_cone": spot.get("innerConeAngle", 0.0), "outer_cone": spot.get("outerConeAngle", np.pi / 4)}
    return {"shape": "spot", "radius": radius, "intensity": emitted} | cones


def _unique(name: str, taken: set[str]) -> str:
    number = 1
    unique = name
    while unique in taken:
        number += 1
        unique = f"{name}#{number}"
    taken.add(unique)
    return unique

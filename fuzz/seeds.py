"""Writes the seed corpus of the `load` target: small glTF files that need no other file.

    python3 fuzz/seeds.py ../shared/scenes     # a folder with .gltf and .glb files; may be left out

External files are turned into data URIs, and one file with every feature of the loader is made here.
"""

import base64
import json
import struct
import sys
import zlib
from pathlib import Path
from urllib.parse import unquote

MOST_BYTES = 40_000
CORPUS = Path(__file__).parent / "corpus" / "load"


def data_uri(data: bytes) -> str:
    return "data:application/octet-stream;base64," + base64.b64encode(data).decode()


def inlined(path: Path) -> bytes:
    """The document with its external files inside it."""
    document = json.loads(path.read_bytes())
    for item in document.get("buffers", []) + document.get("images", []):
        if "uri" in item and not item["uri"].startswith("data:"):
            item["uri"] = data_uri((path.parent / unquote(item["uri"])).read_bytes())
    return json.dumps(document, separators=(",", ":")).encode()


def glb(document: dict, data: bytes) -> bytes:
    text = json.dumps(document, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    data += b"\0" * (-len(data) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(data), b"BIN\0") + data
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def png(size: int) -> bytes:
    """A grey image whose alpha is a checkerboard."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    rows = b"".join(b"\0" + b"".join(bytes([128, 128, 128, 255 * ((x + y) % 2)]) for x in range(size)) for y in range(size))
    header = struct.pack(">IIBBBBB", size, size, 8, 6, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(rows)) + chunk(b"IEND", b"")


def everything() -> bytes:
    """A quad in all ways: sparse, quantized, strip, fan, instanced, cut out, emissive, skinned, morphed, animated in every way;
    every light; both cameras."""
    data = b""
    views, accessors = [], []

    def view(part: bytes, **more) -> int:
        nonlocal data
        views.append({"buffer": 0, "byteOffset": len(data), "byteLength": len(part), **more})
        data += part + b"\0" * (-len(part) % 4)
        return len(views) - 1

    def accessor(view_index, component: int, count: int, kind: str, **more) -> int:
        accessors.append({"bufferView": view_index, "componentType": component, "count": count, "type": kind, **more})
        return len(accessors) - 1

    corners = [(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)]
    interleaved = b"".join(struct.pack("<6f", *corner, 0, 0, 1) for corner in corners)
    vertices = view(interleaved, byteStride=24)
    positions = accessor(vertices, 5126, 4, "VEC3")
    normals = accessor(vertices, 5126, 4, "VEC3", byteOffset=12)
    shorts = view(b"".join(struct.pack("<4h", *(32767 * c for c in corner), 0) for corner in corners), byteStride=8)
    quantized = accessor(shorts, 5122, 4, "VEC3", normalized=True)
    uvs = accessor(view(struct.pack("<8B", 0, 255, 255, 255, 255, 0, 0, 0)), 5121, 4, "VEC2", normalized=True)
    indices = accessor(view(struct.pack("<6H", 0, 1, 2, 0, 2, 3)), 5123, 6, "SCALAR")
    strip = accessor(view(bytes([0, 1, 3, 2])), 5121, 4, "SCALAR")
    fan = accessor(view(struct.pack("<4I", 0, 1, 2, 3)), 5125, 4, "SCALAR")
    moved = accessor(vertices, 5126, 4, "VEC3")
    accessors[moved]["sparse"] = {
        "count": 1,
        "indices": {"bufferView": view(bytes([2])), "componentType": 5121},
        "values": {"bufferView": view(struct.pack("<3f", 2, 2, 0))},
    }
    translations = accessor(view(struct.pack("<6f", 0, 0, 3, 0, 0, 4)), 5126, 2, "VEC3")
    rotations = accessor(view(struct.pack("<8b", 0, 0, 0, 127, 0, 127, 0, 0)), 5120, 2, "VEC4", normalized=True)
    scales = accessor(view(struct.pack("<6f", 1, 1, 1, 2, 2, 2)), 5126, 2, "VEC3")
    image = view(png(4))
    joints = accessor(view(bytes([0, 1, 0, 0] * 4)), 5121, 4, "VEC4")
    weights = accessor(view(struct.pack("<16H", *[40000, 20000, 0, 0] * 4)), 5123, 4, "VEC4", normalized=True)
    more_weights = accessor(view(struct.pack("<16f", *[0.25, 0.5, 0, 0] * 4)), 5126, 4, "VEC4")
    matrices = accessor(view(struct.pack("<32f", *[1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 1, 2, 3, 1] * 2)), 5126, 2, "MAT4")
    accessors.append({"componentType": 5126, "count": 4, "type": "VEC3", "sparse": accessors[moved]["sparse"]})
    displacements = len(accessors) - 1
    times = accessor(view(struct.pack("<2f", 0.5, 2)), 5126, 2, "SCALAR")
    turns = accessor(view(struct.pack("<8h", 0, 0, 0, 32767, 0, 32767, 0, 0)), 5122, 2, "VEC4", normalized=True)
    moves = accessor(view(struct.pack("<18f", *range(18))), 5126, 6, "VEC3")
    shapes = accessor(view(bytes([0, 255, 128, 0])), 5121, 4, "SCALAR", normalized=True)

    def mesh(index: int, *primitives: dict) -> dict:
        return {"name": f"mesh {index}", "primitives": list(primitives)}

    base = {"POSITION": positions, "NORMAL": normals, "TEXCOORD_0": uvs}
    lights = [
        {"shape": "rect", "width": 1, "height": 2, "radiance": [1, 1, 1], "spread": 1.5},
        {"shape": "disk", "width": 1, "radiance": [1, 1, 1], "light_exclude": ["child"]},
        {"shape": "sphere", "radius": 0.5, "radiance": [1, 1, 1], "facing": True},
        {"shape": "tube", "length": 2, "radius": 0.1, "radiance": [1, 1, 1], "casts_shadow": False},
        {"shape": "sun", "angle": 0.01, "irradiance": [1, 1, 1]},
        {"shape": "point", "intensity": [1, 1, 1]},
        {"shape": "spot", "radius": 0.1, "intensity": [1, 1, 1], "inner_cone": 0.1, "outer_cone": 0.5},
    ]
    nodes = [
        {"name": "parent", "mesh": 0, "children": [1], "translation": [1, 2, 3], "scale": [1, -2, 3]},
        {"name": "child", "mesh": 1, "rotation": [0, 0.6, 0, 0.8], "matrix": [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 5, 6, 7, 1]},
        {
            "mesh": 0,
            "extensions": {
                "EXT_mesh_gpu_instancing": {
                    "attributes": {"TRANSLATION": translations, "ROTATION": rotations, "SCALE": scales}
                }
            },
        },
        {"camera": 0, "translation": [0, 0, 9]},
        {"camera": 1, "rotation": [0, 1, 0, 0]},
        {"mesh": 2, "translation": [0, 5, 0]},
        {"extensions": {"EXT_lights_area": {"light": 0}}},
        {"extensions": {"EXT_lights_area": {"light": 1}, "PENUMBRA_lights": {"version": 1, **lights[1]}}},
    ]
    nodes += [
        {"name": "skinned", "mesh": 3, "skin": 0, "weights": [0.5, 0.25]},
        {"name": "joint", "translation": [0, 0, 1]},
    ]
    skinned = len(nodes) - 2
    nodes += [{"extensions": {"KHR_lights_punctual": {"light": i}}, "extras": {"radius": 0.2}} for i in range(3)]
    nodes += [{"name": "light", "extensions": {"PENUMBRA_lights": {"version": 1, **light}}} for light in lights]
    document = {
        "asset": {"version": "2.0"},
        "extensionsUsed": ["EXT_mesh_gpu_instancing", "EXT_lights_area", "PENUMBRA_lights"],
        "extensionsRequired": ["KHR_mesh_quantization", "KHR_lights_punctual"],
        "extensions": {
            "EXT_lights_area": {
                "lights": [
                    {"name": "area", "type": "rect", "color": [1, 1, 1], "intensity": 1000, "size": 2, "rect": {"aspect": 2}},
                    {"type": "disk", "size": 1},
                ]
            },
            "KHR_lights_punctual": {
                "lights": [
                    {"type": "point", "intensity": 100},
                    {"type": "spot", "intensity": 100, "spot": {"innerConeAngle": 0.1, "outerConeAngle": 0.6}},
                    {"type": "directional", "intensity": 3, "extras": {"angle": 0.01}},
                ]
            },
        },
        "scene": 0,
        "scenes": [{"nodes": [0, *range(2, len(nodes))]}],
        "nodes": nodes,
        "meshes": [
            mesh(
                0,
                {"attributes": base, "indices": indices, "material": 0},
                {"attributes": {"POSITION": quantized}, "indices": strip, "mode": 5},
                {"attributes": {"POSITION": moved}, "indices": fan, "mode": 6},
                {"attributes": {"POSITION": positions}, "mode": 1},
            ),
            mesh(1, {"attributes": base, "indices": indices, "material": 1}),
            mesh(2, {"attributes": {"POSITION": positions}, "indices": indices, "material": 2}),
            mesh(
                3,
                {
                    "attributes": {
                        **base,
                        "JOINTS_0": joints,
                        "WEIGHTS_0": weights,
                        "JOINTS_1": joints,
                        "WEIGHTS_1": more_weights,
                    },
                    "indices": indices,
                    "targets": [{"POSITION": displacements, "NORMAL": normals}, {"POSITION": positions}],
                },
            ),
        ],
        "skins": [{"joints": [skinned + 1, 3], "inverseBindMatrices": matrices, "skeleton": skinned + 1}],
        "animations": [
            {
                "name": "all",
                "channels": [
                    {"sampler": 0, "target": {"node": skinned + 1, "path": "rotation"}},
                    {"sampler": 1, "target": {"node": 0, "path": "translation"}},
                    {"sampler": 1, "target": {"node": 3, "path": "scale"}},
                    {"sampler": 2, "target": {"node": skinned, "path": "weights"}},
                ],
                "samplers": [
                    {"input": times, "output": turns},
                    {"input": times, "output": moves, "interpolation": "CUBICSPLINE"},
                    {"input": times, "output": shapes, "interpolation": "STEP"},
                ],
            }
        ],
        "materials": [
            {
                "alphaMode": "MASK",
                "alphaCutoff": 0.4,
                "pbrMetallicRoughness": {
                    "baseColorFactor": [1, 0.5, 0.5, 0.9],
                    "baseColorTexture": {
                        "index": 0,
                        "texCoord": 1,
                        "extensions": {
                            "KHR_texture_transform": {"offset": [0.1, 0.2], "rotation": 1, "scale": [2, 3], "texCoord": 0}
                        },
                    },
                },
            },
            {"alphaMode": "BLEND"},
            {
                "emissiveFactor": [1, 1, 1],
                "doubleSided": True,
                "extensions": {"KHR_materials_emissive_strength": {"emissiveStrength": 100}},
            },
        ],
        "textures": [{"source": 0, "sampler": 0}],
        "images": [{"bufferView": image, "mimeType": "image/png"}],
        "samplers": [{"magFilter": 9728, "wrapS": 33648, "wrapT": 33071}],
        "cameras": [
            {"type": "perspective", "perspective": {"yfov": 0.7, "znear": 0.1, "zfar": 100}},
            {"type": "orthographic", "orthographic": {"xmag": 1, "ymag": 2, "znear": 0, "zfar": 10}},
        ],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": len(data)}],
    }
    return glb(document, data)


def main() -> None:
    CORPUS.mkdir(parents=True, exist_ok=True)
    (CORPUS / "everything.glb").write_bytes(everything())
    for folder in sys.argv[1:]:
        for path in sorted(Path(folder).rglob("*.gl[tb]*")):
            try:
                data = inlined(path) if path.suffix == ".gltf" else path.read_bytes()
            except (OSError, ValueError):
                data = path.read_bytes()
            if len(data) <= MOST_BYTES:
                (CORPUS / path.name).write_bytes(data)
    print(f"{len(list(CORPUS.iterdir()))} seeds in {CORPUS}")


if __name__ == "__main__":
    main()

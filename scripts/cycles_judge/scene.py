"""Scenes in Blender: loaded from .blend or glTF, made ready for direct light alone, and written down as GLB."""

import contextlib
import hashlib
import math
import os
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import astuple, dataclass
from pathlib import Path

import bpy
import mathutils
import numpy as np

from . import Fault
from .gltf import Document, rigid
from .lights import BlenderLight, blender_light, penumbra_block

# glTF's +Y up from Blender's +Z up.
WORLD_FROM_BLENDER = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
BLENDER_FROM_WORLD = WORLD_FROM_BLENDER.T

# Objects that have a surface.
SURFACES = {"MESH", "CURVE", "SURFACE", "FONT", "META"}


@dataclass
class Scene:
    """What is rendered: bpy's scene, its lights in the file's order, and what the user should know."""

    scene: bpy.types.Scene
    lights: list[bpy.types.Object]
    warnings: list[str]


@dataclass
class Mesh:
    """Triangles of an object, world space. Normals, one a corner, where any part is smooth."""

    name: str
    corners: np.ndarray
    normals: np.ndarray | None


@contextlib.contextmanager
def quiet() -> Iterator[None]:
    """Keeps what Blender prints from the output, and shows it if it fails."""
    sys.stdout.flush()
    sys.stderr.flush()
    kept = [os.dup(stream) for stream in (1, 2)]
    with tempfile.TemporaryFile() as log:
        for stream in (1, 2):
            os.dup2(log.fileno(), stream)
        try:
            yield
        finally:
            sys.stdout.flush()
            sys.stderr.flush()
            for stream, original in zip((1, 2), kept, strict=True):
                os.dup2(original, stream)
                os.close(original)


def load(path: Path, camera: str | None, light_names: list[str], size: tuple[int, int], frame: int | None) -> Scene:
    """Loads a scene, and keeps of its lights those of the names (all if there are none)."""
    if not path.is_file():
        raise Fault(f"{path}: no such file")
    suffix = path.suffix.lower()
    if suffix == ".blend":
        loaded = _load_blend(path, camera)
    elif suffix in (".glb", ".gltf"):
        loaded = _load_gltf(path, camera, size)
    else:
        raise Fault(f"{path}: expected a .blend, .glb or .gltf file")
    scene = loaded.scene
    if frame is not None:
        with quiet():
            scene.frame_set(frame)
    names = [light.name for light in loaded.lights]
    if not names:
        raise Fault(f"{path}: no light in the scene")
    for name in light_names:
        if name not in names:
            raise Fault(f"{path}: no light named {name}; there is {', '.join(names)}")
    if light_names:
        loaded.lights = [light for light in loaded.lights if light.name in light_names]
    for light in loaded.lights:
        settings_of(light)
    render = scene.render
    render.resolution_x, render.resolution_y = size
    render.resolution_percentage = 100
    render.pixel_aspect_x = render.pixel_aspect_y = 1.0
    _strip(scene)
    return loaded


def settings_of(light: bpy.types.Object) -> BlenderLight:
    """A light's settings; an error where it does what Penumbra's lights can't say."""
    data = light.data
    refused = {
        "light nodes": data.use_nodes and _has_light_nodes(data),
        "a colour temperature": data.use_temperature,
        "a custom diffuse factor": data.diffuse_factor != 1.0,
        "a portal": data.cycles.is_portal,
        "spot blend above 0": data.type == "SPOT" and data.spot_blend > 0.0,
        "a square spot": data.type == "SPOT" and data.use_square,
        "light linking": light.light_linking.receiver_collection or light.light_linking.blocker_collection,
    }
    for what, present in refused.items():
        if present:
            raise Fault(f"light {light.name}: {what} is not supported")
    return BlenderLight(
        kind=data.type,
        energy=data.energy,
        color=tuple(data.color),
        shape=getattr(data, "shape", "SQUARE"),
        size=getattr(data, "size", 0.0),
        size_y=getattr(data, "size_y", 0.0),
        spread=getattr(data, "spread", math.pi),
        radius=data.shadow_soft_size if data.type in ("POINT", "SPOT") else 0.0,
        use_soft_falloff=getattr(data, "use_soft_falloff", False),
        spot_size=getattr(data, "spot_size", 0.0),
        angle=getattr(data, "angle", 0.0),
        use_shadow=data.use_shadow,
    )


def meshes(scene: Scene) -> list[Mesh]:
    """All surfaces as they are rendered, in world space."""
    found = []
    skipped: dict[str, int] = {}
    for instance in bpy.context.evaluated_depsgraph_get().object_instances:
        owner = instance.object
        if owner.type not in SURFACES:
            if owner.type in {"CURVES", "POINTCLOUD", "VOLUME", "GREASEPENCIL"}:
                skipped[owner.type] = skipped.get(owner.type, 0) + 1
            continue
        if not instance.show_self:
            continue
        mesh = owner.to_mesh()
        if mesh is None:
            continue
        world_from_mesh = WORLD_FROM_BLENDER @ np.array(instance.matrix_world)
        mesh.calc_loop_triangles()
        count = len(mesh.loop_triangles)
        vertices = _array(mesh.vertices, "co", np.float32, 3 * len(mesh.vertices)).reshape(-1, 3)
        corners = vertices[_array(mesh.loop_triangles, "vertices", np.int32, 3 * count)].astype(float)
        corners = corners @ world_from_mesh[:3, :3].T + world_from_mesh[:3, 3]
        normals = None
        if count and (mesh.normals_domain != "FACE"):
            loops = _array(mesh.loop_triangles, "loops", np.int32, 3 * count)
            all_normals = _array(mesh.corner_normals, "vector", np.float32, 3 * len(mesh.loops)).reshape(-1, 3)
            normals = all_normals[loops].astype(float) @ np.linalg.inv(world_from_mesh[:3, :3])
            normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
        if np.linalg.det(world_from_mesh[:3, :3]) < 0.0:
            # A mirroring transform turns the winding.
            corners = corners.reshape(-1, 3, 3)[:, ::-1].reshape(-1, 3)
            normals = None if normals is None else normals.reshape(-1, 3, 3)[:, ::-1].reshape(-1, 3)
        owner.to_mesh_clear()
        if count:
            found.append(Mesh(owner.name, corners.reshape(-1, 3), normals))
    for kind, count in skipped.items():
        scene.warnings.append(f"{count} objects of type {kind} have no triangles: Penumbra will not see them")
    if not found:
        raise Fault("no surface in the scene")
    return found


def write_glb(scene: Scene, surfaces: list[Mesh], path: Path) -> None:
    """Writes what is rendered as Penumbra reads it."""
    document = Document()
    for surface in surfaces:
        document.mesh(surface.name, surface.corners, normals=surface.normals)
    for light in scene.lights:
        settings = settings_of(light)
        matrix = np.array(light.matrix_world)
        scale = np.linalg.norm(matrix[:3, :3], axis=0)
        block = penumbra_block(
            settings, exposure=light.data.exposure, normalize=light.data.normalize, scale=(scale[0], scale[1])
        )
        document.light(light.name, rigid(WORLD_FROM_BLENDER @ matrix), block)
    _write_camera(scene.scene, document)
    document.write(path)


def fingerprint(scene: Scene, surfaces: list[Mesh]) -> str:
    """A hash of all that the picture depends on but the settings of the renderer."""
    digest = hashlib.sha256()
    for surface in surfaces:
        digest.update(np.ascontiguousarray(surface.corners).tobytes())
        digest.update(b"flat" if surface.normals is None else np.ascontiguousarray(surface.normals).tobytes())
    camera = scene.scene.camera
    data = camera.data
    view = (data.type, data.lens, data.sensor_width, data.sensor_height, data.sensor_fit, data.ortho_scale, data.clip_start)
    described: list[object] = [np.array(camera.matrix_world).tolist(), view, data.clip_end, data.shift_x, data.shift_y]
    for light in scene.lights:
        extras = (light.data.exposure, light.data.normalize)
        described.append((light.name, np.array(light.matrix_world).tolist(), astuple(settings_of(light)), extras))
    digest.update(repr(described).encode())
    return digest.hexdigest()


def _load_blend(path: Path, camera: str | None) -> Scene:
    try:
        with quiet():
            bpy.ops.wm.open_mainfile(filepath=str(path), load_ui=False)
    except RuntimeError as error:
        raise Fault(f"{path}: is not a .blend file that can be read: {_first_line(error)}") from error
    scene = bpy.context.scene
    if camera is not None:
        found = scene.objects.get(camera)
        if found is None or found.type != "CAMERA":
            names = [item.name for item in scene.objects if item.type == "CAMERA"]
            raise Fault(f"{path}: no camera named {camera}; there is {', '.join(names) or 'none'}")
        scene.camera = found
    if scene.camera is None:
        raise Fault(f"{path}: no camera in the scene")
    lights = [item for item in scene.objects if item.type == "LIGHT" and not item.hide_render]
    return Scene(scene, lights, [])


def _load_gltf(path: Path, camera_name: str | None, size: tuple[int, int]) -> Scene:
    document = Document.read(path)
    try:
        lights, cameras = document.lights(), document.cameras()
        _refuse_unsupported(path, document)
    except (KeyError, IndexError, TypeError, AttributeError, ValueError) as error:
        raise Fault(f"{path}: is not a glTF scene that can be read: {type(error).__name__} {error}") from error
    if not cameras:
        raise Fault(f"{path}: no camera in the scene")
    chosen = next((camera for camera in cameras if camera_name in (None, camera[0])), None)
    if chosen is None:
        names = ", ".join(camera[0] for camera in cameras)
        raise Fault(f"{path}: no camera named {camera_name}; there is {names}")
    try:
        with quiet():
            bpy.ops.wm.read_factory_settings(use_empty=True)
            bpy.ops.import_scene.gltf(filepath=str(path.resolve()))
    except RuntimeError as error:
        raise Fault(f"{path}: Blender's importer fails: {_first_line(error)}") from error
    scene = bpy.context.scene
    for imported in [item for item in scene.objects if item.type in ("LIGHT", "CAMERA")]:
        bpy.data.objects.remove(imported)
    made = []
    for name, world_from_light, block in lights:
        made.append(_make_light(scene, name, world_from_light, blender_light(name, block)))
    _make_camera(scene, *chosen, size)
    with quiet():
        bpy.context.view_layer.update()
    return Scene(scene, made, [])


def _refuse_unsupported(path: Path, document: Document) -> None:
    for index, material in enumerate(document.json.get("materials", [])):
        if material.get("alphaMode") == "MASK":
            raise Fault(f"{path}: materials[{index}] is a cut-out (alphaMode MASK), which is not supported here")
        emission = material.get("emissiveFactor", [0.0])
        if "KHR_materials_emissive_strength" in material.get("extensions", {}) and max(emission) > 0.0:
            raise Fault(f"{path}: materials[{index}] emits: lights made of meshes are not supported here")


def _make_light(scene: bpy.types.Scene, name: str, world_from_light: np.ndarray, settings: BlenderLight) -> bpy.types.Object:
    data = bpy.data.lights.new(name, settings.kind)
    data.energy, data.color, data.use_shadow = settings.energy, settings.color, settings.use_shadow
    if settings.kind == "AREA":
        data.shape, data.size, data.size_y, data.spread = settings.shape, settings.size, settings.size_y, settings.spread
    elif settings.kind == "SUN":
        data.angle = settings.angle
    else:
        data.shadow_soft_size, data.use_soft_falloff = settings.radius, settings.use_soft_falloff
        if settings.kind == "SPOT":
            data.spot_size, data.spot_blend = settings.spot_size, 0.0
    taken = bpy.data.objects.get(name)
    if taken is not None:
        taken.name = f"{name} (geometry)"
    light = bpy.data.objects.new(name, data)
    if light.name != name:
        raise Fault(f"light {name}: Blender can't give it this name")
    light.matrix_world = mathutils.Matrix(BLENDER_FROM_WORLD @ world_from_light)
    scene.collection.objects.link(light)
    return light


def _make_camera(scene: bpy.types.Scene, name: str, world_from_camera: np.ndarray, camera: dict, size: tuple[int, int]) -> None:
    data = bpy.data.cameras.new(name)
    # The image's height is what glTF's angle and Penumbra's views belong to.
    data.sensor_fit = "VERTICAL"
    if camera["type"] == "perspective":
        view = camera["perspective"]
        # As a ratio of lengths: Blender stores a focal length, in floats.
        data.sensor_height = 24.0
        data.lens = 0.5 * data.sensor_height / math.tan(0.5 * view["yfov"])
    else:
        view = camera["orthographic"]
        data.type = "ORTHO"
        data.ortho_scale = 2.0 * view["ymag"]
    data.clip_start = max(view.get("znear", 0.0), 1e-6)
    data.clip_end = view.get("zfar", 1e9)
    item = bpy.data.objects.new(name, data)
    item.matrix_world = mathutils.Matrix(BLENDER_FROM_WORLD @ world_from_camera)
    scene.collection.objects.link(item)
    scene.camera = item


def _write_camera(scene: bpy.types.Scene, document: Document) -> None:
    camera = scene.camera
    data = camera.data
    width, height = scene.render.resolution_x, scene.render.resolution_y
    if data.shift_x != 0.0 or data.shift_y != 0.0:
        raise Fault(f"camera {camera.name}: glTF has no shifted lens")
    vertical = data.sensor_fit == "VERTICAL" or (data.sensor_fit == "AUTO" and height > width)
    aspect = width / height
    matrix = rigid(WORLD_FROM_BLENDER @ np.array(camera.matrix_world))
    if data.type == "PERSP":
        sensor = data.sensor_height if data.sensor_fit == "VERTICAL" else data.sensor_width
        slope = 0.5 * sensor / data.lens / (1.0 if vertical else aspect)
        document.camera(camera.name, matrix, 2.0 * math.atan(slope))
    elif data.type == "ORTHO":
        half = 0.5 * data.ortho_scale / (1.0 if vertical else aspect)
        document.orthographic_camera(camera.name, matrix, half, aspect)
    else:
        raise Fault(f"camera {camera.name}: glTF has no {data.type.lower()} cameras")


def _strip(scene: bpy.types.Scene) -> None:
    """Takes away all but geometry and lights: background, effects, what hides surfaces from some rays, viewport settings."""
    scene.world = bpy.data.worlds.new("black")
    if scene.world.node_tree is None:
        scene.world.use_nodes = True
    for node in scene.world.node_tree.nodes:
        if node.type == "BACKGROUND":
            node.inputs["Strength"].default_value = 0.0
    render = scene.render
    render.use_compositing = render.use_sequencer = render.use_motion_blur = False
    render.use_border = render.use_simplify = render.use_freestyle = False
    render.film_transparent = True
    scene.camera.data.dof.use_dof = False
    for layer in scene.view_layers:
        layer.use = layer == bpy.context.view_layer
    for item in scene.objects:
        # What the depsgraph shows is then what is rendered.
        item.hide_viewport = item.hide_render
        item.hide_set(False)
        for modifier in item.modifiers:
            modifier.show_viewport = modifier.show_render
            if modifier.type in ("SUBSURF", "MULTIRES"):
                modifier.levels = modifier.render_levels
        if item.type == "LIGHT":
            item.visible_camera = False
            continue
        item.visible_camera = item.visible_diffuse = item.visible_shadow = True
        item.is_holdout = item.is_shadow_catcher = False
        # Penumbra's horizon is the surface's own: no shadow is moved away from it.
        item.shadow_terminator_geometry_offset = item.shadow_terminator_shading_offset = 0.0
        item.shadow_terminator_normal_offset = 0.0
    for collection in bpy.data.collections:
        collection.hide_viewport = collection.hide_render
    with quiet():
        bpy.context.view_layer.update()


def _has_light_nodes(data: bpy.types.Light) -> bool:
    """Whether a light's nodes do more than the one emission node of strength 1 that new lights have."""
    tree = data.node_tree
    if tree is None:
        return False
    kinds = sorted(node.type for node in tree.nodes)
    if kinds != ["EMISSION", "OUTPUT_LIGHT"]:
        return True
    emission = next(node for node in tree.nodes if node.type == "EMISSION")
    return emission.inputs["Strength"].default_value != 1.0 or tuple(emission.inputs["Color"].default_value)[:3] != (
        1.0,
        1.0,
        1.0,
    )


def _array(items: bpy.types.bpy_prop_collection, member: str, kind: type, count: int) -> np.ndarray:
    values = np.empty(count, kind)
    items.foreach_get(member, values)
    return values


def _first_line(error: Exception) -> str:
    return str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__

# SPDX-License-Identifier: GPL-3.0-or-later
"""From an evaluated dependency graph to arrays, on Blender's main thread: modifiers, instances, visibility as Blender has."""

from __future__ import annotations

import math
from typing import Any

import bpy
import numpy as np

from . import glb, lights, textures

# What has no surface of its own; curves, surfaces, text and metaballs come once more, as the meshes made of them.
_WITHOUT_SURFACE = {"ARMATURE", "CAMERA", "EMPTY", "LATTICE", "LIGHT", "LIGHT_PROBE", "LIGHTPROBE", "SPEAKER"}
_WITHOUT_SURFACE |= {"CURVE", "SURFACE", "FONT", "META"}
# Components of attributes that may hold a UV map.
_PLACES = {"FLOAT2": 2, "FLOAT_VECTOR": 3}
# The least volume that a transform leaves to a unit cube, its lengths aside; the binary takes no singular transform.
_LEAST_VOLUME = 2.0**-40
# The binary shortens a light's name that is longer than 232 bytes; `#2` and so on are to fit too.
_MAX_LIGHT_NAME_BYTES = 200


class ExtractError(ValueError):
    """The scene can't be shown as Blender shows it; the message is one line for the user."""


def view_height_fraction(*, sensor_fit: str, width_px: float, height_px: float) -> float:
    """Height of the view per unit of the length that the sensor (or `ortho_scale`) stands for."""
    fit_width = sensor_fit == "HORIZONTAL" or (sensor_fit == "AUTO" and width_px >= height_px)
    return height_px / width_px if fit_width else 1.0


def camera_of(camera_object: bpy.types.Object, *, size: tuple[int, int], pixel_aspect: float = 1.0) -> glb.Camera:
    """A camera as it frames an image of `size` pixels. `pixel_aspect`: width of a pixel over its height."""
    camera = camera_object.data
    name = camera_object.name
    if camera_object.type != "CAMERA":
        raise ExtractError(f"{name!r} is no camera: choose one in the scene's properties")
    if min(lights.column_lengths(np.array(camera_object.matrix_world, dtype=float))) == 0.0:
        raise ExtractError(f"camera {name!r}: its scale is 0")
    if pixel_aspect != 1.0:
        raise ExtractError(f"camera {name!r}: pixels that are not square are not supported; set both aspects to 1")
    if camera.type not in {"PERSP", "ORTHO"}:
        raise ExtractError(f"camera {name!r}: {camera.type.lower()} cameras are not supported; use perspective or orthographic")
    if camera.shift_x != 0.0 or camera.shift_y != 0.0:
        raise ExtractError(f"camera {name!r}: lens shift is not supported; set both shifts to 0")
    width, height = size
    fraction = view_height_fraction(sensor_fit=camera.sensor_fit, width_px=width, height_px=height)
    world_from_camera = glb.rigid(np.array(camera_object.matrix_world, dtype=float))
    # Blender lets far be below near; nothing is seen then, and glTF has no such camera.
    near, far = camera.clip_start, max(camera.clip_end, math.nextafter(camera.clip_start, math.inf))
    placed = {"world_from_camera": world_from_camera, "near": near, "far": far}
    if camera.type == "ORTHO":
        return glb.Camera(**placed, half_height=0.5 * camera.ortho_scale * fraction)
    # The sensor's height counts only where it is what fits.
    sensor = camera.sensor_height if camera.sensor_fit == "VERTICAL" else camera.sensor_width
    return glb.Camera(**placed, fov_y=2.0 * math.atan(0.5 * sensor * fraction / camera.lens))


def view_camera(window_matrix: Any, view_matrix: Any, *, is_perspective: bool, near: float, far: float) -> glb.Camera:
    """The camera of a 3D view's region, whose window has its centre on the view axis."""
    world_from_camera = glb.rigid(np.linalg.inv(np.array(view_matrix, dtype=float)))
    slope = 1.0 / window_matrix[1][1]
    if is_perspective:
        return glb.Camera(world_from_camera, near=near, far=far, fov_y=2.0 * math.atan(slope))
    # A parallel view begins far behind its centre: Blender puts the near plane there.
    back = np.eye(4)
    back[2, 3] = far
    return glb.Camera(world_from_camera @ back, near=0.0, far=2.0 * far, half_height=slope)


def _read(collection: Any, name: str, shape: tuple[int, ...], dtype: Any) -> np.ndarray:
    values = np.empty(int(np.prod(shape)), dtype)
    collection.foreach_get(name, values)
    return values.reshape(shape)


def _corner_vertices(mesh: bpy.types.Mesh) -> np.ndarray:
    attribute = mesh.attributes.get(".corner_vert")
    if attribute is not None:
        return _read(attribute.data, "value", (len(mesh.loops),), np.int32)
    return _read(mesh.loops, "vertex_index", (len(mesh.loops),), np.int32)


def _normals_domain(mesh: bpy.types.Mesh) -> str:
    """FACE (flat), POINT (smooth) or CORNER (both, or custom ones)."""
    if hasattr(mesh, "normals_domain"):
        return mesh.normals_domain
    smooth = _read(mesh.polygons, "use_smooth", (len(mesh.polygons),), bool)
    if not smooth.any():
        return "FACE"
    return "POINT" if smooth.all() and not (mesh.use_auto_smooth or mesh.has_custom_normals) else "CORNER"


def _corner_normals(mesh: bpy.types.Mesh) -> np.ndarray:
    if hasattr(mesh, "corner_normals"):
        return _read(mesh.corner_normals, "vector", (len(mesh.loops), 3), np.float32)
    mesh.calc_normals_split()
    normals = _read(mesh.loops, "normal", (len(mesh.loops), 3), np.float32)
    mesh.free_normals_split()
    return normals


def _triangle_materials(mesh: bpy.types.Mesh, count: int) -> np.ndarray:
    attribute = mesh.attributes.get("material_index")
    if attribute is not None and hasattr(mesh, "loop_triangle_polygons"):
        by_face = _read(attribute.data, "value", (len(mesh.polygons),), np.int32)
        return by_face[_read(mesh.loop_triangle_polygons, "value", (count,), np.int32)]
    if attribute is None and hasattr(mesh, "normals_domain"):
        return np.zeros(count, np.int32)
    return _read(mesh.loop_triangles, "material_index", (count,), np.int32)


def _uv_map(mesh: bpy.types.Mesh, name: str) -> np.ndarray:
    """(corners, 2), with the image's first row at v = 0, as glTF has it; where there is no such map its last, as in Cycles."""
    layer = mesh.uv_layers.get(name) if name else next((layer for layer in mesh.uv_layers if layer.active_render), None)
    if layer is None and name:
        # Geometry nodes leave attributes, of other types and domains.
        attribute = mesh.attributes.get(name)
        if attribute is not None and attribute.data_type in _PLACES and attribute.domain in {"CORNER", "POINT"}:
            places = _read(attribute.data, "vector", (len(attribute.data), _PLACES[attribute.data_type]), np.float32)
            uv = np.ascontiguousarray((places if attribute.domain == "CORNER" else places[_corner_vertices(mesh)])[:, :2])
            uv[:, 1] = 1.0 - uv[:, 1]
            return uv
    if layer is None:
        # 1, but for what repeats.
        return np.tile(np.array([0.0, 1.0 - 2.0**-20], np.float32), (len(mesh.loops), 1))
    is_attribute = hasattr(layer, "uv")
    uv = _read(layer.uv if is_attribute else layer.data, "vector" if is_attribute else "uv", (len(mesh.loops), 2), np.float32)
    uv[:, 1] = 1.0 - uv[:, 1]
    return uv


def _mesh_arrays(mesh: bpy.types.Mesh, slots: list[int], uv_maps: set[str]) -> glb.Mesh | None:
    """Triangles, vertices and normals of an evaluated mesh; none where it has no face. `slots`: material of each slot.
    `uv_maps`: those that they need.
    """
    mesh.calc_loop_triangles()
    count = len(mesh.loop_triangles)
    if count == 0:
        return None
    positions = _positions(mesh)
    if not np.isfinite(positions).all():
        raise ExtractError(f"mesh {mesh.name!r}: a vertex is not at a finite position")
    if len(mesh.polygons) == count:
        # All triangles already, which are then their faces' corners.
        triangles = _corner_vertices(mesh).reshape(-1, 3)
    else:
        triangles = _read(mesh.loop_triangles, "vertices", (count, 3), np.int32)
    domain = _normals_domain(mesh)
    normals = None
    if domain == "POINT":
        normals = _read(mesh.vertex_normals, "vector", (len(mesh.vertices), 3), np.float32)
    uvs = {}
    if domain == "CORNER" or uv_maps:
        # A vertex for each corner of each triangle.
        corners = _read(mesh.loop_triangles, "loops", (count * 3,), np.int32)
        if domain == "CORNER":
            normals = _corner_normals(mesh)[corners]
        elif normals is not None:
            normals = normals[triangles.reshape(-1)]
        uvs = {name: _uv_map(mesh, name)[corners] for name in sorted(uv_maps)}
        positions = positions[triangles.reshape(-1)]
        triangles = np.arange(3 * count, dtype=np.int32).reshape(-1, 3)
    if normals is not None:
        normals = _unit(normals)
    parts = [(0, count, slots[0])]
    if len(slots) > 1:
        by_triangle = np.minimum(_triangle_materials(mesh, count), len(slots) - 1)
        order = np.argsort(by_triangle, kind="stable")
        triangles = triangles[order]
        used, first, counts = np.unique(by_triangle[order], return_index=True, return_counts=True)
        parts = [(int(f), int(c), slots[slot]) for slot, f, c in zip(used, first, counts)]
    return glb.Mesh(positions, np.ascontiguousarray(triangles, np.uint32), normals, uvs, parts)


def _positions(mesh: bpy.types.Mesh) -> np.ndarray:
    attribute = mesh.attributes.get("position")
    if attribute is not None:
        return _read(attribute.data, "vector", (len(mesh.vertices), 3), np.float32)
    return _read(mesh.vertices, "co", (len(mesh.vertices), 3), np.float32)


def _unit(normals: np.ndarray) -> np.ndarray:
    """Vertices of degenerate faces have no normal in Blender; glTF wants one, and no pixel shows it."""
    lengths = np.sqrt(np.einsum("ij,ij->i", normals, normals))
    normals[lengths == 0.0] = (0.0, 0.0, 1.0)
    lengths[lengths == 0.0] = 1.0
    normals /= lengths[:, None]
    return normals


class _Extraction:
    """The scene as it grows."""

    def __init__(self, depsgraph: bpy.types.Depsgraph) -> None:
        self.depsgraph = depsgraph
        self.scene = glb.Scene()
        self.mesh_of: dict[tuple, int | None] = {}
        self.material_of: dict[int, int] = {}
        self.materials = textures.Reader(self.scene.warnings)
        # By copy, whether it casts shadows.
        self.casts_shadow: list[bool] = []
        self.light_objects: list[bpy.types.Object] = []

    def material(self, material: bpy.types.Material | None) -> int:
        key = material.as_pointer() if material else 0
        if key not in self.material_of:
            self.material_of[key] = len(self.scene.materials)
            self.scene.materials.append(self.materials.material(material))
        return self.material_of[key]

    def mesh(self, instance_object: bpy.types.Object) -> int | None:
        """Index of the evaluated mesh of an object: the same for all that share it."""
        data = instance_object.data
        slots = [self.material(slot.material) for slot in instance_object.material_slots] or [self.material(None)]
        # In Edit Mode it stands for the mesh that is edited, and is empty.
        is_mesh = not data.is_editmode
        owner = 0 if is_mesh else instance_object.original.as_pointer()
        key = (data.as_pointer(), owner, tuple(slots))
        if key not in self.mesh_of:
            mesh = data if is_mesh else instance_object.to_mesh()
            materials = [self.scene.materials[slot] for slot in slots]
            uv_maps = {material.uv_map for material in materials if material.image is not None}
            arrays = _mesh_arrays(mesh, slots, uv_maps) if mesh is not None else None
            if not is_mesh:
                instance_object.to_mesh_clear()
            self.mesh_of[key] = None if arrays is None else len(self.scene.meshes)
            if arrays is not None:
                self.scene.meshes.append(arrays)
        return self.mesh_of[key]

    def warn_once(self, message: str) -> None:
        if message not in self.scene.warnings:
            self.scene.warnings.append(message)

    def add(self, instance: bpy.types.DepsgraphObjectInstance) -> None:
        item = instance.object
        if item.type == "LIGHT":
            self.add_light(instance)
            return
        if not instance.show_self:
            return
        if item.type != "MESH":
            if item.type not in _WITHOUT_SURFACE:
                self.warn_once(f"{item.type.lower()} objects are left out ({item.name!r})")
            return
        # Linking follows the object that makes the instances, as in Cycles.
        owner = instance.parent.original if instance.is_instance and instance.parent else item.original
        if any(system.settings.type == "HAIR" and system.settings.render_type == "PATH" for system in item.particle_systems):
            self.warn_once(f"hair is left out ({item.name!r})")
        index = self.mesh(item)
        if index is None:
            return
        if not item.visible_camera or item.is_holdout:
            self.warn_once(f"object {owner.name!r} is hidden from the camera or a holdout, which is not supported: it is shown")
        matrix = np.array(instance.matrix_world, dtype=float)
        lengths = lights.column_lengths(matrix)
        if min(lengths) == 0.0 or abs(np.linalg.det(matrix[:3, :3] / lengths)) <= _LEAST_VOLUME:
            index, matrix = self.flattened(index, matrix), np.eye(4)
        self.scene.copies.append(glb.Copy(owner.name, index, matrix))
        self.casts_shadow.append(item.visible_shadow)

    def flattened(self, index: int, matrix: np.ndarray) -> int:
        """A mesh of its own where a transform leaves no volume: what is flat then is shown so, as Cycles does."""
        mesh = self.scene.meshes[index]
        positions = (mesh.positions @ matrix[:3, :3].T + matrix[:3, 3]).astype(np.float32)
        self.scene.meshes.append(glb.Mesh(positions, mesh.triangles, None, mesh.uvs, mesh.parts))
        return len(self.scene.meshes) - 1

    def add_light(self, instance: bpy.types.DepsgraphObjectInstance) -> None:
        item = instance.object
        if not instance.show_self:
            return
        matrix = np.array(instance.matrix_world, dtype=float)
        if lights.column_lengths(matrix)[1] == 0.0 or lights.column_lengths(matrix)[2] == 0.0:
            raise ExtractError(f"light {item.name!r}: its scale is 0")
        try:
            block = lights.describe(item.data, matrix, version=bpy.app.version)
        except lights.UnsupportedLight as error:
            raise ExtractError(str(error)) from error
        self.scene.lights.append(glb.Light(self.unique_light_name(item.original.name), block, glb.rigid(matrix)))
        self.light_objects.append(item.original)

    def add_linking(self) -> None:
        """Adds to lights which copies they do not light, and which do not block them: an instancer's copies that cast no shadow
        have another name than those that do.
        """
        casting = {copy.name for copy, casts in zip(self.scene.copies, self.casts_shadow) if casts}
        names: dict[str, set[str]] = {}
        shadowless = set()
        for copy, casts in zip(self.scene.copies, self.casts_shadow):
            owner = copy.name
            if not casts:
                copy.name += " (no shadow)" if owner in casting else ""
                shadowless.add(copy.name)
            names.setdefault(owner, set()).add(copy.name)
        for light, light_object in zip(self.scene.lights, self.light_objects):
            block: dict[str, list[str]] = {}
            lights.add_linking(block, light_object, set(names), set())
            for key, others in (("light_exclude", set()), ("shadow_exclude", shadowless)):
                left_out = others.union(*(names[owner] for owner in block.get(key, ())))
                if left_out:
                    light.block[key] = sorted(left_out)

    def unique_light_name(self, name: str) -> str:
        """A light that instances repeat is a light of its own: `#2` and so on, as the binary names them."""
        name = name.encode()[:_MAX_LIGHT_NAME_BYTES].decode(errors="ignore")
        taken = {light.name for light in self.scene.lights}
        candidates = (f"{name}#{number}" for number in range(2, len(taken) + 3))
        return name if name not in taken else next(candidate for candidate in candidates if candidate not in taken)


def extract(depsgraph: bpy.types.Depsgraph, camera: glb.Camera, space: bpy.types.SpaceView3D | None = None) -> glb.Scene:
    """All that a depsgraph shows, seen from `camera`. `space`: of a 3D view, whose local view hides surfaces, but no light:
    there is no other light here.
    """
    extraction = _Extraction(depsgraph)
    for instance in depsgraph.object_instances:
        item = instance.object
        if space is None or item.type == "LIGHT" or item.visible_in_viewport_get(space):
            extraction.add(instance)
    scene = extraction.scene
    scene.cameras.append(camera)
    extraction.add_linking()
    if not scene.copies:
        raise ExtractError("nothing to render: the scene shows no surface")
    if not scene.lights:
        raise ExtractError("no light to render: add an area, point, spot or sun light")
    return scene


def render_size(render: bpy.types.RenderSettings) -> tuple[int, int]:
    """Width and height of the full frame, pixels."""
    # In whole numbers, as Blender rounds it.
    width, height = (n * render.resolution_percentage // 100 for n in (render.resolution_x, render.resolution_y))
    return max(1, width), max(1, height)

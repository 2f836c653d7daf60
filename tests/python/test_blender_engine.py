"""Final renders: passes, border, view layers, transparency, animation, and what Blender evaluates."""

from __future__ import annotations

import subprocess
import sys

import bpy
import numpy as np
import pytest
from conftest import BINARY, MODULE, add_light, read_exr, use_multilayer_exr


def render(scene, path) -> dict[str, np.ndarray]:
    """F12 to a multilayer EXR: its channels, (height, width), top row first."""
    scene.render.engine = "PENUMBRA"
    use_multilayer_exr(scene, path)
    assert bpy.ops.render.render(write_still=True) == {"FINISHED"}
    return read_exr(path)


def by_binary(scene, tmp_path, *options: str) -> dict[str, np.ndarray]:
    """What the binary itself makes of the scene."""
    glb, exr = tmp_path / "scene.glb", tmp_path / "binary.exr"
    assert bpy.ops.penumbra.export_gltf(filepath=str(glb), evaluation="RENDER") == {"FINISHED"}
    width, height = scene.render.resolution_x, scene.render.resolution_y
    subprocess.run(
        [BINARY, "render", glb, "-o", exr, "--size", f"{width}x{height}", "--set", "samples=4", *options], check=True
    )
    return read_exr(exr)


@pytest.mark.timeout(120)
def test_every_pass_is_in_the_file_and_is_what_the_binary_says(scene, tmp_path):
    add_light(scene, "Fill.001", "POINT", location=(-3, -2, 4), energy=300.0, shadow_soft_size=0.3)
    layer = scene.view_layers[0]
    layer.use_pass_z = layer.use_pass_position = layer.use_pass_normal = True
    layer.penumbra.use_pass_irradiance = True
    image = render(scene, tmp_path / "f12.exr")
    truth = by_binary(scene, tmp_path, "--quantity", "shaded", "--aov", "position,shading_normal,depth")
    irradiance = by_binary(scene, tmp_path, "--quantity", "irradiance")
    name = layer.name
    for light in ("Key", "Fill.001"):
        assert np.array_equal(image[f"{name}.Visibility {light}.X"], truth[f"{light}.visibility"])
    for channel in "RGB":
        assert np.array_equal(image[f"{name}.Combined.{channel}"], truth[f"shaded.{channel}"])
        total = irradiance[f"Key.irradiance.{channel}"] + irradiance[f"Fill.001.irradiance.{channel}"]
        assert np.array_equal(image[f"{name}.Irradiance.{channel}"], total)
    covered = truth["coverage.A"] == 1.0
    assert not covered.all() and covered.any()
    assert np.array_equal(image[f"{name}.Depth.Z"][covered], truth["depth.Z"][covered])
    assert (image[f"{name}.Depth.Z"][~covered] == np.float32(1e10)).all()
    for layer_name, channel in (("Position", "position"), ("Normal", "shading_normal")):
        assert np.array_equal(image[f"{name}.{layer_name}.X"], truth[f"{channel}.X"])
        assert np.array_equal(image[f"{name}.{layer_name}.Y"], -truth[f"{channel}.Z"])
        assert np.array_equal(image[f"{name}.{layer_name}.Z"], truth[f"{channel}.Y"])


@pytest.mark.timeout(120)
def test_positions_are_those_that_cycles_sees(scene, tmp_path):
    layer = scene.view_layers[0]
    layer.use_pass_position = layer.use_pass_z = True
    ours = render(scene, tmp_path / "ours.exr")
    scene.render.engine = "CYCLES"
    scene.cycles.samples = 1
    scene.cycles.pixel_filter_type, scene.cycles.filter_width = "GAUSSIAN", 0.01
    use_multilayer_exr(scene, tmp_path / "cycles.exr")
    assert bpy.ops.render.render(write_still=True) == {"FINISHED"}
    theirs = read_exr(tmp_path / "cycles.exr")
    name = layer.name
    here, there = (np.stack([image[f"{name}.Position.{axis}"] for axis in "XYZ"], -1) for image in (ours, theirs))
    covered = (ours[f"{name}.Depth.Z"] < 1e9) & (theirs[f"{name}.Depth.Z"] < 1e9)
    assert (ours[f"{name}.Depth.Z"] < 1e9).sum() == pytest.approx(covered.sum(), abs=2)
    # A pixel of the camera (50 mm on 36 mm, 64 wide) at 12 m is 0.135 m; the pass was measured within 9e-4 of a pixel of the
    # centre, on the floor seen at 35° that is twice as long.
    apart = np.linalg.norm(here - there, axis=-1)[covered]
    assert np.quantile(apart, 0.99) < 2 * 9e-4 * 0.135
    depth = np.abs(ours[f"{name}.Depth.Z"] - theirs[f"{name}.Depth.Z"])[covered]
    assert np.quantile(depth, 0.99) < 2 * 9e-4 * 0.135


@pytest.mark.timeout(120)
@pytest.mark.parametrize("crop", [False, True])
@pytest.mark.parametrize("border", [(0.25, 0.75, 0.5, 1.0), (0.101, 0.467, 0.233, 0.911)])
def test_a_border_shows_the_same_pixels(scene, tmp_path, border, crop):
    full = render(scene, tmp_path / "full.exr")
    scene.render.use_border, scene.render.use_crop_to_border = True, crop
    r = scene.render
    r.border_min_x, r.border_max_x, r.border_min_y, r.border_max_y = border
    part = render(scene, tmp_path / "part.exr")
    left, bottom, right, top = sys.modules[f"{MODULE}.engine"].border_px(r, (64, 48))
    x0, x1, y0, y1 = border
    assert (left, bottom, right, top) == (int(x0 * 64), int(y0 * 48), int(x1 * 64), int(y1 * 48))
    channel = "ViewLayer.Visibility Key.X"
    expected = full[channel][48 - top : 48 - bottom, left:right]
    if crop:
        assert np.array_equal(part[channel], expected)
    else:
        assert np.array_equal(part[channel][48 - top : 48 - bottom, left:right], expected)
        outside = np.ones((48, 64), bool)
        outside[48 - top : 48 - bottom, left:right] = False
        assert not part[channel][outside].any()


@pytest.mark.timeout(120)
def test_view_layers_show_their_own_collections(scene, tmp_path):
    cubes = bpy.data.collections.new("Cubes")
    scene.collection.children.link(cubes)
    cube = scene.objects["Cube"]
    scene.collection.objects.unlink(cube)
    cubes.objects.link(cube)
    empty = scene.view_layers.new("Floor only")
    empty.layer_collection.children["Cubes"].exclude = True
    image = render(scene, tmp_path / "layers.exr")
    with_cube, without = (image[f"{name}.Visibility Key.X"] for name in ("ViewLayer", "Floor only"))
    assert (with_cube < 1).sum() > 100
    # Nothing blocks the light, which the floor faces: 1 wherever there is a floor, and where there is nothing.
    assert (without == 1).all()


@pytest.mark.timeout(120)
def test_transparent_film_has_no_background(scene, tmp_path):
    assert (render(scene, tmp_path / "opaque.exr")["ViewLayer.Combined.A"] == 1).all()
    scene.render.film_transparent = True
    alpha = render(scene, tmp_path / "transparent.exr")["ViewLayer.Combined.A"]
    assert np.array_equal(alpha, by_binary(scene, tmp_path)["coverage.A"])
    assert 0 < alpha.sum() < alpha.size


@pytest.mark.timeout(120)
def test_an_animation_is_rendered_frame_by_frame(scene, tmp_path):
    cube = scene.objects["Cube"]
    for frame, x in ((1, 0.0), (3, 2.0)):
        cube.location.x = x
        cube.keyframe_insert("location", index=0, frame=frame)
    scene.frame_start, scene.frame_end = 1, 3
    scene.render.engine = "PENUMBRA"
    use_multilayer_exr(scene, tmp_path / "frame.####.exr")
    assert bpy.ops.render.render(animation=True) == {"FINISHED"}
    frames = [read_exr(tmp_path / f"frame.000{frame}.exr")["ViewLayer.Visibility Key.X"] for frame in (1, 2, 3)]
    scene.frame_set(2)
    assert np.array_equal(frames[1], by_binary(scene, tmp_path)["Key.visibility"])
    assert not np.array_equal(frames[0], frames[1]) and not np.array_equal(frames[1], frames[2])


def shown(scene, tmp_path) -> dict:
    """`penumbra info` of what a render evaluates."""
    import json

    path = tmp_path / "scene.glb"
    assert bpy.ops.penumbra.export_gltf(filepath=str(path), evaluation="RENDER") == {"FINISHED"}
    return json.loads(subprocess.run([BINARY, "info", path, "--json"], capture_output=True, check=True).stdout)


@pytest.mark.timeout(120)
def test_render_visibility_and_subdivision_decide(scene, tmp_path):
    cube = scene.objects["Cube"]
    modifier = cube.modifiers.new("Subdivision", "SUBSURF")
    modifier.levels, modifier.render_levels = 1, 3
    # 6 faces · 4^3 quads, and the floor.
    assert shown(scene, tmp_path)["triangles"] == 6 * 64 * 2 + 2
    cube.hide_viewport = True
    assert shown(scene, tmp_path)["triangles"] == 6 * 64 * 2 + 2
    cube.hide_viewport, cube.hide_render = False, True
    assert shown(scene, tmp_path)["triangles"] == 2


@pytest.mark.timeout(120)
def test_usd_has_the_subdivided_surface(scene, tmp_path):
    from pxr import Usd, UsdGeom

    modifier = scene.objects["Cube"].modifiers.new("Subdivision", "SUBSURF")
    modifier.levels, modifier.render_levels = 1, 3
    path = tmp_path / "scene.usdc"
    assert bpy.ops.penumbra.export_usd(filepath=str(path)) == {"FINISHED"}
    stage = Usd.Stage.Open(str(path))
    meshes = [UsdGeom.Mesh(prim) for prim in stage.Traverse() if prim.IsA(UsdGeom.Mesh)]
    assert sorted(len(mesh.GetFaceVertexCountsAttr().Get()) for mesh in meshes) == [1, 6 * 64]


@pytest.mark.timeout(120)
def test_instances_stay_instances(scene, tmp_path):
    cube = scene.objects["Cube"]
    for number in range(9):
        linked = bpy.data.objects.new(f"Linked {number}", cube.data)
        linked.location = (number - 4, 2, 0.5)
        scene.collection.objects.link(linked)
    inner = bpy.data.collections.new("Inner")
    inner.objects.link(bpy.data.objects.new("Inside", cube.data))
    for number in range(3):
        empty = bpy.data.objects.new(f"Instancer {number}", None)
        empty.instance_type, empty.instance_collection = "COLLECTION", inner
        empty.location = (number, -2, 0.5)
        scene.collection.objects.link(empty)
    info = shown(scene, tmp_path)
    assert info["instances"] == 1 + 1 + 9 + 3
    assert info["unique_triangles"] == 12 + 2
    assert info["triangles"] == 13 * 12 + 2


@pytest.mark.timeout(120)
def test_many_instances_are_one_node_in_the_same_places(scene, tmp_path):
    """Vertices of a grid carry a cube each, turned and scaled by its parent."""
    bpy.ops.mesh.primitive_grid_add(x_subdivisions=9, y_subdivisions=9, size=6, location=(0, 0, 0.2), rotation=(0.2, 0.1, 0.7))
    grid = bpy.context.object
    bpy.ops.mesh.primitive_cube_add(size=0.2)
    carried = bpy.context.object
    carried.parent, grid.instance_type, grid.show_instancer_for_render = grid, "VERTS", False
    bpy.context.view_layer.update()
    expected = sorted(tuple(grid.matrix_world @ vertex.co) for vertex in grid.data.vertices)
    info = shown(scene, tmp_path)
    assert info["instances"] == 2 + len(expected)
    low, high = info["bounds_world"]
    reach = max(point[2] for point in expected)
    # The cubes are turned as the grid is: their corners reach at most half their diagonal above their centre.
    assert reach <= high[1] <= max(reach + 0.2 * 3**0.5 / 2, 1.6 + 1e-6)
    data = (tmp_path / "scene.glb").read_bytes()
    assert b"EXT_mesh_gpu_instancing" in data
    module = sys.modules[f"{MODULE}.glb"]
    matrices = np.stack([np.array(grid.matrix_world) for _ in range(3)]).astype(float)
    translations, rotations, scales = module._decomposed(matrices)
    x, y, z, w = rotations[0]
    turned = np.array([2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)])
    # Unit quaternions of float matrices: a few roundings.
    assert np.allclose(turned * scales[0][1], np.array(grid.matrix_world)[:3, 1], atol=1e-6)


@pytest.mark.timeout(120)
def test_geometry_nodes_and_particles_make_instances(scene, tmp_path):
    bpy.ops.mesh.primitive_grid_add(x_subdivisions=4, y_subdivisions=4, size=4, location=(0, 0, 0.3))
    grid = bpy.context.object
    points = len(grid.data.vertices)
    tree = bpy.data.node_groups.new("Cubes on points", "GeometryNodeTree")
    tree.interface.new_socket(name="Geometry", in_out="INPUT", socket_type="NodeSocketGeometry")
    tree.interface.new_socket(name="Geometry", in_out="OUTPUT", socket_type="NodeSocketGeometry")
    start, end = tree.nodes.new("NodeGroupInput"), tree.nodes.new("NodeGroupOutput")
    spread, cube = tree.nodes.new("GeometryNodeInstanceOnPoints"), tree.nodes.new("GeometryNodeMeshCube")
    tree.links.new(start.outputs[0], spread.inputs["Points"])
    tree.links.new(cube.outputs["Mesh"], spread.inputs["Instance"])
    tree.links.new(spread.outputs["Instances"], end.inputs[0])
    before = shown(scene, tmp_path)
    grid.modifiers.new("Nodes", "NODES").node_group = tree
    info = shown(scene, tmp_path)
    # The grid itself gives way to the cubes, which are one mesh.
    assert info["instances"] == before["instances"] - 1 + points
    assert info["unique_triangles"] == 2 + 12 + 12

    bpy.ops.mesh.primitive_plane_add(size=3, location=(0, 0, 2))
    emitter = bpy.context.object
    emitter.modifiers.new("Hair", "PARTICLE_SYSTEM")
    hair = emitter.particle_systems[0].settings
    hair.type, hair.count, hair.render_type, hair.instance_object = "HAIR", 7, "OBJECT", scene.objects["Cube"]
    with_hair = shown(scene, tmp_path)
    assert with_hair["instances"] == info["instances"] + 1 + 7
    assert with_hair["unique_triangles"] == info["unique_triangles"] + 2


@pytest.mark.timeout(120)
@pytest.mark.parametrize("percentage", [29, 33, 57, 100])
def test_the_size_is_blenders(scene, tmp_path, percentage):
    scene.render.resolution_x, scene.render.resolution_y, scene.render.resolution_percentage = 100, 99, percentage
    image = render(scene, tmp_path / "f12.exr")
    height, width = image["ViewLayer.Combined.R"].shape
    assert sys.modules[f"{MODULE}.extract"].render_size(scene.render) == (width, height)
    assert image["ViewLayer.Visibility Key.X"].min() < 0.5


@pytest.mark.timeout(120)
def test_stereoscopy_is_refused(scene, tmp_path):
    scene.render.use_multiview = True
    scene.render.engine = "PENUMBRA"
    use_multilayer_exr(scene, tmp_path / "f12.exr")
    with pytest.raises(RuntimeError, match="stereoscopy is not supported"):
        bpy.ops.render.render(write_still=True)


@pytest.mark.timeout(120)
def test_curves_text_and_metaballs_are_surfaces_too(scene, tmp_path):
    before = shown(scene, tmp_path)["triangles"]
    bpy.ops.curve.primitive_bezier_circle_add(location=(3, 0, 1))
    bpy.context.object.data.bevel_depth = 0.1
    curve = shown(scene, tmp_path)["triangles"]
    bpy.ops.object.text_add(location=(-3, 0, 0.1))
    text = shown(scene, tmp_path)["triangles"]
    bpy.ops.object.metaball_add(location=(0, 3, 1))
    assert before < curve < text < shown(scene, tmp_path)["triangles"]


@pytest.mark.timeout(120)
def test_smooth_surfaces_have_blenders_normals_and_materials_their_colour(scene, tmp_path):
    bpy.ops.mesh.primitive_uv_sphere_add(segments=16, ring_count=8, radius=0.6, location=(0, 0, 2.2))
    sphere = bpy.context.object
    for polygon in sphere.data.polygons:
        polygon.use_smooth = True
    red = bpy.data.materials.new("Red")
    if bpy.app.version < (5, 0, 0):
        red.use_nodes = True
    shader = next(node for node in red.node_tree.nodes if node.type == "BSDF_PRINCIPLED")
    shader.inputs["Base Color"].default_value = (0.5, 0.25, 0.125, 1.0)
    floor_blue = bpy.data.materials.new("Blue")
    floor_blue.diffuse_color = (0, 0, 1, 1)
    sphere.data.materials.append(red)
    scene.objects["Floor"].data.materials.append(red)
    image = by_binary(scene, tmp_path, "--quantity", "shaded", "--aov", "normal,shading_normal,position")
    irradiance = by_binary(scene, tmp_path, "--quantity", "irradiance")
    position = np.stack([image[f"position.{axis}"] for axis in "XYZ"], -1)
    centre = np.array([0.0, 2.2, 0.0])
    on_sphere = (np.abs(np.linalg.norm(position - centre, axis=-1) - 0.6) < 0.03) & (image["coverage.A"] > 0)
    assert on_sphere.sum() > 10
    towards = (position - centre) / np.linalg.norm(position - centre, axis=-1, keepdims=True)
    smooth = np.stack([image[f"shading_normal.{axis}"] for axis in "XYZ"], -1)
    flat = np.stack([image[f"normal.{axis}"] for axis in "XYZ"], -1)
    errors = [np.arccos(np.clip((n * towards).sum(-1)[on_sphere], -1, 1)).max() for n in (smooth, flat)]
    # Flat faces of 22.5° are up to 11° and more off at their corners; interpolated normals are not.
    assert errors[0] < 0.5 * errors[1]
    for channel, color in zip("RGB", (0.5, 0.25, 0.125)):
        expected = color / np.pi * irradiance[f"Key.irradiance.{channel}"][on_sphere]
        # Single precision, and a product of three factors.
        assert image[f"shaded.{channel}"][on_sphere] == pytest.approx(expected, rel=4e-7, abs=1e-9)


@pytest.mark.timeout(120)
def test_mixed_smooth_and_flat_faces_and_several_materials(scene, tmp_path):
    bpy.ops.mesh.primitive_cylinder_add(vertices=12, location=(2, 0, 1))
    cylinder = bpy.context.object
    for polygon in cylinder.data.polygons:
        polygon.use_smooth = abs(polygon.normal.z) < 0.5
        polygon.material_index = int(polygon.normal.z > 0.5)
    for name in ("Side", "Top"):
        cylinder.data.materials.append(bpy.data.materials.new(name))
    info = shown(scene, tmp_path)
    assert info["triangles"] == 14 + 12 * 2 + 10 * 2
    assert info["materials"] == 3

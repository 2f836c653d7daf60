"""Image textures: base colours where Cycles has them, and cut-outs that let the light through."""

from __future__ import annotations

import json
import subprocess
import sys

import bpy
import numpy as np
import pytest
from conftest import BINARY, MODULE, read_exr, use_multilayer_exr


def image(name: str, rgba: np.ndarray, *, color_space: str = "sRGB", is_float: bool = False) -> bpy.types.Image:
    """An image of values as stored, (height, width, 4), bottom row first."""
    height, width, _ = rgba.shape
    made = bpy.data.images.new(name, width, height, alpha=True, float_buffer=is_float)
    made.colorspace_settings.name = color_space
    made.pixels.foreach_set(np.ascontiguousarray(rgba, np.float32).ravel())
    made.update()
    return made


def material(name: str) -> tuple[bpy.types.Material, bpy.types.Node]:
    """A material and its Principled BSDF, wholly diffuse."""
    made = bpy.data.materials.new(name)
    if bpy.app.version < (5, 0, 0):
        made.use_nodes = True
    shader = next(node for node in made.node_tree.nodes if node.type == "BSDF_PRINCIPLED")
    shader.inputs["Specular IOR Level"].default_value = 0.0
    return made, shader


def textured(made: bpy.types.Material, of: bpy.types.Image, **values) -> bpy.types.Node:
    """An image texture node."""
    node = made.node_tree.nodes.new("ShaderNodeTexImage")
    node.image = of
    node.interpolation = "Closest"
    for key, value in values.items():
        setattr(node, key, value)
    return node


def random_colors(*, alpha: float = 1.0) -> np.ndarray:
    """Six by four texels as bytes store them."""
    rgba = np.random.default_rng(1).integers(0, 256, (4, 6, 4)) / 255.0
    rgba[..., 3] = alpha
    return rgba


def rendered(scene, tmp_path, quantity: str) -> dict[str, np.ndarray]:
    """What the binary makes of the scene as it is rendered."""
    glb, exr = tmp_path / "scene.glb", tmp_path / f"{quantity}.exr"
    assert bpy.ops.penumbra.export_gltf(filepath=str(glb), evaluation="RENDER") == {"FINISHED"}
    size = f"{scene.render.resolution_x}x{scene.render.resolution_y}"
    command = [BINARY, "render", glb, "-o", exr, "--size", size, "--set", "samples=4", "--quantity", quantity]
    subprocess.run(command, check=True)
    return read_exr(exr)


def base_color_by_cycles(scene, path) -> np.ndarray:
    """Cycles' pass of diffuse colour at pixel centres."""
    scene.render.engine = "CYCLES"
    scene.cycles.samples = 1
    scene.cycles.pixel_filter_type, scene.cycles.filter_width = "GAUSSIAN", 0.01
    scene.view_layers[0].use_pass_diffuse_color = True
    use_multilayer_exr(scene, path)
    assert bpy.ops.render.render(write_still=True) == {"FINISHED"}
    channels = read_exr(path)
    name = next(name for name in ("DiffCol", "Diffuse Color") if f"{scene.view_layers[0].name}.{name}.R" in channels)
    return np.stack([channels[f"{scene.view_layers[0].name}.{name}.{channel}"] for channel in "RGB"], -1)


def map_in_place(node: bpy.types.Node, tree: bpy.types.NodeTree, source: str) -> None:
    """Coordinates moved, turned and scaled unevenly, from a UV map node or texture coordinates."""
    mapping = tree.nodes.new("ShaderNodeMapping")
    mapping.inputs["Location"].default_value = (0.13, -0.21, 0.0)
    mapping.inputs["Rotation"].default_value = (0.0, 0.0, 0.4)
    mapping.inputs["Scale"].default_value = (1.7, 0.6, 1.0)
    tree.links.new(mapping.outputs[0], node.inputs["Vector"])
    at = tree.nodes.new(source)
    tree.links.new(at.outputs["UV"], mapping.inputs["Vector"])


@pytest.mark.timeout(120)
@pytest.mark.parametrize(
    ("color_space", "is_float", "extension", "source"),
    [
        ("sRGB", False, "REPEAT", None),
        ("sRGB", False, "EXTEND", "ShaderNodeTexCoord"),
        ("sRGB", False, "MIRROR", "ShaderNodeUVMap"),
        ("Non-Color", False, "REPEAT", "ShaderNodeUVMap"),
        ("Linear Rec.709", True, "REPEAT", None),
    ],
)
def test_textures_are_where_cycles_has_them(scene, tmp_path, color_space, is_float, extension, source):
    # In Cycles what has no material has a coat, which takes from its diffuse colour.
    bpy.data.objects.remove(scene.objects["Cube"])
    floor = scene.objects["Floor"]
    made, shader = material("Painted")
    node = textured(made, image("Colors", random_colors(), color_space=color_space, is_float=is_float), extension=extension)
    if source is not None:
        map_in_place(node, made.node_tree, source)
    made.node_tree.links.new(node.outputs["Color"], shader.inputs["Base Color"])
    floor.data.materials.append(made)
    shaded, lit = (rendered(scene, tmp_path, quantity) for quantity in ("shaded", "irradiance"))
    expected = base_color_by_cycles(scene, tmp_path / "cycles.exr")
    irradiance = np.stack([lit[f"Key.irradiance.{channel}"] for channel in "RGB"], -1)
    seen = (lit["coverage.A"] == 1.0) & (irradiance.min(-1) > 0.05 * irradiance.max())
    found = np.pi * np.stack([shaded[f"shaded.{channel}"] for channel in "RGB"], -1)[seen] / irradiance[seen]
    apart = np.abs(found - expected[seen]).max(-1)
    assert seen.mean() > 0.5 and np.ptp(expected[seen]) > 0.5
    # Texels of 8 bits, stored as sRGB: half a step is 0.0045 at white. Few pixels' centres lie on texels' edges.
    assert np.quantile(apart, 0.99) < 0.006


def card(scene, *, left: float, right: float) -> bpy.types.Object:
    """A horizontal card between two x, over the floor."""
    mesh = bpy.data.meshes.new("Card")
    corners = [(left, -0.7, 0), (right, -0.7, 0), (right, 0.7, 0), (left, 0.7, 0)]
    mesh.from_pydata(corners, [], [(0, 1, 2, 3)])
    layer = mesh.uv_layers.new(name="UVMap")
    layer.data.foreach_set("uv", [(x + 1.0) / 2.0 if axis == 0 else 0.5 for x, *_ in corners for axis in (0, 1)])
    item = bpy.data.objects.new("Card", mesh)
    item.location = (-1.5, -1.0, 0.8)
    scene.collection.objects.link(item)
    return item


@pytest.mark.timeout(120)
@pytest.mark.parametrize("how", ["alpha", "threshold", "mix", "other image", "dirty file"])
def test_light_passes_where_alpha_cuts_a_surface_out(scene, tmp_path, how):
    item = card(scene, left=-1.0, right=0.0)
    half = rendered(scene, tmp_path, "visibility")
    bpy.data.objects.remove(item)
    item = card(scene, left=-1.0, right=1.0)
    whole = rendered(scene, tmp_path, "visibility")

    made, shader = material("Leaf")
    links, nodes = made.node_tree.links, made.node_tree.nodes
    rgba = np.ones((2, 2, 4))
    rgba[:, 1, 3] = 0.4
    if how == "dirty file":
        path = tmp_path / "leaf.png"
        of = image("Leaf", np.ones((2, 2, 4)))
        of.filepath_raw, of.file_format = str(path), "PNG"
        of.save()
        # Painted since.
        of.pixels.foreach_set(rgba.astype(np.float32).ravel())
    elif how == "other image":
        of = image("Color", np.full((2, 2, 4), 0.5))
        mask = rgba.copy()
        mask[..., :3] = rgba[..., 3:]
        mask[..., 3] = 1.0
        other = textured(made, image("Mask", mask, color_space="Non-Color"))
        links.new(other.outputs["Color"], shader.inputs["Alpha"])
    else:
        of = image("Leaf", rgba)
    node = textured(made, of)
    links.new(node.outputs["Color"], shader.inputs["Base Color"])
    if how in {"alpha", "dirty file"}:
        links.new(node.outputs["Alpha"], shader.inputs["Alpha"])
    elif how == "threshold":
        math = nodes.new("ShaderNodeMath")
        math.operation = "GREATER_THAN"
        math.inputs[1].default_value = 0.45
        links.new(node.outputs["Alpha"], math.inputs[0])
        links.new(math.outputs[0], shader.inputs["Alpha"])
    elif how == "mix":
        mix, clear = nodes.new("ShaderNodeMixShader"), nodes.new("ShaderNodeBsdfTransparent")
        output = made.node_tree.get_output_node("CYCLES")
        links.new(node.outputs["Alpha"], mix.inputs[0])
        links.new(clear.outputs[0], mix.inputs[1])
        links.new(shader.outputs[0], mix.inputs[2])
        links.new(mix.outputs[0], output.inputs["Surface"])
    item.data.materials.append(made)
    found = rendered(scene, tmp_path, "visibility")

    assert np.abs(whole["Key.visibility"] - half["Key.visibility"]).max() == 1.0
    # A sample of four in some pixels may pass by the other side of the edge where the card's middle is cut.
    apart = np.abs(found["Key.visibility"] - half["Key.visibility"])
    assert apart.max() <= 0.25 and (apart > 0.0).sum() <= 3


@pytest.mark.timeout(120)
def test_what_is_not_carried_over_is_told(scene, tmp_path, capfd):
    floor = scene.objects["Floor"]
    made, shader = material("Odd")
    links, nodes = made.node_tree.links, made.node_tree.nodes
    noise = nodes.new("ShaderNodeTexNoise")
    links.new(noise.outputs["Color"], shader.inputs["Base Color"])
    links.new(noise.outputs[0], shader.inputs["Alpha"])
    floor.data.materials.append(made)
    glass, glass_shader = material("Glass")
    glass_shader.inputs["Alpha"].default_value = 0.3
    node = textured(glass, image("Clipped", random_colors()), extension="CLIP")
    glass.node_tree.links.new(node.outputs["Color"], glass_shader.inputs["Base Color"])
    scene.objects["Cube"].data.materials.append(glass)
    loose, loose_shader = material("Loose")
    reroute = loose.node_tree.nodes.new("NodeReroute")
    loose.node_tree.links.new(reroute.outputs[0], loose_shader.inputs["Alpha"])
    empty = textured(loose, image("Empty", random_colors()))
    empty.image = None
    muted = loose.node_tree.links.new(empty.outputs["Color"], loose_shader.inputs["Base Color"])
    muted.is_muted = True
    item = card(scene, left=-1.0, right=0.0)
    item.data.materials.append(loose)
    mixed, mixed_shader = material("Mixed")
    mixed_shader.inputs["Alpha"].default_value = 0.5
    nodes = mixed.node_tree.nodes
    mix, output = nodes.new("ShaderNodeMixShader"), next(node for node in nodes if node.type == "OUTPUT_MATERIAL")
    mix.inputs[0].default_value = 1.0
    mixed.node_tree.links.new(nodes.new("ShaderNodeBsdfTransparent").outputs[0], mix.inputs[1])
    mixed.node_tree.links.new(mixed_shader.outputs[0], mix.inputs[2])
    mixed.node_tree.links.new(mix.outputs[0], output.inputs["Surface"])
    card(scene, left=0.0, right=1.0).data.materials.append(mixed)
    assert bpy.ops.penumbra.preview() == {"FINISHED"}
    told = " ".join(sys.modules[f"{MODULE}.preview"].Preview.current.caption)
    for message in (
        "'Odd': its base colour comes from nodes; its viewport colour is used",
        "'Odd': its alpha comes from nodes; it is taken as opaque",
        "'Glass': transparency is not supported; it is taken as opaque",
        "'Glass': its texture's extension clip is not supported; its viewport colour is used",
        "'Mixed': it is mixed with a Transparent BSDF; its own alpha is left out",
    ):
        assert message in told
    # What feeds nothing is as if it were not there.
    assert "'Loose'" not in told


@pytest.mark.timeout(120)
def test_muted_nodes_and_meshes_without_uv_map_look_as_in_cycles(scene, tmp_path):
    colors = np.ones((2, 2, 4))
    colors[..., :3] = [[[1, 0, 0], [0, 1, 0]], [[0, 0, 1], [1, 1, 0]]]
    pixels = image("Corners", colors)
    for name, left, muted, mapped in (("Muted", -2.0, True, True), ("Plain", 0.0, False, False)):
        made, shader = material(name)
        node = textured(made, pixels)
        node.mute = muted
        shader.inputs["Base Color"].default_value = (0.2, 0.4, 0.6, 1.0)
        made.node_tree.links.new(node.outputs["Color"], shader.inputs["Base Color"])
        item = card(scene, left=left, right=left + 1.5)
        item.data.materials.append(made)
        if not mapped:
            while item.data.uv_layers:
                item.data.uv_layers.remove(item.data.uv_layers[0])
    ours = rendered(scene, tmp_path, "shaded")
    assert "shaded.R" in ours
    path = tmp_path / "scene.glb"
    document = json.loads(path.read_bytes()[20 : 20 + int.from_bytes(path.read_bytes()[12:16], "little")])
    by_name = {made["name"]: made["pbrMetallicRoughness"] for made in document["materials"]}
    assert "baseColorTexture" not in by_name["Muted"]
    assert by_name["Muted"]["baseColorFactor"][:3] == pytest.approx([0.2, 0.4, 0.6])
    # The corner of the image where u and v are 0: red.
    assert "baseColorTexture" in by_name["Plain"]


def test_surfaces_that_light_passes_cast_no_shadow(scene, tmp_path):
    cube = scene.objects["Cube"]
    lit = []
    for kind in ("none", "transparent", "volume"):
        made, shader = material(kind)
        tree = made.node_tree
        output = next(node for node in tree.nodes if node.type == "OUTPUT_MATERIAL")
        if kind != "none":
            tree.nodes.remove(shader)
            other = tree.nodes.new("ShaderNodeBsdfTransparent" if kind == "transparent" else "ShaderNodeVolumePrincipled")
            tree.links.new(other.outputs[0], output.inputs["Surface" if kind == "transparent" else "Volume"])
        cube.data.materials.clear()
        cube.data.materials.append(made)
        layers = rendered(scene, tmp_path, "visibility")
        name = next(name for name in layers if name.endswith(".visibility"))
        lit.append(float((layers[name] < 0.5).sum()))
    assert lit[0] > 0.0
    assert lit[1:] == [0.0, 0.0]


@pytest.mark.timeout(120)
def test_a_comparison_with_cycles_takes_cut_outs_as_whole(scene):
    made, shader = material("Nothing")
    shader.inputs["Alpha"].default_value = 0.0
    scene.objects["Cube"].data.materials.append(made)
    scene.penumbra.cycles_samples = 4
    assert bpy.ops.penumbra.compare() == {"FINISHED"}
    lines = sys.modules[f"{MODULE}.compare"].last_lines
    assert lines[-1] == "Cut-outs are taken as whole, in both"
    # The cube's shadow is in Cycles' picture, and in ours.
    assert float(lines[0].split("RMSE ")[1].split(",")[0]) < 0.25


def test_uv_maps_of_geometry_nodes_are_read(scene):
    mesh = scene.objects["Cube"].data
    mesh.attributes.new("places", "FLOAT_VECTOR", "POINT").data.foreach_set(
        "vector", [vertex for v in mesh.vertices for vertex in v.co]
    )
    made, shader = material("Placed")
    node = textured(made, image("Colors", random_colors()))
    uv_map = made.node_tree.nodes.new("ShaderNodeUVMap")
    uv_map.uv_map = "places"
    made.node_tree.links.new(uv_map.outputs[0], node.inputs["Vector"])
    made.node_tree.links.new(node.outputs["Color"], shader.inputs["Base Color"])
    mesh.materials.clear()
    mesh.materials.append(made)
    preview = sys.modules[f"{MODULE}.preview"]
    found = preview.harvest(scene, bpy.context.view_layer, None, (64, 48)).scene
    uvs = next(mesh.uvs["places"] for mesh in found.meshes if "places" in mesh.uvs)
    places = np.array([vertex.co for vertex in scene.objects["Cube"].data.vertices])
    assert set(uvs[:, 0]) == set(places[:, 0])
    # v is turned over.
    assert set(uvs[:, 1]) == set(1.0 - places[:, 1])


@pytest.mark.parametrize("space", ["Rec.1886", "Display P3"])
def test_color_spaces_that_are_not_read_are_told(scene, space):
    names = {
        item.name for item in bpy.types.Image.bl_rna.properties["colorspace_settings"].fixed_type.properties["name"].enum_items
    }
    if space not in names:
        pytest.skip(f"this Blender has no colour space {space}")
    made, shader = material("Other")
    node = textured(made, image("Wide", random_colors(), color_space=space))
    made.node_tree.links.new(node.outputs["Color"], shader.inputs["Base Color"])
    scene.objects["Cube"].data.materials.clear()
    scene.objects["Cube"].data.materials.append(made)
    assert bpy.ops.penumbra.preview() == {"FINISHED"}
    told = " ".join(sys.modules[f"{MODULE}.preview"].Preview.current.caption)
    assert f"image 'Wide' is in {space}" in told

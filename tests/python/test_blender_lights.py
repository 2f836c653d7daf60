"""Every light keeps shape, size, emission, flags and linking: Blender → glTF and GLB → the binary; Blender → USD → pxr."""

from __future__ import annotations

import json
import math
import subprocess

import bpy
import pytest
from conftest import BINARY, add_light

# What Blender's lights should be, from powers, sizes and scales. A: area of the emitter, m²; r: radius, m. Blender's values are
# floats, and so is an object's scale: relative 1e-6 is eight of their roundings.
ROUNDING = 1e-6

AREA = {
    "square": (dict(shape="SQUARE", size=0.5, size_y=0.9, energy=100.0), (1, 1, 1), "rect", (0.5, 0.5)),
    "rect": (dict(shape="RECTANGLE", size=1.5, size_y=0.8, energy=200.0), (1, 1, 1), "rect", (1.5, 0.8)),
    "disk": (dict(shape="DISK", size=0.8, size_y=0.3, energy=100.0), (1, 1, 1), "disk", (0.8, 0.8)),
    "ellipse": (dict(shape="ELLIPSE", size=0.8, size_y=0.3, energy=100.0), (1, 1, 1), "disk", (0.8, 0.3)),
    "scaled rect": (dict(shape="RECTANGLE", size=1.0, size_y=1.0, energy=100.0), (2.0, 0.5, 3.0), "rect", (2.0, 0.5)),
    "scaled disk": (dict(shape="DISK", size=1.0, energy=100.0), (2.0, 0.5, 1.0), "disk", (2.0, 0.5)),
    "exposed": (dict(shape="SQUARE", size=1.0, energy=10.0, exposure=2.0, color=(1.0, 0.5, 0.25)), (1, 1, 1), "rect", (1, 1)),
    "not normalised": (dict(shape="SQUARE", size=2.0, energy=10.0, normalize=False), (1, 1, 1), "rect", (2, 2)),
    "spread": (dict(shape="SQUARE", size=1.0, energy=10.0, spread=math.radians(90)), (1, 1, 1), "rect", (1, 1)),
    "no shadow": (dict(shape="SQUARE", size=1.0, energy=10.0, use_shadow=False), (1, 1, 1), "rect", (1, 1)),
}


def area_radiance(values: dict, size: tuple[float, float], is_disk: bool) -> list[float]:
    """L = P 2^exposure / (π A)."""
    area = size[0] * size[1] * (math.pi / 4 if is_disk else 1.0) if values.get("normalize", True) else 1.0
    radiance = values["energy"] * 2 ** values.get("exposure", 0.0) / (math.pi * area)
    return [radiance * component for component in values.get("color", (1.0, 1.0, 1.0))]


ROUND = {
    "point": ("POINT", dict(energy=100.0, shadow_soft_size=0.25), "sphere", "radius", 100 / (4 * math.pi**2 * 0.25**2), True),
    "hard point": (
        "POINT",
        dict(energy=100.0, shadow_soft_size=0.5, use_soft_falloff=False),
        "sphere",
        "radius",
        100 / (4 * math.pi**2 * 0.5**2),
        False,
    ),
    "bare point": ("POINT", dict(energy=100.0, shadow_soft_size=0.0), "point", "intensity", 100 / (4 * math.pi), False),
    "spot": (
        "SPOT",
        dict(energy=100.0, shadow_soft_size=0.25, spot_size=1.0, spot_blend=0.3),
        "sphere",
        "radius",
        100 / (4 * math.pi**2 * 0.25**2),
        True,
    ),
}


def info(path) -> dict:
    """`penumbra info` of a file."""
    return json.loads(subprocess.run([BINARY, "info", path, "--json"], capture_output=True, check=True).stdout)


def numbers(text: str) -> list[float]:
    """The numbers of `0.5 x 0.8 m` or `1/2/3 W/sr`; one for all three where they are equal."""
    return [float(part) for part in text.split(" W")[0].split(" m")[0].replace(" x ", "/").split("/")]


def rgb(text: str) -> list[float]:
    """The three components of an emission."""
    values = numbers(text)
    return values * 3 if len(values) == 1 else values


@pytest.fixture(params=["EXPORTER", "RENDER"])
def exported(request, scene, tmp_path):
    """Exports and loads the scene: a function that gives lights by name."""

    def export() -> dict[str, dict]:
        path = tmp_path / "scene.glb"
        assert bpy.ops.penumbra.export_gltf(filepath=str(path), evaluation=request.param) == {"FINISHED"}
        return {light["name"]: light for light in info(path)["lights"]}

    return export


@pytest.mark.timeout(120)
def test_area_lights_keep_shape_size_radiance_and_flags(scene, exported):
    for name, (values, scale, _, _) in AREA.items():
        add_light(scene, name, "AREA", scale=scale, **values)
    lights = exported()
    for name, (values, _, shape, size) in AREA.items():
        light = lights[name]
        assert light["shape"] == shape, name
        assert numbers(light["size"]) == pytest.approx(size, rel=ROUNDING), name
        assert rgb(light["emission"]) == pytest.approx(area_radiance(values, size, shape == "disk"), rel=ROUNDING), name
        assert light["casts_shadow"] == values.get("use_shadow", True), name
        degrees = light.get("spread_degrees")
        assert degrees == (pytest.approx(90, rel=ROUNDING) if name == "spread" else None), name


@pytest.mark.timeout(120)
def test_round_lights_keep_radius_emission_and_falloff(scene, exported):
    for name, (kind, values, *_) in ROUND.items():
        add_light(scene, name, kind, **values)
    lights = exported()
    for name, (kind, values, shape, _, emission, facing) in ROUND.items():
        light = lights[name]
        assert light["shape"] == shape, name
        assert rgb(light["emission"]) == pytest.approx([emission] * 3, rel=ROUNDING), name
        if shape == "sphere":
            radius = float(light["size"].split()[1])
            assert radius == pytest.approx(values["shadow_soft_size"], rel=ROUNDING), name
            assert light["size"].endswith("facing") == facing, name
        if kind == "SPOT":
            outer = 0.5
            inner = math.acos(math.cos(outer) + 0.3 * (1 - math.cos(outer)))
            assert light["cone_degrees"] == pytest.approx([math.degrees(inner), math.degrees(outer)], rel=ROUNDING)


@pytest.mark.timeout(120)
def test_lights_without_normalisation_emit_by_their_surface(scene, tmp_path):
    """By our own way alone: the glTF exporter of Blender 5.0 fails on such points and spots (it calls `area` with a
    wrong name), and those before it ignore the setting."""
    add_light(scene, "Point", "POINT", energy=100.0, shadow_soft_size=0.25, normalize=False)
    add_light(scene, "Sun", "SUN", energy=4.0, angle=math.radians(20), normalize=False)
    path = tmp_path / "scene.glb"
    assert bpy.ops.penumbra.export_gltf(filepath=str(path), evaluation="RENDER") == {"FINISHED"}
    lights = {light["name"]: light for light in info(path)["lights"]}
    assert rgb(lights["Point"]["emission"]) == pytest.approx([100 / math.pi] * 3, rel=ROUNDING)
    irradiance = 4 * math.pi * math.sin(math.radians(10)) ** 2
    assert rgb(lights["Sun"]["emission"]) == pytest.approx([irradiance] * 3, rel=ROUNDING)


@pytest.mark.timeout(120)
def test_a_spot_may_be_as_wide_as_blender_lets_it(scene, exported):
    add_light(scene, "Wide", "SPOT", spot_size=math.pi, spot_blend=0.0)
    assert exported()["Wide"]["cone_degrees"] == [90.0, 90.0]


@pytest.mark.timeout(120)
def test_suns_keep_angle_irradiance_and_direction(scene, exported):
    add_light(scene, "Sun", "SUN", location=(0, 0, 5), target=(0, 3, 1), energy=4.0, angle=math.radians(5))
    light = exported()["Sun"]
    assert light["shape"] == "sun"
    assert float(light["size"].rstrip("°")) == pytest.approx(5.0, rel=ROUNDING)
    assert rgb(light["emission"]) == pytest.approx([4.0] * 3, rel=ROUNDING)
    # Blender's (0, 3, −4)/5 is (0, −4, −3)/5 in a file with Y up. Its rotation comes from Euler angles in floats.
    assert light["direction_world"] == pytest.approx([0.0, -0.8, -0.6], abs=1e-6)


@pytest.mark.timeout(120)
def test_temperature_and_a_plain_emission_node_tint_a_light(scene, exported):
    warm = add_light(scene, "Warm", "AREA", shape="SQUARE", size=1.0, energy=10.0, use_temperature=True, temperature=3000.0)
    nodes = add_light(scene, "Nodes", "AREA", shape="SQUARE", size=1.0, energy=10.0)
    nodes.data.use_nodes = True
    emission = next(node for node in nodes.data.node_tree.nodes if node.type == "EMISSION")
    emission.inputs["Strength"].default_value = 2.5
    emission.inputs["Color"].default_value = (0.2, 0.4, 1.0, 1.0)
    lights = exported()
    assert rgb(lights["Warm"]["emission"]) == pytest.approx(
        [10 / math.pi * c for c in warm.data.temperature_color], rel=ROUNDING
    )
    assert rgb(lights["Nodes"]["emission"]) == pytest.approx([25 / math.pi * c for c in (0.2, 0.4, 1.0)], rel=ROUNDING)


@pytest.mark.timeout(120)
def test_linking_names_what_a_light_does_not_light_and_what_does_not_block_it(scene, exported):
    key = scene.objects["Key"]
    receivers = bpy.data.collections.new("receivers")
    receivers.objects.link(scene.objects["Floor"])
    key.light_linking.receiver_collection = receivers
    blockers = bpy.data.collections.new("blockers")
    blockers.objects.link(scene.objects["Cube"])
    blockers.collection_objects[0].light_linking.link_state = "EXCLUDE"
    key.light_linking.blocker_collection = blockers
    bpy.context.view_layer.update()
    light = exported()["Key"]
    assert light["light_exclude"] == ["Cube"]
    assert light["shadow_exclude"] == ["Cube"]


@pytest.mark.timeout(120)
def test_an_object_without_shadow_visibility_blocks_no_light(scene, exported):
    scene.objects["Cube"].visible_shadow = False
    assert exported()["Key"]["shadow_exclude"] == ["Cube"]


@pytest.mark.timeout(120)
@pytest.mark.parametrize("evaluation", ["EXPORTER", "RENDER"])
def test_what_a_light_cannot_be_is_refused_in_one_line_and_nothing_is_written(scene, tmp_path, evaluation):
    odd = add_light(scene, "Odd", "AREA", shape="SQUARE", size=1.0)
    odd.data.use_nodes = True
    tree = odd.data.node_tree
    emission = next(node for node in tree.nodes if node.type == "EMISSION")
    blackbody = tree.nodes.new("ShaderNodeBlackbody")
    tree.links.new(blackbody.outputs[0], emission.inputs["Color"])
    path = tmp_path / "scene.glb"
    with pytest.raises(RuntimeError, match="'Odd': its nodes are more than a plain Emission"):
        bpy.ops.penumbra.export_gltf(filepath=str(path), evaluation=evaluation)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.timeout(120)
def test_both_extensions_say_the_same_and_the_scene_is_untouched(scene, tmp_path):
    add_light(scene, "Scaled", "AREA", shape="RECTANGLE", size=1.0, size_y=1.0, energy=100.0, scale=(2.0, 0.5, 3.0))
    before = {item.name: list(item.keys()) for item in bpy.data.objects}
    path = tmp_path / "scene.glb"
    assert bpy.ops.penumbra.export_gltf(filepath=str(path)) == {"FINISHED"}
    data = path.read_bytes()
    document = json.loads(data[20 : 20 + int.from_bytes(data[12:16], "little")])
    assert {"EXT_lights_area", "PENUMBRA_lights"} <= set(document["extensionsUsed"])
    assert not set(document.get("extensionsRequired", ())) & {"EXT_lights_area", "PENUMBRA_lights"}
    node = next(node for node in document["nodes"] if node["name"] == "Scaled")
    block = node["extensions"]["PENUMBRA_lights"]
    area = document["extensions"]["EXT_lights_area"]["lights"][node["extensions"]["EXT_lights_area"]["light"]]
    # World size = size × the largest scale, 3; intensity in nits.
    assert area["size"] * 3.0 == pytest.approx(block["height"], rel=ROUNDING)
    assert area["rect"]["aspect"] == pytest.approx(block["width"] / block["height"], rel=ROUNDING)
    assert area["intensity"] == pytest.approx(683.0 * block["radiance"][0], rel=ROUNDING)
    assert {item.name: list(item.keys()) for item in bpy.data.objects} == before


def usd_lights(path) -> dict:
    """The light prims of a stage, by the name of their object."""
    from pxr import Usd, UsdLux

    stage = Usd.Stage.Open(str(path))
    return {prim.GetParent().GetName(): (stage, prim) for prim in stage.Traverse() if prim.HasAPI(UsdLux.LightAPI)}


def usd_radiance(prim) -> list[float]:
    """L = color · intensity · 2^exposure / sizeFactor, the area in world space (UsdLux)."""
    import numpy as np
    from pxr import UsdGeom, UsdLux

    light = UsdLux.LightAPI(prim)
    assert not light.GetEnableColorTemperatureAttr().Get()
    matrix = np.array(UsdGeom.Xformable(prim).ComputeLocalToWorldTransform(0))
    scale = [np.linalg.norm(matrix[row, :3]) for row in range(3)]
    divisor = 1.0
    if light.GetNormalizeAttr().Get():
        if prim.IsA(UsdLux.RectLight):
            rect = UsdLux.RectLight(prim)
            divisor = rect.GetWidthAttr().Get() * scale[0] * rect.GetHeightAttr().Get() * scale[1]
        elif prim.IsA(UsdLux.DiskLight):
            divisor = math.pi * UsdLux.DiskLight(prim).GetRadiusAttr().Get() ** 2 * scale[0] * scale[1]
        elif prim.IsA(UsdLux.SphereLight):
            divisor = 4 * math.pi * UsdLux.SphereLight(prim).GetRadiusAttr().Get() ** 2
    intensity = light.GetIntensityAttr().Get() * 2 ** light.GetExposureAttr().Get()
    return [component * intensity / divisor for component in light.GetColorAttr().Get()]


@pytest.mark.timeout(120)
def test_usd_keeps_area_lights(scene, tmp_path):
    from pxr import UsdGeom, UsdLux

    for name, (values, scale, _, _) in AREA.items():
        add_light(scene, name.replace(" ", "_"), "AREA", scale=scale, **values)
    path = tmp_path / "scene.usda"
    assert bpy.ops.penumbra.export_usd(filepath=str(path)) == {"FINISHED"}
    prims = usd_lights(path)
    for name, (values, _, shape, size) in AREA.items():
        stage, prim = prims[name.replace(" ", "_")]
        assert usd_radiance(prim) == pytest.approx(area_radiance(values, size, shape == "disk"), rel=2 * ROUNDING), name
        assert UsdLux.ShadowAPI(prim).GetShadowEnableAttr().Get() in (
            {None, True} if values.get("use_shadow", True) else {False}
        )
        assert (prim.GetAttribute("penumbra:spread").Get() is not None) == (name == "spread"), name
        if shape == "disk":
            matrix = UsdGeom.Xformable(prim).ComputeLocalToWorldTransform(0)
            diameter = 2 * UsdLux.DiskLight(prim).GetRadiusAttr().Get()
            axes = [diameter * matrix.GetRow3(row).GetLength() for row in range(2)]
            assert axes == pytest.approx(size, rel=2 * ROUNDING), name


@pytest.mark.timeout(120)
def test_usd_keeps_suns_points_and_linking(scene, tmp_path):
    from pxr import UsdLux

    add_light(scene, "Sun", "SUN", energy=4.0, angle=math.radians(5), color=(1.0, 0.5, 0.25))
    add_light(scene, "Point", "POINT", energy=100.0, shadow_soft_size=0.25)
    add_light(scene, "Spot", "SPOT", energy=100.0, shadow_soft_size=0.25, spot_size=1.0)
    # A child of what is excluded: it must stay lit.
    bpy.ops.mesh.primitive_cube_add(size=0.1)
    child = bpy.context.object
    child.name, child.parent = "Child", scene.objects["Cube"]
    blockers = bpy.data.collections.new("blockers")
    blockers.objects.link(scene.objects["Cube"])
    blockers.collection_objects[0].light_linking.link_state = "EXCLUDE"
    scene.objects["Key"].light_linking.blocker_collection = blockers
    bpy.context.view_layer.update()
    path = tmp_path / "scene.usda"
    assert bpy.ops.penumbra.export_usd(filepath=str(path)) == {"FINISHED"}
    prims = usd_lights(path)

    stage, sun = prims["Sun"]
    light = UsdLux.LightAPI(sun)
    assert UsdLux.DistantLight(sun).GetAngleAttr().Get() == pytest.approx(5.0, rel=ROUNDING)
    # Normalised: π sin²(angle/2) cancels, and the intensity is the irradiance at normal incidence.
    assert light.GetNormalizeAttr().Get()
    irradiance = [light.GetIntensityAttr().Get() * c for c in light.GetColorAttr().Get()]
    assert irradiance == pytest.approx([4.0, 2.0, 1.0], rel=ROUNDING)

    for name in ("Point", "Spot"):
        stage, point = prims[name]
        assert UsdLux.SphereLight(point).GetRadiusAttr().Get() == pytest.approx(0.25, rel=ROUNDING)
        assert usd_radiance(point) == pytest.approx([100 / (4 * math.pi**2 * 0.25**2)] * 3, rel=2 * ROUNDING), name
        assert point.GetAttribute("penumbra:facing").Get() is True

    stage, key = prims["Key"]
    query = UsdLux.LightAPI(key).GetShadowLinkCollectionAPI().ComputeMembershipQuery()
    meshes = {prim.GetParent().GetName(): prim.GetPath() for prim in stage.Traverse() if prim.GetTypeName() == "Mesh"}
    assert {name: query.IsPathIncluded(path) for name, path in meshes.items()} == {"Floor": True, "Cube": False, "Child": True}


@pytest.mark.timeout(120)
def test_usd_finds_its_textures_and_nothing_else_is_left(scene, tmp_path):
    from pxr import Usd, UsdShade

    image = bpy.data.images.new("Texture", 4, 4)
    image.filepath_raw, image.file_format = str(tmp_path / "texture.png"), "PNG"
    image.save()
    material = bpy.data.materials.new("Textured")
    if bpy.app.version < (5, 0, 0):
        material.use_nodes = True
    shader = next(node for node in material.node_tree.nodes if node.type == "BSDF_PRINCIPLED")
    texture = material.node_tree.nodes.new("ShaderNodeTexImage")
    texture.image = image
    material.node_tree.links.new(texture.outputs["Color"], shader.inputs["Base Color"])
    scene.objects["Floor"].data.materials.append(material)
    path = tmp_path / "scene.usda"
    assert bpy.ops.penumbra.export_usd(filepath=str(path)) == {"FINISHED"}
    stage = Usd.Stage.Open(str(path))
    shaders = [UsdShade.Shader(prim) for prim in stage.Traverse() if prim.IsA(UsdShade.Shader)]
    files = [shader.GetInput("file").Get() for shader in shaders if shader.GetInput("file")]
    assert [file.resolvedPath for file in files if file] == [str(tmp_path / "texture.png")]
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["scene.usda", "texture.png"]


@pytest.mark.timeout(120)
def test_a_light_comes_back_from_the_file_as_blender_had_it(scene, tmp_path):
    """Blender → our file → the binary's lights → Blender's properties, by the formulas read backwards."""
    add_light(scene, "Disk", "AREA", shape="DISK", size=0.8, energy=123.0)
    path = tmp_path / "scene.glb"
    assert bpy.ops.penumbra.export_gltf(filepath=str(path), evaluation="RENDER") == {"FINISHED"}
    lights = {light["name"]: light for light in info(path)["lights"]}
    radiance, (width, height) = rgb(lights["Disk"]["emission"])[0], numbers(lights["Disk"]["size"])
    assert radiance * math.pi * (math.pi / 4 * width * height) == pytest.approx(123.0, rel=2 * ROUNDING)
    x, y, z = lights["Key"]["position_world"]
    assert (x, -z, y) == pytest.approx(tuple(scene.objects["Key"].location), rel=ROUNDING)

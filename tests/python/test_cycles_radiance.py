"""The irradiance that Blender's lights give without shadow, by Cycles, against the closed forms of the binary."""

import math
import subprocess
from pathlib import Path

import numpy as np
import pytest
from cycles_tools import LEAST_E0, ROOT, Document, cycles, exact, floor, looking, read_exr, run

PYTHONS = ("5.0.1", "4.5.15")

# Measured on both versions: means within 1e-4, single pixels by their noise at these samples.
MEAN_TOLERANCE = 1e-3
RMS_TOLERANCE = 5e-3
SAMPLES = 256
SIZE = "32x24"

WHITE = [30.0, 30.0, 30.0]
BLOCKS = {
    "rect": {"shape": "rect", "width": 1.5, "height": 0.8, "radiance": [30.0, 20.0, 5.0]},
    "square": {"shape": "rect", "width": 1.0, "height": 1.0, "radiance": WHITE},
    "disk": {"shape": "disk", "width": 1.2, "height": 1.2, "radiance": WHITE},
    "ellipse": {"shape": "disk", "width": 1.5, "height": 0.6, "radiance": WHITE},
    "spread 90": {"shape": "rect", "width": 1.5, "height": 0.8, "radiance": WHITE, "spread": math.radians(90)},
    "sphere": {"shape": "sphere", "radius": 0.5, "radiance": WHITE},
    "facing sphere": {"shape": "sphere", "radius": 0.5, "radiance": WHITE, "facing": True},
    "point": {"shape": "point", "intensity": [40.0, 30.0, 20.0]},
    "spot": {"shape": "spot", "radius": 0.0, "intensity": WHITE, "inner_cone": 0.9, "outer_cone": 0.9},
    "soft spot": {"shape": "spot", "radius": 0.4, "intensity": WHITE, "facing": True, "inner_cone": 0.9, "outer_cone": 0.9},
    "sun": {"shape": "sun", "angle": math.radians(5), "irradiance": [4.0, 3.0, 2.0]},
    "wide sun": {"shape": "sun", "angle": math.radians(60), "irradiance": WHITE},
    "directional": {"shape": "sun", "angle": 0.0, "irradiance": WHITE},
}

# Runs in Blender: lights as its users make them, one a line, all of the same place.
BLEND = """
import sys, math, bpy, mathutils
bpy.ops.wm.read_factory_settings(use_empty=True)
scene = bpy.context.scene
bpy.ops.mesh.primitive_plane_add(size=12)
camera = bpy.data.objects.new("view", bpy.data.cameras.new("view"))
scene.collection.objects.link(camera)
camera.location, camera.rotation_euler = (3.0, -4.0, 6.0), (0.7, 0.0, 0.64)
scene.camera = camera
area = dict(size=1.5, size_y=0.8, shape="RECTANGLE")
lights = {
    "square": ("AREA", dict(shape="SQUARE", size=1.2, size_y=0.3), {}),
    "rectangle": ("AREA", area, {}),
    "disk": ("AREA", dict(shape="DISK", size=1.2, size_y=0.3), {}),
    "ellipse": ("AREA", dict(shape="ELLIPSE", size=1.5, size_y=0.8), {}),
    "normalize off": ("AREA", dict(normalize=False, **area), {}),
    "ellipse, normalize off": ("AREA", dict(normalize=False, shape="ELLIPSE", size=1.5, size_y=0.8), {}),
    "exposure": ("AREA", dict(exposure=1.5, **area), {}),
    "exposure down": ("AREA", dict(exposure=-1.0, **area), {}),
    "spread 90": ("AREA", dict(spread=math.radians(90), **area), {}),
    "spread 45": ("AREA", dict(spread=math.radians(45), **area), {}),
    "scale": ("AREA", area, dict(scale=(2.0, 0.5, 3.0))),
    "scale, normalize off": ("AREA", dict(normalize=False, **area), dict(scale=(2.0, 0.5, 3.0))),
    "scaled disk": ("AREA", dict(shape="DISK", size=1.2), dict(scale=(1.5, 0.5, 1.0))),
    "colour": ("AREA", dict(color=(1.0, 0.5, 0.25), **area), {}),
    "point": ("POINT", dict(shadow_soft_size=0.0), {}),
    "soft point": ("POINT", dict(shadow_soft_size=0.5), {}),
    "soft point without falloff": ("POINT", dict(shadow_soft_size=0.5, use_soft_falloff=False), {}),
    "point exposure": ("POINT", dict(shadow_soft_size=0.3, exposure=1.0), {}),
    "spot": ("SPOT", dict(shadow_soft_size=0.0, spot_size=1.8, spot_blend=0.0), {}),
    "soft spot": ("SPOT", dict(shadow_soft_size=0.4, spot_size=1.8, spot_blend=0.0), {}),
    "sun": ("SUN", dict(angle=math.radians(5.0)), {}),
    "sun exposure": ("SUN", dict(angle=math.radians(0.5), exposure=1.0), {}),
}
for name, (kind, members, placed) in lights.items():
    data = bpy.data.lights.new(name, kind)
    data.use_shadow = False
    data.energy = 4.0 if kind == "SUN" else 200.0
    for member, value in members.items():
        setattr(data, member, value)
    light = bpy.data.objects.new(name, data)
    scene.collection.objects.link(light)
    light.location = (1.5, 1.0, 4.0)
    light.rotation_euler = (mathutils.Vector((0, 0, 0)) - light.location).to_track_quat("-Z", "Y").to_euler()
    for member, value in placed.items():
        setattr(light, member, value)
bpy.ops.wm.save_as_mainfile(filepath=sys.argv[1])
import os
os._exit(0)
"""


def python_of(version: str) -> Path:
    """The Python with a version of Blender."""
    found = ROOT / f"target/python/bpy-{version}/bin/python"
    if not found.is_file():
        pytest.fail(f"{found} is missing: scripts/python_env")
    return found


def errors_by_light(cycles_image: dict, closed_form: dict) -> dict[str, tuple[float, float]]:
    """Mean and RMS of E / closed form - 1, over the receivers that the light reaches well."""
    found = {}
    covered = cycles_image["coverage.A"] == 1.0
    names = [name.removesuffix(".irradiance.R") for name in closed_form if name.endswith(".irradiance.R")]
    for name in names:
        measured = np.stack([cycles_image[f"{name}.irradiance_unshadowed.{channel}"] for channel in "RGB"])
        expected = np.stack([closed_form[f"{name}.irradiance.{channel}"] for channel in "RGB"])
        # A spot's edge is one pixel's samples wide, and within its radius soft in Cycles alone: look inside.
        inside = covered & (expected[0] > LEAST_E0 * expected[0].max())
        if "spot" in name:
            inside &= well_inside_cone(cycles_image)
        assert inside.sum() > 100, name
        relative = (measured / np.maximum(expected, 1e-30) - 1.0)[:, inside]
        found[name] = (float(relative.mean()), float(np.sqrt((relative**2).mean())))
    return found


def well_inside_cone(image: dict) -> np.ndarray:
    """Receivers that see all of the spots' disks from within their cones; all spots stand at one place and look at the
    origin."""
    position = np.stack([image[f"position.{axis}"] for axis in "XYZ"], axis=-1)
    place = np.array([1.5, 4.0, -1.0])
    offset, axis = position - place, -place / np.linalg.norm(place)
    along = offset @ axis
    across = np.linalg.norm(offset - along[..., None] * axis, axis=-1)
    # The disk has a radius of 0.4 m; the cone is 0.9 rad wide.
    return (across + 0.4) < math.tan(0.9) * (along - 0.4)


def check(found: dict[str, tuple[float, float]]) -> None:
    for name, (mean, rms) in found.items():
        print(f"{name:28} mean {mean:+.1e} rms {rms:.1e}")
    wrong = {name: errors for name, errors in found.items() if abs(errors[0]) > MEAN_TOLERANCE or errors[1] > RMS_TOLERANCE}
    assert not wrong, wrong


@pytest.mark.timeout(180)
def test_lights_of_a_gltf_file_shine_in_cycles_as_their_closed_forms(tmp_path: Path) -> None:
    document = Document()
    floor(document, 0.0, 6.0)
    document.camera("view", looking((3.0, 6.0, 4.0), (0.0, 0.0, 0.0)), 0.8)
    for name, block in BLOCKS.items():
        document.light(name, looking((1.5, 4.0, -1.0), (0.0, 0.0, 0.0)), block | {"casts_shadow": False})
    scene = tmp_path / "lights.glb"
    document.write(scene)
    image, _ = cycles(scene, tmp_path / "cycles.exr", samples=SAMPLES, size=SIZE)
    check(errors_by_light(image, exact(scene, tmp_path / "cycles.exr")))


@pytest.mark.timeout(900)
@pytest.mark.parametrize("version", PYTHONS)
def test_lights_of_a_blend_file_shine_in_cycles_as_their_closed_forms(version: str, tmp_path: Path) -> None:
    python = python_of(version)
    blend, scene, output = (tmp_path / name for name in ("lights.blend", "lights.glb", "cycles.exr"))
    subprocess.run([python, "-c", BLEND, blend], check=True, timeout=60, stdout=subprocess.DEVNULL)
    command = [python, ROOT / "scripts/cycles_reference", blend, "-o", output, "--glb", scene]
    run([*command, "--samples", SAMPLES, "--size", SIZE], 180)
    check(errors_by_light(read_exr(output), exact(scene, output)))

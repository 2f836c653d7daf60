"""Fixtures of the Blender tests. scripts/test runs each file in a process of its own: there is one Blender in a process."""

from __future__ import annotations

import math
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent.parent
BINARY = Path(os.environ.get("PENUMBRA_BINARY", ROOT / "target/release/penumbra"))

# Before bpy is imported: nothing of the user's Blender is read or written.
os.environ.setdefault("BLENDER_USER_RESOURCES", tempfile.mkdtemp(prefix="penumbra-blender-"))

MODULE = "bl_ext.user_default.penumbra"


def pytest_unconfigure(config: pytest.Config) -> None:
    """bpy 4.5 hangs at exit while classes with methods are registered, other packages' too: leave without its destructors."""
    if "bpy" in sys.modules:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(getattr(config, "penumbra_status", 1))


def pytest_sessionfinish(session: pytest.Session, exitstatus: int) -> None:
    """Keeps the status for `pytest_unconfigure`."""
    session.config.penumbra_status = int(exitstatus)


@pytest.fixture(scope="session")
def extension_zip() -> Path:
    """The extension as users get it, from scripts/build_addon."""
    found = sorted((ROOT / "target/blender").glob("penumbra-*-linux-x64.zip"))
    if not found:
        built = subprocess.run([ROOT / "scripts/build_addon"], capture_output=True, text=True, check=True)
        found = [Path(built.stdout.strip())]
    return found[-1]


@pytest.fixture(scope="session")
def addon(extension_zip: Path):
    """The add-on's package, installed from the zip and enabled."""
    import bpy

    assert bpy.ops.extensions.package_install_files(
        filepath=str(extension_zip), repo="user_default", enable_on_install=True
    ) == {"FINISHED"}
    return sys.modules[MODULE]


@pytest.fixture
def preferences(addon):
    """The add-on's preferences, with the binary of this tree; as before afterwards."""
    import bpy

    chosen = bpy.context.preferences.addons[MODULE].preferences
    chosen.binary = str(BINARY)
    chosen.stall_seconds = 60.0
    yield chosen
    chosen.binary = ""
    chosen.stall_seconds = 300.0


@pytest.fixture
def scene(preferences):
    """A cube over a floor under a rect light, seen by a camera, 64 x 48 pixels."""
    import bpy

    # Factory settings would turn the extension off.
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=False)
    scene = bpy.context.scene
    for item in list(bpy.data.objects):
        bpy.data.objects.remove(item)
    bpy.ops.mesh.primitive_plane_add(size=12)
    bpy.context.object.name = "Floor"
    bpy.ops.mesh.primitive_cube_add(size=1, location=(0, 0, 1.1), rotation=(0, 0, 0.5))
    bpy.context.object.name = "Cube"
    add_light(scene, "Key", "AREA", location=(1.5, 1.0, 4.0), shape="RECTANGLE", size=1.5, size_y=0.8, energy=200.0)
    camera = bpy.data.objects.new("Camera", bpy.data.cameras.new("Camera"))
    scene.collection.objects.link(camera)
    place(camera, (6, -6, 6), (0, 0, 0.2))
    scene.camera = camera
    scene.render.resolution_x, scene.render.resolution_y = 64, 48
    scene.render.resolution_percentage = 100
    scene.render.use_file_extension = False
    settings = scene.penumbra
    settings.width, settings.height = 64, 48
    settings.verify = 0
    settings.antialiasing = 1
    override(settings, "samples", "4")
    bpy.context.view_layer.update()
    return scene


def place(item, location, target) -> None:
    """Puts an object somewhere and turns its −Z to a target."""
    import mathutils

    item.location = location
    direction = mathutils.Vector(target) - mathutils.Vector(location)
    item.rotation_euler = direction.to_track_quat("-Z", "Y").to_euler()


def add_light(scene, name: str, kind: str, *, location=(0, 0, 3), target=(0, 0, 0), scale=(1, 1, 1), **values):
    """A light object; values that this Blender's lights do not have are an error."""
    import bpy

    light = bpy.data.lights.new(name, kind)
    for key, value in values.items():
        setattr(light, key, value)
    item = bpy.data.objects.new(name, light)
    scene.collection.objects.link(item)
    place(item, location, target)
    item.scale = scale
    bpy.context.view_layer.update()
    return item


def override(settings, name: str, value: str) -> None:
    """Gives a parameter of the chosen technique a value."""
    for item in settings.overrides:
        if item.technique == settings.technique_name and item.name == name:
            item.value = value
            return
    item = settings.overrides.add()
    item.technique, item.name, item.value = settings.technique_name, name, value


def use_multilayer_exr(scene, path: Path) -> None:
    """The render goes to a multilayer EXR of 32-bit floats."""
    image = scene.render.image_settings
    if hasattr(image, "media_type"):
        # Blender 5 refuses the format until the kind of file is chosen.
        image.media_type = "MULTI_LAYER_IMAGE"
    image.file_format = "OPEN_EXR_MULTILAYER"
    image.color_depth = "32"
    scene.render.filepath = str(path)


def read_exr(path: Path) -> dict:
    """Channels of all parts by name, (height, width), top row first."""
    import OpenEXR

    return {
        name: channel.pixels
        for part in OpenEXR.File(str(path), separate_channels=True).parts
        for name, channel in part.channels.items()
    }


def fake_binary(path: Path, script: str) -> Path:
    """An executable Python script in the place of the penumbra binary, which still lists techniques."""
    path.write_text(
        f"#!{sys.executable}\nimport os, subprocess, sys, time\n"
        f"if sys.argv[1] == 'list':\n    sys.exit(subprocess.run([{str(BINARY)!r}, *sys.argv[1:]]).returncode)\n{script}\n"
    )
    path.chmod(0o755)
    return path


RECT_AREA = 1.5 * 0.8
RECT_RADIANCE = 200.0 / (math.pi * RECT_AREA)

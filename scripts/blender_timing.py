"""What scripts/blender_timing runs in Blender: medians of five, main thread and worker apart."""

from __future__ import annotations

import os
import statistics
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
os.environ["BLENDER_USER_RESOURCES"] = tempfile.mkdtemp(prefix="penumbra-blender-")
import bpy  # noqa: E402

REPEATS = 5


def median_seconds(work: Callable[[], object], repeats: int = REPEATS) -> float:
    """Wall time."""
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        work()
        times.append(time.perf_counter() - start)
    return statistics.median(times)


def build() -> bpy.types.Scene:
    """A monkey of a million triangles over a floor, under a rect light."""
    bpy.ops.wm.read_homefile(use_empty=True)
    scene = bpy.context.scene
    bpy.ops.mesh.primitive_plane_add(size=12)
    bpy.ops.mesh.primitive_monkey_add(size=2, location=(0, 0, 1.2))
    modifier = bpy.context.object.modifiers.new("Subdivision", "SUBSURF")
    modifier.levels = modifier.render_levels = 5
    light = bpy.data.lights.new("Key", "AREA")
    light.shape, light.size, light.size_y, light.energy = "RECTANGLE", 1.5, 0.8, 200.0
    item = bpy.data.objects.new("Key", light)
    item.location = (0.5, 0.5, 4.0)
    scene.collection.objects.link(item)
    camera = bpy.data.objects.new("Camera", bpy.data.cameras.new("Camera"))
    camera.location, camera.rotation_euler = (0.0, -9.0, 5.0), (1.1, 0.0, 0.0)
    scene.collection.objects.link(camera)
    scene.camera = camera
    return scene


def main() -> None:
    """Prints the table."""
    archives = sorted((ROOT / "target/blender").glob("penumbra-*-linux-x64.zip"))
    if not archives:
        sys.exit("error: no extension: run scripts/build_addon")
    bpy.ops.extensions.package_install_files(filepath=str(archives[-1]), repo="user_default", enable_on_install=True)
    package = "bl_ext.user_default.penumbra"
    preview, glb, extract = (sys.modules[f"{package}.{name}"] for name in ("preview", "glb", "extract"))
    scene = build()
    size = (960, 540)
    folder = Path(tempfile.mkdtemp())
    seconds: dict[str, float] = {}

    depsgraph = bpy.context.evaluated_depsgraph_get()
    camera = extract.camera_of(scene.camera, size=size)
    seconds["extraction (main thread)"] = median_seconds(lambda: extract.extract(depsgraph, camera))
    extracted = extract.extract(depsgraph, camera)
    millions = extracted.triangle_count / 1e6
    seconds["evaluation for a render, and extraction (main thread)"] = median_seconds(
        lambda: preview.harvest(scene, bpy.context.view_layer, None, size), 3
    )
    seconds["writing the GLB (worker)"] = median_seconds(lambda: glb.write(folder / "ours.glb", extracted, aspect=16 / 9))
    path = str(folder / "theirs.glb")
    seconds["Blender's glTF exporter"] = median_seconds(
        lambda: bpy.ops.export_scene.gltf(
            filepath=path, export_format="GLB", export_apply=True, export_texcoords=False, export_lights=True
        ),
        3,
    )
    settings = scene.penumbra
    settings.width, settings.height, settings.verify = *size, 0
    item = settings.overrides.add()
    item.technique, item.name, item.value = "rays", "samples", "16"
    start = time.perf_counter()
    running = preview.start(bpy.context)
    seconds["preview: until the binary runs (main thread)"] = time.perf_counter() - start
    steps = []
    while True:
        before = time.perf_counter()
        goes_on = running.step()
        steps.append(time.perf_counter() - before)
        if not goes_on:
            break
        time.sleep(0.02)
    seconds["preview: longest step after that (main thread)"] = max(steps)
    seconds["preview: 960 x 540, rays, 16 samples, all of it"] = time.perf_counter() - start
    assert running.message == "", running.message

    print(f"\nBlender {bpy.app.version_string}, {millions:.3f} million triangles, load {os.getloadavg()[0]:.1f}")
    for name, value in seconds.items():
        print(f"{1e3 * value:9.1f} ms  {name}")
    for name in ("ours.glb", "theirs.glb"):
        print(f"{(folder / name).stat().st_size / 1e6:9.1f} MB  {name}")
    sys.stdout.flush()
    os._exit(0)


main()

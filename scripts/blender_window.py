"""What scripts/blender_window does in Blender's window: one step after another from a timer, with screenshots between."""

from __future__ import annotations

import os
import struct
import sys
import time
import traceback
import zlib
from collections.abc import Iterator
from pathlib import Path

import bpy
import mathutils

OUTPUT, BINARY = sys.argv[sys.argv.index("--") + 1 :]
# Seconds that a step may take on a loaded machine.
PATIENCE_SECONDS = 90.0


def place(item: bpy.types.Object, location: tuple, target: tuple) -> None:
    """Puts an object somewhere and turns its −Z to a target."""
    item.location = location
    item.rotation_euler = (mathutils.Vector(target) - mathutils.Vector(location)).to_track_quat("-Z", "Y").to_euler()


def build() -> None:
    """A monkey over a floor, under two lights."""
    for item in list(bpy.data.objects):
        bpy.data.objects.remove(item)
    scene = bpy.context.scene
    bpy.ops.mesh.primitive_plane_add(size=12)
    bpy.ops.mesh.primitive_monkey_add(size=2, location=(0, 0, 1.1), rotation=(0, 0, 0.6))
    monkey = bpy.context.object
    subdivision = monkey.modifiers.new("Subdivision", "SUBSURF")
    # What is rendered is not what the viewport shows: previews have to evaluate it anew.
    subdivision.levels, subdivision.render_levels = 1, 2
    for polygon in monkey.data.polygons:
        polygon.use_smooth = True
    for name, color in (("Clay", (0.8, 0.55, 0.4, 1.0)), ("Floor", (0.6, 0.6, 0.6, 1.0))):
        material = bpy.data.materials.new(name)
        material.use_nodes = True
        material.node_tree.nodes["Principled BSDF"].inputs["Base Color"].default_value = color
        bpy.data.objects["Suzanne" if name == "Clay" else "Plane"].data.materials.append(material)
    for name, kind, location, values in (
        ("Key", "AREA", (2.5, -1.0, 4.0), dict(shape="RECTANGLE", size=1.6, size_y=0.8, energy=400.0)),
        ("Fill", "POINT", (-3.0, -2.5, 2.5), dict(energy=150.0, shadow_soft_size=0.3)),
    ):
        light = bpy.data.lights.new(name, kind)
        for key, value in values.items():
            setattr(light, key, value)
        item = bpy.data.objects.new(name, light)
        scene.collection.objects.link(item)
        place(item, location, (0, 0, 0.8))
    camera = bpy.data.objects.new("Camera", bpy.data.cameras.new("Camera"))
    scene.collection.objects.link(camera)
    place(camera, (4.5, -5.5, 4.0), (0, 0, 0.7))
    scene.camera = camera
    scene.render.resolution_x, scene.render.resolution_y = 640, 360
    scene.penumbra.width, scene.penumbra.height = 640, 360
    scene.penumbra.light = "Key"
    bpy.ops.penumbra.override(parameter="samples")
    scene.penumbra.overrides[0].as_int = 16
    bpy.ops.object.select_all(action="DESELECT")


def areas(kind: str) -> list[bpy.types.Area]:
    """Areas of the window, largest first."""
    found = [area for area in bpy.context.window_manager.windows[0].screen.areas if area.type == kind]
    return sorted(found, key=lambda area: -area.width * area.height)


def shot(name: str) -> None:
    """A picture of the whole window."""
    window = bpy.context.window_manager.windows[0]
    path = str(Path(OUTPUT).resolve() / f"blender-{name}.png")
    with bpy.context.temp_override(window=window, area=window.screen.areas[0]):
        bpy.ops.screen.screenshot(filepath=path)
    compress(Path(path))
    print("window: shot", path, flush=True)


def compress(path: Path) -> None:
    """Deflates a PNG's pixels anew, as small as zlib can: Blender writes screenshots fast."""
    data, at, chunks, pixels = path.read_bytes(), 8, [], b""
    while at < len(data):
        length, kind = struct.unpack_from(">I4s", data, at)
        body = data[at + 8 : at + 8 + length]
        at += 12 + length
        if kind == b"IDAT":
            pixels += body
        elif kind == b"IEND":
            chunks += [(b"IDAT", zlib.compress(zlib.decompress(pixels), 9)), (kind, body)]
        elif kind == b"IHDR":
            chunks.append((kind, body))
    with open(path, "wb") as file:
        file.write(data[:8])
        for kind, body in chunks:
            file.write(struct.pack(">I4s", len(body), kind) + body + struct.pack(">I", zlib.crc32(kind + body)))


def call(operator, kind: str, **values) -> None:
    """An operator as a click in an area's main region would call it."""
    window = bpy.context.window_manager.windows[0]
    area = areas(kind)[0]
    region = next(region for region in area.regions if region.type == "WINDOW")
    with bpy.context.temp_override(window=window, area=area, region=region):
        assert operator("INVOKE_DEFAULT", **values) in ({"FINISHED"}, {"RUNNING_MODAL"}), operator


def click(x: int, y: int) -> Iterator[float]:
    """A click of the left mouse button, pixels from the window's bottom left, as slow as people are."""
    window = bpy.context.window_manager.windows[0]
    for kind, value in (("MOUSEMOVE", "NOTHING"), ("LEFTMOUSE", "PRESS"), ("LEFTMOUSE", "RELEASE")):
        window.event_simulate(kind, value, x=x, y=y)
        yield 0.5


def until(condition) -> Iterator[float]:
    """Waits for a condition."""
    deadline = time.monotonic() + PATIENCE_SECONDS
    while not condition():
        assert time.monotonic() < deadline, "waited too long"
        yield 0.1


def steps() -> Iterator[float]:
    """The session; each value is how long to wait, s."""
    from penumbra import compare, engine, preview

    build()
    scene = bpy.context.scene
    view = areas("VIEW_3D")[0]
    view.spaces.active.show_region_ui = True
    view.spaces.active.region_3d.view_perspective = "CAMERA"
    yield 1.0
    # The sidebar's tab: Blender 3.4 has no way to choose it but a click. The last of four, in a window of 1280 x 800.
    yield from click(1044, 540)
    yield 1.0
    shot("panel")

    # Cancelled in the window: gone within a second.
    scene.penumbra.overrides[0].as_int = 1000000
    call(bpy.ops.penumbra.preview, "VIEW_3D")
    running = preview.Preview.current
    yield 1.0
    asked = time.monotonic()
    call(bpy.ops.penumbra.cancel, "VIEW_3D")
    running.job.join()
    assert time.monotonic() - asked < 1.0
    yield from until(lambda: not running.is_running)
    assert running.message == "cancelled", running.message
    scene.penumbra.overrides[0].as_int = 16

    call(bpy.ops.penumbra.preview, "VIEW_3D")
    first = preview.Preview.current
    yield from until(lambda: not first.is_running)
    assert first.message == "", first.message
    yield 1.0
    shot("preview")
    for line in first.caption:
        print("window: preview:", line, flush=True)

    scene.penumbra.cycles_samples = 16
    call(bpy.ops.penumbra.compare, "VIEW_3D")
    for line in compare.last_lines:
        print("window: compare:", line, flush=True)
    # The technique's panel is closed by its header, and the one below it opened.
    yield from click(931, 289)
    yield 1.0
    yield from click(931, 263)
    yield 1.0
    shot("compare-panel")
    editor = areas("DOPESHEET_EDITOR")[0] if areas("DOPESHEET_EDITOR") else areas("OUTLINER")[0]
    editor.type = "IMAGE_EDITOR"
    view.type = "IMAGE_EDITOR"
    view.spaces.active.image = bpy.data.images["Penumbra Key Difference"]
    yield 1.0
    with bpy.context.temp_override(
        window=bpy.context.window_manager.windows[0],
        area=view,
        region=next(region for region in view.regions if region.type == "WINDOW"),
    ):
        bpy.ops.image.view_all(fit_view=True)
    yield 1.0
    shot("compare")

    scene.render.engine = engine.ENGINE
    properties = areas("PROPERTIES")[0]
    properties.spaces.active.context = "RENDER"
    window = bpy.context.window_manager.windows[0]
    with bpy.context.temp_override(window=window):
        bpy.ops.render.render("EXEC_DEFAULT")
    view.spaces.active.image = bpy.data.images["Render Result"]
    yield 1.0
    with bpy.context.temp_override(
        window=window, area=view, region=next(region for region in view.regions if region.type == "WINDOW")
    ):
        bpy.ops.image.view_all(fit_view=True)
    yield 1.0
    shot("f12")

    # A preview leaves the last render as it is.
    result = bpy.data.images["Render Result"]
    paths = [Path(bpy.app.tempdir) / f"result-{number}.png" for number in range(2)]
    result.save_render(str(paths[0]))
    call(bpy.ops.penumbra.preview, "IMAGE_EDITOR")
    again = preview.Preview.current
    yield from until(lambda: not again.is_running)
    assert again.message == "", again.message
    yield 1.0
    result.save_render(str(paths[1]))
    assert paths[0].read_bytes() == paths[1].read_bytes(), "the preview changed the last render"

    view.type = "VIEW_3D"
    scene.penumbra.show_in_view = False
    view.spaces.active.region_3d.view_perspective = "PERSP"
    view.spaces.active.shading.type = "RENDERED"
    finished = []
    take = engine._Viewport._take
    engine._Viewport._take = lambda self, result: (take(self, result), finished.append(len(self.scene.copies)))
    yield from until(lambda: finished)
    yield 1.0
    shot("viewport")
    # The view moves, then a light, then one object alone is shown: each time a new image comes when it rests.
    for change in ("view", "light", "local view"):
        count = len(finished)
        if change == "view":
            view.spaces.active.region_3d.view_distance *= 0.8
        elif change == "light":
            bpy.data.objects["Key"].location.x -= 1.0
        else:
            for item in scene.objects:
                item.select_set(item.name == "Plane")
            call(bpy.ops.view3d.localview, "VIEW_3D", frame_selected=False)
        yield from until(lambda count=count: len(finished) > count)
        yield 1.0
    assert finished[0] > 1 and finished[-1] == 1, f"objects in the rendered views: {finished}"
    call(bpy.ops.view3d.localview, "VIEW_3D", frame_selected=False)
    print("window: rendered views:", len(finished), flush=True)

    # A preview of what the view itself shows, beside another engine.
    scene.render.engine = "CYCLES"
    view.spaces.active.shading.type = "SOLID"
    scene.penumbra.view, scene.penumbra.quantity, scene.penumbra.show_in_view = "VIEW", "shaded", True
    yield 1.0
    call(bpy.ops.penumbra.preview, "VIEW_3D")
    last = preview.Preview.current
    yield from until(lambda: not last.is_running)
    assert last.message == "", last.message
    yield 1.0
    shot("preview-view")


def main() -> None:
    """Registers the timer."""
    bpy.context.preferences.view.show_splash = False
    bpy.context.preferences.view.show_developer_ui = False
    bpy.ops.preferences.addon_enable(module="penumbra")
    bpy.context.preferences.addons["penumbra"].preferences.binary = BINARY
    session = steps()

    def tick() -> float | None:
        try:
            return next(session)
        except StopIteration:
            print("window: done", flush=True)
            bpy.ops.wm.quit_blender()
            return None
        except BaseException:
            # A timer that raises is dropped, and Blender would wait for ever.
            traceback.print_exc()
            os._exit(3)

    bpy.app.timers.register(tick, first_interval=2.0)


main()

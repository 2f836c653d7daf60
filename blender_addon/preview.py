# SPDX-License-Identifier: GPL-3.0-or-later
"""Previews beside any render engine: extracted on the main thread, rendered by the binary in the background, shown as images.

The evaluation is that of a final render (render visibility and subdivision). Where the viewport's is the same, it is read as
it is; else a temporary copy of the scene is handed to this add-on's engine, which only reads it: Blender has no other way to a
dependency graph of renders.
"""

from __future__ import annotations

import time
import traceback
from collections.abc import Callable
from typing import Any

import bpy

from . import extract, glb, images, job, preferences, process

# How often the window looks at the running job, s.
POLL_SECONDS = 0.1


class Harvest:
    """What the engine leaves when it is asked to read a scene and not to render it."""

    current: Harvest | None = None

    def __init__(self, camera: glb.Camera | None, size: tuple[int, int]) -> None:
        self.camera = camera
        self.size = size
        self.scene: glb.Scene | None = None
        self.error = ""
        self.extract_seconds = 0.0

    def take(self, depsgraph: bpy.types.Depsgraph) -> None:
        """Called by the engine."""
        start = time.perf_counter()
        try:
            camera = self.camera or scene_camera(depsgraph, self.size)
            self.scene = extract.extract(depsgraph, camera)
        except extract.ExtractError as error:
            self.error = str(error)
        except Exception as error:
            traceback.print_exc()
            self.error = f"the scene could not be read: {type(error).__name__}: {error}"
        self.extract_seconds = time.perf_counter() - start


def scene_camera(depsgraph: bpy.types.Depsgraph, size: tuple[int, int]) -> glb.Camera:
    """The evaluated scene camera."""
    scene = depsgraph.scene_eval
    if scene.camera is None:
        raise extract.ExtractError("the scene has no camera: add one, or set the active one")
    render = scene.render
    if render.use_multiview:
        raise extract.ExtractError("stereoscopy is not supported: turn it off in the output properties")
    pixel_aspect = render.pixel_aspect_x / render.pixel_aspect_y
    return extract.camera_of(scene.camera.evaluated_get(depsgraph), size=size, pixel_aspect=pixel_aspect)


def harvest(
    scene: bpy.types.Scene, view_layer: bpy.types.ViewLayer, camera: glb.Camera | None, size: tuple[int, int]
) -> Harvest:
    """Reads `scene` as a final render evaluates it. The scene itself, its settings and its last render stay as they are."""
    result = Harvest(camera, size)
    if is_viewport_as_rendered(scene, view_layer):
        result.take(bpy.context.evaluated_depsgraph_get())
        return result
    temporary = scene.copy()
    try:
        temporary.name = "Penumbra Preview"
        temporary.render.engine = "PENUMBRA"
        temporary.render.use_compositing = temporary.render.use_sequencer = False
        temporary.render.use_border = False
        # The engine renders nothing: the buffers that Blender makes for its image may be as small as they can.
        temporary.render.resolution_x, temporary.render.resolution_y = 4, 4
        temporary.render.resolution_percentage = 100
        Harvest.current = result
        bpy.ops.render.render("EXEC_DEFAULT", scene=temporary.name, layer=view_layer.name)
    except RuntimeError as error:
        result.error = result.error or str(error).strip().removeprefix("Error: ")
    finally:
        Harvest.current = None
        bpy.data.scenes.remove(temporary)
    if result.scene is None and not result.error:
        result.error = "the scene could not be read"
    return result


# What modifiers have once for the viewport and once for renders.
_LEVELS = (("levels", "render_levels"), ("steps", "render_steps"), ("viewport_resolution", "resolution"))


def is_viewport_as_rendered(scene: bpy.types.Scene, view_layer: bpy.types.ViewLayer) -> bool:
    """Whether the viewport surely evaluates what a final render does; no wherever that takes more than a look."""
    context = bpy.context
    if context.scene != scene or context.view_layer != view_layer or context.mode != "OBJECT" or scene.render.use_simplify:
        return False
    return all(map(_is_collection_as_rendered, _used_layers(view_layer.layer_collection))) and all(
        _is_object_as_rendered(item, view_layer) for item in scene.objects
    )


def _used_layers(layer: bpy.types.LayerCollection) -> list[bpy.types.LayerCollection]:
    """A layer collection and all below it that are not excluded."""
    return [layer, *(below for child in layer.children if not child.exclude for below in _used_layers(child))]


def _is_collection_as_rendered(layer: bpy.types.LayerCollection) -> bool:
    return not layer.hide_viewport and layer.collection.hide_viewport == layer.collection.hide_render


def _is_object_as_rendered(item: bpy.types.Object, view_layer: bpy.types.ViewLayer) -> bool:
    if item.name not in view_layer.objects:
        return True
    if item.type not in {"MESH", "LIGHT", "CAMERA", "EMPTY", "ARMATURE"} or len(item.particle_systems) > 0:
        return False
    if item.hide_viewport != item.hide_render or item.hide_get(view_layer=view_layer) or item.instance_collection is not None:
        return False
    if item.show_instancer_for_viewport != item.show_instancer_for_render:
        return False
    # Geometry nodes may ask whether they are seen in a viewport.
    return all(
        modifier.show_viewport == modifier.show_render
        and modifier.type != "NODES"
        and all(getattr(modifier, shown, 0) == getattr(modifier, rendered, 0) for shown, rendered in _LEVELS)
        for modifier in item.modifiers
    )


class Preview:
    """A running or finished preview; one at a time. `step` moves it on and is all that runs on the main thread meanwhile."""

    current: Preview | None = None

    def __init__(self, scene: bpy.types.Scene, request: job.Request, work: job.Job, extract_seconds: float) -> None:
        self.scene_name = scene.name
        self.request = request
        self.job = work
        self.extract_seconds = extract_seconds
        self.is_shown = False
        self.message = ""
        self.caption: list[str] = []
        self.images: list[str] = []

    @property
    def is_running(self) -> bool:
        """Whether the binary is still at work."""
        return not self.is_shown

    def step(self) -> bool:
        """Takes the result once it is there. Whether there is more to wait for."""
        if self.is_shown:
            return False
        if not self.job.is_done:
            return True
        self.is_shown = True
        if self.job.is_cancelled:
            self.message = "cancelled"
        elif self.job.error:
            self.message = self.job.error
        else:
            self._show(self.job.results[0])
        return False

    def _show(self, result: job.Result) -> None:
        if self.request.quantity == "shaded":
            pictures = {"Penumbra Shaded": images.rgba(result.rgb("shaded"))}
        elif self.request.quantity == "irradiance":
            pictures = {
                f"Penumbra Irradiance {name}": images.rgba(result.rgb(f"{name}.irradiance")) for name in result.light_names
            }
        else:
            pictures = {f"Penumbra {name}": images.rgba(result.visibility(name)) for name in result.light_names}
        self.images = [images.put(name, pixels).name for name, pixels in pictures.items()]
        width, height = result.size
        record = result.record
        self.caption = [
            f"{record['technique']}, {width} x {height}, {record['scene']['triangles']:,} triangles,"
            f" {record['adapter']['name']}",
            f"Render {record['time_ms']['render'] / 1e3:.2f} s, all {self.extract_seconds + self.job.elapsed_seconds:.2f} s",
        ]
        verified = job.verified_line(record)
        if verified:
            self.caption.append(verified)
        self.caption += [f"Warning: {warning}" for warning in result.warnings]

    def cancel(self) -> None:
        """Stops the binary within a second."""
        self.job.cancel()


def start(
    context: bpy.types.Context, *, after: Callable[[job.Job, Any], Any] | None = None, requests: list[job.Request] | None = None
) -> Preview:
    """Reads the scene and starts the binary; raises `process.ProcessError` or `extract.ExtractError`."""
    scene = context.scene
    settings = scene.penumbra
    binary = preferences.find_binary()
    size = (settings.width, settings.height)
    camera = None
    if settings.view == "VIEW":
        camera, size = region_camera(context, size)
    harvested = harvest(scene, context.view_layer, camera, size)
    if harvested.scene is None:
        raise extract.ExtractError(harvested.error)
    lights = (settings.light_name,) if settings.light_name else ()
    request = settings.request(size, quantity=settings.quantity, lights=lights, verify=settings.verify)
    work = job.Job(
        binary=binary,
        scene=harvested.scene,
        requests=requests or [request],
        folder=bpy.app.tempdir or None,
        stall_seconds=preferences.stall_seconds(),
        after=after,
    )
    preview = Preview(scene, request, work, harvested.extract_seconds)
    work.start()
    return preview


def region_camera(context: bpy.types.Context, size: tuple[int, int]) -> tuple[glb.Camera, tuple[int, int]]:
    """The camera of the 3D view at hand, and `size` with that view's aspect."""
    area = context.area if context.area and context.area.type == "VIEW_3D" else None
    if area is None and context.window is not None:
        area = next((a for a in context.window.screen.areas if a.type == "VIEW_3D"), None)
    if area is None:
        raise extract.ExtractError("no 3D view to look through: open one, or choose the camera")
    view = area.spaces.active.region_3d
    region = next(region for region in area.regions if region.type == "WINDOW")
    if view.view_perspective == "CAMERA":
        raise extract.ExtractError("the 3D view looks through the camera: choose the camera as the view")
    space = area.spaces.active
    camera = extract.view_camera(
        view.window_matrix, view.view_matrix, is_perspective=view.is_perspective, near=space.clip_start, far=space.clip_end
    )
    return camera, (size[0], max(1, round(size[0] * region.height / region.width)))


def _poll() -> float | None:
    """The window's timer."""
    preview = Preview.current
    if preview is None:
        return None
    try:
        goes_on = preview.step()
    except Exception as error:  # A timer that raises is dropped, and the panel would wait for ever.
        traceback.print_exc()
        goes_on, preview.message = False, f"the preview could not be shown: {type(error).__name__}: {error}"
    images.redraw()
    if not goes_on and preview.images:
        images.show(preview.images[0])
    return POLL_SECONDS if goes_on else None


class PENUMBRA_OT_preview(bpy.types.Operator):
    """Render a soft-shadow preview of the scene's lights with Penumbra, in the background"""

    bl_idname = "penumbra.preview"
    bl_label = "Render Preview"
    bl_options = {"REGISTER"}

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """From a window: the result comes by and by."""
        if not self._start(context):
            return {"CANCELLED"}
        bpy.app.timers.register(_poll, first_interval=POLL_SECONDS)
        return {"FINISHED"}

    def execute(self, context: bpy.types.Context) -> set[str]:
        """From a script: returns when the result is there."""
        if not self._start(context):
            return {"CANCELLED"}
        preview = Preview.current
        preview.job.join()
        preview.step()
        if preview.message:
            self.report({"ERROR"}, preview.message)
            return {"CANCELLED"}
        return {"FINISHED"}

    def _start(self, context: bpy.types.Context) -> bool:
        cancel_running()
        try:
            Preview.current = start(context)
        except (process.ProcessError, extract.ExtractError) as error:
            self.report({"ERROR"}, str(error))
            return False
        return True


class PENUMBRA_OT_cancel(bpy.types.Operator):
    """Stop the running preview"""

    bl_idname = "penumbra.cancel"
    bl_label = "Cancel"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """While one runs."""
        return Preview.current is not None and Preview.current.is_running

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Stops it."""
        cancel_running()
        return {"FINISHED"}


def cancel_running() -> None:
    """Stops the preview that runs, if one does."""
    if Preview.current is not None and Preview.current.is_running:
        Preview.current.cancel()


@bpy.app.handlers.persistent
def _forget(*_: Any) -> None:
    """Another file is being loaded: nothing of this one is shown in it."""
    cancel_running()
    Preview.current = None


CLASSES = (PENUMBRA_OT_preview, PENUMBRA_OT_cancel)


def register() -> None:
    """Watches for files being loaded."""
    bpy.app.handlers.load_pre.append(_forget)


def unregister() -> None:
    """Stops what runs."""
    _forget()
    bpy.app.handlers.load_pre.remove(_forget)
    if bpy.app.timers.is_registered(_poll):
        bpy.app.timers.unregister(_poll)

# SPDX-License-Identifier: GPL-3.0-or-later
"""Penumbra as a render engine: final renders, animations, and rendered 3D views."""

from __future__ import annotations

import time
import traceback
from collections.abc import Iterator
from typing import Any

import bpy
import numpy as np
from gpu_extras.presets import draw_texture_2d

import gpu

from . import extract, glb, job, preferences, preview, process

ENGINE = "PENUMBRA"
# How often a render asks whether it was cancelled, s.
_POLL_SECONDS = 0.05
# A rendered 3D view starts when nothing has changed for so long, s.
_REST_SECONDS = 0.25
# Blender's own name of the passes that its switches turn on, and our layer.
_PASSES = (
    ("Depth", "use_pass_z", 1, "Z", "VALUE", "depth"),
    ("Position", "use_pass_position", 3, "XYZ", "VECTOR", "position"),
    ("Normal", "use_pass_normal", 3, "XYZ", "VECTOR", "shading_normal"),
)
# What Blender and Cycles write as the depth of nothing.
_FAR_DEPTH = 1e10
_MAX_PASS_NAME_BYTES = 63


def visibility_pass(light: str) -> str:
    """Name of the pass with a light's visibility, as long as Blender lets it be."""
    return f"Visibility {light}".encode()[:_MAX_PASS_NAME_BYTES].decode(errors="ignore")


def _shown_lights(scene: bpy.types.Scene, view_layer: bpy.types.ViewLayer) -> Iterator[str]:
    """Names of the lights that a view layer's render has, as far as is known before it is evaluated."""
    for item in view_layer.objects:
        if item.type == "LIGHT" and not item.hide_render:
            yield item.name


def border_px(render: bpy.types.RenderSettings, size: tuple[int, int]) -> tuple[int, int, int, int]:
    """Left, bottom, right, top of what is rendered, pixels: the border as Blender rounds it, or the full frame."""
    width, height = size
    if not render.use_border:
        return 0, 0, width, height
    # In Blender's arithmetic: 32-bit floats, rounded down.
    f = np.float32
    left, right = int(f(render.border_min_x) * f(width)), int(f(render.border_max_x) * f(width))
    bottom, top = int(f(render.border_min_y) * f(height)), int(f(render.border_max_y) * f(height))
    return left, bottom, max(right, left + 1), max(top, bottom + 1)


def _fill(render_pass: bpy.types.RenderPass, values: np.ndarray) -> None:
    """Copies (height, width) or (height, width, channels) into a pass."""
    flat = np.ascontiguousarray(values, np.float32).reshape(-1)
    try:
        render_pass.rect.foreach_set(flat)
    except TypeError:
        # 3.4 wants a row for each pixel.
        render_pass.rect.foreach_set(flat.reshape(-1, render_pass.channels))


class PenumbraRenderEngine(bpy.types.RenderEngine):
    """Direct light of area lights with measured soft shadows"""

    bl_idname = ENGINE
    bl_label = "Penumbra"
    bl_use_preview = False
    bl_use_postprocess = True
    bl_use_shading_nodes_custom = False
    bl_use_eevee_viewport = True

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self._viewport = None

    # Final renders

    def update_render_passes(self, scene: bpy.types.Scene = None, renderlayer: bpy.types.ViewLayer = None) -> None:
        """Tells Blender which passes there will be."""
        self.register_pass(scene, renderlayer, "Combined", 4, "RGBA", "COLOR")
        for name, switch, channels, ids, kind, _ in _PASSES:
            if getattr(renderlayer, switch):
                self.register_pass(scene, renderlayer, name, channels, ids, kind)
        settings = renderlayer.penumbra
        if settings.use_pass_irradiance:
            self.register_pass(scene, renderlayer, "Irradiance", 3, "RGB", "COLOR")
        if settings.use_pass_visibility:
            for light in _shown_lights(scene, renderlayer):
                self.register_pass(scene, renderlayer, visibility_pass(light), 1, "X", "VALUE")

    def render(self, depsgraph: bpy.types.Depsgraph) -> None:
        """A view layer of a frame. It never raises: an exception here takes Blender down with it."""
        if preview.Harvest.current is not None:
            preview.Harvest.current.take(depsgraph)
            return
        try:
            self._render(depsgraph)
        except (process.ProcessError, extract.ExtractError) as error:
            self._fail(depsgraph, str(error))
        except Exception as error:
            traceback.print_exc()
            self._fail(depsgraph, f"rendering with Penumbra failed: {type(error).__name__}: {error}")

    def is_stopped(self) -> bool:
        """Whether the user has pressed Esc."""
        return self.test_break()

    def _fail(self, depsgraph: bpy.types.Depsgraph, message: str) -> None:
        """One clear message, and a result that is empty but ended."""
        self.report({"ERROR"}, message)
        self.error_set(message)
        left, bottom, right, top = border_px(depsgraph.scene.render, extract.render_size(depsgraph.scene.render))
        result = self.begin_result(0, 0, right - left, top - bottom, layer=depsgraph.view_layer.name)
        self.end_result(result, cancel=True)

    def _render(self, depsgraph: bpy.types.Depsgraph) -> None:
        start = time.perf_counter()
        scene, view_layer = depsgraph.scene, depsgraph.view_layer
        settings, layer_settings = scene.penumbra, view_layer.penumbra
        size = extract.render_size(scene.render)
        self.update_stats("Penumbra", "reading the scene")
        extracted = extract.extract(depsgraph, preview.scene_camera(depsgraph, size))
        layers = tuple(layer for _, switch, *_, layer in _PASSES if getattr(view_layer, switch))
        # The binary tells coverage at pixel centres alone: colours mixed with nothing would have no alpha to match.
        antialiasing = 1 if scene.render.film_transparent else settings.antialiasing
        requests = [settings.request(size, quantity="shaded", antialiasing=antialiasing, layers=layers)]
        if layer_settings.use_pass_irradiance:
            requests.append(settings.request(size, quantity="irradiance", antialiasing=antialiasing))
        work = job.Job(
            binary=preferences.find_binary(),
            scene=extracted,
            requests=requests,
            folder=bpy.app.tempdir or None,
            stall_seconds=preferences.stall_seconds(),
        )
        work.start()
        while not work.is_done:
            if self.is_stopped():
                work.cancel()
            self.update_stats("Penumbra", f"{settings.technique_name}: {work.label}, {100 * work.fraction:.0f} %")
            self.update_progress(work.fraction)
            work.join(_POLL_SECONDS)
        if work.is_cancelled:
            left, bottom, right, top = border_px(scene.render, size)
            result = self.begin_result(0, 0, right - left, top - bottom, layer=view_layer.name)
            self.end_result(result, cancel=True)
            return
        if work.error:
            raise process.ProcessError(work.error)
        for warning in work.results[0].warnings:
            self.report({"WARNING"}, warning)
        self._hand_over(depsgraph, work.results, size)
        record = work.results[0].record
        self.update_stats(
            "Penumbra",
            f"{record['technique']} {record['time_ms']['render'] / 1e3:.2f} s of {time.perf_counter() - start:.2f} s",
        )

    def _hand_over(self, depsgraph: bpy.types.Depsgraph, results: list[job.Result], size: tuple[int, int]) -> None:
        """Puts the images into Blender's passes."""
        scene, view_layer = depsgraph.scene, depsgraph.view_layer
        left, bottom, right, top = border_px(scene.render, size)
        shaded = results[0]
        coverage = shaded.channels["coverage.A"]
        alpha = coverage if scene.render.film_transparent else np.ones_like(coverage)
        images = {"Combined": np.concatenate([shaded.rgb("shaded"), alpha[..., None]], axis=-1)}
        for name, switch, channels, _, _, layer in _PASSES:
            if getattr(view_layer, switch):
                if channels == 3:
                    images[name] = shaded.vector(layer)
                else:
                    images[name] = np.where(coverage > 0.0, shaded.channels["depth.Z"], np.float32(_FAR_DEPTH))
        settings = view_layer.penumbra
        if settings.use_pass_irradiance:
            images["Irradiance"] = sum(results[1].rgb(f"{light}.irradiance") for light in results[1].light_names)
        if settings.use_pass_visibility:
            known = set(_shown_lights(scene, view_layer))
            for light in shaded.light_names:
                images[visibility_pass(light)] = shaded.visibility(light)
                if light not in known:
                    self.add_pass(visibility_pass(light), 1, "X", layer=view_layer.name)
        result = self.begin_result(0, 0, right - left, top - bottom, layer=view_layer.name)
        try:
            for render_pass in result.layers[0].passes:
                if render_pass.name in images:
                    _fill(render_pass, images[render_pass.name][bottom:top, left:right])
        finally:
            self.end_result(result)

    # Rendered 3D views

    def view_update(self, context: bpy.types.Context, depsgraph: bpy.types.Depsgraph) -> None:
        """Something changed, or the view has come to rest: reads what is needed, on the main thread, and starts a worker."""
        if self._viewport is None:
            self._viewport = _Viewport(self)
        try:
            self._viewport.update(context, depsgraph)
        except (process.ProcessError, extract.ExtractError) as error:
            self._viewport.fail(str(error))
        except Exception as error:
            traceback.print_exc()
            self._viewport.fail(f"{type(error).__name__}: {error}")

    def view_draw(self, context: bpy.types.Context, depsgraph: bpy.types.Depsgraph) -> None:
        """Draws what is there."""
        if self._viewport is not None:
            self._viewport.draw(context, depsgraph)


class _Viewport:
    """A rendered 3D view: the scene as it was last read, the worker, and its last image."""

    def __init__(self, engine: PenumbraRenderEngine) -> None:
        self.engine = engine
        self.scene: glb.Scene | None = None
        self.work: job.Job | None = None
        self.texture: gpu.types.GPUTexture | None = None
        self.pixels: np.ndarray | None = None
        self.wanted: tuple | None = None
        self.started: tuple | None = None
        self.changed_at = 0.0
        self.is_timed = False
        self.has_failed = False

    def update(self, context: bpy.types.Context, depsgraph: bpy.types.Depsgraph) -> None:
        """Reads the scene where it changed; starts the worker where the view has come to rest."""
        if self.scene is None or len(depsgraph.updates) > 0:
            self.scene = None
            self.started = None
            self._stop()
            if self.changed_at == 0.0 or time.monotonic() - self.changed_at >= _REST_SECONDS:
                self.scene = extract.extract(depsgraph, _region_camera(context), context.space_data)
            self.changed_at = time.monotonic()
        view = _view_key(context)
        if self.scene is not None and self.started != view:
            self._start(context, view)
        self.has_failed = False
        self._watch()

    def _start(self, context: bpy.types.Context, view: tuple) -> None:
        settings = context.scene.penumbra
        scale = settings.viewport_scale / 100.0
        size = (max(8, int(context.region.width * scale)), max(8, int(context.region.height * scale)))
        self.scene.cameras = [_region_camera(context)]
        self._stop()
        self.started = self.wanted = view
        self.work = job.Job(
            binary=preferences.find_binary(),
            scene=self.scene,
            requests=[settings.request(size, quantity="shaded")],
            folder=bpy.app.tempdir or None,
            stall_seconds=preferences.stall_seconds(),
        )
        self.work.start()

    def _stop(self) -> None:
        if self.work is not None:
            self.work.cancel()
            self.work = None

    def fail(self, message: str) -> None:
        """Says why there is no image; what changes next is tried again."""
        self._stop()
        self.has_failed = True
        self.engine.update_stats("Penumbra", message)

    def _watch(self) -> None:
        if not self.is_timed:
            self.is_timed = True
            bpy.app.timers.register(self._tick, first_interval=_POLL_SECONDS)

    def _tick(self) -> float | None:
        """The window's timer: runs while there is something to wait for."""
        try:
            if self.work is not None and self.work.is_done:
                work, self.work = self.work, None
                if work.error:
                    self.engine.update_stats("Penumbra", work.error)
                elif work.results:
                    self._take(work.results[0])
                self.engine.tag_redraw()
            rested = time.monotonic() - self.changed_at >= _REST_SECONDS
            if rested and not self.has_failed and (self.scene is None or self.started != self.wanted):
                # Leads to view_update.
                self.engine.tag_update()
                self.is_timed = False
                return None
            if self.work is not None:
                self.engine.update_stats("Penumbra", f"{self.work.label}, {100 * self.work.fraction:.0f} %")
        except ReferenceError:
            # The view is closed.
            self._stop()
            return None
        if self.has_failed or (self.work is None and self.scene is not None and self.started == self.wanted):
            self.is_timed = False
            return None
        return _POLL_SECONDS

    def _take(self, result: job.Result) -> None:
        alpha = np.ones_like(result.channels["coverage.A"])
        self.pixels = np.concatenate([result.rgb("shaded"), alpha[..., None]], axis=-1)
        self.texture = None
        milliseconds = result.record["time_ms"]["render"]
        self.engine.update_stats("Penumbra", f"{result.record['technique']}, {milliseconds / 1e3:.2f} s")

    def draw(self, context: bpy.types.Context, depsgraph: bpy.types.Depsgraph) -> None:
        """Draws the last image, whatever the view is now, and notes that the view has changed."""
        view = _view_key(context)
        if view != self.wanted:
            self.wanted = view
            self.changed_at = time.monotonic()
            self.has_failed = False
            self._stop()
            self._watch()
        if self.pixels is None:
            return
        if self.texture is None:
            height, width = self.pixels.shape[:2]
            flat = np.ascontiguousarray(self.pixels, np.float32).reshape(-1)
            self.texture = gpu.types.GPUTexture(
                (width, height), format="RGBA16F", data=gpu.types.Buffer("FLOAT", flat.size, flat)
            )
        gpu.state.blend_set("ALPHA_PREMULT")
        self.engine.bind_display_space_shader(depsgraph.scene)
        draw_texture_2d(self.texture, (0, 0), context.region.width, context.region.height)
        self.engine.unbind_display_space_shader()
        gpu.state.blend_set("NONE")


def _view_key(context: bpy.types.Context) -> tuple:
    """What a 3D view shows, to be compared."""
    view = context.region_data
    matrices = tuple(value for matrix in (view.window_matrix, view.view_matrix) for row in matrix for value in row)
    settings = context.scene.penumbra
    choices = (settings.technique_name, settings.preset_name, settings.settings(), settings.device, settings.viewport_scale)
    return matrices, (context.region.width, context.region.height), choices


def _region_camera(context: bpy.types.Context) -> glb.Camera:
    view, space = context.region_data, context.space_data
    matrix = view.window_matrix
    # Of a perspective matrix these move the centre of the view; of a parallel one it is the last column.
    center = (matrix[0][2], matrix[1][2]) if view.is_perspective else (matrix[0][3], matrix[1][3])
    # A pixel of a window of 4000 is 5e-4 of it.
    if max(abs(center[0]), abs(center[1])) > 2.5e-4:
        raise extract.ExtractError("the view is shifted: press Home to centre the camera's view")
    return extract.view_camera(
        matrix, view.view_matrix, is_perspective=view.is_perspective, near=space.clip_start, far=space.clip_end
    )


def _compatible_panels() -> Iterator[type]:
    """Blender's own panels that any engine can use."""
    excluded = {
        "VIEWLAYER_PT_filter",
        "VIEWLAYER_PT_layer_passes",
        "RENDER_PT_simplify",
        "RENDER_PT_gpencil",
        "RENDER_PT_freestyle",
    }
    for panel in bpy.types.Panel.__subclasses__():
        if "BLENDER_RENDER" in getattr(panel, "COMPAT_ENGINES", ()) and panel.__name__ not in excluded:
            yield panel


CLASSES = (PenumbraRenderEngine,)


def register() -> None:
    """Lets Blender's panels for output, film and lights show for this engine."""
    for panel in _compatible_panels():
        panel.COMPAT_ENGINES.add(ENGINE)


def unregister() -> None:
    """Takes that back."""
    for panel in _compatible_panels():
        panel.COMPAT_ENGINES.discard(ENGINE)

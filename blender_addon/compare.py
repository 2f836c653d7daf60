# SPDX-License-Identifier: GPL-3.0-or-later
"""The same view and lights in Cycles, and how far the two are apart.

What is compared is E/E₀, a light's irradiance over what it would be without blockers, at the same pixel centres: Cycles renders
it with a filter of 0.01 pixels on a white diffuse material, once with and once without the light's shadows, direct light only.
It works in a temporary copy of the scene; what has to be set on lights is set back.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import bpy
import numpy as np

from . import exr, extract, images, job, preferences, preview, process

# What the panel shows of the last comparison.
last_lines: list[str] = []
# Cycles is sampled alike every time.
_SEED = 0


@contextmanager
def _set(owner: Any, **values: Any) -> Iterator[None]:
    """Sets attributes for a while."""
    before = {name: getattr(owner, name) for name in values}
    try:
        for name, value in values.items():
            setattr(owner, name, value)
        yield
    finally:
        for name, value in before.items():
            setattr(owner, name, value)


@contextmanager
def _cycles_scene(
    scene: bpy.types.Scene, size: tuple[int, int], samples: int
) -> Iterator[tuple[bpy.types.Scene, bpy.types.Material]]:
    """A copy of the scene for Cycles: its direct light alone, on surfaces of a white material, which is told too."""
    copy = scene.copy()
    material = bpy.data.materials.new("Penumbra White")
    world = bpy.data.worlds.new("Penumbra Black")
    try:
        copy.name = "Penumbra Compare"
        copy.render.engine = "CYCLES"
        copy.render.use_compositing = copy.render.use_sequencer = copy.render.use_border = False
        copy.render.resolution_x, copy.render.resolution_y = size
        copy.render.resolution_percentage = 100
        copy.render.use_motion_blur = False
        # Alpha then tells where there is a surface.
        copy.render.film_transparent = True
        if bpy.app.version < (5, 0, 0):
            material.use_nodes = True
        nodes, links = material.node_tree.nodes, material.node_tree.links
        nodes.clear()
        diffuse, output = nodes.new("ShaderNodeBsdfDiffuse"), nodes.new("ShaderNodeOutputMaterial")
        diffuse.inputs["Color"].default_value = (1.0, 1.0, 1.0, 1.0)
        diffuse.inputs["Roughness"].default_value = 0.0
        links.new(diffuse.outputs[0], output.inputs["Surface"])
        world.color = (0.0, 0.0, 0.0)
        if world.node_tree:
            for node in world.node_tree.nodes:
                if node.type == "BACKGROUND":
                    node.inputs["Strength"].default_value = 0.0
        copy.world = world
        cycles = copy.cycles
        cycles.device = "CPU"
        cycles.samples = samples
        cycles.time_limit = 0.0
        for layer in copy.view_layers:
            layer.samples = 0
        cycles.seed, cycles.use_animated_seed = _SEED, False
        cycles.use_adaptive_sampling = cycles.use_denoising = False
        cycles.max_bounces = cycles.diffuse_bounces = cycles.glossy_bounces = cycles.transmission_bounces = 0
        cycles.volume_bounces = cycles.transparent_max_bounces = 0
        # A box ignores its width in Cycles; a Gaussian of 0.01 pixels samples their centres.
        cycles.pixel_filter_type, cycles.filter_width = "GAUSSIAN", 0.01
        cycles.sample_clamp_direct = cycles.sample_clamp_indirect = 0.0
        cycles.light_sampling_threshold = 0.0
        cycles.caustics_reflective = cycles.caustics_refractive = False
        if hasattr(cycles, "use_light_tree"):
            cycles.use_light_tree = False
        yield copy, material
    finally:
        bpy.data.scenes.remove(copy)
        bpy.data.materials.remove(material)
        bpy.data.worlds.remove(world)


class _CyclesImage:
    """What Cycles shows: colours and positions (height, width, 3), where there is a surface, and the seconds that it took."""

    def __init__(self, channels: dict[str, np.ndarray], seconds: float) -> None:
        by_pass = {tuple(name.split(".")[-2:]): values for name, values in channels.items()}
        self.rgb = np.stack([by_pass["Combined", channel] for channel in "RGB"], axis=-1)
        self.covered = by_pass["Combined", "A"] > 0.5
        self.position = np.stack([by_pass["Position", axis] for axis in "XYZ"], axis=-1)
        self.seconds = seconds


def _render_cycles(copy: bpy.types.Scene, view_layer: bpy.types.ViewLayer, path: Path) -> _CyclesImage:
    settings = copy.render.image_settings
    if hasattr(settings, "media_type"):
        settings.media_type = "MULTI_LAYER_IMAGE"
    settings.file_format = "OPEN_EXR_MULTILAYER"
    settings.color_mode, settings.color_depth, settings.exr_codec = "RGBA", "32", "ZIP"
    if hasattr(settings, "use_exr_interleave"):
        # One part, as before Blender 5.
        settings.use_exr_interleave = True
    copy.render.filepath, copy.render.use_file_extension = str(path), False
    start = time.perf_counter()
    bpy.ops.render.render("EXEC_DEFAULT", write_still=True, scene=copy.name, layer=view_layer.name)
    seconds = time.perf_counter() - start
    channels, _ = exr.read(path)
    return _CyclesImage({name: values for name, values in channels.items() if name.startswith(view_layer.name)}, seconds)


@contextmanager
def _only(light: bpy.types.Object, others: list[bpy.types.Object]) -> Iterator[None]:
    """Renders without the other lights."""
    with ExitStack() as stack:
        stack.enter_context(_set(light, hide_render=False))
        for other in others:
            stack.enter_context(_set(other, hide_render=True))
        yield


def _without_shadow(light: Any) -> Any:
    """A context in which Cycles casts no shadow of this light."""
    if bpy.app.version < (4, 0, 0):
        return _set(light.cycles, cast_shadow=False)
    return _set(light, use_shadow=False)


def _is_more_than_grazing(unshadowed: np.ndarray) -> np.ndarray:
    """Where unblocked light is at least a step of an 8-bit picture. Where it is less it grazes the surface, and Cycles' guard
    against self-shadowing decides, not the blockers."""
    return unshadowed > unshadowed.max() / 256.0


class Truth:
    """What Cycles says of one light: E/E₀ (0 where E₀ is next to nothing), where it is more, where there is a surface."""

    def __init__(self, lit: _CyclesImage, unshadowed: _CyclesImage) -> None:
        e, e0 = lit.rgb.sum(axis=-1), unshadowed.rgb.sum(axis=-1)
        self.facing = lit.covered & _is_more_than_grazing(e0)
        self.ratio = np.where(self.facing, e / np.where(e0 > 0.0, e0, 1.0), 0.0).astype(np.float32)
        self.covered = lit.covered
        self.position = lit.position
        self.seconds = lit.seconds


def cycles_truth(
    context: bpy.types.Context, light_names: list[str], size: tuple[int, int], samples: int, folder: Path
) -> dict[str, Truth]:
    """Renders each light in Cycles, with and without its shadow."""
    scene = context.scene
    all_lights = [item for item in scene.objects if item.type == "LIGHT" and not item.hide_render]
    truths = {}
    with _cycles_scene(scene, size, samples) as (copy, white), _set(scene.camera.data.dof, use_dof=False):
        layer = copy.view_layers[context.view_layer.name]
        layer.use_pass_combined = layer.use_pass_position = True
        layer.material_override = white
        for name in light_names:
            light = scene.objects[name]
            with _only(light, [other for other in all_lights if other != light]):
                lit = _render_cycles(copy, layer, folder / "cycles.exr")
                with _without_shadow(light.data):
                    unshadowed = _render_cycles(copy, layer, folder / "cycles-unshadowed.exr")
            truths[name] = Truth(lit, unshadowed)
    return truths


def _measure(work: job.Job, folder: Path, truths: dict[str, Truth]) -> dict[str, Any]:
    """Compares through the binary: its report, and pictures of where the two differ as PNG bytes, by light."""
    result = work.results[0]
    test: dict[str, np.ndarray] = {"coverage.A": result.channels["coverage.A"]}
    reference: dict[str, np.ndarray] = {}
    for name, truth in truths.items():
        # `compare` measures layers of this name; here they hold E/E₀ on both sides.
        ratio = test[f"{name}.visibility"] = result.channels[f"{name}.irradiance_ratio"]
        reference[f"{name}.visibility"] = truth.ratio
        # E₀ by E and E/E₀, where something of the light is seen: next to nothing of it is sampled noisily in Cycles.
        irradiance = result.rgb(f"{name}.irradiance").sum(axis=-1)
        seen = ratio > 0.0
        unshadowed = np.where(seen, irradiance / np.where(seen, ratio, 1.0), 0.0)
        facing = truth.facing & (_is_more_than_grazing(unshadowed) | ~seen)
        reference[f"{name}.facing"] = facing.astype(np.float32)
        reference["coverage.A"] = truth.covered.astype(np.float32)
        # Both in Blender's axes: pixels that show other surfaces are left out.
        for image, position in ((test, result.vector("position")), (reference, truth.position)):
            image |= {f"position.{axis}": position[..., number] for number, axis in enumerate("XYZ")}
    paths = folder / "test.exr", folder / "reference.exr"
    exr.write(paths[0], test)
    exr.write(paths[1], reference)
    text = work.execute(["compare", *paths, "--heatmap", folder / "difference.png", "--json"])
    pictures = {}
    for name in truths:
        single = folder / "difference.png"
        pictures[name] = (single if single.exists() else folder / f"difference.{name}.png").read_bytes()
    return {"report": process.parse_json(text, "penumbra compare"), "pictures": pictures}


def lines_of(result: job.Result, measured: dict[str, Any], truths: dict[str, Truth], samples: int) -> list[str]:
    """The comparison for people."""
    lines = []
    for light, run in zip(measured["report"]["lights"], result.record["lights"]):
        shadow = light["masks"]["shadow"]
        if not shadow["count"]:
            lines.append(f"{light['name']}: nothing is in its shadow")
            continue
        lines.append(
            f"{light['name']}: E/E0 in shadow ({shadow['count']} px): RMSE {shadow['rmse']:.4f}, SSIM {shadow['ssim']:.4f},"
            f" FLIP {shadow['flip']:.4f}"
        )
        ours = run["time_ms"]["total"] / 1e3
        theirs = truths[light["name"]].seconds
        lines.append(f"Penumbra {result.record['technique']} {ours:.2f} s, Cycles ({samples} samples) {theirs:.2f} s")
    return lines


class PENUMBRA_OT_compare(bpy.types.Operator):
    """Render the camera's view in Penumbra and in Cycles (which holds the window meanwhile), and show where they differ"""

    bl_idname = "penumbra.compare"
    bl_label = "Compare"
    bl_options = {"REGISTER"}

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Renders both and compares."""
        last_lines.clear()
        try:
            self._compare(context)
        except (process.ProcessError, extract.ExtractError, exr.ImageError) as error:
            message = str(error)
        except OSError as error:
            message = process.describe_os_error(error, "comparing")
        except RuntimeError as error:
            # What Blender's render operator says.
            message = " ".join(str(error).split())
        else:
            return {"FINISHED"}
        last_lines.append(message)
        self.report({"ERROR"}, message)
        return {"CANCELLED"}

    def _compare(self, context: bpy.types.Context) -> None:
        scene = context.scene
        settings = scene.penumbra
        if not hasattr(scene, "cycles"):
            raise process.ProcessError("Cycles is not enabled: turn it on in the preferences (Add-ons, Render)")
        size = (settings.width, settings.height)
        binary = preferences.find_binary()
        harvested = preview.harvest(scene, context.view_layer, None, size)
        if harvested.scene is None:
            raise extract.ExtractError(harvested.error)
        names = [light.name for light in harvested.scene.lights]
        if settings.light_name:
            names = [name for name in names if name == settings.light_name]
        instanced = [light.name for light in harvested.scene.lights if light.name not in scene.objects]
        if instanced:
            raise process.ProcessError(
                f"light {instanced[0]!r} comes from an instance: Cycles can't be asked for one light alone then"
            )
        # Cycles is given white surfaces without holes: both see the same.
        cut_out = [material for material in harvested.scene.materials if material.cutoff is not None]
        for material in cut_out:
            material.cutoff = None
        truths: dict[str, Truth] = {}

        def after(work: job.Job, folder: Path) -> dict[str, Any]:
            return _measure(work, folder, truths)

        work = job.Job(
            binary=binary,
            scene=harvested.scene,
            requests=[settings.request(size, quantity="irradiance", lights=tuple(names), layers=("position",))],
            folder=bpy.app.tempdir or None,
            stall_seconds=preferences.stall_seconds(),
            after=after,
        )
        with tempfile.TemporaryDirectory(prefix="penumbra-", dir=bpy.app.tempdir or None) as folder:
            truths.update(cycles_truth(context, names, size, settings.cycles_samples, Path(folder)))
        work.start()
        work.join()
        if work.error:
            raise process.ProcessError(work.error)
        result, measured = work.results[0], work.after_result
        for name, truth in truths.items():
            images.put(f"Penumbra {name} E by E0", images.rgba(result.channels[f"{name}.irradiance_ratio"]))
            images.put(f"Penumbra {name} Cycles", images.rgba(truth.ratio))
        differences = [images.put_png(f"Penumbra {name} Difference", measured["pictures"][name]) for name in truths]
        images.show(differences[0].name)
        last_lines.extend(lines_of(result, measured, truths, settings.cycles_samples))
        if cut_out:
            last_lines.append("Cut-outs are taken as whole, in both")


CLASSES = (PENUMBRA_OT_compare,)

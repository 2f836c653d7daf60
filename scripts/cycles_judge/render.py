"""Renders direct light with Cycles or EEVEE, a light at a time, and hands it over in Penumbra's layers."""

import json
import math
import tempfile
import time
from dataclasses import asdict, dataclass
from pathlib import Path

import bpy
import mathutils
import numpy as np
import OpenEXR

from . import Fault
from .scene import SURFACES, WORLD_FROM_BLENDER, Mesh, Scene, quiet

# Farther than any surface: Blender's depth where there is none is 1e10.
NOWHERE = 1e9

# How far the mean of a pixel's samples may lie from its first one where both are of one surface, pixels: no sample lies
# farther, for the filter is a Gaussian of 0.01 pixel that is cut off at 0.015.
ONE_SURFACE_PX = 0.015

# And how short their mean normal may be: irradiance is linear in the normal, so that a mean normal made unit again is off by
# as much.
ONE_SURFACE_NORMAL = 1e-4

# Cycles works in floats: a vertex goes through two matrices of four terms each, a point is a sum of three products. Rounded
# to half a unit in the last place each time, that leaves it within so many units of the largest coordinate around.
POSITION_ROUNDINGS = 8


@dataclass(frozen=True)
class Settings:
    """How it is rendered."""

    engine: str = "cycles"
    samples: int = 1024
    seed: int = 0
    denoise: bool = False
    threads: int = 0
    shadowed_only: bool = False


@dataclass
class Picture:
    """What one render gives: combined and direct light, RGB; alpha; and each pixel's surface, Blender's space."""

    light: np.ndarray
    alpha: np.ndarray
    position: np.ndarray
    mean_position: np.ndarray
    true_normal: np.ndarray
    shading_normal: np.ndarray
    depth: np.ndarray
    seconds: float


@dataclass
class Result:
    """Layers by channel name, and what they took."""

    channels: dict[str, np.ndarray]
    mixed_pixels: int
    covered_pixels: int
    lights: list[dict]


def render(scene: Scene, settings: Settings) -> Result:
    """E, E0 and E/E0 of each light, and where the receivers are."""
    _prepare(scene, settings)
    if settings.engine == "eevee":
        # The first picture of a process compiles shaders.
        _with_light(scene, scene.lights[0], shadows=True)
        _samples(scene, settings, 1)
        _picture(scene)
        _samples(scene, settings, settings.samples)
    channels: dict[str, np.ndarray] = {}
    lights = []
    covered = None
    for light in scene.lights:
        casts_shadow = light.data.use_shadow
        # With and without shadows: E and E0.
        pictures = {}
        for shadows in {casts_shadow} if settings.shadowed_only else {False, casts_shadow}:
            _with_light(scene, light, shadows=shadows)
            pictures[shadows] = _picture(scene)
        if covered is None:
            covered, mixed = _add_receivers(scene, next(iter(pictures.values())), channels)
        layers = {"irradiance": pictures[casts_shadow]}
        if not settings.shadowed_only:
            layers["irradiance_unshadowed"] = pictures[False]
        for layer, picture in layers.items():
            for index, channel in enumerate("RGB"):
                channels[f"{light.name}.{layer}.{channel}"] = np.where(covered, math.pi * picture.light[..., index], 0.0)
        if not settings.shadowed_only:
            total, most = (np.where(covered, layers[layer].light.sum(axis=-1), 0.0) for layer in layers)
            channels[f"{light.name}.irradiance_ratio"] = np.divide(total, most, out=np.zeros_like(total), where=most > 0.0)
        lights.append({"name": light.name, "seconds": {layer: picture.seconds for layer, picture in layers.items()}})
    return Result(channels, int(mixed.sum()), int(covered.sum() + mixed.sum()), lights)


def attributes(scene_path: Path, surfaces: list[Mesh], settings: Settings) -> dict[str, str]:
    """The EXR header's own entries; nothing that changes from run to run."""
    parameters = {name: value for name, value in asdict(settings).items() if name not in ("threads", "engine")}
    largest = max(np.abs(surface.corners).max() for surface in surfaces)
    return {
        "penumbra:position_error": repr(float(POSITION_ROUNDINGS * np.finfo(np.float32).eps * largest)),
        "penumbra:technique": settings.engine,
        "penumbra:parameters": json.dumps(parameters),
        "penumbra:adapter": f"Blender {bpy.app.version_string}",
        "penumbra:scene": scene_path.name,
    }


def write_exr(path: Path, channels: dict[str, np.ndarray], header: dict[str, str]) -> None:
    """Writes scan lines of 32-bit floats, ZIP."""
    fixed = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    samples = {name: np.ascontiguousarray(values, np.float32) for name, values in channels.items()}
    for name, values in samples.items():
        if not np.isfinite(values).all():
            raise Fault(f"{name} is not finite everywhere: Blender's picture can't be used")
    OpenEXR.File(fixed | header, samples).write(str(path))


def _add_receivers(scene: Scene, picture: Picture, channels: dict[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Adds where receivers are; returns which pixels have one, and which show more than one surface and so have none."""
    hit = picture.alpha > 0.0
    world = WORLD_FROM_BLENDER[:3, :3].T
    camera = scene.scene.camera
    to_camera = np.array(camera.matrix_world)[:3, 3] - picture.position
    if camera.data.type == "ORTHO":
        to_camera = np.broadcast_to(np.array(camera.matrix_world)[:3, 2], to_camera.shape)
    distance = np.maximum(np.linalg.norm(to_camera, axis=-1), 1e-30)
    length = np.linalg.norm(picture.true_normal, axis=-1)
    normal = picture.true_normal / np.maximum(length, 1e-30)[..., None]
    slant = np.abs((normal * to_camera).sum(axis=-1)) / distance
    apart = np.linalg.norm(picture.mean_position - picture.position, axis=-1)
    shading_length = np.linalg.norm(picture.shading_normal, axis=-1)
    one_surface = (
        (picture.alpha > 1.0 - 1e-6)
        & (picture.depth < NOWHERE)
        & (apart * np.maximum(slant, 1e-3) <= ONE_SURFACE_PX * _footprint(scene, picture.depth))
        & (shading_length > 1.0 - ONE_SURFACE_NORMAL)
        & (length > 0.5)
    )
    covered = hit & one_surface
    # Both normals on the camera's side of the surface.
    normal *= np.where((normal * to_camera).sum(axis=-1) < 0.0, -1.0, 1.0)[..., None]
    shading_normal = picture.shading_normal / np.maximum(shading_length, 1e-30)[..., None]
    shading_normal *= np.where((shading_normal * normal).sum(axis=-1) < 0.0, -1.0, 1.0)[..., None]
    vectors = {"position": picture.position, "normal": normal, "shading_normal": shading_normal}
    for name, values in vectors.items():
        values = values @ world
        channels |= {f"{name}.{axis}": np.where(covered, values[..., index], 0.0) for index, axis in enumerate("XYZ")}
    channels["depth.Z"] = np.where(covered, picture.depth, 0.0)
    channels["coverage.A"] = covered.astype(float)
    return covered, hit & ~covered


def _footprint(scene: Scene, depth: np.ndarray) -> np.ndarray:
    """The width of a pixel at a depth, m."""
    camera = scene.scene.camera.data
    corners = [np.array(corner) for corner in camera.view_frame(scene=scene.scene)]
    width = np.linalg.norm(corners[0] - corners[3])
    if camera.type == "ORTHO":
        return np.full_like(depth, width / scene.scene.render.resolution_x)
    return depth * width / abs(corners[0][2]) / scene.scene.render.resolution_x


def _prepare(scene: Scene, settings: Settings) -> None:
    """One white Lambertian material, the passes that are read back, and the renderer's settings."""
    target = scene.scene
    layer = bpy.context.view_layer
    layer.material_override = _white()
    layer.samples = 0
    for name in ("combined", "z", "position", "normal", "diffuse_direct", "diffuse_color"):
        setattr(layer, f"use_pass_{name}", True)
    for name in ("true_normal", "mean_position"):
        entry = layer.aovs.add()
        entry.name, entry.type = name, "COLOR"
    target.render.threads_mode = "FIXED" if settings.threads else "AUTO"
    if settings.threads:
        target.render.threads = settings.threads
    image = target.render.image_settings
    if hasattr(image, "media_type"):
        image.media_type = "MULTI_LAYER_IMAGE"
    image.file_format, image.color_depth, image.exr_codec = "OPEN_EXR_MULTILAYER", "32", "ZIP"
    target.render.use_file_extension = False
    if settings.engine == "cycles":
        _prepare_cycles(target, settings)
    else:
        _prepare_eevee(scene, settings)
    _samples(scene, settings, settings.samples)


def _prepare_cycles(target: bpy.types.Scene, settings: Settings) -> None:
    target.render.engine = "CYCLES"
    cycles = target.cycles
    cycles.device, cycles.shading_system = "CPU", False
    cycles.seed, cycles.use_animated_seed = settings.seed, False
    cycles.use_adaptive_sampling = cycles.use_light_tree = cycles.use_auto_tile = False
    cycles.use_fast_gi = cycles.use_guiding = False
    cycles.light_sampling_threshold = 0.0
    cycles.sample_clamp_direct = cycles.sample_clamp_indirect = 0.0
    cycles.film_exposure = 1.0
    for kind in ("", "diffuse_", "glossy_", "transmission_", "volume_", "transparent_max_"):
        setattr(cycles, f"{kind}bounces" if kind else "max_bounces", 0)
    # Samples at pixel centres: of Cycles' filters only this one can be made that narrow (the box is always a pixel wide).
    cycles.pixel_filter_type, cycles.filter_width = "GAUSSIAN", 0.01
    cycles.use_denoising = settings.denoise
    if settings.denoise:
        cycles.denoiser, cycles.denoising_use_gpu = "OPENIMAGEDENOISE", False
        cycles.denoising_input_passes, cycles.denoising_prefilter = "RGB_ALBEDO_NORMAL", "ACCURATE"
        cycles.denoising_quality = "HIGH"


def _prepare_eevee(scene: Scene, settings: Settings) -> None:
    target = scene.scene
    target.render.engine = "BLENDER_EEVEE" if bpy.app.version >= (5, 0, 0) else "BLENDER_EEVEE_NEXT"
    target.render.filter_size = 0.0
    eevee = target.eevee
    eevee.use_shadows, eevee.use_raytracing = True, False
    eevee.shadow_ray_count, eevee.shadow_step_count, eevee.shadow_resolution_scale = 4, 16, 1.0
    # At its default EEVEE drops 5 % of the light; at 0 its shadows break.
    eevee.light_threshold = 0.001
    for light in scene.lights:
        light.data.use_shadow_jitter = True
    # Its shadow maps are fitted to the camera's range, which glTF may leave open.
    view = scene.scene.camera.matrix_world.inverted()
    depths = [
        -(view @ item.matrix_world @ mathutils.Vector(corner)).z
        for item in scene.scene.objects
        if item.type in SURFACES
        for corner in item.bound_box
    ]
    camera = scene.scene.camera.data
    camera.clip_end = min(camera.clip_end, 1.01 * max(depths))
    camera.clip_start = max(camera.clip_start, 1e-3 * camera.clip_end)


def _samples(scene: Scene, settings: Settings, count: int) -> None:
    if settings.engine == "cycles":
        scene.scene.cycles.samples = count
    else:
        scene.scene.eevee.taa_render_samples = count


def _with_light(scene: Scene, only: bpy.types.Object, *, shadows: bool) -> None:
    for item in scene.scene.objects:
        if item.type == "LIGHT":
            item.hide_render = item != only
    only.data.use_shadow = shadows


def _picture(scene: Scene) -> Picture:
    """Renders, and reads the passes back."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "passes.exr"
        scene.scene.render.filepath = str(path)
        start = time.perf_counter()
        try:
            with quiet():
                bpy.ops.render.render(write_still=True)
        except RuntimeError as error:
            raise Fault(f"Blender does not render it: {str(error).strip().splitlines()[0]}") from error
        seconds = time.perf_counter() - start
        if not path.is_file():
            raise Fault("Blender does not render it: no picture was written")
        passes = {}
        for part in OpenEXR.File(str(path), separate_channels=True).parts:
            passes |= {name: channel.pixels for name, channel in part.channels.items()}

    def layer(names: tuple[str, ...], channels: str) -> np.ndarray:
        # Blender 5 writes long names of passes, those before it short ones.
        for name in names:
            found = [next((key for key in passes if key.endswith(f".{name}.{channel}")), None) for channel in channels]
            if all(found):
                return np.stack([passes[key] for key in found], axis=-1).astype(float)
        raise Fault(f"Blender's picture has no pass {names[0]}; it has {', '.join(sorted(passes))}")

    denoised = scene.scene.render.engine == "CYCLES" and scene.scene.cycles.use_denoising
    return Picture(
        # Only the combined pass is denoised; with one bounce of a white diffuse surface it is the same.
        light=layer(("Combined",) if denoised else ("Diffuse Direct", "DiffDir"), "RGB"),
        alpha=layer(("Combined",), "A")[..., 0],
        position=layer(("Position",), "XYZ"),
        mean_position=layer(("mean_position",), "RGB"),
        true_normal=layer(("true_normal",), "RGB"),
        shading_normal=layer(("Normal",), "XYZ"),
        depth=layer(("Depth",), "Z")[..., 0],
        seconds=seconds,
    )


def _white() -> bpy.types.Material:
    """White, Lambertian, and it says where it is."""
    material = bpy.data.materials.new("white")
    if material.node_tree is None:
        material.use_nodes = True
    tree = material.node_tree
    tree.nodes.clear()
    diffuse = tree.nodes.new("ShaderNodeBsdfDiffuse")
    diffuse.inputs["Color"].default_value = (1.0, 1.0, 1.0, 1.0)
    diffuse.inputs["Roughness"].default_value = 0.0
    output = tree.nodes.new("ShaderNodeOutputMaterial")
    tree.links.new(diffuse.outputs["BSDF"], output.inputs["Surface"])
    geometry = tree.nodes.new("ShaderNodeNewGeometry")
    for name, socket in (("true_normal", "True Normal"), ("mean_position", "Position")):
        aov = tree.nodes.new("ShaderNodeOutputAOV")
        aov.aov_name = name
        tree.links.new(geometry.outputs[socket], aov.inputs["Color"])
    return material

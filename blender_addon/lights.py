# SPDX-License-Identifier: GPL-3.0-or-later
"""What Blender's lights are in Penumbra's terms: a block of `PENUMBRA_lights`, lengths in world metres, angles in radians.

Nothing here imports bpy: lights and objects are read by their attributes.

Radiance as Cycles has it, measured against closed forms within 0.02 % on each version (P: power in W, A: area in m²):

- area: L = P / (π A), from 4.2 on; P / (4 A) before 4.0, where the power was meant for another lobe;
- point and spot of radius r: L = P / (4π · π r²), as a disk that faces the receiver (soft falloff) or a
  sphere; without a radius I = P / 4π;
- sun: irradiance at normal incidence is the strength, whatever the angle.

Without normalisation (from 4.5 on): area L = P / π; point and spot L = P / π, I = P / π without a radius; sun: the strength
is a radiance. Spots with a radius (0.4 % darker) and wide suns (17 % darker at 90°) of version 3.4 are not followed.
"""

from __future__ import annotations

import math
from typing import Any

# Since this version area lights emit P / (π A); before, P / (4 A). Measured on 3.4.1 and 4.2.23.
EXACT_AREA_POWER = (4, 0, 0)

# Lumens of a watt in glTF exporters: nits = 683 · W/(m²·sr).
LUMENS_PER_WATT = 683.0


class UnsupportedLight(ValueError):
    """A light that Penumbra can't show as Cycles does; the message is one line for the user."""


def column_lengths(matrix: Any) -> tuple[float, float, float]:
    """Scale along the local axes of a 4x4 matrix (rows of columns, as mathutils has it)."""
    return tuple(math.sqrt(sum(matrix[row][column] ** 2 for row in range(3))) for column in range(3))


def emission_tint(light: Any) -> tuple[float, float, float]:
    """Linear RGB that all of a light's emission is multiplied by: colour, temperature, exposure and an Emission node."""
    tint = list(light.color)
    if getattr(light, "use_temperature", False):
        tint = [a * b for a, b in zip(tint, light.temperature_color)]
    scale = 2.0 ** getattr(light, "exposure", 0.0)
    if light.use_nodes and light.node_tree is not None:
        color, strength = _plain_emission(light)
        tint = [a * b for a, b in zip(tint, color)]
        scale *= strength
    return tuple(component * scale for component in tint)


def _plain_emission(light: Any) -> tuple[tuple[float, float, float], float]:
    """Colour and strength of the Emission node that a light's nodes consist of."""
    outputs = [node for node in light.node_tree.nodes if node.type == "OUTPUT_LIGHT" and node.is_active_output]
    links = outputs[0].inputs["Surface"].links if outputs else ()
    if not links:
        return (0.0, 0.0, 0.0), 0.0
    emission = links[0].from_node
    if emission.type != "EMISSION" or any(socket.is_linked for socket in emission.inputs):
        raise UnsupportedLight(
            f"light {light.name!r}: its nodes are more than a plain Emission, which is not supported; turn off Use Nodes"
        )
    return tuple(emission.inputs["Color"].default_value)[:3], emission.inputs["Strength"].default_value


def casts_shadow(light: Any, *, version: tuple[int, int, int]) -> bool:
    """Whether Cycles lets the light's rays be blocked: in 3.x its own setting counts, and `use_shadow` has no effect on it."""
    if version < (4, 0, 0):
        return bool(light.cycles.cast_shadow) if hasattr(light, "cycles") else True
    return bool(light.use_shadow)


def describe(light: Any, matrix_world: Any, *, version: tuple[int, int, int]) -> dict[str, Any]:
    """The `PENUMBRA_lights` block of a light data-block placed by `matrix_world`, scale baked, without linking."""
    tint = emission_tint(light)
    normalize = getattr(light, "normalize", True)
    block: dict[str, Any] = {"version": 1}

    def emit(value: float) -> list[float]:
        return [value * component for component in tint]

    if light.type == "AREA":
        scale_x, scale_y, _ = column_lengths(matrix_world)
        has_height = light.shape in {"RECTANGLE", "ELLIPSE"}
        width = light.size * scale_x
        height = (light.size_y if has_height else light.size) * scale_y
        is_round = light.shape in {"DISK", "ELLIPSE"}
        block |= {"shape": "disk" if is_round else "rect", "width": width, "height": height}
        area = width * height * (math.pi / 4.0 if is_round else 1.0)
        if area <= 0.0:
            raise UnsupportedLight(f"light {light.name!r}: its area is 0; give it a size")
        exact = version >= EXACT_AREA_POWER
        block["radiance"] = emit(light.energy / ((math.pi if exact else 4.0) * (area if normalize else 1.0)))
        if light.spread < math.pi:
            block["spread"] = light.spread
    elif light.type in {"POINT", "SPOT"}:
        block |= {"shape": "sphere" if light.type == "POINT" else "spot"}
        radius = light.shadow_soft_size
        if radius > 0.0:
            surface = 4.0 * math.pi * radius * radius if normalize else 1.0
            block |= {"radius": radius, "radiance": emit(light.energy / (math.pi * surface))}
            block["facing"] = getattr(light, "use_soft_falloff", True)
        else:
            if light.type == "POINT":
                block["shape"] = "point"
            block["intensity"] = emit(light.energy / (math.pi * (4.0 if normalize else 1.0)))
        if light.type == "SPOT":
            # Blender's 180° is a float, and a little more.
            outer = min(0.5 * light.spot_size, 0.5 * math.pi)
            # Cycles blends in the cosine: full within cos = cos(outer) + blend (1 − cos(outer)).
            inner = math.acos(min(1.0, math.cos(outer) + light.spot_blend * (1.0 - math.cos(outer))))
            block |= {"inner_cone": min(inner, outer), "outer_cone": outer}
    elif light.type == "SUN":
        # Without normalisation the strength is a radiance, as long as there is an angle.
        disc = 1.0 if normalize or light.angle == 0.0 else math.pi * math.sin(0.5 * light.angle) ** 2
        block |= {"shape": "sun", "angle": light.angle, "irradiance": emit(light.energy * disc)}
    else:
        raise UnsupportedLight(f"light {light.name!r}: lights of type {light.type} are not supported")
    block["casts_shadow"] = casts_shadow(light, version=version)
    return block


def area_extension(block: dict[str, Any], *, name: str) -> dict[str, Any] | None:
    """The entry of `EXT_lights_area` for a block, where it can say it: rect, or disk of equal axes."""
    shape = block["shape"]
    if shape not in {"rect", "disk"} or (shape == "disk" and block["width"] != block["height"]):
        return None
    radiance = block["radiance"]
    peak = max(radiance)
    color = [component / peak for component in radiance] if peak > 0.0 else [1.0, 1.0, 1.0]
    light = {"name": name, "type": shape, "color": color, "intensity": LUMENS_PER_WATT * peak, "size": block["height"]}
    if shape == "rect":
        light["rect"] = {"aspect": block["width"] / block["height"]}
    return light


def linked_names(collection: Any) -> tuple[set[str], set[str]]:
    """Names of the objects that a light-linking collection includes and excludes, children's objects with it."""
    included: set[str] = set()
    excluded: set[str] = set()

    def add(names: set[str], link: Any) -> None:
        target = excluded if link.light_linking.link_state == "EXCLUDE" else included
        target |= names

    for item, link in zip(collection.objects, collection.collection_objects):
        add({item.name}, link)
    for child, link in zip(collection.children, collection.collection_children):
        add({item.name for item in child.all_objects}, link)
    return included, excluded


def excluded_names(collection: Any, all_names: set[str]) -> list[str]:
    """Which of `all_names` a linking collection leaves out: all but its included objects where it includes any, and its
    excluded ones."""
    if collection is None:
        return []
    included, excluded = linked_names(collection)
    left_out = (all_names - included if included else set()) | (all_names & excluded)
    return sorted(left_out)


def add_linking(block: dict[str, Any], light_object: Any, all_names: set[str], shadowless: set[str]) -> None:
    """Adds which objects a light does not light, and which do not block it.

    `shadowless`: objects that block no light at all (ray visibility).
    """
    linking = getattr(light_object, "light_linking", None)
    light_exclude = excluded_names(linking.receiver_collection, all_names) if linking else []
    shadow_exclude = excluded_names(linking.blocker_collection, all_names) if linking else []
    shadow_exclude = sorted(set(shadow_exclude) | shadowless)
    if light_exclude:
        block["light_exclude"] = light_exclude
    if shadow_exclude:
        block["shadow_exclude"] = shadow_exclude

"""Lights in Blender's terms and in those of Penumbra's glTF block (PENUMBRA_lights), and the way from one to the other.

Measured with Cycles of Blender 4.5 and 5.0 (tests/python/test_cycles_radiance.py), P in W, area A in m^2 with the object's
scale: area lights L = P 2^exposure / (pi A), or P 2^exposure / pi with `normalize` off; points and spots of radius r:
intensity P/(4 pi), which a disc or sphere of that radius has at L = P/(4 pi^2 r^2); suns: perpendicular irradiance =
strength, whatever their angle.
"""

import math
from dataclasses import dataclass

from . import Fault

# Of a watt, as glTF exporters convert: nits = 683 W/(m^2 sr).
LUMENS_PER_WATT = 683.0

# A light of PENUMBRA_lights: its members by name.
Block = dict[str, object]


@dataclass(frozen=True)
class BlenderLight:
    """What a Blender light needs beside its place. Lengths in metres, angles in radians, energy in W (of a sun: W/m^2)."""

    kind: str
    energy: float
    color: tuple[float, float, float]
    shape: str = "SQUARE"
    size: float = 0.0
    size_y: float = 0.0
    spread: float = math.pi
    radius: float = 0.0
    use_soft_falloff: bool = False
    spot_size: float = 0.0
    angle: float = 0.0
    use_shadow: bool = True


def blender_light(name: str, block: Block) -> BlenderLight:
    """The Blender light that emits as a block says."""
    shape = block.get("shape")
    for member in ("light_exclude", "shadow_exclude"):
        if block.get(member):
            raise Fault(f"light {name}: {member} is not supported here")
    casts_shadow = bool(block.get("casts_shadow", True))
    if shape in ("rect", "disk"):
        width = _number(name, block, "width")
        height = _number(name, block, "height") if shape == "rect" or "height" in block else width
        round_shape = "DISK" if width == height else "ELLIPSE"
        area = width * height * (1.0 if shape == "rect" else math.pi / 4.0)
        power, color = _split(name, block, "radiance", math.pi * area)
        kind = "RECTANGLE" if shape == "rect" else round_shape
        spread = float(block.get("spread", math.pi))
        return BlenderLight("AREA", power, color, kind, width, height, spread, use_shadow=casts_shadow)
    if shape == "sun":
        strength, color = _split(name, block, "irradiance", 1.0)
        return BlenderLight("SUN", strength, color, angle=float(block.get("angle", 0.0)), use_shadow=casts_shadow)
    if shape in ("sphere", "point", "spot"):
        radius = float(block.get("radius", 0.0)) if shape != "point" else 0.0
        if "radiance" in block:
            power, color = _split(name, block, "radiance", 4.0 * math.pi**2 * radius**2)
        else:
            power, color = _split(name, block, "intensity", 4.0 * math.pi)
        facing = bool(block.get("facing", False))
        if shape != "spot":
            return BlenderLight("POINT", power, color, radius=radius, use_soft_falloff=facing, use_shadow=casts_shadow)
        outer = _number(name, block, "outer_cone")
        if float(block.get("inner_cone", 0.0)) != outer:
            raise Fault(f"light {name}: Blender's spots fall off otherwise than glTF's; give it equal inner and outer cones")
        return BlenderLight(
            "SPOT", power, color, radius=radius, use_soft_falloff=facing, spot_size=2.0 * outer, use_shadow=casts_shadow
        )
    raise Fault(f"light {name}: Blender has no light of the shape {shape}")


def penumbra_block(light: BlenderLight, *, exposure: float, normalize: bool, scale: tuple[float, float]) -> Block:
    """The block of a Blender light whose object's local X and Y are scaled."""
    gain = 2.0**exposure
    block: Block = {} if light.use_shadow else {"casts_shadow": False}
    emitted = [channel * light.energy * gain for channel in light.color]
    if light.kind == "SUN":
        return block | {"shape": "sun", "angle": light.angle, "irradiance": emitted}
    if light.kind == "AREA":
        size_y = light.size_y if light.shape in ("RECTANGLE", "ELLIPSE") else light.size
        width, height = light.size * scale[0], size_y * scale[1]
        shape = "rect" if light.shape in ("SQUARE", "RECTANGLE") else "disk"
        area = width * height * (1.0 if shape == "rect" else math.pi / 4.0)
        # Blender's floats round pi up.
        spread = min(light.spread, math.pi)
        radiance = [value / (math.pi * (area if normalize else 1.0)) for value in emitted]
        return block | {"shape": shape, "width": width, "height": height, "radiance": radiance, "spread": spread}
    if not normalize:
        raise Fault(f"a {light.kind.lower()} light without `normalize` is not supported here")
    block |= {"intensity": [value / (4.0 * math.pi) for value in emitted], "radius": light.radius}
    if light.radius > 0.0:
        block["facing"] = light.use_soft_falloff
    if light.kind == "SPOT":
        return block | {"shape": "spot", "inner_cone": 0.5 * light.spot_size, "outer_cone": 0.5 * light.spot_size}
    return block | {"shape": "sphere" if light.radius > 0.0 else "point"}


def _number(name: str, block: Block, member: str) -> float:
    value = block.get(member)
    if not isinstance(value, (int, float)) or not value > 0.0:
        raise Fault(f"light {name}: {member} must be a positive number, found {value}")
    return float(value)


def _split(name: str, block: Block, member: str, factor: float) -> tuple[float, tuple[float, float, float]]:
    """Blender's power and colour: the largest channel is 1."""
    value = block.get(member)
    if not isinstance(value, list) or len(value) != 3:
        raise Fault(f"light {name}: {member} must be three numbers, found {value}")
    largest = max(value)
    if largest <= 0.0:
        return 0.0, (1.0, 1.0, 1.0)
    return factor * largest, (value[0] / largest, value[1] / largest, value[2] / largest)

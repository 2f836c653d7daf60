# SPDX-License-Identifier: GPL-3.0-or-later
"""What Blender's USD exporter loses of lights, put back by UsdLux's rules. Nothing here imports bpy."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

from . import lights


def expect_pxr() -> None:
    """Raises `lights.UnsupportedLight` with one line where USD's Python is missing."""
    try:
        import pxr  # noqa: F401
    except ImportError as error:
        raise lights.UnsupportedLight("exporting USD needs its Python module pxr: install usd-core for this Python") from error


def correct(path: Path, blocks: dict[str, tuple[Any, dict[str, Any]]]) -> list[str]:
    """Corrects the lights of a stage in place. `blocks`: light data-block and `PENUMBRA_lights` block by object name."""
    from pxr import Sdf, Usd, UsdGeom, UsdLux

    stage = Usd.Stage.Open(str(path))
    surfaces: dict[str, list[Any]] = {}
    found: dict[str, list[Any]] = {}
    for prim in stage.Traverse():
        name = _object_name(prim)
        if name is None:
            continue
        if prim.HasAPI(UsdLux.LightAPI):
            found.setdefault(name, []).append(prim)
        elif prim.IsA(UsdGeom.Gprim):
            surfaces.setdefault(name, []).append(prim.GetPath())
    warnings = []
    for name, prims in found.items():
        if name not in blocks:
            continue
        light, block = blocks[name]
        for prim in prims:
            warnings += _correct_light(prim, light, block, surfaces, Sdf=Sdf, UsdGeom=UsdGeom, UsdLux=UsdLux)
    stage.GetRootLayer().Save()
    return warnings


def _object_name(prim: Any) -> str | None:
    """The Blender object that a prim, or the transform above it, was made from."""
    while prim and not prim.IsPseudoRoot():
        attribute = prim.GetAttribute("userProperties:blender:object_name")
        if attribute and attribute.HasAuthoredValue():
            return attribute.Get()
        prim = prim.GetParent()
    return None


def _correct_light(
    prim: Any, light: Any, block: dict[str, Any], surfaces: dict[str, list[Any]], *, Sdf: Any, UsdGeom: Any, UsdLux: Any
) -> list[str]:
    api = UsdLux.LightAPI(prim)
    moving = [a.GetName() for a in prim.GetAttributes() if a.GetName().startswith("inputs:") and a.ValueMightBeTimeVarying()]

    # Blender always turns colour temperature on, and 6500 K is not white in UsdLux.
    if getattr(light, "use_temperature", False):
        api.CreateColorAttr().Set(tuple(a * b for a, b in zip(light.color, light.temperature_color)))
    api.CreateEnableColorTemperatureAttr().Set(False)
    # Blender leaves it out where it is off, and UsdLux's default is off.
    normalize = getattr(light, "normalize", True)
    api.CreateNormalizeAttr().Set(normalize)

    if light.type == "AREA" and light.shape == "ELLIPSE":
        # A disk of diameter `size` under a scale: UsdLux takes the area with the transform's scale.
        disk = UsdLux.DiskLight(prim)
        disk.CreateRadiusAttr().Set(0.5 * light.size)
        UsdGeom.Xformable(prim).AddScaleOp(opSuffix="ellipse").Set((1.0, light.size_y / light.size, 1.0))
    if light.type == "SUN":
        distant = UsdLux.DistantLight(prim)
        distant.CreateAngleAttr().Set(math.degrees(light.angle))
        # Normalised, the intensity is the irradiance at normal incidence (angle up to 180°): π sin²(angle/2) cancels.
        api.CreateNormalizeAttr().Set(True)
        api.CreateExposureAttr().Set(0.0)
        peak = max(block["irradiance"])
        api.CreateColorAttr().Set(tuple(c / peak for c in block["irradiance"]) if peak > 0.0 else (1.0, 1.0, 1.0))
        api.CreateIntensityAttr().Set(peak)
    if not block["casts_shadow"]:
        UsdLux.ShadowAPI.Apply(prim).CreateShadowEnableAttr().Set(False)
    # UsdLux has no word for these.
    for name in ("spread", "facing"):
        if name in block:
            kind = Sdf.ValueTypeNames.Bool if name == "facing" else Sdf.ValueTypeNames.Float
            prim.CreateAttribute(f"penumbra:{name}", kind, custom=True).Set(block[name])
    for key, collection in (
        ("light_exclude", api.GetLightLinkCollectionAPI()),
        ("shadow_exclude", api.GetShadowLinkCollectionAPI()),
    ):
        names = block.get(key, ())
        # The surfaces themselves: an object's transform would take its children with it.
        targets = [path for name in names for path in surfaces.get(name, ())]
        if targets:
            collection.CreateIncludeRootAttr().Set(True)
            collection.CreateExcludesRel().SetTargets(targets)
    if moving and (light.type == "SUN" or (light.type == "AREA" and light.shape == "ELLIPSE")):
        return [f"light {prim.GetName()}: animated {', '.join(moving)} are as Blender wrote them"]
    return []

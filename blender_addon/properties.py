# SPDX-License-Identifier: GPL-3.0-or-later
"""Settings of a scene. Techniques, presets and parameters are the binary's; here are only their chosen values."""

from __future__ import annotations

from typing import Any

import bpy

from . import job, preferences, process, schema

# Blender keeps no reference to the strings of dynamic enumerations, and goes on using those of earlier calls: every string that
# it was ever given stays.
_kept: dict[str, str] = {}


def known_techniques() -> tuple[schema.Technique, ...]:
    """What the binary offers; nothing while there is none."""
    try:
        return schema.techniques(preferences.find_binary())
    except (process.ProcessError, OSError):
        return ()


def _items(entries: list[tuple[str, str]], chosen: str) -> list[tuple[str, str, str, int]]:
    """Items of an enumeration by name and help. A chosen value that is not offered stays, and says so."""
    names = [name for name, _ in entries]
    if chosen not in names:
        entries = [*entries, (chosen, "The binary does not offer this")]
    kept = ((_kept.setdefault(name, name), _kept.setdefault(text, text)) for name, text in entries)
    return [(name, name, text, number) for number, (name, text) in enumerate(kept)]


def _number_of(items: list[tuple[str, str, str, int]], name: str) -> int:
    return next((number for identifier, _, _, number in items if identifier == name), 0)


class ParameterOverride(bpy.types.PropertyGroup):
    """A parameter of a technique with another value than the preset's. `value` is what the binary is given."""

    technique: bpy.props.StringProperty()
    # `name`, which every property group has, is the parameter's.
    value: bpy.props.StringProperty(name="Value")

    def parameter(self) -> schema.Parameter | None:
        """What the binary says about it."""
        technique = schema.find(known_techniques(), self.technique)
        return technique.parameter(self.name) if technique else None

    def _clamped(self, number: float) -> float:
        parameter = self.parameter()
        if parameter and parameter.minimum is not None:
            number = max(number, parameter.minimum)
        if parameter and parameter.maximum is not None:
            number = min(number, parameter.maximum)
        return number

    def _number(self) -> float:
        try:
            return float(self.value)
        except ValueError:
            return 0.0

    def _bool(self) -> bool:
        return self.value == "true"

    def _set_bool(self, on: bool) -> None:
        self.value = "true" if on else "false"

    def _int(self) -> int:
        # Blender's integers have 32 bits.
        return min(int(self._number()), 2**31 - 1)

    def _set_int(self, number: int) -> None:
        self.value = str(int(self._clamped(number)))

    def _set_float(self, number: float) -> None:
        # Seven digits are what a 32-bit float of Blender's interface holds.
        self.value = f"{self._clamped(number):.7g}"

    def _choice_items(self, context: bpy.types.Context | None) -> list[tuple[str, str, str, int]]:
        parameter = self.parameter()
        return _items(list(parameter.choices) if parameter else [], self.value)

    def _choice(self) -> int:
        return _number_of(self._choice_items(None), self.value)

    def _set_choice(self, number: int) -> None:
        self.value = next(item[0] for item in self._choice_items(None) if item[3] == number)

    as_bool: bpy.props.BoolProperty(
        name="On",
        get=_bool,
        set=_set_bool,
    )
    as_int: bpy.props.IntProperty(name="Value", get=_int, set=_set_int)
    as_float: bpy.props.FloatProperty(name="Value", precision=4, get=_number, set=_set_float)
    as_choice: bpy.props.EnumProperty(
        name="Value",
        items=_choice_items,
        get=_choice,
        set=_set_choice,
    )


class PenumbraSettings(bpy.types.PropertyGroup):
    """How Penumbra renders this scene"""

    technique_name: bpy.props.StringProperty(default="rays")
    preset_name: bpy.props.StringProperty()
    light_name: bpy.props.StringProperty()
    overrides: bpy.props.CollectionProperty(type=ParameterOverride)

    def chosen_technique(self) -> schema.Technique | None:
        """What the binary says about the chosen technique."""
        return schema.find(known_techniques(), self.technique_name)

    def _technique_items(self, context: bpy.types.Context | None) -> list[tuple[str, str, str, int]]:
        entries = [(t.name, f"{t.summary}. {t.paper}. Needs: {t.needs}") for t in known_techniques()]
        return _items(entries, self.technique_name)

    def _technique(self) -> int:
        return _number_of(self._technique_items(None), self.technique_name)

    def _set_technique(self, number: int) -> None:
        self.technique_name = next(item[0] for item in self._technique_items(None) if item[3] == number)
        self.preset_name = ""

    def _preset_items(self, context: bpy.types.Context | None) -> list[tuple[str, str, str, int]]:
        technique = self.chosen_technique()
        entries = [("best", "The best settings known"), *(technique.presets if technique else ())]
        return _items(entries, self.preset_name or "best")

    def _preset(self) -> int:
        return _number_of(self._preset_items(None), self.preset_name or "best")

    def _set_preset(self, number: int) -> None:
        name = next(item[0] for item in self._preset_items(None) if item[3] == number)
        self.preset_name = "" if number == 0 else name

    def _light_items(self, context: bpy.types.Context | None) -> list[tuple[str, str, str, int]]:
        scene = self.id_data
        names = sorted(item.name for item in scene.objects if item.type == "LIGHT")
        entries = [("ALL LIGHTS", "Every light of the scene"), *((name, f"Only {name}") for name in names)]
        return _items(entries, self.light_name or "ALL LIGHTS")

    def _light(self) -> int:
        return _number_of(self._light_items(None), self.light_name or "ALL LIGHTS")

    def _set_light(self, number: int) -> None:
        name = next(item[0] for item in self._light_items(None) if item[3] == number)
        self.light_name = "" if number == 0 else name

    technique: bpy.props.EnumProperty(
        name="Technique",
        description="How visibility is found",
        items=_technique_items,
        get=_technique,
        set=_set_technique,
    )
    preset: bpy.props.EnumProperty(
        name="Preset",
        description="The technique's settings to start from",
        items=_preset_items,
        get=_preset,
        set=_set_preset,
    )
    light: bpy.props.EnumProperty(
        name="Light",
        description="Which lights the preview shows",
        items=_light_items,
        get=_light,
        set=_set_light,
    )
    device: bpy.props.EnumProperty(
        name="Device",
        items=[
            ("auto", "Automatic", "What the technique needs"),
            ("gpu", "GPU", "A GPU or nothing"),
            ("cpu", "Processor", "The processor"),
        ],
    )
    quantity: bpy.props.EnumProperty(
        name="Show",
        description="What the preview shows",
        items=[
            ("visibility", "Visibility", "Fraction of each light's area that is seen, an image a light"),
            ("irradiance", "Irradiance", "W/m² on the surface, an image a light"),
            ("shaded", "Shaded", "Lambertian surfaces with their base colour, lit by all of the lights shown"),
        ],
    )
    view: bpy.props.EnumProperty(
        name="View",
        items=[("CAMERA", "Camera", "The scene's camera"), ("VIEW", "3D view", "What this 3D view shows")],
    )
    width: bpy.props.IntProperty(name="Width", default=960, min=8, max=16384, subtype="PIXEL")
    height: bpy.props.IntProperty(name="Height", default=540, min=8, max=16384, subtype="PIXEL")
    verify: bpy.props.IntProperty(
        name="Verify",
        description="Hold the preview against the exact answer at so many random points, and show the error; 0: don't",
        default=256,
        min=0,
        max=1 << 20,
    )
    show_in_view: bpy.props.BoolProperty(
        name="In 3D views", description="Draw the preview in the corner of 3D views", default=True
    )
    antialiasing: bpy.props.IntProperty(
        name="Antialiasing",
        description="N x N receivers a pixel in final renders with an opaque film; visibility is always that of pixel centres",
        default=2,
        min=1,
        max=16,
    )
    viewport_scale: bpy.props.IntProperty(
        name="Viewport", description="Of a rendered 3D view", default=50, min=10, max=100, subtype="PERCENTAGE"
    )
    cycles_samples: bpy.props.IntProperty(
        name="Samples", description="Samples a pixel of the image that Cycles renders", default=64, min=1, max=65536
    )

    def settings(self) -> tuple[tuple[str, str], ...]:
        """The overridden parameters of the chosen technique."""
        return tuple((item.name, item.value) for item in self.overrides if item.technique == self.technique_name)

    def request(self, size: tuple[int, int], **choices: Any) -> job.Request:
        """What the binary is asked for, with the chosen technique."""
        return job.Request(
            size=size,
            technique=self.technique_name,
            preset=self.preset_name,
            settings=self.settings(),
            device=self.device,
            **choices,
        )


class PenumbraLayerSettings(bpy.types.PropertyGroup):
    """Passes of a view layer that Blender has no switch for"""

    use_pass_visibility: bpy.props.BoolProperty(
        name="Visibility", description="Fraction of each light's area that is seen, a pass a light", default=True
    )
    use_pass_irradiance: bpy.props.BoolProperty(
        name="Irradiance", description="W/m² that the surface gets from all lights. Renders a second time", default=False
    )


CLASSES = (ParameterOverride, PenumbraSettings, PenumbraLayerSettings)


def register() -> None:
    """Adds the settings to scenes and view layers."""
    bpy.types.Scene.penumbra = bpy.props.PointerProperty(type=PenumbraSettings)
    bpy.types.ViewLayer.penumbra = bpy.props.PointerProperty(type=PenumbraLayerSettings)


def unregister() -> None:
    """Takes them away."""
    del bpy.types.ViewLayer.penumbra
    del bpy.types.Scene.penumbra

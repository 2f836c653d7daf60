# SPDX-License-Identifier: GPL-3.0-or-later
"""Panels: the 3D view's sidebar (any engine), the render and view-layer properties (Penumbra's engine)."""

from __future__ import annotations

import textwrap
from typing import Any

import bpy

from . import compare, engine, preferences, preview, process, schema


class PENUMBRA_OT_override(bpy.types.Operator):
    """Give a parameter another value than the preset's, or take that back"""

    bl_idname = "penumbra.override"
    bl_label = "Set Parameter"
    bl_options = {"REGISTER", "UNDO", "INTERNAL"}

    parameter: bpy.props.StringProperty(options={"HIDDEN"})
    remove: bpy.props.BoolProperty(options={"HIDDEN"})

    @classmethod
    def description(cls, context: bpy.types.Context, operator: Any) -> str:
        """What the binary says about the parameter."""
        technique = context.scene.penumbra.chosen_technique()
        parameter = technique.parameter(operator.parameter) if technique else None
        if parameter is None:
            return cls.__doc__
        limits = [f"at least {parameter.minimum:g}"] if parameter.minimum is not None else []
        limits += [f"at most {parameter.maximum:g}"] if parameter.maximum is not None else []
        return f"{parameter.meaning}\nDefault: {_text(parameter.default)}. {', '.join(limits).capitalize()}"

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Adds or removes it."""
        settings = context.scene.penumbra
        technique = settings.chosen_technique()
        parameter = technique.parameter(self.parameter) if technique else None
        found = [
            number
            for number, item in enumerate(settings.overrides)
            if item.technique == settings.technique_name and item.name == self.parameter
        ]
        if self.remove:
            for number in reversed(found):
                settings.overrides.remove(number)
        elif parameter is None:
            self.report({"ERROR"}, f"{settings.technique_name} has no parameter {self.parameter!r}")
            return {"CANCELLED"}
        elif not found:
            item = settings.overrides.add()
            item.technique, item.name, item.value = technique.name, parameter.name, _text(parameter.default)
        return {"FINISHED"}


def _text(value: bool | int | float | str) -> str:
    """A value as the binary's `--set` takes it."""
    return str(value).lower() if isinstance(value, bool) else str(value)


def _draw_lines(layout: bpy.types.UILayout, text: str, context: bpy.types.Context, icon: str = "NONE") -> None:
    """Text over as many lines as the panel's width needs."""
    width = context.region.width if context.region else 300
    # Of Blender's interface font, 7 px at scale 1 is wider than its average letter.
    columns = max(16, int((width - 40) / (7 * context.preferences.system.ui_scale)))
    for number, line in enumerate(textwrap.wrap(text, columns) or [""]):
        layout.label(text=line, icon=icon if number == 0 else "BLANK1" if icon != "NONE" else "NONE")


def draw_technique(layout: bpy.types.UILayout, context: bpy.types.Context) -> None:
    """The technique with its preset and parameters, all of it as the binary lists them."""
    settings = context.scene.penumbra
    column = layout.column()
    column.use_property_split = True
    column.use_property_decorate = False
    column.prop(settings, "technique")
    technique = settings.chosen_technique()
    if technique is None:
        return
    if technique.presets:
        column.prop(settings, "preset")
    overrides = {item.name: item for item in settings.overrides if item.technique == technique.name}
    for parameter in technique.parameters:
        _draw_parameter(column, parameter, overrides.get(parameter.name))
    for name in overrides.keys() - {parameter.name for parameter in technique.parameters}:
        row = column.row()
        row.label(text=f"{name}: not offered by the binary", icon="ERROR")
        _override_button(row, name, "X", remove=True)


def _draw_parameter(column: bpy.types.UILayout, parameter: schema.Parameter, item: Any) -> None:
    row = column.row(align=True)
    label = parameter.name.replace("_", " ").capitalize()
    if item is None:
        split = row.split(factor=0.4)
        split.alignment = "RIGHT"
        split.label(text=label)
        value = split.row()
        value.active = False
        value.label(text=_text(parameter.default) or "-")
        _override_button(row, parameter.name, "ADD", remove=False)
        return
    names = {"bool": "as_bool", "int": "as_int", "float": "as_float", "choice": "as_choice", "text": "value"}
    row.prop(item, names[parameter.kind], text=label)
    _override_button(row, parameter.name, "X", remove=True)


def _override_button(row: bpy.types.UILayout, name: str, icon: str, *, remove: bool) -> None:
    button = row.operator(PENUMBRA_OT_override.bl_idname, text="", icon=icon, emboss=False)
    button.parameter, button.remove = name, remove


def _draw_missing_binary(layout: bpy.types.UILayout, context: bpy.types.Context) -> bool:
    """Says so where there is no binary."""
    try:
        schema.techniques(preferences.find_binary())
        return False
    except (process.ProcessError, OSError) as error:
        _draw_lines(layout.box().column(align=True), str(error), context, "ERROR")
        return True


class _Sidebar:
    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"
    bl_category = "Penumbra"


class PENUMBRA_PT_preview(_Sidebar, bpy.types.Panel):
    """Soft-shadow previews beside any engine"""

    bl_label = "Shadow Preview"

    def draw(self, context: bpy.types.Context) -> None:
        """The panel."""
        layout = self.layout
        if _draw_missing_binary(layout, context):
            return
        settings = context.scene.penumbra
        column = layout.column()
        column.use_property_split = True
        column.use_property_decorate = False
        column.prop(settings, "light")
        column.prop(settings, "quantity")
        column.prop(settings, "view")
        sizes = column.column(align=True)
        sizes.prop(settings, "width")
        sizes.prop(settings, "height")
        column.prop(settings, "verify")
        column.prop(settings, "show_in_view")
        current = preview.Preview.current
        if current is not None and current.is_running:
            row = layout.row(align=True)
            text = f"{current.job.label}: {100 * current.job.fraction:.0f} %"
            if hasattr(row, "progress"):
                row.progress(factor=current.job.fraction, text=text)
            else:
                row.label(text=text, icon="TIME")
            row.operator(preview.PENUMBRA_OT_cancel.bl_idname, text="", icon="X")
        else:
            layout.operator(preview.PENUMBRA_OT_preview.bl_idname, icon="RENDER_STILL")


class PENUMBRA_PT_result(_Sidebar, bpy.types.Panel):
    """What the last preview took, and how far off it is"""

    bl_label = "Result"
    bl_parent_id = "PENUMBRA_PT_preview"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Where there is one."""
        return preview.Preview.current is not None and not preview.Preview.current.is_running

    def draw(self, context: bpy.types.Context) -> None:
        """The panel."""
        current = preview.Preview.current
        column = self.layout.column(align=True)
        if current.message:
            _draw_lines(column, current.message.capitalize(), context, "ERROR" if current.message != "cancelled" else "CANCEL")
        for line in current.caption:
            _draw_lines(column, line, context)
        for name in current.images:
            column.label(text=f"Image: {name}", icon="IMAGE_DATA")


class PENUMBRA_PT_technique(_Sidebar, bpy.types.Panel):
    """Which technique finds the shadows, and its parameters"""

    bl_label = "Technique"
    bl_parent_id = "PENUMBRA_PT_preview"

    def draw(self, context: bpy.types.Context) -> None:
        """The panel."""
        draw_technique(self.layout, context)


class PENUMBRA_PT_compare(_Sidebar, bpy.types.Panel):
    """The same view in Cycles, and the difference"""

    bl_label = "Compare with Cycles"
    bl_parent_id = "PENUMBRA_PT_preview"
    bl_options = {"DEFAULT_CLOSED"}

    def draw(self, context: bpy.types.Context) -> None:
        """The panel."""
        layout = self.layout
        column = layout.column()
        column.use_property_split = True
        column.use_property_decorate = False
        column.prop(context.scene.penumbra, "cycles_samples")
        layout.operator(compare.PENUMBRA_OT_compare.bl_idname, icon="IMAGE_ALPHA")
        lines = layout.column(align=True)
        for line in compare.last_lines:
            _draw_lines(lines, line, context)


class PENUMBRA_PT_render(bpy.types.Panel):
    """The technique of final renders"""

    bl_label = "Penumbra"
    bl_space_type = "PROPERTIES"
    bl_region_type = "WINDOW"
    bl_context = "render"
    COMPAT_ENGINES = {engine.ENGINE}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """With this engine."""
        return context.engine in cls.COMPAT_ENGINES

    def draw(self, context: bpy.types.Context) -> None:
        """The panel."""
        layout = self.layout
        if _draw_missing_binary(layout, context):
            return
        draw_technique(layout, context)
        column = layout.column()
        column.use_property_split = True
        column.use_property_decorate = False
        column.prop(context.scene.penumbra, "device")
        column.prop(context.scene.penumbra, "antialiasing")
        column.prop(context.scene.penumbra, "viewport_scale")


class PENUMBRA_PT_film(bpy.types.Panel):
    """The background of final renders"""

    bl_label = "Film"
    bl_space_type = "PROPERTIES"
    bl_region_type = "WINDOW"
    bl_context = "render"
    COMPAT_ENGINES = {engine.ENGINE}
    poll = PENUMBRA_PT_render.poll

    def draw(self, context: bpy.types.Context) -> None:
        """The panel."""
        self.layout.use_property_split = True
        self.layout.prop(context.scene.render, "film_transparent", text="Transparent")


class PENUMBRA_PT_passes(bpy.types.Panel):
    """Passes of a view layer"""

    bl_label = "Passes"
    bl_space_type = "PROPERTIES"
    bl_region_type = "WINDOW"
    bl_context = "view_layer"
    COMPAT_ENGINES = {engine.ENGINE}
    poll = PENUMBRA_PT_render.poll

    def draw(self, context: bpy.types.Context) -> None:
        """The panel."""
        layout = self.layout
        layout.use_property_split = True
        layout.use_property_decorate = False
        column = layout.column(heading="Penumbra")
        column.prop(context.view_layer.penumbra, "use_pass_visibility")
        column.prop(context.view_layer.penumbra, "use_pass_irradiance")
        column = layout.column(heading="Data")
        column.prop(context.view_layer, "use_pass_z", text="Depth")
        column.prop(context.view_layer, "use_pass_position")
        column.prop(context.view_layer, "use_pass_normal")


CLASSES = (
    PENUMBRA_OT_override,
    PENUMBRA_PT_preview,
    PENUMBRA_PT_result,
    PENUMBRA_PT_technique,
    PENUMBRA_PT_compare,
    PENUMBRA_PT_render,
    PENUMBRA_PT_film,
    PENUMBRA_PT_passes,
)

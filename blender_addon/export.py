# SPDX-License-Identifier: GPL-3.0-or-later
"""Export: glTF and USD through Blender's own exporters, with what they lose of lights put back, and the geometry of a render as
a plain GLB. The user's scene stays as it is."""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path
from typing import Any

import bpy
import numpy as np
from bpy_extras.io_utils import ExportHelper

from . import extract, glb, lights, preview, process


def light_block(light_object: bpy.types.Object, matrix_world: Any, shown: list[bpy.types.Object]) -> dict[str, Any]:
    """A light's `PENUMBRA_lights` block with its linking among the objects that are exported."""
    block = lights.describe(light_object.data, np.array(matrix_world, dtype=float), version=bpy.app.version)
    names = {item.name for item in shown}
    lights.add_linking(block, light_object, names, {item.name for item in shown if not item.visible_shadow})
    return block


def _surfaces(scene: bpy.types.Scene) -> list[bpy.types.Object]:
    """Objects of a scene that may light or block."""
    return [item for item in scene.objects if item.type not in {"LIGHT", "CAMERA", "ARMATURE", "LATTICE", "SPEAKER"}]


class glTF2ExportUserExtension:
    """Hook of Blender's glTF exporter: adds `EXT_lights_area` and `PENUMBRA_lights` to the nodes of lights."""

    def __init__(self) -> None:
        from io_scene_gltf2.io.com.gltf2_io_extensions import ChildOfRootExtension, Extension

        self.child_of_root, self.extension = ChildOfRootExtension, Extension
        self.shown = _surfaces(bpy.context.scene)

    def gather_node_hook(self, node: Any, blender_object: bpy.types.Object | None, settings: dict[str, Any]) -> None:
        """Called for every node of the file."""
        if blender_object is None or blender_object.type != "LIGHT" or not settings.get("gltf_lights"):
            return
        matrix = np.array(blender_object.matrix_world, dtype=float)
        block = light_block(blender_object, matrix, self.shown)
        node.extensions = node.extensions or {}
        node.extensions["PENUMBRA_lights"] = self.extension(name="PENUMBRA_lights", extension=block, required=False)
        area = lights.area_extension(block, name=blender_object.name)
        if area is not None:
            # The extension's size is multiplied by the node's largest scale.
            area["size"] /= max(lights.column_lengths(matrix))
            node.extensions["EXT_lights_area"] = self.extension(
                name="EXT_lights_area",
                extension={
                    "light": self.child_of_root(path=["lights"], name="EXT_lights_area", extension=area, required=False)
                },
                required=False,
            )


def _check_lights(scene: bpy.types.Scene) -> None:
    """Raises `lights.UnsupportedLight` for a light that can't be exported as it is."""
    for item in scene.objects:
        if item.type == "LIGHT" and not item.hide_render:
            lights.describe(item.data, np.array(item.matrix_world, dtype=float), version=bpy.app.version)


def _supported(operator: Any, options: dict[str, Any]) -> dict[str, Any]:
    """Those options that this Blender's exporter has."""
    known = operator.get_rna_type().properties.keys()
    return {name: value for name, value in options.items() if name in known}


class _Export(ExportHelper):
    """What both exports share: written beside their place and renamed, errors as one line."""

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Writes the file."""
        path = Path(bpy.path.abspath(self.filepath))
        # In the same folder, where relative paths to textures hold.
        written = path.with_name(f".penumbra-{os.getpid()}-{path.name}")
        try:
            for warning in self.write(context, written):
                self.report({"WARNING"}, warning)
            os.replace(written, path)
        except (lights.UnsupportedLight, extract.ExtractError, process.ProcessError, glb.SceneTooLarge) as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        except OSError as error:
            self.report({"ERROR"}, process.describe_os_error(error, f"exporting {path.name}"))
            return {"CANCELLED"}
        except RuntimeError as error:
            # What Blender's exporter says: where that is a traceback, its last line tells.
            lines = [line.strip() for line in str(error).splitlines() if line.strip() and not line.startswith("Location:")]
            self.report({"ERROR"}, f"Blender's exporter failed: {lines[-1] if lines else error}")
            return {"CANCELLED"}
        finally:
            with suppress(OSError):
                written.unlink(missing_ok=True)
        self.report({"INFO"}, f"wrote {path}")
        return {"FINISHED"}


class PENUMBRA_OT_export_gltf(_Export, bpy.types.Operator):
    """Write the scene for Penumbra as a .glb, with all that Cycles knows about its lights"""

    bl_idname = "penumbra.export_gltf"
    bl_label = "Export for Penumbra (.glb)"
    filename_ext = ".glb"
    filter_glob: bpy.props.StringProperty(default="*.glb", options={"HIDDEN"})
    evaluation: bpy.props.EnumProperty(
        name="Geometry",
        items=[
            ("EXPORTER", "Blender's exporter", "Materials, textures and animation too; modifiers as in the viewport"),
            (
                "RENDER",
                "As rendered",
                "What a final render evaluates at this frame, with base colours; instances are kept",
            ),
        ],
    )

    def write(self, context: bpy.types.Context, path: Path) -> list[str]:
        """Writes it to `path` and returns warnings."""
        scene = context.scene
        _check_lights(scene)
        if self.evaluation == "RENDER":
            size = extract.render_size(scene.render)
            harvested = preview.harvest(scene, context.view_layer, None, size)
            if harvested.scene is None:
                raise extract.ExtractError(harvested.error)
            glb.write(path, harvested.scene, aspect=size[0] / size[1])
            return harvested.scene.warnings
        options = {
            "export_format": "GLB",
            "export_lights": True,
            "export_cameras": True,
            "export_apply": True,
            "export_yup": True,
            "use_renderable": True,
            "use_active_scene": True,
            "export_gn_mesh": True,
        }
        exporter = bpy.ops.export_scene.gltf
        exporter(filepath=str(path), check_existing=False, **_supported(exporter, options))
        return _linked_parents(scene)


def _linked_parents(scene: bpy.types.Scene) -> list[str]:
    """Warnings about light linking that a hierarchy of nodes says for children too."""
    shown = _surfaces(scene)
    warnings = []
    for item in scene.objects:
        if item.type != "LIGHT" or item.hide_render:
            continue
        block = light_block(item, item.matrix_world, shown)
        left_out = set(block.get("light_exclude", ())) | set(block.get("shadow_exclude", ()))
        parents = [o.name for o in shown if o.name in left_out and any(child.name not in left_out for child in o.children)]
        if parents:
            warnings.append(f"light {item.name!r}: the file excludes {', '.join(parents)} with all children; use As rendered")
    return warnings


class PENUMBRA_OT_export_usd(_Export, bpy.types.Operator):
    """Write the scene as USD, with what Blender's exporter loses of lights put back"""

    bl_idname = "penumbra.export_usd"
    bl_label = "Export for Penumbra (.usdc)"
    filename_ext = ".usdc"
    filter_glob: bpy.props.StringProperty(default="*.usdc;*.usda;*.usd", options={"HIDDEN"})
    animation: bpy.props.BoolProperty(name="Animation", description="All frames of the scene as time samples")

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Where this Blender was built with USD."""
        return bpy.app.build_options.usd

    def check(self, context: bpy.types.Context) -> bool:
        """Keeps .usda and .usd where they are chosen."""
        if Path(self.filepath).suffix in {".usda", ".usdc", ".usd"}:
            return False
        self.filepath += self.filename_ext
        return True

    def write(self, context: bpy.types.Context, path: Path) -> list[str]:
        """Writes it to `path` and returns warnings."""
        from . import usd_lights

        usd_lights.expect_pxr()
        scene = context.scene
        _check_lights(scene)
        shown = _surfaces(scene)
        blocks = {}
        for item in scene.objects:
            if item.type == "LIGHT" and not item.hide_render:
                blocks[item.name] = (item.data, light_block(item, item.matrix_world, shown))
        is_linked = any({"light_exclude", "shadow_exclude"} & block.keys() for _, block in blocks.values())
        options = {
            "evaluation_mode": "RENDER",
            # The default writes the cage, whose shadow is another.
            "export_subdivision": "TESSELLATE",
            "export_lights": True,
            "export_animation": self.animation,
            # What is linked has to be a prim of its own.
            "use_instancing": not is_linked,
            "convert_world_material": False,
            "export_custom_properties": True,
            "author_blender_name": True,
            # Textures stay where they are (one setting from 4.3 on, another before).
            "export_textures_mode": "KEEP",
            "export_textures": False,
        }
        exporter = bpy.ops.wm.usd_export
        exporter(filepath=str(path), check_existing=False, **_supported(exporter, options))
        return usd_lights.correct(path, blocks)


def _menu(self: Any, context: bpy.types.Context) -> None:
    self.layout.operator(PENUMBRA_OT_export_gltf.bl_idname, text="Penumbra (.glb)")
    if bpy.app.build_options.usd:
        self.layout.operator(PENUMBRA_OT_export_usd.bl_idname, text="Penumbra (.usdc)")


CLASSES = (PENUMBRA_OT_export_gltf, PENUMBRA_OT_export_usd)


def register() -> None:
    """Adds the exports to the File menu."""
    bpy.types.TOPBAR_MT_file_export.append(_menu)


def unregister() -> None:
    """Takes them away."""
    bpy.types.TOPBAR_MT_file_export.remove(_menu)

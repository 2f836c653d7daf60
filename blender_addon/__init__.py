# SPDX-License-Identifier: GPL-3.0-or-later
"""Penumbra in Blender: previews, final renders, comparison with Cycles, and export. Registration only.

The metadata below serves Blender 3.4, where this folder is an add-on; from 4.2 on it is an extension (blender_manifest.toml).
"""

bl_info = {
    "name": "Penumbra",
    "description": "Soft shadows of area lights, with their error measured",
    "author": "The Penumbra maintainers",
    "version": (0, 1, 0),
    "blender": (3, 4, 0),
    "location": "3D View > Sidebar > Penumbra; Render Properties > Render Engine; File > Export",
    "category": "Render",
}

import atexit

import bpy

from . import compare, engine, export, job, overlay, panels, preferences, preview, properties
from .export import glTF2ExportUserExtension as glTF2ExportUserExtension

_CLASSES = (
    preferences.PenumbraPreferences,
    *properties.CLASSES,
    *engine.CLASSES,
    *preview.CLASSES,
    *compare.CLASSES,
    *export.CLASSES,
    *panels.CLASSES,
)
_MODULES = (properties, engine, preview, export, overlay)


def register() -> None:
    """Called by Blender when the add-on is turned on."""
    for cls in _CLASSES:
        bpy.utils.register_class(cls)
    for module in _MODULES:
        module.register()
    atexit.register(job.stop_all)


def unregister() -> None:
    """Called by Blender when the add-on is turned off."""
    atexit.unregister(job.stop_all)
    job.stop_all()
    for module in reversed(_MODULES):
        module.unregister()
    for cls in reversed(_CLASSES):
        bpy.utils.unregister_class(cls)

# SPDX-License-Identifier: GPL-3.0-or-later
"""Preferences of the add-on, and the binary that they lead to."""

from __future__ import annotations

from pathlib import Path

import bpy

from . import process


class PenumbraPreferences(bpy.types.AddonPreferences):
    """Where the binary is, and how patient to be with it"""

    bl_idname = __package__

    binary: bpy.props.StringProperty(
        name="Penumbra binary",
        description="The penumbra program; empty: the one that came with this extension, else the one on the PATH",
        subtype="FILE_PATH",
    )
    stall_seconds: bpy.props.FloatProperty(
        name="Stop after silence",
        description="Stop the program when it has made no progress for so long",
        default=300.0,
        min=1.0,
        max=86400.0,
        subtype="TIME_ABSOLUTE" if bpy.app.version >= (4, 0, 0) else "TIME",
        unit="TIME_ABSOLUTE" if bpy.app.version >= (4, 0, 0) else "TIME",
    )

    def draw(self, context: bpy.types.Context) -> None:
        """The preferences' panel."""
        layout = self.layout
        layout.prop(self, "binary")
        layout.prop(self, "stall_seconds")
        try:
            layout.label(text=f"Uses {find_binary()}", icon="CHECKMARK")
        except process.ProcessError as error:
            layout.label(text=str(error), icon="ERROR")


def preferences() -> PenumbraPreferences | None:
    """The add-on's preferences; none while it is being registered."""
    addon = bpy.context.preferences.addons.get(__package__)
    return addon.preferences if addon else None


def find_binary() -> Path:
    """The binary to run; raises `process.ProcessError` where there is none."""
    prefs = preferences()
    preferred = bpy.path.abspath(prefs.binary) if prefs and prefs.binary else ""
    return process.find(preferred)


def stall_seconds() -> float:
    """How long the binary may make no progress, s."""
    prefs = preferences()
    return prefs.stall_seconds if prefs else 300.0

"""Cycles as a judge: scenes of .blend and glTF files under direct light alone, in Penumbra's layers and units.

`gltf` and `lights` are plain Python; `scene` and `render` need bpy. Matrices are 4x4 numpy arrays named target_from_source;
"world" is glTF's (metres, +Y up), "blender" is Blender's (+Z up). Local axes of lights and cameras are the same in both: they
look along -Z, +Y up.
"""


class Fault(Exception):
    """What a user can mend: said in one line."""

"""The command scripts/cycles_reference: what it writes, keeps and refuses."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from cycles_tools import CYCLES_REFERENCE, PENUMBRA, ROOT, Document, box, cycles, floor, looking, penumbra, read_exr

SIZE = "40x30"


def small_scene(path: Path) -> Document:
    """A box over a floor."""
    document = Document()
    floor(document, 0.0, 6.0)
    box(document, (0.0, 1.1, 0.0), 0.5, 0.5)
    document.camera("view", looking((4.0, 5.0, 4.5), (0.0, 0.2, 0.0)), 0.6)
    block = {"shape": "rect", "width": 1.5, "height": 0.8, "radiance": [50.0, 40.0, 30.0]}
    document.light("Key.1", looking((1.5, 4.0, -1.0), (0.0, 0.0, 0.0)), block)
    document.write(path)
    return document


def refused(*arguments: object) -> tuple[int, str]:
    """Status and the one line of a run that must fail."""
    command = [sys.executable, CYCLES_REFERENCE, *arguments]
    done = subprocess.run([str(part) for part in command], capture_output=True, text=True, timeout=60, check=False)
    assert done.stdout == ""
    lines = done.stderr.splitlines()
    assert len(lines) == 1 and lines[0].startswith("error: "), done.stderr
    return done.returncode, lines[0]


@pytest.mark.timeout(120)
def test_the_picture_has_penumbras_layers_and_the_binary_takes_it(tmp_path: Path) -> None:
    scene, output = tmp_path / "box.glb", tmp_path / "cycles.exr"
    small_scene(scene)
    image, record = cycles(scene, output, samples=16, size=SIZE)
    light = [f"Key.1.{layer}.{channel}" for layer in ("irradiance", "irradiance_unshadowed") for channel in "RGB"]
    vectors = [f"{layer}.{axis}" for layer in ("position", "normal", "shading_normal") for axis in "XYZ"]
    assert sorted(image) == sorted([*light, "Key.1.irradiance_ratio", *vectors, "depth.Z", "coverage.A"])
    assert record["size"] == [40, 30] and [entry["name"] for entry in record["lights"]] == ["Key.1"]
    # The same camera: the same points, to a float's roundings over the way from the camera.
    render = tmp_path / "render.exr"
    penumbra("render", scene, "--size", SIZE, "--aov", "position,normal,depth", "-o", render)
    ours = read_exr(render)
    both = (ours["coverage.A"] == 1.0) & (image["coverage.A"] == 1.0)
    assert both.sum() > 0.95 * max(ours["coverage.A"].sum(), image["coverage.A"].sum())
    for name in ("position.X", "position.Y", "position.Z", "normal.X", "normal.Y", "normal.Z", "depth.Z"):
        assert np.abs(ours[name] - image[name])[both].max() < 1e-4, name
    exact = tmp_path / "exact.exr"
    penumbra("reference", scene, "--receivers", output, "--quantity", "irradiance", "-o", exact)
    compared = json.loads(penumbra("compare", output, exact, "--json"))
    assert compared["lights"][0]["irradiance"]["relative_rmse"] < 0.02


@pytest.mark.timeout(120)
def test_an_image_is_found_again_by_what_it_depends_on(tmp_path: Path) -> None:
    scene, kept = tmp_path / "box.glb", tmp_path / "kept"
    document = small_scene(scene)
    first, record = cycles(scene, tmp_path / "a.exr", "--cache", kept, samples=4, size=SIZE)
    assert not record["cached"]
    moved = tmp_path / "elsewhere.glb"
    document.write(moved)
    again, record = cycles(moved, tmp_path / "b.exr", "--cache", kept, samples=4, size=SIZE)
    assert record["cached"] and all(np.array_equal(again[name], first[name]) for name in first)
    document.json["nodes"][-1]["extensions"]["PENUMBRA_lights"]["width"] = 1.6
    document.write(moved)
    for changed in ((moved, 4, 0), (scene, 5, 0), (scene, 4, 1)):
        path, samples, seed = changed
        _, record = cycles(path, tmp_path / "c.exr", "--cache", kept, samples=samples, size=SIZE, seed=seed)
        assert not record["cached"], changed


@pytest.mark.timeout(900)
def test_what_it_cannot_do_it_says_in_one_line(tmp_path: Path) -> None:
    scene, output = tmp_path / "box.glb", tmp_path / "out.exr"
    document = small_scene(scene)
    assert refused(scene, "-o", tmp_path / "out.png")[0] == 2
    assert refused(scene, "-o", output, "--size", "0x10")[0] == 2
    assert refused(scene, "-o", output, "--denoise", "--engine", "eevee")[0] == 2
    for arguments, expected in (
        ((tmp_path / "missing.glb", "-o", output), "no such file"),
        ((ROOT / "README.md", "-o", output), "expected a .blend"),
        ((scene, "-o", tmp_path / "no" / "out.exr"), "no such directory"),
        ((scene, "-o", output, "--light", "Moon"), "there is Key.1"),
        ((scene, "-o", output, "--camera", "back"), "there is view"),
    ):
        status, line = refused(*arguments)
        assert status == 1 and expected in line, line
    broken = tmp_path / "broken.glb"
    broken.write_bytes(scene.read_bytes()[:300])
    bad_blend = tmp_path / "bad.blend"
    bad_blend.write_bytes(b"no blend")
    for path in (broken, bad_blend):
        assert refused(path, "-o", output)[0] == 1
    light = document.json["nodes"][-1]["extensions"]["PENUMBRA_lights"]
    for change, expected in (
        ({"shape": "tube", "length": 1.0, "radius": 0.1}, "no light of the shape tube"),
        ({"shape": "spot", "radius": 0.0, "intensity": [1.0] * 3, "inner_cone": 0.1, "outer_cone": 0.5}, "fall off otherwise"),
        ({"shape": "rect", "shadow_exclude": ["box"]}, "shadow_exclude is not supported"),
        ({"shape": "rect", "width": -1.0}, "width must be a positive number"),
    ):
        document.json["nodes"][-1]["extensions"]["PENUMBRA_lights"] = light | change
        document.write(scene)
        status, line = refused(scene, "-o", output)
        assert status == 1 and expected in line, line
    document.json["nodes"][-1]["extensions"]["PENUMBRA_lights"] = light
    document.json["materials"] = [{"alphaMode": "MASK"}]
    document.write(scene)
    assert "cut-out" in refused(scene, "-o", output)[1]
    assert not output.exists() and not list(tmp_path.glob(".*"))


@pytest.mark.timeout(60)
def test_positions_say_how_far_they_may_be_off(tmp_path: Path) -> None:
    import OpenEXR

    scene, output = tmp_path / "box.glb", tmp_path / "points.exr"
    small_scene(scene)
    shape = (2, 2)
    # Below the floor by what the header allows for, or not: its own surface must not shadow it.
    below = {
        "position.X": 3.0,
        "position.Y": -1e-5,
        "position.Z": -3.0,
        "normal.X": 0.0,
        "normal.Y": 1.0,
        "normal.Z": 0.0,
        "coverage.A": 1.0,
    }
    samples = {name: np.full(shape, value, np.float32) for name, value in below.items()}
    lit = {}
    for error in (None, "2e-5"):
        header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
        header |= {} if error is None else {"penumbra:position_error": error}
        OpenEXR.File(header, samples).write(str(output))
        penumbra("reference", scene, "--receivers", output, "-o", tmp_path / "seen.exr")
        lit[error] = read_exr(tmp_path / "seen.exr")["Key.1.visibility"]
    assert (lit[None] == 0.0).all() and (lit["2e-5"] > 0.99).all()
    OpenEXR.File(header | {"penumbra:position_error": "far"}, samples).write(str(output))
    command = [PENUMBRA, "reference", scene, "--receivers", output, "-o", tmp_path / "seen.exr"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=30, check=False)
    assert done.returncode == 1 and "penumbra:position_error" in done.stderr

"""Shadows as Cycles sees them, E/E0, against the exact ones, and techniques as both judge them.

Two pictures of Cycles by different seeds tell its noise; what they have in common against the exact answer has to be nothing
that a mean over all pixels can resolve, and their noise has to fall as samples come, so that nothing is hidden in it. Kernel
techniques know visibility alone, which Cycles does not show, and are not judged here.
"""

import math
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from cycles_tools import (
    LEAST_E0,
    SIGMAS,
    Channels,
    Document,
    Judged,
    ball,
    box,
    cycles,
    exact,
    floor,
    looking,
    penumbra,
    read_exr,
    shared,
    without_shadows,
)

SIZE = "120x90"
FEW, MANY = 16, 256

# Share of the pixels that may show more than one surface: silhouettes, which Cycles' 0.03 pixel wide samples meet by chance.
MOST_MIXED = 0.02

# Share of the largest E0 below which light counts as grazing.
GRAZING_E0 = 0.1

# How fast Cycles' error falls with its samples N, as N^-0.75 (its own papers; measured on a box and on Suzanne from 4 to 1024).
CYCLES_TREND = 0.75

RADIANCE = [50.0, 40.0, 30.0]
LIGHTS = {
    "rect": {"shape": "rect", "width": 1.5, "height": 0.8, "radiance": RADIANCE},
    "disk": {"shape": "disk", "width": 1.2, "height": 1.2, "radiance": RADIANCE},
    "ellipse": {"shape": "disk", "width": 1.5, "height": 0.6, "radiance": RADIANCE},
    "spread": {"shape": "rect", "width": 1.5, "height": 0.8, "radiance": RADIANCE, "spread": math.radians(120)},
    "sphere": {"shape": "sphere", "radius": 0.5, "radiance": RADIANCE},
    "facing": {"shape": "sphere", "radius": 0.5, "radiance": RADIANCE, "facing": True},
    "sun": {"shape": "sun", "angle": math.radians(15), "irradiance": RADIANCE},
}


@dataclass(frozen=True)
class Case:
    """A scene with a rect light, and how much a shadow map's texels add to a technique's squared error there, times texels a
    side (tests/map_scenes.rs)."""

    name: str
    build: Callable[[Path], Path]
    texel_share: float
    size: str = SIZE


def box_scene(path: Path, lights: dict | None = None) -> Path:
    """A turned box over a floor."""
    document = Document()
    floor(document, 0.0, 6.0)
    box(document, (0.0, 1.1, 0.0), 0.5, 0.5)
    document.camera("view", looking((4.0, 5.0, 4.5), (-0.3, 0.2, -0.3)), 0.55)
    for name, block in (lights or {"rect": LIGHTS["rect"]}).items():
        document.light(name, looking((1.5, 4.0, -1.0), (0.0, 0.0, 0.0)), block)
    document.write(path)
    return path


def ball_scene(path: Path) -> Path:
    """A smooth ball over a floor: shading normals are not geometric ones."""
    document = Document()
    floor(document, 0.0, 6.0)
    ball(document, (0.0, 1.0, 0.0), 0.6)
    document.camera("view", looking((3.5, 3.0, 4.0), (-0.2, 0.5, -0.2)), 0.55)
    document.light("rect", looking((1.5, 4.0, 1.0), (0.0, 0.0, 0.0)), LIGHTS["rect"])
    document.write(path)
    return path


def shared_scene(
    model: str, *, ground: float, half: float, key: tuple, width: float, eye: tuple, target: tuple, flat: bool
) -> Callable[[Path], Path]:
    """A shared model on a floor, under a rect light. Open surfaces are shown flat: below a smooth one's own horizon Cycles
    sees through its holes."""

    def build(path: Path) -> Path:
        document = Document.read(shared(model))
        document.drop_appearance()
        for mesh in document.json["meshes"] if flat else []:
            for primitive in mesh["primitives"]:
                primitive["attributes"].pop("NORMAL", None)
        floor(document, ground, half)
        light = {"shape": "rect", "width": width, "height": 0.6 * width, "radiance": RADIANCE}
        document.light("rect", looking(key, target), light)
        document.camera("view", looking(eye, target), 0.6)
        document.write(path)
        return path

    return build


# Runs in Blender: the ground and the lights of CLEVR's scenes, and something on it that casts shadows, smooth and flat.
CLEVR = """
import sys, os, bpy
bpy.ops.wm.open_mainfile(filepath=sys.argv[1], load_ui=False)
bpy.ops.mesh.primitive_monkey_add(size=2.0, location=(0.0, 0.0, 0.9), rotation=(0.2, 0.0, 0.7))
bpy.ops.object.modifier_add(type="SUBSURF")
bpy.context.object.modifiers[0].levels, bpy.context.object.modifiers[0].render_levels = 0, 1
bpy.ops.mesh.primitive_cube_add(size=1.0, location=(1.4, -1.2, 0.5), rotation=(0.0, 0.0, 0.4))
bpy.ops.wm.save_as_mainfile(filepath=sys.argv[2])
os._exit(0)
"""

CASES = [
    Case("box", box_scene, 0.25),
    Case("ball", ball_scene, 0.25),
    Case(
        "suzanne",
        shared_scene(
            "suzanne/02_suzanne.gltf",
            ground=-1.7,
            half=8.0,
            key=(2.5, 3.0, 2.0),
            width=1.0,
            eye=(3.0, 1.8, 5.0),
            target=(0.3, -0.8, -0.3),
            flat=True,
        ),
        0.7,
    ),
    Case(
        "bunny",
        shared_scene(
            "stanford-bunny/stanford-bunny.glb",
            ground=0.033,
            half=1.0,
            key=(0.2, 0.45, 0.2),
            width=0.12,
            eye=(0.1, 0.25, 0.45),
            target=(-0.02, 0.09, 0.0),
            flat=False,
        ),
        0.7,
    ),
    Case(
        "jeep",
        shared_scene(
            "jeep1/jeep1.glb",
            ground=-0.03,
            half=40.0,
            key=(12.0, 20.0, 8.0),
            width=5.0,
            eye=(20.0, 12.0, 18.0),
            target=(0.0, 2.0, -4.0),
            flat=True,
        ),
        0.25,
        # Of a smaller picture its many edges would be too large a share.
        "160x120",
    ),
]


class Witness:
    """What Cycles and the exact answer say about a scene."""

    def __init__(self, scene: Path, folder: Path, size: str = SIZE) -> None:
        self.scene, self.size = scene, size
        runs = [cycles(scene, folder / f"{scene.stem}.{seed}.exr", samples=MANY, size=size, seed=seed) for seed in (1, 2)]
        self.pictures = [picture for picture, _ in runs]
        record = runs[0][1]
        self.mixed_share = record["mixed_pixels"] / record["covered_pixels"]
        self.lights = [light["name"] for light in record["lights"]]
        receivers = folder / f"{scene.stem}.1.exr"
        self.exact = exact(scene, receivers)
        # The closed forms, at the same receivers.
        output = folder / f"{scene.stem}.unshadowed.exr"
        bare = without_shadows(scene)
        penumbra("reference", bare, "--receivers", receivers, "--quantity", "irradiance", "-o", output)
        self.unshadowed = read_exr(output)
        covered = [picture["coverage.A"] == 1.0 for picture in self.pictures]
        self.covered = covered[0] & covered[1]

    def ratio(self, image: Channels, light: str) -> np.ndarray:
        """E over the closed form's E0."""
        unshadowed = total(self.unshadowed, light)
        return np.divide(total(image, light), unshadowed, out=np.zeros_like(unshadowed), where=unshadowed > 0.0)

    def lit_well(self, light: str, least: float = LEAST_E0) -> np.ndarray:
        """Where E0 is not a small share of the largest."""
        unshadowed = total(self.unshadowed, light)
        return self.covered & (unshadowed >= least * unshadowed.max())

    def judged(self, light: str, pictures: list[Channels] | None = None) -> Judged:
        """Cycles' two pictures and the truth, in the penumbra."""
        truth = self.ratio(self.exact, light)
        share = self.exact[f"{light}.irradiance_ratio"]
        penumbra_pixels = self.lit_well(light) & (share > 0.0) & (share < 1.0)
        for picture in pictures or self.pictures:
            penumbra_pixels &= picture["coverage.A"] == 1.0
        assert penumbra_pixels.sum() > 50, f"{light}: {penumbra_pixels.sum()} pixels in the penumbra"
        first, second = (self.ratio(picture, light)[penumbra_pixels] for picture in pictures or self.pictures)
        return Judged(first, second, truth[penumbra_pixels])


def total(image: Channels, light: str) -> np.ndarray:
    """Irradiance, all channels."""
    return sum(image[f"{light}.irradiance.{channel}"] for channel in "RGB")


def check_agreement(witness: Witness, light: str) -> Judged:
    """Cycles and the exact answer differ by Cycles' noise alone."""
    judged = witness.judged(light)
    common, common_error = judged.common
    bias, bias_error = judged.bias
    print(
        f"{witness.scene.stem:8} {light:10} {len(judged.truth):5} px  noise {judged.noise:.5f}  "
        f"common square {common:+.1e} ({common_error:.1e})  bias {bias:+.1e} ({bias_error:.1e})"
    )
    assert common <= SIGMAS * common_error, "both pictures of Cycles differ from the exact answer in the same way"
    assert abs(bias) <= SIGMAS * bias_error, "Cycles is brighter or darker than the exact answer"
    # Seen whole or not at all: Cycles' rays say so one by one. Its own E0 knows no horizon but the shading normal's, and where
    # light grazes a surface its floats decide which side of it a ray starts on.
    aligned = sum(witness.pictures[0][f"normal.{axis}"] * witness.pictures[0][f"shading_normal.{axis}"] for axis in "XYZ")
    share = witness.exact[f"{light}.irradiance_ratio"]
    decided = witness.lit_well(light, GRAZING_E0) & (aligned > 1.0 - 1e-6) & ~near_edges(witness.pictures[0], share)
    assert (decided & (share == 1.0)).sum() > 1000
    for picture in witness.pictures:
        ratio = picture[f"{light}.irradiance_ratio"]
        for seen in (0.0, 1.0):
            wrong = decided & (share == seen) & (np.abs(ratio - seen) > 1e-4)
            found = ratio[wrong][:5], np.argwhere(wrong)[:5].tolist()
            assert not wrong.any(), f"{light}: exact says {seen}, Cycles {found}"
    return judged


def near_edges(image: Channels, share: np.ndarray) -> np.ndarray:
    """Pixels beside a silhouette or a penumbra: some of Cycles' samples, up to 0.015 pixel off, may lie beyond."""
    covered = image["coverage.A"] == 1.0
    edges = ~covered | ((share > 0.0) & (share < 1.0))
    depth = np.where(covered, image["depth.Z"], np.nan)
    # Along a plane depth grows evenly, however steep: a bend of half a pixel's width is an edge.
    width = np.median(np.linalg.norm(np.diff([image[f"position.{name}"] for name in "XYZ"], axis=2), axis=0))
    for axis in (0, 1):
        bend = np.abs(np.diff(depth, n=2, axis=axis)) > 0.5 * width
        edges |= np.pad(bend, [(1, 1), (0, 0)] if axis == 0 else [(0, 0), (1, 1)])
    padded = np.pad(edges, 1)
    rows, columns = edges.shape
    return np.any([padded[y : y + rows, x : x + columns] for y in range(3) for x in range(3)], axis=0)


def check_trend(witness: Witness, light: str, few: list[Channels]) -> None:
    """The error has fallen since there were few samples, as Cycles' errors do."""
    before, after = witness.judged(light, few), witness.judged(light)

    def rmse(judged: Judged) -> tuple[float, float]:
        squares = np.concatenate([judged.first - judged.truth, judged.second - judged.truth]) ** 2
        return math.sqrt(squares.mean()), float(squares.std() / (2.0 * squares.mean() * math.sqrt(len(squares))))

    (coarse, coarse_error), (fine, fine_error) = rmse(before), rmse(after)
    slope = math.log(coarse / fine) / math.log(MANY / FEW)
    slope_error = math.hypot(coarse_error, fine_error) / math.log(MANY / FEW)
    print(f"{witness.scene.stem:8} {light:10} RMSE {coarse:.4f} to {fine:.5f}: N^-{slope:.2f} ({slope_error:.2f})")
    assert slope >= CYCLES_TREND - SIGMAS * slope_error


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("cycles")


@pytest.fixture(scope="module", params=CASES, ids=lambda case: case.name)
def case(request: pytest.FixtureRequest, folder: Path) -> tuple[Case, Witness]:
    chosen = request.param
    return chosen, Witness(chosen.build(folder / f"{chosen.name}.glb"), folder, chosen.size)


@pytest.mark.timeout(900)
def test_cycles_converges_to_the_exact_answer(case: tuple[Case, Witness], folder: Path) -> None:
    _, witness = case
    assert witness.mixed_share < MOST_MIXED
    check_agreement(witness, "rect")
    few = [cycles(witness.scene, folder / f"few.{seed}.exr", samples=FEW, size=witness.size, seed=seed)[0] for seed in (3, 4)]
    check_trend(witness, "rect", few)


@pytest.mark.timeout(900)
@pytest.mark.parametrize("technique", ["rays", "uniform", "adaptive", "temporal"])
def test_cycles_judges_techniques_as_the_exact_answer_does(technique: str, case: tuple[Case, Witness], folder: Path) -> None:
    chosen, witness = case
    light = "rect"
    image = rendered(witness, technique, folder)
    truth_image = rendered(witness, "reference", folder)
    positions = [np.stack([channels[f"position.{axis}"] for axis in "XYZ"]) for channels in (image, witness.pictures[0])]
    extent = np.ptp(positions[0].reshape(3, -1), axis=1).max()
    # Where both pictures show the same point, to what a thousandth of the view is.
    same = (image["coverage.A"] == 1.0) & (np.abs(positions[0] - positions[1]).max(axis=0) < 1e-3 * extent)
    share = truth_image[f"{light}.irradiance_ratio"]
    seen = witness.lit_well(light) & (share > 0.0) & (share < 1.0)
    assert (seen & ~same).sum() <= MOST_MIXED * seen.sum()
    pixels = seen & same
    test, truth = (channels[f"{light}.irradiance_ratio"][pixels] for channels in (image, truth_image))
    first, second = (witness.ratio(picture, light)[pixels] for picture in witness.pictures)
    # The mean square of the technique's error, by the exact answer, and by Cycles alone: the product of its differences from
    # two pictures of independent noise.
    by_exact, by_cycles = (test - truth) ** 2, (test - first) * (test - second)
    difference = by_cycles - by_exact
    error = difference.std() / math.sqrt(len(difference))
    print(
        f"{chosen.name:8} {technique:9} {len(test):5} px  RMSE by exact {math.sqrt(by_exact.mean()):.5f}, "
        f"by Cycles {math.sqrt(max(by_cycles.mean(), 0.0)):.5f}"
    )
    assert abs(difference.mean()) <= SIGMAS * error
    if technique in APPROXIMATE:
        return
    # What it may be off: rays at as many samples, and what texels add.
    rays = rendered(witness, "rays", folder)[f"{light}.irradiance_ratio"][pixels]
    allowed = 1.2**2 * ((rays - truth) ** 2).mean() + (0.0 if technique == "rays" else chosen.texel_share / MAP_TEXELS)
    assert by_cycles.mean() <= allowed + SIGMAS * by_cycles.std() / math.sqrt(len(by_cycles))


# Their irradiance is V E0: E/E0 is not what they estimate, but how far V is from it Cycles sees as the exact answer does.
APPROXIMATE = {"temporal"}

MAP_TEXELS = 1024
TECHNIQUES = {
    "reference": ["reference"],
    "rays": ["render", "--technique", "rays", "--set", "samples=81"],
    "uniform": ["render", "--technique", "uniform", "--set", "samples=81", "--set", f"map_size={MAP_TEXELS}"],
    "adaptive": ["render", "--technique", "adaptive", "--set", f"map_size={MAP_TEXELS}"],
    "temporal": ["render", "--technique", "temporal", "--set", "frames=81", "--set", f"map_size={MAP_TEXELS}"],
}


def rendered(witness: Witness, technique: str, folder: Path) -> Channels:
    """A technique's picture of a scene, once."""
    output = folder / f"{witness.scene.stem}.{technique}.exr"
    if not output.is_file():
        command, *options = TECHNIQUES[technique]
        penumbra(
            command,
            witness.scene,
            *options,
            "--size",
            witness.size,
            "--quantity",
            "irradiance",
            "--aov",
            "position",
            "-o",
            output,
        )
    return read_exr(output)


@pytest.mark.timeout(900)
def test_every_light_shape_casts_the_same_shadow_in_cycles(folder: Path) -> None:
    witness = Witness(box_scene(folder / "lights.glb", LIGHTS), folder)
    assert sorted(witness.lights) == sorted(LIGHTS)
    for light in witness.lights:
        check_agreement(witness, light)


@pytest.mark.timeout(900)
def test_a_blend_file_is_written_as_the_scene_that_cycles_renders(folder: Path) -> None:
    source = shared("clevr-blend/image_generation/data/base_scene.blend")
    blend, scene = folder / "clevr.blend", folder / "clevr.glb"
    subprocess.run([sys.executable, "-c", CLEVR, source, blend], check=True, timeout=60, capture_output=True)
    cycles(blend, folder / "first.exr", "--glb", scene, samples=1, size=SIZE)
    witness = Witness(scene, folder)
    direct = [cycles(blend, folder / f"blend.{seed}.exr", samples=FEW, size=SIZE, seed=seed)[0] for seed in (1, 2)]
    assert sorted(witness.lights) == ["Area", "Lamp_Back", "Lamp_Fill", "Lamp_Key"]
    for light in witness.lights:
        check_agreement(witness, light)
    # From the .blend itself: the very same points, and E0.
    for name in ("position.X", "position.Y", "position.Z"):
        both = (direct[0]["coverage.A"] == 1.0) & witness.covered
        assert np.abs(direct[0][name] - witness.pictures[0][name])[both].max() < 1e-3, name


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_4096_samples_of_cycles_are_within_a_thousandth_of_the_exact_answer(folder: Path) -> None:
    scene = box_scene(folder / "slow.glb")
    pictures = [
        cycles(scene, folder / f"slow.{seed}.exr", samples=4096, size="160x120", seed=seed, limit_s=900)[0] for seed in (1, 2)
    ]
    truth = exact(scene, folder / "slow.1.exr")
    share = truth["rect.irradiance_ratio"]
    pixels = (share > 0.0) & (share < 1.0) & (pictures[0]["coverage.A"] == 1.0) & (pictures[1]["coverage.A"] == 1.0)
    for picture in pictures:
        errors = (picture["rect.irradiance_ratio"] - share)[pixels]
        rmse, bias = math.sqrt((errors**2).mean()), errors.mean()
        print(f"4096 samples: RMSE {rmse:.2e}, bias {bias:+.1e}, {pixels.sum()} px")
        assert rmse <= 1e-3
        assert abs(bias) <= 2e-4

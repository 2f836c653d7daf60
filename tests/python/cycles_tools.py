"""What the tests of the Cycles judge share: scenes, runs of Cycles and of the binary, statistics of two noisy pictures."""

import json
import math
import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import OpenEXR
import pytest

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "scripts"))

from cycles_judge.gltf import Document  # noqa: E402
from cycles_judge.gltf import looking as looking  # noqa: E402

SHARED = ROOT / "../shared/scenes"
PENUMBRA = ROOT / "target/release/penumbra"
CYCLES_REFERENCE = ROOT / "scripts/cycles_reference"

# Seconds that any run of a test may take: ten times what it does on four cores. The slow ones have their own.
RUN_LIMIT_S = 300

# Receivers with less than this share of the image's largest E0 see their light at a grazing angle: a ratio of two small
# numbers.
LEAST_E0 = 0.02

# In standard errors: what two unbiased pictures exceed in three of a thousand comparisons.
SIGMAS = 3.0

Channels = dict[str, np.ndarray]


def shared(path: str) -> Path:
    """A shared scene; without it the test is skipped, but not where all have to run."""
    found = SHARED / path
    if not found.is_file():
        message = f"{found} is not there: the shared scenes belong beside the repository"
        if os.environ.get("CI"):
            pytest.fail(message)
        pytest.skip(message)
    return found


def run(command: list[object], limit_s: float = RUN_LIMIT_S) -> str:
    """Runs a command that has to succeed; its standard output."""
    done = subprocess.run([str(part) for part in command], capture_output=True, text=True, timeout=limit_s, check=False)
    assert done.returncode == 0, f"{' '.join(map(str, command))}\n{done.stderr}"
    return done.stdout


def penumbra(*arguments: object, limit_s: float = RUN_LIMIT_S) -> str:
    """Runs the binary."""
    assert PENUMBRA.is_file(), f"{PENUMBRA} is missing: cargo build --release"
    return run([PENUMBRA, *arguments], limit_s)


def read_exr(path: Path) -> Channels:
    """All channels of an image."""
    part = OpenEXR.File(str(path), separate_channels=True).parts[0]
    return {name: channel.pixels.astype(float) for name, channel in part.channels.items()}


def cycles(
    scene: Path,
    output: Path,
    *arguments: object,
    samples: int,
    size: str,
    seed: int = 0,
    limit_s: float = RUN_LIMIT_S,
) -> tuple[Channels, dict]:
    """What Cycles says about a scene, in a process of its own."""
    command = [sys.executable, CYCLES_REFERENCE, scene, "-o", output, "--json"]
    record = run([*command, "--samples", samples, "--seed", seed, "--size", size, *arguments], limit_s)
    return read_exr(output), json.loads(record)


def exact(scene: Path, receivers: Path, limit_s: float = RUN_LIMIT_S) -> Channels:
    """The exact irradiance at the receivers of an image."""
    output = receivers.with_suffix(".exact.exr")
    penumbra("reference", scene, "--receivers", receivers, "--quantity", "irradiance", "-o", output, limit_s=limit_s)
    return read_exr(output)


def without_shadows(scene: Path) -> Path:
    """The scene with lights that nothing blocks: exact irradiance is then the closed form."""
    document = Document.read(scene)
    for node in document.json["nodes"]:
        if "PENUMBRA_lights" in node.get("extensions", {}):
            node["extensions"]["PENUMBRA_lights"]["casts_shadow"] = False
    path = scene.with_name(f"{scene.stem}.unshadowed.glb")
    document.write(path)
    return path


def floor(document: Document, height: float, half: float) -> None:
    """Adds a square floor."""
    corners = [[-half, height, -half], [-half, height, half], [half, height, half], [half, height, -half]]
    document.mesh("floor", np.array(corners), np.array([[0, 1, 2], [0, 2, 3]]))


def box(document: Document, center: tuple[float, float, float], half: float, turn: float) -> None:
    """Adds a cube that is turned about +Y, radians."""
    corners = np.array([[x, y, z] for x in (-half, half) for y in (-half, half) for z in (-half, half)])
    cos, sin = math.cos(turn), math.sin(turn)
    triangles = [[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1], [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4]]
    triangles += [[1, 5, 7], [1, 7, 3]]
    turned = corners @ np.array([[cos, 0.0, -sin], [0.0, 1.0, 0.0], [sin, 0.0, cos]])
    document.mesh("box", turned + center, np.array(triangles))


def ball(document: Document, center: tuple[float, float, float], radius: float, rings: int = 24) -> None:
    """Adds a sphere of triangles with smooth normals, closed."""
    segments = 2 * rings
    points = [[0.0, 1.0, 0.0]]
    for ring in range(1, rings):
        theta = math.pi * ring / rings
        for segment in range(segments):
            phi = 2.0 * math.pi * segment / segments
            points.append([math.sin(theta) * math.cos(phi), math.cos(theta), -math.sin(theta) * math.sin(phi)])
    points.append([0.0, -1.0, 0.0])
    triangles = []
    for segment in range(segments):
        following = (segment + 1) % segments
        triangles.append([0, 1 + segment, 1 + following])
        for ring in range(rings - 2):
            a, b = 1 + ring * segments + segment, 1 + ring * segments + following
            triangles += [[a, a + segments, b + segments], [a, b + segments, b]]
        last = 1 + (rings - 2) * segments
        triangles.append([last + segment, len(points) - 1, last + following])
    normals = np.array(points)
    document.mesh("ball", normals * radius + center, np.array(triangles), normals)


@dataclass(frozen=True)
class Judged:
    """Two pictures of Cycles by different seeds, and what is held against them, at the pixels where that makes sense."""

    first: np.ndarray
    second: np.ndarray
    truth: np.ndarray

    @property
    def noise(self) -> float:
        """RMSE of either picture by chance alone."""
        return float(np.sqrt(np.mean((self.first - self.second) ** 2) / 2.0))

    @property
    def common(self) -> tuple[float, float]:
        """Mean square of what both pictures have against the truth, without their noise, and its standard error.

        The noise of the two is independent, so the mean of the product of their errors is that of what they share.
        """
        products = (self.first - self.truth) * (self.second - self.truth)
        return float(products.mean()), float(products.std() / math.sqrt(len(products)))

    @property
    def bias(self) -> tuple[float, float]:
        """Mean of Cycles - truth, and its standard error."""
        errors = 0.5 * (self.first + self.second) - self.truth
        return float(errors.mean()), float(errors.std() / math.sqrt(len(errors)))

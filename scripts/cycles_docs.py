"""Measures techniques, Cycles and EEVEE on the same scenes in one run, and writes docs/cycles.md with its plot."""

import argparse
import datetime
import json
import math
import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT / "scripts"), str(ROOT / "tests/python")]

from cycles_judge.gltf import Document, looking
from cycles_tools import LEAST_E0, PENUMBRA, Channels, ball, box, floor, read_exr, without_shadows

BLENDER = ROOT / "target/python/bpy-5.0.1/bin/python"
SHARED = ROOT.parent / "shared/scenes"
RADIANCE = [50.0, 40.0, 30.0]

# Seconds that one run may take.
RUN_LIMIT_S = 1800

# More settings than its best, of techniques that trade time for error by a number of samples.
SWEEPS = {
    "rays": ["samples=16", "samples=64", "samples=256"],
    "uniform": ["samples=16", "samples=81", "samples=256"],
    "temporal": ["frames=16", "frames=64", "frames=256"],
}
CYCLES_SAMPLES = (16, 64, 256, 1024)
EEVEE_SAMPLES = (16,)

TEMPLATE = """\
# Cycles and EEVEE as judges and rivals

```sh
scripts/cycles_reference scene.glb -o cycles.exr --samples 1024       # or a .blend; --help says more
penumbra reference scene.glb -o exact.exr --receivers cycles.exr --quantity irradiance
penumbra compare cycles.exr exact.exr
scripts/cycles_docs                                                   # writes this page
```

`scripts/cycles_reference` renders a scene's direct light with Blender's Cycles: every surface white and Lambertian, samples
at pixel centres, nothing clamped, filtered or denoised; E and E0 of each light and their ratio, in Penumbra's layers.
`reference --receivers` then answers at Cycles' own points, so that what differs is light and shadow, never where a pixel's
edge lies. The tests (`tests/python/test_cycles_*.py`) hold Penumbra's answers against it:

- **Radiance.** E of every light shape, spreads, scales, exposures and `normalize` off included, without casters, against the
  closed forms, in Blender 5.0 and 4.5: the mean to 0.1 % (measured: 0.01 %), single pixels to 0.5 %.
- **Shadows.** E/E0 on a box, a smooth ball, Suzanne, the bunny, the jeep and a .blend of CLEVR's lights. Two pictures by
  different seeds tell Cycles' noise; the mean product of their errors against the exact answer is what they have in common,
  and has to vanish to three standard errors; so has the mean error. The noise itself falls as N^-0.75. Nothing is tuned:
  tolerances are these standard errors.
- **Techniques.** The squared error that Cycles alone finds in `rays`, `uniform`, `adaptive` and `temporal` is the one that
  the exact answer finds. Techniques that know V alone are not judged by Cycles, which shows E/E0.

What to know: Cycles' positions are floats, some units off their surfaces, which the header says (`penumbra:position_error`);
a smooth surface's E0 in Cycles has no geometric horizon, so E/E0 is taken by the closed form there; pixels that show more
than one surface have coverage 0. Cut-outs, tubes, lights made of meshes, soft spot cones and light linking are refused.

## Time and error

{machine}
Times are wall clock on that machine{load}: ratios of runs in turn, nothing absolute;
{rounds}.
Penumbra's time is building and rendering, Cycles' and EEVEE's that of `render`, after a first picture where shaders are
compiled; loading and writing are left out everywhere. {size} pixels, one rect light. Error: RMSE over the penumbra against
the exact answer. Of Cycles, EEVEE (by its own E0) and techniques that weight each sample, it is that of E/E0; of the
techniques marked V, which know visibility alone, that of V.

![Error against time, a panel a scene](images/cycles.png)
"""


@dataclass
class Measurement:
    """One point of the plot."""

    family: str
    name: str
    quantity: str
    seconds: float
    rmse: float
    bias: float
    largest: float


def main() -> int:
    """Measures and writes."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="one scene, 96x72, into target/cycles-docs")
    parser.add_argument("--rounds", type=int, default=3, help="runs of each, of which the median counts (default: 3)")
    given = parser.parse_args()
    if not PENUMBRA.is_file() or not BLENDER.is_file():
        print(
            "error: needs target/release/penumbra (cargo build --release) and target/python (scripts/python_env)",
            file=sys.stderr,
        )
        return 1
    size = (96, 72) if given.quick else (160, 120)
    rounds = 1 if given.quick else given.rounds
    docs = ROOT / ("target/cycles-docs" if given.quick else "docs")
    work = ROOT / "target/cycles-docs/work"
    for folder in (docs / "images", work):
        folder.mkdir(parents=True, exist_ok=True)
    before = os.getloadavg()[0]
    machine = f"Measured {datetime.date.today()} on {processor()}, {os.cpu_count()} threads, {blender_version()}."
    load = f", which other work shared (a load of {before:.0f} at the start)" if before > 2.0 else ""
    head = TEMPLATE.format(
        machine=machine,
        load=load,
        rounds=f"the median of {rounds} runs" if rounds > 1 else "one run of each",
        size=f"{size[0]} x {size[1]}",
    )
    results = {}
    for name, scene in scenes(work, given.quick).items():
        results[name] = measure(scene, f"{size[0]}x{size[1]}", rounds, work)
        # A page after every scene: what is measured is not lost.
        draw(results, docs / "images/cycles.png")
        tables = "".join(f"\n### {title}\n\n{table(points)}" for title, points in results.items())
        write_atomically(docs / "cycles.md", head + tables)
    print(docs / "cycles.md")
    return 0


def scenes(work: Path, quick: bool) -> dict[str, Path]:
    """The scenes that are measured."""
    light = {"shape": "rect", "width": 1.5, "height": 0.8, "radiance": RADIANCE}
    found = {}
    document = Document()
    floor(document, 0.0, 6.0)
    box(document, (0.0, 1.1, 0.0), 0.5, 0.5)
    ball(document, (1.2, 0.5, -1.2), 0.4)
    document.camera("view", looking((4.0, 5.0, 4.5), (0.0, 0.2, -0.3)), 0.6)
    document.light("Key", looking((1.5, 4.0, 1.0), (0.0, 0.0, 0.0)), light)
    found["Box and ball"] = write_scene(document, work / "box.glb")
    if quick:
        return found
    document = Document.read(SHARED / "suzanne/02_suzanne.gltf")
    document.drop_appearance()
    floor(document, -1.7, 8.0)
    document.camera("view", looking((3.0, 1.8, 5.0), (0.3, -0.8, -0.3)), 0.6)
    document.light("Key", looking((2.5, 3.0, 2.0), (0.3, -0.6, -0.2)), light | {"width": 1.0, "height": 0.6})
    found["Suzanne"] = write_scene(document, work / "suzanne.glb")
    document = Document.read(SHARED / "jeep1/jeep1.glb")
    document.drop_appearance()
    floor(document, -0.03, 40.0)
    document.camera("view", looking((20.0, 12.0, 18.0), (0.0, 2.0, -4.0)), 0.6)
    document.light("Key", looking((12.0, 20.0, 8.0), (0.0, 2.0, -4.0)), light | {"width": 5.0, "height": 3.0})
    found["Jeep"] = write_scene(document, work / "jeep.glb")
    return found


def write_scene(document: Document, path: Path) -> Path:
    """Open surfaces are shown flat, lest Cycles see through them below a smooth horizon."""
    for mesh in document.json["meshes"]:
        for primitive in mesh["primitives"]:
            if mesh["name"] not in ("ball", "Suzanne"):
                primitive["attributes"].pop("NORMAL", None)
    document.write(path)
    return path


def measure(scene: Path, size: str, rounds: int, work: Path) -> list[Measurement]:
    """All of a scene's points; the runs of a round follow each other, so that what else the machine does meets all alike."""
    names = json.loads(run([PENUMBRA, "list", "--json"]))["techniques"]
    jobs: list[tuple[str, str, list[str]]] = []
    for technique in names:
        jobs += [(technique["name"], setting, ["--set", setting]) for setting in SWEEPS.get(technique["name"], [])]
        if technique["name"] not in SWEEPS:
            jobs.append((technique["name"], "best", []))
    truth = work / f"{scene.stem}.truth.exr"
    exact_seconds = [penumbra("reference", scene, size, truth, ["--quantity", "irradiance"])]
    exact = read_exr(truth)
    files: dict[tuple[str, str], list[tuple[Path, float]]] = {}
    judge = work / f"{scene.stem}.judge.exr"
    cycles(scene, size, judge, CYCLES_SAMPLES[-1], ["--shadowed-only"])
    # The truth at Cycles' points, and the closed forms there.
    truths = []
    for path in (scene, without_shadows(scene)):
        output = work / f"{path.stem}.at-cycles.exr"
        run([PENUMBRA, "reference", path, "--receivers", judge, "--quantity", "irradiance", "-o", output])
        truths.append(read_exr(output))
    measurements = []
    for number in range(rounds):
        for technique, setting, options in jobs:
            output = work / f"{scene.stem}.{technique}.{setting}.exr"
            seconds = penumbra("render", scene, size, output, ["--technique", technique, "--quantity", "irradiance", *options])
            files.setdefault((technique, setting), []).append((output, seconds))
        if number:
            exact_seconds.append(penumbra("reference", scene, size, truth, ["--quantity", "irradiance"]))
        for samples in CYCLES_SAMPLES:
            for family, options in (("Cycles", []), ("Cycles, OpenImageDenoise", ["--denoise"])):
                output = work / f"{scene.stem}.{family}.{samples}.exr"
                seconds = cycles(scene, size, output, samples, [*options, "--shadowed-only"])
                files.setdefault((family, f"{samples} samples"), []).append((output, seconds))
        for samples in EEVEE_SAMPLES:
            output = work / f"{scene.stem}.eevee.{samples}.exr"
            files.setdefault(("EEVEE", f"{samples} samples"), []).append(
                (output, cycles(scene, size, output, samples, ["--engine", "eevee"]))
            )
        print(f"{scene.stem}: round {number + 1} of {rounds}", flush=True)
    seconds = float(np.median(exact_seconds))
    measurements.append(Measurement("reference", "exact", "E/E0", seconds, 0.0, 0.0, 0.0))
    for (family, name), runs in files.items():
        image = read_exr(runs[0][0])
        seconds = float(np.median([seconds for _, seconds in runs]))
        if family.startswith("Cycles") or family == "EEVEE":
            errors = judged(image, *truths, own_unshadowed=family == "EEVEE")
            quantity = "E/E0"
        else:
            quantity = "V" if approximate(runs[0][0]) else "E/E0"
            layer = "Key.visibility" if quantity == "V" else "Key.irradiance_ratio"
            pixels = (exact[layer] > 0.0) & (exact[layer] < 1.0) & (exact["coverage.A"] == 1.0)
            errors = (image[layer] - exact[layer])[pixels]
        rmse, largest = float(np.sqrt((errors**2).mean())), float(np.abs(errors).max())
        measurements.append(Measurement(family, name, quantity, seconds, rmse, float(errors.mean()), largest))
    return measurements


def judged(image: Channels, exact: Channels, unshadowed: Channels, *, own_unshadowed: bool) -> np.ndarray:
    """Errors of Blender's E/E0 in the penumbra, where all pictures show one surface and E0 is not a small number."""
    most, share = total(unshadowed, "irradiance"), exact["Key.irradiance_ratio"]
    covered = (image["coverage.A"] == 1.0) & (exact["coverage.A"] == 1.0)
    pixels = covered & (most >= LEAST_E0 * most.max()) & (share > 0.0) & (share < 1.0)
    own = (total(image, "irradiance_unshadowed") if own_unshadowed else most)[pixels]
    return total(image, "irradiance")[pixels] / np.maximum(own, 1e-30) - total(exact, "irradiance")[pixels] / most[pixels]


def total(image: Channels, layer: str) -> np.ndarray:
    """All channels of the light's layer."""
    return sum(image[f"Key.{layer}.{channel}"] for channel in "RGB")


def approximate(path: Path) -> bool:
    """Whether a picture's irradiance is V times E0."""
    import OpenEXR

    return "penumbra:approximate" in OpenEXR.File(str(path), separate_channels=True).parts[0].header


def penumbra(command: str, scene: Path, size: str, output: Path, options: list[str]) -> float:
    """Runs the binary; the seconds of building and rendering."""
    record = json.loads(run([PENUMBRA, command, scene, "--size", size, "-o", output, "--json", *options]))
    return (record["time_ms"]["build"] + record["time_ms"]["render"]) / 1000.0


def cycles(scene: Path, size: str, output: Path, samples: int, options: list[str]) -> float:
    """Runs Blender; the seconds of its render of E."""
    command = [BLENDER, ROOT / "scripts/cycles_reference", scene, "-o", output, "--size", size, "--samples", samples, "--json"]
    return json.loads(run([*command, *options]))["lights"][0]["seconds"]["irradiance"]


def run(command: list[object]) -> str:
    """Runs a command that has to succeed; its standard output."""
    done = subprocess.run([str(part) for part in command], capture_output=True, text=True, timeout=RUN_LIMIT_S, check=False)
    if done.returncode != 0:
        sys.exit(f"error: {' '.join(map(str, command))}: {done.stderr.strip()}")
    return done.stdout


def table(measurements: list[Measurement]) -> str:
    """A row a point, fastest first within a family."""
    lines = ["| what | setting | of | time, s | RMSE | bias | largest |", "|---|---|---|---|---|---|---|"]
    for point in measurements:
        error = f"{point.rmse:.4f} | {point.bias:+.4f} | {point.largest:.3f}" if point.rmse else "0 | 0 | 0"
        lines.append(f"| {point.family} | {point.name} | {point.quantity} | {point.seconds:.3g} | {error} |")
    return "\n".join(lines) + "\n"


def draw(results: dict[str, list[Measurement]], path: Path) -> None:
    """Error against time, a panel a scene."""
    figure, panels = plt.subplots(1, len(results), figsize=(6.0 * len(results), 5.4), squeeze=False, sharey=True)
    families = list(dict.fromkeys(point.family for points in results.values() for point in points if point.rmse))
    colors = dict(zip(families, plt.get_cmap("tab20").colors * 2, strict=False))
    for panel, (name, points) in zip(panels[0], results.items(), strict=True):
        for family in families:
            series = sorted((point.seconds, point.rmse) for point in points if point.family == family)
            blender = family.startswith(("Cycles", "EEVEE"))
            hollow = any(point.family == family and point.quantity == "V" for point in points)
            panel.loglog(
                *zip(*series, strict=True),
                marker="s" if blender else "o",
                linestyle="--" if blender else "-",
                color=colors[family],
                markerfacecolor="white" if hollow else colors[family],
                label=family + (" (V)" if hollow else ""),
            )
        exact = next(point for point in points if point.family == "reference")
        panel.axvline(exact.seconds, color="black", linewidth=1.0)
        panel.text(exact.seconds, 0.02, " exact", transform=panel.get_xaxis_transform(), fontsize=9)
        panel.margins(y=0.08)
        panel.set_title(name)
        panel.set_xlabel("time, s")
        panel.grid(True, which="major", color="0.85")
    panels[0][0].set_ylabel("RMSE in the penumbra")
    handles, labels = panels[0][0].get_legend_handles_labels()
    columns = 2 * len(results)
    figure.legend(handles, labels, loc="lower center", ncol=columns, fontsize=9, frameon=False)
    figure.tight_layout(rect=(0.0, 0.04 + 0.036 * math.ceil(len(families) / columns), 1.0, 1.0))
    figure.savefig(path, dpi=100)


def processor() -> str:
    """The processor's name."""
    for line in Path("/proc/cpuinfo").read_text().splitlines() if Path("/proc/cpuinfo").is_file() else []:
        if line.startswith("model name"):
            return line.split(":", 1)[1].strip()
    return "an unnamed processor"


def blender_version() -> str:
    """Blender's version as its module says."""
    code = "import bpy; print(bpy.app.version_string)"
    return "Blender " + run([BLENDER, "-c", code]).strip().splitlines()[-1]


def write_atomically(path: Path, text: str) -> None:
    """Writes beside the place and renames."""
    part = path.with_suffix(".part")
    part.write_text(text)
    part.replace(path)


if __name__ == "__main__":
    sys.exit(main())

# SPDX-License-Identifier: GPL-3.0-or-later
"""A render from extracted arrays to an image in memory: the work of a thread, watched and stopped from another.

Nothing here imports bpy.
"""

from __future__ import annotations

import os
import shutil
import tempfile
import threading
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from . import exr, glb, process


@dataclass(frozen=True)
class Request:
    """What the binary is asked for, in its own words."""

    size: tuple[int, int]
    technique: str
    preset: str = ""
    settings: tuple[tuple[str, str], ...] = ()
    quantity: str = "visibility"
    antialiasing: int = 1
    layers: tuple[str, ...] = ()
    lights: tuple[str, ...] = ()
    verify: int = 0
    device: str = "auto"

    def arguments(self) -> list[str]:
        """Options of `penumbra render`."""
        options = ["--technique", self.technique, "--size", f"{self.size[0]}x{self.size[1]}", "--quantity", self.quantity]
        options += ["--device", self.device]
        if self.preset:
            options += ["--preset", self.preset]
        for key, value in self.settings:
            options += ["--set", f"{key}={value}"]
        for light in self.lights:
            # Joined: a name may begin with a dash.
            options.append(f"--light={light}")
        if self.antialiasing > 1:
            options += ["--aa", str(self.antialiasing)]
        if self.layers:
            options += ["--aov", ",".join(self.layers)]
        if self.verify:
            options += ["--verify", str(self.verify)]
        return options


@dataclass
class Result:
    """An image: channels of (height, width), bottom row first, and the binary's record of the run."""

    channels: dict[str, np.ndarray]
    record: dict[str, Any]
    warnings: list[str] = field(default_factory=list)

    @property
    def size(self) -> tuple[int, int]:
        """Width and height, pixels."""
        height, width = self.channels["coverage.A"].shape
        return width, height

    @property
    def light_names(self) -> list[str]:
        """The lights, in the scene's order."""
        return [light["name"] for light in self.record["lights"]]

    def visibility(self, light: str) -> np.ndarray:
        """Fraction of the light's area that each pixel's receiver sees."""
        return self.channels[f"{light}.visibility"]

    def rgb(self, layer: str) -> np.ndarray:
        """A layer of three colours, (height, width, 3)."""
        return np.stack([self.channels[f"{layer}.{channel}"] for channel in "RGB"], axis=-1)

    def vector(self, layer: str) -> np.ndarray:
        """A layer of vectors in Blender's axes, (height, width, 3)."""
        x, y, z = (self.channels[f"{layer}.{axis}"] for axis in "XYZ")
        return np.stack([x, -z, y], axis=-1)


# Jobs at work, and how long they are given to stop their binary when the add-on goes, s.
_running: set[Job] = set()
_STOP_SECONDS = 1.0


def stop_all() -> None:
    """Stops every job: no binary outlives Blender, or the add-on."""
    jobs = list(_running)
    for job in jobs:
        job.cancel()
    for job in jobs:
        job.join(_STOP_SECONDS)


class Job(threading.Thread):
    """Renders `scene` once for each of `requests`. It never raises: `error` says what went wrong, in one line."""

    def __init__(
        self,
        *,
        binary: Path,
        scene: glb.Scene,
        requests: list[Request],
        folder: str | None = None,
        stall_seconds: float = 300.0,
        after: Callable[[Job, Path], Any] | None = None,
    ) -> None:
        super().__init__(daemon=True, name="penumbra")
        self.binary = binary
        self.scene = scene
        self.requests = requests
        self.stall_seconds = stall_seconds
        self.results: list[Result] = []
        self.error = ""
        self.is_cancelled = False
        self.fraction = 0.0
        self.label = "writing the scene"
        self.elapsed_seconds = 0.0
        self.after_result: Any = None
        self._folder = folder
        self._after = after
        self._lock = threading.Lock()
        self._run: process.Run | None = None

    def cancel(self) -> None:
        """Stops within a second."""
        with self._lock:
            self.is_cancelled = True
            if self._run is not None:
                self._run.cancel()

    @property
    def is_done(self) -> bool:
        """Finished, well or not."""
        return self.ident is not None and not self.is_alive()

    def run(self) -> None:
        """The thread."""
        start = time.perf_counter()
        folder = None
        _running.add(self)
        try:
            folder = Path(tempfile.mkdtemp(prefix="penumbra-", dir=self._folder))
            self._render(folder)
            if self._after is not None:
                self.after_result = self._after(self, folder)
        except process.Cancelled:
            self.is_cancelled = True
        except (process.ProcessError, exr.ImageError, glb.SceneTooLarge) as error:
            self.error = str(error)
        except OSError as error:
            self.error = process.describe_os_error(error, "rendering with penumbra")
        except MemoryError:
            self.error = "not enough memory for the scene"
        except Exception as error:  # The thread's last resort: Blender must hear of it, and live.
            traceback.print_exc()
            self.error = f"rendering with penumbra failed: {type(error).__name__}: {error}".replace("\n", " ")
        finally:
            if folder is not None:
                shutil.rmtree(folder, ignore_errors=True)
            if self.error or self.is_cancelled:
                # Nothing partial is left to be shown.
                self.results = []
            self.elapsed_seconds = time.perf_counter() - start
            _running.discard(self)

    def execute(self, arguments: list[str | os.PathLike], on_progress: Callable[[float, str], None] | None = None) -> str:
        """Runs the binary with `arguments` within this job and returns its stdout."""
        with self._lock:
            if self.is_cancelled:
                raise process.Cancelled("cancelled")
            self._run = process.Run([self.binary, *arguments], stall_seconds=self.stall_seconds, on_progress=on_progress)
        return self._run.wait()

    def _render(self, folder: Path) -> None:
        width, height = self.requests[0].size
        scene_path = folder / "scene.glb"
        glb.write(scene_path, self.scene, aspect=width / height)
        for index, request in enumerate(self.requests):

            def on_progress(fraction: float, label: str, index: int = index) -> None:
                self.fraction, self.label = (index + fraction) / len(self.requests), label

            image_path = folder / f"image-{index}.exr"
            self.label = "loading the scene"
            text = self.execute(
                ["render", scene_path, "-o", image_path, "--json", "--progress", *request.arguments()], on_progress
            )
            self.label = "reading the image"
            channels, _ = exr.read(image_path)
            image_path.unlink()
            record = process.parse_json(text, str(self.binary))
            warnings = self.scene.warnings + record.get("warnings", [])
            self.results.append(Result(channels, record, list(dict.fromkeys(warnings))))
        self.fraction = 1.0


def verified_line(record: dict[str, Any]) -> str:
    """The measured error of the worst light, for people; empty where none was asked for."""
    verified = [light["verified"] for light in record["lights"] if light.get("verified")]
    if not verified:
        return ""
    worst = max(verified, key=lambda light: light["rmse"])
    low, high = worst["rmse_ci95"]
    return f"RMSE of V {worst['rmse']:.4f} (95 %: {low:.4f} to {high:.4f}), at {worst['receivers']} receivers"

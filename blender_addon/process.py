# SPDX-License-Identifier: GPL-3.0-or-later
"""The penumbra binary as a process of its own: found, run, watched, stopped. Whatever happens to it is one line here.

Nothing here imports bpy.
"""

from __future__ import annotations

import errno
import json
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

# A process that hasn't ended after being asked to is killed after this long, s.
GRACE_SECONDS = 0.3
# How often a run looks at its process, s: cancelling takes at most this and the grace.
POLL_SECONDS = 0.05


class ProcessError(RuntimeError):
    """The binary did not do what it was asked for; the message is one line for the user."""


class Cancelled(ProcessError):
    """The user stopped it."""


def executable_name() -> str:
    """Name of the binary's file on this system."""
    return "penumbra.exe" if os.name == "nt" else "penumbra"


def find(preferred: str = "") -> Path:
    """The binary: where the preference says, else in the extension's wheel, else on the PATH."""
    if preferred:
        path = Path(preferred)
        if not path.is_file():
            raise ProcessError(f"no penumbra binary at {path}: correct the path in the add-on's preferences, or clear it")
        if not os.access(path, os.X_OK):
            raise ProcessError(f"{path} is not executable: choose the penumbra binary in the add-on's preferences")
        return path
    bundled = _in_wheel()
    if bundled is not None:
        return bundled
    on_path = shutil.which(executable_name())
    if on_path is not None:
        return Path(on_path)
    raise ProcessError("the penumbra binary was not found: set its path in the add-on's preferences, or put it on the PATH")


def _in_wheel() -> Path | None:
    try:
        import penumbra_binary
    except ImportError:
        return None
    path = Path(penumbra_binary.__file__).parent / executable_name()
    if not path.is_file():
        return None
    if not os.access(path, os.X_OK):
        # Blender unpacks wheels without their files' permissions.
        path.chmod(path.stat().st_mode | 0o111)
    return path


class Run:
    """One run of the binary. `wait` blocks (call it from a worker thread); `cancel` may be called from any thread."""

    def __init__(
        self,
        command: Sequence[str | os.PathLike],
        *,
        stall_seconds: float = 300.0,
        on_progress: Callable[[float, str], None] | None = None,
    ) -> None:
        self.command = [os.fspath(part) for part in command]
        self.stall_seconds = stall_seconds
        self.on_progress = on_progress
        self._cancelled = threading.Event()
        self._process: subprocess.Popen | None = None
        self._last_sign_of_life = time.monotonic()
        self._errors: deque[str] = deque(maxlen=50)

    def cancel(self) -> None:
        """Stops the process within a second, and whatever it had not finished is gone."""
        self._cancelled.set()

    @property
    def is_cancelled(self) -> bool:
        """Whether someone asked it to stop."""
        return self._cancelled.is_set()

    def wait(self) -> str:
        """Runs the binary to its end and returns its stdout."""
        if self._cancelled.is_set():
            raise Cancelled("cancelled")
        creation = {"creationflags": subprocess.CREATE_NO_WINDOW} if sys.platform == "win32" else {"start_new_session": True}
        try:
            self._process = subprocess.Popen(
                self.command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.PIPE, **creation
            )
        except OSError as error:
            raise ProcessError(f"{self.command[0]} could not be started: {error.strerror or error}") from error
        self._last_sign_of_life = time.monotonic()
        output: list[bytes] = []
        readers = [
            threading.Thread(target=lambda: output.append(self._process.stdout.read()), daemon=True),
            threading.Thread(target=self._read_errors, daemon=True),
        ]
        for reader in readers:
            reader.start()
        try:
            while self._process.poll() is None:
                if self._cancelled.wait(POLL_SECONDS):
                    raise Cancelled("cancelled")
                silent = time.monotonic() - self._last_sign_of_life
                if silent > self.stall_seconds:
                    raise ProcessError(f"penumbra made no progress for {self.stall_seconds:g} s and was stopped")
        finally:
            self._stop()
            for reader in readers:
                reader.join(timeout=GRACE_SECONDS)
        if self._cancelled.is_set():
            raise Cancelled("cancelled")
        status = self._process.returncode
        if status != 0:
            raise ProcessError(self._failure(status))
        return (output[0] if output else b"").decode(errors="replace")

    def _read_errors(self) -> None:
        for raw in self._process.stderr:
            line = raw.decode(errors="replace").strip()
            self._last_sign_of_life = time.monotonic()
            words = line.split(maxsplit=2)
            if len(words) >= 2 and words[0] == "progress:" and words[1].isdigit():
                if self.on_progress is not None:
                    self.on_progress(int(words[1]) / 100.0, words[2] if len(words) > 2 else "")
            elif line:
                self._errors.append(line)

    def _stop(self) -> None:
        process = self._process
        if process.poll() is not None:
            return
        process.terminate()
        try:
            process.wait(GRACE_SECONDS)
        except subprocess.TimeoutExpired:
            if hasattr(os, "killpg"):
                # It leads a session of its own: nothing that it started outlives it.
                os.killpg(process.pid, signal.SIGKILL)
            else:
                process.kill()
            process.wait()

    def _failure(self, status: int) -> str:
        for line in self._errors:
            if line.startswith("error: "):
                return "penumbra: " + line.removeprefix("error: ")
        last = f": {self._errors[-1]}" if self._errors else ""
        if status < 0:
            try:
                name = signal.Signals(-status).name
            except ValueError:
                name = f"signal {-status}"
            return f"penumbra was killed by {name}{last}"
        return f"penumbra ended with status {status}{last}"

    def warnings(self) -> list[str]:
        """Warnings that it printed."""
        return [line.removeprefix("warning: ") for line in self._errors if line.startswith("warning: ")]


def parse_json(text: str, what: str) -> Any:
    """The JSON that the binary printed."""
    try:
        return json.loads(text)
    except ValueError as error:
        raise ProcessError(f"{what} printed no JSON: is it another version of penumbra?") from error


def describe_os_error(error: OSError, doing: str) -> str:
    """One line for the user."""
    reason = "the disk is full" if error.errno == errno.ENOSPC else (error.strerror or str(error))
    place = f" ({error.filename})" if error.filename else ""
    return f"{doing} failed: {reason}{place}"

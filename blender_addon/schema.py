# SPDX-License-Identifier: GPL-3.0-or-later
"""The techniques as the binary lists them: names, help, presets, and parameters with type, default and range.

Nothing here imports bpy, and nothing of a technique is written down here.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from . import process


@dataclass(frozen=True)
class Parameter:
    """One parameter of a technique. `kind` is bool, int, float, choice or text."""

    name: str
    meaning: str
    default: bool | int | float | str
    minimum: float | None
    maximum: float | None
    choices: tuple[tuple[str, str], ...]

    @property
    def kind(self) -> str:
        """How the value is shown and stored."""
        if self.choices:
            return "choice"
        for kind, python_type in (("bool", bool), ("int", int), ("float", float)):
            if isinstance(self.default, python_type):
                return kind
        return "text"


@dataclass(frozen=True)
class Technique:
    """A technique, as `penumbra list --json` has it."""

    name: str
    paper: str
    summary: str
    needs: str
    presets: tuple[tuple[str, str], ...]
    parameters: tuple[Parameter, ...] = field(default=())

    def parameter(self, name: str) -> Parameter | None:
        """The parameter of that name."""
        return next((parameter for parameter in self.parameters if parameter.name == name), None)


def parse(listing: dict[str, Any]) -> tuple[Technique, ...]:
    """Reads the listing."""
    return tuple(
        Technique(
            name=technique["name"],
            paper=technique["paper"],
            summary=technique["summary"],
            needs=technique["needs"],
            presets=tuple((preset["name"], preset["settings"]) for preset in technique["presets"]),
            parameters=tuple(
                Parameter(
                    name=parameter["name"],
                    meaning=parameter["meaning"],
                    default=parameter["default"],
                    minimum=parameter["minimum"],
                    maximum=parameter["maximum"],
                    choices=tuple((choice[0], choice[1]) for choice in parameter["choices"]),
                )
                for parameter in technique["parameters"]
            ),
        )
        for technique in listing["techniques"]
    )


_known: dict[tuple[str, int], tuple[Technique, ...] | process.ProcessError] = {}


def techniques(binary: Path) -> tuple[Technique, ...]:
    """What the binary offers; asked once for each binary and build of it, since panels ask whenever they are drawn."""
    key = (str(binary), binary.stat().st_mtime_ns)
    if key not in _known:
        try:
            _known[key] = _ask(binary)
        except process.ProcessError as error:
            _known[key] = error
    known = _known[key]
    if isinstance(known, process.ProcessError):
        raise known
    return known


def _ask(binary: Path) -> tuple[Technique, ...]:
    text = process.Run([binary, "list", "--json"], stall_seconds=10.0).wait()
    listing = process.parse_json(text, str(binary))
    try:
        return parse(listing)
    except (KeyError, TypeError, IndexError) as error:
        raise process.ProcessError(f"{binary} lists its techniques in another form: is it another version?") from error


def find(known: Iterable[Technique], name: str) -> Technique | None:
    """The technique of that name."""
    return next((technique for technique in known if technique.name == name), None)

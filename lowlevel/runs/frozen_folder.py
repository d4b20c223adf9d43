"""A frozen network as a folder: one JSON description and one safetensors file. Nothing in it is pickled."""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, TypeVar

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file, save
from torch import Tensor

from lowlevel.runs.configs import from_plain
from lowlevel.runs.files import atomic_write
from robots.errors import PilotError

Config = TypeVar("Config")


@dataclass(frozen=True)
class FrozenFolder:
    """What the folders of one kind of network have in common. Everything it refuses, it refuses with ``error``."""

    kind: str
    """What messages call the network, such as "controller"."""
    version: int
    """Version of the description's format."""
    description_file: str
    weights_file: str
    example: str
    """Where folders of this kind are found."""
    error: type[PilotError]
    other_files: tuple[str, ...] = ()
    """Files beside description and weights."""

    def read_description(self, folder: Path) -> dict[str, Any]:
        """Contents of the description, of whatever version."""
        path = folder / self.description_file
        if not path.is_file():
            raise self.error(f"{path} is missing: give a {self.kind} folder, such as one under {self.example}")
        try:
            content = json.loads(path.read_text())
        except (json.JSONDecodeError, UnicodeDecodeError) as error:
            raise self.error(f"{path} is damaged: {error}") from error
        if not isinstance(content, dict):
            raise self.error(f"{path} is damaged: it does not hold a JSON object")
        return content

    def read_config(self, folder: Path, config: type[Config]) -> tuple[Config, dict[str, Any]]:
        """The description's "config" as a dataclass of class ``config``, and its "provenance"."""
        description = self.read_description(folder)
        path = folder / self.description_file
        version = description.get("format_version")
        if version != self.version:
            raise self.error(f"{path} has format version {version}, this code reads {self.version}")
        try:
            return from_plain(config, description["config"]), description["provenance"]
        except (KeyError, TypeError, ValueError) as error:
            raise self.error(f"{path} is incomplete: {error}") from error

    def read_weights(self, folder: Path) -> dict[str, Tensor]:
        """All tensors of the weights file, which are finite."""
        path = folder / self.weights_file
        if not path.is_file():
            raise self.error(f"{path} is missing: copy the whole {self.kind} folder")
        try:
            tensors = load_file(path)
        except (SafetensorError, OSError) as error:
            raise self.error(f"{path} is damaged or truncated: {error}") from error
        for name, tensor in tensors.items():
            if not torch.isfinite(tensor).all():
                raise self.error(f"{path} holds numbers in {name!r} that are not finite: save the {self.kind} again")
        return tensors

    def write_weights(self, folder: Path, tensors: dict[str, Tensor]) -> None:
        """Write the weights file, complete or not at all; create the folder."""
        for name, tensor in tensors.items():
            if not torch.isfinite(tensor).all():
                raise self.error(f"the {self.kind}'s {name!r} is not finite: nothing was written to {folder}")
        folder.mkdir(parents=True, exist_ok=True)
        contiguous = {name: tensor.cpu().contiguous() for name, tensor in tensors.items()}
        atomic_write(folder / self.weights_file, lambda file: file.write(save(contiguous)))

    def write_description(self, folder: Path, config: Any, provenance: dict[str, Any], **more: Any) -> None:
        """Write the description, complete or not at all; ``more`` are further entries for its readers."""
        description = {
            "format_version": self.version,
            "config": asdict(config),
            **more,
            "provenance": provenance,
        }
        self._write(folder, description)

    def identity(self, folder: Path) -> str:
        """SHA-256 over all that the folder holds but the provenance, 16 hexadecimal digits."""
        description = self.read_description(folder)
        description.pop("provenance", None)
        digest = hashlib.sha256(json.dumps(description, sort_keys=True).encode())
        for name in (self.weights_file, *self.other_files):
            if (folder / name).is_file():
                digest.update(name.encode() + (folder / name).read_bytes())
        return digest.hexdigest()[:16]

    def _write(self, folder: Path, description: dict[str, Any]) -> None:
        text = json.dumps(description, indent=1)
        atomic_write(folder / self.description_file, lambda file: file.write(text.encode()))

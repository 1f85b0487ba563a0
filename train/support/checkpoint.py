"""Writes checkpoints that are read without unpickling, and refuses damaged ones.

The folder is one of TorchRL's `Checkpoint`. Its own adapters would pickle: a replay buffer's
prefetched samples, and whatever a tensordict holds beside tensors. Here every component is its
`state_dict`, as tensors in a safetensors file and the rest as JSON. `SHA256SUMS`, written last, has
the digest of every file; `sha256sum -c SHA256SUMS` reads it too.
"""

from __future__ import annotations

import errno
import hashlib
import json
import os
import re
from collections import OrderedDict
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import safetensors.torch
import torch
from torchrl.checkpoint import Checkpoint, CheckpointAdapter, CheckpointError

SUMS = "SHA256SUMS"
TENSORS, REST = "tensors.safetensors", "state.json"


class DamagedCheckpoint(Exception):
    """Says that a checkpoint is refused; the message names the file and what is wrong with it."""


def save(folder: Path, components: Mapping[str, Any]) -> None:
    """Writes components, which have a `state_dict()`, into a folder that is not there yet.

    Raises:
        OSError: the folder cannot be written.
    """
    try:
        _checkpoint(components).save(folder)
        lines = [f"{_digest(folder / name)}  {name}\n" for name in _files(folder)]
        text = "".join(lines)
        # Its own first line covers it: what is damaged there is not taken for another damage.
        own = f"# {hashlib.sha256(text.encode()).hexdigest()}\n"
        (folder / SUMS).write_text(own + text, encoding="utf-8")
    except safetensors.SafetensorError as error:  # its way to say that the disk is full
        code = re.search(r"os error (\d+)", str(error))
        number = int(code[1]) if code else errno.EIO
        raise OSError(number, os.strerror(number), str(folder)) from error


def load(folder: Path, components: Mapping[str, Any]) -> None:
    """Restores components from a folder that `save` wrote; nothing is restored if it is damaged.

    Raises:
        DamagedCheckpoint: a file is missing, damaged or not one of a checkpoint.
    """
    _check_sums(folder)
    try:
        _checkpoint(components).load(folder)
    except (CheckpointError, OSError, ValueError, TypeError, AttributeError) as error:
        raise DamagedCheckpoint(f"{folder}: {error}") from error


def _checkpoint(components: Mapping[str, Any]) -> Checkpoint:
    checkpoint = Checkpoint()
    for name, component in components.items():
        checkpoint.register(name, component, adapter=_States())
    return checkpoint


def _files(folder: Path) -> list[str]:
    """Returns the paths of all files below a folder except `SUMS`, from there, sorted."""
    found = [Path(at, name) for at, _, names in os.walk(folder) for name in names]
    return sorted(str(path.relative_to(folder)) for path in found if path != folder / SUMS)


def _digest(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _check_sums(folder: Path) -> None:
    path = folder / SUMS
    try:
        own, _, text = path.read_text(encoding="utf-8").partition("\n")
    except (OSError, UnicodeDecodeError) as error:
        raise DamagedCheckpoint(
            f"{path}: cannot be read ({error}); checkpoints of earlier versions, which had to be "
            "unpickled, have none"
        ) from None
    if own != f"# {hashlib.sha256(text.encode()).hexdigest()}":
        raise DamagedCheckpoint(f"{path}: is damaged")
    lines = [line.partition("  ") for line in text.splitlines()]
    wanted = {name: digest for digest, _, name in lines}
    there = _files(folder)
    for name in sorted({*wanted, *there}):
        if name not in there:
            raise DamagedCheckpoint(f"{folder / name}: is missing")
        if name not in wanted:
            raise DamagedCheckpoint(f"{folder / name}: does not belong there")
        if _digest(folder / name) != wanted[name]:
            raise DamagedCheckpoint(f"{folder / name}: is damaged")


class _States(CheckpointAdapter):
    """Saves the `state_dict` of a component as a safetensors file and a JSON file."""

    adapter_id = "mjcollect.states"

    def save(
        self, component: Any, path: Path, *, args: tuple[Any, ...], kwargs: Mapping[str, Any]
    ) -> None:
        path.mkdir(parents=True, exist_ok=True)
        tensors: dict[str, torch.Tensor] = {}
        document = _encoded(component.state_dict(), tensors)
        safetensors.torch.save_file(tensors, path / TENSORS)
        (path / REST).write_text(json.dumps(document) + "\n", encoding="utf-8")

    def load(
        self, component: Any, path: Path, *, map_location: Any,
        tensor_load_kwargs: Mapping[str, Any], args: tuple[Any, ...], kwargs: Mapping[str, Any],
    ) -> None:  # fmt: skip
        tensors = safetensors.torch.load_file(path / TENSORS)
        document = json.loads((path / REST).read_text(encoding="utf-8"))
        component.load_state_dict(_decoded(document, tensors))


def _encoded(value: Any, tensors: dict[str, torch.Tensor]) -> Any:
    """Returns a JSON document of a value; tensors and arrays go into `tensors`, by new names.

    Raises:
        TypeError: the value holds something else than what checkpoints are made of.
    """
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if isinstance(value, torch.Size):
        return {"size": list(value)}
    if isinstance(value, tuple | list):
        return {type(value).__name__: [_encoded(entry, tensors) for entry in value]}
    if isinstance(value, Mapping):
        pairs = [[_encoded(k, tensors), _encoded(v, tensors)] for k, v in value.items()]
        # torch keeps versions and shapes in an attribute of the dict.
        about = getattr(value, "_metadata", None)
        return {"dict": pairs} if about is None else {"dict": pairs, "of": _encoded(about, tensors)}
    if isinstance(value, torch.device):
        return {"device": str(value)}
    name = str(len(tensors))
    if isinstance(value, np.ndarray):
        tensors[name] = torch.from_numpy(value.copy())
        return {"array": name}
    if isinstance(value, torch.Tensor):
        # A copy of its own, since safetensors refuses tensors that share memory.
        tensors[name] = value.detach().cpu().clone(memory_format=torch.contiguous_format)
        return {"tensor": name, "on": str(value.device)}
    raise TypeError(f"checkpoint: {type(value).__name__}: cannot be saved without pickle")


def _decoded(document: Any, tensors: Mapping[str, torch.Tensor]) -> Any:
    """Returns the value that `_encoded` made a document of."""
    if not isinstance(document, dict):
        return document
    kind, content = next(iter(document.items()))
    if kind == "tensor":
        return tensors[content].to(document["on"], copy=True)
    if kind == "array":
        return tensors[content].numpy().copy()
    if kind == "device":
        return torch.device(content)
    if kind == "size":
        return torch.Size(content)
    if kind == "dict":
        found = OrderedDict((_decoded(k, tensors), _decoded(v, tensors)) for k, v in content)
        if "of" not in document:
            return dict(found)
        found._metadata = _decoded(document["of"], tensors)  # type: ignore[attr-defined]
        return found
    return {"tuple": tuple, "list": list}[kind](_decoded(entry, tensors) for entry in content)

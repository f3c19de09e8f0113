"""Checkpoints that a crash, a full disk or a damaged file cannot turn into a lost run.

TorchRL's ``Checkpoint`` decides what is saved; here is how it reaches the disk. A checkpoint is one
file: it is written under another name, sealed with a digest, flushed to the disk, and only then
given its name. A file with that name is whole, whenever the process was killed; a digest that
differs tells damage, and the newest whole checkpoint is taken. Inside are JSON and plain arrays:
nothing in a checkpoint can be executed.
"""

from __future__ import annotations

import contextlib
import functools
import json
import re
import shutil
import sys
import tempfile
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

import torch
from torchrl.checkpoint import (
    Checkpoint,
    CheckpointError,
    CheckpointOptions,
    CheckpointRotation,
    StateDictCheckpointAdapter,
)
from torchrl.checkpoint._checkpoint import _encode_state_dict_value  # its format, our writing

from torchrl_hmcts import __version__
from torchrl_hmcts.trainers.saving.files import remove, remove_leftovers, replacing
from torchrl_hmcts.trainers.saving.sealing import (
    CHECKPOINT_VERSION,
    NewerCheckpointError,
    check_lengths,
    check_settings,
    find_damage,
    read_manifest,
    seal,
)

__all__ = [
    "DurableRotation",
    "PlainStateAdapter",
    "check_settings",
    "find_damage",
    "newest_checkpoint",
    "plain_checkpoint",
    "read_state",
]

_PREFIX = "checkpoint"


class PlainStateAdapter(StateDictCheckpointAdapter):
    """Writes state dicts in TorchRL's format with ordinary writes, and reads only plain arrays.

    TorchRL writes through memory maps. When the disk is full, that kills the process by SIGBUS;
    an ordinary write raises ``OSError``. Its reader would also unpickle a file that somebody put
    into the folder; this one takes JSON and arrays, nothing else.

    Raises:
        CheckpointError: on loading, if there is a file of another kind.
    """

    def save(
        self, component: Any, path: Path, *, args: tuple[Any, ...], kwargs: Mapping[str, Any]
    ) -> Any:
        state = component.state_dict(*args, **kwargs)
        tensors: dict[str, torch.Tensor] = {}
        schema = _encode_state_dict_value(state, tensors)
        folder = path / self.state_directory
        folder.mkdir(parents=True, exist_ok=True)
        meta: dict[str, Any] = {
            "shape": [],
            "device": "cpu",
            "_type": "<class 'tensordict._td.TensorDict'>",
        }
        for key, tensor in tensors.items():
            plain = tensor.detach().cpu().contiguous()
            data = plain.reshape(-1).view(torch.uint8).numpy().tobytes() if plain.numel() else b"\0"
            (folder / f"{key}.memmap").write_bytes(data)
            kind = {"dtype": str(plain.dtype), "is_nested": False}
            meta[key] = {"device": "cpu", "shape": list(plain.shape), **kind}
        (folder / "meta.json").write_text(json.dumps(meta), encoding="utf-8")
        text = json.dumps(schema, separators=(",", ":")) + "\n"
        (path / self.schema_filename).write_text(text, encoding="utf-8")
        return state

    def load(self, component: Any, path: Path, *, map_location: Any, **options: Any) -> Any:
        for file in path.rglob("*"):
            if file.is_symlink() or (file.is_file() and file.suffix not in (".json", ".memmap")):
                raise CheckpointError(
                    f"the checkpoint holds {file.name!r}, and only JSON and plain arrays are "
                    "read: other files could execute code. It was not written by this package."
                )
        check_lengths(path / self.state_directory)
        super().load(component, path, map_location=map_location, **options)


class _PlainCheckpoint(Checkpoint):
    """A checkpoint of one file that is sealed when it is saved and checked when it is loaded."""

    def save(
        self, path: str | Path, *, metadata: Mapping[str, Any] | None = None, **kwargs: Any
    ) -> Path:
        if (kwargs.pop("format", None) or self.format) != "archive":
            return super().save(path, metadata=metadata, format="directory", **kwargs)
        return _write(self, Path(path).expanduser(), metadata or {}, **kwargs)

    def load(self, path: str | Path, **kwargs: Any) -> Any:
        _check_whole(Path(path).expanduser())
        return super().load(path, **kwargs)


def plain_checkpoint(**components: Any) -> Checkpoint:
    """Return a TorchRL ``Checkpoint`` of one file without pickle, which notices all damage.

    Args:
        **components: objects with ``state_dict`` and ``load_state_dict``, by name.

    Examples:
        >>> import torch
        >>> from torchrl_hmcts.trainers.saving.checkpoints import plain_checkpoint
        >>> path = plain_checkpoint(net=torch.nn.Linear(2, 1)).save("linear.torchrl")
        >>> sorted(plain_checkpoint(net=torch.nn.Linear(2, 1)).load(path).loaded)
        ['net']
    """
    checkpoint = _PlainCheckpoint(format="archive").register_adapter(object, PlainStateAdapter())
    for name, component in components.items():
        checkpoint.register(name, component)
    return checkpoint


def read_state(path: str | Path, name: str) -> Any:
    """Return the saved state of a component, without building the component.

    Args:
        path (path): of a checkpoint.
        name (str): of the component.

    Raises:
        CheckpointError: if the checkpoint is damaged, or has no such component.
    """
    held = _Held()
    plain_checkpoint(**{name: held}).load(path, map_location="cpu")
    return held.state


class _Held:
    """Takes the state of any component."""

    def load_state_dict(self, state: Any) -> None:
        self.state = state


class DurableRotation(CheckpointRotation):
    """The newest checkpoints of a run, of which the last good one is never lost.

    Args:
        directory (path): folder of the checkpoints; it is made.
        keep_last (int): good checkpoints kept; a damaged one does not count. Default ``2``: one to
            fall back to.
        overwrite (bool): let :meth:`begin` accept the checkpoints of another run, which are removed
            once this run has written one. Default ``False``.

    Attributes:
        settings (dict): values on which the run depends, by name (JSON). A checkpoint of other
            settings is refused by :func:`check_settings`.

    Raises:
        OSError: if the folder cannot be made or written to, before any work is done.

    Examples:
        >>> import torch
        >>> from torchrl_hmcts.trainers.saving.checkpoints import DurableRotation, plain_checkpoint
        >>> rotation = DurableRotation("run", keep_last=2)
        >>> checkpoint = plain_checkpoint(net=torch.nn.Linear(2, 1))
        >>> for step in (100, 200, 300):
        ...     _ = rotation.save(checkpoint, step=step)
        >>> [path.name for path in rotation.checkpoints()]
        ['checkpoint-000000000200.torchrl', 'checkpoint-000000000300.torchrl']
    """

    def __init__(
        self, directory: str | Path, *, keep_last: int = 2, overwrite: bool = False
    ) -> None:
        super().__init__(directory, keep_last=keep_last, prefix=_PREFIX)
        self.settings: dict[str, Any] = {}
        self.overwrite = overwrite
        self._began = False
        self._others: tuple[Path, ...] = ()  # of another run, which is overwritten
        try:
            self.directory.mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryFile(dir=self.directory):
                pass
        except OSError as error:
            raise OSError(
                error.errno,
                f"checkpoints cannot be written to {str(self.directory)!r} ({error.strerror}). "
                "Choose a save_dir that can be written to",
            ) from error

    def continue_from(self, path: Path) -> None:
        """Note that the run continues from a checkpoint, perhaps one of those in this folder."""
        self._began = self._began or path.resolve().parent == self.directory.resolve()

    def begin(self) -> None:
        """Refuse the checkpoints of another run, before the first of this one is written.

        Raises:
            FileExistsError: if there are some, and ``overwrite`` is false.
        """
        others = () if self._began else self.checkpoints()
        if others and not self.overwrite:
            raise FileExistsError(
                f"{str(self.directory)!r} holds the checkpoints of another run: "
                f"{', '.join(path.name for path in others)}. Continue it with load(), choose "
                "another save_dir, or pass overwrite=True: they are removed once this run has "
                "written its first."
            )
        self._began, self._others = True, others

    def save(
        self,
        checkpoint: Checkpoint,
        *,
        step: int,
        metadata: Mapping[str, Any] | None = None,
        components: Collection[str] | None = None,
        component_options: Mapping[str, CheckpointOptions] | None = None,
    ) -> Path:
        """Write a checkpoint; its name exists only once it is whole and on the disk.

        Raises:
            OSError: if it cannot be written, e.g. to a full disk. What was there is still there.
        """
        final = self.directory / f"{_PREFIX}-{step:012d}.torchrl"
        serial = 1 + max((number for number, _ in _ordered(self.directory)), default=0)
        ours = {"settings": self.settings, "serial": serial}
        chosen = {"components": components, "component_options": component_options}
        try:
            _write(checkpoint, final, {**(metadata or {}), "torchrl_hmcts": ours}, **chosen)
        except OSError as error:
            raise OSError(error.errno, self._not_written(step, error)) from error
        for path in set(self._others) - {final}:
            remove(path)
        self._others = ()
        self.prune()
        return final

    def checkpoints(self) -> tuple[Path, ...]:
        """Return all checkpoints, damaged ones too, in the order in which they were written.

        Each has a number one above those that it found. No clock is read: it may be set back.
        """
        return tuple(path for _, path in _ordered(self.directory))

    def latest(self) -> Path | None:
        """Return the newest checkpoint that is whole; a line on stderr names damaged ones."""
        return _newest_whole(self.directory)

    def prune(self) -> tuple[Path, ...]:
        """Remove checkpoints older than the ``keep_last`` newest whole ones; return them."""
        whole, removed = 0, []
        for path in reversed(self.checkpoints()):
            if whole == self.keep_last:
                remove(path)
                removed.append(path)
            else:
                whole += _is_good(path, _identity(path))
        return tuple(removed)

    def _not_written(self, step: int, error: OSError) -> str:
        kept = [path.name for path in self.checkpoints()]
        free = "unknown"
        with contextlib.suppress(OSError):
            free = f"{shutil.disk_usage(self.directory).free / 2**20:,.1f} MiB"
        return (
            f"the checkpoint of step {step} could not be written to {str(self.directory)!r} "
            f"({error.strerror or error}; {free} free). Kept: {', '.join(kept) or 'none'}. Make "
            "room there, load the newest and continue; or choose another folder for checkpoints"
        )


def newest_checkpoint(path: str | Path) -> Path:
    """Return the checkpoint that a path names.

    Args:
        path (path): a checkpoint, or a folder of checkpoints, which may be read-only, of which the
            newest whole one is taken; a line on stderr names damaged ones.

    Raises:
        FileNotFoundError: if there is none.
        CheckpointError: if none is whole, or a newer version wrote it.
    """
    path = Path(path)
    if path.is_file() or (path / "manifest.json").exists():
        _check_whole(path)
        return path
    found = _newest_whole(path)
    if found is None:
        raise FileNotFoundError(
            f"There is no checkpoint in {str(path)!r}. Pass the save_dir of the run to continue, "
            "or one of the checkpoints in it."
        )
    return found


def _write(checkpoint: Checkpoint, path: Path, metadata: Mapping[str, Any], **kwargs: Any) -> Path:
    """Write a checkpoint of one file and its seal in one move."""
    ours = {"version": __version__, "checkpoint_version": CHECKPOINT_VERSION, "sealed": True}
    ours = {**ours, **metadata.get("torchrl_hmcts", {})}
    path.parent.mkdir(parents=True, exist_ok=True)
    remove_leftovers(path.parent)
    with replacing(path) as temporary:
        content = {**metadata, "torchrl_hmcts": ours}
        Checkpoint.save(checkpoint, temporary, format="archive", metadata=content, **kwargs)
        seal(temporary)
    return path


def _ordered(directory: Path) -> list[tuple[int, Path]]:
    """Number and path of each checkpoint; one that cannot be read has that of the step before."""
    name = re.compile(rf"{_PREFIX}-(\d+)(\.torchrl)?")
    steps = {
        path: int(match[1])
        for path in (directory.iterdir() if directory.is_dir() else ())
        if (match := name.fullmatch(path.name))
    }
    found, before = [], 0
    for path in sorted(steps, key=lambda path: (steps[path], path.name)):
        with contextlib.suppress(CheckpointError):
            before = read_manifest(path)["metadata"]["torchrl_hmcts"].get("serial", 0)
        found.append((before, path))
    return sorted(found, key=lambda entry: entry[0])  # stable: by step where numbers are equal


def _newest_whole(directory: Path) -> Path | None:
    damaged: list[str] = []
    for _, path in reversed(_ordered(directory)):
        damage = find_damage(path)
        if damage is None:
            if damaged:
                print(f"{' '.join(damaged)} Continuing from {path.name}.", file=sys.stderr)
            return path
        damaged.append(f"Checkpoint {path.name} is damaged ({damage}).")
    if damaged:
        raise CheckpointError(
            f"No checkpoint in {str(directory)!r} is whole. {' '.join(damaged)} Start again in "
            "another folder, or restore one from a backup."
        )
    return None


def _check_whole(path: Path) -> None:
    damage = find_damage(path)
    if damage is not None:
        raise CheckpointError(
            f"The checkpoint {str(path)!r} is damaged ({damage}). Pass its folder to continue from "
            "the newest one that is whole."
        )


@functools.lru_cache(maxsize=64)
def _is_good(path: Path, identity: tuple[int, ...]) -> bool:
    try:
        return find_damage(path) is None
    except NewerCheckpointError:  # not ours to judge, and not to remove
        return False


def _identity(path: Path) -> tuple[int, ...]:
    """Tells a file from the one that takes its place; times are compared for equality only."""
    status = path.stat()
    return status.st_ino, status.st_size, status.st_mtime_ns

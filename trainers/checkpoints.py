"""Checkpoints that a crash, a full disk or a damaged file cannot turn into a lost run.

TorchRL's ``Checkpoint`` decides what is saved; here is how it reaches the disk. A checkpoint is one
file: it is written under another name, flushed to the disk, and only then given its name, so that a
file with that name is whole, whenever the process was killed. Zip's checksums tell damage, and the
newest whole checkpoint is taken. What is inside are JSON and plain arrays; nothing in a checkpoint
can be executed.
"""

from __future__ import annotations

import contextlib
import json
import math
import os
import re
import shutil
import sys
import tempfile
import zipfile
from collections.abc import Collection, Mapping
from datetime import datetime, timezone
from pathlib import Path, PurePosixPath
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

_VERSION = 1  # of what this package puts into a checkpoint; raise it when old ones no longer load
_PLAIN = {".json", ".memmap"}
_MANIFEST = "manifest.json"


class PlainStateAdapter(StateDictCheckpointAdapter):
    """Writes state dicts in TorchRL's format with ordinary writes, and reads only plain arrays.

    TorchRL writes through memory maps. When the disk is full, that kills the process by SIGBUS;
    an ordinary write raises ``OSError``. Its reader would also unpickle a file that somebody put
    into the folder; this one takes JSON and arrays, nothing else.

    Raises:
        CheckpointError: on loading, if there is a file of another kind.

    Examples:
        >>> from pathlib import Path
        >>> import torch
        >>> from torchrl_hmcts.trainers.checkpoints import PlainStateAdapter
        >>> one, two = torch.nn.Linear(2, 1), torch.nn.Linear(2, 1)
        >>> _ = PlainStateAdapter().save(one, Path("linear"), args=(), kwargs={})
        >>> PlainStateAdapter().load(two, Path("linear"), map_location=None,
        ...                          tensor_load_kwargs={}, args=(), kwargs={})
        >>> torch.equal(one.weight, two.weight)
        True
    """

    def save(
        self, component: Any, path: Path, *, args: tuple[Any, ...], kwargs: Mapping[str, Any]
    ) -> Any:
        state = component.state_dict(*args, **kwargs)
        tensors: dict[str, torch.Tensor] = {}
        schema = _encode_state_dict_value(state, tensors)
        folder = path / self.state_directory
        folder.mkdir(parents=True, exist_ok=True)
        meta: dict[str, Any] = {}
        for key, tensor in tensors.items():
            plain = tensor.detach().cpu().contiguous()
            (folder / f"{key}.memmap").write_bytes(_bytes(plain))
            meta[key] = {
                "device": "cpu",
                "shape": list(plain.shape),
                "dtype": str(plain.dtype),
                "is_nested": False,
            }
        meta.update(shape=[], device="cpu", _type="<class 'tensordict._td.TensorDict'>")
        (folder / "meta.json").write_text(json.dumps(meta))
        (path / self.schema_filename).write_text(json.dumps(schema, separators=(",", ":")) + "\n")
        return state

    def load(self, component: Any, path: Path, **kwargs: Any) -> Any:
        for file in path.rglob("*"):
            if file.is_file() and file.suffix not in _PLAIN:
                raise CheckpointError(
                    f"the checkpoint holds {file.name!r}, and only JSON and plain arrays are "
                    "read: other files could execute code. It was not written by this package."
                )
        return super().load(component, path, **kwargs)


def _bytes(tensor: torch.Tensor) -> bytes:
    return tensor.reshape(-1).view(torch.uint8).numpy().tobytes() if tensor.numel() else b"\0"


def plain_checkpoint(**components: Any) -> Checkpoint:
    """Return a TorchRL ``Checkpoint`` of one file without pickle.

    Args:
        **components: objects with ``state_dict`` and ``load_state_dict``, by name.

    Examples:
        >>> import torch
        >>> from torchrl_hmcts.trainers.checkpoints import plain_checkpoint
        >>> path = plain_checkpoint(net=torch.nn.Linear(2, 1)).save("linear.torchrl")
        >>> sorted(plain_checkpoint(net=torch.nn.Linear(2, 1)).load(path).loaded)
        ['net']
    """
    checkpoint = Checkpoint(format="archive").register_adapter(object, PlainStateAdapter())
    for name, component in components.items():
        checkpoint.register(name, component)
    return checkpoint


class DurableRotation(CheckpointRotation):
    """The newest checkpoints of a run, of which the last good one is never lost.

    Args:
        directory (path): folder of the checkpoints; it is made.
        keep_last (int): good checkpoints kept; a damaged one does not count. Default ``2``: one to
            fall back to.

    Attributes:
        settings (dict): values on which the run depends, by name (JSON). A checkpoint of other
            settings is refused by :func:`check_settings`.

    Raises:
        OSError: if the folder cannot be made or written to, before any work is done.

    Examples:
        >>> import torch
        >>> from torchrl_hmcts.trainers.checkpoints import DurableRotation, plain_checkpoint
        >>> rotation = DurableRotation("run", keep_last=2)
        >>> checkpoint = plain_checkpoint(net=torch.nn.Linear(2, 1))
        >>> for step in (100, 200, 300):
        ...     _ = rotation.save(checkpoint, step=step)
        >>> [path.name for path in rotation.checkpoints()]
        ['checkpoint-000000000200.torchrl', 'checkpoint-000000000300.torchrl']
    """

    def __init__(self, directory: str | Path, *, keep_last: int = 2) -> None:
        super().__init__(directory, keep_last=keep_last)
        self.settings: dict[str, Any] = {}
        self._good: dict[Path, int] = {}  # modification times of those found whole
        _check_writable(self.directory)

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
        self._validate_step(step)
        final = self._checkpoint_path(step, "archive")
        temporary = final.with_name(f".{final.name}.writing-{os.getpid()}")
        ours = {"version": __version__, "checkpoint_version": _VERSION, "settings": self.settings}
        try:
            self.directory.mkdir(parents=True, exist_ok=True)
            self._remove_leftovers()
            checkpoint.save(
                temporary,
                components=components,
                component_options=component_options,
                format="archive",
                metadata={**(metadata or {}), "torchrl_hmcts": ours},
            )
            _sync(temporary)
            os.replace(temporary, final)
            _sync(self.directory)
        except OSError as error:
            with contextlib.suppress(OSError):
                temporary.unlink()
            raise OSError(error.errno, self._not_written(step, error)) from error
        self._good[final] = final.stat().st_mtime_ns
        self.prune()
        return final

    def checkpoints(self) -> tuple[Path, ...]:
        """Return all checkpoints, damaged ones too, in the order in which they were written."""
        if not self.directory.is_dir():
            return ()
        name = re.compile(rf"{re.escape(self.prefix)}-\d+(\.torchrl)?")
        found = [path for path in self.directory.iterdir() if name.fullmatch(path.name)]
        return tuple(sorted(found, key=lambda path: (_written_at(path), path.name)))

    def latest(self) -> Path | None:
        """Return the newest checkpoint that is whole; a line on stderr names damaged ones."""
        damaged: list[str] = []
        for path in reversed(self.checkpoints()):
            damage = find_damage(path)
            if damage is None:
                if damaged:
                    print(f"{' '.join(damaged)} Going on from {path.name}.", file=sys.stderr)
                return path
            damaged.append(f"Checkpoint {path.name} is damaged ({damage}).")
        if damaged:
            raise CheckpointError(
                f"No checkpoint in {str(self.directory)!r} is whole. {' '.join(damaged)} Start "
                "anew in another folder, or restore one from a backup."
            )
        return None

    def prune(self) -> tuple[Path, ...]:
        """Remove what is older than the ``keep_last`` newest whole checkpoints; return it."""
        whole, removed = 0, []
        for path in reversed(self.checkpoints()):
            if whole == self.keep_last:
                _remove(path)
                self._good.pop(path, None)
                removed.append(path)
            else:
                whole += self._is_good(path)
        return tuple(removed)

    def _is_good(self, path: Path) -> bool:
        modified = path.stat().st_mtime_ns
        if self._good.get(path) != modified:
            try:
                if find_damage(path) is not None:
                    return False
            except CheckpointError:  # another version's: not ours to judge, and not to remove
                return False
            self._good[path] = modified
        return True

    def _remove_leftovers(self) -> None:
        """Removes what processes that were killed while writing have left."""
        for path in self.directory.glob(f".*{self.prefix}-*.writing-*"):
            process = int(re.sub(r"\D.*", "", path.name.rpartition(".writing-")[2]) or 0)
            if process == os.getpid() or not _is_running(process):
                _remove(path)

    def _not_written(self, step: int, error: OSError) -> str:
        kept = [path.name for path in self.checkpoints()]
        free = "unknown"
        with contextlib.suppress(OSError):
            free = f"{shutil.disk_usage(self.directory).free / 2**20:,.1f} MiB"
        return (
            f"the checkpoint of step {step} could not be written to {str(self.directory)!r} "
            f"({error.strerror or error}; {free} free). Kept: {', '.join(kept) or 'none'}. Make "
            "room, or choose another save_dir, and go on with trainer.load(save_dir)"
        )


def find_damage(path: str | Path) -> str | None:
    """Return what is damaged in a checkpoint, or ``None`` if it is whole.

    Args:
        path (path): of a checkpoint, a file or (as TorchRL writes it) a folder. A file is read
            whole and compared with its checksums; in a folder all files must have their sizes.

    Raises:
        CheckpointError: if a newer version wrote it: that is no damage.

    Examples:
        >>> import torch
        >>> from torchrl_hmcts.trainers.checkpoints import find_damage, plain_checkpoint
        >>> path = plain_checkpoint(net=torch.nn.Linear(2, 1)).save("linear.torchrl")
        >>> find_damage(path)
        >>> _ = path.write_bytes(path.read_bytes()[:-100])
        >>> find_damage(path)
        'it is cut off, or no checkpoint'
    """
    path = Path(path)
    try:
        if path.is_dir():
            return _folder_damage(path)
        if not zipfile.is_zipfile(path):
            return "it is cut off, or no checkpoint"
        with zipfile.ZipFile(path) as archive:
            manifest = _check_version(path, json.loads(archive.read(_MANIFEST)))
            bad = archive.testzip()
            if bad is not None:
                return f"{bad} differs from its checksum"
            missing = set(_inventory(manifest)).difference(archive.namelist())
            return f"{min(missing)} is missing" if missing else None
    except CheckpointError:
        raise
    except Exception as error:  # damage takes any form
        return f"{type(error).__name__}: {error}"


def check_settings(path: str | Path, settings: Mapping[str, Any]) -> None:
    """Refuse a checkpoint of a run with other settings.

    Args:
        path (path): of a checkpoint.
        settings (mapping): of this run. Names that only one of the two has are not compared.

    Raises:
        CheckpointError: naming each value that differs.

    Examples:
        >>> import torch
        >>> from torchrl_hmcts.trainers.checkpoints import check_settings, plain_checkpoint
        >>> checkpoint = plain_checkpoint(net=torch.nn.Linear(2, 1))
        >>> path = checkpoint.save(
        ...     "linear.torchrl", metadata={"torchrl_hmcts": {"settings": {"batch_size": 64}}})
        >>> check_settings(path, {"batch_size": 64})
    """
    saved = Checkpoint.manifest(path).get("metadata", {}).get("torchrl_hmcts", {})
    other = saved.get("settings", {})
    here = json.loads(json.dumps(dict(settings)))
    differing = [
        f"{name} was {other[name]!r} and is {value!r} here"
        for name, value in here.items()
        if name in other and other[name] != value
    ]
    if differing:
        raise CheckpointError(
            f"The checkpoint {str(path)!r} is of a run with other settings: "
            f"{'; '.join(differing)}. Build it as it was, or choose another folder to start anew."
        )


def write_json(path: str | Path, content: Any) -> None:
    """Write numbers and texts as JSON in one move; what is no finite number becomes null.

    Args:
        path (path): file.
        content: dicts, lists, texts and numbers.

    Examples:
        >>> from torchrl_hmcts.trainers.checkpoints import write_json
        >>> write_json("metrics.json", {"solved": 0, "frames": float("nan")})
    """
    write_text(path, json.dumps(finite(content), indent=2) + "\n")


def finite(content: Any) -> Any:
    """Return content with None in place of whatever number is not finite: JSON has no other.

    Args:
        content: dicts, lists, texts and numbers, NumPy's as well.

    Examples:
        >>> from torchrl_hmcts.trainers.checkpoints import finite
        >>> finite({"frames": [float("inf"), 2]})
        {'frames': [None, 2]}
    """
    if isinstance(content, Mapping):
        return {key: finite(value) for key, value in content.items()}
    if isinstance(content, list | tuple):
        return [finite(value) for value in content]
    if hasattr(content, "tolist"):  # of NumPy and torch
        return finite(content.tolist())
    return None if isinstance(content, float) and not math.isfinite(content) else content


def write_text(path: str | Path, text: str) -> None:
    """Write a file in one move: whoever reads it finds the old text or the new one.

    Args:
        path (path): file.
        text (str): its content.

    Examples:
        >>> from torchrl_hmcts.trainers.checkpoints import write_text
        >>> write_text("metrics.json", "{}")
    """
    path = Path(path)
    temporary = path.with_name(f".{path.name}.writing-{os.getpid()}")
    try:
        temporary.write_text(text, encoding="utf-8")
        _sync(temporary)
        os.replace(temporary, path)
    except OSError:
        with contextlib.suppress(OSError):
            temporary.unlink()
        raise


def _check_writable(directory: Path) -> None:
    try:
        directory.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=directory):
            pass
    except OSError as error:
        raise type(error)(
            error.errno,
            f"checkpoints cannot be written to {str(directory)!r} ({error.strerror}). Choose a "
            "save_dir that can be written to",
        ) from error


def _check_version(path: Path, manifest: dict[str, Any]) -> dict[str, Any]:
    """Raises if a newer version wrote the manifest, so that it is not taken for damaged."""
    ours = manifest.get("metadata", {}).get("torchrl_hmcts", {})
    if ours.get("checkpoint_version", 0) > _VERSION:
        raise CheckpointError(
            f"The checkpoint {str(path)!r} was written by torchrl_hmcts {ours.get('version')}, "
            f"whose checkpoints have version {ours['checkpoint_version']}; {__version__} reads "
            f"versions up to {_VERSION}. Install the newer one to go on with it."
        )
    if manifest.get("format_version") != 1:
        Checkpoint.manifest(path)  # says which versions it reads
    return manifest


def _inventory(manifest: Mapping[str, Any]) -> list[str]:
    return [
        str(PurePosixPath(record["path"], file))
        for record in manifest["components"].values()
        for file in record["files"]
    ]


def _folder_damage(folder: Path) -> str | None:
    manifest = _check_version(folder, json.loads((folder / _MANIFEST).read_text()))
    for name in _inventory(manifest):
        file = folder / name
        if not file.is_file():
            return f"{name} is missing"
        if file.name == "meta.json":
            for key, entry in json.loads(file.read_text()).items():
                if isinstance(entry, dict) and "dtype" in entry:
                    dtype = getattr(torch, entry["dtype"].removeprefix("torch."))
                    need = math.prod(entry["shape"]) * dtype.itemsize
                    if (file.parent / f"{key}.memmap").stat().st_size < need:
                        return f"{key}.memmap of {file.parent.parent.name} is cut off"
    return None


def _written_at(path: Path) -> datetime:
    try:
        return datetime.fromisoformat(Checkpoint.manifest(path)["created_at"])
    except Exception:  # damaged
        return datetime.fromtimestamp(path.stat().st_mtime, timezone.utc)


def _sync(path: Path) -> None:
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink(missing_ok=True)


def _is_running(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    return process > 0

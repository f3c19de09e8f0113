"""Checkpoints that a crash, a full disk or a damaged file cannot turn into a lost run.

TorchRL's ``Checkpoint`` decides what is saved. A checkpoint is one file of JSON and plain arrays,
written under another name, sealed with a digest of all its bytes, and only then given its name.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import re
import shutil
import sys
import tempfile
import zipfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import torch
from torchrl.checkpoint import (
    Checkpoint,
    CheckpointError,
    CheckpointRotation,
    StateDictCheckpointAdapter,
)
from torchrl.checkpoint._checkpoint import _encode_state_dict_value  # its format, our writing

from torchrl_hmcts import __version__
from torchrl_hmcts.trainers.saving.files import remove, remove_leftovers, replacing
from torchrl_hmcts.trainers.saving.locking import folder_locked
from torchrl_hmcts.trainers.saving.stopping import patient

CHECKPOINT_VERSION = 1
"""Of what this package puts into a checkpoint; it rises when old ones no longer load."""
_PREFIX = "checkpoint"
_SEAL = b"torchrl_hmcts sha256 "  # before the digest, both in the comment of the zip file
_HEX = 64  # digits of the digest


class NewerCheckpointError(CheckpointError):
    """A checkpoint is whole, but of a version that this one does not read."""


class PlainStateAdapter(StateDictCheckpointAdapter):
    """Writes state dicts in TorchRL's format with ordinary writes, and reads only plain arrays.

    TorchRL writes through memory maps. When the disk is full, that kills the process by SIGBUS;
    an ordinary write raises ``OSError``. Its reader would also unpickle a file that somebody put
    into the folder; this one takes JSON and arrays, nothing else.
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
        super().load(component, path, map_location=map_location, **options)


class _PlainCheckpoint(Checkpoint):
    """A checkpoint of one file that is sealed when it is saved and checked when it is loaded."""

    def save(
        self, path: str | Path, *, metadata: Mapping[str, Any] | None = None, **kwargs: Any
    ) -> Path:
        return _write(self, Path(path).expanduser(), metadata or {}, **kwargs)

    def load(self, path: str | Path, **kwargs: Any) -> Any:
        newest_checkpoint(Path(path).expanduser())  # whole
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
    """Return the saved state of a component, without building the component."""
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

    @contextlib.contextmanager
    def taken(self) -> Iterator[None]:
        """Keep others from writing to the folder; the first signal only asks for the end."""
        self.begin()
        with folder_locked(self.directory), patient():
            yield

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
        **chosen: Any,
    ) -> Path:
        """Write a checkpoint; its name exists only once it is whole and on the disk.

        Those of later steps are removed then: the run has continued from an older one.

        Raises:
            OSError: if it cannot be written, e.g. to a full disk. What was there is still there.
        """
        final = self.directory / f"{_PREFIX}-{step:012d}.torchrl"
        noted = {**(metadata or {}), "torchrl_hmcts": {"settings": self.settings}}
        try:
            _write(checkpoint, final, noted, **chosen)
        except OSError as error:
            free = "unknown"
            with contextlib.suppress(OSError):
                free = f"{shutil.disk_usage(self.directory).free / 2**20:,.1f} MiB"
            kept = ", ".join(path.name for path in self.checkpoints()) or "none"
            raise OSError(
                error.errno,
                f"the checkpoint of step {step} could not be written to {str(self.directory)!r} "
                f"({error.strerror or error}; {free} free). Kept: {kept}. Make room there, load "
                "the newest and continue; or choose another folder for checkpoints",
            ) from error
        for path in {*self._others, *(p for p in self.checkpoints() if p.name > final.name)}:
            if path != final:
                remove(path)
        self._others = ()
        self.prune()
        return final

    def checkpoints(self) -> tuple[Path, ...]:
        """Return all checkpoints, damaged ones too, in the order of their steps."""
        return _ordered(self.directory)

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
                continue
            with contextlib.suppress(NewerCheckpointError):  # not ours to judge, nor to remove
                whole += find_damage(path) is None
        return tuple(removed)


def newest_checkpoint(path: str | Path) -> Path:
    """Return a checkpoint if it is whole, or the newest whole one in a folder, which is only read.

    A line on stderr names damaged ones.
    """
    path = Path(path)
    found = _newest_whole(path) if path.is_dir() else path
    if found is None or not found.exists():
        raise FileNotFoundError(
            f"There is no checkpoint in {str(path)!r}. Pass the save_dir of the run to continue, "
            "or one of the checkpoints in it."
        )
    damage = None if path.is_dir() else find_damage(found)
    if damage is not None:
        raise CheckpointError(
            f"The checkpoint {str(path)!r} is damaged ({damage}). Pass its folder to continue from "
            "the newest one that is whole."
        )
    return found


def find_damage(path: str | Path) -> str | None:
    """Return what is damaged in a checkpoint, or ``None`` if it is whole.

    Those that older versions wrote have no seal; in them, each file has a checksum of its own.
    """
    path = Path(path)
    if not zipfile.is_zipfile(path):
        return "it is cut off, or no checkpoint"
    content = memoryview(path.read_bytes())
    sealed = bytes(content[:-_HEX][-len(_SEAL) :]) == _SEAL
    if sealed and hashlib.sha256(content[:-_HEX]).hexdigest().encode() != content[-_HEX:]:
        return "it differs from its checksum"
    try:
        ours = read_manifest(path)
        if ours.get("sealed") and not sealed:
            return "its checksum is damaged"
        with zipfile.ZipFile(path) as archive:
            bad = None if sealed else archive.testzip()
            twice = len(set(archive.namelist())) < len(archive.namelist())
    except NewerCheckpointError:
        raise
    except CheckpointError as error:
        return str(error).rstrip(".")
    except Exception as error:  # damage takes any form
        return f"{type(error).__name__}: {error}"
    return "it has a file twice" if twice else bad and f"{bad} differs from its checksum"


def read_manifest(path: Path) -> dict[str, Any]:
    """Return what this package has noted in a checkpoint."""
    try:
        with zipfile.ZipFile(path) as archive:
            if sum(member.file_size for member in archive.infolist()) > path.stat().st_size:
                raise CheckpointError("it would unpack to more than its size")
        ours = dict(Checkpoint.manifest(path).get("metadata", {}).get("torchrl_hmcts", {}))
        version = int(ours.get("checkpoint_version", 0))
        ours["settings"] = dict(ours.get("settings", {}))
    except CheckpointError as error:
        newer = re.match("Unsupported (newer|older)", str(error))
        raise NewerCheckpointError(str(error)) if newer else error from None
    except Exception as error:  # damage takes any form
        raise CheckpointError(
            f"The manifest of {str(path)!r} is damaged ({type(error).__name__}: {error})."
        ) from error
    if version > CHECKPOINT_VERSION:
        raise NewerCheckpointError(
            f"The checkpoint {str(path)!r} was written by torchrl_hmcts {ours.get('version')}, "
            f"whose checkpoints have version {version}; {__version__} reads versions up to "
            f"{CHECKPOINT_VERSION}. Install the newer one to continue with it."
        )
    return ours


def to_continue(
    path: str | Path, settings: Mapping[str, Any], rotation: DurableRotation | None
) -> Path:
    """Return the checkpoint that a run of these settings continues from, and note it."""
    found = newest_checkpoint(path)
    check_settings(found, settings)
    if rotation is not None:
        rotation.continue_from(found)
    return found


def check_settings(path: str | Path, settings: Mapping[str, Any]) -> None:
    """Refuse a checkpoint of a run with other settings; names that one lacks are skipped."""
    other = read_manifest(Path(path))["settings"]
    here = json.loads(json.dumps(dict(settings)))
    differing = [
        f"{name} was {other[name]!r} and is {value!r} here"
        for name, value in here.items()
        if name in other and other[name] != value
    ]
    if differing:
        raise CheckpointError(
            f"The checkpoint {str(path)!r} is of a run with other settings: "
            f"{'; '.join(differing)}. Build it as it was, or choose another folder to start again."
        )


def _write(checkpoint: Checkpoint, path: Path, metadata: Mapping[str, Any], **kwargs: Any) -> Path:
    """Write a checkpoint of one file and its seal in one move."""
    ours = {"version": __version__, "checkpoint_version": CHECKPOINT_VERSION, "sealed": True}
    ours = {**ours, **metadata.get("torchrl_hmcts", {})}
    path.parent.mkdir(parents=True, exist_ok=True)
    remove_leftovers(path.parent)
    with replacing(path) as temporary:
        content = {**metadata, "torchrl_hmcts": ours}
        Checkpoint.save(checkpoint, temporary, format="archive", metadata=content, **kwargs)
        bare = temporary.read_bytes()[:-2]  # then the comment's length: there is none yet
        sealed = bare + (len(_SEAL) + _HEX).to_bytes(2, "little") + _SEAL
        temporary.write_bytes(sealed + hashlib.sha256(sealed).hexdigest().encode())
    return path


def _ordered(directory: Path) -> tuple[Path, ...]:
    return tuple(sorted(directory.glob(f"{_PREFIX}-*.torchrl")))


def _newest_whole(directory: Path) -> Path | None:
    damaged: list[str] = []
    for path in reversed(_ordered(directory)):
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

"""Damage in checkpoints: the seal, the manifest, and how large a checkpoint may be.

A checkpoint of this package ends with a digest of all its other bytes (in the comment of the zip
file, which other readers pass over). A bit that differs anywhere is noticed before anything is
loaded. Checkpoints of TorchRL and older ones have no seal; their files have checksums of their own.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import re
import zipfile
from collections import Counter
from collections.abc import Iterator, Mapping
from pathlib import Path, PurePosixPath
from typing import Any

import torch
from torchrl.checkpoint import Checkpoint, CheckpointError

from torchrl_hmcts import __version__

CHECKPOINT_VERSION = 1
"""Of what this package puts into a checkpoint; it rises when old ones no longer load."""
MAX_UNPACKED_BYTES = 2**31
"""Bytes to which a checkpoint may unpack: 2 GiB, or its own size on the disk if that is more (what
is written here is not compressed). The variable ``TORCHRL_HMCTS_MAX_UNPACKED_BYTES`` raises it."""
_SEAL = b"torchrl_hmcts sha256 "
_HEX = 64  # digits of the digest
_TYPES = {"settings": dict, "checkpoint_version": int, "serial": int}  # of what is read here


class NewerCheckpointError(CheckpointError):
    """A checkpoint is whole, but of a version that this one does not read."""


def seal(path: Path) -> None:
    """Write the digest of an archive's bytes behind them, as the comment of the zip file."""
    with path.open("r+b") as file:
        file.seek(-2, os.SEEK_END)  # the comment's length; there is none yet
        file.write((len(_SEAL) + _HEX).to_bytes(2, "little") + _SEAL)
        file.write(_digest(file, file.tell()))


def read_manifest(path: str | Path) -> dict[str, Any]:
    """Return the manifest of a checkpoint; what of it is read here has its right type."""
    path = Path(path)
    try:
        if path.is_file():
            with zipfile.ZipFile(path) as archive:
                _check_size(path, archive)
        manifest = Checkpoint.manifest(path)
        ours = manifest.setdefault("metadata", {}).setdefault("torchrl_hmcts", {})
        for name, kind in _TYPES.items():
            if type(ours.get(name, kind())) is not kind:
                raise TypeError(f"{name} is {ours[name]!r}")
    except FileNotFoundError:
        raise
    except CheckpointError as error:
        if re.match("Unsupported (newer|older)", str(error)):
            raise NewerCheckpointError(str(error)) from None
        raise
    except Exception as error:  # damage takes any form
        raise CheckpointError(
            f"The manifest of {str(path)!r} is damaged ({type(error).__name__}: {error})."
        ) from error
    if ours.get("checkpoint_version", 0) > CHECKPOINT_VERSION:
        raise NewerCheckpointError(
            f"The checkpoint {str(path)!r} was written by torchrl_hmcts {ours.get('version')}, "
            f"whose checkpoints have version {ours['checkpoint_version']}; {__version__} reads "
            f"versions up to {CHECKPOINT_VERSION}. Install the newer one to continue with it."
        )
    return manifest


def find_damage(path: str | Path) -> str | None:
    """Return what is damaged in a checkpoint, or ``None`` if it is whole.

    Args:
        path (path): of a checkpoint, a file or (as TorchRL writes it) a folder. A file is read
            whole and compared with its checksums; in a folder all files must have their sizes.

    Raises:
        FileNotFoundError: if there is nothing.
        CheckpointError: if a newer version wrote it: that is no damage.

    Examples:
        >>> import torch
        >>> from torchrl_hmcts.trainers.saving.checkpoints import find_damage, plain_checkpoint
        >>> path = plain_checkpoint(net=torch.nn.Linear(2, 1)).save("linear.torchrl")
        >>> find_damage(path)
        >>> _ = path.write_bytes(path.read_bytes()[:-100])
        >>> find_damage(path)
        'it is cut off, or no checkpoint'
    """
    path = Path(path)
    if not path.exists():
        raise FileNotFoundError(f"There is no checkpoint {str(path)!r}.")
    try:
        if path.is_dir():
            return _folder_damage(path, read_manifest(path))
        if not zipfile.is_zipfile(path):
            return "it is cut off, or no checkpoint"
        sealed = _is_sealed(path)
        if sealed is False:
            return "it differs from its checksum"
        manifest = read_manifest(path)
        if sealed is None and manifest["metadata"]["torchrl_hmcts"].get("sealed"):
            return "its checksum is damaged"
        with zipfile.ZipFile(path) as archive:
            return _archive_damage(archive, manifest)
    except NewerCheckpointError:
        raise
    except CheckpointError as error:
        return str(error).rstrip(".")
    except Exception as error:  # damage takes any form
        return f"{type(error).__name__}: {error}"


def check_settings(path: str | Path, settings: Mapping[str, Any]) -> None:
    """Refuse a checkpoint of a run with other settings; names that one lacks are skipped."""
    other = read_manifest(path)["metadata"]["torchrl_hmcts"].get("settings", {})
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


def check_lengths(folder: Path) -> None:
    """Refuse arrays that are shorter than they say."""
    for size, file in _array_files(folder):
        if file.stat().st_size < size:
            raise CheckpointError(f"{file.name} of {folder.parent.name} is cut off")


def _array_files(folder: Path) -> Iterator[tuple[int, Path]]:
    """Yield bytes and file of each array."""
    for key, entry in json.loads((folder / "meta.json").read_text(encoding="utf-8")).items():
        if isinstance(entry, dict) and "dtype" in entry:
            dtype = getattr(torch, entry["dtype"].removeprefix("torch."))
            size = math.prod(entry["shape"]) * dtype.itemsize
            yield size, folder / f"{Path(key).name}.memmap"


def _digest(file: Any, end: int) -> bytes:
    """Digest of the first bytes of an open file, in hexadecimal digits; leaves it at their end."""
    found, left = hashlib.sha256(), end
    file.seek(0)
    while block := file.read(min(left, 2**20)):
        found.update(block)
        left -= len(block)
    return found.hexdigest().encode()


def _is_sealed(path: Path) -> bool | None:
    """Whether the digest at the end is right; None if there is none."""
    end = path.stat().st_size - _HEX
    if end < len(_SEAL):
        return None
    with path.open("rb") as file:
        file.seek(end - len(_SEAL))
        if file.read(len(_SEAL)) != _SEAL:
            return None
        return bool(file.read() == _digest(file, end))


def _check_size(path: Path, archive: zipfile.ZipFile) -> None:
    """Refuse an archive by the sizes it declares; Python's reader gives no byte more than those."""
    limit = int(os.environ.get("TORCHRL_HMCTS_MAX_UNPACKED_BYTES") or MAX_UNPACKED_BYTES)
    unpacked = sum(member.file_size for member in archive.infolist())
    if unpacked > max(limit, path.stat().st_size):
        raise CheckpointError(
            f"The checkpoint {str(path)!r} would unpack to {unpacked:,} bytes, and {limit:,} are "
            "allowed. If you know where it is from, set TORCHRL_HMCTS_MAX_UNPACKED_BYTES."
        )


def _inventory(manifest: Mapping[str, Any]) -> list[str]:
    return [
        str(PurePosixPath(record["path"], file))
        for record in manifest["components"].values()
        for file in record["files"]
    ]


def _archive_damage(archive: zipfile.ZipFile, manifest: Mapping[str, Any]) -> str | None:
    names = Counter(archive.namelist())
    expected = {"manifest.json", *_inventory(manifest)}
    for name, number in names.items():
        if number > 1:
            return f"{name} is in it {number} times"
        if name not in expected:
            return f"{name} is not in its manifest"
    if missing := expected.difference(names):
        return f"{min(missing)} is missing"
    bad = archive.testzip()
    return None if bad is None else f"{bad} differs from its checksum"


def _folder_damage(folder: Path, manifest: Mapping[str, Any]) -> str | None:
    for name in _inventory(manifest):
        file = folder / name
        if file.is_symlink() or not file.is_file():
            return f"{name} is {'a link' if file.is_symlink() else 'missing'}"
        if file.name == "meta.json":
            check_lengths(file.parent)
    return None

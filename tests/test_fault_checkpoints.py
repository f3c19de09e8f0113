"""Full disks, read-only folders, damaged and foreign checkpoints, and losses that are NaN."""

from __future__ import annotations

import errno
import json
import os
import pickle
import shlex
import shutil
import subprocess
import sys
import warnings
import zipfile
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import torch
from small_trainers import make_diayn
from torch import nn
from torchrl.checkpoint import (
    Checkpoint,
    CheckpointError,
    CheckpointRotation,
    StateDictCheckpointAdapter,
)

from torchrl_hmcts.trainers.saving import checkpoints
from torchrl_hmcts.trainers.saving.checkpoints import (
    DurableRotation,
    check_settings,
    find_damage,
    newest_checkpoint,
    plain_checkpoint,
)

FULL = OSError(errno.ENOSPC, "No space left on device")
NAME = "checkpoint-{:012d}.torchrl"
refused = partial(pytest.raises, CheckpointError)


class Big(nn.Module):
    """Half a mebibyte of weights that say at which step they were saved."""

    def __init__(self, step: int = 0) -> None:
        super().__init__()
        self.register_buffer("weights", torch.full((2**17,), float(step)))


def save(folder: Path, *steps: int, keep_last: int = 9) -> DurableRotation:
    rotation = DurableRotation(folder, keep_last=keep_last)
    for step in steps:
        rotation.save(plain_checkpoint(net=Big(step)), step=step)
    return rotation


def load(path: Path) -> float:
    net = Big()
    plain_checkpoint(net=net).load(path)
    assert len(set(net.weights.tolist())) == 1
    return float(net.weights[0])


def loaded(rotation: DurableRotation) -> list[float]:
    return [load(path) for path in rotation.checkpoints()]


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def rewrite(path: Path, change: Callable[[dict[str, bytes]], dict[str, bytes]]) -> None:
    """Write the files of a zip again, without a seal."""
    with zipfile.ZipFile(path) as archive:
        content = {name: archive.read(name) for name in archive.namelist()}
    with zipfile.ZipFile(path, "w") as archive:
        for name, data in change(content).items():
            archive.writestr(name, data)


def rewrite_manifest(path: Path, change: Callable[[dict[str, Any]], None]) -> None:
    def changed(content: dict[str, bytes]) -> dict[str, bytes]:
        manifest = json.loads(content["manifest.json"])
        change(manifest)
        return {**content, "manifest.json": json.dumps(manifest).encode()}

    rewrite(path, changed)


def harm(path: Path, how: str = "flip") -> None:
    whole = path.read_bytes()
    middle = len(whole) // 2
    if how == "strip":  # a valid zip without its arrays
        rewrite(path, lambda content: {k: v for k, v in content.items() if "memmap" not in k})
    else:
        bad = {"cut": whole[:middle], "empty": b"", "text": b"no checkpoint"}
        bad["flip"] = whole[:middle] + bytes([whole[middle] ^ 0x10]) + whole[middle + 1 :]
        path.write_bytes(bad[how])


class TestDamage:
    @pytest.mark.parametrize("how", ["cut", "flip", "empty", "text", "strip"])
    def test_the_newest_whole_checkpoint_is_taken_and_a_line_says_so(
        self, how: str, tmp_path, capsys
    ) -> None:
        harm(save(tmp_path, 1, 2, 3).checkpoints()[-1], how)
        assert load(newest_checkpoint(tmp_path)) == 2.0
        said = capsys.readouterr().err
        assert said.count("\n") == 1
        assert said.startswith(f"Checkpoint {NAME.format(3)} is damaged (")
        assert said.endswith(f"Continuing from {NAME.format(2)}.\n")

    def test_a_damaged_checkpoint_that_was_asked_for_is_refused(self, tmp_path) -> None:
        path = save(tmp_path, 1, 2).checkpoints()[-1]
        harm(path)
        with refused(match=r"damaged \(.*checksum\).*Pass its folder"):
            newest_checkpoint(path)

    def test_when_all_are_damaged_each_is_named(self, tmp_path) -> None:
        for path in save(tmp_path, 1, 2).checkpoints():
            harm(path, "cut")
        with refused(match=r"is whole.*02\.torchrl.*01\.torchrl.*again"):
            newest_checkpoint(tmp_path)

    def test_torchrl_reads_what_is_written_here(self, tmp_path) -> None:
        save(tmp_path, 7)
        net = Big()
        CheckpointRotation(tmp_path, keep_last=1).load_latest(Checkpoint(net=net))
        assert net.weights[0] == 7.0

    def test_every_kind_of_entry_comes_back_as_it_was(self, tmp_path) -> None:
        state: dict[Any, Any] = {
            "scalar": torch.tensor(2.5),
            "none": torch.zeros(0, 3),
            "half": torch.ones(3, dtype=torch.bfloat16),
            "flags": torch.tensor([True, False]),
            "strided": torch.arange(6).view(2, 3).t(),
            3: [1, None, "x", (True, 1e-9)],
        }

        class Holder:
            def state_dict(self) -> dict[Any, Any]:
                return state

        path = plain_checkpoint(it=Holder()).save(tmp_path / "c")
        got = checkpoints.read_state(path, "it")
        assert list(got) == list(state)
        assert got.pop(3) == state[3]
        for name, value in got.items():
            assert value.dtype == state[name].dtype
            assert torch.equal(value, state[name]), name


class TestRotation:
    def test_a_damaged_one_does_not_count_so_that_the_last_good_one_stays(self, tmp_path) -> None:
        rotation = save(tmp_path, 1, 2, 3)
        rotation.keep_last = 1
        for path in rotation.checkpoints()[1:]:
            harm(path)
        rotation.prune()
        assert len(names(tmp_path)) == 3
        assert load(newest_checkpoint(tmp_path)) == 1.0

    def test_after_a_fall_back_the_new_ones_count_as_the_newest(self, tmp_path) -> None:
        rotation = save(tmp_path, 100, 200, keep_last=1)
        harm(rotation.checkpoints()[-1])
        rotation.save(plain_checkpoint(net=Big(150)), step=150)
        assert names(tmp_path) == [NAME.format(150)]
        assert load(newest_checkpoint(tmp_path)) == 150.0

    def test_checkpoints_of_older_versions_are_read(self, tmp_path) -> None:
        for step in (3, 1, 2):
            Checkpoint(net=Big(step), format="archive").save(tmp_path / NAME.format(step))
        assert load(newest_checkpoint(tmp_path)) == 3.0
        save(tmp_path, 2, keep_last=2)
        assert loaded(DurableRotation(tmp_path)) == [1.0, 2.0]

    def test_the_same_step_can_be_saved_again(self, tmp_path) -> None:
        save(tmp_path, 5).save(plain_checkpoint(net=Big(6)), step=5)
        assert load(newest_checkpoint(tmp_path)) == 6.0

    def test_a_folder_that_vanishes_while_training_is_made_again(self, tmp_path) -> None:
        rotation = save(tmp_path / "run", 1)
        shutil.rmtree(tmp_path / "run")
        rotation.save(plain_checkpoint(net=Big(2)), step=2)
        assert load(newest_checkpoint(tmp_path / "run")) == 2.0

    def test_what_a_killed_process_left_is_removed(self, tmp_path) -> None:
        gone = subprocess.Popen([sys.executable, "-c", ""])
        gone.wait()
        left = tmp_path / f"..{NAME.format(1)}.writing-{gone.pid}.stage-0a"
        left.mkdir()
        (left / "x.memmap").write_bytes(b"x")
        other = tmp_path / f".{NAME.format(1)}.writing-{os.getppid()}"
        other.write_bytes(b"x")
        save(tmp_path, 2)
        assert names(tmp_path) == [other.name, NAME.format(2)]


def fail(*_: Any, **__: Any) -> None:
    raise FULL


class TestDisk:
    @pytest.mark.parametrize(
        ("owner", "call"),
        [(Path, "write_bytes"), (zipfile.ZipFile, "write"), (os, "fsync"), (os, "replace")],
    )
    def test_a_full_disk_loses_no_checkpoint_and_is_named(
        self, owner: Any, call: str, tmp_path, monkeypatch
    ) -> None:
        rotation = save(tmp_path, 1, 2)
        before = names(tmp_path)
        message = r"of step 3 .*No space left.*MiB free\).*Kept: .*01\.torchrl, .*02"
        with monkeypatch.context() as patch:
            patch.setattr(owner, call, fail)
            with pytest.raises(OSError, match=message) as caught:
                rotation.save(plain_checkpoint(net=Big(3)), step=3)
        assert caught.value.errno == errno.ENOSPC
        assert names(tmp_path) == before
        rotation.save(plain_checkpoint(net=Big(4)), step=4)  # there is room again
        assert load(newest_checkpoint(tmp_path)) == 4.0

    def test_a_small_disk_that_really_is_full_ends_in_an_error(self, tmp_path) -> None:
        """Memory maps, which TorchRL writes by, would kill the process: hence a process."""
        disk = tmp_path / "disk"
        disk.mkdir()
        script = (
            f"import sys; sys.path.insert(0, {str(Path(__file__).parent)!r})\n"
            f"from pathlib import Path; from {Path(__file__).stem} import *\n"
            f"disk = Path({str(disk)!r})\n"
            "try:\n    save(disk, *range(9))\n"
            "finally:\n    print(loaded(DurableRotation(disk)))"
        )
        mount = f"mount -t tmpfs -o size=2m tmpfs {shlex.quote(str(disk))}"
        private = ["unshare", "-m", "sh", "-c"]  # the disk vanishes with the process
        if not shutil.which("unshare") or subprocess.run([*private, mount]).returncode:
            pytest.skip("needs the right to mount a file system")
        command = f"{mount} && exec {shlex.quote(sys.executable)} -c {shlex.quote(script)}"
        done = subprocess.run([*private, command], capture_output=True, text=True)
        assert done.returncode == 1, done.returncode  # and no signal
        assert "No space left on device; " in done.stderr.splitlines()[-1]
        assert done.stdout.splitlines()[-1] == "[0.0, 1.0]"

    def test_a_folder_that_cannot_be_written_is_named_before_any_work(self, tmp_path) -> None:
        (tmp_path / "file").write_text("")
        with pytest.raises(OSError, match="cannot be written to '.*file/run' .Not a directory"):
            DurableRotation(tmp_path / "file" / "run")

    def test_a_read_only_folder_is_named_before_any_work_and_can_be_read(
        self, tmp_path, monkeypatch
    ) -> None:
        def read_only(*_: Any, **__: Any) -> None:
            raise OSError(errno.EROFS, "Read-only file system")

        save(tmp_path, 1)
        # For root, no folder is read-only.
        monkeypatch.setattr(checkpoints.tempfile, "TemporaryFile", read_only)
        with pytest.raises(OSError, match=r"Read-only file system.*Choose a save_dir"):
            DurableRotation(tmp_path)
        assert load(newest_checkpoint(tmp_path)) == 1.0


FORM = '{"format": "torchrl.checkpoint", "format_version": 1, "components": '
METADATA = ("null", "[1]", '{"torchrl_hmcts": {"settings": "x", "checkpoint_version": NaN}}')


class TestForeign:
    @pytest.mark.parametrize(
        "manifest",
        [
            *("[]", "null", "3", "{", "\\ud800", FORM + "[]}", FORM + '{"a": 1}}'),
            *(f'{FORM}{{}}, "metadata": {metadata}}}' for metadata in METADATA),
        ],
    )
    def test_a_manifest_of_any_content_is_an_error_of_the_checkpoint(
        self, manifest: str, tmp_path
    ) -> None:
        path = tmp_path / "c"
        with zipfile.ZipFile(path, "w") as archive:
            archive.writestr("manifest.json", manifest)
        assert find_damage(path)
        for read in (newest_checkpoint, load, lambda path: check_settings(path, {"a": 1})):
            with refused():
                read(path)

    def test_a_file_that_is_in_it_twice_is_refused(self, tmp_path) -> None:
        path = Checkpoint(net=Big(1), format="archive").save(tmp_path / "c")
        with zipfile.ZipFile(path, "a") as archive, warnings.catch_warnings():
            warnings.simplefilter("ignore")
            archive.writestr("manifest.json", archive.read("manifest.json"))
        with refused(match="a file twice"):
            load(path)

    @pytest.mark.parametrize(("old", "new"), [(b"131072", b"9" * 13), (b"float32", b"nn")])
    def test_arrays_that_are_not_what_they_say_are_refused(
        self, old: bytes, new: bytes, tmp_path
    ) -> None:
        def change(content: dict[str, bytes]) -> dict[str, bytes]:
            (name,) = (name for name in content if name.endswith("meta.json"))
            return {**content, name: content[name].replace(old, new)}

        path = Checkpoint(net=Big(1), format="archive").save(tmp_path / "c")
        rewrite(path, change)
        with refused(match="Failed to load"):
            load(path)

    def test_a_checkpoint_that_would_unpack_to_more_than_its_size_is_refused(
        self, tmp_path
    ) -> None:
        made = Checkpoint(net=Big(1), format="archive", archive_compression="deflate")
        path = made.save(tmp_path / "c")  # 0.5 MiB of ones, in some KiB
        for read in (load, newest_checkpoint):
            with refused(match="unpack to more than its size"):
                read(path)

    def test_a_newer_version_is_named_and_nothing_older_is_taken_instead(self, tmp_path) -> None:
        path = save(tmp_path, 1, 2).checkpoints()[-1]
        newer = {"version": "9.1", "checkpoint_version": 7}
        rewrite_manifest(path, lambda m: m["metadata"]["torchrl_hmcts"].update(newer))
        with refused(match=r"written by torchrl_hmcts 9\.1.*version 7"):
            newest_checkpoint(tmp_path)
        rewrite_manifest(path, lambda m: m.update(format_version=8, metadata={}))
        with refused(match="Unsupported newer checkpoint format version 8"):
            newest_checkpoint(tmp_path)

    def test_a_run_of_another_shape_is_refused_with_what_differs(self, tmp_path) -> None:
        make_diayn(tmp_path / "run").train()
        with refused(match="other settings: batch_size was 8 and is 16 here.*Build it as"):
            make_diayn(tmp_path / "new", batch_size=16).load(tmp_path / "run")
        other = make_diayn(tmp_path / "new")
        other.run_settings["loss_module"] = "METRALoss"
        with refused(match="loss_module was 'DIAYNLoss' and is 'METRALoss'"):
            other.load(tmp_path / "run")
        with refused(match="size mismatch|shape"):
            make_diayn(tmp_path / "new", hidden=9).load(tmp_path / "run")

    def test_a_checkpoint_without_a_component_is_refused(self, tmp_path) -> None:
        one = make_diayn(None)
        path = plain_checkpoint(loss_module=one.loss_module).save(tmp_path / "c")
        with refused(match="missing=.*'optimizer'"):
            one.load(path)

    def test_settings_are_compared_as_they_come_back_from_json(self, tmp_path) -> None:
        rotation = DurableRotation(tmp_path)
        rotation.settings = {"hidden": (8, 8), "fraction": None}
        path = rotation.save(plain_checkpoint(net=Big()), step=0)
        check_settings(path, {"hidden": (8, 8), "fraction": None, "new": 1})
        with refused(match=r"hidden was \[8, 8\] and is \[8\] here"):
            check_settings(path, {"hidden": (8,)})

    def test_a_pickle_inside_a_checkpoint_is_not_opened(self, tmp_path) -> None:
        class Bomb:
            def __reduce__(self) -> Any:
                return os.mkdir, (str(tmp_path / "exploded"),)

        class Pickled(StateDictCheckpointAdapter):
            def save(self, component: Any, path: Path, **_: Any) -> None:
                path.mkdir(parents=True)
                (path / "state.pt").write_bytes(pickle.dumps(Bomb()))

        made = Checkpoint(format="archive").register("net", Big(), adapter=Pickled())
        with refused(match="holds 'state.pt'.*could execute code"):
            load(made.save(tmp_path / "c"))
        assert not (tmp_path / "exploded").exists()


class TestNaN:
    @pytest.mark.parametrize("how", ["loss", "gradient"])
    def test_it_stops_the_training_unchanged_and_names_the_last_good_checkpoint(
        self, how: str, tmp_path
    ) -> None:
        one = make_diayn(tmp_path, 160, save_trainer_interval=15)
        forward, weights = one.loss_module.forward, {}

        def poisoned(td: Any) -> Any:
            out = forward(td)
            if one.collected_frames >= 64:
                weights.update({k: v.clone() for k, v in one.loss_module.state_dict().items()})
                actor = out["loss_actor"]
                # A finite loss whose gradient is not: d sqrt(x) / dx at 0.
                bad = actor * float("nan") if how == "loss" else actor + (actor - actor).sqrt()
                out["loss_actor"] = bad
            return out

        one.loss_module.forward = poisoned
        where = "loss_actor is nan" if how == "loss" else "The gradient's norm is nan"
        newest = tmp_path / NAME.format(48)
        message = f"{where} in update 10, after 64 base steps.*not applied.*is '{newest}'.*learning"
        with pytest.raises(FloatingPointError, match=message):
            one.train()
        for name, value in one.loss_module.state_dict().items():
            assert torch.equal(value, weights[name]), name
        again = make_diayn(tmp_path, 80, save_trainer_interval=15).load(tmp_path)
        assert again.collected_frames == 48
        again.train()

    def test_without_checkpoints_the_error_says_how_to_have_some(self) -> None:
        one = make_diayn(None)
        with torch.no_grad():
            next(one.loss_module.parameters()).fill_(float("inf"))
        with pytest.raises(FloatingPointError, match="There is no checkpoint: pass save_dir"):
            one.train()

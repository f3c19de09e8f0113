"""Files from which something continues, with bits flipped and cut off: refused, or read as saved.

``python tests/test_fault_damage.py COUNT`` damages a file of each kind so often and prints what
happened. Half of the flips are in the last 4 KiB, where a zip file has its directory.
"""

from __future__ import annotations

import contextlib
import hashlib
import io
import json
import random
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import torch
from small_trainers import make_a3c, make_diayn
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.checkpoint import Checkpoint, CheckpointError
from torchrl.checkpoint._checkpoint import _encode_state_dict_value

from torchrl_hmcts.envs import WaterworldMazeEnv
from torchrl_hmcts.planners import MCTSPlanner, RadiusNovelty, SearchBudget
from torchrl_hmcts.testing import ChainEnv
from torchrl_hmcts.trainers import A3CTrainer, DIAYNTrainer, ExpertIterationTrainer, HMCTSTrainer
from torchrl_hmcts.trainers.experiments.registry import load_config
from torchrl_hmcts.trainers.experiments.settings import DemoConfig
from torchrl_hmcts.trainers.saving.checkpoints import (
    DurableRotation,
    PlainStateAdapter,
    check_settings,
    newest_checkpoint,
    plain_checkpoint,
)
from torchrl_hmcts.trainers.saving.run_folder import read_run, start_record

REFUSED = (CheckpointError, ValueError)  # of checkpoints, and of JSON
Kind = tuple[Path, Callable[[], Any]]  # the file, and what is loaded from it; raises what refuses


def diayn(folder: Path) -> Kind:
    return _of_trainer(lambda: make_diayn(folder))


def hmcts(folder: Path) -> Kind:
    from torchrl_hmcts.trainers.experiments.kits.waterworld import make_training_env

    loss = DIAYNTrainer.make_loss(make_training_env(), num_skills=4, hidden=(8,), seed=0)
    planner = partial(
        MCTSPlanner, novelty=RadiusNovelty("position", 0.7), budget=SearchBudget(expansions=2)
    )
    return _of_trainer(
        lambda: HMCTSTrainer(
            partial(WaterworldMazeEnv, observation=False), loss, rounds=6, num_init_samples=4,
            retrain_interval=2, option_steps=5, updates_per_step=0.1, batch_size=16,
            make_planner=planner, save_dir=folder,
        )
    )  # fmt: skip


class TwoHeads(nn.Linear):
    def forward(self, state: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        out = super().forward(state.float().reshape(-1, 1))
        return out[:, :2], out[:, 2:].sigmoid()


def expert_iteration(folder: Path) -> Kind:
    network = TensorDictModule(TwoHeads(1, 3), ["state"], ["logits", "state_value"])
    env = ChainEnv(length=5)
    return _of_trainer(
        lambda: ExpertIterationTrainer(
            env, network, MCTSPlanner(env), iterations=2, searches_per_iteration=1,
            updates_per_iteration=6, save_dir=folder,
        )
    )  # fmt: skip


def a3c(folder: Path) -> Kind:
    return _of_trainer(lambda: make_a3c(folder, total=100, length=5))


def _of_trainer(make: Callable[[], Any]) -> Kind:
    first, trainer = make(), make()
    first.train()
    a3c = isinstance(first, A3CTrainer)
    path = first.rotation.latest()

    def load() -> Any:
        trainer.load(path)
        parts = (trainer._checkpoint if a3c else trainer.checkpoint).components
        return {name: part.state_dict() for name, part in parts.items()}

    return path, load


def demo(folder: Path) -> Kind:
    from torchrl_hmcts.trainers.experiments.kits import make_kit
    from torchrl_hmcts.trainers.experiments.skills import learn
    from torchrl_hmcts.trainers.saving.worker_file import load_networks

    config = DemoConfig(train_base_steps=128, out=str(folder))
    loss = learn(make_kit(config), save_dir=folder / "checkpoints").loss

    def load() -> Any:
        load_networks(loss, folder)
        return loss.state_dict()

    return newest_checkpoint(folder / "checkpoints"), load


def _atari_run(folder: Path) -> Any:
    from torchrl_hmcts.trainers.experiments.atari.config import AtariConfig
    from torchrl_hmcts.trainers.experiments.atari.episodes import AtariRun

    pytest.importorskip("ale_py")
    config = AtariConfig(
        frames=400, max_episode_frames=200, source="repeat", option_steps=10, ratio=1.0,
        rollout_options=0, num_processes=0, replant_every=5, guide="prior_value", out=str(folder),
    )  # fmt: skip
    run = AtariRun(config)
    saved: list[Any] = []
    run.play(lambda: saved.append(run.state_dict()), lambda: None)
    run.close()
    return saved[-1]


class Saved:
    def __init__(self, state: Any) -> None:
        self.state_dict = lambda: state


def checkpoint_of_older_versions(folder: Path) -> Kind:
    """A file without a seal, as TorchRL writes it."""
    saved = Checkpoint(format="archive").register_adapter(object, PlainStateAdapter())
    saved.register("net", nn.Linear(5, 3))
    ours = {"version": "0.1", "checkpoint_version": 1, "settings": {"seed": 1}}
    path = saved.save(folder / "checkpoint-000000000001.torchrl", metadata={"torchrl_hmcts": ours})

    def load() -> Any:
        net = nn.Linear(5, 3)
        check_settings(newest_checkpoint(folder), {"seed": 1})
        plain_checkpoint(net=net).load(newest_checkpoint(folder))
        return net.state_dict()

    return path, load


def atari_run(folder: Path) -> Kind:
    from torchrl_hmcts.trainers.experiments.atari.episodes import load_run

    rotation = DurableRotation(folder / "checkpoints")
    state = _atari_run(folder)
    path = rotation.save(plain_checkpoint(run=Saved(state)), step=state["frames"])
    return path, lambda: load_run(folder)[1]


def atari_run_of_older_versions(folder: Path) -> Kind:
    from torchrl_hmcts.trainers.experiments.atari.episodes import load_run

    path = folder / "checkpoints" / "run.pt"
    path.parent.mkdir(parents=True)
    torch.save(_atari_run(folder), path)
    return path, lambda: load_run(folder)[1]


def atari_trials(folder: Path) -> Kind:
    from torchrl_hmcts.trainers.experiments.atari.memory import Trial, TrialMemory

    folder.mkdir(parents=True)
    path = folder / "trials.json"
    make = partial(TrialMemory, path, {"game": "Pong", "seed": 0})
    for i in range(20):
        make().remember(f"key {i}", Trial(float(i), 300 + i, 7_000))

    def load() -> Any:
        said = io.StringIO()
        with contextlib.redirect_stderr(said):
            known = make()._known
        if not known and "are played again" in said.getvalue():
            raise ValueError(said.getvalue())
        return known

    return path, load


def run_record(folder: Path) -> Kind:
    config = DemoConfig(seed=3, out=str(folder))
    start_record("demo", config, ["hmcts", "demo", "seed=3"])
    return folder / "run.json", lambda: vars(load_config(read_run(folder))[1])


def sweep_journal(folder: Path) -> Kind:
    journal = pytest.importorskip("torchrl_hmcts.trainers.runs.sweep")
    folder.mkdir(parents=True)
    path = folder / "journal.log"
    for i in range(20):
        journal.CheckedJournal(path).append_logs([{"op_code": i, "trial": 0.5 * i}])

    def read() -> list[Any]:  # the entries that Optuna reads; a checksum's name may be damaged
        logs = journal.CheckedJournal(path).read_logs(0)
        return [{name: log.get(name) for name in ("op_code", "trial")} for log in logs]

    whole = read()

    def load() -> Any:
        logs = read()
        if len(logs) < len(whole) and logs == whole[: len(logs)]:
            raise ValueError("It continues where it was after some trials fewer.")
        return logs

    return path, load


KINDS = [
    diayn, hmcts, a3c, expert_iteration, demo, checkpoint_of_older_versions, atari_run,
    atari_run_of_older_versions, atari_trials, run_record, sweep_journal,
]  # fmt: skip


def fingerprint(state: Any) -> str:
    """Equal for equal content, bit for bit."""
    tensors: dict[str, torch.Tensor] = {}
    found = hashlib.sha256(json.dumps(_encode_state_dict_value(state, tensors)).encode())
    for tensor in tensors.values():
        found.update(f"{tensor.dtype} {tuple(tensor.shape)}".encode())
        found.update(tensor.detach().cpu().numpy().tobytes())
    return found.hexdigest()


def damage(kind: Callable[[Path], Kind], folder: Path, count: int, seed: int = 0) -> Counter[str]:
    """Damages a file so often, by turns a bit and its end; counts what loading it does."""
    path, load = kind(folder)
    expected, whole, rng = fingerprint(load()), path.read_bytes(), random.Random(seed)
    counts: Counter[str] = Counter()
    for case in range(count):
        if case % 2:
            what, bad = "cut", whole[: rng.randrange(len(whole))]
        else:
            what, content = "flipped", bytearray(whole)
            first = 0 if rng.random() < 0.5 else max(0, len(whole) - 4096)
            content[rng.randrange(first, len(whole))] ^= 1 << rng.randrange(8)
            bad = bytes(content)
        path.write_bytes(bad)
        with contextlib.redirect_stderr(io.StringIO()):
            try:
                result = "as_saved" if fingerprint(load()) == expected else "AS_SOMETHING_ELSE"
            except REFUSED:
                result = "refused"
            except Exception as error:
                result = f"ANOTHER_ERROR {type(error).__name__}"
        counts[f"{what}_{result}"] += 1
    path.write_bytes(whole)
    assert fingerprint(load()) == expected
    return counts


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.__name__)
def test_a_damaged_file_is_refused_or_read_as_it_was_saved(
    kind: Callable[[Path], Kind], tmp_path
) -> None:
    counts = damage(kind, tmp_path / "run", 60)
    assert sum(counts.values()) == 60
    assert not [name for name in counts if "SOMETHING_ELSE" in name or "ERROR" in name], counts
    assert counts["cut_refused"] >= 29  # JSON is whole without its last line break


def main() -> None:
    count, figures = int(sys.argv[1]), {}
    torch.set_num_threads(1)
    for kind in KINDS:
        begin = time.process_time()
        with tempfile.TemporaryDirectory() as folder, contextlib.redirect_stdout(sys.stderr):
            counts = dict(sorted(damage(kind, Path(folder) / "run", count).items()))
        seconds = round(time.process_time() - begin, 1)
        figures[kind.__name__] = {**counts, "cpu_seconds": seconds}
    print(json.dumps({"cases_of_each_kind": count, "kinds": figures}))


if __name__ == "__main__":
    main()

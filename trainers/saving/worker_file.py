"""The networks of a finished run in one file, named with the training step they are from.

The page of the run shows them, and ``hmcts evaluate`` tests them.
"""

from __future__ import annotations

import re
import sys
from pathlib import Path

from torchrl.checkpoint import CheckpointError
from torchrl.objectives import LossModule

from torchrl_hmcts.trainers.saving.checkpoints import (
    find_damage,
    newest_checkpoint,
    plain_checkpoint,
)
from torchrl_hmcts.trainers.saving.files import replacing
from torchrl_hmcts.trainers.saving.run_folder import read_run
from torchrl_hmcts.trainers.saving.stopping import unbroken

_NAME = re.compile(r"worker-(\d+)\.torchrl")


def save_worker(run: str | Path, loss_module: LossModule, step: int) -> Path:
    """Write a run's networks as ``worker/worker-STEP.torchrl``, the only one there."""
    folder = Path(run) / "worker"
    folder.mkdir(exist_ok=True)
    path = folder / f"worker-{step:012d}.torchrl"
    with unbroken():
        with replacing(path) as temporary:
            plain_checkpoint(loss_module=loss_module).save(temporary)
        for other in folder.iterdir():
            if other != path and _NAME.fullmatch(other.name):
                other.unlink()
    return path


def find_worker(run: str | Path) -> Path:
    """Return the file that holds a run's networks: its worker, or its newest checkpoint.

    A run that has not finished, or is of an older version, has no worker file. A line on stderr
    names one that is damaged.
    """
    run = Path(run)
    try:
        over = read_run(run).status in ("", "finished")
    except ValueError:  # no record: written from Python
        over = True
    if over and (run / "worker").is_dir():
        workers = [p for p in (run / "worker").iterdir() if _NAME.fullmatch(p.name)]
        for path in sorted(workers, reverse=True):
            damage = find_damage(path)
            if damage is None:
                return path
            print(
                f"{path} is damaged ({damage}). Taking the networks of the newest checkpoint.",
                file=sys.stderr,
            )
    return newest_checkpoint(run / "checkpoints")


def load_networks(loss_module: LossModule, run: str | Path) -> Path:
    """Give a loss's networks the weights of a run's worker, and nothing else of it."""
    path = find_worker(run)
    try:
        plain_checkpoint(loss_module=loss_module).load(path)
    except CheckpointError as error:
        raise ValueError(
            f"The networks of {path} are not those of this configuration. Leave the keys that "
            "shape them (num_skills, hidden, ...) as they were."
        ) from error
    return path

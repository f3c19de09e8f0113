"""``hmcts data``: record the episodes of an OGBench dataset."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from torchrl_hmcts.trainers.command_line.running import WRONG_WORDS, Failure, printing, told
from torchrl_hmcts.trainers.command_line.words import only_words
from torchrl_hmcts.trainers.experiments.ogbench.config import split_name
from torchrl_hmcts.trainers.runs.config import home, need_package, read_value

_KEYS = ("id", "out", "seed", "episodes", "walker")


def data(words: Sequence[str]) -> int:
    """Record a dataset and write it as memory-mapped tensors; return the exit status."""
    with told("data", *WRONG_WORDS):
        own = only_words(words, _KEYS)
        if "id" not in own:
            raise ValueError("say which dataset: id=NAME, e.g. id=pointmaze-giant-stitch-v0.")
        split_name(own["id"])
        seed, episodes = (read_value(key, own.get(key, "0"), "int") for key in ("seed", "episodes"))
        folder = Path(home(own.get("out", f"data/ogbench/{own['id']}")))
        need_package("ogbench")
    if folder.exists():
        raise Failure(
            f"hmcts data: {folder} exists already; remove it, or name another: out=DIR.", 1
        )
    print(f"hmcts data records {own['id']} in {folder} (minutes)", flush=True)
    with told("data", ValueError, OSError), printing(own.get("log_level", "info")):
        from torchrl_hmcts.trainers.experiments.ogbench.data import record, save
        from torchrl_hmcts.trainers.runs.console import counted

        found = record(
            own["id"],
            seed=seed,
            episodes=episodes,
            walker=own.get("walker", ""),
            progress=counted("record", "episodes"),
        )
        save(found, folder)
        print(f"{len(found):,} steps, {int(found['done'].sum()):,} episodes: {folder}")
    return 0

"""Mazes solved by planning over skills that were never trained, beside trained ones.

    python benchmarks/untrained.py --seeds 0 1 2 --out docs/results/skills/untrained.json

The same networks, starts and search as `hmcts demo`, in the first 20 of its test mazes. "Actions":
no network, an option repeats one action.
"""

from __future__ import annotations

import dataclasses
import time
from typing import Any

from table import markdown, read_arguments, write

from torchrl_hmcts.modules import SkillPolicy
from torchrl_hmcts.trainers.experiments.kits import make_kit
from torchrl_hmcts.trainers.experiments.settings import DemoConfig
from torchrl_hmcts.trainers.experiments.skills import learn, make_loss, solve

COMMAND = "python benchmarks/untrained.py --seeds 0 1 2 --out docs/results/skills/untrained.json"


def measure(seed: int, worker: str, mazes: int) -> dict[str, Any]:
    """Solve the test mazes of a seed with one kind of worker."""
    config = DemoConfig(seed=seed, mazes=mazes)
    if worker == "actions":
        config = dataclasses.replace(config, options="actions")
    kit = make_kit(config)
    acts: Any = kit.given_worker()
    if worker == "untrained":
        acts = SkillPolicy(make_loss(kit).actor_network, deterministic=True)
    elif worker == "trained":
        acts = learn(kit).worker
    begin = time.process_time()
    summary = solve(kit, acts).results.summary()
    seconds = round(time.process_time() - begin, 1)
    return {"worker": worker, "seed": seed, **summary, "cpu_seconds": seconds}


COLUMNS = {
    "worker": lambda row: row["worker"],
    "seed": lambda row: row["seed"],
    "solved": lambda row: f"{row['solved']} of {row['starts']}",
    "simulated base steps, median (95 %)": lambda row: "{median:,.0f} ({p95:,.0f})".format(
        **row["simulated_steps"]
    ),
    "episode, median": lambda row: f"{row['episode_steps']['median']:.0f}",
}


def main() -> None:
    args = read_arguments(__doc__, {"seeds": [0], "mazes": 3}, seeds=[0, 1, 2], mazes=20)
    kinds = ("trained", "actions", "untrained")
    rows: list[dict[str, Any]] = []
    for worker in kinds:
        for seed in args.seeds:
            rows.append(measure(seed, worker, args.mazes))
            print(markdown(rows[-1:], COLUMNS).splitlines()[-1], flush=True)
            write(args, {"command": COMMAND, "rows": rows})
    print(markdown(rows, COLUMNS))


if __name__ == "__main__":
    main()

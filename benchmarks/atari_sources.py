"""Where options come from, compared: every source and guide under the same short planned episode.

    python benchmarks/atari_sources.py --games Breakout Pong --out sources.json

A row is a game, a source and a protocol: the score of one episode of at most ``--real-steps`` base
steps (4 frames each), the frames spent on finding the options and on the episode. Goals are found
once per game and shared by the sources that go on from them. Rows that the file has already are not
run again, so that it can be stopped.
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from torchrl_hmcts.envs import AtariOptionPool
from torchrl_hmcts.trainers import (
    ActionSetSource,
    AtariAgent,
    AtariSearch,
    DIAYNSource,
    DistilledSource,
    FineTunedSource,
    GoalSearch,
    GoalSource,
    Options,
    RepeatSource,
    RetrainedSource,
    SearchGuide,
    WorkerSource,
    load_options,
)
from torchrl_hmcts.trainers.saving.files import write_json

SMALL = GoalSearch(trial_steps=300, trial_ratio=5.0)


@dataclass(frozen=True)
class Known:
    """A source that gives what another has found, anew each time: weights are not shared."""

    options: Options

    def find(self, game: str, make_pool: Any, *, seed: int, log: Any) -> Options:
        known = self.options
        worker = load_options(known.saved)
        return Options(
            worker, known.names, known.num_frames, dict(known.report), known.saved, known.training
        )


def sources(goals: Options, network: Options, steps: int, seed: int) -> dict[str, WorkerSource]:
    """All sources by name; those of goals go on from what was found."""
    return {
        "repeat": RepeatSource(),
        "action_sets": ActionSetSource(SMALL),
        "goals": Known(goals),
        "goals_network": Known(network),
        "goals_fine_tuned": FineTunedSource(Known(network), steps),
        "goals_retrained": RetrainedSource(Known(network)),
        "diayn": DIAYNSource(3, steps),
        "diayn_displacement": DIAYNSource(3, steps, discriminator="displacement"),
        "diayn_controllable": DIAYNSource(3, steps, discriminator="controllable"),
        "diayn_retrained": RetrainedSource(DIAYNSource(3, steps), intrinsic_weight=0.1),
    }


def run_game(game: str, arguments: argparse.Namespace, rows: list[dict[str, Any]]) -> None:
    seed = arguments.seed

    def make_pool(worker: Any, max_steps: int, **kwargs: Any) -> AtariOptionPool:
        return AtariOptionPool(
            game, worker, max_steps=max_steps, num_processes=0, seed=seed, **kwargs
        )

    def play(options: Options, sticky: bool, guide: SearchGuide | None) -> dict[str, Any]:
        pool = make_pool(options.worker, arguments.option_steps)
        real = None
        if sticky:
            real = AtariOptionPool(
                game,
                options.worker,
                max_steps=arguments.option_steps,
                num_processes=0,
                repeat_action_probability=0.25,
                seed=seed + 7_654_321,
            )
        search = AtariSearch(ratio=arguments.ratio)
        agent = AtariAgent(pool, search, play_in=real, guide=guide, seed=seed)
        progress = agent.play(max_steps=arguments.real_steps)
        return {
            "score": progress.score,
            "real_steps": progress.real_steps,
            "ended": progress.done,
            "frames": agent.num_frames,
            "options_taken": progress.options,
        }

    def missing(name: str) -> list[str]:
        done = {(r["game"], r["source"], r["protocol"]) for r in rows}
        return [p for p in ("deterministic", "sticky") if (game, name, p) not in done]

    def record(name: str, options: Options, seconds: float, kind: str = "none") -> None:
        for protocol in missing(name):
            begin = time.process_time()
            values = kind == "prior_value"
            guide = None
            if kind != "none":
                guide = SearchGuide(options.worker.num_options, values=values, seed=seed)
            row = {
                "game": game,
                "source": name,
                "protocol": protocol,
                "seed": seed,
                **play(options, protocol == "sticky", guide),
                "options": options.names,
                "frames_finding_options": options.num_frames,
                "cpu_seconds_finding": round(seconds, 1),
                "cpu_seconds": round(time.process_time() - begin, 1),
            }
            rows.append(row)
            print(row, flush=True)
            save(arguments, rows)

    names = list(sources_of_nothing(arguments))
    if not any(missing(name) for name in names):
        return
    begin = time.process_time()
    quiet = {"seed": seed, "log": print}
    goals = GoalSource(SMALL).find(game, make_pool, **quiet)
    found = time.process_time() - begin
    network = DistilledSource(Known(goals)).find(game, make_pool, **quiet)
    distilled = time.process_time() - begin
    spent = {"goals": found}
    for name, source in sources(goals, network, arguments.base_steps, seed).items():
        if not missing(name):
            continue
        begin = time.process_time()
        options = source.find(game, make_pool, **quiet)
        before = spent.get(name, distilled if name.startswith("goals_") else 0.0)
        record(name, options, before + time.process_time() - begin)
    for kind in ("prior", "prior_value"):
        record(f"goals, guide={kind}", goals, found, kind)


def sources_of_nothing(arguments: argparse.Namespace) -> list[str]:
    nothing = Options(None, [], 0)  # type: ignore[arg-type]
    names = list(sources(nothing, nothing, arguments.base_steps, arguments.seed))
    return [*names, "goals, guide=prior", "goals, guide=prior_value"]


def save(arguments: argparse.Namespace, rows: list[dict[str, Any]]) -> None:
    if arguments.out is not None:
        settings = {
            key: getattr(arguments, key)
            for key in ("seed", "real_steps", "ratio", "option_steps", "base_steps")
        }
        words = " ".join(f"--{k.replace('_', '-')} {v}" for k, v in settings.items())
        games = " ".join(sorted({row["game"] for row in rows}))
        command = f"python benchmarks/atari_sources.py --games {games} {words}"
        arguments.out.parent.mkdir(parents=True, exist_ok=True)
        write_json(arguments.out, {"command": command, **settings, "rows": rows})


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--games", nargs="+", default=["Breakout", "Pong"])
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--real-steps", type=int, default=900)
    parser.add_argument("--ratio", type=float, default=25.0)
    parser.add_argument("--option-steps", type=int, default=10)
    parser.add_argument("--base-steps", type=int, default=20_000, help="of a worker's training")
    parser.add_argument("--out", type=Path)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    rows = []
    if arguments.out is not None and arguments.out.is_file():
        rows = json.loads(arguments.out.read_text())["rows"]
    for game in arguments.games:
        run_game(game, arguments, rows)


if __name__ == "__main__":
    main()

"""Where options come from, compared: every source and guide under the same short planned episode.

    python benchmarks/atari_sources.py --games Breakout Pong --out sources.json

A row is a game, a source and a protocol: the score of one episode of at most ``--real-steps`` base
steps (4 frames each), the frames spent on finding the options and on the episode. Goals are found
once per game and shared by the sources that begin with them. Rows that the file has already are not
run again, so that it can be stopped.
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch

from torchrl_hmcts.trainers import (
    AtariAgent,
    AtariKit,
    AtariSearch,
    Options,
    RuleSource,
    SearchGuide,
    TrainedSource,
)
from torchrl_hmcts.trainers.saving.files import write_json

SETTINGS = ("seed", "real_steps", "ratio", "option_steps", "base_steps")
GUIDES = ("prior", "prior_value")
PROTOCOLS = ("deterministic", "sticky")


@dataclass
class Once:
    """A source that is asked once, and gives copies of what it found: weights are not shared."""

    source: Any
    found: Options | None = None
    seconds: float = 0.0

    def find(self, kit: AtariKit) -> Options:
        if self.found is None:
            begin = time.process_time()
            self.found = self.source.find(kit)
            self.seconds = time.process_time() - begin
        copy = Options.from_plain(self.found.plain())
        return replace(copy, teacher=self.found.teacher, training=self.found.training)


def seconds_spent(source: Any) -> float:
    """What was spent before on a source and those that it begins with."""
    if source is None:
        return 0.0
    return getattr(source, "seconds", 0.0) + seconds_spent(getattr(source, "source", None))


def make_sources(steps: int) -> dict[str, Any]:
    """All sources by name; those of goals share what was found."""
    goals = Once(RuleSource("goals", trial_steps=300, trial_ratio=5.0))
    network = Once(TrainedSource("distilled", goals))
    skills = {"num_skills": 3, "base_steps": steps}
    diayn = TrainedSource("diayn", **skills)
    return {
        "repeat": RuleSource("repeat"),
        "action_sets": RuleSource("action_sets", trial_steps=300, trial_ratio=5.0),
        "goals": goals,
        "goals_network": network,
        "goals_fine_tuned": TrainedSource("fine_tuned", network, base_steps=steps),
        "goals_retrained": TrainedSource("retrained", network),
        "diayn": diayn,
        "diayn_displacement": TrainedSource("diayn", discriminator="displacement", **skills),
        "diayn_controllable": TrainedSource("diayn", discriminator="controllable", **skills),
        "diayn_retrained": TrainedSource("retrained", diayn, intrinsic_weight=0.1),
        **{f"goals, guide={kind}": goals for kind in GUIDES},
    }


def play(
    kit: AtariKit, name: str, options: Options, protocol: str, args: argparse.Namespace
) -> dict[str, Any]:
    kind = name.partition("guide=")[2]
    guide = None
    if kind:
        values = kind == "prior_value"
        guide = SearchGuide(options.worker.num_options, values=values, seed=kit.seed)
    begin = time.process_time()
    steps, sticky = args.option_steps, protocol == "sticky"
    agent = AtariAgent(
        kit.make_pool(options.worker, steps),
        AtariSearch(ratio=args.ratio),
        play_in=kit.make_pool(options.worker, steps, sticky=True) if sticky else None,
        guide=guide,
        seed=kit.seed,
    ).play(max_steps=args.real_steps)
    return {
        "game": kit.game,
        "source": name,
        "protocol": protocol,
        "seed": kit.seed,
        "score": agent.score,
        "real_steps": agent.real_steps,
        "ended": agent.done,
        "frames": agent.num_frames,
        "options_taken": agent.options_taken,
        "options": options.names,
        "frames_finding_options": options.num_frames,
        "cpu_seconds": round(time.process_time() - begin, 1),
    }


def save(args: argparse.Namespace, rows: list[dict[str, Any]]) -> None:
    settings = {key: getattr(args, key) for key in SETTINGS}
    words = " ".join(f"--{k.replace('_', '-')} {v}" for k, v in settings.items())
    games = " ".join(sorted({row["game"] for row in rows}))
    command = f"python benchmarks/atari_sources.py --games {games} {words}"
    args.out.parent.mkdir(parents=True, exist_ok=True)
    write_json(args.out, {"command": command, **settings, "rows": rows})


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--games", nargs="+", default=["Breakout", "Pong"])
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--real-steps", type=int, default=900)
    parser.add_argument("--ratio", type=float, default=25.0)
    parser.add_argument("--option-steps", type=int, default=10)
    parser.add_argument("--base-steps", type=int, default=20_000, help="of a worker's training")
    parser.add_argument("--out", type=Path)
    args = parser.parse_args()
    torch.set_num_threads(1)
    rows = []
    if args.out is not None and args.out.is_file():
        rows = json.loads(args.out.read_text())["rows"]
    for game in args.games:
        kit = AtariKit(game, num_processes=0, seed=args.seed)
        for name, source in make_sources(args.base_steps).items():
            done = {(row["game"], row["source"], row["protocol"]) for row in rows}
            missing = [p for p in PROTOCOLS if (game, name, p) not in done]
            if not missing:
                continue
            before, begin = seconds_spent(source), time.process_time()
            options = source.find(kit)
            seconds = before + time.process_time() - begin
            for protocol in missing:
                row = play(kit, name, options, protocol, args)
                rows.append({**row, "cpu_seconds_finding": round(seconds, 1)})
                print(rows[-1], flush=True)
                if args.out is not None:
                    save(args, rows)


if __name__ == "__main__":
    main()

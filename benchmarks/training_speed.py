r"""Speed of training skills: DIAYNTrainer against a plain-torch loop that does the same work.

    python benchmarks/training_speed.py --seeds 0 1 2 \
        --out docs/results/skills/training_speed.json               (about 4 minutes)
    python benchmarks/training_speed.py --quick

Both lanes: 32 copies of the same Waterworld env, one update of 256 transitions per 64 base steps,
the same networks, losses, learning rates, gradient clipping and logged figures, one thread. They
run in alternating slices of one process, so that a busy machine slows both; a third lane steps the
env alone with random actions. The plain lane is what one writes without any library: modules, a
ring buffer of tensors, autograd, ``torch.optim.Adam``.
"""

from __future__ import annotations

import argparse
import json
import math
import time
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torch.nn import functional as F
from torchrl.envs import EnvBase

from torchrl_hmcts.trainers.diayn import DIAYNTrainer
from torchrl_hmcts.trainers.experiments.kits.waterworld import make_training_env

SKILLS, ACTIONS, COPIES, FRAMES, BATCH, BUFFER = 4, 4, 32, 64, 256, 20_000
GAMMA, ALPHA, TAU, CLIP = 0.95, 0.3, 0.05, 10.0
ACTOR_LR, CRITIC_LR, DISCRIMINATOR_LR = 2e-3, 3e-3, 1e-2


class Heads(nn.Module):
    """Two shared layers and one head per skill."""

    def __init__(self, in_features: int) -> None:
        super().__init__()
        self.trunk = nn.Sequential(
            nn.Linear(in_features, 64), nn.ReLU(), nn.Linear(64, 64), nn.ReLU()
        )
        self.heads = nn.Linear(64, SKILLS * ACTIONS)

    def forward(self, x: Tensor, skill: Tensor) -> Tensor:
        y = self.heads(self.trunk(x)).view(-1, SKILLS, ACTIONS)
        return y.gather(1, skill.view(-1, 1, 1).expand(-1, 1, ACTIONS)).squeeze(1)


class PlainLoop:
    """DIAYN with discrete soft actor-critic, written out."""

    def __init__(self, env: EnvBase, seed: int, updates: int) -> None:
        env.set_seed(seed)
        torch.manual_seed(seed)
        self.env, self.updates = env, updates
        self.actor = Heads(2)
        self.critics = nn.ModuleList([Heads(4), Heads(4)])
        self.targets = nn.ModuleList([Heads(4), Heads(4)])
        self.targets.load_state_dict(self.critics.state_dict())
        self.targets.requires_grad_(False)
        self.discriminator = nn.Linear(2, SKILLS)
        self.optimizer = torch.optim.Adam(
            [
                {"params": list(self.actor.parameters()), "lr": ACTOR_LR},
                {"params": list(self.critics.parameters()), "lr": CRITIC_LR},
                {"params": list(self.discriminator.parameters()), "lr": DISCRIMINATOR_LR},
            ],
            fused=True,
        )
        self.parameters = [p for group in self.optimizer.param_groups for p in group["params"]]
        self.target_pairs = list(
            zip(self.targets.parameters(), self.critics.parameters(), strict=True)
        )
        self.buffer: dict[str, Tensor] = {
            "velocity": torch.empty(BUFFER, 2),
            "displacement": torch.empty(BUFFER, 2),
            "skill": torch.empty(BUFFER, dtype=torch.int64),
            "action": torch.empty(BUFFER, dtype=torch.int64),
            "next_velocity": torch.empty(BUFFER, 2),
            "next_displacement": torch.empty(BUFFER, 2),
            "terminated": torch.empty(BUFFER),
        }
        self.cursor = self.size = 0
        self.history: dict[str, list[float]] = defaultdict(list)
        self.td = env.reset()

    def collect(self) -> None:
        for _ in range(FRAMES // COPIES):
            td = self.td
            with torch.no_grad():
                logits = self.actor(td["velocity"], td["skill"])
                td["action"] = torch.multinomial(logits.softmax(-1), 1).squeeze(-1)
            td, self.td = self.env.step_and_maybe_reset(td)
            self.store(td)

    def store(self, td: TensorDictBase) -> None:
        after = td["next"]
        rows = slice(self.cursor, self.cursor + COPIES)  # BUFFER is a multiple of COPIES
        buffer = self.buffer
        for key in ("velocity", "displacement", "skill", "action"):
            buffer[key][rows] = td[key]
        buffer["next_velocity"][rows] = after["velocity"]
        buffer["next_displacement"][rows] = after["displacement"]
        buffer["terminated"][rows] = after["terminated"].squeeze(-1).float()
        self.cursor = (self.cursor + COPIES) % BUFFER
        self.size = min(self.size + COPIES, BUFFER)

    def update(self) -> dict[str, Tensor]:
        index = torch.randint(self.size, (BATCH,))
        b = {key: value[index] for key, value in self.buffer.items()}
        skill, action = b["skill"], b["action"].unsqueeze(-1)
        features = torch.cat((b["velocity"], b["displacement"]), -1)
        skill_logits = self.discriminator(b["next_displacement"])
        with torch.no_grad():
            log_q = skill_logits.log_softmax(-1).gather(-1, skill.unsqueeze(-1)).squeeze(-1)
            reward = log_q + math.log(SKILLS)
            next_features = torch.cat((b["next_velocity"], b["next_displacement"]), -1)
            next_log_pi = self.actor(b["next_velocity"], skill).log_softmax(-1)
            next_q = torch.minimum(*[target(next_features, skill) for target in self.targets])
            next_v = (next_log_pi.exp() * (next_q - ALPHA * next_log_pi)).sum(-1)
            target_q = reward + GAMMA * (1.0 - b["terminated"]) * next_v
        values = [critic(features, skill) for critic in self.critics]
        critic_losses = [F.mse_loss(q.gather(-1, action).squeeze(-1), target_q) for q in values]
        log_pi = self.actor(b["velocity"], skill).log_softmax(-1)
        q = torch.minimum(*[value.detach() for value in values])
        actor_loss = (log_pi.exp() * (ALPHA * log_pi - q)).sum(-1).mean()
        discriminator_loss = F.cross_entropy(skill_logits, skill)
        loss = actor_loss + critic_losses[0] + critic_losses[1] + discriminator_loss
        self.optimizer.zero_grad()
        loss.backward()
        norm = nn.utils.clip_grad_norm_(self.parameters, CLIP)
        self.optimizer.step()
        with torch.no_grad():
            for target, source in self.target_pairs:
                target.lerp_(source, TAU)
            return {
                "loss_actor": actor_loss,
                "qvalue_loss_0": critic_losses[0],
                "qvalue_loss_1": critic_losses[1],
                "loss_discriminator": discriminator_loss,
                "discriminator_accuracy": (skill_logits.argmax(-1) == skill).float().mean(),
                "entropy": -(log_pi.exp() * log_pi).sum(-1).mean(),
                "grad_norm": norm,
            }

    def run(self, batches: int) -> None:
        for _ in range(batches):
            self.collect()
            for _ in range(self.updates):
                figures = self.update()
            for key, value in figures.items():
                self.history[key].append(value.item())


class EnvAlone:
    """The same env with random actions, for its share in the time."""

    def __init__(self, env: EnvBase, seed: int) -> None:
        env.set_seed(seed)
        self.env, self.td = env, env.reset()

    def run(self, batches: int) -> None:
        for _ in range(batches * FRAMES // COPIES):
            self.td["action"] = torch.randint(ACTIONS, (COPIES,))
            _, self.td = self.env.step_and_maybe_reset(self.td)


class Lanes:
    """A trainer's hook that lets the other lanes run after every slice of batches.

    Times are CPU seconds of this process and wall seconds.
    """

    def __init__(self, slice_batches: int, others: dict[str, Callable[[int], None]]) -> None:
        self.slice_batches, self.others = slice_batches, others
        self.seconds: dict[str, list[tuple[float, float]]] = defaultdict(list)
        self.batches = 0
        self.begin = (time.process_time(), time.perf_counter())

    def measured(self, name: str) -> None:
        now = (time.process_time(), time.perf_counter())
        self.seconds[name].append((now[0] - self.begin[0], now[1] - self.begin[1]))
        self.begin = (time.process_time(), time.perf_counter())

    def __call__(self, batch: TensorDictBase) -> None:
        self.batches += 1
        if self.batches % self.slice_batches:
            return
        self.measured("DIAYNTrainer")
        for name, run in self.others.items():
            run(self.slice_batches)
            self.measured(name)


def measure(seed: int, slices: int, slice_batches: int, updates: int) -> dict[str, Any]:
    """Run all lanes in turns; return figures of one seed, the first slice left out."""
    plain = PlainLoop(make_training_env(copies=COPIES), seed, updates)
    alone = EnvAlone(make_training_env(copies=COPIES), seed)
    env = make_training_env(copies=COPIES)
    loss = DIAYNTrainer.make_loss(env, SKILLS, seed=seed, gamma=GAMMA, alpha_init=ALPHA)
    trainer = DIAYNTrainer(
        env,
        loss,
        total_frames=slices * slice_batches * FRAMES,
        frames_per_batch=FRAMES,
        updates_per_batch=updates,
        batch_size=BATCH,
        buffer_size=BUFFER,
        seed=seed,
    )
    lanes = Lanes(slice_batches, {"plain torch": plain.run, "env alone": alone.run})
    trainer.register_op("post_steps_log", lanes)
    lanes.begin = (time.process_time(), time.perf_counter())
    trainer.train()
    cpu, wall = (
        {name: np.array([s[clock] for s in seconds[1:]]) for name, seconds in lanes.seconds.items()}
        for clock in (0, 1)
    )
    ratio = cpu["plain torch"] / cpu["DIAYNTrainer"]
    steps = slice_batches * FRAMES
    last = max(1, len(plain.history["discriminator_accuracy"]) // 5)
    return {
        "seed": seed,
        "ratio": float(np.median(ratio)),
        "ratio_quartiles": np.percentile(ratio, (25, 75)).tolist(),
        "ratio_wall": float(np.median(wall["plain torch"] / wall["DIAYNTrainer"])),
        "steps_per_second": {name: float(steps / np.median(s)) for name, s in cpu.items()},
        "steps_per_second_wall": {name: float(steps / np.median(s)) for name, s in wall.items()},
        "env_share": {
            name: float(np.median(cpu["env alone"] / cpu[name]))
            for name in ("DIAYNTrainer", "plain torch")
        },
        "final_accuracy": {
            "DIAYNTrainer": float(np.mean(trainer.history["discriminator_accuracy"][-last:])),
            "plain torch": float(np.mean(plain.history["discriminator_accuracy"][-last:])),
        },
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--slices", type=int, default=26)
    parser.add_argument("--slice-batches", type=int, default=25)
    parser.add_argument("--updates", type=int, default=1, help="per 64 base steps")
    parser.add_argument("--quick", action="store_true", help="a tenth of it, to see that it runs")
    parser.add_argument("--out", type=Path)
    args = parser.parse_args()
    torch.set_num_threads(1)
    slices = 5 if args.quick else args.slices
    runs = [measure(seed, slices, args.slice_batches, args.updates) for seed in args.seeds]
    print("| seed | trainer, steps/s | plain, steps/s | ratio (quartiles) | env share | accuracy |")
    print("|---|---|---|---|---|---|")
    for r in runs:
        speed, share, accuracy = r["steps_per_second"], r["env_share"], r["final_accuracy"]
        low, high = r["ratio_quartiles"]
        print(
            f"| {r['seed']} | {speed['DIAYNTrainer']:,.0f} | {speed['plain torch']:,.0f} "
            f"| {r['ratio']:.2f} ({low:.2f} to {high:.2f}) "
            f"| {share['DIAYNTrainer']:.0%}, plain {share['plain torch']:.0%} "
            f"| {accuracy['DIAYNTrainer']:.0%}, plain {accuracy['plain torch']:.0%} |"
        )
    if args.out is not None:
        settings = {
            "copies": COPIES,
            "base_steps_per_batch": FRAMES,
            "updates_per_batch": args.updates,
            "batch_size": BATCH,
            "slices": slices,
            "base_steps_per_slice": args.slice_batches * FRAMES,
            "clock": "CPU seconds of the process, one thread; median over slices",
        }
        args.out.parent.mkdir(parents=True, exist_ok=True)
        args.out.write_text(json.dumps({"settings": settings, "runs": runs}, indent=2) + "\n")
        print(f"Written: {args.out}")


if __name__ == "__main__":
    main()

"""Networks that learn a game's options: skills by DIAYN or METRA, or what rules do.

Letters: Z options, S states. :class:`TrainedSource` tells what the settings are.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchrl_hmcts.envs import OccasionalAction, OptionWorker, SharedMLP
from torchrl_hmcts.modules import SkillEncoder, SkillMLP
from torchrl_hmcts.objectives import METRAEncoderLoss, SkillObjective
from torchrl_hmcts.trainers.diayn import DIAYNTrainer
from torchrl_hmcts.trainers.experiments.atari.kit import AtariKit
from torchrl_hmcts.trainers.experiments.atari.options import Options, Training
from torchrl_hmcts.trainers.experiments.atari.rules import RuleSearch, RuleSource
from torchrl_hmcts.trainers.skills.controllability import random_states
from torchrl_hmcts.transforms import SkillReward

SLOW: dict[str, Any] = {
    "critic_lr": 3e-4,
    "objective_lr": 3e-4,
    "target_tau": 0.01,
}  # than in a maze
_DISCRIMINATORS = ("state", "displacement", "controllable")
_METRA_SCALE = 3.0  # of its reward, whose steps have at most length 1


def learn_skills(
    kit: AtariKit,
    *,
    num_skills: int = 3,
    base_steps: int = 40_000,
    skill_steps: int = 40,
    discriminator: str = "state",
    objective: str = "diayn",
    game_weight: float = 0.0,
    fire: float = 0.0,
    num_envs: int = 8,
    hidden: Sequence[int] = (128, 128, 128),
) -> Options:
    """Learn skills by DIAYN or METRA on the RAM."""
    if objective not in ("diayn", "metra"):
        raise ValueError(f"objective is 'diayn' or 'metra'; got {objective!r}.")
    if discriminator not in _DISCRIMINATORS:
        raise ValueError(f"discriminator is one of {_DISCRIMINATORS}; got {discriminator!r}.")
    report: dict[str, Any] = {}
    num_frames = 0
    bytes_seen = None if discriminator == "state" else list(range(128))
    if discriminator == "controllable":
        search = RuleSearch(RuleSource("goals"), kit)
        probed: dict[str, Any] = {}
        search.probe(probed)
        num_frames += search.num_frames
        report["controllable"] = bytes_seen = probed["controllable"]
        if not bytes_seen:
            raise ValueError(
                f"No byte of {kit.game} was found that actions raise and lower, so the "
                "discriminator has no input. Use discriminator='displacement'."
            )
    env, count = kit.make_training_env(
        num_skills,
        option_steps=skill_steps,
        num_envs=num_envs,
        bytes_seen=bytes_seen,
        clip_reward=True,
    )
    encoded: SkillObjective | None = None
    if objective == "metra":
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(kit.seed)
            encoded = METRAEncoderLoss(SkillEncoder(128, num_skills, in_keys=["observation"]))
    loss = DIAYNTrainer.make_loss(
        env,
        num_skills,
        objective=encoded,
        in_keys=["observation"],
        critic_keys=["observation"],
        discriminator_keys=["observation" if bytes_seen is None else "displacement"],
        hidden=hidden,
        discriminator_hidden=(128,),
        alpha_init=0.1,
        gamma=0.97,
        seed=kit.seed,
    )
    names = kit.action_names
    student = SharedMLP(num_skills, len(names), hidden=hidden)
    worker: OptionWorker = student
    if fire and "FIRE" in names:
        worker = OccasionalAction(student, names.index("FIRE"), fire)

    def show() -> None:
        student.load(loss.actor_network_params.parameters())
        if kit.curve is not None:
            kit.curve(worker, trainer.collected_frames, num_frames + count())

    trainer = DIAYNTrainer(
        env,
        loss,
        total_frames=base_steps,
        updates_per_batch=8,
        actor_lr=3e-4,
        **SLOW,
        reward=SkillReward(
            loss.objective,
            intrinsic_coeff=1.0 if encoded is None else _METRA_SCALE,
            extrinsic_coeff=game_weight,
        ),
        seed=kit.seed,
    )
    if kit.curve is not None:
        show()
        trainer.register_op("post_steps", show)
    trainer.train()
    show()
    last = {name: values[-20:] for name, values in trainer.history.items() if len(values)}
    report["last"] = means = {name: sum(values) / len(values) for name, values in last.items()}
    kit.log(f"{objective}: accuracy {means.get('discriminator_accuracy', float('nan')):.2f}")
    data = trainer.replay_buffer.storage.get(slice(None))
    return Options(
        worker,
        [f"skill {z}" for z in range(num_skills)],
        num_frames + count(),
        report,
        training=Training(loss, data, bytes_seen, trainer.collected_frames),
    )


def distil(
    found: Options,
    kit: AtariKit,
    *,
    samples: int = 20_000,
    epochs: int = 8,
    hidden: Sequence[int] = (128, 128, 128),
    batch_size: int = 256,
    lr: float = 1e-3,
) -> Options:
    """Teach options to one network with a head for each, in the states of both (DAgger)."""
    teacher, num_options, names = found.worker, found.worker.num_options, kit.action_names
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(kit.seed)
        network = SkillMLP(128, len(names), num_options, hidden=tuple(hidden))
    student = SharedMLP(num_options, len(names), hidden=hidden)
    worker: OptionWorker = student
    if "FIRE" in names:
        worker = OccasionalAction(student, names.index("FIRE"), 0.05)
    optimizer = torch.optim.Adam(network.parameters(), lr=lr)
    generator = torch.Generator().manual_seed(kit.seed)
    states: list[Tensor] = []
    labels: list[Tensor] = []
    num_frames, agreement = found.num_frames, 0.0
    players: tuple[OptionWorker, ...] = (teacher, worker)
    for number, player in enumerate(players):
        pool = kit.make_pool(player, 10)
        ram = random_states(pool, samples // num_options, kit.seed + number)["ram"]
        num_frames += pool.num_frames
        pool.close()
        states.append(ram / 255.0)
        labels.append(_labels(ram, teacher, kit.seed))
        data = torch.cat(states), torch.cat(labels)
        for _ in range(epochs):
            agreement = _fit(network, optimizer, *data, batch_size, generator)
        student.load(network.parameters())
        kit.log(f"distilled: {agreement:.1%} of {data[1].numel():,} labels")
    report = {**found.report, "distilled_agreement": agreement}
    return Options(worker, found.names, num_frames, report, teacher=teacher)


def _fit(
    network: SkillMLP,
    optimizer: torch.optim.Optimizer,
    states: Tensor,
    labels: Tensor,
    batch_size: int,
    generator: torch.Generator,
) -> float:
    """Pass once over the labels ``[S, Z]`` of states ``[S, 128]``; return the share learned."""
    num_options, right = labels.shape[1], 0
    for rows in torch.randperm(labels.numel(), generator=generator).split(batch_size):
        at, options = rows // num_options, rows % num_options
        logits, targets = network(states[at], options), labels[at, options]
        optimizer.zero_grad()
        torch.nn.functional.cross_entropy(logits, targets).backward()
        optimizer.step()
        right += int((logits.argmax(-1) == targets).sum())
    return right / labels.numel()


def _labels(ram: Tensor, teacher: OptionWorker, seed: int) -> Tensor:
    """Return what a worker does in states ``[S, 128]``, for each of its options ``[S, Z]``."""
    generator = np.random.default_rng(seed)
    options = range(teacher.num_options)
    return torch.tensor([[teacher.act(row, z, generator) for z in options] for row in ram.numpy()])

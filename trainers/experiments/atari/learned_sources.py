"""Options that are learned: DIAYN skills, and a network that imitates other options.

Letters: Z options, A actions, S states.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torchrl.envs import Compose, SerialEnv, SignTransform, TransformedEnv, UnaryTransform

from torchrl_hmcts.envs import (
    AtariRAMEnv,
    OccasionalAction,
    OptionWorker,
    RepeatActions,
    SharedMLP,
)
from torchrl_hmcts.modules import SkillMLP
from torchrl_hmcts.trainers.diayn import DIAYNTrainer
from torchrl_hmcts.trainers.experiments.atari.goals import GoalFinder, GoalSearch, random_states
from torchrl_hmcts.trainers.experiments.atari.options import (
    MakePool,
    Options,
    Training,
    WorkerSource,
    plain_worker,
)
from torchrl_hmcts.transforms import DisplacementTransform, SkillTransform


@dataclass(frozen=True)
class DIAYNSource:
    r"""Skills learned by DIAYN on the RAM, before the manager plans: the source's worker.

    The actor is 128 - 3 x 128 - A with ReLU and a softmax, a head for each skill.

    Attributes:
        num_skills: Z (the source's N_policies).
        base_steps: of training.
        skill_steps: base steps of a mini-episode.
        discriminator: ``"state"`` tells skills by the RAM, ``"displacement"`` by how it changed
            since the option began, ``"controllable"`` by how its controllable bytes did.
        num_envs: emulators that play at a time.
        hidden: widths of the shared layers.

    Raises:
        ValueError: if the discriminator is unknown.

    Reference:
        Eysenbach et al., "Diversity is All You Need", 2018, arXiv 1802.06070; dissertation, ch. 5.

    Example:
        >>> from torchrl_hmcts.trainers import DIAYNSource
        >>> DIAYNSource(num_skills=5, discriminator="displacement").skill_steps
        40
    """

    num_skills: int = 3
    base_steps: int = 40_000
    skill_steps: int = 40
    discriminator: str = "state"
    num_envs: int = 8
    hidden: Sequence[int] = (128, 128, 128)

    def __post_init__(self) -> None:
        if self.discriminator not in ("state", "displacement", "controllable"):
            raise ValueError(
                f"DIAYNSource's discriminator reads 'state', 'displacement' or 'controllable'; got "
                f"{self.discriminator!r}."
            )

    def find(
        self, game: str, make_pool: MakePool, *, seed: int, log: Callable[[str], None]
    ) -> Options:
        """Return the options of a game."""
        report: dict[str, Any] = {}
        frames = 0
        seen = "observation" if self.discriminator == "state" else "displacement"
        bytes_seen = list(range(128))
        if self.discriminator == "controllable":
            finder = GoalFinder(make_pool, GoalSearch(), seed=seed)
            finder.probe()
            frames += finder.num_frames
            report["controllable"] = bytes_seen = finder.report["controllable"]
            if not bytes_seen:
                raise ValueError(
                    f"No byte of {game} was found that actions raise and lower, so that the "
                    f"discriminator has nothing to see. Use discriminator='displacement'."
                )
        displaced = None if self.discriminator == "state" else bytes_seen
        env = make_skill_env(
            game,
            self.num_skills,
            skill_steps=self.skill_steps,
            num_envs=self.num_envs,
            bytes_seen=displaced,
            seed=seed,
        )
        loss = DIAYNTrainer.make_loss(
            env,
            self.num_skills,
            in_keys=["observation"],
            critic_keys=["observation"],
            discriminator_keys=[seen],
            hidden=self.hidden,
            discriminator_hidden=(128,),
            alpha_init=0.1,
            gamma=0.97,
            seed=seed,
        )
        trainer = DIAYNTrainer(
            env,
            loss,
            total_frames=self.base_steps,
            frames_per_batch=64,
            updates_per_batch=8,
            actor_lr=3e-4,
            critic_lr=3e-4,
            objective_lr=3e-4,
            target_tau=0.01,
            seed=seed,
        )
        trainer.train()
        history = {k: v[-20:] for k, v in trainer.history.items() if len(v)}
        report["last"] = {k: sum(v) / len(v) for k, v in history.items()}
        log(f"DIAYN: accuracy {report['last'].get('discriminator_accuracy', float('nan')):.2f}")
        frames += 4 * self.base_steps
        network = next(m for m in loss.actor_network.modules() if isinstance(m, SkillMLP))
        loss.actor_network_params.to_module(loss.actor_network)
        worker = SharedMLP(self.num_skills, env.action_spec.space.n, hidden=self.hidden)
        worker.load(network.parameters())
        names = [f"skill {z}" for z in range(self.num_skills)]
        training = Training(loss, trainer.replay_buffer.storage.get(slice(None)), displaced)
        return Options(worker, names, frames, report, {"parts": [plain_worker(worker)]}, training)


def make_skill_env(
    game: str,
    num_skills: int,
    *,
    skill_steps: int,
    num_envs: int = 8,
    bytes_seen: Sequence[int] | None = None,
    clip_reward: bool = False,
    seed: int = 0,
) -> TransformedEnv:
    """Make deterministic emulators in which a worker learns skills, or options, of its own.

    Args:
        game: e.g. ``"Breakout"``.
        num_skills: Z.
        skill_steps: base steps for which a skill is kept.
        num_envs: emulators that play at a time.
        bytes_seen: of which ``"displacement"`` since the skill began is written; None: not written.
        clip_reward: whether the game's reward is replaced by its sign.
        seed: of the starts and of the skills.
    """

    def one() -> AtariRAMEnv:
        return AtariRAMEnv(game, repeat_action_probability=0.0, seed=seed)

    parts: list[Any] = [SkillTransform(num_skills, max_skill_steps=skill_steps)]
    if clip_reward:
        parts.append(SignTransform(in_keys=["reward"]))
    if bytes_seen is not None:
        indices = list(bytes_seen)
        parts.append(UnaryTransform(["observation"], ["seen"], fn=lambda x: x[..., indices]))
        parts.append(DisplacementTransform("seen"))
    return TransformedEnv(SerialEnv(num_envs, one), Compose(*parts))


def network_of(worker: OptionWorker) -> SharedMLP:
    """Return the network that carries a worker's options out.

    Args:
        worker: a network, or one whose options an :class:`OccasionalAction` interrupts.

    Raises:
        TypeError: if there is none.

    Example:
        >>> from torchrl_hmcts.envs import OccasionalAction, SharedMLP
        >>> network_of(OccasionalAction(SharedMLP(2, 4), action=1)).num_options
        2
    """
    inner = worker.worker if isinstance(worker, OccasionalAction) else worker
    if not isinstance(inner, SharedMLP):
        raise TypeError(
            f"Only a network can be trained further; these options are carried out by "
            f"{type(inner).__name__}. Wrap their source: DistilledSource(source)."
        )
    return inner


@dataclass(frozen=True)
class DistilledSource:
    r"""Another source's options, learned by one network with a head for each.

    .. math:: \min_\theta\; -\mathbb{E}_{s, z}\, \log \pi_\theta\bigl(\mu_z(s) \mid s, z\bigr)

    with :math:`\mu_z` the option's own worker, in states on the way of random options of that
    worker, and in a second round of the network itself, labelled by the worker (DAgger). The
    network samples its actions, so that it keeps some noise.

    Attributes:
        source: whose options are learned.
        samples: labelled states of each round.
        epochs: passes over all of them in each round.
        hidden: widths of the shared layers.
        batch_size, lr: of Adam.
        fire_probability: how often FIRE is taken whatever the option, in games that have it.

    Reference:
        Ross, Gordon and Bagnell, "A reduction of imitation learning and structured prediction to
        no-regret online learning", 2011, arXiv 1011.0686.

    Example:
        >>> from torchrl_hmcts.trainers import DistilledSource, GoalSource
        >>> DistilledSource(GoalSource(), samples=5_000).hidden
        (128, 128, 128)
    """

    source: WorkerSource
    samples: int = 20_000
    epochs: int = 8
    hidden: Sequence[int] = (128, 128, 128)
    batch_size: int = 256
    lr: float = 1e-3
    fire_probability: float = 0.05

    def find(
        self, game: str, make_pool: MakePool, *, seed: int, log: Callable[[str], None]
    ) -> Options:
        """Return the options of a game."""
        found = self.source.find(game, make_pool, seed=seed, log=log)
        teacher, num_options = found.worker, found.worker.num_options
        pool = make_pool(RepeatActions(1), 1)
        names = list(pool.action_names)
        pool.close()
        num_actions = len(names)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            network = SkillMLP(128, num_actions, num_options, hidden=tuple(self.hidden))
        student = SharedMLP(num_options, num_actions, hidden=self.hidden)
        worker: OptionWorker = student
        if self.fire_probability and "FIRE" in names:
            worker = OccasionalAction(student, names.index("FIRE"), self.fire_probability)
        optimizer = torch.optim.Adam(network.parameters(), lr=self.lr)
        generator = torch.Generator().manual_seed(seed)
        seen: list[tuple[torch.Tensor, torch.Tensor]] = []
        frames, agreement = found.num_frames, 0.0
        players: tuple[OptionWorker, ...] = (teacher, worker)
        for player in players:
            pool = make_pool(player, 10)
            states = random_states(pool, self.samples // num_options, seed + len(seen))
            frames += pool.num_frames
            pool.close()
            seen.append(_labelled(states["ram"], teacher, seed))
            ram, labels = (torch.cat(parts) for parts in zip(*seen, strict=True))
            agreement = self._fit(network, optimizer, ram, labels, generator)
            student.load(network.parameters())
            log(f"distilled: {agreement:.1%} of {labels.numel():,} labels")
        report = {**found.report, "distilled_agreement": agreement}
        saved = {"parts": [plain_worker(worker)], "teacher": [plain_worker(teacher)]}
        return Options(worker, found.names, frames, report, saved)

    def _fit(
        self,
        network: SkillMLP,
        optimizer: torch.optim.Optimizer,
        ram: torch.Tensor,
        labels: torch.Tensor,
        generator: torch.Generator,
    ) -> float:
        """Learn labels ``[S, Z]`` of states ``[S, 128]``; return the share that is right."""
        count, num_options = labels.shape
        right = 0
        for epoch in range(self.epochs):
            order = torch.randperm(count * num_options, generator=generator)
            for rows in order.split(self.batch_size):
                states, options = rows // num_options, rows % num_options
                logits = network(ram[states] / 255.0, options)
                targets = labels[states, options]
                loss = torch.nn.functional.cross_entropy(logits, targets)
                optimizer.zero_grad()
                loss.backward()
                optimizer.step()
                if epoch == self.epochs - 1:
                    right += int((logits.argmax(-1) == targets).sum())
        return right / (count * num_options)


def _labelled(
    ram: torch.Tensor, teacher: OptionWorker, seed: int
) -> tuple[torch.Tensor, torch.Tensor]:
    """What a worker does in states ``[S, 128]``, for each of its options ``[S, Z]``."""
    generator = np.random.default_rng(seed)
    rows = ram.numpy()
    labels = [[teacher.act(row, z, generator) for z in range(teacher.num_options)] for row in rows]
    return ram, torch.tensor(labels)

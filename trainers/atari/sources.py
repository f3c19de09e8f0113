"""Where the agent's options come from; each an object that swaps in.

Letters: Z options, A actions.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any, Protocol

import numpy as np
import torch
from torchrl.envs import Compose, SerialEnv, TransformedEnv, UnaryTransform

from torchrl_hmcts.envs import (
    AtariOptionPool,
    AtariRAMEnv,
    ByteGoal,
    FollowGoals,
    JoinedWorkers,
    OptionWorker,
    RepeatActions,
    SharedMLP,
)
from torchrl_hmcts.modules import SkillMLP
from torchrl_hmcts.trainers.atari.agent import AtariSearch
from torchrl_hmcts.trainers.atari.goals import (
    Candidate,
    GoalFinder,
    GoalSearch,
    random_states,
    repeat_candidates,
)
from torchrl_hmcts.trainers.diayn import DIAYNTrainer
from torchrl_hmcts.transforms import DisplacementTransform, SkillTransform

MakePool = Callable[[OptionWorker, int], AtariOptionPool]


@dataclass
class Options:
    """The options a source has found.

    Attributes:
        worker: carries them out.
        names: one for each.
        num_frames: frames emulated to find them.
        report: what was found on the way, as plain data.
        saved: from which :func:`load_options` builds the worker again: plain data and tensors.
    """

    worker: OptionWorker
    names: list[str]
    num_frames: int
    report: dict[str, Any] = field(default_factory=dict)
    saved: dict[str, Any] = field(default_factory=dict)


class WorkerSource(Protocol):
    """What gives a game its options: ``find(game, make_pool, seed=..., log=...)``."""

    def find(
        self, game: str, make_pool: MakePool, *, seed: int, log: Callable[[str], None]
    ) -> Options:
        """Return the options of a game."""
        ...


@dataclass(frozen=True)
class RepeatSource:
    """An option for each of the game's actions: to repeat it. Nothing is learned.

    Example:
        >>> from torchrl_hmcts.envs import AtariOptionPool
        >>> from torchrl_hmcts.trainers import RepeatSource
        >>> def make_pool(worker, max_steps):
        ...     return AtariOptionPool("Pong", worker, max_steps=max_steps, num_processes=0)
        >>> RepeatSource().find("Pong", make_pool, seed=0, log=print).names[:3]
        ['NOOP', 'FIRE', 'RIGHT']
    """

    def find(
        self, game: str, make_pool: MakePool, *, seed: int, log: Callable[[str], None]
    ) -> Options:
        """Return the options of a game."""
        pool = make_pool(RepeatActions(1), 1)
        names, frames = list(pool.action_names), pool.num_frames
        pool.close()
        worker = RepeatActions(len(names))
        return Options(worker, names, frames, saved={"parts": [_plain(worker)]})


@dataclass(frozen=True)
class ActionSource:
    """Actions to repeat, chosen by trials: with fewer options a search looks further ahead.

    Attributes:
        settings: how much to try; what it says of goals and screening is not used.
        search: the planner of the trials.

    Example:
        >>> from torchrl_hmcts.envs import AtariOptionPool
        >>> from torchrl_hmcts.trainers import ActionSource, GoalSearch
        >>> def make_pool(worker, max_steps):
        ...     return AtariOptionPool("Pong", worker, max_steps=max_steps, num_processes=0)
        >>> small = GoalSearch(min_options=1, options=1, trial_steps=4, trial_ratio=1.0)
        >>> len(ActionSource(small).find("Pong", make_pool, seed=0, log=lambda text: None).names)
        1
    """

    settings: GoalSearch = field(default_factory=GoalSearch)
    search: AtariSearch = field(default_factory=AtariSearch)

    def find(
        self, game: str, make_pool: MakePool, *, seed: int, log: Callable[[str], None]
    ) -> Options:
        """Return the options of a game."""
        finder = GoalFinder(make_pool, self.settings, search=self.search, seed=seed, log=log)
        pool = make_pool(RepeatActions(1), 1)
        candidates = repeat_candidates(pool)
        finder.num_frames += pool.num_frames
        pool.close()
        return _joined(finder.choose(candidates), finder.num_frames, finder.report)


@dataclass(frozen=True)
class GoalSource:
    """Goals on controllable bytes and actions to repeat, chosen by trials: :class:`GoalFinder`.

    Attributes:
        settings: how much to try.
        search: the planner of the trials.
    """

    settings: GoalSearch = field(default_factory=GoalSearch)
    search: AtariSearch = field(default_factory=AtariSearch)

    def find(
        self, game: str, make_pool: MakePool, *, seed: int, log: Callable[[str], None]
    ) -> Options:
        """Return the options of a game."""
        finder = GoalFinder(make_pool, self.settings, search=self.search, seed=seed, log=log)
        chosen = finder.find()
        return _joined(chosen, finder.num_frames, finder.report)


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
        env = self._env(game, bytes_seen, seed)
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
        return Options(worker, names, frames, report, {"parts": [_plain(worker)]})

    def _env(self, game: str, bytes_seen: Sequence[int], seed: int) -> TransformedEnv:
        def one() -> AtariRAMEnv:
            return AtariRAMEnv(game, repeat_action_probability=0.0, seed=seed)

        env = SerialEnv(self.num_envs, one)
        parts: list[Any] = [SkillTransform(self.num_skills, max_skill_steps=self.skill_steps)]
        if self.discriminator != "state":
            indices = list(bytes_seen)
            parts.append(UnaryTransform(["observation"], ["seen"], fn=lambda x: x[..., indices]))
            parts.append(DisplacementTransform("seen"))
        return TransformedEnv(env, Compose(*parts))


def _joined(chosen: Sequence[Candidate], frames: int, report: dict[str, Any]) -> Options:
    workers = [c.worker for c in chosen]
    saved = {"parts": [_plain(w) for w in workers]}
    return Options(JoinedWorkers(workers), [c.name for c in chosen], frames, report, saved)


def _plain(worker: Any) -> dict[str, Any]:
    """A worker as plain data and tensors."""
    if isinstance(worker, RepeatActions):
        return {"kind": "repeat", "actions": list(worker.actions)}
    if isinstance(worker, FollowGoals):
        goals = [asdict(goal) for goal in worker.goals]
        return {
            "kind": "goals",
            "goals": goals,
            "fire": worker.fire,
            "fire_probability": worker.fire_probability,
        }
    if isinstance(worker, SharedMLP):
        return {
            "kind": "network",
            "num_options": worker.num_options,
            "num_actions": worker.num_actions,
            "hidden": list(worker.sizes[1:]),
            "weights": worker.weights.clone(),
        }
    raise TypeError(f"{type(worker).__name__} cannot be saved as plain data.")


def load_options(saved: dict[str, Any]) -> OptionWorker:
    """Build a worker from what an :class:`Options` keeps in ``saved``.

    Args:
        saved: plain data and tensors.

    Raises:
        ValueError: if a part is of no known kind.

    Example:
        >>> from torchrl_hmcts.trainers import load_options
        >>> load_options({"parts": [{"kind": "repeat", "actions": [0, 3]}]}).num_options
        2
    """
    workers: list[Any] = []
    for part in saved["parts"]:
        if part["kind"] == "repeat":
            workers.append(RepeatActions(part["actions"]))
        elif part["kind"] == "goals":
            goals = [ByteGoal(**goal) for goal in part["goals"]]
            workers.append(
                FollowGoals(goals, fire=part["fire"], fire_probability=part["fire_probability"])
            )
        elif part["kind"] == "network":
            worker = SharedMLP(part["num_options"], part["num_actions"], hidden=part["hidden"])
            worker.weights.copy_(part["weights"])
            workers.append(worker)
        else:
            raise ValueError(f"Options of the kind {part['kind']!r} are not known.")
    return workers[0] if len(workers) == 1 else JoinedWorkers(workers)


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

    Reference:
        Ross, Gordon and Bagnell, "A reduction of imitation learning and structured prediction to
        no-regret online learning", 2011, arXiv 1011.0686.
    """

    source: WorkerSource
    samples: int = 20_000
    epochs: int = 8
    hidden: Sequence[int] = (128, 128, 128)
    batch_size: int = 256
    lr: float = 1e-3

    def find(
        self, game: str, make_pool: MakePool, *, seed: int, log: Callable[[str], None]
    ) -> Options:
        """Return the options of a game."""
        found = self.source.find(game, make_pool, seed=seed, log=log)
        teacher, num_options = found.worker, found.worker.num_options
        pool = make_pool(RepeatActions(1), 1)
        num_actions = len(pool.action_names)
        pool.close()
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            network = SkillMLP(128, num_actions, num_options, hidden=tuple(self.hidden))
        student = SharedMLP(num_options, num_actions, hidden=self.hidden)
        optimizer = torch.optim.Adam(network.parameters(), lr=self.lr)
        generator = torch.Generator().manual_seed(seed)
        seen: list[tuple[torch.Tensor, torch.Tensor]] = []
        frames, agreement = found.num_frames, 0.0
        players: tuple[OptionWorker, ...] = (teacher, student)
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
        return Options(student, found.names, frames, report, {"parts": [_plain(student)]})

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

"""Network workers that are trained further: on their goals, on the game, on what searches found.

Letters: Z options, B transitions, n recorded options, T base steps of an option.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor
from torchrl.data import LazyTensorStorage, ReplayBuffer
from torchrl.objectives import SoftUpdate

from torchrl_hmcts.arguments import name_arguments
from torchrl_hmcts.envs import (
    ByteGoal,
    FollowGoals,
    JoinedWorkers,
    OptionWorker,
    RepeatActions,
)
from torchrl_hmcts.modules import SkillMLP
from torchrl_hmcts.objectives import DiscreteSkillSACLoss, SkillObjective
from torchrl_hmcts.trainers.diayn import DIAYNTrainer, make_skill_optimizer
from torchrl_hmcts.trainers.experiments.atari.agent import AtariAgent, AtariSearch
from torchrl_hmcts.trainers.experiments.atari.learned_sources import make_skill_env, network_of
from torchrl_hmcts.trainers.experiments.atari.options import (
    MakePool,
    Options,
    Training,
    WorkerSource,
    load_options,
    plain_worker,
)
from torchrl_hmcts.transforms import SkillReward


@name_arguments
class OptionGoals(SkillObjective):
    r"""Rewards an option for doing what it is for. Nothing is learned.

    .. math:: r(s, z, a, s') = \begin{cases}
        \max(0,\; 1 - |x'_c - x'_b - o| / \kappa) & \text{z brings byte c to byte b plus o} \\
        [a = a_z] & \text{z repeats an action} \end{cases}

    Args:
        goals (sequence of ByteGoal or int): what each option is for: a goal, or the action to
            repeat.
        scale (float): :math:`\kappa`, the distance at which the reward is 0. Default 30.

    Raises:
        ValueError: if there are no goals or ``scale`` is not positive.

    Keys (``set_keys``): those of :class:`SkillObjective`; ``"action"`` (int64 ``[B]``) and
    ``("next", "observation")`` (RAM / 255, float32 ``[B, 128]``) are read, too.

    Reference:
        This project's; goals as in chapter 3 of the dissertation.

    Example:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_hmcts.envs import ByteGoal
        >>> from torchrl_hmcts.trainers import OptionGoals
        >>> goals = OptionGoals([ByteGoal(72, 99, offset=10, raising=2, lowering=3), 1])
        >>> ram = torch.zeros(2, 128)
        >>> ram[:, 99], ram[:, 72] = 100, 95  # 15 below 100 + 10
        >>> td = TensorDict(skill=torch.tensor([0, 1]), action=torch.tensor([2, 1]),
        ...                 next=TensorDict(observation=ram / 255, batch_size=[2]), batch_size=[2])
        >>> goals.reward(td).flatten().tolist()
        [0.5, 1.0]
    """

    root_features = ["action"]
    next_features = ["observation"]
    out_keys: list[str] = []

    def __init__(self, goals: Sequence[ByteGoal | int], *, scale: float = 30.0) -> None:
        if not goals:
            raise ValueError("OptionGoals needs a goal for each option; got none.")
        if not scale > 0.0:
            raise ValueError(f"OptionGoals needs scale > 0; got {scale}.")
        super().__init__(len(goals))
        self.scale = float(scale)
        rows = [
            (g.controlled, g.target, g.offset, -1) if isinstance(g, ByteGoal) else (0, 0, 0, g)
            for g in goals
        ]
        self.register_buffer("rows", torch.tensor(rows))

    rows: Tensor

    def losses(self, tensordict: TensorDictBase) -> dict[str, Tensor]:
        """Returns nothing: there is nothing to learn."""
        return {}

    @torch.no_grad()
    def reward(self, tensordict: TensorDictBase) -> Tensor:
        """Returns the reward ``[B, 1]``, between 0 and 1."""
        row = self.rows[tensordict.get(self.tensor_keys.skill)]  # [B, 4]
        ram = tensordict.get(("next", "observation")) * 255.0
        at = ram.gather(-1, row[..., :2])
        missing = (at[..., 0] - at[..., 1] - row[..., 2]).abs()
        near = (1.0 - missing / self.scale).clamp_min(0.0)
        action = tensordict.get("action")
        repeated = (action == row[..., 3]).to(near.dtype)
        return torch.where(row[..., 3] < 0, near, repeated).unsqueeze(-1)


def goals_of(worker: OptionWorker) -> list[ByteGoal | int]:
    """Return what each option of a rule worker is for: a goal, or the action it repeats.

    Args:
        worker: goals, repeated actions, or both joined.

    Raises:
        TypeError: if it is of another kind.

    Example:
        >>> from torchrl_hmcts.envs import RepeatActions
        >>> goals_of(RepeatActions([0, 3]))
        [0, 3]
    """
    if isinstance(worker, JoinedWorkers):
        return [goal for part in worker.workers for goal in goals_of(part)]
    if isinstance(worker, FollowGoals):
        return list(worker.goals)
    if isinstance(worker, RepeatActions):
        return list(worker.actions)
    raise TypeError(
        f"What the options of a {type(worker).__name__} are for is not known. Goals and repeated "
        f"actions have it: use GoalSource, RepeatSource or ActionSource under DistilledSource."
    )


def make_goal_training(found: Options, game: str, seed: int, **loss_kwargs: Any) -> Training:
    """Build critics and goals for a distilled network; its actor starts as that network.

    Args:
        found: of a :class:`DistilledSource`.
        game: whose options they are.
        seed: of the critics' initial weights.
        **loss_kwargs: passed to :class:`DiscreteSkillSACLoss`.

    Raises:
        TypeError: if there is no network, or nobody knows what its options are for.
    """
    network = network_of(found.worker)
    if "teacher" not in found.saved:
        raise TypeError(
            "What these options are for is not known. Wrap goals or actions to repeat: "
            "DistilledSource(GoalSource())."
        )
    goals = goals_of(load_options({"parts": found.saved["teacher"]}))
    hidden = tuple(network.sizes[1:])
    distilled = SkillMLP(128, network.num_actions, network.num_options, hidden=hidden)
    distilled.requires_grad_(False)
    network.store(list(distilled.parameters()))
    env = make_skill_env(game, network.num_options, skill_steps=1, num_envs=1, seed=seed)
    loss = DIAYNTrainer.make_loss(
        env,
        network.num_options,
        objective=OptionGoals(goals),
        in_keys=["observation"],
        critic_keys=["observation"],
        hidden=hidden,
        policy_prior=TensorDictModule(distilled, ["observation", "skill"], ["logits"]),
        seed=seed,
        **loss_kwargs,
    )
    env.close(raise_if_closed=False)
    network.store(_actor_parameters(loss))
    return Training(loss, TensorDict(batch_size=[0]))


@dataclass(frozen=True)
class FineTunedSource:
    r"""A network worker, trained further by soft actor-critic on its goals and on the game.

    .. math:: r = c_g\, r_{goal}(s, z, a, s') + c_e\, \mathrm{sign}(r_{game})

    with the goals' reward of :class:`OptionGoals`. The actor begins as the network that imitates
    the rules, the critics learn alone first, and the policy is kept near where it began
    (``policy_prior`` of :class:`~torchrl_hmcts.objectives.DiscreteSkillSACLoss`): critics of a
    policy that hardly varies know little of other actions, and would spoil it.

    Attributes:
        source: gives the network, e.g. ``DistilledSource(GoalSource())``.
        base_steps: of training in all.
        warm_up: share of them in which only the critics learn.
        skill_steps: base steps for which an option is kept.
        goal_weight, game_weight: :math:`c_g`, :math:`c_e`.
        lr, critic_lr: Adam's learning rates of the actor and of the critics.
        alpha: weight of the divergence from the network at the start, fixed.
        gamma: discount per base step.
        num_envs: emulators that play at a time.
        updates_per_batch: updates for every 64 base steps.

    Raises:
        ValueError: if a number is out of range.

    Reference:
        Christodoulou, "Soft Actor-Critic for Discrete Action Settings", 2019, arXiv 1910.07207; the
        use is this project's.

    Example:
        >>> from torchrl_hmcts.trainers import DistilledSource, FineTunedSource, RepeatSource
        >>> FineTunedSource(DistilledSource(RepeatSource()), base_steps=2_000).warm_up
        0.25
    """

    source: WorkerSource
    base_steps: int = 20_000
    warm_up: float = 0.25
    skill_steps: int = 40
    goal_weight: float = 1.0
    game_weight: float = 1.0
    lr: float = 1e-4
    critic_lr: float = 3e-4
    alpha: float = 0.1
    gamma: float = 0.9
    num_envs: int = 8
    updates_per_batch: int = 16

    def __post_init__(self) -> None:
        for name in ("base_steps", "skill_steps", "num_envs", "updates_per_batch"):
            if getattr(self, name) < 1:
                raise ValueError(f"FineTunedSource needs {name} >= 1; got {getattr(self, name)}.")
        if not 0.0 <= self.warm_up < 1.0:
            raise ValueError(f"FineTunedSource needs 0 <= warm_up < 1; got {self.warm_up}.")

    def find(
        self, game: str, make_pool: MakePool, *, seed: int, log: Callable[[str], None]
    ) -> Options:
        """Return the options of a game."""
        found = self.source.find(game, make_pool, seed=seed, log=log)
        training = make_goal_training(found, game, seed, gamma=self.gamma, alpha_init=self.alpha)
        loss, network = training.loss, network_of(found.worker)
        reward = SkillReward(
            loss.objective, intrinsic_coeff=self.goal_weight, extrinsic_coeff=self.game_weight
        )
        batch = 8 * self.num_envs
        batches = max(1, round(self.base_steps / batch))
        env = make_skill_env(
            game,
            network.num_options,
            skill_steps=self.skill_steps,
            num_envs=self.num_envs,
            clip_reward=True,
            seed=seed,
        )
        trainer = DIAYNTrainer(
            env,
            loss,
            total_frames=batches * batch,
            frames_per_batch=batch,
            updates_per_batch=self.updates_per_batch,
            actor_lr=0.0,
            critic_lr=self.critic_lr,
            objective_lr=self.critic_lr,
            target_tau=0.01,
            reward=reward,
            seed=seed,
        )

        alone = round(self.warm_up * batches) * batch

        def begin_with_the_critics() -> None:
            if trainer.collected_frames > alone:
                _learning_rate(trainer.optimizer, "actor", self.lr)

        trainer.register_op("pre_optim_steps", begin_with_the_critics)
        trainer.train()
        network.load(_actor_parameters(loss))
        data = trainer.replay_buffer.storage.get(slice(None))
        share = loss.objective.reward(data).mean().item()
        log(f"fine-tuned: goals' reward {share:.2f} per base step, over the last {len(data):,}")
        report = {**found.report, "fine_tuned_goal_reward": share}
        saved = {**found.saved, "parts": [plain_worker(found.worker)]}
        frames = found.num_frames + 4 * batch * batches
        training.data = data
        return Options(found.worker, found.names, frames, report, saved, training)


@dataclass(frozen=True)
class RetrainedSource:
    r"""A network worker, retrained on what the manager's searches simulated: Algorithm 3.

    Rounds of planning with the worker as it is, every base step of every option that is simulated
    being kept as S; then updates of its own loss on :math:`S \cup D`, with D what it was trained on
    before:

    .. math:: r = c_i\, r_\phi(s, z, s') + c_e\, \mathrm{sign}(r_{game})

    Attributes:
        source: gives the network: :class:`DIAYNSource`, :class:`DistilledSource` or
            :class:`FineTunedSource`.
        search: the planner of the rounds.
        rounds: of planning and retraining.
        round_steps: real base steps of a round.
        option_steps: base steps of an option.
        intrinsic_weight, game_weight: :math:`c_i`, :math:`c_e`.
        warm_up: share of the first round's updates in which new critics learn alone; critics that
            came with the network need none.
        updates_per_step: updates per base step that S has gained.
        lr: Adam's learning rate.
        buffer_size: transitions of S that are kept.

    Raises:
        ValueError: if a number is out of range.

    Reference:
        Dissertation, algorithm 3 and chapter 5.

    Example:
        >>> from torchrl_hmcts.trainers import DIAYNSource, RetrainedSource
        >>> RetrainedSource(DIAYNSource(base_steps=512), rounds=2).round_steps
        300
    """

    source: WorkerSource
    search: AtariSearch = field(default_factory=lambda: AtariSearch(ratio=10.0))
    rounds: int = 3
    round_steps: int = 300
    option_steps: int = 10
    intrinsic_weight: float = 1.0
    game_weight: float = 1.0
    warm_up: float = 0.75
    updates_per_step: float = 0.125
    lr: float = 3e-4
    buffer_size: int = 100_000

    def __post_init__(self) -> None:
        for name in ("rounds", "round_steps", "option_steps", "buffer_size"):
            if getattr(self, name) < 1:
                raise ValueError(f"RetrainedSource needs {name} >= 1; got {getattr(self, name)}.")
        if not 0.0 <= self.warm_up <= 1.0:
            raise ValueError(f"RetrainedSource needs 0 <= warm_up <= 1; got {self.warm_up}.")
        if not self.updates_per_step > 0.0:
            raise ValueError(
                f"RetrainedSource needs updates_per_step > 0; got {self.updates_per_step}."
            )

    def find(
        self, game: str, make_pool: MakePool, *, seed: int, log: Callable[[str], None]
    ) -> Options:
        """Return the options of a game."""
        found = self.source.find(game, make_pool, seed=seed, log=log)
        network = network_of(found.worker)
        training = found.training
        warm_up = self.warm_up if training is None else 0.0
        if training is None:
            training = make_goal_training(found, game, seed, gamma=0.9, alpha_init=0.1)
        loss = training.loss
        keys = list(dict.fromkeys([*loss.in_keys, *loss.objective.in_keys]))
        reward = SkillReward(
            loss.objective,
            intrinsic_coeff=self.intrinsic_weight,
            extrinsic_coeff=self.game_weight,
        )
        buffer = ReplayBuffer(
            storage=LazyTensorStorage(self.buffer_size), transform=reward, batch_size=256
        )
        if len(training.data):
            buffer.extend(training.data.select(*keys))
        optimizer = make_skill_optimizer(loss, self.lr, self.lr, self.lr)
        updater = SoftUpdate(loss, tau=0.01)
        frames, rows = found.num_frames, []
        for number in range(self.rounds):
            pool = make_pool(found.worker, self.option_steps, record=True)
            recorded: list[TensorDictBase] = []
            pool.on_step = lambda before, after, to=recorded: to.append(
                option_transitions(before, after, training.bytes_seen).select(*keys)
            )
            pool.set_seed(seed * 10_000 + number)
            agent = AtariAgent(pool, self.search, seed=seed * 10_000 + number)
            progress = agent.play(max_steps=self.round_steps)
            frames += pool.num_frames
            pool.close()
            samples = torch.cat(recorded)  # type: ignore[call-overload]
            buffer.extend(samples)
            with torch.random.fork_rng(devices=[]):
                torch.manual_seed(seed * 10_000 + number)
                updates = max(1, round(self.updates_per_step * len(samples)))
                alone = round(warm_up * updates) if number == 0 else 0
                for i in range(updates):
                    _learning_rate(optimizer, "actor", 0.0 if i < alone else self.lr)
                    _update(loss, buffer.sample(), optimizer)
                    updater.step()
            network.load(_actor_parameters(loss))
            row = {"score": progress.score, "real_steps": progress.real_steps}
            rows.append({**row, "samples": len(samples)})
            log(f"round {number + 1} of planning and retraining: {rows[-1]}")
        report = {**found.report, "rounds": rows}
        saved = {**found.saved, "parts": [plain_worker(found.worker)]}
        return Options(found.worker, found.names, frames, report, saved, training)


def option_transitions(
    before: TensorDictBase, after: TensorDictBase, bytes_seen: Sequence[int] | None = None
) -> TensorDict:
    """Return the base transitions inside options that a pool has carried out.

    Args:
        before: what was stepped ``[n]``, with ``"option"``.
        after: what an :class:`~torchrl_hmcts.envs.AtariOptionPool` with ``record=True`` made of it.
        bytes_seen: bytes of which the displacement since the option began is written, too.

    Returns:
        Transitions ``[sum of durations]``, option by option: ``"observation"`` (RAM / 255),
        ``"skill"`` (the option), ``"action"``, and under ``"next"`` ``"observation"``, ``"skill"``,
        the sign of the game's ``"reward"``, ``"done"`` and ``"terminated"``; with ``bytes_seen``
        ``"displacement"`` in both.
    """
    duration = after["duration"].reshape(-1)
    ram, count = after["inner_ram"], duration.numel()
    ram = ram.reshape(count, -1, 128)
    steps = torch.arange(ram.shape[1])
    last = steps == duration.unsqueeze(-1) - 1  # [n, T]
    then = ram.roll(-1, 1)
    then[last] = after["ram"].reshape(count, 128)
    taken = steps < duration.unsqueeze(-1)
    skill = before["option"].reshape(-1, 1).expand(taken.shape)[taken]
    over = {}
    for key in ("done", "terminated"):
        over[key] = (last & after[key].reshape(-1, 1))[taken].unsqueeze(-1)
    states = [x[taken].to(torch.float32) / 255.0 for x in (ram, then)]
    reward = after["inner_reward"].reshape(taken.shape)[taken].sign().unsqueeze(-1)
    size = [len(skill)]
    following = TensorDict(
        {"observation": states[1], "skill": skill, "reward": reward, **over}, batch_size=size
    )
    out = TensorDict(
        {
            "observation": states[0],
            "skill": skill,
            "action": after["inner_action"].reshape(taken.shape)[taken],
            "next": following,
        },
        batch_size=size,
    )
    if bytes_seen is not None:
        seen = list(bytes_seen)
        first = ram[:, :1].expand(ram.shape)[taken][:, seen].to(torch.float32) / 255.0
        out["displacement"] = states[0][:, seen] - first
        following["displacement"] = states[1][:, seen] - first
    return out


def _update(
    loss: DiscreteSkillSACLoss, batch: TensorDictBase, optimizer: torch.optim.Optimizer
) -> None:
    """One step of the optimiser on all losses."""
    out = loss(batch)
    total = torch.stack([v for k, v in out.items() if k.startswith("loss_")]).sum()
    if not torch.isfinite(total):
        raise FloatingPointError(
            f"A loss of the worker is not finite: "
            f"{ {k: v.item() for k, v in out.items() if k.startswith('loss_')} }. Lower lr."
        )
    optimizer.zero_grad()
    total.backward()
    torch.nn.utils.clip_grad_norm_(loss.parameters(), 10.0)
    optimizer.step()


def _learning_rate(optimizer: torch.optim.Optimizer, name: str, lr: float) -> None:
    for group in optimizer.param_groups:
        if group["name"] == name:
            group["lr"] = lr


def _actor_parameters(loss: DiscreteSkillSACLoss) -> list[Tensor]:
    """The live parameters of a loss's actor, in the order of a ``SkillMLP``."""
    network = next(m for m in loss.actor_network.modules() if isinstance(m, SkillMLP))
    return list(network.parameters())

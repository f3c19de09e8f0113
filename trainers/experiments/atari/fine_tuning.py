"""Networks that are trained further: on their goals, on the game, on what searches simulated.

Letters: Z options, B transitions, n recorded options, T base steps of an option.
:class:`TrainedSource` tells what the settings are.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor
from torchrl.data import LazyTensorStorage, ReplayBuffer
from torchrl.objectives import SoftUpdate

from torchrl_hmcts.checks import real_number, whole_number
from torchrl_hmcts.envs import ByteGoal
from torchrl_hmcts.modules import SkillMLP
from torchrl_hmcts.objectives import DiscreteSkillSACLoss, SkillObjective
from torchrl_hmcts.trainers.diayn import DIAYNTrainer, make_skill_optimizer
from torchrl_hmcts.trainers.experiments.atari.agent import AtariAgent, AtariSearch
from torchrl_hmcts.trainers.experiments.atari.kit import AtariKit
from torchrl_hmcts.trainers.experiments.atari.options import (
    Options,
    Training,
    goals_of,
    network_of,
)
from torchrl_hmcts.trainers.experiments.atari.skills import SLOW
from torchrl_hmcts.transforms import SkillReward


class OptionGoals(SkillObjective):
    r"""Rewards an option for its own goal. Nothing is learned.

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
    rows: Tensor  # [Z, 4]: c, b, o, and the action of an option that repeats one, else -1

    def __init__(self, goals: Sequence[ByteGoal | int], *, scale: float = 30.0) -> None:
        if not goals:
            raise ValueError("OptionGoals needs a goal for each option; got none.")
        super().__init__(len(goals))
        self.scale = real_number("OptionGoals", "scale", scale, above=0.0)
        rows = [
            (g.controlled, g.target, g.offset, -1) if isinstance(g, ByteGoal) else (0, 0, 0, g)
            for g in goals
        ]
        self.register_buffer("rows", torch.tensor(rows))

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
        repeated = (tensordict.get("action") == row[..., 3]).to(near.dtype)
        return torch.where(row[..., 3] < 0, near, repeated).unsqueeze(-1)


def _goal_training(found: Options, kit: AtariKit) -> Training:
    """Build critics and goals for a distilled network; its actor starts as that network."""
    network = network_of(found.worker)
    if found.teacher is None:
        raise TypeError(
            "The purpose of these options is unknown. Wrap goals or actions to repeat: "
            "TrainedSource('distilled', RuleSource('goals'))."
        )
    hidden = tuple(network.sizes[1:])
    distilled = SkillMLP(128, network.num_actions, network.num_options, hidden=hidden)
    distilled.requires_grad_(False)
    network.store(distilled.parameters())
    env, _ = kit.make_training_env(network.num_options, option_steps=1, num_envs=1)
    loss = DIAYNTrainer.make_loss(
        env,
        network.num_options,
        objective=OptionGoals(goals_of(found.teacher)),
        in_keys=["observation"],
        critic_keys=["observation"],
        hidden=hidden,
        policy_prior=TensorDictModule(distilled, ["observation", "skill"], ["logits"]),
        gamma=0.9,
        alpha_init=0.1,  # weight of the divergence from the network at the start, fixed
        seed=kit.seed,
    )
    env.close(raise_if_closed=False)
    network.store(loss.actor_network_params.parameters())
    return Training(loss, TensorDict(batch_size=[0]))


def fine_tune(
    found: Options,
    kit: AtariKit,
    *,
    base_steps: int = 20_000,
    warm_up: float = 0.25,
    skill_steps: int = 40,
    lr: float = 1e-4,
    num_envs: int = 8,
    updates_per_batch: int = 16,
) -> Options:
    """Train a distilled network further by soft actor-critic on its goals and on the game."""
    real_number("fine_tuned", "warm_up", warm_up, least=0.0, most=1.0)
    training = _goal_training(found, kit)
    loss = training.loss
    batch = 8 * num_envs
    batches = max(1, round(base_steps / batch))
    env, count = kit.make_training_env(
        len(found.names), option_steps=skill_steps, num_envs=num_envs, clip_reward=True
    )
    trainer = DIAYNTrainer(
        env,
        loss,
        total_frames=batches * batch,
        frames_per_batch=batch,
        updates_per_batch=updates_per_batch,
        actor_lr=0.0,
        **SLOW,
        reward=SkillReward(loss.objective, extrinsic_coeff=1.0),
        seed=kit.seed,
    )
    alone = round(warm_up * batches) * batch

    def begin_with_the_critics() -> None:
        if trainer.collected_frames > alone:
            _set_actor_lr(trainer.optimizer, lr)

    trainer.register_op("pre_optim_steps", begin_with_the_critics)
    trainer.train()
    training.data = data = trainer.replay_buffer.storage.get(slice(None))
    training.samples += trainer.collected_frames
    share = loss.objective.reward(data).mean().item()
    kit.log(f"fine-tuned: goals' reward {share:.2f} per base step, over the last {len(data):,}")
    network_of(found.worker).load(loss.actor_network_params.parameters())
    report = {**found.report, "fine_tuned_goal_reward": share}
    num_frames = found.num_frames + count()
    return replace(found, num_frames=num_frames, report=report, training=training)


def retrain(
    found: Options,
    kit: AtariKit,
    *,
    search: AtariSearch | None = None,
    rounds: int = 3,
    round_steps: int = 300,
    option_steps: int = 10,
    intrinsic_weight: float = 1.0,
    warm_up: float = 0.75,
    lr: float = 3e-4,
) -> Options:
    """Retrain a network on what the manager's searches simulated: Algorithm 3."""
    whole_number("retrained", "rounds", rounds, least=1)
    real_number("retrained", "warm_up", warm_up, least=0.0, most=1.0)
    network_of(found.worker)
    search = AtariSearch(ratio=10.0) if search is None else search
    alone = warm_up if found.training is None else 0.0
    training = found.training or _goal_training(found, kit)
    loss = training.loss
    keys = list(dict.fromkeys([*loss.in_keys, *loss.objective.in_keys]))
    reward = SkillReward(loss.objective, intrinsic_coeff=intrinsic_weight, extrinsic_coeff=1.0)
    buffer = ReplayBuffer(storage=LazyTensorStorage(100_000), transform=reward, batch_size=256)
    if len(training.data):
        buffer.extend(training.data.select(*keys))
    optimizer = make_skill_optimizer(loss, lr, lr, lr)
    updater = SoftUpdate(loss, tau=0.01)
    num_frames, rows = found.num_frames, []
    for number in range(rounds):
        seed = kit.seed * 10_000 + number
        pool = kit.make_pool(found.worker, option_steps, record=True)
        recorded: list[TensorDictBase] = []
        pool.on_step = lambda before, after, to=recorded: to.append(
            option_transitions(before, after, training.bytes_seen).select(*keys)
        )
        pool.set_seed(seed)
        agent = AtariAgent(pool, search, seed=seed).play(max_steps=round_steps)
        num_frames += pool.num_frames
        pool.close()
        samples = torch.cat(recorded)  # type: ignore[call-overload]
        buffer.extend(samples)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            updates = max(1, round(len(samples) / 8))
            for i in range(updates):
                waiting = number == 0 and i < round(alone * updates)
                _set_actor_lr(optimizer, 0.0 if waiting else lr)
                _update(loss, buffer.sample(), optimizer)
                updater.step()
        network_of(found.worker).load(loss.actor_network_params.parameters())
        training.samples += len(samples)
        if kit.curve is not None:
            kit.curve(found.worker, training.samples, num_frames)
        row = {"score": agent.score, "real_steps": agent.real_steps, "samples": len(samples)}
        rows.append(row)
        kit.log(f"round {number + 1} of planning and retraining: {row}")
    report = {**found.report, "rounds": rows}
    return replace(found, num_frames=num_frames, report=report, training=training)


def option_transitions(
    before: TensorDictBase, after: TensorDictBase, bytes_seen: Sequence[int] | None = None
) -> TensorDict:
    """Return the base transitions ``[sum of durations]`` inside options that a recording pool has
    executed, with the displacement of ``bytes_seen`` since the option began."""
    duration = after["duration"].reshape(-1, 1)
    ram = after["inner_ram"].reshape(len(duration), -1, 128)
    steps = torch.arange(ram.shape[1])
    taken, last = steps < duration, steps == duration - 1  # [n, T]
    then = ram.roll(-1, 1)
    then[last] = after["ram"].reshape(-1, 128)
    skill = before["option"].reshape(-1, 1).expand(taken.shape)[taken]
    out = TensorDict(
        {
            "skill": skill,
            "action": after["inner_action"].reshape(taken.shape)[taken],
            "next": {
                "skill": skill,
                "reward": after["inner_reward"].reshape(taken.shape)[taken].sign().unsqueeze(-1),
            },
        },
        batch_size=[len(skill)],
    )
    for key in ("done", "terminated"):
        out["next", key] = (last & after[key].reshape(-1, 1))[taken].unsqueeze(-1)
    first = ram[:, :1].expand(ram.shape)[taken].float() / 255.0
    for at, bytes_at in ((out, ram), (out["next"], then)):
        at["observation"] = observed = bytes_at[taken].float() / 255.0
        if bytes_seen is not None:
            at["displacement"] = (observed - first)[:, list(bytes_seen)]
    return out


def _update(
    loss: DiscreteSkillSACLoss, batch: TensorDictBase, optimizer: torch.optim.Optimizer
) -> None:
    losses = {k: v for k, v in loss(batch).items() if k.startswith("loss_")}
    total = torch.stack(list(losses.values())).sum()
    if not torch.isfinite(total):
        values = {name: value.item() for name, value in losses.items()}
        raise FloatingPointError(f"A loss of the worker is not finite: {values}. Lower lr.")
    optimizer.zero_grad()
    total.backward()
    torch.nn.utils.clip_grad_norm_(loss.parameters(), 10.0)
    optimizer.step()


def _set_actor_lr(optimizer: torch.optim.Optimizer, lr: float) -> None:
    for group in optimizer.param_groups:
        if group["name"] == "actor":
            group["lr"] = lr

"""Training of the worker: skills that can be told apart."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from types import NoneType
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torchrl.collectors import BaseCollector, Collector
from torchrl.data import TensorSpec
from torchrl.envs import EnvBase, Transform
from torchrl.objectives import LossModule
from torchrl.trainers import UpdateWeights

from torchrl_hmcts.checks import instance, real_number, whole_number
from torchrl_hmcts.modules import (
    SkillActionCritic,
    SkillActor,
    SkillCritic,
    SkillDiscriminator,
    SkillPolicy,
)
from torchrl_hmcts.modules.skill_spec import require_known
from torchrl_hmcts.objectives import (
    DIAYNLoss,
    DiscreteSkillSACLoss,
    SkillDiscriminatorLoss,
    SkillObjective,
    SkillSACLoss,
)
from torchrl_hmcts.trainers.collectors import CollectorError
from torchrl_hmcts.trainers.off_policy import OffPolicyTrainer, Progress, made_by
from torchrl_hmcts.trainers.skills.coverage import StateCoverage
from torchrl_hmcts.transforms import SkillReward


class DIAYNTrainer(OffPolicyTrainer):
    """Trains skills off-policy with any skill loss, on TorchRL's Trainer and Collector.

    Per batch: collect ``frames_per_batch`` base steps with the current policy, store them, and make
    ``updates_per_batch`` updates, each on ``batch_size`` transitions whose reward the current
    objective gives (:class:`SkillReward`), with one Adam over all parameters and a soft update
    of the target critics. Another objective (METRA, LSD, DADS) is another loss, nothing else.

    :attr:`history` and the ``logger`` get the mean of each loss and diagnostic over a batch's
    updates: ``loss_x`` as ``x_loss``, the critics as ``critic_1_loss`` and ``critic_2_loss``
    (figures 4.6 to 4.9), ``discriminator_accuracy``, ``entropy`` (nats), ``grad_norm``,
    ``optim_steps``, and the counts of :class:`StateCoverage`.

    Args:
        env (EnvBase): env under :class:`SkillTransform` and what the objective reads (e.g.
            :class:`DisplacementTransform`). Mini-episodes of 50 steps and 32 copies in one batch
            (a stateless env built with ``batch_size=[32]``) go with the defaults below.
        loss_module (LossModule): a :class:`DIAYNLoss`, e.g. from :meth:`make_loss`, or any
            :class:`DiscreteSkillSACLoss` or :class:`SkillSACLoss` (continuous actions).
        total_frames, frames_per_batch (int): base steps in all, and per batch, a multiple of the
            env's copies.
        updates_per_batch (int): updates per batch.
        batch_size (int): transitions per update.
        buffer_size (int): transitions kept.
        actor_lr, critic_lr, objective_lr, alpha_lr (float): Adam's learning rates; the actor is the
            slowest, so that it follows settled values.
        target_tau (float): share of the critics moved into their targets per update.
        clip_norm (float): bound of the gradient's norm, over all parameters.
        reward (Transform, optional): replay buffer transform that writes the reward. Default:
            ``SkillReward(loss_module.objective)``.
        coverage (StateCoverage, optional): what counts as visited. Default: the first entry that
            the objective reads of the next state, in cells of side 0.5.
        progress (callable, optional): called with ``total=total_frames`` it returns a progress bar,
            e.g. ``tqdm.tqdm``.
        seed (int, optional): seeds the env and torch before the first reset. The networks' initial
            weights are older: :meth:`make_loss` has its own.
        save_dir (path, optional): folder of checkpoints. To continue from one, build env, loss and
            trainer as before and call ``trainer.load(save_dir)``.
        log_interval (int): base steps between two values that reach the ``logger``; 0: every batch.
        make_collector (callable): called as ``torchrl.collectors.Collector`` is, with env, policy
            and keywords; e.g. one that collects in other processes. Such a run does not resume
            exactly.
        **trainer_kwargs: passed to :class:`ResumableTrainer` (``logger``, ``keep_last``, ...).

    Raises:
        ValueError: if a number is out of range, a batch does not divide among the env's copies, or
            the env draws other skills than actor and objective know.
        KeyError: if the env does not write what the actor reads, e.g. without a SkillTransform.
        TypeError: if the loss has no skill objective and no ``reward`` is given.

    Reference:
        Eysenbach et al., "Diversity is All You Need", 2018, arXiv 1802.06070; Bartley 2023, ch. 4.

    Examples:
        >>> from torchrl.envs import Compose, TransformedEnv
        >>> from torchrl_hmcts.envs import WaterworldMazeEnv
        >>> from torchrl_hmcts.trainers.diayn import DIAYNTrainer
        >>> from torchrl_hmcts.transforms import DisplacementTransform, SkillTransform
        >>> env = TransformedEnv(
        ...     WaterworldMazeEnv(batch_size=[32], observation=False),
        ...     Compose(SkillTransform(4, max_skill_steps=50), DisplacementTransform()),
        ... )
        >>> loss = DIAYNTrainer.make_loss(env, num_skills=4, seed=0)
        >>> trainer = DIAYNTrainer(env, loss, total_frames=128, seed=0)
        >>> trainer.train()
        >>> len(trainer.history["discriminator_loss"])
        2
    """

    def __init__(
        self,
        env: EnvBase,
        loss_module: LossModule,
        *,
        total_frames: int = 40_000,
        frames_per_batch: int = 64,
        updates_per_batch: int = 3,
        batch_size: int = 256,
        buffer_size: int = 20_000,
        actor_lr: float = 2e-3,
        critic_lr: float = 3e-3,
        objective_lr: float = 1e-2,
        alpha_lr: float = 1e-2,
        target_tau: float = 0.05,
        clip_norm: float = 10.0,
        reward: Transform | None = None,
        coverage: StateCoverage | None = None,
        progress: Callable[..., Progress] | None = None,
        seed: int | None = None,
        save_dir: str | Path | None = None,
        log_interval: int = 0,
        make_collector: Callable[..., BaseCollector] = Collector,
        **trainer_kwargs: Any,
    ) -> None:
        owner = "DIAYNTrainer"
        instance(owner, "env", env, EnvBase)
        instance(owner, "reward", reward, Transform, NoneType)
        instance(owner, "coverage", coverage, StateCoverage, NoneType)
        whole_number(owner, "frames_per_batch", frames_per_batch, least=1)
        whole_number(owner, "updates_per_batch", updates_per_batch, least=1)
        whole_number(owner, "log_interval", log_interval, least=-1)
        copies = env.batch_size.numel()
        if frames_per_batch % copies:
            raise ValueError(
                f"DIAYNTrainer collects whole steps of all {copies} copies of the env, so "
                f"frames_per_batch must be a multiple of {copies}; got {frames_per_batch}."
            )
        objective = _objective(loss_module)
        if seed is not None:  # before the collector makes its first reset
            seed = whole_number(owner, "seed", seed)
            env.set_seed(seed)
            torch.manual_seed(seed)
        if reward is None:
            reward = SkillReward(objective, reward_key=loss_module.tensor_keys.reward)
        if coverage is None:
            coverage = StateCoverage(_reached(objective))
        # Only what is read is stored.
        keys = list(dict.fromkeys([*loss_module.in_keys, *objective.in_keys, coverage.key]))
        policy = SkillPolicy(loss_module.actor_network)
        _check_fits(env, policy, objective)
        super().__init__(
            partial(_collect, make_collector, env, policy, keys, frames_per_batch, total_frames),
            loss_module,
            make_skill_optimizer(loss_module, actor_lr, critic_lr, objective_lr, alpha_lr),
            total_frames=total_frames,
            optim_steps_per_batch=updates_per_batch,
            batch_size=batch_size,
            buffer_size=buffer_size,
            buffer_options={"transform": reward},
            clip_norm=clip_norm,
            target_tau=target_tau,
            settings={"frames_per_batch": frames_per_batch, "updates_per_batch": updates_per_batch},
            progress=progress,
            progress_total=total_frames,
            save_dir=save_dir,
            log_interval=log_interval,
            auto_log_optim_steps=False,
            **trainer_kwargs,
        )
        self.seed = seed
        self._latest: dict[str, float] = {}
        self.register_op("post_optim_complete_log", self._log_curves)
        if not isinstance(self.collector, Collector):  # it has weights of its own
            self.register_op("post_steps", UpdateWeights(self.collector, 1))
        coverage.register(self)

    def train(self) -> None:
        """Train.

        Raises:
            CollectorError: if processes that collect died again and again; it names the last
                checkpoint.
        """
        try:
            super().train()
        except CollectorError as error:
            raise CollectorError(f"{error} {self.last_good_checkpoint()}") from error

    @property
    def history(self) -> dict[str, list[float]]:
        """All logged values by name: per batch the mean over its updates of each curve."""
        return Curves(super().history)

    def _log_curves(self, optim_steps: int, losses: TensorDictBase | None) -> dict[str, float]:
        self._latest = log_curves(optim_steps, losses)
        return self._latest

    def progress_figures(self) -> dict[str, str]:
        names = {"accuracy": "discriminator_accuracy", "actor": "actor_loss"}
        latest = self._latest
        return {short: f"{latest[name]:.2f}" for short, name in names.items() if name in latest}

    @staticmethod
    def make_loss(
        env: EnvBase,
        num_skills: int | TensorSpec | None = None,
        *,
        objective: SkillObjective | None = None,
        loss_class: type[LossModule] | None = None,
        in_keys: Sequence[NestedKey] | None = None,
        critic_keys: Sequence[NestedKey] | None = None,
        discriminator_keys: Sequence[NestedKey] | None = None,
        hidden: Sequence[int] = (64, 64),
        discriminator_hidden: Sequence[int] = (),
        seed: int | None = None,
        **loss_kwargs: Any,
    ) -> LossModule:
        """Builds actor, critics, discriminator and loss with the sizes of an env's specs.

        Critics of discrete actions are :class:`SkillCritic`, those of actions within bounds
        :class:`SkillActionCritic`.

        Args:
            env (EnvBase): env that writes ``in_keys`` and ``discriminator_keys``.
            num_skills (int or TensorSpec, optional): number of skills, or the spec of one that is a
                vector. Default: what the ``objective`` distinguishes, what the env draws, or 4.
            objective (SkillObjective, optional): what makes skills different, e.g.
                :class:`METRAEncoderLoss`. Default: DIAYN's discriminator.
            loss_class (type, optional): one of :func:`worker_losses`. Default: the first.
            in_keys (sequence of NestedKey, optional): what the actor sees besides the skill.
                Default: ``["velocity"]``, or ``["observation"]`` of an env without.
            critic_keys (sequence of NestedKey, optional): what the critics see besides the skill.
                Default: ``in_keys``, and ``"displacement"`` if the env writes it.
            discriminator_keys (sequence of NestedKey, optional): what the discriminator sees.
                Default: ``["displacement"]``, or ``in_keys`` in an env without.
            hidden, discriminator_hidden (sequence of int): widths of the hidden layers.
            seed (int, optional): of the initial weights; torch's generator is left as it was.
            **loss_kwargs: passed to the loss.

        Returns:
            LossModule: the loss, with fresh networks.

        Raises:
            KeyError: if the env does not write one of the keys.
            ValueError: if ``loss_class`` does not train such actions, or such an objective; for
                skills that are vectors without an ``objective``.
        """
        shown = env.full_observation_spec_unbatched
        written = shown.keys(True, True)
        if num_skills is None:
            drawn = shown["skill"] if "skill" in written else 4
            num_skills = drawn if objective is None else objective.skill_spec
        moved = ["displacement"] if "displacement" in written else []
        if in_keys is None:
            in_keys = ["velocity" if "velocity" in written else "observation"]
        critic_keys = [*in_keys, *moved] if critic_keys is None else critic_keys
        discriminator_keys = moved or in_keys if discriminator_keys is None else discriminator_keys
        action_spec = env.action_spec_unbatched
        losses = worker_losses(action_spec, objective)
        if loss_class is None:
            loss_class = losses[0]
        if loss_class not in losses:
            raise ValueError(
                f"{loss_class.__name__} does not fit a worker with {type(action_spec).__name__} "
                "actions and "
                f"{'no other objective' if objective is None else type(objective).__name__}. These "
                f"do: {', '.join(loss.__name__ for loss in losses)}."
            )
        with torch.random.fork_rng(devices=[], enabled=seed is not None):
            if seed is not None:
                torch.manual_seed(int(seed))
            actor = SkillActor(
                _width(env, in_keys), action_spec, num_skills, in_keys=in_keys, hidden=hidden
            )
            keys: dict[str, Any] = {"in_keys": critic_keys, "hidden": hidden}
            width = _width(env, critic_keys)
            critic: SkillCritic | SkillActionCritic
            if issubclass(loss_class, SkillSACLoss):
                critic = SkillActionCritic(width, action_spec.shape[-1], num_skills, **keys)
            else:
                critic = SkillCritic(width, actor.num_actions, num_skills, **keys)
                loss_kwargs["action_space"] = action_spec
            if objective is not None:
                return loss_class(actor, critic, objective, **loss_kwargs)
            discriminator = SkillDiscriminator(
                _width(env, discriminator_keys),
                num_skills,
                in_keys=discriminator_keys,
                hidden=discriminator_hidden,
            )
            if issubclass(loss_class, DIAYNLoss):
                return loss_class(actor, critic, discriminator, **loss_kwargs)
            return loss_class(actor, critic, SkillDiscriminatorLoss(discriminator), **loss_kwargs)


def worker_losses(
    action_spec: TensorSpec, objective: SkillObjective | None = None
) -> tuple[type[LossModule], ...]:
    """Returns the losses that train a worker with such actions, the default first."""
    if not hasattr(action_spec.space, "n"):
        return (SkillSACLoss,)
    return (DIAYNLoss, DiscreteSkillSACLoss)[objective is not None :]


def curve_name(key: str) -> str:
    """Return the name under which an entry of a loss's output is logged."""
    if key == "loss_qvalue":
        return "critic_loss"
    if key.startswith("qvalue_loss_"):
        return f"critic_{int(key.rsplit('_', 1)[1]) + 1}_loss"
    if key.startswith("loss_"):
        return f"{key.removeprefix('loss_')}_loss"
    return key


def log_curves(optim_steps: int, average_losses: TensorDictBase | None) -> dict[str, float]:
    """Name the losses and diagnostics of a batch, averaged over its updates, for the log.

    A hook of any TorchRL ``Trainer`` for the stage ``"post_optim_complete_log"``; turn off the
    Trainer's own ``auto_log_optim_steps`` with it.
    """
    values: dict[str, float] = {"optim_steps": optim_steps}
    if average_losses is not None:
        names = [curve_name(key) for key in average_losses.keys()]
        # One stack and one copy for all of them.
        values.update(zip(names, torch.stack(list(average_losses.values())).tolist(), strict=True))
    return values


class Curves(dict[str, list[float]]):
    """Curves by their names; the loss's own names find them as well."""

    def __missing__(self, key: str) -> list[float]:
        name = curve_name(key)
        if name == key:
            raise KeyError(f"{key!r} was not logged; there are {sorted(self)}.")
        return self[name]


def make_skill_optimizer(
    loss_module: LossModule,
    actor_lr: float = 2e-3,
    critic_lr: float = 3e-3,
    objective_lr: float = 1e-2,
    alpha_lr: float = 1e-2,
) -> torch.optim.Adam:
    """Builds one Adam for all parts of a skill loss, each with its own learning rate.

    Args:
        loss_module (LossModule): e.g. a :class:`DIAYNLoss` or :class:`DiscreteSkillSACLoss`.
        actor_lr, critic_lr, objective_lr (float): learning rates.
        alpha_lr (float): of log alpha, when it is tuned.

    Returns:
        torch.optim.Adam: with the groups ``"actor"``, ``"critic"``, ``"objective"`` and ``"alpha"``
        under ``"name"``, those that have parameters.

    Examples:
        >>> from torchrl_hmcts.trainers.diayn import DIAYNTrainer, make_skill_optimizer
        >>> from torchrl_hmcts.trainers.experiments.kits.waterworld import make_training_env
        >>> loss = DIAYNTrainer.make_loss(make_training_env(copies=1))
        >>> [(g["name"], g["lr"]) for g in make_skill_optimizer(loss).param_groups]
        [('actor', 0.002), ('critic', 0.003), ('objective', 0.01)]
    """
    parts = {
        "actor": (loss_module.actor_network_params.parameters(), "actor_lr", actor_lr),
        "critic": (loss_module.qvalue_network_params.parameters(), "critic_lr", critic_lr),
        "objective": (_objective(loss_module).parameters(), "objective_lr", objective_lr),
        "alpha": ([loss_module.log_alpha], "alpha_lr", alpha_lr),
    }
    groups = []
    for name, (parameters, argument, lr) in parts.items():
        rate = real_number("make_skill_optimizer", argument, lr, least=0.0)
        trained = [p for p in parameters if p.requires_grad]
        if trained:
            groups.append({"params": trained, "lr": rate, "name": name})
    return torch.optim.Adam(groups, fused=True)


def _collect(
    make_collector: Callable[..., BaseCollector],
    env: EnvBase,
    policy: SkillPolicy,
    keys: Sequence[NestedKey],
    frames_per_batch: int,
    total_frames: int,
) -> BaseCollector:
    """Returns a collector whose batches have one dimension and only these entries."""
    return made_by(
        make_collector,
        "DIAYNTrainer",
        "make_collector",
        object,
        env,
        policy,
        frames_per_batch=frames_per_batch,
        total_frames=total_frames,
        postproc=lambda batch: batch.select(*keys, strict=False).reshape(-1),
        trust_policy=True,
        track_traj_ids=False,
        use_buffers=False,
        return_same_td=True,  # each batch is a new one as it is
        auto_register_policy_transforms=False,
    )


def _check_fits(env: EnvBase, policy: SkillPolicy, objective: SkillObjective) -> None:
    """Refuses an env that does not write what is read, or draws other skills than are known."""
    shown, state = env.full_observation_spec, env.full_state_spec
    written = {*shown.keys(True, True), *state.keys(True, True)}
    missing = [key for key in policy.in_keys if key not in written]
    if missing:
        raise KeyError(
            f"DIAYNTrainer's actor reads {missing[0]!r}, which the env does not write; it writes "
            f"{sorted(map(str, written))}. Append a SkillTransform for the skill, give the actor "
            f"other in_keys, or append the transform that writes it."
        )
    for part in (policy, objective):
        key = policy.in_keys[-1] if part is policy else objective.tensor_keys.skill
        if key in shown.keys(True, True):
            require_known("DIAYNTrainer", part, part.skill_spec, shown[key])


def _objective(loss_module: LossModule) -> SkillObjective:
    objective = getattr(loss_module, "objective", None)
    if not isinstance(objective, SkillObjective):
        raise TypeError(
            f"Skills are trained with a loss whose attribute `objective` is a SkillObjective; "
            f"{type(loss_module).__name__} has none. Use DIAYNLoss, DiscreteSkillSACLoss or "
            "SkillSACLoss."
        )
    return objective


def _reached(objective: SkillObjective) -> NestedKey:
    """Returns the first entry that an objective reads of the next state."""
    for key in objective.in_keys:
        if isinstance(key, tuple) and key[0] == "next":
            return key[1:] if len(key) > 2 else key[1]
    raise ValueError(
        f"{type(objective).__name__} reads nothing of the next state, so DIAYNTrainer cannot guess "
        "where to count coverage. Pass coverage=StateCoverage(key)."
    )


def _width(env: EnvBase, keys: Sequence[NestedKey]) -> int:
    """Returns the summed size of the last dimension of observation entries."""
    spec = env.full_observation_spec_unbatched
    missing = [key for key in keys if key not in spec.keys(True, True)]
    if missing:
        raise KeyError(
            f"The env does not write {missing}; it writes {list(spec.keys(True, True))}. Choose "
            "in_keys and discriminator_keys among these, or add the transform that writes them."
        )
    return sum(spec[key].shape[-1] for key in keys)

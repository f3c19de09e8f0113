"""Training of the worker: skills that can be told apart."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Protocol

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, ReplayBuffer
from torchrl.envs import EnvBase
from torchrl.objectives import SoftUpdate
from torchrl.trainers import (
    DefaultOptimizationStepper,
    ReplayBufferTrainer,
    TargetNetUpdaterHook,
    Trainer,
)

from torchrl_hmcts.modules import SkillActor, SkillCritic, SkillDiscriminator, SkillPolicy
from torchrl_hmcts.objectives import DIAYNLoss
from torchrl_hmcts.transforms import DIAYNReward


class Progress(Protocol):
    """What a progress bar must offer; ``tqdm.tqdm`` does."""

    def update(self, n: int) -> object: ...
    def set_postfix(self, *, refresh: bool, **figures: str) -> object: ...
    def close(self) -> object: ...


class DIAYNTrainer(Trainer):
    """Trains skills with :class:`DIAYNLoss` off-policy, on TorchRL's Trainer and Collector.

    Per batch: collect ``frames_per_batch`` base steps with the current policy, store them, and make
    ``updates_per_batch`` updates, each on ``batch_size`` transitions whose reward the current
    discriminator gives (:class:`DIAYNReward`), with one Adam over all parameters and a soft update
    of the target critics.

    Args:
        env (EnvBase): env under :class:`SkillTransform` and whatever the discriminator reads (e.g.
            :class:`DisplacementTransform`). Mini-episodes of 50 steps and 32 copies in one batch
            (a stateless env built with ``batch_size=[32]``) go with the defaults below.
        loss_module (DIAYNLoss): the loss, e.g. from :meth:`make_loss`.
        total_frames (int): base steps in all. Default ``40_000``, the source's.
        frames_per_batch (int): base steps per batch, a multiple of the env's copies. Default
            ``64``.
        updates_per_batch (int): updates per batch. Default ``3``.
        batch_size (int): transitions per update. Default ``256``.
        buffer_size (int): transitions kept. Default ``20_000``.
        actor_lr, critic_lr, discriminator_lr (float): Adam's learning rates. Defaults ``2e-3``,
            ``3e-3`` and ``1e-2``: the actor is the slowest, so that it follows settled values.
        alpha_lr (float): learning rate of log alpha, when it is tuned. Default ``1e-2``.
        target_tau (float): share of the critics moved into their targets per update. Default
            ``0.05``.
        clip_norm (float): bound of the gradient's norm, over all parameters. Default ``10.0``.
        reward (Transform, optional): replay buffer transform that writes the reward. Default:
            ``DIAYNReward`` with the loss's discriminator.
        progress (callable, optional): called with ``total=total_frames`` it returns a progress bar,
            e.g. ``tqdm.tqdm``. Default ``None``: quiet.
        seed (int, optional): seeds the env and torch before the first reset. Default ``None``. The
            networks' initial weights are older than the trainer: :meth:`make_loss` has its own.
        **trainer_kwargs: passed to ``torchrl.trainers.Trainer`` (``logger``, ``checkpoint``, ...).

    Raises:
        ValueError: if a batch does not divide among the env's copies.

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
        >>> len(trainer.history["loss_discriminator"])
        2
    """

    def __init__(
        self,
        env: EnvBase,
        loss_module: DIAYNLoss,
        *,
        total_frames: int = 40_000,
        frames_per_batch: int = 64,
        updates_per_batch: int = 3,
        batch_size: int = 256,
        buffer_size: int = 20_000,
        actor_lr: float = 2e-3,
        critic_lr: float = 3e-3,
        discriminator_lr: float = 1e-2,
        alpha_lr: float = 1e-2,
        target_tau: float = 0.05,
        clip_norm: float = 10.0,
        reward: torch.nn.Module | None = None,
        progress: Callable[..., Progress] | None = None,
        seed: int | None = None,
        **trainer_kwargs: Any,
    ) -> None:
        copies = env.batch_size.numel()
        if frames_per_batch % copies:
            raise ValueError(
                f"DIAYNTrainer collects whole steps of all {copies} copies of the env, so "
                f"frames_per_batch must be a multiple of {copies}; got {frames_per_batch}."
            )
        if seed is not None:  # before the collector makes its first reset
            env.set_seed(seed)
            torch.manual_seed(seed)
        discriminator = loss_module.discriminator
        if reward is None:
            reward = DIAYNReward(
                discriminator,
                discriminator.num_skills,
                skill_key=loss_module.tensor_keys.skill,
                skill_logits_key=loss_module.tensor_keys.skill_logits,
                reward_key=loss_module.tensor_keys.reward,
            )
        # Only what the loss reads is stored.
        keys = loss_module.in_keys

        def stored(batch: TensorDictBase) -> TensorDictBase:
            return batch.select(*keys, strict=False).reshape(-1)

        collector = Collector(
            env,
            SkillPolicy(loss_module.actor_network),
            frames_per_batch=frames_per_batch,
            total_frames=total_frames,
            postproc=stored,
            trust_policy=True,
            track_traj_ids=False,
            use_buffers=False,
            auto_register_policy_transforms=False,
        )
        buffer = ReplayBuffer(
            storage=LazyTensorStorage(buffer_size),
            transform=reward,
            batch_size=batch_size,
        )
        groups: list[dict[str, Any]] = [
            {"params": list(loss_module.actor_network_params.parameters()), "lr": actor_lr},
            {"params": list(loss_module.qvalue_network_params.parameters()), "lr": critic_lr},
            {"params": list(loss_module.discriminator_params.parameters()), "lr": discriminator_lr},
        ]
        if loss_module.log_alpha.requires_grad:
            groups.append({"params": [loss_module.log_alpha], "lr": alpha_lr})
        optimizer = torch.optim.Adam(groups, fused=True)
        updater = SoftUpdate(loss_module, tau=target_tau)
        super().__init__(
            collector=collector,
            total_frames=total_frames,
            frame_skip=1,
            optim_steps_per_batch=updates_per_batch,
            loss_module=loss_module,
            optimizer=optimizer,
            optimization_stepper=_DetachedStepper(),
            replay_buffer=buffer,
            target_net_updater=updater,
            batch_size=batch_size,
            clip_norm=clip_norm,
            progress_bar=False,
            **trainer_kwargs,
        )
        self.seed = seed
        replay = ReplayBufferTrainer(buffer, batch_size=batch_size)
        self.register_op("batch_process", replay.extend)
        self.register_op("process_optim_batch", replay.sample)
        self.register_op("post_optim", TargetNetUpdaterHook(updater))
        if progress is not None:
            _ProgressHook(self, progress(total=total_frames)).register(self)

    @property
    def history(self) -> dict[str, list[float]]:
        """Per batch the mean over its updates of each loss and diagnostic, by its name."""
        return {key: [float(x) for x in values] for key, values in self._log_dict.items()}

    @staticmethod
    def make_loss(
        env: EnvBase,
        num_skills: int = 4,
        *,
        in_keys: Sequence[NestedKey] = ("velocity",),
        critic_keys: Sequence[NestedKey] = ("velocity", "displacement"),
        discriminator_keys: Sequence[NestedKey] = ("displacement",),
        hidden: Sequence[int] = (64, 64),
        discriminator_hidden: Sequence[int] = (),
        seed: int | None = None,
        **loss_kwargs: Any,
    ) -> DIAYNLoss:
        """Builds actor, critics, discriminator and loss with the sizes of an env's specs.

        Args:
            env (EnvBase): env that writes ``in_keys`` and ``discriminator_keys``.
            num_skills (int): number of skills. Default ``4``.
            in_keys (sequence of NestedKey): what the actor sees besides the skill. Default
                ``("velocity",)``.
            critic_keys (sequence of NestedKey): what the critics see besides the skill. Default
                ``("velocity", "displacement")``: the reward is a function of the displacement.
                Critics serve only in training, so they may see what the actor does not.
            discriminator_keys (sequence of NestedKey): what the discriminator sees. Default
                ``("displacement",)``.
            hidden (sequence of int): widths of actor's and critics' shared layers. Default
                ``(64, 64)``.
            discriminator_hidden (sequence of int): widths of the discriminator's hidden layers.
                Default ``()``: see :class:`SkillDiscriminator`.
            seed (int, optional): seed of the initial weights; torch's generator is left as it was.
                Default ``None``: torch's generator goes on.
            **loss_kwargs: passed to :class:`DIAYNLoss`.

        Returns:
            DIAYNLoss: the loss, with fresh networks.
        """
        action_spec = env.action_spec_unbatched
        with torch.random.fork_rng(devices=[], enabled=seed is not None):
            if seed is not None:
                torch.manual_seed(seed)
            actor = SkillActor(
                _width(env, in_keys), action_spec, num_skills, in_keys=in_keys, hidden=hidden
            )
            critic = SkillCritic(
                _width(env, critic_keys),
                actor.num_actions,
                num_skills,
                in_keys=critic_keys,
                hidden=hidden,
            )
            discriminator = SkillDiscriminator(
                _width(env, discriminator_keys),
                num_skills,
                in_keys=discriminator_keys,
                hidden=discriminator_hidden,
            )
            return DIAYNLoss(actor, critic, discriminator, action_space=action_spec, **loss_kwargs)


class _DetachedStepper(DefaultOptimizationStepper):
    """The default step; what it logs is kept for ever and must not hold a graph."""

    def step(self, trainer: Trainer, sub_batch: TensorDictBase) -> TensorDictBase:
        return super().step(trainer, sub_batch).detach()


class _ProgressHook:
    """Moves a progress bar and shows the latest figures beside it."""

    figures = ("loss_actor", "loss_qvalue", "loss_discriminator", "discriminator_accuracy")

    def __init__(self, trainer: Trainer, bar: Progress) -> None:
        self.trainer, self.bar = trainer, bar

    def register(self, trainer: Trainer) -> None:
        trainer.register_op("post_steps_log", self)
        trainer.register_op("shutdown", self.bar.close)

    def __call__(self, batch: TensorDictBase) -> None:
        log = self.trainer._log_dict
        figures = {key: f"{float(log[key][-1]):.3f}" for key in self.figures if log.get(key)}
        self.bar.set_postfix(refresh=False, **figures)
        self.bar.update(batch.numel())


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

"""The kit of ant mazes: the kit ``gym``, and what is known by hand of MuJoCo's ant.

Letters: *B batch, S numbers of a state.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import gymnasium
import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torchrl.data import Composite, Unbounded
from torchrl.envs import Compose, EnvBase, RenameTransform, Transform, TransformedEnv
from torchrl.objectives import LossModule

from torchrl_hmcts.envs import MujocoBatch, MujocoTask, OptionPool
from torchrl_hmcts.envs.gym.ant import (
    ACTIONS,
    BODY,
    POSITIONS,
    VELOCITIES,
    AntView,
    AntWorker,
    body_of,
    goal_rings,
    seen_from,
    turns,
    up_of,
)
from torchrl_hmcts.envs.gym.mujoco import find_physics
from torchrl_hmcts.envs.gym.mujoco_batch import RoboticsAntMaze, task_of
from torchrl_hmcts.envs.gym.option_run import OptionWorker
from torchrl_hmcts.envs.gym.settable import make_gym
from torchrl_hmcts.modules import (
    SkillActionCritic,
    SkillActor,
    SkillEncoder,
    SkillPolicy,
    SpectralLinear,
)
from torchrl_hmcts.nesting import given
from torchrl_hmcts.objectives import LSDEncoderLoss, SkillSACLoss
from torchrl_hmcts.trainers.experiments.gym_settings import AntConfig
from torchrl_hmcts.trainers.experiments.kits.gym import GymKit
from torchrl_hmcts.transforms import SkillReward, SkillTransform
from torchrl_hmcts.transforms.env_transform import EnvTransform

_FELL = 0.2  # how far the back is up where an episode of training ends
_METRES = 10.0  # of a reward in which a metre is about 1
_LOSS = {"gamma": 0.98, "alpha_init": 0.1, "fixed_alpha": False, "target_entropy": -float(ACTIONS)}


def make_ant(name: Any, gait: Mapping[str, Any], **keywords: Any) -> AntView:
    """Make an ant maze as the worker sees it."""
    return AntView(make_gym(name, **keywords), **gait)


def open_arena(name: Any, **keywords: Any) -> gymnasium.Env:
    """Make an ant maze whose walls touch nothing."""
    env: gymnasium.Env = make_gym(name, **keywords)
    model, _ = find_physics(env)
    for i in range(model.ngeom):
        if model.geom_bodyid[i] == 0 and model.geom(i).name != "floor":
            model.geom_contype[i] = model.geom_conaffinity[i] = 0
    return env


class Arena(MujocoTask):
    """A task without reward or goal, which ends where the ant falls."""

    def __init__(self, env: gymnasium.Env, *, repeat: int = 1, strength: float = 1.0) -> None:
        super().__init__(env)
        self._maze = task_of(env)
        self.frame_skip, self._strength = self._maze.frame_skip * repeat, np.float32(strength)

    def goal(self) -> np.ndarray:
        return self._maze.goal()

    def begin(self, model: Any, data: Any, action: np.ndarray) -> None:
        data.ctrl[:] = self._strength * action

    def observe(
        self, qpos: np.ndarray, qvel: np.ndarray, derived: np.ndarray, goal: np.ndarray
    ) -> dict[str, np.ndarray]:
        return {}

    def judge(
        self, qpos: np.ndarray, qvel: np.ndarray, goal: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        return np.zeros(len(qpos)), up_of(qpos) < _FELL


class SkillFrame(EnvTransform):
    """Writes the body and its displacement, seen from where and how it was when a skill began."""

    def __init__(self) -> None:
        super().__init__(in_keys=["physics"], out_keys=["body", "displacement", "frame", "origin"])

    def _write(self, td: TensorDictBase, frame: Tensor | None, origin: Tensor | None) -> None:
        physics = td.get("physics").numpy()[..., 1 : 1 + POSITIONS + VELOCITIES]  # 0 is the time
        body, axes = body_of(physics, None if frame is None else np.moveaxis(frame.numpy(), -1, 0))
        place = physics[..., :2]
        began = place.copy() if origin is None else origin.numpy()
        x, y = np.moveaxis(place - began, -1, 0)
        moved, axes = (np.stack(pair, -1) for pair in (seen_from(axes, x, y), axes))
        found = {"body": np.float32(body), "displacement": np.float32(moved)}
        for key, value in {**found, "frame": axes, "origin": began}.items():
            td.set(key, torch.from_numpy(value))

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        frame = given(tensordict, "frame")
        origin = None if frame is None else tensordict.get("origin")
        self._write(tensordict_reset, frame, origin)
        return tensordict_reset

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        self._write(next_tensordict, tensordict.get("frame"), tensordict.get("origin"))
        return next_tensordict

    def _post_step_mdp_hooks(
        self, tensordict: TensorDictBase, tensordict_: TensorDictBase
    ) -> tuple[TensorDictBase, TensorDictBase]:
        began = tensordict_.get("skill_step") == 0
        if began.any():
            fresh = tensordict_.select("physics")
            self._write(fresh, None, None)
            for key in self.out_keys:
                tensordict_.set(key, torch.where(began, fresh.get(key), tensordict_.get(key)))
        return tensordict, tensordict_

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        shape = observation_spec.shape
        for key, width in (("body", BODY), ("displacement", 2)):
            observation_spec[key] = Unbounded((*shape, width))
        return self.transform_state_spec(observation_spec)

    def transform_state_spec(self, state_spec: Composite) -> Composite:
        for key in ("frame", "origin"):
            state_spec[key] = Unbounded((*state_spec.shape, 2), dtype=torch.float64)
        return state_spec


class Imagine(Transform):
    """Replays a share of transitions as those of another skill, by an ant with its legs renamed.

    Both are exact: the reward is a function of skill and displacement, and a turned body moves as
    the body does.
    """

    def __init__(self, num_skills: int, share: float) -> None:
        super().__init__(in_keys=[], out_keys=[])
        self.num_skills, self.share = num_skills, share
        self._turns = dict(zip(("body", "action", "displacement"), turns(), strict=True))

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Change a batch ``[*B]``."""
        td = tensordict.copy()
        after = td.get("next").copy()
        td.set("next", after)
        shape = td.batch_size
        changed = torch.rand(shape) < self.share
        skill = torch.where(changed, torch.randint(self.num_skills, shape), td.get("skill"))
        quarters = (torch.randint(4, shape) * changed).numpy()
        for part, keys in ((td, self._turns), (after, ("body", "displacement"))):
            part.set("skill", skill)
            for key in keys:
                turned = self._turns[key](part.get(key).numpy(), quarters)
                part.set(key, torch.from_numpy(turned))
        return td


class NormalizedReLU(nn.Module):
    """ReLU of what is brought to mean 0 and variance 1, for a critic that is updated often."""

    def forward(self, x: Tensor) -> Tensor:
        """Return ``[*B, n]`` of ``[*B, n]``."""
        return nn.functional.layer_norm(x, x.shape[-1:]).relu()


class AntKit(GymKit):
    """Ant mazes of OGBench and gymnasium-robotics, with what is known by hand of the ant.

    Skills are learned by LSD where no wall touches, in an episode that ends where the ant falls;
    :class:`AntView`, :class:`SkillFrame` and :class:`Imagine` say what is given besides.
    """

    worker_keys = ("body",)  # type: ignore[assignment]
    config: AntConfig
    shorter_paths = True  # type: ignore[assignment]  # an episode is short for the longest ways

    def __init__(self, config: AntConfig, env: Any = None) -> None:
        self._name = config.id if env is None else env
        super().__init__(config, env)
        self.look = replace(self.look, features=goal_rings)

    def maker(self, name: Any) -> Any:
        config = self.config
        slow = isinstance(AntView(make_gym(name, **config.make)).task, RoboticsAntMaze)
        self._gait: dict[str, Any] = {
            "repeat": config.repeat or (2 if slow else 1),
            "strength": config.strength or (0.3 if slow else 1.0),
        }
        return self._made(np.zeros((2 * config.num_skills, 2)))

    def _made(self, directions: np.ndarray) -> Any:
        mask = {"directions": directions} if self.config.options == "learned" else {}
        return partial(make_ant, self._name, {**self._gait, **mask})

    def prepare(self, worker: Any) -> None:
        """Try each option where no wall is, and take note of its direction for the mask."""
        arena = partial(make_ant, partial(open_arena, self._name), self._gait)
        pool = OptionPool(
            partial(arena, **self.config.make),
            self.pool_worker(worker),
            max_steps=self.config.option_steps,
            num_processes=0,
            seed=self.config.seed,
        )
        start = pool.reset()
        after = pool.step(
            start.expand(pool.num_options).clone().set("option", torch.arange(pool.num_options))
        )["next"]
        x, y = (after["achieved_goal"] - start["achieved_goal"]).numpy().T
        _, frame = body_of(start["physics"].numpy())
        moved = np.stack(seen_from(frame, x, y), -1)
        pool.close()
        length = np.linalg.norm(moved, axis=-1, keepdims=True)
        self._env = self._made(moved / np.maximum(length, 1.0))

    def _arena(self, shape: list[int], *more: Transform) -> EnvBase:
        config = self.config
        base = MujocoBatch(
            partial(open_arena, self._name, **config.make),
            task=partial(Arena, **self._gait),
            batch_size=shape,
            seed=config.seed,
        )
        skills = SkillTransform(config.num_skills, max_skill_steps=config.skill_steps)
        return TransformedEnv(base, Compose(skills, SkillFrame(), *more))

    def describe(self) -> str:
        config = self.config
        return (
            f"{config.id}: {config.num_skills} skills, each as it is and after half a turn, in "
            f"options of {config.option_steps} actions; {self._gait['repeat']} env steps an "
            f"action, {self._gait['strength']:g} of the torques."
        )

    def make_training_env(self, num_envs: int = 16) -> EnvBase:
        return self._arena([num_envs])

    def make_loss(self) -> LossModule:
        config = self.config
        sizes: dict[str, Any] = {"hidden": (config.hidden, config.hidden), "in_keys": ["body"]}
        spec = self.make_training_env(1).action_spec_unbatched
        count = config.num_skills
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(config.seed)
            encoder = SkillEncoder(
                2, count, in_keys=["displacement"], hidden=(), linear=SpectralLinear
            )
            actor = SkillActor(BODY, spec, count, **sizes)
            critic = SkillActionCritic(BODY, ACTIONS, count, activation=NormalizedReLU, **sizes)
            return SkillSACLoss(actor, critic, LSDEncoderLoss(encoder), **{**_LOSS, **config.loss})

    def trainer_part(self, loss: Any) -> dict[str, Any]:
        config = self.config
        reward = SkillReward(loss.objective, intrinsic_coeff=_METRES)
        rates = dict.fromkeys(("actor_lr", "critic_lr", "alpha_lr"), 5e-4)
        return {
            **rates,
            "objective_lr": 1e-3,
            "target_tau": 0.01,
            "buffer_size": config.train_steps,
            "reward": Compose(Imagine(config.num_skills, config.imagined), reward),
        }

    def pool_worker(self, worker: SkillPolicy) -> OptionWorker:
        return AntWorker(worker.actor)

    @property
    def manager_keys(self) -> Sequence[Any]:
        return [key for key in self.state_entries if key != "action_mask"]

    def map(self, env: EnvBase) -> Any:
        from torchrl_hmcts.trainers.figures.maps import FeatureMap

        arena = self._arena([], RenameTransform(["position"], ["features"], create_copy=True))
        return FeatureMap(arena, "features", names=("x", "y"), is_place=True)

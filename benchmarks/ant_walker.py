"""The ant of the AntMaze benchmark: what its worker sees, its symmetry, how it learns and walks.

Two symmetries are given to the worker, and no reward: the plane has no north, so that a skill sees
the world from where and how the ant stood when the skill began; and a quarter turn of the body
renames its legs, so that what one skill learns can be taken in four directions.

Letters: *B batch, S numbers of a state, z a skill, q a number of quarter turns.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torch.nn.functional import normalize
from torchrl.data import Composite, Unbounded
from torchrl.envs import Transform

from torchrl_hmcts.envs import MujocoBatch, MujocoTask
from torchrl_hmcts.envs.gym.mujoco import find_physics
from torchrl_hmcts.envs.gym.mujoco_tasks import task_of
from torchrl_hmcts.envs.gym.settable import make_gym
from torchrl_hmcts.modules import SkillActor
from torchrl_hmcts.nesting import given
from torchrl_hmcts.transforms.env_transform import EnvTransform

BODY, ACTIONS = 32, 8
_LEGS = [2, 3, 4, 5, 6, 7, 0, 1]  # leg i of a body turned by a quarter is leg i + 1
_BENDS = [1.0, -1.0, 1.0, 1.0, 1.0, -1.0, 1.0, 1.0]  # ankles of every other leg bend the other way
_ACTUATORS = [6, 7, 0, 1, 2, 3, 4, 5]  # are those of legs 4, 1, 2 and 3


# ---------------------------------------------------------------- what the worker sees


def seen_from(frame: Tensor, vector: Tensor) -> Tensor:
    """Vectors ``[*B, 2]`` in a frame, whose first axis has this cosine and sine ``[*B, 2]``."""
    c, s = frame[..., :1], frame[..., 1:]
    x, y = vector[..., :1], vector[..., 1:]
    return torch.cat((c * x + s * y, c * y - s * x), -1)


def body_of(physics: Tensor, frame: Tensor | None) -> tuple[Tensor, Tensor]:
    """What the worker sees of states ``[*B, S]`` in a frame ``[*B, 2]``, and the frame.

    Height, rotation matrix, joints, and all velocities, scaled: ``[*B, 32]``. Without a frame, in
    that of its own heading, which turns by a quarter where the body does.
    """
    qpos, qvel = physics[..., 1:16], physics[..., 16:30]
    w, x, y, z = normalize(qpos[..., 3:7], dim=-1).unbind(-1)
    rows = (
        torch.stack((1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)), -1),
        torch.stack((2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)), -1),
        torch.stack((2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)), -1),
    )
    if frame is None:
        cosine = rows[0][..., 0] + rows[1][..., 1]
        frame = normalize(torch.stack((cosine, rows[1][..., 0] - rows[0][..., 1]), -1), dim=-1)
    c, s = frame[..., :1], frame[..., 1:]
    parts = (
        qpos[..., 2:3],
        c * rows[0] + s * rows[1],
        c * rows[1] - s * rows[0],
        rows[2],
        qpos[..., 7:],
        0.5 * seen_from(frame, qvel[..., :2]),
        0.5 * qvel[..., 2:3],
        0.25 * qvel[..., 3:6],
        0.1 * qvel[..., 6:],
    )
    return torch.cat(parts, -1), frame


def up_of(qpos: Any) -> Any:
    """How far the ant's back is up, 1 to -1."""
    return 1 - 2 * (qpos[..., 4] ** 2 + qpos[..., 5] ** 2)


@dataclass(frozen=True)
class Turn:
    """A body or an action after 0 to 3 quarter turns: its number i is ``sign * x[index[q, i]]``."""

    index: Tensor  # int64 [4, n]
    sign: Tensor  # float32 [4, n]

    @classmethod
    def of(cls, quarter: Tensor) -> Turn:
        """Of the signed permutation ``[n, n]`` of one quarter turn."""
        powers = torch.stack([torch.linalg.matrix_power(quarter, q) for q in range(4)])
        index = powers.abs().argmax(-1)
        return cls(index, powers.gather(-1, index.unsqueeze(-1)).squeeze(-1))

    def __call__(self, x: Tensor, quarters: Tensor) -> Tensor:
        """Turn ``[*B, n]`` by ``[*B]`` quarters."""
        return x.gather(-1, self.index[quarters]) * self.sign[quarters].to(x.dtype)


def turns() -> tuple[Turn, Turn, Turn]:
    """The turns of what :func:`body_of` returns, of an action and of a vector in the plane."""
    plane = torch.tensor([[0.0, 1.0], [-1.0, 0.0]])
    space = torch.block_diag(plane, torch.ones(1, 1))
    legs = torch.eye(8)[_LEGS] * torch.tensor(_BENDS).unsqueeze(-1)
    body = torch.block_diag(torch.ones(1, 1), torch.kron(space, space), legs, space, space, legs)
    order = torch.eye(8)[_ACTUATORS]
    return Turn.of(body), Turn.of(order @ legs @ order.T), Turn.of(plane)


# ---------------------------------------------------------------- how it moves and learns


@dataclass(frozen=True)
class Gait:
    """How an action of the worker moves the ant: env steps that it lasts, share of the torques.

    Both ants act at 10 Hz with about the same torque: that of gymnasium-robotics has 5 times the
    torque of OGBench's, with which an untrained one somersaults.
    """

    repeat: int = 1
    strength: float = 1.0

    @staticmethod
    def of(name: str) -> Gait:
        return Gait() if name.startswith("antmaze") else Gait(2, 0.3)

    def task(self, env: Any) -> MujocoTask:
        """The task of an env, of its own steps, without the forces of contacts."""
        task = task_of(env)
        task.derived = ()
        task.frame_skip *= self.repeat
        task.begin = self._begin  # type: ignore[method-assign]
        task.observe = lambda qpos, qvel, derived, goal: {}  # type: ignore[method-assign]
        return task

    def arena(self, env: Any) -> MujocoTask:
        """The task in which the worker learns: no reward, and the end where the ant falls."""
        task = self.task(env)
        task.judge = lambda qpos, qvel, goal: (np.zeros(len(qpos)), up_of(qpos) < 0.2)  # type: ignore[method-assign]
        return task

    def _begin(self, model: Any, data: Any, action: np.ndarray) -> None:
        data.ctrl[:] = np.float32(self.strength) * action


def open_arena(name: str) -> Any:
    """Make an ant maze whose walls touch nothing."""
    env = make_gym(name)
    model, _ = find_physics(env)
    for i in range(model.ngeom):
        if model.geom_bodyid[i] == 0 and model.geom(i).name != "floor":
            model.geom_contype[i] = model.geom_conaffinity[i] = 0
    return env


class SkillFrame(EnvTransform):
    """Writes the body and its displacement, seen from where and how it was when a skill began."""

    def __init__(self) -> None:
        super().__init__(in_keys=["physics"], out_keys=["body", "displacement", "frame", "origin"])

    def _write(self, td: TensorDictBase, frame: Tensor | None, origin: Tensor | None) -> None:
        physics = td.get("physics")
        body, frame = body_of(physics, frame)
        place = physics[..., 1:3]
        origin = place.clone() if origin is None else origin
        td.set("body", body.float()).set("frame", frame).set("origin", origin)
        td.set("displacement", seen_from(frame, place - origin).float())

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
        self.body, self.action, self.plane = turns()

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        td = tensordict.copy()
        after = td.get("next").copy()
        td.set("next", after)
        shape = td.batch_size
        changed = torch.rand(shape) < self.share
        skill = torch.where(changed, torch.randint(self.num_skills, shape), td.get("skill"))
        quarters = torch.randint(4, shape) * changed
        for part in (td, after):
            part.set("skill", skill)
            part.set("body", self.body(part.get("body"), quarters))
            part.set("displacement", self.plane(part.get("displacement"), quarters))
        return td.set("action", self.action(td.get("action"), quarters))


def normalized(width: int) -> Any:
    """Builds the activation of a critic that is updated often."""
    return lambda: nn.Sequential(nn.LayerNorm(width, elementwise_affine=False), nn.ReLU())


class Walker(TensorDictModuleBase):
    """Walks by a skill and quarter turns of the body, from the heading that an option began with.

    Of the quarter turns only half turns are taken, option ``2 z + h``: three skills are six
    directions. The network runs in double precision and its mean action is rounded to single, so
    that it does not depend on how many states are walked at once, and a plan is executed to the
    bit.
    """

    def __init__(self, actor: SkillActor) -> None:
        super().__init__()
        self.network = copy.deepcopy(actor.network).double().requires_grad_(False)
        self.num_options = 2 * actor.num_skills
        self.in_keys = ["physics", "skill", "frame"]
        self.out_keys = ["action", ("next", "frame")]
        self.body, self.action, _ = turns()

    @torch.no_grad()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        physics, option = tensordict.get("physics"), tensordict.get("skill")
        kept = tensordict.get("frame", None)  # zeros where the option begins
        body, frame = body_of(physics, None)
        if kept is not None and kept.any():
            frame = torch.where(kept.any(-1, keepdim=True), kept, frame)
            body, _ = body_of(physics, frame)
        quarters = 2 * (option % 2)
        outputs = self.network(self.body(body, quarters), option // 2)
        action = outputs[..., :ACTIONS].tanh().float()
        tensordict.set("action", self.action(action, (4 - quarters) % 4))
        return tensordict.set(("next", "frame"), frame)


def fallen(td: TensorDictBase) -> Tensor:
    """Whether the ant lies on its back, bool ``[*B]``: the end of an option."""
    return up_of(td.get("physics")[..., 1:16]) < 0.0


def act(
    env: Any, batch: MujocoBatch, worker: Walker, option: int, steps: int
) -> tuple[float, bool, int, list[list[float]]]:
    """Execute an option in a Gymnasium env: what it earned, the end, env steps, places."""
    gait = Gait.of(env.spec.id)
    td = batch.read(env).select("physics").set("skill", torch.tensor(option))
    path, earned, taken, ended = [td["physics"][1:3].tolist()], 0.0, 0, False
    for _ in range(steps):
        action = np.float32(gait.strength) * worker(td)["action"].numpy()
        for _ in range(gait.repeat):
            if not ended:
                _, reward, terminated, truncated, _ = env.step(action)
                earned, taken, ended = earned + float(reward), taken + 1, terminated or truncated
        td.set("frame", td["next", "frame"]).set("physics", batch.read(env)["physics"])
        path.append(td["physics"][1:3].tolist())
        if ended or bool(fallen(td)):
            break
    return earned, ended, taken, path

"""AntMaze: an ant learns to walk without a reward, and a planner takes its skills to goals."""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torchrl.data import Composite, Unbounded
from torchrl.envs import Compose, Transform, TransformedEnv

from torchrl_hmcts.envs import MujocoBatch
from torchrl_hmcts.envs.gym.mujoco import find_physics
from torchrl_hmcts.envs.gym.mujoco_tasks import task_of
from torchrl_hmcts.envs.gym.settable import make_gym
from torchrl_hmcts.modules import (
    SkillActionCritic,
    SkillActor,
    SkillEncoder,
    SpectralLinear,
)
from torchrl_hmcts.nesting import given
from torchrl_hmcts.objectives import LSDEncoderLoss, SkillSACLoss
from torchrl_hmcts.trainers.diayn import DIAYNTrainer
from torchrl_hmcts.transforms import SkillReward, SkillTransform
from torchrl_hmcts.transforms.env_transform import EnvTransform

BODY, JOINTS, ACTIONS = 32, 8, 8
# What leg i is called when the body is said to be turned by a quarter: leg i + 1, ankles of every
# other leg bend the other way.
_LEG = [2, 3, 4, 5, 6, 7, 0, 1]
_BEND = [1, -1, 1, 1, 1, -1, 1, 1]


def heading(rotation: Tensor) -> Tensor:
    """Cosine and sine of the turn about the vertical, ``[*B, 2]``, of rotations ``[*B, 3, 3]``."""
    flat = torch.stack(
        (
            rotation[..., 0, 0] + rotation[..., 1, 1],
            rotation[..., 1, 0] - rotation[..., 0, 1],
        ),
        -1,
    )
    return torch.nn.functional.normalize(flat, dim=-1)


def rotation_of(quaternion: Tensor) -> Tensor:
    """Rotation matrices ``[*B, 3, 3]`` of quaternions ``[*B, 4]``."""
    w, x, y, z = torch.nn.functional.normalize(quaternion, dim=-1).unbind(-1)
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return torch.stack([torch.stack(row, -1) for row in rows], -2)


def turned_back(vector: Tensor, frame: Tensor) -> Tensor:
    """Vectors ``[*B, 2]`` as seen from a frame (cosine, sine) ``[*B, 2]``."""
    c, s = frame[..., :1], frame[..., 1:]
    x, y = vector[..., :1], vector[..., 1:]
    return torch.cat((c * x + s * y, c * y - s * x), -1)


def body_of(physics: Tensor, frame: Tensor | None) -> tuple[Tensor, Tensor]:
    """What the worker sees, ``[*B, 32]``, from a frame ``[*B, 2]``; its own heading if None."""
    qpos, qvel = physics[..., 1:16], physics[..., 16:30]
    rotation = rotation_of(qpos[..., 3:7])
    if frame is None:
        frame = heading(rotation)
    seen = torch.stack([turned_back(rotation[..., :2, i], frame) for i in range(3)], -1)
    rows = torch.cat((seen, rotation[..., 2:, :]), -2)  # [*B, 3, 3]
    velocity = turned_back(qvel[..., :2], frame)
    parts = (
        qpos[..., 2:3],
        rows.flatten(-2),
        qpos[..., 7:],
        0.5 * velocity,
        0.5 * qvel[..., 2:3],
        0.25 * qvel[..., 3:6],
        0.1 * qvel[..., 6:],
    )
    return torch.cat(parts, -1), frame


def quarter_turns() -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """The index and sign of each number of a body, and of an action, after 0 to 3 quarter turns."""

    def matrix_of(size: int, pairs: list[tuple[int, int, float]]) -> Tensor:
        matrix = torch.zeros(size, size, dtype=torch.float64)
        for out, source, sign in pairs:
            matrix[out, source] = sign
        return matrix

    turn = torch.tensor([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
    legs = matrix_of(8, [(i, _LEG[i], _BEND[i]) for i in range(8)])
    one = torch.ones(1, 1, dtype=torch.float64)
    body = torch.block_diag(one, torch.kron(turn, turn), legs, turn, turn, legs)
    # Actuators are those of legs 4, 1, 2, 3.
    order = torch.tensor([6, 7, 0, 1, 2, 3, 4, 5])
    shuffle = torch.zeros(8, 8, dtype=torch.float64)
    shuffle[torch.arange(8), order] = 1.0
    action = shuffle @ legs @ shuffle.T
    out = []
    for matrix in (body, action):
        powers = torch.stack([torch.linalg.matrix_power(matrix, q) for q in range(4)])
        index = powers.abs().argmax(-1)
        out += [index, powers.gather(-1, index.unsqueeze(-1)).squeeze(-1).float()]
    return tuple(out)  # type: ignore[return-value]


class SkillFrame(EnvTransform):
    """Writes the body and its displacement as seen from where and how it stood when a skill began."""

    def __init__(self) -> None:
        super().__init__(in_keys=["physics"], out_keys=["body", "displacement", "frame", "origin"])

    def _write(self, td: TensorDictBase, frame: Tensor | None, origin: Tensor | None) -> None:
        physics = td.get("physics")
        body, frame = body_of(physics, frame)
        place = physics[..., 1:3]
        origin = place.clone() if origin is None else origin
        td.set("body", body.float()).set("frame", frame).set("origin", origin)
        td.set("displacement", turned_back(place - origin, frame).float())

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
        for key in ("frame", "origin"):
            observation_spec[key] = Unbounded((*shape, 2), dtype=torch.float64)
        return observation_spec

    def transform_state_spec(self, state_spec: Composite) -> Composite:
        for key in ("frame", "origin"):
            state_spec[key] = Unbounded((*state_spec.shape, 2), dtype=torch.float64)
        return state_spec


class Imagine(Transform):
    """Replays transitions under other skills, and with the ant's legs renamed by quarter turns."""

    def __init__(self, num_skills: int, *, turns: bool = True, skills: bool = True) -> None:
        super().__init__(in_keys=[], out_keys=[])
        self.num_skills, self.turns, self.skills = num_skills, turns, skills
        self.tables = quarter_turns()

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        td = tensordict.copy()
        after = td.get("next").copy()
        td.set("next", after)
        shape = td.batch_size
        if self.skills:
            skill = torch.randint(self.num_skills, shape)
            other = torch.where(torch.rand(shape) < 0.5, skill, td.get("skill"))
            td.set("skill", other)
            after.set("skill", other)
        if self.turns:
            quarter = torch.randint(4, shape)
            index, sign, action_index, action_sign = (table[quarter] for table in self.tables)
            frame = torch.tensor([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]])[quarter]
            for part in (td, after):
                part.set("body", part.get("body").gather(-1, index) * sign)
                part.set("displacement", turned_back(part.get("displacement"), frame))
            td.set("action", td.get("action").gather(-1, action_index) * action_sign)
        return td


def open_arena(name: str, **keywords: Any) -> Any:
    """Make an ant maze whose walls touch nothing."""
    env = make_gym(name, **keywords)
    model, _ = find_physics(env)
    for i in range(model.ngeom):
        if model.geom_bodyid[i] == 0 and model.geom(i).name != "floor":
            model.geom_contype[i] = model.geom_conaffinity[i] = 0
    return env


def walking(least_up: float) -> Any:
    """A task without a reward, which ends where the ant lies on its back or side."""

    def task(env: Any) -> Any:
        made = task_of(env)
        made.derived = ()
        made.observe = lambda qpos, qvel, derived, goal: {}

        def judge(qpos: np.ndarray, qvel: np.ndarray, goal: np.ndarray) -> Any:
            x, y = qpos[:, 4], qpos[:, 5]
            upright = 1 - 2 * (x * x + y * y)
            return np.zeros(len(qpos)), upright < least_up

        made.judge = judge
        return made

    return task


def activation() -> nn.Module:
    return nn.Sequential(nn.LayerNorm(256, elementwise_affine=False), nn.ReLU())


def learn(
    name: str,
    *,
    seed: int = 0,
    total_frames: int = 400_000,
    num_skills: int = 3,
    skill_steps: int = 100,
    copies: int = 16,
    frames_per_batch: int = 64,
    updates_per_batch: int = 16,
    lr: float = 5e-4,
    objective_lr: float = 1e-3,
    gamma: float = 0.98,
    scale: float = 10.0,
    alpha: float = 0.1,
    tuned: bool = True,
    target_entropy: float = -8.0,
    tau: float = 0.01,
    batch_size: int = 256,
    report: Any = None,
    progress: Any = None,
    **keywords: Any,
) -> SkillSACLoss:
    torch.manual_seed(seed)
    base = MujocoBatch(
        lambda: open_arena(name, **keywords),
        task=walking(0.2),
        batch_size=[copies],
        seed=seed,
    )
    env = TransformedEnv(
        base, Compose(SkillTransform(num_skills, max_skill_steps=skill_steps), SkillFrame())
    )
    sizes = {"hidden": (256, 256), "in_keys": ["body"]}
    encoder = SkillEncoder(
        2, num_skills, in_keys=["displacement"], hidden=(), linear=SpectralLinear
    )
    loss = SkillSACLoss(
        SkillActor(BODY, base.action_spec_unbatched, num_skills, **sizes),
        SkillActionCritic(BODY, ACTIONS, num_skills, activation=activation, **sizes),
        LSDEncoderLoss(encoder),
        gamma=gamma,
        alpha_init=alpha,
        fixed_alpha=not tuned,
        target_entropy=target_entropy,
    )
    trainer = DIAYNTrainer(
        env,
        loss,
        total_frames=total_frames,
        frames_per_batch=frames_per_batch,
        updates_per_batch=updates_per_batch,
        batch_size=batch_size,
        buffer_size=total_frames,
        actor_lr=lr,
        critic_lr=lr,
        objective_lr=objective_lr,
        alpha_lr=lr,
        target_tau=tau,
        reward=Compose(Imagine(num_skills), SkillReward(loss.objective, intrinsic_coeff=scale)),
        seed=seed,
    )
    if report is not None:
        trainer.register_op("post_steps_log", report(trainer, loss))
    trainer.train()
    return loss


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("name")
    parser.add_argument("--frames", type=int, default=400_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path)
    parser.add_argument("--set", nargs="*", default=[])
    args = parser.parse_args()
    torch.set_num_threads(1)
    extra = {k: float(v) if "." in v else int(v) for k, v in (x.split("=") for x in args.set)}

    def report(trainer: Any, loss: Any) -> Any:
        state = {"n": 0, "moved": [], "fell": [], "t": time.process_time()}

        def hook(batch: TensorDictBase) -> dict[str, float]:
            state["n"] += batch.numel()
            ends = batch["next", "terminated"].float().mean()
            state["fell"].append(float(ends))
            step = (batch["next", "displacement"] - batch["displacement"]).norm(dim=-1)
            with torch.no_grad():
                w = loss.objective.reward(batch).squeeze(-1)
            state["moved"].append((float(step.mean()), float(w.mean())))
            if state["n"] % 6400 < batch.numel():
                last = {k: v[-1] for k, v in trainer.history.items() if len(v)}
                keys = ("actor_loss", "critic_loss", "alpha", "entropy", "encoder_loss", "grad_norm")
                m = np.mean(state["moved"][-100:], 0)
                print(
                    state["n"], f"cpu {time.process_time() - state['t']:.0f} step {m[0]:.4f} "
                    f"along {m[1]:.4f} fell {np.mean(state['fell'][-100:]):.4f}",
                    {k: round(last[k], 3) for k in keys if k in last}, flush=True,
                )
                if args.out and state["n"] % 51200 < batch.numel():
                    torch.save(loss.state_dict(), args.out)
            return {}

        return hook

    loss = learn(args.name, seed=args.seed, total_frames=args.frames, report=report, **extra)
    if args.out:
        torch.save(loss.state_dict(), args.out)


if __name__ == "__main__":
    main()

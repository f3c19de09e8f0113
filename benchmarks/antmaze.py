"""AntMaze: an ant learns to walk without a reward, and a planner takes its skills to goals."""

from __future__ import annotations

import argparse
import copy
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
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
from torchrl_hmcts.planners import UCT, MCTSPlanner, RadiusNovelty, SearchBudget, extract_plans
from torchrl_hmcts.trainers.diayn import DIAYNTrainer
from torchrl_hmcts.transforms import OptionTransform, SkillReward, SkillTransform
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
    """Writes the body and its displacement, seen from where and how it was when a skill began."""

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

    def __init__(self, num_skills: int, share: float) -> None:
        super().__init__(in_keys=[], out_keys=[])
        self.num_skills, self.share = num_skills, share
        self.tables = quarter_turns()

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        td = tensordict.copy()
        after = td.get("next").copy()
        td.set("next", after)
        shape = td.batch_size
        changed = torch.rand(shape) < self.share
        skill = torch.where(changed, torch.randint(self.num_skills, shape), td.get("skill"))
        quarter = torch.randint(4, shape) * changed
        td.set("skill", skill)
        after.set("skill", skill)
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


def normalized(width: int) -> Any:
    """Builds the activation of a critic that is updated often."""
    return lambda: nn.Sequential(nn.LayerNorm(width, elementwise_affine=False), nn.ReLU())


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
    imagined: float = 0.5,
    width: int = 256,
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
    sizes = {"hidden": (width, width), "in_keys": ["body"]}
    encoder = SkillEncoder(
        2, num_skills, in_keys=["displacement"], hidden=(), linear=SpectralLinear
    )
    loss = SkillSACLoss(
        SkillActor(BODY, base.action_spec_unbatched, num_skills, **sizes),
        SkillActionCritic(BODY, ACTIONS, num_skills, activation=normalized(width), **sizes),
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
        reward=Compose(
            Imagine(num_skills, imagined), SkillReward(loss.objective, intrinsic_coeff=scale)
        ),
        seed=seed,
    )
    if report is not None:
        trainer.register_op("post_steps_log", report(trainer, loss))
    trainer.train()
    return loss


class Walker(TensorDictModuleBase):
    """Walks by a skill and a quarter turn: option ``4 z + q``, from the heading where it began.

    The network runs in double precision and its mean action is rounded to single, so that it does
    not depend on how many states are walked at once.
    """

    def __init__(self, actor: SkillActor) -> None:
        super().__init__()
        self.network = copy.deepcopy(actor.network).double().requires_grad_(False)
        self.num_options = 4 * actor.num_skills
        self.in_keys = ["physics", "skill", "frame"]
        self.out_keys = ["action", ("next", "frame")]
        self.tables = quarter_turns()

    @torch.no_grad()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        physics, option = tensordict.get("physics"), tensordict.get("skill")
        kept = tensordict.get("frame", None)
        body, frame = body_of(physics, None)
        if kept is not None and kept.any():
            frame = torch.where(kept.any(-1, keepdim=True), kept, frame)
            body, _ = body_of(physics, frame)
        skill, quarter = option // 4, option % 4
        index, sign, _, _ = (table[quarter] for table in self.tables)
        _, _, action_index, action_sign = (table[(4 - quarter) % 4] for table in self.tables)
        outputs = self.network(body.gather(-1, index) * sign, skill)
        action = outputs[..., :ACTIONS].tanh().float()
        tensordict.set("action", action.gather(-1, action_index) * action_sign)
        return tensordict.set(("next", "frame"), frame)


class Fallen:
    """Ends an option where the ant lies on its back."""

    def __call__(self, td: TensorDictBase) -> Tensor:
        x, y = td.get("physics")[..., 5:6], td.get("physics")[..., 6:7]
        return 1 - 2 * (x * x + y * y) < 0.0


def make_planner(batch: MujocoBatch, worker: Walker, option_steps: int, radius: float, **kw: Any):
    options = OptionTransform(worker, worker.num_options, option_steps, termination=Fallen())
    env = TransformedEnv(batch, options)
    settings: dict[str, Any] = {
        "tree_policy": UCT(c=1.0),
        "novelty": RadiusNovelty("position", radius),
        "budget": SearchBudget(expansions=3000),
        "leaves_per_wave": 4,
    }
    return MCTSPlanner(env, **(settings | kw))


def act(env: Any, batch: MujocoBatch, worker: Walker, option: int, steps: int) -> tuple[Any, ...]:
    """Execute an option in a Gymnasium env; its reward, end, base steps and path."""
    td = batch.read(env).select("physics").set("skill", torch.tensor(option))
    path, earned = [td["physics"][1:3].tolist()], 0.0
    for i in range(steps):  # noqa: B007
        worker(td)
        _, reward, terminated, truncated, _ = env.step(td["action"].numpy())
        td.set("frame", td["next", "frame"]).set("physics", batch.read(env)["physics"])
        path.append(td["physics"][1:3].tolist())
        earned += float(reward)
        if terminated or truncated or bool(Fallen()(td)):
            break
    return earned, terminated, truncated, i + 1, path


def solve(
    name: str,
    actor: SkillActor,
    starts: Any,
    *,
    option_steps: int,
    radius: float,
    max_plans: int = 5,
    **kw: Any,
) -> list[dict[str, Any]]:
    worker = Walker(actor)
    keywords = {} if name[0] == "a" else {"continuing_task": False}
    batch = MujocoBatch(name, seed=0, **keywords)
    real = make_gym(name, **keywords)
    planner = make_planner(batch, worker, option_steps, radius, **kw)
    rows = []
    for seed, options in starts:
        real.reset(seed=seed, options=dict(options) if options else None)
        start = batch.read(real)
        row: dict[str, Any] = {"seed": seed, "plans": 0, "plan_cpu": [], "steps": 0, "simulated": 0}
        row["task"] = options
        row["start"], row["goal"] = start["position"].tolist(), start["goal"].tolist()
        solved = ended = False
        path = []
        while not ended and row["plans"] < max_plans:
            begin = time.process_time()
            state = batch.read(real)
            search = planner.search(state)
            plan = extract_plans(search)[0]
            row["plan_cpu"].append(round(time.process_time() - begin, 2))
            row["simulated"] += int(search.num_base_steps[0])
            row["nodes"] = (
                int(search.tree.num_nodes[0]) if hasattr(search.tree, "num_nodes") else None
            )
            row["plans"] += 1
            if not bool(plan.found):
                break
            options_taken = plan.options[: int(plan.lengths)].tolist()
            row["options"] = len(options_taken)
            for i, option in enumerate(options_taken):
                earned, terminated, truncated, steps, new = act(
                    real, batch, worker, option, option_steps
                )
                path += new
                row["steps"] += steps
                ended = terminated or truncated
                solved = solved or earned > 0
                if ended or solved:
                    ended = True
                    break
                expected = plan.states.get("physics")[i + 1]
                if not torch.equal(expected, batch.read(real)["physics"]):
                    row["differs"] = row.get("differs", 0) + 1
                    break
        row["solved"] = solved
        row["path"] = path
        rows.append(row)
        print({k: v for k, v in row.items() if k != "path"}, flush=True)
    return rows


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
                keys = (
                    "actor_loss",
                    "critic_loss",
                    "alpha",
                    "entropy",
                    "encoder_loss",
                    "grad_norm",
                )
                m = np.mean(state["moved"][-100:], 0)
                print(
                    state["n"],
                    f"cpu {time.process_time() - state['t']:.0f} step {m[0]:.4f} "
                    f"along {m[1]:.4f} fell {np.mean(state['fell'][-100:]):.4f}",
                    {k: round(last[k], 3) for k in keys if k in last},
                    flush=True,
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

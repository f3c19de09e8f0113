"""The ant of the ant mazes: what its worker sees and does, and the symmetry of its legs.

The plane has no north, and a quarter turn of the body renames its legs. Letters: *B batch, q a
number of quarter turns.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import gymnasium
import numpy as np
import torch
from gymnasium import spaces

from torchrl_hmcts.envs.gym.mujoco import find_physics
from torchrl_hmcts.envs.gym.mujoco_batch import task_of
from torchrl_hmcts.envs.gym.skill_worker import SkillWorker
from torchrl_hmcts.envs.gym.snapshots import SnapshotError
from torchrl_hmcts.modules import SkillActor

POSITIONS, VELOCITIES, BODY, ACTIONS = 15, 14, 32, 8
_LEGS = [2, 3, 4, 5, 6, 7, 0, 1]  # leg i of a body turned by a quarter is leg i + 1
_BENDS = [1.0, -1.0, 1.0, 1.0, 1.0, -1.0, 1.0, 1.0]  # ankles of every other leg bend the other way
_BACK = -0.7  # cosine between walk and option: what is less is to turn back
_WALKS = 0.7  # metres a second
_NEAR, _ZOOM = 4.0, 4.0  # metres from the goal within which a metre counts as 4
_ACTUATORS = [6, 7, 0, 1, 2, 3, 4, 5]  # are those of legs 4, 1, 2 and 3


def seen_from(frame: Sequence[Any], x: Any, y: Any) -> tuple[Any, Any]:
    """Return (x, y) as seen in a frame: cosine and sine of its first axis, each ``[*B]``."""
    c, s = frame
    return c * x + s * y, c * y - s * x


def _scaled(*x: Any) -> list[Any]:
    """A vector at length 1, or 0 where it has none."""
    square = sum(number * number for number in x)
    length = square**0.5 + (square == 0)
    return [number / length for number in x]


def body_of(physics: np.ndarray, frame: Any = None) -> tuple[np.ndarray, Any]:
    """Return what the worker sees of ``qpos`` and ``qvel``, ``[*B, 29]``, and the frame.

    It is height, rotation matrix, joints and all velocities, scaled, ``[*B, 32]``. The frame, its
    cosine and sine, is by default that of the body's own heading, which turns by a quarter where
    the body does.
    """
    single = physics.ndim == 1  # numbers of Python are faster than arrays of one
    numbers = physics.tolist() if single else list(np.moveaxis(physics, -1, 0))
    qpos, qvel = numbers[:POSITIONS], numbers[POSITIONS:]
    w, x, y, z = _scaled(*qpos[3:7])
    first = (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y))
    second = (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x))
    third = (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y))
    if frame is None:
        frame = _scaled(first[0] + second[1], second[0] - first[1])
    seen = [seen_from(frame, *pair) for pair in zip(first, second, strict=True)]
    speed = seen_from(frame, qvel[0], qvel[1])
    body = (
        [qpos[2], *(pair[0] for pair in seen), *(pair[1] for pair in seen), *third, *qpos[7:]]
        + [0.5 * v for v in (*speed, qvel[2])]
        + [0.25 * v for v in qvel[3:6]]
        + [0.1 * v for v in qvel[6:]]
    )
    return (np.array(body) if single else np.stack(body, -1)), frame


def up_of(qpos: np.ndarray) -> np.ndarray:
    """Return how far the ant's back is up, 1 to -1, of ``qpos``, ``[*B, 15]`` and more."""
    up: np.ndarray = 1 - 2 * (qpos[..., 4] ** 2 + qpos[..., 5] ** 2)
    return up


def goal_rings(env: gymnasium.Env, observation: Any) -> np.ndarray:
    """Return the place, and how near the goal is where it is near, float32 ``[3]``.

    So that a search tells places apart that are metres from each other, and near the goal those
    that are a goal's width nearer.
    """
    x, y = observation["achieved_goal"]
    u, v = observation["desired_goal"]
    return np.array([x, y, _ZOOM * min(math.hypot(x - u, y - v), _NEAR)], np.float32)


class Turn(NamedTuple):
    """Turns by 0 to 3 quarters: number i becomes ``sign[q, i] * x[source[q, i]]``."""

    source: np.ndarray  # int64 [4, n]
    sign: np.ndarray  # float32 [4, n]

    @classmethod
    def of(cls, quarter: np.ndarray) -> Turn:
        """Return the turns of a signed permutation ``[n, n]``, that of one quarter."""
        powers = np.stack([np.linalg.matrix_power(quarter, q) for q in range(4)])
        source = np.abs(powers).argmax(-1)
        sign = np.take_along_axis(powers, source[..., None], -1)[..., 0]
        return cls(source, sign.astype(np.float32))

    def __call__(self, x: np.ndarray, quarters: Any) -> np.ndarray:
        """Turn ``[*B, n]`` by ``[*B]`` quarters, or all by a number of them."""
        if isinstance(quarters, int):
            return x[..., self.source[quarters]] * self.sign[quarters]
        turned: np.ndarray = np.take_along_axis(x, self.source[quarters], -1)
        return turned * self.sign[quarters].astype(x.dtype)


def _block_diag(*blocks: np.ndarray) -> np.ndarray:
    return torch.block_diag(*map(torch.from_numpy, blocks)).numpy()


def turns() -> tuple[Turn, Turn, Turn]:
    """Return the turns of what :func:`body_of` returns, of an action and of a vector in a plane."""
    one, plane = np.ones((1, 1)), np.array([[0.0, 1.0], [-1.0, 0.0]])
    space = _block_diag(plane, one)
    legs = np.eye(8)[_LEGS] * np.array(_BENDS)[:, None]
    body = _block_diag(one, np.kron(space, space), legs, space, space, legs)
    order = np.eye(8)[_ACTUATORS]
    return Turn.of(body), Turn.of(order @ legs @ order.T), Turn.of(plane)


class AntView(gymnasium.Wrapper):
    """Shows an ant maze as positions, velocities, place and goal, and slows its ant down.

    An action lasts ``repeat`` steps of the env, with the share ``strength`` of the torques. With
    ``directions`` of the options as seen from the heading, ``[A, 2]``, (0, 0) of those that are
    unknown, there is an ``"action_mask"`` too: an ant that walks does not turn back.
    """

    is_stateless = True

    def __init__(
        self,
        env: gymnasium.Env,
        *,
        repeat: int = 1,
        strength: float = 1.0,
        directions: np.ndarray | None = None,
    ) -> None:
        super().__init__(env)
        model, self._data = find_physics(env)
        if (model.nq, model.nv, model.nu) != (POSITIONS, VELOCITIES, ACTIONS):
            raise SnapshotError(
                f"{env} has no ant: its model has {model.nq} positions, {model.nv} velocities and "
                f"{model.nu} motors, an ant {POSITIONS}, {VELOCITIES} and {ACTIONS}."
            )
        self.task, self.repeat, self.strength = task_of(env), repeat, np.float32(strength)
        sizes = {"physics": POSITIONS + VELOCITIES, "achieved_goal": 2, "desired_goal": 2}
        self.observation_space = spaces.Dict(
            {key: spaces.Box(-np.inf, np.inf, (n,), np.float64) for key, n in sizes.items()}
        )
        self._directions = directions
        if directions is not None:
            self.observation_space.spaces["action_mask"] = spaces.MultiBinary(len(directions))

    def _seen(self) -> dict[str, np.ndarray]:
        physics = np.concatenate((self._data.qpos, self._data.qvel))
        seen = {
            "physics": physics,
            "achieved_goal": physics[:2].copy(),
            "desired_goal": self.task.goal().astype(np.float64),
        }
        if self._directions is not None:
            x, y = physics[POSITIONS : POSITIONS + 2].tolist()
            _, frame = body_of(physics)
            forward = self._directions @ np.array(seen_from(frame, x, y))
            seen["action_mask"] = forward >= _BACK * max(math.hypot(x, y), _WALKS)
        return seen

    def reset(self, **keywords: Any) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Begin an episode."""
        _, info = self.env.reset(**keywords)
        return self._seen(), info

    def step(
        self, action: np.ndarray
    ) -> tuple[dict[str, np.ndarray], float, bool, bool, dict[str, Any]]:
        """Take the steps of an action, fewer where the episode ends."""
        earned = 0.0
        for _ in range(self.repeat):
            _, reward, terminated, truncated, info = self.env.step(self.strength * action)
            earned += float(reward)
            if terminated or truncated or info.get("success"):
                break
        return self._seen(), earned, terminated, truncated, info


class AntWorker:
    """Walks by a skill and half turns of the body, from the heading that an option began with.

    Option ``2 z + h`` is skill z after h half turns, so that three skills are six directions. It
    ends where the ant lies on its back.
    """

    def __init__(self, actor: SkillActor) -> None:
        self._skills = SkillWorker(actor, deterministic=True)
        self.num_options = 2 * self._skills.num_options
        self._body, self._action, _ = turns()
        self._frame: Any = None

    def begin(self, observation: Any, option: int) -> None:
        """Take note of the heading."""
        _, self._frame = body_of(observation["physics"], None)

    def act(self, observation: Any, option: int, generator: np.random.Generator) -> np.ndarray:
        """Return an action, ``[8]``."""
        body, _ = body_of(observation["physics"], self._frame)
        skill, half = divmod(option, 2)
        action = self._skills.act(self._body(body, 2 * half), skill, generator)
        return self._action(action, 2 * half)

    def ends(self, observation: Any, option: int, steps: int) -> bool:
        """Return whether the ant lies on its back."""
        return bool(up_of(observation["physics"]) < 0.0)

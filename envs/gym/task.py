"""A Gymnasium env as a task for a planner, and the short look that finds its defaults."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal

import gymnasium
import numpy as np
from gymnasium import spaces

from torchrl_hmcts.envs.gym.families import snapshot_of
from torchrl_hmcts.envs.gym.features import Features, features_of, whole_observation
from torchrl_hmcts.envs.gym.settable import make_gym
from torchrl_hmcts.envs.gym.snapshots import env_layers, redraw

_LENGTHS = (1, 2, 3, 4, 5, 7, 10, 14, 20, 28, 40, 56)  # base steps of an option that are tried
_REACH = 0.08  # how far an option should move the features, as a share of what they span
_CELLS = 2_000  # of a novelty radius that should fill the features' span
_EPISODES, _STEPS = 6, 200
_MAX_OPTIONS = 64
_SUCCESS = ("success", "is_success")


class TaskEnv(gymnasium.Wrapper):
    r"""Pays a planner for what the task is about.

    A task of kind ``"goal"`` pays 1 for a success and nothing else, and a success ends the episode.
    A success is ``info["success"]`` or ``info["is_success"]`` where the env has one of them, else
    an end that pays more than 0, or, where every step costs, no more than ``step_reward``, the
    least of a step. A task of kind ``"return"`` pays :math:`(r + \text{shift}) \cdot \text{scale}`.
    """

    is_stateless = True

    def __init__(
        self,
        env: gymnasium.Env,
        kind: Literal["goal", "return"] = "goal",
        *,
        step_reward: float = 0.0,
        shift: float = 0.0,
        scale: float = 1.0,
    ) -> None:
        super().__init__(env)
        self.kind, self.step_reward, self.shift, self.scale = kind, step_reward, shift, scale
        self.is_real = False

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Take a step."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        solved = self.kind == "goal" and self.is_success(reward, terminated, info)
        if self.is_real:
            over = truncated or (terminated and not solved)
            return observation, reward, solved, over, info
        if self.kind == "return":
            paid = (float(reward) + self.shift) * self.scale
            return observation, paid, terminated, truncated, info
        return observation, float(solved), terminated or solved, truncated, info

    def is_success(self, reward: Any, terminated: bool, info: dict[str, Any]) -> bool:
        """Return whether a step solved a task of kind ``"goal"``."""
        for name in _SUCCESS:
            if name in info:
                return bool(info[name])
        costs = self.step_reward < 0.0 and reward >= self.step_reward
        return bool(terminated) and (reward > 0.0 or costs)


def fixed_actions(space: gymnasium.Space) -> list[Any]:
    """Return actions that options may repeat: all of them, or directions within bounds.

    Of a box of one dimension its ends and its middle, of two dimensions eight directions, of more
    both ends of each axis. A ValueError where there are too many to plan over.
    """
    found: list[Any] = []
    if isinstance(space, spaces.Discrete):
        found = [int(i) for i in range(space.start, space.start + space.n)]
    elif isinstance(space, spaces.Box):
        low, high = (np.clip(bound, -1e3, 1e3).reshape(-1) for bound in (space.low, space.high))
        middle, half = (high + low) / 2, (high - low) / 2
        ends = np.concatenate([np.eye(len(low)), -np.eye(len(low))])
        if len(low) == 1:
            ends = np.array([[-1.0], [0.0], [1.0]])
        elif len(low) == 2:
            angles = np.arange(8) * np.pi / 4
            ends = np.stack([np.cos(angles), np.sin(angles)], 1)
        actions = (middle + half * ends).astype(space.dtype)
        found = list(actions.reshape(-1, *space.shape))
    elif isinstance(space, spaces.MultiDiscrete) and np.prod(space.nvec) <= _MAX_OPTIONS:
        choices = itertools.product(*map(range, space.nvec.reshape(-1).tolist()))
        found = [np.array(c, space.dtype).reshape(space.shape) for c in choices]
    if not 1 <= len(found) <= _MAX_OPTIONS:
        raise ValueError(
            f"Options that repeat an action need 1 to {_MAX_OPTIONS} actions; {space} has "
            f"{len(found) or 'actions of another kind'}. Learn skills, or pass a worker of your "
            "own."
        )
    return found


@dataclass(frozen=True)
class Look:
    """Result of a short look at an env: the task it sets, and how far its actions reach.

    Attributes:
        kind: ``"goal"``, or ``"return"`` where rewards are collected on the way.
        stochastic: whether the same action in the same state may lead elsewhere.
        features: what says where the env is.
        discrete: whether the features are numbers of kinds, not of degree.
        option_steps: base steps after which a quarter of the options has moved the features by a
            twelfth of what they span, or by three quarters of the farthest that any length does.
        novelty_radius: half of how far that is; more where there are many features, so that some
            thousand states fill their span.
        step_reward: least reward of a step that does not end an episode.
        shift, scale: of the rewards of a task of kind ``"return"``. Where no episode ends early and
            steps cost, the mean reward is shifted to 0, so that a path is worth neither more nor
            less for being searched deeper; the scale brings returns of random episodes to 1.
        steps: base steps that the look took.
    """

    kind: Literal["goal", "return"]
    stochastic: bool
    features: Features
    discrete: bool
    option_steps: int
    novelty_radius: float
    step_reward: float
    shift: float
    scale: float
    steps: int

    def task(self, env: gymnasium.Env) -> TaskEnv:
        """Return the env as the task that was found."""
        return TaskEnv(
            env, self.kind, step_reward=self.step_reward, shift=self.shift, scale=self.scale
        )

    def __str__(self) -> str:
        task = "reach a goal" if self.kind == "goal" else "collect rewards"
        chance = ", with chance" if self.stochastic else ""
        return (
            f"task: {task}{chance}; options of {self.option_steps} base steps; "
            f"novelty radius {self.novelty_radius:.3g} (found in {self.steps:,} steps)"
        )


def look_at(
    env: str | Callable[..., gymnasium.Env],
    *,
    features: Features | None = None,
    gamma: float = 0.99,
    seed: int = 0,
    **keywords: Any,
) -> Look:
    """Play an env, an id or what makes it, for about two thousand steps; return what suits it.

    The ``features`` say where the env is; by default those of :func:`features_of`. An observation's
    numbers are brought to equal spans.
    """
    made = make_gym(env, **keywords)
    chosen = features_of(made) if features is None else features
    draws = np.random.default_rng(seed)
    walk = _Walk(made, chosen, draws)
    for _ in range(_EPISODES):
        walk.episode(gamma)
    points = np.array(walk.points, np.float64)
    counts = chosen is whole_observation and not isinstance(made.observation_space, spaces.Box)
    discrete = counts or np.array(walk.points).dtype.kind in "iu"
    span = np.ptp(points, 0)
    if chosen is whole_observation and discrete:
        chosen = partial(whole_observation, scale=None)
    elif chosen is whole_observation:
        scale = np.divide(1.0, span, out=np.zeros_like(span), where=span > 1e-6)
        chosen = partial(whole_observation, scale=scale.astype(np.float32))
        span = np.sign(scale)
    goals = [o["desired_goal"] for o in walk.starts if isinstance(o, dict) and "desired_goal" in o]
    if goals:
        both = np.concatenate([points[:, : len(goals[0])], np.array(goals)])
        span = np.ptp(both, 0)
    steady = np.array(walk.rewards or [0.0])
    goal = walk.has_success or bool(goals) or (steady.max() <= 0.0 and len(np.unique(steady)) <= 3)
    option_steps, radius = 1, 0.5
    if not discrete:
        moved = _moves(made, chosen, draws, walk)
        wide = span[span > 0.0]
        whole = float(np.linalg.norm(wide) if goal else span.max())
        least = float(np.exp(np.log(wide).mean())) * _CELLS ** (-1 / len(wide)) if len(wide) else 0
        wanted = min(max(_REACH * whole, 1.6 * least * goal), 0.75 * float(moved.max()))
        best = int(np.argmax(moved >= wanted))
        option_steps, radius = _LENGTHS[best], max(float(moved[best]) / 2, least, 1e-6)
    shift = -float(steady.mean()) if not walk.ended and steady.min() < 0.0 else 0.0
    size = max((abs(value) for value in walk.returns), default=1.0)
    stochastic = _is_stochastic(made, draws, walk)
    made.close()
    return Look(
        "goal" if goal else "return",
        stochastic,
        chosen,
        discrete,
        option_steps,
        radius,
        float(steady.min()),
        shift,
        1.0 / max(size, 1e-6),
        walk.steps,
    )


class _Walk:
    """Episodes of random actions, each held for a while, and what was seen on the way."""

    def __init__(self, env: gymnasium.Env, features: Features, draws: np.random.Generator) -> None:
        self.env, self.features, self.draws = env, features, draws
        self.points: list[np.ndarray] = []
        self.starts: list[Any] = []
        self.rewards: list[float] = []  # of steps that ended nothing
        self.returns: list[float] = []
        self.has_success, self.ended, self.steps = False, False, 0
        env.action_space.seed(int(draws.integers(2**31)))

    def begin(self) -> Any:
        observation, _ = self.env.reset(seed=int(self.draws.integers(2**31)))
        self.starts.append(observation)
        return observation

    def step(self, action: Any) -> tuple[Any, float, bool]:
        observation, reward, terminated, truncated, info = self.env.step(action)
        self.steps += 1
        self.has_success |= any(name in info for name in _SUCCESS)
        self.ended |= bool(terminated)
        if not terminated:
            self.rewards.append(float(reward))
        return observation, float(reward), bool(terminated or truncated)

    def episode(self, gamma: float) -> None:
        observation, action, value, discount = self.begin(), None, 0.0, 1.0
        for _ in range(_STEPS):
            if action is None or self.draws.random() < 0.1:
                action = self.env.action_space.sample()
            self.points.append(self.features(self.env, observation))
            observation, reward, over = self.step(action)
            value, discount = value + discount * reward, discount * gamma
            if over:
                break
        self.points.append(self.features(self.env, observation))
        self.returns.append(value)


def _moves(
    env: gymnasium.Env, features: Features, draws: np.random.Generator, walk: _Walk
) -> np.ndarray:
    """How far an action moves the features that is repeated for each of the lengths."""
    try:
        actions = fixed_actions(env.action_space)
    except ValueError:
        actions = [env.action_space.sample() for _ in range(8)]
    moved: list[list[float]] = [[] for _ in _LENGTHS]
    for action in [actions[i] for i in draws.permutation(len(actions))[:12]] * 2:
        observation = walk.begin()
        first, length = features(env, observation), 0
        for at, wanted in enumerate(_LENGTHS):
            over = False
            while length < wanted and not over:
                observation, _, over = walk.step(action)
                length += 1
            if over:
                break
            moved[at].append(float(np.linalg.norm(features(env, observation) - first)))
    return np.array([np.quantile(m, 0.75) if len(m) > 2 else 0.0 for m in moved])


def _is_stochastic(env: gymnasium.Env, draws: np.random.Generator, walk: _Walk) -> bool:
    """Whether other random numbers lead elsewhere, from states of an episode."""
    snapshot, layers = snapshot_of(env), env_layers(env)
    snapshot.note_reset(seed := int(draws.integers(2**31)))
    env.reset(seed=seed)
    for _ in range(20):
        row, action = snapshot.read(), env.action_space.sample()
        outcomes = set()
        for seed in range(4):
            snapshot.restore(row)
            redraw(layers, seed)
            snapshot.note_redraw(seed)
            snapshot.note_step(action)
            observation, *rest = env.step(action)[:4]
            walk.steps += 1
            outcomes.add((walk.features(env, observation).tobytes(), *map(float, rest)))
        if len(outcomes) > 1:
            return True
        if any(rest[1:]):
            return False
    return False

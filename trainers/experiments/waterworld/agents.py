"""Agents that act in Waterworld themselves, with goals or without: their networks, their test.

Letters: *B batch of the tensordict, S starts, A actions.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from operator import index
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import MLP, ProbabilisticActor, ValueOperator


class MazeNetwork(nn.Module):
    """Two hidden layers over entries of Waterworld, brought to numbers around one.

    Places (tiles from the maze's corner) are counted from its middle in half widths, the velocity
    in what thrust reaches, goals (relative to the player) in the distance that counts as strayed.

    Args:
        inputs (int): numbers of all entries together.
        outputs (int): numbers that come out.
        hidden (int): units of each hidden layer.
        half_size (float): half the width of the maze, tiles.

    Examples:
        >>> network = MazeNetwork(74, 4, hidden=128, half_size=4.5)
        >>> network(torch.zeros(2, 66), torch.zeros(2, 2), torch.ones(2, 6)).shape
        torch.Size([2, 4])
    """

    MAX_SPEED = 2.0  # tiles per second
    MAX_DISTANCE = 2.0  # tiles

    def __init__(self, inputs: int, outputs: int, *, hidden: int, half_size: float) -> None:
        super().__init__()
        self.half_size = half_size
        self.layers = MLP(inputs, outputs, num_cells=[hidden, hidden], activation_class=nn.Tanh)

    def forward(self, observation: Tensor, velocity: Tensor, goals: Tensor | None = None) -> Tensor:
        parts = [observation / self.half_size - 1.0, velocity / self.MAX_SPEED]
        if goals is not None:
            parts.append(goals / self.MAX_DISTANCE)
        return self.layers(torch.cat(parts, -1))


def make_maze_networks(
    env: EnvBase, *, in_keys: Sequence[str], hidden: int = 128, seed: int = 0
) -> tuple[ProbabilisticActor, ValueOperator]:
    """Build actor and critic for Waterworld: a :class:`MazeNetwork` each.

    Args:
        env: whose specs give the sizes.
        in_keys: ``"observation"``, ``"velocity"`` and, for an agent with goals, ``"goals"``.
        hidden: units of each hidden layer.
        seed: of the initial weights.

    Returns:
        The actor, which writes ``"action"`` and its log-probability, and the critic, which writes
        ``"state_value"``.

    Example:
        >>> from torchrl_hmcts.envs import WaterworldMazeEnv
        >>> env = WaterworldMazeEnv(batch_size=[2])
        >>> actor, critic = make_maze_networks(env, in_keys=["observation", "velocity"])
        >>> actor(critic(env.reset()))["action"].shape
        torch.Size([2])
    """
    spec = env.observation_spec
    size = sum(int(np.prod(spec[key].shape[len(env.batch_size) :])) for key in in_keys)
    half_size = float(spec["position"].space.high.max()) / 2.0
    num_actions = int(env.action_spec.space.n)

    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(index(seed))
        logits = MazeNetwork(size, num_actions, hidden=hidden, half_size=half_size)
        value = MazeNetwork(size, 1, hidden=hidden, half_size=half_size)
    with torch.no_grad():
        logits.layers[-1].weight.mul_(0.01)  # all actions about equally likely at first
    actor = ProbabilisticActor(
        TensorDictModule(logits, in_keys=list(in_keys), out_keys=["logits"]),
        in_keys=["logits"],
        out_keys=["action"],
        distribution_class=torch.distributions.Categorical,
        return_log_prob=True,
        default_interaction_type=ExplorationType.RANDOM,
    )
    return actor, ValueOperator(value, in_keys=list(in_keys))


@dataclass
class MazeTest:
    """What an agent did in test mazes, one episode each."""

    solved: Tensor  # bool [S], reached the target in time
    base_steps: Tensor  # int64 [S], length of the episode
    last: TensorDictBase  # [S] last state of each episode, with the counters that it has

    def summary(self) -> dict[str, float | None]:
        """Return how many were solved, and the base steps of these episodes and of all.

        Example:
            >>> from tensordict import TensorDict
            >>> solved, steps = torch.tensor([True, False]), torch.tensor([30, 100])
            >>> summary = MazeTest(solved, steps, TensorDict(batch_size=[2])).summary()
            >>> summary["solved_share"], summary["base_steps_mean"], summary["base_steps_mean_all"]
            (0.5, 30.0, 65.0)
        """
        steps = self.base_steps[self.solved].double()
        some = len(steps) > 0
        return {
            "mazes": len(self.solved),
            "solved": len(steps),
            "solved_share": round(len(steps) / len(self.solved), 4),
            "base_steps_mean": round(float(steps.mean()), 1) if some else None,
            "base_steps_median": float(steps.median()) if some else None,
            "base_steps_max": int(steps.max()) if some else None,
            "base_steps_mean_all": round(float(self.base_steps.double().mean()), 1),
        }


@torch.no_grad()
def play_mazes(
    policy: Callable[[TensorDictBase], TensorDictBase],
    env: EnvBase,
    starts: TensorDictBase,
    *,
    deterministic: bool = False,
    seed: int = 0,
    watch: Callable[[TensorDictBase], Any] | None = None,
) -> MazeTest:
    """Play one episode from each start, all side by side, until it ends by itself or is cut off.

    Args:
        policy: writes ``"action"``.
        env: stateless; may be transformed. It is set to the starts.
        starts: states ``[S]``, as ``make_starts`` gives them.
        deterministic: take the most probable actions. Default: sample.
        seed: of the sampling.
        watch: called after every step with the transitions of the running episodes, which have the
            entry ``"start"`` (int64, from which of the starts).

    Returns:
        What came of it.

    Example:
        >>> from torchrl_hmcts.envs import WaterworldMazeEnv
        >>> env = WaterworldMazeEnv(torch.zeros(1, 1, 3, dtype=torch.bool))
        >>> def to_the_right(td):
        ...     return td.set("action", torch.full(td.batch_size, 3))
        >>> play_mazes(to_the_right, env, env.make_state(0, [[0.5, 0.5]], (2.5, 0.5))).base_steps
        tensor([24])
    """
    mode = ExplorationType.DETERMINISTIC if deterministic else ExplorationType.RANDOM
    state = env.reset(starts.clone(), set_state=True)
    count = len(starts)
    state.set("start", torch.arange(count))
    solved = torch.zeros(count, dtype=torch.bool)
    steps = torch.zeros(count, dtype=torch.int64)
    last: list[TensorDictBase] = []
    with torch.random.fork_rng(devices=[]), set_exploration_type(mode):
        torch.manual_seed(index(seed))
        while len(state):
            transition = env.step(policy(state))
            if watch is not None:
                watch(transition)
            start = transition["start"]
            state = transition["next"].set("start", start)
            steps[start] += 1
            done = state["done"].squeeze(-1)
            solved[start] = state["terminated"].squeeze(-1)
            if done.any():
                last.append(state[done])
                state = state[~done]
    ended: TensorDictBase = torch.cat(last)  # type: ignore[arg-type, assignment]
    return MazeTest(solved, steps, ended[ended["start"].argsort()])

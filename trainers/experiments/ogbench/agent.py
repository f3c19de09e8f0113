"""The agent that learned from recorded episodes: a worker, a model of landmarks, and a planner.

Letters: T recorded steps, F numbers of a place, B transitions of an update.
"""

from __future__ import annotations

import copy
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torchrl.modules import MLP

from torchrl_hmcts.modules import LandmarkEnv, LandmarkModel, find_jumps
from torchrl_hmcts.objectives import GoalCloningLoss
from torchrl_hmcts.planners import (
    UCT,
    HighestValue,
    MCTSPlanner,
    ProgressiveWidening,
    SearchBudget,
    ValueEvaluator,
)
from torchrl_hmcts.trainers.experiments.ogbench.config import OGBenchConfig

_HIDDEN = (256, 256)
_LATE = 3.0  # times an option's base steps, after which it has failed
_LEAST_STEPS = 20  # that an option is given
_MAX_NORM = 10.0


class _ToGoal(nn.Module):
    """An action within -1 and 1, from an observation and where the goal is from there."""

    mean: Tensor
    std: Tensor

    def __init__(
        self, observations: Tensor, num_places: int, num_actions: int, unit: float
    ) -> None:
        super().__init__()
        self.num_places, self.unit = num_places, unit
        self.register_buffer("mean", observations.mean(0))
        self.register_buffer("std", observations.std(0).clamp_min(1e-6))
        inputs = observations.shape[-1] + num_places
        self.layers = MLP(inputs, num_actions, num_cells=_HIDDEN, activation_class=nn.GELU)

    def forward(self, observation: Tensor, goal: Tensor) -> Tensor:
        ahead = (goal - observation[..., : self.num_places]) / self.unit
        seen = (observation - self.mean) / self.std
        return self.layers(torch.cat([seen, ahead], -1)).tanh()


def fit_model(data: TensorDictBase, config: OGBenchConfig) -> LandmarkModel:
    """Return the option model of recorded episodes.

    Args:
        data: as of :func:`~torchrl_hmcts.trainers.experiments.ogbench.data.record`.
        config: of the run.
    """
    places = data["observation"][..., : config.num_places]
    return LandmarkModel.fit(
        places,
        data["done"][:, 0],
        radius=config.radius,
        min_count=config.min_count,
        max_steps=config.goal_steps,
        jump_factor=config.jump_factor,
        seed=config.seed,
    )


@dataclass
class Learned:
    """A worker and its training, which a checkpoint keeps beside the networks.

    Attributes:
        loss: with the worker in ``actor_network``.
        curves: of the loss's outputs, by name, and the ``"updates"`` at which they were taken.
        cpu_seconds: of the training.
    """

    loss: GoalCloningLoss
    curves: dict[str, list[float]] = field(default_factory=dict)
    cpu_seconds: float = 0.0

    def state_dict(self) -> dict[str, Any]:
        """Return the training without the networks."""
        return {"curves": self.curves, "cpu_seconds": self.cpu_seconds}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Take over a training.

        Args:
            state_dict: of :meth:`state_dict`.
        """
        self.curves, self.cpu_seconds = state_dict["curves"], state_dict["cpu_seconds"]


def make_loss(data: TensorDictBase, config: OGBenchConfig) -> GoalCloningLoss:
    """Return the loss of a worker that reads ``"observation"`` and ``"goal"``, writes ``"action"``.

    Args:
        data: recorded episodes, for the sizes and the spread of the observation.
        config: of the run.
    """
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(config.seed)
        actions, seen = data["action"].shape[-1], data["observation"].float()
        network = _ToGoal(seen, config.num_places, actions, config.radius)
    worker = TensorDictModule(network, ["observation", "goal"], ["action"])
    return GoalCloningLoss(worker, progress_coeff=config.progress_coeff)


def learn(
    data: TensorDictBase, config: OGBenchConfig, *, progress: Callable[[Any], Any] = iter
) -> Learned:
    """Train the worker to reach places that lie ahead in recorded episodes, but behind no jump.

    Args:
        data: recorded episodes ``[T]``.
        config: of the run.
        progress: wraps the range of the updates.

    Returns:
        The worker and its training.
    """
    begin, loss = time.process_time(), make_loss(data, config)
    optimizer = torch.optim.Adam(loss.parameters(), config.learning_rate)
    decay = torch.optim.lr_scheduler.LinearLR(optimizer, 1.0, 0.0, config.updates)
    draw = _Hindsight(data, config)
    curves: dict[str, list[float]] = {"updates": [], "loss_actor": [], "action_error": []}
    for update in progress(range(config.updates)):
        out = loss(draw(config.batch_size))
        optimizer.zero_grad()
        out["loss_actor"].backward()
        nn.utils.clip_grad_norm_(loss.parameters(), _MAX_NORM)
        optimizer.step()
        decay.step()
        if update % 100 == 99 or update == config.updates - 1:
            curves["updates"].append(update + 1)
            for name in ("loss_actor", "action_error"):
                curves[name].append(out[name].item())
    return Learned(loss, curves, time.process_time() - begin)


class _Hindsight:
    """Draws transitions, each with a place to which the same episode led within some steps.

    TorchRL's ``HERReplayBuffer`` draws goals from all the rest of an episode.
    """

    def __init__(self, data: TensorDictBase, config: OGBenchConfig) -> None:
        self.seen = data["observation"].float().contiguous()
        self.actions = data["action"].float().contiguous()
        self.num_places, self.most = config.num_places, config.goal_steps
        ends = data["done"][:, 0].clone()
        ends[-1] = True
        ends |= find_jumps(self.seen[:, : self.num_places], ends, config.jump_factor)
        last = torch.nonzero(ends).flatten()
        steps = torch.arange(len(ends))
        self.left = last[torch.searchsorted(last, steps)] - steps
        self.rows = torch.nonzero(self.left > 0).flatten()
        self.generator = torch.Generator().manual_seed(config.seed)

    def __call__(self, count: int) -> TensorDict:
        draws = torch.rand(2, count, generator=self.generator)
        at = self.rows[(draws[0] * len(self.rows)).long()]
        ahead = torch.minimum(1 + (draws[1] * self.most).long(), self.left[at])
        seen, after, goal = self.seen[at], self.seen[at + 1], self.seen[at + ahead]
        f = self.num_places
        return TensorDict(
            observation=seen,
            action=self.actions[at],
            position=seen[:, :f],
            goal=goal[:, :f],
            next=TensorDict(position=after[:, :f], batch_size=[count]),
            batch_size=[count],
        )


class LandmarkAgent:
    """Acts towards a goal: a search before every option, and a worker that takes it.

    It sees observations and a goal, and nothing of the env. An option ends near its landmark, after
    a jump, or when it has taken three times its base steps; then it is thought longer by these for
    the rest of the episode, so that the next search may find another way.

    Args:
        model: of the options.
        worker: reads ``"observation"`` and ``"goal"``, writes ``"action"``.
        config: of the run.

    Attributes:
        planner: of type :class:`MCTSPlanner`.
        num_options: options taken in this episode.
        path: landmarks to which they led.
    """

    def __init__(
        self, model: LandmarkModel, worker: TensorDictModule, config: OGBenchConfig
    ) -> None:
        self._given, self.worker, self.config = model, worker, config
        self.model = copy.deepcopy(model)
        self._env = LandmarkEnv(self.model, gamma=config.gamma, seed=config.seed)
        self._table = torch.zeros(0)  # values of landmarks on the way to the goal
        values = TensorDictModule(lambda at: self._table[at], ["landmark"], ["state_value"])
        self.planner = MCTSPlanner(
            self._env,
            tree_policy=UCT(c=0.05),
            leaf_evaluator=ValueEvaluator(values),
            chance=ProgressiveWidening() if model.has_chance else None,
            backup="max",
            final_choice=HighestValue(),
            budget=SearchBudget(simulations=config.simulations, until_plan=False),
        )

    def begin(self, goal: np.ndarray) -> None:
        """Begin an episode.

        Args:
            goal: an observation of it.
        """
        self.model.load_state_dict(self._given.state_dict())
        self._goal = torch.from_numpy(goal[: self.config.num_places]).float()
        self._goal_landmark = self.model.nearest(self._goal[None], goal=True)
        self._table = self.model.values(self._goal_landmark, self.config.gamma)
        self._target: Tensor | None = None
        self._last: Tensor | None = None
        self._steps, self._limit, self._chosen = 0, 0, (0, -1)
        self._arrived: int | None = None  # at the landmark of the last option
        self.num_options = 0
        self.path: list[int] = []

    def act(self, observation: np.ndarray) -> np.ndarray:
        """Return an action.

        Args:
            observation: of the env.
        """
        seen = torch.from_numpy(observation).float()
        here = seen[: self.config.num_places]
        if self._is_over(here):
            self._choose(here)
        self._last, self._steps = here, self._steps + 1
        td = TensorDict(observation=seen, goal=self._target)
        with torch.no_grad():
            action: np.ndarray = self.worker(td)["action"].numpy()
        return action

    def _is_over(self, here: Tensor) -> bool:
        """Whether another option is due."""
        if self._target is None or self._last is None:
            return True
        if float((here - self._last).norm()) > float(self.model.jump):
            return True
        if self._steps >= self._limit:
            landmark, option = self._chosen
            if option >= 0:  # it did not lead where it should
                self.model.durations[landmark, option] += self._limit
                self._table = self.model.values(self._goal_landmark, self.config.gamma)
            return True
        near = self.config.radius / 2
        if self._chosen[1] < 0 or float((here - self._target).norm()) >= near:
            return False
        self._arrived = self.path[-1]
        return True

    def _choose(self, here: Tensor) -> None:
        landmark = self.model.nearest(here[None])
        if self._arrived is not None and bool((self.model.targets[self._arrived] >= 0).any()):
            landmark = torch.tensor([self._arrived])  # another one may be nearer by a little
        self._arrived, self._steps = None, 0
        if bool(landmark == self._goal_landmark):
            self._target, self._chosen, self._limit = self._goal, (int(landmark), -1), _LEAST_STEPS
            return
        state = TensorDict(landmark=landmark, goal=self._goal_landmark, batch_size=[1])
        root = self._env.reset(state, set_state=True)
        option = int(self.planner(root)["action"])
        at = int(landmark)
        target = int(self.model.targets[at, option])
        self._target, self._chosen = self.model.places[target], (at, option)
        self._limit = max(_LEAST_STEPS, int(_LATE * float(self.model.durations[at, option])))
        self.num_options += 1
        self.path.append(target)

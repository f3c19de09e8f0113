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

from torchrl_hmcts.envs.gym.ant import body_of
from torchrl_hmcts.modules import EffectModel, LandmarkEnv, LandmarkModel, find_jumps
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

    def __init__(self, observations: Tensor, num_actions: int, config: OGBenchConfig) -> None:
        super().__init__()
        self.place, self.unit = config.place, config.radius
        self.columns = slice(*config.recipe.seen)
        place = self.place
        ahead = torch.ones_like(observations[:, place])
        seen, where = self.view(observations, ahead)
        self.register_buffer("mean", seen.mean(0))
        self.register_buffer("std", seen.std(0).clamp_min(1e-6))
        inputs = seen.shape[-1] + where.shape[-1]
        self.layers = MLP(inputs, num_actions, num_cells=_HIDDEN, activation_class=nn.GELU)

    def view(self, observation: Tensor, ahead: Tensor) -> tuple[Tensor, Tensor]:
        """What the network sees of the agent and of the goal."""
        return observation[..., self.columns], ahead

    def forward(self, observation: Tensor, goal: Tensor) -> Tensor:
        ahead = (goal - observation[..., self.place]) / self.unit
        seen, where = self.view(observation, ahead)
        return self.layers(torch.cat([(seen - self.mean) / self.std, where], -1)).tanh()


class _AntToGoal(_ToGoal):
    """Sees the body from the direction of the goal: the plane has no north."""

    def view(self, observation: Tensor, ahead: Tensor) -> tuple[Tensor, Tensor]:
        length = ahead.norm(dim=-1, keepdim=True).clamp_min(1e-6)
        body, _ = body_of(observation.double().numpy(), (ahead / length).numpy().T)
        return torch.from_numpy(body).float(), length


def fit_model(data: TensorDictBase, config: OGBenchConfig) -> LandmarkModel | EffectModel:
    """Return the option model of recorded episodes: of effects in puzzles, of places in mazes."""
    seen, ends = data["observation"].float(), data["done"][:, 0]
    places = seen[:, config.place]
    if config.recipe.kind == "play":
        return EffectModel.fit(seen, ends, places)
    return LandmarkModel.fit(
        places,
        ends,
        radius=config.radius,
        min_count=config.min_count,
        max_steps=config.goal_steps,
        jump_factor=config.jump_factor,
        seed=config.seed,
    )


@dataclass
class Learned:
    """A worker in ``loss.actor_network``, and its training, which a checkpoint keeps beside it."""

    loss: GoalCloningLoss
    curves: dict[str, list[float]] = field(default_factory=dict)
    cpu_seconds: float = 0.0

    def state_dict(self) -> dict[str, Any]:
        """Return the training without the networks."""
        return {"curves": self.curves, "cpu_seconds": self.cpu_seconds}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Take over a training."""
        self.curves, self.cpu_seconds = state_dict["curves"], state_dict["cpu_seconds"]


def make_loss(data: TensorDictBase, config: OGBenchConfig) -> GoalCloningLoss:
    """Return the loss of a worker of ``"observation"`` and ``"goal"`` that writes ``"action"``."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(config.seed)
        actions, seen = data["action"].shape[-1], data["observation"].float()
        kind = _AntToGoal if config.recipe.is_ant else _ToGoal
        network = kind(seen, actions, config)
    worker = TensorDictModule(network, ["observation", "goal"], ["action"])
    coeff = config.progress_coeff if config.progress_coeff >= 0.0 else config.recipe.progress_coeff
    return GoalCloningLoss(worker, progress_coeff=coeff)


def learn(
    data: TensorDictBase,
    model: LandmarkModel | EffectModel,
    config: OGBenchConfig,
    *,
    progress: Callable[[Any], Any] = iter,
) -> Learned:
    """Train the worker to reach places that lie ahead in recorded episodes.

    Args:
        data: recorded episodes ``[T]``.
        model: of the options. With effects, a step's goal is where the next one happens; else it is
            a place that the episode reached some steps later, but behind no jump.
        config: of the run.
        progress: wraps the range of the updates.

    Returns:
        The worker and its training.
    """
    begin, loss = time.process_time(), make_loss(data, config)
    optimizer = torch.optim.Adam(loss.parameters(), config.learning_rate)
    decay = torch.optim.lr_scheduler.LinearLR(optimizer, 1.0, 0.0, config.num_updates)
    draw = (
        _NextEffect(data, model, config) if isinstance(model, EffectModel) else _Ahead(data, config)
    )
    curves: dict[str, list[float]] = {"updates": [], "loss_actor": [], "action_error": []}
    for update in progress(range(config.num_updates)):
        out = loss(draw(config.batch_size))
        optimizer.zero_grad()
        out["loss_actor"].backward()
        nn.utils.clip_grad_norm_(loss.parameters(), _MAX_NORM)
        optimizer.step()
        decay.step()
        if update % 100 == 99 or update == config.num_updates - 1:
            curves["updates"].append(update + 1)
            for name in ("loss_actor", "action_error"):
                curves[name].append(out[name].item())
    return Learned(loss, curves, time.process_time() - begin)


class _Hindsight:
    """Draws transitions, each with a place to which the same episode led.

    TorchRL's ``HERReplayBuffer`` draws goals from all the rest of an episode.
    """

    def __init__(self, data: TensorDictBase, config: OGBenchConfig, ends: Tensor) -> None:
        self.seen = data["observation"].float().contiguous()
        self.actions = data["action"].float().contiguous()
        self.place, self.most = config.place, config.goal_steps
        last = torch.nonzero(ends).flatten()
        steps = torch.arange(len(ends))
        behind = torch.searchsorted(last, steps)
        self.end = torch.cat([last, last[-1:]])[behind]
        self.left = torch.where(behind < len(last), self.end - steps, 0)
        self.rows = torch.nonzero(self.left > 0).flatten()
        self.generator = torch.Generator().manual_seed(config.seed)

    def goals(self, at: Tensor, draws: Tensor) -> Tensor:
        """Goals of steps, ``[B, F]``."""
        ahead = torch.minimum(1 + (draws * self.most).long(), self.left[at])
        return self.seen[at + ahead, self.place]

    def __call__(self, count: int) -> TensorDict:
        draws = torch.rand(2, count, generator=self.generator)
        at = self.rows[(draws[0] * len(self.rows)).long()]
        seen, after = self.seen[at], self.seen[at + 1]
        return TensorDict(
            observation=seen,
            action=self.actions[at],
            position=seen[:, self.place],
            goal=self.goals(at, draws[1]),
            next=TensorDict(position=after[:, self.place], batch_size=[count]),
            batch_size=[count],
        )


class _Ahead(_Hindsight):
    """A goal lies some steps ahead, but behind no jump."""

    def __init__(self, data: TensorDictBase, config: OGBenchConfig) -> None:
        ends = data["done"][:, 0].clone()
        ends[-1] = True
        places = data["observation"][:, config.place].float()
        ends |= find_jumps(places, ends, config.jump_factor)
        super().__init__(data, config, ends)


class _NextEffect(_Hindsight):
    """The goal is where the next effect happens."""

    def __init__(self, data: TensorDictBase, model: EffectModel, config: OGBenchConfig) -> None:
        ends, settings = data["done"][:, 0].clone(), model.settings(data["observation"])
        self.effects = torch.full_like(settings, -1)
        self.effects[1:] = model.effect(settings[:-1], settings[1:])
        self.effects[1:][ends[:-1]] = -1
        super().__init__(data, config, ends | (settings != settings.roll(1)))
        self.rows = self.rows[self.effects[self.end[self.rows]] >= 0]
        self.places = model.places

    def goals(self, at: Tensor, draws: Tensor) -> Tensor:
        return self.places[self.effects[self.end[at]]]


class OptionAgent:
    """Acts towards a goal: a search before every option, and a worker that takes it.

    It sees observations and a goal, and nothing of the env. Its worker reads ``"observation"`` and
    ``"goal"`` and writes ``"action"``.
    """

    def __init__(self, model: Any, worker: TensorDictModule, config: OGBenchConfig) -> None:
        self.model, self.worker, self.config = model, worker, config
        self._env = LandmarkEnv(model, gamma=config.gamma, seed=config.seed)
        self._goal_landmark, self._target = torch.tensor([-1]), torch.zeros(0)
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
        """Begin an episode with an observation of its goal."""
        self._begin(torch.from_numpy(goal).float())
        self._has_begun = False
        self._steps, self._limit, self.num_options = 0, 0, 0

    def act(self, observation: np.ndarray) -> np.ndarray:
        """Return an action in an observation."""
        seen = torch.from_numpy(observation).float()
        if not self._has_begun or self._is_over(seen):
            self._has_begun, self._steps = True, 0
            self._target, self._limit = self._choose(seen)
        self._steps += 1
        with torch.no_grad():
            td = self.worker(TensorDict(observation=seen, goal=self._target))
        action: np.ndarray = td["action"].numpy()
        return action

    def search(self, landmark: Tensor) -> int:
        """Return the option with which a search from a landmark, int64 ``[1]``, begins."""
        self.num_options += 1
        state = TensorDict(landmark=landmark, goal=self._goal_landmark, batch_size=[1])
        return int(self.planner(self._env.reset(state, set_state=True))["action"])

    def _begin(self, goal: Tensor) -> None:
        """Take a goal."""
        raise NotImplementedError

    def _is_over(self, seen: Tensor) -> bool:
        """Whether another option is due."""
        raise NotImplementedError

    def _choose(self, seen: Tensor) -> tuple[Tensor, int]:
        """The next place to go to, and the steps after which this has failed."""
        raise NotImplementedError


def _limit(duration: Tensor) -> int:
    return max(_LEAST_STEPS, int(_LATE * float(duration)))


class LandmarkAgent(OptionAgent):
    """Goes from landmark to landmark; ``path`` has those of this episode.

    An option ends near its landmark, after a jump, or when it has taken three times its base steps;
    then it is thought longer by these for the rest of the episode, so that the next search may find
    another way.
    """

    def __init__(
        self, model: LandmarkModel, worker: TensorDictModule, config: OGBenchConfig
    ) -> None:
        super().__init__(copy.deepcopy(model), worker, config)
        self._given = model

    def _begin(self, goal: Tensor) -> None:
        self.model.load_state_dict(self._given.state_dict())
        self._goal = goal[self.config.place]
        self._goal_landmark = self.model.nearest(self._goal[None], goal=True)
        self._table = self.model.values(self._goal_landmark, self.config.gamma)
        self._last: Tensor | None = None
        self._chosen = (0, -1)
        self._arrived: int | None = None  # at the landmark of the last option
        self.path: list[int] = []

    def act(self, observation: np.ndarray) -> np.ndarray:
        action = super().act(observation)
        self._last = torch.from_numpy(observation[self.config.place]).float()
        return action

    def _is_over(self, seen: Tensor) -> bool:
        here = seen[self.config.place]
        if self._last is not None and float((here - self._last).norm()) > float(self.model.jump):
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

    def _choose(self, seen: Tensor) -> tuple[Tensor, int]:
        landmark = self.model.nearest(seen[None, self.config.place])
        if self._arrived is not None and bool((self.model.targets[self._arrived] >= 0).any()):
            landmark = torch.tensor([self._arrived])  # another one may be nearer by a little
        self._arrived, at = None, int(landmark)
        if bool(landmark == self._goal_landmark):
            self._chosen = (at, -1)
            return self._goal, _LEAST_STEPS
        option = self.search(landmark)
        target = int(self.model.targets[at, option])
        self._chosen = (at, option)
        self.path.append(target)
        return self.model.places[target], _limit(self.model.durations[at, option])


class EffectAgent(OptionAgent):
    """Makes one effect after another: it goes where it happens, until switches change.

    When nothing has changed after three times the base steps of an option, it searches again.
    """

    def _begin(self, goal: Tensor) -> None:
        landmark = self.model.settings(goal)[None]
        if bool(landmark != self._goal_landmark):
            self._goal_landmark = landmark
            self._table = self.model.values(landmark, self.config.gamma)

    def _is_over(self, seen: Tensor) -> bool:
        changed = bool(self.model.settings(seen) != self._setting)
        return changed or self._steps >= self._limit

    def _choose(self, seen: Tensor) -> tuple[Tensor, int]:
        self._setting = self.model.settings(seen)
        option = self.search(self._setting[None])
        return self.model.places[option], _limit(self.model.duration)


def make_agent(
    model: LandmarkModel | EffectModel, worker: TensorDictModule, config: OGBenchConfig
) -> OptionAgent:
    """Return the agent that plans in a model."""
    if isinstance(model, EffectModel):
        return EffectAgent(model, worker, config)
    return LandmarkAgent(model, worker, config)

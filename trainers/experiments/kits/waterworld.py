"""The kit of Waterworld's random mazes, and its envs for learning, planning and acting."""

from __future__ import annotations

import math
import time
from dataclasses import replace
from operator import index
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs import Compose, EnvBase, TransformedEnv

from torchrl_hmcts.envs import (
    MazeItems,
    WaterworldMazeEnv,
    free_tiles,
    maze_pool,
    shortest_path_lengths,
)
from torchrl_hmcts.planners import MCTSPlanner, RadiusNovelty
from torchrl_hmcts.trainers.experiments.kits import Kit, LearnedSkills, Trial
from torchrl_hmcts.trainers.experiments.settings import DemoConfig
from torchrl_hmcts.trainers.experiments.waterworld.maze_network import MazeNetwork
from torchrl_hmcts.trainers.runs.config import ExperimentError
from torchrl_hmcts.transforms import DisplacementTransform, OptionTransform, SkillTransform

GUIDED_RADIUS = 0.2
"""Novelty radius of a search that a network guides, tiles."""


def make_training_env(
    mazes: Tensor | None = None,
    *,
    num_skills: int = 4,
    skill_steps: int = 50,
    copies: int = 32,
    max_steps: int = 400,
    **env_kwargs: Any,
) -> TransformedEnv:
    """Build the env in which skills are learned in mini-episodes, with their displacement.

    Args:
        mazes: bool ``[M, H, W]``. Default: the training split.
        num_skills: number of skills.
        skill_steps: base steps of a mini-episode.
        copies: mazes played at once.
        max_steps: base steps after which a copy gets a new maze.
        **env_kwargs: of :class:`~torchrl_hmcts.envs.WaterworldMazeEnv`.

    Returns:
        The env, of batch size ``[copies]``.

    Example:
        >>> make_training_env(copies=2).rollout(3)["next", "displacement"].shape
        torch.Size([2, 3, 2])
    """
    env_kwargs = {"observation": False, "max_steps": max_steps, **env_kwargs}
    base = WaterworldMazeEnv(mazes, batch_size=[copies], **env_kwargs)
    return TransformedEnv(
        base,
        Compose(SkillTransform(num_skills, max_skill_steps=skill_steps), DisplacementTransform()),
    )


def make_option_env(
    worker: Any,
    mazes: Tensor | None = None,
    *,
    num_skills: int = 4,
    option_steps: int = 25,
    seed: int | None = None,
) -> TransformedEnv:
    """Build a Waterworld whose actions are the worker's skills, for planning and for acting.

    Args:
        worker: reads ``"velocity"`` and ``"skill"``, writes ``"action"``.
        mazes: bool ``[M, H, W]``. Default: the training split.
        num_skills: number of skills, the options.
        option_steps: base steps of an option.
        seed: of the env.

    Returns:
        The macro environment, stateless and without batch size.

    Example:
        >>> from tensordict.nn import TensorDictModule
        >>> worker = TensorDictModule(lambda skill: skill, ["skill"], ["action"])
        >>> make_option_env(worker).rollout(2)["next", "duration"].shape
        torch.Size([2, 1])
    """
    options = OptionTransform(worker, num_skills, option_steps, 0.99)
    return TransformedEnv(WaterworldMazeEnv(mazes, observation=False, seed=seed), options)


def make_starts(env: WaterworldMazeEnv, num_mazes: int, seed: int) -> TensorDict:
    """Draw free tiles for player and target in each of the first mazes of an env.

    Args:
        env: whose mazes are used, one episode each.
        num_mazes: how many.
        seed: of the draw.

    Returns:
        States ``[num_mazes]``, at rest.

    Example:
        >>> from torchrl_hmcts.envs import WaterworldMazeEnv
        >>> make_starts(WaterworldMazeEnv(), 5, seed=0)["maze_index"].tolist()
        [0, 1, 2, 3, 4]
    """
    generator = torch.Generator().manual_seed(index(seed))
    tiles = free_tiles(env.mazes[:num_mazes])
    picks = torch.stack(
        [torch.randperm(tiles.shape[1], generator=generator)[:2] for _ in range(num_mazes)]
    )
    chosen = tiles.gather(1, picks)  # [num_mazes, 2]
    centers = torch.stack((chosen % env.width, chosen // env.width), -1) + 0.5
    angle = torch.rand(num_mazes, generator=generator) * (2.0 * math.pi)  # of boats
    heading = torch.stack((angle.cos(), angle.sin()), -1)
    return env.make_state(torch.arange(num_mazes), *centers.unbind(1), heading=heading)


class WaterworldKit(Kit):
    """Waterworld's mazes: skills thrust, options last 25 base steps, a maze is its target reached.

    Starts while it learns (split ``"curve"``) are in training mazes.
    """

    config: DemoConfig
    title = "Solving random mazes by planning over learned skills"
    group = 1  # each search is timed on its own
    learning_options = 400

    def __init__(self, config: DemoConfig) -> None:
        super().__init__(config)
        size = config.size
        tasks: dict[str, dict[str, Any]] = {
            "maze": {},
            "boat": {"steering": "heading"},
            "apples": {"items": MazeItems(apples=size**2 // 9), "max_steps": 40 * size},
            "key": {"items": MazeItems(key=True)},
        }
        self.env_kwargs = tasks[config.task]
        """Keywords of the task's env, besides its mazes."""
        extra = ("heading",) if config.task == "boat" else ()
        self.worker_keys = ("velocity", *extra)
        self.sees = config.objective_key == "observation"
        self.shorter_paths = config.task in ("apples", "boat")
        self.has_items = "items" in self.env_kwargs
        items = ("items",) if self.has_items else ()
        self.state_keys = ("maze_index", "position", "velocity", "target", *extra, *items)

    def make_training_env(self, num_envs: int = 32) -> EnvBase:
        config = self.config
        return make_training_env(
            num_skills=config.num_skills,
            skill_steps=config.skill_steps,
            copies=num_envs,
            observation=self.sees,
            steering=self.env_kwargs.get("steering", "directions"),
        )

    def make_env(self, split: str) -> WaterworldMazeEnv:
        size = self.config.size if split == "test" else 9
        mazes = maze_pool("test" if split == "test" else "train", size)
        limit = {"max_steps": 1000 * size**2 // 81}
        return WaterworldMazeEnv(mazes, observation=self.sees, **{**limit, **self.env_kwargs})

    def planner_part(self) -> dict[str, Any]:
        config, part = self.config, super().planner_part()
        if self.has_items and config.features == "place" and part.get("novelty"):
            # The same place is another state when other items are left.
            part["novelty"] |= {"key": ["position", "items"], "scale": [1.0, 10.0]}
        if config.task == "apples":
            part["tree_policy"] = {"_component_": "torchrl_hmcts.planners.UCT", "c": 0.3}
            part["budget"] |= {"until_plan": False, "base_steps": 4_000}
        if config.search_steps:
            part["budget"]["base_steps"] = config.search_steps
        return part

    def starts(self, split: str, num_starts: int) -> TensorDictBase:
        return make_starts(self.make_env(split), num_starts, self.config.seed)

    def manager_network(
        self, planner: MCTSPlanner, split: str, *, scale: bool = True
    ) -> MazeNetwork:
        if self.config.task != "maze":
            raise ExperimentError(
                f"The network of Waterworld's manager knows mazes with a target; task="
                f"{self.config.task} has more to see. Use task=maze, or leave manager out."
            )
        planner.simulator.keep(MazeNetwork.KEYS)
        mazes = self.make_env(split).mazes
        return MazeNetwork(mazes, self.config.num_skills, gamma=self.config.gamma)

    def manager_for(self, network: TensorDictModuleBase, split: str) -> TensorDictModuleBase:
        assert isinstance(network, MazeNetwork)
        return network.on(self.make_env(split).mazes)

    def guide(self, planner: MCTSPlanner, network: TensorDictModuleBase) -> MCTSPlanner:
        guided = super().guide(planner, network)
        guided.novelty = RadiusNovelty("position", GUIDED_RADIUS)  # values tell near states apart
        if (nodes := guided.budget.expansions) is not None:  # now of one option each
            guided.budget = replace(guided.budget, expansions=nodes * guided.num_options)
        return guided

    def path_lengths(self, starts: TensorDictBase) -> np.ndarray:
        mazes = self.make_env("test").mazes
        lengths = []
        for start in starts.unbind(0):
            player, target = (start[key].long().flip(-1).tolist() for key in ("position", "target"))
            from_target = shortest_path_lengths(mazes[int(start["maze_index"])], target)
            lengths.append(int(from_target[player[0], player[1]]))
        return np.array(lengths, dtype=np.int64)

    def metrics(self, learned: LearnedSkills, trial: Trial) -> dict[str, Any]:
        results, solved = trial.results, trial.results.solved
        begin = time.perf_counter()
        trial.planner.plan(trial.starts)  # all mazes in one batch

        def median(values: np.ndarray) -> float:
            return float(np.median(values)) if len(values) else float("nan")

        steps = results.episode_steps[solved]
        per_tile = steps / self.path_lengths(trial.starts)[solved]
        earned = {"reward_mean": round(float(results.rewards.mean()), 3)} if self.has_items else {}
        return {
            "mazes": len(solved),
            "solved": int(solved.sum()),
            **earned,
            "train_base_steps": learned.steps,
            "compile_seconds": round(trial.compile_seconds, 2),
            "plan_seconds_median": round(median(results.plan_seconds), 4),
            "plan_seconds_p95": round(float(np.percentile(results.plan_seconds, 95)), 4),
            "plan_seconds_batched": round(time.perf_counter() - begin, 2),
            "plan_base_steps_median": median(results.simulated_steps),
            "expansions_median": median(results.expansions),
            "expansions_max": int(results.expansions.max()),
            "plan_options_median": median(results.plan_options),
            "episode_base_steps_median": median(steps),
            "episode_base_steps_over_shortest": round(median(per_tile), 2),
        }

    def map(self, env: EnvBase) -> Any:
        from torchrl_hmcts.trainers.figures.maps import WaterworldMap

        return WaterworldMap(env)  # type: ignore[arg-type]

    def rows(self) -> list[tuple[str, str]]:
        earned = [("reward of an episode, mean", "{reward_mean:.2f}")] if self.has_items else []
        return [
            ("mazes solved at the first trial", "{solved} of {mazes}"),
            *earned,
            ("worker training", "{train_seconds:.1f} s"),
            ("planning, one maze, median", "{plan_seconds_median:.3f} s"),
            ("planning, one maze, 95th percentile", "{plan_seconds_p95:.3f} s"),
            ("planning, all mazes in one batch", "{plan_seconds_batched:.2f} s"),
            ("simulated base steps per plan, median", "{plan_base_steps_median:,.0f}"),
            ("nodes expanded per plan, median", "{expansions_median:.0f}"),
            ("options per plan, median", "{plan_options_median:.0f}"),
            ("base steps per episode, median", "{episode_base_steps_median:.0f}"),
            ("base steps per tile of the shortest path", "{episode_base_steps_over_shortest:.1f}"),
            ("whole run", "{seconds:.1f} s"),
        ]

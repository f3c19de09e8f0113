"""The kit of Waterworld's random mazes, and its envs for learning, planning and acting."""

from __future__ import annotations

import time
from collections.abc import Sequence
from operator import index
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.envs import Compose, EnvBase, TransformedEnv

from torchrl_hmcts.envs import WaterworldMazeEnv, free_tiles, maze_pool, shortest_path_lengths
from torchrl_hmcts.trainers.experiments.kits import Kit, LearnedSkills, Trial
from torchrl_hmcts.transforms import DisplacementTransform, OptionTransform, SkillTransform


def make_training_env(
    mazes: Tensor | None = None,
    *,
    num_skills: int = 4,
    skill_steps: int = 50,
    copies: int = 32,
    max_steps: int = 400,
) -> TransformedEnv:
    """Build the env in which skills are learned in mini-episodes, with their displacement.

    Args:
        mazes: bool ``[M, H, W]``. Default: the training split.
        num_skills: number of skills.
        skill_steps: base steps of a mini-episode.
        copies: mazes played at once.
        max_steps: base steps after which a copy gets a new maze.

    Returns:
        The env, of batch size ``[copies]``.

    Example:
        >>> make_training_env(copies=2).rollout(3)["next", "displacement"].shape
        torch.Size([2, 3, 2])
    """
    base = WaterworldMazeEnv(mazes, observation=False, batch_size=[copies], max_steps=max_steps)
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
    gamma: float = 0.99,
    trajectory_keys: Sequence[str] | None = None,
    seed: int | None = None,
) -> TransformedEnv:
    """Build a Waterworld whose actions are the worker's skills, for planning and for acting.

    Args:
        worker: reads ``"velocity"`` and ``"skill"``, writes ``"action"``.
        mazes: bool ``[M, H, W]``. Default: the training split.
        num_skills: number of skills, the options.
        option_steps: base steps of an option.
        gamma: discount per base step.
        trajectory_keys: base transitions to hand out, see ``OptionTransform``.
        seed: of the env.

    Returns:
        The macro environment, stateless and without batch size.

    Example:
        >>> from tensordict.nn import TensorDictModule
        >>> worker = TensorDictModule(lambda skill: skill, ["skill"], ["action"])
        >>> make_option_env(worker).rollout(2)["next", "duration"].shape
        torch.Size([2, 1])
    """
    options = OptionTransform(
        worker, num_skills, option_steps, gamma, trajectory_keys=trajectory_keys
    )
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
    return env.make_state(torch.arange(num_mazes), centers[:, 0], centers[:, 1])


class WaterworldKit(Kit):
    """Waterworld's mazes: skills thrust, options last 25 base steps, a maze is its target reached.

    Starts while it learns (split ``"curve"``) are in training mazes.

    Example:
        >>> from torchrl_hmcts.trainers.experiments.settings import DemoConfig
        >>> WaterworldKit(DemoConfig()).make_env("test").num_mazes
        342
    """

    worker_keys = ("velocity",)
    state_keys = ("maze_index", "position", "velocity", "target")
    title = "Solving random mazes by planning over learned skills"
    group = 1  # each search is timed on its own

    def make_training_env(self, num_envs: int = 32) -> EnvBase:
        config = self.config
        return make_training_env(
            num_skills=config.num_skills, skill_steps=config.skill_steps, copies=num_envs
        )

    def make_env(self, split: str) -> WaterworldMazeEnv:
        mazes = maze_pool("test" if split == "test" else "train")
        return WaterworldMazeEnv(mazes, observation=False)

    def starts(self, split: str, num_starts: int) -> TensorDictBase:
        return make_starts(self.make_env(split), num_starts, self.config.seed)

    def path_lengths(self, starts: TensorDictBase) -> np.ndarray:
        mazes = maze_pool("test")
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
        return {
            "mazes": len(solved),
            "solved": int(solved.sum()),
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
        return [
            ("mazes solved at the first trial", "{solved} of {mazes}"),
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

"""What the agent achieves in lab mazes it has never seen, with a model that is right or wrong.

Letters: M mazes, one episode each.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import EnvBase, TransformedEnv

from torchrl_hmcts.planners import (
    HierarchicalPolicy,
    MCTSPlanner,
    RadiusNovelty,
    SearchBudget,
)
from torchrl_hmcts.trainers.evaluation import Results, plan_and_execute, spread
from torchrl_hmcts.trainers.experiments.lab.script import ShortestPathScript
from torchrl_hmcts.trainers.experiments.lab.worker import (
    PLACE_KEY,
    held_out_seeds,
    make_option_env,
    make_starts,
)
from torchrl_hmcts.trainers.skills.rounds import RoundRecords

if TYPE_CHECKING:
    from torchrl_hmcts.trainers.experiments.lab.config import LabMazeConfig

GROUP = 40  # mazes that are planned side by side
_FRAME = 3  # column of the state's "level"


def make_planner(config: LabMazeConfig, simulator: EnvBase, **changes: Any) -> MCTSPlanner:
    """Build the manager of the test mazes.

    Args:
        config: of the experiment.
        simulator: the model, of ``make_option_env``.
        **changes: of the :class:`~torchrl_hmcts.planners.SearchBudget`.
    """
    budget = {"expansions": config.expansions, "improve_expansions": config.improve_expansions}
    return MCTSPlanner(
        simulator,
        novelty=RadiusNovelty(PLACE_KEY, config.novelty_radius, shorter_paths=True),
        budget=SearchBudget(**{**budget, **changes}),
        leaves_per_wave=config.leaves_per_wave,
        seed=config.seed,
    )


def make_maze_env(
    config: LabMazeConfig,
    worker: TensorDictModuleBase,
    maze_seeds: Sequence[int],
    size: int | None = None,
    **kwargs: Any,
) -> TransformedEnv:
    """Build a macro env of test mazes by the configuration; keywords go to the maze."""
    size = config.size if size is None else size
    return make_option_env(
        worker,
        maze_seeds,
        num_skills=config.num_skills,
        option_steps=config.option_steps,
        gamma=config.gamma,
        stall_steps=config.stall_steps,
        num_steps=config.frames_per_step,
        max_frames=config.max_frames,
        rows=size,
        columns=size,
        **kwargs,
    )


def solve_mazes(
    config: LabMazeConfig,
    worker: TensorDictModuleBase,
    *,
    size: int | None = None,
    mazes: int | None = None,
    timed: int = 8,
) -> dict[str, Any]:
    """Plan in the model, carry the plan out in another instance of the env: one trial per maze.

    Args:
        config: of the experiment.
        worker: carries options out.
        size, mazes: of and how many. Default: those of the configuration.
        timed: mazes that are planned once more, one by one, to measure the time of a search.

    Returns:
        ``mazes``, ``solved`` at the first trial, and what it took: means, medians and 95th
        percentiles of ``frames`` to the goal (of the solved), ``simulated_frames``, ``expansions``
        (of both searches where ``second_searches`` with options of full length were needed)
        and ``plan_cpu_seconds``; ``script_frames`` of a script on the shortest path, and
        ``frames_over_script``, mean over mean.
    """
    size = config.size if size is None else size
    seeds = held_out_seeds(config.mazes if mazes is None else mazes, size)
    model, real = (make_maze_env(config, worker, seeds, size) for _ in range(2))
    starts = make_starts(real.base_env, config.seed)
    planner = make_planner(config, model)
    begin = time.process_time()
    results = plan_and_execute(planner, real, starts, group=GROUP)
    again = np.flatnonzero(~results.found) if config.stall_steps else np.zeros(0, np.int64)
    if len(again):  # nothing has been carried out there yet
        whole = dataclasses.replace(config, stall_steps=0)
        model, real = (make_maze_env(whole, worker, seeds, size) for _ in range(2))
        second = plan_and_execute(
            make_planner(whole, model), real, starts[torch.from_numpy(again)], group=GROUP
        )
        results = _with_second_search(results, again, second)
    seconds = time.process_time() - begin
    script = ShortestPathScript(real.base_env)
    out = summary(config, results, script.frames(starts))
    out.update(
        second_searches=len(again), size=size, path_cells=spread(script.path_lengths(starts))
    )
    out["plan_cpu_seconds_batched"] = round(seconds / len(seeds), 4)
    singly = []
    for start in starts[:timed].split(1):
        begin = time.process_time()
        planner.search(start)
        singly.append(time.process_time() - begin)
    out["plan_cpu_seconds"] = spread(singly)
    return out


def _with_second_search(first: Results, again: np.ndarray, second: Results) -> Results:
    """Results where the starts ``again`` have what a second search gave, at the cost of both."""
    columns = {name: value.copy() for name, value in vars(first).items()}
    for name in ("simulated_steps", "expansions", "simulations"):
        columns[name][again] += getattr(second, name)
    for name in ("found", "solved", "plan_options", "episode_steps"):
        columns[name][again] = getattr(second, name)
    return Results(**columns)


def summary(config: LabMazeConfig, results: Results, script: np.ndarray) -> dict[str, Any]:
    """Return the figures of first trials, in frames.

    Args:
        config: of the experiment.
        results: of ``plan_and_execute``.
        script: frames of the script, ``[M]``.
    """
    per_step, ok = config.frames_per_step, results.solved
    frames = results.episode_steps * per_step  # the last base step counts whole
    return {
        "mazes": len(ok),
        "found": int(results.found.sum()),
        "solved": int(ok.sum()),
        "unsolved": np.flatnonzero(~ok).tolist(),
        "frames": spread(frames[ok]),
        "script_frames": spread(script),
        "frames_over_script": round(float(frames[ok].mean() / script[ok].mean()), 3)
        if ok.any()
        else float("nan"),
        "plan_options": spread(results.plan_options[ok]),
        "expansions": spread(results.expansions),
        "expansions_max": int(results.expansions.max()),
        "simulated_frames": spread(results.simulated_steps * per_step),
    }


def wrong_models(error: float) -> dict[str, dict[str, Any]]:
    """Return the real env's clock and friction beside a model of 60 frames a second and friction 6.

    Args:
        error: share by which both differ; the engine rounds the length of a frame to milliseconds,
            so that 5 % fewer frames a second are 17 ms each instead of 16.

    Example:
        >>> wrong_models(0.05)["slower clock, more friction"]
        {'fps': 57, 'friction': 6.3}
    """
    low, high = round(60 * (1 - error)), round(60 * (1 + error))
    less, more = round(6.0 * (1 - error), 4), round(6.0 * (1 + error), 4)
    return {
        "slower clock, more friction": {"fps": low, "friction": more},
        "faster clock, less friction": {"fps": high, "friction": less},
        "slower clock, less friction": {"fps": low, "friction": less},
        "faster clock, more friction": {"fps": high, "friction": more},
    }


def solve_with_wrong_model(
    config: LabMazeConfig,
    worker: TensorDictModuleBase,
    *,
    mazes: int | None = None,
    replan_every: int | None = 1,
    **real_kwargs: Any,
) -> dict[str, Any]:
    """Act where clock or friction are not the model's, with a new plan after every option.

    The search improves its plan for a while: a first plan is any plan, and one any plan after the
    other would walk in circles.

    Args:
        config: of the experiment.
        worker: carries options out.
        mazes: how many. Default: ``robust_mazes`` of the configuration.
        replan_every: options between two plans; None for a plan's end.
        **real_kwargs: of the real maze, e.g. ``fps=57, friction=6.3``.

    Returns:
        ``mazes``, ``solved`` within ``max_frames``, ``frames`` of the solved, ``num_plans``; and
        ``solved_by_the_first_plan``, the same without a second plan.
    """
    seeds = held_out_seeds(config.robust_mazes if mazes is None else mazes, config.size)
    model = make_maze_env(config, worker, seeds)
    real = make_maze_env(config, worker, seeds, **real_kwargs)
    starts = make_starts(real.base_env, config.seed)
    planner = make_planner(config, model)
    blind = plan_and_execute(planner, real, starts, group=GROUP)
    policy = HierarchicalPolicy(planner, env=real, replan_every=replan_every)
    episodes = [_act(policy, real, group) for group in starts.split(GROUP)]
    ok, gone, made = (torch.cat(column).numpy() for column in zip(*episodes, strict=True))
    return {
        "mazes": len(seeds),
        "solved": int(ok.sum()),
        "unsolved": np.flatnonzero(~ok).tolist(),
        "solved_by_the_first_plan": int(blind.solved.sum()),
        "frames": spread(gone[ok]),
        "num_plans": spread(made[ok]),
        **real_kwargs,
    }


@torch.no_grad()
def _act(
    policy: HierarchicalPolicy, real: TransformedEnv, starts: TensorDict
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Whether each episode met the goal, its frames, and the plans that were made."""
    base = real.base_env
    transform = real.transform[-1] if hasattr(real.transform, "__len__") else real.transform
    longest = -(-base.max_frames // (base.num_steps * transform.max_steps))
    rollout = real.rollout(
        longest,
        policy=policy,
        tensordict=real.reset(starts, set_state=True),
        auto_reset=False,
        break_when_all_done=True,
    )
    solved = rollout["next", "terminated"].any(1).squeeze(-1)
    frames = rollout["next", "level"][..., _FRAME].amax(1)
    return solved, frames, rollout["num_plans"].amax(1).squeeze(-1)


def frames_curve(
    records: RoundRecords, frames_per_step: int, max_frames: int
) -> dict[str, list[float]]:
    """Return the mean frames of an episode against the frames of training; Figure 4.10's curve.

    An episode without a plan, or whose plan fails, counts with its whole length.

    Args:
        records: of test rounds.
        frames_per_step: frames of a base step.
        max_frames: of an episode.

    Returns:
        ``"training_steps"`` and ``"frames"`` (both in frames), ``"solved"`` (share) and
        ``"solved_frames"``, the mean over those that were solved (NaN if none was).

    Example:
        >>> import numpy as np
        >>> columns = dict.fromkeys(RoundRecords().columns, np.array([0, 1]))
        >>> columns = {**columns, "training_steps": np.array([8, 8])}
        >>> columns = {**columns, "executed_steps": np.array([0, 50])}
        >>> frames_curve(RoundRecords(columns), 4, 10_000)
        {'training_steps': [32.0], 'frames': [5100.0], 'solved': [0.5], 'solved_frames': [200.0]}
    """
    columns = records.columns
    out: dict[str, list[float]] = {}
    for steps in np.unique(columns["training_steps"]):
        here = columns["training_steps"] == steps
        solved = columns["solved"][here].astype(bool)
        frames = columns["executed_steps"][here] * frames_per_step
        point = {
            "training_steps": float(steps * frames_per_step),
            "frames": float(np.where(solved, frames, max_frames).mean()),
            "solved": float(solved.mean()),
            "solved_frames": float(frames[solved].mean()) if solved.any() else float("nan"),
        }
        for name, value in point.items():
            out.setdefault(name, []).append(value)
    return out

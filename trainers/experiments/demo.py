"""The demo: learn skills, plan over them, carry the plans out, show what happened."""

from __future__ import annotations

import dataclasses
import time
from operator import index
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.envs import EnvBase
from torchrl.record.loggers import Logger
from tqdm import tqdm

from torchrl_hmcts.envs import WaterworldMazeEnv, free_tiles, maze_pool, shortest_path_lengths
from torchrl_hmcts.modules import SkillPolicy
from torchrl_hmcts.planners import MCTSPlanner, Plan, RadiusNovelty, SearchBudget
from torchrl_hmcts.trainers.diayn import DIAYNTrainer
from torchrl_hmcts.trainers.experiments.waterworld.worker import make_option_env, make_training_env
from torchrl_hmcts.trainers.figures.pictures import Pictures
from torchrl_hmcts.trainers.runs.config import FRAMES_PER_BATCH, DemoConfig
from torchrl_hmcts.trainers.runs.loggers import make_logger
from torchrl_hmcts.trainers.runs.run import Run, open_run
from torchrl_hmcts.trainers.runs.worker_file import save_worker
from torchrl_hmcts.trainers.saving.run_folder import versions


def run_demo(config: DemoConfig) -> dict[str, Any]:
    """Run ``hmcts demo`` and return its metrics, as they are written to ``metrics.json``.

    Args:
        config: see :class:`~torchrl_hmcts.trainers.runs.config.DemoConfig`.

    Returns:
        The metrics. Times are in seconds, steps in base steps.

    Reference:
        Dissertation, chapter 4 (tree search over DIAYN skills), on the mazes of chapter 3.
    """
    with open_run(config) as run:
        return _run_demo(run.config, run)


def _run_demo(config: DemoConfig, run: Run) -> dict[str, Any]:
    """Carry the demo out in a folder that is open."""
    if config.toy:
        config = dataclasses.replace(config, train_base_steps=1_920, mazes=min(3, config.mazes))
    test_mazes = maze_pool("test")
    torch.set_num_threads(1)  # the networks are small: threads would only get in each other's way
    out = run.path
    begin = time.perf_counter()

    print(f"Learning {config.num_skills} skills in {config.train_base_steps:,} base steps ...")
    logger = make_logger(config)
    trainer, loss = train_worker(
        config, save_dir=run.checkpoints, logger=logger, resume=run.resumes
    )
    logger.close()
    save_worker(out, loss, trainer.collected_frames)
    train_seconds = time.perf_counter() - begin
    policy = SkillPolicy(loss.actor_network, deterministic=True)

    options: dict[str, Any] = {
        "num_skills": config.num_skills,
        "option_steps": config.option_steps,
        "gamma": config.gamma,
    }
    simulator = make_option_env(policy, test_mazes, **options)
    real = make_option_env(policy, test_mazes, **options, trajectory_keys=["position", "velocity"])
    planner = MCTSPlanner(
        simulator,
        novelty=RadiusNovelty("position", config.novelty_radius),
        budget=SearchBudget(expansions=config.expansions),
        leaves_per_wave=config.leaves_per_wave,
    )
    starts = make_starts(real.base_env, config.mazes, config.seed)
    print("Compiling the search (a moment; about half a minute the first time) ...", flush=True)
    compile_begin = time.perf_counter()
    planner.plan(starts[:1])  # compiles the kernels, so that the times below are of planning
    compile_seconds = time.perf_counter() - compile_begin
    print(f"Solving {config.mazes} test mazes that the worker has never seen ...", flush=True)
    episodes = _solve(planner, real, starts)
    batch_begin = time.perf_counter()
    planner.plan(starts)
    batch_seconds = time.perf_counter() - batch_begin

    metrics = _summarise(config, episodes, starts, real.base_env)
    metrics.update(
        train_seconds=round(train_seconds, 2),
        compile_seconds=round(compile_seconds, 2),
        plan_seconds_batched=round(batch_seconds, 2),
    )
    shown = _episode_to_show(episodes, starts, real.base_env)
    metrics["seconds"] = round(time.perf_counter() - begin, 2)
    title = "Solving random mazes by planning over learned skills"
    with run.finish(metrics, title=title) as pictures:
        print("Drawing ...")
        planner.plan(starts[shown : shown + 1])
        _draw_episode(pictures, planner, real.base_env, starts[shown], episodes[shown])
        maze = int(starts["maze_index"][shown])
        _draw_worker(pictures, config, trainer, loss, real.base_env, maze)
    print(format_table(metrics))
    return metrics


def _draw_episode(
    pictures: Pictures,
    planner: MCTSPlanner,
    env: WaterworldMazeEnv,
    start: TensorDictBase,
    episode: Episode,
) -> None:
    words = "A test maze as it was solved: the plan (colours are skills) and the worker's way."
    if not episode.solved:
        words = (
            "A test maze that was NOT solved: the plan, if one was found (colours are skills), and "
            "how far the worker came."
        )
    with pictures.one("episode.gif", words) as path:
        from torchrl_hmcts.trainers.figures.maps import WaterworldMap, write_episode_gif

        positions = torch.from_numpy(episode.positions)
        states = [start.clone().set("position", position) for position in positions]
        write_episode_gif(WaterworldMap(env), states, episode.options.tolist(), episode.plan, path)
    words = "The search for that plan: every place an option led to in the maze (grey: refused by "
    with pictures.one("search.png", words + "the novelty test), and the tree.") as path:
        from torchrl_hmcts.trainers.figures.maps import WaterworldMap, plot_search

        assert planner.last_search is not None
        plot_search(WaterworldMap(env), planner.last_search, path)


def _draw_worker(
    pictures: Pictures,
    config: DemoConfig,
    trainer: DIAYNTrainer,
    loss: Any,
    env: WaterworldMazeEnv,
    maze: int,
) -> None:
    words = "The skills: 10 mini-episodes of 100 base steps for each, in an open room and in the "
    with pictures.one("skills.png", words + "maze above.") as path:
        from torchrl_hmcts.trainers.figures.maps import WaterworldMap, plot_skill_fan

        rooms = WaterworldMap(env).rooms(10 * config.num_skills, maze)
        policy = SkillPolicy(loss.actor_network)
        plot_skill_fan(policy, rooms, path, num_skills=config.num_skills)
    words = "Training of the worker: actor, both critics, discriminator."
    with pictures.one("losses.png", words) as path:
        from torchrl_hmcts.trainers.figures.curves import plot_losses

        plot_losses(trainer.history, config.train_base_steps, path)


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


def train_worker(
    config: DemoConfig,
    *,
    save_dir: Path | None = None,
    logger: Logger | None = None,
    resume: bool = False,
) -> tuple[DIAYNTrainer, Any]:
    """Train the demo's worker; return the trainer with its history, and the loss with its networks.

    Args:
        config: see :class:`~torchrl_hmcts.trainers.runs.config.DemoConfig`.
        save_dir: folder of the checkpoints. Default: none are written.
        logger: of TorchRL; gets the training's values. Default: none.
        resume: continue from the newest checkpoint in ``save_dir``.
    """
    env = make_training_env(num_skills=config.num_skills, skill_steps=config.skill_steps)
    loss = DIAYNTrainer.make_loss(env, config.num_skills, seed=config.seed)
    trainer = DIAYNTrainer(
        env,
        loss,
        total_frames=config.train_base_steps,
        frames_per_batch=FRAMES_PER_BATCH,
        seed=config.seed,
        progress=lambda total: tqdm(total=total, desc="train", unit="step", disable=None),
        save_dir=save_dir,
        logger=logger,
    )
    if resume and save_dir is not None:
        trainer.load(save_dir)
    trainer.train()
    return trainer, loss


@dataclasses.dataclass
class Episode:
    """One maze: the plan, what finding it cost, and what carrying it out gave."""

    plan: Plan
    plan_seconds: float
    plan_base_steps: int
    expansions: int
    positions: np.ndarray  # [base steps + 1, 2] of the player as it was carried out
    options: np.ndarray  # [base steps] option that was being carried out
    base_steps: int
    solved: bool


def _solve(planner: MCTSPlanner, real: EnvBase, starts: TensorDictBase) -> list[Episode]:
    """Plan and act in one maze after the other."""
    episodes: list[Episode] = []
    bar = tqdm(starts.unbind(0), desc="plan and act", unit="maze", disable=None)
    for start in bar:
        episodes.append(_plan_and_act(planner, real, start))
        bar.set_postfix(
            solved=sum(e.solved for e in episodes),
            plan_seconds=f"{np.median([e.plan_seconds for e in episodes]):.2f}",
            plan_base_steps=f"{np.median([e.plan_base_steps for e in episodes]):.0f}",
        )
    return episodes


def _plan_and_act(planner: MCTSPlanner, real: EnvBase, start: TensorDictBase) -> Episode:
    begin = time.perf_counter()
    plan = planner.plan(start)
    seconds = time.perf_counter() - begin
    search = planner.last_search
    assert search is not None
    positions, options = [start["position"].numpy()[None]], []
    state, solved, base_steps = start, False, 0
    for option in plan.options[: int(plan.lengths)]:
        after = real.step(state.clone().set("option", option))["next"]
        duration = int(after["duration"])
        base_steps += duration
        inner = after["trajectory", "position"][1:duration].numpy()
        positions += [inner, after["position"].numpy()[None]]
        options += [int(option)] * duration
        solved = bool(after["terminated"])
        if bool(after["done"]):
            break
        state = after.exclude("trajectory", "reward")
    return Episode(
        plan=plan,
        plan_seconds=seconds,
        plan_base_steps=int(search.num_base_steps[0]),
        expansions=int(search.num_expansions[0]),
        positions=np.concatenate(positions),
        options=np.array(options, dtype=np.int64),
        base_steps=base_steps,
        solved=solved,
    )


def _shortest(starts: TensorDictBase, env: WaterworldMazeEnv, i: int) -> int:
    """Tiles of the shortest path from player to target."""
    player, target = (starts[key][i].long().flip(-1).tolist() for key in ("position", "target"))
    lengths = shortest_path_lengths(env.mazes[int(starts["maze_index"][i])], target)
    return int(lengths[player[0], player[1]])


def _summarise(
    config: DemoConfig, episodes: list[Episode], starts: TensorDictBase, env: WaterworldMazeEnv
) -> dict[str, Any]:
    def median(values: list[float]) -> float:
        return float(np.median(values)) if values else float("nan")

    solved = [i for i, episode in enumerate(episodes) if episode.solved]
    seconds = [e.plan_seconds for e in episodes]
    per_tile = [episodes[i].base_steps / _shortest(starts, env, i) for i in solved]
    return {
        "seed": config.seed,
        "mazes": config.mazes,
        "solved": len(solved),
        "train_base_steps": config.train_base_steps,
        "train_seconds": 0.0,
        "plan_seconds_median": round(median(seconds), 4),
        "plan_seconds_p95": round(float(np.percentile(seconds, 95)), 4),
        "plan_seconds_batched": 0.0,
        "plan_base_steps_median": median([e.plan_base_steps for e in episodes]),
        "expansions_median": median([e.expansions for e in episodes]),
        "expansions_max": max(e.expansions for e in episodes),
        "plan_options_median": median([int(e.plan.lengths) for e in episodes]),
        "episode_base_steps_median": median([episodes[i].base_steps for i in solved]),
        "episode_base_steps_over_shortest": round(median(per_tile), 2),
        "config": dataclasses.asdict(config),
        "versions": versions(),
    }


def _episode_to_show(
    episodes: list[Episode], starts: TensorDictBase, env: WaterworldMazeEnv
) -> int:
    """A solved maze with a rather long way to the target."""
    solved = [i for i, e in enumerate(episodes) if e.solved] or list(range(len(episodes)))
    by_length = sorted(solved, key=lambda i: _shortest(starts, env, i))
    return by_length[int(0.85 * (len(by_length) - 1))]


def format_table(metrics: dict[str, Any]) -> str:
    """Return the figures of a demo as a table for the terminal.

    Args:
        metrics: as :func:`run_demo` returns them.

    Example:
        >>> print(format_table({"mazes": 3, "solved": 3, "train_seconds": 1.5}))
        <BLANKLINE>
          mazes solved at the first trial      3 of 3
          worker training                       1.5 s
    """
    rows = [
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
        ("whole demo", "{seconds:.1f} s"),
    ]
    lines = [""]
    for name, form in rows:
        try:
            value = form.format(**metrics)
        except KeyError:
            continue
        lines.append(f"  {name:<{36 if len(metrics) < 5 else 42}}{value:>8}")
    return "\n".join(lines)

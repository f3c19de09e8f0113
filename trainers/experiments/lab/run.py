"""Chapter 4's experiment: tree search over learned skills in DeepMind Lab's random maze."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Iterable
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase
from tqdm import tqdm

from torchrl_hmcts.envs import draw_first_person
from torchrl_hmcts.modules import SkillPolicy
from torchrl_hmcts.planners import MCTSPlanner, Plan
from torchrl_hmcts.trainers.experiments.lab.config import LabMazeConfig
from torchrl_hmcts.trainers.experiments.lab.evaluation import (
    frames_curve,
    make_maze_env,
    make_planner,
    solve_mazes,
    solve_with_wrong_model,
    wrong_models,
)
from torchrl_hmcts.trainers.experiments.lab.script import ShortestPathScript
from torchrl_hmcts.trainers.experiments.lab.training import (
    TrainedWorker,
    curve_script_frames,
    train_worker,
)
from torchrl_hmcts.trainers.experiments.lab.worker import held_out_seeds, make_starts
from torchrl_hmcts.trainers.figures.pictures import Pictures
from torchrl_hmcts.trainers.runs.loggers import make_logger
from torchrl_hmcts.trainers.runs.run import Run, open_run
from torchrl_hmcts.trainers.runs.worker_file import save_worker
from torchrl_hmcts.trainers.saving.files import left_out, replacing, write_csv
from torchrl_hmcts.trainers.saving.run_folder import versions

TOY: dict[str, Any] = {
    "mazes": 4,
    "train_frames": 4_096,
    "init_options": 8,
    "round_expansions": 1,
    "expansions": 16,
    "improve_expansions": 4,
    "curve_mazes": 2,
    "curve_points": 1,
    "robust_mazes": 2,
    "max_frames": 300,
}
_STATE = ("maze_index", "position", "velocity", "turned", "level")

_PICTURES = {
    "episode.gif": "A test maze as it was solved: the plan (pale; colours are skills), the worker "
    "that carries it out, and what the player sees.",
    "solving.png": "Figure 4.10: frames of an episode in held-out mazes while the worker learns; "
    "an episode that is not solved counts with all its frames.",
    "skills.png": "Figure 4.5: the skills, 10 mini-episodes of 100 frames for each.",
    "losses.png": "Figures 4.6 to 4.9: training of the worker: actor, both critics, discriminator.",
    "search.png": "The search for that plan: every place an option led to (grey: refused by the "
    "novelty test), and the tree.",
    "mazes.png": 'Figure 4.4: four test mazes, as text (goal "G", walls "*") and from above.',
    "view.png": "Figure 4.3: what the player sees (drawn by this package, not by DeepMind Lab).",
}


def run_labmaze(config: LabMazeConfig) -> dict[str, Any]:
    """Run ``hmcts train experiment=labmaze`` and return its figures, as in ``metrics.json``.

    Args:
        config: see :class:`~torchrl_hmcts.trainers.experiments.lab.config.LabMazeConfig`.

    Returns:
        The figures; lengths of episodes and of training are in frames.

    Reference:
        Dissertation, chapter 4.
    """
    with open_run(config) as run:
        return _run_labmaze(run.config, run)


def _run_labmaze(config: LabMazeConfig, run: Run) -> dict[str, Any]:
    """Carry the experiment out in a folder that is open."""
    if config.toy:
        config = dataclasses.replace(config, **TOY)
    torch.set_num_threads(1)  # the networks are small: threads would only get in each other's way
    out = run.path
    begin = time.perf_counter()
    print(f"Learning {config.num_skills} skills in {config.train_frames:,} frames ...", flush=True)
    logger = make_logger(config)
    trained = train_worker(
        config,
        save_dir=run.checkpoints,
        logger=logger,
        progress=lambda total: tqdm(total=total if total < 2**31 - 1000 else None, disable=None),
    )
    logger.close()
    save_worker(out, trained.loss, trained.worker_step)
    curve = frames_curve(trained.tests, config.frames_per_step, config.max_frames)
    with left_out("curves.csv"):
        head = ("curve", "training_frames", "value")
        write_csv(out / "curves.csv", head, _curve_rows(trained, curve, config))
    worker = trained.policy
    print(f"Solving {config.mazes} mazes of {config.size} x {config.size} ...", flush=True)
    test = solve_mazes(config, worker)
    print("Solving mazes whose clock and friction are not the model's ...", flush=True)
    robust = {
        name: solve_with_wrong_model(
            config, worker, mazes=min(config.mazes, config.robust_mazes), **real
        )
        for name, real in list(wrong_models(config.robust_error).items())[:2]
    }
    metrics: dict[str, Any] = {
        "seed": config.seed,
        "algorithm": config.algorithm,
        "training_frames": trained.steps * config.frames_per_step,
        "training_base_steps": trained.steps,
        "training_rounds": trained.rounds,
        "worker_training_frames": trained.worker_step * config.frames_per_step,
        "training_cpu_seconds": trained.seconds,
        "test": test,
        "wrong_model": robust,
        "config": dataclasses.asdict(config),
        "versions": versions(),
    }
    metrics["seconds"] = round(time.perf_counter() - begin, 1)
    title = "DeepMind Lab's random maze, by planning over learned skills"
    with run.finish(metrics, title=title) as pictures:
        print("Drawing ...", flush=True)
        draw(config, trained, pictures, unsolved=test["unsolved"])
    print(
        f"{test['solved']} of {test['mazes']} mazes solved at the first trial, in "
        f"{test['frames']['mean']:.0f} frames (a script on the shortest path: "
        f"{test['script_frames']['mean']:.0f})."
    )
    return metrics


def _captions(config: LabMazeConfig, trained: TrainedWorker, solved: bool) -> dict[str, str]:
    """The captions, which say whether the maze was solved, and which worker is shown."""
    captions = dict(_PICTURES)
    if not solved:
        captions["episode.gif"] = (
            "A test maze that was NOT solved: the plan, if one was found (pale; colours are "
            "skills), how far the worker came, and what the player sees."
        )
    frames = trained.worker_step * config.frames_per_step
    captions["skills.png"] += f" The worker of all pictures is that after {frames:,} frames."
    return captions


def draw(
    config: LabMazeConfig,
    trained: TrainedWorker,
    pictures: Pictures,
    *,
    unsolved: list[int] | None = None,
) -> bool:
    """Draw all figures of a run; return whether the maze of the GIF was solved.

    Args:
        config: of the experiment.
        trained: its worker.
        pictures: of the run.
        unsolved: test mazes that are not to be shown as solved.
    """
    worker, seeds = trained.policy, held_out_seeds(max(4, config.mazes), config.size)
    model = make_maze_env(config, worker, seeds)
    real = make_maze_env(config, worker, seeds, trajectory_keys=_STATE)
    env = real.base_env
    starts = make_starts(env, config.seed)
    lengths = ShortestPathScript(env).path_lengths(starts)
    shown = [i for i in np.argsort(lengths, kind="stable") if i not in (unsolved or ())]
    start = starts[int(shown[int(0.85 * (len(shown) - 1))]) if shown else 0]
    planner = make_planner(config, model)
    plan, states, options, solved = play_plan(planner, real, start)
    captions = _captions(config, trained, solved)

    def picture(name: str) -> AbstractContextManager[Path]:
        return pictures.one(name, captions[name])

    with picture("episode.gif") as path:
        from torchrl_hmcts.trainers.figures.maps import LabMap, write_episode_gif

        write_episode_gif(LabMap(env), states, options, plan, path)
    with picture("solving.png") as path:
        from torchrl_hmcts.trainers.figures.curves import plot_training, solving_panels

        name = "Algorithm 3" if config.algorithm == "hmcts" else "DIAYN"
        plot_training(
            {name: [frames_curve(trained.tests, config.frames_per_step, env.max_frames)]},
            solving_panels(curve_script_frames(config)),
            path,
            title=f"{name}: {config.curve_mazes} held-out mazes of 9 x 9",
            x_label="frames of training",
        )
    with picture("skills.png") as path:
        from torchrl_hmcts.trainers.figures.maps import LabMap, plot_skill_fan

        generator = torch.Generator().manual_seed(config.seed)
        sampling = SkillPolicy(trained.loss.actor_network, generator=generator)
        rooms = LabMap(env).rooms(10 * config.num_skills)
        steps = 100 // config.frames_per_step
        plot_skill_fan(sampling, rooms, path, num_skills=config.num_skills, steps=steps)
    with picture("losses.png") as path:
        from torchrl_hmcts.trainers.figures.curves import plot_losses

        plot_losses(trained.history, trained.steps, path)
    with picture("search.png") as path:
        from torchrl_hmcts.trainers.figures.maps import LabMap, plot_search

        assert planner.last_search is not None
        plot_search(LabMap(env), planner.last_search, path)
    with picture("mazes.png") as path:
        from torchrl_hmcts.trainers.figures.maps import plot_mazes

        plot_mazes(env, path)
    with picture("view.png") as path, replacing(path) as temporary:
        import imageio.v3 as iio

        view = draw_first_person(env, states[0], width=640, height=480)
        temporary.write_bytes(iio.imwrite("<bytes>", view, extension=".png"))
    return solved


def play_plan(
    planner: MCTSPlanner, real: Any, start: TensorDictBase
) -> tuple[Plan, list[TensorDictBase], list[int], bool]:
    """Plan from a start and carry the plan out; return the state after every base step.

    Args:
        planner: over the worker's options.
        real: macro env that hands out the state of its base steps.
        start: state without batch dimensions.

    Returns:
        The plan, the states ``[T + 1]`` and the options ``[T]`` of the base steps, and whether the
        goal was met.
    """
    plan = planner.plan(start)
    state, states, options, solved = start, [start.select(*_STATE)], [], False
    for option in plan.options[: int(plan.lengths)]:
        after = real.step(state.clone().set("option", option))["next"]
        duration = int(after["duration"])
        states += list(after["trajectory"][1:duration].select(*_STATE).unbind(0))
        states.append(after.select(*_STATE))
        options += [int(option)] * duration
        solved = bool(after["terminated"])
        if bool(after["done"]):
            break
        state = after.exclude("trajectory", "reward")
    return plan, states, options, solved


def _curve_rows(
    trained: TrainedWorker, curve: dict[str, list[float]], config: LabMazeConfig
) -> Iterable[tuple[str, int, float]]:
    """All curves, a value a row."""
    total = trained.steps * config.frames_per_step
    for name in ("loss_actor", "qvalue_loss_0", "qvalue_loss_1", "loss_discriminator"):
        values = trained.history[name]
        for i, value in enumerate(values):
            yield name, round(total * (i + 1) / len(values)), value
    for name in ("frames", "solved", "solved_frames"):
        for frames, value in zip(curve["training_steps"], curve[name], strict=True):
            yield name, round(frames), value

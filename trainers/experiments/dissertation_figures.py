"""The dissertation's figures, drawn from runs or measured results; each returns its caption."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from matplotlib import image
from matplotlib.figure import Figure

from torchrl_hmcts.envs import WaterworldMazeEnv, maze_pool
from torchrl_hmcts.modules import SkillPolicy
from torchrl_hmcts.trainers.experiments.dissertation import (
    FIGURES,
    DissertationFigure,
    MissingData,
    Sources,
    find_figure,
)
from torchrl_hmcts.trainers.experiments.goals import make_agent_env, make_agent_loss
from torchrl_hmcts.trainers.experiments.kits.lab import LabMazeKit, held_out_seeds, make_lab_env
from torchrl_hmcts.trainers.experiments.kits.waterworld import make_starts
from torchrl_hmcts.trainers.experiments.registry import load_config, recognise
from torchrl_hmcts.trainers.experiments.settings import LabMazeConfig
from torchrl_hmcts.trainers.experiments.skills import make_loss
from torchrl_hmcts.trainers.experiments.waterworld.episodes import play_mazes
from torchrl_hmcts.trainers.experiments.waterworld.goal_planning import (
    make_goal_env,
    make_tile_planner,
)
from torchrl_hmcts.trainers.experiments.waterworld.scripted_expert import ScriptedExpert
from torchrl_hmcts.trainers.figures.atari_scores import draw_game, read_scores, write_table
from torchrl_hmcts.trainers.figures.curves import (
    draw_band,
    learning_panels,
    plot_training,
    solving_panels,
    style,
)
from torchrl_hmcts.trainers.figures.goals import plot_goals, plot_macro_env, plot_tile_search
from torchrl_hmcts.trainers.figures.maps import LabMap, plot_mazes, plot_skill_fan
from torchrl_hmcts.trainers.figures.pages import Section, picture, write_sections
from torchrl_hmcts.trainers.figures.pictures import COLORS, STAMP, refuse_foreign, save_figure
from torchrl_hmcts.trainers.saving.run_folder import RunFolder, is_run, read_curves, read_run
from torchrl_hmcts.trainers.saving.worker_file import load_networks

_AGENTS = {"waterworld_goals": "goal-based agent", "waterworld_a3c": "A3C without goals"}
_MAZES = 20  # of the test split, of which one with a rather long way is shown


def draw_figure(
    name: str, folders: Sequence[str | Path], results: Path | None, out: str | Path
) -> tuple[Path, str]:
    """Draw one figure; return its file and its caption."""
    figure = find_figure(name)
    sources = Sources(tuple(recognise(read_run(folder)) for folder in folders), results)
    Path(out).mkdir(parents=True, exist_ok=True)
    path = Path(out) / figure.file
    refuse_foreign(path)
    beside = path.with_suffix(".md")  # of a table
    if figure.ending == ".html" and not path.exists() and beside.exists():
        refuse_foreign(beside)
    return path, globals()[figure.draws](figure, sources, path)


def draw_all(
    folders: Sequence[str | Path], results: Path | None, out: str | Path
) -> tuple[Path, list[str]]:
    """Draw every figure whose data are there, and a page of all of them."""
    file = Path(out) / "index.html"
    for path in (file, *(Path(out) / figure.file for figure in FIGURES.values())):
        refuse_foreign(path)
    if is_run(out):
        raise ValueError(f"out={out} is the folder of a run, whose page is index.html.")
    sections, lacking = [], []
    for figure in FIGURES.values():
        table = figure.name.startswith("table")
        title = figure.name.replace("table", "Table ") if table else f"Figure {figure.name}"
        there = [f"In the dissertation: {figure.shows}."]
        try:
            path, caption = draw_figure(figure.name, folders, results, out)
        except MissingData as error:
            lacking.append(str(error))
            sections.append(Section(title, there, code=[str(error)]))
            continue
        if table:
            sections.append(Section(title, there, link=(path.name, caption)))
        else:
            sections.append(Section(title, there, pictures=[picture(path, caption, embed=True)]))
    write_sections(file, "The dissertation's figures, drawn of this package", sections)
    return file, lacking


def draw_environments(figure: DissertationFigure, sources: Sources, path: Path) -> str:
    """Draw a test maze as Waterworld and as Gridworld."""
    env = WaterworldMazeEnv(maze_pool("test"), observation=False)
    plot_macro_env(env, make_starts(env, _MAZES, seed=0)[3], path)
    return "A test maze, drawn afresh: as Waterworld (Figure 3.1) and as Gridworld (Figure 3.2)."


def draw_tile_search(figure: DissertationFigure, sources: Sources, path: Path) -> str:
    """Draw the search over tiles in a test maze."""
    env = WaterworldMazeEnv(maze_pool("test"), observation=False)
    state = make_starts(env, _MAZES, seed=0)[3]
    manager = make_tile_planner(env)
    goals, lengths = manager.plan_goals(state[None])
    search = manager.planner.last_search
    assert search is not None
    plot_tile_search(env, state, search, goals[0, : int(lengths[0])], path)
    return "The manager's search over tiles in a test maze, made afresh, and its plan."


def draw_goals(figure: DissertationFigure, sources: Sources, path: Path) -> str:
    """Draw an episode with its goals, of the worker of a run or of the scripted one."""
    runs = sources.of("waterworld_goals")
    worker: Any = ScriptedExpert()
    whose = "a scripted worker"
    if runs:
        config = load_config(runs[0])[1]
        env = make_agent_env(config, maze_pool("test"))
        loss = make_agent_loss(config)
        load_networks(loss, runs[0].path)
        worker, whose = loss.actor_network, f"the worker of {runs[0].name}"
    else:
        env = make_goal_env(maze_pool("test"), observation=False)
    starts = make_starts(env.base_env, _MAZES, seed=0)
    episodes = play_mazes(worker, env, starts, deterministic=True, record=True)
    order = episodes.base_steps.numpy().argsort()
    shown = int(order[int(0.85 * (len(order) - 1))])
    plot_goals(env.base_env, starts[shown], episodes.tracks[shown], path)
    return f"An episode of {whose} in a test maze: the goals (red) that are still to be met."


def draw_learning(figure: DissertationFigure, sources: Sources, path: Path) -> str:
    """Draw the test curves of the agents with and without goals."""
    entries = {"solved_share": "eval_solved_share", "episode_steps": "eval_episode_steps"}
    curves: dict[str, list[dict[str, Any]]] = {}
    told = []
    for experiment, agent in _AGENTS.items():
        found = [curve for run in sources.of(experiment) if (curve := _curve(run, entries))]
        if found:
            curves[agent] = found
            told.append(f"{agent}: {len(found)} seed(s) of the runs given")
    measured = sources.result("goals/goal_agent.json")
    if measured is not None:
        for agent, rows in json.loads(measured.read_text(encoding="utf-8"))["agents"].items():
            found = [row["curve"] for row in rows if "curve" in row]
            if found and agent not in curves:
                curves[agent] = found
                told.append(f"{agent}: {len(found)} seed(s) of docs/results")
    if not curves:
        raise figure.missing("there is no run of either agent.")
    limits = [run.config.get("max_episode_steps") for run in sources.of(*_AGENTS)]
    title = "Test mazes while the agents learn: mean, least and largest over the seeds"
    panels = learning_panels(next(filter(None, limits), 1_000))
    plot_training(curves, panels, path, title=title)
    caption = "Test mazes while the agents learn; " + ", ".join(told) + "."
    missing = [agent for agent in _AGENTS.values() if agent not in curves]
    if missing:
        caption += f"\nNot shown: {figure.missing(f'no data of {missing[0]}.')}"
    return caption


def draw_mazes(figure: DissertationFigure, sources: Sources, path: Path) -> str:
    """Draw four test mazes as text and from above."""
    plot_mazes(make_lab_env(held_out_seeds(4)), path)
    return "Four test mazes, made afresh from their seeds."


def draw_skills(figure: DissertationFigure, sources: Sources, path: Path) -> str:
    """Draw the trajectories of the skills of a run's worker."""
    runs = sources.of("labmaze")
    if runs:
        config: LabMazeConfig = load_config(runs[0])[1]
        loss = make_loss(LabMazeKit(config))
        load_networks(loss, runs[0].path)
        generator = torch.Generator().manual_seed(config.seed)
        sampling = SkillPolicy(loss.actor_network, generator=generator)
        env = make_lab_env(held_out_seeds(4), num_steps=config.frames_per_step)
        rooms = LabMap(env).rooms(10 * config.num_skills)
        steps = 100 // config.frames_per_step
        plot_skill_fan(sampling, rooms, path, num_skills=config.num_skills, steps=steps)
        return f"The skills of {runs[0].name}: 10 mini-episodes of 100 frames for each."
    measured = sources.result("lab/skills.png")
    if measured is None:
        raise figure.missing("there is no run of labmaze.")
    image.imsave(path, image.imread(measured), metadata=STAMP)
    return "The skills of a worker with seed 0 (docs/results): 10 mini-episodes of 100 frames each."


def draw_loss(figure: DissertationFigure, sources: Sources, path: Path) -> str:
    """Draw a loss of the worker while it learns: mean, least and largest over the seeds."""
    runs = [run.curves for run in _alike(sources)]
    measured = sources.result("lab/curves.csv")
    where = "given runs"
    if not runs and measured is not None:
        runs, where = [read_curves(measured.parent)], "docs/results"
    curves = [run[figure.argument] for run in runs if figure.argument in run]
    if not curves:
        raise figure.missing("there is no run of labmaze with its curves.")
    drawn = Figure(figsize=(6.6, 4.0), layout="constrained")
    axes = drawn.subplots()
    draw_band(axes, [(c.steps, c.values) for c in curves], color=COLORS[0], smooth=True)
    style(axes, figure.shows)
    axes.set_xlabel(curves[0].step_label)
    axes.set_xlim(left=0)
    save_figure(drawn, path)
    band = ", band from the least to the largest" if len(curves) > 1 else ""
    return (
        f"{figure.shows[0].upper()}{figure.shows[1:]}, {len(curves)} seed(s) of {where}: moving "
        f"average{band}; pale: as it is logged."
    )


def draw_solving(figure: DissertationFigure, sources: Sources, path: Path) -> str:
    """Draw frames of an episode in held-out mazes against frames of training."""
    runs = _alike(sources)
    entries = {"frames": "frames", "solved": "solved"}
    curves = [curve for run in runs if (curve := _curve(run, entries))]
    config = load_config(runs[0])[1] if curves else LabMazeConfig()
    where = f"{len(runs)} run(s) given"
    measured = sources.result("lab/labmaze.json")
    if not curves and measured is not None:
        results = json.loads(measured.read_text(encoding="utf-8"))["results"].items()
        diayn = [row for key, row in results if key.startswith("diayn ")]
        curves = [row["curve"] for row in diayn if "curve" in row]
        where = f"{len(curves)} seed(s) of docs/results"
    if not curves:
        raise figure.missing("there is no run of labmaze with its curves.")
    name = {"diayn": "DIAYN", "hmcts": "Algorithm 3"}[config.algorithm]
    plot_training(
        {name: curves},
        solving_panels(LabMazeKit(config).script_frames()),
        path,
        title=f"{name}: {config.curve_mazes} held-out mazes of 9 x 9",
        x_label="frames of training",
    )
    return f"Frames to solve a held-out maze while the worker learns; {where}."


def draw_scores(figure: DissertationFigure, sources: Sources, path: Path) -> str:
    """Draw the scores in a game against emulated steps."""
    caption = draw_game(
        read_scores(sources.of("atari"), sources.result("atari")), path, figure.argument
    )
    if not caption:
        raise figure.missing(f"there is no run of {figure.argument} with its curves.")
    return caption


def draw_table(figure: DissertationFigure, sources: Sources, path: Path) -> str:
    """Write Table 5.1 with our scores beside the dissertation's."""
    rows = read_scores(sources.of("atari"), sources.result("atari"))
    if not rows:
        raise figure.missing("there is no run of atari.")
    return write_table(rows, path)


def _curve(run: RunFolder, entries: dict[str, str]) -> dict[str, Any]:
    """The curves of a run by the names of the panels; empty if they are not there."""
    found = {name: run.curves[curve] for name, curve in entries.items() if curve in run.curves}
    steps = [curve.steps for curve in found.values()]
    if len(found) < len(entries) or any(other != steps[0] for other in steps):
        return {}
    return {"training_steps": steps[0], **{name: c.values for name, c in found.items()}}


def _alike(sources: Sources) -> list[RunFolder]:
    """The runs of labmaze with the config of the first one."""
    runs = sources.of("labmaze")
    keys = ("algorithm", "train_frames", "num_skills", "option_frames", "frames_per_step")
    return [r for r in runs if all(r.config.get(k) == runs[0].config.get(k) for k in keys)]

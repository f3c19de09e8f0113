"""The kit of DeepMind Lab's random maze: chapter 4, with a model that is right or wrong.

A base step is ``frames_per_step`` frames with the same action.

Letters: M mazes, one episode each.
"""

from __future__ import annotations

import dataclasses
import functools
import time
from collections.abc import Iterable, Iterator, Sequence
from itertools import count, islice
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import Compose, EnvBase, TransformedEnv

from torchrl_hmcts.envs import LAB_ACTIONS, LabMazeEnv, draw_first_person, lab_maze
from torchrl_hmcts.envs.lab.read_outs import READ_OUTS
from torchrl_hmcts.modules import StallTermination
from torchrl_hmcts.planners import HierarchicalPolicy
from torchrl_hmcts.trainers.evaluation import plan_and_execute, spread
from torchrl_hmcts.trainers.experiments.kits import Curve, Kit, LearnedSkills, Trial
from torchrl_hmcts.trainers.experiments.kits.lab_script import ShortestPathScript
from torchrl_hmcts.trainers.experiments.settings import LabMazeConfig
from torchrl_hmcts.trainers.figures.pictures import Pictures
from torchrl_hmcts.trainers.runs import console
from torchrl_hmcts.trainers.saving.files import replacing
from torchrl_hmcts.trainers.skills.rounds import RoundRecords, frames_curve
from torchrl_hmcts.transforms import (
    DisplacementTransform,
    SkillTransform,
    StallTransform,
)

TRAINING_MAZES = 256
"""Seeds 0 to 255 are those of the mazes that skills are learned in."""
TEST_SEED, CURVE_SEED = 1_000_000, 2_000_000
"""First seeds of the test mazes, and of the mazes that Figure 4.10's curve is drawn from."""
_STALL_SPEED = 0.3  # share of the top speed below which a player is at a standstill
_LOSSES = ("loss_actor", "qvalue_loss_0", "qvalue_loss_1", "loss_discriminator")
_FRAME = 3  # column of the state's "level"
TURN_ACTIONS = ("forward", "look left", "look right")
"""Actions of the task "turn": without a step sideways or back, a player must face where it goes."""


def make_lab_env(maze_seeds: Sequence[int] = range(TRAINING_MAZES), **kwargs: Any) -> LabMazeEnv:
    """Build the maze as the experiment plays it: only the goal is rewarded, and ends it."""
    settings: dict[str, Any] = {
        "num_steps": 4,
        "apple_reward": 0.0,  # a search ends with the first reward, which is to be the goal's
        "goal_reward": 1.0,
        "read_outs": (LabMazeKit.place_key, *LabMazeKit.worker_keys),
    }
    return LabMazeEnv(maze_seeds=maze_seeds, **{**settings, **kwargs})


@functools.cache
def held_out_seeds(num_mazes: int, size: int = 9, *, first: int = TEST_SEED) -> list[int]:
    """Return seeds of mazes none of which is the maze of a training seed, or of another of them.

    Small mazes can come twice, from different seeds; such ones are left out.
    """
    known = {lab_maze(seed, size, size) for seed in range(TRAINING_MAZES)}

    def fresh() -> Iterator[int]:
        for seed in count(first):
            maze = lab_maze(seed, size, size)
            if maze not in known:
                known.add(maze)
                yield seed

    return list(islice(fresh(), num_mazes))


def make_starts(env: LabMazeEnv, seed: int) -> TensorDict:
    """Draw one of its spawn points and a heading for each maze of an env; return states ``[M]``."""
    generator = np.random.default_rng(seed)
    mazes = np.arange(env.num_mazes)
    spawn = (generator.random(len(mazes)) * env.layout.num_spawns).astype(np.int64)
    place = torch.from_numpy(env.layout.spawn[mazes, spawn])
    heading = torch.from_numpy(generator.random(len(mazes)) * 360.0)
    return env.make_state(torch.from_numpy(mazes), place, heading)


class LabMazeKit(Kit):
    """DeepMind Lab's mazes: skills walk, an option ends at a wall, a maze is its goal reached.

    The worker sees how it moves and where east is, the discriminator the displacement in cells:
    skills are directions on the map, whichever way the player faces.
    """

    config: LabMazeConfig  # type: ignore[assignment]
    place_key = "tile_position"
    worker_keys = ("body_velocity", "heading")
    state_keys = ("maze_index", "position", "velocity", "turned", "level")
    captions = {
        **Kit.captions,
        "solving.png": "Figure 4.10: frames of an episode in held-out mazes while the worker "
        "learns; an episode that is not solved counts with all its frames.",
        "skills.png": "Figure 4.5: the skills, 10 mini-episodes of 100 frames for each.",
        "losses.png": "Figures 4.6 to 4.9: training of the worker: actor, both critics, "
        "discriminator.",
        "mazes.png": 'Figure 4.4: four test mazes, as text (goal "G", walls "*") and from above.',
        "view.png": "Figure 4.3: what the player sees (drawn by this package, not by DeepMind "
        "Lab).",
    }
    unit = "frames"
    curve_steps = "training_frames"
    title = "DeepMind Lab's random maze, by planning over learned skills"
    group = 40
    shorter_paths = True

    def __init__(self, config: LabMazeConfig) -> None:
        if config.task == "turn":  # who turns stands still
            config = dataclasses.replace(config, stall_steps=0)
        super().__init__(config)
        read_outs: tuple[str, ...] = (self.place_key, *self.worker_keys)
        if config.objective_key in READ_OUTS[3:]:
            read_outs = (*read_outs, config.objective_key)
        tasks: dict[str, dict[str, Any]] = {
            "maze": {},
            "turn": {"actions": {name: LAB_ACTIONS[name] for name in TURN_ACTIONS}},
            "apples": {"apple_reward": 1.0, "read_outs": (*read_outs, "apples")},
        }
        self.env_kwargs: dict[str, Any] = {"read_outs": read_outs, **tasks[config.task]}
        """Keywords of the task's env, besides its mazes."""

    # ------------------------------------------------------- envs

    def make_training_env(self, num_envs: int = 32) -> TransformedEnv:
        config = self.config
        skills = SkillTransform(config.num_skills, max_skill_steps=config.skill_steps)
        base = make_lab_env(
            batch_size=[num_envs], num_steps=config.frames_per_step, **self.env_kwargs
        )
        return TransformedEnv(base, Compose(skills, DisplacementTransform(self.place_key)))

    def make_env(self, split: str, num_mazes: int | None = None, **kwargs: Any) -> LabMazeEnv:
        config = self.config
        limits = {"num_steps": config.frames_per_step, "max_frames": config.max_frames}
        kwargs = {**limits, **self.env_kwargs, **kwargs}
        if split == "train":
            return make_lab_env(**kwargs)
        if split == "curve":
            return make_lab_env(held_out_seeds(config.curve_mazes, first=CURVE_SEED), **kwargs)
        size = config.size
        seeds = held_out_seeds(config.mazes if num_mazes is None else num_mazes, size)
        return make_lab_env(seeds, rows=size, columns=size, **kwargs)

    def stall(self, env: EnvBase) -> tuple[Any, Any] | None:
        steps = self.config.stall_steps
        return (stall_transform(env), StallTermination(steps)) if steps else None  # type: ignore[arg-type]

    def starts(self, split: str, num_starts: int) -> TensorDictBase:
        if split != "test":
            env = self.make_env(split)
            env.set_seed(self.config.seed)
            return env.reset(TensorDict(batch_size=[num_starts]))
        return make_starts(self.make_env(split, num_starts), self.config.seed)

    def planner_part(self) -> dict[str, Any]:
        part = super().planner_part()
        config, budget = self.config, part["budget"]
        if config.search_frames:
            budget["base_steps"] = config.search_frames // config.frames_per_step
        if config.task == "apples":
            if config.features == "place":
                part["novelty"] |= {"key": [self.place_key, "apples"], "scale": [1.0, 10.0]}
            part["tree_policy"] = {"_component_": "torchrl_hmcts.planners.UCT", "c": 0.3}
            budget["until_plan"] = False
        else:
            budget["improve_expansions"] = config.improve_expansions
        return {**part, "seed": config.seed}

    def second_try(self) -> LabMazeKit | None:
        if not self.config.stall_steps:
            return None
        return LabMazeKit(dataclasses.replace(self.config, stall_steps=0))

    # ------------------------------------------------------- figures

    def path_lengths(self, starts: TensorDictBase) -> np.ndarray:
        return ShortestPathScript(self.make_env("test")).path_lengths(starts)

    def figures(self, trial: Trial, timed: int = 8) -> dict[str, Any]:
        """Return the figures of first trials, in frames.

        Args:
            trial: one episode per maze.
            timed: mazes that are planned once more, one by one, to measure the time of a search.

        Returns:
            ``mazes``, ``solved`` at the first trial, and what it took: means, medians and 95th
            percentiles of ``frames`` to the goal (of the solved), ``simulated_frames``,
            ``expansions`` (of both searches where ``second_searches`` with options of full length
            were needed) and ``plan_cpu_seconds``; ``script_frames`` of a script on the shortest
            path, and ``frames_over_script``, mean over mean.
        """
        per_step, results, starts = self.config.frames_per_step, trial.results, trial.starts
        ok = results.solved
        script = ShortestPathScript(self.make_env("test"))
        walked = script.frames(starts)
        frames = results.episode_steps * per_step  # the last base step counts whole
        over_script = float(frames[ok].mean() / walked[ok].mean()) if ok.any() else float("nan")
        singly = []
        for start in starts[:timed].split(1):
            begin = time.process_time()
            trial.planner.search(start)
            singly.append(time.process_time() - begin)
        return {
            "mazes": len(ok),
            "found": int(results.found.sum()),
            "solved": int(ok.sum()),
            "unsolved": np.flatnonzero(~ok).tolist(),
            "frames": spread(frames[ok]),
            "script_frames": spread(walked),
            "frames_over_script": round(over_script, 3),
            "plan_options": spread(results.plan_options[ok]),
            "expansions": spread(results.expansions),
            "expansions_max": int(results.expansions.max()),
            "simulated_frames": spread(results.simulated_steps * per_step),
            "second_searches": trial.second_searches,
            "size": self.config.size,
            "path_cells": spread(script.path_lengths(starts)),
            "plan_cpu_seconds_batched": round(trial.cpu_seconds / len(ok), 4),
            "plan_cpu_seconds": spread(singly),
        }

    def extras(self, worker: TensorDictModuleBase) -> dict[str, Any]:
        console.say("Solving mazes whose clock and friction are not the model's ...")
        robust = list(wrong_models(self.config.robust_error).items())[:2]
        return {"wrong_model": {k: self.solve_with_wrong_model(worker, **v) for k, v in robust}}

    def solve_with_wrong_model(
        self, worker: TensorDictModuleBase, mazes: int | None = None, **real_kwargs: Any
    ) -> dict[str, Any]:
        """Act where clock or friction are not the model's, with a new plan after every option.

        The search improves its plan for a while: a first plan is any plan, and one any plan after
        the other would walk in circles.

        Args:
            worker: executes the options.
            mazes: how many. Default: ``robust_mazes`` of the configuration, at most ``mazes``.
            **real_kwargs: of the real maze, e.g. ``fps=57, friction=6.3``.

        Returns:
            ``mazes``, ``solved`` within ``max_frames``, ``frames`` of the solved, ``num_plans``;
            and ``solved_by_the_first_plan``, the same without a second plan.
        """
        config = self.config
        mazes = min(config.mazes, config.robust_mazes) if mazes is None else mazes
        model = self.make_options(self.make_env("test", mazes), worker)
        real = self.make_options(self.make_env("test", mazes, **real_kwargs), worker)
        starts = make_starts(real.base_env, config.seed)
        planner = self.make_planner(model)
        blind = plan_and_execute(planner, real, starts, group=self.group)
        policy = HierarchicalPolicy(planner, env=real, replan_every=1)
        episodes = [self._act(policy, real, group) for group in starts.split(self.group)]
        ok, gone, made = (torch.cat(column).numpy() for column in zip(*episodes, strict=True))
        return {
            "mazes": mazes,
            "solved": int(ok.sum()),
            "unsolved": np.flatnonzero(~ok).tolist(),
            "solved_by_the_first_plan": int(blind.solved.sum()),
            "frames": spread(gone[ok]),
            "num_plans": spread(made[ok]),
            **real_kwargs,
        }

    @torch.no_grad()
    def _act(
        self, policy: HierarchicalPolicy, real: TransformedEnv, starts: TensorDict
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Whether each episode met the goal, its frames, and the plans that were made."""
        longest = -(-self.config.max_frames // self.config.option_frames)
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

    def metrics(self, learned: LearnedSkills, trial: Trial) -> dict[str, Any]:
        per_step = self.config.frames_per_step
        return {
            "algorithm": self.config.algorithm,
            "training_frames": learned.steps * per_step,
            "training_base_steps": learned.steps,
            "training_rounds": learned.rounds,
            "worker_training_frames": learned.worker_step * per_step,
            "training_cpu_seconds": learned.seconds,
            "test": self.figures(trial),
        }

    def frames_curve(self, tests: RoundRecords) -> dict[str, list[float]]:
        """Return Figure 4.10's curve, see :func:`frames_curve`."""
        return frames_curve(tests, self.config.frames_per_step, self.config.max_frames)

    def script_frames(self) -> float:
        """Return the mean frames of a script on the shortest path where the worker is tried."""
        num_mazes = self.config.curve_mazes
        env = make_lab_env(held_out_seeds(num_mazes, first=CURVE_SEED))
        env.set_seed(self.config.seed)
        starts = env.reset(TensorDict(batch_size=[num_mazes]))
        return float(np.mean(ShortestPathScript(env).frames(starts)))

    def curves(self, learned: LearnedSkills) -> dict[str, Curve]:
        total, curve = learned.steps * self.config.frames_per_step, self.frames_curve(learned.tests)
        found: dict[str, Curve] = {}
        names: Iterable[str] = (
            _LOSSES if "discriminator_loss" in learned.history else learned.history
        )
        for name in names:
            values = learned.history[name]
            steps = [round(total * (i + 1) / len(values)) for i in range(len(values))]
            found[name] = steps, values
        for name in ("frames", "solved", "solved_frames"):
            if curve:
                found[name] = [round(x) for x in curve["training_steps"]], curve[name]
        return found

    # ------------------------------------------------------- pictures

    def map(self, env: EnvBase) -> Any:
        from torchrl_hmcts.trainers.figures.maps import LabMap

        return LabMap(env)  # type: ignore[arg-type]

    def draw(self, pictures: Pictures, learned: LearnedSkills, trial: Trial) -> None:
        super().draw(pictures, learned, trial)
        config, captions = self.config, self.captions
        env = self.make_env("test", max(4, config.mazes))
        if learned.tests.columns["round"].size:
            with pictures.one("solving.png", captions["solving.png"]) as path:
                from torchrl_hmcts.trainers.figures.curves import plot_training, solving_panels

                name = "Algorithm 3" if config.algorithm == "hmcts" else "DIAYN"
                plot_training(
                    {name: [self.frames_curve(learned.tests)]},
                    solving_panels(self.script_frames()),
                    path,
                    title=f"{name}: {config.curve_mazes} held-out mazes of 9 x 9",
                    x_label="frames of training",
                )
        with pictures.one("mazes.png", captions["mazes.png"]) as path:
            from torchrl_hmcts.trainers.figures.maps import plot_mazes

            plot_mazes(env, path)
        with pictures.one("view.png", captions["view.png"]) as path, replacing(path) as temporary:
            import imageio.v3 as iio

            view = draw_first_person(env, trial.starts[0], width=640, height=480)
            temporary.write_bytes(iio.imwrite("<bytes>", view, extension=".png"))

    def rows(self) -> list[tuple[str, str]]:
        return [
            ("mazes solved at the first trial", "{test[solved]} of {test[mazes]}"),
            ("frames per episode, mean", "{test[frames][mean]:,.0f}"),
            ("frames of a script on the shortest path, mean", "{test[script_frames][mean]:,.0f}"),
            ("frames of training", "{training_frames:,}"),
            ("CPU seconds of training", "{training_cpu_seconds:,.1f}"),
            ("simulated frames per plan, median", "{test[simulated_frames][median]:,.0f}"),
            ("options per plan, median", "{test[plan_options][median]:.0f}"),
            ("CPU seconds per plan, median", "{test[plan_cpu_seconds][median]:.3f}"),
            ("seconds of the run", "{seconds:,.1f}"),
        ]


def stall_transform(env: LabMazeEnv) -> StallTransform:
    """Count the base steps in which the player moves at less than 0.3 of the top speed.

    Who pushes against a wall has nothing to gain from the rest of an option. A start from rest is
    faster than that within 4 frames.
    """
    seconds = env.num_steps * env.frame_msec / 1000.0
    return StallTransform("position", tolerance=_STALL_SPEED * env.TOP_SPEED * seconds)


def wrong_models(error: float) -> dict[str, dict[str, Any]]:
    """Return the real env's clock and friction beside a model of 60 frames a second and friction 6.

    Both differ by the share ``error``; the engine rounds the length of a frame to milliseconds, so
    that 5 % fewer frames a second are 17 ms each instead of 16.
    """
    low, high = round(60 * (1 - error)), round(60 * (1 + error))
    less, more = round(6.0 * (1 - error), 4), round(6.0 * (1 + error), 4)
    return {
        "slower clock, more friction": {"fps": low, "friction": more},
        "faster clock, less friction": {"fps": high, "friction": less},
        "slower clock, less friction": {"fps": low, "friction": less},
        "faster clock, more friction": {"fps": high, "friction": more},
    }

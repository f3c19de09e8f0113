"""The kit of any Gymnasium env: learn skills in it, plan over options of it, act in it."""

from __future__ import annotations

import dataclasses
import textwrap
import warnings
from collections.abc import Mapping, Sequence
from functools import cached_property, partial
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from torchrl.envs import Compose, DoubleToFloat, EnvBase, GymWrapper, StepCounter, TransformedEnv

from torchrl_hmcts.envs import (
    GridMoves,
    GridView,
    OptionPool,
    OptionWorker,
    RepeatActions,
    SettableGymEnv,
    SkillWorker,
)
from torchrl_hmcts.envs.gym.families import Box2DSnapshot
from torchrl_hmcts.envs.gym.features import WithFeatures, achieved_goal, root_place
from torchrl_hmcts.envs.gym.minigrid import MiniGridSnapshot
from torchrl_hmcts.envs.gym.settable import make_gym
from torchrl_hmcts.envs.gym.snapshots import SnapshotError
from torchrl_hmcts.envs.gym.task import Look, fixed_actions, look_at
from torchrl_hmcts.modules import SkillPolicy
from torchrl_hmcts.planners import HierarchicalPolicy, MCTSPlanner, SearchBudget, extract_plans
from torchrl_hmcts.trainers.evaluation import Results, spread
from torchrl_hmcts.trainers.experiments.gym_settings import GymConfig
from torchrl_hmcts.trainers.experiments.kits import RADIUS_SHARE, Kit, Trial
from torchrl_hmcts.trainers.experiments.kits.feature_goals import find_goals
from torchrl_hmcts.trainers.experiments.kits.film import Film
from torchrl_hmcts.trainers.experiments.kits.table import ValueTable
from torchrl_hmcts.trainers.runs.config import ExperimentError
from torchrl_hmcts.trainers.runs.console import WIDTH
from torchrl_hmcts.transforms import DisplacementTransform, SkillTransform

_PLAYED = 1_000_003  # added to the seed of envs to act in
_STILL = 0.05  # of the radius, within a fifth of an option: it no longer moves
_GOALS = ("achieved_goal", "desired_goal")


def make_seen(name: Any, given: bool, **keywords: Any) -> gymnasium.Env:
    """Make an env as options see it: MiniGrid without pictures, if no skill is to be learned."""
    env: gymnasium.Env = make_gym(name, **keywords)
    return GridView(env) if given and MiniGridSnapshot.fits(env) else env


def make_task(make: Any, look: Look, real: bool, keywords: Mapping[str, Any]) -> gymnasium.Env:
    """Make an env as the task that a look found, in any process.

    A ``real`` one pays what the env itself pays, and calls only a success terminal.
    """
    task = look.task(make(**keywords))
    task.is_real = real
    return task


class _Rows:
    """Steps the states of a batch one after the other, for pictures of skills."""

    def __init__(self, env: EnvBase) -> None:
        self.env, self.reset = env, env.reset

    def step(self, td: TensorDictBase) -> TensorDictBase:
        rows = []
        for row in td.unbind(0):
            self.env.reset(row, set_state=True)
            rows.append(self.env.step(row))
        return torch.stack(rows)


class GymKit(Kit):
    """Any Gymnasium env whose state can be set: tasks with a goal, and rewards to collect.

    Option length, features, novelty radius and the kind of task are found by a short look at the
    env, printed, and changed by the keys of :class:`GymConfig`.
    """

    place_key = "features"
    state_keys = ("features",)
    captions = {
        **Kit.captions,
        "episode.gif": "A solved episode: the plan (pale; colours are options) and the way.",
        "unsolved": "An episode that was NOT solved: the plan, if one was found (pale; colours are "
        "options), and how far it came.",
        "skills.png": "The skills: 10 mini-episodes for each, from one start.",
    }
    start_name = "starts at one trial each"
    title = "Planning over options of a Gymnasium env"
    group = 1  # each search is timed on its own
    config: GymConfig

    def __init__(self, config: GymConfig, env: Any = None) -> None:
        super().__init__(config)
        if env is None:
            config.check_inputs()
        self._env = self.maker(config.id if env is None else env)
        try:
            look = look_at(self._env, gamma=config.gamma, **config.make)
        except SnapshotError as error:
            raise ExperimentError(
                f"{error} A kit itself chooses how a state is stored: pass yours to an OptionPool, "
                "and plan in it by MCTSPlanner."
            ) from None
        if config.task != "auto":
            look = dataclasses.replace(look, kind=config.task)  # type: ignore[arg-type]
        self.look = look
        self._moves = isinstance(self.gym_env, GridView)
        steps = config.option_steps or (3 if self._moves else look.option_steps)
        self.config = dataclasses.replace(
            config,
            option_steps=steps,
            skill_steps=config.skill_steps or steps,
            novelty_radius=config.novelty_radius or look.novelty_radius,
        )
        self._fixed: Any = None  # worker of a pool whose options are given
        self._radius = config.novelty_radius  # 0: found

    def maker(self, name: Any) -> Any:
        """Return what makes the env as options see it, from keywords of ``gymnasium.make``."""
        return partial(make_seen, name, self.config.options != "learned")

    @cached_property
    def gym_env(self) -> gymnasium.Env:
        """The env as Gymnasium makes it, for what it says of itself."""
        return self._env(**self.config.make)

    # ------------------------------------------------------- envs

    def make_env(self, split: str) -> SettableGymEnv:
        make = partial(make_task, self._env, self.look, split == "test", self.config.make)
        seed = self.config.seed + (_PLAYED if split == "test" else 0)
        return SettableGymEnv(make, features=self.look.features, seed=seed)

    @cached_property
    def _start_env(self) -> SettableGymEnv:
        return self.make_env("test")

    @cached_property
    def worker_keys(self) -> Sequence[Any]:  # type: ignore[override]
        """Entries of the observation but those of goals."""
        return [key for key in self.state_entries if key not in _GOALS]

    def make_training_env(self, num_envs: int = 16) -> EnvBase:
        config = self.config

        def make() -> gymnasium.Env:
            return WithFeatures(self._env(**config.make), self.look.features)

        envs = SyncVectorEnv([make] * num_envs, autoreset_mode=AutoresetMode.DISABLED)
        return TransformedEnv(
            GymWrapper(envs, categorical_action_encoding=True),
            Compose(
                StepCounter(max_steps=10 * config.skill_steps),
                DoubleToFloat(),
                SkillTransform(config.num_skills, max_skill_steps=config.skill_steps),
                DisplacementTransform("features"),
            ),
        )

    def starts(self, split: str, num_starts: int) -> TensorDictBase:
        env, seed = self._start_env, self.config.seed
        with torch.random.fork_rng(devices=[]):  # TorchRL seeds its global generator, too
            env.set_seed(seed + _PLAYED if split == "test" else seed)
        tasks = getattr(self.gym_env.unwrapped, "num_tasks", 0)
        found: list[TensorDictBase] = []
        for number in range(seed, seed + num_starts):
            options = {"options": {"task_id": number % tasks + 1}} if tasks else {}
            found.append(env.reset(**options))
        return torch.stack(found).exclude("done", "terminated", "truncated")  # type: ignore[attr-defined]

    def make_real(
        self, worker: TensorDictModuleBase, trajectory_keys: Any = None, split: str = "test"
    ) -> EnvBase:
        return self.make_pool(worker, real=True)

    def make_simulator(self, worker: TensorDictModuleBase, split: str = "test") -> EnvBase:
        return self.make_pool(worker)

    def make_pool(
        self,
        worker: TensorDictModuleBase,
        *,
        real: bool = False,
        film: Film | None = None,
        render: str = "",
    ) -> OptionPool:
        """Return a pool of the worker's options.

        A ``real`` one is to act in, rather than to plan in: rewards are the env's own, not
        discounted. A ``film`` records what happens; ``render`` is the mode in which the env draws
        itself.
        """
        config, keywords = self.config, dict(self.config.make)
        if render:
            keywords["render_mode"] = render
        make: Any = partial(make_task, self._env, self.look, real, keywords)
        acts: Any = self._fixed
        if isinstance(worker, SkillPolicy):
            acts = self.pool_worker(worker)
        if film is not None:
            make, acts = film.of(make, acts)
        return OptionPool(
            make,
            acts,
            max_steps=config.option_steps,
            num_processes=0 if real else config.processes,
            gamma=1.0 if real else config.gamma,
            determinised=not self.look.stochastic,
            features=self.look.features,
            still=0.0 if self.look.discrete or self.replans else _STILL * config.novelty_radius,
            seed=config.seed + (_PLAYED if real else 0),
        )

    def pool_worker(self, worker: SkillPolicy) -> OptionWorker:
        """Return learned skills as the worker of a pool."""
        return SkillWorker(worker.actor, deterministic=worker.deterministic)

    def describe(self) -> str:
        return f"{self.config.id}: {self.look}."

    def given_worker(self) -> TensorDictModuleBase | None:
        if self.config.options == "learned":
            return None
        self._fixed = self._given_options()
        self.config = dataclasses.replace(self.config, num_skills=self._fixed.num_options)
        if not isinstance(self._fixed, RepeatActions):
            return TensorDictModule(lambda skill: skill, ["skill"], ["action"])
        table = torch.from_numpy(np.array(self._fixed.actions))
        return TensorDictModule(lambda skill: table[skill], ["skill"], ["action"])

    def _given_options(self) -> Any:
        config, space = self.config, self.gym_env.action_space
        if config.options != "goals":
            moves: Any = space
            return GridMoves(int(moves.n)) if self._moves else RepeatActions(fixed_actions(space))
        if self.look.discrete:
            raise ExperimentError(
                f"options=goals moves a feature to a value; the features of {config.id} are "
                "categories without an order. Use options=actions."
            )
        return find_goals(
            partial(make_task, self._env, self.look, False, config.make),
            self.look.features,
            self.starts("train", 10),
            option_steps=config.option_steps,
            seed=config.seed,
        )

    def prepare(self, worker: TensorDictModuleBase) -> None:
        """Set the novelty radius to three quarters of how far learned options move the features."""
        if self._radius or self.config.options != "learned":
            return
        starts = self.starts("train", 8)
        radius = RADIUS_SHARE * self.reach(self.make_pool(worker), starts)
        if radius > 0.0:
            self.config = dataclasses.replace(self.config, novelty_radius=radius)

    # ------------------------------------------------------- the planner

    def planner_part(self) -> dict[str, Any]:
        config, part = self.config, super().planner_part()
        if self.look.discrete:
            part["leaves_per_wave"] = 32
        if self.look.step_reward < 0.0:  # shorter plans pay more
            part["budget"]["improve_expansions"] = config.improve_expansions
        elif self.look.discrete:
            stages = getattr(self.look.features, "stages", ())
            name = "torchrl_hmcts.planners.WidthNovelty"
            part["novelty"] = {"_component_": name, "key": self.place_key, "stages": stages}
        if not self.replans:
            return part
        planners = "torchrl_hmcts.planners"
        part |= {
            "novelty": None,
            "expand": "one",
            "rollout": {"_component_": f"{planners}.TreeRollout", "max_options": 20},
            # Rollouts side by side would be replayed from the beginning at every step.
            "leaves_per_wave": 1 if Box2DSnapshot.fits(self.gym_env) else 16,
            "budget": {
                "_component_": f"{planners}.SearchBudget",
                "base_steps": config.search_steps,
                "until_plan": False,
            },
        }
        uct = {"_component_": f"{planners}.UCT"}
        if self.look.kind == "return" and self.look.step_reward > 0.0:
            # To live on is what pays: the deepest path would be the best, a dead end too. The mean
            # over random ways says how many of them survive.
            part["rollout"]["max_options"] = 30
            most_visited = {"_component_": f"{planners}.MostVisited"}
            part |= {"tree_policy": uct | {"c": 1.0}, "final_choice": most_visited}
        elif self.look.kind == "return":
            part["rollout"]["max_options"] = 10
            part |= {
                "tree_policy": uct | {"c": 0.3},
                "backup": "max",
                "final_choice": {"_component_": f"{planners}.HighestValue"},
            }
        else:
            part["chance"] = {"_component_": f"{planners}.ProgressiveWidening"}
        if self.look.discrete and self.look.stochastic:
            name = "torchrl_hmcts.trainers.experiments.kits.table.ValueTable"
            keys = self.state_entries
            part["leaf_evaluator"] = {"_component_": name, "keys": keys, "gamma": config.gamma}
            part["budget"]["base_steps"] = max(1, config.search_steps // 100)
        return part

    def make_planner(self, simulator: EnvBase, **budget: Any) -> MCTSPlanner:
        planner = super().make_planner(simulator, **budget)
        planner.simulator.keep([self.place_key])  # for pictures
        table: Any = planner.evaluate.leaf_evaluator
        if isinstance(table, ValueTable):
            planner.final_choice = table  # type: ignore[assignment]
            simulator.on_step = table.note
        return planner

    @cached_property
    def state_entries(self) -> Sequence[Any]:
        """Entries of the observation."""
        keys = self._start_env.observation_spec.keys(True, True)
        return [key for key in keys if key not in ("features", "snapshot")]

    @property
    def manager_keys(self) -> Sequence[Any]:
        return [] if self._moves else self.state_entries  # the view of the grid has too little

    @property
    def shorter_paths(self) -> bool:  # type: ignore[override]
        """True where every step costs."""
        return self.look.step_reward < 0.0

    @property
    def replans(self) -> bool:  # type: ignore[override]
        """True if it plans again after every option, rather than execute one plan."""
        return self.look.stochastic or self.look.kind == "return"

    def act(
        self,
        planner: MCTSPlanner,
        real: EnvBase,
        starts: TensorDictBase,
        keys: Sequence[Any] = (),
    ) -> Results:
        if not self.replans:
            return super().act(planner, real, starts, keys)
        return Results.concatenate([self._play(planner, real, one) for one in starts.split(1)])

    def act_by(self, policy: TensorDictModuleBase, real: EnvBase, start: TensorDictBase) -> Results:
        results = super().act_by(policy, real, start)
        if self.look.kind == "return":
            wanted = np.inf if self.threshold is None else self.threshold
            results.solved = results.rewards >= wanted
        return results

    def _play(self, planner: MCTSPlanner, real: EnvBase, start: TensorDictBase) -> Results:
        """Act in one episode, with a search before every option."""
        policy = HierarchicalPolicy(planner, replan_every=1, reuse=True)
        pool: Any = planner.simulator.given_env
        before = pool.num_steps
        if isinstance(planner.final_choice, ValueTable):
            self._fill(planner.final_choice, planner, start)
        results = self.act_by(policy, real, start)
        results.simulated_steps = np.array([pool.num_steps - before])
        if planner.has_searched:
            results.plans = [extract_plans(planner.last_search)[0]]
        return results

    def _fill(self, table: ValueTable, planner: MCTSPlanner, start: TensorDictBase) -> None:
        """Begin an episode's table by a long search, until it has met the goal."""
        table.clear()
        budget, steps = planner.budget, self.config.search_steps
        try:
            planner.budget = SearchBudget(base_steps=steps, until_plan=False)
            search = planner.search(start)
            planner.budget = SearchBudget(expansions=self.config.expansions)
            planner.resume(search)
        finally:
            planner.budget = budget

    # ------------------------------------------------------- figures

    def map(self, env: EnvBase) -> Any:
        if self.look.discrete:
            return None
        from torchrl_hmcts.trainers.figures.maps import FeatureMap

        is_place = self.look.features in (achieved_goal, root_place)
        names = ("x", "y") if is_place else ("feature 0", "feature 1")
        return FeatureMap(_Rows(env), "features", names=names, is_place=is_place)  # type: ignore[arg-type]

    @cached_property
    def _draws_itself(self) -> bool:
        """Whether the env can draw here; what hinders it is printed."""
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # GLFW's, where there is no display
                env = self._env(**{**self.config.make, "render_mode": "rgb_array"})
                env.reset(seed=0)
                picture = env.render()
                env.close()
        except Exception as error:
            name, why = self.config.id or self.gym_env, str(error).partition(",")[0]
            words = f"{name} cannot draw itself here ({why}): its features are drawn."
            print(textwrap.fill(words, WIDTH))
            return False
        return isinstance(picture, np.ndarray)

    def film(
        self,
        worker: TensorDictModuleBase,
        planner: MCTSPlanner,
        start: TensorDictBase,
        *,
        render: str = "",
    ) -> Results:
        if render == "rgb_array" and not self._draws_itself:
            render = ""
        film = Film(self.look.features, render == "rgb_array")
        real = self.make_pool(worker, real=True, film=film, render=render)
        film.clear()
        film.points.append(start["features"][0].numpy())
        episode = self.act(planner, real, start)
        real.close()
        points = torch.from_numpy(np.array(film.points))
        episode.states = [TensorDict({"features": points}, [len(points)])]
        episode.options = [torch.tensor(film.options, dtype=torch.int64)]
        episode.frames = film.frames
        return episode

    def figures(self, trial: Trial) -> dict[str, Any]:
        results = trial.results
        found = results.summary() | {"reward": spread(results.rewards)}
        if not self.can_be_solved:
            found["solved"] = None
        threshold = self.threshold
        if threshold is not None:
            found["reward_threshold"] = threshold
        return found | {"plan_seconds": spread(results.plan_seconds)}

    def rows(self) -> list[tuple[str, str]]:
        solved, *others = super().rows()
        first = [solved] if self.can_be_solved else [("return that counts as solved", "none")]
        return [
            *first,
            ("return, mean over starts", "{test[reward][mean]:.4g}"),
            ("seconds per plan, median", "{test[plan_seconds][median]:.2f}"),
            *others,
        ]

    @property
    def can_be_solved(self) -> bool:  # type: ignore[override]
        """True if there is a goal to reach, or a return that the env asks for."""
        return self.look.kind == "goal" or self.threshold is not None

    @cached_property
    def threshold(self) -> float | None:
        """The return at which the env counts as solved; None where it names none."""
        spec = self.gym_env.spec
        return None if spec is None else spec.reward_threshold

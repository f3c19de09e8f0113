"""The agent in one line: an environment's id, learned skills, plans, and a folder to save it in."""

from __future__ import annotations

import contextlib
import dataclasses
import logging
from collections.abc import Callable, Iterator
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import EnvBase
from torchrl.objectives import LossModule

from torchrl_hmcts import notebook
from torchrl_hmcts.checks import whole_number
from torchrl_hmcts.modules import SkillPolicy
from torchrl_hmcts.planners import MCTSPlanner, Plan
from torchrl_hmcts.trainers.evaluation import Results
from torchrl_hmcts.trainers.experiments import skills
from torchrl_hmcts.trainers.experiments.gym_settings import GymConfig
from torchrl_hmcts.trainers.experiments.kits import Kit, LearnedSkills, make_kit
from torchrl_hmcts.trainers.experiments.kits.gym import GymKit
from torchrl_hmcts.trainers.experiments.managers import (
    learn_manager,
    load_manager,
    save_manager,
)
from torchrl_hmcts.trainers.experiments.registry import KITS, find_experiment, load_config
from torchrl_hmcts.trainers.experiments.settings import SkillsConfig
from torchrl_hmcts.trainers.manager import ManagerPolicy
from torchrl_hmcts.trainers.runs.config import unknown_key
from torchrl_hmcts.trainers.runs.console import Bar
from torchrl_hmcts.trainers.runs.run import FolderRefused, next_free, open_run, run_files
from torchrl_hmcts.trainers.saving.run_folder import read_run
from torchrl_hmcts.trainers.saving.worker_file import save_worker

_OTHER_DRAWS = 1_000_003  # added to the seed of the env to act in, whose draws no planner knows


@dataclasses.dataclass(frozen=True)
class Solution:
    """One episode: its plan, and its result in another instance of the env.

    Attributes:
        solved (bool, optional): whether the goal was reached. If rewards are collected, whether
            their sum reaches the env's ``reward_threshold``; None if the env has none.
        reward (float): the env's own rewards, summed.
        base_steps (int): of the episode.
        num_options (int): that were executed.
        simulated_steps (int): base steps of all searches.
        plan_seconds (float): of all searches.
        plan (Plan, optional): that was executed, or the last one if each option had its own search;
            options ``[L]``.

    Example:
        >>> Solution(True, 1.0, 40, 4, 900, 0.1).solved
        True
    """

    solved: bool | None
    reward: float
    base_steps: int
    num_options: int
    simulated_steps: int
    plan_seconds: float = dataclasses.field(compare=False)
    plan: Plan | None = dataclasses.field(default=None, repr=False, compare=False)


class HMCTS:
    """Learns skills in any environment whose state can be set, plans over them, and acts.

    Without :meth:`learn` the planner's options repeat the env's actions. The parts are TorchRL's
    and this library's: :attr:`env` is the macro environment, :attr:`planner` the manager,
    :attr:`loss` the skill loss with its networks.

    Args:
        env (str or callable): a Gymnasium id, or a function that makes such an env.
        num_skills (int, optional): skills to learn. Default: 8, and what the kit names.
        kit (str): of the env: ``"gym"`` or, with what is known of an ant, ``"ant"``.
        seed (int): of all random numbers. Default 0.
        **keys: of :class:`~torchrl_hmcts.trainers.experiments.gym_settings.GymConfig`, e.g.
            ``option_steps=10``, ``task="return"``, ``make={"max_episode_steps": 500}``,
            ``worker=DIR`` for the skills of another agent or run,
            ``planner={"leaves_per_wave": 8}``. A short look at the env chooses the others.

    Raises:
        ValueError: if the id is unknown (the nearest are named), or the state cannot be stored.
        ImportError: if a package is missing; the extra that has it is named.
        TypeError: if there is no such key; the nearest are named.

    Reference:
        Dissertation, chapters 4 and 5.

    Example:
        >>> from torchrl_hmcts.trainers import HMCTS
        >>> agent = HMCTS("MountainCar-v0", option_steps=14)
        >>> agent
        HMCTS(MountainCar-v0, 3 actions, each for 14 base steps)
        >>> agent.solve(seed=0).solved
        True
    """

    def __init__(
        self,
        env: str | Callable[[], Any] | SkillsConfig,
        *,
        num_skills: int | None = None,
        kit: str = "gym",
        seed: int = 0,
        **keys: Any,
    ) -> None:
        config = env
        if not isinstance(config, SkillsConfig):
            options = "learned" if keys.get("worker") else "directions"
            keys = {"options": options, "seed": seed, **keys}
            if num_skills is not None:
                keys["num_skills"] = num_skills
            made = find_experiment(kit, KITS).config_class
            if not issubclass(made, GymConfig):
                raise ValueError(f"kit={kit!r} is not a kit of Gymnasium envs. Use 'gym' or 'ant'.")
            names = [field.name for field in dataclasses.fields(made)]
            for key in set(keys) - set(names):
                raise TypeError(f"HMCTS: {unknown_key(key, names)} hmcts list {kit} names all.")
            config = made(id=env if isinstance(env, str) else "", **keys)
        self._asked, self._env = config, None if isinstance(env, SkillsConfig) else env
        self.kit = self._make_kit(config)
        self.learned: LearnedSkills | None = None
        self.manager: TensorDictModuleBase | None = None
        self._worker = self.kit.given_worker()
        if config.worker:
            self._take(skills.load_skills(self.kit, config.worker))

    def _make_kit(self, config: Any) -> Kit:
        return make_kit(config, *([self._env] if isinstance(config, GymConfig) else []))

    # ------------------------------------------------------------ parts

    @property
    def config(self) -> SkillsConfig:
        """All keys, those that were found by a look at the env included."""
        return self.kit.config

    @property
    def loss(self) -> LossModule | None:
        """The loss of the worker, with its networks; None before :meth:`learn`."""
        return None if self.learned is None else self.learned.loss

    @property
    def worker(self) -> TensorDictModuleBase:
        """The policy that executes the options."""
        if self._worker is None:
            raise RuntimeError("No skills have been learned. Call learn() first.")
        return self._worker

    @cached_property
    def env(self) -> EnvBase:
        """The macro environment in which the planner searches."""
        return self.kit.make_simulator(self.worker)

    @cached_property
    def planner(self) -> MCTSPlanner:
        """The manager."""
        return self.kit.make_planner(self.env)

    @cached_property
    def real_env(self) -> EnvBase:
        """The macro environment in which the agent acts, another instance."""
        return self.kit.make_real(self.worker)

    @property
    def policy(self) -> TensorDictModuleBase:
        """The manager without a search; :meth:`distill` trains it."""
        if self.manager is None:
            raise RuntimeError("No policy has been distilled from searches. Call distill() first.")
        return ManagerPolicy(self.manager)

    # ------------------------------------------------------------ what it does

    def learn(
        self, base_steps: int | None = None, *, progress: bool = True, save_dir: Any = None
    ) -> HMCTS:
        """Learn skills without reward; return the agent.

        Args:
            base_steps: of training. Default: 50,000, or what the kit names.
            progress: show a bar; False prints nothing.
            save_dir: folder of checkpoints.

        Raises:
            ValueError: if the agent is none of a Gymnasium env.
        """
        if not isinstance(self._asked, GymConfig):
            raise ValueError(
                f"{self} has the kit {self.config.KIT}, which only the command line trains: hmcts "
                f"train kit={self.config.KIT}. Then load its folder."
            )
        changes: dict[str, Any] = {"options": "learned", "worker": ""}
        if base_steps is not None:
            changes["train_base_steps"] = whole_number("learn", "base_steps", base_steps, least=1)
        self.kit = self._make_kit(dataclasses.replace(self._asked, **changes))
        with _torchrl_quiet():
            self._take(skills.learn(self.kit, save_dir=save_dir, progress=_bar("learn", progress)))
        return self

    def _take(self, learned: LearnedSkills) -> None:
        self.learned, self._worker, self.manager = learned, learned.worker, None
        for name in ("env", "planner", "real_env"):
            part = self.__dict__.pop(name, None)
            if isinstance(part, EnvBase):
                part.close()
        self.kit.prepare(learned.worker)

    def distill(
        self, searches: int = 100, *, iterations: int = 2, updates: int = 400, progress: bool = True
    ) -> HMCTS:
        """Train a policy that needs no search, and with it the planner's prior and value.

        Searches from fresh starts are its examples; after the first iteration the network guides
        them. :attr:`planner` is guided from then on, :attr:`policy` acts alone.

        Args:
            searches: of each iteration.
            iterations: in all.
            updates: of the network, in each iteration.
            progress: show a bar; False prints nothing.

        Raises:
            ValueError: if the planner sees nothing but a snapshot of the state.

        Reference:
            Anthony, Tian and Barber, "Thinking fast and slow with deep learning and tree search",
            2017, arXiv 1705.08439.
        """
        env = self.kit.make_simulator(self.worker, "train")
        with _torchrl_quiet(), contextlib.closing(env):
            network = learn_manager(
                self.kit,
                env,
                searches=searches,
                iterations=iterations,
                updates=updates,
                progress=_bar("distil", progress),
            )
        self._guide(network)
        return self

    def _guide(self, network: TensorDictModuleBase) -> None:
        self.manager = self.kit.manager_for(network, "test")
        self.__dict__["planner"] = self.kit.guide(self.kit.make_planner(self.env), self.manager)

    def solve(self, seed: int = 0, *, search: bool = True) -> Solution:
        """Plan from a start, and execute the plan in another instance of the env.

        Args:
            seed: of the start, and of all that is drawn in the episode and its searches.
            search: False: act by :attr:`policy` alone.
        """
        start = self.start(seed)
        if not search:
            return self._solution(self.kit.act_by(self.policy, self.real_env, start))
        return self._solution(self.kit.act(self.planner, self.real_env, start))

    def play(
        self, seed: int = 0, *, render: bool = True, out: str | Path | None = None
    ) -> Solution:
        """Act in one episode that is shown.

        Args:
            seed: of the start.
            render: show a window, as Gymnasium's ``render_mode="human"`` does.
            out: GIF to write instead, with a video (``.mp4``) beside it: the env's own pictures
                where it draws any, else its features.
        """
        if out is not None and Path(out).suffix not in (".gif", ".mp4"):
            raise ValueError(f"out is a film, FILE.gif or FILE.mp4; got {str(out)!r}.")
        start = self.start(seed)
        if out is None:
            mode = "human" if render else ""
            return self._solution(self.kit.film(self.worker, self.planner, start, render=mode))
        episode = self.kit.film(self.worker, self.planner, start, render="rgb_array")
        self.kit.write_film(episode, Path(out).with_suffix(".gif"))
        return self._solution(episode)

    def _solution(self, results: Results) -> Solution:
        return Solution(
            bool(results.solved[0]) if self.kit.can_be_solved else None,
            float(results.rewards[0]),
            int(results.episode_steps[0]),
            int(results.plan_options[0]),
            int(results.simulated_steps[0]),
            float(results.plan_seconds[0]),
            results.plans[0] if results.plans else None,
        )

    def start(self, seed: int) -> TensorDictBase:
        """Begin an episode that depends on nothing but its seed; return its first state ``[1]``."""
        own, seed = self.config, whole_number("HMCTS", "seed", seed)
        with torch.random.fork_rng(devices=[]):  # TorchRL seeds its global generator, too
            self.env.set_seed(seed)
            self.real_env.set_seed(seed + _OTHER_DRAWS)
        self.planner.set_seed(seed)
        try:
            self.kit.config = dataclasses.replace(own, seed=seed)
            return self.kit.starts("test", 1)
        finally:
            self.kit.config = own

    # ------------------------------------------------------------ files

    def save(self, folder: str | Path, *, overwrite: bool = False) -> Path:
        """Write keys and networks into a folder: JSON and plain arrays, no code.

        Args:
            folder: made if absent; ``hmcts play run=FOLDER`` shows the agent.
            overwrite: replace the agent or the run that is in the folder.

        Raises:
            ValueError: if the env is a function, which cannot be written, or the folder holds an
                agent or a run already.
        """
        if isinstance(self.kit, GymKit) and not self.kit.config.id:
            raise ValueError(
                "An agent over a function that makes its env cannot be saved: register the env "
                "with gymnasium.register and build the agent from its id."
            )
        if not overwrite and run_files(Path(folder)):
            raise FolderRefused(
                f"{str(folder)!r} holds an agent or a run already. Save into another folder, e.g. "
                f"{next_free(str(folder))!r}, or pass overwrite=True to replace it."
            )
        changes: dict[str, Any] = {"out": str(folder), "overwrite": overwrite, "resume": False}
        with open_run(dataclasses.replace(self.config, **changes)) as run:
            if self.learned is not None and self.learned.loss is not None:
                save_worker(run.path, self.learned.loss, self.learned.worker_step)
            if self.manager is not None:
                save_manager(run.path, self.manager)
        return run.path

    @classmethod
    def load(cls, folder: str | Path) -> HMCTS:
        """Read an agent that :meth:`save` or ``hmcts train`` wrote.

        Args:
            folder: of the agent, or of a run of the kits ``gym``, ``waterworld`` and ``labmaze``.

        Raises:
            FileNotFoundError: if it has no networks yet.
            ValueError: if there is no such folder, it holds another kind of run, or is damaged.
        """
        _, config = load_config(read_run(folder))
        if not isinstance(config, SkillsConfig):
            raise ValueError(f"{folder} holds a run of {config.EXPERIMENT}, which has no skills.")
        agent = cls(config)
        if config.options == "learned":
            agent._take(skills.load_skills(agent.kit, folder))
        network = load_manager(agent.kit, folder, lambda: agent.env)
        if network is not None:
            agent._guide(network)
        return agent

    def _repr_html_(self) -> str:
        planner: Any = self.__dict__.get("planner")
        searched = planner is not None and planner.has_searched
        return notebook.shown(repr(self)) + (planner.last_search._repr_html_() if searched else "")

    def __repr__(self) -> str:
        config = self.config
        name = getattr(config, "id", "") or getattr(self._env, "__name__", config.EXPERIMENT)
        what = "skills" if config.options == "learned" else "actions"
        return (
            f"HMCTS({name}, {config.num_skills} {what}, each for {config.option_steps} base step"
            f"{'s' * (config.option_steps != 1)})"
        )


def _bar(name: str, shown: bool) -> Callable[..., Any] | None:
    return partial(Bar, desc=name) if shown else None


@contextlib.contextmanager
def _torchrl_quiet() -> Iterator[None]:
    """Hides messages of TorchRL that are not warnings."""
    logger = logging.getLogger("torchrl")
    level = logger.level
    logger.setLevel(max(level, logging.WARNING))
    try:
        yield
    finally:
        logger.setLevel(level)


def load_worker(folder: str | Path) -> SkillPolicy:
    """Return the skills of an agent alone: a policy that reads an observation and a skill.

    Args:
        folder: as of :meth:`HMCTS.load`.

    Returns:
        The policy, in evaluation mode, with its most probable actions.

    Raises:
        FileNotFoundError: if it has no networks yet.
        ValueError: if there is no such folder, or the agent's options are given, not learned.

    Example:
        >>> import tempfile
        >>> from torchrl_hmcts.trainers import HMCTS, load_worker
        >>> folder = tempfile.mkdtemp()
        >>> agent = HMCTS("MountainCar-v0", option_steps=14).learn(64, progress=False)
        >>> load_worker(agent.save(folder)).in_keys
        ['observation', 'skill']
    """
    worker = HMCTS.load(folder).worker
    if not isinstance(worker, SkillPolicy):
        raise ValueError(
            f"{folder} holds an agent whose options are given, so it has no learned worker. Load "
            f"the agent: HMCTS.load({str(folder)!r})."
        )
    worker.eval()
    return worker

"""Chapter 3: A3C in Waterworld's mazes, with goals that a tree search sets or without."""

from __future__ import annotations

import time
from collections.abc import Sequence
from functools import partial
from operator import index
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from torch import Tensor, nn
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType
from torchrl.modules import MLP, ProbabilisticActor, ValueOperator

from torchrl_hmcts.envs import WaterworldMazeEnv, maze_pool
from torchrl_hmcts.objectives import A3CLoss
from torchrl_hmcts.trainers.a3c.trainer import A3CTrainer
from torchrl_hmcts.trainers.experiments.kits.waterworld import make_starts
from torchrl_hmcts.trainers.experiments.settings import WaterworldA3CConfig, WaterworldGoalsConfig
from torchrl_hmcts.trainers.experiments.waterworld.episodes import (
    MazeTest,
    play_mazes,
)
from torchrl_hmcts.trainers.experiments.waterworld.goal_planning import (
    make_goal_env,
    make_tile_planner,
)
from torchrl_hmcts.trainers.figures.pictures import Pictures
from torchrl_hmcts.trainers.runs import console
from torchrl_hmcts.trainers.runs.loggers import make_logger
from torchrl_hmcts.trainers.runs.run import Run, open_run
from torchrl_hmcts.trainers.saving.worker_file import load_networks, save_worker

_GOAL_KEYS = (
    *("num_goals", "goal_met_threshold", "goal_divergence_threshold"),
    *("r_tick", "r_goal_met", "r_goal_divergence"),
)
_MAX_SPEED, _MAX_DISTANCE = 2.0, 2.0  # tiles a second; tiles from a goal that count as strayed


def run_goals(config: WaterworldA3CConfig) -> dict[str, Any]:
    """Run ``hmcts train experiment=waterworld_goals`` or ``waterworld_a3c``; return its figures.

    Times are in seconds, steps in base steps.

    Reference:
        Dissertation, chapter 3.
    """
    with open_run(config) as run:
        return _run(run.config.sized(), run)


def _run(config: WaterworldA3CConfig, run: Run) -> dict[str, Any]:
    torch.set_num_threads(1)  # the networks are small: threads would only get in each other's way
    tests, starts = _tests(config)
    loss = make_agent_loss(config)

    def evaluate(policy: TensorDictModuleBase) -> dict[str, float]:
        test = play_mazes(policy, tests, starts[: config.eval_mazes], seed=config.seed)
        return {
            "solved_share": float(test.solved.double().mean()),
            "episode_steps": float(test.base_steps.double().mean()),
        }

    logger = make_logger(config)
    trainer = A3CTrainer(
        partial(make_agent_env, config, None, (config.envs_per_learner,)),
        loss,
        total_frames=config.total_frames,
        segment_steps=config.segment_steps,
        num_learners=config.num_learners,
        lr=config.learning_rate,
        clip_norm=config.clip_norm,
        evaluate=evaluate,
        eval_interval=config.eval_interval,
        logger=logger,
        save_dir=run.checkpoints,
        progress=partial(console.Bar, desc="learn", unit="base steps"),
        seed=config.seed,
    )
    kept = [key for key in config.KEPT if key != "toy"]
    trainer.run_settings.update({name: getattr(config, name) for name in kept})
    if run.resumes:
        trainer.load(run.checkpoints)
    name = "the worker of the goal-based agent" if _with_goals(config) else "A3C without goals"
    console.say(f"Training {name}, {config.total_frames:,} base steps ...")
    begin = time.perf_counter()
    history = trainer.train()
    train_seconds = time.perf_counter() - begin
    save_worker(run.path, loss, trainer.frames)
    steps = {True: history["eval_frames"], False: history["frames"]}
    curves = {k: (steps[k.startswith("eval_")], values) for k, values in history.items()}
    run.write_curves(curves, "base_steps")

    console.say(f"Testing in {config.test_mazes} mazes it has never seen ...")
    policy = loss.actor_network
    sampled = play_mazes(policy, tests, starts, seed=config.seed)
    greedy = play_mazes(policy, tests, starts, deterministic=True)
    metrics: dict[str, Any] = {
        "seed": config.seed,
        "train_base_steps": int(history["frames"][-1]),
        "train_seconds": round(train_seconds, 1),
        "test": sampled.summary(),
        "test_greedy": greedy.summary(),
    }
    if _with_goals(config):
        for key in ("num_plans", "num_goals_met", "num_divergences"):
            metrics["test"][f"{key}_mean"] = round(float(sampled.last[key].double().mean()), 3)
    with run.finish(metrics, config, title=f"Random mazes: {name}") as pictures:
        words = "Test mazes solved and base steps of an episode while it learns."
        with pictures.one("learning.png", words) as path:
            from torchrl_hmcts.trainers.figures.curves import learning_panels, plot_training

            curve = {
                "training_steps": history["eval_frames"],
                "solved_share": history["eval_solved_share"],
                "episode_steps": history["eval_episode_steps"],
            }
            plot_training(
                {name: [curve]},
                learning_panels(config.max_episode_steps),
                path,
                title=f"{name[0].upper()}{name[1:]}, seed {config.seed}",
            )
        if _with_goals(config):
            _draw_episode(policy, tests, starts, greedy, pictures)
        logger.log_pictures(run.path, pictures.captions)
    logger.close()
    print(console.figures_table({k: metrics[k] for k in ("train_seconds", "test", "test_greedy")}))
    return metrics


def evaluate_goals(config: WaterworldA3CConfig) -> dict[str, Any]:
    """Test the agent of a run, whose folder is ``out``, with the starts of ``config.seed``.

    Returns figures with sampled actions (``"test"``) and with the most probable
    (``"test_greedy"``).

    Reference:
        Dissertation, figure 3.6.
    """
    config = config.sized()
    torch.set_num_threads(1)
    loss = make_agent_loss(config)
    checkpoint = load_networks(loss, config.out)
    tests, starts = _tests(config)
    policy = loss.actor_network
    return {
        "checkpoint": checkpoint.name,
        "test": play_mazes(policy, tests, starts, seed=config.seed).summary(),
        "test_greedy": play_mazes(policy, tests, starts, deterministic=True).summary(),
    }


def _with_goals(config: WaterworldA3CConfig) -> bool:
    return isinstance(config, WaterworldGoalsConfig)


def _tests(config: WaterworldA3CConfig) -> tuple[EnvBase, TensorDictBase]:
    """The env of the test mazes, and a start in each."""
    env = make_agent_env(config, maze_pool("test"))
    base: Any = env.base_env if _with_goals(config) else env
    return env, make_starts(base, config.test_mazes, config.seed)


def make_agent_env(
    config: WaterworldA3CConfig, mazes: Tensor | None = None, batch_size: tuple[int, ...] = ()
) -> EnvBase:
    """Build Waterworld as the agent of an experiment meets it, with its goals if it has any."""
    arguments: dict[str, Any] = {"max_steps": config.max_episode_steps, "batch_size": batch_size}
    if _with_goals(config):
        arguments.update({name: getattr(config, name) for name in _GOAL_KEYS})
        return make_goal_env(mazes, **arguments)
    return WaterworldMazeEnv(mazes, **arguments)


def make_agent_loss(config: WaterworldA3CConfig) -> A3CLoss:
    """Build actor, critic and loss; the agents with and without goals differ in one input."""
    in_keys = ["observation", "velocity", *["goals"] * _with_goals(config)]
    actor, critic = make_maze_networks(
        make_agent_env(config), in_keys=in_keys, hidden=config.hidden, seed=config.seed
    )
    return A3CLoss(
        actor,
        critic,
        entropy_coeff=config.entropy_coeff,
        critic_coeff=config.critic_coeff,
        gamma=config.gamma,
    )


class _Scaled(nn.Module):
    """Two hidden layers over entries of Waterworld, brought to numbers around one.

    Places are counted from the maze's middle in half widths, the velocity in what thrust reaches,
    goals (relative to the player) in the distance that counts as strayed.
    """

    def __init__(self, inputs: int, outputs: int, *, hidden: int, half_size: float) -> None:
        super().__init__()
        self.half_size = half_size
        self.layers = MLP(inputs, outputs, num_cells=[hidden, hidden], activation_class=nn.Tanh)

    def forward(self, observation: Tensor, velocity: Tensor, goals: Tensor | None = None) -> Tensor:
        parts = [observation / self.half_size - 1.0, velocity / _MAX_SPEED]
        if goals is not None:
            parts.append(goals / _MAX_DISTANCE)
        return self.layers(torch.cat(parts, -1))


def make_maze_networks(
    env: EnvBase, *, in_keys: Sequence[str], hidden: int = 128, seed: int = 0
) -> tuple[ProbabilisticActor, ValueOperator]:
    """Build actor and critic for Waterworld: two hidden layers each.

    Args:
        env: whose specs give the sizes.
        in_keys: ``"observation"``, ``"velocity"`` and, for an agent with goals, ``"goals"``.
        hidden: units of each hidden layer.
        seed: of the initial weights.

    Returns:
        The actor, which writes ``"action"`` and its log-probability, and the critic, which writes
        ``"state_value"``.

    Example:
        >>> from torchrl_hmcts.envs import WaterworldMazeEnv
        >>> env = WaterworldMazeEnv(batch_size=[2])
        >>> actor, critic = make_maze_networks(env, in_keys=["observation", "velocity"])
        >>> actor(critic(env.reset()))["action"].shape
        torch.Size([2])
    """
    spec = env.observation_spec
    size = sum(int(np.prod(spec[key].shape[len(env.batch_size) :])) for key in in_keys)
    half_size = float(spec["position"].space.high.max()) / 2.0
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(index(seed))
        num_actions = int(env.action_spec.space.n)
        logits = _Scaled(size, num_actions, hidden=hidden, half_size=half_size)
        value = _Scaled(size, 1, hidden=hidden, half_size=half_size)
    with torch.no_grad():
        logits.layers[-1].weight.mul_(0.01)  # all actions about equally likely at first
    actor = ProbabilisticActor(
        TensorDictModule(logits, in_keys=list(in_keys), out_keys=["logits"]),
        in_keys=["logits"],
        out_keys=["action"],
        distribution_class=torch.distributions.Categorical,
        return_log_prob=True,
        default_interaction_type=ExplorationType.RANDOM,
    )
    return actor, ValueOperator(value, in_keys=list(in_keys))


def _draw_episode(
    policy: TensorDictModuleBase,
    env: EnvBase,
    starts: TensorDictBase,
    test: MazeTest,
    pictures: Pictures,
) -> None:
    """Draw a rather long episode, solved if there is one: Figure 3.5, the search, and a GIF."""
    among = torch.nonzero(test.solved).flatten() if test.solved.any() else torch.arange(len(starts))
    by_length = among[test.base_steps[among].argsort(stable=True)]
    shown = int(by_length[int(0.85 * (len(by_length) - 1))])
    start = starts[shown]
    one = starts[shown : shown + 1]
    track = play_mazes(policy, env, one, deterministic=True, record=True).tracks[0]
    words = "A test maze: the player (blue) follows the goals (magenta) to the target (green)."
    if not track.solved:
        steps = len(track.positions) - 1
        words = words.replace("maze", f"maze that was NOT solved in {steps} base steps")
    with pictures.one("episode.gif", words) as path:
        from torchrl_hmcts.trainers.figures.goals import write_goal_gif

        write_goal_gif(env.base_env, start, track, path)
    words = "The same episode: the manager's goals, half way, and at the end."
    with pictures.one("goals.png", words) as path:
        from torchrl_hmcts.trainers.figures.goals import plot_goals

        plot_goals(env.base_env, start, track, path)
    words = "The manager's tree over tiles, and the path it found."
    with pictures.one("search.png", words) as path:
        from torchrl_hmcts.trainers.figures.goals import plot_tile_search

        manager = make_tile_planner(env.base_env)
        goals, lengths = manager.plan_goals(start[None])
        search = manager.planner.last_search
        assert search is not None
        plot_tile_search(env.base_env, start, search, goals[0, : int(lengths[0])], path)

"""Any Gymnasium env as a task: what a short look finds, the kit over it, and the agent."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium import spaces
from tensordict import TensorDict

from torchrl_hmcts.envs import OptionPool, RepeatActions, SettableGymEnv
from torchrl_hmcts.envs.gym.features import WithFeatures, whole_observation
from torchrl_hmcts.envs.gym.snapshots import ReplaySnapshot, redraw
from torchrl_hmcts.envs.gym.task import TaskEnv, fixed_actions, look_at
from torchrl_hmcts.planners import (
    HierarchicalPolicy,
    HighestValue,
    MCTSPlanner,
    MostVisited,
    SearchBudget,
)
from torchrl_hmcts.testing import ChainEnv
from torchrl_hmcts.trainers import HMCTS, load_worker, make_kit
from torchrl_hmcts.trainers.cli import main
from torchrl_hmcts.trainers.experiments.kits.table import ValueTable
from torchrl_hmcts.trainers.saving.run_folder import read_run


class Line(gymnasium.Env):
    """A walk on whole places 0 to 9, or with ``noise`` one that slips; 9 ends it."""

    action_space = spaces.Discrete(2)
    observation_space = spaces.Box(0.0, 9.0, (1,))

    def __init__(self, reward: str = "sparse", noise: bool = False) -> None:
        self.reward, self.noise, self.place = reward, noise, 0

    def _shown(self) -> np.ndarray:
        return np.array([self.place], np.float32)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[np.ndarray, dict]:
        super().reset(seed=seed)
        self.place = 0
        return self._shown(), {}

    def step(self, action: int) -> tuple[np.ndarray, float, bool, bool, dict]:
        slips = self.noise and self.np_random.random() < 0.3
        self.place = max(0, self.place + (1 if bool(action) != slips else -1))
        over = self.place == 9
        paid = {"sparse": float(over), "cost": -1.0, "dense": float(self.place)}[self.reward]
        return self._shown(), paid, over, False, {}


def test_rewards_on_the_way_make_a_task_of_returns_and_costs_one_of_a_goal() -> None:
    looks = {reward: look_at(lambda r=reward: Line(r)) for reward in ("sparse", "cost", "dense")}
    assert {reward: look.kind for reward, look in looks.items()} == {
        "sparse": "goal",
        "cost": "goal",
        "dense": "return",
    }
    assert not any(look.stochastic for look in looks.values())
    assert look_at(lambda: Line(noise=True)).stochastic


def test_an_option_moves_the_features_by_a_twelfth_of_what_they_span() -> None:
    look = look_at(lambda: Line())
    env = Line()
    points = [look.features(env, np.array([place], np.float32)) for place in (0.0, 1.0)]
    step = float(abs(points[1] - points[0]).item())  # of one base step
    assert look.novelty_radius == pytest.approx(look.option_steps * step / 2)
    assert look.option_steps * step >= 0.08 > (look.option_steps - 1) * step


def test_an_option_ends_where_it_no_longer_moves_the_features() -> None:
    keywords: dict[str, Any] = {"features": whole_observation, "num_processes": 0, "max_steps": 18}
    lengths = {}
    for still in (0.0, 0.5):  # in a fifth of 18 steps, rounded up
        pool = OptionPool(lambda: Line(), RepeatActions(2), still=still, **keywords)
        starts = pool.reset().expand(2).clone().set("option", torch.arange(2))
        lengths[still] = pool.step(starts)["next", "duration"].flatten().tolist()
    assert lengths == {0.0: [18, 9], 0.5: [5, 9]}  # left is a wall, right the goal


@pytest.mark.parametrize(
    ("reward", "terminated", "info", "solved"),
    [
        (1.0, True, {}, True),
        (0.0, True, {}, False),
        (-1.0, True, {}, True),  # every step costs 1, and this one ended it
        (-9.0, True, {}, False),
        (1.0, False, {}, False),
        (0.0, False, {"success": True}, True),
        (5.0, True, {"is_success": False}, False),
    ],
)
def test_what_counts_as_a_success(
    reward: float, terminated: bool, info: dict[str, Any], solved: bool
) -> None:
    step_reward = -1.0 if reward < 0.0 else 0.0
    task = TaskEnv(Line(), step_reward=step_reward)
    assert task.is_success(reward, terminated, info) is solved


def test_actions_to_repeat() -> None:
    assert fixed_actions(spaces.Discrete(3, start=1)) == [1, 2, 3]
    eight = np.array(fixed_actions(spaces.Box(-2.0, 2.0, (2,))))
    assert eight.shape == (8, 2)
    assert np.allclose(np.linalg.norm(eight, axis=1), 2.0)
    ends = np.array(fixed_actions(spaces.Box(np.array([0, 0, 0]), np.array([2, 4, 6]))))
    assert ends[[0, 3]].tolist() == [[2.0, 2.0, 3.0], [0.0, 2.0, 3.0]]
    assert len(fixed_actions(spaces.MultiDiscrete([2, 3]))) == 6
    with pytest.raises(ValueError, match="Learn skills"):
        fixed_actions(spaces.MultiDiscrete([9, 9]))


def test_pools_and_settable_envs_write_the_same_features() -> None:
    def features(env: gymnasium.Env, observation: np.ndarray) -> np.ndarray:
        return np.array([observation[0], 2 * env.unwrapped.place], np.int64)  # type: ignore[attr-defined]

    pool = OptionPool(Line, RepeatActions(2), max_steps=3, num_processes=0, features=features)
    after = pool.step(pool.reset().set("option", torch.tensor(1)))["next"]
    assert after["features"].tolist() == [3, 6]
    env = SettableGymEnv(Line, features=features)
    assert env.rollout(1, lambda td: td.set("action", torch.tensor(1)))["next", "features"][
        0
    ].tolist() == [1, 2]
    shown, _ = WithFeatures(Line(), features).reset()
    assert shown["features"].tolist() == [0, 0]


def test_a_search_before_every_option_takes_the_final_choice() -> None:
    class Left:
        def choose(self, search: Any) -> np.ndarray:
            return np.zeros(search.num_roots, np.int64)

    planner = MCTSPlanner(ChainEnv(length=4), final_choice=Left())
    policy = HierarchicalPolicy(planner, replan_every=1)
    assert policy(ChainEnv(length=4).reset())["action"].item() == 0  # the plan says 1


def test_an_agent_solves_saves_and_is_loaded(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    agent = HMCTS("MountainCar-v0", option_steps=14, novelty_radius=0.06, expansions=300)
    solution = agent.solve(seed=3)
    assert solution.solved
    assert solution.reward == -solution.base_steps
    assert int(solution.plan.durations) == solution.base_steps  # type: ignore[union-attr]
    again = HMCTS.load(agent.save(tmp_path / "given"))
    assert repr(again) == repr(agent) == "HMCTS(MountainCar-v0, 3 actions, each for 14 base steps)"
    assert again.solve(seed=3) == solution
    capfd.readouterr()
    agent.learn(640, progress=False)
    assert capfd.readouterr() == ("", "")
    assert agent.config.num_skills == 8
    assert agent.loss is not None
    again = HMCTS.load(agent.save(tmp_path / "learned"))
    assert again.solve(seed=3) == agent.solve(seed=3)
    td = again.kit.make_training_env(2).reset()
    assert torch.equal(
        load_worker(tmp_path / "learned")(td.clone())["action"], agent.worker(td)["action"]
    )


def test_rewards_are_collected_with_a_search_before_every_option() -> None:
    def make() -> gymnasium.Env:
        return gymnasium.wrappers.TimeLimit(Line("dense"), 12)

    agent = HMCTS(make, option_steps=1, search_steps=200, gamma=0.9)
    solution = agent.solve()
    assert solution.solved is None  # nothing says which return would do
    assert isinstance(agent.planner.final_choice, HighestValue)
    assert agent.planner.budget == SearchBudget(base_steps=200, until_plan=False)
    assert solution.base_steps == 12  # to the right and to the end would take 9
    assert 1 + 2 + 3 + 4 + 5 + 6 + 7 + 8 + 9 < solution.reward <= 36 + 7 + 8 + 7 + 8
    with pytest.raises(ValueError, match=r"gymnasium\.register"):
        agent.save("nowhere")


@pytest.mark.parametrize(
    ("name", "backup", "depth"), [("CartPole-v1", "mean", 30), ("Pendulum-v1", "max", 10)], ids=str
)
def test_where_it_pays_to_live_on_the_mean_over_rollouts_counts(
    name: str, backup: str, depth: int
) -> None:
    planner = HMCTS(name).planner
    assert planner.backup == backup
    assert planner.rollout.max_options == depth
    chooses = MostVisited if backup == "mean" else HighestValue
    assert isinstance(planner.final_choice, chooses)


@pytest.mark.parametrize(("threshold", "solved"), [(20.0, True), (99.0, False)])
def test_a_return_counts_as_solved_from_the_envs_threshold_on(
    threshold: float, solved: bool
) -> None:
    keywords = {"max_episode_steps": 12, "reward_threshold": threshold}
    gymnasium.register("TestDense-v0", Line, kwargs={"reward": "dense"}, **keywords)
    solution = HMCTS("TestDense-v0", option_steps=1, search_steps=50, gamma=0.9).solve()
    gymnasium.registry.pop("TestDense-v0")
    assert 20.0 < solution.reward < 99.0
    assert solution.solved is solved


def test_where_every_step_costs_the_plan_is_the_shortest() -> None:
    agent = HMCTS("Taxi-v4")
    for seed in range(3):
        solution = agent.solve(seed=seed)
        taxi: Any = gymnasium.make("Taxi-v4").unwrapped
        reached, steps = {int(agent.start(seed)["observation"])}, 0
        while 20 not in {taxi.P[s][a][0][2] for s in reached for a in range(6)}:
            reached |= {taxi.P[s][a][0][1] for s in reached for a in range(6)}
            steps += 1
        assert solution.reward == 20 - steps


class Slope(gymnasium.Env):
    """Go one place further with probability 0.8, or two with 0.5, or else fall; 4 is the goal."""

    action_space, observation_space = spaces.Discrete(2), spaces.Discrete(6)
    place = 0

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[int, dict]:
        super().reset(seed=seed)
        self.place = 0
        return self.place, {}

    def step(self, action: int) -> tuple[int, float, bool, bool, dict]:
        lucky = self.np_random.random() < (0.5 if action else 0.8)
        falls = bool(action) and not lucky
        self.place = min(4, self.place + lucky * (2 if action else 1))
        return self.place, float(self.place == 4), falls or self.place == 4, False, {}


def test_with_chance_the_agent_takes_the_surer_way() -> None:
    agent = HMCTS(Slope, search_steps=300)
    assert agent.kit.look.stochastic
    solutions = [agent.solve(seed=seed) for seed in range(5)]
    assert all(solution.solved for solution in solutions)
    assert len({solution.base_steps for solution in solutions}) > 1  # it does not know the dice


def test_a_table_learns_the_values_of_a_random_chain() -> None:
    pool = OptionPool(Slope, RepeatActions(2), max_steps=1, num_processes=0, determinised=False)
    table = ValueTable(["observation"], gamma=0.9)
    pool.on_step = table.note
    state = pool.reset(TensorDict({}, [1]))
    for option in np.random.default_rng(0).integers(2, size=(3_000, 1)):
        td = pool.step(state.set("option", torch.from_numpy(option)))["next"]
        over = bool(td["done"])
        state = pool.reset(TensorDict({}, [1])) if over else td.exclude("reward")
    q = 0.8 * 0.9 / (1 - 0.2 * 0.9)  # of a step that may have to be taken again
    values = table(TensorDict({"observation": torch.arange(4)}, [4]))
    last = 0.8 / (1 - 0.2 * 0.9)
    assert values.numpy() == pytest.approx([last * q**3, last * q**2, last * q, last], abs=0.05)


def test_states_of_a_pool_with_other_dice_are_whole() -> None:
    dice = {"max_steps": 4, "num_processes": 0, "determinised": False, "seed": 0}
    pool = OptionPool(lambda: Line(noise=True), RepeatActions(2), **dice)
    start = pool.reset().expand(40).clone().set("option", torch.ones(40, dtype=torch.int64))
    after = pool.step(start)["next"]
    places, rows = after["observation"].flatten().tolist(), after["snapshot"].tolist()
    assert len(set(places)) == len({tuple(row) for row in rows}) > 1  # equal states, equal rows
    env, other = Line(noise=True), Line(noise=True)
    snapshot, again = ReplaySnapshot(env, max_steps=20), ReplaySnapshot(other, max_steps=20)
    snapshot.note_reset(3)
    env.reset(seed=3)
    for step in range(20):
        if step % 4 == 0:
            redraw([env], step + 1)
            snapshot.note_redraw(step + 1)
        snapshot.note_step(1)
        env.step(1)
        again.restore(snapshot.read())  # on the way
        assert other.place == env.place
    again.note_reset(0)
    again.restore(snapshot.read())  # from the beginning
    assert other.place == env.place


def test_the_kit_from_the_command_line(tmp_path: Path) -> None:
    words = ["kit=gym", "env.id=MountainCar-v0", "make.max_episode_steps=150", "toy=true"]
    assert main(["train", *words, f"out={tmp_path}", "train_base_steps=640"]) == 0
    run = read_run(tmp_path)
    assert run.config["make"] == {"max_episode_steps": 150}
    assert {"episode.gif", "search.png", "skills.png"} <= set(run.pictures)
    assert json.loads((tmp_path / "metrics.json").read_text())["test"]["starts"] == 2
    assert HMCTS.load(tmp_path).config.num_skills == 8


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ([], "say which env: env.id=NAME"),
        (["env.id=MountainCa-v0"], "MountainCar-v0"),
        (["env.id=MountainCar-v0", "options=fly"], "options is one of"),
    ],
)
def test_wrong_words_say_what_to_write(
    words: list[str], message: str, capsys: Any, tmp_path: Path
) -> None:
    assert main(["train", "kit=gym", *words, f"out={tmp_path / 'run'}"]) in (1, 2)
    assert message in capsys.readouterr().err
    assert not (tmp_path / "run").exists()


def test_goals_are_found_on_features_that_actions_control() -> None:
    agent = HMCTS(lambda: Line(), options="goals")
    goals = agent.kit._fixed.goals  # type: ignore[attr-defined]
    assert {(g.controlled, g.raising, g.lowering) for g in goals} == {(0, 1, 0)}
    scale = float(goals[0].features(None, np.array([1.0])).item())  # of one place
    assert [g.value / scale for g in goals] == pytest.approx([-0.8, 1.6, 4.0, 6.4, 8.8])  # of 0..8
    solution = agent.solve(seed=0)
    assert solution.solved
    assert solution.base_steps == 9
    with pytest.raises(ValueError, match="are categories without an order. Use options=actions"):
        HMCTS("FrozenLake-v1", options="goals")


def test_what_does_not_fit_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(TypeError, match="key 'option_step'. Did you mean: option_steps"):
        HMCTS("CartPole-v1", option_step=3)
    given = HMCTS("MountainCar-v0", option_steps=14).save(tmp_path / "given")
    with pytest.raises(ValueError, match=r"options are given \(options=directions\), not learned"):
        HMCTS("MountainCar-v0", worker=given)
    agent = HMCTS("MountainCar-v0", option_steps=14).learn(64, progress=False)
    learned = agent.save(tmp_path / "learned")
    with pytest.raises(ValueError, match="learned in MountainCar-v0; .* do not fit CartPole-v1"):
        HMCTS("CartPole-v1", worker=learned)
    words = ["kit=gym", "env.id=CartPole-v1", f"worker={learned}", f"out={tmp_path / 'run'}"]
    assert main(["train", *words]) == 1
    assert "do not fit CartPole-v1" in capsys.readouterr().err

    class Wide(Line):
        def reset(self, **keywords: Any) -> Any:
            self.memory = np.zeros(10_000)
            return super().reset(**keywords)

    with pytest.raises(ValueError, match="80,.* bytes.* OptionPool, and plan in it by MCTSPlanner"):
        HMCTS(lambda: Wide())


def test_no_skills_no_worker() -> None:
    with pytest.raises(RuntimeError, match=r"Call learn\(\) first"):
        HMCTS("MountainCar-v0", options="learned").solve()


def test_a_distilled_manager_guides_the_search_and_acts_alone(tmp_path: Path) -> None:
    gymnasium.register("TestLine-v0", Line)
    agent = HMCTS("TestLine-v0", option_steps=1, gamma=0.9)
    with pytest.raises(RuntimeError, match=r"Call distill\(\) first"):
        agent.solve(search=False)
    agent.distill(2, iterations=2, updates=80, progress=False)
    alone = agent.solve(search=False)
    assert (alone.solved, alone.base_steps, alone.simulated_steps) == (True, 9, 0)
    again = HMCTS.load(agent.save(tmp_path))
    assert again.solve(search=False) == alone
    assert again.solve() == agent.solve()
    gymnasium.registry.pop("TestLine-v0")


def test_an_episode_depends_on_nothing_but_its_seed() -> None:
    agent = HMCTS(lambda: Line(noise=True), option_steps=1, search_steps=400)
    before, noise = agent.solve(seed=2), torch.get_rng_state()
    agent.solve(seed=1)
    assert agent.solve(seed=2) == before
    assert agent.config.seed == 0
    assert torch.equal(torch.get_rng_state(), noise)  # the caller's draws are his own


def test_an_agent_is_not_written_over_a_run(tmp_path: Path) -> None:
    agent = HMCTS("MountainCar-v0", option_steps=14)
    agent.save(tmp_path)
    (tmp_path / "manager.torchrl").write_bytes(b"of an older agent")
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(ValueError, match="holds an agent or a run already.*overwrite=True"):
        agent.save(tmp_path)
    agent.save(tmp_path, overwrite=True)
    names = sorted(path.name for path in tmp_path.iterdir() if not path.name.startswith("."))
    assert names == ["notes.txt", "run.json"]


def test_wrong_arguments_of_the_agent_are_named(tmp_path: Path) -> None:
    agent = HMCTS("MountainCar-v0", option_steps=14)
    with pytest.raises(ValueError, match="learn needs base_steps >= 1; got -5"):
        agent.learn(-5)
    with pytest.raises(TypeError, match="needs a whole number for seed; got 'x', a str"):
        agent.solve(seed="x")
    with pytest.raises(ValueError, match=r"FILE.gif or FILE.mp4; got 'film.xyz'"):
        agent.play(out="film.xyz")
    with pytest.raises(ValueError, match="'nowhere' is no folder of a run: it does not exist"):
        HMCTS.load("nowhere")
    with pytest.raises(TypeError, match="make_kit needs a SkillsConfig for config; got 'ant'"):
        make_kit("ant")


def test_ogbenchs_tasks_follow_the_seed() -> None:
    pytest.importorskip("ogbench")
    agent = HMCTS("pointmaze-medium-v0")
    places = [agent.start(seed)["observation"][0].round() for seed in (0, 1, 5)]
    assert not torch.equal(places[0], places[1])
    assert (places[0] - places[2]).norm() < 3.0  # task 1 with other noise

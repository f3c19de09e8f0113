"""Tasks in which skills and search matter: boats, apples, keys, larger mazes; managers; novelty."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from queue_search import ORDERS, plan_by_queue, search
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torchrl.envs import TransformedEnv
from torchrl.envs.utils import check_env_specs

from torchrl_hmcts.envs import MazeItems, WaterworldMazeEnv, maze_from_text, maze_pool
from torchrl_hmcts.modules import SkillPolicy
from torchrl_hmcts.planners import (
    MCTSPlanner,
    RadiusNovelty,
    RolloutEvaluator,
    SearchBudget,
)
from torchrl_hmcts.testing import ChainEnv
from torchrl_hmcts.trainers import HMCTS, DemoConfig, make_kit
from torchrl_hmcts.trainers.cli import main
from torchrl_hmcts.trainers.experiments.managers import learn_manager, load_manager, save_manager
from torchrl_hmcts.trainers.experiments.settings import LabMazeConfig
from torchrl_hmcts.trainers.experiments.skills import make_loss, solve
from torchrl_hmcts.trainers.runs.config import ExperimentError
from torchrl_hmcts.transforms import OptionTransform

OPEN = torch.zeros(1, 9, 9, dtype=torch.bool)
DT, THRUST = WaterworldMazeEnv.TIME_STEP, WaterworldMazeEnv.THRUST
RIGHT = torch.tensor(3)


def fixed_worker() -> TensorDictModule:
    return TensorDictModule(lambda skill: skill, ["skill"], ["action"])


def plan_with_features(features: str) -> MCTSPlanner:
    kit = make_kit(DemoConfig(features=features))
    make_loss(kit)
    return kit.make_planner(kit.make_options(kit.make_env("test"), fixed_worker()))


@pytest.mark.parametrize(
    "keywords",
    [
        {"steering": "heading"},
        {"items": MazeItems(apples=3)},
        {"items": MazeItems(apples=2, key=True), "steering": "heading", "drag": 4.0},
    ],
)
def test_a_task_keeps_the_contract_of_an_env_and_can_be_set(keywords) -> None:
    env = WaterworldMazeEnv(batch_size=[3], seed=0, **keywords)
    check_env_specs(env)
    first = env.rand_step(env.reset())["next"]
    again = env.reset(first.clone(), set_state=True)
    action = env.action_spec.rand()
    one, two = (env.step(td.clone().set("action", action))["next"] for td in (first, again))
    assert (one == two).all()


def test_a_boat_turns_an_eleventh_and_a_quarter_and_thrusts_where_it_heads() -> None:
    env = WaterworldMazeEnv(OPEN, steering="heading", seed=0)
    td = env.make_state(0, (4.5, 4.5), (0.5, 0.5))
    td = env.step(td.set("action", torch.tensor(2)))["next"]  # right, y is down
    angle = math.radians(11.25)
    assert td["heading"].tolist() == pytest.approx([math.cos(angle), math.sin(angle)])
    assert td["velocity"].tolist() == [0.0, 0.0]
    td = env.step(td.set("action", torch.tensor(0)))["next"]
    expected = [THRUST * DT * math.cos(angle), THRUST * DT * math.sin(angle)]
    assert td["velocity"].tolist() == pytest.approx(expected, abs=1e-6)
    for _ in range(32):
        td = env.step(td.set("action", torch.tensor(1)))["next"]
    assert td["heading"].tolist() == pytest.approx([math.cos(angle), math.sin(angle)])


def test_an_apple_pays_its_worth_once_and_only_to_who_touches_it() -> None:
    maze, _, _ = maze_from_text("...")
    env = WaterworldMazeEnv(maze[None], items=MazeItems(apples=1, worth=(0.5,)), goal_reward=2.0)
    assert env._placed.places[0, 0].tolist() in [[0.5, 0.5], [1.5, 0.5], [2.5, 0.5]]
    env._placed.places[0, 0] = [1.5, 0.5]
    td, rewards = env.make_state(0, (0.5, 0.5), (2.5, 0.5)), []
    while not td["done"]:
        td = env.step(td.set("action", RIGHT))["next"]
        rewards.append(td["reward"].item())
    assert [r for r in rewards if r] == [0.5, 2.0]
    assert rewards[-1] == 2.0
    assert not td["items"].any()


def test_a_target_is_shut_until_the_key_is_taken() -> None:
    maze, _, _ = maze_from_text("...")
    env = WaterworldMazeEnv(maze[None], items=MazeItems(key=True), max_steps=60)
    env._placed.places[0, 0] = [2.5, 0.5]
    td, rewards = env.make_state(0, (0.5, 0.5), (1.5, 0.5)), []
    for action in [3] * 40 + [2] * 20:  # through the target to the key, and back
        td = env.step(td.set("action", torch.tensor(action)))["next"]
        rewards.append(td["reward"].item())
        if td["terminated"]:
            break
    assert sum(rewards) == 1.0
    assert len(rewards) > 40
    held = env.make_state(0, (0.5, 0.5), (0.9, 0.5), items=[False])
    assert env.step(held.set("action", RIGHT))["next", "terminated"].item()


def test_items_are_drawn_from_their_seed_on_free_tiles() -> None:
    mazes = maze_pool("test")[:20]
    first, again, other = (
        WaterworldMazeEnv(mazes, items=MazeItems(apples=5, key=True, seed=seed))._placed
        for seed in (1, 1, 2)
    )
    assert np.array_equal(first.places, again.places)
    assert not np.array_equal(first.places, other.places)
    tiles = first.places.astype(int)
    rows = np.arange(20)[:, None]
    assert not mazes.numpy()[rows, tiles[..., 1], tiles[..., 0]].any()
    assert all(len(np.unique(row, axis=0)) == 6 for row in tiles)
    assert set(np.unique(first.worth[:, :-1])) == {np.float32(0.2), np.float32(1.0)}
    assert not first.worth[:, -1].any()


@pytest.mark.parametrize(
    ("build", "words"),
    [
        (lambda: MazeItems(), "an apple or a key"),
        (lambda: WaterworldMazeEnv(items=MazeItems(apples=60)), "room for 48"),
        (lambda: WaterworldMazeEnv(steering="rudder"), "'rudder'"),
        (lambda: WaterworldMazeEnv(drag=0.5), "drag"),
        (lambda: maze_pool("test", 11), "9, 15 and 31"),
        (lambda: DemoConfig(size=11), "size is 9, 15 or 31"),
        (lambda: DemoConfig(task="sail"), "task is one of maze, boat"),
        (lambda: DemoConfig(features="learned", algorithm="hmcts"), "goes with algorithm='diayn'"),
        (lambda: plan_with_features("learned"), "objective=metra"),
    ],
)
def test_what_does_not_exist_is_refused_with_what_does(build, words) -> None:
    with pytest.raises(ValueError, match=words):
        build()


@pytest.mark.parametrize(("size", "walls"), [(15, 96), (31, 440)])
def test_larger_mazes_are_distinct_and_split(size: int, walls: int) -> None:
    train, test = (maze_pool(split, size) for split in ("train", "test"))
    assert (train.shape, test.shape) == ((256, size, size), (342, size, size))
    every = torch.cat((train, test)).flatten(1)
    assert len(every.unique(dim=0)) == 598
    assert (every.sum(-1) == walls).all()


@pytest.mark.parametrize("config", [DemoConfig(task="boat"), DemoConfig(task="key", size=15)])
def test_a_kit_of_a_task_plans_and_acts(config: DemoConfig) -> None:
    config.mazes, config.search_steps = 2, 2_000
    kit = make_kit(config)
    worker = SkillPolicy(make_loss(kit).actor_network, deterministic=True)
    results = solve(kit, worker).results
    assert (results.simulated_steps <= 2_000 + 4 * config.option_steps * 4).all()


@pytest.mark.parametrize(
    "config",
    [
        LabMazeConfig(task="turn", mazes=2, search_frames=800),
        LabMazeConfig(task="apples", mazes=2, search_frames=2_000, max_frames=600),
    ],
)
def test_a_kit_of_a_lab_task_plans_and_acts(config: LabMazeConfig) -> None:
    kit = make_kit(config)
    num_actions = kit.make_env("test").action_spec.n
    assert num_actions == {"turn": 3, "apples": 9}[config.task]
    kit.second_try = lambda: None
    worker = SkillPolicy(make_loss(kit).actor_network, deterministic=True)
    assert solve(kit, worker).results.simulated_steps.max() <= config.search_frames // 4 + 1_600


def test_rewards_of_an_episode_are_not_discounted() -> None:
    kit = make_kit(DemoConfig(task="apples", options="actions", mazes=3))
    kit.env_kwargs["items"] = MazeItems(apples=9, worth=(1.0,))
    rewards = solve(kit, kit.given_worker()).results.rewards
    assert rewards.sum() > 0.0
    assert np.array_equal(rewards, rewards.round())


def test_novelty_of_learned_features_compares_what_the_encoder_says() -> None:
    encoder = TensorDictModule(lambda x: 2.0 * x, ["position"], ["phi"])
    ours, other = RadiusNovelty("phi", 1.0, encoder=encoder), RadiusNovelty("position", 0.5)
    td = TensorDict({"position": torch.rand(50, 2, generator=torch.Generator().manual_seed(0)) * 3})
    td.batch_size = [50]
    answers = []
    for test in (ours, other):
        test.start(1)
        answers.append(test.accept(np.zeros(50, np.int64), test.features(td), np.arange(50)))
    assert answers[0].tolist() == answers[1].tolist()
    assert ours.in_keys == ["position"]
    with pytest.raises(ValueError, match="its encoder writes"):
        RadiusNovelty("position", 1.0, encoder=encoder)


def test_learned_features_have_a_radius_found_from_the_options() -> None:
    config = DemoConfig(objective={"_component_": "torchrl_hmcts.objectives.METRAEncoderLoss"})
    config.features, config.objective_key = "learned", "observation"
    kit = make_kit(config)
    loss = make_loss(kit)
    worker = SkillPolicy(loss.actor_network, deterministic=True)
    kit.prepare(worker)
    novelty = kit.make_planner(kit.make_simulator(worker)).novelty
    assert novelty.encoder is loss.objective.encoder
    assert novelty.in_keys == ["observation"]
    assert novelty.radius == pytest.approx(
        0.75 * kit.reach(kit.make_simulator(worker, "train"), kit.starts("train", 8))
    )


def test_learned_features_are_a_key_of_the_command_line(tmp_path) -> None:
    words = ["objective=metra", "objective_key=observation", "features=learned", "toy=true"]
    assert main(["train", "kit=waterworld", *words, f"out={tmp_path}"]) == 0
    assert main(["evaluate", f"run={tmp_path}", "features=none"]) == 0


def test_the_dissertations_manager_has_four_stages() -> None:
    kit = make_kit(DemoConfig(manager="four_stages"))
    planner = kit.make_planner(kit.make_options(kit.make_env("test"), fixed_worker()))
    assert planner.novelty is None
    assert (planner.settings.expand, planner.settings.backup) == ("one", "mean")
    assert isinstance(planner.evaluate.leaf_evaluator, RolloutEvaluator)
    assert kit.make_round_planner(planner.simulator.given_env, seed=0).novelty is None


def test_a_learned_manager_is_saved_and_plans_in_other_mazes(tmp_path) -> None:
    kit = make_kit(DemoConfig(manager="learned", mazes=4, option_steps=20))
    worker = fixed_worker()
    train = kit.make_simulator(worker, "train")
    network = learn_manager(kit, train, searches=30, iterations=2, updates=30)
    save_manager(tmp_path, network)
    loaded = load_manager(kit, tmp_path, lambda: train)
    td = train.reset(TensorDict(batch_size=[5]))
    assert torch.equal(network(td.clone())["logits"], loaded(td.clone())["logits"])
    kit.manager = kit.manager_for(loaded, "test")
    results = solve(kit, worker).results
    assert results.solved.all()
    assert load_manager(kit, tmp_path / "none", lambda: train) is None


def test_a_manager_stopped_before_or_after_its_first_checkpoint_is_the_same(tmp_path) -> None:
    kit = make_kit(DemoConfig(manager="learned", option_steps=20))
    few = {"searches": 4, "iterations": 2, "updates": 5, "save_dir": tmp_path}

    def weights(resume: bool) -> list[torch.Tensor]:
        simulator = kit.make_simulator(fixed_worker(), "train")
        return list(learn_manager(kit, simulator, resume=resume, **few).parameters())

    first = weights(resume=True)  # there is nothing to continue from
    newest = max(tmp_path.glob("checkpoint-*"))
    for again in (weights(resume=True), newest.unlink() or weights(resume=True)):
        assert all(map(torch.equal, first, again))


def test_an_agent_that_is_loaded_reports_the_rewards_that_a_run_does(tmp_path) -> None:
    words = ["kit=waterworld", "options=actions", "option_steps=20", "toy=true", f"out={tmp_path}"]
    assert main(["train", *words]) == 0
    assert HMCTS.load(tmp_path).solve(seed=0).reward == 1.0


def test_a_manager_that_cannot_learn_says_so() -> None:
    kit = make_kit(LabMazeConfig(manager="learned", mazes=1))
    planner = kit.make_planner(kit.make_options(kit.make_env("test"), fixed_worker()))
    with pytest.raises(ExperimentError, match="no network can learn"):
        kit.manager_network(planner, "train")


@pytest.mark.parametrize("order", ORDERS)
def test_a_queue_finds_the_only_plan_of_a_chain(order: str) -> None:
    env = ChainEnv(length=5)
    planner = MCTSPlanner(env, budget=SearchBudget(expansions=200))
    found = search(planner, env.reset().unsqueeze(0), ORDERS[order])
    assert found["options"] == [1, 1, 1, 1] or order == "random node"
    assert found["found"]


def test_a_queue_takes_all_that_pays_and_keeps_its_budget() -> None:
    maze, _, _ = maze_from_text(".......")
    env = WaterworldMazeEnv(maze[None], items=MazeItems(apples=2), max_steps=400)
    env._placed.places[0] = [[2.5, 0.5], [6.5, 0.5]]
    env._placed.worth[0] = [0.1, 1.0]
    macro = TransformedEnv(env, OptionTransform(fixed_worker(), 4, 20, 1.0))
    start = env.make_state([0], (3.5, 0.5), (0.5, 0.5))
    novelty = RadiusNovelty(["position", "items"], 0.5, scale=[1.0, 10.0])
    budget = SearchBudget(base_steps=4_000, until_plan=False)
    planner = MCTSPlanner(macro, novelty=novelty, budget=budget)
    results = plan_by_queue(planner, macro, start, "breadth first", seed=0)
    assert results.rewards.tolist() == pytest.approx([2.1])  # both apples, then the target
    assert results.simulated_steps[0] <= 4_000 + 4 * 20

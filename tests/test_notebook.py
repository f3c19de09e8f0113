"""In a notebook: Tab finds names, objects show themselves, slips are answered by what to write."""

from __future__ import annotations

import importlib
import subprocess
import sys

import pytest
import torch
from gymnasium.envs.classic_control import CartPoleEnv
from tensordict.nn import TensorDictModule
from torchrl.envs import StepCounter, TransformedEnv

import torchrl_hmcts
from torchrl_hmcts.envs import (
    LabMazeEnv,
    OptionPool,
    RepeatActions,
    SettableGymEnv,
    WaterworldMazeEnv,
)
from torchrl_hmcts.planners import (
    PUCT,
    UCT,
    BestPlan,
    MCTSPlanner,
    RadiusNovelty,
    SearchBudget,
    ValueEvaluator,
)
from torchrl_hmcts.testing import ChainEnv
from torchrl_hmcts.trainers import HMCTS, DIAYNTrainer, make_training_env
from torchrl_hmcts.transforms import OptionTransform

PACKAGES = ("envs", "modules", "objectives", "planners", "testing", "trainers", "transforms")
PICTURE = '<img src="data:image/png;base64,'


def maze_planner() -> tuple[TransformedEnv, MCTSPlanner]:
    worker = TensorDictModule(lambda skill: skill, ["skill"], ["action"])
    env = TransformedEnv(WaterworldMazeEnv(seed=0), OptionTransform(worker, 4, 20))
    return env, MCTSPlanner(env, novelty=RadiusNovelty("position", 0.6), seed=0)


@pytest.mark.parametrize("name", PACKAGES)
def test_tab_lists_every_public_name(name: str) -> None:
    assert name in dir(torchrl_hmcts)
    package = importlib.import_module(f"torchrl_hmcts.{name}")
    assert set(package.__all__) <= set(dir(package))


def test_shortcuts_are_the_names_of_the_packages_and_cost_no_torch() -> None:
    assert torchrl_hmcts.MCTSPlanner is MCTSPlanner
    assert torchrl_hmcts.HMCTS is HMCTS
    assert torchrl_hmcts.planners.UCT is UCT
    code = "import sys, torchrl_hmcts; dir(torchrl_hmcts); assert 'torch' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True)


def test_plans_searches_and_planners_show_a_short_text_and_a_picture() -> None:
    env, planner = maze_planner()
    plan = planner.plan(env.reset(seed=1))
    assert repr(plan).startswith("Plan(options=[")
    assert repr(planner.last_search.tree).startswith("SearchTree(")
    for shown in (plan, planner.last_search, planner.last_search.tree, planner, env.base_env):
        assert len(repr(shown)) < 200
        assert PICTURE in shown._repr_html_()
    assert repr(SearchBudget(seconds=2.0)) == "SearchBudget(seconds=2.0)"


def test_agents_pools_and_trainers_show_what_they_are() -> None:
    agent = HMCTS("MountainCar-v0", option_steps=14)
    assert agent._repr_html_() == f"<pre>{agent!r}</pre>"
    agent.planner.plan(agent.start(0))
    assert PICTURE in agent._repr_html_()
    pool = OptionPool("MountainCar-v0", RepeatActions(3), max_steps=3, num_processes=0)
    assert (
        repr(pool)
        == "OptionPool(MountainCar-v0, RepeatActions([0, 1, 2]), snapshot=ClassicSnapshot)"
    )
    env = make_training_env(copies=4)
    trainer = DIAYNTrainer(
        env, DIAYNTrainer.make_loss(env), total_frames=64, frames_per_batch=32, batch_size=8
    )
    assert repr(trainer) == "DIAYNTrainer(DIAYNLoss, 0 of 64 base steps)"
    assert PICTURE not in trainer._repr_html_()
    trainer.train()
    assert PICTURE in trainer._repr_html_()


def test_a_gymnasium_env_shows_its_state_also_below_transforms() -> None:
    pytest.importorskip("pygame")
    env = SettableGymEnv("CartPole-v1", seed=0)
    start = env._repr_html_()
    assert start == env._repr_html_()  # no step was taken
    assert start.startswith("<pre>SettableGymEnv(CartPole-v1, ")
    for _ in range(4):
        env.step(env.full_action_spec.zero())
    assert PICTURE in env._repr_html_() != start
    assert TransformedEnv(env, StepCounter())._repr_html_() == env._repr_html_()
    nameless = SettableGymEnv(CartPoleEnv, seed=0)  # without an id no copy can be made that draws
    assert nameless._repr_html_() == f"<pre>{nameless!r}</pre>"


@pytest.mark.parametrize("env", [WaterworldMazeEnv(seed=0), LabMazeEnv(maze_seeds=[1], seed=0)])
def test_positions_are_drawn_on_the_map_the_right_way_up(env) -> None:
    planner = MCTSPlanner(env, budget=SearchBudget(expansions=3), seed=0)
    axes = planner.search(env.reset()).tree.plot_positions()
    assert len(axes.images) == 1  # the walls
    south_is_up = axes.get_ylim()[0] < axes.get_ylim()[1]
    assert south_is_up == isinstance(env, LabMazeEnv)  # there y points north, in Waterworld down


@pytest.mark.parametrize(
    ("keywords", "message"),
    [
        ({"tree_policy": UCT}, r"Write tree_policy=UCT\(\)"),
        ({"tree_policy": PUCT}, r"Write tree_policy=PUCT\(\)"),
        ({"novelty": RadiusNovelty}, r"Write novelty=RadiusNovelty\(key, radius\)"),
        ({"novelty": "radius"}, r'Write novelty=RadiusNovelty\("position", radius\)'),
        ({"budget": SearchBudget}, r"Write budget=SearchBudget\(\)"),
        ({"final_choice": BestPlan}, r"Write final_choice=BestPlan\(\)"),
        ({"leaf_evaluator": ValueEvaluator}, r"Write leaf_evaluator=ValueEvaluator\(module\)"),
        ({"leaf_evaluator": torch.nn.Linear(1, 1)}, r"Write leaf_evaluator=ValueEvaluator\(Tensor"),
        ({"option_prior": torch.nn.Linear(1, 2)}, r"Write option_prior=ModulePrior\(TensorDict"),
        ({"num_simulations": 50}, r"Write budget=SearchBudget\(simulations=...\)"),
        ({"seconds": 1.0}, r"Write budget=SearchBudget\(seconds=...\)"),
        ({"c_puct": 1.0}, r"Write tree_policy="),
    ],
)
def test_a_slip_is_answered_by_what_to_write(keywords, message: str) -> None:
    with pytest.raises(TypeError, match=message):
        MCTSPlanner(ChainEnv(length=4), **keywords)


def test_an_env_is_no_state_and_there_is_no_search_before_the_first() -> None:
    env = ChainEnv(length=4)
    planner = MCTSPlanner(env)
    with pytest.raises(RuntimeError, match=r"Write planner.plan\(env.reset\(\)\) first"):
        _ = planner.last_search
    assert not planner.has_searched
    with pytest.raises(TypeError, match=r"Write planner.plan\(env.reset\(\)\)"):
        planner.plan(env)
    planner.plan(env.reset())
    assert planner.has_searched
    with pytest.raises(TypeError, match=r"got 'CartPole-v1'. Make one .* SettableGymEnv\(env\)"):
        MCTSPlanner("CartPole-v1")
    with pytest.raises(TypeError, match="needs an object for worker; got the class TensorDictModu"):
        OptionTransform(TensorDictModule, 2, 3)

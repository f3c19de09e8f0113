"""Figures of skills and of planners, by hand on small examples."""

from __future__ import annotations

import imageio.v3 as iio
import numpy as np
import pytest
import skill_figures as skills
import torch
from tensordict.nn import TensorDictModule

from torchrl_hmcts.envs import maze_from_text
from torchrl_hmcts.planners import MCTSPlanner, SearchBudget
from torchrl_hmcts.testing import ChainEnv
from torchrl_hmcts.trainers.evaluation import Results, plan_and_execute, spread
from torchrl_hmcts.trainers.experiments.kits.waterworld import make_option_env
from torchrl_hmcts.trainers.figures.curves import Panel, common_steps, plot_training

PUSH = TensorDictModule(lambda skill: skill, ["skill"], ["action"])  # skill z: thrust z


class Compass(torch.nn.Module):
    """Tells up, down, left, right by the largest component of the displacement."""

    def forward(self, displacement: torch.Tensor) -> torch.Tensor:
        x, y = displacement.unbind(-1)
        return torch.stack((-y, y, -x, x), -1)


COMPASS = TensorDictModule(Compass(), ["displacement"], ["skill_logits"])


def test_thrust_in_four_directions_is_told_apart_without_error_and_at_right_angles() -> None:
    room, _, _ = maze_from_text(".........\n" * 9)
    figures = skills.skill_figures(PUSH, COMPASS, room.expand(30, 9, 9), steps=(10, 20))
    assert list(figures) == [10, 20]
    assert figures[20]["accuracy"] == 1.0
    # Thrust changes the velocity first: after one step nobody has moved, one guess in four hits.
    assert figures[20]["accuracy_until"] == pytest.approx((19 + 0.25) / 20)
    assert figures[20]["angle"] == pytest.approx(90.0, abs=0.5)
    up, down, left, right = figures[20]["displacement"]
    assert up[1] < -0.3 < 0.3 < down[1]
    assert left[0] < -0.3 < 0.3 < right[0]


def test_skills_that_do_the_same_are_guessed_at_chance_and_have_no_angle_between_them() -> None:
    room, _, _ = maze_from_text(".........\n" * 9)
    same = TensorDictModule(lambda skill: torch.full_like(skill, 3), ["skill"], ["action"])
    figures = skills.skill_figures(same, COMPASS, room.expand(30, 9, 9), steps=(20,))[20]
    assert figures["accuracy"] == 0.25
    assert figures["angle"] == pytest.approx(0.0, abs=1.0)


def test_the_smallest_angle_is_that_of_the_closest_pair() -> None:
    angles = torch.deg2rad(torch.tensor([0.0, 100.0, 170.0, 330.0]))
    vectors = torch.stack((angles.cos(), angles.sin()), -1) * torch.tensor([[1.0], [5], [0.1], [2]])
    assert skills.smallest_angle(vectors) == pytest.approx(30.0, abs=1e-4)


def test_coverage_counts_the_tiles_in_front_of_the_target_only() -> None:
    # A corridor: the player in the third tile, the target in the fifth; two tiles lie behind it.
    maze, _, _ = maze_from_text(".......\n#######")
    env = make_option_env(PUSH, maze[None], option_steps=12)
    start = env.base_env.make_state(0, position=(2.5, 0.5), target=(4.5, 0.5))[None]
    budget = SearchBudget(expansions=40, until_plan=False)
    search = MCTSPlanner(env, budget=budget).search(start)
    position = search.tree.states["position"][0, : int(search.tree.num_nodes[0])]
    reached = {int(x) for x in position[:, 0]}
    share = skills.search_coverage(search, env.base_env)
    assert share.tolist() == pytest.approx([len(reached) / 5])
    assert reached <= {0, 1, 2, 3, 4}


def test_a_plan_is_carried_out_to_its_end_and_its_steps_are_counted() -> None:
    env = ChainEnv(length=4)
    starts = env.reset().expand(3).clone()
    results = plan_and_execute(MCTSPlanner(env), ChainEnv(length=4), starts, group=2)
    distance = 3  # states 0 to 3, the reward is at the end
    assert results.solved.tolist() == [True] * 3
    assert results.plan_options.tolist() == results.episode_steps.tolist() == [distance] * 3
    assert (results.simulated_steps >= distance).all()


def test_a_plan_that_fails_in_the_real_env_is_not_solved() -> None:
    env, longer = ChainEnv(length=4), ChainEnv(length=6)  # the end is farther than the model says
    results = plan_and_execute(MCTSPlanner(env), longer, env.reset()[None])
    assert (results.found.tolist(), results.solved.tolist()) == ([True], [False])
    assert results.summary()["solved"] == 0
    assert np.isnan(results.summary()["episode_steps"]["median"])


def test_a_start_without_a_plan_costs_its_search_and_no_step() -> None:
    env = ChainEnv(length=30)
    planner = MCTSPlanner(env, budget=SearchBudget(expansions=3))
    results = plan_and_execute(planner, ChainEnv(length=30), env.reset()[None])
    assert (results.found.tolist(), results.episode_steps.tolist()) == ([False], [0])
    assert results.expansions.tolist() == [3]


def test_results_are_joined_in_order_and_summed_up_by_hand() -> None:
    def part(*solved: bool) -> Results:
        ones = np.ones(len(solved), dtype=np.int64)
        return Results(ones > 0, np.array(solved), *[ones * 10 * len(solved)] * 5)

    joined = Results.concatenate([part(True), part(False, True)])
    assert joined.solved.tolist() == [True, False, True]
    summary = joined.summary()
    assert (summary["starts"], summary["found"], summary["solved"]) == (3, 3, 2)
    assert summary["simulated_steps"] == {"mean": 16.6667, "median": 20.0, "p95": 20.0}
    assert summary["episode_steps"]["mean"] == 15.0  # of the two solved ones


def test_spread_of_nothing_is_not_a_number() -> None:
    assert all(np.isnan(value) for value in spread([]).values())


def test_figures_need_no_gradient() -> None:
    net = TensorDictModule(torch.nn.Linear(2, 4), ["displacement"], ["skill_logits"])
    room, _, _ = maze_from_text("...\n...\n...")
    figures = skills.skill_figures(PUSH, net, room[None], steps=(3,))
    assert isinstance(figures[3]["accuracy"], float)


def test_curves_of_seeds_are_brought_to_the_steps_that_all_of_them_reached() -> None:
    short = ([0, 5, 10], [0.0, 0.5, 1.0])
    long = ([0, 5, 10, 20], [0.0, 0.0, 0.5, 1.0])
    steps, values = common_steps([long, short])
    assert steps.tolist() == [0.0, 5.0, 10.0]
    assert values.tolist() == [[0.0, 0.0, 0.5], [0.0, 0.5, 1.0]]
    with pytest.raises(ValueError, match="got none"):
        common_steps([])


def test_solving_curves_are_drawn(tmp_path) -> None:
    curve = {
        "training_steps": [0, 10],
        "base_steps": [900.0, 100.0],
        "executed_steps": [90.0, 50.0],
        "solved": [0.5, 1.0],
    }
    steps = Panel("base_steps", "to solve", log=True, dotted=("executed_steps", "executed only"))
    panels = [steps, Panel("solved", "solved", share=True, level=(0.9, "wanted"))]
    plot_training({"from scratch": [curve, curve]}, panels, tmp_path / "a.png", title="two seeds")
    picture = iio.imread(tmp_path / "a.png")
    assert picture.shape[:2] == (506, 1210)
    violet = (np.abs(picture[..., :3].astype(int) - (127, 16, 253)) < 12).all(-1)
    assert violet.sum() > 500  # the curve is there

"""The lab maze experiment at toy size, its script, its envs, its first-person view."""

from __future__ import annotations

import csv
import dataclasses
import json
import math
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from tensordict.nn import TensorDictModule
from torch import Tensor

from torchrl_hmcts.envs import LabMazeEnv, draw_first_person, lab_maze
from torchrl_hmcts.trainers.evaluation import Results
from torchrl_hmcts.trainers.experiments import curve_tests
from torchrl_hmcts.trainers.experiments.kits import make_kit
from torchrl_hmcts.trainers.experiments.kits.lab import (
    TRAINING_MAZES,
    LabMazeKit,
    held_out_seeds,
    make_lab_env,
    make_starts,
    wrong_models,
)
from torchrl_hmcts.trainers.experiments.kits.lab_script import ShortestPathScript
from torchrl_hmcts.trainers.experiments.settings import LabMazeConfig
from torchrl_hmcts.trainers.experiments.skills import (
    evaluate_skills,
    learn,
    run_skills,
    solve,
    with_second_search,
)
from torchrl_hmcts.trainers.skills.rounds import RoundRecords, frames_curve
from torchrl_hmcts.transforms import OptionTransform

ROOM = ["*" * 9, "*P      *", *["*       *"] * 6, "*" * 9]
CORRIDOR = ["*******", "*P   G*", "*******"]


def push(skill: torch.Tensor, heading: torch.Tensor) -> torch.Tensor:
    """The key that pushes most to the east, north, west or south."""
    cosine, sine = heading.unbind(-1)
    forward, left = torch.stack((cosine, sine), -1), torch.stack((-sine, cosine), -1)
    keys = torch.stack((forward, -forward, left, -left), -2)  # in the order of LAB_ACTIONS
    wanted = torch.tensor([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]])[skill]
    return (keys * wanted.unsqueeze(-2)).sum(-1).argmax(-1)


WORKER = TensorDictModule(push, ["skill", "heading"], ["action"])


@pytest.fixture(scope="module")
def toy(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    out = tmp_path_factory.mktemp("labmaze")
    return out, run_skills(LabMazeConfig(seed=1, out=str(out), toy=True))


class TestRun:
    def test_everything_is_written(self, toy: tuple[Path, dict[str, Any]]) -> None:
        out, metrics = toy
        page = (out / "index.html").read_text()
        for name in ("mazes", "skills", "losses", "solving", "search", "view"):
            assert (out / f"{name}.png").stat().st_size > 1000, name
            assert f'src="{name}.png"' in page
        assert (out / "episode.gif").stat().st_size > 1000
        written = json.loads((out / "metrics.json").read_text())
        assert written == json.loads(json.dumps(metrics), parse_constant=lambda _: None)
        assert any((out / "checkpoints").iterdir())
        (worker,) = (out / "worker").iterdir()
        frames = metrics["worker_training_frames"]
        assert worker.name == f"worker-{frames // 4:012d}.torchrl"
        assert f"The worker of all pictures is that after {frames:,} frames." in page
        shown = "NOT solved" in page
        assert shown == (metrics["test"]["solved"] == 0)

    def test_an_evaluation_tests_the_worker_of_the_page(
        self, toy: tuple[Path, dict[str, Any]]
    ) -> None:
        out, metrics = toy
        again = evaluate_skills(LabMazeConfig(seed=1, out=str(out), toy=True))
        assert again["checkpoint"].startswith("worker-")
        for name in ("mazes", "solved", "unsolved", "expansions"):
            assert again["test"][name] == metrics["test"][name], name

    def test_the_curves_are_those_of_the_dissertations_figures(
        self, toy: tuple[Path, dict[str, Any]]
    ) -> None:
        out, metrics = toy
        rows = list(csv.DictReader((out / "curves.csv").read_text().splitlines()))
        names = {row["name"] for row in rows}
        losses = {"loss_actor", "qvalue_loss_0", "qvalue_loss_1", "loss_discriminator"}
        assert names == losses | {"frames", "solved", "solved_frames"}
        assert max(int(r["training_frames"]) for r in rows) == metrics["training_frames"]

    def test_a_finished_run_that_is_resumed_learns_no_further(
        self, toy: tuple[Path, dict[str, Any]]
    ) -> None:
        out, metrics = toy
        kit = make_kit(LabMazeConfig(**metrics["config"]))
        again = learn(kit, save_dir=out / "checkpoints", resume=True)
        assert again.steps == metrics["training_base_steps"]
        assert again.rounds == metrics["training_rounds"]


def test_diayn_alone_learns_within_its_frames_and_is_tried_before_and_after() -> None:
    config = LabMazeConfig(
        algorithm="diayn", train_frames=600, expansions=2, curve_mazes=2, curve_points=1
    )
    assert config.train_steps == 128  # two batches of 64 steps of 4 frames
    trained = learn(make_kit(config))
    assert trained.steps == 128
    assert frames_curve(trained.tests, 4, 10_800)["training_steps"] == [0.0, 512.0]


@pytest.mark.parametrize(
    ("solved", "kept"),
    [([1, 2, 1], 1), ([2, 2, 2], 2), ([0, 0, 0], 2), ([2, 1, 0], 1), ([2, 0, 0], 2)],
)
def test_the_worker_that_solved_the_most_mazes_is_kept_of_several_the_latest(
    solved: list[int], kept: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Before the training, after one batch of 64 steps and after two.
    seen: list[Tensor] = []

    def scripted(planner: Any, env: Any, starts: Any) -> Results:
        parts = getattr(env.transform, "transforms", [env.transform])
        (option,) = [x for x in parts if isinstance(x, OptionTransform)]
        actor = next(option.worker.parameters())
        yes = np.arange(2) < solved[len(seen)]
        seen.append(actor.detach().clone())
        two = np.full(2, 7)
        return Results(yes, yes, two, two, two, two, two)

    monkeypatch.setattr(curve_tests, "plan_and_execute", scripted)
    config = LabMazeConfig(
        algorithm="diayn", train_frames=600, curve_mazes=2, curve_points=2, keep="best"
    )
    trained = learn(make_kit(config))
    policy = trained.worker
    assert trained.worker_step == 64 * kept  # never 0: what has not learned shows no skills
    assert len(seen) == 3
    assert not torch.equal(seen[0], seen[1])
    assert not torch.equal(seen[1], seen[2])
    assert [torch.equal(next(policy.parameters()), actor) for actor in seen].index(True) == kept
    seen.clear()
    last = learn(make_kit(dataclasses.replace(config, keep="last"))).worker
    assert torch.equal(next(last.parameters()), seen[2])


def test_algorithm_3_learns_within_its_frames_and_logs_the_same_losses() -> None:
    config = LabMazeConfig(
        algorithm="hmcts",
        train_frames=2_400,
        init_options=4,
        retrain_interval=2,
        round_expansions=1,
        expansions=2,
        curve_mazes=2,
        curve_points=1,
    )
    assert config.train_steps == 600 - 2 * 1 * 5 * 25  # two rounds may still be under way
    trained = learn(make_kit(config))
    assert config.train_steps <= trained.steps <= 600
    assert trained.rounds > 2
    losses = ("loss_actor", "qvalue_loss_0", "qvalue_loss_1", "loss_discriminator")
    assert {len(trained.history[name]) for name in losses} == {1 + trained.rounds // 2}
    assert len(frames_curve(trained.tests, 4, 10_800)["frames"]) >= 2


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({"algorithm": "sac"}, "algorithm is one of"),
        ({"size": 10}, "size must be odd and at least 5 cells; got 10"),
        ({"option_frames": 90}, "option_frames=90 is not a multiple of frames_per_step=4"),
        ({"train_frames": 255}, "train_frames=255 are too few"),
        ({"algorithm": "hmcts", "train_frames": 9_000}, "train_frames=9000 are too few"),
        ({"keep": "first"}, "keep is one of best, last; got 'first'"),
        ({"mazes": 0}, "mazes must be at least 1; got 0"),
        ({"stall_steps": -1}, "stall_steps must be at least 0; got -1"),
    ],
)
def test_a_bad_value_is_refused_by_name(keys: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=re.escape(message)):
        LabMazeConfig(**keys)


class TestMazes:
    @pytest.mark.parametrize("size", [5, 9])
    def test_no_held_out_maze_is_a_training_maze_or_comes_twice(self, size: int) -> None:
        """5 x 5 mazes are so few that most seeds have to be skipped."""
        seeds = held_out_seeds(3 if size == 5 else 40, size)
        mazes = {lab_maze(seed, size, size) for seed in seeds}
        assert len(mazes) == len(seeds)
        assert not mazes & {lab_maze(seed, size, size) for seed in range(TRAINING_MAZES)}

    def test_starts_are_spawn_points_at_rest_one_a_maze(self) -> None:
        env = make_lab_env(range(10))
        starts = make_starts(env, seed=3)
        for maze, place in enumerate(starts["position"].numpy()):
            spawn = env.layout.spawn[maze, : env.layout.num_spawns[maze]]
            assert (spawn == place).all(-1).any()
        assert not starts["velocity"].any()
        assert starts["position"].equal(make_starts(env, seed=3)["position"])


class TestOptions:
    def test_a_player_at_a_wall_ends_its_option_and_one_on_the_way_does_not(self) -> None:
        """Walls are met at 116.1; 25 steps of 4 frames to the east or north end before a wall."""
        kit = LabMazeKit(LabMazeConfig())
        env = kit.make_options(make_lab_env(mazes=[ROOM]), WORKER)
        state = env.base_env.make_state(0, (117.0, 117.0), 90.0)  # the south-west corner
        durations = [
            env.step(state.clone().set("option", torch.tensor(skill)))["next", "duration"].item()
            for skill in range(4)
        ]
        assert durations == [25, 25, 2, 2]  # east, north, west, south

    def test_without_stall_steps_every_option_lasts(self) -> None:
        kit = LabMazeKit(LabMazeConfig(stall_steps=0))
        env = kit.make_options(make_lab_env(mazes=[ROOM]), WORKER)
        state = env.base_env.make_state(0, (117.0, 117.0), 90.0)
        after = env.step(state.set("option", torch.tensor(2)))["next"]
        assert after["duration"].item() == 25


class TestScript:
    def test_a_corridor_takes_as_long_as_it_is_by_hand(self) -> None:
        """From 150 to 506 (the goal is touched 44 west of 550) in frames of 16 ms.

        The start takes 10 frames for 0.016 * (45 + 89 + ... + 320) = 30.0 units; 320 units a second
        are 5.12 a frame for the other 326, 64 frames, less the frame that is under way.
        """
        env = LabMazeEnv([CORRIDOR])
        start = env.make_state([0], (150.0, 150.0), 0.0)
        frames = ShortestPathScript(env).frames(start).item()
        assert abs(frames - 74) <= 1

    def test_it_reaches_the_goal_of_every_maze_at_a_steady_pace(self) -> None:
        env = make_lab_env(held_out_seeds(40))
        starts, script = make_starts(env, 0), ShortestPathScript(env)
        per_cell = script.frames(starts) / script.path_lengths(starts)
        assert 14.0 < per_cell.min()
        assert per_cell.max() < 24.0

    def test_a_maze_without_a_goal_is_refused(self) -> None:
        with pytest.raises(ValueError, match="maze 0 has none"):
            ShortestPathScript(LabMazeEnv([["****", "*P *", "****"]]))


def solved(config: LabMazeConfig, worker: Any) -> dict[str, Any]:
    kit = LabMazeKit(config)
    return kit.figures(solve(kit, worker), timed=1)


class TestEvaluation:
    config = LabMazeConfig(
        mazes=4, expansions=200, improve_expansions=10, max_frames=1_500, stall_steps=0
    )

    def test_a_worker_of_the_four_directions_solves_all_at_the_first_trial(self) -> None:
        figures = solved(self.config, WORKER)
        assert (figures["mazes"], figures["solved"], figures["unsolved"]) == (4, 4, [])
        assert 1.0 < figures["frames_over_script"] < 3.0
        assert figures["frames_over_script"] == pytest.approx(
            figures["frames"]["mean"] / figures["script_frames"]["mean"], abs=1e-3
        )

    def test_a_worker_that_stands_still_solves_none_in_two_searches(self) -> None:
        config = dataclasses.replace(self.config, mazes=2, expansions=3, stall_steps=2)
        still = TensorDictModule(lambda skill: skill * 0 + 8, ["skill"], ["action"])
        figures = solved(config, still)
        assert (figures["found"], figures["solved"], figures["unsolved"]) == (0, 0, [0, 1])
        assert figures["second_searches"] == 2
        assert math.isnan(figures["frames_over_script"])

    def test_a_second_search_adds_its_cost_and_replaces_the_result(self) -> None:
        def results(found: list[bool], cost: int) -> Results:
            numbers = [np.full(len(found), cost) for _ in range(5)]
            return Results(np.array(found), np.array(found), *numbers)

        first, second = results([True, False, True], 10), results([True], 7)
        both = with_second_search(first, np.array([1]), second)
        assert both.solved.tolist() == [True, True, True]
        assert both.simulated_steps.tolist() == both.expansions.tolist() == [10, 17, 10]
        assert both.episode_steps.tolist() == both.plan_options.tolist() == [10, 7, 10]

    def test_planning_again_solves_what_one_plan_of_a_wrong_model_does_not(self) -> None:
        real = wrong_models(0.05)["faster clock, less friction"]
        figures = LabMazeKit(self.config).solve_with_wrong_model(WORKER, mazes=4, **real)
        assert figures["solved"] == 4
        assert figures["solved_by_the_first_plan"] < 4
        assert figures["num_plans"]["mean"] > 2

    def test_the_wrong_models_have_both_signs(self) -> None:
        signs = {
            (x["fps"] > 60, x["friction"] > 6.0)
            for x in wrong_models(0.05).values()
            if abs(x["friction"] / 6.0 - 1.0) == pytest.approx(0.05)
        }
        assert len(signs) == 4
        assert {LabMazeEnv([CORRIDOR], fps=fps).frame_msec for fps in (57, 60, 63)} == {15, 16, 17}


def test_an_episode_that_is_not_solved_counts_with_its_whole_length() -> None:
    columns = {name: np.array([0, 0, 0]) for name in RoundRecords().columns}
    columns["training_steps"] = np.array([0, 100, 100])
    columns["solved"] = np.array([0, 1, 0])
    columns["executed_steps"] = np.array([0, 30, 70])
    curve = frames_curve(RoundRecords(columns), 4, 1_000)
    assert curve["training_steps"] == [0.0, 400.0]
    assert curve["frames"] == [1_000.0, 560.0]
    assert curve["solved"] == [0.0, 0.5]
    assert math.isnan(curve["solved_frames"][0])
    assert curve["solved_frames"][1] == 120.0


class TestFirstPersonView:
    env = LabMazeEnv([CORRIDOR])

    def look(self, x: float, heading: float, **options: Any) -> np.ndarray:
        return draw_first_person(self.env, self.env.make_state(0, (x, 150.0), heading), **options)

    def green(self, picture: np.ndarray) -> np.ndarray:
        red, green, blue = picture.astype(int).transpose(2, 0, 1)
        return (green > 1.8 * red) & (green > 1.2 * blue)

    def test_the_goal_is_ahead_larger_when_near_and_not_behind(self) -> None:
        far, near = self.green(self.look(150.0, 0.0)), self.green(self.look(350.0, 0.0))
        assert far.any()
        assert near.sum() > 2 * far.sum()
        assert not self.green(self.look(350.0, 180.0)).any()

    def test_what_is_to_the_left_is_drawn_on_the_left(self) -> None:
        columns = np.flatnonzero(
            self.green(self.look(350.0, -30.0)).any(0)
        )  # it looks to the right
        assert columns.size
        assert columns.mean() < 160

    def test_a_wall_half_a_cell_ahead_fills_the_height_as_geometry_says(self) -> None:
        """At distance d, with 90 degrees over w pixels, a wall of one cell has w / 2d pixels."""
        picture = self.look(150.0, 180.0, width=64, height=240).astype(int)
        # 32 / 0.5 = 64 pixels of wall in the middle column; floor and ceiling are bluish there.
        column = picture[:, 32]
        wall = column[:, 0] > column[:, 2] * 1.2
        assert abs(int(wall.sum()) - 64) <= 2

    def test_walls_hide_what_is_behind_them(self) -> None:
        env = LabMazeEnv([["*******", "*P * G*", "* *** *", "*     *", "*******"]])
        picture = draw_first_person(env, env.make_state(0, (150.0, 350.0), 0.0))
        assert not self.green(picture).any()

    def test_bad_arguments_are_refused(self) -> None:
        with pytest.raises(ValueError, match="draws one state, got a batch"):
            draw_first_person(self.env, self.env.make_state([0, 0], (150.0, 150.0)))
        with pytest.raises(ValueError, match="field of view from 10 to 150"):
            self.look(150.0, 0.0, field_of_view=179.0)

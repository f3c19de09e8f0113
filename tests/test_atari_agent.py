"""The hierarchical agent on Atari: options, how they are found, playing, stopping and going on."""

from __future__ import annotations

import csv
import dataclasses
import json

import numpy as np
import pytest
import torch
from tensordict import TensorDict

pytest.importorskip("ale_py")

from torchrl.checkpoint import CheckpointError  # noqa: E402

from torchrl_hmcts.envs import (  # noqa: E402
    AtariOptionPool,
    ByteGoal,
    FollowGoals,
    JoinedWorkers,
    RepeatActions,
)
from torchrl_hmcts.trainers import (  # noqa: E402
    AtariAgent,
    AtariSearch,
    GoalFinder,
    GoalSearch,
)
from torchrl_hmcts.trainers.experiments.atari.config import AtariConfig  # noqa: E402
from torchrl_hmcts.trainers.experiments.atari.run import (  # noqa: E402
    AtariRun,
    draw,
    evaluate_atari,
    load_run,
    run_atari,
)
from torchrl_hmcts.trainers.experiments.atari.trials import RememberedTrials, Trial  # noqa: E402
from torchrl_hmcts.trainers.figures.atari_figures import write_atari_gif  # noqa: E402
from torchrl_hmcts.trainers.figures.pictures import Pictures  # noqa: E402
from torchrl_hmcts.trainers.saving.checkpoints import DurableRotation, plain_checkpoint  # noqa: E402

TRACKERS = FollowGoals([ByteGoal(72, 99, offset, 2, 3) for offset in (-12, 0, 12)], fire=1)

TRACKERS_WITHOUT_FIRE = FollowGoals(TRACKERS.goals)


def make_pool(worker, max_steps, **kwargs) -> AtariOptionPool:
    kwargs = {"num_processes": 0, "seed": 0, **kwargs}
    return AtariOptionPool("Breakout", worker, max_steps=max_steps, **kwargs)


# ------------------------------------------------------------------------------------ goals


@pytest.mark.parametrize(
    ("controlled", "action"), [(100, 2), (104, 2), (105, 0), (111, 0), (112, 3), (200, 3)]
)
def test_a_goal_brings_its_byte_to_the_target_plus_the_offset(controlled, action) -> None:
    ram = np.zeros(128, np.uint8)
    ram[72], ram[99] = controlled, 120
    assert ByteGoal(72, 99, -12, raising=2, lowering=3, dead_zone=3).action(ram) == action


def test_fire_is_taken_now_and_then_whatever_the_goal() -> None:
    ram, generator = np.zeros(128, np.uint8), np.random.default_rng(0)
    worker = FollowGoals([ByteGoal(72, 99, 0, 2, 3)], fire=1, fire_probability=0.25)
    taken = [worker.act(ram, 0, generator) for _ in range(4000)]
    assert set(taken) == {0, 1}
    assert np.mean(taken) == pytest.approx(0.25, abs=0.02)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (([],), "a goal for each option; got none"),
        (([ByteGoal(128, 0, 0, 1, 2)],), "bytes 0 to 127; got .*controlled=128"),
        (([ByteGoal(0, 1, 0, 1, 2)], 1, 1.5), "from 0 to 1; got 1.5"),
    ],
)
def test_goals_that_are_none_are_refused(arguments, message) -> None:
    goals, *rest = arguments
    with pytest.raises(ValueError, match=message):
        FollowGoals(goals, **dict(zip(("fire", "fire_probability"), rest, strict=False)))


def test_joined_workers_number_their_options_one_after_the_other() -> None:
    class Ends(RepeatActions):
        def ends(self, ram, option, steps):
            return steps >= 2

    joined = JoinedWorkers([RepeatActions([4, 5]), Ends([6])])
    assert [joined.act(None, z, None) for z in range(3)] == [4, 5, 6]
    assert [joined.ends(None, z, 2) for z in range(3)] == [False, False, True]
    with pytest.raises(ValueError, match="at least one worker; got none"):
        JoinedWorkers([])


def test_the_goals_of_breakout_are_found_without_being_told() -> None:
    settings = GoalSearch(probe_states=150, screen_steps=300)
    finder = GoalFinder(make_pool, settings, seed=0)
    candidates, states = finder.probe()
    assert finder.report["controllable"] == [72]  # the paddle
    assert 99 in finder.report["moving"]  # the ball
    ranked = finder._screen(candidates, states[:1])
    best = ranked[0].worker.goals[0]
    assert (best.controlled, best.target) == (72, 99)
    # An action alone scores nothing in these steps, and is still a candidate.
    assert finder.report["screened"][ranked[0].name] > 0.0
    assert {"NOOP", "FIRE", "RIGHT", "LEFT"} <= set(finder.report["screened"])
    assert finder.num_frames > 150 * 4 * 3 * 4


# ------------------------------------------------------------------------------------ playing


def agent(**kwargs) -> AtariAgent:
    pool = make_pool(TRACKERS, 5)
    return AtariAgent(pool, AtariSearch(ratio=4.0), seed=1, **kwargs)


def test_what_was_planned_happens_and_the_subtree_is_kept() -> None:
    player = agent()
    kept = []
    advance = player.planner.advance
    player.planner.advance = lambda *a, **k: kept.append(bool(advance(*a, **k).all()))
    player.begin()
    assert player.play(12).decisions == 12
    assert kept == [True] * 12


def test_play_goes_on_bit_for_bit_from_where_the_tree_is_planted_anew() -> None:
    whole = agent(replant_every=4)
    whole.begin()
    whole.play(10)
    first = agent(replant_every=4)
    first.begin()
    first.play(8)
    second = agent(replant_every=4)
    second.load_state_dict(first.state_dict())
    second.play(2)
    assert second.progress == whole.progress
    torch.testing.assert_close(
        second.state["emulator_state"], whole.state["emulator_state"], rtol=0, atol=0
    )


def test_a_lost_life_costs_planning_but_not_the_score() -> None:
    player = agent()
    player.greatest_reward = 4.0
    player.begin()
    player.play(1)
    assert player.pool.life_loss_penalty == 4.0
    assert player.progress.score >= 0.0


def test_with_sticky_actions_the_planner_sees_no_random_generator() -> None:
    plan = make_pool(TRACKERS, 5)
    real = make_pool(TRACKERS, 5, repeat_action_probability=0.25, seed=9)
    player = AtariAgent(plan, AtariSearch(ratio=2.0), play_in=real)
    player.begin()
    player.play(3)
    width = plan.reset()["emulator_state"].shape[-1]
    assert player.state["emulator_state"].shape == (1, width)
    assert player.num_frames == plan.num_frames + real.num_frames


def test_pools_of_different_options_are_refused() -> None:
    with pytest.raises(ValueError, match="plans over 3 options and plays with 4"):
        AtariAgent(make_pool(TRACKERS, 5), play_in=make_pool(RepeatActions(4), 5))


def test_trackers_under_a_small_search_keep_the_ball_in_play() -> None:
    pool = make_pool(TRACKERS, 20)
    player = AtariAgent(pool, AtariSearch(ratio=4.0, rollout_options=3), seed=0)
    progress = player.play(max_steps=300)
    assert progress.score >= 8.0  # a random player has 1 or 2
    assert player.state["lives"].item() == 5 if "lives" in player.state.keys() else True


def test_the_search_that_is_kept_explores_in_units_of_the_greatest_reward() -> None:
    pool = make_pool(RepeatActions(4), max_steps=5)
    player = AtariAgent(pool, AtariSearch(ratio=4.0, tree_policy="uct", c=2.0), seed=0)
    player.play(1)
    kept = player.planner.last_search
    assert kept.settings.tree_policy.c == 2.0
    player.greatest_reward = 40.0
    player.play(1)
    assert player.planner.last_search is kept  # no tree was planted again
    assert kept.settings.tree_policy.c == kept.record["c"][0] == 80.0
    assert kept.settings is player.planner.settings


# ------------------------------------------------------------------------------------ experiment


def test_a_short_run_of_two_processes_leaves_its_figures(tmp_path) -> None:
    metrics = run_atari(AtariConfig(toy=True, out=str(tmp_path), num_processes=2))
    assert metrics["frames"] >= 20_000
    assert metrics["score_max"] == max(row["score"] for row in metrics["episodes"])
    assert json.loads((tmp_path / "metrics.json").read_text())["frames"] == metrics["frames"]
    with (tmp_path / "curves.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert {"score", "score_max"} <= {row["name"] for row in rows}
    assert int(rows[0]["step"]) * 4 == pytest.approx(metrics["episodes"][0]["frames"], abs=4)
    for name in ("index.html", "scores.png", "episode.gif"):
        assert (tmp_path / name).stat().st_size > 100
    checkpoints = sorted(path.name for path in (tmp_path / "checkpoints").iterdir())
    newest = f"checkpoint-{metrics['frames']:012d}.torchrl"
    assert checkpoints[-1] == newest
    assert len(checkpoints) == 2


@pytest.mark.parametrize("protocol", ["deterministic", "sticky"])
def test_the_gif_is_the_episode_that_scored(tmp_path, protocol) -> None:
    config = AtariConfig(
        frames=9_000, max_episode_frames=800, source="repeat", option_steps=10, ratio=2.0,
        num_processes=0, replant_every=5, seed=4, out=str(tmp_path), protocol=protocol,
        rollout_options=2,
    )  # fmt: skip
    first, saved = AtariRun(config), []

    def save() -> None:
        saved.append(first.state_dict())
        if len(saved) == 4:  # in the middle of the first episode
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        first.play(save, lambda: None)
    assert "decisions of the next" in first.kept()
    run = AtariRun(config)
    run.load_state_dict(saved[-1])
    run.play(lambda: None, lambda: None)
    best = run.best["episode"]
    assert run.scores[best]["score"] == run.best["score"] == max(r["score"] for r in run.scores)
    assert len(run.best["decisions"]) == run.scores[best]["decisions"]
    recorder = run.make_pool(
        run.options.worker, run.tuned.option_steps, record=True, sticky=protocol == "sticky"
    )
    recorder.set_seed(run.start_seed(best))
    shown, score = write_atari_gif(
        recorder, run.best["decisions"], tmp_path / "episode.gif", real_steps=10**6
    )
    recorder.close()
    assert score == run.best["score"]  # played again to its end: the same score
    assert shown * 4 == run.scores[best]["real_frames"]
    pictures = Pictures(tmp_path)
    draw(run, pictures)
    assert f"which scored {score:g}" in pictures.captions["episode.gif"]


@pytest.mark.parametrize("guide", ["none", "prior_value"])
def test_a_run_in_pieces_is_the_run_in_one(tmp_path, guide) -> None:
    config = AtariConfig(
        frames=9_000, max_episode_frames=1_200, source="repeat", option_steps=10, ratio=3.0,
        num_processes=0, replant_every=5, seed=4, out=str(tmp_path), guide=guide,
    )  # fmt: skip

    def nothing() -> None:
        return None

    whole = AtariRun(config)
    whole.play(nothing, nothing)
    saved: list[dict] = []
    first = AtariRun(config)

    def save() -> None:
        saved.append(first.state_dict())
        if len(saved) == 4:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        first.play(save, nothing)
    DurableRotation(tmp_path / "checkpoints").save(plain_checkpoint(run=first), step=1)
    first.close()
    second = AtariRun(config)
    second.load_state_dict(load_run(tmp_path)[1])
    second.play(nothing, nothing)
    assert second.scores == whole.scores
    assert second.points == whole.points
    longer = AtariRun(AtariConfig(**{**config.__dict__, "frames": whole.scores[-1]["frames"] + 1}))
    whole_again = AtariRun(config)
    ended: list[dict] = []
    whole_again.play(lambda: ended.append(whole_again.state_dict()), nothing)
    longer.load_state_dict(ended[-1])
    longer.play(nothing, nothing)  # one episode more, and none twice
    assert longer.scores[: len(whole.scores)] == whole.scores
    assert len(longer.scores) == len(whole.scores) + 1
    assert longer.scores[-1]["frames"] > whole.scores[-1]["frames"]
    other = AtariRun(AtariConfig(**{**config.__dict__, "ratio": 4.0}))
    with pytest.raises(ValueError, match="other settings: ratio=4.0 instead of 3.0"):
        other.load_state_dict(saved[-1])


def test_a_run_stopped_while_it_looks_for_options_plays_no_trial_twice(
    tmp_path, monkeypatch
) -> None:
    config = AtariConfig(
        game="Pong", frames=1_000, max_episode_frames=400, source="actions", tune_trials=2,
        trial_steps=6, trial_ratio=1.0, ratio=1.0, num_processes=0, out=str(tmp_path), seed=4,
    )  # fmt: skip
    played = []
    real = AtariRun.make_pool

    def make_pool(self, worker, max_steps, **kwargs):
        if len(played) == stop_after:
            raise KeyboardInterrupt
        played.append(worker.num_options)
        return real(self, worker, max_steps, **kwargs)

    monkeypatch.setattr(AtariRun, "make_pool", make_pool)
    stop_after = -1
    whole = AtariRun(config)
    whole.play(lambda: None, lambda: None)
    assert len(json.loads((tmp_path / "checkpoints" / "trials.json").read_text())["trials"]) > 10
    pools, played[:] = len(played), []
    (tmp_path / "checkpoints" / "trials.json").unlink()
    stop_after = 8
    with pytest.raises(KeyboardInterrupt):
        AtariRun(config).play(lambda: None, lambda: None)
    stop_after = -1
    second = AtariRun(config)
    second.play(lambda: None, lambda: None)
    assert len(played) == pools + 1  # the pool that only names the actions is made twice
    assert second.options.names == whole.options.names
    assert second.tuned == whole.tuned
    assert second.scores == whole.scores


def test_a_run_of_an_older_version_continues_and_what_was_half_written_is_removed(
    tmp_path, monkeypatch
) -> None:
    monkeypatch.setattr(
        "torchrl_hmcts.trainers.experiments.atari.run.draw", lambda run, pictures: None
    )
    config = AtariConfig(
        frames=1_000, max_episode_frames=400, source="repeat", option_steps=10, ratio=1.0,
        rollout_options=0, num_processes=0, replant_every=5, seed=4, out=str(tmp_path),
    )  # fmt: skip
    whole = run_atari(config)
    folder = tmp_path / "checkpoints"
    state = load_run(tmp_path)[1]
    for path in folder.glob("checkpoint-*"):
        path.unlink()
    torch.save(state, folder / "run.pt")
    (folder / ".run.pt.writing-999999999").write_bytes(b"half")
    assert evaluate_atari(config)["checkpoint"] == "run.pt"
    longer = dataclasses.replace(config, resume=True, frames=whole["frames"] + 1)
    metrics = run_atari(longer)
    assert metrics["episodes"][: len(whole["episodes"])] == whole["episodes"]
    assert not list(folder.glob(".*"))
    (folder / "run.pt").write_bytes((folder / "run.pt").read_bytes()[:-99])
    assert load_run(tmp_path)[0].name == f"checkpoint-{metrics['frames']:012d}.torchrl"
    for path in folder.glob("checkpoint-*"):
        path.unlink()
    with pytest.raises(CheckpointError, match=r"run\.pt' is damaged"):
        evaluate_atari(config)


def test_of_two_checkpoints_the_older_is_taken_where_the_newer_is_damaged(tmp_path, capsys) -> None:
    class Saved:
        def __init__(self, frames: int) -> None:
            self.state_dict = lambda: {"frames": frames, "points": [(1, 2.0)]}

    rotation = DurableRotation(tmp_path / "checkpoints")
    for frames in (400, 800):
        newest = rotation.save(plain_checkpoint(run=Saved(frames)), step=frames)
    newest.write_bytes(newest.read_bytes()[:-1])
    assert load_run(tmp_path)[1] == {"frames": 400, "points": [(1, 2.0)]}
    assert "800.torchrl is damaged" in capsys.readouterr().err


def test_trials_of_other_settings_or_a_damaged_file_are_played_again(tmp_path, capsys) -> None:
    path = tmp_path / "trials.json"
    RememberedTrials(None, path, {"game": "Pong"}).remember("key", Trial(1.0, 2, 3))
    assert RememberedTrials(None, path, {"game": "Pong"}).recall("key") == Trial(1.0, 2, 3)
    assert RememberedTrials(None, path, {"game": "Breakout"}).recall("key") is None
    assert capsys.readouterr().err == ""
    whole = path.read_text()
    for text in (
        "[]",
        "{",
        '{"settings": {"game": "Pong"}}',
        whole.replace("1.0", "9.0"),
        "\udcff",
    ):
        path.write_bytes(text.encode(errors="surrogateescape"))
        assert RememberedTrials(None, path, {"game": "Pong"}).recall("key") is None
        said = capsys.readouterr().err
        assert said.startswith(f"{path} cannot be read: ")
        assert said.endswith("Its trials are played again.\n")
    older = {"settings": {"game": "Pong"}, "trials": {"key": [1.0, 2, 3]}}  # without a checksum
    path.write_text(json.dumps(older))
    assert RememberedTrials(None, path, {"game": "Pong"}).recall("key") == Trial(1.0, 2, 3)


@pytest.mark.parametrize("guide", ["none", "prior"])
def test_a_run_is_evaluated_with_what_it_found_and_learned(tmp_path, monkeypatch, guide) -> None:
    monkeypatch.setattr(
        "torchrl_hmcts.trainers.experiments.atari.run.draw", lambda run, pictures: None
    )
    config = AtariConfig(
        frames=1_000, max_episode_frames=400, source="repeat", option_steps=10, ratio=1.0,
        rollout_options=0, num_processes=0, replant_every=5, seed=4, out=str(tmp_path), guide=guide,
    )  # fmt: skip
    metrics = run_atari(config)
    again = evaluate_atari(config)["test"]
    first = metrics["episodes"][0]
    if guide == "none":  # a guide knows more now than it did then
        assert again == {**first, "frames": again["frames"]}
    assert again["real_frames"] == first["real_frames"] <= 400
    assert again["real_frames"] < again["frames"] < metrics["frames"] + 400
    other = dataclasses.replace(config, protocol="sticky", seed=5)
    assert evaluate_atari(other)["test"]["real_frames"] <= 400
    with pytest.raises(ValueError, match="out=nowhere is no run"):
        evaluate_atari(dataclasses.replace(config, out="nowhere"))
    with pytest.raises(ValueError, match="is a run of Breakout, not of Pong"):
        evaluate_atari(dataclasses.replace(config, game="Pong"))


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"protocol": "random"}, "deterministic, sticky; got 'random'"),
        ({"source": "luck"}, "one of best, goals, .*repeat.*got 'luck'"),
        ({"ratio": 0.0}, "ratio must be above 0; got 0.0"),
        ({"gamma": 1.5}, r"gamma must be in \(0, 1\]; got 1.5"),
        ({"frames": 0}, "frames must be at least 1; got 0"),
        ({"num_processes": -2}, "num_processes must be at least -1; got -2"),
    ],
)
def test_a_config_that_cannot_be_is_refused(wrong, message) -> None:
    with pytest.raises(ValueError, match=message):
        AtariConfig(**wrong)


def test_an_agent_starts_by_itself() -> None:
    assert agent().play(1).decisions == 1
    assert isinstance(agent().pool.reset(TensorDict(batch_size=[1])), TensorDict)

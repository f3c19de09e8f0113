"""The hierarchical agent on Atari: playing, stopping and continuing, what a run leaves."""

from __future__ import annotations

import csv
import dataclasses
import json

import pytest
import torch

pytest.importorskip("ale_py")

from torchrl.checkpoint import CheckpointError  # noqa: E402

from torchrl_hmcts.envs import (
    AtariOptionPool,
    ByteGoal,
    FollowGoals,
    OccasionalAction,
    RepeatActions,
)  # noqa: E402
from torchrl_hmcts.trainers import AtariAgent, AtariKit, AtariSearch  # noqa: E402
from torchrl_hmcts.trainers.experiments.atari import run as experiment  # noqa: E402
from torchrl_hmcts.trainers.experiments.atari.config import AtariConfig  # noqa: E402
from torchrl_hmcts.trainers.experiments.atari.episodes import AtariRun, load_run  # noqa: E402
from torchrl_hmcts.trainers.experiments.atari.run import draw, evaluate_atari, run_atari  # noqa: E402
from torchrl_hmcts.trainers.figures.atari_figures import write_atari_gif  # noqa: E402
from torchrl_hmcts.trainers.figures.pictures import Pictures  # noqa: E402
from torchrl_hmcts.trainers.saving.checkpoints import DurableRotation, plain_checkpoint  # noqa: E402

GOALS = FollowGoals([ByteGoal(72, 99, offset, 2, 3) for offset in (-12, 0, 12)])
TRACKERS = OccasionalAction(GOALS, 1)
SHORT = {
    "frames": 9_000, "source": "repeat", "option_steps": 10, "num_processes": 0,
    "replant_every": 5, "seed": 4,
}  # fmt: skip


def make_pool(worker, max_steps, **kwargs) -> AtariOptionPool:
    kwargs = {"num_processes": 0, "seed": 0, **kwargs}
    return AtariOptionPool("Breakout", worker, max_steps=max_steps, **kwargs)


def agent(worker=TRACKERS, search=None, **kwargs) -> AtariAgent:
    return AtariAgent(make_pool(worker, 5), search or AtariSearch(ratio=4.0), seed=1, **kwargs)


def nothing() -> None:
    """Saves and shows nothing."""


@pytest.fixture
def no_pictures(monkeypatch):
    monkeypatch.setattr(experiment, "draw", lambda run, pictures: None)


# ------------------------------------------------------------------------------------ playing


def test_what_was_planned_happens_and_the_subtree_is_kept() -> None:
    player, kept = agent(), []
    advance = player.planner.advance
    player.planner.advance = lambda *a, **k: kept.append(bool(advance(*a, **k).all()))
    assert player.play(12).decisions == 12  # it begins by itself
    assert kept == [True] * 12
    assert sum(player.options_taken) == 12


def test_play_continues_bit_for_bit_from_where_a_new_tree_begins() -> None:
    whole, first, second = (agent(replant_every=4) for _ in range(3))
    whole.play(10)
    second.load_state_dict(first.play(8).state_dict())
    second.play(2)
    before, after = whole.state_dict(), second.state_dict()
    assert after["state"].equal(before["state"])
    assert after["progress"] == before["progress"]


def test_a_lost_life_costs_planning_but_not_the_score() -> None:
    player = agent()
    player.greatest_reward = 4.0
    player.play(1)
    assert player.pool.life_loss_penalty == 4.0
    assert player.score >= 0.0


def test_with_sticky_actions_the_planner_sees_no_random_generator() -> None:
    real = make_pool(TRACKERS, 5, repeat_action_probability=0.25, seed=9)
    player = agent(play_in=real).play(3)
    width = player.pool.reset()["emulator_state"].shape[-1]
    assert player.state["emulator_state"].shape == (1, width)
    assert player.num_frames == player.pool.num_frames + real.num_frames
    with pytest.raises(ValueError, match="plans over 3 options and plays with 4"):
        agent(play_in=make_pool(RepeatActions(4), 5))


def test_trackers_under_a_small_search_keep_the_ball_in_play() -> None:
    search = AtariSearch(ratio=4.0, rollout_options=3)
    player = AtariAgent(make_pool(TRACKERS, 20), search, seed=0)
    assert player.play(max_steps=300).score >= 8.0  # a random player has 1 or 2


def test_the_backup_is_a_setting_of_its_own() -> None:
    def backup(*words):
        return AtariSearch(**dict(words)).settings().backup

    assert backup() == "max"
    assert backup(("tree_policy", "uct")) == "mean"
    assert backup(("backup", "mean")) == "mean"
    assert agent(search=AtariSearch(ratio=4.0, backup="mean")).planner.settings.backup == "mean"
    with pytest.raises(ValueError, match="'max' or 'mean'; got 'sum'"):
        AtariSearch(backup="sum")


def test_uct_explores_in_units_of_the_greatest_reward_from_a_new_tree_on() -> None:
    player = agent(RepeatActions(4), AtariSearch(ratio=4.0, tree_policy="uct", c=2.0)).play(1)
    kept = player.planner.last_search
    assert player.planner.tree_policy.c == 2.0
    assert player.play(1).planner.last_search is kept
    player.greatest_reward = 40.0
    player.play(1)
    assert player.planner.last_search is not kept  # nothing changes under a search
    assert player.planner.tree_policy.c == 80.0


# ------------------------------------------------------------------------------------ experiment


GAMES = ["Breakout", "Qbert", "SpaceInvaders"]
OTHERS = [
    pytest.param(g, marks=pytest.mark.slow) for g in ("BeamRider", "Enduro", "Pong", "Seaquest")
]


@pytest.mark.parametrize("game", [*GAMES, *OTHERS])
def test_no_start_that_is_scored_is_one_that_chooses_and_there_are_a_hundred_of_each(game) -> None:
    kit = AtariKit(game, num_processes=0)
    seen = {}
    for split in ("train", "test"):
        starts = kit.starts(split, 200)
        assert kit.starts(split, 3)["emulator_state"].equal(starts["emulator_state"][:3])
        for key in ("emulator_state", "ram"):
            seen[split, key] = {row.numpy().tobytes() for row in starts[key]}
            assert len(seen[split, key]) >= 100  # behaviour too: the RAM differs
    assert not seen["train", "emulator_state"] & seen["test", "emulator_state"]
    assert not seen["train", "ram"] & seen["test", "ram"]


@pytest.mark.parametrize("protocol", ["deterministic", "sticky"])
def test_trials_and_training_begin_in_one_split_and_scored_episodes_in_the_other(
    tmp_path, monkeypatch, protocol
) -> None:
    config = AtariConfig(
        game="Pong", frames=1_000, episodes=1, max_episode_frames=400, source="diayn_retrained",
        tune_trials=1, trial_steps=6, trial_ratio=1.0, rounds=1, skill_base_steps=64, ratio=1.0,
        num_processes=0, out=str(tmp_path), seed=4, protocol=protocol, curve_every=64,
        curve_steps=10, curve_episodes=2, guide="none",
    )  # fmt: skip
    splits: list[tuple[str, int]] = []
    real = AtariOptionPool._reset

    def reset(self, tensordict=None, **kwargs):
        out = real(self, tensordict, **kwargs)
        if not kwargs.get("set_state"):
            frames = int(out["episode_frame"].flatten()[0])
            splits.append(("train" if frames % 2 else "test", frames))
        return out

    monkeypatch.setattr(AtariOptionPool, "_reset", reset)
    run = played(config)
    # curve: untrained, trained, retrained (two episodes each); the round; a trial; the episode
    found = "".join(split[1] for split, _ in splits)
    assert found == "eeeereere"
    assert [row["samples"] for row in run.learning][:2] == [0, 64]
    assert run.learning[-1]["samples"] > 64
    assert run.figures()["acts"] == "network"
    assert run.figures()["score_min"] == run.figures()["score_mean"] == run.scores[0]["score"]


def test_the_number_of_skills_is_searched_for_as_in_the_dissertation(tmp_path, monkeypatch) -> None:
    config = AtariConfig(
        game="Pong", frames=1_000, source="diayn", num_skills=0, trial_steps=3, trial_ratio=1.0,
        skill_base_steps=64, ratio=1.0, num_processes=0, out=str(tmp_path), max_episode_frames=400,
    )  # fmt: skip
    run = AtariRun(config)
    run._find_options()
    tried = sorted((row["num_skills"], row["option_steps"]) for row in run.tuned.trials)
    assert tried == [(k, n) for k in (3, 4, 5) for n in (10, 20, 30)]
    best = max(run.tuned.trials, key=lambda row: (row["score"], row["real_steps"]))
    assert len(run.options.names) == best["num_skills"]
    assert run.tuned.option_steps == best["option_steps"]
    assert run.num_frames == run.options.num_frames + run.tuned.num_frames > 3 * 4 * 64


def test_a_short_run_of_two_processes_leaves_its_figures(tmp_path) -> None:
    metrics = run_atari(AtariConfig(toy=True, out=str(tmp_path), num_processes=2))
    assert metrics["frames"] >= 20_000
    assert metrics["score_max"] == max(row["score"] for row in metrics["episodes"])
    assert json.loads((tmp_path / "metrics.json").read_text())["frames"] == metrics["frames"]
    with (tmp_path / "curves.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert {"score", "score_max"} <= {row["name"] for row in rows}
    assert int(rows[0]["base_steps"]) * 4 == pytest.approx(metrics["episodes"][0]["frames"], abs=4)
    for name in ("index.html", "scores.png", "episode.gif"):
        assert (tmp_path / name).stat().st_size > 100
    checkpoints = sorted(path.name for path in (tmp_path / "checkpoints").iterdir())
    assert checkpoints[1:] == [f"checkpoint-{metrics['frames']:012d}.torchrl"]


def stopped(config: AtariConfig, after: int) -> tuple[AtariRun, dict]:
    """A run that is stopped at a checkpoint, and what that holds."""
    run, saved = AtariRun(config), []

    def save() -> None:
        saved.append(run.state_dict())
        if len(saved) == after:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run.play(save, nothing)
    return run, saved[-1]


def played(config: AtariConfig, state: dict | None = None) -> AtariRun:
    run = AtariRun(config)
    if state is not None:
        run.load_state_dict(state)
    run.play(nothing, nothing)
    return run


@pytest.mark.parametrize("protocol", ["deterministic", "sticky"])
def test_the_gif_is_the_episode_that_scored(tmp_path, protocol) -> None:
    config = AtariConfig(
        **SHORT, max_episode_frames=800, ratio=2.0, out=str(tmp_path), protocol=protocol,
        rollout_options=2,
    )  # fmt: skip
    first, state = stopped(config, after=4)  # in the middle of the first episode
    assert "decisions of the next" in first.kept()
    run = played(config, state)
    best = run.best["episode"]
    assert run.scores[best]["score"] == run.best["score"] == max(r["score"] for r in run.scores)
    assert len(run.best["decisions"]) == run.scores[best]["decisions"]
    sticky, recorder = protocol == "sticky", run.make_player(record=True)
    recorder.set_seed(run.kit.start_seed(best, sticky=sticky))
    shown, score = write_atari_gif(
        recorder, run.best["decisions"], tmp_path / "episode.gif", real_steps=10**6
    )
    recorder.close()
    assert score == run.best["score"]  # played again to its end: the same score
    assert shown * 4 == run.scores[best]["real_frames"]
    pictures = Pictures(tmp_path)
    draw(run, pictures)
    assert f"which scored {score:g}" in pictures.captions["episode.gif"]


@pytest.mark.parametrize("guide", ["none", "prior_value", "reactive"])
def test_a_run_in_pieces_is_the_run_in_one(tmp_path, guide) -> None:
    config = AtariConfig(
        **SHORT, max_episode_frames=1_200, ratio=3.0, out=str(tmp_path), guide=guide
    )
    ended: list[dict] = []
    whole = AtariRun(config)
    whole.play(lambda: ended.append(whole.state_dict()), nothing)
    first, state = stopped(config, after=4)
    DurableRotation(tmp_path / "checkpoints").save(plain_checkpoint(run=first), step=1)
    first.close()
    second = played(config, load_run(tmp_path)[1])
    assert second.scores == whole.scores
    assert second.points == whole.points
    more = dataclasses.replace(config, frames=whole.scores[-1]["frames"] + 1)
    longer = played(more, ended[-1])  # one episode more, and none twice
    assert longer.scores[: len(whole.scores)] == whole.scores
    assert len(longer.scores) == len(whole.scores) + 1
    assert longer.scores[-1]["frames"] > whole.scores[-1]["frames"]
    with pytest.raises(ValueError, match="other settings: ratio=4.0 instead of 3.0"):
        AtariRun(dataclasses.replace(config, ratio=4.0)).load_state_dict(state)


def test_a_run_stopped_while_it_looks_for_options_plays_no_trial_twice(
    tmp_path, monkeypatch
) -> None:
    config = AtariConfig(
        game="Pong", frames=1_000, max_episode_frames=400, source="actions", tune_trials=2,
        trial_steps=6, trial_ratio=1.0, ratio=1.0, num_processes=0, out=str(tmp_path), seed=4,
    )  # fmt: skip
    pools, stop_after = [], -1
    real = AtariKit.make_pool

    def make_pool(self, worker, max_steps, **kwargs):
        if len(pools) == stop_after:
            raise KeyboardInterrupt
        pools.append(worker.num_options)
        return real(self, worker, max_steps, **kwargs)

    monkeypatch.setattr(AtariKit, "make_pool", make_pool)
    whole, count = played(config), len(pools)
    trials = tmp_path / "checkpoints" / "trials.json"
    assert len(json.loads(trials.read_text())["trials"]) > 10
    trials.unlink()
    pools.clear()
    stop_after = 8
    with pytest.raises(KeyboardInterrupt):
        played(config)
    stop_after = -1
    second = played(config)
    assert len(pools) == count
    assert second.options.names == whole.options.names
    assert second.tuned == whole.tuned
    assert second.scores == whole.scores


def tiny(folder, **keys) -> AtariConfig:
    keys = {"frames": 1_000, "max_episode_frames": 400, "ratio": 1.0, "rollout_options": 0, **keys}
    return AtariConfig(**{**SHORT, **keys, "out": str(folder)})


def test_a_run_of_an_older_version_continues_and_what_was_half_written_is_removed(
    tmp_path, no_pictures
) -> None:
    config = tiny(tmp_path)
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


@pytest.mark.parametrize("guide", ["none", "prior"])
def test_a_run_is_evaluated_with_what_it_found_and_learned(tmp_path, no_pictures, guide) -> None:
    config = tiny(tmp_path, guide=guide)
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
        ({"ratio": 0.0}, "ratio must be above 0; got 0.0"),
        ({"gamma": 1.5}, r"gamma must be in \(0, 1\]; got 1.5"),
        ({"frames": 0}, "frames must be at least 1; got 0"),
        ({"num_processes": -2}, "num_processes must be at least -1; got -2"),
    ],
)
def test_a_config_that_cannot_be_is_refused(wrong, message) -> None:
    with pytest.raises(ValueError, match=message):
        AtariConfig(**wrong)

"""A manager that plays without search: practice, labels from searches, runs that practise."""

from __future__ import annotations

import copy
import dataclasses
from types import SimpleNamespace

import pytest
import torch
from tensordict import TensorDict

pytest.importorskip("ale_py")

from torchrl_hmcts.envs import AtariOptionPool, RepeatActions  # noqa: E402
from torchrl_hmcts.trainers import AtariAgent, AtariSearch, ReactiveManager  # noqa: E402
from torchrl_hmcts.trainers.cli import main  # noqa: E402
from torchrl_hmcts.trainers.experiments.atari.config import AtariConfig  # noqa: E402
from torchrl_hmcts.trainers.experiments.atari.episodes import AtariRun, choose_arm, score_at  # noqa: E402

SMALL = {"hidden": (16,), "num_envs": 4, "steps": 8, "batch_size": 16, "lr": 0.01}


class Corridor:
    """A pool of a game of three options: byte 0 tells the place, option 1 moves on and earns 50,
    option 2 costs a life; the episode ends at place 5."""

    num_frames = 0

    def reset(self, td: TensorDict) -> TensorDict:
        return self._state(torch.zeros(td.batch_size[0], dtype=torch.int64))

    def _state(self, place: torch.Tensor) -> TensorDict:
        ram = torch.zeros(len(place), 128, dtype=torch.uint8)
        ram[:, 0] = place.to(torch.uint8)
        return TensorDict({"emulator_state": place[:, None], "ram": ram}, [len(place)])

    def step(self, td: TensorDict) -> TensorDict:
        place, option = td["emulator_state"][:, 0], td["option"]
        self.num_frames += 20 * len(place)
        place = place + (option == 1)
        after = self._state(place)
        over = (place == 5)[:, None]
        after["done"], after["terminated"] = over, over
        after["life_losses"] = (option == 2)[:, None].float()
        after["score"] = 50.0 * (option == 1)[:, None].float()
        after["duration"] = torch.full((len(place), 1), 5)
        return TensorDict({"next": after}, [len(place)])


def test_practice_finds_the_option_that_earns_and_values_are_in_units_of_the_score() -> None:
    manager, pool = ReactiveManager(3, **SMALL, imitation_coeff=0.0), Corridor()
    start = pool.reset(TensorDict(batch_size=[1]))
    priors, values = manager(start)
    assert priors.tolist() == [[pytest.approx(1 / 3)] * 3]
    assert manager.practise(pool, frames=20_000) == manager.practised == pool.num_frames
    priors, values = manager(start)
    assert priors[0, 1] > 0.8  # a quarter of the prior is uniform: 0.83 at most
    assert priors.sum().item() == pytest.approx(1.0)
    assert manager.scale == 50.0
    # Five options of 5 base steps earn 50 each: 50 * (1 + g + g^2 + g^3 + g^4), g = 0.99^5.
    assert values.item() == pytest.approx(50 * sum(0.99 ** (5 * i) for i in range(5)), rel=0.15)
    assert manager.scores[-1] == 250.0
    assert len(manager.scores) <= 100
    assert manager.act(start.expand(40), seed=0).eq(1).sum() > 35


def test_labels_of_searches_are_learned_beside_practice() -> None:
    def learned(coefficient: float) -> float:
        manager, pool = ReactiveManager(3, **SMALL, imitation_coeff=coefficient), Corridor()
        pool.step = lambda td: still(Corridor.step(pool, td))
        root = pool.reset(TensorDict(batch_size=[1]))
        search = SimpleNamespace(tree=SimpleNamespace(states=root.unsqueeze(1)))
        for _ in range(16):
            manager.learn(search, 1.0, option=2)
        assert manager.num_labels == 16
        manager.practise(pool, frames=2_000)
        return manager(root).priors[0, 2].item()

    def still(td: TensorDict) -> TensorDict:  # nothing is earned or lost: only labels teach
        td["next", "score"].zero_()
        td["next", "life_losses"].zero_()
        return td

    assert learned(1.0) > 0.8 > 0.5 > learned(0.0)


def test_a_manager_that_is_saved_continues_to_the_bit() -> None:
    first, pool = ReactiveManager(3, **SMALL, seed=2), Corridor()
    search = SimpleNamespace(
        tree=SimpleNamespace(states=pool.reset(TensorDict(batch_size=[1]))[None])
    )
    for _ in range(20):
        first.learn(search, 1.0, option=1)
    first.practise(pool, 1_000)
    second = ReactiveManager(3, **SMALL, seed=9)
    second.load_state_dict(copy.deepcopy(first.state_dict()))
    for manager in (first, second):
        manager.practise(Corridor(), 1_000)
    one, other = (manager.state_dict()["networks"] for manager in (first, second))
    assert all(torch.equal(one[name], other[name]) for name in one)
    assert (first.practised, first.scores) == (second.practised, second.scores)


def test_with_a_ratio_of_0_the_manager_plays_and_nothing_is_simulated() -> None:
    pool = AtariOptionPool("Breakout", RepeatActions(4), max_steps=5, num_processes=0, seed=0)
    manager = ReactiveManager(4, seed=1)
    with pytest.raises(ValueError, match="ratio of 0 does not search"):
        AtariAgent(pool, AtariSearch(ratio=0.0))
    agent = AtariAgent(pool, AtariSearch(ratio=0.0), guide=manager, seed=3)
    agent.begin()
    before, state = pool.num_frames, agent.state
    agent.play(1)
    assert agent.last_option == manager.act(state, seed=3 * 1_000_003).item()
    agent.play(9)
    assert pool.num_frames - before == 4 * agent.real_steps == 200
    assert manager.num_labels == 0


def test_a_sticky_run_practises_its_share_and_plays_until_the_frames_are_spent(tmp_path) -> None:
    config = AtariConfig(
        game="Breakout", protocol="sticky", source="repeat", frames=60_000, ratio=2.0,
        max_episode_frames=400, num_processes=0, episodes=2, out=str(tmp_path), practice=0.6,
        rollout_options=0,
    )  # fmt: skip
    run = AtariRun(config)
    run.play(lambda: None, lambda: None)
    manager = run.agent.guide
    played = run.num_frames - manager.practised
    assert len(run.scores) > 5  # `episodes` says which count, not when it ends
    # The last block of practice came before the last episode, and was finished by an update.
    least = 0.6 / 0.4 * (played - 400 * 4)
    assert least * 0.9 <= manager.practised <= 0.6 / 0.4 * played + 32 * 32 * 30
    last = [row["score"] for row in run.scores[-2:]]
    assert run.figures()["score_mean"] == sum(last) / 2
    assert run.figures()["source"] == "repeat, guide=reactive"
    assert {row["guided"] for row in run.scores} == {False, True}  # a bandit tries both
    run.close()
    alone = AtariRun(dataclasses.replace(config, ratio=0.0, frames=20_000))
    alone.play(lambda: None, lambda: None)
    assert alone.agent.guide.num_labels == 0 < alone.agent.guide.practised
    alone.close()


def test_the_arm_of_the_bandit_is_that_of_ucb1() -> None:
    assert choose_arm([], [3.0]) == 0
    # Means 0 and 1 after scaling; n = 4: 0 + sqrt(ln 4 / 6) = 0.48 against 1 + sqrt(ln 4 / 2).
    assert choose_arm([1.0, 1.0, 1.0], [2.0]) == 1
    # 0.5 + sqrt(ln 21 / 2) = 1.73 against 1 + sqrt(ln 21 / 40) = 1.28: the rare one is due.
    assert choose_arm([5.0], [10.0] * 19 + [0.0], last=1) == 0
    assert choose_arm([0.0] * 9 + [8.0] * 10, [4.0] * 19) == 0  # what it scored of late counts


def test_an_episode_without_the_guide_is_searched_as_if_there_were_none() -> None:
    def played(**guide: object) -> AtariAgent:
        pool = AtariOptionPool("Breakout", RepeatActions(4), max_steps=5, num_processes=0, seed=0)
        agent = AtariAgent(pool, AtariSearch(ratio=4.0), seed=1, **guide)
        agent.begin(guided=False)
        return agent.play(5)

    manager = ReactiveManager(4, seed=1)
    alone, beside = played(), played(guide=manager)
    assert beside.options_taken == alone.options_taken
    assert beside.pool.num_frames == alone.pool.num_frames
    assert manager.num_labels == 5  # it learns from the searches all the same


def test_what_auto_stands_for() -> None:
    plain, sticky = AtariConfig().resolved(), AtariConfig(protocol="sticky").resolved()
    assert (plain.guide, plain.source) == ("none", "best")
    assert (sticky.guide, sticky.source) == ("reactive", "screened")
    assert AtariConfig(protocol="sticky", guide="none").resolved().source == "best"
    assert AtariConfig(ratio=0.0, guide="reactive").ratio == 0.0
    with pytest.raises(ValueError, match="practice is a share of the frames"):
        AtariConfig(practice=1.0)


def test_the_score_at_a_number_of_frames_is_that_of_the_last_episodes_that_were_over() -> None:
    rows = [{"frames": i * 1_000_000, "score": float(i)} for i in range(1, 10)]
    assert score_at(rows, last=3) == {"2000000": 1.5, "5000000": 4.0}
    assert score_at(rows[:1]) == {}  # a run that was stopped at 1 million frames has none


def test_a_run_is_shown_with_search_and_without(tmp_path, capsys) -> None:
    folder, film = tmp_path / "run", tmp_path / "film.gif"
    words = ["experiment=atari", "game=Breakout", "protocol=sticky", "source=repeat", "ratio=1"]
    small = ["frames=9000", "max_episode_frames=400", "num_processes=0", f"out={folder}"]
    assert main(["train", *words, *small]) == 0
    for ratio, how in ((0, "plays without search"), (1, "searches")):
        assert main(["play", f"run={folder}", f"ratio={ratio}", f"out={film}"]) == 0
        assert f"Breakout, sticky: the agent {how} and scores" in capsys.readouterr().out
        assert film.read_bytes()[:3] == b"GIF"
        film.unlink()
    assert main(["play", f"run={folder}", "out=film.mp4"]) != 0
    assert "out of an Atari run is a film FILE.gif; got" in capsys.readouterr().err

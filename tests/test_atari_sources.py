"""Options of Atari games: rules chosen by trials, networks, and how they are trained further."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from tensordict import TensorDict

pytest.importorskip("ale_py")

from torchrl_hmcts.envs import (  # noqa: E402
    AtariOptionPool,
    AtariRAMEnv,
    ByteGoal,
    FollowGoals,
    JoinedWorkers,
    OccasionalAction,
    RepeatActions,
    SharedMLP,
)
from torchrl_hmcts.modules import SkillMLP  # noqa: E402
from torchrl_hmcts.trainers import (  # noqa: E402
    AtariAgent,
    AtariKit,
    AtariSearch,
    OptionGoals,
    Options,
    RuleSource,
    SearchGuide,
    TrainedSource,
)
from torchrl_hmcts.trainers.experiments.atari import rules  # noqa: E402
from torchrl_hmcts.trainers.experiments.atari.config import RULES, AtariConfig  # noqa: E402
from torchrl_hmcts.trainers.experiments.atari.fine_tuning import option_transitions  # noqa: E402
from torchrl_hmcts.trainers.experiments.atari.memory import Trial, TrialMemory  # noqa: E402
from torchrl_hmcts.trainers.experiments.atari.options import (  # noqa: E402
    load_worker,
    plain_worker,
)
from torchrl_hmcts.trainers.experiments.atari.rules import RuleSearch  # noqa: E402
from torchrl_hmcts.trainers.experiments.atari.sources import make_source  # noqa: E402

TRACKERS = FollowGoals([ByteGoal(72, 99, offset, 2, 3) for offset in (-12, 0, 12)])
KIT = AtariKit("Breakout", num_processes=0, log=lambda text: None)
SMALL_SKILLS = {"skill_steps": 8, "num_envs": 2}


class Given:
    """A source that has its options already."""

    def __init__(self, worker) -> None:
        self.worker = worker

    def find(self, kit) -> Options:
        names = [f"option {z}" for z in range(self.worker.num_options)]
        return Options(self.worker, names, num_frames=7)


def train(*args, **settings) -> Options:
    return TrainedSource(*args, **settings).find(KIT)


def network_weights(options: Options) -> torch.Tensor:
    worker = options.worker
    return (worker.worker if isinstance(worker, OccasionalAction) else worker).weights


def distilled(**settings) -> TrainedSource:
    small = {"samples": 60, "epochs": 1, "hidden": (8,), **settings}
    return TrainedSource("distilled", Given(TRACKERS), **small)


# ------------------------------------------------------------------------------ workers


@pytest.mark.parametrize(
    ("controlled", "action"), [(100, 2), (104, 2), (105, 0), (111, 0), (112, 3), (200, 3)]
)
def test_a_goal_brings_its_byte_to_the_target_plus_the_offset(controlled, action) -> None:
    ram = np.zeros(128, np.uint8)
    ram[72], ram[99] = controlled, 120
    assert ByteGoal(72, 99, -12, raising=2, lowering=3, dead_zone=3).action(ram) == action


@pytest.mark.parametrize(
    ("worker", "others"),
    [
        (OccasionalAction(FollowGoals([ByteGoal(72, 99, 0, 2, 3)]), 1, 0.25), 0),
        (OccasionalAction(RepeatActions([3]), action=1, probability=0.25), 3),
    ],
)
def test_an_action_is_taken_now_and_then_whatever_the_option(worker, others) -> None:
    ram, draws = np.zeros(128, np.uint8), np.random.default_rng(0)
    taken = [worker.act(ram, 0, draws) for _ in range(4000)]
    assert set(taken) == {1, others}
    assert np.mean(np.array(taken) == 1) == pytest.approx(0.25, abs=0.02)


class Ends(RepeatActions):
    def ends(self, ram, option, steps):
        return steps >= 2


def test_joined_and_interrupted_workers_keep_their_options_and_ends() -> None:
    joined = JoinedWorkers([RepeatActions([4, 5]), Ends([6])])
    assert [joined.act(None, z, None) for z in range(3)] == [4, 5, 6]
    assert [joined.ends(None, z, 2) for z in range(3)] == [False, False, True]
    interrupted = OccasionalAction(Ends([3]), action=1)
    assert [interrupted.ends(None, 0, n) for n in (1, 2)] == [False, True]
    assert not OccasionalAction(RepeatActions(2), 1).ends(None, 0, 9)


def test_options_are_built_again_from_what_was_saved() -> None:
    network = SharedMLP(2, 4, hidden=(8,))
    network.weights.normal_(generator=torch.Generator().manual_seed(0))
    nested = OccasionalAction(JoinedWorkers([TRACKERS, network]), 1)
    parts = [RepeatActions([3, 1]), TRACKERS, network, OccasionalAction(network, 2, 0.5), nested]
    before = JoinedWorkers(parts)
    plain = Options(before, ["a"], 7, {"c": 1}).plain()
    older = {**plain, "saved": {"parts": [plain_worker(part) for part in parts], "teacher": []}}
    ram = np.arange(128, dtype=np.uint8)[::-1].copy()
    for again in (Options.from_plain(plain), Options.from_plain(older)):
        assert (again.names, again.num_frames, again.report) == (["a"], 7, {"c": 1})
        assert again.worker.num_options == before.num_options == 14
        for option in range(14):
            draws = [np.random.default_rng(1) for _ in range(2)]
            for _ in range(20):
                acts = [
                    w.act(ram, option, d)
                    for w, d in zip((again.worker, before), draws, strict=True)
                ]
                assert acts[0] == acts[1]


def test_goals_of_an_older_folder_still_fire() -> None:
    part = plain_worker(TRACKERS) | {"fire": 1, "fire_probability": 0.5}
    older = {"names": ["a"], "num_frames": 7, "report": {}, "saved": {"parts": [part]}}
    worker: Any = Options.from_plain(older).worker
    assert (worker.action, worker.probability, worker.worker.goals) == (1, 0.5, TRACKERS.goals)


def test_weights_are_written_back_into_the_network_they_came_from() -> None:
    network, other = (SkillMLP(128, 5, 3, hidden=(16, 8)) for _ in range(2))
    worker = SharedMLP(3, 5, hidden=(16, 8))
    worker.load(network.parameters())
    worker.store(other.parameters())
    for a, b in zip(network.parameters(), other.parameters(), strict=True):
        assert a.equal(b)
    with pytest.raises(ValueError, match=r"needs parameters of the shapes \[\(16, 128\)"):
        worker.store(SkillMLP(128, 5, 2, hidden=(16, 8)).parameters())


# ------------------------------------------------------------------------------ rules


def test_every_source_of_a_config_is_made_of_rules_and_trainings() -> None:
    def described(source):
        if isinstance(source, RuleSource):
            assert (source.min_options, source.trial_steps, source.trial_ratio) == (2, 50, 3.0)
            return source.candidates
        begin = () if source.source is None else (described(source.source),)
        return (source.training, *begin, *sorted(source.settings.items()))

    def skills(objective, seen="state"):
        rest = {"discriminator": seen, "fire": 0.1, "game_weight": 0.5, "num_skills": 4}
        return ("diayn", ("base_steps", 90), *rest.items(), ("objective", objective))

    def retrained(source, weight):
        settings = {"intrinsic_weight": weight, "option_steps": 20, "round_steps": 50, "rounds": 2}
        return "retrained", source, *settings.items(), ("search", AtariSearch(ratio=3.0))

    network = ("distilled", "goals")
    expected = {
        **{name: name for name in RULES},
        "goals_network": network,
        "goals_fine_tuned": ("fine_tuned", network, ("base_steps", 90)),
        "goals_retrained": retrained(network, 1.0),
        "diayn": skills("diayn"),
        "diayn_retrained": retrained(skills("diayn"), 0.1),
        "metra_retrained": retrained(skills("metra"), 0.1),
    }
    for kind in ("displacement", "controllable"):
        expected[f"diayn_{kind}"] = skills("diayn", kind)
        expected[f"diayn_{kind}_retrained"] = retrained(skills("diayn", kind), 0.1)
    sizes = {"trial_steps": 50, "trial_ratio": 3.0, "num_skills": 4, "skill_base_steps": 90}
    sizes |= {"rounds": 2, "fire": 0.1, "option_steps": 20, "game_weight": 0.5}
    for name, parts in expected.items():
        assert described(make_source(AtariConfig(source=name, **sizes), AtariSearch())) == parts
    with pytest.raises(ValueError, match="best, goals, actions.*got 'luck'"):
        AtariConfig(source="luck")


def test_repeated_actions_are_an_option_each() -> None:
    options = RuleSource("repeat").find(KIT)
    assert options.names == ["NOOP", "FIRE", "RIGHT", "LEFT"]
    assert [options.worker.act(None, z, None) for z in range(4)] == [0, 1, 2, 3]
    assert options.num_frames == 0


def test_the_goals_of_breakout_are_found_without_being_told() -> None:
    search = RuleSearch(RuleSource("goals", probe_states=150, screen_steps=300), KIT)
    report: dict = {}
    candidates, states = search.probe(report)
    assert 72 in report["controllable"]  # the paddle
    assert 99 in report["moving"]  # the ball
    ranked = search.screen(candidates, states[:1], report)
    best = ranked[0].worker.worker.goals[0]
    assert (best.controlled, best.target) == (72, 99)
    # An action alone scores nothing in these steps, and is still a candidate.
    assert report["screened"][ranked[0].name] > 0.0
    assert {"NOOP", "FIRE", "RIGHT", "LEFT"} <= set(report["screened"])
    assert search.num_frames > 150 * 4 * 3 * 4


@pytest.fixture
def trials(monkeypatch):
    """Plays no trial, but scores it by a function; returns what was tried: names and seeds."""
    asked: list[tuple[int, ...]] = []

    def scored_by(function) -> list[tuple[int, ...]]:
        def play(kit, worker, search, *, seed, start, **rest) -> Trial:
            actions = tuple(part.actions[0] for part in worker.workers)
            asked.append((*actions, seed))
            assert start in (None, seed)
            return Trial(function(actions) + seed % 2, real_steps=0, num_frames=100)

        monkeypatch.setattr(rules, "play_trial", play)
        return asked

    return scored_by


@pytest.mark.parametrize(("best", "name"), [("firing", "FIRE"), ("not firing", "NOOP")])
def test_of_all_actions_those_are_taken_with_which_trials_score_best(trials, best, name) -> None:
    fires = {1, 4, 5}  # NOOP, FIRE, RIGHT, LEFT, RIGHTFIRE, LEFTFIRE
    wanted = fires if best == "firing" else {0, 2, 3}
    asked = trials(lambda actions: 10.0 * len(wanted & set(actions)) / len(actions))
    pong = replace(KIT, game="Pong", seed=3)
    found = RuleSource("action_sets").find(pong)
    assert found.names[0] == name
    assert len(found.names) == 3
    assert found.report["action_sets"] == {
        "all": 5.5,
        "firing": 10.5 if best == "firing" else 0.5,
        "not firing": 0.5 if best == "firing" else 10.5,
    }
    assert [row[-1] for row in asked] == [30_000, 30_001] * 3
    assert found.num_frames == 6 * 100
    equal = RuleSource("action_sets").find(KIT)  # in Breakout FIRE alone fires
    assert list(equal.report["action_sets"]) == ["all", "not firing"]


def test_options_are_added_one_by_one_until_the_score_falls(trials) -> None:
    worth = {0: 1.0, 1: 0.0, 2: 4.0, 3: 2.0}
    trials(lambda actions: sum(worth[a] for a in actions) - max(0, len(actions) - 2) ** 2 * 2.0)
    found = RuleSource("actions", min_options=1).find(KIT)
    # RIGHT alone 4, LEFT too 6, NOOP too 7 - 2: it falls, and the two are left.
    assert found.names == found.report["chosen"] == ["RIGHT", "LEFT"]
    assert [row["options"] for row in found.report["trials"]][4:7] == [
        ["RIGHT", "NOOP"], ["RIGHT", "FIRE"], ["RIGHT", "LEFT"]
    ]  # fmt: skip
    assert found.num_frames == (4 + 3 + 2) * 100


def test_the_candidates_whose_options_score_best_in_trials_are_taken(trials, monkeypatch) -> None:
    sizes = {"action_sets": 2, "actions": 3, "goals": 4}
    real = RuleSearch.choose

    def choose(self, name, report):
        if name == "best":
            return real(self, name, report)
        self.num_frames += 7
        report["of"] = name
        return self.repeats()[: sizes[name]]

    monkeypatch.setattr(RuleSearch, "choose", choose)
    asked = trials(lambda actions: {2: 3.0, 3: 5.0, 4: 4.0}[len(actions)])
    best = RuleSource("best").find(replace(KIT, seed=1))
    assert best.names == ["NOOP", "FIRE", "RIGHT"]
    assert (best.report["source"], best.report["of"]) == ("actions", "actions")
    scores = {name: row["score"] for name, row in best.report["sources"].items()}
    assert scores == {"action_sets": 3.5, "actions": 5.5, "goals": 4.5}
    assert best.num_frames == 3 * 7 + 6 * 100  # of all candidates, and of the trials
    assert [(len(row) - 1, row[-1]) for row in asked] == [
        (n, 10_000 + i) for n in (2, 3, 4) for i in (0, 1)
    ]


def test_trials_of_other_settings_or_a_damaged_file_are_played_again(tmp_path, capsys) -> None:
    path = tmp_path / "trials.json"
    TrialMemory(path, {"game": "Pong"}).remember("key", Trial(1.0, 2, 3))
    assert TrialMemory(path, {"game": "Pong"}).recall("key") == Trial(1.0, 2, 3)
    assert TrialMemory(path, {"game": "Breakout"}).recall("key") is None
    assert capsys.readouterr().err == ""
    changed = path.read_text().replace("1.0", "9.0")
    for text in ("[]", "{", '{"settings": {"game": "Pong"}}', changed, "\udcff"):
        path.write_bytes(text.encode(errors="surrogateescape"))
        assert TrialMemory(path, {"game": "Pong"}).recall("key") is None
        told = capsys.readouterr().err
        assert told.startswith(f"{path} cannot be read: ")
        assert told.endswith("Its trials are played again.\n")
    older = {"settings": {"game": "Pong"}, "trials": {"key": [1.0, 2, 3]}}  # without a checksum
    path.write_text(json.dumps(older))
    assert TrialMemory(path, {"game": "Pong"}).recall("key") == Trial(1.0, 2, 3)


# ------------------------------------------------------------------------------ networks


@pytest.mark.parametrize(
    "how",
    [{}, {"discriminator": "displacement", "game_weight": 1.0}, {"objective": "metra"}],
    ids=str,
)
def test_skills_learned_on_the_ram_become_options(how) -> None:
    sizes = {"num_skills": 2, "base_steps": 128, "hidden": (16,), **SMALL_SKILLS}
    seen: list[tuple[int, int]] = []
    measured = replace(KIT, curve=lambda worker, *spent: seen.append(spent))
    options = TrainedSource("diayn", **how, **sizes).find(measured)
    assert options.worker.num_options == 2
    # Every frame counts: two starts of up to 240 frames and 5 steps, and what it takes to set them.
    assert 4 * 128 < options.num_frames < 4 * 128 + 2 * (240 + 20 + 100)
    assert [samples for samples, _ in seen] == [0, 64, 128, 128]
    assert seen[-1][1] == options.num_frames
    unmeasured = train("diayn", **how, **sizes)
    assert unmeasured.worker.weights.equal(options.worker.weights)
    again = Options.from_plain(options.plain())
    assert again.worker.weights.equal(options.worker.weights)
    assert options.worker.weights.abs().sum() > 0
    pool = KIT.make_pool(again.worker, 3)
    td = pool.reset().set("option", torch.tensor(1))
    assert pool.step(td)["next", "duration"].item() == 3


def test_a_network_learns_the_goals_that_rules_follow() -> None:
    options = distilled(samples=900, epochs=30, hidden=(32,), batch_size=32, lr=3e-3).find(KIT)
    assert options.names == ["option 0", "option 1", "option 2"]
    assert options.num_frames > 7
    assert options.report["distilled_agreement"] > 0.8  # of 4 actions
    again = Options.from_plain(options.plain())
    for worker in (again.worker, options.worker):
        assert (worker.action, worker.probability) == (1, 0.05)  # FIRE
        worker.worker.deterministic = True
    ram = np.zeros(128, np.uint8)
    ram[72], ram[99] = 60, 180
    assert again.worker.worker.act(ram, 1, None) == options.worker.worker.act(ram, 1, None)


def test_goals_pay_for_being_near_and_actions_for_being_repeated() -> None:
    goals = OptionGoals([ByteGoal(5, 9, -4, 2, 3), 3], scale=10.0)
    ram = torch.zeros(5, 128)
    ram[:, 9] = 50
    ram[:, 5] = torch.tensor([46.0, 41.0, 60.0, 46.0, 46.0])  # 0, 5 and 14 away from 50 - 4
    td = TensorDict(
        skill=torch.tensor([0, 0, 0, 1, 1]),
        action=torch.tensor([0, 1, 2, 3, 0]),
        next=TensorDict(observation=ram / 255.0, batch_size=[5]),
        batch_size=[5],
    )
    expected = torch.tensor([[1.0], [0.5], [0.0], [1.0], [0.0]])
    torch.testing.assert_close(goals.reward(td), expected, atol=1e-4, rtol=0)
    assert list(goals.parameters()) == []


def test_recorded_options_become_the_transitions_that_an_env_makes_of_their_actions() -> None:
    pool = KIT.make_pool(RepeatActions(4), 5, record=True)
    start = pool.reset(TensorDict(batch_size=[2])).set("option", torch.tensor([1, 2]))
    after = pool.step(start)["next"]
    found = option_transitions(start, after, bytes_seen=[72, 99])
    assert len(found) == after["duration"].sum() == 10
    env = AtariRAMEnv("Breakout", repeat_action_probability=0.0)
    for i, rows in enumerate(found.split(5)):
        td = env.reset(start[i].select("emulator_state"), set_state=True)
        first = td["observation"]
        for row in rows:
            assert row["observation"].equal(td["observation"])
            assert (row["skill"].item(), row["action"].item()) == (i + 1, i + 1)
            td = env.step(td.exclude("next").set("action", row["action"]))["next"]
            assert row["next", "observation"].equal(td["observation"])
            assert row["next", "reward"].item() == td["reward"].sign().item()
            moved = (td["observation"] - first)[[72, 99]]
            torch.testing.assert_close(row["next", "displacement"], moved)
        assert not rows["next", "done"].any()
    ended = after.clone()
    ended["duration"][0], ended["terminated"][0], ended["done"][0] = 3, True, True
    cut = option_transitions(start, ended)
    assert cut["next", "terminated"].flatten().tolist() == [False, False, True] + [False] * 5
    assert "displacement" not in cut.keys()


def test_while_the_critics_warm_up_the_actor_stays_and_then_it_learns() -> None:
    before = distilled().find(KIT)
    small = {"base_steps": 96, "updates_per_batch": 1, **SMALL_SKILLS}
    same = train("fine_tuned", distilled(), warm_up=0.99, **small)
    other = train("fine_tuned", distilled(), warm_up=0.5, lr=1e-2, **small)
    torch.testing.assert_close(network_weights(same), network_weights(before))
    assert not network_weights(other).allclose(network_weights(before), atol=1e-3)
    assert 4 * 96 < other.num_frames - before.num_frames < 4 * 96 + 2 * 360
    assert 0.0 <= other.report["fine_tuned_goal_reward"] <= 1.0
    assert network_weights(Options.from_plain(other.plain())).equal(network_weights(other))
    assert len(other.training.data) == 96  # those of the warm-up too
    rounds = {"search": AtariSearch(ratio=2), "rounds": 1, "round_steps": 5, "option_steps": 5}
    waiting = train("retrained", distilled(), warm_up=1.0, **rounds)
    torch.testing.assert_close(network_weights(waiting), network_weights(before))


@pytest.mark.parametrize(
    ("make", "error", "message"),
    [
        (lambda: FollowGoals([]), ValueError, "a goal for each option; got none"),
        (lambda: FollowGoals([ByteGoal(128, 0, 0, 1, 2)]), ValueError, "0 to 127; got .*=128"),
        (lambda: JoinedWorkers([]), ValueError, "at least one worker; got none"),
        (lambda: OccasionalAction(RepeatActions(2), 1, 1.5), ValueError, "from 0 to 1; got 1.5"),
        (lambda: load_worker({"kind": "magic"}), ValueError, "kind of options: 'magic'"),
        (lambda: plain_worker(Given(None)), TypeError, "Given cannot be saved as plain data"),
        (lambda: OptionGoals([]), ValueError, "got none"),
        (lambda: OptionGoals([3], scale=0.0), ValueError, "scale > 0.0.*; got 0.0"),
        (lambda: RuleSource("luck"), ValueError, "one of best, goals, .*got 'luck'"),
        (lambda: RuleSource(repetitions=0), ValueError, "repetitions >= 1; got 0"),
        (lambda: SearchGuide(3, min_visits=0), ValueError, "min_visits >= 1; got 0"),
        (lambda: TrainedSource("by hand"), ValueError, "one of diayn, .*got 'by hand'"),
        (lambda: TrainedSource("distilled"), TypeError, "needs another source; got None"),
        (lambda: TrainedSource("diayn", distilled()), TypeError, "begins with no other; got"),
        (lambda: TrainedSource("diayn", base_step=3), TypeError, "'base_step'"),
        (lambda: train("diayn", discriminator="ram"), ValueError, "'controllable'.*'ram'"),
        (lambda: train("fine_tuned", Given(TRACKERS)), TypeError, "executed by FollowGoals"),
        (lambda: train("retrained", Given(SharedMLP(2, 4))), TypeError, "options.* is unknown"),
        (lambda: train("retrained", distilled(), rounds=0), ValueError, "rounds >= 1; got 0"),
        (lambda: train("retrained", distilled(), warm_up=2.0), ValueError, "warm_up .*2.0"),
        (lambda: train("fine_tuned", distilled(), warm_up=-1), ValueError, "warm_up .*-1"),
    ],
)
def test_what_cannot_be_is_refused(make, error, message) -> None:
    with pytest.raises(error, match=message):
        make()


@pytest.mark.parametrize("kind", ["goals", "state", "displacement"])
def test_a_worker_is_retrained_on_what_searches_simulated(kind) -> None:
    sizes = {"num_skills": 2, "base_steps": 64, "hidden": (8,), **SMALL_SKILLS}
    source = distilled() if kind == "goals" else TrainedSource("diayn", discriminator=kind, **sizes)
    before = source.find(KIT)
    rounds = {"search": AtariSearch(ratio=2), "rounds": 2, "round_steps": 10, "option_steps": 5}
    after = train("retrained", source, lr=1e-2, **rounds)
    rows = after.report["rounds"]
    assert [row["real_steps"] for row in rows] == [10, 10]
    # Simulated and executed base steps; nothing ends here, so all options are whole.
    assert all(row["samples"] >= 10 and row["samples"] % 5 == 0 for row in rows)
    assert after.num_frames - before.num_frames >= 4 * sum(row["samples"] for row in rows)
    assert not network_weights(before).allclose(network_weights(after), atol=1e-3)
    assert torch.isfinite(network_weights(after)).all()


# ------------------------------------------------------------------------------ guide


def breakout(worker, max_steps, seed=0) -> AtariOptionPool:
    return replace(KIT, seed=seed).make_pool(worker, max_steps)


def test_a_guide_that_has_learned_nothing_changes_no_decision() -> None:
    pool, played = breakout(RepeatActions(4), 5), []
    for guide in (None, SearchGuide(4, values=True, learn_every=1000)):
        pool.set_seed(0)
        agent = AtariAgent(pool, AtariSearch(ratio=4), guide=guide, seed=0).play(6)
        played.append((agent.score, agent.options_taken, agent.state["ram"].tolist()))
    assert played[0] == played[1]


def test_a_guide_learns_which_option_was_visited_and_what_it_was_worth() -> None:
    guide = SearchGuide(
        3, values=True, hidden=(32,), min_visits=10_000, learn_every=1, updates=150, lr=1e-2
    )
    pool = breakout(TRACKERS, 5, seed=1)
    agent = AtariAgent(pool, AtariSearch(ratio=6), guide=SearchGuide(3), seed=0)
    agent.begin()
    search = agent.planner.plant(agent.state, seed=0)
    agent.planner.resume(search)
    visits = search.tree.edges["visits"][0, 0].astype(float)
    search.tree.nodes["value"][0, 0] = 3.0  # of a scale of 6
    guide.learn(search, scale=6.0)
    root = agent.state.select("ram")
    priors, values = guide(root)
    expected = 0.75 * visits / visits.sum() + 0.25 / 3
    np.testing.assert_allclose(priors[0].numpy(), expected, atol=0.03)
    assert values.item() == pytest.approx(3.0, abs=0.5)
    assert SearchGuide(3)(root).values is None

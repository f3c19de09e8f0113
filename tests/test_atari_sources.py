"""Where options of Atari games come from: repeated, chosen, learned, imitated, trained further."""

from __future__ import annotations

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
    ActionSetSource,
    AtariAgent,
    AtariSearch,
    BestSource,
    DIAYNSource,
    DistilledSource,
    FineTunedSource,
    GoalFinder,
    GoalSearch,
    OptionGoals,
    Options,
    RepeatSource,
    RetrainedSource,
    SearchGuide,
    load_options,
)
from torchrl_hmcts.trainers.experiments.atari.options import plain_worker  # noqa: E402
from torchrl_hmcts.trainers.experiments.atari.trained_sources import option_transitions  # noqa: E402

TRACKERS = FollowGoals([ByteGoal(72, 99, offset, 2, 3) for offset in (-12, 0, 12)])


def make_pool(worker, max_steps, **kwargs) -> AtariOptionPool:
    kwargs = {"num_processes": 0, "seed": 0, **kwargs}
    return AtariOptionPool("Breakout", worker, max_steps=max_steps, **kwargs)


class Given:
    """A source that has its options already."""

    def __init__(self, worker) -> None:
        self.worker = worker

    def find(self, game, make_pool, *, seed, log) -> Options:
        names = [f"option {z}" for z in range(self.worker.num_options)]
        return Options(self.worker, names, 7, {}, {"parts": [plain_worker(self.worker)]})


def quiet(text: str) -> None:
    """Says nothing."""


def test_repeated_actions_are_an_option_each() -> None:
    options = RepeatSource().find("Breakout", make_pool, seed=0, log=print)
    assert options.names == ["NOOP", "FIRE", "RIGHT", "LEFT"]
    assert options.worker.num_options == 4


@pytest.mark.parametrize("discriminator", ["state", "displacement"])
def test_skills_learned_on_the_ram_become_options(discriminator) -> None:
    source = DIAYNSource(
        2, 128, skill_steps=8, num_envs=2, hidden=(16,), discriminator=discriminator
    )
    options = source.find("Breakout", make_pool, seed=0, log=lambda text: None)
    assert options.worker.num_options == 2
    assert options.num_frames == 4 * 128
    again = load_options(options.saved)
    assert again.weights.equal(options.worker.weights)
    assert options.worker.weights.abs().sum() > 0
    td = make_pool(options.worker, 3).reset().set("option", torch.tensor(1))
    assert make_pool(options.worker, 3).step(td)["next", "duration"].item() == 3


def test_an_unknown_discriminator_is_refused() -> None:
    with pytest.raises(ValueError, match="'state', 'displacement' or 'controllable'; got 'ram'"):
        DIAYNSource(discriminator="ram")


@pytest.mark.parametrize("kind", ["repeat", "goals", "network", "occasional", "nested", "joined"])
def test_options_are_built_again_from_what_was_saved(kind) -> None:
    network = SharedMLP(2, 4, hidden=(8,), deterministic=True)
    network.deterministic = False
    network.weights.normal_(generator=torch.Generator().manual_seed(0))
    workers = {"repeat": [RepeatActions([3, 1])], "goals": [TRACKERS], "network": [network]}
    workers["occasional"] = [OccasionalAction(network, 2, 0.5)]
    workers["nested"] = [OccasionalAction(JoinedWorkers([TRACKERS, network]), 1)]
    workers["joined"] = [w for part in list(workers.values()) for w in part]
    saved = {"parts": [plain_worker(w) for w in workers[kind]]}
    worker = load_options(saved)
    before = workers[kind][0] if len(workers[kind]) == 1 else JoinedWorkers(workers[kind])
    assert worker.num_options == before.num_options
    ram = np.arange(128, dtype=np.uint8)[::-1].copy()
    for option in range(worker.num_options):
        drawn = [
            [w.act(ram, option, draws) for _ in range(20)]
            for w, draws in ((w, np.random.default_rng(1)) for w in (worker, before))
        ]
        assert drawn[0] == drawn[1]
    with pytest.raises(ValueError, match="kind 'magic' are not known"):
        load_options({"parts": [{"kind": "magic"}]})


def test_a_network_learns_the_goals_that_rules_carry_out() -> None:
    source = DistilledSource(
        Given(TRACKERS), samples=900, epochs=30, hidden=(32,), batch_size=32, lr=3e-3
    )
    options = source.find("Breakout", make_pool, seed=0, log=lambda text: None)
    assert options.names == ["option 0", "option 1", "option 2"]
    assert options.num_frames > 7
    assert options.report["distilled_agreement"] > 0.8  # of 4 actions
    again = load_options(options.saved)
    for worker in (again, options.worker):
        assert (worker.action, worker.probability) == (1, 0.05)  # FIRE
        worker.worker.deterministic = True
    ram = np.zeros(128, np.uint8)
    ram[72], ram[99] = 60, 180
    assert again.worker.act(ram, 1, None) == options.worker.worker.act(ram, 1, None)


@pytest.mark.parametrize(("best", "names"), [("firing", ["FIRE"]), ("not firing", ["NOOP"])])
def test_of_all_actions_those_are_taken_with_which_trials_score_best(
    monkeypatch, best, names
) -> None:
    asked = []

    def trial(self, options, *, seed):
        asked.append(seed)
        firing = [("FIRE" in c.name) == (best == "firing") for c in options]
        return 10.0 * sum(firing) / len(options) + seed % 2

    monkeypatch.setattr(GoalFinder, "trial", trial)

    def pong(worker, max_steps):
        return AtariOptionPool("Pong", worker, max_steps=max_steps, num_processes=0, seed=0)

    found = ActionSetSource(GoalSearch(), trials=2).find("Pong", pong, seed=3, log=quiet)
    assert found.names[0] == names[0]
    assert len(found.names) == 3  # of 6
    assert found.report["action_sets"] == {
        "all": 5.5,
        "firing": 10.5 if best == "firing" else 0.5,
        "not firing": 0.5 if best == "firing" else 10.5,
    }
    assert asked == [30_000, 30_001] * 3
    with pytest.raises(ValueError, match="trials >= 1; got 0"):
        ActionSetSource(trials=0)


def test_sets_of_one_action_are_not_tried(monkeypatch) -> None:
    monkeypatch.setattr(GoalFinder, "trial", lambda self, options, *, seed: 0.0)
    found = ActionSetSource().find("Breakout", make_pool, seed=0, log=quiet)
    assert list(found.report["action_sets"]) == ["all", "not firing"]  # FIRE alone fires
    assert found.names == ["NOOP", "FIRE", "RIGHT", "LEFT"]  # of equal sets the first


def test_the_source_whose_options_score_best_in_trials_is_taken(monkeypatch) -> None:
    asked = []

    def try_worker(self, worker, *, seed) -> float:
        asked.append((worker.num_options, seed))
        self.num_frames += 100
        return {2: 3.0, 3: 5.0, 4: 4.0}[worker.num_options] + seed % 2

    monkeypatch.setattr(GoalFinder, "try_worker", try_worker)
    given = {name: Given(RepeatActions(n)) for name, n in {"a": 2, "b": 3, "c": 4}.items()}
    found = BestSource(given, trials=2).find("Breakout", make_pool, seed=1, log=quiet)
    assert found.worker.num_options == 3
    assert load_options(found.saved).num_options == 3
    assert found.report["source"] == "b"
    assert {name: row["score"] for name, row in found.report["sources"].items()} == {
        "a": 3.5,
        "b": 5.5,
        "c": 4.5,
    }
    assert found.num_frames == 3 * 7 + 6 * 100  # of all sources, and of the trials
    assert asked == [(n, 10_000 + i) for n in (2, 3, 4) for i in (0, 1)]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [(({},), "got none"), (({"a": RepeatSource()},), "trials >= 1; got 0")],
)
def test_a_choice_of_nothing_is_refused(arguments, message) -> None:
    with pytest.raises(ValueError, match=message):
        BestSource(*arguments, trials=0)


# ------------------------------------------------------------------------------ networks


def test_weights_are_written_back_into_the_network_they_came_from() -> None:
    network, other = (SkillMLP(128, 5, 3, hidden=(16, 8)) for _ in range(2))
    worker = SharedMLP(3, 5, hidden=(16, 8))
    worker.load(network.parameters())
    worker.store(other.parameters())
    for a, b in zip(network.parameters(), other.parameters(), strict=True):
        assert a.equal(b)
    with pytest.raises(ValueError, match=r"wants parameters of the shapes \[\(16, 128\)"):
        worker.store(SkillMLP(128, 5, 2, hidden=(16, 8)).parameters())


def test_an_occasional_action_is_taken_as_often_as_asked_and_ends_stay_the_workers() -> None:
    class Ends(RepeatActions):
        def ends(self, ram, option, steps):
            return steps >= 2

    draws = np.random.default_rng(0)
    worker = OccasionalAction(Ends([3]), action=1, probability=0.25)
    taken = [worker.act(None, 0, draws) for _ in range(4000)]
    assert set(taken) == {1, 3}
    assert np.mean(np.array(taken) == 1) == pytest.approx(0.25, abs=0.02)
    assert [worker.ends(None, 0, n) for n in (1, 2)] == [False, True]
    assert not OccasionalAction(RepeatActions(2), 1).ends(None, 0, 9)
    with pytest.raises(ValueError, match="from 0 to 1; got 1.5"):
        OccasionalAction(RepeatActions(2), 1, 1.5)


# ------------------------------------------------------------------------------ trained further


def test_goals_pay_for_being_near_and_actions_for_being_repeated() -> None:
    goals = OptionGoals([ByteGoal(5, 9, -4, 2, 3), 3], scale=10.0)
    ram = torch.zeros(4, 128)
    ram[:, 9] = 50
    ram[:, 5] = torch.tensor([46.0, 41.0, 60.0, 46.0])  # 0, 5 and 14 away from 50 - 4
    td = TensorDict(
        skill=torch.tensor([0, 0, 0, 1]),
        action=torch.tensor([0, 1, 2, 3]),
        next=TensorDict(observation=ram / 255.0, batch_size=[4]),
        batch_size=[4],
    )
    torch.testing.assert_close(
        goals.reward(td).flatten(), torch.tensor([1.0, 0.5, 0.0, 1.0]), atol=1e-4, rtol=0
    )
    td["action"][3] = 0
    assert goals.reward(td)[3].item() == 0.0
    assert list(goals.parameters()) == []
    for wrong, message in ((([],), "got none"), (([3], 0.0), "scale > 0; got 0.0")):
        with pytest.raises(ValueError, match=message):
            OptionGoals(wrong[0], **({"scale": wrong[1]} if len(wrong) > 1 else {}))


@pytest.mark.parametrize("bytes_seen", [None, [72, 99]])
def test_recorded_options_become_the_transitions_that_an_env_makes_of_their_actions(
    bytes_seen,
) -> None:
    pool = make_pool(RepeatActions(4), 5, record=True)
    taken: list[TensorDict] = []
    pool.on_step = lambda before, after: taken.append(option_transitions(before, after, bytes_seen))
    start = pool.reset(TensorDict(batch_size=[2])).set("option", torch.tensor([1, 2]))
    after = pool.step(start)["next"]
    (found,) = taken
    assert len(found) == after["duration"].sum() == 10
    env = AtariRAMEnv("Breakout", repeat_action_probability=0.0)
    for i in range(2):
        rows = found[5 * i : 5 * i + 5]
        td = env.reset(start[i].select("emulator_state"), set_state=True)
        first = td["observation"]
        for row in rows:
            assert row["observation"].equal(td["observation"])
            assert (row["skill"].item(), row["action"].item()) == (i + 1, i + 1)
            td = env.step(td.exclude("next").set("action", row["action"]))["next"]
            assert row["next", "observation"].equal(td["observation"])
            assert row["next", "reward"].item() == td["reward"].sign().item()
            if bytes_seen is not None:
                moved = (td["observation"] - first)[bytes_seen]
                torch.testing.assert_close(row["next", "displacement"], moved)
        assert not rows["next", "done"].any()
    ended = after.clone()
    ended["duration"][0], ended["terminated"][0], ended["done"][0] = 3, True, True
    cut = option_transitions(start, ended, bytes_seen)
    assert cut["next", "terminated"].flatten().tolist() == [False, False, True] + [False] * 5


def distilled(**kwargs) -> DistilledSource:
    return DistilledSource(Given(TRACKERS), samples=60, epochs=1, hidden=(8,), **kwargs)


def test_while_the_critics_warm_up_the_actor_stays_and_then_it_learns() -> None:
    before = distilled().find("Breakout", make_pool, seed=0, log=quiet)
    small = {"skill_steps": 8, "num_envs": 2, "updates_per_batch": 1}
    waiting = FineTunedSource(distilled(), base_steps=96, warm_up=0.99, **small)
    learning = FineTunedSource(distilled(), base_steps=96, warm_up=0.5, lr=1e-2, **small)
    same, other = (s.find("Breakout", make_pool, seed=0, log=quiet) for s in (waiting, learning))
    torch.testing.assert_close(same.worker.worker.weights, before.worker.worker.weights)
    assert not other.worker.worker.weights.allclose(before.worker.worker.weights, atol=1e-3)
    assert other.num_frames == before.num_frames + 4 * 96
    assert 0.0 <= other.report["fine_tuned_goal_reward"] <= 1.0
    again = load_options(other.saved)
    assert again.worker.weights.equal(other.worker.worker.weights)
    assert len(other.training.data) == 96  # those of the warm-up too


def test_what_cannot_be_trained_further_is_refused() -> None:
    with pytest.raises(TypeError, match="carried out by FollowGoals. Wrap their source"):
        FineTunedSource(Given(TRACKERS)).find("Breakout", make_pool, seed=0, log=quiet)
    network = Given(SharedMLP(2, 4))
    with pytest.raises(TypeError, match="What these options are for is not known"):
        FineTunedSource(network).find("Breakout", make_pool, seed=0, log=quiet)
    for wrong in ({"base_steps": 0}, {"warm_up": 1.0}):
        with pytest.raises(ValueError, match=f"{next(iter(wrong))}.*got"):
            FineTunedSource(network, **wrong)
    with pytest.raises(ValueError, match="rounds >= 1; got 0"):
        RetrainedSource(network, rounds=0)


@pytest.mark.parametrize("kind", ["goals", "state", "displacement"])
def test_a_worker_is_retrained_on_what_searches_simulated(kind) -> None:
    source = (
        distilled()
        if kind == "goals"
        else DIAYNSource(2, 64, skill_steps=8, num_envs=2, hidden=(8,), discriminator=kind)
    )
    before = source.find("Breakout", make_pool, seed=0, log=quiet)
    retrained = RetrainedSource(
        source, AtariSearch(ratio=2), rounds=2, round_steps=10, option_steps=5, lr=1e-2
    )
    after = retrained.find("Breakout", make_pool, seed=0, log=quiet)
    rows = after.report["rounds"]
    assert [row["real_steps"] for row in rows] == [10, 10]
    # Simulated and executed base steps; nothing ends here, so all options are whole.
    assert all(row["samples"] >= 10 and row["samples"] % 5 == 0 for row in rows)
    assert after.num_frames - before.num_frames >= 4 * sum(row["samples"] for row in rows)

    def weights(options):
        worker = options.worker
        return (worker.worker if isinstance(worker, OccasionalAction) else worker).weights

    assert not weights(before).allclose(weights(after), atol=1e-3)
    assert torch.isfinite(weights(after)).all()


def test_new_critics_learn_alone_before_a_worker_is_retrained() -> None:
    before = distilled().find("Breakout", make_pool, seed=0, log=quiet)
    waiting = RetrainedSource(
        distilled(), AtariSearch(ratio=2), rounds=1, round_steps=5, option_steps=5, warm_up=1.0
    )
    after = waiting.find("Breakout", make_pool, seed=0, log=quiet)
    torch.testing.assert_close(after.worker.worker.weights, before.worker.worker.weights)
    with pytest.raises(ValueError, match="0 <= warm_up <= 1; got 2.0"):
        RetrainedSource(distilled(), warm_up=2.0)


# ------------------------------------------------------------------------------ guide


def test_a_guide_that_has_learned_nothing_changes_no_decision() -> None:
    pool = make_pool(RepeatActions(4), 5)
    played = []
    for guide in (None, SearchGuide(4, values=True, learn_every=1000)):
        pool.set_seed(0)
        agent = AtariAgent(pool, AtariSearch(ratio=4), guide=guide, seed=0)
        played.append(agent.play(decisions=6))
    assert played[0] == played[1]


def test_a_guide_learns_which_option_was_visited_and_what_it_was_worth() -> None:
    pool = make_pool(TRACKERS, 5, seed=1)
    guide = SearchGuide(
        3, values=True, hidden=(32,), min_visits=10_000, learn_every=1, updates=150, lr=1e-2
    )
    agent = AtariAgent(pool, AtariSearch(ratio=6), seed=0)
    agent.begin()
    agent.planner.simulator.keep(["ram"])
    search = agent.planner.plant(agent.state, seed=0)
    agent.planner.resume(search)
    visits = search.tree.edges["visits"][0, 0].astype(float)
    search.tree.nodes["value"][0, 0] = 3.0  # of a scale of 6
    guide.learn(search, scale=6.0)
    root = agent.state.select("ram")
    prior = guide.evaluate(root).priors[0].detach().numpy()
    np.testing.assert_allclose(prior, 0.75 * visits / visits.sum() + 0.25 / 3, atol=0.03)
    assert guide.evaluate(root).values.item() == pytest.approx(3.0, abs=0.5)
    assert SearchGuide(3).value is None
    with pytest.raises(ValueError, match="min_visits >= 1; got 0"):
        SearchGuide(3, min_visits=0)

"""AtariOptionPool: what it has beside OptionPool, which test_option_pool.py tests."""

from __future__ import annotations

import copy
import os
import pickle
import signal
import threading
from functools import partial

import numpy as np
import pytest
import torch

pytest.importorskip("ale_py", reason="the games come with ale-py: pip install ale-py")

from torchrl.envs import ParallelEnv  # noqa: E402
from torchrl.envs.utils import check_env_specs  # noqa: E402

from torchrl_hmcts.envs import (  # noqa: E402
    AtariOptionPool,
    AtariRAMEnv,
    RepeatActions,
    SharedMLP,
)
from torchrl_hmcts.envs.gym.processes import NUM_SLOTS  # noqa: E402
from torchrl_hmcts.modules import SkillMLP  # noqa: E402
from torchrl_hmcts.planners import (  # noqa: E402
    PUCT,
    HierarchicalPolicy,
    MCTSPlanner,
    MostVisited,
    SearchBudget,
    TreeRollout,
)

OUTCOME = ["emulator_state", "ram", "reward", "duration", "lives", "done", "life_losses"]


class StopsAfterTwo(RepeatActions):
    def ends(self, ram, option, steps):
        return steps == 2


@pytest.fixture(scope="module")
def network():
    torch.manual_seed(0)
    return SkillMLP(128, out_features=4, num_skills=3, hidden=(128, 128, 128))


@pytest.fixture(scope="module")
def worker(network):
    worker = SharedMLP(3, 4)
    worker.load(network.parameters())
    return worker


@pytest.fixture(scope="module")
def pool(worker):
    """Two processes, started once for all tests."""
    pool = AtariOptionPool("Breakout", worker, max_steps=6, num_processes=2, seed=0)
    yield pool
    pool.close()


def local(worker, **keywords):
    keywords = {"max_steps": 6, "seed": 0, **keywords}
    return AtariOptionPool("Breakout", worker, num_processes=0, **keywords)


def every_option(td, pool, copies=1):
    options = torch.arange(pool.num_options).repeat(copies)
    return td.expand(len(options)).clone().set("option", options)


def test_an_option_is_what_the_env_gives_step_by_step():
    keywords = {"repeat_action_probability": 0.0, "noop_max": 0}
    pool = local(RepeatActions([1, 2]), max_steps=30, gamma=0.9, life_loss_penalty=3.0, **keywords)
    env = AtariRAMEnv("Breakout", **keywords)
    td, real = pool.reset(), env.reset()
    losses = 0
    for option in (0, 0, 1, 0):
        td = pool.step(td.set("option", torch.tensor(option)))["next"]
        reward = score = lost = 0.0
        for i in range(30):
            lives = real["lives"].item()
            real = env.step(real.set("action", torch.tensor(1 + option)))["next"]
            score += real["reward"].item()
            reward += 0.9**i * real["reward"].item()
            lost += 0.9**i * (lives - real["lives"].item())
        losses += lost > 0
        assert td["emulator_state"].equal(real["emulator_state"])
        assert td["ram"].equal(real["ram"])
        assert td["observation"].equal(real["observation"])
        assert td["lives"].equal(real["lives"])
        assert td["episode_frame"].equal(real["episode_frame"])
        assert td["duration"].item() == 30
        assert td["score"].item() == score
        assert td["life_losses"].item() == pytest.approx(lost)
        assert td["reward"].item() == pytest.approx(reward - 3.0 * lost)
    assert losses


def test_the_outcome_does_not_depend_on_the_process(pool, worker):
    here = local(worker)
    td = here.reset()
    again = local(worker).reset(td.select("emulator_state"), set_state=True)
    assert all(again[key].equal(td[key]) for key in ("ram", "lives", "episode_frame"))
    wave = every_option(td, here, copies=4)
    ours, theirs = here.step(wave.clone())["next"], pool.step(wave.clone())["next"]
    for key in OUTCOME:
        assert ours[key].equal(theirs[key]), key
    assert ours["emulator_state"][:3].equal(ours["emulator_state"][3:6])  # a function of the state


def test_specs_hold(worker):
    check_env_specs(local(worker, record=True), seed=0)


def test_the_steps_inside_an_option_are_recorded_on_request(worker):
    here = local(worker, record=True)
    td = here.step(here.reset().set("option", torch.tensor(2)))
    env = AtariRAMEnv("Breakout", repeat_action_probability=0.0)
    real = env.reset(td.exclude("next"), set_state=True)
    for i in range(6):
        assert td["next", "inner_ram"][i].equal(real["ram"])
        real = env.step(real.set("action", td["next", "inner_action"][i]))["next"]
    assert real["ram"].equal(td["next", "ram"])


def test_an_option_ends_when_the_worker_says_or_the_life_is_lost():
    here = local(StopsAfterTwo(3))
    td = here.step(here.reset().set("option", torch.tensor(0)))["next"]
    assert td["duration"].item() == 2
    here = local(RepeatActions([1]), max_steps=200, end_on_life_loss=True)
    td = here.step(here.reset().set("option", torch.tensor(0)))["next"]
    assert td["duration"].item() < 200
    assert td["lives"].item() == 4


def test_the_fast_network_is_the_torch_network(network):
    worker = SharedMLP(3, 4, deterministic=True)
    worker.load(network.parameters())
    generator = np.random.default_rng(0)
    for _ in range(50):
        ram = generator.integers(256, size=128, dtype=np.uint8)
        logits = network(torch.from_numpy(ram) / 255.0, torch.tensor(1))
        assert worker.act(ram, 1, generator) == int(logits.argmax())
        np.testing.assert_allclose(worker._logits, logits.detach().numpy(), atol=1e-5)


def test_the_fast_network_samples_from_the_softmax(network):
    worker = SharedMLP(1, 3, hidden=(4,))
    parameters = [torch.zeros(4, 128), torch.zeros(4), torch.zeros(3, 4)]
    worker.load([*parameters, torch.tensor([0.5, 0.3, 0.2]).log()])
    generator = np.random.default_rng(0)
    drawn = [worker.act(np.zeros(128, np.uint8), 0, generator) for _ in range(4000)]
    assert np.bincount(drawn) / 4000 == pytest.approx([0.5, 0.3, 0.2], abs=0.03)


@pytest.mark.parametrize("waves", [1, 2])
def test_killed_processes_do_not_change_a_search(pool, worker, waves):
    planner = MCTSPlanner(
        pool,
        tree_policy=PUCT(),
        backup="max",
        expand="one",
        leaves_per_wave=6,
        waves_in_flight=waves,
        budget=SearchBudget(base_steps=600, until_plan=False),
    )
    td = pool.reset()
    undisturbed = planner.search(td.clone(), seed=1)
    restarts, frames = pool.num_restarts, pool.num_frames
    timer = threading.Timer(0.05, lambda: os.kill(pool.pids[0], signal.SIGKILL))
    timer.start()
    disturbed = planner.search(td.clone(), seed=1)
    timer.join()
    if pool.num_restarts == restarts:  # it was killed after the last wave: the next one notices
        pool.step(every_option(td, pool))
    assert pool.num_restarts == restarts + 1
    assert pool.num_frames - frames >= 4 * int(disturbed.num_base_steps.sum())
    count = int(undisturbed.tree.num_nodes[0])
    for field in ("visits", "value", "reward", "parent", "option"):
        left, right = undisturbed.tree.nodes[field], disturbed.tree.nodes[field]
        assert (left[0, :count] == right[0, :count]).all(), field


def test_planners_whose_waves_fill_the_room_search_all_the_same(worker):
    here = local(worker, max_steps=1, frame_skip=1)
    budget = SearchBudget(expansions=2, until_plan=False)
    planner = MCTSPlanner(here, expand="all", waves_in_flight=3, budget=budget)
    search = planner.search(here.reset().expand(300).clone())
    assert (search.num_simulations >= 6).all()
    assert sorted(here._free) == list(range(NUM_SLOTS))


@pytest.mark.parametrize("waves", [1, 3])
def test_a_search_is_the_same_on_processes_and_without(pool, worker, waves):
    trees = []
    for simulator in (pool, local(worker)):
        planner = MCTSPlanner(
            simulator,
            tree_policy=PUCT(normalize="tree"),
            expand="one",
            rollout=TreeRollout(3),
            leaves_per_wave=2,
            waves_in_flight=waves,
            budget=SearchBudget(base_steps=400, until_plan=False),
        )
        search = planner.search(local(worker).reset(), seed=1)
        count = int(search.tree.num_nodes[0])
        states = search.tree.states["emulator_state"][0, :count]
        trees.append((search.tree.nodes[0, :count].tobytes(), states.numpy().tobytes()))
        assert count > 60
    assert trees[0] == trees[1]


def test_what_was_planned_is_what_happens_and_subtrees_are_reused(worker):
    here = local(worker)
    planner = MCTSPlanner(
        here,
        tree_policy=PUCT(),
        expand="one",
        leaves_per_wave=4,
        final_choice=MostVisited(),
        budget=SearchBudget(base_steps=120, until_plan=False),
        seed=0,
    )
    td = here.reset()
    search = planner.search(td)
    option = torch.tensor(int(planner.choose(search)[0]))
    after = here.step(td.set("option", option))["next"]
    assert planner.advance(search, option, after)
    assert int(search.tree.num_nodes[0]) > 1
    policy = HierarchicalPolicy(planner, replan_every=1, reuse=True)
    assert here.rollout(3, policy=policy)["next", "duration"].flatten().tolist() == [6, 6, 6]


def test_sticky_actions_in_options_are_drawn_from_the_seed(worker):
    ends = []
    for seed in (0, 0, 1):
        here = local(worker, repeat_action_probability=0.5, max_steps=20, seed=seed)
        td = here.reset(local(worker).reset(), set_state=True)
        td.set("option", torch.tensor(1))
        ends.append(here.step(td.clone())["next", "ram"])
        here.step(every_option(td, here))  # whatever is done in between
        assert here.step(td.clone())["next", "ram"].equal(ends[-1])
    assert ends[0].equal(ends[1])
    assert not ends[0].equal(ends[2])


def test_without_determinising_every_call_draws_anew(worker):
    here = local(worker, determinised=False, max_steps=20)
    td = every_option(here.reset(), here, copies=3)
    rams = here.step(td)["next", "ram"]
    assert not (rams[0].equal(rams[3]) and rams[0].equal(rams[6]))


def test_a_hundred_thousand_nodes_fit_in_two_hundred_megabytes():
    from torchrl_hmcts.planners.tree import EDGE, NODE

    pool = AtariOptionPool("Seaquest", RepeatActions(18), max_steps=1, num_processes=0, seed=0)
    per_node = pool.state_spec["emulator_state"].shape[-1] + NODE.itemsize + 18 * EDGE.itemsize
    assert 100_000 * per_node < 200e6 / 1.5  # room for a tree that grows by doubling


@pytest.mark.parametrize(
    ("keywords", "message"),
    [
        ({"max_steps": 0}, "max_steps >= 1; got 0"),
        ({"gamma": 0.0}, "gamma"),
        ({"worker": RepeatActions(9)}, "took the action 4 in option 4; Breakout has the actions"),
        ({"worker": object()}, "num_options"),
    ],
)
def test_arguments_out_of_range_are_refused_at_construction(keywords, message):
    keywords = {"worker": RepeatActions(2), "max_steps": 3, **keywords}
    with pytest.raises(ValueError, match=message):
        AtariOptionPool("Breakout", keywords.pop("worker"), num_processes=0, **keywords)


def test_a_network_of_other_shapes_is_refused():
    with pytest.raises(ValueError, match="parameters of the shapes"):
        SharedMLP(2, 4).load(SkillMLP(128, 4, 3, hidden=(128, 128, 128)).parameters())


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda x: pickle.loads(pickle.dumps(x))])
def test_a_copy_of_a_pool_steps_as_the_pool(copied) -> None:
    pool = AtariOptionPool("Breakout", RepeatActions(4), max_steps=5, num_processes=0, seed=0)
    td = pool.reset().set("option", torch.tensor(1))
    want = pool.step(td.clone())["next", "emulator_state"]
    assert copied(pool).step(td.clone())["next", "emulator_state"].equal(want)


@pytest.mark.slow
def test_a_worker_of_a_parallel_env_may_have_a_pool() -> None:
    make = partial(AtariOptionPool, "Pong", RepeatActions(2), max_steps=3, num_processes=2, seed=0)
    envs = ParallelEnv(2, make, mp_start_method="fork")
    try:
        assert envs.rollout(2)["next", "duration"].flatten().tolist() == [3] * 4
    finally:
        envs.close()

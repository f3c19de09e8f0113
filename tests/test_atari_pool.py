"""AtariOptionPool: outcomes of options, whatever process finds them and whichever dies."""

from __future__ import annotations

import copy
import multiprocessing
import os
import pickle
import signal
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
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
    MaxBackup,
    MCTSPlanner,
    MostVisited,
    SearchBudget,
    TreeRollout,
)

OUTCOME = ["emulator_state", "ram", "reward", "duration", "lives", "done", "life_losses"]


class Kills:
    """Kills its own process while a file exists: what a crash of the emulator does."""

    num_options = 2

    def __init__(self, path, once):
        self.path, self.once, self.owner = str(path), once, os.getpid()

    def act(self, ram, option, generator):
        if option == 1 and os.getpid() != self.owner and os.path.exists(self.path):
            if self.once:
                os.remove(self.path)
            os.kill(os.getpid(), signal.SIGKILL)
        return 1 + option


class Fails:
    num_options = 1

    def act(self, ram, option, generator):
        if os.getpid() != self.owner:
            raise KeyError("no such feature")
        return 0

    def __init__(self):
        self.owner = os.getpid()


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


def test_waves_larger_than_the_shared_memory_and_any_batch_shape_are_run(worker):
    here = local(worker, max_steps=1, frame_skip=1)
    td = every_option(here.reset(), here, copies=200)
    assert len(td) == 600 > NUM_SLOTS
    flat = here.step(td.clone())["next"]
    three = here.step(td[:3].clone())["next"]
    assert flat["ram"].equal(three["ram"].repeat(200, 1))
    shaped = here.step(td.reshape(3, 20, 10))["next"]
    assert shaped["ram"].shape == (3, 20, 10, 128)
    assert shaped["emulator_state"].reshape(600, -1).equal(flat["emulator_state"])


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


def test_new_weights_are_used_by_the_running_processes(network):
    worker = SharedMLP(3, 4, deterministic=True)
    pool = AtariOptionPool("Breakout", worker, max_steps=20, num_processes=1, seed=0)
    td = pool.reset().set("option", torch.tensor(0))
    before = pool.step(td.clone())["next", "ram"]  # of zeros: action 0
    pids = pool.pids
    with torch.no_grad():
        chosen = [p.clone().zero_() for p in network.parameters()]
        chosen[-1][2] = 1.0  # option 0 goes to the right
    worker.load(chosen)
    after = pool.step(td.clone())["next", "ram"]
    assert pool.pids == pids
    pool.close()
    assert not after.equal(before)
    here = local(RepeatActions([2]), max_steps=20)
    td = here.step(here.reset(td, set_state=True).set("option", torch.tensor(0)))
    assert after.equal(td["next", "ram"])


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


def test_an_option_is_run_again_when_its_process_crashes(tmp_path):
    (tmp_path / "armed").touch()
    worker = Kills(tmp_path / "armed", once=True)
    pool = AtariOptionPool("Breakout", worker, max_steps=5, num_processes=2, seed=0)
    td = every_option(pool.reset(), pool, copies=3)
    after = pool.step(td.clone())["next"]
    assert pool.num_restarts == 1
    expected = local(worker, max_steps=5).step(td.clone())["next"]
    assert after["emulator_state"].equal(expected["emulator_state"])
    assert pool.num_frames >= 6 * 20
    pool.close()


def test_processes_that_die_again_and_again_are_an_error(tmp_path):
    (tmp_path / "armed").touch()
    worker = Kills(tmp_path / "armed", once=False)
    pool = AtariOptionPool("Breakout", worker, max_steps=5, num_processes=1, seed=0)
    with pytest.raises(RuntimeError, match=r"exit codes \[-9\]"):
        pool.step(pool.reset().set("option", torch.tensor(1)))
    assert pool.pids == []


@pytest.mark.parametrize("waves", [1, 2])
def test_killed_processes_do_not_change_a_search(pool, worker, waves):
    planner = MCTSPlanner(
        pool,
        tree_policy=PUCT(),
        backup=MaxBackup(),
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


def test_steps_under_way_at_the_same_time_do_not_touch_each_other(pool, worker):
    here = local(worker)
    td = here.reset()
    batches = [every_option(td, pool, copies=k) for k in (1, 3, 2)]
    for batch in batches:
        batch["option"] = batch["option"].flip(0)
    for order in ((0, 1, 2), (2, 0, 1)):
        tickets = [pool.step_async(batch.clone()) for batch in batches]
        assert pool.step(batches[0].clone())["next", "ram"].shape[0] == 3  # and others besides
        for i in order:
            after, expected = pool.step_wait(tickets[i]), here.step(batches[i].clone())["next"]
            for key in OUTCOME:
                assert after[key].equal(expected[key]), (order, i, key)


def test_a_ticket_counts_once_and_one_that_is_given_up_frees_its_room(pool):
    td = every_option(pool.reset(), pool)
    ticket = pool.step_async(td.clone())
    pool.step_wait(ticket)
    with pytest.raises(RuntimeError, match=r"waited for before.*step_async again"):
        pool.step_wait(ticket)
    pool.step_abandon(ticket)
    for _ in range(NUM_SLOTS):  # three options each
        pool.step_abandon(pool.step_async(td.clone()))
    assert sorted(pool._free) == list(range(NUM_SLOTS))


def test_when_all_room_is_taken_the_oldest_steps_are_waited_for(pool, worker):
    td = every_option(pool.reset(), pool)
    expected = local(worker).step(td.clone())["next", "ram"]
    dropped = pool.step_async(td.clone())  # which nobody waits for
    large = pool.step_async(td.repeat(NUM_SLOTS // 3).clone())
    small = [pool.step_async(td.clone()) for _ in range(4)]
    assert len(pool._free) + sum(len(t.slots) for t in (large, *small)) == NUM_SLOTS
    assert not dropped.slots
    for ticket in small:
        assert pool.step_wait(ticket)["ram"].equal(expected)
    assert pool.step_wait(large)["ram"].equal(expected.repeat(NUM_SLOTS // 3, 1))
    pool.step_abandon(dropped)
    assert sorted(pool._free) == list(range(NUM_SLOTS))


def test_planners_whose_waves_fill_the_room_search_all_the_same(worker):
    here = local(worker, max_steps=1, frame_skip=1)
    budget = SearchBudget(expansions=2, until_plan=False)
    planner = MCTSPlanner(here, expand="all", waves_in_flight=3, budget=budget)
    search = planner.search(here.reset().expand(300).clone())
    assert (search.num_simulations >= 6).all()
    assert sorted(here._free) == list(range(NUM_SLOTS))


def test_a_ticket_is_of_one_pool_and_cannot_be_copied(pool, worker):
    here = local(worker)
    ticket = here.step_async(every_option(here.reset(), here))
    with pytest.raises(ValueError, match="another pool"):
        pool.step_wait(ticket)
    with pytest.raises(TypeError, match="neither copied nor sent"):
        copy.deepcopy(ticket)
    pool.step_abandon(ticket)
    assert here.step_wait(ticket)["ram"].shape == (3, 128)


def test_a_state_of_another_width_costs_no_room(worker):
    here = local(worker)
    td = every_option(here.reset(), here)
    td["emulator_state"] = td["emulator_state"][:, :-1]
    with pytest.raises(ValueError, match=r"has \[\d+\] numbers; got \[\d+\]"):
        here.step(td)
    assert sorted(here._free) == list(range(NUM_SLOTS))


def test_a_crash_while_steps_are_under_way_loses_none_of_them(tmp_path):
    (tmp_path / "armed").touch()
    worker = Kills(tmp_path / "armed", once=True)
    pool = AtariOptionPool("Breakout", worker, max_steps=5, num_processes=2, seed=0)
    td = every_option(pool.reset(), pool, copies=2)
    tickets = [pool.step_async(td.clone()) for _ in range(3)]
    expected = local(worker, max_steps=5).step(td.clone())["next"]
    for ticket in reversed(tickets):
        assert pool.step_wait(ticket)["emulator_state"].equal(expected["emulator_state"])
    assert pool.num_restarts == 1
    pool.close()


def test_steps_under_way_when_the_processes_stop_have_no_outcome():
    pool = AtariOptionPool("Breakout", RepeatActions(2), max_steps=400, num_processes=1, seed=0)
    td = every_option(pool.reset(), pool)
    ticket = pool.step_async(td.clone())
    pool._processes.stop()
    with pytest.raises(RuntimeError, match=r"stopped while this step was under way.*step again"):
        pool.step_wait(ticket)
    abandoned = pool.step_async(td.clone())
    pool._processes.stop()
    pool.step_abandon(abandoned)  # no error: nobody asks for the outcome
    pool._free.sort()  # the same slots again
    assert pool.step(td.clone())["next", "duration"][0].item() == 400
    pool.close()


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


def test_the_planner_discounts_as_the_options_do(worker):
    assert MCTSPlanner(local(worker, gamma=0.9)).gamma == 0.9


def test_an_error_of_the_worker_where_it_is_called_costs_no_room():
    worker = Fails()
    here = local(worker)
    worker.owner = None
    td = every_option(here.reset(), here)
    for _ in range(NUM_SLOTS + 1):
        with pytest.raises(KeyError, match="no such feature"):
            here.step(td.clone())
    worker.owner = os.getpid()
    assert here.step(td.clone())["next", "duration"].item() == 6


def test_an_error_of_the_worker_is_raised_with_its_traceback():
    pool = AtariOptionPool("Breakout", Fails(), max_steps=2, num_processes=1, seed=0)
    with pytest.raises(RuntimeError, match="no such feature"):
        pool.step(pool.reset().set("option", torch.tensor(0)))
    assert pool.pids == []


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
        ({"start_method": "fork"}, "would inherit"),
        ({"worker": RepeatActions(9)}, "took the action 4 in option 4; Breakout has the actions"),
        ({"worker": object()}, "num_options"),
    ],
)
def test_arguments_out_of_range_are_refused_at_construction(keywords, message):
    keywords = {"worker": RepeatActions(2), "max_steps": 3, **keywords}
    with pytest.raises(ValueError, match=message):
        AtariOptionPool("Breakout", keywords.pop("worker"), num_processes=0, **keywords)


def test_an_option_that_does_not_exist_is_refused(worker):
    here = local(worker)
    with pytest.raises(ValueError, match="Option 3 does not exist"):
        here.step(here.reset().set("option", torch.tensor(3)))


def test_a_network_of_other_shapes_is_refused():
    with pytest.raises(ValueError, match="parameters of the shapes"):
        SharedMLP(2, 4).load(SkillMLP(128, 4, 3, hidden=(128, 128, 128)).parameters())


@pytest.mark.skipif(sys.platform != "linux", reason="stops a process")
def test_a_stopped_process_is_replaced_and_the_outcome_is_the_same() -> None:
    pool = AtariOptionPool(
        "Breakout", RepeatActions(4), max_steps=20, num_processes=1, seed=0, step_seconds=1.0
    )
    td = pool.reset().set("option", torch.tensor(1))
    want = pool.step(td.clone())["next"]
    (stopped,) = pool.pids
    os.kill(stopped, signal.SIGSTOP)
    begin = time.monotonic()
    got = pool.step(td.clone())["next"]
    assert time.monotonic() - begin < 30.0
    assert got["emulator_state"].equal(want["emulator_state"])
    assert pool.num_restarts == 1
    assert stopped not in pool.pids
    pool.close()


class Sleeps:
    """A worker whose steps never end in a process of a pool."""

    num_options = 1

    def act(self, ram, option, generator):
        if multiprocessing.parent_process() is not None:
            time.sleep(1e6)
        return 0


def test_processes_that_hang_again_and_again_are_an_error_that_names_step_seconds() -> None:
    pool = AtariOptionPool("Pong", Sleeps(), max_steps=2, num_processes=1, seed=0, step_seconds=2.0)
    with pytest.raises(RuntimeError, match="took no step for 2 s, 2 times .* step_seconds"):
        pool.rollout(1)
    pool.close()


def test_threads_that_share_a_pool_get_what_they_would_in_turn() -> None:
    pool = AtariOptionPool("Breakout", RepeatActions(4), max_steps=5, num_processes=2, seed=0)
    roots = pool.reset().expand(4).clone().set("option", torch.arange(4))
    want = pool.step(roots.clone())["next", "emulator_state"]
    with ThreadPoolExecutor(4) as threads:
        for got in threads.map(lambda _: pool.step(roots.clone()), range(8)):
            assert got["next", "emulator_state"].equal(want)
    pool.close()


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda x: pickle.loads(pickle.dumps(x))])
def test_a_copy_of_a_pool_steps_as_the_pool(copied) -> None:
    pool = AtariOptionPool("Breakout", RepeatActions(4), max_steps=5, num_processes=0, seed=0)
    td = pool.reset().set("option", torch.tensor(1))
    want = pool.step(td.clone())["next", "emulator_state"]
    assert copied(pool).step(td.clone())["next", "emulator_state"].equal(want)


@pytest.mark.skipif(not hasattr(os, "fork"), reason="forks")
def test_a_forked_process_steps_without_the_processes_of_its_parent() -> None:
    pool = AtariOptionPool("Breakout", RepeatActions(4), max_steps=5, num_processes=1, seed=0)
    td = pool.reset().set("option", torch.tensor(1))
    want = pool.step(td.clone())["next", "emulator_state"]
    child = os.fork()
    if child == 0:
        same = pool.step(td.clone())["next", "emulator_state"].equal(want)
        os._exit(0 if same and not pool.pids else 1)
    assert os.waitpid(child, 0)[1] == 0
    assert pool.step(td.clone())["next", "emulator_state"].equal(want)
    pool.close()


@pytest.mark.slow
def test_a_worker_of_a_parallel_env_may_have_a_pool() -> None:
    make = partial(AtariOptionPool, "Pong", RepeatActions(2), max_steps=3, num_processes=2, seed=0)
    envs = ParallelEnv(2, make, mp_start_method="fork")
    try:
        assert envs.rollout(2)["next", "duration"].flatten().tolist() == [3] * 4
    finally:
        envs.close()

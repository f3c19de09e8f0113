"""OptionPool: outcomes of options, whatever process finds them and whichever dies or hangs."""

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
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from tensordict.nn import NormalParamExtractor, TensorDictModule, TensorDictSequential
from torch import Tensor, nn
from torchrl.data import Bounded, Categorical
from torchrl.modules import GRUModule

from torchrl_hmcts.envs import (
    OptionPool,
    PolicyWorker,
    RepeatActions,
    ReplaySnapshot,
    SettableGymEnv,
    SkillWorker,
)
from torchrl_hmcts.envs.gym import processes
from torchrl_hmcts.envs.gym.processes import NUM_SLOTS
from torchrl_hmcts.modules import ConcatSkillMLP, SkillActor, SkillPolicy
from torchrl_hmcts.planners import MCTSPlanner, ProgressiveWidening, SearchBudget
from torchrl_hmcts.testing import check_macro_env

OUTCOME = ["observation", "snapshot", "reward", "duration", "done", "terminated"]


def leaning(**keywords: Any) -> SkillActor:
    torch.manual_seed(0)
    return SkillActor(4, Categorical(2), 3, in_keys=["observation"], hidden=(8,), **keywords)


def local(worker: Any = None, env: Any = "CartPole-v1", **keywords: Any) -> OptionPool:
    keywords = {"max_steps": 5, "num_processes": 0, "seed": 0, **keywords}
    return OptionPool(env, RepeatActions(2) if worker is None else worker, **keywords)


def every_option(pool: OptionPool, copies: int = 1) -> Any:
    options = torch.arange(pool.num_options).repeat(copies)
    return pool.reset().expand(len(options)).clone().set("option", options)


@pytest.fixture(scope="module")
def worker() -> SkillWorker:
    """Draws its actions."""
    return SkillWorker(leaning())


@pytest.fixture(scope="module")
def pool(worker: SkillWorker) -> Any:
    """Two processes, started once for all tests."""
    pool = OptionPool("CartPole-v1", worker, max_steps=5, num_processes=2, seed=0)
    yield pool
    pool.close()


@pytest.mark.parametrize(
    ("name", "package"),
    [("CartPole-v1", None), ("FrozenLake-v1", None), ("PointMaze_UMaze-v3", "gymnasium_robotics")],
)
def test_an_option_is_what_the_env_gives_step_by_step(name: str, package: str | None) -> None:
    if package:
        pytest.importorskip(package, exc_type=ImportError)
    env = SettableGymEnv(name, seed=3)
    space = env._env.action_space
    space.seed(0)
    actions = [space.sample() for _ in range(2)]
    pool = local(RepeatActions(actions), name, gamma=0.9)
    td = env.reset()  # whose state is one of the pool, too
    for option in (0, 1, 1):
        after = pool.step(td.select(*pool.state_spec.keys(True)).set("option", option))["next"]
        reward, duration = 0.0, 0
        while duration < 5:
            td = env.step(td.set("action", torch.as_tensor(actions[option])))["next"]
            reward += 0.9**duration * td["reward"].item()
            duration += 1
            if td["done"]:
                break
        for key in env.observation_spec.keys(True, True):
            if key != "snapshot":
                assert after[key].equal(td[key]), key
        assert after["reward"].item() == pytest.approx(reward)
        assert after["duration"].item() == duration
        assert after["done"].equal(td["done"])
        if td["done"]:
            break
        td = td.exclude("reward")
    assert pool.num_steps > 0


def test_a_state_that_is_reached_by_replaying_gives_the_same_outcome() -> None:
    draws, pools = torch.Generator().manual_seed(0), [local(), local(snapshot=ReplaySnapshot)]
    states = [pool.reset() for pool in pools]
    for _ in range(3):
        option = torch.randint(2, (), generator=draws)
        states = [
            p.step(td.set("option", option))["next"] for p, td in zip(pools, states, strict=True)
        ]
        for key in ("observation", "reward", "duration", "done"):
            assert states[0][key].equal(states[1][key])
        states = [td.exclude("reward") for td in states]
    again = pools[1].reset(states[1].exclude("option"), set_state=True)
    assert again["observation"].equal(states[0]["observation"])


def test_an_option_ends_at_the_time_limit_of_its_episode() -> None:
    pool = local(max_episode_steps=7)
    td = pool.rollout(2, policy=lambda td: td.set("option", torch.tensor(0)))
    assert td["next", "duration"].flatten().tolist() == [5, 2]
    assert td["next", "truncated"].flatten().tolist() == [False, True]


def test_it_keeps_the_contract_of_a_macro_env() -> None:
    check_macro_env(local(max_steps=3), num_steps=5)


def test_the_outcome_does_not_depend_on_the_process(pool: OptionPool, worker: SkillWorker) -> None:
    here = local(worker)
    wave = every_option(here, copies=4)
    ours, theirs = here.step(wave.clone())["next"], pool.step(wave.clone())["next"]
    for key in OUTCOME:
        assert ours[key].equal(theirs[key]), key
    assert ours["observation"][:3].equal(ours["observation"][3:6])  # a function of the state


@pytest.mark.parametrize("waves", [1, 3])
def test_a_search_is_the_same_on_processes_that_die_and_without(
    pool: OptionPool, worker: SkillWorker, waves: int
) -> None:
    trees = []
    for simulator, killing in ((local(worker), False), (pool, False), (pool, True)):
        planner = MCTSPlanner(
            simulator,
            expand="one",
            leaves_per_wave=6,
            waves_in_flight=waves,
            budget=SearchBudget(base_steps=600, until_plan=False),
        )
        timer = threading.Timer(0.02, lambda: os.kill(pool.pids[0], signal.SIGKILL))
        if killing:
            timer.start()
        search = planner.search(local(worker).reset(), seed=1)
        if killing:
            timer.join()
            for _ in range(1000):  # notices one that was killed after the last wave
                pool.step(every_option(pool))
                if pool.num_restarts:
                    break
        count = int(search.tree.num_nodes[0])
        assert count > 30
        trees.append(search.tree.nodes[0, :count].tobytes())
    assert trees[0] == trees[1] == trees[2]
    assert pool.num_restarts


def test_large_waves_and_any_batch_shape_are_run() -> None:
    here = local(max_steps=1)
    td = every_option(here, copies=300)
    assert len(td) > NUM_SLOTS
    flat = here.step(td.clone())["next", "observation"]
    assert flat.equal(here.step(td[:2].clone())["next", "observation"].repeat(300, 1))
    assert here.step(td.reshape(3, 20, 10))["next", "observation"].reshape(600, 4).equal(flat)


def test_steps_under_way_at_the_same_time_do_not_touch_each_other(
    pool: OptionPool, worker: SkillWorker
) -> None:
    here = local(worker)
    batches = [every_option(here, copies=k) for k in (1, 3, 2)]
    for order in ((0, 1, 2), (2, 0, 1)):
        tickets = [pool.step_async(batch.clone()) for batch in batches]
        for i in order:
            after, expected = pool.step_wait(tickets[i]), here.step(batches[i].clone())["next"]
            assert all(after[key].equal(expected[key]) for key in OUTCOME)


def test_a_ticket_is_of_one_pool_counts_once_and_frees_its_room(pool: OptionPool) -> None:
    td = every_option(pool)
    ticket = pool.step_async(td.clone())
    with pytest.raises(ValueError, match="another pool"):
        local().step_wait(ticket)
    with pytest.raises(TypeError, match="neither copied nor sent"):
        copy.deepcopy(ticket)
    pool.step_wait(ticket)
    with pytest.raises(RuntimeError, match=r"returned or dropped before.*step_async"):
        pool.step_wait(ticket)
    pool.step_abandon(ticket)
    for _ in range(NUM_SLOTS // 2):  # three options each
        pool.step_abandon(pool.step_async(td.clone()))
    assert sorted(pool._free) == list(range(NUM_SLOTS))


def test_when_all_room_is_taken_the_oldest_steps_are_waited_for(pool: OptionPool) -> None:
    td = every_option(pool)
    expected = pool.step(td.clone())["next", "observation"]
    dropped = pool.step_async(td.clone())  # which nobody waits for
    large = pool.step_async(td.repeat(NUM_SLOTS // 3).clone())
    small = [pool.step_async(td.clone()) for _ in range(4)]
    assert not dropped.slots
    assert len(pool._free) + sum(len(t.slots) for t in (large, *small)) == NUM_SLOTS
    assert all(pool.step_wait(ticket)["observation"].equal(expected) for ticket in small)
    assert pool.step_wait(large)["observation"].equal(expected.repeat(NUM_SLOTS // 3, 1))
    pool.step_abandon(dropped)
    assert sorted(pool._free) == list(range(NUM_SLOTS))


class Kills(RepeatActions):
    """Kills its own process while a file exists: what a crash of the env does."""

    def __init__(self, path: Path, once: bool) -> None:
        super().__init__(2)
        self.path, self.once = str(path), once

    def act(self, observation: Any, option: int, generator: Any) -> int:
        inside = multiprocessing.parent_process() is not None
        if option == 1 and inside and os.path.exists(self.path):
            if self.once:
                os.remove(self.path)
            os.kill(os.getpid(), signal.SIGKILL)
        return option


def test_a_crash_while_steps_are_under_way_loses_none_of_them(tmp_path: Path) -> None:
    (tmp_path / "armed").touch()
    worker = Kills(tmp_path / "armed", once=True)
    pool = local(worker, num_processes=2)
    td = every_option(pool, copies=2)
    tickets = [pool.step_async(td.clone()) for _ in range(3)]
    expected = local(worker).step(td.clone())["next", "observation"]
    for ticket in reversed(tickets):
        assert pool.step_wait(ticket)["observation"].equal(expected)
    assert pool.num_restarts == 1
    ticket = pool.step_async(td.clone())
    pool._processes.stop()
    with pytest.raises(RuntimeError, match=r"stopped while this step was under way.*step again"):
        pool.step_wait(ticket)
    assert pool.step(td.clone())["next", "observation"].equal(expected)
    pool.close()


def test_processes_that_die_again_and_again_are_an_error(tmp_path: Path) -> None:
    (tmp_path / "armed").touch()
    pool = local(Kills(tmp_path / "armed", once=False), num_processes=1)
    with pytest.raises(RuntimeError, match=r"exit codes \[-9\]"):
        pool.step(pool.reset().set("option", torch.tensor(1)))
    assert pool.pids == []


class Waits(RepeatActions):
    """Sleeps or computes for ever in a process of a pool."""

    def __init__(self, computes: bool) -> None:
        super().__init__(2)
        self.computes = computes

    def act(self, observation: Any, option: int, generator: Any) -> int:
        while multiprocessing.parent_process() is not None:
            if not self.computes:
                time.sleep(1e6)
        return option


@pytest.mark.parametrize("computes", [False, True])
def test_processes_that_hang_again_and_again_are_an_error_that_names_step_seconds(
    computes: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(processes, "_STALLS", 1)
    monkeypatch.setattr(processes, "_LEAST_STALL", 3.0)
    pool = local(Waits(computes), num_processes=1, step_seconds=3.0)
    with pytest.raises(RuntimeError, match="took no step for 3 s, 2 times .* step_seconds"):
        pool.rollout(1)
    pool.close()


@pytest.mark.skipif(sys.platform != "linux", reason="stops a process")
def test_a_stopped_process_is_replaced_and_the_outcome_is_the_same() -> None:
    pool = local(num_processes=1, step_seconds=1.0)
    td = every_option(pool)
    want = pool.step(td.clone())["next", "observation"]
    (stopped,) = pool.pids
    os.kill(stopped, signal.SIGSTOP)
    assert pool.step(td.clone())["next", "observation"].equal(want)
    assert pool.num_restarts == 1
    assert stopped not in pool.pids
    pool.close()


class Fails(RepeatActions):
    def act(self, observation: Any, option: int, generator: Any) -> int:
        if multiprocessing.parent_process() is not None or observation[0] > 99:
            raise KeyError("no such feature")
        return option


def test_an_error_of_the_worker_is_raised_and_costs_no_room() -> None:
    pool = local(Fails(2), num_processes=1)
    with pytest.raises(RuntimeError, match="no such feature"):
        pool.rollout(1)
    assert pool.pids == []
    here = local(Fails(2))
    td = every_option(here)
    wrong = td.clone().set("observation", td["observation"] + 100)
    for _ in range(NUM_SLOTS):
        with pytest.raises(KeyError, match="no such feature"):
            here.step(wrong.clone())
    assert here.step(td)["next", "duration"].tolist() == [[5], [5]]


class Tires(RepeatActions):
    def act(self, observation: Any, option: int, generator: Any) -> int:
        return option if abs(observation[1]) < 0.5 else 9  # once the cart is fast


def test_a_wrong_action_in_the_middle_of_an_option_is_told_with_the_right_ones() -> None:
    with pytest.raises(ValueError, match=r"Tires took the action 9 in option \d; .* Discrete\(2\)"):
        local(Tires(2)).rollout(3)


def test_threads_copies_and_forks_step_as_the_pool(pool: OptionPool) -> None:
    roots = every_option(pool)
    want = pool.step(roots.clone())["next", "observation"]

    def same(other: OptionPool) -> bool:
        return bool(other.step(roots.clone())["next", "observation"].equal(want))

    with ThreadPoolExecutor(4) as threads:
        assert all(threads.map(same, [pool] * 8))
    here = local(pool.worker)
    assert same(copy.deepcopy(here))
    assert same(pickle.loads(pickle.dumps(here)))
    if hasattr(os, "fork"):
        child = os.fork()
        if child == 0:
            os._exit(0 if same(pool) and not pool.pids else 1)
        assert os.waitpid(child, 0)[1] == 0
    assert same(pool)


def test_every_call_draws_anew_without_determinising() -> None:
    """The dice of the ice are in the state: with them a plan would know where it slips."""
    ends = {}
    for determinised in (True, False):
        here = local(RepeatActions(4), "FrozenLake-v1", determinised=determinised, max_steps=3)
        td = here.reset().set("option", torch.tensor(2)).expand(20).clone()
        ends[determinised] = len(here.step(td)["next", "observation"].unique())
    assert ends[True] == 1 < ends[False]
    here = local(RepeatActions(4), "FrozenLake-v1", determinised=False, max_steps=3)
    budget = SearchBudget(base_steps=200, until_plan=False)
    search = MCTSPlanner(here, chance=ProgressiveWidening(), budget=budget).search(here.reset())
    assert int(search.tree.num_nodes[0]) > 5


# ------------------------------------------------------------------ workers


@pytest.mark.parametrize("case", ["plain", "concatenated", "tanh", "gaussian"])
def test_a_skill_worker_acts_as_its_actor(case: str) -> None:
    if case == "gaussian":
        spec = Bounded(torch.tensor([-1.0, 0.0]), torch.tensor([1.0, 3.0]))
        torch.manual_seed(0)
        actor: Any = SkillActor(4, spec, 3, in_keys=["observation"], hidden=(8,))
    else:
        settings = {"concatenated": {"network": ConcatSkillMLP}, "tanh": {"activation": nn.Tanh}}
        actor = leaning(**settings.get(case, {}))
    worker = pickle.loads(pickle.dumps(SkillWorker(actor, deterministic=True)))
    policy = SkillPolicy(actor, deterministic=True)
    draws = np.random.default_rng(0)
    for _ in range(20):
        x, skill = draws.normal(size=4), int(draws.integers(3))
        td = local().reset().update({"observation": torch.tensor(x).float()})
        want = policy(td.set("skill", torch.tensor(skill)))["action"].numpy()
        np.testing.assert_allclose(worker.act(x, skill, draws), want, atol=1e-5)


def test_a_skill_worker_draws_from_the_policy_of_its_actor() -> None:
    actor = leaning()
    x = np.array([0.1, -0.2, 0.3, 0.4], np.float32)
    shares = actor.network(torch.from_numpy(x), torch.tensor(1)).softmax(-1)
    draws, worker = np.random.default_rng(0), SkillWorker(actor)
    drawn = np.mean([worker.act(x, 1, draws) for _ in range(4000)])
    assert drawn == pytest.approx(shares[1].item(), abs=0.03)
    torch.manual_seed(0)
    gaussian = SkillActor(4, Bounded(-1, 1, (1,)), 2, in_keys=["observation"], hidden=(8,))
    worker = SkillWorker(gaussian)
    actions = np.array([worker.act(x, 1, draws) for _ in range(4000)])
    outputs = gaussian.network(torch.from_numpy(x), torch.tensor(1))
    loc, scale = (part.item() for part in NormalParamExtractor()(outputs))
    assert np.arctanh(actions).mean() == pytest.approx(loc, abs=0.05)
    assert np.arctanh(actions).std() == pytest.approx(scale, rel=0.05)


def torque(features: Tensor, skill: Tensor) -> Tensor:
    return (features[..., :1] + skill).tanh()


def test_a_recurrent_policy_remembers_its_option_in_any_process() -> None:
    torch.manual_seed(0)
    keys = ["observation", "memory", "is_init"]
    memory = GRUModule(3, 8, in_keys=keys, out_keys=["features", ("next", "memory")])
    policy = TensorDictSequential(
        memory, TensorDictModule(torque, ["features", "skill"], ["action"])
    )
    worker, draws = PolicyWorker(policy, 2), np.random.default_rng(0)
    seen = torch.randn(4, 3)
    for _ in range(2):  # options
        worker.begin(seen[0].numpy(), 1)
        hidden = torch.zeros(1, 1, 8)
        for x in seen:
            features, hidden = memory.gru(x.view(1, 1, 3), hidden)
            wanted = torque(features.flatten(), torch.tensor(1)).detach()
            acts = worker.act(x.double().numpy(), 1, draws)
            np.testing.assert_allclose(acts, wanted, atol=1e-6)
    alone, other = (local(worker, "Pendulum-v1", num_processes=n) for n in (0, 1))
    start = every_option(alone)
    here, there = (pool.step(start.clone())["next"] for pool in (alone, other))
    assert all(here[key].equal(there[key]) for key in OUTCOME)
    with torch.no_grad():
        policy[0].gru.bias_ih_l0.add_(1.0)
    worker.load(policy)
    assert not other.step(start.clone())["next", "observation"].equal(there["observation"])
    other.close()


def test_new_weights_are_used_by_the_running_processes() -> None:
    actor = leaning()
    pool = local(SkillWorker(actor, deterministic=True), num_processes=1, max_steps=8)
    td = pool.reset().set("option", torch.tensor(0))
    pool.step(td.clone())
    pids = pool.pids
    for action in (0, 1):
        with torch.no_grad():
            for parameter in actor.parameters():
                parameter.zero_()
            actor.network.heads.bias[action] = 1.0  # of option 0
        pool.worker.load(actor)
        after = pool.step(td.clone())["next", "observation"]
        here = local(RepeatActions(2), max_steps=8)
        td_here = here.reset(td.exclude("option"), set_state=True)
        assert after.equal(here.step(td_here.set("option", action))["next", "observation"])
    assert pool.pids == pids
    pool.close()


# ------------------------------------------------------------------ what is refused


class Wide(RepeatActions):
    def act(self, observation: Any, option: int, generator: Any) -> Any:
        return np.zeros(3)


@pytest.mark.parametrize(
    ("keywords", "error", "words"),
    [
        ({"max_steps": 0}, ValueError, "max_steps >= 1; got 0"),
        ({"num_processes": -1}, ValueError, "num_processes >= 0; got -1"),
        ({"gamma": 1.5}, ValueError, r"gamma .*<= 1.0; got 1.5"),
        ({"step_seconds": 0.0}, ValueError, "step_seconds > 0.0 .*got 0.0"),
        ({"still": 0.1}, ValueError, "pass features="),
        ({"start_method": "fork"}, ValueError, "would inherit"),
        ({"env": "CartPol-v1"}, ValueError, "Nearest: CartPole-v1"),
        ({"env": gymnasium.make("CartPole-v1")}, TypeError, "an id or a function"),
        ({"worker": object()}, ValueError, "num_options"),
        ({"worker": RepeatActions(3)}, ValueError, "took the action 2 in option 2"),
        ({"worker": Wide(1)}, ValueError, r"took the action array.*Discrete\(2\)"),
    ],
)
def test_arguments_that_make_no_sense_are_refused(
    keywords: dict[str, Any], error: type[Exception], words: str
) -> None:
    with pytest.raises(error, match=words):
        local(**keywords)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda td: td.set("option", torch.tensor(2)), "Option 2 does not exist"),
        (lambda td: td.exclude("snapshot"), "under 'snapshot', which the tensordict lacks"),
        (lambda td: td.set("snapshot", td["snapshot"][:-1]), r"has \[80\] numbers; got \[79\]"),
    ],
)
def test_a_state_or_option_that_is_none_is_refused_and_costs_no_room(
    change: Any, words: str
) -> None:
    here = local()
    with pytest.raises(ValueError, match=words):
        here.step(change(here.reset().set("option", torch.tensor(0))))
    assert sorted(here._free) == list(range(NUM_SLOTS))


@pytest.mark.slow
def test_a_function_makes_the_env_in_each_process() -> None:
    pool = local(env=partial(gymnasium.make, "CartPole-v1"), num_processes=1)
    assert pool.rollout(2)["next", "duration"].flatten().tolist() == [5, 5]
    picture = local(env="CartPole-v1", render_mode="rgb_array")
    assert picture.render(picture.reset()).ndim == 3
    pool.close()

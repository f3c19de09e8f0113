"""The planner in envs that nobody here wrote: TorchRL's pendulum, tic-tac-toe and MuJoCo walker."""

from __future__ import annotations

import math
from functools import partial
from typing import Any

import numpy as np
import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule
from torchrl.data import Binary, Categorical, Composite, Unbounded
from torchrl.envs import (
    Compose,
    EnvBase,
    GymEnv,
    PendulumEnv,
    SerialEnv,
    StepCounter,
    TicTacToeEnv,
    Transform,
    TransformedEnv,
)

from torchrl_hmcts.envs import SettableGymEnv
from torchrl_hmcts.planners import (
    UCT,
    HighestValue,
    MCTSPlanner,
    ProgressiveWidening,
    SearchBudget,
)
from torchrl_hmcts.testing import ChainEnv, TableEnv
from torchrl_hmcts.transforms import OptionTransform

# ---------------------------------------------------------------------- pendulum


def swinging_pendulum() -> EnvBase:
    """Three options, full torque either way or none, each held for 6 steps (0.3 s)."""
    torque = torch.tensor([[-2.0], [0.0], [2.0]])
    worker = TensorDictModule(lambda skill: torque[skill], ["skill"], ["action"])
    return TransformedEnv(PendulumEnv(), OptionTransform(worker, 3, 6, gamma=0.99))


def test_a_pendulum_is_swung_up_by_a_search_over_held_torques() -> None:
    env = swinging_pendulum()
    hanging = env.reset()
    hanging["th"], hanging["thdot"] = torch.tensor(math.pi), torch.tensor(0.0)
    hanging = env.reset(hanging, set_state=True)

    def swing(policy: Any) -> TensorDictBase:
        return env.rollout(18, policy, tensordict=hanging.clone(), auto_reset=False)["next"]

    planner = MCTSPlanner(
        swinging_pendulum(),
        tree_policy=UCT(c=5.0),  # a step costs up to 16
        backup="max",
        final_choice=HighestValue(),
        budget=SearchBudget(expansions=24, until_plan=False),
        leaves_per_wave=8,
        seed=0,
    )
    planned = swing(planner)
    # No torque lifts it by itself, so it must swing; within 6 s it stands.
    assert planned["th"][-3:].cos().min().item() > 0.9
    at_random = [swing(None)["reward"].sum().item() for _ in range(3)]
    assert planned["reward"].sum().item() > 0.7 * max(at_random)  # both are negative


# ---------------------------------------------------------------------- tic-tac-toe


def test_a_random_opponent_at_tic_tac_toe_hardly_ever_wins_and_no_move_is_illegal() -> None:
    num_games = 20
    env = TicTacToeEnv(single_player=True)
    planner = MCTSPlanner(
        TicTacToeEnv(single_player=True),
        chance=ProgressiveWidening(k=2.0, alpha=0.5),  # the opponent's answer is random
        reward_key=("player0", "reward"),
        mask_key="mask",
        expand="one",
        gamma=1.0,
        budget=SearchBudget(simulations=200, until_plan=False),
        seed=0,
    )
    rollout = env.rollout(
        6,
        planner,
        tensordict=env.reset(TensorDict(batch_size=[num_games])),
        auto_reset=False,
        break_when_all_done=True,
    )
    games, ends = torch.arange(num_games), rollout["next", "done"].int().argmax(1).squeeze(-1)
    assert rollout["next", "done"][games, ends].all()
    played = torch.arange(rollout.shape[1]) <= ends.unsqueeze(-1)
    legal = rollout["mask"].gather(-1, rollout["action"].unsqueeze(-1)).squeeze(-1)
    assert legal[played].all()
    won = rollout["next", "player0", "reward"][games, ends].sum().item()
    lost = rollout["next", "player1", "reward"][games, ends].sum().item()
    assert lost <= 1
    assert won >= 15  # a random player who moves first wins 58 % of its games


def test_a_winning_move_is_found_for_every_answer_of_the_opponent() -> None:
    env = TicTacToeEnv(single_player=True)
    td = env.reset()
    # Ours are 1: two in the top row, the third square is free.
    td["board"] = torch.tensor([[1, 1, -1], [0, 0, -1], [-1, -1, -1]], dtype=torch.int32)
    td["mask"] = td["board"].flatten() == -1
    planner = MCTSPlanner(
        env,
        chance=ProgressiveWidening(),
        reward_key=("player0", "reward"),
        mask_key="mask",
        expand="one",
        budget=SearchBudget(simulations=100, until_plan=False),
        seed=0,
    )
    assert planner(td)["action"].item() == 2
    assert td["root_visits"][[0, 1, 3, 4]].tolist() == [0] * 4  # squares that are taken


def test_several_rewards_must_be_told_apart() -> None:
    with pytest.raises(ValueError, match="plans for one reward; TicTacToeEnv has"):
        MCTSPlanner(TicTacToeEnv(single_player=True), mask_key="mask")


# ---------------------------------------------------------------------- MuJoCo


class MujocoState(Transform):
    """Writes what ``reset(td, set_state=True)`` of a MujocoEnv restores, and declares it."""

    def _read(self, td: TensorDictBase) -> TensorDictBase:
        return td.update(self.parent.base_env.get_state().select("qpos", "qvel"))

    def _step(self, td: TensorDictBase, next_td: TensorDictBase) -> TensorDictBase:
        return self._read(next_td)

    def _reset(self, td: TensorDictBase, td_reset: TensorDictBase) -> TensorDictBase:
        return self._read(td_reset)

    def _spec(self) -> dict[str, Unbounded]:
        state = self.parent.base_env.get_state()
        return {k: Unbounded(state[k].shape, dtype=state[k].dtype) for k in ("qpos", "qvel")}

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        return observation_spec.clone().update(self._spec())

    def transform_input_spec(self, input_spec: Composite) -> Composite:
        input_spec = input_spec.clone()
        input_spec["full_state_spec"].update(self._spec())
        return input_spec


def walker(max_steps: int = 14) -> EnvBase:
    """Four options, two joints pushed either way, each held for 4 steps."""
    return TransformedEnv(bare_walker(), Compose(MujocoState(), *walker_options(max_steps)))


def bare_walker() -> EnvBase:
    from torchrl.envs import Walker2dEnv

    return Walker2dEnv(backend="mujoco", seed=0)


def walker_with_state() -> EnvBase:
    return TransformedEnv(bare_walker(), MujocoState())


def walker_options(max_steps: int = 14) -> list[Transform]:
    push = torch.eye(6)[:2]
    push = torch.cat((push, -push))
    worker = TensorDictModule(lambda skill: push[skill], ["skill"], ["action"])
    return [StepCounter(max_steps=max_steps), OptionTransform(worker, 4, 4, gamma=0.99)]


def test_a_mujoco_walker_is_set_back_to_the_state_of_every_node() -> None:
    pytest.importorskip("mujoco")
    env = walker()
    planner = MCTSPlanner(env, budget=SearchBudget(expansions=12, until_plan=False), seed=0)
    td = env.reset()
    tree = planner.search(td).tree
    num_nodes = int(tree.num_nodes[0])
    assert num_nodes == 1 + 4 * 12
    assert tree.states is not None
    # From the last node to the first, so that nothing is left over from a neighbour.
    for node in range(num_nodes - 1, 0, -1):
        record = tree.nodes[0, node]
        before = tree.get_states(
            np.array([0]), np.array([record["parent"]]), planner.simulator.state_keys
        )
        after = planner.simulator.step(before, np.array([record["option"]], dtype=np.int64))
        for key in planner.simulator.state_keys:
            assert torch.equal(after[key][0], tree.states[key][0, node]), key
        assert planner.simulator.rewards(after)[0] == record["reward"]


def test_what_transforms_count_is_restored_in_an_env_with_a_state_of_its_own() -> None:
    pytest.importorskip("mujoco")
    env = walker(max_steps=6)  # one option and a half
    planner = MCTSPlanner(env, budget=SearchBudget(expansions=100, until_plan=False), seed=0)
    search = planner.search(env.reset())
    assert search.num_expansions.tolist() == [1 + 4]
    assert search.tree.states is not None
    depths = search.tree.nodes["depth"][0, :21]
    assert depths.tolist() == [0] + [1] * 4 + [2] * 16
    counts = search.tree.states["step_count"][0, :21].flatten().tolist()
    assert counts == [0] + [4] * 4 + [6] * 16


@pytest.mark.parametrize("make", [partial(SettableGymEnv, "CartPole-v1"), partial(ChainEnv, 12)])
@pytest.mark.parametrize("behind", [True, False])
def test_what_is_counted_behind_the_options_is_a_nodes_own(make: Any, behind: bool) -> None:
    worker = TensorDictModule(lambda skill: skill.clone(), ["skill"], ["action"])
    parts: list[Any] = [OptionTransform(worker, 2, 2), StepCounter(50)]
    env = TransformedEnv(make(), Compose(*(parts if behind else parts[::-1])))
    planner = MCTSPlanner(env, budget=SearchBudget(simulations=14, until_plan=False))
    td = env.step(env.reset().set("option", torch.tensor(1)))["next"].exclude("reward")
    tree, each = planner.search(td.clone()).tree, 1 if behind else 2
    count = int(tree.num_nodes[0])
    depth = torch.from_numpy(tree.nodes["depth"][0, :count].astype(np.int64))
    assert depth.max() >= 2
    assert tree.states is not None
    counted = tree.states["step_count"][0, :count].flatten()
    running = torch.from_numpy(tree.nodes["base_steps"][0, :count] == 2 * depth.numpy())
    assert counted[running].equal(each * (1 + depth[running]))
    # The env that is acted in counts on from where it was.
    acted = env.step(td.set("option", torch.tensor(1)))["next", "step_count"]
    assert acted.item() == 2 * each


def test_a_batch_of_mujoco_walkers_gives_the_tree_of_one() -> None:
    pytest.importorskip("mujoco")
    two = TransformedEnv(SerialEnv(2, walker_with_state), Compose(*walker_options()))
    one = walker()
    td = one.reset()
    trees = []
    for env in (one, two):
        budget = SearchBudget(expansions=6, until_plan=False)
        planner = MCTSPlanner(env, budget=budget, seed=0)
        # An odd number of states: the last call is filled up.
        trees.append(planner.search(td).tree)
    num_nodes = int(trees[0].num_nodes[0])
    for name in ("value", "visits", "reward", "parent", "base_steps"):
        np.testing.assert_array_equal(*(tree.nodes[name][0, :num_nodes] for tree in trees))


# ---------------------------------------------------------------------- a state of its own


class RoomEnv(EnvBase):
    """A walk along a corridor of 5 rooms whose state is in the env: only ``set_state`` moves it."""

    _supports_set_state = True

    def __init__(self, batch_size: tuple[int, ...]) -> None:
        super().__init__(batch_size=batch_size)
        shape = self.batch_size
        self.room = torch.zeros(shape, dtype=torch.int64)
        self.observation_spec = Composite(room=Categorical(5, shape=shape), shape=shape)
        self.state_spec = self.observation_spec.clone()
        self.action_spec = Categorical(2, shape=shape)
        self.reward_spec = Unbounded((*shape, 1))
        self.done_spec = Binary(1, shape=(*shape, 1), dtype=torch.bool)
        self.num_steps = 0

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDictBase:
        self.room = torch.zeros_like(self.room)
        if kwargs.get("set_state") and tensordict is not None:
            self.room = tensordict["room"].clone()
        return TensorDict({"room": self.room.clone()}, self.batch_size)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        self.num_steps += 1
        self.room = (self.room + 2 * tensordict["action"] - 1).clamp(0, 4)
        done = (self.room == 4).unsqueeze(-1)
        return TensorDict(
            {"room": self.room.clone(), "reward": done.float(), "done": done}, self.batch_size
        )

    def _set_seed(self, seed: int | None) -> None:
        """Nothing is random."""


@pytest.mark.parametrize("batch_size", [(), (1,), (2,), (3,), (2, 2)])
def test_an_env_with_a_state_of_its_own_steps_as_many_states_as_it_holds(
    batch_size: tuple[int, ...],
) -> None:
    env = RoomEnv(batch_size)
    planner = MCTSPlanner(env, gamma=0.5)
    plan = planner.plan(TensorDict({"room": torch.tensor([0, 2, 1])}, [3]))
    assert plan.options.tolist() == [[1, 1, 1, 1], [1, 1, -1, -1], [1, 1, 1, -1]]
    assert plan.returns.tolist() == [0.5**3, 0.5, 0.25]
    env.num_steps = 0
    planner.simulator.step(
        TensorDict({"room": torch.tensor([0, 1, 2])}, [3]), np.array([1, 0, 1], dtype=np.int64)
    )
    assert env.num_steps == math.ceil(3 / max(1, env.batch_size.numel()))


# ---------------------------------------------------------------------- stateless, but terse


class ForgetfulEnv(TableEnv):
    """A table that pays a bonus, part of its state, which ``_step`` reads and never writes."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.state_spec["bonus"] = Unbounded((1,))
        self.observation_spec["bonus"] = Unbounded((1,))

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        after = super()._step(tensordict)
        return after.set("reward", after.get("reward") * tensordict.get("bonus"))


def test_entries_of_the_state_that_a_step_leaves_unwritten_stay_as_they_are() -> None:
    table = {(0, 0): (1, 0.0, 1), (1, 0): (2, 1.0, 1)}
    env = ForgetfulEnv(table, terminal=[2])
    td = TableEnv(table, terminal=[2]).reset(TensorDict(batch_size=[2]))
    td["bonus"] = torch.tensor([[3.0], [5.0]])
    plan = MCTSPlanner(env, gamma=0.5).plan(td)
    assert plan.returns.tolist() == [1.5, 2.5]
    assert plan.states["bonus"].squeeze(-1).tolist() == [[3.0] * 3, [5.0] * 3]


# ---------------------------------------------------------------------- envs that cannot serve


def test_a_gym_env_is_refused_with_what_to_use_instead() -> None:
    pytest.importorskip("gymnasium")
    env = GymEnv("CartPole-v1", categorical_action_encoding=True)
    with pytest.raises(ValueError, match="needs an env it can set to any state; GymEnv cannot"):
        MCTSPlanner(env)


def test_an_env_that_hides_its_state_is_told_what_to_declare() -> None:
    env = RoomEnv(())
    env.state_spec = Composite()
    with pytest.raises(ValueError, match="RoomEnv has an empty state_spec"):
        MCTSPlanner(env)

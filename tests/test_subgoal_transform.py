"""SubgoalTransform: algorithm 1 on a plane where every distance can be checked by hand."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Bounded, Categorical, Composite, Unbounded
from torchrl.envs import EnvBase, TransformedEnv

from torchrl_hmcts.planners import GoalPlanner, MCTSPlanner
from torchrl_hmcts.testing import ChainEnv
from torchrl_hmcts.transforms import PlansGoals, SubgoalTransform

RIGHT, LEFT, STAY = 0, 1, 2
DONE = ("done", "terminated", "truncated")
ROLL_ON: dict[str, Any] = {"break_when_any_done": False}
STEPS = torch.tensor([[0.25, 0.0], [-0.25, 0.0], [0.0, 0.0]])


class Plane(EnvBase):
    """A point steps a quarter to the right or left, or stays; element i begins at (0, 10 i).

    It is terminated at x >= ``end``, and element i truncated after ``limit + i`` steps. The reward
    is 7 times x.
    """

    batch_locked = False
    _supports_set_state = True

    def __init__(
        self, batch_size: Sequence[int] = (), end: float = 100.0, limit: int = 1000
    ) -> None:
        super().__init__(batch_size=torch.Size(batch_size))
        shape = self.batch_size
        state = {
            "position": Unbounded((*shape, 2)),
            "age": Bounded(-1000, 10_000, shape=(*shape, 1), dtype=torch.int64),
        }
        self.observation_spec = Composite(state, shape=shape)
        self.state_spec = self.observation_spec.clone()
        self.action_spec = Categorical(3, shape=shape)
        self.reward_spec = Unbounded((*shape, 1))
        self.done_spec = Composite(
            {key: Binary(1, (*shape, 1), dtype=torch.bool) for key in DONE}, shape=shape
        )
        self.end, self.limit = end, limit

    def _set_seed(self, seed: int | None) -> None:
        """Nothing is random."""

    def _reset(self, td: TensorDictBase | None = None, **kwargs: Any) -> TensorDict:
        if kwargs.get("set_state"):
            assert td is not None
            return td.select("position", "age")
        shape = self.batch_size if td is None else td.batch_size
        age = -torch.arange(shape.numel()).view(*shape, 1)
        position = torch.cat((torch.zeros_like(age), -10 * age), -1).float()
        return TensorDict({"position": position, "age": age}, batch_size=shape)

    def _step(self, td: TensorDictBase) -> TensorDict:
        age, position = td["age"] + 1, td["position"] + STEPS[td["action"]]
        terminated = position[..., :1] >= self.end
        truncated = age >= self.limit
        return TensorDict(
            {
                "position": position,
                "age": age,
                "reward": 7.0 * position[..., :1],
                "terminated": terminated,
                "truncated": truncated,
                "done": terminated | truncated,
            },
            batch_size=td.batch_size,
        )


class Ahead:
    """A manager that plans ``length`` goals to the right, 1 apart, and remembers its calls."""

    def __init__(self, length: int = 3) -> None:
        self.length = length
        self.calls: list[TensorDictBase] = []

    def plan_goals(self, td: TensorDictBase) -> tuple[Tensor, Tensor]:
        self.calls.append(td.clone())
        steps = torch.arange(1, self.length + 1)[:, None] * torch.tensor([1.0, 0.0])
        return td["position"].unsqueeze(1) + steps, torch.full((len(td),), self.length)


def make_env(
    batch: Sequence[int] = (), planner: Any = None, *, end: float = 100.0, **kwargs: Any
) -> TransformedEnv:
    limit = kwargs.pop("limit", 1000)
    kwargs = {"r_tick": -0.5, "max_goals": 5, **kwargs}
    planner = Ahead() if planner is None else planner
    return TransformedEnv(Plane(batch, end, limit), SubgoalTransform(planner, **kwargs))


def walk(env: EnvBase, actions: Sequence[int], td: TensorDictBase | None = None) -> TensorDictBase:
    """Take actions, the same in each element; return the transitions stacked along time."""
    td = env.reset() if td is None else td
    out = []
    for action in actions:
        td["action"] = torch.full(td.batch_size, action)
        out.append(env.step(td))
        td = env.step_mdp(td)
    return torch.stack(out, -1)


def numbers(data: TensorDictBase, key: str) -> list[Any]:
    found: list[Any] = data["next", key].squeeze(-1).tolist()
    return found


# ------------------------------------------------------------------------------------ algorithm 1


def test_each_step_costs_the_tick_and_each_goal_met_pays() -> None:
    # Goals at x = 1, 2, 3; a goal is met when closer than a half: at 0.75, 1.75, 2.75.
    data = walk(make_env(), [RIGHT] * 8)
    met = [0, 0, 1, 0, 0, 0, 1, 0]
    assert numbers(data, "reward") == [-0.5 + 1.0 * m for m in met]
    assert numbers(data, "num_goals_met") == [0, 0, 1, 1, 1, 1, 2, 2]
    assert numbers(data, "goal_index") == [0, 0, 1, 1, 1, 1, 2, 2]
    assert numbers(data, "num_plans") == [1] * 8
    assert numbers(data, "num_divergences") == [0] * 8


def test_going_away_is_punished_and_planned_anew_from_where_it_led() -> None:
    # The goal at x = 1 is further than 2 when x < -1, at the fifth step.
    env = make_env()
    data = walk(env, [LEFT] * 7)
    assert numbers(data, "reward") == [-0.5] * 4 + [-1.5] + [-0.5] * 2
    assert numbers(data, "num_divergences") == [0] * 4 + [1] * 3
    assert numbers(data, "num_plans") == [1] * 4 + [2] * 3
    goals = data["next", "plan"][:, :3, 0].tolist()
    assert goals[3] == [1.0, 2.0, 3.0]
    assert goals[4] == [-0.25, 0.75, 1.75]  # planned from x = -1.25, shown before the next action
    assert data["next", "goals"][4].tolist() == [1.0, 0.0, 2.0, 0.0, 3.0, 0.0]


def test_at_exactly_a_threshold_nothing_happens() -> None:
    # After two steps x = 0.5 is a half from the goal at 1; at x = -1 it is 2 away.
    assert numbers(walk(make_env(), [RIGHT] * 2), "num_goals_met") == [0, 0]
    assert numbers(walk(make_env(), [LEFT] * 4), "num_divergences") == [0] * 4


def test_thresholds_and_rewards_are_arguments() -> None:
    env = make_env(
        goal_met_threshold=0.3,
        goal_divergence_threshold=1.2,
        r_tick=0.0,
        r_goal_met=3.0,
        r_goal_divergence=-4.0,
    )
    assert numbers(walk(env, [RIGHT] * 3), "reward") == [0.0, 0.0, 3.0]
    assert numbers(walk(env, [LEFT] * 2), "reward") == [-4.0, -4.0]  # 1.25 from each first goal


def test_an_infinite_threshold_never_plans_again() -> None:
    data = walk(make_env(goal_divergence_threshold=math.inf), [LEFT] * 20)
    assert numbers(data, "num_plans") == [1] * 20


def test_a_goal_is_judged_by_where_the_step_led_and_was_current_while_it_was_taken() -> None:
    # At x = 0.75 the first goal is met; the second, 1.25 away, counts from the next step on.
    env = make_env(goal_divergence_threshold=1.2)
    assert numbers(walk(env, [RIGHT] * 3 + [STAY]), "num_divergences") == [0, 0, 0, 1]


@pytest.mark.parametrize("relative", [True, False])
def test_the_next_goals_are_shown_and_the_last_one_fills_up(relative: bool) -> None:
    data = walk(make_env(relative=relative), [RIGHT] * 11)
    origin = data["next", "position"][:, 0] if relative else torch.zeros(11)
    shown = data["next", "goals"][:, 0::2] + origin[:, None]
    assert shown[1].tolist() == [1.0, 2.0, 3.0]
    assert shown[2].tolist() == [2.0, 3.0, 3.0]
    assert shown[6].tolist() == [3.0, 3.0, 3.0]
    assert not data["next", "goals"][:, 1::2].any()  # y is never left


def test_any_number_of_goals_can_be_shown() -> None:
    assert make_env(num_goals=1).reset()["goals"].tolist() == [1.0, 0.0]
    assert make_env(num_goals=5).reset()["goals"][0::2].tolist() == [1.0, 2.0, 3.0, 3.0, 3.0]


def test_after_the_last_goal_a_new_plan_is_made_without_punishment() -> None:
    data = walk(make_env(planner=Ahead(1)), [RIGHT] * 6)  # met at 0.75, then 1 ahead of that
    assert numbers(data, "reward") == [-0.5, -0.5, 0.5, -0.5, -0.5, 0.5]
    assert numbers(data, "num_plans") == [1, 1, 2, 2, 2, 3]
    assert data["next", "plan"][2:5, 0, 0].tolist() == [1.75] * 3


def test_a_terminal_state_is_not_planned_from() -> None:
    planner = Ahead(1)
    data = walk(make_env(planner=planner, end=0.75), [RIGHT] * 3)
    assert data["next", "terminated"][-1].item()
    assert numbers(data, "reward")[-1] == 0.5
    assert len(planner.calls) == 1
    assert numbers(data, "goal_index") == [0, 0, 0]


def test_a_truncated_state_is_planned_from_since_its_value_is_asked_for() -> None:
    planner = Ahead(1)
    data = walk(make_env(planner=planner, limit=3), [RIGHT] * 3)
    assert data["next", "truncated"][-1].item()
    assert len(planner.calls) == 2


def test_a_plan_that_is_too_long_goes_on_when_its_last_goal_is_met() -> None:
    env = make_env(planner=Ahead(9), max_goals=2)
    assert env.reset()["plan_length"].item() == 2
    data = walk(env, [RIGHT] * 7)
    assert numbers(data, "num_plans") == [1] * 6 + [2]
    assert data["next", "plan"][6, :, 0].tolist() == [2.75, 3.75]
    assert numbers(data, "goal_index") == [0, 0, 1, 1, 1, 1, 0]


def test_the_reward_of_the_task_is_kept_under_its_own_key() -> None:
    data = walk(make_env(task_reward_key=("task", "reward")), [RIGHT] * 3)
    assert data["next", "task", "reward"].flatten().tolist() == [1.75, 3.5, 5.25]


# ----------------------------------------------------------------------------------------- batches


def test_all_elements_that_need_a_plan_get_it_in_one_call() -> None:
    planner = Ahead()
    env = make_env((4,), planner)
    td = env.reset()
    assert [len(call) for call in planner.calls] == [4]
    for step in range(5):
        td["action"] = torch.tensor([RIGHT, LEFT, STAY, LEFT])
        td = env.step_mdp(env.step(td))
        assert len(planner.calls) == (2 if step == 4 else 1)
    assert planner.calls[1]["position"].tolist() == [[-1.25, 10.0], [-1.25, 30.0]]
    assert td["num_plans"].flatten().tolist() == [1, 2, 1, 2]
    assert td["plan"][:, 0].tolist() == [[1.0, 0.0], [-0.25, 10.0], [1.0, 20.0], [-0.25, 30.0]]


def test_elements_of_a_batch_do_what_each_does_alone() -> None:
    torch.manual_seed(1)
    actions = torch.randint(2, (60, 2, 3))
    env = make_env((2, 3), goal_divergence_threshold=1.3)
    td, alone = env.reset(), make_env(goal_divergence_threshold=1.3)
    singles = [[alone.reset(td[i, j].clone(), set_state=True) for j in range(3)] for i in range(2)]
    for action in actions:
        td["action"] = action
        td = env.step_mdp(env.step(td))
        for i in range(2):
            for j in range(3):
                single = singles[i][j].set("action", action[i, j])
                singles[i][j] = alone.step_mdp(alone.step(single))
    assert td["num_divergences"].sum() > 5
    assert td["num_goals_met"].sum() > 5
    for i in range(2):
        for j in range(3):
            assert (td[i, j] == singles[i][j]).all()


def test_a_partial_reset_plans_only_where_it_resets() -> None:
    # Element i is truncated after 4 + i steps, and diverges at its fifth.
    planner = Ahead()
    env = make_env((3,), planner, limit=4)
    data = env.rollout(9, lambda td: td.set("action", torch.full((3,), LEFT)), **ROLL_ON)
    # All; element 0 resets; 1 and 2 diverge; 1 resets; 2 resets; 0 resets again.
    assert [len(call) for call in planner.calls[-6:]] == [3, 1, 2, 1, 1, 1]
    steps = data["age"].squeeze(-1) + torch.arange(3)[:, None]  # base steps of the episode
    assert steps[0].tolist() == [0, 1, 2, 3, 0, 1, 2, 3, 0]
    fresh = data["goals"][steps == 0]
    assert (fresh == torch.tensor([1.0, 0.0, 2.0, 0.0, 3.0, 0.0])).all()
    # x = -0.25 per step of the episode, and the first goal stands at 1.
    first = data["plan"][..., 0, 0]
    unplanned = data["num_plans"].squeeze(-1) == 1
    assert (first[unplanned] == 1.0).all()


def test_finished_elements_wait_without_being_planned_for() -> None:
    torch.manual_seed(0)
    env = make_env(limit=6)
    ages = -torch.arange(3)[:, None]
    starts = TensorDict({"position": torch.zeros(3, 2), "age": ages}, [3])
    starts = env.reset(starts, set_state=True)
    together = env.rollout(20, auto_reset=False, tensordict=starts, break_when_all_done=True)
    assert together.shape == (3, 8)
    for i in range(3):
        actions = together["action"][i, : 6 + i].tolist()
        start = env.reset(together[i, 0].select("position", "age"), set_state=True)
        alone = walk(env, actions, start)
        for key in ("reward", "goals", "num_plans", "goal_index", "plan"):
            assert (together["next", key][i, : 6 + i] == alone["next", key]).all(), key


def test_elements_that_a_batched_env_does_not_step_are_left_alone() -> None:
    planner = Ahead()
    env = make_env((2,), planner)
    td = env.reset().set("action", torch.tensor([LEFT, LEFT]))
    after = env.base_env._step(td)
    after["position"] = torch.full((2, 2), 50.0)  # for the second element no state, but a leftover
    after = env.transform._step(td.set("_step", torch.tensor([True, False])), after)
    assert after["reward"].flatten().tolist() == [-1.5, 0.0]
    assert after["num_divergences"].flatten().tolist() == [1, 0]
    assert [len(call) for call in planner.calls[-2:]] == [2, 1]


# ------------------------------------------------------------------------------------ states, specs


def test_a_state_that_holds_a_plan_goes_on_with_it() -> None:
    actions = [RIGHT] * 5 + [LEFT] * 9 + [RIGHT] * 4
    planner = Ahead()
    env = make_env(planner=planner)
    unbroken = walk(env, actions)
    middle = unbroken["next"][8].exclude("reward", "task_reward", "done", "terminated", "truncated")
    calls = len(planner.calls)
    resumed = env.reset(middle.clone(), set_state=True)
    assert len(planner.calls) == calls
    again = walk(env, actions[9:], resumed)
    for key in unbroken["next"].keys():
        assert (again["next", key] == unbroken["next", key][9:]).all(), key


def test_a_state_without_a_plan_is_given_one() -> None:
    env = make_env((2,))
    position = torch.tensor([[4.0, 0.0], [-3.0, 1.0]])
    start = TensorDict({"position": position, "age": torch.zeros(2, 1, dtype=torch.int64)}, [2])
    td = env.reset(start, set_state=True)
    assert td["plan"][:, 0].tolist() == [[5.0, 0.0], [-2.0, 1.0]]
    assert td["num_plans"].flatten().tolist() == [1, 1]


def test_a_reset_to_elsewhere_does_not_keep_an_old_plan() -> None:
    env = make_env()
    old = walk(env, [RIGHT] * 5)["next"][-1].exclude("reward", "task_reward")
    td = env.reset(old, set_state=False)  # the env goes back to the origin
    assert td["plan"][0].tolist() == [1.0, 0.0]
    assert td["num_goals_met"].item() == 0
    assert td["goal_index"].item() == 0


def test_steps_share_the_memory_of_a_plan_that_does_not_change() -> None:
    env = make_env((2,))
    td = env.reset().set("action", torch.tensor([LEFT, STAY]))
    same = env.base_env._step(td)
    after = env.transform._step(td, same)
    assert after["plan"].data_ptr() == td["plan"].data_ptr()
    for _ in range(4):
        td = env.step_mdp(env.step(td.set("action", torch.tensor([LEFT, STAY]))))
    before = td["plan"].clone()
    changed = env.step(td.set("action", torch.tensor([LEFT, STAY])))
    assert (changed["plan"] == before).all()  # the root keeps its own
    assert (changed["next", "plan"][0] != before[0]).any()


# ------------------------------------------------------------------------------------ the planner


def test_a_function_and_an_object_are_both_planners() -> None:
    manager = Ahead()
    assert isinstance(manager, PlansGoals)
    function, method = make_env(planner=manager.plan_goals), make_env(planner=manager)
    assert (walk(function, [LEFT] * 6) == walk(method, [LEFT] * 6)).all()


def test_a_planner_that_says_what_it_reads_gets_only_that() -> None:
    manager = Ahead()
    manager.in_keys = ["position"]  # type: ignore[attr-defined]
    walk(make_env(planner=manager), [LEFT] * 5)
    assert [list(call.keys()) for call in manager.calls] == [["position"]] * 2
    everything = Ahead()
    make_env(planner=everything).reset()
    assert {"position", "age"} <= set(everything.calls[0].keys())


@pytest.mark.parametrize(
    ("answer", "message"),
    [
        ((torch.zeros(1, 2, 3), torch.ones(1)), r"goals \[1, 2, 3\].* positions of 2 coordinates"),
        ((torch.zeros(2, 2), torch.ones(1)), r"must return goals \[1, any, 2\]"),
        ((torch.zeros(1, 2, 2), torch.ones(1, 1)), r"lengths \[1, 1\]"),
        ((torch.zeros(1, 2, 2), torch.zeros(1)), r"plan of 0 goals.*= \[0.0, 0.0\]; a plan needs"),
        ((torch.zeros(1, 2, 2), torch.full((1,), 3)), "plan of 3 goals, in an array of 2"),
        ((torch.full((1, 2, 2), math.nan), torch.ones(1)), "a goal of nan"),
    ],
)
def test_a_wrong_answer_of_the_planner_is_refused(
    answer: tuple[Tensor, Tensor], message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        make_env(planner=lambda td: answer).reset()


def test_what_stands_behind_the_end_of_a_plan_is_ignored() -> None:
    def plan(td: TensorDictBase) -> tuple[Tensor, Tensor]:
        goals, lengths = Ahead(3).plan_goals(td)
        goals[:, 1:] = math.nan
        return goals, torch.ones_like(lengths)

    assert make_env(planner=plan).reset()["plan"][:, 0].tolist() == [1.0] * 5


def test_the_states_along_a_search_s_best_plan_are_goals() -> None:
    env = ChainEnv(length=6)

    def to_macro(td: TensorDictBase) -> TensorDict:
        return TensorDict({"state": td["x"].long()}, td.batch_size)

    manager = GoalPlanner(MCTSPlanner(env), to_macro, goal_key="state", in_keys=["x"])
    goals, lengths = manager.plan_goals(TensorDict({"x": torch.tensor([1.9, 3.2])}, [2]))
    assert lengths.tolist() == [4, 2]
    assert goals.squeeze(-1).tolist() == [[2, 3, 4, 5], [4, 5, 5, 5]]
    assert manager.in_keys == ["x"]


def test_a_search_without_a_plan_says_from_where() -> None:
    from torchrl_hmcts.planners import SearchBudget

    planner = MCTSPlanner(ChainEnv(length=9), budget=SearchBudget(expansions=1))
    manager = GoalPlanner(planner, lambda td: td, goal_key="state")
    with pytest.raises(ValueError, match=r"no plan from \{'state': 2.*expansions=1"):
        manager.plan_goals(TensorDict({"state": torch.tensor([2])}, [1]))


# ----------------------------------------------------------------------------------------- errors


def test_missing_entries_are_named() -> None:
    with pytest.raises(KeyError, match="place"):
        make_env(position_key="place").observation_spec  # noqa: B018
    with pytest.raises(KeyError, match="payment"):
        make_env(reward_key="payment").reward_spec  # noqa: B018
    env = make_env()
    td = env.reset().exclude("plan").set("action", torch.tensor(RIGHT))
    with pytest.raises(KeyError, match="plan"):
        env.step(td)

"""Envs to plan in: their masks, rewards, ends, discounts, and the states that transforms keep."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import Any

import pytest
import torch
from search_parts import expansions, simulations
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule
from torchrl.data import Binary, Bounded, Categorical, Composite, MultiCategorical, Unbounded
from torchrl.envs import (
    CatFrames,
    Compose,
    DTypeCastTransform,
    EnvBase,
    InitTracker,
    ObservationNorm,
    ParallelEnv,
    RandomTruncationTransform,
    RenameTransform,
    RewardSum,
    SerialEnv,
    StepCounter,
    TimeMaxPool,
    Transform,
    TransformedEnv,
    UnsqueezeTransform,
    VecNormV2,
)

from torchrl_hmcts.envs import StatelessSimulator
from torchrl_hmcts.modules import FixedSkillPrior
from torchrl_hmcts.planners import HighestValue, MCTSPlanner
from torchrl_hmcts.testing import ChainEnv, ContractError, TableEnv, check_macro_env
from torchrl_hmcts.transforms import OptionTransform, SkillMaskTransform

ALL = simulations(40)


def follow(gamma: float = 0.99, num_options: int = 2, max_steps: int = 3) -> OptionTransform:
    """Options that hold an action."""
    worker = TensorDictModule(lambda skill: skill, ["skill"], ["action"])
    return OptionTransform(worker, num_options, max_steps, gamma=gamma)


# ---------------------------------------------------------------------- masks

# From 0 only action 1 is legal and leads to 1; there only action 0 is, which earns 1 and ends.
LEGAL = {(0, 1): (1, 0.0, 1), (1, 0): (2, 1.0, 1)}


class AnyLegal(torch.nn.Module):
    """Takes the first legal base action."""

    def forward(self, skill: torch.Tensor, mask: torch.Tensor) -> torch.Tensor:
        return mask.float().argmax(-1)


def legal_options(num_options: int, mask_key: Any = "action_mask", **kwargs: Any) -> EnvBase:
    """Option 0 lasts two base steps (the reward after the second), the others one."""
    env = TransformedEnv(TableEnv(LEGAL, terminal=[2]))
    if mask_key != "action_mask":
        env.append_transform(RenameTransform(["action_mask"], [mask_key]))
    worker = TensorDictModule(AnyLegal(), ["skill", mask_key], ["action"])
    ends = lambda td: td["skill"] != 0  # noqa: E731
    env.append_transform(OptionTransform(worker, num_options, 5, 0.9, ends, **kwargs))
    return env


@pytest.mark.parametrize("batch_size", [(), (2,)])
@pytest.mark.parametrize("mask_key", ["action_mask", ("group", "action_mask"), "legal"])
@pytest.mark.parametrize("num_options", [2, 3])
def test_a_mask_of_base_actions_forbids_no_option(
    num_options: int, mask_key: Any, batch_size: tuple[int, ...]
) -> None:
    env = legal_options(num_options, mask_key)
    planner = MCTSPlanner(env, seed=0, budget=ALL, final_choice=HighestValue())
    td = planner(env.reset(TensorDict(batch_size=batch_size)))
    assert planner.last_search.allowed().all()
    assert not td["option"].any()
    q = planner.last_search.tree.view().children_values[:, 0, 0]
    assert q.flatten().tolist() == pytest.approx([0.9] * q.numel())


def test_above_the_options_the_base_mask_goes_by_another_name() -> None:
    env = legal_options(3)
    td = env.reset()
    assert td["base_action_mask"].tolist() == [False, True]
    assert "action_mask" not in env.full_observation_spec.keys()
    assert "base_action_mask" in env.full_state_spec.keys()  # the worker reads it
    check_macro_env(env)


def test_options_have_a_mask_of_their_own_while_the_worker_sees_the_base_actions() -> None:
    env = legal_options(2)
    env.append_transform(SkillMaskTransform(FixedSkillPrior(2, [0.0, 1.0])))
    planner = MCTSPlanner(env, seed=0, budget=ALL)
    assert planner(env.reset())["option"].item() == 1
    assert planner.last_search.allowed().tolist() == [[False, True]]
    assert planner.last_search.num_simulations.tolist() == [2]  # option 1, twice: to 1 and to 2


def test_a_mask_of_as_many_base_actions_as_options_is_refused_where_it_is_named() -> None:
    with pytest.raises(ValueError, match=r"in TableEnv this is the mask of the 2 base actions"):
        MCTSPlanner(legal_options(2, "legal"), mask_key="legal")
    with pytest.raises(ValueError, match=r"which of the 3 options .* that is torch.bool \[2\]"):
        MCTSPlanner(legal_options(3, "legal"), mask_key="legal")


def test_a_mask_may_have_a_further_dimension_or_be_left_out() -> None:
    env = TransformedEnv(ChainEnv(length=4), Ones("action_mask", (1, 2)))
    assert MCTSPlanner(env).plan(env.reset()).options.tolist() == [1, 1, 1]
    env = TransformedEnv(ChainEnv(length=4), Ones("action_mask", (5,)))
    assert MCTSPlanner(env, mask_key=None).plan(env.reset()).options.tolist() == [1, 1, 1]


class Ones(Transform):
    """Writes an entry of ones."""

    def __init__(self, key: str, shape: tuple[int, ...], dtype: torch.dtype = torch.bool) -> None:
        super().__init__(in_keys=[], out_keys=[key])
        self.key, self.shape, self.dtype = key, shape, dtype

    def _reset(self, td: TensorDictBase, after: TensorDictBase) -> TensorDictBase:
        return self._step(td, after)

    def _step(self, td: TensorDictBase, after: TensorDictBase) -> TensorDictBase:
        return after.set(self.key, torch.ones((*after.batch_size, *self.shape), dtype=self.dtype))

    def transform_observation_spec(self, spec: Composite) -> Composite:
        spec[self.key] = Unbounded((*spec.shape, *self.shape), dtype=self.dtype)
        return spec


# ---------------------------------------------------------------------- one number each


class Specs(EnvBase):
    """An env of which only the specs are looked at."""

    _supports_set_state = True

    def __init__(
        self, locked: bool = False, batch_size: tuple[int, ...] = (), **specs: Any
    ) -> None:
        super().__init__(batch_size=batch_size)
        self.locked = locked
        x = Unbounded((*batch_size, 1))
        self.observation_spec = Composite(x=x, shape=batch_size)
        self.state_spec = Composite(x=x.clone(), shape=batch_size)
        specs = {name: spec.clone() for name, spec in specs.items()}  # an env locks its own
        one = Binary(1, shape=(*batch_size, 1), dtype=torch.bool)
        both = {"done": one, "terminated": one.clone()}
        self.action_spec = specs.get("action", Categorical(2, shape=batch_size))
        self.reward_spec = specs.get("reward", Unbounded((*batch_size, 1)))
        self.done_spec = specs.get("done", Composite(both, shape=batch_size))

    @property
    def batch_locked(self) -> bool:
        return self.locked

    def _reset(self, tensordict: Any = None, **kwargs: Any) -> TensorDictBase: ...

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase: ...

    def _set_seed(self, seed: int | None) -> None: ...


TWO_ENDS = Composite(done=Binary(2, dtype=torch.bool), terminated=Binary(2, dtype=torch.bool))
AGENTS = Composite(
    {
        name: {key: Binary(1, dtype=torch.bool) for key in ("done", "terminated")}
        for name in ("a", "b")
    }
)


@pytest.mark.parametrize("locked", [False, True])
@pytest.mark.parametrize(
    ("specs", "message"),
    [
        ({"reward": Unbounded((2,))}, r"one reward, .* 'reward' of Specs is torch.float32 \[2\]"),
        ({"reward": Unbounded((2, 1))}, r"'reward' of Specs is torch.float32 \[2, 1\]"),
        (
            {"reward": Composite(agents=Composite(reward=Unbounded((3,))))},
            r"the reward \('agents', 'reward'\) of Specs is torch.float32 \[3\]",
        ),
        (
            {"reward": Composite(a=Unbounded((1,)), b=Unbounded((1,)))},
            "plans for one reward; Specs has",
        ),
        ({"done": TWO_ENDS}, r"one end per state, a bool \[1\]; 'done' of Specs is .* \[2\]"),
        ({"done": AGENTS}, "one entry that says that an episode is over; Specs has"),
        (
            {"action": Bounded(-1.0, 1.0, (1,))},
            r"has Bounded[\s\S]*ActionDiscretizer",
        ),
        ({"action": MultiCategorical([2, 3])}, "searches one discrete action; Specs has Multi"),
        ({"action": Categorical(2, shape=(3,))}, "searches one discrete action; Specs has Cat"),
        (
            {"action": Composite(a=Categorical(2, shape=()), b=Categorical(2, shape=()))},
            "chooses one option per step; Specs has the actions",
        ),
    ],
)
def test_what_is_not_one_number_is_refused_with_its_key_and_shape(
    specs: dict[str, Any], message: str, locked: bool
) -> None:
    with pytest.raises(ValueError, match=message):
        MCTSPlanner(Specs(locked, **specs))


@pytest.mark.parametrize(
    ("shape", "dtype"), [((2,), torch.int64), ((1,), torch.float32), ((1,), torch.bool)]
)
def test_a_duration_is_one_integer(shape: tuple[int, ...], dtype: torch.dtype) -> None:
    env = TransformedEnv(ChainEnv(), Ones("duration", shape, dtype))
    with pytest.raises(ValueError, match=r"an int64 \[1\], from 'duration'; in ChainEnv that is"):
        MCTSPlanner(env, gamma=0.9)
    assert MCTSPlanner(env, gamma=0.9, duration_key=None).plan(env.reset()).found


# ---------------------------------------------------------------------- batched envs


def settable_options() -> EnvBase:
    return TransformedEnv(ChainEnv(length=8), follow(gamma=0.7))


@pytest.mark.parametrize("kind", [SerialEnv, pytest.param(ParallelEnv, marks=pytest.mark.slow)])
@pytest.mark.parametrize("started", [False, True])
def test_a_batch_of_settable_macro_envs_is_a_simulator(kind: Any, started: bool) -> None:
    env = kind(2, settable_options)
    if started:
        env.reset()
    planner = MCTSPlanner(env)
    assert planner.gamma == 0.7
    plan = planner.plan(settable_options().reset())
    # From 0 to 7 by options of 3, 3 and 1 base steps: the reward comes with the seventh.
    assert plan.options.tolist() == [1, 1, 1]
    assert plan.returns.item() == pytest.approx(0.7**6)
    env.close(raise_if_closed=False)


# ---------------------------------------------------------------------- the discount


class Wrapper(EnvBase):
    """An env that holds another and hands everything on."""

    batch_locked, _supports_set_state = False, True

    def __init__(self, env: EnvBase) -> None:
        super().__init__()
        self.inner = env
        self.observation_spec = env.full_observation_spec.clone()
        self.state_spec = env.full_state_spec.clone()
        self.action_spec = env.full_action_spec.clone()
        self.reward_spec = env.full_reward_spec.clone()
        self.done_spec = env.full_done_spec.clone()

    def _reset(self, tensordict: Any = None, **kwargs: Any) -> TensorDictBase:
        return self.inner._reset(tensordict, **kwargs)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        return self.inner._step(tensordict)

    def _set_seed(self, seed: int | None) -> None: ...


@pytest.mark.parametrize(
    "around",
    [
        lambda env: TransformedEnv(env, Compose(), auto_unwrap=False),
        lambda env: TransformedEnv(env, StepCounter(), auto_unwrap=False),
        Wrapper,
        lambda env: TransformedEnv(Wrapper(env), StepCounter()),
        StatelessSimulator,
    ],
)
def test_the_discount_of_the_options_is_found_through_any_nesting(
    around: Callable[[EnvBase], EnvBase],
) -> None:
    assert MCTSPlanner(around(settable_options())).gamma == 0.7


def test_no_discount_is_guessed_for_an_env_that_writes_durations() -> None:
    env = TransformedEnv(ChainEnv(), Ones("duration", (1,), torch.int64))
    with pytest.raises(ValueError, match=r"writes 'duration'.* MCTSPlanner\(env, gamma=0.99\)"):
        MCTSPlanner(env)
    assert MCTSPlanner(env, gamma=0.8).gamma == 0.8
    assert MCTSPlanner(ChainEnv()).gamma == 0.99


def test_batches_of_options_of_several_discounts_are_refused() -> None:
    other = lambda: TransformedEnv(ChainEnv(length=8), follow(gamma=0.9))  # noqa: E731
    env = SerialEnv(2, [settable_options, other])
    with pytest.raises(ValueError, match=r"discounts: \[0.7, 0.9\]"):
        MCTSPlanner(env)


# ---------------------------------------------------------------------- states of transforms


def numbered(batch_size: tuple[int, ...] = (), *, locked: bool = False) -> TransformedEnv:
    """A chain whose state is also a frame of one number."""
    base = LockedChain(length=9) if locked else ChainEnv(length=9, batch_size=batch_size)
    cast = DTypeCastTransform(torch.int64, torch.float32, in_keys=["state"], out_keys=["number"])
    frame = UnsqueezeTransform(dim=-1, in_keys=["number"], out_keys=["frame"])
    return TransformedEnv(base, Compose(cast, frame))


class LockedChain(ChainEnv):
    """A chain that keeps its state to itself."""

    batch_locked = True

    def _reset(self, tensordict: Any = None, **kwargs: Any) -> TensorDictBase:
        out = super()._reset(tensordict, **kwargs)
        self.state = out["state"].clone()
        return out

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        out = super()._step(tensordict.copy().set("state", self.state))
        self.state = out["state"].clone()
        return out


def stack(num_frames: int = 3, padding: str = "same") -> CatFrames:
    return CatFrames(N=num_frames, dim=-1, in_keys=["frame"], out_keys=["stack"], padding=padding)


class Seen:
    """An evaluator that records the stacks it is shown."""

    in_keys = ["stack"]

    def __init__(self) -> None:
        self.stacks: list[list[float]] = []

    def __call__(self, td: TensorDictBase) -> torch.Tensor:
        self.stacks += td["stack"].tolist()
        return torch.zeros(td.batch_size[0])


@pytest.mark.parametrize(
    ("locked", "batch_size"), [(False, ()), (False, (1,)), (False, (2,)), (True, ())]
)
@pytest.mark.parametrize("padding", ["same", "constant"])
def test_every_node_has_the_frames_of_its_own_path(
    locked: bool, padding: str, batch_size: tuple[int, ...]
) -> None:
    seen = Seen()
    env = numbered(batch_size, locked=locked)
    env.append_transform(stack(padding=padding))
    planner = MCTSPlanner(env, leaf_evaluator=seen, expand="one", seed=0, budget=ALL)
    planner(env.reset())
    tree = planner.last_search.tree
    roots = torch.Size(batch_size).numel()
    for b in range(roots):
        for node in range(1, int(tree.num_nodes[b])):
            numbers = [float(tree.states["state"][b, n]) for n in tree_path(tree, b, node)]
            path = [0.0, 0.0, *numbers]  # the chain begins in 0, and so does the padding
            assert tree.states["stack"][b, node].tolist() == path[-3:]
    assert len(seen.stacks) > roots


def tree_path(tree: Any, b: int, node: int) -> list[int]:
    """The nodes from the root to a node."""
    above = [node]
    while above[0]:
        above.insert(0, int(tree.nodes["parent"][b, above[0]]))
    return above


@pytest.mark.parametrize("locked", [False, True])
@pytest.mark.parametrize("options", [False, True])
def test_planning_in_the_env_that_is_acted_in_changes_nothing_of_what_it_shows(
    options: bool, locked: bool
) -> None:
    def run(plans: bool) -> list[Any]:
        env = numbered(locked=locked)
        for transform in (stack(), StepCounter(), RewardSum(), InitTracker()):
            env.append_transform(transform)
        if options:
            env.append_transform(follow(max_steps=2))
        planner = MCTSPlanner(env, budget=simulations(9), seed=0)
        td, shown = env.reset(), []
        for action in (1, 1, 0, 1):
            if plans:
                planner(td.clone())
            td = env.step(td.set(planner.option_key, torch.tensor(action)))["next"]
            shown.append([td[key].tolist() for key in ("state", "stack", "step_count")])
            td = td.exclude("reward")
        return shown

    assert run(plans=True) == run(plans=False)
    ends = [2, 4, 2, 4] if options else [1, 2, 1, 2]
    assert [state for state, _, _ in run(plans=True)] == ends


def test_frames_inside_an_option_follow_its_row() -> None:
    env = numbered((2,))
    env.append_transform(stack())
    worker = TensorDictModule(lambda skill: skill, ["skill"], ["action"])
    env.append_transform(OptionTransform(worker, 2, 4, termination=lambda td: td["state"] % 5 == 0))
    td = env.step(env.reset().set("option", torch.tensor([1, 0])))["next"].exclude("reward")
    assert td["stack"].tolist() == [[2, 3, 4], [0, 0, 0]]  # four steps right; one against the wall
    td = env.step(td.set("option", torch.tensor([1, 1])))["next"]
    assert td["stack"].tolist() == [[3, 4, 5], [2, 3, 4]]  # the first ends in 5


def norm(frozen: bool, kind: Any = VecNormV2) -> Transform:
    transform = kind(in_keys=["frame"])
    if frozen:
        transform.freeze()
    return transform


VEC_NORM = "ignore:Support of VecNormV2 for:UserWarning"


@pytest.mark.filterwarnings(VEC_NORM)
@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: norm(False), r"its VecNormV2 keeps a state elsewhere.* Freeze it first"),
        (lambda: TimeMaxPool(["frame"], T=2), r"TimeMaxPool .* Stack them by CatFrames"),
        (
            lambda: Compose(StepCounter(), RandomTruncationTransform(1, 5)),
            r"RandomTruncationTransform .* Use StepCounter",
        ),
        (
            lambda: Compose(stack(), ObservationNorm(0.0, 2.0, in_keys=["stack"])),
            r"the entry 'stack'. It is written again by ObservationNorm",
        ),
        (lambda: Compose(stack(), RenameTransform(["stack"], ["x"])), "'stack'. It is taken away"),
    ],
)
@pytest.mark.parametrize("below", [False, True])
def test_a_transform_whose_state_cannot_be_set_is_refused_by_name(
    make: Callable[[], Transform], message: str, below: bool
) -> None:
    env = numbered()
    env.append_transform(make())
    if below:
        env.append_transform(follow())
    with pytest.raises(ValueError, match=message):
        MCTSPlanner(env)


def test_frames_that_are_kept_in_the_envs_of_a_batch_are_refused() -> None:
    def make() -> EnvBase:
        env = numbered()
        env.append_transform(stack())
        return env

    with pytest.raises(ValueError, match="CatFrames keeps a state elsewhere: .* inside SerialEnv"):
        MCTSPlanner(SerialEnv(2, make))


class OwnBuffer(Transform):
    """Shows the frame before this one, which it keeps in a buffer."""

    def __init__(self) -> None:
        super().__init__(in_keys=["frame"], out_keys=["last_frame"])
        self.register_buffer("kept", torch.zeros(1))
        self.recent: deque[torch.Tensor] = deque([torch.zeros(1)], maxlen=1)

    def _reset(self, td: TensorDictBase, after: TensorDictBase) -> TensorDictBase:
        return self._step(td, after)

    def _step(self, td: TensorDictBase, after: TensorDictBase) -> TensorDictBase:
        after.set("last_frame", self.last().clone().expand_as(after["frame"]))
        self.keep(after["frame"].reshape(-1, 1)[0].clone())
        return after

    def last(self) -> torch.Tensor:
        return self.kept

    def keep(self, frame: torch.Tensor) -> None:
        self.kept = frame

    def transform_observation_spec(self, spec: Composite) -> Composite:
        spec["last_frame"] = spec["frame"].clone()
        return spec


class OwnDeque(OwnBuffer):
    def last(self) -> torch.Tensor:
        return self.recent[-1]

    def keep(self, frame: torch.Tensor) -> None:
        self.recent.append(frame)


@pytest.mark.parametrize(("kind", "name"), [(OwnBuffer, "kept"), (OwnDeque, "recent")])
def test_what_a_transform_of_ones_own_keeps_is_found_and_put_back(kind: Any, name: str) -> None:
    env = numbered()
    env.append_transform(kind())
    td = env.reset()
    td = env.step(td.set("action", torch.tensor(1)))["next"].exclude("reward")
    planner = MCTSPlanner(env, budget=ALL)
    with pytest.raises(ValueError, match=rf"{kind.__name__}.{name} of ChainEnv changed while"):
        planner(td.clone())
    assert env.step(td.set("action", torch.tensor(1)))["next", "last_frame"].tolist() == [1.0]
    with pytest.raises(ContractError, match=rf"{kind.__name__}.{name} changes as the env"):
        check_macro_env(env)


@pytest.mark.filterwarnings(VEC_NORM)
def test_a_frozen_normaliser_and_counts_in_the_tensordict_are_planned_with() -> None:
    env = numbered()
    normaliser = VecNormV2(in_keys=["frame"])
    for transform in (normaliser, StepCounter(5), RewardSum(), InitTracker()):
        env.append_transform(transform)
    env.rollout(3)
    normaliser.freeze()
    before = normaliser.loc["frame"].clone()
    planner = MCTSPlanner(env, budget=ALL, seed=0)
    planner(env.reset())
    tree = planner.last_search.tree
    counts = tree.states["step_count"][0, : int(tree.num_nodes[0])].flatten().tolist()
    assert counts == tree.nodes["depth"][0, : len(counts)].tolist()
    assert torch.equal(normaliser.loc["frame"], before)


# ---------------------------------------------------------------------- one state at a time


@pytest.mark.parametrize("num_steps", [1, 3])
@pytest.mark.parametrize("with_end", [False, True])
@pytest.mark.parametrize("counted", [False, True])
def test_an_env_of_one_state_gives_the_tree_of_a_stateless_one(
    counted: bool, with_end: bool, num_steps: int
) -> None:
    trees = []
    for base in (ChainEnv(length=6, reward_per_step=-0.1), LockedChain(6, reward_per_step=-0.1)):
        env = TransformedEnv(base, StepCounter(7) if counted else Compose())
        worker = TensorDictModule(lambda skill: skill, ["skill"], ["action"])
        ends = (lambda td: td["state"] == 2) if with_end else None
        env.append_transform(OptionTransform(worker, 2, num_steps, 0.9, ends))
        planner = MCTSPlanner(env, budget=expansions(30), seed=0)
        trees.append(planner.search(env.reset()).tree)
    num_nodes = int(trees[0].num_nodes[0])
    assert num_nodes == int(trees[1].num_nodes[0]) > 10
    for name in ("value", "visits", "reward", "parent", "base_steps", "flags"):
        assert (trees[0].nodes[name][0, :num_nodes] == trees[1].nodes[name][0, :num_nodes]).all()
    for key in ("state", "step_count") if counted else ("state",):
        one, two = (tree.states[key][0, :num_nodes] for tree in trees)
        assert torch.equal(one, two)


# ---------------------------------------------------------------------- states that are not told


class Shy(ChainEnv):
    """Steps from the state in the tensordict, as Brax does, and does not say so."""

    batch_locked, _supports_set_state = True, False


class HiddenClock(Shy):
    """Pays more from step to step of an episode, by a count that the state leaves out."""

    count = 0

    def _reset(self, tensordict: Any = None, **kwargs: Any) -> TensorDictBase:
        self.count = 0
        return super()._reset(tensordict, **kwargs)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        self.count += 1
        out = super()._step(tensordict)
        return out.set("reward", out["reward"] + self.count)


@pytest.mark.parametrize("batch_size", [(), (3,)])
def test_a_simulator_that_does_not_say_that_it_is_one_is_one_by_declaration(
    batch_size: tuple[int, ...],
) -> None:
    with pytest.raises(ValueError, match=r"declare it by StatelessSimulator\(env\)"):
        MCTSPlanner(Shy(length=5))
    env = TransformedEnv(StatelessSimulator(Shy(length=8, batch_size=batch_size)), follow())
    check_macro_env(env)
    plan = MCTSPlanner(env).plan(env.reset())
    assert plan.options.reshape(-1, 3).tolist() == [[1, 1, 1]] * plan.options.shape[:-1].numel()


def test_a_declaration_that_is_not_true_is_found_out() -> None:
    with pytest.raises(ContractError, match="Its state is not all in state_spec"):
        check_macro_env(StatelessSimulator(HiddenClock(length=30)), num_steps=6)


@pytest.mark.parametrize("state_keys", [["nowhere"], []])
def test_a_declaration_names_entries_that_exist(state_keys: list[str]) -> None:
    with pytest.raises(ValueError, match=r"got state_keys=.*Shy writes \['state'\]"):
        StatelessSimulator(Shy(), state_keys=state_keys)

"""The engine without tensordicts: closed forms, agreement with the planner, and bad input."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import pytest
import torch
from search_parts import simulations, trees, uct_in_python
from tensordict import TensorDict

from torchrl_hmcts.planners import (
    PUCT,
    UCT,
    Gumbel,
    MCTSPlanner,
    Root,
    Search,
    Transition,
    tree_search,
)
from torchrl_hmcts.testing import TableEnv

F32, UCT_IN_PYTHON = np.float32, uct_in_python(0.7)


def uniform(m: int, num_options: int) -> np.ndarray:
    return np.full((m, num_options), 1.0 / num_options, F32)


def visits(search: Search, b: int = 0) -> list[int]:
    return search.tree.edges["visits"][b, 0].tolist()


# ---------------------------------------------------------------------- closed forms


def bandit(rewards: list[float], priors: list[float]) -> tuple[Root, Any]:
    """One state whose options all end the episode."""
    prior = np.array([priors], F32)

    def transition(state: np.ndarray, option: np.ndarray) -> Transition:
        zeros = np.zeros(len(state), F32)
        return Transition(np.array(rewards, F32)[option], zeros, prior[state], zeros, state)

    return Root(prior, np.zeros(1, F32), np.zeros(1, np.int64)), transition


def test_the_visits_of_a_bandit_follow_puct_by_hand() -> None:
    # Q + 2 P sqrt(sum N) / (1 + N) with rewards 1, 0, 2 and priors 1/2, 1/4, 1/4; an option never
    # tried is worth 0. Written: scores, and what is taken.
    #   N = 0 0 0: all 0, the highest prior             -> 0
    #   N = 1 0 0: 1 + 1/2;      1/2;    1/2            -> 0
    #   N = 2 0 0: 1 + .471;     .707;   .707           -> 0
    #   N = 3 0 0: 1 + .433;     .866;   .866           -> 0
    #   N = 4 0 0: 1 + 2/5;      1;      1              -> 0
    #   N = 5 0 0: 1 + .373;     1.118;  1.118          -> 0
    #   N = 6 0 0: 1 + .350;     1.225;  1.225          -> 0
    #   N = 7 0 0: 1 + .331;     1.323;  1.323          -> 0 (1.331)
    #   N = 8 0 0: 1 + .314;     1.414;  1.414          -> 1 (a tie, the lower index)
    #   N = 8 1 0: 1 + 3/9;      3/4;    3/2            -> 2
    #   N = 8 1 1: 1 + .351;     .791;   2 + .791       -> 2, and from now on
    root, transition = bandit([1.0, 0.0, 2.0], [0.5, 0.25, 0.25])
    for number, expected in [
        (1, [1, 0, 0]),
        (8, [8, 0, 0]),
        (9, [8, 1, 0]),
        (10, [8, 1, 1]),
        (11, [8, 1, 2]),
        (30, [8, 1, 21]),
    ]:
        search = tree_search(root, transition, number, tree_policy=PUCT(c=2.0))
        assert visits(search) == expected
        # The mean of the root's own value of 0 and every reward that was backed up.
        mean = (expected[0] + 2 * expected[2]) / (1 + number)
        assert search.tree.nodes["value"][0, 0] == pytest.approx(mean)
        assert search.num_simulations.tolist() == [number]
        assert search.roots["revisits"][0] == number - sum(n > 0 for n in expected)


def test_the_value_of_a_loop_is_its_geometric_series() -> None:
    # One option that pays 1 for ever, D = 1/2: with max backup after n steps 2 - 2^(1 - n).
    def transition(state: np.ndarray, option: np.ndarray) -> Transition:
        ones = np.ones(len(state), F32)
        return Transition(ones, ones / 2, uniform(len(state), 1), 0 * ones, state)

    root = Root(np.ones((1, 1), F32), np.zeros(1, F32), np.zeros(1, np.int64))
    for n in (1, 2, 5, 20):
        search = tree_search(root, transition, n, backup="max")
        assert search.tree.nodes["value"][0, 0] == pytest.approx(2 - 2 ** (1 - n), rel=1e-6)
        assert search.tree.nodes["depth"][0, n] == n
        assert search.tree.nodes["base_steps"][0, n] == n


def test_a_value_behind_a_discount_of_zero_does_not_count() -> None:
    def transition(state: np.ndarray, option: np.ndarray) -> Transition:
        ones = np.ones(len(state), F32)
        return Transition(ones, 0 * ones, uniform(len(state), 2), 100 * ones, state)

    root = Root(uniform(1, 2), np.zeros(1, F32), np.zeros(1, np.int64))
    search = tree_search(root, transition, 10)
    assert search.tree.nodes["value"][0, 0] == pytest.approx(10 / 11)
    assert search.tree.nodes["raw_value"][0, 1:3].tolist() == [0.0, 0.0]


# ---------------------------------------------------------------------- a random MDP, two ways

NUM_STATES, NUM_OPTIONS, GAMMA = 12, 3, 0.9


class Table:
    """A random MDP as a transition function and as an env; the last state is terminal."""

    def __init__(self, seed: int) -> None:
        rng = np.random.default_rng(seed)
        shape = (NUM_STATES, NUM_OPTIONS)
        self.next_state = rng.integers(0, NUM_STATES, shape)
        self.reward = rng.uniform(-1, 1, shape).astype(F32)
        self.prior = rng.dirichlet(np.ones(NUM_OPTIONS), NUM_STATES).astype(F32)
        self.value = rng.uniform(-1, 1, NUM_STATES).astype(F32)
        self.calls: list[int] = []

    def __call__(self, state: np.ndarray, option: np.ndarray) -> Transition:
        self.calls.append(len(state))
        after = self.next_state[state, option]
        discount = np.where(after == NUM_STATES - 1, F32(0), F32(GAMMA))
        return Transition(
            self.reward[state, option], discount, self.prior[after], self.value[after], after
        )

    def root(self, states: list[int]) -> Root:
        return Root(self.prior[states], self.value[states], np.array(states))

    def planner(self, **kwargs: Any) -> MCTSPlanner:
        table = {
            (s, a): (int(self.next_state[s, a]), float(self.reward[s, a]), 1)
            for s in range(NUM_STATES - 1)
            for a in range(NUM_OPTIONS)
        }
        values, priors = torch.from_numpy(self.value), torch.from_numpy(self.prior)
        return MCTSPlanner(
            TableEnv(table, terminal=[NUM_STATES - 1]),
            gamma=GAMMA,
            leaf_evaluator=lambda td: values[td["state"]],
            option_prior=lambda td: priors[td["state"]],
            expand="one",
            **kwargs,
        )


POLICIES = [UCT(0.7), PUCT(1.0), PUCT.mctx(), PUCT(normalize="tree"), Gumbel(max_considered=2)]


@pytest.mark.parametrize("policy", POLICIES, ids=str)
@pytest.mark.parametrize("backup", ["mean", "max"])
def test_the_tree_is_that_of_the_planner_on_the_same_mdp(policy: Any, backup: Any) -> None:
    table, states = Table(seed=1), [0, 3, 7]
    engine = tree_search(table.root(states), table, 60, tree_policy=policy, backup=backup, seed=5)
    planner = table.planner(
        tree_policy=policy,
        backup=backup,
        exhausted="revisit",
        budget=simulations(60),
    )
    td = planner.simulator.env.reset(
        TensorDict({"state": torch.tensor(states)}, [3]), set_state=True
    )
    search = planner.search(td, seed=5)
    assert engine.num_simulations.tolist() == [60] * 3
    assert trees(engine) == trees(search)


def test_a_root_has_the_same_tree_whatever_is_searched_beside_it() -> None:
    table, policy = Table(seed=3), Gumbel()
    together = tree_search(table.root([0, 4, 9]), table, 40, tree_policy=policy, seed=10)
    for b, state in enumerate([0, 4, 9]):
        alone = tree_search(table.root([state]), table, 40, tree_policy=policy, seed=10 + b)
        assert trees(alone)[0] == trees(together)[b]


def test_masked_options_of_a_root_are_never_tried_there() -> None:
    table = Table(seed=4)
    mask = np.array([[True, False, True], [False, False, True]])
    for policy in POLICIES:
        for given in (mask, torch.from_numpy(mask)):
            search = tree_search(table.root([0, 1]), table, 50, tree_policy=policy, mask=given)
            tried = search.tree.edges["visits"][:, 0] > 0
            assert (tried == mask).all()
            assert search.allowed().tolist() == mask.tolist()
            below = search.tree.edges["visits"][0, 1:].sum(0)
            assert (below > 0).all()  # the mask is the root's alone


@pytest.mark.parametrize("exhausted", ["skip", "revisit"])
def test_a_tree_policy_in_python_grows_the_same_tree(exhausted: Any) -> None:
    table = Table(seed=5)
    kwargs: dict[str, Any] = {"exhausted": exhausted}
    compiled = tree_search(table.root([0, 4]), table, 50, tree_policy=UCT(0.7), **kwargs)
    python = tree_search(table.root([0, 4]), table, 50, tree_policy=UCT_IN_PYTHON, **kwargs)
    assert trees(compiled) == trees(python)


# ---------------------------------------------------------------------- embeddings

Code = Callable[[np.ndarray], np.ndarray]
Decode = Callable[[np.ndarray], np.ndarray]


# How a state is written as an embedding, and read back.
EMBEDDINGS: dict[str, tuple[Code, Decode]] = {
    "int64": (lambda s: s, lambda e: e),
    "float32 [m, 3]": (
        lambda s: np.stack([s * 0.5, -s, s], 1).astype(F32),
        lambda e: e[:, 2].astype(np.int64),
    ),
    "int64 [m, 1]": (lambda s: s[:, None], lambda e: e[:, 0]),  # NumPy gives the axis no stride
    "uint8 [m, 128]": (
        lambda s: np.repeat(s[:, None], 128, 1).astype(np.uint8),
        lambda e: e[:, 127].astype(np.int64),
    ),
    "bool [m, 2, 6]": (
        lambda s: np.eye(NUM_STATES, dtype=np.bool_)[s].reshape(-1, 2, 6),
        lambda e: e.reshape(-1, NUM_STATES).argmax(-1),
    ),
}


@pytest.mark.parametrize("kind", EMBEDDINGS)
@pytest.mark.parametrize("tensors", [False, True])
@pytest.mark.parametrize("policy", [PUCT(), UCT_IN_PYTHON])
def test_embeddings_of_any_shape_and_dtype_give_the_same_tree(
    kind: str, tensors: bool, policy: Any
) -> None:
    table, (code, decode) = Table(seed=6), EMBEDDINGS[kind]
    plain = tree_search(table.root([0, 8]), table, 40, tree_policy=policy)
    shape, dtype = code(np.zeros(2, np.int64)).shape[1:], code(np.zeros(2, np.int64)).dtype

    def transition(embedding: Any, option: Any) -> Transition:
        assert isinstance(embedding, torch.Tensor) == isinstance(option, torch.Tensor) == tensors
        if tensors:
            embedding, option = embedding.numpy(), option.numpy()
        assert embedding.shape[1:] == shape
        assert embedding.dtype == dtype
        assert option.dtype == np.int64
        answer = table(decode(embedding), option)
        answer = answer._replace(embedding=np.ascontiguousarray(code(answer.embedding)))
        return Transition(*map(torch.from_numpy, answer)) if tensors else answer

    root = table.root([0, 8])
    root = root._replace(embedding=np.ascontiguousarray(code(root.embedding)))
    if tensors:
        root = Root(*map(torch.from_numpy, root))
    assert trees(tree_search(root, transition, 40, tree_policy=policy)) == trees(plain)


class Place(NamedTuple):
    at: Any
    seen: Any


def chain(at: np.ndarray, option: np.ndarray) -> Transition:
    at = np.clip(at + 2 * option - 1, 0, 4)
    end = (at == 4).astype(F32)
    return Transition(end, F32(0.9) * (1 - end), uniform(len(at), 2), 0 * end, at)


def of_dicts(state: Any, option: Any) -> Transition:
    out = chain(state["at"], option)
    return out._replace(embedding={"deep": {"n": state["deep"]["n"] + 1}, "at": out.embedding})


def of_tuples(state: Any, option: Any) -> Transition:
    assert isinstance(state, Place)
    out = chain(state.at, option)
    return out._replace(embedding=Place(out.embedding, (state.seen[0],)))


def of_tensordicts(state: Any, option: Any) -> Transition:
    assert state.batch_size == option.shape
    *numbers, at = map(torch.from_numpy, chain(state["at"].numpy(), option.numpy()))
    return Transition(*numbers, TensorDict(at=at, batch_size=at.shape))


def of_objects(states: Any, option: Any) -> Transition:
    out = chain(np.array([state["at"] for state in states]), option)
    return out._replace(embedding=[{"at": int(at)} for at in out.embedding])


STARTS = np.array([2, 1])


@pytest.mark.parametrize(
    ("states", "transition", "tensors"),
    [
        ({"at": STARTS, "deep": {"n": np.zeros((2, 3), np.int8)}}, of_dicts, False),
        (Place(STARTS, (np.zeros(2, bool),)), of_tuples, False),
        (TensorDict(at=torch.from_numpy(STARTS), batch_size=[2]), of_tensordicts, True),
        ([{"at": 2}, {"at": 1}], of_objects, False),
    ],
    ids=["mapping", "tuple", "TensorDict", "list"],
)
@pytest.mark.parametrize("policy", [PUCT(), UCT_IN_PYTHON])
def test_states_of_any_structure_give_the_tree_of_an_array(
    states: Any, transition: Any, tensors: bool, policy: Any
) -> None:
    found = []
    for embedding, step in ((STARTS, chain), (states, transition)):
        root = Root(uniform(2, 2), np.zeros(2, F32), embedding)
        if tensors and embedding is states:
            root = root._replace(prior=torch.from_numpy(root.prior), value=torch.zeros(2))
        tree = tree_search(root, step, 30, tree_policy=policy).tree
        found.append((tree.nodes.tobytes(), tree.edges.tobytes()))
    assert found[0] == found[1]


@pytest.mark.parametrize(
    ("embedding", "transition", "message"),
    [
        ({"at": STARTS}, lambda s, o: chain(s["at"], o), "embedding is built as the roots'"),
        (
            {"at": STARTS},
            lambda s, o: chain(s["at"], o)._replace(embedding={"at": s["at"].astype(F32)}),
            r"int64 \[2\].*got.*float32 \[2\]",
        ),
        ({"at": STARTS}, lambda s, o: 3, "got {'embedding': 'None'}"),
        ({"at": STARTS, "x": torch.zeros(2)}, chain, "holds NumPy arrays only, or tensors"),
        ({"at": STARTS, "x": np.zeros(3)}, chain, "one row for each root.*'at'.*2.*'x'.*3"),
        ({}, chain, "holds NumPy arrays only, or tensors; got {}"),
        ([1], chain, "one row for each of the 2 rows"),
        ([1, 2], lambda s, o: chain(np.array(s), o), "a list of 2 states.*got array int64"),
        (5.0, chain, "or a list of states; got a float"),
    ],
)
def test_structures_that_do_not_fit_are_named(
    embedding: Any, transition: Any, message: str
) -> None:
    root = Root(uniform(2, 2), np.zeros(2, F32), embedding)
    with pytest.raises((TypeError, ValueError), match=message):
        tree_search(root, transition, 10)


def test_a_network_with_gradients_may_be_the_transition_function() -> None:
    net = torch.nn.Linear(4, 4)

    def transition(state: torch.Tensor, option: torch.Tensor) -> Transition:
        after = torch.tanh(net(state + option[:, None]))
        prior = torch.softmax(after[:, :2], -1)
        return Transition(after[:, 0].clone(), 0.9 + 0 * after[:, 0], prior, after[:, 1] * 1, after)

    root = Root(torch.full((3, 2), 0.5), torch.zeros(3), torch.randn(3, 4))
    search = tree_search(root, transition, 20)
    assert search.tree.edges["visits"][:, 0].sum(-1).tolist() == [20] * 3
    assert net.weight.grad is None


# ---------------------------------------------------------------------- bad input


ROOT = Root(uniform(2, 3), np.zeros(2, F32), np.zeros(2, np.int64))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"prior": np.ones(3, F32)}, r"prior must be \[B, A\]; got \[3\]"),
        ({"prior": np.ones((2, 0), F32)}, r"prior must be \[B, A\]; got \[2, 0\]"),
        ({"prior": np.array([[0.5, np.nan, 0.5]] * 2)}, "prior holds nan, which is no prior"),
        ({"prior": np.array([[0.5, -0.5, 1.0]] * 2)}, "prior holds -0.5, which is no prior"),
        ({"value": np.zeros(3, F32)}, r"value must have one row for each of the 2.*\[3\]"),
        ({"value": np.zeros((2, 1), F32)}, r"value must have one row.*\[2, 1\]"),
        ({"value": np.array([0.0, np.inf])}, "value holds inf, which is no value"),
        ({"embedding": np.zeros((3, 4))}, r"embedding must have one row.*\[3, 4\]"),
        ({"embedding": torch.tensor(0)}, r"embedding must have one row.*got shape \[\]"),
    ],
)
def test_roots_that_do_not_fit_are_refused(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        tree_search(ROOT._replace(**changes), Table(0), 5)


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"num_simulations": 0}, "num_simulations >= 1; got 0"),
        ({"mask": np.ones(3, np.bool_)}, r"mask must be bool \[2, 3\]; got \[3\]"),
        ({"mask": np.array([[True] * 3, [False] * 3])}, "Root 1 has no option.*all False"),
    ],
)
def test_arguments_out_of_range_are_refused(kwargs: dict[str, Any], message: str) -> None:
    kwargs = {"num_simulations": 5, **kwargs}
    with pytest.raises(ValueError, match=message):
        tree_search(ROOT, Table(0), **kwargs)


def nth(call: int, change: Callable[[Transition], Any]) -> Any:
    """A transition function whose answer is changed in one of its calls, counted from 1."""
    table = Table(seed=7)

    def transition(state: np.ndarray, option: np.ndarray) -> Any:
        answer = table(state, option)
        return change(answer) if len(table.calls) == call else answer

    return transition


@pytest.mark.parametrize("policy", [PUCT(), UCT_IN_PYTHON])
@pytest.mark.parametrize(
    ("name", "make", "error", "message"),
    [
        ("reward", lambda x: x[:, None], ValueError, r"reward as float32 \[2, 1\]; .*\[2\]"),
        ("reward", lambda x: x.astype(np.float64), ValueError, r"reward as float64 \[2\]; .*32"),
        ("discount", lambda x: x[:1], ValueError, r"discount as float32 \[1\]; .*\[2\]"),
        ("prior", lambda x: x[:, :2].copy(), ValueError, r"prior as float32 \[2, 2\]; .*\[2, 3\]"),
        ("value", lambda x: x.astype(int), ValueError, r"value as int64 \[2\]; .*float32"),
        ("value", lambda x: x.tolist(), TypeError, "value as list; return.*a NumPy array"),
        ("reward", torch.from_numpy, TypeError, "reward as Tensor; return.*a NumPy array"),
        ("embedding", lambda x: x.astype(np.int32), ValueError, r"embedding as int32.*int64"),
        (
            "prior",
            lambda x: np.asfortranarray(x),
            ValueError,
            r"prior as float32 \[2, 3\] \(not contiguous\); .*contiguous",
        ),
        ("reward", lambda x: x + np.nan, ValueError, "returned the reward nan; .*finite"),
    ],
)
def test_an_answer_that_does_not_fit_is_named_at_once(
    name: str, make: Any, error: type[Exception], message: str, policy: Any
) -> None:
    transition = nth(1, lambda answer: answer._replace(**{name: make(getattr(answer, name))}))
    root = Table(seed=7).root([0, 1])
    with pytest.raises(error, match=message):
        tree_search(root, transition, 20, tree_policy=policy)


@pytest.mark.parametrize("policy", [PUCT(), UCT_IN_PYTHON])
def test_an_error_inside_the_transition_comes_out_and_breaks_nothing(policy: Any) -> None:
    def fail(answer: Transition) -> Transition:
        raise RuntimeError("the physics exploded")

    table = Table(seed=7)
    healthy = trees(tree_search(table.root([0, 1]), table, 40, tree_policy=policy))
    with pytest.raises(RuntimeError, match="the physics exploded"):
        tree_search(table.root([0, 1]), nth(9, fail), 40, tree_policy=policy)
    assert trees(tree_search(table.root([0, 1]), table, 40, tree_policy=policy)) == healthy

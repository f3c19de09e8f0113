"""A search tree as a graph, as TorchRL's tree, as text and as pictures, against its records."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from matplotlib import pyplot
from matplotlib.collections import LineCollection, PathCollection
from matplotlib.colors import to_rgba
from search_parts import simulations
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Composite, Unbounded

from torchrl_hmcts.planners import (
    UCT,
    MCTSPlanner,
    ProgressiveWidening,
    Root,
    Search,
    SearchBudget,
    SearchTree,
    Transition,
    Transpositions,
    tree_search,
)
from torchrl_hmcts.planners.drawing import layered_layout, option_color
from torchrl_hmcts.planners.tree import CLOSED, EXPANDED, PRUNED, REWARDED, TERMINAL
from torchrl_hmcts.testing import ChainEnv, TableEnv

FLAGS = {
    "expanded": EXPANDED,
    "terminal": TERMINAL,
    "pruned": PRUNED,
    "closed": CLOSED,
    "rewarded": REWARDED,
}


class SlipperyEnv(TableEnv):
    """A table in which option 0 slips into the transition of option 1 half of the time."""

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        action = tensordict.get("action")
        slips = torch.rand(action.shape) < 0.5
        return super()._step(tensordict.copy().set("action", torch.where(slips, 1, action)))


class PlaneEnv(TableEnv):
    """A table whose states also lie in the plane, at (state, state squared)."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.state_spec = Composite(
            state=self.state_spec["state"], place=Composite(position=Unbounded(2))
        )
        self.observation_spec["place"] = Composite(position=Unbounded(2))

    def _place(self, td: TensorDictBase) -> TensorDictBase:
        state = td["state"].float()
        return td.set(("place", "position"), torch.stack((state, state**2), -1))

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        return self._place(super()._step(tensordict))

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDictBase:
        return self._place(super()._reset(tensordict, **kwargs))


# States 0 to 6: 1 and 2 below 0, 3 to 6 below these, terminal, of which 5 pays 1. Option 1 of
# state 1 may not be taken. Options last 3 and 1 base steps.
TABLE = {
    (0, 0): (1, 0.0, 3),
    (0, 1): (2, 0.0, 1),
    (1, 0): (3, 0.0, 3),
    (2, 0): (5, 1.0, 3),
    (2, 1): (6, 0.0, 1),
}


def small_search() -> Search:
    planner = MCTSPlanner(
        PlaneEnv(TABLE, terminal=[3, 4, 5, 6]), gamma=0.9, budget=SearchBudget(until_plan=False)
    )
    return planner.search(planner.simulator.env.reset())


def random_search() -> Search:
    table = {(0, 0): (1, 0.0, 1), (0, 1): (2, 0.0, 1), (1, 0): (3, 1.0, 1), (1, 1): (0, 0.0, 1)}
    table |= {(2, 0): (0, 0.0, 1), (2, 1): (2, 0.0, 1)}
    planner = MCTSPlanner(
        SlipperyEnv(table, terminal=[3]),
        gamma=0.9,
        chance=ProgressiveWidening(k=2.0),
        budget=simulations(60),
        expand="one",
        seed=0,
    )
    return planner.search(planner.simulator.env.reset())


def transposed_search() -> Search:
    planner = MCTSPlanner(
        ChainEnv(6),
        gamma=0.9,
        backup="max",
        transpositions=Transpositions("state"),
        budget=SearchBudget(until_plan=False),
    )
    return planner.search(ChainEnv(6).reset())


def large_search(num_nodes: int = 500) -> Search:
    """A chain whose end is not found, so that there is no plan."""
    budget = SearchBudget(nodes=num_nodes, expansions=None, until_plan=False)
    planner = MCTSPlanner(ChainEnv(1_000), tree_policy=UCT(c=0.5), budget=budget)
    return planner.search(ChainEnv(1_000).reset())


def deep_tree(depth: int) -> SearchTree:
    """A tree of one option, of which each node has one child."""
    tree = SearchTree(1, 1, capacity=depth + 1)
    nodes, edges = tree.nodes[0], tree.edges[0]
    index = np.arange(depth + 1)
    nodes["parent"], nodes["depth"], nodes["base_steps"] = index - 1, index, 2 * index
    nodes["option"][0], nodes["sibling"], nodes["twin"] = -1, -1, -1
    nodes["visits"], nodes["samples"], nodes["discount"] = depth + 1 - index, 1, 0.9
    edges["child"][:, 0] = np.where(index < depth, index + 1, -1)
    edges["visits"][:-1, 0] = nodes["visits"][1:]
    edges["prior"] = 1.0
    tree.roots["num_nodes"], tree.roots["best_node"] = depth + 1, depth
    tree.set_states(
        np.zeros(depth + 1, np.int64), index, TensorDict({"state": torch.arange(depth + 1)})
    )
    return tree


SEARCHES = {"small": small_search, "random": random_search, "transposed": transposed_search}


@pytest.fixture(params=SEARCHES)
def search(request: pytest.FixtureRequest) -> Search:
    return SEARCHES[request.param]()


@pytest.fixture(autouse=True)
def _closed_figures() -> Iterator[None]:
    yield
    pyplot.close("all")


# ---------------------------------------------------------------------- networkx


def test_the_graph_holds_the_records(search: Search) -> None:
    tree, graph = search.tree, search.tree.to_networkx()
    assert list(graph.nodes) == list(range(tree.num_nodes[0]))
    assert graph.number_of_edges() == tree.num_nodes[0] - 1
    assert graph.graph == {
        "num_nodes": tree.num_nodes[0],
        "best_node": tree.roots["best_node"][0],
    }
    for n, attributes in graph.nodes(data=True):
        node = tree.nodes[0, n]
        for name in ("visits", "value", "depth", "base_steps", "path_return", "twin"):
            assert attributes.pop(name) == node[name], name
        for name, bit in FLAGS.items():
            assert attributes.pop(name) is bool(node["flags"] & bit), name
        assert not attributes
    for above, below, attributes in graph.edges(data=True):
        node = tree.nodes[0, below]
        assert above == node["parent"]
        edge = tree.edges[0, above, node["option"]]
        for name in ("option", "reward", "discount", "samples"):
            assert attributes.pop(name) == node[name], name
        for name in ("visits", "value", "prior"):
            assert attributes.pop(name) == edge[name], name
        assert not attributes


def test_several_outcomes_of_an_option_are_several_edges() -> None:
    tree = random_search().tree
    below = tree.to_networkx().out_edges(0, data=True)
    options = [edge["option"] for *_, edge in below]
    assert options.count(0) == 2  # it slipped, and it did not
    assert options.count(1) == 1
    drawn = sum(edge["samples"] for *_, edge in below if edge["option"] == 0)
    assert drawn == tree.edges["samples"][0, 0, 0]
    assert drawn > 2


def test_a_state_known_from_elsewhere_names_its_twin() -> None:
    graph = transposed_search().tree.to_networkx(states=True)
    twins = {n: node["twin"] for n, node in graph.nodes(data=True) if node["twin"] >= 0}
    assert len(twins) == 5
    for n, twin in twins.items():
        assert graph.nodes[n]["state"] == graph.nodes[twin]["state"]


def test_states_come_with_the_graph_if_asked_for() -> None:
    graph = small_search().tree.to_networkx(states=True)
    assert graph.nodes[0]["state"] == {"state": 0, ("place", "position"): [0.0, 0.0]}
    assert "state" not in small_search().tree.to_networkx().nodes[0]


@pytest.mark.parametrize("max_nodes", [1, 2, 17, 100])
def test_a_part_of_the_graph_is_a_tree_of_the_most_visited_nodes(max_nodes: int) -> None:
    tree = large_search().tree
    graph = tree.to_networkx(max_nodes=max_nodes)
    assert len(graph) == max_nodes
    assert graph.number_of_edges() == max_nodes - 1
    assert all(tree.nodes["parent"][0, n] in graph for n in graph if n)
    visits = tree.nodes["visits"][0, : tree.num_nodes[0]]
    shown = sorted((int(visits[n]) for n in graph), reverse=True)
    assert shown == sorted(visits.tolist(), reverse=True)[:max_nodes]


def test_without_networkx_the_error_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "networkx", None)
    with pytest.raises(ImportError, match="pip install networkx"):
        small_search().tree.to_networkx()


# ---------------------------------------------------------------------- torchrl


def depths(tree: Any) -> dict[int, int]:
    """Options from the root to each vertex."""
    return {vertex.node_id: len(path) for path, vertex in tree.vertices(key_type="path").items()}


def test_torchrls_tree_has_the_same_vertices(search: Search) -> None:
    tree, exported = search.tree, search.tree.to_torchrl()
    count = int(tree.num_nodes[0])
    assert exported.num_vertices() == exported.num_vertices(count_repeat=True) == count
    assert depths(exported) == dict(enumerate(tree.nodes["depth"][0, :count].tolist()))
    assert exported.max_length() == tree.nodes["depth"][0, :count].max()
    parents = tree.nodes["parent"][0, :count].tolist()
    assert sorted(exported.edges()) == sorted(zip(parents[1:], range(1, count), strict=True))
    assert tree.states is not None
    for n, vertex in exported.vertices(key_type="id").items():
        node = tree.nodes[0, n]
        assert vertex.count == vertex.visits == node["visits"]
        assert vertex.wins == pytest.approx(node["visits"] * node["value"])
        assert (vertex.node_data == tree.states[0, n]).all()
        assert bool(vertex.is_terminal) == bool(node["flags"] & TERMINAL)
        if n:
            step = vertex.rollout[0]
            assert vertex.branching_action.item() == vertex.prev_action.item() == node["option"]
            assert step["next", "reward"].item() == node["reward"]
            assert step["next", "discount"].item() == node["discount"]
            assert (step["state"] == tree.states["state"][0, node["parent"]]).all()


def test_a_rollout_along_torchrls_tree_is_that_of_the_env() -> None:
    tree = small_search().tree
    rollout = tree.to_torchrl().rollout_from_path((1, 0))
    assert rollout["state"].tolist() == [0, 2]
    assert rollout["action"].tolist() == [1, 0]
    assert rollout["next", "state"].tolist() == [2, 5]
    assert rollout["next", "place", "position"].tolist() == [[2.0, 4.0], [5.0, 25.0]]
    for key, values in (("duration", [1, 3]), ("reward", [0.0, 1.0]), ("done", [False, True])):
        assert rollout["next", key].tolist() == [[value] for value in values]
    assert (rollout["next", "terminated"] == rollout["next", "done"]).all()


def test_torchrls_tree_is_a_copy() -> None:
    tree = small_search().tree
    exported = tree.to_torchrl()
    visits = exported.count.clone()
    tree.nodes["visits"] += 1
    assert tree.states is not None
    tree.states["state"] += 1
    assert exported.count == visits
    assert exported.node_data["state"] == 0


def test_a_truncated_node_is_done_and_not_terminated() -> None:
    tree = small_search().tree
    tree.nodes["discount"][0, 3] = 0.9
    step = tree.to_torchrl().get_vertex_by_id(3).rollout
    assert step["next", "done"].all()
    assert not step["next", "terminated"].any()


def test_a_chain_of_2000_options_is_no_problem() -> None:
    tree = deep_tree(2_000)
    exported = tree.to_torchrl()
    assert exported.num_vertices() == 2_001
    assert exported.max_length() == 2_000
    assert exported.get_vertex_by_id(2_000).count == 1
    assert tree.to_networkx().number_of_edges() == 2_000
    assert marks(tree.plot(max_nodes=None)) == 2_001
    text = tree.summary()
    assert "Best plan: 2,000 options, 4,000 base steps" in text
    assert "... 1,961 options left out ..." in text
    assert len(text.splitlines()) < 60


# ---------------------------------------------------------------------- text


def test_the_summary_reads_as_it_should() -> None:
    text = small_search().tree.summary(option_names=["slow", "quick"])
    # node 2 has its own evaluation 0, and the returns 1 and 0; node 1 its own and 0
    assert text.splitlines() == [
        "Search tree: 6 nodes, 3 expanded, 3 terminal; depth 2",
        "Root: 6 visits, value V = 0.1500",
        "",
        "option   visits                              Q  prior",
        "1 quick       3  60.0 % |#######     |  0.3000  0.500",
        "0 slow        2  40.0 % |#####       |  0.0000  0.500",
        "",
        "Best plan: 2 options, 4 base steps, return 0.9000",
        "",
        "  #  option   steps       R  return       Q       V  visits",
        "  1  1 quick      1  0.0000  0.0000  0.3000  0.3333       3",
        "  2  0 slow       4  1.0000  0.9000  1.0000  0.0000       1",
    ]


def test_without_a_plan_the_summary_follows_the_visits() -> None:
    tree = large_search().tree
    lines = tree.summary().splitlines()
    begin = lines.index("No plan found yet. Most visited path:") + 3
    node = 0
    for line in lines[begin:]:
        option = int(tree.edges["visits"][0, node].argmax())
        node = int(tree.edges["child"][0, node, option])
        cells = line.split()
        assert int(cells[1]) == option
        assert int(cells[-1]) == tree.nodes["visits"][0, node]
    assert not tree.edges["visits"][0, node].any()


def test_the_summary_says_which_options_are_not_allowed() -> None:
    env = TableEnv(TABLE, terminal=[3, 4, 5, 6], start=1)
    text = MCTSPlanner(env).search(env.reset()).tree.summary()
    row = next(line for line in text.splitlines() if line.startswith("1 "))
    assert row.split() == ["1", "not", "allowed"]


def test_the_summary_counts_known_states_and_says_where_they_go_on() -> None:
    search = transposed_search()
    assert "5 of known states" in search.tree.summary()
    assert "It continues" not in search.tree.summary()
    twin = search.tree.nodes["twin"][0, : search.tree.num_nodes[0]]
    search.roots["best_node"] = known = np.flatnonzero(twin >= 0)[-1]
    last = search.tree.summary().splitlines()[-1]
    behind = ", ".join(map(str, search.tree.options(0, int(twin[known]))))
    assert last == f"It continues from the same state behind: {behind}"


def test_a_root_without_children_has_a_summary() -> None:
    env = ChainEnv(3)
    planner = MCTSPlanner(env, budget=SearchBudget(nodes=1, expansions=None, until_plan=False))
    tree = planner.search(env.reset()).tree
    assert "Nothing has been simulated." in tree.summary()
    assert len(tree.to_networkx()) == tree.to_torchrl().num_vertices() == marks(tree.plot()) == 1


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e5, 1e12])
def test_lines_of_the_summary_are_never_too_long(scale: float) -> None:
    tree = small_search().tree
    tree.nodes["visits"] *= 90_000_000
    tree.edges["visits"] *= 90_000_000
    tree.nodes["base_steps"] *= 9_000_000
    for records in (tree.nodes, tree.edges):
        records["value"] *= -scale
    for name in ("reward", "path_return"):
        tree.nodes[name] *= -scale
    text = tree.summary(option_names=["a very long name of an option, indeed"] * 2)
    assert max(map(len, text.splitlines())) <= 88
    assert all(line == line.rstrip() for line in text.splitlines())


# ---------------------------------------------------------------------- pictures


def marks(ax: Any) -> int:
    """Nodes that were drawn."""
    scatters = [c for c in ax.collections if isinstance(c, PathCollection)]
    return sum(len(scatter.get_offsets()) for scatter in scatters)


def segments(ax: Any, width: float | None = None) -> list[np.ndarray]:
    lines = [c for c in ax.collections if isinstance(c, LineCollection)]
    return [
        part for c in lines if width is None or c.get_linewidth()[0] == width
        for part in c.get_segments()
    ]  # fmt: skip


def test_every_node_is_drawn_once_at_its_depth(search: Search) -> None:
    tree, ax = search.tree, search.tree.plot()
    count = int(tree.num_nodes[0])
    assert marks(ax) == count
    ax.figure.canvas.draw()
    drawn = np.concatenate(
        [c.get_offsets() for c in ax.collections if isinstance(c, PathCollection)]
    )
    assert sorted(drawn[:, 1].tolist()) == sorted(tree.nodes["depth"][0, :count].tolist())
    assert len(np.unique(drawn.round(6), axis=0)) == count
    low, high = ax.get_ylim()
    assert low > high  # the root is at the top


def test_values_shape_and_plan_are_drawn() -> None:
    tree = small_search().tree
    ax = tree.plot(option_names=["slow", "quick"])
    circles, squares = (c for c in ax.collections if isinstance(c, PathCollection))
    assert len(circles.get_offsets()) == len(squares.get_offsets()) == 3
    values = tree.nodes["value"][0, :3]
    expected = pyplot.get_cmap("Blues")((values - values.min()) / np.ptp(values))
    np.testing.assert_allclose(circles.get_facecolors(), expected, atol=1e-6)
    areas = circles.get_sizes()
    assert areas[0] > areas[2] > areas[1]  # as 6, 3 and 2 visits
    rims = [tuple(rim) for rim in squares.get_edgecolors()]
    assert rims.count(to_rgba("#16a34a")) == 1  # the rewarded one
    assert len(segments(ax, width=8.0)) == 2  # the band of the best plan
    assert len(segments(ax)) == 5 + 2
    labels = [text.get_text() for text in ax.get_legend().get_texts()]
    assert labels[:5] == ["slow", "quick", "best plan", "terminal", "rewarded"]
    assert ax.get_title(loc="left") == (
        "6 nodes, depth 2, 6 visits, root value 0.15\n"
        "best plan: 2 options, 4 base steps, return 0.9"
    )


def test_edges_have_the_colour_of_their_option() -> None:
    tree = random_search().tree
    ax = tree.plot()
    colors = [
        tuple(color[:3])
        for c in ax.collections
        if isinstance(c, LineCollection) and c.get_zorder() == 2
        for color in c.get_colors()
    ]
    for option in range(2):
        led = (tree.nodes["option"][0, 1 : tree.num_nodes[0]] == option).sum()
        assert colors.count(option_color(option)) == led


def test_known_states_are_hollow_diamonds() -> None:
    ax = transposed_search().tree.plot()
    hollow = [c for c in ax.collections if isinstance(c, PathCollection) and c.get_zorder() == 3]
    assert [len(c.get_offsets()) for c in hollow] == [5]
    assert "known state" in [text.get_text() for text in ax.get_legend().get_texts()]


def test_a_large_tree_is_drawn_in_part_and_says_so() -> None:
    ax = large_search(500).tree.plot(max_nodes=60)
    assert marks(ax) == 60
    assert "shown: the 60 most visited; 441 nodes left out" in ax.get_title(loc="left")


def test_a_picture_goes_into_the_axes_it_is_given() -> None:
    figure, (left, right) = pyplot.subplots(1, 2)
    tree = small_search().tree
    assert tree.plot(ax=left, legend=False) is left
    assert left.get_legend() is None
    assert figure.axes == [left, right]
    tree.plot(ax=right)
    assert len(figure.axes) == 3
    assert marks(right) == 6


@pytest.mark.parametrize("draw", ["plot", "plot_positions"])
def test_without_matplotlib_the_error_says_what_to_install(
    draw: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    tree = small_search().tree
    with pytest.raises(ImportError, match=r"pip install torchrl_hmcts\[train\]"):
        getattr(tree, draw)()


@given(st.lists(st.integers(0, 10**6), max_size=40))
def test_the_layout_is_tidy_for_any_tree(numbers: list[int]) -> None:
    parents = np.array([-1, *(number % (i + 1) for i, number in enumerate(numbers))])
    across = layered_layout(parents, np.arange(len(parents)))
    depth = np.zeros(len(parents), int)
    for row in range(1, len(parents)):
        depth[row] = depth[parents[row]] + 1
    for layer in range(depth.max() + 1):
        assert (np.diff(np.sort(across[depth == layer])) >= 1.0 - 1e-9).all()
    for row in range(len(parents)):
        below = across[parents == row]
        assert (np.diff(below) > 0.0).all()  # in their order
        if len(below):
            assert across[row] == pytest.approx((below[0] + below[-1]) / 2.0)
    mirrored = layered_layout(parents, np.arange(len(parents))[::-1])
    np.testing.assert_allclose(mirrored, -across, atol=1e-9)


# ---------------------------------------------------------------------- positions


def test_positions_are_joined_as_the_nodes_are() -> None:
    tree = small_search().tree
    ax = tree.plot_positions(key=("place", "position"))
    drawn = {tuple(map(tuple, segment.tolist())) for segment in segments(ax)}
    ends = [(0, 1), (0, 2), (1, 3), (2, 5), (2, 6)]
    assert drawn == {((a, a**2), (b, b**2)) for a, b in ends}
    thick = {tuple(segment[1]) for segment in segments(ax, width=3.6)}
    assert thick == {(2.0, 4.0), (5.0, 25.0)}
    root, end = (line.get_xydata()[0].tolist() for line in ax.lines)
    assert (root, end) == ([0.0, 0.0], [5.0, 25.0])


def test_positions_leave_the_limits_of_a_map_alone() -> None:
    ax = pyplot.subplots()[1]
    ax.imshow(np.zeros((4, 3)), extent=(0, 3, 4, 0))
    assert small_search().tree.plot_positions(key=("place", "position"), ax=ax) is ax
    assert (ax.get_xlim(), ax.get_ylim()) == ((0, 3), (4, 0))


@pytest.mark.parametrize(
    ("key", "message"),
    [
        ("position", r"no entry 'position', only .*place.*state"),
        ("state", "draws \\(x, y\\); 'state' has 1 numbers"),
    ],
)
def test_a_key_without_positions_is_refused(key: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        small_search().tree.plot_positions(key=key)


# ---------------------------------------------------------------------- arguments


@pytest.mark.parametrize(
    "method", ["plot", "plot_positions", "summary", "to_networkx", "to_torchrl"]
)
@pytest.mark.parametrize("root", [-1, 1])
def test_a_root_that_does_not_exist_is_refused(method: str, root: int) -> None:
    with pytest.raises(IndexError, match=f"no root {root}: the search has 1"):
        getattr(small_search().tree, method)(root)


@pytest.mark.parametrize("method", ["plot", "to_networkx"])
def test_no_nodes_at_all_are_refused(method: str) -> None:
    with pytest.raises(ValueError, match="max_nodes must be at least 1, the root; got 0"):
        getattr(small_search().tree, method)(max_nodes=0)


@pytest.mark.parametrize("method", ["plot", "summary"])
@pytest.mark.parametrize("names", [["slow"], "ab"])
def test_too_few_names_are_refused(method: str, names: Any) -> None:
    with pytest.raises(ValueError, match="one name for each of the 2 options"):
        getattr(small_search().tree, method)(option_names=names)


def test_each_root_has_its_own_picture_and_text() -> None:
    env = ChainEnv(5)
    td = env.reset(TensorDict({"state": torch.tensor([3, 0])}, [2]), set_state=True)
    tree = MCTSPlanner(env, gamma=0.9).search(td).tree
    sizes = tree.num_nodes.tolist()
    assert sizes[0] < sizes[1]
    for root, size in enumerate(sizes):
        assert len(tree.to_networkx(root)) == size
        assert tree.to_torchrl(root).num_vertices() == size
        assert marks(tree.plot(root)) == size
    assert "Best plan: 1 option, 1 base step, return 1.0000" in tree.summary(0)
    assert "Best plan: 4 options, 4 base steps, return 0.7290" in tree.summary(1)


def test_a_tree_without_states_can_be_looked_at() -> None:
    def transition(state: np.ndarray, option: np.ndarray) -> Transition:
        ones = np.ones(len(state), np.float32)
        return Transition(0 * ones, 0.9 * ones, np.full((len(state), 2), 0.5, "f4"), ones, state)

    root = Root(np.full((1, 2), 0.5, np.float32), np.zeros(1, np.float32), np.zeros(1))
    tree = tree_search(root, transition, 20).tree
    count = int(tree.num_nodes[0])
    assert tree.to_torchrl().num_vertices() == len(tree.to_networkx()) == marks(tree.plot())
    assert tree.summary().startswith(f"Search tree: {count} nodes")
    with pytest.raises(ValueError, match="keeps no states"):
        tree.plot_positions()
    with pytest.raises(ValueError, match="keeps no states"):
        tree.to_networkx(states=True)

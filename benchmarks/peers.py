"""One search in our engine and in other libraries: `python benchmarks/peers.py --help`.

The task: a fixed 9x9 maze, four moves, a model, a prior and values that are table look-ups, so that
the tree search itself is timed. One simulation is a descent, one step of the model, the expansion
and the backup. Everything runs on one core, pinned, with one thread (`taskset -c 0 python ...`
picks the core); the libraries take turns within each repeat, so that noise hits all alike.

Columns: simulations per second of CPU time, per second of wall time, and the first of the two as a
multiple of the reference row (mctx `muzero_policy` where it is installed).

Peers (all optional): `pip install mctx open_spiel`, `pip install --no-deps LightZero` (only its C++
tree is loaded). Letters: B roots, A = 4 actions, N simulations, S = 81 tiles.
"""

from __future__ import annotations

import argparse
import importlib.machinery
import importlib.metadata
import importlib.util
import json
import math
import os
import platform
import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

MAZE = """
.........
.##.###..
.#.....#.
...##.#..
.#..#...#
.##...#..
....#.##.
.#.##....
...#...#.
"""
GOAL = (8, 6)
GAMMA = 0.99
SINGLE_RUN_LIMIT = 60.0  # seconds
SHORTEST_TIMING = 0.2  # seconds; shorter searches are repeated within one timing

Search = Callable[[], np.ndarray]  # runs once, returns the visits of the roots' actions [B, A]


class Skipped(Exception):
    """Why a library cannot run this search; the message goes into the table."""


class MazeTask:
    """The maze as tables over edges (tile * 4 + action) and over tiles; the goal absorbs."""

    def __init__(self, seed: int = 0) -> None:
        free = np.array([[c == "." for c in row] for row in MAZE.split()])
        height, width = free.shape
        self.walls = ~free  # [9, 9]
        self.goal = GOAL[0] * width + GOAL[1]
        next_tile = np.arange(free.size).repeat(4).reshape(height, width, 4)
        for row, col in np.argwhere(free):
            for action, (down, right) in enumerate(((-1, 0), (1, 0), (0, -1), (0, 1))):
                r, c = row + down, col + right
                if 0 <= r < height and 0 <= c < width and free[r, c]:
                    next_tile[row, col, action] = r * width + c
        self.next_tile = next_tile.reshape(-1)  # [S * 4]
        edges_of_goal = slice(4 * self.goal, 4 * self.goal + 4)
        self.next_tile[edges_of_goal] = self.goal
        entered = self.next_tile == self.goal
        self.discount = np.where(entered, 0.0, GAMMA).astype(np.float32)  # [S * 4]
        entered[edges_of_goal] = False
        self.reward = entered.astype(np.float32)  # [S * 4]
        rng = np.random.default_rng(seed)
        weights = np.exp(rng.normal(size=(free.size, 4)))
        self.prior = (weights / weights.sum(-1, keepdims=True)).astype(np.float32)  # [S, 4]
        self.logits = np.log(self.prior)  # [S, 4]
        self.value = rng.uniform(0.0, 0.5, free.size).astype(np.float32)  # [S]
        self.value[self.goal] = 0.0
        self.free_tiles = np.setdiff1d(np.flatnonzero(free), self.goal)

    def roots(self, batch: int, seed: int = 1) -> np.ndarray:
        """Free tiles other than the goal, int64 [B]; distinct while there are enough."""
        rng = np.random.default_rng(seed)
        return rng.choice(self.free_tiles, batch, replace=batch > len(self.free_tiles))


# ------------------------------------------------------------------------------------------- ours


def tree_search_model(task: MazeTask, tiles: np.ndarray) -> tuple[Any, Any]:
    """Root and transition function of the maze for our `tree_search`."""
    from torchrl_hmcts.planners import Root, Transition

    # All tables are over edges, and the embedding is the first edge of the tile: an addition and
    # five look-ups, each of which gives a contiguous array.
    after = task.next_tile
    reward, discount, prior = task.reward, task.discount, task.prior[after]
    value, next_embedding = task.value[after], 4 * after

    def transition(embedding: np.ndarray, option: np.ndarray) -> Any:
        edge = embedding + option
        return Transition(
            reward=reward.take(edge),
            discount=discount.take(edge),
            prior=prior.take(edge, 0),
            value=value.take(edge),
            embedding=next_embedding.take(edge),
        )

    root = Root(prior=task.prior[tiles], value=task.value[tiles], embedding=4 * tiles)
    return root, transition


def ours_tree_search(task: MazeTask, tiles: np.ndarray, num_simulations: int) -> Search:
    try:
        from torchrl_hmcts.planners import PUCT, tree_search
    except ImportError as error:
        raise Skipped("tree_search is missing") from error
    root, transition = tree_search_model(task, tiles)
    policy = PUCT.mctx()

    def run() -> np.ndarray:
        search = tree_search(
            root,
            transition,
            num_simulations=num_simulations,
            tree_policy=policy,
            exhausted="revisit",  # as the peers do
        )
        return search.tree.edges["visits"][:, 0]

    return run


def ours_planner(task: MazeTask, tiles: np.ndarray, num_simulations: int) -> Search:
    import torch

    from torchrl_hmcts.envs import GridworldMazeEnv
    from torchrl_hmcts.planners import PUCT, MCTSPlanner, SearchBudget

    try:
        budget = SearchBudget(simulations=num_simulations, until_plan=False)
    except TypeError as error:
        raise Skipped("SearchBudget(simulations=...) is missing") from error
    env = GridworldMazeEnv(
        torch.from_numpy(task.walls)[None], max_steps=10**9, observation=False, seed=0
    )
    planner = MCTSPlanner(env, tree_policy=PUCT(), expand="one", budget=budget)
    width = task.walls.shape[1]
    player = np.stack((tiles // width, tiles % width), -1)
    state = env.make_state(0, torch.from_numpy(player), GOAL)

    def run() -> np.ndarray:
        return planner.search(state).tree.edges["visits"][:, 0]

    return run


# ------------------------------------------------------------------------------------------ peers


def mctx_search(
    task: MazeTask, num_simulations: int, policy: str = "muzero", **options: Any
) -> Callable[[np.ndarray], tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Compiled mctx search without noise: tiles [B] -> visits [B, A], values [B], actions [B]."""
    try:
        import jax
        import jax.numpy as jnp
        import mctx
    except ImportError as error:
        raise Skipped("not installed: pip install mctx") from error
    names = ("next_tile", "reward", "discount", "value", "logits")
    tables = {name: jnp.asarray(getattr(task, name)) for name in names}
    if policy == "muzero":
        search_policy, no_noise = mctx.muzero_policy, {"dirichlet_fraction": 0.0}
    else:
        search_policy, no_noise = mctx.gumbel_muzero_policy, {"gumbel_scale": 0.0}

    def step(tables: Any, key: Any, action: Any, tile: Any) -> Any:
        edge = 4 * tile + action
        after = tables["next_tile"][edge]
        output = mctx.RecurrentFnOutput(
            reward=tables["reward"][edge],
            discount=tables["discount"][edge],
            prior_logits=tables["logits"][after],
            value=tables["value"][after],
        )
        return output, after

    @jax.jit
    def search(tables: Any, tile: Any) -> Any:
        root = mctx.RootFnOutput(
            prior_logits=tables["logits"][tile], value=tables["value"][tile], embedding=tile
        )
        output = search_policy(
            tables, jax.random.PRNGKey(0), root, step, num_simulations, **no_noise, **options
        )
        summary = output.search_tree.summary()
        return summary.visit_counts, summary.value, output.action

    def run(tiles: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        visits, values, actions = jax.device_get(search(tables, tiles.astype(np.int32)))
        return visits.astype(np.int64), values, actions

    return run


def mctx_muzero(task: MazeTask, tiles: np.ndarray, num_simulations: int) -> Search:
    search = mctx_search(task, num_simulations)
    return lambda: search(tiles)[0]


def mctx_gumbel(task: MazeTask, tiles: np.ndarray, num_simulations: int) -> Search:
    search = mctx_search(task, num_simulations, "gumbel")
    return lambda: search(tiles)[0]


def lightzero_tree() -> Any:
    """LightZero's compiled MuZero tree, without the rest of LightZero."""
    package = importlib.util.find_spec("lzero")
    for folder in package.submodule_search_locations or () if package else ():
        for path in Path(folder, "mcts/ctree/ctree_muzero").glob("mz_tree.*.so"):
            loader = importlib.machinery.ExtensionFileLoader("mz_tree", str(path))
            spec = importlib.util.spec_from_file_location("mz_tree", path, loader=loader)
            module = importlib.util.module_from_spec(spec)
            loader.exec_module(module)
            return module
    raise Skipped("not installed: pip install --no-deps LightZero")


def lightzero(task: MazeTask, tiles: np.ndarray, num_simulations: int) -> Search:
    """The loop of LightZero's MuZeroMCTSCtree.search, with a numpy model.

    It has one discount for all edges; the goal gives nothing more, so returns are the same.
    """
    mz_tree = lightzero_tree()
    batch = len(tiles)
    edge_value, edge_logits = task.value[task.next_tile], task.logits[task.next_tile]
    legal = [[0, 1, 2, 3] for _ in range(batch)]
    one_player = [-1] * batch

    def run() -> np.ndarray:
        roots = mz_tree.Roots(batch, legal)
        roots.prepare_no_noise([0.0] * batch, task.logits[tiles].tolist(), one_player)
        min_max = mz_tree.MinMaxStatsList(batch)
        min_max.set_delta(0.01)
        reached = np.empty((num_simulations + 1, batch), np.int64)
        reached[0] = tiles
        for simulation in range(1, num_simulations + 1):
            results = mz_tree.ResultsWrapper(num=batch)
            wave, row, action, players = mz_tree.batch_traverse(
                roots, 19652, 1.25, GAMMA, min_max, results, one_player
            )
            edge = 4 * reached[wave, row] + action
            reached[simulation] = task.next_tile[edge]
            mz_tree.batch_backpropagate(
                simulation,
                GAMMA,
                task.reward[edge].tolist(),
                edge_value[edge].tolist(),
                edge_logits[edge].tolist(),
                min_max,
                results,
                players,
            )
        return np.array(roots.get_distributions())

    return run


def open_spiel(task: MazeTask, tiles: np.ndarray, num_simulations: int) -> Search:
    """OpenSpiel's Python bot on a Python game: its C++ bot takes no prior or value from Python.

    It knows terminal rewards only, so the game discounts from the root.
    """
    try:
        import pyspiel
        from open_spiel.python.algorithms import mcts
    except ImportError as error:
        raise Skipped("not installed: pip install open_spiel") from error
    if len(tiles) > 1:
        raise Skipped("one root only")
    next_tile = task.next_tile.tolist()
    value = task.value.tolist()
    prior = [list(enumerate(row)) for row in task.prior.tolist()]
    goal = task.goal

    class State:
        __slots__ = ("tile", "weight")

        def __init__(self, tile: int, weight: float) -> None:
            self.tile, self.weight = tile, weight

        def clone(self) -> State:
            return State(self.tile, self.weight)

        def apply_action(self, action: int) -> None:
            self.tile = next_tile[4 * self.tile + action]
            if self.tile != goal:
                self.weight *= GAMMA

        def is_terminal(self) -> bool:
            return self.tile == goal

        def is_chance_node(self) -> bool:
            return False

        def current_player(self) -> int:
            return 0

        def returns(self) -> list[float]:
            return [self.weight]

    class Game:
        def get_type(self) -> Game:
            return self

        reward_model = pyspiel.GameType.RewardModel.TERMINAL
        dynamics = pyspiel.GameType.Dynamics.SEQUENTIAL

        def max_utility(self) -> float:
            return 1.0

    class Tables(mcts.Evaluator):
        def evaluate(self, state: State) -> list[float]:
            return [state.weight * value[state.tile]]

        def prior(self, state: State) -> list[tuple[int, float]]:
            return list(prior[state.tile])

    def run() -> np.ndarray:
        bot = mcts.MCTSBot(
            Game(),
            1.25,
            num_simulations + 1,  # its first one evaluates the root
            Tables(),
            solve=False,
            random_state=np.random.RandomState(0),  # noqa: NPY002  the bot asks for it
            child_selection_fn=mcts.SearchNode.puct_value,
        )
        root = bot.mcts_search(State(int(tiles[0]), 1.0))
        visits = np.zeros((1, 4), np.int64)
        for child in root.children:
            visits[0, child.action] = child.explore_count
        return visits

    return run


class PythonNode:
    """A node and the edge that leads to it: `q` is reward + discount * value."""

    __slots__ = ("children", "discount", "prior", "q", "reward", "tile", "value", "visits")

    def __init__(
        self, tile: int, reward: float, discount: float, prior: list[float], value: float
    ) -> None:
        self.tile, self.reward, self.discount, self.prior = tile, reward, discount, prior
        self.value, self.visits, self.children = value, 1, [None] * 4
        self.q = reward + discount * value


def python_puct(num_simulations: int) -> Callable[[PythonNode], int]:
    """The selection of mctx's `muzero_policy`; the first of equals."""
    exploration = [  # by the visits of the node
        math.sqrt(n) * (1.25 + math.log((n + 19653.0) / 19652.0))
        for n in range(num_simulations + 1)
    ]

    def select(node: PythonNode) -> int:
        low = high = node.value
        for child in node.children:
            if child is not None:
                q = child.q
                if q < low:
                    low = q
                elif q > high:
                    high = q
        scale = 1.0 / (high - low) if high - low > 1e-8 else 1e8
        c = exploration[node.visits]
        best, best_score, action = 0, -1.0, 0
        for child, prior in zip(node.children, node.prior):  # noqa: B905  strict costs time
            if child is None:
                score = c * prior
            else:
                score = (child.q - low) * scale + c * prior / (child.visits + 1)
            if score > best_score:
                best, best_score = action, score
            action += 1
        return best

    return select


def python_search(
    task: MazeTask, num_simulations: int, select: Callable[[PythonNode], int]
) -> Callable[[int], PythonNode]:
    """A tree of plain Python objects: tile -> root."""
    next_tile, reward = task.next_tile.tolist(), task.reward.tolist()
    discount, prior, value = task.discount.tolist(), task.prior.tolist(), task.value.tolist()

    def search(tile: int) -> PythonNode:
        root = PythonNode(tile, 0.0, 1.0, prior[tile], value[tile])
        for _ in range(num_simulations):
            node, path = root, []
            while node is not None:
                path.append(node)
                action = select(node)
                node = node.children[action]
            parent = path[-1]
            edge = 4 * parent.tile + action
            after = next_tile[edge]
            leaf = PythonNode(after, reward[edge], discount[edge], prior[after], value[after])
            parent.children[action] = leaf
            result = leaf.q
            for node in reversed(path):
                visits = node.visits
                node.value += (result - node.value) / (visits + 1)
                node.visits = visits + 1
                node.q = node.reward + node.discount * node.value
                result = node.reward + node.discount * result
        return root

    return search


def visits_of(node: PythonNode) -> list[int]:
    return [child.visits if child else 0 for child in node.children]


def python_objects(task: MazeTask, tiles: np.ndarray, num_simulations: int) -> Search:
    search = python_search(task, num_simulations, python_puct(num_simulations))
    return lambda: np.array([visits_of(search(tile)) for tile in tiles.tolist()])


LIBRARIES: dict[str, Callable[[MazeTask, np.ndarray, int], Search]] = {
    "ours: tree_search, numpy model": ours_tree_search,
    "ours: MCTSPlanner, TensorDict env [1]": ours_planner,
    "mctx muzero_policy": mctx_muzero,
    "mctx gumbel_muzero_policy [2]": mctx_gumbel,
    "LightZero C++ mz_tree, numpy model [3]": lightzero,
    "OpenSpiel Python MCTSBot [4]": open_spiel,
    "plain Python objects": python_objects,
}
NOTES = """\
- : one search took longer than 60 s
[1] 5 actions (the fifth stays), uniform prior, values 0, plain PUCT; a TorchRL env as the model
[2] Gumbel scale 0, sequential halving at the root: another formula
[3] its own normalisation of values; only the C++ tree, driven as LightZero's Python loop drives it
[4] plain PUCT over a Python game, ends at the goal; its C++ bot takes no model from Python
same visits: share of roots whose visits are those of the reference row"""


# --------------------------------------------------------------------------------------- measuring


def prepare(
    task: MazeTask, batch: int, num_simulations: int
) -> tuple[dict[str, Search], dict[str, dict[str, Any]]]:
    """Build and warm up every library: those to measure, and a first record of each."""
    tiles = task.roots(batch)
    searches, records = {}, {}
    for name, build in LIBRARIES.items():
        record = {"library": name, "batch": batch, "simulations": num_simulations}
        records[name] = record
        try:
            begin = time.perf_counter()
            search = build(task, tiles, num_simulations)
            search()
            first = time.perf_counter() - begin
        except Skipped as reason:
            record["skipped"] = str(reason)
            continue
        warm = first
        if first < 2 * SINGLE_RUN_LIMIT:  # else it is too slow even if half of it was compilation
            begin = time.perf_counter()
            visits = np.asarray(search())
            warm = time.perf_counter() - begin
        if warm > SINGLE_RUN_LIMIT:
            record["skipped"] = "-"
            continue
        record["compile_seconds"] = max(0.0, first - warm)
        record["visits"] = visits
        record["calls"] = max(1, math.ceil(SHORTEST_TIMING / warm))
        record["timings"] = []
        searches[name] = search
    return searches, records


def measure(task: MazeTask, batch: int, num_simulations: int, repeats: int) -> list[dict[str, Any]]:
    """Time every library on one shape; they take turns."""
    searches, records = prepare(task, batch, num_simulations)
    for _ in range(repeats):
        for name, search in searches.items():
            record = records[name]
            if sum(wall for _, wall in record["timings"]) > SINGLE_RUN_LIMIT:
                continue  # slow enough to be known by now
            cpu, wall = time.process_time(), time.perf_counter()
            for _ in range(record["calls"]):
                search()
            cpu, wall = time.process_time() - cpu, time.perf_counter() - wall
            record["timings"].append((cpu, wall))
    for name in searches:
        record = records[name]
        done = int(record["visits"].sum()) * record.pop("calls")  # simulations of one timing
        timings = record.pop("timings")
        record["simulations_per_cpu_second"] = done / statistics.median(t[0] for t in timings)
        record["simulations_per_wall_second"] = done / statistics.median(t[1] for t in timings)
    compare(records)
    return list(records.values())


def compare(records: dict[str, dict[str, Any]]) -> None:
    """Set the records beside the reference row's; without its figures no ratio is given."""
    has_mctx = not records["mctx muzero_policy"].get("skipped", "").startswith("not installed")
    reference = records["mctx muzero_policy" if has_mctx else "plain Python objects"]
    rate, expected = reference.get("simulations_per_cpu_second"), reference.get("visits")
    for record in records.values():
        visits = record.pop("visits", None)
        if rate is None or visits is None:
            continue
        record["ratio"] = record["simulations_per_cpu_second"] / rate
        if visits.shape == expected.shape:
            record["same_visits"] = float((visits == expected).all(-1).mean())


def short(rate: float) -> str:
    """1234567 -> 1.23M."""
    for unit, size in (("M", 1e6), ("K", 1e3)):
        if rate >= size:
            return f"{rate / size:.3g}{unit}" if rate < 999.5 * size else f"{rate / size:.0f}{unit}"
    return f"{rate:.3g}"


def table(records: list[dict[str, Any]]) -> str:
    """One Markdown table: a row per library and N, a column per B."""
    cells = {(r["library"], r["simulations"], r["batch"]): r for r in records}
    batches = sorted({r["batch"] for r in records})
    head = ["library", "N", *(f"B={b}" for b in batches), "compile s", "same visits"]
    lines = [head, ["---"] * len(head)]
    for simulations in sorted({r["simulations"] for r in records}):
        for library in LIBRARIES:
            row = [library, str(simulations)]
            here = [cells[library, simulations, b] for b in batches]
            for r in here:
                if "skipped" in r:
                    row.append(r["skipped"])
                    continue
                rates = [short(r[f"simulations_per_{kind}_second"]) for kind in ("cpu", "wall")]
                row.append(" / ".join(rates + ([f"{r['ratio']:.3g}x"] if "ratio" in r else [])))
            compiled = [r["compile_seconds"] for r in here if "compile_seconds" in r]
            row.append(f"{max(compiled):.1f}" if compiled else "")
            same = [r["same_visits"] for r in here if "same_visits" in r]
            row.append(f"{min(same):.0%}" if same else "")
            lines.append(row)
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    return "\n".join(
        "| " + " | ".join(c.ljust(w) for c, w in zip(line, widths, strict=True)) + " |"
        for line in lines
    )


def versions() -> dict[str, str]:
    found = {"python": platform.python_version()}
    ours = ("torchrl_hmcts", "numpy", "numba", "torch")
    for name in (*ours, "mctx", "jax", "LightZero", "open_spiel"):
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            continue
    return found


def use_one_core() -> None:
    """Before jax and torch are imported: they size their thread pools by what they see."""
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
    flags = "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"
    os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} {flags}".strip()
    os.environ.setdefault("JAX_PLATFORMS", "cpu")
    import torch

    torch.set_num_threads(1)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--batches", type=int, nargs="+", default=[1, 16, 256, 1024], metavar="B")
    parser.add_argument("--simulations", type=int, nargs="+", default=[32, 128, 512], metavar="N")
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--out", type=Path, help="write the figures to this JSON file too")
    arguments = parser.parse_args()
    use_one_core()
    task, records = MazeTask(), []
    for num_simulations in arguments.simulations:
        for batch in arguments.batches:
            print(f"measuring N={num_simulations}, B={batch}", file=sys.stderr)
            records += measure(task, batch, num_simulations, arguments.repeats)
    print("Cells: simulations per CPU-second / per wall-second / CPU rate over the reference row.")
    print(table(records))
    print(NOTES)
    print(", ".join(f"{name} {version}" for name, version in versions().items()))
    if arguments.out:
        arguments.out.write_text(
            json.dumps({"versions": versions(), "figures": records}, indent=1) + "\n"
        )


if __name__ == "__main__":
    main()

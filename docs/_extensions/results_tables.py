"""The tables of the results page: which file of docs/results each shows, and which entries of it.

Files without a section of their own are listed at the end of the page.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any


@dataclass(frozen=True)
class Section:
    """A part of the page: a table of one file of data, and pictures.

    ``columns`` are entries of a row (``mazes.solved``; ``solved/mazes`` is the first of the second;
    ``*.says`` joins those of all names; ``name`` is the name of the row). Rows are below the entry
    ``rows``, in which ``*`` stands for each name, and are left out where they lack the last column.
    With ``group``, rows that agree in the first column are one line, with a value for each.
    """

    title: str
    data: str
    columns: str = ""
    rows: str = ""
    group: bool = False
    note: str = ""
    pictures: Mapping[str, str] = field(default_factory=dict)  # captions by file
    also: tuple[str, ...] = ()  # further files of the same measurement
    write: Callable[[Any], str] | None = None  # what is no table of rows

    def text(self, data: Any) -> str:
        """Return the table, in Markdown."""
        if self.write is not None:
            return self.write(data)
        columns = self.columns.split()
        rows = [row for row in records(data, self.rows) if _entry(row, columns[-1]) is not None]
        if not rows:
            raise ValueError(f"no row has {columns[-1]}")
        lines: dict[Any, list[Any]] = {}
        for i, row in enumerate(rows):
            lines.setdefault(_entry(row, columns[0]) if self.group else i, []).append(row)
        cells = [
            [_cell(runs[: 1 if i == 0 else None], column) for i, column in enumerate(columns)]
            for runs in lines.values()
        ]
        note = f"\n{self.note}\n" if self.note else ""
        return table([_head(column) for column in columns], cells) + note


def records(data: Any, path: str) -> list[dict[str, Any]]:
    """Return the rows below an entry, each with its name where it has one."""
    nodes = [data]
    for name in filter(None, path.split(".")):
        nodes = [v for node in nodes for v in (node.values() if name == "*" else [node[name]])]
    rows: list[dict[str, Any]] = []
    for node in nodes:
        for key, value in node.items() if isinstance(node, dict) else [("", node)]:
            several = value if isinstance(value, list) else [value]
            rows += [{"name": key, **row} for row in several if isinstance(row, dict)]
    return rows


def _head(column: str) -> str:
    words = column.partition("/")[0].replace(".", " ").replace("_", " ")
    return words.replace("p95", "95 %")


def _cell(rows: Sequence[Any], column: str) -> str:
    first, _, whole = column.partition("/")
    values = [number(_entry(row, first)) for row in rows]
    shown = " / ".join(values) if _is_figure(values[0]) else values[0]
    return f"{shown} of {number(_entry(rows[0], whole))}" if whole else shown


def _entry(row: Any, path: str) -> Any:
    for name in path.partition("/")[0].split("."):
        if name == "*":
            rest = path.partition("*.")[2]
            values = (_entry(value, rest) for value in row.values() if isinstance(value, dict))
            return " ".join(dict.fromkeys(value[:450] for value in values if value))
        row = row.get(name) if isinstance(row, dict) else None
    return row


def table(head: Sequence[str], rows: Iterable[Sequence[Any]]) -> str:
    """Return a table in Markdown; columns of figures stand to the right."""
    cells = [[number(cell) for cell in row] for row in rows]
    columns = [[row[i] for row in cells] for i in range(len(head))]
    right = [i > 0 and all(map(_is_figure, column)) for i, column in enumerate(columns)]
    rule = "|".join("---:" if r else "---" for r in right)
    lines = ["| " + " | ".join(head) + " |", f"|{rule}|"]
    lines += ["| " + " | ".join(row) + " |" for row in cells]
    return "\n".join(lines) + "\n"


def _is_figure(cell: str) -> bool:
    return not cell or (cell.lstrip("-")[:1].isdigit() and len(cell) <= 24)


def number(value: Any) -> str:
    """Return a number as people write it."""
    if isinstance(value, list):  # of scores: their mean
        value = sum(value) / len(value) if value else None
    if value is None or value != value:
        return ""
    if isinstance(value, str) and value.replace(".", "", 1).isdigit():  # of a CSV file
        value = float(value)
    if isinstance(value, bool):
        return "yes" if value else "no"
    if not isinstance(value, (int, float)):
        return str(value).replace("|", "/")
    if isinstance(value, int) or value == int(value) or abs(value) >= 1000:
        return f"{value:,.0f}"
    return f"{value:.3g}" if abs(value) < 10 else f"{value:,.1f}"


def peers(data: dict[str, Any]) -> str:
    batches = sorted({row["batch"] for row in data["figures"]})
    found = {(row["library"], row["batch"]): row for row in data["figures"] if "ratio" in row}

    def cell(library: str, batch: int) -> str:
        row = found.get((library, batch))
        if row is None:
            return ""
        rate, times = row["simulations_per_cpu_second"] / 1000, row["ratio"]
        rate = f"{rate / 1000:.2f}M" if rate >= 1000 else f"{rate:.{int(rate < 10)}f}K"
        return f"{rate}, {times:.2g}x"

    rows = [
        [library.split(" [")[0], *(cell(library, batch) for batch in batches)]
        for library in dict.fromkeys(row["library"] for row in data["figures"])
    ]
    head = ["simulations per CPU second, and as a multiple of mctx", *(f"B = {b}" for b in batches)]
    return table(head, rows) + (f"\n{speed(data)}\n" if len(batches) > 1 else "")


def speed(data: dict[str, Any]) -> str:
    """Return what README and pages say about speed, from a file of ``benchmarks/peers.py``."""
    ratios: dict[str, list[tuple[int, float]]] = {}
    for row in data["figures"]:
        if "ratio" in row:
            ratios.setdefault(row["library"], []).append((row["batch"], row["ratio"]))
    array, planner = (sorted(v) for k, v in ratios.items() if k.startswith("ours"))
    low, high = (f"{bound(ratio for _, ratio in array):.0f}" for bound in (min, max))
    (_, slow), (many, fast) = planner[0], planner[-1]
    return (
        f"On one CPU core, with {data['figures'][0]['simulations']} simulations per root, "
        f"`tree_search` makes {low} to {high} times the simulations per second of mctx's "
        "`muzero_policy`. "
        f"`MCTSPlanner` steps a TorchRL env and makes {slow:.1f} times as many with one root, "
        f"{fast:.0f} times with {many:,}."
    )


def sticky_means(data: dict[str, Any]) -> str:
    """Return interquartile means of human-normalised scores, beside Dopamine's training curves."""
    checkpoints = data["dopamine"]["frames"]
    ours = {line["frames"]: line for line in data["summary"] if len(line["games"]) == 7}
    rows = [[name, *values] for name, values in data["dopamine"]["interquartile_mean"].items()]
    means = [ours[at]["interquartile_mean"] if at in ours else None for at in checkpoints]
    rows.append(["ours, seven games", *means])
    return table(["agent", *(f"{at:,} frames" for at in checkpoints)], rows)


_SPEED = "agent.frames_per_second bare.frames_per_second ratio.frames_per_cpu_second"
_OBJECTIVES = "objective seed train_seconds solved/starts simulated_steps.median"

SECTIONS: dict[str, tuple[Section, ...]] = {
    "Planning over learned skills": (
        Section(
            "The demo",
            "demo/seeds.csv",
            "seed solved/mazes train_base_steps train_seconds plan_seconds_median "
            "plan_base_steps_median expansions_median episode_base_steps_median "
            "episode_base_steps_over_shortest seconds",
            pictures={
                "demo/episode.gif": "A test maze, the plan, and the worker that executes it",
                "demo/search.png": "The search for that plan: where options led, and the tree",
                "demo/skills.png": "Ten mini-episodes of each skill",
                "demo/losses.png": "Figures 4.6 to 4.9: training of the worker",
            },
            also=("demo/metrics.json",),
        ),
        Section(
            "How much training the worker needs",
            "skills/worker.json",
            "train_base_steps seed mazes.solved/mazes.starts mazes.simulated_steps.median "
            "mazes.simulated_steps.p95 mazes.episode_steps.median sampled.100.accuracy "
            "greedy.25.angle",
            rows="rows",
            note="The accuracy is of the discriminator after 100 base steps, worker sampling.",
        ),
        Section("Skill objectives", "skills/skill_objectives.json", _OBJECTIVES, group=True),
        Section("Skills that are vectors", "skills/skill_vectors.json", _OBJECTIVES, group=True),
        Section(
            "Algorithm 3: learning from the searches",
            "skills/hmcts_rounds.json",
            "name seed training_base_steps rounds final.solved/final.starts "
            "final.simulated_steps.median final.episode_steps.median",
            rows="runs",
            pictures={"skills/hmcts_rounds.png": "Base steps to solve a maze against training"},
        ),
        Section(
            "Skills added as needed",
            "skills/growing_skills.json",
            "skills seed skills_at_the_end mazes.solved/mazes.starts mazes.simulated_steps.mean",
            rows="rows",
            group=True,
        ),
        Section(
            "A manager that learns",
            "skills/learned_manager.json",
            "name solved simulated_steps.median simulated_steps.mean",
            rows="seeds.*.planners",
            group=True,
            note="Solved of 342 mazes, a value for each seed; iterations are counted from 0.",
        ),
        Section(
            "Planning in a learned model",
            "skills/option_model.json",
            "name seed solved/mazes episode_steps.median",
            rows="rows",
            group=True,
        ),
        Section(
            "Plans in 342 test mazes",
            "planner/waterworld_plans.json",
            "name solved/mazes simulated_base_steps.median simulated_base_steps.p95 "
            "first_plan_base_steps.median",
            pictures={"planner/tree.png": "A search tree"},
        ),
    ),
    "Chapter 3: the goal-based agent": (
        Section(
            "Random mazes of Waterworld",
            "goals/goal_agent.json",
            "name seed train_base_steps test.solved/test.mazes test.base_steps_median "
            "test.base_steps_mean",
            rows="agents",
            note="The dissertation's Figure 3.6 has no numbers in its text: with goals the mazes "
            "are solved consistently and quickly, by plain A3C they are not.",
            pictures={
                "goals/goal_agent.png": "Figure 3.6: test mazes while it learns",
                "goals/episode.png": "Figure 3.5: goals over the maze",
                "goals/search.png": "Figure 3.4: the search over tiles",
                "goals/macro_env.png": "Figure 3.2: the macro environment",
                "goals/episode.gif": "An episode",
            },
        ),
        Section(
            "A3C in CartPole-v1",
            "a3c/a3c_figures.json",
            "seed solved frames mean_return",
            rows="cartpole",
        ),
    ),
    "Chapter 4: DeepMind Lab's random maze": (
        Section(
            "Test mazes",
            "lab/labmaze.json",
            "name solved/mazes frames.mean frames_over_script simulated_frames.mean",
            rows="results",
            note="The dissertation (Figure 4.10): the time to solve falls until about 40,000 "
            "training steps; after that every random maze is solved at the first trial.",
            pictures={
                "lab/labmaze_diayn.png": "Figure 4.10: frames to solve a maze while the worker "
                "learns",
                "lab/episode.gif": "A test maze: the plan, the player, and what it sees",
                "lab/skills.png": "Figure 4.5: ten mini-episodes of each skill",
                "lab/search.png": "Figure 4.4: the search",
                "lab/mazes.png": "Figure 4.3: random mazes",
            },
        ),
        Section(
            "A real env with another clock and friction, a plan after every option",
            "lab/labmaze.json",
            "name solved/mazes solved_by_the_first_plan num_plans.mean fps friction",
            rows="results",
        ),
    ),
    "Speed": (
        Section(
            "Search beside other libraries: 128 simulations", "planner/peers_128.json", write=peers
        ),
        Section("32 simulations", "planner/peers_32.json", write=peers),
        Section("512 simulations", "planner/peers_512.json", write=peers),
        Section(
            "What the planner costs",
            "planner/planner_figures.json",
            "name ms_per_expansion planner_ms_per_expansion planner_share",
        ),
        Section(
            "Training, base steps per CPU second",
            "skills/training_speed.json",
            "seed ratio steps_per_second.DIAYNTrainer",
            rows="runs",
            note="The ratio is to a loop in plain torch.",
        ),
        Section("LabMazeEnv", "lab_speed.json", "how writes num_steps frames_per_second"),
        Section(
            "Atari: search beside bare emulation",
            "atari/speed.json",
            f"game {_SPEED}",
            rows="games",
        ),
        Section(
            "Atari: leaves that are simulated together",
            "atari/waves.json",
            "game leaves_per_wave waves_in_flight seed score simulated_per_real_step",
            rows="runs",
        ),
    ),
    "Atari": (
        Section(
            "Seven games",
            "atari/runs.json",
            "game protocol score_mean score_max frames source option_steps seed",
            note="The dissertation reports the highest score within 10 million time steps of an "
            "agent whose worker is a learned network. Here rules act, which trials chose on starts "
            "that are scored, too (the old rule); all emulated frames count.",
        ),
        Section(
            "Learned workers",
            "atari/learned.json",
            "game source acts seed score_mean score_min score_max simulated_per_real base_steps",
            rows="rows",
            note="Ten test episodes for each seed, cut short; no setting was chosen by a score.",
        ),
        Section(
            "Sticky actions, whole episodes",
            "atari/sticky.json",
            "game seed score_at.2000000 score_at.5000000 score_at.10000000 score_at.40000000 "
            "reactive_sticky reactive_deterministic frames_finding_options frames",
            rows="rows",
            note="A score is the mean of the last ten planned episodes that were over at that many "
            "emulated frames, all kinds; reactive is without search, ten episodes, after 2 to 5 "
            "million frames. **The simulator is set** to "
            "plan; Dopamine's agents never set theirs.",
        ),
        Section("Interquartile means, human-normalised", "atari/sticky.json", write=sticky_means),
    ),
    "Reliability": (
        Section(
            "Runs that are killed",
            "reliability/kills.json",
            "name by_SIGKILL by_SIGTERM by_child not_continued went_back damaged same_figures "
            "kills",
            rows="runs",
            note="Forks of the first two are all killed. A3C promises no figures of the same bits.",
        ),
        Section(
            "Machines that lack something",
            "reliability/environments.json",
            "name import.result plan.result demo.result a3c.result pool.result *.says",
            rows="situations",
        ),
        Section("Faults, resumed and repeated runs", "reliability/tests.json", "name passed"),
        Section("TorchRL's contracts", "reliability/contracts.json", "name skipped passed"),
        Section("Memory", "reliability/leaks.json", "name number growth_mib growth_objects"),
        Section(
            "Lines that the tests reach",
            "reliability/coverage.json",
            "name lines reached share",
            rows="folders",
        ),
        Section(
            "The wheel on several Pythons",
            "pythons.json",
            "python torch torchrl test_files skipped passed",
            rows="pythons",
        ),
    ),
}

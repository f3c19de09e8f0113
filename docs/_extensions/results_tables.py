"""The tables of the results page, each made from one file of docs/results.

A section is a function of the file's content that returns Markdown. `SECTIONS` says which file it
reads; files without a section of their own are listed at the end of the page.
"""

from __future__ import annotations

import statistics
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

Rows = Iterable[Sequence[Any]]


@dataclass(frozen=True)
class Section:
    """A part of the page: its heading, the file it is made of, pictures, and how it is written."""

    title: str
    data: str
    write: Callable[[Any], str]
    pictures: tuple[tuple[str, str], ...] = ()
    also: tuple[str, ...] = ()  # further files of the same measurement
    level: int = 3


def table(head: Sequence[str], rows: Rows) -> str:
    """Return a table in Markdown; columns of figures stand to the right."""
    cells = [[number(cell) for cell in row] for row in rows]
    columns = [[row[i] for row in cells] for i in range(len(head))]
    right = [i > 0 and all(_is_figure(cell) for cell in col) for i, col in enumerate(columns)]
    rule = "|".join("---:" if r else "---" for r in right)
    lines = ["| " + " | ".join(head) + " |", f"|{rule}|"]
    lines += ["| " + " | ".join(row) + " |" for row in cells]
    return "\n".join(lines) + "\n"


def _is_figure(cell: str) -> bool:
    return not cell or (cell.lstrip("-")[:1].isdigit() and len(cell) <= 24)


def number(value: Any) -> str:
    """Return a number as people write it."""
    if value is None or value != value:
        return ""
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return str(value)
    if isinstance(value, int) or value == int(value) or abs(value) >= 1000:
        return f"{value:,.0f}"
    return f"{value:.3g}" if abs(value) < 10 else f"{value:,.1f}"


def by_seed(values: Iterable[Any]) -> str:
    return " / ".join(number(value) for value in values)


Columns = Mapping[str, str | Callable[[Any], Any]]
"""Columns of a table by their heads: an entry (``mazes.solved``), two (``solved/mazes``: the first
of the second), or a function of the row, or of the runs in it."""


def of_rows(rows: Iterable[Any], columns: Columns) -> str:
    """Return a table with a line for each row of data."""
    return table(list(columns), [[_cell(row, c) for c in columns.values()] for row in rows])


def of_groups(rows: Sequence[Any], key: str, columns: Columns) -> str:
    """Return a table with a line for each value of ``key``, whose cells have a value a seed."""
    lines = []
    for name in dict.fromkeys(row[key] for row in rows):
        runs = [row for row in rows if row[key] == name]
        lines.append([name, *(_cells(runs, column) for column in [*columns.values()][1:])])
    return table(list(columns), lines)


def rounded(entry: str) -> Callable[[Any], str]:
    """Return a column of a table of groups: an entry, rounded."""
    return lambda runs: by_seed(round(_entry(run, entry)) for run in runs)


def _cell(row: Any, column: str | Callable[[Any], Any]) -> Any:
    if callable(column):
        return column(row)
    first, _, whole = column.partition("/")
    value = _entry(row, first)
    return f"{value} of {_entry(row, whole)}" if whole else value


def _cells(runs: Sequence[Any], column: str | Callable[[Any], Any]) -> Any:
    if callable(column):
        return column(runs)
    first, _, whole = column.partition("/")
    shown = by_seed(_entry(run, first) for run in runs)
    return f"{shown} of {_entry(runs[0], whole)}" if whole else shown


def _entry(row: Any, path: str) -> Any:
    for name in path.split("."):
        row = row[name]
    return row


# ------------------------------------------------------------------------------ sections


def demo(rows: list[dict[str, str]]) -> str:
    figures = [{key: float(value) for key, value in row.items()} for row in rows]
    lines = [
        ("test mazes solved at the first trial", "solved", "mazes"),
        ("worker training, base steps", "train_base_steps", None),
        ("worker training, seconds", "train_seconds", None),
        ("planning one maze, median seconds", "plan_seconds_median", None),
        ("simulated base steps per plan, median", "plan_base_steps_median", None),
        ("nodes expanded per plan, median", "expansions_median", None),
        ("base steps of an episode, median", "episode_base_steps_median", None),
        ("base steps per tile of the shortest path", "episode_base_steps_over_shortest", None),
        ("whole demo, seconds", "seconds", None),
    ]
    return table(
        ["", *(f"seed {row['seed']}" for row in rows)],
        [
            [name, *(number(f[key]) + (f" of {number(f[of])}" if of else "") for f in figures)]
            for name, key, of in lines
        ],
    )


def goal_agent(data: dict[str, Any]) -> str:
    rows = [{**run, "agent": name} for name, runs in data["agents"].items() for run in runs]
    columns: Columns = {
        "agent": "agent",
        "seed": "seed",
        "training base steps": lambda run: run.get("train_base_steps", 0),
        "solved": "test.solved/test.mazes",
        "base steps, mean": "test.base_steps_mean",
        "median": "test.base_steps_median",
    }
    return of_rows(rows, columns) + (
        "\nThe dissertation's Figure 3.6 has no numbers in its text: with goals the mazes are "
        "solved consistently and quickly, by plain A3C they are not.\n"
    )


def labmaze(data: dict[str, Any]) -> str:
    def named(name: str, row: dict[str, Any]) -> dict[str, Any]:
        learner, seed = name.replace(",", "").split()[:2]
        return {**row, "worker": f"{learner}, seed {seed}"}

    rows = {name: named(name, row) for name, row in data["results"].items()}
    sizes: Columns = {
        "test mazes": lambda row: f"{row['size']} x {row['size']}",
        "worker": "worker",
        "solved": "solved/mazes",
        "frames": "frames.mean",
        "over the script's": "frames_over_script",
        "simulated frames": "simulated_frames.mean",
    }
    real: Columns = {
        "real env": lambda row: f"{row['fps']} frames a second, friction {row['friction']}",
        "worker": "worker",
        "solved": "solved/mazes",
        "by the first plan": "solved_by_the_first_plan",
        "plans": "num_plans.mean",
    }
    wrong = [row for row in rows.values() if "fps" in row]
    text = of_rows([row for name, row in rows.items() if name.split()[2] == "size"], sizes)
    if wrong:
        text += "\nThe real env's clock and friction differ from the model's (60, 6.0); a new plan "
        text += "after every option:\n\n" + of_rows(wrong, real)
    return text + (
        "\nThe dissertation (Figure 4.10): the time to solve falls until about 40,000 training "
        "steps; after that every random maze is solved at the first trial.\n"
    )


def worker(data: dict[str, Any]) -> str:
    def accuracy(row: dict[str, Any]) -> str:
        return " / ".join(f"{row['sampled'][k]['accuracy']:.2f}" for k in ("25", "50", "100"))

    columns: Columns = {
        "training base steps": "train_base_steps",
        "seed": "seed",
        "solved": "mazes.solved/mazes.starts",
        "simulated base steps": "mazes.simulated_steps.median",
        "(95 %)": "mazes.simulated_steps.p95",
        "episode": "mazes.episode_steps.median",
        "accuracy at 25 / 50 / 100": accuracy,
        "smallest angle": "greedy.25.angle",
    }
    note = "\nMedians; the accuracy is of the discriminator, worker sampling.\n"
    return of_rows(data["rows"], columns) + note


def objectives(data: list[dict[str, Any]]) -> str:
    columns: Columns = {
        "objective": "objective",
        "seeds": "seed",
        "solved": "solved/starts",
        "simulated base steps, median": rounded("simulated_steps.median"),
        "smallest angle": "smallest_angle",
        "training, s": lambda runs: round(statistics.mean(run["train_seconds"] for run in runs)),
    }
    return of_groups(data, "objective", columns)


def learned_manager(data: dict[str, Any]) -> str:
    seeds = data["seeds"].values()
    rows = [{**row, "planner": name} for run in seeds for name, row in run["planners"].items()]
    columns: Columns = {
        "planner": "planner",
        "solved of 342": "solved",
        "simulated base steps, median": rounded("simulated_steps.median"),
        "mean": rounded("simulated_steps.mean"),
    }
    note = f"\nSeeds {', '.join(data['seeds'])}; iterations are counted from 0.\n"
    return of_groups(rows, "planner", columns) + note


def option_model(data: dict[str, Any]) -> str:
    columns: Columns = {
        "planned in": "name",
        "seeds": "seed",
        "solved": "solved/mazes",
        "base steps of an episode, median": "episode_steps.median",
    }
    return of_groups(data["rows"], "name", columns)


def growing(data: dict[str, Any]) -> str:
    columns: Columns = {
        "skills": "skills",
        "seeds": "seed",
        "at the end": "skills_at_the_end",
        "solved": "mazes.solved/mazes.starts",
        "simulated base steps, mean": rounded("mazes.simulated_steps.mean"),
    }
    return of_groups(data["rows"], "skills", columns)


def rounds(data: dict[str, Any]) -> str:
    rows = [{**run, "worker": name} for name, runs in data["runs"].items() for run in runs]
    columns: Columns = {
        "worker": "worker",
        "seed": "seed",
        "base steps of its rounds": "training_base_steps",
        "rounds": "rounds",
        "solved": "final.solved/final.starts",
        "simulated": "final.simulated_steps.median",
        "episode": "final.episode_steps.median",
    }
    return of_rows(rows, columns) + "\nBase steps, medians.\n"


def training_speed(data: dict[str, Any]) -> str:
    rows = [
        [name, by_seed(round(run["steps_per_second"][name]) for run in data["runs"])]
        for name in data["runs"][0]["steps_per_second"]
    ]
    seeds = by_seed(run["seed"] for run in data["runs"])
    return table(["base steps per CPU second", f"seeds {seeds}"], rows)


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


def waterworld_plans(data: dict[str, Any]) -> str:
    rows = [
        {**row, "search": name.replace("_", " ")}
        for name, row in data.items()
        if isinstance(row, dict) and "solved" in row
    ]
    columns: Columns = {
        "search": "search",
        "solved": "solved/mazes",
        "simulated base steps, median": "simulated_base_steps.median",
        "(95 %)": "simulated_base_steps.p95",
        "plan, median": "first_plan_base_steps.median",
    }
    long = data["long_search"]
    return of_rows(rows, columns) + (
        f"\nOne worker, seed {data['arguments']['seed']}. First plans are "
        f"{number(long['first_plan_over_best']['median'])} times (95 %: "
        f"{number(long['first_plan_over_best']['p95'])}) the best plan that a search of "
        f"{number(long['expansions'])} expansions found, improved ones "
        f"{number(long['improved_plan_over_best']['p95'])} times (95 %).\n"
    )


def planner_costs(data: dict[str, Any]) -> str:
    columns: Columns = {
        "simulator": "simulator",
        "ms per expansion": "ms_per_expansion",
        "of it the planner's": "planner_ms_per_expansion",
        "share": lambda row: f"{100 * row['planner_share']:.1f} %",
    }
    names = [name for name in ("waterworld", "atari") if name in data]
    return of_rows([{**data[name], "simulator": name} for name in names], columns)


def a3c(data: dict[str, Any]) -> str:
    columns: Columns = {
        "CartPole-v1, seed": "seed",
        "solved": lambda run: "yes" if run["solved"] else "no",
        "frames": "frames",
        "mean return": "mean_return",
    }
    text = of_rows(data["cartpole"], columns)
    if speeds := data.get("asynchrony"):
        text += (
            f"\nTwo learners make {speeds['ratio']} times the base steps per second of one "
            f"(median of {len(speeds['ratios'])} pairs of runs: {by_seed(speeds['ratios'])}).\n"
        )
    return text


def lab_speed(data: list[dict[str, Any]]) -> str:
    names = {"frames per step": "num_steps", "frames per second": "frames_per_second"}
    return of_rows(data, {"how": "how", "writes": "writes", **names})


def atari_speed(data: dict[str, Any]) -> str:
    columns: Columns = {
        "game": "game",
        "agent, frames per second": "agent.frames_per_second",
        "bare emulators, as many": "bare.frames_per_second",
        "ratio": "ratio.frames_per_second",
        "agent, frames per CPU second": "agent.frames_per_cpu_second",
        "bare": "bare.frames_per_cpu_second",
        "ratio of these": "ratio.frames_per_cpu_second",
    }
    return of_rows(data["games"], columns)


def atari_waves(data: dict[str, Any]) -> str:
    groups: dict[tuple[Any, ...], list[dict[str, Any]]] = {}
    for run in data["runs"]:
        key = (run["game"], run["leaves_per_wave"], run["waves_in_flight"])
        groups.setdefault(key, []).append(run)
    rows = [
        [
            *key,
            ", ".join(f"{run['score']:g}" for run in runs),
            round(statistics.mean(run["simulated_per_real_step"] for run in runs)),
        ]
        for key, runs in groups.items()
    ]
    heads = ["game", "leaves per wave", "waves in flight", "scores of seeds 0, 1, 2"]
    return table([*heads, "simulated base steps per real one"], rows)


SECTIONS: dict[str, tuple[Section, ...]] = {
    "Planning over learned skills": (
        Section(
            "The demo",
            "demo/seeds.csv",
            demo,
            (
                ("demo/episode.gif", "A test maze, the plan, and the worker that executes it"),
                ("demo/search.png", "The search for that plan: where options led, and the tree"),
                ("demo/skills.png", "Ten mini-episodes of each skill"),
                (
                    "demo/losses.png",
                    "Figures 4.6 to 4.9: training of the worker",
                ),
            ),
            ("demo/metrics.json",),
        ),
        Section("How much training the worker needs", "skills/worker.json", worker),
        Section("Skill objectives", "skills/skill_objectives.json", objectives),
        Section("Skills that are vectors", "skills/skill_vectors.json", objectives),
        Section(
            "Algorithm 3: learning from the searches",
            "skills/hmcts_rounds.json",
            rounds,
            (("skills/hmcts_rounds.png", "Base steps to solve a maze against training"),),
        ),
        Section("Skills added as needed", "skills/growing_skills.json", growing),
        Section("A manager that learns", "skills/learned_manager.json", learned_manager),
        Section("Planning in a learned model", "skills/option_model.json", option_model),
        Section(
            "Plans in 342 test mazes",
            "planner/waterworld_plans.json",
            waterworld_plans,
            (("planner/tree.png", "A search tree"),),
        ),
    ),
    "Chapter 3: the goal-based agent": (
        Section(
            "Random mazes of Waterworld",
            "goals/goal_agent.json",
            goal_agent,
            (
                (
                    "goals/goal_agent.png",
                    "Figure 3.6: test mazes while it learns",
                ),
                ("goals/episode.png", "Figure 3.5: goals over the maze"),
                ("goals/search.png", "Figure 3.4: the search over tiles"),
                ("goals/macro_env.png", "Figure 3.2: the macro environment"),
                ("goals/episode.gif", "An episode"),
            ),
        ),
        Section("A3C", "a3c/a3c_figures.json", a3c),
    ),
    "Chapter 4: DeepMind Lab's random maze": (
        Section(
            "Test mazes",
            "lab/labmaze.json",
            labmaze,
            (
                ("lab/episode.gif", "A test maze: the plan, the player, and what it sees"),
                (
                    "lab/skills.png",
                    "Figure 4.5: ten mini-episodes of each skill",
                ),
                ("lab/search.png", "Figure 4.4: the search"),
                ("lab/mazes.png", "Figure 4.3: random mazes"),
            ),
        ),
    ),
    "Speed": (
        Section("Search beside other libraries: 128 simulations", "planner/peers_128.json", peers),
        Section("32 simulations", "planner/peers_32.json", peers),
        Section("512 simulations", "planner/peers_512.json", peers),
        Section("What the planner costs", "planner/planner_figures.json", planner_costs),
        Section("Training", "skills/training_speed.json", training_speed),
        Section("LabMazeEnv", "lab_speed.json", lab_speed),
        Section("Atari: search beside bare emulation", "atari/speed.json", atari_speed),
        Section("Atari: leaves that are simulated together", "atari/waves.json", atari_waves),
    ),
}

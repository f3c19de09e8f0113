"""The tables of the results page, each made from one file of docs/results.

A section is a function of the file's content that returns Markdown. `SECTIONS` says which file it
reads; files without a section of their own are listed at the end of the page.
"""

from __future__ import annotations

import statistics
from collections.abc import Callable, Iterable, Sequence
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
    """Return a number as people write it.

    Example:
        >>> number(40000), number(0.25), number(1598.0), number("a"), number(float("nan"))
        ('40,000', '0.25', '1,598', 'a', '')
    """
    if value is None or value != value:
        return ""
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return str(value)
    if isinstance(value, int) or value == int(value) or abs(value) >= 1000:
        return f"{value:,.0f}"
    return f"{value:.3g}" if abs(value) < 10 else f"{value:,.1f}"


def by_seed(values: Iterable[Any]) -> str:
    return " / ".join(number(value) for value in values)


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
    rows = []
    for name, runs in data["agents"].items():
        for run in runs:
            test = run["test"]
            rows.append(
                [
                    name,
                    run["seed"],
                    run.get("train_base_steps", 0),
                    f"{test['solved']} of {test['mazes']}",
                    test["base_steps_mean"],
                    test["base_steps_median"],
                ]
            )
    head = ["agent", "seed", "training base steps", "solved", "base steps, mean", "median"]
    return table(head, rows) + (
        "\nThe source's Figure 3.6 has no numbers in its text: with goals the mazes are solved "
        "consistently and quickly, by plain A3C they are not.\n"
    )


def labmaze(data: dict[str, Any]) -> str:
    sizes, wrong = [], []
    for name, result in data["results"].items():
        learner, seed, *what = name.replace(",", "").split()
        if what[0] == "size":
            sizes.append(
                [
                    f"{result['size']} x {result['size']}",
                    f"{learner}, seed {seed}",
                    f"{result['solved']} of {result['mazes']}",
                    result["frames"]["mean"],
                    result["frames_over_script"],
                    result["simulated_frames"]["mean"],
                ]
            )
        elif "fps" in result:
            wrong.append(
                [
                    f"{result['fps']} frames a second, friction {result['friction']}",
                    f"{learner}, seed {seed}",
                    f"{result['solved']} of {result['mazes']}",
                    result["solved_by_the_first_plan"],
                    result["num_plans"]["mean"],
                ]
            )
    head = ["test mazes", "worker", "solved", "frames", "over the script's", "simulated frames"]
    text = table(head, sizes)
    if wrong:
        text += "\nThe real env's clock and friction differ from the model's (60, 6.0); a new plan "
        text += "after every option:\n\n"
        text += table(["real env", "worker", "solved", "by the first plan", "plans"], wrong)
    return text + (
        "\nThe source (Figure 4.10): the time to solve falls until about 40,000 training steps; "
        "after that every random maze is solved at the first trial.\n"
    )


def worker(data: dict[str, Any]) -> str:
    head = ["training base steps", "seed", "solved", "simulated base steps", "(95 %)"]
    head += ["episode", "accuracy at 25 / 50 / 100", "smallest angle"]
    rows = [
        [
            row["train_base_steps"],
            row["seed"],
            f"{row['mazes']['solved']} of {row['mazes']['starts']}",
            row["mazes"]["simulated_steps"]["median"],
            row["mazes"]["simulated_steps"]["p95"],
            row["mazes"]["episode_steps"]["median"],
            " / ".join(f"{row['sampled'][k]['accuracy']:.2f}" for k in ("25", "50", "100")),
            row["greedy"]["25"]["angle"],
        ]
        for row in data["rows"]
    ]
    return table(head, rows) + "\nMedians; the accuracy is of the discriminator, worker sampling.\n"


def objectives(data: list[dict[str, Any]]) -> str:
    rows = []
    for name in dict.fromkeys(row["objective"] for row in data):
        runs = [row for row in data if row["objective"] == name]
        rows.append(
            [
                name,
                by_seed(run["seed"] for run in runs),
                by_seed(run["solved"] for run in runs) + f" of {runs[0]['starts']}",
                by_seed(round(run["simulated_steps"]["median"]) for run in runs),
                by_seed(run["smallest_angle"] for run in runs),
                round(statistics.mean(run["train_seconds"] for run in runs)),
            ]
        )
    head = ["objective", "seeds", "solved", "simulated base steps, median", "smallest angle"]
    return table([*head, "training, s"], rows)


def learned_manager(data: dict[str, Any]) -> str:
    seeds = data["seeds"]
    names = dict.fromkeys(name for run in seeds.values() for name in run["planners"])
    rows = []
    for name in names:
        runs = [run["planners"][name] for run in seeds.values() if name in run["planners"]]
        rows.append(
            [
                name,
                by_seed(run["solved"] for run in runs),
                by_seed(round(run["simulated_steps"]["median"]) for run in runs),
                by_seed(round(run["simulated_steps"]["mean"]) for run in runs),
            ]
        )
    head = ["planner", "solved of 342", "simulated base steps, median", "mean"]
    return table(head, rows) + f"\nSeeds {', '.join(seeds)}; iterations are counted from 0.\n"


def option_model(data: dict[str, Any]) -> str:
    rows = []
    for name in dict.fromkeys(row["name"] for row in data["rows"]):
        runs = [row for row in data["rows"] if row["name"] == name]
        rows.append(
            [
                name,
                by_seed(run["seed"] for run in runs),
                by_seed(run["solved"] for run in runs) + f" of {runs[0]['mazes']}",
                by_seed(run["episode_steps"]["median"] for run in runs),
            ]
        )
    return table(["planned in", "seeds", "solved", "base steps of an episode, median"], rows)


def growing(data: dict[str, Any]) -> str:
    rows = []
    for name in dict.fromkeys(row["skills"] for row in data["rows"]):
        runs = [row for row in data["rows"] if row["skills"] == name]
        mazes = [run["mazes"] for run in runs]
        rows.append(
            [
                name,
                by_seed(run["seed"] for run in runs),
                by_seed(run["skills_at_the_end"] for run in runs),
                by_seed(maze["solved"] for maze in mazes) + f" of {mazes[0]['starts']}",
                by_seed(round(maze["simulated_steps"]["mean"]) for maze in mazes),
            ]
        )
    return table(["skills", "seeds", "at the end", "solved", "simulated base steps, mean"], rows)


def rounds(data: dict[str, Any]) -> str:
    rows = [
        [
            name,
            run["seed"],
            run["training_base_steps"],
            run["rounds"],
            f"{run['final']['solved']} of {run['final']['starts']}",
            run["final"]["simulated_steps"]["median"],
            run["final"]["episode_steps"]["median"],
        ]
        for name, runs in data["runs"].items()
        for run in runs
    ]
    head = ["worker", "seed", "base steps of its rounds", "rounds", "solved"]
    return table([*head, "simulated", "episode"], rows) + "\nBase steps, medians.\n"


def training_speed(data: dict[str, Any]) -> str:
    rows = [
        [name, by_seed(round(run["steps_per_second"][name]) for run in data["runs"])]
        for name in data["runs"][0]["steps_per_second"]
    ]
    seeds = by_seed(run["seed"] for run in data["runs"])
    return table(["base steps per CPU second", f"seeds {seeds}"], rows)


def peers(data: dict[str, Any]) -> str:
    figures = data["figures"]
    batches = sorted({row["batch"] for row in figures})
    speed = "simulations_per_cpu_second"
    found = {(row["library"], row["batch"]): row for row in figures if speed in row}
    rows = []
    for library in dict.fromkeys(row["library"] for row in figures):
        cells = []
        for batch in batches:
            row = found.get((library, batch))
            cells.append("" if row is None else f"{row[speed] / 1000:,.0f}K")
        rows.append([library.split(" [")[0], *cells])
    return table(["simulations per CPU second", *(f"B = {batch}" for batch in batches)], rows)


def waterworld_plans(data: dict[str, Any]) -> str:
    rows = [
        [
            name.replace("_", " "),
            f"{row['solved']} of {row['mazes']}",
            row["simulated_base_steps"]["median"],
            row["simulated_base_steps"]["p95"],
            row["first_plan_base_steps"]["median"],
        ]
        for name, row in data.items()
        if isinstance(row, dict) and "solved" in row
    ]
    head = ["search", "solved", "simulated base steps, median", "(95 %)", "plan, median"]
    long = data["long_search"]
    return table(head, rows) + (
        f"\nOne worker, seed {data['arguments']['seed']}. First plans are "
        f"{number(long['first_plan_over_best']['median'])} times (95 %: "
        f"{number(long['first_plan_over_best']['p95'])}) the best plan that a search of "
        f"{number(long['expansions'])} expansions found, improved ones "
        f"{number(long['improved_plan_over_best']['p95'])} times (95 %).\n"
    )


def planner_costs(data: dict[str, Any]) -> str:
    rows = [
        [
            name,
            data[name]["ms_per_expansion"],
            data[name]["planner_ms_per_expansion"],
            f"{100 * data[name]['planner_share']:.1f} %",
        ]
        for name in ("waterworld", "atari")
        if name in data
    ]
    return table(["simulator", "ms per expansion", "of it the planner's", "share"], rows)


def a3c(data: dict[str, Any]) -> str:
    rows = [
        [run["seed"], "yes" if run["solved"] else "no", run["frames"], run["mean_return"]]
        for run in data["cartpole"]
    ]
    text = table(["CartPole-v1, seed", "solved", "frames", "mean return"], rows)
    speeds = data.get("asynchrony")
    if speeds:
        text += (
            f"\nTwo learners make {speeds['ratio']} times the base steps per second of one "
            f"(median of {len(speeds['ratios'])} pairs of runs: {by_seed(speeds['ratios'])}).\n"
        )
    return text


def lab_speed(data: list[dict[str, Any]]) -> str:
    rows = [[r["how"], r["writes"], r["num_steps"], r["frames_per_second"]] for r in data]
    return table(["how", "writes", "frames per step", "frames per second"], rows)


def atari_speed(data: dict[str, Any]) -> str:
    rows = [
        [
            game["game"],
            *(
                game[who][key]
                for key in ("frames_per_second", "frames_per_cpu_second")
                for who in ("agent", "bare", "ratio")
            ),
        ]
        for game in data["games"]
    ]
    heads = ["game", "agent, frames per second", "bare emulators, as many", "ratio"]
    return table([*heads, "agent, frames per CPU second", "bare", "ratio"], rows)


def atari_waves(data: dict[str, Any]) -> str:
    groups: dict[tuple[Any, ...], list[dict[str, Any]]] = {}
    for run in data["runs"]:
        key = (run["game"], run["leaves_per_wave"], run["waves_in_flight"])
        groups.setdefault(key, []).append(run)
    rows = [
        [
            *key,
            ", ".join(f"{run['score']:g}" for run in runs),
            round(sum(run["simulated_per_real_step"] for run in runs) / len(runs)),
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
                ("demo/episode.gif", "A test maze, the plan, and the worker that carries it out"),
                ("demo/search.png", "The search for that plan: where options led, and the tree"),
                ("demo/skills.png", "Ten mini-episodes of each skill"),
                ("demo/losses.png", "The source's figures 4.6 to 4.9: training of the worker"),
            ),
            ("demo/metrics.json",),
        ),
        Section("How much training the worker needs", "skills/worker.json", worker),
        Section("Skill objectives", "skills/skill_objectives.json", objectives),
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
                ("goals/goal_agent.png", "The source's figure 3.6: test mazes while it learns"),
                ("goals/episode.png", "The source's figure 3.5: goals over the maze"),
                ("goals/search.png", "The source's figure 3.4: the search over tiles"),
                ("goals/macro_env.png", "The source's figure 3.2: the macro environment"),
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
                ("lab/skills.png", "The source's figure 4.5: ten mini-episodes of each skill"),
                ("lab/search.png", "The source's figure 4.4: the search"),
                ("lab/mazes.png", "The source's figure 4.3: random mazes"),
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

# Dissertation, table 5.1 and table A.1 (mean of the best of seven algorithms of OpenAI Baselines).
ATARI = (
    ("BeamRider", 6823, 3, 20, "2171 (acktr)"),
    ("Breakout", 464, 3, 30, "131 (deepq)"),
    ("Enduro", 708, 4, 20, "480 (deepq)"),
    ("SpaceInvaders", 1343, 4, 30, "657 (acer)"),
    ("Qbert", 19839, 5, 10, "7185 (ppo2_mpi)"),
    ("Seaquest", 1904, 5, 10, "1383 (ppo2_mpi)"),
    ("Pong", 20, 3, 10, "16.5 (deepq)"),
)

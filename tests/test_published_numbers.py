"""Every measured number of README and of the main pages is that of a file in docs/results."""

from __future__ import annotations

import csv
import json
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

import pytest

import torchrl_hmcts

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "docs" / "results"


@cache
def data(name: str) -> Any:
    text = (RESULTS / name).read_text(encoding="utf-8")
    return list(csv.DictReader(text.splitlines())) if name.endswith(".csv") else json.loads(text)


def page(name: str) -> str:
    return (ROOT / name).read_text(encoding="utf-8")


def flat(text: str) -> str:
    return " ".join(text.split())


def listed(values: Any) -> str:
    return ", ".join(f"{int(value):,}" for value in values)


def speed(monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.syspath_prepend(str(ROOT / "docs" / "_extensions"))
    import results_tables

    return results_tables


def untrained(task: str) -> str:
    """Mazes that networks of random weights solve: the fewest and the most, and of how many."""
    rows = data("ablations.json")["rows"]
    rows = [r for r in rows if (r["task"], r["arm"]) == (task, "untrained")]
    counts = [sum(row["solved"]) for row in rows]
    assert len(rows) == 10
    return f"{min(counts)} to {max(counts)} of {len(rows[0]['solved'])}"


def readme_claims() -> list[str]:
    """The rows of README's table of results, as the data have them."""
    demo, maze = data("demo/seeds.csv"), data("settable/point_mazes.json")
    lab = [data("lab/labmaze.json")["results"][f"diayn {seed} size 9"] for seed in range(3)]
    frames = data("lab/labmaze.json")["results"]["diayn 0 training"]["frames"]
    large = maze["runs"]["PointMaze_Large-v3"]
    bare, ant_bare = large["0"]["untrained"], data("antmaze/results.json")["solving"]
    ant_bare = ant_bare["AntMaze_Large-v5 untrained seed 0"]
    ants = [data("antmaze/results.json")["solving"][f"AntMaze_Large-v5 seed {s}"] for s in range(3)]
    ant = ", ".join(f"{ant['solved']} of {ant['starts']}" for ant in ants)
    steps = f"{int(demo[0]['train_base_steps']):,} steps of training"
    arm = "DIAYN, 81,920 base steps"
    rows = data("ablations.json")["rows"]
    boats = [r["solved"] for r in rows if (r["task"], r["arm"]) == ("boat", arm)]
    return [
        f"a body that must turn, 81,920 steps | {listed(map(sum, boats))} of {len(boats[0])} "
        f"| {untrained('boat')} | {len(boats)} |",
        f"mazes, 4 skills, {steps} | {listed(r['solved'] for r in demo)} of {demo[0]['mazes']} "
        f"| {untrained('maze')} | {len(demo)} |",
        f"{frames:,} frames of training | {listed(r['solved'] for r in lab)} of {lab[0]['mazes']} "
        f"| {untrained('lab')} | {len(lab)} |",
        f"PointMaze_Large-v3, {maze['skills']} skills, {maze['training_steps']:,} steps of "
        f"training | {listed(run['learned']['solved'] for run in large.values())} of "
        f"{large['0']['learned']['starts']} "
        f"| {bare['solved']} of {bare['starts']} | {len(large)} |",
        f"AntMaze_Large-v5, ant trained without a maze | {ant} "
        f"| {ant_bare['solved']} of {ant_bare['starts']} | {len(ants)} |",
    ]


def test_every_number_of_readme_is_in_the_data(monkeypatch: pytest.MonkeyPatch) -> None:
    tables = speed(monkeypatch)
    text = flat(re.sub(r"```.*?```", "", page("README.md"), flags=re.DOTALL))
    for claim in [*readme_claims(), tables.speed(data("planner/peers_128.json"))]:
        assert claim in text, f"README should say: {claim}"
        text = text.replace(claim, "")
    text = re.sub(r"`[^`]*`|\]\([^)]*\)", "", text)  # names and links
    versions = {"3.10", "3.13", torchrl_hmcts.__version__.rpartition(".")[0]}
    assert set(re.findall(r"\d+(?:\.\d+)?", text)) <= versions


def test_the_home_page_says_what_the_demo_measured() -> None:
    demo = data("demo/seeds.csv")
    assert {(row["solved"], row["mazes"]) for row in demo} == {("100", "100")}
    assert len(demo) == 3
    text = flat(page("docs/index.md"))
    assert "solves 100 of 100 such mazes at the first trial, in each of three seeds" in text
    assert f"in {int(demo[0]['train_base_steps']):,} steps" in text


# Pages with a table of solved mazes.
IN_WATERWORLD = (
    *("diayn", "skill_objectives", "mcts_over_options", "expert_iteration", "option_model"),
    *("option_termination", "growing_skills", "hmcts"),
)


@pytest.mark.parametrize("name", [f"algorithms/{name}" for name in IN_WATERWORLD] + ["index"])
def test_the_untrained_worker_stands_beside_what_is_solved_in_waterworld(name: str) -> None:
    mazes = untrained("maze").partition(" of ")[0]
    assert f"ntrained skills solve {mazes} of" in flat(page(f"docs/{name}.md"))


@pytest.mark.parametrize("name", ["algorithms/hmcts", "lab_maze"])
def test_the_untrained_worker_stands_beside_what_is_solved_in_the_lab(name: str) -> None:
    runs = [data("lab/labmaze.json")["results"][f"diayn {s} training"]["curve"] for s in range(3)]
    assert {run["training_steps"][0] for run in runs} == {0.0}
    first = listed(round(20 * run["solved"][0]) for run in runs)
    assert f"ntrained skills solve {first} of 20 other mazes" in flat(page(f"docs/{name}.md"))


def test_speed_is_said_in_the_same_words_everywhere(monkeypatch: pytest.MonkeyPatch) -> None:
    tables = speed(monkeypatch)
    sentence, table = tables.speed(data("planner/peers_128.json")), None
    assert sentence in flat(page("README.md"))
    assert sentence in flat(page("docs/planning.md"))
    table = tables.peers(data("planner/peers_128.json")).partition("\n\n")[0]
    assert table in page("docs/planning.md")


def beside_the_dissertation() -> Iterator[str]:
    """Rows of docs/results/README.md."""
    lab = data("lab/labmaze.json")["results"]
    for size, mazes in ((9, 200), (15, 200), (31, 40)):
        rows = [lab[f"diayn {seed} size {size}"]["solved"] for seed in range(3)]
        yield f"{listed(rows)} of {mazes}"
    worker = [r for r in data("skills/worker.json")["rows"] if r["train_base_steps"] == 40_000]
    yield f"| | {listed(row['mazes']['solved'] for row in worker)} of 342 at the first trial | 3 |"
    goals = data("goals/goal_agent.json")["agents"]["goal-based agent"]
    yield f"quickly | {listed(run['test']['solved'] for run in goals)} of 342 | {len(goals)} |"
    # Deterministic, options chosen by `best` (the command's defaults), a run for each seed.
    for game in ("Breakout", "Pong", "Qbert", "Seaquest", "Enduro", "SpaceInvaders", "BeamRider"):
        runs = {
            run["seed"]: run["score_max"]
            for run in data("atari/runs.json")
            if (run["game"], run["protocol"], run["source"]) == (game, "deterministic", "best")
        }
        scores = [f"{int(runs[seed]):,}" for seed in sorted(runs)]
        yield f"| {', '.join(scores[:-1])} and {scores[-1]} | {len(scores)} |"


def test_figures_beside_the_dissertation_are_those_of_the_data() -> None:
    text = flat(page("docs/results/README.md"))
    for claim in beside_the_dissertation():
        assert claim in text, f"docs/results/README.md should say: {claim}"


@pytest.mark.parametrize(("ratio", "claim"), [(25.0, "{} to {} base steps"), (50.0, "{} to {} at")])
def test_simulated_steps_for_a_real_one_are_those_of_the_runs(ratio: float, claim: str) -> None:
    found = []
    for run in (run for run in data("atari/runs.json") if run["settings"]["ratio"] == ratio):
        real = sum(episode["real_frames"] for episode in run["episodes"])
        spent = run["frames"] - run["frames_finding_options"] - run["frames_tuning"]
        found.append((spent - real) / real)
    assert claim.format(round(min(found)), round(max(found))) in page("docs/atari.md")


# Tables that people wrote: page, heading, and the file whose records their rows show.
TABLES = [
    ("docs/results/README.md", "## Classic envs at the defaults", "settable/classic.json"),
    ("docs/results/README.md", "## gymcts and ours", "settable/gymcts.json"),
    ("docs/results/README.md", "## MiniGrid", "settable/minigrid.json"),
    ("docs/results/README.md", "## AntMaze", "antmaze/results.json"),
    ("docs/results/README.md", "## OGBench's point mazes", "ogbench/mazes.json"),
    ("docs/results/README.md", "## OGBench's puzzles and ants", "ogbench/puzzles.json"),
    ("docs/results/README.md", "## Point mazes", "settable/point_mazes.json"),
]


def records(node: Any, name: str) -> Iterator[Any]:
    """Yield the parts of a file that are about an env: under its name, or with it as a value."""
    if isinstance(node, dict):
        if any(isinstance(value, str) and value == name for value in node.values()):
            yield node
            return
        for key, value in node.items():
            if key == name or key.startswith(f"{name} "):
                yield value
            else:
                yield from records(value, name)
    elif isinstance(node, list):
        for value in node:
            yield from records(value, name)


def leaves(node: Any) -> Iterator[float]:
    if isinstance(node, (dict, list)):
        for value in node.values() if isinstance(node, dict) else node:
            yield from leaves(value)
    elif isinstance(node, (int, float)) and not isinstance(node, bool):
        yield float(node)
    elif isinstance(node, str):
        yield from (float(x) for x in re.findall(r"\d+(?:\.\d+)?", node))


def shown(token: str, values: list[float]) -> bool:
    """Whether a number as it is written is one of the values, rounded as it is."""
    number = float(token.replace(",", ""))
    whole, _, decimals = token.replace(",", "").partition(".")
    zeros = len(whole) - len(whole.rstrip("0")) if not decimals and abs(number) >= 1000 else 0
    unit = 10.0 ** (zeros - len(decimals))
    return number == 0 or any(abs(value - number) <= 0.501 * unit for value in values)


@pytest.mark.parametrize(("name", "heading", "file"), TABLES)
def test_every_number_of_a_table_is_in_its_data(name: str, heading: str, file: str) -> None:
    text = page(name)
    text = text[text.index(f"\n{heading}") + 1 :]
    text = text.partition("\n## ")[0]
    checked = 0
    for row in re.findall(r"^\|(.*)\|$", text, re.MULTILINE):
        first, *cells = (cell.strip() for cell in row.split("|"))
        values = list(leaves(list(records(data(file), first.partition(",")[0]))))
        if not values:  # a head
            continue
        line = " ".join(re.sub(r"HIQL.*|seed \d|[A-Za-z][\w-]*\d\w*", "", cell) for cell in cells)
        wrong = [t for t in re.findall(r"-?\d[\d,]*(?:\.\d+)?", line) if not shown(t, values)]
        assert not wrong, f"{first}: {wrong} in {name} are not in {file}"
        checked += 1
    assert checked >= 5


def test_the_tables_of_each_parts_worth_are_those_of_the_data() -> None:
    import ablations

    found = ablations.tables(data("ablations.json")["rows"])
    assert ablations.fill(page("docs/ablations.md"), found) == page("docs/ablations.md")
    assert set(found) <= set(re.findall(r"<!-- (.*?) -->", page("docs/ablations.md")))

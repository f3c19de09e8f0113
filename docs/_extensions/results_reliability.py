"""Tables of what went wrong on purpose, from ``docs/results/reliability``."""

from __future__ import annotations

from typing import Any

from results_tables import Section, table


def kills(data: dict[str, Any]) -> str:
    rows = []
    for name, run in data.get("runs", {"DIAYN": data}).items():
        same = run.get("same_figures", run.get("same_bits_as_the_unbroken_run"))
        lost = ("not_continued", "went_back", "damaged", "checkpoints_lost", "damaged_checkpoints")
        by = [run.get(f"by_{how}") for how in ("SIGKILL", "SIGTERM", "child")]
        by = by if by[0] is not None else [run["kills"], 0, 0]  # forks are killed
        promised = {None: "not promised", True: "yes", False: "no"}[same]
        rows.append([name, run["kills"], *by, sum(run.get(key, 0) for key in lost), promised])
    head = ["run", "times ended", "SIGKILL", "SIGTERM", "a process of it", "lost", "same bits"]
    sums = [sum(row[i] for row in rows) for i in range(1, 6)]
    return table(head, [*rows, ["all", *sums, ""]])


_TRIED = {
    "import": "importing",
    "plan": "planning",
    "demo": "the demo",
    "a3c": "A3C",
    "pool": "an Atari pool",
}


def environments(data: dict[str, Any]) -> str:
    rows = [
        [what, f"not tried: it {row['skipped']}" if "skipped" in row else _what_happens(row)]
        for what, row in data["situations"].items()
    ]
    return table(["machine", "what happens"], rows)


def _what_happens(row: dict[str, dict[str, Any]]) -> str:
    """Sentences about what was tried on a machine; what said the same shares one."""
    works = [_TRIED[action] for action, tried in row.items() if tried["result"] == "works"]
    text = [f"{_listed(works)} {'works' if len(works) == 1 else 'work'}."] if works else []
    said: dict[tuple[str, bool], list[str]] = {}
    for action, tried in row.items():
        if "says" in tried:
            key = (
                tried["says"][:450].replace("`", "'").replace("|", "/"),
                tried["result"] == "works",
            )
            said.setdefault(key, []).append(_TRIED[action])
        if tried["result"] == "hangs":
            text.append(f"{_listed([_TRIED[action]])} hangs.")
        if "processes_left" in tried or "shared_memory_left" in tried:
            text.append(f"{_listed([_TRIED[action]])} leaves processes or shared memory.")
    for (words, fine), actions in said.items():
        one = len(actions) == 1
        verb = ("says" if one else "say") if fine else ("ends with" if one else "end with")
        text.append(f"{_listed(actions)} {verb}: `{words}`")
    return " ".join(text)


def _listed(names: list[str]) -> str:
    text = ", ".join(names[:-1]) + " and " * (len(names) > 1) + names[-1]
    return text[0].upper() + text[1:]


def fuzz(data: dict[str, Any]) -> str:
    rows = [[name, number] for name, number in data["cases"].items()]
    return table(["what was senseless", "cases"], [*rows, ["all", data["all_cases"]]])


def tests(data: dict[str, Any]) -> str:
    names = {
        "faults_injected_and_survived": "faults injected and survived",
        "runs_resumed_and_compared": "runs resumed and compared with the unbroken one",
        "runs_repeated_and_compared": "runs and searches repeated and compared",
        "security": "security",
    }
    return table(_HEAD, [[text, *_counts(data[key])] for key, text in names.items()])


def contracts(data: dict[str, Any]) -> str:
    kinds = [kind for kind in ("transforms", "losses", "envs") if kind in data]
    return table(_HEAD, [[f"contract of {kind}", *_counts(data[kind])] for kind in kinds])


def ray(data: dict[str, Any]) -> str:
    return table(_HEAD, [["collecting in processes of a Ray cluster", *_counts(data)]])


def leaks(data: dict[str, Any]) -> str:
    rows = [
        [text, *(data[key][name] for name in ("number", "growth_mib", "growth_objects"))]
        for key, text in (("searches", "searches"), ("base_steps", "base steps"))
    ]
    return table(["", "number", "MiB more", "Python objects more"], rows)


def coverage(data: dict[str, Any]) -> str:
    rows = [
        [name, row["lines"], row["reached"], f"{100 * row['share']:.1f} %"]
        for name, row in data["folders"].items()
    ]
    return table(["folder", "lines", "reached by tests", "share"], rows)


def mutants(data: dict[str, Any]) -> str:
    lines = {
        "possible mutants": "mutants_possible",
        "drawn at random and tried": "tried",
        "noticed by a test at the first run": "killed_at_first_run",
        "noticed after tests were added": "killed_after_tests_were_added",
        "cannot be noticed (reasons in the file)": "equivalent",
        "survived": "survived",
    }
    rows: list[list[Any]] = [[text, data[key]] for text, key in lines.items()]
    rows.append(["share noticed, of all tried", f"{100 * data['killed_share']:.0f} %"])
    rows.append(["at the first run", f"{100 * data['killed_share_at_first_run']:.0f} %"])
    return table(["", "count"], rows)


def pythons(data: dict[str, Any]) -> str:
    rows = [
        [
            row["python"],
            row["torch"],
            row["torchrl"],
            row["test_files"],
            row["passed"],
            row["skipped"],
            ", ".join(row["failed"]) or "none",
        ]
        for row in data["pythons"].values()
    ]
    head = ["Python", "torch", "torchrl", "test files", "passed", "skipped", "failed"]
    return table(head, rows)


_HEAD = ("tests", "passed", "failed", "skipped")


def _counts(data: dict[str, Any]) -> list[int]:
    return [data.get(word, 0) for word in _HEAD[1:]]


RELIABILITY = (
    Section("Runs that are killed", "reliability/kills.json", kills),
    Section("Machines that lack something", "reliability/environments.json", environments),
    Section("Faults, resumed and repeated runs", "reliability/tests.json", tests),
    Section("A Ray cluster whose processes die", "reliability/ray.json", ray),
    Section("Senseless input", "reliability/fuzz.json", fuzz),
    Section("Senseless input, many more cases", "reliability/fuzz_slow.json", fuzz),
    Section("TorchRL's contracts", "reliability/contracts.json", contracts),
    Section("Memory", "reliability/leaks.json", leaks),
    Section("Lines that the tests reach", "reliability/coverage.json", coverage),
    Section("Wrong lines that the tests notice", "reliability/mutants.json", mutants),
    Section("The wheel on several Pythons", "pythons.json", pythons),
)

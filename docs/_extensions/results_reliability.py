"""Tables of what went wrong on purpose, from ``docs/results/reliability``."""

from __future__ import annotations

from typing import Any

from results_tables import Section, table


def kills(data: dict[str, Any]) -> str:
    lines = {
        "times the run was killed": "kills",
        "of these while it wrote a checkpoint": "killed_while_writing_a_checkpoint",
        "checkpoints written": "checkpoints_written",
        "damaged checkpoints": "damaged_checkpoints",
        "checkpoints lost": "checkpoints_lost",
    }
    same = "the same bits as" if data["same_bits_as_the_unbroken_run"] else "other bits than"
    rows = [[text, data[key]] for text, key in lines.items()]
    return table(["", "count"], rows) + f"\nIt ended with {same} the run that was not killed.\n"


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
    Section("A run that is killed", "reliability/kills.json", kills),
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

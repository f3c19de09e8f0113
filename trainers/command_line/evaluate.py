"""``hmcts evaluate run=DIR key=value ...``."""

from __future__ import annotations

import dataclasses
import json
import sys
from collections.abc import Sequence
from typing import Any

from torchrl_hmcts.trainers.command_line.running import fail, missing, refuse, said
from torchrl_hmcts.trainers.command_line.words import split_words
from torchrl_hmcts.trainers.experiments.registry import load_config, recognise
from torchrl_hmcts.trainers.runs.config import home, parse_overrides
from torchrl_hmcts.trainers.saving.files import left_out
from torchrl_hmcts.trainers.saving.locking import is_locked
from torchrl_hmcts.trainers.saving.run_folder import (
    add_evaluation,
    machine,
    read_run,
    shown_word,
    versions,
)


def evaluate(words: Sequence[str]) -> int:
    """Test a run's newest checkpoint again and add the figures to its ``evaluation.json``."""
    try:
        own, rest = split_words(words, ["run"])
        if "run" not in own:
            raise ValueError("say which run: run=DIR, the folder that a training wrote.")
        run = read_run(home(own["run"]))
        experiment, saved = load_config(run)
        changed = parse_overrides(
            experiment.config_class, rest, base=saved, others=["run", "log_level"]
        )
        if changed.out != saved.out:
            raise ValueError("the figures go to the folder of the run, next to its own; no out=.")
        changes = {
            field.name: getattr(changed, field.name)
            for field in dataclasses.fields(changed)
            if getattr(changed, field.name) != getattr(saved, field.name)
        }
        for key in ("resume", "overwrite"):
            if key in changes:
                raise ValueError(f"{key} is for hmcts train; an evaluation changes no run.")
        function = experiment.evaluation
        if hasattr(changed, "check_inputs"):
            changed.check_inputs()
    except ModuleNotFoundError as error:
        return missing(error)
    except (ValueError, TypeError) as error:
        return refuse("evaluate", error)
    if is_locked(run.path):
        print(f"{run.path} is still running: its newest checkpoint is tested.", file=sys.stderr)
    from torchrl_hmcts.trainers.figures.run_page import write_run_page
    from torchrl_hmcts.trainers.saving.files import finite

    try:
        with said(own.get("log_level", "info")):
            results = function(changed)
    except FileNotFoundError as error:
        return fail("evaluate", error)
    except RuntimeError as error:
        if type(error).__name__ != "CheckpointError":  # torchrl's; not worth its import here
            raise
        return fail("evaluate", error)
    except ValueError as error:
        return refuse("evaluate", error)
    evaluation: dict[str, Any] = {
        "changes": changes,
        "results": results,
        "command": " ".join(map(shown_word, ["hmcts", "evaluate", *words])),
        "versions": versions(),
        "machine": machine(),
    }
    print(json.dumps(finite(results), indent=1))
    with left_out("evaluation.json"):
        print(f"Figures: {add_evaluation(run.path, evaluation)}")
    with left_out("index.html"):
        print(f"With all others: {write_run_page(recognise(read_run(run.path)))}")
    return 0

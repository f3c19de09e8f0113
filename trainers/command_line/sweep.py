"""``hmcts sweep experiment=NAME key=[a,b] key=low..high trials=N``."""

from __future__ import annotations

import contextlib
import io
import shlex
import sys
from collections.abc import Iterator, Sequence

from torchrl_hmcts.trainers.command_line.running import fail, missing, refuse, said
from torchrl_hmcts.trainers.command_line.words import LOG_LEVELS, set_log_level, split_words
from torchrl_hmcts.trainers.experiments.registry import (
    EXPERIMENTS,
    ExperimentError,
    find_experiment,
)
from torchrl_hmcts.trainers.runs.config import parse_overrides, read_value
from torchrl_hmcts.trainers.runs.sweep_space import parse_space
from torchrl_hmcts.trainers.saving.files import left_out, write_json
from torchrl_hmcts.trainers.saving.locking import FolderInUse
from torchrl_hmcts.trainers.saving.run_folder import shown_word
from torchrl_hmcts.trainers.saving.stopping import Stopped, signals_handled

_OWN = ("experiment", "trials", "objective", "storage", "prune", "out")
_DEFAULT_TRIALS = 20


def sweep(words: Sequence[str]) -> int:
    """Run trials until as many as asked for are finished, and write the page of the sweep."""
    try:
        own, rest = split_words(words, _OWN)
        if "experiment" not in own:
            raise ValueError(
                f"say which experiment, e.g. experiment={next(iter(EXPERIMENTS))} "
                "(all: hmcts list)."
            )
        experiment = find_experiment(own["experiment"])
        space, fixed = parse_space(experiment.config_class, rest, [*_OWN, "log_level"])
        default = f"runs/sweep_{experiment.name}" + "_toy" * ("toy=true" in fixed)
        folder = own.get("out", default)
        config = parse_overrides(experiment.config_class, [*fixed, f"out={folder}"])
        trials = _whole("trials", own.get("trials", str(_DEFAULT_TRIALS)))
        objective = own.get("objective", experiment.objective)
        if not objective:
            raise ValueError("say what to improve, e.g. objective=test.solved.")
        prune = _yes_or_no("prune", own.get("prune", "true"))
        level = own.get("log_level", "info")
        if level not in LOG_LEVELS:
            set_log_level(level)  # raises
        from torchrl_hmcts.trainers.runs.sweep import Sweep

        plan = Sweep(experiment, config, space, objective, own.get("storage"), prune, config.seed)
        study = plan.study()  # before any trial: says what is wrong with storage or folder
    except ModuleNotFoundError as error:
        return missing(error)
    except (ValueError, TypeError) as error:
        return refuse("sweep", error)
    except OSError as error:
        return fail("sweep", f"{error}. Choose another folder with out=DIR.")
    command = " ".join(map(shown_word, ["hmcts", "sweep", *words]))
    try:
        # Optuna says what came of each trial; what the trials say is for those who ask for it.
        with signals_handled(), said(level), said_by_trials(level):
            study = plan.run(trials)
    except KeyboardInterrupt as error:
        _page(plan, study, command)
        print(
            "\nhmcts sweep: stopped. Finished trials are kept, one under way will be continued. "
            f"Continue with: {shlex.join(['hmcts', 'sweep', *words])}",
            file=sys.stderr,
        )
        return error.status if isinstance(error, Stopped) else 130
    except ModuleNotFoundError as error:
        return missing(error)
    except (ExperimentError, FolderInUse) as error:
        return fail("sweep", error)
    except ValueError as error:
        return refuse("sweep", error)
    best = _page(plan, study, command)
    print(best)
    return 0


def _page(plan: object, study: object, command: str) -> str:
    from torchrl_hmcts.trainers.figures.sweep_page import write_sweep_page
    from torchrl_hmcts.trainers.runs.sweep import Sweep, importances, trial_rows

    assert isinstance(plan, Sweep)
    rows, shares = trial_rows(study), importances(study)  # type: ignore[arg-type]
    content = {
        "study": study.study_name,  # type: ignore[attr-defined]
        "objective": plan.objective,
        "trials": rows,
        "importances": shares,
    }
    with left_out("sweep.json"):
        write_json(plan.folder / "sweep.json", content)
    page = plan.folder / "index.html"
    with left_out("index.html"):
        write_sweep_page(
            plan.folder,
            study=study,  # type: ignore[arg-type]
            experiment=plan.experiment.name,
            objective=plan.objective,
            rows=rows,
            importances=shares,
            command=command,
        )
    best = next((row for row in rows if row["value"] is not None), None)
    if best is None:
        return f"No trial has finished. Page: {page}"
    values = " ".join(f"{key}={value}" for key, value in best["params"].items())
    name = plan.objective.removeprefix("-")
    return f"Best of {len(rows)} trials: {name} = {best['value']:.6g} with {values}\nPage: {page}"


@contextlib.contextmanager
def said_by_trials(level: str) -> Iterator[None]:
    """Keep what experiments print to themselves, unless the level is ``"debug"``."""
    if level == "debug":
        yield
        return
    with contextlib.redirect_stdout(io.StringIO()):
        yield


def _whole(key: str, value: str) -> int:
    number = read_value(key, value, "int") if value[:1].isdigit() else 0
    if number < 1:
        raise ValueError(f"{key} must be a whole number above 0; got {value!r}.")
    return int(number)


def _yes_or_no(key: str, value: str) -> bool:
    if value.lower() not in ("true", "false"):
        raise ValueError(f"{key} is true or false; got {value!r}.")
    return value.lower() == "true"

"""Files that a run leaves in its folder, and reading them again.

========================  ======================================================================
``run.json``              experiment, config, commands, versions, machine, status; written first
``metrics.json``          the figures of a finished run
``curves.csv``            its curves, a value a row: name, step, value
``log/scalars/*.csv``     the same while it runs
``page.json``             title of its page and captions of its pictures
``checkpoints/``          from which it continues
``worker/``               networks of a finished run, which its page shows, by their step
``evaluation.json``       evaluations made later by ``hmcts evaluate``
========================  ======================================================================
"""

from __future__ import annotations

import csv
import math
import os
import platform
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from importlib import metadata
from pathlib import Path, PurePath
from typing import Any

from torchrl_hmcts import __version__
from torchrl_hmcts.trainers.saving.files import left_out, read_json, write_json
from torchrl_hmcts.trainers.saving.locking import folder_locked, is_locked

_PACKAGES = ("torch", "torchrl", "tensordict", "numpy")
_NAME_COLUMNS = ("name", "curve")
_STEP_LABELS = {
    "frames": "base steps",
    "training_frames": "frames of training",
    "step": "steps",
}


@dataclass(frozen=True)
class RunCurve:
    """A logged value against steps; entries that are not finite are left out."""

    name: str
    steps: list[float]
    values: list[float]
    step_label: str


@dataclass
class RunFolder:
    """A run as its folder tells it; fields of what is missing are empty."""

    path: Path
    record: dict[str, Any] = field(default_factory=dict)  # run.json
    metrics: dict[str, Any] = field(default_factory=dict)  # metrics.json without config, versions
    evaluations: list[dict[str, Any]] = field(default_factory=list)  # evaluation.json
    title: str = ""  # heading of the page
    pictures: dict[str, str] = field(default_factory=dict)  # captions of files that are there
    curves: dict[str, RunCurve] = field(default_factory=dict)
    damage: list[str] = field(default_factory=list)  # a sentence a file that cannot be read
    # Default and meaning of each key of its experiment, where these are known.
    keys: Mapping[str, tuple[Any, str]] = field(default_factory=dict)

    @property
    def name(self) -> str:
        """Name of the folder."""
        return self.path.resolve().name

    @property
    def experiment(self) -> str:
        """Name of the experiment; empty if unknown."""
        return str(self.record.get("experiment", ""))

    @property
    def config(self) -> dict[str, Any]:
        """The keys it ran with."""
        return dict(self.record.get("config", {}))

    @property
    def seed(self) -> Any:
        """Its seed, if it has one."""
        return self.config.get("seed", self.metrics.get("seed"))

    @property
    def finished(self) -> bool:
        """True once it came to its end; one that is being extended has not yet."""
        return bool(self.metrics) and self.status in ("", "finished")

    @property
    def status(self) -> str:
        """State that ``run.json`` notes; ``"interrupted"`` if its process ended without noting it.

        Empty if unknown.
        """
        status = str(self.record.get("status", ""))
        return "interrupted" if status == "running" and not is_locked(self.path) else status


def read_run(path: str | Path) -> RunFolder:
    """Read a run's folder."""
    path = Path(path)
    damage: list[str] = []
    record = _json(path / "run.json", damage, config=dict, commands=list, versions=dict)
    metrics = _json(path / "metrics.json", damage, config=dict, versions=dict)
    if not record and not metrics and not damage:
        why = "has neither run.json nor metrics.json" if path.exists() else "does not exist"
        runs = sorted(str(file.parent) for file in path.glob("*/run.json"))
        inside = f" It holds the runs {', '.join(runs)}." if runs else ""
        raise ValueError(
            f"{str(path)!r} is no folder of a run: it {why}. Pass the folder that was given as "
            f"out=DIR, or to HMCTS.save.{inside}"
        )
    if not record:  # of a run that was not started by the command line
        record = {name: metrics.get(name, {}) for name in ("config", "versions")}
    page = _json(path / "page.json", damage, pictures=dict, title=str)
    captions = page.get("pictures")
    if captions is None:
        found = (sorted(path.glob(f"*.{end}")) for end in ("gif", "png"))
        captions = {picture.name: "" for pictures in found for picture in pictures}
    evaluated = _json(path / "evaluation.json", damage, evaluations=list)
    curves: dict[str, RunCurve] = {}
    try:
        curves = read_curves(path)
    except (ValueError, csv.Error, OSError, KeyError, TypeError) as error:
        damage.append(f"{path.resolve().name}/curves.csv cannot be read: {error}.")
    return RunFolder(
        path,
        record,
        {k: v for k, v in metrics.items() if k not in ("config", "versions")},
        [e for e in evaluated.get("evaluations", []) if isinstance(e, dict)],
        page.get("title") or record.get("experiment") or path.resolve().name,
        {name: str(text) for name, text in captions.items() if (path / name).is_file()},
        curves,
        damage,
    )


def is_run(path: str | Path) -> bool:
    """Return whether a folder is that of a run or of a sweep."""
    return any(Path(path, name).is_file() for name in ("run.json", "metrics.json", "sweep.json"))


def read_curves(path: Path) -> dict[str, RunCurve]:
    """Return the curves in a run's folder, those of the log while there is no ``curves.csv``."""
    points: dict[str, list[tuple[float, float]]] = {}
    label = "steps"
    if (path / "curves.csv").is_file():
        with (path / "curves.csv").open(newline="", encoding="utf-8") as file:
            rows = csv.DictReader(file)
            columns = rows.fieldnames or []
            name = next((c for c in _NAME_COLUMNS if c in columns), None)
            step = next((c for c in columns if c not in (name, "value")), None)
            if name is not None and step is not None:
                label = _STEP_LABELS.get(step, step.replace("_", " "))
                for row in rows:
                    point = (float(row[step]), float(row["value"]))
                    points.setdefault(row[name], []).append(point)
    else:
        log = path / "log" / "scalars"
        for scalars in sorted(log.rglob("*.csv")):
            with scalars.open(newline="", encoding="utf-8") as file:
                rows_of = [(float(x), float(y)) for x, y in csv.reader(file)]
            points[scalars.relative_to(log).with_suffix("").as_posix()] = rows_of
    curves = {}
    for curve, pairs in points.items():
        finite = sorted(pair for pair in pairs if all(map(math.isfinite, pair)))
        if finite:
            steps, values = zip(*finite, strict=True)
            curves[curve] = RunCurve(curve, list(steps), list(values), label)
    return curves


def start_record(experiment: str, config: Any, command: Sequence[str]) -> None:
    """Write ``run.json`` into the folder of a run that begins or is resumed, without its path."""
    path = Path(config.out)
    path.mkdir(parents=True, exist_ok=True)
    resumed = getattr(config, "resume", False)
    before = _json(path / "run.json", [], config=dict, commands=list) if resumed else {}
    values = asdict(config)
    # What the command asked for, not what the run is.
    values |= {key: False for key in ("resume", "overwrite") if key in values}
    values["out"] = shown_path(config.out)
    commands = [*before.get("commands", []), " ".join(shown_word(word) for word in command)]
    record = {
        "experiment": experiment,
        "config": values,
        "commands": [line for line in commands if line],
        "versions": versions(),
        "machine": machine(),
        "status": "running",
    }
    write_json(path / "run.json", record, checksum=True)


def end_record(path: str | Path, status: str) -> None:
    """Note in ``run.json`` how a run ended: finished (it stays so), stopped, failed or given up."""
    file = Path(path) / "run.json"
    record = _json(file, [])
    if record and record.get("status") != "finished":
        with left_out(f"{file.name}'s status"):  # of what is over, e.g. on a full disk
            write_json(file, {**record, "status": status}, checksum=True)


def add_evaluation(path: str | Path, evaluation: Mapping[str, Any]) -> Path:
    """Add an evaluation to ``evaluation.json``; one with the same settings is replaced."""
    file = Path(path) / "evaluation.json"
    changes = evaluation.get("changes")
    with folder_locked(path, name=".evaluation.lock", wait=True):  # two evaluations at a time
        before = _json(file, [], evaluations=list).get("evaluations", [])
        others = [e for e in before if e.get("changes") != changes]
        write_json(file, {"evaluations": [*others, dict(evaluation)]})
    return file


def flat(metrics: Mapping[str, Any], prefix: str = "") -> list[tuple[str, Any]]:
    """Return nested figures as one list, names joined by dots."""
    rows: list[tuple[str, Any]] = []
    for name, value in metrics.items():
        inside = isinstance(value, Mapping)
        rows += flat(value, f"{prefix}{name}.") if inside else [(prefix + name, value)]
    return rows


def versions() -> dict[str, str]:
    """Return the versions that a run's figures depend on, by package."""
    found = {name: metadata.version(name) for name in _PACKAGES}
    return {"torchrl_hmcts": __version__, **found, "python": platform.python_version()}


def machine() -> dict[str, Any]:
    """Return what a run's times depend on; nothing that names the machine or its folders."""
    kind = f"{platform.system()} {platform.machine()}".strip()
    return {"cpus": os.cpu_count(), "platform": kind}


def shown_path(value: str) -> str:
    """Return a path as it may be shown to others: without the folders of this machine.

    Example:
        >>> shown_path("/somewhere/private/runs/one"), shown_path("runs/one")
        ('one', 'runs/one')
    """
    path = PurePath(value)
    return path.name if path.is_absolute() or value.startswith("~") else value


def shown_word(word: str) -> str:
    """Return a word of a command line with its path, if it holds one, as :func:`shown_path` does.

    Example:
        >>> shown_word("out=/somewhere/private/one"), shown_word("seed=1")
        ('out=one', 'seed=1')
    """
    key, separator, value = word.partition("=")
    return f"{key}={shown_path(value)}" if separator else shown_path(word)


def _json(path: Path, damage: list[str], **kinds: type) -> dict[str, Any]:
    """A file's content, empty if there is none; or if it is damaged, which is noted.

    ``kinds`` are types of entries, where they are there.
    """
    if not path.is_file():
        return {}
    try:
        content = read_json(path)
        for name, kind in kinds.items():
            if not isinstance(content.get(name, kind()), kind):
                raise ValueError(f"{path} cannot be read: {name} is {content[name]!r}.")
        return content
    except (ValueError, OSError) as error:
        said = " ".join(str(error).split())
        damage.append(said.replace(str(path), f"{path.parent.resolve().name}/{path.name}"))
        return {}

"""A lost ffmpeg, broken libraries, full disks and locales cost a picture, never the run."""

from __future__ import annotations

import builtins
import errno
import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from torchrl.record.loggers import CSVLogger, Logger

from torchrl_hmcts.trainers import cli
from torchrl_hmcts.trainers.figures.animation import write_gif
from torchrl_hmcts.trainers.runs.config import RunConfig
from torchrl_hmcts.trainers.runs.loggers import ScalarLoggers
from torchrl_hmcts.trainers.runs.run import Run
from torchrl_hmcts.trainers.saving import files
from torchrl_hmcts.trainers.saving.files import left_out, replacing, write_text

FULL = OSError(errno.ENOSPC, "No space left on device")
FRAMES = [np.full((4, 4, 3), shade, np.uint8) for shade in (0, 99, 200)]
METRICS = {"solved": 3, "config": {}, "versions": {}}


def full(*_: Any, **__: Any) -> None:
    raise FULL


def without(monkeypatch, *packages: str) -> None:
    """Lets imports of packages fail, also of those that were imported before."""
    real = builtins.__import__

    def load(name: str, *args: Any, **kwargs: Any) -> Any:
        if name.partition(".")[0] in packages:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)
        return real(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", load)


def crashing_ffmpeg(tmp_path) -> str:
    program = tmp_path / "ffmpeg"
    program.write_text('#!/bin/sh\ncase "$*" in *-version*) echo ffmpeg version 7;; esac\nexit 3\n')
    program.chmod(0o755)
    return str(program)


class TestVideo:
    @pytest.mark.parametrize("fault", ["nowhere", "crashes", "no package"])
    def test_a_lost_ffmpeg_costs_the_video_and_one_line(
        self, fault: str, tmp_path, monkeypatch, capsys
    ) -> None:
        (tmp_path / "episode.mp4").write_bytes(b"of an older episode")
        if fault == "no package":
            without(monkeypatch, "imageio_ffmpeg")
        else:
            program = "/nowhere/ffmpeg" if fault == "nowhere" else crashing_ffmpeg(tmp_path)
            monkeypatch.setenv("IMAGEIO_FFMPEG_EXE", program)
        write_gif(FRAMES, tmp_path / "episode.gif", milliseconds=40.0)
        said = capsys.readouterr().err
        assert said.startswith("Left out episode.mp4: ")
        assert said.count("\n") == 1
        assert {path.name for path in tmp_path.iterdir()} - {"ffmpeg"} == {"episode.gif"}


class TestPageAtTheEnd:
    def end(self, out: Path, draw: Callable[[Path], Any]) -> str:
        run = Run(RunConfig(out=str(out)), "demo")
        with run.finish(dict(METRICS), title="A run") as pictures:
            for name in ("one.png", "two.png"):
                with pictures.one(name, name) as path:
                    if name == "one.png":
                        draw(path)
                    write_text(path, "picture")
        page = out / "index.html"
        return page.read_text(encoding="utf-8") if page.is_file() else ""

    def test_figures_are_on_the_disk_before_the_first_picture_is_drawn(self, tmp_path) -> None:
        page = self.end(
            tmp_path, lambda path: json.loads((path.parent / "metrics.json").read_text())
        )
        assert "one.png" in page

    @pytest.mark.parametrize("error", [FULL, ImportError("no font"), AssertionError(), KeyError(1)])
    def test_the_page_has_all_but_the_picture_that_failed(
        self, error: Exception, tmp_path, capsys
    ) -> None:
        def draw(path: Path) -> None:
            raise error

        page = self.end(tmp_path, draw)
        assert "two.png" in page
        assert "one.png" not in page
        assert json.loads((tmp_path / "metrics.json").read_text())["solved"] == 3
        said = capsys.readouterr().err
        assert said.startswith("Left out one.png: ")
        assert said.count("\n") == 1

    def test_ctrl_c_is_no_picture_that_failed(self, tmp_path) -> None:
        def draw(path: Path) -> None:
            raise KeyboardInterrupt

        with pytest.raises(KeyboardInterrupt):
            self.end(tmp_path, draw)
        assert (tmp_path / "metrics.json").is_file()

    @pytest.mark.parametrize("call", ["fsync", "replace"])
    def test_on_a_full_disk_the_figures_are_printed(
        self, call: str, tmp_path, monkeypatch, capsys
    ) -> None:
        (tmp_path / "index.html").write_text("of an older run")
        with monkeypatch.context() as patch:
            patch.setattr(files.os, call, full)
            self.end(tmp_path, lambda path: None)
        said = capsys.readouterr()
        assert json.loads(said.out)["solved"] == 3
        lines = said.err.splitlines()
        assert [line.partition(":")[0] for line in lines] == [
            f"Left out {name}" for name in ("metrics.json", "one.png", "two.png", "index.html")
        ]
        assert (tmp_path / "index.html").read_text() == "of an older run"
        assert [path.name for path in tmp_path.iterdir()] == ["index.html"]

    def test_without_matplotlib_the_page_lacks_its_curves(
        self, tmp_path, monkeypatch, capsys
    ) -> None:
        (tmp_path / "curves.csv").write_text("name,step,value\nloss,1,2\nloss,2,1\n")
        without(monkeypatch, "matplotlib")
        monkeypatch.delitem(sys.modules, "torchrl_hmcts.trainers.figures.curves", raising=False)
        page = self.end(tmp_path, lambda path: None)
        assert "one.png" in page
        assert "Curves" not in page
        assert capsys.readouterr().err.startswith("Left out the curves of the page: No module")

    def test_without_jinja2_the_run_lacks_its_page(self, tmp_path, monkeypatch, capsys) -> None:
        without(monkeypatch, "jinja2")
        assert not self.end(tmp_path, lambda path: None)
        assert (tmp_path / "metrics.json").is_file()
        assert capsys.readouterr().err.startswith("Left out index.html: No module named 'jinja2'")


class Failing(Logger):
    """A logger whose disk is full from its second value on."""

    def __init__(self) -> None:
        self.values = 0
        super().__init__(exp_name="log", log_dir=None)

    def _create_experiment(self) -> None:
        return None

    def log_scalar(self, name: str, value: float, step: int | None = None) -> None:
        self.values += 1
        if self.values > 1:
            raise FULL

    log_video = log_hparams = log_histogram = __repr__ = full  # type: ignore[assignment]


def test_a_logger_on_a_full_disk_is_left_out_and_the_others_continue(tmp_path, capsys) -> None:
    failing, seen = Failing(), []
    csv = CSVLogger(exp_name="log", log_dir=str(tmp_path))
    logger = ScalarLoggers([failing, csv], [lambda *values: seen.append(values)])
    for step in range(4):
        logger.log_scalar("loss", 0.5, step=step)
    logger.close()
    assert failing.values == 2
    assert len(seen) == 4
    assert len((tmp_path / "log" / "scalars" / "loss.csv").read_text().splitlines()) == 4
    said = capsys.readouterr().err
    assert said == "Left out what Failing still had to log: [Errno 28] No space left on device\n"


class TestFiles:
    def test_a_file_is_replaced_in_one_move_whatever_goes_wrong(self, tmp_path) -> None:
        path = tmp_path / "a.png"
        path.write_text("old")

        def stop() -> None:
            with replacing(path) as temporary:
                temporary.write_text("ne")
                raise KeyboardInterrupt

        with pytest.raises(KeyboardInterrupt):
            stop()
        assert path.read_text() == "old"
        with replacing(path) as temporary:
            assert temporary.suffix == ".png"
            temporary.write_text("new")
        assert path.read_text() == "new"
        assert [path.name for path in tmp_path.iterdir()] == ["a.png"]

    def test_what_killed_processes_left_of_a_file_is_removed(self, tmp_path) -> None:
        gone = subprocess.Popen([sys.executable, "-c", ""])
        gone.wait()
        for name in (f".writing-{gone.pid}.a.json", f".a.json.writing-{gone.pid}"):
            (tmp_path / name).write_text("half")
        (tmp_path / f".writing-{os.getppid()}.a.json").write_text("of a process that runs")
        write_text(tmp_path / "a.json", "{}")
        names = sorted(path.name for path in tmp_path.iterdir())
        assert names == [f".writing-{os.getppid()}.a.json", "a.json"]

    def test_a_name_of_a_locale_without_utf8_is_written_as_its_bytes(self, tmp_path) -> None:
        name = os.fsdecode("ünï".encode()) if os.name == "posix" else "ünï"
        write_text(tmp_path / "a.html", "ünï".encode().decode("ascii", "surrogateescape") + name)
        assert (tmp_path / "a.html").read_text(encoding="utf-8") == "ünïünï"

    def test_a_long_reason_is_one_line(self, capsys) -> None:
        with left_out("episode.mp4"):
            raise RuntimeError("a\nb\n" + 999 * "c")
        said = capsys.readouterr().err
        assert said.startswith("Left out episode.mp4: a b ccc")
        assert said.count("\n") == 1
        assert len(said) < 400


def test_pages_of_runs_are_the_same_bytes_in_every_locale(tmp_path) -> None:
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        config = {"seed": 0, "out": "ünï"}
        (tmp_path / name / "metrics.json").write_text(
            json.dumps({"solved": 1, "config": config}, ensure_ascii=False), encoding="utf-8"
        )
    runs = [str(tmp_path / name) for name in ("a", "b")]
    assert cli.main(["report", *runs, f"out={tmp_path / 'here.html'}"]) == 0
    plain = {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}
    there = tmp_path / "ünï.html"
    command = [sys.executable, "-m", "torchrl_hmcts.trainers.cli", "report", *runs, f"out={there}"]
    for more in ({}, {"PYTHONIOENCODING": "ascii"}):
        done = subprocess.run(command, env={**os.environ, **plain, **more}, capture_output=True)
        assert (done.returncode, done.stderr) == (0, b"")
        assert there.read_bytes() == (tmp_path / "here.html").read_bytes()

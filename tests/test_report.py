"""Pages of runs: what stands on them, that nothing gets in unescaped, and how they look."""

from __future__ import annotations

import base64
import json
import re
import shutil
import subprocess
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import pytest

from torchrl_hmcts.trainers import HMCTS
from torchrl_hmcts.trainers.cli import main
from torchrl_hmcts.trainers.experiments.registry import load_config
from torchrl_hmcts.trainers.figures.intervals import bootstrap, interquartile_mean
from torchrl_hmcts.trainers.figures.pages import picture, plain
from torchrl_hmcts.trainers.figures.run_page import group_runs, write_page, write_run_page
from torchrl_hmcts.trainers.saving.run_folder import (
    RunFolder,
    add_evaluation,
    read_curves,
    read_run,
)

EVIL = '<script>alert("x")</script>'


def write_run(path: Path, seed: int = 0, *, finished: bool = True, **config: object) -> Path:
    """A run's folder as an experiment leaves it, with two pictures and a curve."""
    path.mkdir(parents=True)
    keys = {"seed": seed, "out": f"/private/place/{path.name}", "total_frames": 4_000, **config}
    record = {
        "experiment": "waterworld_a3c",
        "config": keys,
        "commands": [f"hmcts train experiment=waterworld_a3c seed={seed}"],
        "versions": {"torch": "9.9"},
        "machine": {"cpus": 2, "platform": "Linux x86_64"},
        "status": "finished" if finished else "stopped",
    }
    (path / "run.json").write_text(json.dumps(record))
    rows = [f"eval_solved_share,{t},{0.1 * seed + (t / 4_000) ** 2}" for t in (0, 2_000, 4_000)]
    (path / "curves.csv").write_text("name,frames,value\n" + "\n".join(rows) + "\n")
    if finished:
        test = {"solved": 10 + seed, "frames": {"mean": 100.0 + seed, "median": 90.0, "p95": 1.0}}
        (path / "metrics.json").write_text(json.dumps({"seed": seed, "test": test}))
    pixels = np.full((60, 90, 3), 200, dtype=np.uint8)
    iio.imwrite(path / "learning.png", pixels)
    iio.imwrite(path / "episode.gif", np.stack([pixels, pixels // 2]), loop=0)
    captions = {"learning.png": "The test curve.", "episode.gif": "An episode."}
    (path / "page.json").write_text(json.dumps({"title": "A3C", "pictures": captions}))
    return path


def test_a_page_leads_with_four_curves_and_leaves_straight_lines_out(tmp_path) -> None:
    run = write_run(tmp_path / "one")
    names = ("actor_loss", "alpha", "critic_loss", "entropy", "eval_solved_share", "grad_norm")
    rows = [f"{name},{t},{t * t}" for name in names for t in (0, 1, 2)]
    rows += [f"optim_steps,{t},{4 * t}" for t in (0, 1, 2)] + [f"lr,{t},0.1" for t in (0, 1, 2)]
    (run / "curves.csv").write_text("name,frames,value\n" + "\n".join(rows) + "\n")
    assert main(["report", str(run)]) == 0
    page = (run / "index.html").read_text()
    leading, _, folded = page.partition("All other curves")
    drawn = [name for name in names if f'alt="{name}' in leading]
    assert drawn == ["actor_loss", "alpha", "critic_loss", "eval_solved_share"]
    assert 'alt="entropy' in folded
    assert "optim_steps" not in page
    assert 'alt="lr' not in page


def sources(page: str) -> list[str]:
    return re.findall(r'<img src="([^"]*)"', page)


def test_the_page_of_a_run_shows_figures_pictures_curve_config_and_command(tmp_path) -> None:
    run = write_run(tmp_path / "one", seed=3)
    assert main(["report", str(run)]) == 0
    page = (run / "index.html").read_text()
    assert "<title>A3C</title>" in page
    assert {"learning.png", "episode.gif"} <= set(sources(page))
    assert "The test curve." in page
    assert any(source.startswith("data:image/svg+xml") for source in sources(page))
    assert 'title="test.solved"' in page
    assert "hmcts train experiment=waterworld_a3c seed=3" in page
    assert "torch 9.9" in page
    assert "2 CPUs, Linux x86_64" in page
    assert "Base steps of training" in page  # what the key means
    assert 'title="default: 2000000">4000' in page  # what is not the default stands out
    assert "/private" not in page  # no folder of the machine
    assert str(tmp_path) not in page


def test_a_gif_with_a_video_beside_it_links_to_it(tmp_path) -> None:
    path = tmp_path / "episode.gif"
    iio.imwrite(path, np.zeros((2, 8, 8, 3), np.uint8), loop=0)
    assert not picture(path, "An episode.", embed=False).video
    path.with_suffix(".mp4").write_bytes(b"x")
    assert picture(path, "An episode.", embed=False).video == "episode.mp4"
    assert not picture(path, "An episode.", embed=True).video  # it does not lie beside the page


def test_a_page_in_another_place_holds_its_pictures(tmp_path) -> None:
    run = write_run(tmp_path / "one")
    assert main(["report", str(run), f"out={tmp_path}/page.html"]) == 0
    found = sources((tmp_path / "page.html").read_text())
    assert len(found) == 3
    assert all(source.startswith("data:image/") for source in found)
    gif = next(s for s in found if s.startswith("data:image/gif;base64,"))
    assert base64.b64decode(gif.partition(",")[2]) == (run / "episode.gif").read_bytes()


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("run.json", b'{"experiment": "wat'),
        ("run.json", b"[]"),
        ("run.json", b'{"config": 3}'),
        ("run.json", b'{"experiment": "x", "checksum": "0"}'),
        ("run.json", b"\xff\x00"),
        ("metrics.json", b""),
        ("metrics.json", b"null"),
        ("page.json", b'{"title": 3}'),
        ("page.json", b'{"pictures": ["a.png"]}'),
        ("evaluation.json", b'{"evaluations": {}}'),
        ("curves.csv", b"name,frames,value\nloss,1,2\nloss,3"),
        ("curves.csv", b"name,frames,value\nlo\xff,\x00,2\n"),
    ],
)
def test_a_damaged_file_is_named_once_and_spares_all_else(
    name: str, content: bytes, tmp_path, capsys
) -> None:
    bad, good = write_run(tmp_path / "bad"), write_run(tmp_path / "good", 7, gamma=0.9)
    (bad / name).write_bytes(content)
    assert main(["report", str(bad)]) == 0
    assert main(["report", str(bad), str(good), f"out={tmp_path}/both.html"]) == 0
    said = capsys.readouterr().err.splitlines()
    assert said == [said[0], said[0]]
    assert said[0].startswith(f"bad/{name} cannot be read: ")
    for page in (bad / "index.html", tmp_path / "both.html"):
        text = page.read_text()
        assert text.count(f"Damaged: bad/{name} cannot be read") == 1
        assert str(tmp_path) not in text
    assert ">17<" in text  # the other run's figure
    if name == "run.json":
        for words in (["train", f"resume={bad}"], ["evaluate", f"run={bad}"]):
            assert main(words) == 2
            assert "bad/run.json cannot be read" in capsys.readouterr().err


def test_whatever_a_run_says_is_escaped(tmp_path) -> None:
    run = write_run(tmp_path / "one", total_frames=EVIL)
    record = json.loads((run / "run.json").read_text())
    record["commands"], record["versions"], record["status"] = [EVIL], {EVIL: EVIL}, EVIL
    record["config"][EVIL] = EVIL
    (run / "run.json").write_text(json.dumps(record))
    (run / "metrics.json").write_text(json.dumps({EVIL: {EVIL: EVIL, "mean": EVIL}}))
    captions = {"title": EVIL, "pictures": {"learning.png": EVIL}}
    (run / "page.json").write_text(json.dumps(captions))
    (run / "curves.csv").write_text(f"name,frames,value\n{EVIL},0,1\n{EVIL},1,2\n")
    add_evaluation(run, {"changes": {EVIL: EVIL}, "results": {EVIL: EVIL}, "command": EVIL})
    write_run_page(read_run(run))
    other = write_run(tmp_path / "two", total_frames=EVIL + "2")
    assert main(["report", str(run), str(other), f"out={tmp_path}/both.html"]) == 0
    for file in (run / "index.html", tmp_path / "both.html"):
        assert "<script" not in file.read_text()


def test_runs_that_differ_in_their_seeds_are_one_group(tmp_path) -> None:
    runs = [read_run(write_run(tmp_path / f"a{s}", s)) for s in (0, 1)]
    runs += [read_run(write_run(tmp_path / f"b{s}", s, total_frames=9)) for s in (0, 1, 2)]
    groups = group_runs(runs)
    assert [(g.name, len(g.runs)) for g in groups] == [
        ("waterworld_a3c, total_frames=4000", 2),
        ("waterworld_a3c, total_frames=9", 3),
    ]
    assert groups[1].figures() == {"test.solved": [10, 11, 12], "test.frames": [100, 101, 102]}


def test_a_comparison_shows_means_intervals_and_every_run(tmp_path) -> None:
    folders = [str(write_run(tmp_path / f"a{s}", s)) for s in (0, 1, 2)]
    folders.append(str(write_run(tmp_path / "b", 0, total_frames=9)))
    assert main(["report", *folders, f"out={tmp_path}/cmp"]) == 0
    page = (tmp_path / "cmp" / "index.html").read_text()
    assert "4 runs compared" in page
    assert ">11<br><small>10 to 12</small>" in page  # test.solved of the three seeds
    assert "seeds 0, 1, 2" in page
    assert all(source.startswith("data:image/") for source in sources(page))
    for name in ("a0", "a1", "a2", "b"):
        assert f'<td class="text">{name}</td>' in page


def test_a_folder_of_runs_stands_for_all_of_them(tmp_path, capsys) -> None:
    for seed in (0, 1):
        write_run(tmp_path / "runs" / f"a{seed}", seed)
    assert main(["report", f"{tmp_path}/runs", f"out={tmp_path}/cmp"]) == 0
    assert "2 runs compared" in (tmp_path / "cmp" / "index.html").read_text()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ([], "say which runs"),
        (["nothing-here"], "no folder of a run"),
        (["figur=3.1"], "Did you mean: figure"),
        (["results=x", "{run}"], "results=DIR is for figure=NAME"),
    ],
)
def test_what_report_cannot_do_is_said(tmp_path, capsys, words, message) -> None:
    run = write_run(tmp_path / "one")
    assert main(["report", *(word.format(run=run) for word in words)]) == 2
    assert message in capsys.readouterr().err


def test_curves_are_read_in_every_form_and_while_the_run_goes_on(tmp_path) -> None:
    (tmp_path / "log" / "scalars" / "test").mkdir(parents=True)
    (tmp_path / "log" / "scalars" / "test" / "x.csv").write_text("8,2.0\n4,1.0\n")
    assert read_curves(tmp_path)["test/x"].steps == [4.0, 8.0]
    for head, label in (("name,frames,value", "base steps"), ("name,step,value", "steps")):
        (tmp_path / "curves.csv").write_text(f"{head}\nx,4,1.5\nx,8,nan\ny,4,2\n")
        curves = read_curves(tmp_path)
        assert (curves["x"].steps, curves["x"].values) == ([4.0], [1.5])
        assert curves["y"].step_label == label


def test_a_run_without_a_record_is_known_by_its_keys(tmp_path) -> None:
    config = {"seed": 3, "size": 9, "option_frames": 100}
    (tmp_path / "metrics.json").write_text(json.dumps({"solved": 1, "config": config}))
    experiment, loaded = load_config(read_run(tmp_path))
    assert experiment.name == "labmaze"
    assert loaded.seed == 3
    assert loaded.out == str(tmp_path)


def test_a_run_whose_keys_are_gone_says_which(tmp_path) -> None:
    run = RunFolder(tmp_path, {"experiment": "labmaze", "config": {"old_key": 1}})
    with pytest.raises(ValueError, match="no longer has: old_key"):
        load_config(run)


def test_a_page_can_be_written_where_no_run_was_recorded(tmp_path) -> None:
    write_page(tmp_path / "index.html", title="T", metrics={"config": {"a": 1}}, pictures={})
    assert "<code>a</code>" in (tmp_path / "index.html").read_text()


def test_the_bootstrap_covers_the_mean_about_as_often_as_it_says() -> None:
    generator = np.random.default_rng(1)
    samples = generator.normal(5.0, 2.0, size=(100, 30))
    share = np.mean([low <= 5.0 <= high for _, low, high in map(bootstrap, samples)])
    assert 0.88 <= share <= 0.99  # 95 %, less what 30 values cost


def test_the_interquartile_mean_leaves_a_quarter_out_at_each_end() -> None:
    assert interquartile_mean(np.array([9.0, 1.0, 2.0, 1000.0, 3.0, 4.0, 5.0, -7.0])) == 3.5


@pytest.mark.parametrize(
    ("value", "shown"),
    [(None, "-"), (float("nan"), "-"), (1234, "1,234"), (0.5, "0.5"), (True, "yes"), ([], "-")],
)
def test_values_are_written_as_people_read_them(value, shown) -> None:
    assert plain(value) == shown


CHROMIUM = next(
    (p for n in ("chromium", "chromium-browser", "google-chrome") if (p := shutil.which(n))), None
)


FRAME = """<html><body><iframe id="f" width="{width}" height="844" style="border:0" src="{page}">
</iframe><pre id="out"></pre><script>
const f = document.getElementById("f");
const errors = [];
f.onload = () => {{
  f.contentWindow.onerror = (e) => errors.push(String(e));
  const d = f.contentDocument;
  const size = (e) => parseFloat(getComputedStyle(e).fontSize);
  setTimeout(() => {{
    document.getElementById("out").textContent = JSON.stringify({{
      errors,
      images: [...d.images].map((i) => i.naturalWidth),
      width: d.documentElement.scrollWidth,
      font: Math.min(...[...d.querySelectorAll("p,td,figcaption,h2")].map(size)) }});
  }}, 300);
}};</script></body></html>"""
BROWSER = [
    *(str(CHROMIUM), "--headless=new", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage"),
    "--allow-file-access-from-files",  # the frame looks into the page
    *("--virtual-time-budget=8000", "--enable-logging=stderr", "--dump-dom"),
]


def rendered(file: Path, folder: Path, width: int) -> dict:
    """Open a page in a frame of a phone's width; return what the browser says about it."""
    frame = folder / "frame.html"
    frame.write_text(FRAME.format(width=width, page=file.as_uri()))
    words = [*BROWSER, f"--user-data-dir={folder}/profile", frame.as_uri()]
    done = subprocess.run(words, capture_output=True, text=True, timeout=120)
    assert "CONSOLE" not in done.stderr, done.stderr
    found = re.search(r'<pre id="out">(.+?)</pre>', done.stdout, re.S)
    assert found, done.stdout[-2000:] + done.stderr[-2000:]
    return json.loads(found[1])


@pytest.mark.skipif(CHROMIUM is None, reason="there is no Chromium on this machine")
@pytest.mark.parametrize(("kind", "width"), [("run", 390), ("comparison", 390), ("run", 1280)])
def test_a_page_opens_with_all_pictures_and_nothing_cut_off(tmp_path, kind, width) -> None:
    runs = [write_run(tmp_path / f"a{s}", s) for s in (0, 1)]
    runs.append(write_run(tmp_path / "b", 0, total_frames=9))
    file = runs[0] / "index.html"
    if kind == "run":
        add_evaluation(runs[0], {"changes": {"seed": 7}, "results": {"solved": 1}, "command": "x"})
        write_run_page(read_run(runs[0]))
    else:
        file = tmp_path / "cmp.html"
        assert main(["report", *map(str, runs), f"out={file}"]) == 0
    told = rendered(file, tmp_path, width)
    assert told["errors"] == []
    assert len(told["images"]) >= 3
    assert min(told["images"]) > 0  # all pictures have loaded
    assert told["width"] <= width  # no scrolling to the side
    assert told["font"] >= 14


@pytest.mark.skipif(CHROMIUM is None, reason="there is no Chromium on this machine")
def test_the_page_of_an_episode_opens_and_its_film_moves(tmp_path, monkeypatch) -> None:
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    HMCTS("MountainCar-v0", option_steps=14, improve_expansions=1).save(tmp_path / "agent")
    assert main(["play", f"run={tmp_path / 'agent'}"]) == 0
    page = tmp_path / "agent/play/index.html"
    told = rendered(page, tmp_path, 390)
    assert told["errors"] == []
    assert len(told["images"]) == 2  # film and search
    assert min(told["images"]) > 0
    assert told["width"] <= 390
    (film,) = page.parent.glob("*.gif")
    first, *_, last = iio.imread(film)
    assert (first != last).any()

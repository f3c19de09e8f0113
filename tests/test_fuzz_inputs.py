"""Mazes, states, masks, specs, configurations and checkpoint files that make no sense."""

from __future__ import annotations

import json
import math
import os
import shutil
import zipfile
from collections import Counter
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from tensordict import TensorDict
from torch import nn
from torchrl.checkpoint import CheckpointError
from torchrl.data import Binary, Bounded, Categorical, Composite, MultiOneHot, OneHot, Unbounded

from torchrl_hmcts.envs import (
    GridworldMazeEnv,
    WaterworldMazeEnv,
    maze_from_text,
    maze_pool,
    maze_to_text,
)
from torchrl_hmcts.envs.mazes.layouts import check_mazes
from torchrl_hmcts.modules import SkillActor
from torchrl_hmcts.planners import Root, Transition, tree_search
from torchrl_hmcts.trainers.experiments.settings import (
    DemoConfig,
    LabMazeConfig,
    WaterworldGoalsConfig,
)
from torchrl_hmcts.trainers.runs.config import parse_overrides
from torchrl_hmcts.trainers.saving.checkpoints import (
    DurableRotation,
    find_damage,
    newest_checkpoint,
    plain_checkpoint,
)

CASES: Counter[str] = Counter()
MANY = int(os.environ.get("TORCHRL_HMCTS_FUZZ_TIMES", "1"))
FLOATS = st.one_of(
    st.floats(width=32), st.sampled_from([math.nan, math.inf, -math.inf, 0.0, 3.5, 4.5, 1e30])
)


def cases(number: int) -> Any:
    return settings(
        max_examples=number * MANY,
        suppress_health_check=list(HealthCheck),
        database=None,
        deadline=None,
    )


def refused(error: Exception, *words: str) -> None:
    """The error must say what it is about."""
    assert any(word in str(error) for word in words), f"{type(error).__name__}: {error}"


@cache
def envs() -> dict[str, Any]:
    return {
        "waterworld": WaterworldMazeEnv(maze_pool("train")[:3], observation=False),
        "gridworld": GridworldMazeEnv(maze_pool("train")[:3], observation=False),
    }


@cases(300)
@given(
    st.lists(st.integers(0, 11), max_size=4),
    st.sampled_from([torch.bool, torch.uint8, torch.float32, torch.int64, torch.complex64]),
    st.sampled_from(["zeros", "ones", "random", "ring", "nan"]),
    st.integers(0, 999),
)
def test_mazes_of_any_shape_type_and_content(
    shape: list[int], dtype: torch.dtype, how: str, seed: int
) -> None:
    CASES["mazes"] += 1
    random = torch.rand(shape, generator=torch.Generator().manual_seed(seed))
    mazes = (random < {"zeros": 0.0, "ones": 2.0, "random": 0.5, "ring": 0.2, "nan": 0.3}[how]).to(
        dtype
    )
    if how == "ring" and len(shape) >= 2:
        mazes[..., :1] = mazes[..., -1:] = mazes[..., :1, :] = mazes[..., -1:, :] = True
    if how == "nan" and dtype.is_floating_point:
        mazes = mazes * float("nan")
    try:
        check_mazes(mazes)
    except (ValueError, TypeError) as error:
        refused(error, "maze", "Maze")
        for kind in (WaterworldMazeEnv, GridworldMazeEnv):
            with pytest.raises((ValueError, TypeError), match="(?i)maze"):
                kind(mazes)
        return
    state = GridworldMazeEnv(mazes).reset()
    assert torch.isfinite(state["position"]).all()


@cases(300)
@given(st.one_of(st.text(), st.text(alphabet="#PTG* .\n", max_size=60)))
def test_mazes_of_any_text(text: str) -> None:
    CASES["maze texts"] += 1
    try:
        maze, player, target = maze_from_text(text)
    except (ValueError, TypeError) as error:
        refused(error, "maze", "Maze", "text", repr(text))
    else:
        again = maze_from_text(maze_to_text(maze, player, target))
        assert torch.equal(again[0], maze)
        assert again[1:] == (player, target)


@cases(300)
@given(
    st.sampled_from(["waterworld", "gridworld"]),
    st.sampled_from(["position", "velocity", "target", "maze_index", "step_count", "player_tile"]),
    st.lists(FLOATS, min_size=2, max_size=2),
)
def test_states_with_any_numbers_are_refused_or_go_on_finitely(
    name: str, key: str, values: list[float]
) -> None:
    CASES["states"] += 1
    env = envs()[name]
    env.set_seed(0)
    state = env.reset()
    if key not in state.keys():
        return
    old = state[key]
    raw = torch.tensor(values)[: max(1, old.numel())].reshape(old.shape)
    integers = raw.nan_to_num(0.0, 99.0, -99.0).clamp(-(2**31), 2**31 - 1)
    state[key] = (raw if old.is_floating_point() else integers).to(old.dtype)
    try:
        begun = env.reset(state.exclude("reward"), set_state=True)
        begun["action"] = env.action_spec.rand()
        after = env.step(begun)["next"]
    except (ValueError, TypeError) as error:
        refused(error, key, "state", "position", "tile")
    else:
        for entry, value in after.items(True, True):
            assert torch.isfinite(value.double()).all(), (key, values, entry)


def walk(states: Any, options: Any) -> Transition:
    n = len(states)
    return Transition(
        np.zeros(n, np.float32),
        np.full(n, 0.9, np.float32),
        np.full((n, 2), 0.5, np.float32),
        np.zeros(n, np.float32),
        (states * 2 + options) % 7,
    )


@cases(300)
@given(
    st.lists(st.integers(0, 4), max_size=3),
    st.sampled_from([np.bool_, np.int64, np.float32, object]),
    st.floats(0, 1),
    st.one_of(st.none(), FLOATS),
)
def test_masks_of_any_shape_and_type(shape: list[int], dtype: Any, share: float, odd: Any) -> None:
    CASES["masks"] += 1
    mask = np.array(np.random.default_rng(0).random(shape) < share, dtype=dtype)
    if odd is not None and mask.size and dtype is not np.bool_:
        with np.errstate(all="ignore"):
            mask.flat[0] = odd if dtype is not np.int64 else 7
    root = Root(np.full((2, 2), 0.5, np.float32), np.zeros(2, np.float32), np.zeros(2, np.int64))
    try:
        search = tree_search(root, walk, 8, mask=mask)
    except (ValueError, TypeError) as error:
        refused(error, "mask", "option", "action")
    else:
        assert torch.isfinite(search.tree.view().node_values).all()


SPECS = st.one_of(
    st.integers(1, 5).map(OneHot),
    st.integers(1, 5).map(Categorical),
    st.lists(st.integers(1, 3), min_size=1, max_size=3).map(MultiOneHot),
    st.integers(1, 3).map(Binary),
    st.tuples(FLOATS, FLOATS, st.integers(0, 3)).map(
        lambda x: Unbounded((x[2],)) if not x[0] < x[1] else Bounded(x[0], x[1], (x[2],))
    ),
    st.sampled_from([None, 3, "one-hot", torch.zeros(2), "empty composite", "composite"]),
)
COMPOSITES = {"empty composite": Composite(), "composite": Composite(a=OneHot(2))}


@cases(300)
@given(SPECS, st.integers(-1, 4))
def test_specs_of_any_kind(spec: Any, num_skills: int) -> None:
    CASES["specs"] += 1
    if isinstance(spec, str):
        spec = COMPOSITES.get(spec, spec)
    try:
        actor = SkillActor(2, spec, num_skills, in_keys=["velocity"], hidden=(2,))
    except (ValueError, TypeError) as error:
        refused(error, "spec", "num_skills", "bounds", "out_features")
    else:
        td = TensorDict(velocity=torch.zeros(3, 2), skill=torch.zeros(3).long(), batch_size=[3])
        action = actor(td)["action"]
        assert action.shape[1:] == spec.shape
        assert spec.is_in(action[0].to(spec.dtype))


KEYS = st.sampled_from(
    ["seed", "out", "mazes", "gamma", "num_skills", "objective", "toy", "novelty_radius", "x"]
)


@cases(500)
@given(
    st.sampled_from([DemoConfig, LabMazeConfig, WaterworldGoalsConfig]),
    st.lists(
        st.one_of(
            st.text(),
            st.tuples(
                KEYS,
                st.one_of(
                    st.text(), st.integers().map(str), FLOATS.map(str), st.sampled_from(["true"])
                ),
            ).map("=".join),
        ),
        min_size=1,
        max_size=3,
    ),
)
def test_words_of_the_command_line(config: Any, words: list[str]) -> None:
    CASES["configurations"] += 1
    try:
        made = parse_overrides(config, words)
    except (ValueError, TypeError) as error:
        parts = [part for word in words for part in (word, *word.split("="))]
        refused(error, *(part for part in parts if part), "''", *map(repr, words + parts))
    else:
        for name, value in vars(made).items():
            assert not (isinstance(value, float) and math.isnan(value)), name


@pytest.fixture(scope="module")
def saved(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("saved")
    torch.manual_seed(0)
    DurableRotation(folder).save(plain_checkpoint(net=nn.Linear(3, 2)), step=1)
    return folder


def load_or_refuse(path: Path, whole: bytes) -> None:
    """A file whose bytes differ is damaged or gives the same weights; nothing else happens."""
    net = nn.Linear(3, 2)
    damage = find_damage(path)
    if damage is not None:
        with pytest.raises(CheckpointError, match="damaged"):
            newest_checkpoint(path)
        return
    plain_checkpoint(net=net).load(newest_checkpoint(path))
    torch.manual_seed(0)
    assert torch.equal(net.weight, nn.Linear(3, 2).weight)


@cases(300)
@given(st.data())
def test_checkpoints_with_any_bytes_changed(saved: Path, data: Any) -> None:
    CASES["checkpoint bytes"] += 1
    (path,) = saved.iterdir()
    whole = path.read_bytes()
    content = bytearray(whole)
    for _ in range(data.draw(st.integers(1, 4))):
        content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    copy = path.parent.parent / "copy.torchrl"
    copy.write_bytes(content)
    try:
        load_or_refuse(copy, whole)
    except CheckpointError as error:  # a version number that was hit
        refused(error, "version", "damaged", "manifest", "component")


JSON = st.recursive(
    st.one_of(st.none(), st.booleans(), st.integers(-9, 9), st.text(max_size=4)),
    lambda inner: st.one_of(
        st.lists(inner, max_size=3), st.dictionaries(st.text(max_size=4), inner, max_size=3)
    ),
    max_leaves=6,
)


@cases(300)
@given(
    JSON,
    st.sampled_from(
        [
            (),
            ("components",),
            ("components", "net"),
            ("components", "net", "files"),
            ("components", "net", "path"),
            ("metadata",),
            ("metadata", "torchrl_hmcts"),
            ("format_version",),
            ("created_at",),
        ]
    ),
)
def test_checkpoints_with_any_manifest(saved: Path, value: Any, where: tuple[str, ...]) -> None:
    CASES["checkpoint manifests"] += 1
    (path,) = saved.iterdir()
    folder = saved.parent / "rewritten"
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    with zipfile.ZipFile(path) as old:
        content = {name: old.read(name) for name in old.namelist()}
    manifest = json.loads(content["manifest.json"])
    inner = manifest
    for name in where[:-1]:
        inner = inner[name]
    if where:
        inner[where[-1]] = value
    content["manifest.json"] = json.dumps(manifest if where else value).encode()
    copy = folder / path.name
    with zipfile.ZipFile(copy, "w") as new:
        for name, data in content.items():
            new.writestr(name, data)
    net = nn.Linear(3, 2)
    try:
        plain_checkpoint(net=net).load(newest_checkpoint(folder))
    except (CheckpointError, FileNotFoundError) as error:
        refused(error, "heckpoint")
    assert torch.isfinite(net.weight).all()


def test_the_cases_are_counted() -> None:
    """Runs last; writes the counts where TORCHRL_HMCTS_FUZZ_COUNT says."""
    path = os.environ.get("TORCHRL_HMCTS_FUZZ_COUNT")
    if path:
        with open(path, "a") as file:
            for name, count in CASES.items():
                file.write(f"{name} {count}\n")


@pytest.mark.slow
def test_ten_times_as_many_inputs() -> None:
    import subprocess
    import sys

    words = [sys.executable, "-m", "pytest", __file__, "-q", "-p", "no:cacheprovider"]
    done = subprocess.run(words, env={**os.environ, "TORCHRL_HMCTS_FUZZ_TIMES": "10"})
    assert done.returncode == 0

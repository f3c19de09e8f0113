"""Nothing executes code from a file that it loads, and nothing talks to the network unasked."""

from __future__ import annotations

import ast
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch
from tensordict import NonTensorData, TensorDict

from torchrl_hmcts.trainers.figures.run_page import write_page
from torchrl_hmcts.trainers.skills.dataset import load_dataset

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

ROOT = Path(__file__).resolve().parent.parent
SOURCES = sorted(
    path
    for folder in ("torchrl_hmcts", "envs", "trainers", "benchmarks")
    for path in (ROOT / folder).rglob("*.py")
)
# Bytes that a process of ours sends to another through a pipe; no file and no socket is read.
PIPES = {"trainers/a3c/actor_learner.py"}
SAFE_ONLY_WITH = {  # the argument that makes a call safe, and its value
    "torch.load": ("weights_only", True),
    "np.load": ("allow_pickle", False),
    "numpy.load": ("allow_pickle", False),
    "load_memmap": ("allow_pickle", False),
}
NEVER = re.compile(
    r"(c?[Pp]ickle\.(load|loads|Unpickler)|cloudpickle\.(load|loads)|dill\.\w+|joblib\.load|marshal\.loads?"
    r"|shelve\.\w+|yaml\.(load|unsafe_load|full_load)|eval|exec|os\.system|os\.popen|pd\.read_pickle"
    r"|tensordict\.load|TensorDict\.load|.*\.from_consolidated)"
)


def dotted(node: ast.expr) -> str:
    """Returns ``a.b.c`` for such an expression; other parts are left out."""
    if isinstance(node, ast.Attribute):
        return f"{dotted(node.value)}.{node.attr}".lstrip(".")
    return node.id if isinstance(node, ast.Name) else ""


def dangers(source: str) -> Iterator[str]:
    """Yields each call that may execute what a file says."""
    for node in ast.walk(ast.parse(source)):
        if not isinstance(node, ast.Call):
            continue
        name = dotted(node.func)
        given = {k.arg: getattr(k.value, "value", None) for k in node.keywords}
        for call, (argument, value) in SAFE_ONLY_WITH.items():
            if name == call or name.endswith("." + call):
                if given.get(argument) is not value:
                    yield f"line {node.lineno}: {name}() without {argument}={value}"
        copies = node.args and isinstance(node.args[0], ast.Call)  # loads(dumps(x))
        if copies and dotted(node.args[0].func) == name.replace(".loads", ".dumps"):
            continue
        if NEVER.fullmatch(name):
            yield f"line {node.lineno}: {name}()"
        if given.get("shell") is True:
            yield f"line {node.lineno}: {name}(shell=True)"


def test_no_module_loads_what_could_execute_code() -> None:
    found = {}
    for path in SOURCES:
        name = str(path.relative_to(ROOT))
        dangerous = list(dangers(path.read_text()))
        if name in PIPES:
            dangerous = [danger for danger in dangerous if "cloudpickle.loads" not in danger]
        found.update({name: dangerous} if dangerous else {})
    assert found == {}


@pytest.mark.parametrize(
    ("source", "number"),
    [
        ("torch.load('x')", 1),
        ("torch.load('x', weights_only=False)", 1),
        ("torch.load('x', weights_only=True)", 0),
        ("pickle.load(file)", 1),
        ("pickle.loads(pickle.dumps(x))", 0),
        ("eval('1')", 1),
        ("network.eval()", 0),
        ("yaml.load(text)", 1),
        ("np.load('x', allow_pickle=True)", 1),
        ("TensorDict.load_memmap('x')", 1),
        ("subprocess.run('ls', shell=True)", 1),
    ],
)
def test_the_check_catches_what_is_dangerous_and_lets_the_rest_pass(
    source: str, number: int
) -> None:
    assert len(list(dangers(source))) == number


class Bomb:
    """Makes a folder when it is unpickled."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def __reduce__(self) -> tuple[object, tuple[str]]:
        return os.mkdir, (str(self.folder),)


def test_a_dataset_with_a_pickle_is_refused_and_not_opened(tmp_path: Path) -> None:
    data = TensorDict(skill=torch.arange(3), batch_size=[3])
    data["note"] = NonTensorData(Bomb(tmp_path / "exploded"), batch_size=[3])
    data.memmap(tmp_path / "data")
    assert list((tmp_path / "data").rglob("*.pickle"))
    with pytest.raises(Exception, match="(?i)refusing to load pickled"):
        load_dataset(tmp_path / "data", ["skill"])
    assert not (tmp_path / "exploded").exists()


@pytest.mark.parametrize("where", ["title", "metric", "value", "picture", "caption", "nested"])
def test_the_page_escapes_every_place(where: str, tmp_path: Path) -> None:
    evil = "\"'><script>alert(1)</script>"
    at = dict.fromkeys(("title", "metric", "value", "picture", "caption", "nested"), "plain")
    at[where] = evil
    write_page(
        tmp_path / "index.html",
        title=at["title"],
        metrics={at["metric"]: at["value"], "group": {at["nested"]: [at["value"]]}},
        pictures={at["picture"]: at["caption"]},
    )
    page = (tmp_path / "index.html").read_text()
    assert "<script" not in page
    if where != "picture":  # a picture that is not there is left out
        assert "&lt;script&gt;alert(1)" in page
    assert "http" not in page  # it loads nothing from elsewhere


OFFLINE = """
import importlib, pkgutil, socket, sys
def refuse(event, args):
    if event == "socket.connect" and isinstance(args[1], tuple) or event in (
        "socket.getaddrinfo", "socket.gethostbyname", "socket.sendto", "urllib.Request"):
        raise SystemExit(f"network use: {event} {args}")
sys.addaudithook(refuse)
import torchrl_hmcts, torchrl_hmcts.envs, torchrl_hmcts.trainers
count = 0
for package in (torchrl_hmcts, torchrl_hmcts.envs, torchrl_hmcts.trainers):
    for module in pkgutil.walk_packages(package.__path__, package.__name__ + "."):
        try:
            importlib.import_module(module.name)
        except ModuleNotFoundError as error:  # an extra that is not installed
            assert "torchrl_hmcts" not in error.name, error
        count += 1
from torchrl_hmcts.trainers.cli import main
status = main(["demo", "toy=true", "out=" + sys.argv[1]])
try:
    socket.create_connection(("127.0.0.1", 9))
except SystemExit:
    print("guarded", count, status)
"""


def test_importing_training_planning_and_reporting_use_no_network(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-c", OFFLINE, str(tmp_path / "run")], capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr[-2000:]
    word, count, status = done.stdout.split()[-3:]
    assert (word, status) == ("guarded", "0")
    assert int(count) > 100


def test_every_dependency_is_listed_with_its_reason() -> None:
    page = (ROOT / "docs" / "reliability.md").read_text()
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras = project["optional-dependencies"]
    wanted = [*project["dependencies"], *(line for lines in extras.values() for line in lines)]
    missing = []
    for line in wanted:
        name = re.split(r"[\s\[<>=!~;]", line)[0]
        if not re.search(rf"^\| `{re.escape(name)}` \|[^|]+\| \S[^|]+\|", page, re.MULTILINE):
            missing.append(name)
    assert not missing

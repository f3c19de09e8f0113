"""``hmcts completion``: what Tab offers in bash and zsh."""

from __future__ import annotations

from collections.abc import Sequence

from torchrl_hmcts.trainers.command_line.running import Failure
from torchrl_hmcts.trainers.experiments.registry import ALL_EXPERIMENTS, DEMO, EXPERIMENTS, KITS
from torchrl_hmcts.trainers.runs.config import key_kinds

VERBS = ("demo", "train", "evaluate", "play", "report", "sweep", "data", "list", "completion")
_OWN = {
    "train": ["experiment=", "kit=", "resume=", "log_level="],
    "evaluate": ["run=", "log_level="],
    "play": ["run=", "seed=", "out="],
    "report": ["figure=", "out=", "results="],
    "sweep": ["experiment=", "trials=", "objective=", "storage=", "prune=", "out="],
    "data": ["id=", "out=", "seed=", "episodes="],
    "list": [*ALL_EXPERIMENTS, "figures"],
}
_SCRIPT = """\
{zsh}_hmcts() {{
    local word="${{COMP_WORDS[COMP_CWORD]}}" IFS=$'\\n'
    COMP_WORDBREAKS="${{COMP_WORDBREAKS//=}}"
    COMPREPLY=($(compgen -W "$(hmcts completion words "${{COMP_WORDS[@]:1}}")" -- "$word"))
    [[ ${{#COMPREPLY[@]}} -eq 0 ]] && COMPREPLY=($(compgen -f -- "$word"))
    [[ ${{COMPREPLY[0]}} == *= ]] && compopt -o nospace 2>/dev/null
    return 0
}}
complete -F _hmcts hmcts"""


def completion(words: Sequence[str]) -> int:
    """Print the script for a shell, or after ``words`` what may follow; return the exit status."""
    shell = words[0] if words else ""
    if shell == "words":
        print("\n".join(candidates(words[1:])))
    elif shell in ("bash", "zsh"):
        print(_SCRIPT.format(zsh="autoload -U bashcompinit && bashcompinit\n" * (shell == "zsh")))
    else:
        raise Failure('hmcts completion: say bash or zsh, e.g. eval "$(hmcts completion bash)".', 2)
    return 0


def candidates(words: Sequence[str]) -> list[str]:
    """Return the words that may stand in place of the last one."""
    if len(words) < 2:
        return list(VERBS)
    verb, *rest = words
    given = dict(word.split("=", 1) for word in rest if "=" in word)
    key, equals, _ = rest[-1].partition("=")
    if equals:
        values = {"experiment": EXPERIMENTS, "kit": KITS}.get(key, ())
        return [f"{key}={value}" for value in values]
    experiment = DEMO if verb == "demo" else EXPERIMENTS.get(given.get("experiment", ""))
    experiment = experiment or KITS.get(given.get("kit", ""))
    keys = key_kinds(experiment.config_class) if experiment else {}
    return [*_OWN.get(verb, []), *(f"{key}=" for key in keys)]

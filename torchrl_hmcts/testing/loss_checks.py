"""The contract of a loss: what TorchRL's trainers and users rely on.

Letters: *B batch of the tensordict.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.utils import NestedKey, unravel_key
from torchrl.objectives import LossModule, SoftUpdate

from torchrl_hmcts.nesting import parts
from torchrl_hmcts.testing.contract import (
    ContractError,
    during,
    leaves,
    refuse_unknown,
    require,
    require_kind,
    require_same,
    seeded,
)

Rename = Callable[[NestedKey], NestedKey]

LOSS_CHECKS = (
    "out_keys",
    "reduction",
    "gradients",
    "target_networks",
    "dispatch",
    "select_out_keys",
    "set_keys",
    "nested_keys",
    "value_estimators",
    "terminal_states",
    "state_dict",
    "compile",
)
"""The names of what :func:`check_loss` checks, in order."""


MakeLoss = Callable[..., LossModule]
"""``make_loss(name, **kwargs)``: see :func:`check_loss`."""


def check_loss(
    make_loss: MakeLoss,
    tensordict: TensorDictBase,
    *,
    gradients: Mapping[str, Sequence[str]] | None = None,
    targets: Sequence[str] = (),
    value_estimators: Sequence[Any] = (),
    tolerance: float = 1e-5,
    seed: int = 0,
    checks: Sequence[str] = LOSS_CHECKS,
) -> None:
    """Check a loss module as TorchRL checks its own.

    ================ ============================================================================
    out_keys         it writes its ``out_keys``; what begins with ``loss`` has a gradient and
                     nothing else has; its input is only added to
    reduction        ``"mean"`` and ``"sum"`` are those of what ``"none"`` gives; others are refused
    gradients        each loss has gradients for its own parameters and for no others
    target_networks  they are no parameters, and move with ``SoftUpdate`` and not without
    dispatch         called with tensors by keyword it returns the same, in order of ``out_keys``
    select_out_keys  it gives the losses that were asked for
    set_keys         with every key renamed it gives the same
    nested_keys      with every key nested it gives the same
    value_estimators each of those named can be made and gives finite losses
    terminal_states  what follows a terminal state may be NaN: losses and gradients are finite
    state_dict       loaded into another loss it gives the same; using a loss adds nothing to it
    compile          ``torch.compile(fullgraph=True)`` gives the same losses and gradients
    ================ ============================================================================

    Args:
        make_loss (callable): ``make_loss(name, **kwargs) -> LossModule``, a new one at each call,
            whose networks read and write ``name(key)`` for every key, made in the same order each
            time: ``seed`` gives their first weights. Keyword arguments (``reduction=...``) go to
            the loss.
        tensordict (TensorDictBase): data the loss reads, e.g. transitions ``[*B]``, under the
            loss's default keys.
        gradients (mapping, optional): for each loss the beginnings of the names of its parameters,
            as ``named_parameters()`` has them, e.g.
            ``{"loss_actor": ["actor_network_params"]}``; ``[]`` for one without. Default: not
            looked at, except that every parameter must have a gradient from some loss.
        targets (sequence of str): networks that have target parameters, e.g.
            ``["qvalue_network"]``. Default: none.
        value_estimators (sequence): arguments of ``make_value_estimator`` to try, e.g.
            ``ValueEstimators.TD0``. Default: none.
        tolerance (float): difference that is allowed, relative and absolute. Default 1e-5.
        seed (int): of first weights and sampled actions. Default 0.
        checks (sequence of str): which of the above. Default: all. Compiling takes longest.

    Raises:
        ValueError: if there is no check of a name.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_hmcts.modules import SkillDiscriminator
        >>> from torchrl_hmcts.objectives import SkillDiscriminatorLoss
        >>> from torchrl_hmcts.testing import check_loss
        >>> def make_loss(name, **kwargs):
        ...     network = SkillDiscriminator(2, num_skills=3, in_keys=[name("displacement")],
        ...                                  skill_logits_key=name("skill_logits"))
        ...     return SkillDiscriminatorLoss(network, **kwargs)
        >>> td = TensorDict(skill=torch.arange(3),
        ...                 next=TensorDict(displacement=torch.randn(3, 2), batch_size=[3]),
        ...                 batch_size=[3])
        >>> gradients = {"loss_discriminator": ["discriminator_params"]}
        >>> check_loss(make_loss, td, gradients=gradients, checks=["gradients", "nested_keys"])
    """
    refuse_unknown("check_loss", checks, LOSS_CHECKS)
    it = _Loss(make_loss, tensordict, gradients, targets, value_estimators, tolerance, seed)
    for check in checks:
        getattr(it, f"check_{check}")()


@dataclass
class _Loss:
    """The loss under test, and what is expected of it; a method for each check."""

    make_loss: MakeLoss
    data: TensorDictBase
    gradients: Mapping[str, Sequence[str]] | None
    targets: Sequence[str]
    value_estimators: Sequence[Any]
    tolerance: float
    seed: int

    def __post_init__(self) -> None:
        loss = self.make()
        self.name = require_kind(loss, LossModule)
        with during(self.name, "on the data that check_loss was given"):
            self.expected = self.run(loss)
        self.losses = [key for key in self.expected.keys() if str(key).startswith("loss")]

    def make(
        self, name: Rename = lambda key: key, *, seed: int | None = None, **kw: Any
    ) -> LossModule:
        with seeded(self.seed if seed is None else seed):
            return self.make_loss(name, **kw)

    def run(self, loss: Any, data: TensorDictBase | None = None) -> TensorDictBase:
        with seeded(self.seed):
            return loss((self.data if data is None else data).clone())

    def backward(self, out: TensorDictBase) -> None:
        out.select(*self.losses).sum(reduce=True).backward()

    def equal(
        self, actual: TensorDictBase, doing: str, expected: TensorDictBase | None = None
    ) -> None:
        expected = self.expected if expected is None else expected
        require_same(
            expected.detach(),
            actual.detach(),
            f"{self.name} {doing}: <key> is <other> instead of <one>.",
            leaves(expected) | leaves(actual),
            self.tolerance,
        )

    def close(self, one: torch.Tensor, other: torch.Tensor) -> bool:
        return torch.allclose(one, other, rtol=self.tolerance, atol=self.tolerance)

    def check_out_keys(self) -> None:
        loss, given = self.make(), self.data.clone()
        with seeded(self.seed):
            out = loss(given)
        require(
            leaves(out) == set(map(unravel_key, loss.out_keys)),
            f"{self.name} announces out_keys {loss.out_keys} and writes "
            f"{sorted(map(str, leaves(out)))}. Let both be the same.",
        )
        require(bool(self.losses), f"{self.name} writes no entry that begins with 'loss'.")
        for key, value in out.items(True, True):
            is_loss = str(key).startswith("loss")
            require(
                not is_loss or torch.isfinite(value).all(),
                f"{self.name}: {key!r} is {value!s:.200}, not finite.",
            )
            require(
                is_loss or not value.requires_grad,
                f"{self.name}: {key!r} has a gradient. A trainer sums what begins with 'loss'; "
                "rename it, or detach it.",
            )
        require_same(self.data, given, f"{self.name} changed <key> of its input. Write to a copy.")

    def check_reduction(self) -> None:
        single = self.run(self.make(reduction="none"))
        for kind in ("mean", "sum"):
            reduced = self.run(self.make(reduction=kind))
            for key in self.losses:
                value, found = getattr(single.get(key), kind)(), reduced.get(key)
                require(
                    found.ndim == 0 and self.close(found, value),
                    f"{self.name}(reduction={kind!r}): {key!r} is {found!s:.200}, the {kind} of "
                    f"reduction='none' is {value.item():.6g}. Reduce with self._reduce_loss.",
                )
        try:
            self.make(reduction="median")
        except ValueError as error:
            if "median" in str(error):
                return
        raise ContractError(
            f"{self.name} accepts reduction='median' at construction. Refuse what is not 'mean', "
            "'sum' or 'none' with a ValueError that names it."
        )

    def _touched(self, key: NestedKey) -> set[str]:
        """Return the names of the parameters for which a loss has a gradient."""
        loss = self.make()
        value = self.run(loss).get(key)
        if value.requires_grad:
            value.sum().backward()
        named = [(name, p.grad) for name, p in loss.named_parameters() if p.grad is not None]
        return {name for name, grad in named if bool((grad != 0).any())}

    def check_gradients(self) -> None:
        names = [name for name, p in self.make().named_parameters() if p.requires_grad]
        touched = {str(key): self._touched(key) for key in self.losses}
        if self.gradients is None:
            idle = set(names) - set().union(*touched.values())
            require(
                not idle,
                f"{self.name}: no loss has a gradient for {sorted(idle)[:3]}. Train it, or keep it "
                "out of the loss's parameters.",
            )
            return
        require(
            set(touched) == set(self.gradients),
            f"{self.name} has the losses {sorted(touched)}; gradients= names "
            f"{sorted(self.gradients)}.",
        )
        for key, beginnings in self.gradients.items():
            strays = [n for n in touched[key] if not n.startswith(tuple(beginnings))]
            require(
                not strays,
                f"{self.name}: {key!r} has a gradient for {sorted(strays)[:3]}, and may have one "
                f"for {list(beginnings)} only. Detach what it reads of other networks.",
            )
            for beginning in beginnings:
                require(
                    any(name.startswith(beginning) for name in touched[key]),
                    f"{self.name}: {key!r} has no gradient for {beginning!r}; parameters are "
                    f"{sorted({n.split('.')[0] for n in names})}.",
                )

    def check_target_networks(self) -> None:
        if not self.targets:
            return
        loss = self.make()
        trained = {p.data_ptr() for p in loss.parameters()}
        create = "Create them with convert_to_functional(..., create_target_params=True)."
        for network in self.targets:
            held: Any = getattr(loss, f"target_{network}_params", None)
            require(held is not None, f"{self.name} has no target_{network}_params. {create}")
            apart = all(
                target.data_ptr() not in trained and not target.requires_grad
                for target in held.values(True, True)
            )
            require(apart, f"{self.name}: target_{network}_params would be trained. {create}")

        def data(prefix: str) -> dict[str, TensorDictBase]:
            return {n: getattr(loss, f"{prefix}{n}_params").data.clone() for n in self.targets}

        with during(self.name, "under torchrl.objectives.SoftUpdate"):
            updater = SoftUpdate(loss, tau=0.5)
        with torch.no_grad():
            for parameter in loss.parameters():
                parameter.add_(1.0)
        before, goal = data("target_"), data("")
        self.backward(self.run(loss))
        for network, now in data("target_").items():
            message = f"a call moved target_{network}_params (<key>). Only an updater may."
            require_same(before[network], now, f"{self.name}: {message}")
        updater.step()
        for network, now in data("target_").items():
            half = before[network].lerp(goal[network], 0.5)
            message = f"did not move target_{network}_params half of the way (<key>)."
            message = f"{self.name}: SoftUpdate(tau=0.5) {message}"
            require_same(half, now, message, tolerance=self.tolerance)

    def check_dispatch(self) -> None:
        loss = self.make()
        flat: dict[str, Any] = {}
        for key in map(unravel_key, loss.in_keys):
            value = self.data.get(key, None)
            require(
                value is not None,
                f"{self.name} announces the in_key {key!r}, but works without it: the data have "
                f"{sorted(map(str, leaves(self.data)))}. Correct in_keys.",
            )
            flat["_".join(parts(key))] = value.clone()
        advice = "Decorate forward with tensordict.nn.dispatch, and name all it reads in in_keys."
        with during(self.name, "called with tensors by keyword", advice), seeded(self.seed):
            values = loss(**flat)
        values = values if isinstance(values, tuple) else (values,)
        require(
            len(values) == len(loss.out_keys),
            f"{self.name} called with tensors returns {len(values)} of {len(loss.out_keys)} "
            "outputs. Return all out_keys.",
        )
        out = dict(zip(loss.out_keys, values, strict=True))
        out = TensorDict(out, batch_size=self.expected.batch_size)
        self.equal(out, "called with tensors by keyword")

    def check_select_out_keys(self) -> None:
        for key in self.losses:
            loss = self.make().select_out_keys(key)
            out = self.run(loss)
            require(
                leaves(out) == {unravel_key(key)} and list(loss.out_keys) == [key],
                f"{self.name}.select_out_keys({key!r}) gives {sorted(map(str, leaves(out)))} and "
                f"announces {loss.out_keys}.",
            )
            self.equal(out, f".select_out_keys({key!r})", self.expected.select(key))

    def check_set_keys(self) -> None:
        self.renamed("set_keys", _flat)

    def check_nested_keys(self) -> None:
        self.renamed("nested_keys", _nested)

    def renamed(self, check: str, name: Rename) -> None:
        loss = self.make(name)
        new: dict[str, Any] = {}
        for field in loss._AcceptedKeys.__dataclass_fields__:
            key = getattr(self.make().tensor_keys, field)
            new[field] = [name(k) for k in key] if isinstance(key, list) else name(key)
        with during(self.name, f"in set_keys(**{new}) ({check!r})"):
            loss.set_keys(**new)
        moved = TensorDict(batch_size=self.data.batch_size, device=self.data.device)
        for key in leaves(self.data):
            moved.set(name(key), self.data.get(key).clone())
        doing = f"with renamed keys ({check!r})"
        with during(self.name, doing, "Read every key from self.tensor_keys."):
            out = self.run(loss, moved)
        self.equal(out, doing)
        absent = [key for key in map(unravel_key, loss.in_keys) if moved.get(key, None) is None]
        require(
            not absent,
            f"{self.name}: after set_keys in_keys still names {absent}. Compute them again in "
            "_forward_value_estimator_keys.",
        )

    def check_value_estimators(self) -> None:
        for kind in self.value_estimators:
            loss = self.make()
            with during(self.name, f"with make_value_estimator({kind})"):
                loss.make_value_estimator(kind)
                out = self.run(loss)
            require(
                leaves(out) == leaves(self.expected)
                and all(bool(torch.isfinite(out.get(key)).all()) for key in self.losses),
                f"{self.name} with make_value_estimator({kind}) gives {out.select(*self.losses)}.",
            )

    def check_terminal_states(self) -> None:
        loss, data = self.make(), self.data.clone()
        names = [n for n in ("terminated", "done") if hasattr(loss.tensor_keys, n)]
        ends = [data.get(("next", getattr(loss.tensor_keys, n)), None) for n in names]
        if not any(end is not None for end in ends):
            return
        first = (0,) * data.ndim
        for end in ends:
            if end is not None:
                end[first] = True
        kept = unravel_key(("next", getattr(loss.tensor_keys, "reward", "reward")))
        for key, value in data.items(True, True):
            if key[0] == "next" and key != kept and value.is_floating_point():
                value[first] = torch.nan
        out = self.run(loss, data).select(*self.losses)
        self.backward(out)
        gradients = {n: p.grad for n, p in loss.named_parameters() if p.grad is not None}
        for name, value in (*out.items(), *gradients.items()):
            require(
                bool(torch.isfinite(value).all()),
                f"{self.name}: with NaN in the entries after a terminal state {name!r} is not "
                "finite. Replace them before a network reads them: a product with 0 is NaN too.",
            )

    def check_state_dict(self) -> None:
        loss, other = self.make(), self.make(seed=self.seed + 1)
        at_first = set(loss.state_dict())
        self.backward(self.run(loss))
        grown = set(loss.state_dict()) ^ at_first
        require(
            not grown,
            f"{self.name}: its first use changed the state dict by {sorted(grown)[:3]}, so that a "
            "run could not be resumed. Make it at construction, e.g. the value estimator.",
        )
        with during(self.name, "loading the state dict of another"):
            other.load_state_dict(loss.state_dict())
        self.equal(self.run(other), "with the state dict of another", self.run(loss))

    def check_compile(self) -> None:
        torch.compiler.reset()
        loss, plain = self.make(), self.make()
        expected, where = self.run(plain), "under torch.compile(fullgraph=True)"
        advice = "Leave out of forward what torch.compile cannot trace, e.g. print or .item()."
        with during(self.name, where, advice):
            actual = self.run(torch.compile(loss, backend="eager", fullgraph=True))
        self.equal(actual, where, expected)
        self.backward(expected)
        self.backward(actual)
        for (name, a), b in zip(plain.named_parameters(), loss.parameters(), strict=True):
            one, other = (torch.zeros_like(a) if p.grad is None else p.grad for p in (a, b))
            require(
                self.close(one, other), f"{self.name} {where}: the gradient of {name!r} is another."
            )


def _flat(key: NestedKey) -> NestedKey:
    """``"a"`` becomes ``"other_a"``, also under ``"next"``."""
    *path, last = parts(key)
    return unravel_key((*path, f"other_{last}"))


def _nested(key: NestedKey) -> NestedKey:
    """``"a"`` becomes ``("group", "a")``, also under ``"next"``."""
    path = parts(key)
    return ("next", "group", *path[1:]) if path[0] == "next" else ("group", *path)

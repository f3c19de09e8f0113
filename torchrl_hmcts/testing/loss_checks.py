"""The contract of a loss: what TorchRL's trainers and users rely on.

Letters: *B batch of the tensordict.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Protocol

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.utils import NestedKey, unravel_key
from torchrl.objectives import LossModule, SoftUpdate

from torchrl_hmcts.testing.claims import ContractError, different, during, leaves, require, seeded

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


class MakeLoss(Protocol):
    """What :func:`check_loss` asks of a function that makes a loss."""

    def __call__(self, name: Rename, **kwargs: Any) -> LossModule:
        """Return a loss whose networks read and write ``name(key)`` for every key.

        Keyword arguments (``reduction=...``) go to the loss.
        """


def check_loss(
    make_loss: MakeLoss,
    tensordict: TensorDictBase,
    *,
    gradients: Mapping[str, Sequence[str]] | None = None,
    targets: Sequence[str] = (),
    value_estimators: Sequence[Any] = (),
    keys: Sequence[str] | None = None,
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
    set_keys         with every key renamed it gives the same; unknown names are refused
    nested_keys      with every key nested it gives the same
    value_estimators each of those named can be made and gives finite losses
    terminal_states  what follows a terminal state may be NaN: losses and gradients are finite
    state_dict       loaded into another loss it gives the same; using a loss adds nothing to it
    compile          ``torch.compile(fullgraph=True)`` gives the same losses and gradients
    ================ ============================================================================

    Args:
        make_loss (callable): ``make_loss(name, **kwargs) -> LossModule``, a new one at each call;
            see :class:`MakeLoss`. Networks are to be made in the same order each time, since they
            get their first weights from ``seed``.
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
        keys (sequence of str, optional): names of ``set_keys`` to rename. Default: all.
        tolerance (float): difference that is allowed, relative and absolute. Default 1e-5.
        seed (int): of first weights and sampled actions. Default 0.
        checks (sequence of str): which of the above. Default: all. Compiling takes longest.

    Raises:
        ContractError: if one of them fails; the message names it.
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
    unknown = [check for check in checks if check not in LOSS_CHECKS]
    if unknown:
        raise ValueError(
            f"check_loss has no check {unknown[0]!r}; it has {', '.join(LOSS_CHECKS)}."
        )
    it = _Loss(make_loss, tensordict, tolerance, seed)
    for check in checks:
        if check == "out_keys":
            it.out_keys()
        elif check == "reduction":
            it.reduction()
        elif check == "gradients":
            it.gradients(gradients)
        elif check == "target_networks":
            it.target_networks(targets)
        elif check == "dispatch":
            it.dispatch()
        elif check == "select_out_keys":
            it.select_out_keys()
        elif check == "set_keys":
            it.renamed(check, _flat, keys)
        elif check == "nested_keys":
            it.renamed(check, _nested, keys)
        elif check == "value_estimators":
            it.value_estimators(value_estimators)
        elif check == "terminal_states":
            it.terminal_states()
        elif check == "state_dict":
            it.state_dict()
        else:
            it.compiled()


class _Loss:
    """The loss under test, and data for it."""

    def __init__(
        self, make_loss: MakeLoss, data: TensorDictBase, tolerance: float, seed: int
    ) -> None:
        self._make, self.data, self.tolerance, self.seed = make_loss, data, tolerance, seed
        loss = self.make()
        self.name = type(loss).__name__
        if not isinstance(loss, LossModule):
            raise ContractError(
                f"{self.name} is no torchrl.objectives.LossModule. Derive it from that class."
            )
        with during(self.name, "on the data that check_loss was given"):
            self.expected = self.run(loss)
        self.losses = [key for key in self.expected.keys() if str(key).startswith("loss")]

    def make(
        self, name: Rename = lambda key: key, *, seed: int | None = None, **kw: Any
    ) -> LossModule:
        with seeded(self.seed if seed is None else seed):
            return self._make(name, **kw)

    def run(self, loss: Any, data: TensorDictBase | None = None) -> TensorDictBase:
        with seeded(self.seed):
            return loss((self.data if data is None else data).clone())

    def equal(
        self, actual: TensorDictBase, doing: str, expected: TensorDictBase | None = None
    ) -> None:
        expected = self.expected if expected is None else expected
        missing = leaves(expected) ^ leaves(actual)
        require(
            not missing,
            f"{self.name} {doing}: it writes {sorted(map(str, leaves(actual)))} instead of "
            f"{sorted(map(str, leaves(expected)))}.",
        )
        one, two = expected.detach(), actual.detach()
        where = different(one, two, sorted(leaves(one), key=str), self.tolerance)
        require(
            where is None,
            f"{self.name} {doing}: {where and where[0]!r} is {where and two.get(where[0])!s:.200} "
            f"instead of {where and one.get(where[0])!s:.200}.",
        )

    def out_keys(self) -> None:
        loss = self.make()
        given = self.data.clone()
        with seeded(self.seed):
            out = loss(given)
        require(
            leaves(out) == set(map(unravel_key, loss.out_keys)),
            f"{self.name} announces out_keys {loss.out_keys} and writes "
            f"{sorted(map(str, leaves(out)))}. Let both be the same.",
        )
        require(bool(self.losses), f"{self.name} writes no entry that begins with 'loss'.")
        for key in leaves(out):
            value = out.get(key)
            is_loss = str(key).startswith("loss")
            if is_loss:
                require(
                    torch.isfinite(value).all(),
                    f"{self.name}: {key!r} is {value!s:.200}, not finite.",
                )
            require(
                is_loss or not value.requires_grad,
                f"{self.name}: {key!r} has a gradient. A trainer sums what begins with 'loss'; "
                "rename it, or detach it.",
            )
        where = different(self.data, given, leaves(self.data))
        require(
            where is None,
            f"{self.name} changed {where and where[0]!r} of its input. Write to a copy.",
        )

    def reduction(self) -> None:
        single = self.run(self.make(reduction="none"))
        for kind in ("mean", "sum"):
            reduced = self.run(self.make(reduction=kind))
            for key in self.losses:
                value = getattr(single.get(key), kind)()
                close = torch.allclose(
                    reduced.get(key), value, rtol=self.tolerance, atol=self.tolerance
                )
                require(
                    close and reduced.get(key).ndim == 0,
                    f"{self.name}(reduction={kind!r}): {key!r} is {reduced.get(key)!s:.200}, the "
                    f"{kind} of reduction='none' is {value.item():.6g}. Reduce with "
                    "self._reduce_loss.",
                )
        try:
            self.make(reduction="median")
        except ValueError as error:
            require(
                "median" in str(error),
                f"{self.name} refuses reduction='median' without naming it: {error}",
            )
            return
        raise ContractError(
            f"{self.name} accepts reduction='median' at construction. Refuse what is not 'mean', "
            "'sum' or 'none' with a ValueError."
        )

    def _touched(self, key: NestedKey) -> set[str]:
        loss = self.make()
        value = self.run(loss).get(key)
        if value.requires_grad:
            value.sum().backward()
        return {
            name
            for name, parameter in loss.named_parameters()
            if parameter.grad is not None and bool((parameter.grad != 0).any())
        }

    def gradients(self, gradients: Mapping[str, Sequence[str]] | None) -> None:
        names = [name for name, p in self.make().named_parameters() if p.requires_grad]
        touched = {str(key): self._touched(key) for key in self.losses}
        if gradients is None:
            idle = set(names) - set().union(*touched.values())
            require(
                not idle,
                f"{self.name}: no loss has a gradient for {sorted(idle)[:3]}. Train it, or keep it "
                "out of the loss's parameters.",
            )
            return
        missing = set(touched) ^ set(gradients)
        require(
            not missing,
            f"{self.name} has the losses {sorted(touched)}; gradients= names {sorted(gradients)}.",
        )
        for key, beginnings in gradients.items():
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

    def target_networks(self, targets: Sequence[str]) -> None:
        loss = self.make()
        parameters = {id(p) for p in loss.parameters()}
        for network in targets:
            held = getattr(loss, f"target_{network}_params", None)
            require(
                held is not None, f"{self.name} has no target_{network}_params. Create them with "
                "convert_to_functional(..., create_target_params=True).",
            )  # fmt: skip
            assert held is not None
            own = getattr(loss, f"{network}_params")
            for target, trained in zip(
                held.values(True, True), own.values(True, True), strict=True
            ):
                require(
                    id(target) not in parameters and not target.requires_grad,
                    f"{self.name}: target_{network}_params would be trained. Create them with "
                    "convert_to_functional(..., create_target_params=True).",
                )
                require(
                    target.data_ptr() != trained.data_ptr(),
                    f"{self.name}: target_{network}_params are the network's own. Pass the "
                    "argument that delays them.",
                )
        if not targets:
            return
        with during(self.name, "under torchrl.objectives.SoftUpdate"):
            updater = SoftUpdate(loss, tau=0.5)
        with torch.no_grad():
            for parameter in loss.parameters():
                parameter.add_(1.0)
        before = {n: getattr(loss, f"target_{n}_params").data.clone() for n in targets}
        trained = {n: getattr(loss, f"{n}_params").data.clone() for n in targets}
        self.run(loss).select(*self.losses).sum(reduce=True).backward()
        moved = self._moved(loss, before)
        require(
            moved is None, f"{self.name}: a call moved target_{moved}_params. Only an updater may."
        )
        updater.step()
        for network in targets:
            now = getattr(loss, f"target_{network}_params").data
            half = before[network].lerp(trained[network], 0.5)
            where = different(half, now, leaves(half), self.tolerance)
            require(
                where is None,
                f"{self.name}: SoftUpdate(tau=0.5) did not move target_{network}_params half of "
                f"the way ({where and where[0]!r}).",
            )

    def _moved(self, loss: LossModule, before: Mapping[str, TensorDictBase]) -> str | None:
        for network, old in before.items():
            now = getattr(loss, f"target_{network}_params").data
            if different(old, now, leaves(old)) is not None:
                return network
        return None

    def dispatch(self) -> None:
        loss = self.make()
        flat: dict[str, Any] = {}
        for key in map(unravel_key, loss.in_keys):
            value = self.data.get(key, None)
            require(
                value is not None,
                f"{self.name} announces the in_key {key!r}, which it does without: the data have "
                f"{sorted(map(str, leaves(self.data)))}. Correct in_keys.",
            )
            flat[key if isinstance(key, str) else "_".join(key)] = value.clone()
        advice = "Decorate forward with tensordict.nn.dispatch, and name all it reads in in_keys."
        with during(self.name, "called with tensors by keyword", advice), seeded(self.seed):
            values = loss(**flat)
        values = values if isinstance(values, tuple) else (values,)
        require(
            len(values) == len(loss.out_keys),
            f"{self.name} called with tensors returns {len(values)} of {len(loss.out_keys)} "
            "outputs. Return all out_keys.",
        )
        out = TensorDict(
            dict(zip(loss.out_keys, values, strict=True)), batch_size=self.expected.batch_size
        )
        self.equal(out, "called with tensors by keyword")

    def select_out_keys(self) -> None:
        for key in self.losses:
            loss = self.make().select_out_keys(key)
            out = self.run(loss)
            require(
                leaves(out) == {unravel_key(key)} and list(loss.out_keys) == [key],
                f"{self.name}.select_out_keys({key!r}) gives {sorted(map(str, leaves(out)))} and "
                f"announces {loss.out_keys}.",
            )
            self.equal(out, f".select_out_keys({key!r})", self.expected.select(key))

    def renamed(self, check: str, name: Rename, keys: Sequence[str] | None) -> None:
        loss = self.make(name)
        fields = loss._AcceptedKeys.__dataclass_fields__
        names = list(fields) if keys is None else list(keys)
        defaults = self.make().tensor_keys
        new: dict[str, Any] = {}
        for field in names:
            default = getattr(defaults, field)
            new[field] = [name(k) for k in default] if isinstance(default, list) else name(default)
        with during(self.name, f"in set_keys(**{new}) ({check!r})"):
            loss.set_keys(**new)
        moved = TensorDict({}, batch_size=self.data.batch_size, device=self.data.device)
        for key in leaves(self.data):
            moved.set(name(key), self.data.get(key).clone())
        with during(
            self.name, f"with renamed keys ({check!r})", "Read every key from self.tensor_keys."
        ):
            out = self.run(loss, moved)
        self.equal(out, f"with renamed keys ({check!r})")
        absent = [key for key in map(unravel_key, loss.in_keys) if moved.get(key, None) is None]
        require(
            not absent,
            f"{self.name}: after set_keys in_keys still names {absent}. Compute them anew in "
            "_forward_value_estimator_keys.",
        )
        with during(self.name, "after its keys were renamed, refusing an unknown one"):
            try:
                loss.set_keys(no_such_key="x")
            except ValueError:
                return
        raise ContractError(
            f"{self.name}.set_keys accepts a key of which its _AcceptedKeys know nothing."
        )

    def value_estimators(self, value_estimators: Sequence[Any]) -> None:
        for kind in value_estimators:
            loss = self.make()
            with during(self.name, f"with make_value_estimator({kind})"):
                loss.make_value_estimator(kind)
                out = self.run(loss)
            require(
                leaves(out) == leaves(self.expected)
                and all(bool(torch.isfinite(out.get(key)).all()) for key in self.losses),
                f"{self.name} with make_value_estimator({kind}) gives {out.select(*self.losses)}.",
            )

    def terminal_states(self) -> None:
        loss = self.make()
        keys = [unravel_key(("next", k)) for k in _ends(loss)]
        if not any(self.data.get(key, None) is not None for key in keys):
            return
        data = self.data.clone()
        first = (0,) * data.ndim
        for key in keys:
            if data.get(key, None) is not None:
                data.get(key)[first] = True
        kept = unravel_key(("next", getattr(loss.tensor_keys, "reward", "reward")))
        for key in leaves(data):
            value = data.get(key)
            if key[0] == "next" and key != kept and value.is_floating_point():
                value[first] = torch.nan
        out = self.run(loss, data).select(*self.losses)
        out.sum(reduce=True).backward()
        gradients = {n: p.grad for n, p in loss.named_parameters() if p.grad is not None}
        for name, value in (*out.items(), *gradients.items()):
            require(
                bool(torch.isfinite(value).all()),
                f"{self.name}: with NaN in the entries after a terminal state {name!r} is not "
                "finite. Replace them before a network reads them: a product with 0 is NaN too.",
            )

    def state_dict(self) -> None:
        loss, other = self.make(), self.make(seed=self.seed + 1)
        at_first = set(loss.state_dict())
        used = self.run(loss)
        used.select(*self.losses).sum(reduce=True).backward()
        grown = set(loss.state_dict()) ^ at_first
        require(
            not grown,
            f"{self.name}: its first use changed the state dict by {sorted(grown)[:3]}, so that a "
            "run could not be resumed. Make it at construction, e.g. the value estimator.",
        )
        with during(self.name, "loading the state dict of another"):
            other.load_state_dict(loss.state_dict())
        self.equal(self.run(other), "with the state dict of another", self.run(loss))

    def compiled(self) -> None:
        torch._dynamo.reset()
        loss, plain = self.make(), self.make()
        expected = self.run(plain)
        advice = "Leave out of forward what torch.compile cannot trace, e.g. print or .item()."
        with during(self.name, "under torch.compile(fullgraph=True)", advice):
            actual = self.run(torch.compile(loss, backend="eager", fullgraph=True))
        self.equal(actual, "under torch.compile(fullgraph=True)", expected)
        for out in (expected, actual):
            out.select(*self.losses).sum(reduce=True).backward()
        for (name, a), (_, b) in zip(
            plain.named_parameters(), loss.named_parameters(), strict=True
        ):
            if a.grad is None or b.grad is None:
                same = (a.grad is None or not a.grad.any()) and (b.grad is None or not b.grad.any())
            else:
                same = torch.allclose(a.grad, b.grad, rtol=self.tolerance, atol=self.tolerance)
            require(
                same,
                f"{self.name} under torch.compile(fullgraph=True): the gradient of {name!r} is "
                "another.",
            )


def _ends(loss: LossModule) -> list[NestedKey]:
    """The names of what says that an episode is at its end."""
    keys = loss.tensor_keys
    return [getattr(keys, name) for name in ("terminated", "done") if hasattr(keys, name)]


def _flat(key: NestedKey) -> NestedKey:
    """``"a"`` becomes ``"other_a"``, also under ``"next"``."""
    if isinstance(key, str):
        return f"other_{key}"
    return (*key[:-1], f"other_{key[-1]}")


def _nested(key: NestedKey) -> NestedKey:
    """``"a"`` becomes ``("group", "a")``, also under ``"next"``."""
    if isinstance(key, str):
        return ("group", key)
    return ("next", "group", *key[1:]) if key[0] == "next" else ("group", *key)

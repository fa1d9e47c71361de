"""A torch device that exists on every machine: its tensors live in the host's memory, but behave as if they did not.

Operations between them and the host's tensors are refused, and so is handing them to numpy, as on a GPU. Code that runs here
says of each tensor on which device it is. Use :func:`elsewhere` around all of it.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves, tree_map
from torch.utils.backend_registration import _setup_privateuseone_for_python_backend

NAME = "elsewhere"

_MAY_CROSS = ("aten::copy_", "aten::_to_copy")


class _Elsewhere(torch.Tensor):
    """A tensor of the device, around one of the host."""

    inner: torch.Tensor

    @staticmethod
    def __new__(cls, inner: torch.Tensor) -> _Elsewhere:
        shape = {"strides": inner.stride(), "storage_offset": inner.storage_offset()}
        device = torch.device(NAME, 0)
        tensor = torch.Tensor._make_wrapper_subclass(cls, inner.size(), **shape, dtype=inner.dtype, device=device)
        tensor.inner = inner
        return tensor

    @classmethod
    def __torch_dispatch__(cls, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return _run(func, args, kwargs or {})

    def tolist(self) -> Any:
        return self.inner.tolist()

    def numpy(self, *args: Any, **kwargs: Any) -> Any:
        raise TypeError(f"can't convert {NAME}:0 device type tensor to numpy")


class _Dispatch(TorchDispatchMode):
    """Sees what makes tensors, too."""

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return _run(func, args, kwargs or {})


class _Functions(TorchFunctionMode):
    """torch.tensor copies to its device where no dispatch sees it."""

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = dict(kwargs or {})
        if func is torch.tensor and torch.device(kwargs.get("device") or "cpu").type == NAME:
            del kwargs["device"]
            return _Elsewhere(torch.tensor(*args, **kwargs))
        return func(*args, **kwargs)


def _run(func: Any, args: Any, kwargs: dict[str, Any]) -> Any:
    """Run an operation on the host and say where its result is."""
    name = func._schema.name
    tensors = [leaf for leaf in tree_leaves((args, kwargs)) if isinstance(leaf, torch.Tensor)]
    away = [tensor for tensor in tensors if isinstance(tensor, _Elsewhere)]
    here = [tensor for tensor in tensors if not isinstance(tensor, _Elsewhere) and tensor.dim() > 0]
    if away and here and name not in _MAY_CROSS:
        raise RuntimeError(f"{name}: expected all tensors on one device, got {NAME} and cpu")
    result_is_away = bool(away)
    if kwargs.get("device") is not None:
        result_is_away = torch.device(kwargs["device"]).type == NAME
        kwargs = {**kwargs, "device": torch.device("cpu")}
    args, kwargs = tree_map(lambda leaf: leaf.inner if isinstance(leaf, _Elsewhere) else leaf, (args, kwargs))
    result = func(*args, **kwargs)
    outer = {id(tensor.inner): tensor for tensor in away}

    def wrap(leaf: Any) -> Any:
        if not isinstance(leaf, torch.Tensor) or not result_is_away:
            return leaf
        return outer[id(leaf)] if id(leaf) in outer else _Elsewhere(leaf)

    return tree_map(wrap, result)


@contextmanager
def elsewhere() -> Iterator[str]:
    """The device's name, for as long as it exists."""
    if torch._C._get_privateuse1_backend_name() != NAME:
        _setup_privateuseone_for_python_backend(NAME)
    with _Functions(), _Dispatch():
        yield f"{NAME}:0"

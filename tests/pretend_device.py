"""A GPU for machines without one: tensors that say they are not on the CPU, compute there all the same, and
refuse to mix with CPU tensors.

    with PretendDevice():
        tensor.to("meta") ...
The device is called `meta`, which torch knows without drivers; real meta tensors (without values) do not
exist inside the block.
"""

from contextlib import ExitStack
from unittest.mock import patch

import torch
from torch.optim import optimizer
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_flatten, tree_map

# take tensors from two devices, as on a GPU
COPIES = ("aten.copy_", "aten._to_copy", "aten.index_put", "aten._index_put", "aten.index.")


class _Tensor(torch.Tensor):
    """Says `meta`; `inner` holds the values."""

    @staticmethod
    def __new__(cls, inner):
        tensor = torch.Tensor._make_wrapper_subclass(
            cls,
            inner.shape,
            strides=inner.stride(),
            storage_offset=inner.storage_offset(),
            dtype=inner.dtype,
            device="meta",
        )
        tensor.inner = inner
        return tensor

    __torch_function__ = torch._C._disabled_torch_function_impl

    @classmethod
    def __torch_dispatch__(cls, function, types, args=(), kwargs=None):
        return _run(function, args, dict(kwargs or {}))


def _run(function, args, kwargs):
    name, tensors = (
        str(function),
        [value for value in tree_flatten((args, kwargs))[0] if isinstance(value, torch.Tensor)],
    )
    there = [tensor for tensor in tensors if isinstance(tensor, _Tensor)]
    here = [tensor for tensor in tensors if not isinstance(tensor, _Tensor) and tensor.dim() > 0]
    if there and here and not name.startswith(COPIES):
        raise RuntimeError(f"{name}: tensors on two devices")
    stays = bool(there)
    if kwargs.get("device") is not None:
        stays = torch.device(kwargs["device"]).type == "meta"
        kwargs["device"] = torch.device("cpu")
    elif name.startswith(COPIES):
        stays = isinstance(args[0], _Tensor)
        if there and not stays and name.startswith("aten.index"):
            raise RuntimeError(f"{name}: CPU tensor indexed from a device")
    result = function(*tree_map(_inside, args), **tree_map(_inside, kwargs))
    if not function._schema.returns:  # lists of tensors, changed in place
        return None
    first = function._schema.arguments[0].alias_info if function._schema.arguments else None
    if first is not None and first.is_write:
        return args[0]
    return (
        tree_map(lambda value: _Tensor(value) if isinstance(value, torch.Tensor) else value, result)
        if stays
        else result
    )


def _inside(value):
    return value.inner if isinstance(value, _Tensor) else value


class _Dispatch(TorchDispatchMode):
    def __torch_dispatch__(self, function, types, args=(), kwargs=None):
        return _run(function, args, dict(kwargs or {}))


class PretendDevice(TorchFunctionMode):
    """Context in which `meta` is a device with values. `new_tensor` needs help: torch makes empty tensors of
    it there. Optimizers may be fused on it.
    """

    def __enter__(self):
        self._stack = ExitStack()
        supported = [*optimizer._get_fused_kernels_supported_devices(), "meta"]
        self._stack.enter_context(
            patch.object(optimizer, "_get_fused_kernels_supported_devices", lambda: supported)
        )
        self._stack.enter_context(_Dispatch())
        return super().__enter__()

    def __exit__(self, *error):
        super().__exit__(*error)
        self._stack.__exit__(*error)

    def __torch_function__(self, function, types, args=(), kwargs=None):
        if getattr(function, "__name__", "") == "new_tensor" and isinstance(args[0], _Tensor):
            return torch.tensor(args[1], dtype=args[0].dtype).to("meta")
        return function(*args, **(kwargs or {}))

"""CPU convolutions of pictures, split into parts that idle cores pick up.

The first layer has one input channel and a large stride, which suits matrix instructions badly. So it is computed
space-to-depth: each block of stride x stride pixels becomes as many channels, and the rearranged weights become a
kernel of stride 1. That is five times as fast in bfloat16, and equal up to rounding.

A minibatch is processed in parts of `PART` pictures, whose activations stay in the processor's cache. Each part has its
own backward pass, and gradients are summed in the order of the parts: the result is bit-identical on any number of
threads. A thread that other work slows down takes fewer parts, and the others need not wait for it.
"""

import functools
import os
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, TypeVar

import torch
from torch import Tensor, nn
from torch.nn import functional

PART = 128
"""Pictures per part: a thread convolves one part at a time."""
_BLOCK_ROWS = {2: torch.int16, 4: torch.int32, 8: torch.int64}
"""Integer type by the width in bytes of a block's row: moving whole rows is ten times as fast as moving bytes."""

_T = TypeVar("_T")
_R = TypeVar("_R")


def convolve(layers: nn.Sequential, pictures: Tensor, dtype: torch.dtype) -> Tensor:
    """Return the outputs of layers that begin with a convolution without padding, flat, [n, channels * places].

    Args:
        layers: their inputs are brightness from 0 to 1.
        pictures: uint8 [n, channels, height, width].
        dtype: of the matrix products, float32 or bfloat16.
    """
    if pictures.is_cuda:
        return _convolve(layers, pictures, dtype)
    weights = [weight for weight in layers.parameters() if weight.requires_grad]
    if not torch.is_grad_enabled() or not weights:
        return torch.cat(_in_turns(functools.partial(_convolve, layers, dtype=dtype), pictures.split(PART)))
    outputs: Tensor = _InParts.apply(layers, pictures, dtype, *weights)
    return outputs


class _InParts(torch.autograd.Function):
    """Convolves and differentiates each part on its own; arguments as for `convolve`, and weights with gradients."""

    @staticmethod
    def forward(
        ctx: Any, layers: nn.Sequential, pictures: Tensor, dtype: torch.dtype, *weights: Tensor
    ) -> Tensor:
        def with_graph(part: Tensor) -> Tensor:
            with torch.enable_grad():
                return _convolve(layers, part, dtype)

        ctx.weights, ctx.parts = weights, _in_turns(with_graph, pictures.split(PART))
        return torch.cat([part.detach() for part in ctx.parts])

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        def by_weights(part: tuple[Tensor, Tensor]) -> tuple[Tensor, ...]:
            # Another loss may need gradients of the same outputs.
            return torch.autograd.grad(part[0], ctx.weights, part[1], retain_graph=True)

        first, *others = _in_turns(by_weights, list(zip(ctx.parts, gradient.split(PART), strict=True)))
        for other in others:
            for gradient, part in zip(first, other, strict=True):
                gradient += part
        return None, None, None, *first


def _convolve(layers: nn.Sequential, pictures: Tensor, dtype: torch.dtype) -> Tensor:
    first = layers[0]
    assert isinstance(first, nn.Conv2d)
    with torch.autocast(pictures.device.type, torch.bfloat16, enabled=dtype == torch.bfloat16):
        stride, weight = first.stride[0], first.weight / 255
        if any(side % stride for side in pictures.shape[-2:]):
            seen = pictures.to(dtype, memory_format=torch.channels_last)
            values = functional.conv2d(seen, weight, first.bias, stride)
        else:
            blocks = _blocks(pictures, stride).to(dtype)
            values = functional.conv2d(blocks, _of_blocks(weight, stride), first.bias)
        for layer in list(layers)[1:]:
            # Only the activation needs its input, which may therefore be overwritten.
            values = functional.relu_(values) if isinstance(layer, nn.ReLU) else layer(values)
        return values.flatten(1)


def _blocks(pictures: Tensor, size: int) -> Tensor:
    """Return [n, channels * size * size, height / size, width / size] of bytes, channels last.

    The result equals PyTorch's `pixel_unshuffle`, which takes eight times as long for bytes: a fifth of an update.
    """
    count, channels, height, width = pictures.shape
    rows = pictures.contiguous()
    rows = (
        rows.view(_BLOCK_ROWS[size])
        if size in _BLOCK_ROWS
        else rows.view(count, channels, height, width // size, size)
    )
    rows = rows.view(count, channels, height // size, size, width // size, -1)
    blocks = rows.permute(0, 2, 4, 1, 3, 5).contiguous().view(torch.uint8)
    return blocks.view(count, height // size, width // size, -1).permute(0, 3, 1, 2)


def _of_blocks(weight: Tensor, size: int) -> Tensor:
    """Return a kernel for `_blocks`, padded to whole ones, [filters, channels * size * size, rows, columns]."""
    missing = -weight.shape[-1] % size
    return functional.pixel_unshuffle(functional.pad(weight, (0, missing, 0, missing)), size)


def _in_turns(function: Callable[[_T], _R], parts: Sequence[_T]) -> list[_R]:
    """Apply a function to each part, on torch's number of threads; return the results."""
    threads = torch.get_num_threads()
    if threads == 1 or len(parts) == 1:
        return [function(part) for part in parts]
    # A thread has its own switch for gradients.
    with_gradients = torch.is_grad_enabled()

    def in_thread(part: _T) -> _R:
        with torch.set_grad_enabled(with_gradients):
            return function(part)

    results: Iterable[_R] = _pool(threads).map(in_thread, parts)
    return list(results)


@functools.cache
def _pool(threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads, "convolve", initializer=_begin_thread)


def _begin_thread() -> None:
    torch.get_num_threads()  # begins by taking the process's number
    torch.set_num_threads(1)


if hasattr(os, "register_at_fork"):  # a child has none of the threads
    os.register_at_fork(after_in_child=_pool.cache_clear)

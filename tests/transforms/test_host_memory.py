from __future__ import annotations

import pytest
import torch

from crptpro.transforms.host_memory import as_numpy_bits, empty_on_huge_pages


@pytest.mark.parametrize("dtype", [torch.uint8, torch.int64, torch.float32, torch.float64, torch.bfloat16])
def test_memory_has_the_shape_and_dtype_asked_for(dtype):
    block = empty_on_huge_pages((3, 4, 5), dtype)
    assert block.shape == (3, 4, 5)
    assert block.dtype == dtype
    assert block.is_contiguous()


@pytest.mark.parametrize("dtype", [torch.uint8, torch.float32, torch.bfloat16])
def test_copies_through_numpy_bits_are_exact_and_share_memory(dtype):
    source = (torch.randn(6, 7) * 100).to(dtype)
    target = torch.zeros_like(source)
    as_numpy_bits(target)[:, 2:] = as_numpy_bits(source)[:, 2:]
    assert torch.equal(target[:, 2:], source[:, 2:])
    assert not target[:, :2].any()

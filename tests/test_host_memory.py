from __future__ import annotations

import os
import random
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

import pytest
import torch

from crptpro.host_memory import SMALLEST_BLOCK, BlockPool, as_numpy_bits, empty_batch, empty_on_huge_pages


@pytest.mark.parametrize("dtype", [torch.uint8, torch.int64, torch.float32, torch.float64, torch.bfloat16])
@pytest.mark.parametrize("allocate", [empty_on_huge_pages, empty_batch])
@pytest.mark.parametrize("shape", [(3, 4, 5), (3, 4, SMALLEST_BLOCK // 12)])
def test_memory_has_the_shape_and_dtype_asked_for(dtype, allocate, shape):
    block = allocate(shape, dtype)
    assert block.shape == shape
    assert block.dtype == dtype
    assert block.is_contiguous()
    block[-1, -1, -1] = 1


def test_memory_is_used_again_when_the_last_view_of_it_is_gone():
    pool = BlockPool()
    tensor = torch.frombuffer(pool.take(4096), dtype=torch.uint8)
    view, address = tensor[100:200].view(2, 50), tensor.data_ptr()
    del tensor
    other = torch.frombuffer(pool.take(4096), dtype=torch.uint8)
    assert other.data_ptr() != address, "a view still looks at the first block"
    del view
    again = torch.frombuffer(pool.take(4096), dtype=torch.uint8)
    assert again.data_ptr() == address


def test_numpy_views_keep_memory_too():
    pool = BlockPool()
    bits = as_numpy_bits(torch.frombuffer(pool.take(4096), dtype=torch.bfloat16))
    assert torch.frombuffer(pool.take(4096), dtype=torch.uint8).data_ptr() != bits.ctypes.data


def test_blocks_of_another_size_are_not_given_and_only_a_few_are_remembered():
    pool = BlockPool(kept=2)
    first = pool.take(4096)
    addresses = [torch.frombuffer(pool.take(size), dtype=torch.uint8).data_ptr() for size in (8192, 4096)]
    del first  # forgotten: two were remembered after it
    assert len(set(addresses)) == 2
    assert torch.frombuffer(pool.take(8192), dtype=torch.uint8).data_ptr() == addresses[0]


def test_what_is_remembered_has_a_limit_in_bytes_too():
    pool = BlockPool(kept_bytes=3 * 4096)
    for size in (4096, 8192, 16384):
        pool.take(size)
    assert not pool._blocks, "the last is larger than all that may be remembered"
    pool.take(8192)
    pool.take(4096)
    assert [len(block) for block in pool._blocks] == [8192, 4096]


def test_batches_in_use_never_share_memory_whoever_allocates():
    """Several threads take and drop batches; what one has written nobody else changes."""

    def work(number: int) -> bool:
        rng = random.Random(number)
        held: list[tuple[torch.Tensor, int]] = []
        for turn in range(60):
            tensor = empty_batch((SMALLEST_BLOCK,), torch.uint8)
            tensor[::65536] = mark = (7 * number + turn) % 256
            held.append((tensor[::65536], mark))
            if len(held) > 3:
                held.pop(rng.randrange(len(held)))
            if any((view != mark).any() for view, mark in held):
                return False
        return True

    with ThreadPoolExecutor(4) as threads:
        assert all(threads.map(work, range(4)))


@pytest.mark.parametrize("dtype", [torch.uint8, torch.float32, torch.bfloat16])
def test_copies_through_numpy_bits_are_exact_and_share_memory(dtype):
    source = (torch.randn(6, 7) * 100).to(dtype)
    target = torch.zeros_like(source)
    as_numpy_bits(target)[:, 2:] = as_numpy_bits(source)[:, 2:]
    assert torch.equal(target[:, 2:], source[:, 2:])
    assert not target[:, :2].any()


def test_large_tensors_are_asked_for_on_huge_pages_unless_that_was_turned_off():
    code = "import os, crptpro; print(os.environ['THP_MEM_ALLOC_ENABLE'])"
    for given, expected in ((None, "1"), ("0", "0")):
        environment = {k: v for k, v in os.environ.items() if k != "THP_MEM_ALLOC_ENABLE"}
        if given is not None:
            environment["THP_MEM_ALLOC_ENABLE"] = given
        done = subprocess.run(
            [sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True
        )
        assert done.stdout.strip() == expected

"""Any number of images through a batch of fixed size."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from fus3dmaps_core.errors import EncoderError
from fus3dmaps_core.runtimes.static_batches import run_in_batches


@given(count=st.integers(0, 11), size=st.integers(1, 4), several=st.booleans())
def test_every_image_has_its_row_whatever_the_batch(count, size, several):
    images = torch.arange(count * 12.0).reshape(count, 3, 2, 2)
    seen: list[torch.Size] = []

    def run(batch: torch.Tensor) -> list[torch.Tensor]:
        seen.append(batch.shape)
        sums = batch.sum(dim=(1, 2, 3))
        return [sums[:, None], -batch] if several else [sums[:, None]]

    found = run_in_batches(run, images, (size, 3, 2, 2), "graph 'a'")
    assert set(seen) == {torch.Size((size, 3, 2, 2))}
    assert len(seen) == max(1, -(-count // size))
    first = found[0] if several else found
    assert torch.equal(first, images.sum(dim=(1, 2, 3))[:, None])
    if several:
        assert torch.equal(found[1], -images)


def test_a_batch_is_contiguous_float32():
    images = torch.arange(48, dtype=torch.float64).reshape(2, 2, 4, 3).permute(0, 3, 1, 2)

    def run(batch: torch.Tensor) -> list[torch.Tensor]:
        assert batch.is_contiguous()
        assert batch.dtype == torch.float32
        return [batch]

    assert torch.equal(run_in_batches(run, images, (2, 3, 2, 4), "graph 'a'"), images.float())


@pytest.mark.parametrize("shape", [(1, 3, 2, 3), (1, 1, 2, 2), (3, 2, 2)])
def test_another_size_is_refused_by_name(shape):
    with pytest.raises(EncoderError, match=r"graph 'a' takes images of shape \(3, 2, 2\), got"):
        run_in_batches(lambda batch: [batch], torch.zeros(shape), (4, 3, 2, 2), "graph 'a'")

"""Devices that torch cannot use are refused in one short line, and half precision is for GPUs."""

from __future__ import annotations

import pytest
import torch

from fus3dmaps_core.encoders.devices import check_device, default_dtype
from fus3dmaps_core.errors import EncoderError


@pytest.mark.parametrize("device", ["mps", "xla", "hpu", "vulkan", "meta", "cuda:99", "gpu", "", "cpu\n"])
def test_what_cannot_be_used_is_named_in_one_short_line(device):
    with pytest.raises(EncoderError) as refusal:
        check_device(device)
    message = str(refusal.value)
    assert message.startswith(f"parameter 'encoder.device': torch cannot use {device!r}: ")
    assert "\n" not in message
    assert len(message) < 350


def test_the_processor_can_be_used():
    check_device("cpu")


def test_half_precision_is_for_gpus():
    assert default_dtype("cpu") is torch.float32
    assert default_dtype("cuda:0") is torch.bfloat16

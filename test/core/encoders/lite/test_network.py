"""The classifier against a plain reading of its definition, and on photographs whose class is known."""

from __future__ import annotations

import numpy as np
import pytest
import skimage.data
import torch
from torch.nn import functional

from fus3dmaps_core.encoders.lite.network import EfficientNetLite0, load_classifier
from fus3dmaps_core.encoders.lite.packaged_files import CLASSIFIER, IMAGENET_NAMES


@pytest.fixture(scope="module")
def classifier() -> EfficientNetLite0:
    return load_classifier("cpu")


def plain_features(state: dict[str, torch.Tensor], x: torch.Tensor) -> torch.Tensor:
    """Run the same network written as a list of operations on the raw weights, normalisation apart."""

    def conv(name: str, x: torch.Tensor, stride: int = 1, groups: int = 1) -> torch.Tensor:
        weight = state[f"{name}.weight"]
        kernel = weight.shape[-1]
        height, width = x.shape[-2:]
        # "Same": output ceil(size / stride), the odd pixel of padding after the image.
        pad_y = max(0, (int(np.ceil(height / stride)) - 1) * stride + kernel - height)
        pad_x = max(0, (int(np.ceil(width / stride)) - 1) * stride + kernel - width)
        x = functional.pad(x, (pad_x // 2, pad_x - pad_x // 2, pad_y // 2, pad_y - pad_y // 2))
        return functional.conv2d(x, weight, stride=stride, groups=groups)

    def norm(name: str, x: torch.Tensor) -> torch.Tensor:
        scale = state[f"{name}.weight"] / (state[f"{name}.running_var"] + 1e-3).sqrt()
        return (x - state[f"{name}.running_mean"][:, None, None]) * scale[:, None, None] + state[f"{name}.bias"][
            :, None, None
        ]

    def relu6(x: torch.Tensor) -> torch.Tensor:
        return x.clamp(0, 6)

    x = relu6(norm("_bn0", conv("_conv_stem", (x - 127) / 128, stride=2)))
    for index in range(16):
        name = f"_blocks.{index}"
        stride = 2 if index in (1, 3, 5, 11) else 1
        y = x
        if index > 0:
            y = relu6(norm(f"{name}._bn0", conv(f"{name}._expand_conv", y)))
        y = relu6(norm(f"{name}._bn1", conv(f"{name}._depthwise_conv", y, stride, groups=y.shape[1])))
        y = norm(f"{name}._bn2", conv(f"{name}._project_conv", y))
        x = x + y if y.shape == x.shape else y
    return relu6(norm("_bn1", conv("_conv_head", x)))


@pytest.mark.parametrize("size", [(64, 96), (75, 61)])
def test_features_match_a_plain_reading_of_the_weights(classifier, size, rng):
    state = torch.load(CLASSIFIER.locate(), weights_only=True)
    image = torch.from_numpy(rng.uniform(0, 255, (2, 3, *size)).astype(np.float32))
    expected = plain_features(state, image)
    found = classifier.features(image)
    assert found.shape == (2, 1280, -(-size[0] // 32), -(-size[1] // 32))
    torch.testing.assert_close(found, expected, rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize(("photograph", "name"), [("chelsea", "Egyptian cat"), ("coffee", "espresso")])
def test_photographs_are_recognised(classifier, photograph, name):
    image = torch.from_numpy(getattr(skimage.data, photograph)()).permute(2, 0, 1)[None].float()
    image = functional.interpolate(image, size=(224, 224), mode="bilinear", antialias=True)
    names = IMAGENET_NAMES.locate().read_text().splitlines()
    assert names[int(classifier(image).argmax())].startswith(name)

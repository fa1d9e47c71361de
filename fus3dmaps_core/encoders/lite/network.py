"""EfficientNet-Lite0: the image classifier behind patches and crops (Tan and Le 2019, the "Lite" variant of 2020).

No squeeze-and-excitation, ReLU6 everywhere, stem and head not scaled. Modules carry the names of the converted weights, so
that these load strictly.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional
from torch.nn.utils.fusion import fuse_conv_bn_eval

from fus3dmaps_core.encoders.lite.packaged_files import CLASSIFIER

FEATURE_STRIDE = 32
FEATURE_WIDTH = 1280
CLASSES = 1000

MEAN = 127.0
_STD = 128.0
_EPSILON = 1e-3
_POOLING = 3
# Repeats, kernel, stride of the first, expansion, channels in, channels out of each stage.
_STAGES = (
    (1, 3, 1, 1, 32, 16),
    (2, 3, 2, 6, 16, 24),
    (2, 5, 2, 6, 24, 40),
    (3, 3, 2, 6, 40, 80),
    (3, 5, 1, 6, 80, 112),
    (4, 5, 2, 6, 112, 192),
    (1, 3, 1, 6, 192, 320),
)


class _SameConv(nn.Conv2d):
    """Convolution with TensorFlow's "same" padding: where the padding is odd, the extra pixel goes right and below."""

    def forward(self, x: Tensor) -> Tensor:
        pads: list[int] = []
        for size, kernel, stride in zip(
            reversed(x.shape[-2:]), reversed(self.kernel_size), reversed(self.stride), strict=True
        ):
            total = max((-(-size // stride) - 1) * stride + kernel - size, 0)
            pads += [total // 2, total - total // 2]
        if any(pads):
            x = functional.pad(x, pads)
        return super().forward(x)


def _conv(inputs: int, outputs: int, kernel: int, stride: int = 1, groups: int = 1) -> nn.Conv2d:
    return _SameConv(inputs, outputs, kernel, stride=stride, groups=groups, bias=False)


def _norm(channels: int) -> nn.BatchNorm2d:
    return nn.BatchNorm2d(channels, eps=_EPSILON)


class _InvertedResidual(nn.Module):
    def __init__(self, inputs: int, outputs: int, kernel: int, stride: int, expansion: int) -> None:
        super().__init__()
        width = inputs * expansion
        self.expands = expansion > 1
        self.skips = stride == 1 and inputs == outputs
        if self.expands:
            self._expand_conv = _conv(inputs, width, 1)
            self._bn0 = _norm(width)
        self._depthwise_conv = _conv(width, width, kernel, stride, groups=width)
        self._bn1 = _norm(width)
        self._project_conv = _conv(width, outputs, 1)
        self._bn2 = _norm(outputs)

    def forward(self, x: Tensor) -> Tensor:
        y = x
        if self.expands:
            y = functional.relu6(self._bn0(self._expand_conv(y)))
        y = functional.relu6(self._bn1(self._depthwise_conv(y)))
        y = self._bn2(self._project_conv(y))
        result: Tensor = x + y if self.skips else y
        return result


class EfficientNetLite0(nn.Module):
    """Classifier of ImageNet-1k. Inputs are RGB in [0, 255], (n, 3, H, W) float32; see :meth:`features`."""

    def __init__(self) -> None:
        """Build the network with untrained weights."""
        super().__init__()
        self._conv_stem = _conv(3, 32, 3, 2)
        self._bn0 = _norm(32)
        self._blocks = nn.ModuleList(
            _InvertedResidual(inputs if first else outputs, outputs, kernel, stride if first else 1, expansion)
            for repeats, kernel, stride, expansion, inputs, outputs in _STAGES
            for first in (index == 0 for index in range(repeats))
        )
        self._conv_head = _conv(320, FEATURE_WIDTH, 1)
        self._bn1 = _norm(FEATURE_WIDTH)
        self._fc = nn.Linear(FEATURE_WIDTH, CLASSES)

    def fold_normalisation(self) -> None:
        """Fold the batch normalisations into the convolutions before them, which changes nothing in inference."""
        _fold(self, "_conv_stem", "_bn0")
        _fold(self, "_conv_head", "_bn1")
        for block in self._blocks:
            if hasattr(block, "_expand_conv"):
                _fold(block, "_expand_conv", "_bn0")
            _fold(block, "_depthwise_conv", "_bn1")
            _fold(block, "_project_conv", "_bn2")

    def features(self, rgb: Tensor) -> Tensor:
        """Compute the final feature map, (n, 1280, ceil(H / 32), ceil(W / 32))."""
        x = functional.relu6(self._bn0(self._conv_stem((rgb - MEAN) / _STD)))
        for block in self._blocks:
            x = block(x)
        return functional.relu6(self._bn1(self._conv_head(x)))

    def logits(self, features: Tensor) -> Tensor:
        """Compute class logits (..., 1000) of pooled or local features (..., 1280)."""
        return functional.linear(features, self._fc.weight, self._fc.bias)

    def forward(self, rgb: Tensor) -> Tensor:
        """Compute class logits (n, 1000) of whole images."""
        return self.logits(self.features(rgb).mean(dim=(2, 3)))


class PatchLogits(nn.Module):
    """Class logits of every patch: the classifier on each cell of the pooled feature map, interpolated to a finer grid."""

    def __init__(self, network: EfficientNetLite0, upsampling: int) -> None:
        """Share the classifier.

        Args:
            network: The classifier.
            upsampling: Patches along a side of a cell of its feature map.
        """
        super().__init__()
        self.network, self._upsampling = network, upsampling

    def forward(self, rgb: Tensor) -> Tensor:
        """Compute logits (n, rows, columns, 1000) of images as :class:`EfficientNetLite0` takes them."""
        features = functional.avg_pool2d(self.network.features(rgb), _POOLING, 1, _POOLING // 2, count_include_pad=False)
        logits = self.network.logits(features.permute(0, 2, 3, 1)).permute(0, 3, 1, 2)
        # The classifier is linear and the weights of the interpolation sum to one: logits of the interpolated features.
        logits = functional.interpolate(logits, scale_factor=self._upsampling, mode="bilinear", align_corners=False)
        return logits.permute(0, 2, 3, 1)


def _fold(module: nn.Module, conv: str, norm: str) -> None:
    setattr(module, conv, fuse_conv_bn_eval(getattr(module, conv), getattr(module, norm)))
    setattr(module, norm, nn.Identity())


def load_classifier(device: str) -> EfficientNetLite0:
    """Load the network with its ImageNet weights, in inference mode.

    Raises:
        EncoderError: The weights' package is missing or altered.
    """
    state = torch.load(CLASSIFIER.locate(), map_location="cpu", weights_only=True)
    network = EfficientNetLite0()
    network.load_state_dict(state, strict=True)
    network.eval().requires_grad_(False)
    network.fold_normalisation()
    # Depthwise convolutions run faster in this layout on a CPU.
    return network.to(device).to(memory_format=torch.channels_last)  # type: ignore[call-overload, no-any-return]

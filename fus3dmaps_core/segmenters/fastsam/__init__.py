"""The paper's segmenter ``fastsam`` (Zhao et al. 2023), as an exported network with pre- and post-processing of our own.

The network comes as an ONNX file that the user exports once, in an environment of its own, with the package ultralytics::

    yolo export model=FastSAM-s.pt format=onnx imgsz=480,640 opset=17

``imgsz`` is the height and width of the images it will take, multiples of 32; other images are fitted into it. The parameter
``segmenter.weights`` is that file, or a directory that holds ``FastSAM-s.onnx`` or ``FastSAM-x.onnx``.

Licence: ultralytics' package and the weights that it distributes are under the AGPL-3.0, see
:mod:`fus3dmaps_core.segmenters.fastsam.published`. Nothing of either is part of this package or imported by it.
"""

from __future__ import annotations

import numpy as np
import torch

from fus3dmaps_core.config.schema import EncoderConfig, Precision
from fus3dmaps_core.encoders.devices import check_device
from fus3dmaps_core.runtimes.example_images import pictures
from fus3dmaps_core.runtimes.exported_network import open_network
from fus3dmaps_core.runtimes.foreign_graphs import in_precision
from fus3dmaps_core.runtimes.graph_files import graph_directory
from fus3dmaps_core.runtimes.tensorrt_network import check_cuda
from fus3dmaps_core.segmenters.fastsam.contract import input_shape
from fus3dmaps_core.segmenters.fastsam.published import find_network
from fus3dmaps_core.segmenters.fastsam.segmenter import FastSamSegmenter


def load(encoder: EncoderConfig, weights: str) -> FastSamSegmenter:
    """Load the segmenter.

    Args:
        encoder: Its ``device`` is the segmenter's. With the runtime ``tensorrt`` the network runs there, in ``precision``,
            whose files are kept in ``graph_directory``; with all others in ONNX Runtime, as exported.
        weights: The exported network or its directory, see above; "" for this package's cache.

    Raises:
        EncoderError: The device cannot be used, a package is missing, or there is no exported network or another one's.
    """
    check_device(encoder.device)
    path = find_network(weights)
    height, width = input_shape(path)
    directory = graph_directory(encoder.graph_directory)
    precision: Precision = "fp32"
    if encoder.runtime == "tensorrt":
        check_cuda(encoder.device)
        precision = encoder.precision
        images = torch.from_numpy(np.stack(pictures(height, width))).permute(0, 3, 1, 2).float().div_(255.0)
        path = in_precision(path, precision, directory, images)
    network = open_network(path, encoder.device, encoder.runtime, precision, directory)
    return FastSamSegmenter(network, (height, width), encoder.device)

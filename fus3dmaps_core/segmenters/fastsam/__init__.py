"""The paper's segmenter ``fastsam`` (Zhao et al. 2023), as an exported network with pre- and post-processing of our own.

The network comes as an ONNX file that the user exports once, in an environment of its own, with the package ultralytics::

    yolo export model=FastSAM-s.pt format=onnx imgsz=480,640 opset=17

``imgsz`` is the height and width of the images it will take, multiples of 32; other images are fitted into it. The parameter
``segmenter.weights`` is that file, or a directory that holds ``FastSAM-s.onnx`` or ``FastSAM-x.onnx``.

Licence: ultralytics' package and the weights that it distributes are under the AGPL-3.0, see
:mod:`fus3dmaps_core.segmenters.fastsam.published`. Nothing of either is part of this package or imported by it.
"""

from __future__ import annotations

from fus3dmaps_core.config import Runtime
from fus3dmaps_core.encoders.devices import check_device
from fus3dmaps_core.runtimes.graph_files import graph_directory
from fus3dmaps_core.runtimes.opening import open_network
from fus3dmaps_core.segmenters.fastsam.contract import input_shape
from fus3dmaps_core.segmenters.fastsam.published import find_network
from fus3dmaps_core.segmenters.fastsam.segmenter import FastSamSegmenter


def load(device: str, weights: str, runtime: Runtime) -> FastSamSegmenter:
    """Load the segmenter.

    Args:
        device: Torch device, e.g. ``cpu`` or ``cuda:0``.
        weights: The exported network or its directory, see above; "" for this package's cache.
        runtime: ``tensorrt`` runs the network there, in the precision of its file; all others in ONNX Runtime.

    Raises:
        EncoderError: The device cannot be used, a package is missing, or there is no exported network or another one's.
    """
    check_device(device)
    path = find_network(weights)
    shape = input_shape(path)
    chosen: Runtime = "tensorrt" if runtime == "tensorrt" else "onnxruntime"
    return FastSamSegmenter(open_network(path, device, chosen, "fp32", graph_directory("")), shape, device)

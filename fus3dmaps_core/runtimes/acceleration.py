"""The networks of a trio, run by the runtime that the configuration names instead of plain torch.

This concerns images alone. The text tower stays in torch: prompts are rare and short.
"""

from __future__ import annotations

from fus3dmaps_core.config.schema import EncoderConfig, ImageConfig
from fus3dmaps_core.encoders.network_graphs import Network
from fus3dmaps_core.encoders.protocols import EncoderTrio
from fus3dmaps_core.runtimes.compiled_network import CompiledNetwork
from fus3dmaps_core.runtimes.exported_network import open_network
from fus3dmaps_core.runtimes.exporting import NamedEncoder, ensure_exported, graph_encoders
from fus3dmaps_core.runtimes.graph_files import graph_directory, own_precision
from fus3dmaps_core.runtimes.image_memory import naming_image_size
from fus3dmaps_core.runtimes.packages import import_onnxruntime, import_tensorrt
from fus3dmaps_core.runtimes.tensorrt_network import check_cuda


def accelerate(trio: EncoderTrio, encoder: EncoderConfig, image: ImageConfig) -> EncoderTrio:
    """Have the networks of a trio run by ``encoder.runtime``.

    Graphs and engines that are not in ``encoder.graph_directory`` yet are made there, which takes minutes the first time.
    With ``encoder.instance_embeddings: patches`` the crop encoder stays in torch, since it only embeds the image of a query
    then.

    Args:
        trio: The trio as loaded; its encoders are changed.
        encoder: Runtime, precision, device and directory.
        image: Size of the images that will be embedded.

    Returns:
        The trio.

    Raises:
        EncoderError: The runtime or its packages are missing or not for this device, an encoder has no graph, or a graph
            cannot be made, for lack of memory if the images are too large. The trio then is as it was.
    """
    if encoder.runtime == "torch":
        return trio
    chosen = graph_encoders(trio, with_crops=encoder.instance_embeddings == "crops")
    if encoder.runtime == "tensorrt":
        check_cuda(encoder.device)
        import_tensorrt()
    if encoder.runtime == "onnxruntime":
        import_onnxruntime()
    with naming_image_size(trio.name, image.height, image.width):
        networks = [_network(named, encoder, image) for named in chosen]
    for named, network in zip(chosen, networks, strict=True):
        named.encoder.run_with(network)
    return trio


def _network(named: NamedEncoder, encoder: EncoderConfig, image: ImageConfig) -> Network:
    graph = named.encoder.graph(image.height, image.width)
    if encoder.runtime == "compile":
        return CompiledNetwork(graph, named.trio, encoder.device)
    precision = encoder.precision if encoder.runtime == "tensorrt" else own_precision(graph.network)
    directory = graph_directory(encoder.graph_directory)
    path = ensure_exported(named, precision, directory, image.height, image.width)
    return open_network(path, encoder.device, encoder.runtime, precision, directory)

"""Which file of weights SAM 2.1 needs, where it is published, and under which licence."""

from __future__ import annotations

from fus3dmaps_core.encoders.weights import WeightFile

PARAMETER = "segmenter.weights"

SAM2 = WeightFile(
    title="SAM 2.1 Hiera tiny",
    file_name="model.safetensors",
    url="",
    hub="facebook/sam2.1-hiera-tiny",
    revision="de431c4043854a71d8101e17995dfe596bf101a5",
    sha256="",
    licence="Apache-2.0",
)

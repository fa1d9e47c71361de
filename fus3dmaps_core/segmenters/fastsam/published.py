"""Where FastSAM's exported network lies, how it is made, and under which licence.

Nobody publishes it as ONNX: ultralytics' ``.pt`` files are pickles of Python objects, which are never read here, and its
package exports them. That package and the weights it distributes are under the AGPL-3.0 (or a licence bought from
ultralytics), and the files it exports say so. FastSAM's authors state Apache-2.0 for their model, in a repository that holds
a copy of ultralytics' AGPL-3.0 code. Neither is part of fus3dmaps: whoever exports the file and runs it decides under which
of these terms.
"""

from __future__ import annotations

from pathlib import Path

from fus3dmaps_core.encoders.weights import WeightFile, local_path
from fus3dmaps_core.errors import EncoderError

PARAMETER = "segmenter.weights"
LICENCE = "AGPL-3.0 (ultralytics), Apache-2.0 as stated by FastSAM's authors"


def _exported(name: str) -> WeightFile:
    return WeightFile(title=name, file_name=f"{name}.onnx", url="", hub="", revision="", sha256="", licence=LICENCE)


FASTSAM_S = _exported("FastSAM-s")
FASTSAM_X = _exported("FastSAM-x")
FILES = (FASTSAM_S, FASTSAM_X)
"""In the order in which they are looked for."""


def find_network(value: str) -> Path:
    """Find the exported network.

    Args:
        value: Value of the parameter ``segmenter.weights``: the file, or a directory that holds ``FastSAM-s.onnx`` or
            ``FastSAM-x.onnx``; "" for this package's own cache.

    Raises:
        EncoderError: There is no such file; the message says how to export it and where to put it.
    """
    if not value:
        candidates = [file.cached_path for file in FILES]
        reason = "it is not in this package's cache"
    else:
        path = local_path(value)
        if path is None:
            raise refusal(f"there is no file or directory '{value}'")
        candidates = [path / file.file_name for file in FILES] if path.is_dir() else [path]
        reason = f"directory '{path}' has neither '{FASTSAM_S.file_name}' nor '{FASTSAM_X.file_name}'"
    found = next((path for path in candidates if path.is_file()), None)
    if found is None:
        raise refusal(reason)
    if found.suffix != ".onnx":
        raise refusal(f"'{found}' is no .onnx file, and ultralytics' own files hold Python objects, which are not loaded")
    return found


def refusal(reason: str) -> EncoderError:
    """Make the error that says why there is no network to run, and how to get one."""
    return EncoderError(
        f"parameter '{PARAMETER}': FastSAM: {reason}; export it once with the package ultralytics (code and weights "
        f"AGPL-3.0) by 'yolo export model=FastSAM-s.pt format=onnx imgsz=480,640 opset=17', and put "
        f"{FASTSAM_S.file_name} at '{FASTSAM_S.cached_path}', or set '{PARAMETER}' to where it lies"
    )

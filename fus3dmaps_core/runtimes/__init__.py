"""Runtimes of the encoders' networks other than plain torch: exported graphs in ONNX Runtime or TensorRT, torch.compile."""

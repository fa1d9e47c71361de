"""What runs the encoders' networks other than torch as it is: exported graphs in ONNX Runtime or TensorRT, torch.compile."""

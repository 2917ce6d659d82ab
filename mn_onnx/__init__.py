"""mn-onnx: exact level sets of networks exported to ONNX."""

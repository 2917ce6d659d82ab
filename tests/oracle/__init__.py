"""An independent oracle: tiny networks, their exact level sets, and comparisons with the product.

It shares no code with the extraction. Only the network contract (`mn_onnx.ir.network`) is common to both.
"""

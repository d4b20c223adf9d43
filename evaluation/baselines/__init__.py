"""Other people's policies: a card says how an ONNX file is run, and with it the file is a whole-body controller."""

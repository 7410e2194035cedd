"""`deepracer-exp export` and `check`: a policy as files of the service, of the car, or of ONNX."""

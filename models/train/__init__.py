"""Training project of the small fire and smoke detector `ember-nano.onnx`."""

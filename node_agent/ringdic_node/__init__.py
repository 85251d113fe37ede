"""The program on every camera node: triggered by the controller, it captures a still and delivers it without loss."""

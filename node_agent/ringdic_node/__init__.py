"""The agent on every camera node: armed, triggered, it captures a still and delivers it without loss."""

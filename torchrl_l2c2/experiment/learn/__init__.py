"""Replay buffers, gradient steps, and their compilation."""
